//! The ring of the loop's records: one thread writes, another one reads. What was read stays until its slot is used
//! again: the newest records are at hand without a copy, and where the memory has a name, they outlive the process.
//!
//! A slot is written before it is announced, so that a process may end at any instant: what is announced is whole.

use std::cell::Cell;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::mem::offset_of;
use std::num::NonZeroUsize;
use std::os::fd::BorrowedFd;
use std::os::unix::fs::FileExt;
use std::ptr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crossbeam::utils::CachePadded;

use super::record::Record;
use super::stored::{LAYOUT, RECORD};
use crate::rt::{Mapping, Regions, memory};

/// The first bytes of the memory.
const MARK: [u8; 8] = *b"FBRECORD";

/// Where what its owner says of the records begins.
const ABOUT: usize = 4096;

/// Where the guardian of its owner writes what it has done, as text, and how much room there is for it.
const SAID: usize = 2048;
const MOST_SAID: usize = ABOUT - SAID;

/// More is no description of a machine.
const MOST_ABOUT: usize = 16 << 20;

/// The first page of the memory. Another process reads it.
#[derive(Debug)]
#[repr(C)]
struct Head {
    mark: [u8; 8],
    layout: u32,
    record: u32,
    /// Bytes of what its owner says.
    about: u64,
    slots: u64,
    /// At least so many of the records before the newest one are whole.
    kept: u64,
    /// Records that were written so far.
    written: CachePadded<AtomicU64>,
    /// Records that were read so far; all, if nobody reads any more.
    read: CachePadded<AtomicU64>,
}

/// Where the records begin, behind what the owner says.
fn records_at(about: usize) -> usize {
    (ABOUT + about).next_multiple_of(ABOUT)
}

/// The memory, of both ends.
#[derive(Debug)]
struct Shared {
    mapping: Mapping,
    records: *mut Record,
    slots: u64,
    /// Records that may wait to be read.
    room: u64,
}

// SAFETY: `records` points into the mapping, which lives as long; who may use which slot follows from the counts.
unsafe impl Send for Shared {}
// SAFETY: as above.
unsafe impl Sync for Shared {}

impl Shared {
    fn head(&self) -> &Head {
        // SAFETY: a page of the mapping that was written as a head before this was shared. Only its atomics change.
        unsafe { self.mapping.begin().cast().as_ref() }
    }

    fn slot(&self, number: u64) -> *mut Record {
        // SAFETY: less than the slots behind `records`.
        unsafe { self.records.add((number % self.slots) as usize) }
    }
}

/// Which records of a ring stay at hand after they were read.
#[derive(Debug, Default)]
pub struct Kept {
    /// How many.
    pub records: usize,
    /// They outlive the process, and this is what a reader then needs to know of them; `None`: they end with it.
    pub about: Option<Vec<u8>>,
}

/// A ring in which so many records may wait to be read, all of it present and added to `regions`. Also why its records
/// end with the process, although they are to outlive it.
pub fn records(
    room: usize,
    kept: Kept,
    regions: &mut Regions,
) -> (RecordWriter, RecordReader, Option<io::Error>) {
    let room = room.max(1);
    let slots = room + kept.records;
    let about = kept.about.as_deref().unwrap_or_default();
    let bytes = records_at(about.len()).saturating_add(slots.saturating_mul(RECORD));
    let bytes = NonZeroUsize::MIN.saturating_add(bytes - 1);
    let shared = kept.about.is_some().then(|| Mapping::shared(bytes));
    let (mapping, mut unnamed) = match shared {
        Some(Ok(mapping)) => (mapping, None),
        Some(Err(error)) => (Mapping::anonymous(bytes), Some(error)),
        None => (Mapping::anonymous(bytes), None),
    };
    let begin = mapping.begin();
    let head = Head {
        mark: MARK,
        layout: LAYOUT,
        record: RECORD as u32,
        about: about.len() as u64,
        slots: slots as u64,
        kept: kept.records as u64,
        written: CachePadded::default(),
        read: CachePadded::default(),
    };
    // SAFETY: new memory of `bytes` bytes at a page, of which nobody else in this process has a pointer.
    let records = unsafe {
        let all = std::slice::from_raw_parts_mut(begin.as_ptr().cast(), bytes.get());
        memory::prefault::<u8>(all);
        regions.add(all);
        begin.add(ABOUT).copy_from_nonoverlapping(ptr::NonNull::from(about).cast(), about.len());
        begin.cast::<Head>().write(head);
        begin.add(records_at(about.len())).cast().as_ptr()
    };
    unnamed = unnamed.or(mapping.appear().err());
    let shared = Arc::new(Shared { mapping, records, slots: slots as u64, room: room as u64 });
    let writer = RecordWriter { shared: Arc::clone(&shared), written: 0, at: 0, read: 0 };
    let kept = kept.records as u64;
    (writer, RecordReader { shared, kept, next: Cell::new(0), seen: Cell::new(0) }, unnamed)
}

