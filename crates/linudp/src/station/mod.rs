//! The master's view of one drive: which reply answers which request, what the drive reported last, and the next
//! request.
//! It takes `now` and slices, and knows no socket. What is desired of it becomes blocks in `profile`.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the next request, and what is received |
//! | `identity` | which request a reply answers |
//! | `serial` | which drive it is |
//! | `report` | an accepted reply: values in user units, evidence |
//!
//! In most exchanges nothing new is desired, and the drive says the same as before but for its positions. Then the
//! request is the last one with the next definition, and only positions and velocities are computed anew.

mod identity;
mod report;
mod serial;

use std::mem::offset_of;

pub(super) use self::serial::SerialNote;

use self::identity::{EarlierRequest, EarlierRequests, Echo, Identity, Unrequested};
use self::report::{Counts, Turns};
use self::serial::Identification;
use super::counters::Own;
use super::native::{Native, NativePort};
use super::other::OtherMaster;
use super::plan::{LinUdpDrive, MonitorPlan, ReplyTag};
use super::profile::{Inputs, Outputs, Profile};
use super::rtc::RtcChannel;
use super::upid::commanding;
use super::wire::{ErrorCode, MotionBlock, Request, ResponseDef, ResponseView, RtcBlock};
use fieldbeat_core::axis::acyclic::{self, AcyclicEnds};
use fieldbeat_core::axis::{Link, Units};
use fieldbeat_core::bus::desired::Power;
use fieldbeat_core::bus::last::PowerSent;
use fieldbeat_core::bus::native::native;
use fieldbeat_core::bus::notes::NoteCells;
use fieldbeat_core::bus::{Cycle, Exchange, Slot};
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

/// Every so many probes of a silent drive, one carries a no-operation motion block and a real-time-config block: some
/// factory-fresh drives do not answer a telegram without any block (sheet, 1.3).
const FULL_PROBE_EVERY: u8 = 4;

/// The following fields begin a line of the cache.
#[derive(Debug)]
#[repr(align(64))]
struct Line;

/// The bytes.
const LINE: usize = align_of::<Line>();

/// The number of words before the profile that let its part touched by each exchange begin a line.
const BEFORE: usize = (LINE - (size_of::<Profile>() - Profile::TOUCHED) % LINE) % LINE / 8;

/// No revision comes to this.
const UNSETTLED: u64 = u64::MAX;

/// One drive. What each exchange touches lies on four lines of the cache: the requests need the first one, from the end
/// of the profile to the start of the identity, and the check for a call; the replies need the first one, and the two
/// from `settled` to the start of `native`.
#[derive(Debug)]
#[repr(C, align(64))]
pub struct Station {
    _before: [u64; BEFORE],
    profile: Profile,
    /// The channel has nothing to send, and calls that command the drive are refused or not as it knows.
    idle: bool,
    guarded: bool,
    /// Each request has a count of its own.
    tagged: bool,
    /// The prepared request is a probe.
    probing: bool,
    identity: Identity,
    _replies: Line,
    /// Another clean reply with the same states changes nothing but positions, as long as this is the revision of the
    /// profile, or [`UNSETTLED`].
    settled: u64,
    inputs: Inputs,
    /// The positions in the last clean reply, for velocities, if there was one since the drive started.
    last: Counts,
    units: Units,
    has_last: bool,
    /// The last clean reply was the first one that says that the drive starts: the next one confirms it.
    starts: bool,
    /// The drive reports variables.
    shows: bool,
    /// Which drive it is.
    who: Identification,
    native: NativePort,
    _calls: Line,
    rtc: RtcChannel,
    turns: Turns,
    earlier: EarlierRequests,
    other: OtherMaster,
    monitor: MonitorPlan,
    /// The code of its error, since the error is reported; `None`: not known yet.
    error: Option<ErrorCode>,
    serial_note: NoteCells<SerialNote>,
    /// Probes that have gone out.
    probes: u8,
}

const _: () = {
    assert!(offset_of!(Station, identity) % LINE + Identity::TOUCHED <= LINE, "a request needs one line");
    let replies = offset_of!(Station, native) + 16 - offset_of!(Station, settled);
    assert!(replies <= 2 * LINE, "a reply needs two lines more, up to the writer of its inputs");
};

