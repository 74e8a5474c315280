//! What is desired of a drive as its outputs, and what its packets prove.
//!
//! The drive makes its own setpoints: a motion is a command with its parameters in the same packet. Nothing echoes a
//! command, so what proves it is its effect: a state or a motion that only this command explains. Where there is none
//! (another speed of a jog) it counts once it was delivered; a stop, a homing and a change of power never do by that
//! alone. A motion that begins while another one runs stops that first: what the drive makes of a command in motion is
//! not documented, but for the speed of a jog.
//!
//! A command of power is not repeated once its effect was seen: a drive that then switches off by itself stays off. A
//! stop is repeated until the drive stands.
//!
//! | file | what |
//! |---|---|
//! | `mod` | how far power and motion are; the next packet, and what has left |
//! | `words` | the command that is wanted next, with its parameters |
//! | `proofs` | what a packet of the drive proves |
//! | `capabilities` | what a drive can do |
//!
//! Sources: Host Command Reference 920-0002 W; sheet, 5.3 to 5.6.

mod capabilities;
mod proofs;
mod words;

pub(super) use self::capabilities::capabilities;
use self::words::{is_begun, is_motion};
use super::edges::{Change, Edges};
use super::exchange::Facts;
use super::native::NativePort;
use super::plan::{Homing, MoonsDrive};
use super::wire::assembly::{Outputs, command, status};
use fieldbeat_core::axis::Units;
use fieldbeat_core::axis::command::NativeOwner;
use fieldbeat_core::bus::desired::{Desired, Homing as HomingIs, Intent, Motion, Power, Refused};
use fieldbeat_core::time::Time;

const NO_POWER: &str = "its power is the master's in this native mode: give it a motion or a host command, \
     or own the control word";
const BUSY_NOW: &str = "the drive is busy: it starts, saves its parameters or runs a Q program";

/// An absolute move and a jog are sent again so often, since that is safe: with two idle packets before the first one,
/// one behind thirty of them. At a loss of 30 % one in 10^15 goes wrong.
const REPEATS: u8 = 3;

/// Its setpoint generator runs.
const MOVES: u16 = status::MOVING | status::JOGGING | status::STOPPING | status::HOMING;
/// No command is taken meanwhile.
const BUSY: u16 = status::SAVING | status::PROGRAM | status::INITIALIZING;

/// The drive's last packet, as far as the profile needs it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Seen {
    /// There was one on this connection.
    pub any: bool,
    /// See `wire::assembly::status`.
    pub status: u16,
    pub alarm: u32,
    /// The absolute position, unwrapped, steps.
    pub demand: i64,
    /// The input that is its hardware enable keeps it off.
    pub sto_open: bool,
}

impl Seen {
    fn has(&self, bits: u16) -> bool {
        self.status & bits != 0
    }

    /// Its setpoint generator runs.
    pub(super) fn moves(&self) -> bool {
        self.has(MOVES)
    }

    pub(super) fn is_enabled(&self) -> bool {
        self.has(status::ENABLED)
    }

    /// It jogs, and is not on its way to standstill: it takes another speed.
    fn jogs(&self) -> bool {
        self.has(status::JOGGING) && !self.has(status::STOPPING)
    }
}

/// How far a part of what is desired is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Step {
    /// Nothing is to be sent: it was, or nothing is needed.
    #[default]
    Settled,
    /// What moves before it has to stand first.
    Clearing,
    /// Its command has to be sent.
    Due,
    /// Its command is held.
    Held,
    /// Of a homing: its command was taken, and it runs.
    Runs,
    /// Of a homing: the position has to be set to zero; its host command is due, or held.
    Zeroing { held: bool },
}

/// Whose command is held.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Holder {
    #[default]
    Nobody,
    Power,
    Motion,
    /// The stop of what moves before a motion.
    Clearing,
    Native,
}

