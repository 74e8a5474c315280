//! The real-time-config channel of one drive: one acyclic call after the other, each as a block in the requests
//! that go out anyway. It delays no cycle, sends no telegram of its own, and does a bounded slice of work.
//!
//! The channel has four bits of identity: a command runs only if its count differs from the one that the drive has
//! stored, and the answer echoes the count (LinUDP V2 manual, chapter 7). So the stored count is learned first, by
//! a command that does nothing; the same block then goes out with every request until its echo comes with a final
//! status; and after every doubt (a time-out, a lost link, a restart, a foreign block) it is learned anew. Only
//! replies that can be no older ones are read.

mod monitor;

use self::monitor::Monitor;
use super::upid::{RtcCall, Upid};
use super::wire::{RtcBlock, RtcCommand, RtcStatus};
use fieldbeat_core::axis::Link;
use fieldbeat_core::axis::acyclic::{Answer, Call, CallError, Port, Posted};
use fieldbeat_core::bus::Calls;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::{MS, S, Time};

/// A block without an echo for so long, ns, and in so many clean replies, was not accepted: it goes out with
/// another count. Masters in the field wait 200 ms.
const TAKEN_WITHIN_NS: u64 = 200 * MS;
const TAKEN_WITHIN: u32 = 5;

/// Time limit of a call of the station's own.
const OWN_LIMIT_NS: u64 = S;

/// Counts go from 1 to 14, as the vendor's own library counts: 0 is what a drive has stored after its start.
fn next(count: u8) -> u8 {
    if count >= 14 { 1 } else { count + 1 }
}

fn no_operation(count: u8) -> RtcBlock {
    RtcBlock::command(count, RtcCommand::NO_OPERATION)
}

/// Status of a call whose command was followed by silence without an acknowledge: it went out, and the drive is
/// back. Only a restart and a check show whether it was done.
pub const UNACKNOWLEDGED: u32 = 0x100;

/// A parameter that every drive allows to be read.
const HARMLESS: Upid = Upid::MONITOR_SOURCE;

/// The channel. An exchange without a call touches its first field alone.
#[derive(Debug)]
#[repr(C)]
pub(super) struct RtcChannel {
    /// Each call is about a value of its own.
    calls: Calls<0>,
    /// The count of the last own block that went out, and the last prepared one.
    sent: u8,
    prepared: Option<RtcBlock>,
    stored: Stored,
    active: Option<Active>,
    /// Since the count of the block was chosen: the instant, and how many clean replies did not echo it.
    counted: Time,
    unechoed: u32,
    /// Requests since the last one that was answered by a reply that can be no older one. A drive is silent after
    /// `within` of them: so long a reply counts.
    unanswered: u8,
    within: u8,
    /// A call of the station's own failed: one of the application goes first.
    turn: bool,
    /// When the prepared request was built.
    now: Time,
    /// The motion software was stopped through this channel: status 0 is then no restart.
    software_stopped: bool,
    /// The drive has restarted since a list or a block was started: it has lost it.
    forgotten: bool,
    monitor: Monitor,
}

/// The count that the drive has stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stored {
    Unknown,
    /// It is being learned by this count.
    Learning(u8),
    Known(u8),
}

/// The call under way.
#[derive(Clone, Copy, Debug)]
struct Active {
    posted: Posted,
    /// A call of the station's own.
    own: bool,
    command: RtcCommand,
    /// The count of its command; 0 = not chosen yet.
    count: u8,
    since: Time,
    stage: Stage,
}

/// How far a command is, and how silent the drive is after one that may silence it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// No request with it went out.
    Waiting,
    /// The drive answers.
    Sent,
    /// The drive has missed an exchange.
    Silent,
    /// The link was lost.
    Lost,
}

impl Active {
    fn has_gone_out(&self) -> bool {
        self.stage != Stage::Waiting
    }

