//! The file of a black box: a recording, whose metadata say why it was written. Any other recording is read alike.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fs::Metadata;
use std::num::NonZeroU32;
use std::path::Path;
use std::time::UNIX_EPOCH;

use serde::{Deserialize, Serialize};

use crate::recording::machine::{CYCLE, Machine, PROGRAM, UNIT, WHY, WRITTEN, faults_of};
use crate::recording::reading::{Entry, Reading, Wrong, about};
use fieldbeat_core::axis::{Command, Emergency, EventKind, Fault, Link, MONITOR_CHANNELS, State, StopCause};
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::cycle::record::{
    CycleRecord, DriveFlags, DriveRecord, EventRecord, MonitorRecord, Record, ReferenceRecord, Reply,
    SkippedRecord, Stage, short,
};
use fieldbeat_core::time::Time;

/// The number of records of a file that are kept, those of its end: as many as the largest black box has.
const MOST_RECORDS: usize = 1 << 21;

/// The number of faults of an axis that have a name.
const MOST_FAULTS: usize = 1 << 12;

/// The description of the records.
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
    /// The name.
    pub name: String,
    /// The user unit.
    pub unit: String,
    /// On a rotary axis: the length of a turn. It is not in a file.
    pub modulo: Option<f64>,
    /// The monitored variables of its drive, channel by channel.
    pub monitor: [Option<Channel>; MONITOR_CHANNELS],
    /// The protocol's names of the fault codes that occur in the records.
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
    /// The name.
    pub name: String,
    /// Of its values; empty for a plain number.
    pub unit: String,
}

/// The description of the records of a run of `plan`; no fault has occurred yet.
pub fn header(plan: &Plan) -> Header {
    let Machine { about, axes, .. } = Machine::of(plan, env!("CARGO_PKG_VERSION"));
    let axes = axes.into_iter().map(|mut axis| Axis {
        name: axis.name,
        unit: axis.about.remove(UNIT).unwrap_or_default(),
        modulo: axis.modulo,
        monitor: axis.monitor.map(|channel| channel.map(|(name, unit)| Channel { name, unit })),
        faults: BTreeMap::new(),
    });
    // Numbers that stand there can be read.
    Header { axes: axes.collect(), ..Header::of(about).unwrap_or_default() }
}

/// Reads a file. Of one that no black box wrote, the cause is its end.
pub fn load(path: &Path) -> Result<(Header, Vec<Record>), Wrong> {
    read(load_header(path)?, Reading::open(path)?)
}

/// The same of a file with this header and these messages.
pub fn read(
    header: Header,
    entries: impl IntoIterator<Item = Result<Entry, Wrong>>,
) -> Result<(Header, Vec<Record>), Wrong> {
    let mut file = Loading { header, places: HashMap::new(), records: VecDeque::new() };
    for entry in entries {
        match entry {
            Ok(entry) => file.enter(&entry)?,
            // It has no message.
            Err(Wrong::Foreign) => break,
            Err(wrong) => return Err(wrong),
        }
    }
    let Loading { mut header, records, .. } = file;
    if header.why.is_empty() {
        header.why = "the end of the recording".to_owned();
        header.cycle = records.back().map_or(0, Record::index);
    }
    Ok((header, records.into()))
}

/// Reads the header of a file, which has no axes then; without a reason if no black box wrote it. Whether the end of
/// the file is there is looked at, too.
pub fn load_header(path: &Path) -> Result<Header, Wrong> {
    let mut header = Header::of(about(path)?)?;
    if header.written.is_empty() {
        header.written = changed(&std::fs::metadata(path)?);
    }
    Ok(header)
}

impl Header {
    /// That of a machine of which this is said.
    fn of(mut about: BTreeMap<String, String>) -> Result<Header, Wrong> {
        let number = |key: &str| {
            let number = about.get(key).and_then(|number| number.parse().ok());
            number.ok_or_else(|| Wrong::Damaged(format!("its {key}")))
        };
        let [period_ns, deadline_ns, late_ns] =
            [number("period_ns")?, number("deadline_ns")?, number("late_ns")?];
        let cycle = if about.contains_key(WHY) { number(CYCLE)? } else { 0 };
        let mut text = |key: &str| about.remove(key);
        Ok(Header {
            program: text(PROGRAM).unwrap_or_default(),
            machine: text("machine"),
            why: text(WHY).unwrap_or_default(),
            cycle,
            written: text(WRITTEN).unwrap_or_default(),
            period_ns,
            deadline_ns,
            late_ns,
            reference: text("reference"),
            axes: Vec::new(),
            kernel: text("kernel"),
            preemption: text("preemption"),
            cpu: text("cpu"),
        })
    }
}

/// When a file was changed last, UTC.
pub fn changed(facts: &Metadata) -> String {
    humantime::format_rfc3339_seconds(facts.modified().unwrap_or(UNIX_EPOCH)).to_string()
}

