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

use std::mem::offset_of;

pub(super) use self::capabilities::capabilities;
use self::words::{is_begun, is_motion};
use super::edges::{Change, Edges, MOST_REPEATS};
use super::exchange::Facts;
use super::native::{NativeOutput, NativePort};
use super::plan::{Homing, MoonsDrive};
use super::wire::assembly::{Outputs, command, status};
use fieldbeat_core::axis::Units;
use fieldbeat_core::axis::command::NativeOwner;
use fieldbeat_core::bus::Prepared;
use fieldbeat_core::bus::desired::{Desired, Homing as HomingIs, Intent, Motion, Power, Refused};
use fieldbeat_core::time::Time;

const NO_POWER: &str = "its power is the master's in this native mode: give it a motion or a host command, \
     or own the control word";
const BUSY_NOW: &str = "the drive is busy: it starts, saves its parameters or runs a Q program";

/// The setpoint generator runs.
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

    /// The setpoint generator runs.
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
    /// The present motion has to stand first.
    Clearing,
    /// The command has to be sent.
    Due,
    /// The command is held.
    Held,
    /// Of a homing: its command was taken, and it runs.
    Runs,
    /// Of a homing: the position has to be set to zero; its host command is due, or held.
    Zeroing { held: bool },
}

/// The owner of the held command.
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

/// The state after the packets that left, and those of the drive.
#[derive(Clone, Copy, Debug, PartialEq)]
struct State {
    edges: Edges,
    /// The outputs of the last packet.
    outputs: Outputs,
    power: Intent<Power>,
    motion: Intent<Motion>,
    power_step: Step,
    motion_step: Step,
    holder: Holder,
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
    /// The number of outputs of the application that have left.
    native_taken: u32,
}

/// The profile of one drive. What each exchange touches is the end of the state and what follows it: the last
/// [`TOUCHED`](Self::TOUCHED) bytes.
#[derive(Debug)]
#[repr(C)]
pub(super) struct Profile {
    facts: Facts,
    rules: Rules,
    state: Prepared<State>,
    /// Another packet of the drive that says the same proves the same, and the next of ours is like the last one, as
    /// long as this is the revision of the state, or [`UNSETTLED`].
    settled: u64,
}

/// No revision comes to this.
const UNSETTLED: u64 = u64::MAX;