/// The end that writes.
#[derive(Debug)]
pub struct RecordWriter {
    shared: Arc<Shared>,
    written: u64,
    /// The slot of the next record.
    at: usize,
    /// As it was seen last.
    read: u64,
}

impl RecordWriter {
    /// For how many records there is room, for as many as `wanted` if there is.
    #[inline]
    fn room(&mut self, wanted: usize) -> u64 {
        let room = self.shared.room;
        // Nobody reads: the number of what was read is beyond all.
        let free = |written: u64, read| room.saturating_sub(written.saturating_sub(read));
        match free(self.written, self.read) {
            free if free >= wanted as u64 => free,
            _ => {
                self.read = self.shared.head().read.load(Ordering::Acquire);
                free(self.written, self.read)
            }
        }
    }

    /// Writes a record; `false`: there is no room.
    #[inline]
    pub fn push(&mut self, record: Record) -> bool {
        let has_room = self.room(1) > 0;
        if has_room {
            self.put(record);
            self.announce();
        }
        has_room
    }

    /// Writes so many records, built in their slots; `false`: there is no room for all of them, and none was made.
    #[inline]
    pub fn push_all(&mut self, count: usize, records: impl Iterator<Item = Record>) -> bool {
        let has_room = self.room(count) >= count as u64;
        if has_room {
            self.write(count as u64, records);
        }
        has_room
    }

    /// Writes records while there is room for more, `most` at most.
    #[inline]
    pub fn push_some(&mut self, most: usize, records: impl Iterator<Item = Record>) {
        let room = self.room(most);
        self.write(room.min(most as u64), records);
    }

    /// Writes so many records at most, for which there is room. They are announced together.
    #[inline]
    fn write(&mut self, most: u64, records: impl Iterator<Item = Record>) {
        records.take(most as usize).for_each(|record| self.put(record));
        self.announce();
    }

    /// Writes a record, for which there is room.
    #[inline(always)]
    fn put(&mut self, record: Record) {
        // SAFETY: one of the slots, and one that the reader has left, since there is room.
        unsafe { self.shared.records.add(self.at).write(record) };
        self.at = if self.at + 1 == self.shared.slots as usize { 0 } else { self.at + 1 };
        self.written += 1;
    }

    /// Written entries may be read.
    #[inline(always)]
    fn announce(&self) {
        self.shared.head().written.store(self.written, Ordering::Release);
    }
}

impl Drop for RecordWriter {
    /// The loop has ended: what follows is no crash, however the process ends.
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.shared.mapping.disappear();
        }
    }
}

/// The end that reads.
#[derive(Debug)]
pub struct RecordReader {
    shared: Arc<Shared>,
    kept: u64,
    next: Cell<u64>,
    /// The number of written entries at the last look.
    seen: Cell<u64>,
}

impl RecordReader {
    /// The next record. Its slot stays until [`release`](Self::release).
    #[inline]
    pub fn next(&self) -> Option<&Record> {
        let next = self.next.get();
        if next == self.seen.get() {
            self.seen.set(self.shared.head().written.load(Ordering::Acquire));
        }
        (next < self.seen.get()).then(|| {
            self.next.set(next + 1);
            // SAFETY: announced, and not released yet.
            unsafe { &*self.shared.slot(next) }
        })
    }

