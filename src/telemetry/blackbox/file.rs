//! The file of a black box: a mark, a header in JSON, records of one size, and a checksum over all of it. Integers and
//! floats are little-endian, so that a file may be read on another machine than its own.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::num::NonZeroU32;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::axis::{Emergency, Fault, Link, MONITOR_CHANNELS, Shown, State, StopCause};
use crate::cycle::record::{
    CycleRecord, DriveRecord, Look, MonitorRecord, Record, ReferenceRecord, Reply, SkippedRecord,
};
use crate::time::Time;

/// What a file begins with: the name, and the version of its layout.
const MARK: [u8; 8] = *b"FBBOX\0\x04\n";

/// The oldest layout that is read. Layout 1 has no monitored variables; up to layout 2 every drive has a
/// position, and the header has no names of faults; up to layout 3 the grid follows the clock of the computer.
/// Emergencies came later, in bytes that were 0 before: any layout may have them.
const OLDEST: u8 = 1;

/// Bytes of a record.
const RECORD: usize = 72;

/// Bytes of a file without its header and its records: mark, length of the header, count of the records, checksum.
const FRAME: u64 = 24;

/// A header that is larger is none of ours: that of 256 axes has some 100 kB.
const MOST_HEADER: u64 = 16 << 20;

/// What the records are of.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
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
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Axis {
    /// Its name.
    pub name: String,
    /// Its user unit.
    pub unit: String,
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
#[derive(Error)]
pub enum ReadError {
    /// The operating system refused.
    #[error("cannot read {path}: {error}; name a file that fieldbeat wrote (*.blackbox)")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        error: io::Error,
    },
    /// It does not begin like one.
    #[error("{0} is not a black-box file; name a file that fieldbeat wrote (*.blackbox)")]
    Foreign(PathBuf),
    /// Of another version.
    #[error(
        "{path} has layout {found}, this program reads {OLDEST} to {}; read it with the version that wrote it",
        MARK[6]
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// Its layout.
        found: u8,
    },
    /// Cut off, or changed.
    #[error("{path} is damaged: {what}; copy it again from where it was written")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: &'static str,
    },
}
crate::errors::debug_as_display!(ReadError);

impl ReadError {
    /// The reason alone, for where the file is named already.
    pub fn reason(&self) -> String {
        match self {
            ReadError::Io { error, .. } => error.to_string(),
            ReadError::Foreign(_) => "not a black-box file".to_owned(),
            ReadError::Version { found, .. } => format!("layout {found} of another version"),
            ReadError::Damaged { what, .. } => (*what).to_owned(),
        }
    }

    fn of(wrong: Wrong, path: &Path) -> ReadError {
        let path = path.to_owned();
        match wrong {
            Wrong::Foreign => ReadError::Foreign(path),
            Wrong::Version(found) => ReadError::Version { path, found },
            Wrong::Damaged(what) => ReadError::Damaged { path, what },
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
        let begin = bytes.len();
        put(record, &mut bytes);
        bytes.resize(begin + RECORD, 0);
    }
    let sum = crc32fast::hash(&bytes);
    bytes.extend_from_slice(&sum.to_le_bytes());
    bytes
}

/// Reads a file.
pub fn load(path: &Path) -> Result<(Header, Vec<Record>), ReadError> {
    let failed = |error| ReadError::Io { path: path.to_owned(), error };
    let (file, size) = open(path)?;
    let mut bytes = read_begin(&file, size, path)?;
    // Not more than there was: whoever writes to it meanwhile writes no black box.
    (&file).take(size - bytes.len() as u64).read_to_end(&mut bytes).map_err(failed)?;
    decode(&bytes).map_err(|wrong| ReadError::of(wrong, path))
}

/// Reads the header of a file alone; whether the records behind it are whole is seen by their number only.
pub fn load_header(path: &Path) -> Result<Header, ReadError> {
    let (file, size) = open(path)?;
    let begin = read_begin(&file, size, path)?;
    header_of(&begin).map_err(|wrong| ReadError::of(wrong, path))
}

/// Opens a file without waiting for anybody, as one would for the writer of a pipe; with its size.
fn open(path: &Path) -> Result<(File, u64), ReadError> {
    let failed = |error| ReadError::Io { path: path.to_owned(), error };
    let file = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK).open(path).map_err(failed)?;
    let facts = file.metadata().map_err(failed)?;
    if !facts.is_file() {
        return Err(ReadError::Foreign(path.to_owned()));
    }
    Ok((file, facts.len()))
}

