//! What a drive reported last, in user units.

use std::fmt;
use std::mem::offset_of;

use super::cell::{Packed, Writer};
use crate::named;
use crate::time::Time;

named! {
    /// State of the CiA 402 power drive system, onto which every protocol maps its own state words.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
    #[repr(u8)]
    pub enum State {
        /// Nothing known yet.
        #[default]
        Unknown = 0: "Unknown",
        /// Booting, or the motion software is stopped.
        NotReadyToSwitchOn = 1: "NotReadyToSwitchOn",
        /// Power off; switching on is locked until the control word was low once.
        SwitchOnDisabled = 2: "SwitchOnDisabled",
        /// Power off, ready.
        ReadyToSwitchOn = 3: "ReadyToSwitchOn",
        /// Powered or powering, operation not enabled.
        SwitchedOn = 4: "SwitchedOn",
        /// Powered and following commands.
        OperationEnabled = 5: "OperationEnabled",
        /// A quick stop is running or holding.
        QuickStopActive = 6: "QuickStopActive",
        /// The drive reacts to a fault.
        FaultReactionActive = 7: "FaultReactionActive",
        /// Stopped by a fault, power off.
        Fault = 8: "Fault",
    }
}

impl State {
    /// Whether the power stage may be on.
    pub fn is_powered(self) -> bool {
        matches!(
            self,
            State::SwitchedOn | State::OperationEnabled | State::QuickStopActive | State::FaultReactionActive
        )
    }
}

named! {
    /// The link to a drive as the loop evaluates it.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
    #[repr(u8)]
    pub enum Link {
        /// No answer since the start; probed slowly.
        #[default]
        Unseen = 0: "unseen",
        /// Answers, but not yet often enough in a row (quality gate).
        Qualifying = 1: "qualifying",
        /// Up.
        Online = 2: "online",
        /// Was up and became silent; probed slowly.
        Lost = 3: "lost",
    }
}

named! {
    /// Why an axis was stopped by the master. It stays latched until `reset`.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
    #[repr(u8)]
    #[non_exhaustive]
    pub enum StopCause {
        /// The program or the application ended the master.
        Shutdown = 1: "shutdown",
        /// The link to the drive was lost.
        LinkLost = 2: "link lost",
        /// The drive reported a fault.
        DriveFault = 3: "drive fault",
        /// The loop overran and its policy is to stop.
        Overrun = 4: "overrun",
        /// The stream ran empty and its policy is to stop.
        Underrun = 5: "stream underrun",
        /// A setpoint was outside the limits.
        Limit = 6: "limit",
        /// The in-loop task panicked or overran its budget.
        Task = 7: "in-loop task",
        /// The drive was found enabled or moving when the master started.
        FoundRunning = 8: "found running",
        /// Another axis of its stop group was stopped.
        Group = 9: "stop group",
        /// The drive left operation by itself (its own panel, a limit switch).
        DriveDropped = 10: "drive left operation",
        /// The drive's hardware enable (STO) went away.
        StoOpen = 11: "hardware enable (STO) missing",
        /// The application gave no sign of life within the heartbeat time.
        Heartbeat = 12: "application silent",
        /// The application gave no sign of life within the heartbeat time.
        StaleSetpoint = 13: "setpoint too old",
        /// A jog was not renewed within its dead-man time.
        DeadMan = 14: "jog not renewed",
        /// The members of its group missed too many exchanges together.
        GroupLink = 15: "too many misses in its group",
        /// An enable or a motion of its group failed at this axis, or was ended here alone.
        GroupFailed = 16: "command of its group failed",
        /// It moved, with power on, although nothing commanded it.
        Uncommanded = 17: "motion without a command",
        /// A stop of the application took longer than the stop's time-out.
        StopTimeout = 18: "stop not complete in time",
        /// The computer was suspended.
        Suspended = 19: "computer suspended",
        /// The loop panicked: an error of this software.
        Panic = 20: "internal error (panic)",
        /// The thread that opens the connections of its bus ended: an error of this software.
        LinkThread = 21: "link thread ended",
        /// Another master commands the drive, or has frames on its segment.
        OtherMaster = 22: "another master",
        /// The application dropped the [`Axis`](super::Axis), or its group, while the axis moved or was about to.
        OwnerLost = 23: "axis dropped (on_owner_lost)",
        /// The loop's cycle did not end: the watch took the wires from it.
        LoopStuck = 24: "loop stuck",
        /// It did not follow its demand.
        FollowingError = 25: "following error",
        /// The reported position jumped farther than the axis can have moved: its encoder or its drive has lost it.
        PositionJump = 26: "position jumped",
    }
}

impl StopCause {
    /// That of a number, as in records; 0 is none.
    #[doc(hidden)]
    pub fn of(number: usize) -> Option<StopCause> {
        StopCause::ALL.get(number.checked_sub(1)?).copied()
    }
}