    /// The drive is silent after it.
    fn is_silent(&self) -> bool {
        matches!(self.stage, Stage::Silent | Stage::Lost)
    }

    fn block(&self) -> RtcBlock {
        let RtcCall { index, value, .. } = RtcCall::of(&self.posted.call);
        RtcBlock::call(self.count, self.command, index, value)
    }
}

/// Commands during which a drive may become silent, or drop the link: that is no fault then. Other masters report
/// that a saving drive gives no acknowledge at all; repeated into its silence, such a command might be done again
/// and again.
fn may_be_silent(command: RtcCommand) -> bool {
    matches!(
        command,
        RtcCommand::SAVE_CURVES
            | RtcCommand::SAVE_TABLE
            | RtcCommand::RESTART
            | RtcCommand::WRITE_ROM
            | RtcCommand::WRITE_BOTH
            | RtcCommand::DEFAULT_OS
            | RtcCommand::DEFAULT_MC
            | RtcCommand::DEFAULT_INTERFACE
            | RtcCommand::DEFAULT_APPLICATION
    )
}

/// Commands that are sent only to a drive whose power is off: they stop its software, or may delay it.
fn needs_power_off(command: RtcCommand) -> bool {
    may_be_silent(command) || command == RtcCommand::STOP_SOFTWARE
}

/// Why a call of the application is refused while the power of its drive is on. A table that runs goes on with
/// whatever stands in it, and so does a curve; a new curve is used by nothing yet.
pub(super) fn refusal(call: &Call) -> Option<CallError> {
    let RtcCall { command, index, .. } = RtcCall::of(call);
    match command {
        command if needs_power_off(command) => Some(CallError::Powered),
        RtcCommand::WRITE_RAM if Upid(index).is_harmless() => None,
        RtcCommand::WRITE_RAM
        | RtcCommand::START_SOFTWARE
        | RtcCommand::DELETE_CURVES
        | RtcCommand::MODIFY_CURVE
        | RtcCommand::MODIFY_CURVE_INFO
        | RtcCommand::MODIFY_CURVE_DATA
        | RtcCommand::DELETE_TABLE
        | RtcCommand::DELETE_ENTRY
        | RtcCommand::WRITE_ENTRY
        | RtcCommand::WRITE_ENTRY_DATA => Some(CallError::Commands),
        // A command that the manual does not list may do anything.
        command if command.name().is_none() => Some(CallError::Commands),
        _ => None,
    }
}

/// Commands that begin a list or a block ...
fn begins(command: RtcCommand) -> bool {
    matches!(command.0, 0x20 | 0x22 | 0x50 | 0x53 | 0x60 | 0x83 | 0x85)
}

/// ... and those that continue it.
fn goes_on(command: RtcCommand) -> bool {
    matches!(command.0, 0x21 | 0x23 | 0x51 | 0x52 | 0x54 | 0x55 | 0x61 | 0x62 | 0x84 | 0x86)
}

/// Commands whose answer names the requested index. An answer with another index is that of an earlier command.
fn repeats_index(command: RtcCommand) -> bool {
    matches!(command.0, 0x10..=0x17 | 0x50..=0x55 | 0x60..=0x62 | 0x71..=0x74 | 0x82..=0x86)
}

impl RtcChannel {
    /// The channel behind `port`, which has the drive monitor `sources` and answer `within` so many cycles.
    pub(super) fn new(port: Port, sources: [Option<Upid>; 4], within: u8) -> RtcChannel {
        RtcChannel {
            calls: Calls::new(port, 0, 0),
            sent: 0,
            prepared: None,
            stored: Stored::Unknown,
            active: None,
            counted: Time(0),
            unechoed: 0,
            unanswered: 0,
            within,
            turn: false,
            now: Time(0),
            software_stopped: false,
            forgotten: false,
            monitor: Monitor::new(sources),
        }
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.calls.memory(regions);
    }

