//! The file of a black box: a mark, a header in JSON, records of one size, and a checksum over all of it. Integers and
//! floats are little-endian, so that a file may be read on another machine than its own.

pub mod record;

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::fmt;
use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use self::record::{RECORD, get, put};
use fieldbeat_core::axis::{Fault, MONITOR_CHANNELS};
use fieldbeat_core::cycle::record::Record;

/// What a file begins with: the name, and the version of its layout.
const MARK: [u8; 8] = *b"FBBOX\0\x04\n";

/// The oldest layout that is read. Layout 1 has no monitored variables; up to layout 2 every drive has a
/// position, and the header has no names of faults; up to layout 3 the grid follows the clock of the computer.
/// Emergencies came later, in bytes that were 0 before: any layout may have them.
const OLDEST: u8 = 1;

/// Bytes before the header: the mark, and the length of the header.
const BEFORE_HEADER: usize = MARK.len() + 4;

/// Bytes of a file without its header and its records: mark, length of the header, count of the records, checksum.
const FRAME: u64 = 24;

/// A header that is larger is none of ours: that of 256 axes has some 100 kB.
const MOST_HEADER: u64 = 16 << 20;

/// What the records are of.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// Version of the program that wrote it.
    pub program: String,
    /// The configuration.
    pub machine: Option<String>,
    /// Why it was written.
    pub why: String,
    /// The cycle in which that happened.
    pub cycle: u64,
    /// When it was written, UTC.
    pub written: String,
    /// The period of the cycle.
    pub period_ns: u64,
    /// Replies were taken so long after a grid point.
    pub deadline_ns: u64,
    /// The threshold of a late cycle.
    pub late_ns: u64,
    /// The bus whose clock led the grid; `None` = ours did.
    #[serde(default)]
    pub reference: Option<String>,
    /// The axes.
    pub axes: Vec<Axis>,
    /// Kernel release.
    pub kernel: Option<String>,
    /// Preemption model.
    pub preemption: Option<String>,
    /// Processor.
    pub cpu: Option<String>,
}

/// An axis.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Axis {
    /// Its name.
    pub name: String,
    /// Its user unit.
    pub unit: String,
    /// On a rotary axis: the length of a turn. Older files do not have it.
    #[serde(default)]
    pub modulo: Option<f64>,
    /// The monitored variables of its drive, channel by channel.
    #[serde(default)]
    pub monitor: [Option<Channel>; MONITOR_CHANNELS],
    /// What its protocol calls the fault codes that occur in the records.
    #[serde(default)]
    pub faults: BTreeMap<u32, String>,
}

impl Axis {
    /// A fault of its drive.
    pub fn fault(&self, code: u32) -> Fault<'_> {
        Fault { code, name: self.faults.get(&code).map(String::as_str) }
    }
}

/// A monitored variable of a drive.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Channel {
    /// Its name.
    pub name: String,
    /// Of its values; empty for a plain number.
    pub unit: String,
}

/// Why a file cannot be read. The message ends with the remedy.
pub struct ReadError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it.
    pub why: Wrong,
}

/// What is wrong with a file or its bytes, for where the file is named already.
#[derive(Error)]
pub enum Wrong {
    /// The operating system refused.
    #[error("{0}")]
    Io(#[from] io::Error),
    /// It does not begin like a black box.
    #[error("not a black-box file")]
    Foreign,
    /// Of another version: its layout.
    #[error("layout {0} of another version")]
    Version(u8),
    /// Cut off, or changed.
    #[error("{0}")]
    Damaged(&'static str),
}
fieldbeat_core::debug_as_display!(ReadError, Wrong);

impl fmt::Display for ReadError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const NAME_ONE: &str = "name a file that fieldbeat wrote (*.blackbox)";
        let path = self.path.display();
        match &self.why {
            Wrong::Io(error) => write!(f, "cannot read {path}: {error}; {NAME_ONE}"),
            Wrong::Foreign => write!(f, "{path} is not a black-box file; {NAME_ONE}"),
            Wrong::Version(found) => {
                let newest = MARK[6];
                write!(f, "{path} has layout {found}, this program reads {OLDEST} to {newest}; ")?;
                f.write_str("read it with the version that wrote it")
            }
            Wrong::Damaged(what) => {
                write!(f, "{path} is damaged: {what}; copy it again from where it was written")
            }
        }
    }
}