    /// The memory, if it outlives the process.
    pub fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.shared.mapping.descriptor()
    }

    /// Whether there is nothing to read.
    pub fn is_empty(&self) -> bool {
        self.next.get() == self.shared.head().written.load(Ordering::Acquire)
    }

    /// Gives back the slots of all records that were read. They stay at hand as [`kept`](Self::kept) for some time.
    pub fn release(&mut self) {
        self.shared.head().read.store(self.next.get(), Ordering::Release);
    }

    /// The next record, and gives back its slot.
    pub fn pop(&mut self) -> Option<Record> {
        let record = self.next().copied();
        self.release();
        record
    }

    /// Whether older records than those of [`kept`](Self::kept) are gone.
    pub fn is_cut(&self) -> bool {
        self.next.get() > self.kept
    }

    /// The newest records up to the one that was read last, the oldest first: as many as the ring keeps, if there were
    /// as many.
    pub fn kept(&self) -> impl Iterator<Item = &Record> {
        let end = self.next.get();
        // SAFETY: announced; the writer is at most `room` beyond what was released, and so at most all slots but these
        // beyond the first of them.
        (end.saturating_sub(self.kept)..end).map(|number| unsafe { &*self.shared.slot(number) })
    }
}

impl Drop for RecordReader {
    /// Nobody reads any more: the newest records replace the oldest. If that is an error of ours, whoever looks at them
    /// later finds them.
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.shared.mapping.leave();
        }
        self.shared.head().read.store(u64::MAX, Ordering::Release);
    }
}

/// Writes what was done once the owner of this memory had died, for whoever reads what it has left. A long text is cut.
pub fn say(memory: &File, text: &str) -> io::Result<()> {
    memory.write_all_at(&text.as_bytes()[..text.len().min(MOST_SAID)], SAID as u64)
}

/// The records that a process has left in its memory.
#[derive(Debug)]
pub struct Remains<F> {
    memory: F,
    /// The description of the records.
    pub about: Vec<u8>,
    /// The report of its guardian; empty: none.
    pub said: String,
    begin: u64,
    slots: u64,
    kept: u64,
    written: u64,
}

impl<F: Read + Seek> Remains<F> {
    /// That of this memory; `None`: it is none, or of another layout.
    pub fn of(mut memory: F) -> io::Result<Option<Remains<F>>> {
        let length = memory.seek(SeekFrom::End(0))?;
        memory.rewind()?;
        let mut head = [0; size_of::<Head>()];
        if length < ABOUT as u64 {
            return Ok(None);
        }
        memory.read_exact(&mut head)?;
        let number = |at: usize| head[at..].first_chunk().map_or(0, |bytes| u64::from_ne_bytes(*bytes));
        let written = number(offset_of!(Head, written));
        let [length_of_about, slots, kept] =
            [offset_of!(Head, about), offset_of!(Head, slots), offset_of!(Head, kept)].map(number);
        let layout = [LAYOUT, RECORD as u32].map(u32::to_ne_bytes).concat();
        let is_known = head[..8] == MARK && head[8..16] == layout[..];
        if !is_known || length_of_about > MOST_ABOUT as u64 || slots == 0 || kept > slots {
            return Ok(None);
        }
        let begin = records_at(length_of_about as usize) as u64;
        if slots.checked_mul(RECORD as u64).and_then(|bytes| bytes.checked_add(begin)) != Some(length) {
            return Ok(None);
        }
        let mut about = vec![0; length_of_about as usize];
        let mut said = [0; MOST_SAID];
        memory.seek(SeekFrom::Start(SAID as u64))?;
        memory.read_exact(&mut said)?;
        memory.read_exact(&mut about)?;
        let said = said.split(|byte| *byte == 0).next().map(String::from_utf8_lossy);
        let said = said.unwrap_or_default().into_owned();
        Ok(Some(Remains { memory, about, said, begin, slots, kept, written }))
    }

