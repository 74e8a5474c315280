//! All that the loop takes from outside: a log of it, written while a machine runs, or read in place of the outside
//! when the run is repeated.
//!
//! The loop is deterministic between its inputs. Each place in it that takes something from outside is one *look*, and
//! each look goes through the log ([`InputLog`]). Looks follow each other in the same order whenever the same values
//! came: a look that finds what is usual (an empty queue, nothing received, a flag that is unset) only counts, and one
//! that finds more writes an entry, which holds how many looks before it found nothing. A repeated run makes the same
//! looks, and gets from the log what the first one found; the real queues, clocks and sockets are not looked at. What
//! goes out (telegrams, calls of the in-loop task) is logged at its place, too: the repeated run compares it.
//!
//! The looks, all of them:
//!
//! | what | who writes it | where the loop looks |
//! |---|---|---|
//! | the clock, and the time of a suspension | the kernel | `logged::LoggedClock` |
//! | which descriptors are readable | the kernel | `logged::LoggedClock::wait` |
//! | datagrams, results of sends | the kernel | `logged::recorded::LoggedDatagrams` |
//! | bytes of connections and serial ports, their openings and ends, what is ready | the kernel, the link thread | `logged::recorded::Logged` |
//! | frames, their stamps, the date, the address of the interface | the kernel | `logged::recorded::Logged` |
//! | whether the link thread has ended | the link thread | `logged::recorded::Logged::has_ended` |
//! | posted commands | the application | `drive::controller::Queues::posted` |
//! | rows | the application | `drive::controller::Queues::rows` |
//! | setpoints | the application | `drive::controller::setpoints::take_setpoints` |
//! | bells | the application; the sessions of the link thread | `axis::doorbell::Bells::take` |
//! | the application's sign of life | the application | `cycle::heartbeat::Heartbeat::is_silent` |
//! | the request to end | the application, a signal | `cycle::engine::Channels::requested` |
//! | calls of the in-loop task, and its panic | the application's code on the loop | `cycle::task::Axes` |
//! | room for the end of a task's command | the application, which takes events | `cycle::task::has_room` |
//! | acyclic calls, and which are cancelled | normal threads | `axis::acyclic::Port` of an executor on the loop |
//! | native process data of drives | the application | `bus::native::NativePort` |
//! | outputs of EtherCAT devices, and the room for their emergencies | the application | `bus::ethercat::native::TerminalPort` |
//! | findings of the handshake of a Unidrive | the link thread | `bus::modbus::handshake::Found::get` |
//! | news of the sessions of EtherNet/IP, the room for wishes, and whether a call commands | the link thread | `bus::ethernet_ip::exchange::LoopEnd` |
//!
//! Not logged, since nothing that leaves depends on it: what carriers have dropped, errors of an interface, room in
//! the queues of events, samples and records where the loop only counts what it loses there, and what the kernel counts
//! against the thread.
//!
//! | file | what |
//! |---|---|
//! | `entry` | the layout of the log |
//! | `recording` | the loop's side of a recorded run: a ring of words, and its reader |
//! | `replaying` | the loop's side of a repeated run |
//! | `inlet` | the loop's end of a queue |

pub mod entry;
mod inlet;
pub mod recording;
pub mod replaying;

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, AtomicU32, Ordering};

use self::entry::Kind;
pub use self::inlet::Inlet;
pub use self::recording::Recording;
pub use self::replaying::Replaying;
use crate::packed::Part;

/// The log of a machine, for each of its places that look outside; clones are the same place, one *source*. By default
/// there is no log, and a look costs a branch.
#[derive(Clone, Debug, Default)]
pub struct InputLog {
    shared: Option<Arc<Shared>>,
    source: u32,
}

#[derive(Debug)]
struct Shared {
    mode: Mode,
    /// How many sources there are.
    sources: AtomicU32,
    /// The bus whose carriers are being opened, by its place in the plan.
    bus: AtomicU8,
}

#[derive(Debug)]
enum Mode {
    Recording(Recording),
    Replaying(Box<Replaying>),
}

impl InputLog {
    fn new(mode: Mode) -> InputLog {
        let shared = Shared { mode, sources: AtomicU32::new(1), bus: AtomicU8::new(0) };
        InputLog { shared: Some(Arc::new(shared)), source: 0 }
    }

    /// Writes what the loop takes into `recording`.
    pub fn recording(recording: Recording) -> InputLog {
        InputLog::new(Mode::Recording(recording))
    }

    /// Gives the loop what `replaying` reads.
    pub fn replaying(replaying: Replaying) -> InputLog {
        InputLog::new(Mode::Replaying(Box::new(replaying)))
    }

