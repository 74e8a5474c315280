//! The SDOs of the station itself: one after the other, whenever its mailbox is free.
//!
//! The mode of operation comes first, since a homing waits for it; then whether the drive has its reference; then
//! the monitored objects, in turns.

use crate::mode::Mode;
use crate::object::number::{HOMING_METHOD, MANUFACTURER_STATUS, MODE, MODE_DISPLAY};
use crate::object::pdo::Entry;
use crate::plan::KollmorgenDrive;
use crate::service::{Failure, Service};
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
    Method(i8),
    Mode(Mode),
    Display,
    Reference,
    Shown(usize, Entry),
}

impl Pending {
    fn begin(self, service: &mut Service) {
        match self {
            Pending::Method(method) => service.write(HOMING_METHOD, &method.to_le_bytes()),
            Pending::Mode(mode) => service.write(MODE, &mode.0.to_le_bytes()),
            Pending::Display => service.read(MODE_DISPLAY),
            Pending::Reference => service.read(MANUFACTURER_STATUS),
            Pending::Shown(_, entry) => service.read(entry.object),
        }
    }
}

/// The mode that the drive shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Display {
    #[default]
    Unread,
    Read,
    /// Somebody else may have changed the mode: it counts as another one until it is read.
    Doubted,
}

/// The SDOs of one station.
#[derive(Debug, Default)]
pub struct Requests {
    own: Option<Mode>,
    /// The outputs carry the mode, this one: what an SDO writes they would overwrite. `None`: it is not in them.
    pub(super) carried: Option<Mode>,
    method: Option<i8>,
    show: [Option<Entry>; MONITOR_CHANNELS],
    pending: Option<Pending>,
    not_before: Time,
    /// The mode that the drive is in; `None`: not known.
    mode: Option<Mode>,
    display: Display,
    /// The method was written for this homing.
    method_written: bool,
    /// The encoder is absolute: it always has its reference.
    absolute: bool,
    /// The reference that a homing has left; `None`: not known.
    pub(super) reference: Option<Reference>,
    /// The last homing was attained, by bit 12 of its status word: what counts for a drive without 1002h.
    pub(super) attained: bool,
    /// The SDO under way began too early.
    outdated: bool,
    /// It refused the last request.
    pub refused: bool,
    turn: usize,
    /// When a monitored object is to be read next.
    pub(super) next_show: Time,
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
            reference: drive.absolute.then_some(Reference::Set),
            ..Requests::default()
        }
    }

    /// The drive is another one than before, or may be: everything known of it is read again. The end of the present
    /// SDO is nobody's any more.
    pub(super) fn forget(&mut self) {
        let Requests { own, method, show, absolute, .. } = *self;
        let (carried, reference) = (self.carried.and(own), absolute.then_some(Reference::Set));
        *self = Requests { own, carried, method, show, absolute, reference, ..Requests::default() };
        self.show_again(Time(0));
    }

    /// The drive shows this mode: nothing of the start-up was written to it.
    pub fn found_in(&mut self, mode: Mode) {
        (self.mode, self.display) = (Some(mode), Display::Read);
        self.carried = self.carried.map(|_| mode);
    }

    /// The application may have changed the mode.
    pub(super) fn doubt_mode(&mut self) {
        self.display = Display::Doubted;
        self.outdated |= self.pending == Some(Pending::Display);
    }

    /// Monitored objects are read from then on; never, if there are none.
    fn show_again(&mut self, from: Time) {
        self.next_show = self.next_shown().map_or(Time(u64::MAX), |_| from);
    }

    /// The reference may have changed.
    pub(super) fn request_reference(&mut self) {
        if self.absolute {
            return;
        }
        self.reference = None;
        self.outdated |= self.pending == Some(Pending::Reference);
    }

    /// The mode that it is in, as far as is known: a mode written at start-up counts as its own.
    pub(super) fn mode(&self) -> ModeIs {
        match self.mode {
            _ if self.display == Display::Doubted => ModeIs::Other,
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
        if self.are_idle(wanted) && now < self.next_show {
            return false;
        }
        if let Some(pending) = self.pending
            && let Some(end) = service.take_end()
        {
            self.pending = None;
            self.take(now, pending, end);
        }
        if let Some(mode) = self.to_carry(wanted) {
            self.carry(now, mode);
        }
        if self.pending.is_none() && now >= self.not_before && service.is_free() {
            self.pending = self.next(now, wanted);
            if let Some(pending) = self.pending {
                pending.begin(service);
            }
        }
        true
    }

    /// With this mode wanted there is nothing to do, except for monitored objects.
    pub(super) fn are_idle(&self, wanted: ModeWanted) -> bool {
        self.pending.is_none() && self.to_carry(wanted).is_none() && self.next_own(wanted).is_none()
    }

    /// The mode that the drive shall be in; `None`: the one that it is in.
    fn wants(&self, wanted: ModeWanted) -> Option<Mode> {
        match wanted {
            ModeWanted::AsIs => None,
            ModeWanted::Own => self.own.filter(|_| self.mode.or(self.carried).is_some()),
            ModeWanted::Homing => Some(Mode::HOMING),
        }
    }

    /// The method of homing, if it is to be written before this mode.
    fn lacks_method(&self, mode: Mode) -> Option<i8> {
        self.method.filter(|_| mode == Mode::HOMING && !self.method_written)
    }

    /// The mode that the outputs are to carry in place of the present one, whatever the drive shows.
    fn to_carry(&self, wanted: ModeWanted) -> Option<Mode> {
        let carried = self.carried?;
        self.wants(wanted).filter(|mode| *mode != carried && self.lacks_method(*mode).is_none())
    }

    /// The outputs carry this mode from now on: until it was read again nothing is known of the drive's.
    fn carry(&mut self, now: Time, mode: Mode) {
        self.carried = Some(mode);
        self.method_written &= mode == Mode::HOMING;
        self.not_before = now + CARRIED_NS;
        self.doubt_mode();
    }

    fn next(&self, now: Time, wanted: ModeWanted) -> Option<Pending> {
        self.next_own(wanted).or_else(|| self.next_shown().filter(|_| now >= self.next_show))
    }

    /// The next one besides the monitored objects.
    fn next_own(&self, wanted: ModeWanted) -> Option<Pending> {
        match self.wants(wanted) {
            Some(mode) if Some(mode) != self.mode && self.display != Display::Doubted => {
                Some(match self.lacks_method(mode) {
                    Some(method) => Pending::Method(method),
                    // Whether the drive shows it by now.
                    None if self.carried.is_some() => Pending::Display,
                    None => Pending::Mode(mode),
                })
            }
            _ if self.display != Display::Read => Some(Pending::Display),
            _ => self.reference.is_none().then_some(Pending::Reference),
        }
    }

    /// The next channel whose turn it is.
    fn next_shown(&self) -> Option<Pending> {
        let mut places = (self.turn..MONITOR_CHANNELS).chain(0..self.turn);
        places.find_map(|channel| {
            let entry = self.show[channel].filter(|_| !self.show_refused[channel])?;
            Some(Pending::Shown(channel, entry))
        })
    }

    fn take(&mut self, now: Time, pending: Pending, end: Result<u32, Failure>) {
        if matches!(end, Err(Failure::GivenUp(_) | Failure::Unusable(_))) {
            self.outdated = false;
            self.not_before = now + AGAIN_NS;
            if matches!(pending, Pending::Mode(_)) {
                // The write may have reached the drive.
                self.doubt_mode();
            }
            return;
        }
        match (pending, end) {
            (Pending::Method(_), Ok(_)) => self.method_written = true,
            (Pending::Mode(mode), Ok(_)) => {
                self.mode = Some(mode);
                self.method_written &= mode == Mode::HOMING;
            }
            (Pending::Method(_) | Pending::Mode(_), Err(_)) => {
                self.refused = true;
                self.not_before = now + AGAIN_NS;
            }
            (Pending::Display | Pending::Reference, _) if std::mem::take(&mut self.outdated) => {}
            (Pending::Display, end) => {
                self.display = Display::Read;
                // A drive that does not report its mode has the one that was written, or that the outputs carry.
                self.mode = end.ok().map(|raw| Mode(raw as u8 as i8)).or(self.carried);
                if self.carried != self.mode && self.carried.is_some() {
                    self.not_before = now + SHOW_EVERY_NS;
                }
            }
            (Pending::Reference, end) => {
                self.reference = Some(match end {
                    Ok(raw) if raw & REFERENCE != 0 => Reference::Set,
                    Ok(_) => Reference::Lost,
                    // A drive without 1002h has the reference that was seen to be set.
                    Err(_) if self.attained => Reference::Set,
                    Err(_) => Reference::Silent,
                });
            }
            (Pending::Shown(channel, entry), end) => {
                self.turn = (channel + 1) % MONITOR_CHANNELS;
                self.shown_fresh = true;
                match end {
                    Ok(raw) => self.shown[channel] = Some(entry.kind.number(raw.into()) as f64),
                    Err(Failure::Abort(code)) => {
                        (self.shown[channel], self.show_refused[channel]) = (None, true);
                        self.refusal = Some((channel as u8, code.0));
                    }
                    Err(_) => {}
                }
                self.show_again(now + SHOW_EVERY_NS);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::object::Family;
    use crate::object::Object;
    use crate::object::pdo::Layout;
    use crate::wire::sdo::AbortCode;
    use fieldbeat_core::axis::acyclic::CallError;

    #[test]
    fn a_mode_whose_write_was_not_answered_is_read_before_it_counts() {
        let mut requests = Requests::new(&KollmorgenDrive::new("x", 0, Family::S700));
        let own = requests.own.unwrap();
        requests.found_in(own);
        assert_eq!(requests.mode(), ModeIs::Own);
        let write = Pending::Mode(Mode::HOMING);
        requests.take(Time(0), write, Err(Failure::GivenUp(CallError::TimedOut)));
        assert_eq!(requests.mode(), ModeIs::Other, "the drive may have taken it");
        let next = requests.next(Time(u64::MAX), ModeWanted::Own);
        assert_eq!(next, Some(Pending::Display));
        requests.take(Time(0), Pending::Display, Ok(Mode::HOMING.0 as u8 as u32));
        assert_eq!(requests.mode(), ModeIs::Homing);
        let next = requests.next(Time(u64::MAX), ModeWanted::Own);
        assert_eq!(next, Some(Pending::Mode(own)));
    }

    #[test]
    fn a_drive_without_1002h_is_homed_by_what_was_seen_or_by_its_encoder() {
        let mut drive = KollmorgenDrive::new("x", 0, Family::Akd);
        let absent = || Err(Failure::Abort(AbortCode::NO_OBJECT));
        let mut requests = Requests::new(&drive);
        for (attained, expected) in
            [(false, Reference::Silent), (true, Reference::Set), (false, Reference::Silent)]
        {
            requests.attained = attained;
            requests.request_reference();
            assert_eq!(requests.reference, None);
            requests.take(Time(0), Pending::Reference, absent());
            assert_eq!(requests.reference, Some(expected));
        }
        // One that has it says so itself, and one that was away is not known any more.
        requests.attained = true;
        requests.take(Time(0), Pending::Reference, Ok(0));
        assert_eq!(requests.reference, Some(Reference::Lost));
        requests.forget();
        requests.take(Time(0), Pending::Reference, absent());
        assert_eq!(requests.reference, Some(Reference::Silent));
        drive.absolute = true;
        let mut requests = Requests::new(&drive);
        for change in [|_: &mut Requests| {}, Requests::request_reference, Requests::forget] {
            change(&mut requests);
            requests.take(Time(0), Pending::Display, Ok(7));
            assert_eq!(requests.reference, Some(Reference::Set));
            assert_eq!(requests.next(Time(0), ModeWanted::AsIs), None);
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
        for lost in [byte(own), Err(Failure::GivenUp(CallError::TimedOut))] {
            let mut requests = Requests::new(&drive);
            requests.take(Time(0), Pending::Display, byte(own));
            assert_eq!((requests.to_carry(ModeWanted::Own), requests.mode()), (None, ModeIs::Own));
            assert_eq!(requests.to_carry(ModeWanted::Homing), Some(Mode::HOMING));
            requests.carry(Time(0), Mode::HOMING);
            requests.take(Time(0), Pending::Display, lost);
            // What it shows is older than what is sent, or not known.
            assert_eq!((requests.carried, requests.mode()), (Some(Mode::HOMING), ModeIs::Other));
            assert_eq!(requests.to_carry(ModeWanted::Own), Some(own));
            requests.carry(Time(0), own);
            assert_eq!(requests.mode(), ModeIs::Other, "it may still change to the other one");
            assert_eq!(requests.not_before, Time(CARRIED_NS));
            requests.take(Time(CARRIED_NS), Pending::Display, byte(own));
            assert_eq!((requests.carried, requests.mode()), (Some(own), ModeIs::Own));
        }
    }
}
