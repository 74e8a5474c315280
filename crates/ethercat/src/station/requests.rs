//! The SDOs of the station itself: one after the other, whenever its mailbox is free.
//!
//! The mode of operation comes first, since a homing waits for it; then whether the drive has its reference; then
//! the monitored objects, in turns.

use crate::mode::Mode;
use crate::object::number::{HOMING_METHOD, MANUFACTURER_STATUS, MODE, MODE_DISPLAY};
use crate::object::{Object, Type};
use crate::plan::KollmorgenDrive;
use crate::service::{SdoFailure, Service, Transfer};
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::bus::desired::{Mode as ModeWanted, ModeIs, Reference};
use fieldbeat_core::time::{MS, Time};

/// Bit 1 of the manufacturer's status, 1002h: the reference is set (CAN manual).
const REFERENCE: u32 = 1 << 1;
/// An unanswered SDO is repeated after this time, ns.
const AGAIN_NS: u64 = 100 * MS;
/// Monitored objects are read no faster than one in this time, ns.
const SHOW_EVERY_NS: u64 = 10 * MS;
/// A mode in the outputs is taken over within this time, ns (assumed): what the drive shows sooner may be from before.
const CARRIED_NS: u64 = 10 * MS;

/// The SDO under way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pending {
    Method,
    Mode(Mode),
    Display,
    Reference,
    Shown(usize),
}

/// The SDOs of one station.
#[derive(Debug, Default)]
pub struct Requests {
    own: Option<Mode>,
    /// The outputs carry the mode, this one: what an SDO writes they would overwrite.
    carried: Option<Mode>,
    method: Option<i8>,
    show: [Option<(Object, Type)>; MONITOR_CHANNELS],
    pending: Option<Pending>,
    not_before: Time,
    /// With this mode wanted there is nothing to do, except for monitored objects.
    content: Option<ModeWanted>,
    /// The mode that the drive is in; `None`: not known.
    mode: Option<Mode>,
    /// Somebody else may have changed the mode: it counts as another one until it is read.
    doubted: bool,
    /// The method was written for this homing.
    method_written: bool,
    display_read: bool,
    /// Its encoder is absolute: it always has its reference.
    absolute: bool,
    /// Whether it is homed; `None`: not known.
    pub homed: Option<bool>,
    /// The last homing was attained, by bit 12 of its status word: what counts for a drive without 1002h.
    pub(super) attained: bool,
    /// It does not report that.
    unreferred: bool,
    /// The SDO under way began too early.
    outdated: bool,
    /// It refused the last request.
    pub refused: bool,
    turn: usize,
    next_show: Time,
    shown: [Option<f64>; MONITOR_CHANNELS],
    show_refused: [bool; MONITOR_CHANNELS],
    shown_fresh: bool,
    /// The channel whose object it does not show, and its reason.
    pub refusal: Option<(u8, u32)>,
}

impl Requests {
    pub(super) fn new(drive: &KollmorgenDrive) -> Requests {
        let is_carried = drive.outputs.place(MODE).is_some();
        Requests {
            own: drive.mode(),
            carried: drive.mode().filter(|_| is_carried),
            method: drive.home_method,
            show: drive.show,
            absolute: drive.absolute,
            homed: drive.absolute.then_some(true),
            ..Requests::default()
        }
    }

    /// The drive is another one than before, or may be: everything known of it is read again. The end of the present
    /// SDO is nobody's any more.
    pub(super) fn forget(&mut self) {
        let Requests { own, method, show, absolute, .. } = *self;
        let (carried, homed) = (self.carried.and(own), absolute.then_some(true));
        *self = Requests { own, carried, method, show, absolute, homed, ..Requests::default() };
        self.show_again(Time(0));
    }

    /// The drive shows this mode: nothing of the start-up was written to it.
    pub fn found_in(&mut self, mode: Mode) {
        (self.mode, self.display_read, self.content) = (Some(mode), true, None);
        self.carried = self.carried.map(|_| mode);
    }

    /// The mode that the outputs carry; `None`: it is not in them.
    pub(super) fn carried(&self) -> Option<Mode> {
        self.carried
    }

    /// The application may have changed the mode.
    pub(super) fn doubt_mode(&mut self) {
        (self.doubted, self.display_read, self.content) = (true, false, None);
        self.outdated |= self.pending == Some(Pending::Display);
    }