/// A file while it is read.
struct Loading {
    header: Header,
    /// The places of the axes, by name: in the order of their first messages, which is that of the plan.
    places: HashMap<String, u16>,
    records: VecDeque<Record>,
}

impl Loading {
    /// Takes a message in, if there is something of it to tell.
    fn enter(&mut self, entry: &Entry) -> Result<(), Wrong> {
        let topic = &*entry.topic.name;
        let index = entry.number("cycle");
        let short = |field: &str| short(entry.number(field));
        let is = |field: &str| entry.number(field) != 0;
        let record = match topic {
            "/cycle" => Record::Cycle(CycleRecord {
                index,
                grid: Time(entry.number("monotonic_ns")),
                wake_ns: short("wake_ns"),
                spun: is("spun"),
                jitter_ns: short("jitter_ns"),
                stages_ns: Stage::ALL.map(|stage| short(&format!("{}_ns", stage.name()))),
                missed: short("missed").try_into().unwrap_or(u16::MAX),
                look: None,
            }),
            "/skipped" => Record::Skipped(SkippedRecord {
                first: index,
                grid: Time(entry.number("monotonic_ns")),
                count: entry.number("count"),
                late_ns: entry.number("late_ns"),
                given_up_ns: entry.number("given_up_ns"),
                woke_late: is("woke_late"),
                ..SkippedRecord::default()
            }),
            "/reference" => {
                let ns = |field| entry.signed(field).clamp(i32::MIN.into(), i32::MAX.into()) as i32;
                Record::Reference(ReferenceRecord {
                    index,
                    error_ns: is("reported").then(|| ns("error_ns")),
                    step_ns: ns("step_ns"),
                    locked: is("locked"),
                    counts: is("locked"),
                })
            }
            "/events" => match self.event(entry, index) {
                Some(record) => record,
                None => return Ok(()),
            },
            _ => match topic.strip_prefix("/axes/").map(|name| name.split_once('/').unwrap_or((name, ""))) {
                Some((name, "")) => Record::Drive(drive(entry, index, self.axis(name, entry)?)?),
                Some((name, "monitors")) if self.places.contains_key(name) => {
                    Record::Monitor(self.monitor(entry, index, self.places[name]))
                }
                _ => return Ok(()),
            },
        };
        if self.records.len() == MOST_RECORDS {
            self.records.pop_front();
        }
        self.records.push_back(record);
        Ok(())
    }

    /// The place of the axis of a message.
    fn axis(&mut self, name: &str, entry: &Entry) -> Result<u16, Wrong> {
        if let Some(place) = self.places.get(name) {
            return Ok(*place);
        }
        let axes = &mut self.header.axes;
        let place = u16::try_from(axes.len()).map_err(|_| Wrong::Damaged("too many axes".to_owned()))?;
        let unit = entry.topic.about.get(UNIT).cloned().unwrap_or_default();
        let faults = faults_of(&entry.topic.about).take(MOST_FAULTS);
        let faults = faults.map(|(code, name)| (code, name.clone())).collect();
        axes.push(Axis { name: name.to_owned(), unit, faults, ..Axis::default() });
        self.places.insert(name.to_owned(), place);
        Ok(place)
    }

    /// The fields are those of its cycle, and one for each monitored variable.
    fn monitor(&mut self, entry: &Entry, index: u64, axis: u16) -> MonitorRecord {
        let known = &mut self.header.axes[usize::from(axis)].monitor;
        let mut shown = [None; MONITOR_CHANNELS];
        for ((field, known), shown) in entry.topic.fields().skip(2).zip(known).zip(&mut shown) {
            *shown = Some(entry.float(&field)).filter(|value| !value.is_nan());
            known.get_or_insert_with(|| match entry.topic.monitored(&field) {
                Some((name, unit)) => Channel { name: name.clone(), unit: unit.clone() },
                None => Channel { name: field, unit: String::new() },
            });
        }
        MonitorRecord { index, axis, shown: shown.into() }
    }

    /// The name of its fault, and an emergency: all else follows from the records of the drives.
    fn event(&mut self, entry: &Entry, index: u64) -> Option<Record> {
        let axis = *self.places.get(&entry.text("axis_name"))?;
        let (code, name) = (short(entry.number("code")), entry.text("code_name"));
        let faults = &mut self.header.axes[usize::from(axis)].faults;
        if !name.is_empty() && faults.len() < MOST_FAULTS {
            faults.insert(code, name);
        }
        let register = entry.number("register").try_into().ok()?;
        let emergency = Emergency { code: code.try_into().ok()?, register };
        let is_one = entry.text("kind") == "emergency";
        is_one.then(|| Record::Event(EventRecord::new(index, axis, EventKind::Emergency(emergency), None)))
    }
}