impl Station {
    /// The station of `drive`, and the application's ends of its native process data and of its acyclic access.
    pub fn new(drive: &LinUdpDrive, log: &InputLog) -> (Station, Native, AcyclicEnds) {
        let (application, native) = native();
        let (ends, port) = acyclic::queue(drive.axis.parameter_queue, commanding());
        let (native, port) = (native.logged(log), port.logged(log));
        let (mut usual, shown) = (ResponseDef::CYCLIC, drive.monitor != MonitorPlan::Off);
        if shown {
            usual = usual.with(ResponseDef::MONITOR);
        }
        let within = drive.replies_within() as u8;
        let station = Station {
            _before: [0; BEFORE],
            profile: Profile::new(drive),
            idle: false,
            guarded: false,
            tagged: drive.reply_tag == ReplyTag::Count,
            probing: false,
            identity: Identity::new(usual, drive.reply_tag, shown, within.saturating_sub(1)),
            _replies: Line,
            settled: UNSETTLED,
            inputs: Inputs::default(),
            last: Counts::default(),
            units: drive.axis.units,
            has_last: false,
            starts: false,
            shows: shown,
            who: Identification::new(drive.serial),
            native,
            _calls: Line,
            rtc: RtcChannel::new(port, drive.monitor.sources(), within),
            turns: Turns::default(),
            earlier: EarlierRequests::default(),
            other: OtherMaster::default(),
            monitor: drive.monitor,
            error: None,
            serial_note: NoteCells::new(1),
            probes: 0,
        };
        (station, application, ends)
    }

    /// The native process data.
    #[inline]
    pub(super) fn native(&self) -> &NativePort {
        &self.native
    }

    /// Why it is not connected although it answers.
    pub(super) fn serial_note(&self) -> NoteCells<SerialNote> {
        self.serial_note.clone()
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.native.memory(regions);
        self.rtc.memory(regions);
        self.profile.memory(regions);
        self.serial_note.memory(regions);
    }

    /// From now on it notes here what the requests that left say of the drive's power.
    pub(super) fn note_power_in(&mut self, power_sent: PowerSent) {
        self.profile.note_power_in(power_sent);
    }

    /// Builds the request of the next send in `out` and returns its length. Built again for the same send, it is
    /// the same: state that changes with every request changes in [`sent`](Self::sent).
    #[inline(always)] // Of each drive and cycle.
    pub fn prepare(&mut self, cycle: &Cycle, slot: &mut Slot, out: &mut [u8]) -> usize {
        let is_quiet = slot.link == Link::Online
            && !self.tagged
            && self.idle
            && self.guarded == slot.guarded
            && !self.rtc.is_called();
        if !(is_quiet && self.profile.holds(&slot.desired)) {
            return self.build(cycle, slot, out);
        }
        (slot.commanded, slot.expected_silence, self.probing) = (false, false, false);
        let request = Request {
            response_def: self.identity.response_def(),
            control: self.profile.control(),
            ..Request::default()
        };
        self.emit(&request, None, out)
    }

    /// Says whether news since the last request was built have changed what it was built from.
    #[inline]
    pub fn is_void(&self) -> bool {
        self.profile.is_void()
    }

    /// Writes the request, whose reply echoes this tag.
    #[inline]
    fn emit(&mut self, request: &Request, tag: Option<u8>, out: &mut [u8]) -> usize {
        if let Some(block) = &request.motion {
            self.other.prepare((block.header & 0xF) as u8);
        }
        self.identity.prepared = Echo::new(request, tag);
        request.emit(out)
    }

    /// Builds a request that differs from the last one.
    #[inline(never)]
    fn build(&mut self, cycle: &Cycle, slot: &mut Slot, out: &mut [u8]) -> usize {
        let silent = matches!(slot.link, Link::Unseen | Link::Lost);
        self.who.advance(silent, self.identity.is_open());
        let who = self.who.block();
        let outputs = self.profile.encode(&slot.desired, &self.inputs, &mut self.native);
        let Outputs { control, motion, config } = outputs;
        let powered = slot.status.state.is_powered();
        let called = self.rtc.advance(cycle.grid, slot.link, powered, slot.guarded);
        slot.commanded = self.rtc.commands();
        slot.expected_silence = self.rtc.expects_silence() && !powered;
        let mut request = Request {
            response_def: self.identity.response_def(),
            control,
            motion,
            config: who.or(config).or(called),
            ..Request::default()
        };
        if config.is_some() {
            self.rtc.give_way();
        }
        let tag = match (config, called) {
            _ if !self.tagged || who.is_some() => None,
            (Some(_), _) => config,
            // A call is repeated with one count, which does not identify the request.
            (None, Some(_)) => None,
            _ if self.rtc.hushes() => None,
            (None, None) => Some(self.rtc.tag()),
        };
        request.config = request.config.or(tag);
        self.probing = silent && slot.desired.power.value == Power::Untouched;
        if self.probing && self.probes == FULL_PROBE_EVERY - 1 {
            request.motion = Some(MotionBlock::default());
            request.config = request.config.or(Some(RtcBlock::default()));
        }
        if request.config.is_some() {
            request.response_def = request.response_def.with(ResponseDef::CONFIG);
        }
        (self.idle, self.guarded) = (self.rtc.is_idle(), slot.guarded);
        self.emit(&request, tag.map(|block| block.count()), out)
    }