/// The profile of one drive.
#[derive(Debug)]
pub(super) struct Profile {
    edges: Edges,
    /// The outputs of the next packet.
    outputs: Outputs,
    power: Intent<Power>,
    motion: Intent<Motion>,
    power_step: Step,
    motion_step: Step,
    holder: Holder,
    /// What the prepared packet would begin to hold.
    next_holder: Holder,
    /// The prepared packet has the application's next output. What comes between its building and its sending has not
    /// left with it.
    has_native: bool,
    /// The serials of the last packet that has left.
    sent: (u64, u64),
    /// The effect of the newest motion was seen.
    is_taken: bool,
    /// The command word of the newest motion, once it was sent, and how often it was, or is to be, sent again.
    word: u32,
    repeats: u8,
    refused: Option<Refused>,
    /// The jog that runs has this deceleration, 10 rpm/s: it is fixed meanwhile.
    jog: Option<u32>,
    /// The motion that runs has this one. Whether a stop brings another one along is not documented.
    ramp: Option<u32>,
    homing: HomingIs,
    homed: bool,
    /// ENABLE was sent, and power was not seen off behind a DISABLE since: it may still come on.
    may_come_on: bool,
    /// The alarms when the homing began are no failure of it.
    alarms_before: u32,
    /// The position has become zero in this homing; that is new, and was no motion.
    zeroed: bool,
    rehomed: bool,
    /// Another packet of the drive that says the same proves the same, and the next of ours is like the last one.
    steady: bool,
    facts: Facts,
    /// As it was before the prepared packet was built, until that has gone out: what did not leave has no effect.
    before: Option<Before>,
    /// The status at the last proof.
    proved: Seen,
    rules: Rules,
}

/// What building a packet changes.
#[derive(Clone, Copy, Debug)]
struct Before {
    outputs: Outputs,
    power: Intent<Power>,
    power_step: Step,
    motion: Intent<Motion>,
    motion_step: Step,
    is_taken: bool,
    repeats: u8,
    refused: Option<Refused>,
    homing: HomingIs,
    zeroed: bool,
    may_come_on: bool,
}

/// What does not change.
#[derive(Debug)]
struct Rules {
    units: Units,
    /// Velocities and accelerations on the wire for one user unit/s and unit/s², signed.
    velocity: f64,
    acceleration: f64,
    homing: Option<Homing>,
    registers_home: bool,
}

impl Profile {
    pub(super) fn new(drive: &MoonsDrive) -> Profile {
        Profile {
            edges: Edges::new(drive.hold, drive.effect_within_ns),
            outputs: Outputs::default(),
            power: Intent::default(),
            motion: Intent::default(),
            power_step: Step::Settled,
            motion_step: Step::Settled,
            holder: Holder::Nobody,
            next_holder: Holder::Nobody,
            has_native: false,
            sent: (0, 0),
            is_taken: false,
            word: command::IDLE,
            repeats: 0,
            refused: None,
            jog: None,
            ramp: None,
            homing: HomingIs::Open,
            homed: false,
            may_come_on: false,
            alarms_before: 0,
            zeroed: false,
            rehomed: false,
            steady: false,
            facts: Facts::default(),
            before: None,
            proved: Seen::default(),
            rules: Rules {
                units: drive.axis.units,
                velocity: drive.velocity_on_wire(1.0),
                acceleration: drive.acceleration_on_wire(1.0),
                homing: drive.homing,
                registers_home: drive.homed_register.is_some(),
            },
        }
    }

    /// A new connection: the drive has seen none of the commands before, and what moved it meanwhile is not known.
    pub(super) fn connected(&mut self) {
        self.unsent();
        self.edges.reset();
        self.outputs = Outputs::default();
        (self.holder, self.next_holder) = (Holder::Nobody, Holder::Nobody);
        (self.jog, self.ramp, self.homing, self.steady) = (None, None, HomingIs::Open, false);
        self.proved = Seen::default();
        self.homed = self.rules.registers_home && self.facts.homed == Some(true);
        // Nothing is switched on again, and no motion is made twice.
        let ends = matches!(self.power.value, Power::Off | Power::Shutdown | Power::QuickStop);
        self.power_step = if ends && self.power.serial > 0 { Step::Due } else { Step::Settled };
        self.motion_step = match self.motion.value {
            Motion::Ramp { .. } | Motion::Halt => Step::Due,
            Motion::Move { .. } | Motion::Velocity { .. } | Motion::Home => {
                if !self.is_taken || self.motion.value == Motion::Home {
                    self.refused = Some(Refused::NotTaken);
                }
                Step::Settled
            }
            _ => Step::Settled,
        };
    }