/// The axis that began the stop of a stop group, and why that axis was stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct BegunBy {
    /// The index in the machine, in the order of the plan.
    pub axis: u16,
    /// Why it was stopped.
    pub cause: StopCause,
}

impl BegunBy {
    /// Above the lowest 40 bits of a word.
    fn bits(self) -> u64 {
        u64::from(self.axis) << 48 | (self.cause as u64) << 40
    }

    fn of_bits(word: u64) -> Option<BegunBy> {
        let cause = StopCause::of(usize::from((word >> 40) as u8))?;
        Some(BegunBy { axis: (word >> 48) as u16, cause })
    }

    /// `text` of a stop, with who began it; `name` of that axis, if it is known.
    #[doc(hidden)]
    pub fn after(text: String, begun_by: Option<BegunBy>, name: Option<&str>) -> String {
        match (begun_by, name) {
            (None, _) => text,
            (Some(BegunBy { cause, .. }), Some(name)) => format!("{text}, begun by {name}: {cause}"),
            (Some(begun_by), None) => format!("{text}, {begun_by}"),
        }
    }
}

impl fmt::Display for BegunBy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "begun by axis {}: {}", self.axis, self.cause)
    }
}

/// The protocol's names for the fault codes of its drives; `None` = not known.
pub type FaultNames = fn(u32) -> Option<&'static str>;

/// Whether a fault code says that the drive's master was silent.
pub type SilenceFaults = fn(u32) -> bool;

/// A fault of a drive for messages: its code, in hex and in decimal as manuals write it, and its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault<'a> {
    /// Fault code, 0 = none.
    pub code: u32,
    /// The protocol's name for it.
    pub name: Option<&'a str>,
}

impl Fault<'static> {
    /// The fault with this code, named by `names` of its protocol.
    pub fn new(code: u32, names: FaultNames) -> Fault<'static> {
        Fault { code, name: names(code) }
    }
}

impl fmt::Display for Fault<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let code = self.code;
        match self.name {
            _ if code == 0 => f.write_str("none"),
            Some(name) => write!(f, "{code:#06x} ({code}, {name})"),
            None => write!(f, "{code:#06x} ({code})"),
        }
    }
}

/// The last report of a drive, in user units.
///
/// The order of the fields keeps together what is copied and compared in each cycle.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct DriveStatus {
    /// When the values were taken in.
    pub at: Time,
    /// Actual position, user units; NaN if the drive reports none, like the three below.
    pub position: f64,
    /// Demand position as the drive reports it, user units.
    pub demand: f64,
    /// Actual velocity, user units/s. Of a drive that reports none, the difference of the last two fresh positions
    /// over the time between their requests (EtherCAT: between the grid points of their frames). If the drive takes
    /// one of them later after its request than the other, by a twentieth of the period, that shows as 5 %.
    pub velocity: f64,
    /// Motor current, A.
    pub current: f64,
    /// The drive's warning word, 0 = none.
    pub warning: u32,
    /// The drive's fault code, 0 = none.
    pub fault: u32,
    /// The drive's state.
    pub state: State,
    /// Homed, as the drive reports it.
    pub homed: bool,
    /// The drive's setpoint generator is running.
    pub moving: bool,
    /// In the target window, as the drive reports it.
    pub in_target: bool,
    /// The drive's hardware enable (STO) is missing: power cannot come on.
    pub sto_open: bool,
    /// The reply could be that of an earlier request (no sequence number on this wire).
    pub suspect: bool,
    /// The monitored variables, in the units of the plan; `None` where no variable is configured, or it is not set
    /// up yet.
    pub monitor: [Option<f64>; MONITOR_CHANNELS],
}

impl DriveStatus {
    /// True if the values that are reported on change are the same in another report.
    #[inline]
    pub(crate) fn shows(&self, other: &DriveStatus) -> bool {
        (self.warning, self.fault, self.state, self.sto_open)
            == (other.warning, other.fault, other.state, other.sto_open)
    }

    /// Another report, which is not suspect, says the same of the drive, its reference included.
    #[inline]
    pub(crate) fn says(&self, other: &DriveStatus) -> bool {
        self.shows(other) && self.homed == other.homed && !other.suspect
    }

    /// Takes another report over, but for its monitored variables: not every report carries them.
    #[inline]
    pub(crate) fn take(&mut self, newer: &DriveStatus) {
        let DriveStatus {
            at,
            position,
            demand,
            velocity,
            current,
            warning,
            fault,
            state,
            homed,
            moving,
            in_target,
            sto_open,
            suspect,
            monitor: _,
        } = *newer;
        (self.at, self.position, self.demand, self.velocity) = (at, position, demand, velocity);
        (self.current, self.warning, self.fault, self.state) = (current, warning, fault, state);
        (self.homed, self.moving, self.in_target) = (homed, moving, in_target);
        (self.sto_open, self.suspect) = (sto_open, suspect);
    }
}