    /// Monitored objects are read from then on; never, if there are none.
    fn show_again(&mut self, from: Time) {
        self.next_show = self.next_shown().map_or(Time(u64::MAX), |_| from);
    }

    /// Its reference may have changed.
    pub(super) fn request_reference(&mut self) {
        if self.absolute {
            return;
        }
        (self.homed, self.content) = (None, None);
        self.outdated |= self.pending == Some(Pending::Reference);
    }

    /// When a monitored object is to be read next.
    #[inline]
    pub(super) fn next_show(&self) -> Time {
        self.next_show
    }

    /// What a homing has left; `None`: not known yet.
    pub(super) fn reference(&self) -> Option<Reference> {
        self.homed.map(|homed| match homed {
            true => Reference::Set,
            false if self.unreferred => Reference::Silent,
            false => Reference::Lost,
        })
    }

    /// The mode that it is in, as far as is known: a mode written at start-up counts as its own.
    pub(super) fn mode(&self) -> ModeIs {
        match self.mode {
            _ if self.doubted => ModeIs::Other,
            _ if matches!(self.pending, Some(Pending::Mode(_))) => ModeIs::Other,
            None => ModeIs::Own,
            // It shows another one than the outputs carry, and is about to change to that.
            shown if self.carried.is_some() && self.carried != shown => ModeIs::Other,
            mode if mode == self.own => ModeIs::Own,
            Some(Mode::HOMING) => ModeIs::Homing,
            // Without a known setpoint no mode is wrong.
            Some(_) if self.own.is_none() => ModeIs::Own,
            Some(_) => ModeIs::Other,
        }
    }

    /// The monitored values, if they are new; and the refused ones.
    #[inline]
    pub(super) fn take_shown(&mut self) -> Option<&[Option<f64>; MONITOR_CHANNELS]> {
        std::mem::take(&mut self.shown_fresh).then_some(&self.shown)
    }

    /// Takes the result of the last SDO, and begins the next; false: there was nothing to do.
    pub(super) fn advance(&mut self, now: Time, wanted: ModeWanted, service: &mut Service) -> bool {
        let is_idle = self.are_idle(wanted) && now < self.next_show;
        if !is_idle {
            self.go_on(now, wanted, service);
        }
        !is_idle
    }

    /// With this mode wanted there is nothing to do, except for monitored objects.
    pub(super) fn are_idle(&self, wanted: ModeWanted) -> bool {
        self.content == Some(wanted)
    }

    fn go_on(&mut self, now: Time, wanted: ModeWanted, service: &mut Service) {
        self.content = None;
        if let Some(pending) = self.pending
            && let Some(end) = service.take_end()
        {
            self.pending = None;
            self.take(now, pending, end);
        }
        if let Some(mode) = self.to_carry(wanted) {
            self.carry(now, mode);
        }
        if self.pending.is_some() || now < self.not_before {
            return;
        }
        match self.next(now, wanted) {
            Some((pending, transfer)) if service.is_free() => {
                self.pending = Some(pending);
                service.begin(transfer);
            }
            Some(_) => {}
            None => self.content = Some(wanted),
        }
    }

    /// The mode that the drive shall be in; `None`: the one that it is in.
    fn wants(&self, wanted: ModeWanted) -> Option<Mode> {
        match wanted {
            ModeWanted::AsIs => None,
            ModeWanted::Own => self.own.filter(|_| self.mode.or(self.carried).is_some()),
            ModeWanted::Homing => Some(Mode::HOMING),
        }
    }

    /// The method of homing is to be written before its mode.
    fn lacks_method(&self, mode: Mode) -> bool {
        mode == Mode::HOMING && self.method.is_some() && !self.method_written
    }

    /// The mode that the outputs are to carry in place of the present one, whatever the drive shows.
    fn to_carry(&self, wanted: ModeWanted) -> Option<Mode> {
        let carried = self.carried?;
        self.wants(wanted).filter(|mode| *mode != carried && !self.lacks_method(*mode))
    }

    /// The outputs carry this mode from now on: until it was read again nothing is known of the drive's.
    fn carry(&mut self, now: Time, mode: Mode) {
        self.carried = Some(mode);
        self.method_written &= mode == Mode::HOMING;
        self.not_before = now + CARRIED_NS;
        self.doubt_mode();
    }