/// The bytes of a file.
pub fn encode<'a>(header: &Header, records: impl ExactSizeIterator<Item = &'a Record>) -> Vec<u8> {
    // A header of strings and numbers can always be written.
    let header = serde_json::to_vec(header).unwrap_or_default();
    let mut bytes = Vec::with_capacity(MARK.len() + 16 + header.len() + records.len() * RECORD);
    bytes.extend_from_slice(&MARK);
    bytes.extend_from_slice(&(header.len() as u32).to_le_bytes());
    bytes.extend_from_slice(&header);
    bytes.extend_from_slice(&(records.len() as u64).to_le_bytes());
    for record in records {
        put(record, &mut bytes);
    }
    let sum = crc32fast::hash(&bytes);
    bytes.extend_from_slice(&sum.to_le_bytes());
    bytes
}

/// Reads a file.
pub fn load(path: &Path) -> Result<(Header, Vec<Record>), ReadError> {
    let whole = || {
        let (file, size) = open(path)?;
        let mut bytes = read_begin(&file, size)?;
        // Not more than there was: whoever writes to it meanwhile writes no black box.
        (&file).take(size - bytes.len() as u64).read_to_end(&mut bytes)?;
        decode(&bytes)
    };
    whole().map_err(|why| ReadError { path: path.to_owned(), why })
}

/// Reads the header of a file alone; whether the records behind it are whole is seen by their number only.
pub fn load_header(path: &Path) -> Result<Header, ReadError> {
    let header = open(path).and_then(|(file, size)| header_of(&read_begin(&file, size)?));
    header.map_err(|why| ReadError { path: path.to_owned(), why })
}

/// Opens a file without waiting for anybody, as one would for the writer of a pipe; with its size.
fn open(path: &Path) -> Result<(File, u64), Wrong> {
    let file = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK).open(path)?;
    let facts = file.metadata()?;
    if facts.is_file() { Ok((file, facts.len())) } else { Err(Wrong::Foreign) }
}

/// The bytes up to the records, step by step: what they say of themselves must agree with the size of the file before
/// more is read, or a damaged one would take all of the memory.
fn read_begin(file: &File, size: u64) -> Result<Vec<u8>, Wrong> {
    let mut bytes = Vec::new();
    file.take(BEFORE_HEADER as u64).read_to_end(&mut bytes)?;
    let header = header_length(&bytes, size)?;
    file.take(header + 8).read_to_end(&mut bytes)?;
    end_of_header(&bytes, size)?;
    Ok(bytes)
}

/// Whether bytes begin like those of a file.
fn look_at_mark(bytes: &[u8]) -> Result<(), Wrong> {
    match bytes.first_chunk::<8>() {
        Some(mark) if mark[..6] != MARK[..6] || mark[7] != MARK[7] => Err(Wrong::Foreign),
        Some(mark) if !(OLDEST..=MARK[6]).contains(&mark[6]) => Err(Wrong::Version(mark[6])),
        Some(_) => Ok(()),
        None => Err(Wrong::Foreign),
    }
}

/// What the bytes of a file say.
pub fn decode(bytes: &[u8]) -> Result<(Header, Vec<Record>), Wrong> {
    let end = end_of_header(bytes, bytes.len() as u64)?;
    let (rest, sum) = bytes.split_last_chunk::<4>().ok_or(CUT)?;
    if crc32fast::hash(rest) != u32::from_le_bytes(*sum) {
        return Err(Wrong::Damaged("its checksum is wrong"));
    }
    let header = header_of(bytes)?;
    let records = rest.get(end..).ok_or(CUT)?.chunks_exact(RECORD);
    let records = records.map(|bytes| get(bytes, header.axes.len()));
    let records = records.collect::<Option<_>>().ok_or(Wrong::Damaged("a record cannot be read"))?;
    Ok((header, records))
}