/// The newest feedback of one axis.
///
/// Who began its stop stands behind the monitored variables of the status: no usual cycle touches either of them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
#[repr(C)]
pub struct Feedback {
    /// The cycle that published it.
    pub cycle: u64,
    /// Round trip of the last clean exchange, ns.
    pub rtt_ns: Option<u32>,
    /// Cycles since the status left the drive: 0 = from this cycle. A missed exchange keeps the status.
    pub age: u32,
    /// Link health.
    pub link: Link,
    /// The latch: why the master stopped this axis.
    pub stopped: Option<StopCause>,
    /// The last report of the drive.
    pub status: DriveStatus,
    /// Which axis began that stop, and why, if this one was stopped with its stop group.
    pub begun_by: Option<BegunBy>,
}

/// The most variables that a drive may report in addition to its process data.
pub const MONITOR_CHANNELS: usize = 4;

/// The monitored values in compact form: the values, and a bit for each channel that has one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct Shown {
    mask: u8,
    values: [f64; MONITOR_CHANNELS],
}

impl From<[Option<f64>; MONITOR_CHANNELS]> for Shown {
    fn from(values: [Option<f64>; MONITOR_CHANNELS]) -> Shown {
        Shown { mask: Shown::mask(&values), values: values.map(Option::unwrap_or_default) }
    }
}

impl Shown {
    /// Where its fields are in its bytes.
    pub(crate) const MASK_AT: usize = offset_of!(Shown, mask);
    pub(crate) const VALUES_AT: usize = offset_of!(Shown, values);

    /// A bit for each channel that has a value, the first one the lowest.
    #[inline]
    pub(crate) fn mask([a, b, c, d]: &[Option<f64>; MONITOR_CHANNELS]) -> u8 {
        let bit = |value: &Option<f64>| u8::from(value.is_some());
        bit(a) | bit(b) << 1 | bit(c) << 2 | bit(d) << 3
    }

    /// The value of each channel.
    pub fn values(&self) -> [Option<f64>; MONITOR_CHANNELS] {
        std::array::from_fn(|channel| (self.mask >> channel & 1 != 0).then_some(self.values[channel]))
    }

    /// The bits of the channels (the first is the lowest), and the values as bits.
    #[doc(hidden)]
    pub fn to_words(self) -> (u8, [u64; MONITOR_CHANNELS]) {
        (self.mask, self.values.map(f64::to_bits))
    }

    /// The inverse of [`to_words`](Self::to_words); `None` if a bit belongs to no channel.
    #[doc(hidden)]
    pub fn from_words(mask: u8, words: [u64; MONITOR_CHANNELS]) -> Option<Shown> {
        (mask >> MONITOR_CHANNELS == 0).then(|| Shown { mask, values: words.map(f64::from_bits) })
    }
}

impl Feedback {
    /// The status is older by so many cycles.
    #[inline]
    pub(crate) fn grow_older(&mut self, cycles: u64) {
        self.age = self.age.saturating_add(u32::try_from(cycles).unwrap_or(u32::MAX));
    }

    /// Ready for motion commands.
    pub fn is_operational(&self) -> bool {
        self.link == Link::Online && self.status.state == State::OperationEnabled
    }

    /// Publishes it. Of its monitored variables `shown` has a bit for each that has a value; the values are written
    /// only if they are new, and stand there otherwise. Hardly ever has another axis begun its stop. To leave both out
    /// saves 42 instructions a drive and cycle.
    #[inline]
    #[doc(hidden)]
    pub fn write_to(&self, cell: &mut Writer<Feedback>, shows: bool, shown: u8) {
        if shows {
            return self.write_all_to(cell);
        }
        let mut words = self.first_words(shown);
        if self.stopped.is_some()
            && let Some(by) = self.begun_by
        {
            words[9] |= by.bits();
        }
        cell.write_words(words.into_iter());
    }

    #[inline(never)]
    fn write_all_to(&self, cell: &mut Writer<Feedback>) {
        cell.write(self);
    }

    /// The words but for the monitored values and who began its stop; `shown` has a bit for each of these that there
    /// is. What is one byte stands as it lies in memory, so that it is copied by the word.
    #[inline]
    fn first_words(&self, shown: u8) -> [u64; 10] {
        let status = &self.status;
        let states = [
            status.state as u8,
            status.homed.into(),
            status.moving.into(),
            status.in_target.into(),
            status.sto_open.into(),
            status.suspect.into(),
            self.rtt_ns.is_some().into(),
            0,
        ];
        let link = (self.link as u64) | self.stopped.map_or(0, |cause| cause as u64) << 8;
        [
            self.cycle,
            u64::from(self.age) | link << 32,
            status.at.0,
            status.position.to_bits(),
            status.demand.to_bits(),
            status.velocity.to_bits(),
            status.current.to_bits(),
            u64::from(status.warning) | u64::from(status.fault) << 32,
            u64::from_le_bytes(states),
            u64::from(self.rtt_ns.unwrap_or(0)) | u64::from(shown) << 32,
        ]
    }
}

