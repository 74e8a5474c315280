//! The stop of drives without their loop: by the watch of a loop that is stuck, or by the guardian of a process that
//! has died.
//!
//! It is the stop sequence of the loop (`stop`), sent by the drive's own quick stop: standstill is seen in what
//! the drive answers, and power goes off, or stays, as the axis' own stop plan says. Every drive that the master
//! commands is sent its telegram in every round, since a request of the loop may be under way still.
//!
//! What halts a drive switches on one that is ready for that. So the first round only looks: a drive that shows no
//! power is sent off, whatever was sent to it last.

use std::fmt::Write as _;
use std::io::ErrorKind;
use std::net::{SocketAddrV4, UdpSocket};
use std::os::fd::OwnedFd;

use super::stop::{Sight, StopSequence};
use crate::axis::{Command, Load, StopPlan};
use crate::bus::last::{LastDrive, LastResort, Power, Reply, Sighted, Telegram, Telegrams};
use crate::rt::Held;
use crate::time::{MS, Time};

/// A drive that has not answered for so many rounds is not received.
const SILENT_ROUNDS: u32 = 20;

/// Datagrams that a round takes in for each drive: a reply to it, and what the loop's requests have left.
const MOST_EACH: usize = 4;

/// The stop of all drives of one last resort.
#[derive(Debug)]
pub struct LastStop {
    socket: UdpSocket,
    drives: Held<LastDrive>,
    stops: Vec<DriveStop>,
    /// Until then the drives are not free.
    _locks: Vec<OwnedFd>,
}

impl LastStop {
    /// That of these drives. What it needs to know of them is copied: whatever a dying process does to their memory
    /// changes no telegram.
    pub fn new(last: LastResort) -> LastStop {
        let stops = last.drives.all().iter().map(DriveStop::new).collect();
        LastStop { socket: last.socket, drives: last.drives, stops, _locks: last.locks }
    }

    /// The memory of the drives.
    pub fn shared(&self) -> Held<LastDrive> {
        self.drives.clone()
    }

    /// The drives.
    pub fn drives(&self) -> std::slice::Iter<'_, LastDrive> {
        self.drives.all().iter()
    }

    /// One round: takes in what the drives have answered, and sends each of them its telegram. Never waits. The wires
    /// were taken at `taken`.
    pub fn round(&mut self, now: Time, taken: Time) {
        self.take_in(now);
        for (stop, drive) in self.stops.iter_mut().zip(self.drives.all()) {
            let address = stop.address;
            if let Some(telegram) = stop.step(now, taken, drive) {
                // One that the host refuses is sent again with the next round.
                let _ = self.socket.send_to(telegram.bytes(), address);
            }
        }
    }

    fn take_in(&mut self, now: Time) {
        let mut bytes = [0; 128];
        for _ in 0..MOST_EACH * self.stops.len() {
            match self.socket.recv_from(&mut bytes) {
                Ok((length, std::net::SocketAddr::V4(from))) => {
                    if let Some(stop) = self.stops.iter_mut().find(|stop| stop.address == from) {
                        stop.take(now, &bytes[..length]);
                    }
                }
                // An answer of another host, such as that nobody listens.
                Ok(_) => {}
                Err(error) if error.kind() == ErrorKind::ConnectionRefused => {}
                Err(_) => return,
            }
        }
    }

    /// Whether each drive has come to the end of its stop: seen off, held as planned, or by its time-outs.
    pub fn is_done(&self) -> bool {
        self.stops.iter().all(DriveStop::is_done)
    }
}

/// Drives that a text names one by one.
const MOST_NAMED: usize = 16;