const CUT: Wrong = Wrong::Damaged("its end is missing");

/// The length of the header of a file of `size` bytes that begins like this.
fn header_length(begin: &[u8], size: u64) -> Result<u64, Wrong> {
    look_at_mark(begin)?;
    let length = begin.get(MARK.len()..).and_then(<[u8]>::first_chunk).ok_or(CUT)?;
    match u64::from(u32::from_le_bytes(*length)) {
        length if length + FRAME > size => Err(CUT),
        length if length > MOST_HEADER => Err(Wrong::Damaged("its header is too long")),
        length => Ok(length),
    }
}

/// Where the records of a file of `size` bytes begin, if it has as many bytes as its begin says.
fn end_of_header(begin: &[u8], size: u64) -> Result<usize, Wrong> {
    let header = header_length(begin, size)?;
    let place = BEFORE_HEADER + header as usize;
    let count = begin.get(place..).and_then(<[u8]>::first_chunk).ok_or(CUT)?;
    let records = u64::from_le_bytes(*count).checked_mul(RECORD as u64);
    let expected = records.and_then(|records| records.checked_add(FRAME + header));
    match expected.map(|expected| size.cmp(&expected)) {
        Some(Ordering::Equal) => Ok(place + 8),
        Some(Ordering::Greater) => Err(Wrong::Damaged("it has more bytes than its header says")),
        Some(Ordering::Less) | None => Err(CUT),
    }
}