    /// The connection has ended: whether the drive still has its reference is open.
    pub(super) fn disconnected(&mut self) {
        (self.homed, self.steady) = (false, false);
    }

    /// The drive has started anew.
    pub(super) fn drive_restarted(&mut self) {
        (self.homed, self.jog, self.ramp, self.steady) = (false, None, None, false);
    }

    /// What was read of the drive outside its packets.
    pub(super) fn read(&mut self, facts: Facts) {
        self.facts = facts;
        if self.rules.registers_home
            && let Some(homed) = facts.homed
        {
            self.homed = homed;
        }
        self.steady = false;
    }

    /// It has its reference, as far as this master knows.
    pub(super) fn is_homed(&self) -> bool {
        self.homed
    }

    /// The position was set to zero since the last call: it jumps, and that is no motion.
    pub(super) fn take_rehomed(&mut self) -> bool {
        std::mem::take(&mut self.rehomed)
    }

    /// The next packet is like the last one, and the next packet of the drive proves what the last one proved if it
    /// says the same.
    #[inline]
    pub(super) fn is_steady(&self) -> bool {
        self.steady
    }

    /// The same, with what is desired now.
    #[inline]
    pub(super) fn repeats(&self, desired: &Desired) -> bool {
        self.steady && (desired.power.serial, desired.motion.serial) == self.sent
    }

    fn as_it_is(&self) -> Before {
        let &Profile { outputs, power, power_step, motion, motion_step, .. } = self;
        let &Profile { is_taken, repeats, refused, homing, zeroed, may_come_on, .. } = self;
        Before {
            outputs,
            power,
            power_step,
            motion,
            motion_step,
            is_taken,
            repeats,
            refused,
            homing,
            zeroed,
            may_come_on,
        }
    }

    /// The prepared packet does not go out.
    pub(super) fn unsent(&mut self) {
        let Some(before) = self.before.take() else { return };
        let Before { outputs, power, power_step, motion, motion_step, .. } = before;
        let Before { is_taken, repeats, refused, homing, zeroed, may_come_on, .. } = before;
        (self.outputs, self.power, self.power_step) = (outputs, power, power_step);
        (self.motion, self.motion_step, self.is_taken) = (motion, motion_step, is_taken);
        (self.repeats, self.refused, self.homing, self.zeroed) = (repeats, refused, homing, zeroed);
        (self.may_come_on, self.next_holder) = (may_come_on, Holder::Nobody);
    }

    /// The outputs of the packet to be sent at `now`.
    pub(super) fn encode(
        &mut self,
        now: Time,
        desired: &Desired,
        seen: &Seen,
        native: &mut NativePort,
    ) -> &Outputs {
        self.steady = false;
        // Built again, or for a later slot.
        self.unsent();
        self.before = Some(self.as_it_is());
        self.has_native = false;
        if desired.power.serial != self.power.serial {
            self.begin_power(desired.power, seen);
        }
        if desired.motion.serial != self.motion.serial {
            self.begin_motion(desired.motion, seen, native);
        }
        if let Motion::Native(NativeOwner::Application) = self.motion.value
            && !self.edges.is_held()
        {
            // Its outputs as they are: each of them in one packet at least.
            self.next_holder = Holder::Nobody;
            self.edges.prepare(now, None);
            let next = native.peek();
            self.has_native = next.is_some();
            if let Some(output) = next {
                self.outputs = output.outputs;
            }
            self.may_come_on = true;
            return &self.outputs;
        }
        if self.motion.value == Motion::Native(NativeOwner::Master)
            && native.peek().is_some_and(|output| !is_motion(&output))
        {
            self.refused = Some(Refused::Because(NO_POWER));
        }
        let (holder, wanted) = if seen.any { self.wanted(seen, native) } else { (Holder::Nobody, None) };
        let word = self.edges.prepare(now, wanted);
        // The parameters come with the first packet of a command, and stay.
        let begins = self.edges.begins();
        self.next_holder = if begins { holder } else { Holder::Nobody };
        if begins {
            self.outputs = self.parameters(holder, seen, native);
        }
        self.outputs.command = word;
        &self.outputs
    }