/// The constants.
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
    /// The revisions at the end of the state, 32 bytes, and what follows them.
    pub(super) const TOUCHED: usize = 32 + size_of::<Profile>() - offset_of!(Profile, settled);

    pub(super) fn new(drive: &MoonsDrive) -> Profile {
        let state = State {
            edges: Edges::new(drive.hold, drive.effect_within_ns),
            outputs: Outputs::default(),
            power: Intent::default(),
            motion: Intent::default(),
            power_step: Step::Settled,
            motion_step: Step::Settled,
            holder: Holder::Nobody,
            // There is nothing to take.
            is_taken: true,
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
            native_taken: 0,
        };
        Profile {
            state: Prepared::new(state),
            settled: UNSETTLED,
            facts: Facts::default(),
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
        let homed = self.rules.registers_home && self.facts.homed == Some(true);
        self.settled = UNSETTLED;
        self.state.change(|state| state.connected(homed));
    }

    /// The connection has ended: whether the drive still has its reference is open.
    pub(super) fn disconnected(&mut self) {
        self.settled = UNSETTLED;
        self.state.change(|state| state.homed = false);
    }

    /// The drive has started anew.
    pub(super) fn drive_restarted(&mut self) {
        self.settled = UNSETTLED;
        self.state.change(|state| (state.homed, state.jog, state.ramp) = (false, None, None));
    }

    /// Takes the facts read of the drive outside its packets.
    pub(super) fn read(&mut self, facts: Facts) {
        (self.facts, self.settled) = (facts, UNSETTLED);
        if let (true, Some(homed)) = (self.rules.registers_home, facts.homed) {
            self.state.change(|state| state.homed = homed);
        }
    }

    /// It has its reference, as far as this master knows.
    pub(super) fn is_homed(&self) -> bool {
        self.state.left().homed
    }

    /// The power and the motion of the last packet.
    pub(super) fn commanded(&self) -> (Power, Motion) {
        let State { power, motion, .. } = self.state.left();
        (power.value, motion.value)
    }

    /// The position was set to zero since the last call: it jumps, and that is no motion.
    pub(super) fn take_rehomed(&mut self) -> bool {
        let rehomed = self.state.left().rehomed;
        if rehomed {
            self.state.change(|state| state.rehomed = false);
        }
        rehomed
    }

    /// The next packet of the drive proves what the last one proved if it says the same.
    #[inline]
    pub(super) fn is_settled(&self) -> bool {
        self.settled == self.state.revision()
    }

    /// The next packet is like the last one, with what is desired now.
    #[inline]
    pub(super) fn holds(&self, desired: &Desired) -> bool {
        self.is_settled() && self.state.holds(desired.revision())
    }

    /// The outputs of the packet to be sent at `now`.
    pub(super) fn encode(
        &mut self,
        now: Time,
        desired: &Desired,
        seen: &Seen,
        native: &mut NativePort,
    ) -> &Outputs {
        let state = self.state.propose(desired.revision());
        if desired.power.serial != state.power.serial {
            state.begin_power(desired.power, seen);
        }
        let begins = desired.motion.serial != state.motion.serial;
        if begins {
            state.begin_motion(desired.motion, seen, &self.rules);
        }
        // What the application has written before the mode begins is dropped.
        state.go_on(now, seen, if begins { None } else { native.peek() }, &self.rules);
        &self.state.proposed().outputs
    }

    /// The packet has gone out. Returns how many outputs of the application have begun, if that may be new.
    #[inline]
    pub(super) fn sent(&mut self, native: &mut NativePort) -> Option<u32> {
        if self.state.is_proposed() { self.sent_new(native) } else { None }
    }

    #[inline(never)]
    fn sent_new(&mut self, native: &mut NativePort) -> Option<u32> {
        let (before, state) = self.state.leave()?;
        let begins = state.motion.serial != before.motion.serial;
        let is_native = matches!(state.motion.value, Motion::Native(_));
        native.left(state.native_taken != before.native_taken, begins.then_some(is_native));
        Some(state.native_taken)
    }
}