    /// There is nothing to send and nothing to wait for, until a call is posted or the drive restarts.
    pub(super) fn is_idle(&self) -> bool {
        let busy = self.active.is_some() | self.calls.is_unsettled() | self.prepared.is_some();
        !busy && self.monitor.is_done()
    }

    /// A call is posted.
    #[inline]
    pub(super) fn is_called(&self) -> bool {
        !self.calls.is_empty()
    }

    /// The block of the next request, if the channel has something to send. The same until the request has gone
    /// out. `powered` as the drive last reported; calls that command a `guarded` drive are refused.
    pub(super) fn advance(
        &mut self,
        now: Time,
        link: Link,
        powered: bool,
        guarded: bool,
    ) -> Option<RtcBlock> {
        self.now = now;
        self.calls.guard(guarded);
        let down = matches!(link, Link::Unseen | Link::Lost);
        if down {
            self.calls.refuse_all(CallError::NotOnline);
            self.monitor.forget();
        }
        if let Some(active) = self.active.as_mut().filter(|active| may_be_silent(active.command)) {
            active.stage = match active.stage {
                Stage::Waiting => Stage::Waiting,
                Stage::Lost => Stage::Lost,
                _ if down => Stage::Lost,
                _ if self.unanswered < self.within => Stage::Sent,
                _ => Stage::Silent,
            };
        }
        if let Some(active) = self.active {
            let Active { posted, own, command, since, stage, .. } = active;
            let over = match own {
                true => (now.since(since) > posted.limit_ns).then_some(CallError::TimedOut),
                false => self.calls.over(&posted, since, now, active.has_gone_out(), !down),
            };
            let is_lost = down && stage != Stage::Lost;
            let over = over.or(is_lost.then_some(CallError::NotOnline));
            let is_forgotten = self.forgotten && goes_on(command);
            if let Some(why) = over.or(is_forgotten.then_some(CallError::Restarted)) {
                self.end(Err(why));
            }
        }
        if self.active.is_none() {
            match link {
                Link::Online => self.take_up(now, powered),
                Link::Unseen | Link::Lost => {
                    // It may have restarted meanwhile.
                    self.forgotten = true;
                    self.doubt();
                }
                Link::Qualifying => {}
            }
        }
        // Nothing is sent into a silence.
        let settles = self.calls.is_unsettled() && link == Link::Online && self.unanswered < self.within;
        self.prepared = if settles || self.active.is_some() { self.block(now) } else { None };
        self.prepared
    }

    /// A call of the application that commands the drive is under way, or may still be carried out.
    pub(super) fn commands(&self) -> bool {
        self.calls.is_unsettled()
            || self.active.is_some_and(|active| !active.own && self.calls.commands(&active.posted))
    }

    /// The next call: the station's own set-up comes first.
    fn take_up(&mut self, now: Time, powered: bool) {
        let first = if std::mem::take(&mut self.turn) { self.calls.take() } else { None };
        let own = if first.is_some() { None } else { self.monitor.next() };
        let own_call = own.map(|call| Posted { limit_ns: OWN_LIMIT_NS, call, ..Posted::default() });
        let Some(posted) = first.or(own_call).or_else(|| self.calls.take()) else { return };
        let command = RtcCall::of(&posted.call).command;
        if self.forgotten && goes_on(command) {
            return self.calls.end(&posted, Err(CallError::Restarted));
        }
        if powered && needs_power_off(command) {
            return self.calls.end(&posted, Err(CallError::Powered));
        }
        self.forgotten &= !begins(command);
        let (own, stage) = (own.is_some(), Stage::Waiting);
        self.active = Some(Active { posted, own, command, count: 0, since: now, stage });
    }