/// The bytes up to the records, step by step: what they say of themselves must agree with the size of the file before
/// more is read, or a damaged one would take all of the memory.
fn read_begin(mut file: &File, size: u64, path: &Path) -> Result<Vec<u8>, ReadError> {
    let mut bytes = Vec::new();
    let mut take = |length, bytes: &mut Vec<u8>| {
        let failed = |error| ReadError::Io { path: path.to_owned(), error };
        Read::by_ref(&mut file).take(length).read_to_end(bytes).map_err(failed)
    };
    take(MARK.len() as u64 + 4, &mut bytes)?;
    let header = header_length(&bytes, size).map_err(|wrong| ReadError::of(wrong, path))?;
    take(header + 8, &mut bytes)?;
    look_at_size(&bytes, size).map_err(|wrong| ReadError::of(wrong, path))?;
    Ok(bytes)
}

/// What is wrong with bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wrong {
    /// Not of this kind.
    Foreign,
    /// Of another version.
    Version(u8),
    /// Cut off, or changed.
    Damaged(&'static str),
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
    let end = look_at_size(bytes, bytes.len() as u64)?;
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
    let length = Take(begin.get(MARK.len()..).ok_or(CUT)?).u32().ok_or(CUT)?;
    match u64::from(length) {
        length if length + FRAME > size => Err(CUT),
        length if length > MOST_HEADER => Err(Wrong::Damaged("its header is too long")),
        length => Ok(length),
    }
}

/// Where the records of a file of `size` bytes begin, if it has as many bytes as its begin says.
fn look_at_size(begin: &[u8], size: u64) -> Result<usize, Wrong> {
    let header = header_length(begin, size)?;
    let place = MARK.len() + 4 + header as usize;
    let count = Take(begin.get(place..).ok_or(CUT)?).u64().ok_or(CUT)?;
    let expected = count.checked_mul(RECORD as u64).and_then(|records| records.checked_add(FRAME + header));
    match expected.map(|expected| size.cmp(&expected)) {
        Some(Ordering::Equal) => Ok(place + 8),
        Some(Ordering::Greater) => Err(Wrong::Damaged("it has more bytes than its header says")),
        Some(Ordering::Less) | None => Err(CUT),
    }
}

/// The header of a file whose size was looked at.
fn header_of(begin: &[u8]) -> Result<Header, Wrong> {
    let mut take = Take(begin.get(MARK.len()..).ok_or(CUT)?);
    let length = take.u32().ok_or(CUT)? as usize;
    let header = take.bytes(length).ok_or(CUT)?;
    serde_json::from_slice(header).map_err(|_| Wrong::Damaged("its header cannot be read"))
}

const LOOKED: u8 = 1;
const SPUN: u8 = 2;
const WOKE_LATE: u8 = 4;
const LATE: u8 = 8;
const MOVING: u8 = 1;
const INHIBITED: u8 = 2;
const WAS_ONLINE: u8 = 4;
const TOLD: u8 = 1;
const LOCKED: u8 = 2;
const COUNTS: u8 = 4;

fn flag(set: bool, bit: u8) -> u8 {
    if set { bit } else { 0 }
}