/// Writes how the stop of each drive that the master commanded went; first of those that were seen neither at
/// standstill nor off.
pub fn describe<'a>(text: &mut String, drives: impl Iterator<Item = &'a LastDrive> + Clone) {
    let (mut named, mut more) = (0, 0);
    let has_stopped =
        |drive: &LastDrive| drive.outcome.stood_ns().is_some() || drive.outcome.off_ns().is_some();
    let commanded = drives.filter(|drive| drive.sent() != Power::Untouched);
    let not_stopped = commanded.clone().filter(|drive| !has_stopped(drive));
    for drive in not_stopped.chain(commanded.filter(|drive| has_stopped(drive))) {
        if named == MOST_NAMED {
            more += 1;
            continue;
        }
        // A string takes whatever is written to it.
        let _ = write!(text, "{} {}", if named > 0 { "," } else { "" }, drive.name());
        let outcome = &drive.outcome;
        let _ = match (outcome.stood_ns(), outcome.off_ns()) {
            (Some(stood), Some(off)) => {
                write!(text, " stood after {} ms, off after {} ms", stood / MS, off / MS)
            }
            (Some(stood), None) => write!(text, " stood after {} ms", stood / MS),
            (None, Some(off)) => write!(text, " off after {} ms", off / MS),
            (None, None) if outcome.replies() == 0 => write!(text, " did not answer"),
            (None, None) => write!(text, " was not seen at standstill"),
        };
        named += 1;
    }
    let _ = match (named, more) {
        (0, _) => write!(text, " none was commanded"),
        (_, 0) => Ok(()),
        _ => write!(text, ", and {more} more"),
    };
}

/// The stop of one drive. Time and replies go in, telegrams come out.
#[derive(Debug)]
struct DriveStop {
    address: SocketAddrV4,
    plan: (StopPlan, Load),
    reply: Reply,
    telegrams: Telegrams,
    /// The last request sent to it; `None`: the master has never commanded it.
    sent: Option<Sent>,
    /// `None`: it has not begun.
    sequence: Option<StopSequence>,
    was_down: bool,
    /// The state that came since the last round.
    fresh: Option<(Time, Sighted)>,
    /// The newest of those before, and since when it is.
    last: Option<(Time, Sighted)>,
    velocity: f64,
    silent: u32,
}

/// The telegrams of a round.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sent {
    Look,
    Halt,
    Off,
}

impl DriveStop {
    fn new(drive: &LastDrive) -> DriveStop {
        DriveStop {
            address: drive.address(),
            plan: drive.stop(),
            reply: drive.reply(),
            telegrams: drive.telegrams(),
            sent: None,
            sequence: None,
            was_down: false,
            fresh: None,
            last: None,
            velocity: f64::NAN,
            silent: 0,
        }
    }

    fn telegram(&self, sent: Sent) -> &Telegram {
        match sent {
            Sent::Look => &self.telegrams.look,
            Sent::Halt => &self.telegrams.halt,
            Sent::Off => &self.telegrams.off,
        }
    }

    /// The first reply to the last telegram. A second one may be a copy of it, and proves nothing.
    fn take(&mut self, now: Time, bytes: &[u8]) {
        if let Some(sent) = self.sent.filter(|_| self.fresh.is_none()) {
            self.fresh = self.reply.read(self.telegram(sent), bytes).map(|sighted| (now, sighted));
        }
    }

    /// The telegram to send now; `None`: the master does not command the drive.
    fn step(&mut self, now: Time, taken: Time, drive: &LastDrive) -> Option<&Telegram> {
        let sent = match (self.sent, drive.sent()) {
            (None, Power::Untouched) => return None,
            (None, Power::On) => Sent::Look,
            _ => self.stop(now, taken, drive),
        };
        self.sent = Some(sent);
        if sent == Sent::Off {
            // Whoever stops it after this one does not halt it: that would switch it on again.
            drive.note_off();
        }
        Some(self.telegram(sent))
    }