    fn next(&self, now: Time, wanted: ModeWanted) -> Option<(Pending, Transfer)> {
        let wants = self.wants(wanted);
        if wants.is_some() && wants != self.mode && !self.doubted {
            return self.next_mode(wants?);
        }
        if !self.display_read {
            return Some((Pending::Display, Transfer::Read(MODE_DISPLAY)));
        }
        if self.homed.is_none() {
            return Some((Pending::Reference, Transfer::Read(MANUFACTURER_STATUS)));
        }
        if now < self.next_show {
            return None;
        }
        let (channel, object) = self.next_shown()?;
        Some((Pending::Shown(channel), Transfer::Read(object)))
    }

    /// The next channel whose turn it is.
    fn next_shown(&self) -> Option<(usize, Object)> {
        let places = (self.turn..MONITOR_CHANNELS).chain(0..self.turn);
        places
            .filter(|channel| !self.show_refused[*channel])
            .find_map(|channel| Some((channel, self.show[channel]?.0)))
    }

    fn next_mode(&self, mode: Mode) -> Option<(Pending, Transfer)> {
        let byte = |object, value: i8| Transfer::Write { object, raw: u64::from(value as u8), bytes: 1 };
        match self.method {
            Some(method) if self.lacks_method(mode) => Some((Pending::Method, byte(HOMING_METHOD, method))),
            // Whether the drive shows it by now.
            _ if self.carried.is_some() => Some((Pending::Display, Transfer::Read(MODE_DISPLAY))),
            _ => Some((Pending::Mode(mode), byte(MODE, mode.0))),
        }
    }

    fn take(&mut self, now: Time, pending: Pending, end: Result<u32, SdoFailure>) {
        if matches!(end, Err(SdoFailure::Silent | SdoFailure::Unusable(_))) {
            self.outdated = false;
            self.not_before = now + AGAIN_NS;
            if matches!(pending, Pending::Mode(_)) {
                // The write may have reached the drive.
                self.doubt_mode();
            }
            return;
        }
        match (pending, end) {
            (Pending::Method, Ok(_)) => self.method_written = true,
            (Pending::Mode(mode), Ok(_)) => {
                self.mode = Some(mode);
                self.method_written &= mode == Mode::HOMING;
            }
            (Pending::Method | Pending::Mode(_), Err(_)) => {
                self.refused = true;
                self.not_before = now + AGAIN_NS;
            }
            (Pending::Display | Pending::Reference, _) if std::mem::take(&mut self.outdated) => {}
            (Pending::Display, end) => {
                (self.display_read, self.doubted) = (true, false);
                // A drive that does not report its mode has the one that was written, or that the outputs carry.
                self.mode = end.ok().map(|raw| Mode(raw as u8 as i8)).or(self.carried);
                if self.carried != self.mode && self.carried.is_some() {
                    self.not_before = now + SHOW_EVERY_NS;
                }
            }
            // A drive without 1002h has the reference that was seen to be set.
            (Pending::Reference, end) => {
                self.unreferred = end.is_err();
                self.homed = Some(end.map_or(self.attained, |raw| raw & REFERENCE != 0));
            }
            (Pending::Shown(channel), end) => self.take_value(now, channel, end),
        }
    }