fn put(record: &Record, to: &mut Vec<u8>) {
    match record {
        Record::Drive(d) => {
            let stopped = d.stopped.map_or(0, |cause| cause as u8);
            let flags =
                flag(d.moving, MOVING) | flag(d.inhibited, INHIBITED) | flag(d.was_online, WAS_ONLINE);
            to.extend_from_slice(&[1, d.reply as u8, d.link as u8, d.state as u8, stopped, d.verb, flags, 0]);
            to.extend_from_slice(&d.index.to_le_bytes());
            to.extend_from_slice(&u32::from(d.axis).to_le_bytes());
            for ns in [d.phase_ns, d.jitter_ns, d.rtt_ns, d.age_ns] {
                to.extend_from_slice(&ns.map_or(0, NonZeroU32::get).to_le_bytes());
            }
            for word in [d.fault, d.warning, d.current.to_bits(), d.velocity.to_bits()] {
                to.extend_from_slice(&word.to_le_bytes());
            }
            for value in [d.position, d.demand] {
                to.extend_from_slice(&value.to_le_bytes());
            }
            let Emergency { code, register } = d.emergency().unwrap_or_default();
            to.extend_from_slice(&code.to_le_bytes());
            to.extend_from_slice(&[register, flag(d.emergency.is_some(), TOLD)]);
        }
        Record::Monitor(m) => {
            let (mask, values) = m.shown.to_words();
            to.extend_from_slice(&[4, mask, 0, 0]);
            to.extend_from_slice(&u32::from(m.axis).to_le_bytes());
            for word in [m.index].into_iter().chain(values) {
                to.extend_from_slice(&word.to_le_bytes());
            }
        }
        Record::Reference(r) => {
            let flags = flag(r.error_ns.is_some(), TOLD) | flag(r.locked, LOCKED) | flag(r.counts, COUNTS);
            to.extend_from_slice(&[5, flags, 0, 0, 0, 0, 0, 0]);
            to.extend_from_slice(&r.index.to_le_bytes());
            for ns in [r.error_ns.unwrap_or_default(), r.step_ns] {
                to.extend_from_slice(&ns.to_le_bytes());
            }
        }
        Record::Cycle(c) => {
            let flags = flag(c.spun, SPUN) | flag(c.look.is_some(), LOOKED);
            to.extend_from_slice(&[2, flags, 0, 0]);
            to.extend_from_slice(&u32::from(c.missed).to_le_bytes());
            to.extend_from_slice(&c.index.to_le_bytes());
            to.extend_from_slice(&c.grid.0.to_le_bytes());
            let look = c.look.unwrap_or_default();
            for word in
                [c.wake_ns, c.jitter_ns].into_iter().chain(c.stages_ns).chain([look.faults, look.switches])
            {
                to.extend_from_slice(&word.to_le_bytes());
            }
        }
        Record::Skipped(s) => {
            let flags = flag(s.spun, SPUN)
                | flag(s.woke_late, WOKE_LATE)
                | flag(s.late, LATE)
                | flag(s.look.is_some(), LOOKED);
            to.extend_from_slice(&[3, flags, 0, 0, 0, 0, 0, 0]);
            for word in [s.first, s.grid.0, s.count, s.late_ns, s.given_up_ns] {
                to.extend_from_slice(&word.to_le_bytes());
            }
            let look = s.look.unwrap_or_default();
            for word in [look.faults, look.switches] {
                to.extend_from_slice(&word.to_le_bytes());
            }
        }
    }
}