    fn block(&mut self, now: Time) -> Option<RtcBlock> {
        let overdue = now.since(self.counted) > TAKEN_WITHIN_NS && self.unechoed >= TAKEN_WITHIN;
        let stored = match self.stored {
            Stored::Known(count) => count,
            Stored::Learning(count) if !overdue => return Some(no_operation(count)),
            Stored::Unknown | Stored::Learning(_) => {
                let count = next(self.sent);
                (self.stored, self.counted, self.unechoed) = (Stored::Learning(count), now, 0);
                return Some(no_operation(count));
            }
        };
        let active = self.active.as_mut()?;
        match active.stage {
            Stage::Waiting | Stage::Sent => {}
            // The sent block may be under way: until the drive answers, only its state is requested.
            Stage::Silent => return None,
            // With the same count: a drive that has stored it reports the result, and any other one executes a
            // harmless read.
            Stage::Lost => {
                return Some(RtcBlock::call(active.count, RtcCommand::READ_RAM, HARMLESS.0, 0));
            }
        }
        let once = active.has_gone_out() && may_be_silent(active.command);
        if active.count == 0 || overdue && !once {
            // Not 0, not the count that went out before, and not the one stored in the drive: that may be a native
            // block's.
            let count = next(self.sent);
            active.count = if count == stored { next(count) } else { count };
            (self.counted, self.unechoed) = (now, 0);
        }
        Some(active.block())
    }

    /// Nothing is to be sent that the drive would store: it is silent, and may be busy with a command.
    pub(super) fn hushes(&self) -> bool {
        self.active.is_some_and(|active| active.is_silent())
    }

    /// A request to the drive makes it silent, and its power is off: no other axis has to stop because of that.
    pub(super) fn expects_silence(&self) -> bool {
        self.active.is_some_and(|active| active.has_gone_out() && may_be_silent(active.command))
    }

    /// A block that does nothing, with a count of its own, to distinguish replies.
    pub(super) fn tag(&mut self) -> RtcBlock {
        let block = no_operation(next(self.sent));
        self.prepared = Some(block);
        block
    }

    /// The application puts a block of its own into the next request. From then on the stored count is unknown, and
    /// the drive's echo proves nothing: it may be busy and not accept that block, or its reply may be an older one.
    /// So the own counts continue from where they were, and the next one is used to learn the stored count.
    pub(super) fn give_way(&mut self) {
        if self.active.is_some() {
            self.end(Err(CallError::Native));
        }
        self.prepared = None;
        self.stored = Stored::Learning(next(self.sent));
    }

    /// The prepared request has gone out.
    pub(super) fn sent(&mut self) {
        self.unanswered = self.unanswered.saturating_add(1);
        let Some(block) = self.prepared else { return };
        self.sent = block.count();
        if let Some(active) = &mut self.active
            && matches!(self.stored, Stored::Known(_))
            && active.count == block.count()
        {
            if !active.has_gone_out() {
                // The time that learning the count took does not count as its own.
                (active.since, active.stage) = (self.now, Stage::Sent);
            }
            self.software_stopped |= active.command == RtcCommand::STOP_SOFTWARE;
        }
    }

    /// Takes the block of a reply that can be no older one; `is_earlier`: to a request of an earlier cycle.
    pub(super) fn take(&mut self, block: RtcBlock, is_earlier: bool) {
        self.take_none(is_earlier);
        let echo = block.count();
        let Some(active) = self.active.filter(|_| matches!(self.stored, Stored::Known(_))) else {
            // Only the count of a later command shows that an earlier one is over.
            let is_learned = match self.stored {
                Stored::Learning(count) => count == echo,
                Stored::Unknown | Stored::Known(_) => !self.calls.is_unsettled(),
            };
            if is_learned {
                self.stored = Stored::Known(echo);
                self.calls.settle();
            } else {
                self.unechoed = self.unechoed.saturating_add(1);
            }
            return;
        };
        if !active.has_gone_out() || active.count != echo {
            self.unechoed = self.unechoed.saturating_add(1);
            return;
        }
        // It was accepted, however long it takes.
        (self.stored, self.unechoed) = (Stored::Known(echo), 0);
        let answer =
            Answer { status: block.code.into(), address: block.index().into(), value: block.value().into() };
        match block.status() {
            RtcStatus::Running | RtcStatus::Busy => {}
            // It has not stored the command before its silence.
            _ if active.stage == Stage::Lost && block.index() == HARMLESS.0 => {
                self.end(Ok(Answer { status: UNACKNOWLEDGED, ..Answer::default() }));
            }
            RtcStatus::Refused(refusal) => self.end(Err(CallError::Refused(refusal.code().into()))),
            RtcStatus::Done | RtcStatus::BlockNotFinished | RtcStatus::Other(_) => {
                let requested = RtcCall::of(&active.posted.call).index;
                if !repeats_index(active.command) || block.index() == requested {
                    self.end(Ok(answer));
                }
            }
        }
    }