    /// The next step of its stop.
    fn stop(&mut self, now: Time, taken: Time, drive: &LastDrive) -> Sent {
        let after = Time(now.since(taken));
        let sight = self.look(drive);
        let mut sent = self.sent.unwrap_or(Sent::Off);
        match &mut self.sequence {
            None => {
                let is_off = drive.sent() == Power::Off || (sight.fresh && !sight.powered);
                let (plan, load) = self.plan;
                let (sequence, command) = StopSequence::start_last(plan, load, now, is_off);
                self.sequence = Some(sequence);
                sent = if command == Command::Disable { Sent::Off } else { Sent::Halt };
            }
            Some(sequence) => {
                let was_braking = sequence.is_braking();
                let mut command = sequence.step(now, sight);
                self.was_down |= sequence.is_down();
                if sequence.holds() && sight.fresh && sight.moving {
                    command = Some(sequence.again(now, sight.velocity));
                }
                if command == Some(Command::Disable) {
                    sent = Sent::Off;
                }
                let has_stood = drive.outcome.stood_ns().is_some();
                if was_braking && !has_stood && !sequence.is_braking() && sequence.is_standing(sight) {
                    drive.outcome.set_stood(after);
                }
            }
        }
        if sent == Sent::Off && sight.fresh && !sight.powered && drive.outcome.off_ns().is_none() {
            drive.outcome.set_off(after);
        }
        sent
    }

    /// The state of the drive as known now.
    fn look(&mut self, drive: &LastDrive) -> Sight {
        let fresh = self.fresh.take();
        self.silent = if fresh.is_some() { 0 } else { self.silent.saturating_add(1) };
        if let Some((at, sighted)) = fresh {
            drive.outcome.count_reply();
            if let Some((before, last)) = self.last {
                let moved = f64::from(sighted.position.wrapping_sub(last.position)) * self.reply.unit;
                self.velocity = moved * 1e9 / at.since(before).max(1) as f64;
            }
            self.last = fresh;
        }
        Sight {
            fresh: fresh.is_some(),
            answers: self.silent < SILENT_ROUNDS,
            failed: false,
            powered: self.last.is_none_or(|(_, sighted)| sighted.powered),
            moving: self.last.is_none_or(|(_, sighted)| sighted.moving),
            velocity: self.velocity,
        }
    }