fn drive(entry: &Entry, index: u64, axis: u16) -> Result<DriveRecord, Wrong> {
    let ns = |field| NonZeroU32::new(short(entry.number(field)));
    Ok(DriveRecord {
        index,
        axis,
        reply: meant(entry, "exchange", |number| Reply::ALL.get(number).copied())?,
        link: meant(entry, "link", |number| Link::ALL.get(number).copied())?,
        state: meant(entry, "state", |number| State::ALL.get(number).copied())?,
        stopped: meant(entry, "stopped", |number| match number.checked_sub(1) {
            None => Some(None),
            Some(place) => StopCause::ALL.get(place).copied().map(Some),
        })?,
        command: meant(entry, "command", |code| Command::NAMES.get(code).map(|_| code as u8))?,
        flags: DriveFlags::new(entry.number("moving") != 0, entry.number("sto_open") != 0, false),
        phase_ns: ns("sent_after_ns"),
        jitter_ns: ns("send_jitter_ns"),
        rtt_ns: ns("rtt_ns"),
        age_ns: ns("age_ns"),
        fault: short(entry.number("fault")),
        warning: short(entry.number("warning")),
        current: entry.float("current") as f32,
        velocity: entry.float("velocity") as f32,
        position: entry.float("position"),
        demand: entry.float("demand"),
    })
}