    fn take_value(&mut self, now: Time, channel: usize, end: Result<u32, SdoFailure>) {
        self.turn = (channel + 1) % MONITOR_CHANNELS;
        self.shown_fresh = true;
        match (end, self.show[channel]) {
            (Ok(raw), Some((_, kind))) => self.shown[channel] = Some(kind.number(raw.into()) as f64),
            (Err(SdoFailure::Abort(code)), _) => {
                (self.shown[channel], self.show_refused[channel]) = (None, true);
                self.refusal = Some((channel as u8, code.0));
            }
            _ => {}
        }
        self.show_again(now + SHOW_EVERY_NS);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::object::Family;
    use crate::object::pdo::Layout;
    use crate::wire::sdo::AbortCode;

    #[test]
    fn a_mode_whose_write_was_not_answered_is_read_before_it_counts() {
        let mut requests = Requests::new(&KollmorgenDrive::new("x", 0, Family::S700));
        let own = requests.own.unwrap();
        requests.found_in(own);
        assert_eq!(requests.mode(), ModeIs::Own);
        let write = Pending::Mode(Mode::HOMING);
        requests.take(Time(0), write, Err(SdoFailure::Silent));
        assert_eq!(requests.mode(), ModeIs::Other, "the drive may have taken it");
        let next = requests.next(Time(u64::MAX), ModeWanted::Own).map(|(pending, _)| pending);
        assert_eq!(next, Some(Pending::Display));
        requests.take(Time(0), Pending::Display, Ok(Mode::HOMING.0 as u8 as u32));
        assert_eq!(requests.mode(), ModeIs::Homing);
        let next = requests.next(Time(u64::MAX), ModeWanted::Own).map(|(pending, _)| pending);
        assert_eq!(next, Some(Pending::Mode(own)));
    }

    #[test]
    fn a_drive_without_1002h_is_homed_by_what_was_seen_or_by_its_encoder() {
        let mut drive = KollmorgenDrive::new("x", 0, Family::Akd);
        let absent = || Err(SdoFailure::Abort(AbortCode::NO_OBJECT));
        let mut requests = Requests::new(&drive);
        for (attained, expected) in
            [(false, Reference::Silent), (true, Reference::Set), (false, Reference::Silent)]
        {
            requests.attained = attained;
            requests.request_reference();
            assert_eq!((requests.homed, requests.reference()), (None, None));
            requests.take(Time(0), Pending::Reference, absent());
            assert_eq!((requests.homed, requests.reference()), (Some(attained), Some(expected)));
        }
        // One that has it says so itself, and one that was away is not known any more.
        requests.attained = true;
        requests.take(Time(0), Pending::Reference, Ok(0));
        assert_eq!(requests.reference(), Some(Reference::Lost));
        requests.forget();
        requests.take(Time(0), Pending::Reference, absent());
        assert_eq!(requests.homed, Some(false));
        drive.absolute = true;
        let mut requests = Requests::new(&drive);
        for change in [|_: &mut Requests| {}, Requests::request_reference, Requests::forget] {
            change(&mut requests);
            requests.take(Time(0), Pending::Display, Ok(7));
            assert_eq!((requests.homed, requests.reference()), (Some(true), Some(Reference::Set)));
            assert_eq!(requests.next(Time(0), ModeWanted::AsIs).map(|(pending, _)| pending), None);
        }
    }

    /// Whatever was read, it is the wanted one.
    #[test]
    fn a_mode_in_the_outputs_is_the_wanted_one_and_counts_once_it_is_shown() {
        let mut drive = KollmorgenDrive::new("x", 0, Family::Akd);
        let objects = [(0x6040, 0), (0x6060, 0), (0x60C1, 1)].map(|(index, sub)| Object::new(index, sub));
        drive.outputs = Layout::of_known(0x1600, &objects).unwrap();
        drive.mode = Some(Mode::INTERPOLATED);
        let (own, byte) = (Mode::INTERPOLATED, |mode: Mode| Ok(mode.0 as u8 as u32));
        for lost in [byte(own), Err(SdoFailure::Silent)] {
            let mut requests = Requests::new(&drive);
            requests.take(Time(0), Pending::Display, byte(own));
            assert_eq!((requests.to_carry(ModeWanted::Own), requests.mode()), (None, ModeIs::Own));
            assert_eq!(requests.to_carry(ModeWanted::Homing), Some(Mode::HOMING));
            requests.carry(Time(0), Mode::HOMING);
            requests.take(Time(0), Pending::Display, lost);
            // What it shows is older than what is sent, or not known.
            assert_eq!((requests.carried(), requests.mode()), (Some(Mode::HOMING), ModeIs::Other));
            assert_eq!(requests.to_carry(ModeWanted::Own), Some(own));
            requests.carry(Time(0), own);
            assert_eq!(requests.mode(), ModeIs::Other, "it may still change to the other one");
            assert_eq!(requests.not_before, Time(CARRIED_NS));
            requests.take(Time(CARRIED_NS), Pending::Display, byte(own));
            assert_eq!((requests.carried(), requests.mode()), (Some(own), ModeIs::Own));
        }
    }
}