    /// A reply that can be no older one, to a request without a block.
    pub(super) fn take_none(&mut self, is_earlier: bool) {
        // The newest may have left already.
        self.unanswered = self.unanswered.min(is_earlier.into());
    }

    /// Ends the call under way.
    fn end(&mut self, result: Result<Answer, CallError>) {
        let Some(active) = self.active.take() else { return };
        match (active.command, result) {
            (RtcCommand::START_SOFTWARE, Ok(_)) => {
                self.software_stopped = false;
                self.monitor.forget();
            }
            (RtcCommand::STOP_SOFTWARE, Err(_)) => self.software_stopped = false,
            (RtcCommand::RESTART, Ok(_)) => self.doubt(),
            _ => {}
        }
        let answered = matches!(result, Ok(_) | Err(CallError::Refused(_)));
        if active.is_silent() || !answered {
            self.doubt();
        }
        if active.has_gone_out() && !answered && !active.own && self.calls.commands(&active.posted) {
            self.calls.doubt();
        }
        let written = matches!(active.command, RtcCommand::WRITE_RAM | RtcCommand::WRITE_BOTH);
        if written && !active.own && (0x20A8..=0x20AB).contains(&active.posted.call.address) {
            // Another tool has chosen another source.
            self.monitor.forget();
        }
        self.turn |= active.own && result.is_err();
        if active.own {
            self.monitor.take(result);
        } else {
            self.calls.end(&active.posted, result);
        }
    }

    /// The stored count is to be learned anew.
    fn doubt(&mut self) {
        self.stored = Stored::Unknown;
        if let Some(active) = &mut self.active {
            active.count = 0;
        }
    }

    /// The drive reports that it boots, or that its motion software is stopped.
    pub(super) fn drive_restarted(&mut self) {
        if self.software_stopped {
            return;
        }
        self.begin_anew();
    }

    /// The drive's motion software runs again. If it was stopped here and not started here, the drive has restarted.
    pub(super) fn software_runs(&mut self) {
        let starting = self.active.is_some_and(|active| active.command == RtcCommand::START_SOFTWARE);
        if std::mem::take(&mut self.software_stopped) && !starting {
            self.begin_anew();
        }
    }

    fn begin_anew(&mut self) {
        match self.active {
            Some(active) if active.has_gone_out() && active.command == RtcCommand::RESTART => {
                self.end(Ok(Answer::default()));
            }
            Some(active) if active.has_gone_out() || active.own => self.end(Err(CallError::Restarted)),
            // It has not gone out yet: it goes to the restarted drive.
            Some(_) | None => {}
        }
        self.monitor.forget();
        self.forgotten = true;
        self.doubt();
    }

    /// The drive reports the values that it is to monitor, channel by channel.
    pub(super) fn monitors(&self, channel: usize) -> bool {
        self.monitor.shows(channel)
    }

    /// A source that the drive refused, with its status, once.
    pub(super) fn take_monitor_refusal(&mut self) -> Option<(u8, u32)> {
        self.monitor.refused.take()
    }
}

#[cfg(test)]
mod tests;