/// A record; `None` if a number in it has no meaning here.
fn get(bytes: &[u8], axes: usize) -> Option<Record> {
    let mut take = Take(bytes);
    let [kind, flags, link, state] = *take.array()?;
    let look = |set: u8, faults, switches| (set & LOOKED != 0).then_some(Look { faults, switches });
    let known = |axis: u32| u16::try_from(axis).ok().filter(|axis| usize::from(*axis) < axes);
    Some(match kind {
        1 => {
            let [stopped, verb, marks, _] = *take.array()?;
            let stopped = match stopped {
                0 => None,
                code => Some(*StopCause::ALL.get(usize::from(code) - 1)?),
            };
            let index = take.u64()?;
            let axis = known(take.u32()?)?;
            let [phase_ns, jitter_ns, rtt_ns, age_ns] = take.u32s()?.map(NonZeroU32::new);
            let [fault, warning, current, velocity] = take.u32s()?;
            Record::Drive(DriveRecord {
                index,
                axis,
                reply: *Reply::ALL.get(usize::from(flags))?,
                link: *Link::ALL.get(usize::from(link))?,
                state: *State::ALL.get(usize::from(state))?,
                stopped,
                verb,
                moving: marks & MOVING != 0,
                inhibited: marks & INHIBITED != 0,
                was_online: marks & WAS_ONLINE != 0,
                phase_ns,
                jitter_ns,
                rtt_ns,
                age_ns,
                fault,
                warning,
                current: f32::from_bits(current),
                velocity: f32::from_bits(velocity),
                position: f64::from_bits(take.u64()?),
                demand: f64::from_bits(take.u64()?),
                emergency: {
                    let [low, high, register, told] = *take.array()?;
                    let code = u16::from_le_bytes([low, high]);
                    (told & TOLD != 0).then(|| Emergency { code, register }.into())
                },
            })
        }
        2 => {
            let missed = u16::try_from(take.u32()?).ok()?;
            let (index, grid) = (take.u64()?, Time(take.u64()?));
            let [wake_ns, jitter_ns] = take.u32s()?;
            let stages_ns = take.u32s()?;
            let [faults, switches] = take.u32s()?;
            let (spun, look) = (flags & SPUN != 0, look(flags, faults, switches));
            Record::Cycle(CycleRecord { index, grid, wake_ns, spun, jitter_ns, stages_ns, missed, look })
        }
        3 => {
            take.u32()?;
            let (first, grid) = (take.u64()?, Time(take.u64()?));
            let (count, late_ns, given_up_ns) = (take.u64()?, take.u64()?, take.u64()?);
            let [faults, switches] = take.u32s()?;
            Record::Skipped(SkippedRecord {
                first,
                grid,
                count,
                late_ns,
                given_up_ns,
                woke_late: flags & WOKE_LATE != 0,
                late: flags & LATE != 0,
                spun: flags & SPUN != 0,
                look: look(flags, faults, switches),
            })
        }
        4 => {
            let (axis, index) = (known(take.u32()?)?, take.u64()?);
            let values = [take.u64()?, take.u64()?, take.u64()?, take.u64()?];
            Record::Monitor(MonitorRecord { index, axis, shown: Shown::from_words(flags, values)? })
        }
        5 => {
            take.u32()?;
            let index = take.u64()?;
            let [error_ns, step_ns] = take.u32s()?.map(u32::cast_signed);
            Record::Reference(ReferenceRecord {
                index,
                error_ns: (flags & TOLD != 0).then_some(error_ns),
                step_ns,
                locked: flags & LOCKED != 0,
                counts: flags & COUNTS != 0,
            })
        }
        _ => return None,
    })
}

/// Takes bytes from the front; `None` where there are too few.
struct Take<'a>(&'a [u8]);

impl<'a> Take<'a> {
    fn bytes(&mut self, length: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(length)?;
        self.0 = rest;
        Some(taken)
    }

    fn array<const N: usize>(&mut self) -> Option<&'a [u8; N]> {
        let (taken, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(taken)
    }

    fn u32(&mut self) -> Option<u32> {
        Some(u32::from_le_bytes(*self.array()?))
    }

    fn u32s<const N: usize>(&mut self) -> Option<[u32; N]> {
        let mut words = [0; N];
        for word in &mut words {
            *word = self.u32()?;
        }
        Some(words)
    }