    /// Whether older records than its newest are gone.
    pub fn is_cut(&self) -> bool {
        self.written > self.kept
    }

    /// The newest records, the newest first. One that means nothing is left out: the others are whole all the same.
    pub fn newest(&mut self) -> impl Iterator<Item = Record> {
        let Remains { memory, begin, slots, kept, written, .. } = self;
        let record = |number: u64| {
            let mut bytes = [0; RECORD];
            memory.seek(SeekFrom::Start(*begin + number % *slots * RECORD as u64)).ok()?;
            memory.read_exact(&mut bytes).ok()?;
            Record::load(&bytes)
        };
        (written.saturating_sub(*kept)..*written).rev().filter_map(record)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;
    use crate::axis::{
        BegunBy, Command, CommandId, Emergency, EventKind, Failure, GroupCall, Link, Outcome, QueuedCommand,
        State, StopCause,
    };
    use crate::cycle::record::{
        CommandRecord, CommandStep, CycleRecord, DriveFlags, DriveRecord, EventRecord, Look, MonitorRecord,
        NativeRecord, ReferenceRecord, Reply, SkippedRecord, measured,
    };
    use crate::time::Time;

    fn cycle(index: u64) -> Record {
        Record::Cycle(CycleRecord { index, ..CycleRecord::default() })
    }

    fn indices<'a>(records: impl Iterator<Item = &'a Record>) -> Vec<u64> {
        records.map(Record::index).collect()
    }

    /// Records of every kind, with each number of what has a number.
    fn every() -> Vec<Record> {
        let drive = DriveRecord {
            index: u64::MAX,
            position: f64::MIN,
            demand: 1e-9,
            velocity: 2.5,
            current: -1.5,
            phase_ns: measured(1),
            jitter_ns: None,
            rtt_ns: measured(u64::MAX),
            age_ns: measured(4),
            fault: 5,
            warning: 6,
            axis: 300,
            command: 12,
            flags: DriveFlags::new(true, false, true),
            ..DriveRecord::default()
        };
        let look = Some(Look { faults: 18, switches: u32::MAX });
        let cycle = CycleRecord {
            index: 7,
            grid: Time(8),
            wake_ns: 9,
            jitter_ns: 10,
            stages_ns: [11, 12, 13, 14, 15, 16],
            look,
            missed: 17,
            spun: true,
        };
        let skipped = SkippedRecord {
            first: 20,
            grid: Time(21),
            count: 22,
            late_ns: 23,
            given_up_ns: 24,
            woke_late: true,
            late: false,
            spun: true,
            look,
        };
        let (index, axis) = (25, 2);
        let reference =
            ReferenceRecord { index, error_ns: Some(i32::MIN), step_ns: -26, locked: true, counts: true };
        let shown = [Some(-0.25), None, Some(f64::MAX), None].into();
        let native = NativeRecord {
            index,
            received_ns: 3,
            axis,
            total: 40,
            inputs: 30,
            offset: 0,
            bytes: std::array::from_fn(|at| at as u8),
        };
        let id = CommandId::of_task(9);
        let call = GroupCall { parts: 2, together: 1, lead: 7, id };
        let mut all = vec![
            Record::Monitor(MonitorRecord { index, axis, shown }),
            Record::Reference(reference),
            Record::Reference(ReferenceRecord { error_ns: None, ..reference }),
            Record::Cycle(cycle),
            Record::Cycle(CycleRecord { look: None, ..cycle }),
            Record::Skipped(skipped),
            Record::Native(native),
        ];
        for (command, call) in crate::axis::command::tests::all()
            .map(|(command, _)| command)
            .into_iter()
            .zip([None, Some(call)].into_iter().cycle())
        {
            let queued = QueuedCommand { id, member: 5, command, stream: 0, call };
            let step = if call.is_some() { CommandStep::Begun } else { CommandStep::Taken };
            let record = CommandRecord { index, ..CommandRecord::new(step, &queued) };
            let expected = (command, 5, call.map(|call| call.lead as u16), step);
            assert_eq!((record.command(), record.axis(), record.group(), record.step()), expected);
            all.push(Record::Command(record));
        }
        let drives = Reply::ALL.map(|reply| DriveRecord { reply, ..drive }).into_iter();
        let drives = drives.chain(Link::ALL.map(|link| DriveRecord { link, ..drive }));
        let drives = drives.chain(State::ALL.map(|state| DriveRecord { state, ..drive }));
        let drives =
            drives.chain(StopCause::ALL.map(|stopped| DriveRecord { stopped: Some(stopped), ..drive }));
        all.extend(drives.map(Record::Drive));
        let by = BegunBy { axis: u16::MAX, cause: StopCause::PositionJump };
        let ended =
            |outcome| EventKind::Ended { id, command: Command::NAMES[3], outcome: Outcome::Failed(outcome) };
        let events = [
            EventKind::Stopped(StopCause::Group),
            EventKind::Emergency(Emergency { code: u16::MAX, register: 8 }),
            EventKind::PositionJump(-338.9),
            ended(Failure::OutOfPosition { distance: -0.7, window: 0.5 }),
            ended(Failure::Dropped(State::Fault)),
        ];
        all.extend(events.map(|kind| Record::Event(EventRecord::new(index, axis, kind, Some(by)))));
        all
    }