    /// The request was handed to the wire.
    #[inline]
    pub fn sent(&mut self, sent_at: Time, cycle: &Cycle, slot: &mut Slot) {
        let reply_by = cycle.deadline + u64::from(self.identity.beyond()) * cycle.period_ns;
        self.identity.sent();
        if self.probing {
            self.probes = (self.probes + 1) % FULL_PROBE_EVERY;
        }
        slot.owe(sent_at, reply_by, true);
        self.profile.sent(&mut self.native);
        slot.gone.grid = Some(cycle.grid);
        if self.identity.requested.has_motion() {
            self.other.sent(slot.counters.sent);
        }
        if !self.idle {
            self.rtc.sent();
        }
    }

    /// The exchange of an earlier cycle is still owed as the next request leaves.
    #[cold]
    pub fn owe(&mut self, slot: &mut Slot) {
        if let Exchange::Owed { sent_at, reply_by, .. } = slot.exchange {
            let (echo, carried) = (self.identity.requested, self.profile.carried());
            self.earlier.owe(EarlierRequest { echo, sent_at, carried });
            slot.earlier.owe(sent_at, reply_by);
            (slot.exchange, slot.has_earlier) = (Exchange::Idle, true);
        }
    }

    /// A datagram from the drive came in. `in_window` is false for datagrams that were in the socket before the
    /// send.
    #[inline]
    pub fn take(&mut self, at: Time, bytes: &[u8], in_window: bool, slot: &mut Slot) {
        let Ok(view) = ResponseView::new(bytes) else {
            slot.counters.malformed += 1;
            return;
        };
        if !self.who.is_known() {
            return self.identify(&view, in_window, slot);
        }
        match slot.exchange {
            Exchange::Owed { sent_at, .. } if in_window && self.identity.is_answered_by(&view) => {
                let suspect = self.identity.answered();
                slot.exchange = Exchange::Answered { sent_at, at, suspect };
                slot.counters.answered += 1;
                if suspect {
                    slot.counters.suspect += 1;
                }
                self.read(sent_at, at, &view, suspect, None, slot);
            }
            _ => self.unrequested(at, &view, in_window, slot),
        }
    }

    /// A reply of a drive that may be another one: of all that it says only its serial number counts, and the exchange
    /// is a missed one.
    #[cold]
    fn identify(&mut self, view: &ResponseView<'_>, in_window: bool, slot: &mut Slot) {
        let is_owed = matches!(slot.exchange, Exchange::Owed { .. });
        if is_owed && in_window && self.identity.is_answered_by(view) {
            if !self.identity.answered() {
                self.who.take(view.config(), &self.serial_note);
            }
            return;
        }
        if !in_window {
            self.owe(slot);
        }
        if slot.has_earlier
            && let Some((place, _)) = self.earlier.find(view)
        {
            if !self.identity.answer_earlier(&mut self.earlier, place) {
                self.who.take(view.config(), &self.serial_note);
            }
            return;
        }
        match self.identity.unrequested(view, in_window) {
            Unrequested::Second { .. } | Unrequested::Late => slot.counters.late += 1,
            Unrequested::Duplicate => slot.counters.duplicate += 1,
            Unrequested::Foreign => slot.counters.foreign += 1,
        }
    }

    /// Whether a telegram answers an exchange of an earlier cycle. It is read if it is newer than the newest one.
    fn answers_earlier(&mut self, at: Time, view: &ResponseView<'_>, slot: &mut Slot) -> bool {
        let Some((place, request)) = self.earlier.find(view) else { return false };
        if !slot.earlier.answer(request.sent_at, at) {
            // Its time is over.
            self.earlier.forget(place);
            return false;
        }
        let suspect = self.identity.answer_earlier(&mut self.earlier, place);
        slot.has_earlier = true;
        slot.counters.answered += 1;
        slot.counters.suspect += u64::from(suspect);
        Own::Behind.count(&mut slot.counters);
        if self.is_newer(request.sent_at) {
            self.read(request.sent_at, at, view, suspect, Some(request.carried), slot);
        }
        true
    }

    /// A well-formed telegram that does not close the exchange of this window.
    #[cold]
    fn unrequested(&mut self, at: Time, view: &ResponseView<'_>, in_window: bool, slot: &mut Slot) {
        if !in_window {
            self.owe(slot);
        }
        if slot.has_earlier && self.answers_earlier(at, view, slot) {
            return;
        }
        match self.identity.unrequested(view, in_window) {
            Unrequested::Second { suspect } => {
                slot.counters.late += 1;
                let mut sent_at = at;
                if let Exchange::Answered { sent_at: sent, suspect, .. } = &mut slot.exchange {
                    // The feedback is fresh again. The exchange stays without a round-trip sample.
                    (sent_at, *suspect) = (*sent, true);
                }
                self.read(sent_at, at, view, suspect, None, slot);
            }
            Unrequested::Late => slot.counters.late += 1,
            Unrequested::Duplicate => slot.counters.duplicate += 1,
            Unrequested::Foreign => slot.counters.foreign += 1,
        }
    }
}

#[cfg(test)]
mod tests;