    /// It came to its end, even if the drive has moved since and is halted once more: nobody waits for ever.
    fn is_done(&self) -> bool {
        self.sent.is_none() || self.was_down
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::plan::{AxisPlan, HeldBy, Load, StopHow, StopThen, StopTimeout};
    use crate::axis::units::Units;
    use crate::bus::last::{PowerSent, ROUND_NS};
    use crate::time::S;

    const LOOK: [u8; 8] = [0, 7, 7, 7, 7, 7, 7, 7];
    const HALT: [u8; 9] = [7, 7, 7, 7, 7, 7, 7, 7, 0x2F];
    const OFF: [u8; 9] = [7, 7, 7, 7, 7, 7, 7, 7, 0x3E];
    const REPLY: Reply =
        Reply { unpowered: 0b10111, unit: 1e-3, moving: 1, status_at: 8, state_at: 10, position_at: 11 };

    fn telegrams() -> Telegrams {
        let [look, halt, off] = [&LOOK[..], &HALT, &OFF].map(Telegram::new);
        Telegrams { look, halt, off }
    }

    /// A drive of which so much is known, and its stop, begun at 0.
    struct Bench {
        held: Held<LastDrive>,
        stop: DriveStop,
        now: Time,
    }

    impl Bench {
        fn new(sent: Option<bool>, plan: impl FnOnce(&mut AxisPlan)) -> Bench {
            let mut axis = AxisPlan::new("x", Units::millimetres(1_000.0));
            (axis.stop.standstill, axis.stop.standstill_for) = (5.0, 3);
            plan(&mut axis);
            let address = "127.0.0.1:7".parse().unwrap();
            let held = Held::own(LastDrive::new(&axis, MS, address, telegrams(), REPLY));
            if let Some(on) = sent {
                PowerSent::of(held.clone(), 0).note(on);
            }
            Bench { stop: DriveStop::new(held.first()), held, now: Time(0) }
        }

        /// The next round, after a reply with this state and this position, in 1e-3 units; moving by the drive's word.
        fn round(&mut self, reply: Option<(u8, i32, bool)>) -> Option<Vec<u8>> {
            self.now = self.now + ROUND_NS;
            if let Some((state, position, moving)) = reply {
                let mut bytes =
                    self.stop.sent.map_or(vec![0; 8], |sent| self.stop.telegram(sent).echo().to_vec());
                bytes.extend([moving.into(), 0, state]);
                bytes.extend(position.to_le_bytes());
                self.stop.take(self.now, &bytes);
            }
            let telegram = self.stop.step(self.now, Time(0), self.held.first())?;
            Some(telegram.bytes().to_vec())
        }

        /// Rounds until then; what was sent in the last of them.
        fn until(&mut self, end: u64, reply: Option<(u8, i32, bool)>) -> Vec<u8> {
            let mut sent = None;
            while self.now.0 < end {
                sent = self.round(reply);
            }
            sent.unwrap()
        }

        fn outcome(&self) -> String {
            let mut text = String::new();
            describe(&mut text, self.held.all().iter());
            text
        }
    }

    const ON: u8 = 8;
    const READY: u8 = 2;

    #[test]
    fn a_drive_is_halted_until_it_was_seen_at_standstill_and_then_switched_off() {
        let mut bench = Bench::new(Some(true), |_| {});
        assert_eq!(bench.round(None), Some(LOOK.to_vec()));
        // 100 units/s, then slower, and then the drive's own word that it still moves.
        for (position, moving) in [(0, true), (1_000, true), (1_100, true), (1_120, true), (1_120, true)] {
            assert_eq!(bench.round(Some((ON, position, moving))), Some(HALT.to_vec()));
            assert!(!bench.stop.is_done());
        }
        for _ in 0..2 {
            assert_eq!(bench.round(Some((ON, 1_120, false))), Some(HALT.to_vec()));
        }
        // One round in between without a reply proves nothing.
        assert_eq!(bench.round(None), Some(HALT.to_vec()));
        assert_eq!(bench.round(Some((ON, 1_120, false))), Some(OFF.to_vec()));
        assert!(!bench.stop.is_done());
        assert_eq!(bench.round(Some((ON, 1_120, false))), Some(OFF.to_vec()));
        assert_eq!(bench.round(Some((READY, 1_120, false))), Some(OFF.to_vec()));
        assert!(bench.stop.is_done());
        assert_eq!(bench.outcome(), " x stood after 100 ms, off after 120 ms");
    }

    #[test]
    fn a_reply_to_the_loop_or_a_second_one_to_the_same_telegram_proves_nothing() {
        let mut bench = Bench::new(Some(true), |_| {});
        bench.round(None);
        // One to the look, that comes late.
        bench.round(None);
        bench.stop.take(bench.now, &[&LOOK[..], &[0, 0, ON, 0, 0, 0, 0]].concat());
        for _ in 0..50 {
            let standing = [&[7; 8][..], &[0, 0, ON, 0, 0, 0, 0]].concat();
            let mut of_the_loop = standing.clone();
            of_the_loop[7] = 15;
            (0..20).for_each(|_| bench.stop.take(bench.now, &of_the_loop));
            assert_eq!(bench.round(None), Some(HALT.to_vec()));
        }
        assert_eq!(bench.held.first().outcome.replies(), 0);
        // Twenty replies in one round are one.
        let standing = [&[7; 8][..], &[0, 0, ON, 0, 0, 0, 0]].concat();
        (0..20).for_each(|_| bench.stop.take(bench.now, &standing));
        assert_eq!(bench.round(None), Some(HALT.to_vec()));
        assert_eq!(bench.held.first().outcome.replies(), 1);
    }

    #[test]
    fn one_whose_bits_are_forced_or_that_does_not_answer_ends_by_its_time_out() {
        for reply in [Some((ON, 0, true)), None] {
            let mut bench =
                Bench::new(Some(true), |axis| axis.stop.timeout = std::time::Duration::from_secs(1));
            // The second round begins the stop.
            assert_eq!(bench.until(S + ROUND_NS, reply), HALT);
            assert_eq!(bench.until(S + 2 * ROUND_NS, reply), OFF);
            assert!(!bench.stop.is_done());
            bench.until(2 * S + 2 * ROUND_NS, reply);
            assert!(bench.stop.is_done());
        }
        // A load that would drop is never switched off.
        for reply in [Some((ON, 0, true)), None] {
            let mut bench = Bench::new(Some(true), |axis| {
                (axis.stop.on_timeout, axis.stop.then) = (StopTimeout::Hold, StopThen::Hold);
                axis.load = Load::Vertical(HeldBy::Drive);
            });
            assert_eq!(bench.until(3_600 * S, reply), HALT);
            assert!(bench.stop.is_done());
        }
    }

    #[test]
    fn a_held_axis_that_moves_is_halted_again() {
        let mut bench = Bench::new(Some(true), |axis| axis.stop.then = StopThen::Hold);
        assert_eq!(bench.until(S, Some((ON, 0, false))), HALT);
        assert!(bench.stop.is_done());
        let stood = bench.outcome();
        assert_eq!(bench.round(Some((ON, 9_000, true))), Some(HALT.to_vec()));
        assert!(bench.stop.sequence.as_ref().unwrap().is_braking() && bench.stop.is_done());
        assert_eq!((bench.until(3 * S, Some((ON, 9_000, false))), bench.outcome()), (HALT.to_vec(), stood));
    }

    #[test]
    fn drives_not_seen_to_stop_are_named_first() {
        let named = |name: String| {
            let axis = AxisPlan::new(name, Units::millimetres(1_000.0));
            LastDrive::new(&axis, MS, "127.0.0.1:7".parse().unwrap(), telegrams(), REPLY)
        };
        let held = Held::handed((0..20).map(|index| named(format!("d{index}"))).collect());
        for (index, drive) in held.all().iter().enumerate() {
            PowerSent::of(held.clone(), index).note(true);
            match index {
                18 => {}
                17 => drive.outcome.set_off(Time(2 * MS)),
                _ => drive.outcome.set_stood(Time(MS)),
            }
        }
        let mut text = String::new();
        describe(&mut text, held.all().iter());
        assert!(text.starts_with(" d18 did not answer, d0 stood after 1 ms, d1 "), "{text}");
        assert!(text.ends_with(" d14 stood after 1 ms, and 4 more"), "{text}");
    }

    #[test]
    fn a_drive_that_was_off_is_sent_off_and_one_that_is_not_commanded_nothing() {
        let mut bench = Bench::new(Some(false), |_| {});
        assert_eq!(bench.round(None), Some(OFF.to_vec()));
        assert_eq!(bench.round(Some((READY, 0, false))), Some(OFF.to_vec()));
        let mut bench = Bench::new(Some(true), |axis| axis.stop.how = StopHow::Coast);
        assert_eq!(bench.round(None), Some(LOOK.to_vec()));
        assert_eq!(bench.round(Some((ON, 0, true))), Some(OFF.to_vec()));
        let mut bench = Bench::new(None, |_| {});
        assert_eq!(bench.round(Some((ON, 0, true))), None);
        assert!(bench.stop.is_done());
        assert_eq!(bench.outcome(), " none was commanded");
        // A loop that was frozen between its check and its send.
        PowerSent::of(bench.held.clone(), 0).note(true);
        assert_eq!(bench.round(None), Some(LOOK.to_vec()));
        assert!(!bench.stop.is_done());
    }

    /// The last request was to be on, or is believed to have been: one that switched it off may have left behind that.
    #[test]
    fn a_drive_that_shows_no_power_is_never_halted_which_would_switch_it_on() {
        let mut bench = Bench::new(Some(true), |_| {});
        assert_eq!(bench.round(None), Some(LOOK.to_vec()));
        for _ in 0..100 {
            assert_eq!(bench.round(Some((READY, 0, false))), Some(OFF.to_vec()));
        }
        assert!(bench.stop.is_done());
        // What another one has switched off is not halted by the next one, even if it does not answer.
        let mut bench = Bench::new(Some(true), |axis| axis.stop.timeout = std::time::Duration::from_secs(1));
        assert_eq!(bench.until(2 * S, None), OFF);
        bench.stop = DriveStop::new(bench.held.first());
        assert_eq!(bench.until(4 * S, None), OFF);
        let sent: Vec<_> = (0..3).map(|_| bench.round(None).unwrap()).collect();
        assert_eq!(sent, [OFF, OFF, OFF]);
    }
}