    fn u64(&mut self) -> Option<u64> {
        Some(u64::from_le_bytes(*self.array()?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cycle::record::measured;

    fn header() -> Header {
        let axis = |name: &str| Axis { name: name.into(), unit: "mm".into(), ..Axis::default() };
        let channel = |name: &str, unit: &str| Some(Channel { name: name.into(), unit: unit.into() });
        let monitor = [channel("demand-current", "A"), None, channel("0x1E10", ""), None];
        Header {
            why: "drive x: link lost".into(),
            cycle: 7,
            axes: vec![axis("x"), Axis { monitor, faults: [(5, "too hot".into())].into(), ..axis("y") }],
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
                verb: 12,
                moving: true,
                inhibited: true,
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
        assert_eq!(decode(&bytes), Ok((header(), records())));
        assert_eq!(decode(&encode(&header(), [].iter())), Ok((header(), Vec::new())));
    }

    #[test]
    fn every_cut_and_every_changed_byte_is_noticed() {
        let bytes = encode(&header(), records().iter());
        for length in 0..bytes.len() {
            let wrong = decode(&bytes[..length]).unwrap_err();
            assert_eq!(matches!(wrong, Wrong::Foreign), length < 8, "{length}: {wrong:?}");
        }
        for place in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[place] ^= 0x10;
            assert!(decode(&changed).is_err(), "byte {place}");
        }
    }

    #[test]
    fn a_foreign_file_is_called_one() {
        for bytes in [&b""[..], b"PNG", b"FBBOX", &[0; 100]] {
            assert_eq!(decode(bytes), Err(Wrong::Foreign));
        }
        let mut newer = encode(&header(), records().iter());
        for version in [0, 5] {
            newer[6] = version;
            assert_eq!(decode(&newer), Err(Wrong::Version(version)));
        }
    }

    /// As layout 1 was: an axis of a name and a unit. Later ones are the same with more, which may be there in any.
    #[test]
    fn a_file_of_an_earlier_layout_is_read() {
        for layout in [1, 2, 3] {
            is_read(layout);
        }
    }

    fn is_read(layout: u8) {
        let json = r#"{"program":"0.1.0","machine":null,"why":"drive x: link lost","cycle":7,"written":"",
            "period_ns":1000000,"deadline_ns":500000,"late_ns":100000,"axes":[{"name":"x","unit":"mm"}],
            "kernel":null,"preemption":null,"cpu":null}"#;
        let mut bytes = MARK.to_vec();
        bytes[6] = layout;
        bytes.extend((json.len() as u32).to_le_bytes());
        bytes.extend(json.as_bytes());
        bytes.extend(1_u64.to_le_bytes());
        let mut skipped = [0; RECORD];
        (skipped[0], skipped[8], skipped[24]) = (3, 5, 2);
        bytes.extend(skipped);
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        let (header, records) = decode(&bytes).unwrap();
        assert_eq!(header.axes, [Axis { name: "x".into(), unit: "mm".into(), ..Axis::default() }]);
        let expected = SkippedRecord { first: 5, count: 2, ..SkippedRecord::default() };
        assert_eq!(records, [Record::Skipped(expected)]);
    }

    #[test]
    fn a_value_of_no_channel_is_damage() {
        let mut bytes = encode(&header(), records()[1..2].iter());
        let mask = bytes.len() - 4 - RECORD + 1;
        for channel in MONITOR_CHANNELS..8 {
            let mut changed = bytes.clone();
            changed[mask] |= 1 << channel;
            assert_eq!(decode(&sealed(changed)), Err(Wrong::Damaged("a record cannot be read")));
        }
        bytes[mask] = 0;
        let nothing = MonitorRecord { index: u64::MAX - 1, axis: 1, shown: Shown::default() };
        let (_, records) = decode(&sealed(bytes)).unwrap();
        let [Record::Monitor(MonitorRecord { shown, .. })] = &records[..] else { panic!("{records:?}") };
        assert_eq!(shown.values(), nothing.shown.values());
    }

    /// With the checksum of what now stands in them.
    fn sealed(mut bytes: Vec<u8>) -> Vec<u8> {
        let end = bytes.len() - 4;
        let sum = crc32fast::hash(&bytes[..end]).to_le_bytes();
        bytes[end..].copy_from_slice(&sum);
        bytes
    }

    #[test]
    fn an_axis_that_is_not_in_the_header_is_damage() {
        let mut header = header();
        header.axes.pop();
        for record in &records()[..2] {
            let bytes = encode(&header, [record].into_iter());
            assert_eq!(decode(&bytes), Err(Wrong::Damaged("a record cannot be read")));
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
        assert!(matches!(load(&pipe), Err(ReadError::Foreign(_))));
        // Sparse: it takes no room on the disk, and more memory than there is.
        File::create(&huge).unwrap().set_len(1 << 42).unwrap();
        assert!(matches!(load(&huge), Err(ReadError::Foreign(_))));
        for begin in [MARK.to_vec(), [&MARK[..], &u32::MAX.to_le_bytes()].concat()] {
            std::fs::write(&huge, &begin).unwrap();
            OpenOptions::new().write(true).open(&huge).unwrap().set_len(1 << 42).unwrap();
            assert!(matches!(load(&huge), Err(ReadError::Damaged { .. })));
        }
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
                match (what, expected) {
                    (Ok(()), None) => {}
                    (Err(ReadError::Damaged { what, .. }), Some(expected)) => assert_eq!(what, expected),
                    (other, _) => panic!("{expected:?}: {other:?}"),
                }
            }
        }
    }
}