/// The value that the number of a field stands for.
fn meant<T>(entry: &Entry, field: &str, of: impl Fn(usize) -> Option<T>) -> Result<T, Wrong> {
    let number = entry.number(field);
    let known = usize::try_from(number).ok().and_then(of);
    known.ok_or_else(|| Wrong::Damaged(format!("{field} {number}, which this version does not know")))
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::os::unix::fs::FileExt;

    use super::*;
    use crate::recording::machine::{AxisAbout, of_axis, of_cycle};
    use crate::recording::newest::encode;
    use fieldbeat_core::cycle::record::measured;
    use mcap::MAGIC;

    /// Of a machine with two axes, written for that reason in cycle 7.
    fn bytes(why: Option<&str>, records: &[Record]) -> Vec<u8> {
        let mut about = of_cycle("9", 1_000_000, 500_000, 100_000);
        let more = why.into_iter().flat_map(|why| [(WHY, why), (CYCLE, "7"), (WRITTEN, "today")]);
        about.extend(more.map(|(key, value)| (key.to_owned(), value.to_owned())));
        let axis = |name: &str| AxisAbout {
            name: name.into(),
            about: of_axis("mm", "linudp"),
            faults: crate::recording::machine::Faults::Known(|code| (code == 0x4310).then_some("too hot")),
            ..AxisAbout::default()
        };
        let channel = |name: &str, unit: &str| Some((name.into(), unit.into()));
        let monitor = [channel("demand-current", "A"), None, channel("0x1E10", ""), None];
        let axes = vec![axis("x"), AxisAbout { monitor, ..axis("y") }];
        let machine = Machine { about, axes, period_ns: 1_000_000 };
        encode(machine, 0, records.iter(), std::iter::empty(), None, 0).unwrap().bytes
    }

    fn records() -> Vec<Record> {
        let drive = DriveRecord { index: 7, link: Link::Online, ..DriveRecord::default() };
        let emergency = EventKind::Emergency(Emergency { code: 0x4310, register: 8 });
        vec![
            Record::Drive(drive),
            Record::Drive(DriveRecord {
                axis: 1,
                reply: Reply::Unsent,
                link: Link::Lost,
                state: State::Fault,
                stopped: Some(StopCause::GroupFailed),
                command: 12,
                flags: DriveFlags::new(false, true, false),
                phase_ns: measured(1),
                rtt_ns: measured(u64::MAX),
                age_ns: measured(4),
                fault: u32::MAX,
                warning: 6,
                current: -1.5,
                velocity: 2.5,
                position: f64::MIN,
                demand: 1e-9,
                ..drive
            }),
            Record::Monitor(MonitorRecord {
                index: 7,
                axis: 1,
                shown: [Some(-0.25), None, Some(f64::MAX), None].into(),
            }),
            Record::Reference(ReferenceRecord {
                index: 7,
                error_ns: Some(i32::MIN),
                step_ns: -26,
                locked: true,
                counts: true,
            }),
            Record::Event(EventRecord::new(7, 1, emergency, None)),
            Record::Cycle(CycleRecord {
                index: 7,
                grid: Time(8),
                wake_ns: 9,
                spun: true,
                jitter_ns: 10,
                stages_ns: [11, 12, 13, 14, 15, 16],
                missed: 17,
                look: None,
            }),
            Record::Skipped(SkippedRecord {
                first: 8,
                grid: Time(21),
                count: 22,
                late_ns: 23,
                given_up_ns: 24,
                woke_late: true,
                ..SkippedRecord::default()
            }),
        ]
    }

    /// The contents of a file with these bytes.
    fn loaded(bytes: &[u8]) -> Result<(Header, Vec<Record>), Wrong> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        load(file.path())
    }

    #[test]
    fn a_written_black_box_reads_back_equal() {
        let mut expected = records();
        let (header, records) = loaded(&bytes(Some("drive x: link lost"), &expected)).unwrap();
        // Its values stand side by side.
        if let Record::Monitor(monitor) = &mut expected[2] {
            monitor.shown = [Some(-0.25), Some(f64::MAX), None, None].into();
        }
        assert_eq!(records, expected);
        assert_eq!((&*header.why, header.cycle, &*header.written), ("drive x: link lost", 7, "today"));
        assert_eq!((header.period_ns, header.deadline_ns, header.late_ns), (1_000_000, 500_000, 100_000));
        let channel = |name: &str, unit: &str| Some(Channel { name: name.into(), unit: unit.into() });
        let axis = |name: &str| Axis { name: name.into(), unit: "mm".into(), ..Axis::default() };
        let monitor = [channel("demand-current", "A"), channel("0x1E10", ""), None, None];
        let faults = [(0x4310, "too hot".into())].into();
        assert_eq!(header.axes, [axis("x"), Axis { monitor, faults, ..axis("y") }]);
        assert_eq!(loaded(&bytes(Some("requested"), &[])).unwrap().1, []);
    }

    #[test]
    fn a_recording_of_a_run_is_described_up_to_its_end() {
        let (header, records) = loaded(&bytes(None, &records())).unwrap();
        assert_eq!((&*header.why, header.cycle, records.len()), ("the end of the recording", 8, 7));
        assert!(!header.written.is_empty());
    }

    #[test]
    fn a_number_without_a_meaning_is_damage() {
        let unknown = DriveRecord { command: 200, ..DriveRecord::default() };
        let wrong = loaded(&bytes(None, &[Record::Drive(unknown)])).unwrap_err();
        let text = "it is damaged (command 200, which this version does not know)";
        assert_eq!(wrong.to_string(), text);
    }

    #[test]
    fn a_file_that_is_cut_is_named_and_a_directory_is_none() {
        let whole = bytes(Some("requested"), &records());
        for length in [whole.len() - 1, whole.len() / 2, 40] {
            assert!(matches!(loaded(&whole[..length]), Err(Wrong::Cut)), "{length}");
        }
        for path in ["/", "/dev/zero", "/none"] {
            let text = load(path.as_ref()).unwrap_err().to_string();
            assert!(!text.contains('\n') && text.contains("*.mcap"), "{text}");
        }
    }

    #[test]
    fn neither_a_pipe_nor_a_huge_file_is_waited_for() {
        let directory = tempfile::tempdir().unwrap();
        let [pipe, huge] = ["pipe", "huge"].map(|name| directory.path().join(name));
        let name = std::ffi::CString::new(pipe.as_os_str().as_encoded_bytes()).unwrap();
        // SAFETY: a string that ends with its zero.
        assert_eq!(unsafe { libc::mkfifo(name.as_ptr(), 0o600) }, 0);
        assert!(matches!(load(&pipe), Err(Wrong::Foreign)));
        // proc_pid_io(5): all that this thread has read.
        let read = || {
            let io = std::fs::read_to_string("/proc/thread-self/io").unwrap();
            io.lines().find_map(|line| line.strip_prefix("rchar: ")?.parse::<u64>().ok()).unwrap()
        };
        let before = read();
        let whole = bytes(Some("requested"), &records());
        let endless = [MAGIC, &[5, 255, 255, 255, 255]].concat();
        // Up to the first chunk, behind the metadata.
        let mut at = MAGIC.len();
        while whole[at] != mcap::records::op::CHUNK {
            at += 9 + u64::from_le_bytes(*whole[at + 1..].first_chunk().unwrap()) as usize;
        }
        let begins = [&[][..], MAGIC, &endless, &whole[..at], &whole];
        for (begin, has_end) in begins.iter().flat_map(|begin| [(begin, false), (begin, true)]) {
            // Sparse: it takes no room on the disk, and more memory than there is.
            let file = File::create(&huge).unwrap();
            file.write_all_at(begin, 0).unwrap();
            file.set_len(1 << 42).unwrap();
            if has_end {
                file.write_all_at(MAGIC, 1 << 42).unwrap();
            }
            let wrong = load(&huge).unwrap_err();
            assert!(matches!(wrong, Wrong::Foreign | Wrong::Cut | Wrong::Damaged(_)), "{wrong}");
        }
        let bytes = read() - before;
        assert!(bytes < 64 << 20, "{bytes} bytes of files that are none");
    }
}