    /// The bytes of a memory that its process has left, with these records in it.
    fn left(records: &[Record], kept: usize) -> Vec<u8> {
        let kept = Kept { records: kept, about: Some(b"a machine".to_vec()) };
        // Where a host has no named memory, what is in it is the same.
        let (mut writer, reader, _) = super::records(records.len(), kept, &mut Regions::new());
        assert!(records.iter().all(|record| writer.push(*record)));
        let mapping = &reader.shared.mapping;
        // SAFETY: its memory, which nobody writes to any more.
        unsafe { std::slice::from_raw_parts(mapping.begin().as_ptr(), mapping.length()) }.to_vec()
    }

    #[test]
    fn every_record_comes_back_from_the_memory_of_a_process_that_has_ended() {
        let records = every();
        let mut remains = Remains::of(Cursor::new(left(&records, records.len()))).unwrap().unwrap();
        assert_eq!((&*remains.about, remains.is_cut()), (&b"a machine"[..], false));
        assert_eq!(remains.newest().count(), records.len());
        for (record, known) in remains.newest().zip(records.into_iter().rev()) {
            let (Record::Event(event), Record::Event(known_event)) = (record, known) else {
                assert_eq!((record, Record::load(&record.store())), (known, Some(known)));
                continue;
            };
            let stored = Record::load(&known.store());
            let Some(Record::Event(stored)) = stored else { panic!("{stored:?}") };
            for event in [event, stored] {
                let expected = (known_event.kind(), known_event.begun_by());
                assert_eq!((event.kind(), event.begun_by()), expected);
            }
        }
        // What is only a text ends with the process; what it is of does not.
        let failure = Failure::Limit { what: "position", value: 9.0, low: 0.0, high: 8.0 };
        let kind = EventKind::Ended { id: CommandId(1), command: "move", outcome: Outcome::Failed(failure) };
        let event = Record::Event(EventRecord::new(3, 0, kind, None));
        let mut remains = Remains::of(Cursor::new(left(&[event, event], 1))).unwrap().unwrap();
        let newest: Vec<Record> = remains.newest().collect();
        let ([Record::Event(event)], true) = (&newest[..], remains.is_cut()) else { panic!("{newest:?}") };
        let text = event.kind().unwrap().to_string();
        assert!(text.contains("9 is outside its limit (0 ... 8)"), "{text}");
    }

