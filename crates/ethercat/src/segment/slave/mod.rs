//! One slave on its way to OP, and back there when it falls: one step per slot.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the slave, and how it leaves its steps |
//! | `step` | its steps |
//! | `request`, `receive` | the request of a step; the answer to it |
//! | `address` | whether it is there, and its station address |
//! | `identity` | who it is: its alias, its SII, its identification |
//! | `objects` | what is written and read over its mailbox |
//! | `found` | a drive that is in OP already |
//! | `sync` | its clock and SYNC0 |
//! | `setup` | its SyncManagers, FMMUs and watchdog |
//! | `resume` | whether they are still those that were set up here |
//! | `frames` | its content in the frames |
//!
//! | step | what |
//! |---|---|
//! | look | whether it is there, its state, the features of its controller, its station address |
//! | unmap | FMMUs of others, unless it is a drive that may move |
//! | alias, SII, identification | who it is; the SII, with its buffers, is taken from its processor and given back |
//! | INIT | down, whatever its state was; errors acknowledged |
//! | clear | ports, FMMUs, SyncManagers and SYNC0 of others; station address, taken from whoever has it |
//! | clock | delay and offset, as soon as the segment has a time for it |
//! | PREOP | the mailbox, then the objects of its start-up |
//! | process data | watchdog, SyncManagers, FMMUs; read back |
//! | settled | its own clock is synchronised to the segment's; SYNC0 |
//! | SAFEOP, OP | inputs count; outputs too, once the grid is locked to the segment |
//!
//! A slave that comes back, or fell to SAFEOP, is resumed from there only if its settings read back as they were set up
//! here. Otherwise another master has been there, and it is set up from INIT.
//!
//! A step is repeated while its frames are lost; with a slave that does not answer it begins anew after a while.

mod address;
mod found;
mod frames;
mod identity;
mod objects;
mod receive;
mod request;
mod resume;
mod setup;
mod step;
mod sync;

use self::objects::List;
pub use self::step::Missing;
use self::step::{Change, Pause, Phase, Setting, Step};
use super::clock::SegmentClock;
use super::note::Note;
use crate::image::Offsets;
use crate::mode::Mode;
use crate::plan::{Owner, SlavePlan, Start};
use crate::sii::Managers;
use crate::slot::Ask;
use crate::wire::frame::{Command, position};
use crate::wire::registers::{AlState, AlStatus, Features};
use fieldbeat_core::bus::Cycle;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::{MS, S, Time};

/// The interval of looks at a position where no slave answers, or one that cannot be used.
const LOOK_EVERY_NS: u64 = 100 * MS;
/// The pause after the first refusal; after each further one twice as long, up to the longest.
const REFUSED_FOR_NS: u64 = S;
const REFUSED_MOST_NS: u64 = 30 * S;
/// A slave that leaves OP sooner than this after it came there counts as refused again, ns.
const STAYS_NS: u64 = 2 * S;
/// FMMUs and SyncManagers that are cleared in a slot.
const FMMUS_AT_ONCE: u8 = 8;
const MANAGERS_AT_ONCE: u8 = 8;
/// SyncManagers that are written, or read, in a slot.
const MANAGERS_SET: u8 = 2;

/// The context of a step in the segment.
#[derive(Clone, Copy, Debug)]
pub struct Context<'a> {
    /// The cycle whose frame is built, or was received.
    pub cycle: &'a Cycle,
    /// When that frame was sent.
    pub sent_at: Time,
    /// The time of the segment.
    pub clock: SegmentClock,
    /// The station address of the slave whose clock is the segment's, or is to be.
    pub reference: Option<u16>,
    /// The time of the reference clock is sent to all slaves.
    pub timed: bool,
    /// It does, or may begin to.
    pub may_begin: bool,
    /// The position of a slave that runs on a time other than the segment's: it may not begin yet.
    pub other_time: Option<u16>,
    /// How much later than the first slave of all the first one with SYNC0 receives, ns.
    pub first_delay_ns: Option<u32>,
    /// The segment has a time, and not from this slave.
    pub has_time: bool,
    /// How many slaves the broadcast counts in this answer's frame.
    pub counted: u16,
    /// The other slave of this segment that has the station address in this answer, by its position; or else one that
    /// was given it, and may not be reached by it any more.
    pub in_use: Option<u16>,
    /// The request to which this is the answer, or a part of it, was not carried out.
    pub missing: Option<Missing>,
    /// The longest wait of a slave for its turn, ns.
    pub turn_ns: u64,
    /// The drive wants its outputs to go out.
    pub wants_outputs: bool,
    /// Whether its power stage may be on, by a report since this instant; `None`: there was none.
    pub powered: Option<(bool, Time)>,
}