    /// Another power is desired.
    fn begin_power(&mut self, power: Intent<Power>, seen: &Seen) {
        self.power = power;
        self.power_step = match power.value {
            Power::Untouched | Power::SwitchOn => Step::Settled,
            Power::Off | Power::Shutdown if seen.is_enabled() || self.may_come_on => Step::Due,
            Power::Off | Power::Shutdown => Step::Settled,
            Power::EnableOperation if seen.is_enabled() => Step::Settled,
            Power::QuickStop if !seen.moves() && self.holder != Holder::Motion => Step::Settled,
            Power::EnableOperation | Power::QuickStop | Power::FaultReset => Step::Due,
        };
    }

    /// Another motion is desired.
    fn begin_motion(&mut self, motion: Intent<Motion>, seen: &Seen, native: &mut NativePort) {
        let was_native = matches!(self.motion.value, Motion::Native(_));
        // What another master has begun goes on until it is stopped.
        let runs = (seen.moves() || self.holder == Holder::Motion) && is_begun(self.motion.value);
        self.motion = motion;
        (self.refused, self.is_taken, self.homing, self.zeroed) = (None, false, HomingIs::Open, false);
        self.repeats = 0;
        native.runs(matches!(motion.value, Motion::Native(_)));
        if was_native || matches!(motion.value, Motion::Native(_)) {
            native.flush();
        }
        if was_native {
            // What the application left there is no command of the master's, and no idle either.
            self.outputs = Outputs::default();
            self.edges.reset();
            self.holder = Holder::Nobody;
        }
        let jogs = seen.jogs() || self.holder == Holder::Motion && self.jog.is_some();
        self.motion_step = match motion.value {
            // Nothing of its own any more: what runs is not left to its end.
            Motion::Hold if runs => Step::Clearing,
            Motion::Hold | Motion::Follow | Motion::EndStream | Motion::Native(_) => Step::Settled,
            Motion::Ramp { .. } | Motion::Halt => Step::Due,
            Motion::Velocity { acceleration, .. }
                if jogs && self.jog == Some(self.rules.acceleration(acceleration)) =>
            {
                Step::Due
            }
            _ if seen.moves() || self.holder == Holder::Motion => Step::Clearing,
            _ => Step::Due,
        };
        self.is_taken = self.motion_step == Step::Settled;
    }

    /// The packet has gone out.
    pub(super) fn sent(&mut self, native: &mut NativePort) {
        self.before = None;
        self.sent = (self.power.serial, self.motion.serial);
        let change = self.edges.sent();
        if let Motion::Native(NativeOwner::Application) = self.motion.value
            && !self.edges.is_held()
        {
            if std::mem::take(&mut self.has_native) {
                native.pop();
            }
            if self.outputs.command != command::IDLE {
                // The next command is an edge behind idle only.
                self.edges.reset();
            }
        }
        match change {
            Change::Begun => self.begun(native),
            Change::Ended => self.ended(),
            Change::None => {}
        }
    }

    /// A command is held from now on.
    fn begun(&mut self, native: &mut NativePort) {
        self.holder = self.next_holder;
        match self.holder {
            Holder::Power => {
                self.power_step = Step::Held;
                self.may_come_on |= self.outputs.command == command::ENABLE;
            }
            Holder::Motion => {
                self.word = self.outputs.command;
                match self.motion.value {
                    Motion::Velocity { .. } => {
                        (self.jog, self.ramp) =
                            (Some(self.outputs.jog_acceleration), Some(self.outputs.jog_deceleration));
                    }
                    Motion::Move { .. } | Motion::Home => self.ramp = Some(self.outputs.deceleration),
                    _ => {}
                }
                self.motion_step = match self.motion_step {
                    Step::Zeroing { .. } => Step::Zeroing { held: true },
                    _ => Step::Held,
                };
                self.alarms_before = self.proved.alarm;
            }
            Holder::Native => native.pop(),
            Holder::Clearing | Holder::Nobody => {}
        }
    }