    #[test]
    fn damaged_memory_is_read_without_a_panic_and_foreign_memory_is_none() {
        let records = every();
        let whole = left(&records, records.len());
        for seed in 0..300 {
            let mut random = fastrand::Rng::with_seed(seed);
            let mut damaged = whole.clone();
            for _ in 0..random.usize(1..40) {
                let at = random.usize(..damaged.len());
                damaged[at] = random.u8(..);
            }
            damaged.truncate(if random.bool() { damaged.len() } else { random.usize(..damaged.len()) });
            if let Some(mut remains) = Remains::of(Cursor::new(damaged)).unwrap() {
                for record in remains.newest().take(records.len()) {
                    let _ = format!("{record:?}");
                    if let Record::Event(event) = record {
                        let _ = event.kind().map(|kind| kind.to_string());
                    }
                }
            }
        }
        for foreign in [&whole[1..], &whole[..whole.len() - 1], &whole[..100], &[]] {
            assert!(Remains::of(Cursor::new(foreign)).unwrap().is_none());
        }
    }

    #[test]
    fn a_read_entry_stays_until_its_slot_is_reused() {
        let (mut writer, mut reader, _) =
            super::records(4, Kept { records: 3, about: None }, &mut Regions::new());
        assert!((0..4).all(|index| writer.push(cycle(index))) && !writer.push(cycle(9)));
        assert_eq!((reader.next().map(Record::index), indices(reader.kept())), (Some(0), vec![0]));
        // Read, and not released.
        assert!(!writer.push(cycle(9)));
        reader.release();
        assert!(writer.push(cycle(4)) && !writer.push(cycle(9)));
        assert_eq!(indices(std::iter::from_fn(|| reader.next())), [1, 2, 3, 4]);
        assert_eq!((indices(reader.kept()), reader.is_empty()), (vec![2, 3, 4], true));
        reader.release();
        assert!(writer.push_all(4, (5..9).map(cycle)) && !writer.push_all(1, std::iter::once(cycle(9))));
        assert_eq!(indices(reader.kept()), [2, 3, 4]);
        // Without anybody who reads, the newest replace the oldest.
        drop(reader);
        assert!((9..100).all(|index| writer.push(cycle(index))));
    }

    #[test]
    fn an_orderly_end_of_the_loop_takes_the_name_away_and_a_reader_that_panics_keeps_it() {
        for panics in [false, true] {
            let kept = Kept { records: 3, about: Some(Vec::new()) };
            let (writer, reader, _) = super::records(4, kept, &mut Regions::new());
            let Some(path) = reader.shared.mapping.path().map(ToOwned::to_owned) else {
                return println!("no named memory here");
            };
            if panics {
                let read = std::panic::AssertUnwindSafe(move || {
                    let _reader = reader;
                    std::panic::resume_unwind(Box::new("on purpose"));
                });
                assert!(std::panic::catch_unwind(read).is_err());
            }
            drop(writer);
            assert_eq!(path.exists(), panics);
            let _ = std::fs::remove_file(path);
        }
    }

    #[test]
    fn two_threads_pass_every_record_in_order_and_keep_the_last_ones() {
        for seed in 0..4 {
            let mut random = fastrand::Rng::with_seed(seed);
            let (room, kept) = (random.usize(1..9), random.usize(..9));
            let (mut writer, mut reader, _) =
                super::records(room, Kept { records: kept, about: None }, &mut Regions::new());
            const COUNT: u64 = 2_000;
            let writes = std::thread::spawn(move || {
                let mut next = 0;
                while next < COUNT {
                    let most = random.usize(1..=room).min((COUNT - next) as usize);
                    let done = match random.bool() {
                        true => u64::from(writer.push(cycle(next))),
                        false if writer.push_all(most, (next..).map(cycle)) => most as u64,
                        false => 0,
                    };
                    next += done;
                    if done == 0 {
                        std::thread::yield_now();
                    }
                }
            });
            let mut expected = 0;
            while expected < COUNT {
                while let Some(record) = reader.next() {
                    assert_eq!(record.index(), expected);
                    expected += 1;
                    if expected.is_multiple_of(7) {
                        let from = expected.saturating_sub(kept as u64);
                        assert_eq!(indices(reader.kept()), (from..expected).collect::<Vec<u64>>());
                        break;
                    }
                }
                reader.release();
                std::thread::yield_now();
            }
            writes.join().unwrap();
        }
    }
}