/// The header of a file whose size was looked at.
fn header_of(begin: &[u8]) -> Result<Header, Wrong> {
    let length = header_length(begin, u64::MAX)? as usize;
    let header = begin.get(BEFORE_HEADER..BEFORE_HEADER + length).ok_or(CUT)?;
    serde_json::from_slice(header).map_err(|_| Wrong::Damaged("its header cannot be read"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::axis::{Emergency, Link, State, StopCause};
    use fieldbeat_core::cycle::record::{
        CycleRecord, DriveRecord, Look, MonitorRecord, ReferenceRecord, Reply, SkippedRecord, measured,
    };
    use fieldbeat_core::time::Time;

    fn header() -> Header {
        let axis = |name: &str| Axis { name: name.into(), unit: "mm".into(), ..Axis::default() };
        let channel = |name: &str, unit: &str| Some(Channel { name: name.into(), unit: unit.into() });
        let monitor = [channel("demand-current", "A"), None, channel("0x1E10", ""), None];
        Header {
            why: "drive x: link lost".into(),
            cycle: 7,
            axes: vec![
                Axis { modulo: Some(360.0), ..axis("x") },
                Axis { monitor, faults: [(5, "too hot".into())].into(), ..axis("y") },
            ],
            ..Header::default()
        }
    }

    fn records() -> Vec<Record> {
        vec![
            Record::Drive(DriveRecord {
                index: u64::MAX,
                axis: 1,
                reply: Reply::Unsent,
                link: Link::Lost,
                state: State::Fault,
                stopped: Some(StopCause::GroupFailed),
                command: 12,
                moving: true,
                sto_open: true,
                was_online: true,
                phase_ns: measured(1),
                jitter_ns: None,
                rtt_ns: measured(u64::MAX),
                age_ns: measured(4),
                fault: 5,
                warning: 6,
                emergency: Some(Emergency { code: 0x4310, register: 8 }.into()),
                current: -1.5,
                velocity: 2.5,
                position: f64::MIN,
                demand: 1e-9,
            }),
            Record::Monitor(MonitorRecord {
                index: u64::MAX - 1,
                axis: 1,
                shown: [Some(-0.25), None, Some(f64::MAX), None].into(),
            }),
            Record::Reference(ReferenceRecord {
                index: 25,
                error_ns: Some(i32::MIN),
                step_ns: -26,
                locked: true,
                counts: true,
            }),
            Record::Reference(ReferenceRecord { index: 27, ..ReferenceRecord::default() }),
            Record::Cycle(CycleRecord {
                index: 7,
                grid: Time(8),
                wake_ns: 9,
                spun: true,
                jitter_ns: 10,
                stages_ns: [11, 12, 13, 14, 15, 16],
                missed: 17,
                look: Some(Look { faults: 18, switches: 19 }),
            }),
            Record::Skipped(SkippedRecord {
                first: 20,
                grid: Time(21),
                count: 22,
                late_ns: 23,
                given_up_ns: 24,
                woke_late: true,
                late: true,
                spun: false,
                look: None,
            }),
        ]
    }

    #[test]
    fn what_is_written_is_read() {
        let bytes = encode(&header(), records().iter());
        assert_eq!(decode(&bytes).unwrap(), (header(), records()));
        assert_eq!(decode(&encode(&header(), [].iter())).unwrap(), (header(), Vec::new()));
    }

    #[test]
    fn an_axis_that_is_not_in_the_header_is_damage() {
        let mut header = header();
        header.axes.pop();
        for record in &records()[..2] {
            let bytes = encode(&header, [record].into_iter());
            assert_eq!(decode(&bytes).unwrap_err().to_string(), "a record cannot be read");
        }
    }

    #[test]
    fn a_directory_and_a_missing_file_are_one_clear_line() {
        let directory = tempfile::tempdir().unwrap();
        for path in [directory.path().to_owned(), directory.path().join("none"), "/dev/zero".into()] {
            let text = load(&path).unwrap_err().to_string();
            assert!(!text.contains('\n') && text.contains("*.blackbox"), "{text}");
        }
    }

    #[test]
    fn neither_a_pipe_nor_a_huge_file_is_waited_for() {
        let directory = tempfile::tempdir().unwrap();
        let [pipe, huge] = ["pipe", "huge"].map(|name| directory.path().join(name));
        let name = std::ffi::CString::new(pipe.as_os_str().as_encoded_bytes()).unwrap();
        // SAFETY: a string that ends with its zero.
        assert_eq!(unsafe { libc::mkfifo(name.as_ptr(), 0o600) }, 0);
        assert!(matches!(load(&pipe).unwrap_err().why, Wrong::Foreign));
        // Sparse: it takes no room on the disk, and more memory than there is.
        File::create(&huge).unwrap().set_len(1 << 42).unwrap();
        // proc_pid_io(5): all that this thread has read.
        let read = || {
            let io = std::fs::read_to_string("/proc/thread-self/io").unwrap();
            io.lines().find_map(|line| line.strip_prefix("rchar: ")?.parse::<u64>().ok()).unwrap()
        };
        let before = read();
        assert!(matches!(load(&huge).unwrap_err().why, Wrong::Foreign));
        for begin in [MARK.to_vec(), [&MARK[..], &u32::MAX.to_le_bytes()].concat()] {
            std::fs::write(&huge, &begin).unwrap();
            OpenOptions::new().write(true).open(&huge).unwrap().set_len(1 << 42).unwrap();
            assert!(matches!(load(&huge).unwrap_err().why, Wrong::Damaged(_)));
        }
        let bytes = read() - before;
        assert!(bytes < 1 << 20, "{bytes} bytes of files that are none");
    }

    #[test]
    fn a_file_has_as_many_bytes_as_it_says() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("box");
        let whole = encode(&header(), records().iter());
        let cases = [
            (whole.clone(), None),
            (whole[..whole.len() - 1].to_vec(), Some("its end is missing")),
            (whole[..40].to_vec(), Some("its end is missing")),
            ([&whole[..], &[0]].concat(), Some("it has more bytes than its header says")),
        ];
        for (bytes, expected) in cases {
            std::fs::write(&path, bytes).unwrap();
            for what in [load(&path).map(drop), load_header(&path).map(drop)] {
                let why = what.err().map(|error| error.why.to_string());
                assert_eq!(why.as_deref(), expected);
            }
        }
    }
}