    /// The held command is over: its effect was seen, its time has passed, or a stop replaces it.
    fn ended(&mut self) {
        let seen = self.edges.is_seen();
        match std::mem::take(&mut self.holder) {
            // Until it is seen it is repeated; the machine gives up an enable, and a reset.
            Holder::Power if self.power_step == Step::Held => {
                self.power_step =
                    if seen || self.power.value == Power::FaultReset { Step::Settled } else { Step::Due };
            }
            Holder::Motion => self.motion_ended(seen),
            _ => {}
        }
    }

    /// The same command would be sent again, and acted on: it waits for no later enable, and another speed of a jog
    /// that is over would begin a new one.
    fn may_repeat(&self, seen: &Seen) -> bool {
        self.power.value == Power::EnableOperation
            && seen.is_enabled()
            && self.motion_word(self.motion.value, seen) == Some(self.word)
    }

    /// The motion is not sent any more. One that power off has replaced was not refused.
    fn not_taken(&mut self) -> Step {
        if !self.is_taken && self.power.value == Power::EnableOperation {
            self.refused = Some(Refused::NotTaken);
        }
        Step::Settled
    }

    fn motion_ended(&mut self, seen: bool) {
        let stops = matches!(self.motion.value, Motion::Ramp { .. } | Motion::Halt);
        self.motion_step = match self.motion_step {
            Step::Held if stops && !seen => Step::Due,
            Step::Held if self.motion.value == Motion::Home && seen => Step::Runs,
            Step::Held => {
                let lost = !seen && !self.is_taken;
                // It was no edge if each idle packet before it was lost. Of another speed nothing shows that it was
                // taken. A relative move or a homing could be made twice.
                let most = match self.word {
                    command::JOG_SPEED => 1,
                    command::MOVE_ABSOLUTE | command::JOG if lost => REPEATS,
                    _ => 0,
                };
                if self.repeats < most && self.may_repeat(&self.proved) {
                    self.repeats += 1;
                    Step::Due
                } else {
                    self.not_taken()
                }
            }
            Step::Zeroing { .. } if seen => {
                (self.homing, self.homed) = (HomingIs::Attained, true);
                Step::Settled
            }
            Step::Zeroing { .. } => {
                self.homing = HomingIs::Failed;
                Step::Settled
            }
            // Something else is desired meanwhile.
            other => other,
        };
    }
}

#[cfg(test)]
mod tests {
    use super::super::native::native;
    use super::*;
    use fieldbeat_core::bus::desired::Evidence;
    use fieldbeat_core::time::MS;

    #[test]
    fn only_a_motion_that_no_other_power_has_replaced_was_not_taken() {
        for power in [Power::EnableOperation, Power::Off, Power::QuickStop] {
            let mut profile = Profile::new(&MoonsDrive::new("x", [10, 0, 0, 40].into()));
            let (_native, mut port) = native();
            let seen = Seen { any: true, status: status::ENABLED, ..Seen::default() };
            let motion = Motion::Velocity { velocity: 2.0, acceleration: 50.0 };
            let mut desired = Desired { motion: Intent { serial: 1, value: motion }, ..Desired::default() };
            desired.power = Intent { serial: 1, value: Power::EnableOperation };
            let mut evidence = Evidence::default();
            for turn in 0..3_000 {
                if turn == 20 {
                    assert_eq!(profile.outputs.command, command::JOG);
                    desired.power = Intent { serial: 2, value: power };
                }
                profile.encode(Time(turn * MS), &desired, &seen, &mut port);
                profile.sent(&mut port);
                profile.take(&seen, &mut evidence);
            }
            let refused = (power == Power::EnableOperation).then_some(Refused::NotTaken);
            assert_eq!(evidence.refused, refused, "{power:?}");
        }
    }
}