impl State {
    fn connected(&mut self, homed: bool) {
        self.edges.reset();
        (self.outputs, self.holder, self.homed) = (Outputs::default(), Holder::Nobody, homed);
        (self.jog, self.ramp, self.homing) = (None, None, HomingIs::Open);
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

    /// The next packet: with the application's `next` output, in its turn.
    fn go_on(&mut self, now: Time, seen: &Seen, next: Option<NativeOutput>, rules: &Rules) {
        if let Motion::Native(NativeOwner::Application) = self.motion.value
            && !self.edges.is_held()
        {
            // Its outputs as they are: each of them in one packet at least.
            self.edges.step(now, None);
            if let Some(output) = next {
                (self.outputs, self.native_taken) = (output.outputs, self.native_taken.wrapping_add(1));
            }
            self.may_come_on = true;
            if self.outputs.command != command::IDLE {
                // The next command is an edge behind idle only.
                self.edges.reset();
            }
            return;
        }
        if self.motion.value == Motion::Native(NativeOwner::Master)
            && next.is_some_and(|output| !is_motion(&output))
        {
            self.refused = Some(Refused::Because(NO_POWER));
        }
        let (holder, wanted) = if seen.any { self.wanted(seen, next, rules) } else { (Holder::Nobody, None) };
        let (word, change) = self.edges.step(now, wanted);
        // The parameters come with the first packet of a command, and stay.
        if change == Change::Begun {
            self.outputs = self.parameters(holder, seen, next, rules);
        }
        self.outputs.command = word;
        match change {
            Change::Begun => self.begun(holder, seen),
            Change::Ended => self.ended(seen, rules),
            Change::None => {}
        }
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
    fn begin_motion(&mut self, motion: Intent<Motion>, seen: &Seen, rules: &Rules) {
        let was_native = matches!(self.motion.value, Motion::Native(_));
        // What another master has begun goes on until it is stopped.
        let runs = (seen.moves() || self.holder == Holder::Motion) && is_begun(self.motion.value);
        self.motion = motion;
        (self.refused, self.is_taken, self.homing, self.zeroed) = (None, false, HomingIs::Open, false);
        self.repeats = 0;
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
                if jogs && self.jog == Some(rules.acceleration(acceleration)) =>
            {
                Step::Due
            }
            _ if seen.moves() || self.holder == Holder::Motion => Step::Clearing,
            _ => Step::Due,
        };
        self.is_taken = self.motion_step == Step::Settled;
    }

    /// A command is held from now on.
    fn begun(&mut self, holder: Holder, seen: &Seen) {
        self.holder = holder;
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
                self.alarms_before = seen.alarm;
            }
            Holder::Native => self.native_taken = self.native_taken.wrapping_add(1),
            Holder::Clearing | Holder::Nobody => {}
        }
    }

    /// The held command is over: its effect was seen, its time has passed, or a stop replaces it.
    fn ended(&mut self, seen: &Seen, rules: &Rules) {
        let has_effect = self.edges.is_seen();
        match std::mem::take(&mut self.holder) {
            // Until it is seen it is repeated; the machine gives up an enable, and a reset.
            Holder::Power if self.power_step == Step::Held => {
                self.power_step = if has_effect || self.power.value == Power::FaultReset {
                    Step::Settled
                } else {
                    Step::Due
                };
            }
            Holder::Motion => self.motion_ended(has_effect, seen, rules),
            _ => {}
        }
    }

    /// The same command would be sent again, and acted on: it waits for no later enable, and another speed of a jog
    /// that is over would begin a new one.
    fn may_repeat(&self, seen: &Seen, rules: &Rules) -> bool {
        self.power.value == Power::EnableOperation
            && seen.is_enabled()
            && rules.motion_word(self.motion.value, seen) == Some(self.word)
    }

    /// The motion is not sent any more. One that power off has replaced was not refused.
    fn not_taken(&mut self) -> Step {
        if !self.is_taken && self.power.value == Power::EnableOperation {
            self.refused = Some(Refused::NotTaken);
        }
        Step::Settled
    }

    fn motion_ended(&mut self, has_effect: bool, seen: &Seen, rules: &Rules) {
        let stops = matches!(self.motion.value, Motion::Ramp { .. } | Motion::Halt);
        self.motion_step = match self.motion_step {
            Step::Held if stops && !has_effect => Step::Due,
            Step::Held if self.motion.value == Motion::Home && has_effect => Step::Runs,
            Step::Held => {
                let lost = !has_effect && !self.is_taken;
                // It was no edge if each idle packet before it was lost. Of another speed nothing shows that it was
                // taken. A relative move or a homing could be made twice.
                let most = match self.word {
                    command::JOG_SPEED => 1,
                    command::MOVE_ABSOLUTE | command::JOG if lost => MOST_REPEATS,
                    _ => 0,
                };
                if self.repeats < most && self.may_repeat(seen, rules) {
                    self.repeats += 1;
                    Step::Due
                } else {
                    self.not_taken()
                }
            }
            Step::Zeroing { .. } if has_effect => {
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
    use super::*;
    use crate::native::Native;
    use fieldbeat_core::bus::desired::Evidence;
    use fieldbeat_core::bus::native::native;
    use fieldbeat_core::time::MS;

    #[test]
    fn only_a_motion_that_no_other_power_has_replaced_was_not_taken() {
        for power in [Power::EnableOperation, Power::Off, Power::QuickStop] {
            let mut profile = Profile::new(&MoonsDrive::new("x", [10, 0, 0, 40].into()));
            let (_native, mut port): (Native, _) = native();
            let seen = Seen { any: true, status: status::ENABLED, ..Seen::default() };
            let motion = Motion::Velocity { velocity: 2.0, acceleration: 50.0 };
            let mut desired = Desired { motion: Intent { serial: 1, value: motion }, ..Desired::default() };
            desired.power = Intent { serial: 1, value: Power::EnableOperation };
            let mut evidence = Evidence::default();
            for turn in 0..3_000 {
                if turn == 20 {
                    assert_eq!(profile.state.left().outputs.command, command::JOG);
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