    /// The same log for another source. Sources are made in the same order whenever a machine of this plan is built.
    #[inline]
    pub fn source(&self) -> InputLog {
        let source = self.shared.as_ref().map_or(0, |shared| shared.sources.fetch_add(1, Ordering::Relaxed));
        InputLog { shared: self.shared.clone(), source }
    }

    /// The source of its entries.
    pub fn id(&self) -> u64 {
        self.source.into()
    }

    /// The carriers that are opened from now on are those of bus `place`.
    pub fn opens(&self, place: usize) {
        if let Some(shared) = &self.shared {
            shared.bus.store(place as u8, Ordering::Relaxed);
        }
    }

    /// The bus whose carriers are being opened.
    pub fn bus(&self) -> u8 {
        self.shared.as_ref().map_or(0, |shared| shared.bus.load(Ordering::Relaxed))
    }

    #[inline]
    fn mode(&self) -> Option<&Mode> {
        self.shared.as_deref().map(|shared| &shared.mode)
    }

    /// Whether there is one.
    #[inline]
    pub fn is_on(&self) -> bool {
        self.shared.is_some()
    }

    /// The log that is written, if one is.
    #[inline]
    pub fn as_recording(&self) -> Option<&Recording> {
        match self.mode() {
            Some(Mode::Recording(recording)) => Some(recording),
            _ => None,
        }
    }

    /// The log that is read, if one is.
    #[inline]
    pub fn as_replaying(&self) -> Option<&Replaying> {
        match self.mode() {
            Some(Mode::Replaying(replaying)) => Some(&**replaying),
            _ => None,
        }
    }

    /// The cycles so far are whole: what was written may be taken out.
    #[inline]
    pub fn whole(&self) {
        if let Some(recording) = self.as_recording() {
            recording.publish();
        }
    }

    /// A slot of the grid begins.
    #[inline]
    pub fn cycle(&self, index: u64) {
        match self.mode() {
            None => {}
            Some(Mode::Recording(recording)) => recording.cycle(index),
            Some(Mode::Replaying(replaying)) => replaying.cycle(index),
        }
    }

    /// A look that found `found`, which mostly is `usual`. Returns what the loop goes on with.
    #[inline(always)]
    pub fn value(&self, usual: u64, found: u64) -> u64 {
        match self.mode() {
            None => found,
            Some(mode) => self.logged_value(mode, usual, found),
        }
    }

    /// The same with a log.
    #[inline(never)] // What looks without one saves no registers for it.
    fn logged_value(&self, mode: &Mode, usual: u64, found: u64) -> u64 {
        match mode {
            Mode::Recording(recording) => {
                match found == usual {
                    true => recording.nothing(),
                    false => recording.entry(Kind::Value, &[self.source.into(), found], &[]),
                }
                found
            }
            Mode::Replaying(replaying) => replaying.part(self.source).unwrap_or(usual),
        }
    }

    /// The same of a flag.
    #[inline]
    pub fn flag(&self, usual: bool, found: bool) -> bool {
        self.value(usual.into(), found.into()) != 0
    }

    /// The same of a value that mostly is not there.
    #[inline]
    pub fn part<T: Part>(&self, found: Option<T>) -> Option<T> {
        match self.mode() {
            None => found,
            Some(mode) => self.logged_part(mode, found),
        }
    }

    /// The same with a log.
    #[inline(never)] // As that of a value.
    fn logged_part<T: Part>(&self, mode: &Mode, found: Option<T>) -> Option<T> {
        match mode {
            Mode::Recording(recording) => {
                match &found {
                    None => recording.nothing(),
                    Some(part) => with_words(self.source.into(), part, |words| {
                        recording.value(Kind::Value, words);
                    }),
                }
                found
            }
            Mode::Replaying(replaying) => replaying.part(self.source),
        }
    }

    /// A call of the in-loop task: a repeated run has to have the same here.
    #[inline]
    pub fn calls(&self, call: &impl Part) {
        match self.mode() {
            None => {}
            Some(Mode::Recording(recording)) => {
                with_words(0, call, |words| recording.value(Kind::Task, words));
            }
            Some(Mode::Replaying(replaying)) => with_words(0, call, |words| replaying.call(&words[1..])),
        }
    }
}

/// The most words of a part.
const MOST_WORDS: usize = 48;

/// Runs `work` with `first` and the words of `part`.
fn with_words<T: Part>(first: u64, part: &T, work: impl FnOnce(&[u64])) {
    const { assert!(T::WORDS <= MOST_WORDS) };
    let mut words = [0; 1 + MOST_WORDS];
    words[0] = first;
    part.put(&mut words[1..=T::WORDS]);
    work(&words[..=T::WORDS]);
}