/// Which of its process data the frames carry.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mapped {
    /// None.
    #[default]
    None,
    /// AL status and inputs.
    Inputs,
    /// Outputs too.
    All,
}

/// The events of a slave that others have to know.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Happened {
    /// Nothing.
    Nothing,
    /// It came up to OP.
    Operational,
    /// It reported an AL error.
    Error,
    /// It has lost its settings: it was switched off and on.
    Restarted,
    /// Data written at its position may have reached another slave, behind it.
    Misplaced,
    /// Another master has changed its state or its settings.
    Intruded,
    /// It was found running on this time, the lower half, which the segment is to have.
    GivesTime(u32),
}

/// The progress of a bring-up to OP. Each bring-up has one of its own.
#[derive(Clone, Copy, Debug, Default)]
pub struct Way {
    /// It has its station address, and is reached by it.
    pub addressed: bool,
    /// The process data are in the frames.
    pub mapped: Mapped,
    /// The mailbox can be used.
    pub mailbox_open: bool,
    /// How often its objects were begun.
    lists: u8,
    /// It was joined in OP: not all of it was set up here.
    pub joined: bool,
    /// How often its clock was set anew while it settled.
    set_anew: u8,
    /// It has been in OP.
    was_operational: bool,
    /// The state, as far as is known; `None`: it is not there.
    pub al: Option<AlState>,
}

/// The time that a slave runs on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Runs {
    /// That was not read yet: a drive that may move may run on any.
    #[default]
    Unknown,
    /// The segment's or none; or it does not answer.
    Harmless,
    /// Another one than the segment's, as far as is known.
    Apart,
}

/// The relation of this master to a slave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
enum Tie {
    /// Nothing.
    #[default]
    None,
    /// It was given its station address, and has not been switched off since.
    Known,
    /// All of it was set up here, too, and nothing has contradicted that since.
    Ours,
}

/// One slave of the segment.
#[derive(Debug, Default)]
pub struct Slave {
    /// The owner.
    pub owner: Owner,
    /// The offsets of its process data.
    pub offsets: Offsets,
    /// It as configured.
    pub plan: SlavePlan,
    /// The process data go by LRW.
    lrw: bool,
    /// Found running, and not to be joined, it is refused, and runs on; otherwise it is stopped.
    pub refuses_running: bool,
    /// The present step.
    step: Step,
    since: Time,
    silent: u8,
    /// How far it is.
    pub way: Way,
    features: Features,
    /// The controller copies AL control to AL status: it has no errors, and an acknowledgement would become one.
    emulated: bool,
    /// The alias when it was looked at, where it matters.
    alias: u16,
    /// The acknowledgement of the error that it showed when it was looked at.
    acknowledge: Option<AlStatus>,
    fmmus: u8,
    managers: u8,
    /// The SyncManagers as its SII has them.
    delivered: Managers,
    /// The AL status was read.
    pub has_al: bool,
    /// The mode that it showed then.
    pub found_mode: Option<Mode>,
    /// The watchdog is set as configured.
    pub watched: bool,
    /// The clock was set to the segment's, and it has not been away since.
    pub clock_set: bool,
    /// How much later than the first slave it receives, ns; `None`: it has been away since that was found.
    pub delay_ns: Option<u32>,
    /// The time that it runs on.
    pub runs: Runs,
    /// How many slaves the broadcast counted when it was read.
    counted: u16,
    /// The same when it last answered by its own station address.
    counted_as_ours: u16,
    /// The relation of this master to it.
    tie: Tie,
    /// It was given its station address by this master, and as far as is known the same slave still has it.
    given: bool,
    /// The orderly end has begun: it is being shut down.
    ending: bool,
    /// Objects that are read before its outputs count, since these carry its own values.
    pub own: Box<[Start]>,
    /// They were read.
    pub has_own: bool,
    /// A factor for the next object, from the object that was read before.
    factor: u32,
    note: Note,
    /// The remark on it although it is in operation.
    pub remark: Note,
    /// The object that it was found not to take in PREOP.
    omitted: Note,
    /// The same, to be known once it is in operation.
    pub further: Note,
    /// Why it was refused last.
    refused: Note,
    /// How often that was, in a row.
    refusals: u8,
    /// When it came to OP, or fell from there.
    moved_at: Time,
    /// The state last reported.
    pub reported: Option<AlState>,
    /// The AL status in the newest frame; 0: none.
    pub shown: AlStatus,
    /// It was in OP with all of its process data, which was reported, and the newest frame shows the same.
    pub steady: bool,
    /// Frames in a row that came back without it.
    pub missing: u8,
}