impl Packed for Feedback {
    type Words = [u64; 14];

    #[inline]
    fn pack(&self) -> [u64; 14] {
        let (shown, values) = Shown::from(self.status.monitor).to_words();
        let mut words = [0; 14];
        words[..10].copy_from_slice(&self.first_words(shown));
        words[9] |= self.begun_by.map_or(0, BegunBy::bits);
        words[10..].copy_from_slice(&values);
        words
    }

    fn unpack(words: &[u64; 14]) -> Feedback {
        let &[cycle, link, at, position, demand, velocity, current, codes, states, last, shown @ ..] = words;
        let [state, homed, moving, in_target, sto_open, suspect, has_rtt, _] = states.to_le_bytes();
        let shown = Shown::from_words((last >> 32) as u8, shown);
        let status = DriveStatus {
            at: Time(at),
            state: State::ALL.get(usize::from(state)).copied().unwrap_or_default(),
            homed: homed != 0,
            moving: moving != 0,
            in_target: in_target != 0,
            suspect: suspect != 0,
            sto_open: sto_open != 0,
            position: f64::from_bits(position),
            demand: f64::from_bits(demand),
            velocity: f64::from_bits(velocity),
            current: f64::from_bits(current),
            warning: codes as u32,
            fault: (codes >> 32) as u32,
            monitor: shown.unwrap_or_default().values(),
        };
        let byte = |shift: u32| usize::from((link >> shift) as u8);
        Feedback {
            cycle,
            age: link as u32,
            link: Link::ALL.get(byte(32)).copied().unwrap_or_default(),
            stopped: StopCause::of(byte(40)),
            begun_by: BegunBy::of_bits(last),
            rtt_ns: (has_rtt != 0).then_some(last as u32),
            status,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_is_shown_in_both_notations_with_its_name_if_it_has_one() {
        let names: FaultNames = |code| (code == 30).then_some("watchdog");
        let reported = [0, 30, 999].map(|code| Fault::new(code, names).to_string());
        assert_eq!(reported, ["none", "0x001e (30, watchdog)", "0x03e7 (999)"]);
    }

    #[test]
    fn packs_and_unpacks_to_itself() {
        let begun_by = Some(BegunBy { axis: u16::MAX, cause: StopCause::PositionJump });
        for (link, state, stopped, begun_by) in [
            (Link::Online, State::OperationEnabled, None, None),
            (Link::Lost, State::Fault, Some(StopCause::Shutdown), None),
            (Link::Unseen, State::Unknown, Some(StopCause::Group), begun_by),
        ] {
            let status = DriveStatus {
                at: Time(12),
                state,
                homed: true,
                moving: false,
                in_target: true,
                suspect: true,
                sto_open: true,
                position: -1.25,
                demand: 3.5,
                velocity: f64::MIN,
                current: 0.1,
                warning: 0x80,
                fault: 0xFFFF_FFFF,
                monitor: [None, Some(-0.5), None, Some(1e9)],
            };
            let rtt_ns = Some(4_000_000_000);
            let feedback = Feedback { cycle: u64::MAX, age: 77, link, stopped, begun_by, rtt_ns, status };
            assert_eq!(Feedback::unpack(&feedback.pack()), feedback);
            // What a drive does not tell comes out as it went in.
            let none = f64::NAN;
            let status = DriveStatus { position: none, demand: none, current: none, ..status };
            let read = Feedback::unpack(&Feedback { status, ..feedback }.pack()).status;
            assert!(read.position.is_nan() && read.demand.is_nan() && read.current.is_nan());
            assert_eq!(read.velocity, status.velocity);
        }
    }

    #[test]
    fn each_of_its_flags_has_a_place_of_its_own_with_and_without_monitored_values() {
        let monitor = [Some(1.5), None, None, None];
        let (mut writer, reader) = crate::axis::cell::cell(Feedback::default());
        for place in 0..6 {
            let is = |other: usize| place == other;
            let status = DriveStatus {
                homed: is(0),
                moving: is(1),
                in_target: is(2),
                suspect: is(3),
                sto_open: is(4),
                monitor,
                ..DriveStatus::default()
            };
            let feedback = Feedback { rtt_ns: is(5).then_some(7), status, ..Feedback::default() };
            // The values of the first one stay there.
            feedback.write_to(&mut writer, is(0), Shown::mask(&monitor));
            assert_eq!((Feedback::unpack(&feedback.pack()), reader.read()), (feedback, feedback));
        }
    }
}