impl Slave {
    /// A slave that was not seen yet.
    pub fn new(owner: Owner, plan: &SlavePlan, offsets: Offsets, lrw: bool) -> Slave {
        Slave {
            owner,
            offsets,
            plan: plan.clone(),
            lrw,
            watched: true,
            factor: 1,
            note: Note::Starting,
            ..Slave::default()
        }
    }

    /// Adds what it touches besides itself, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.plan.outputs);
        regions.add(&*self.plan.inputs);
        regions.add(&*self.plan.start_up);
        self.plan.start_up.iter().for_each(|start| regions.add(&*start.string));
        regions.add(&*self.plan.verify);
        regions.add(&*self.own);
        regions.add(&*self.plan.verify_found);
    }

    /// The station address.
    pub fn station(&self) -> u16 {
        self.plan.station()
    }

    /// The state of its replies; `None`: they do not count, since it has not been in OP, or its inputs are not
    /// valid.
    pub fn state_of_replies(&self) -> Option<AlState> {
        self.way.al.filter(|al| self.way.was_operational && *al >= AlState::SafeOp)
    }

    /// Why it is not in operation: while it is tried again, the last refusal, until it gets further.
    pub fn note(&self) -> Note {
        match self.note {
            Note::Starting if self.refused != Note::None => self.refused,
            note => note,
        }
    }

    /// It is not a drive: its inputs may all be zero.
    pub fn is_device(&self) -> bool {
        matches!(self.owner, Owner::Device(_))
    }

    /// It waits in SAFEOP or is in OP, as far as is known.
    pub fn is_settled(&self) -> bool {
        matches!(self.step, Step::Up | Step::Lock)
    }

    /// It is up, and stays so as far as is known here: it has no request.
    pub fn wants_nothing(&self) -> bool {
        matches!(self.step, Step::Up) && self.way.mapped == Mapped::All && self.has_al && !self.way.joined
    }

    /// This station address is its own, and the master uses it.
    pub fn has_address(&self, station: u16) -> bool {
        self.way.addressed && self.station() == station
    }

    /// This station address is its own, and it was given it: it may answer at another position now.
    pub fn was_given(&self, station: u16) -> bool {
        self.given && self.station() == station
    }

    /// It is about to have its clock set.
    pub fn waits_for_clock(&self) -> bool {
        matches!(self.step, Step::Time | Step::Offset(_))
    }

    /// The clock is not set yet: it settles while others are set up.
    pub fn is_urgent(&self) -> bool {
        self.plan.sync && !self.clock_set && !matches!(self.step, Step::Rest(_) | Step::Refused(_) | Step::Up)
    }

    /// For that its delay is to be found.
    pub fn lacks_delay(&self) -> bool {
        self.delay_ns.is_none() && matches!(self.step, Step::Time)
    }

    /// Requests so many bytes from this register on.
    fn read(&self, register: u16, length: usize, ask: &mut Ask) {
        ask.read(self.reads(register), length);
    }

    /// Requests that these bytes are written there.
    fn write(&self, register: u16, bytes: &[u8], ask: &mut Ask) {
        ask.write(self.writes(register), bytes);
    }

    fn reads(&self, register: u16) -> Command {
        if self.way.addressed {
            Command::Fprd(self.station(), register)
        } else {
            Command::Aprd(position(self.plan.place), register)
        }
    }

    fn writes(&self, register: u16) -> Command {
        if self.way.addressed {
            Command::Fpwr(self.station(), register)
        } else {
            Command::Apwr(position(self.plan.place), register)
        }
    }

    fn enter(&mut self, now: Time, step: Step) {
        (self.step, self.since, self.silent) = (step, now, 0);
    }

    /// It begins anew, after a while.
    fn start_over(&mut self, now: Time, after_ns: u64, note: Note) {
        (self.way, self.note) = (Way::default(), note);
        self.enter(now, Step::Rest(now + after_ns));
    }

    /// It cannot be used as it is.
    fn refuse(&mut self, now: Time, note: Note) {
        self.doubt();
        if self.runs == Runs::Unknown {
            self.runs = Runs::Apart;
        }
        (self.way, self.note, self.refused) = (Way::default(), note, note);
        let pause_ns = (REFUSED_FOR_NS << self.refusals.min(5)).min(REFUSED_MOST_NS);
        self.refusals = self.refusals.saturating_add(1);
        let pause = Pause { until: now + pause_ns, next: now + LOOK_EVERY_NS, seen: None };
        self.enter(now, Step::Refused(pause));
    }

    /// It has left OP by itself. True: right after it came there, and again, so that it has to wait; the first time it
    /// is brought back at once.
    fn falls_again(&mut self, now: Time) -> bool {
        let has_stayed = self.way.was_operational && now.since(self.moved_at) > STAYS_NS;
        self.moved_at = now;
        if has_stayed {
            self.refusals = 0;
            return false;
        }
        let fell_before = self.refusals > 0;
        self.refusals = self.refusals.max(1);
        fell_before
    }

    /// No slave answers at its position; so many the broadcast counts.
    fn absent(&mut self, now: Time, counted: u16) {
        (self.clock_set, self.runs, self.delay_ns) = (false, Runs::Harmless, None);
        (self.refused, self.refusals) = (Note::None, 0);
        let note = if counted > self.plan.place { Note::Unreachable(counted) } else { Note::Absent };
        self.start_over(now, LOOK_EVERY_NS, note);
    }

    /// Data meant for another slave may have been written to it: it is examined, and set up again.
    pub fn doubted(&mut self, now: Time) {
        self.doubt();
        self.lost(now);
    }

    /// The settings may be others than those that were made here.
    fn doubt(&mut self) {
        self.tie = self.tie.min(Tie::Known);
    }

    /// The frames no longer reach it.
    pub fn lost(&mut self, now: Time) {
        (self.clock_set, self.runs, self.delay_ns) = (false, Runs::Unknown, None);
        self.start_over(now, 0, Note::Absent);
    }

    /// Takes it down to INIT, if it is ours and in any other state: true once it is there, or unreachable.
    pub fn shut_down(&mut self, now: Time) -> bool {
        self.ending = true;
        match self.step {
            Step::State(Change { to: AlState::Init, .. }) => false,
            Step::SiiBack { .. } => false,
            Step::SiiTake { .. } | Step::Sii(_) => {
                self.enter(now, Step::SiiBack { refused: Note::None });
                false
            }
            // It is not ours.
            _ if self.way.joined && self.way.mapped == Mapped::Inputs => true,
            Step::Rest(_)
            | Step::Refused(_)
            | Step::Look
            | Step::Twin { .. }
            | Step::Unaddress
            | Step::Misplaced
            | Step::There(_)
            | Step::Unmap(_)
            | Step::SiiForce
            | Step::Identification
            | Step::Identified { .. }
            | Step::Found
            | Step::FoundClock { .. }
            | Step::FoundFmmus
            | Step::Objects { list: List::Power, .. }
            | Step::Free { joins: true }
            | Step::Address { joins: true }
            | Step::Join => true,
            _ => {
                self.way.was_operational = false;
                self.enter(now, Step::to(AlState::Init));
                false
            }
        }
    }
}
