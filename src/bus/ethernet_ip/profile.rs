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
//! Sources: Host Command Reference 920-0002 W; sheet, 5.3 to 5.6.

use super::edges::{Change, Edges, Urgency, Wanted};
use super::exchange::Facts;
use super::native::{NativeOutput, NativePort};
use super::plan::{Homing, HomingMethod, MOST_PER_REV, MoonsDrive, Version};
use super::wire::assembly::{Letters, Outputs, command, status};
use crate::axis::command::NativeOwner;
use crate::axis::{Lacks, Units};
use crate::bus::desired::{
    Capabilities, Desired, Evidence, FaultIs, Generator, Homing as HomingIs, Intent, Motion, Power, Ranges,
    Reference, Refused, Resettable, Velocities,
};
use crate::time::Time;

const NO_ROWS: &str = "it makes its own profiles, and takes no rows; command moves or velocities";
const NO_TORQUE: &str = "it takes positions and velocities, no torques";
const NO_JOGS: &str = "its jogs are switched off (jog = false)";
const NO_HOMING: &str = "how it homes is not configured (homing)";
const NO_OUTPUTS: &str = "its connection has no outputs: use connection = \"owner\"";
const FIRST_VERSION: &str =
    "a drive of version \"v1\" has no outputs: its values are shown, and it takes parameter calls";
const NO_POWER: &str = "its power is the master's in this native mode: give it a motion or a host command, or own the \
    control word";
const BUSY_NOW: &str = "the drive is busy: it starts, saves its parameters or runs a Q program";

/// The demand ends exactly at its target; a step is left to its rounding.
const ARRIVAL_STEPS: f64 = 2.0;
/// The host command that sets the position.
const SET_POSITION: Letters = Letters(u16::from_be_bytes(*b"SP"));
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
    pub inhibited: bool,
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
    refused: Option<Refused>,
    homing: HomingIs,
    zeroed: bool,
    may_come_on: bool,
}

/// The target of a move, steps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Target {
    Absolute(i32),
    /// From where the drive stands.
    Relative(i32),
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

/// What a drive can do, with a packet every `rpi_ns`.
pub(super) fn capabilities(drive: &MoonsDrive, period_ns: u64) -> Capabilities {
    let units = &drive.axis.units;
    let ends = [i32::MIN, i32::MAX].map(|count| f64::from(count) / units.counts_per_unit);
    let least = |on_wire: f64| (1.0 / on_wire.abs(), MOST_PER_REV / on_wire.abs());
    let control = match drive.version {
        Some(Version::V1) => Some(FIRST_VERSION),
        _ => (!drive.is_owned()).then_some(NO_OUTPUTS),
    };
    // A packet of the drive may be an interval old; the stop waits for its slot and for an idle packet.
    let reaction_ns = drive
        .input_rpi_ns(period_ns)
        .saturating_add(drive.rpi_ns(period_ns).saturating_mul(3))
        .saturating_add(drive.fresh_within_ns(period_ns));
    Capabilities {
        lacks: Lacks {
            control,
            rows: Some(NO_ROWS),
            torques: Some(NO_TORQUE),
            velocities: (!drive.jog).then_some(NO_JOGS),
            homing: drive.homing.is_none().then_some(NO_HOMING),
            ..Lacks::default()
        },
        power_reports: 1,
        still_reports: 2,
        arrival: units.distance(ARRIVAL_STEPS).abs(),
        ranges: Ranges {
            position: (ends[0].min(ends[1]), ends[0].max(ends[1])),
            velocity: least(drive.velocity_on_wire(1.0)),
            acceleration: least(drive.acceleration_on_wire(1.0)),
        },
        ..Capabilities::of(Generator::Drive {
            velocities: drive.jog.then_some(Velocities::Own { reaction_ns }),
        })
    }
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
        let &Profile { is_taken, refused, homing, zeroed, may_come_on, .. } = self;
        Before {
            outputs,
            power,
            power_step,
            motion,
            motion_step,
            is_taken,
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
        let Before { is_taken, refused, homing, zeroed, may_come_on, .. } = before;
        (self.outputs, self.power, self.power_step) = (outputs, power, power_step);
        (self.motion, self.motion_step, self.is_taken) = (motion, motion_step, is_taken);
        (self.refused, self.homing, self.zeroed) = (refused, homing, zeroed);
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

    /// The command that is wanted next, and whose it is.
    fn wanted(&self, seen: &Seen, native: &mut NativePort) -> (Holder, Option<Wanted>) {
        let stops = |word| {
            let fast = word == command::STOP_FAST;
            Some(Wanted { word, urgency: if fast { Urgency::FastStop } else { Urgency::Stop } })
        };
        let goes = |word| Some(Wanted { word, urgency: Urgency::None });
        let is_stop = matches!(self.motion.value, Motion::Ramp { .. } | Motion::Halt);
        let is_due = self.power_step == Step::Due;
        // It replaces an enable that is under way, and waits for no stop.
        if is_due && matches!(self.power.value, Power::Off | Power::Shutdown) {
            return (Holder::Power, Some(Wanted { word: command::DISABLE, urgency: Urgency::Off }));
        }
        if self.motion_step == Step::Due && is_stop {
            return (Holder::Motion, stops(self.stop_word()));
        }
        if is_due {
            return match self.power.value {
                Power::QuickStop => (Holder::Power, stops(command::STOP_FAST)),
                Power::EnableOperation if !seen.has(BUSY) => (Holder::Power, goes(command::ENABLE)),
                Power::FaultReset => (Holder::Power, goes(command::RESET_ALARM)),
                _ => (Holder::Nobody, None),
            };
        }
        // Only a drive in operation moves.
        if self.power.value != Power::EnableOperation || !seen.is_enabled() || seen.has(BUSY) {
            return (Holder::Nobody, None);
        }
        match (self.motion_step, self.motion.value) {
            (Step::Clearing, _) if seen.moves() => (Holder::Clearing, stops(command::STOP)),
            (Step::Due, motion) => (Holder::Motion, self.motion_word(motion, seen).and_then(goes)),
            (Step::Zeroing { held: false }, _) => (Holder::Motion, goes(command::HOST)),
            (Step::Settled, Motion::Native(NativeOwner::Master)) if self.refused.is_none() => {
                let next = native.peek().filter(is_motion);
                (Holder::Native, next.and_then(|output| goes(output.outputs.command)))
            }
            _ => (Holder::Nobody, None),
        }
    }

    /// A stop along the ramp that is set, unless that of the motion that runs is flatter.
    fn stop_word(&self) -> u32 {
        match (self.motion.value, self.ramp) {
            (Motion::Ramp { deceleration }, Some(ramp)) if ramp < self.rules.acceleration(deceleration) => {
                command::STOP_FAST
            }
            (Motion::Ramp { .. }, _) => command::STOP,
            _ => command::STOP_FAST,
        }
    }

    fn motion_word(&self, motion: Motion, seen: &Seen) -> Option<u32> {
        Some(match motion {
            Motion::Move { position, .. } => match self.rules.target(position, seen.demand) {
                Target::Absolute(_) => command::MOVE_ABSOLUTE,
                Target::Relative(_) => command::MOVE_RELATIVE,
            },
            Motion::Velocity { .. } if seen.jogs() => command::JOG_SPEED,
            Motion::Velocity { .. } => command::JOG,
            Motion::Home => match self.rules.homing.as_ref()?.method {
                HomingMethod::Seek => command::SEEK_HOME,
                HomingMethod::Find => command::FIND_HOME,
            },
            _ => return None,
        })
    }

    /// What goes with the command that begins.
    fn parameters(&self, holder: Holder, seen: &Seen, native: &NativePort) -> Outputs {
        let Rules { units, homing, .. } = &self.rules;
        let before = self.outputs;
        if holder == Holder::Native {
            return native.peek().map_or(before, |output| output.outputs);
        }
        if holder != Holder::Motion {
            return before;
        }
        match (self.motion_step, self.motion.value) {
            (Step::Zeroing { .. }, _) => {
                Outputs { letters: SET_POSITION, register_1: 0, register_2: 0, ..before }
            }
            (_, Motion::Move { position, profile }) => Outputs {
                velocity: self.rules.speed(profile.velocity),
                acceleration: self.rules.acceleration(profile.acceleration),
                deceleration: self.rules.acceleration(profile.deceleration),
                distance: match self.rules.target(position, seen.demand) {
                    Target::Absolute(distance) | Target::Relative(distance) => distance,
                },
                ..before
            },
            (_, Motion::Velocity { velocity, acceleration }) => {
                let ramp = self.rules.acceleration(acceleration);
                Outputs {
                    jog_speed: self.rules.signed_speed(velocity),
                    jog_acceleration: ramp,
                    jog_deceleration: ramp,
                    ..before
                }
            }
            (_, Motion::Ramp { deceleration }) => {
                let ramp = self.rules.acceleration(deceleration);
                Outputs { deceleration: ramp, jog_deceleration: ramp, ..before }
            }
            (_, Motion::Home) => homing.as_ref().map_or(before, |homing| {
                let ramp = self.rules.acceleration(homing.acceleration);
                Outputs {
                    velocity: self.rules.speed(homing.velocity),
                    acceleration: ramp,
                    deceleration: ramp,
                    distance: (homing.distance * units.counts_per_unit).round() as i32,
                    register_1: homing.input.into(),
                    register_2: 0,
                    ..before
                }
            }),
            _ => before,
        }
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

    fn motion_ended(&mut self, seen: bool) {
        let stops = matches!(self.motion.value, Motion::Ramp { .. } | Motion::Halt);
        self.motion_step = match self.motion_step {
            Step::Held if stops && !seen => Step::Due,
            Step::Held if self.motion.value == Motion::Home && seen => Step::Runs,
            Step::Held => {
                if !seen && !self.is_taken {
                    self.refused = Some(Refused::NotTaken);
                }
                Step::Settled
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

    /// What a packet of the drive proves.
    pub(super) fn take(&mut self, seen: &Seen, evidence: &mut Evidence) {
        self.edges.answered();
        self.see(seen);
        self.repeat(seen);
        let since = |settled: bool, serial: u64| if settled { serial } else { serial.saturating_sub(1) };
        let (power, motion) = self.sent;
        let delivered = self.edges.is_delivered();
        let power_has = self.power.serial == power
            && match self.power_step {
                Step::Held => delivered,
                Step::Due => false,
                _ => true,
            };
        // One that waits for a busy drive is known to the drive machine by that.
        let waits =
            self.power_step == Step::Due && self.power.value == Power::EnableOperation && seen.has(BUSY);
        evidence.accepted.power = evidence.accepted.power.max(since(power_has || waits, power));
        let motion_has = self.motion.serial == motion && self.is_taken;
        evidence.accepted.motion = evidence.accepted.motion.max(since(motion_has, motion));
        evidence.refused = self.refused;
        evidence.homing = self.homing;
        evidence.reference = Some(if self.homed { Reference::Set } else { Reference::Silent });
        evidence.outputs_count = true;
        evidence.stays_on = seen.is_enabled();
        evidence.ready = !seen.has(BUSY);
        evidence.obstacle = seen.has(BUSY).then_some(BUSY_NOW);
        let active = seen.has(status::FAULT);
        evidence.fault = FaultIs { active, named: true, resettable: Resettable::Now };
        self.proved = *seen;
        self.steady = self.is_settled();
    }

    /// Nothing is under way, and nothing is to be sent but idle.
    fn is_settled(&self) -> bool {
        self.edges.is_settled()
            && self.power_step == Step::Settled
            && matches!(self.motion_step, Step::Settled)
            && !matches!(self.motion.value, Motion::Native(_))
            && self.sent == (self.power.serial, self.motion.serial)
            && self.is_taken
    }

    /// Effects of the held command, and of one that runs.
    fn see(&mut self, seen: &Seen) {
        let delivered = self.edges.is_delivered();
        let effect = match (self.holder, self.power.value, self.motion.value) {
            (Holder::Power, Power::EnableOperation, _) => seen.is_enabled(),
            (Holder::Power, Power::FaultReset, _) => delivered && !seen.has(status::FAULT | status::ALARM),
            (Holder::Power, Power::QuickStop, _) => self.stands(seen, delivered),
            (Holder::Power, ..) => {
                let off = delivered && !seen.is_enabled();
                self.may_come_on &= !off;
                off
            }
            (Holder::Clearing, ..) => self.stands(seen, delivered),
            (Holder::Motion, _, _) if matches!(self.motion_step, Step::Zeroing { .. }) => {
                delivered && seen.demand as i32 == 0
            }
            (Holder::Motion, _, Motion::Ramp { .. } | Motion::Halt) => self.stands(seen, delivered),
            (Holder::Motion, _, Motion::Move { position, .. }) => {
                let target = i64::from(self.rules.position(position, seen.demand));
                seen.has(status::MOVING) || delivered && i64::from(seen.demand as i32) == target
            }
            (Holder::Motion, _, Motion::Velocity { .. }) if self.outputs.command == command::JOG => {
                seen.jogs()
            }
            // One that has ended meanwhile takes no other speed.
            (Holder::Motion, _, Motion::Velocity { .. }) => delivered && seen.jogs(),
            (Holder::Motion, _, Motion::Home) => seen.has(status::HOMING),
            (Holder::Native, ..) => delivered,
            _ => false,
        };
        if effect {
            self.edges.see();
            if self.holder == Holder::Motion && self.motion_step == Step::Held {
                self.is_taken = true;
            }
        }
        let waits = matches!(self.holder, Holder::Nobody | Holder::Clearing);
        if waits && self.motion_step == Step::Clearing && !seen.moves() {
            self.is_taken = self.motion.value == Motion::Hold;
            self.motion_step = if self.is_taken { Step::Settled } else { Step::Due };
        }
        if !seen.moves() && self.holder != Holder::Motion {
            (self.jog, self.ramp) = (None, None);
        }
        if self.motion_step == Step::Runs && !seen.moves() {
            self.home_ended(seen);
        }
        if matches!(self.motion_step, Step::Zeroing { held: true }) && seen.demand as i32 == 0 {
            self.rehomed |= !std::mem::replace(&mut self.zeroed, true);
        }
    }

    /// It stands, after the stop was delivered, or has begun to brake.
    fn stands(&self, seen: &Seen, delivered: bool) -> bool {
        seen.has(status::STOPPING) || delivered && !seen.moves()
    }

    /// The drive's homing is over.
    fn home_ended(&mut self, seen: &Seen) {
        let failed = !seen.is_enabled() || seen.alarm & !self.alarms_before != 0;
        let seeks = self.rules.homing.as_ref().is_some_and(|homing| homing.method == HomingMethod::Seek);
        self.motion_step = match () {
            () if failed => {
                self.homing = HomingIs::Failed;
                Step::Settled
            }
            () if seeks => Step::Zeroing { held: false },
            () => {
                (self.homing, self.homed) = (HomingIs::Attained, true);
                Step::Settled
            }
        };
    }

    /// A stop, and power off, are repeated until they are seen: whatever set the drive in motion after that.
    fn repeat(&mut self, seen: &Seen) {
        let stops = matches!(self.motion.value, Motion::Ramp { .. } | Motion::Halt);
        if stops && self.motion_step == Step::Settled && seen.moves() && !seen.has(status::STOPPING) {
            self.motion_step = Step::Due;
        }
        if self.power_step != Step::Settled || self.power.serial == 0 {
            return;
        }
        let again = match self.power.value {
            Power::Off | Power::Shutdown => seen.is_enabled(),
            Power::QuickStop => seen.moves() && !seen.has(status::STOPPING),
            _ => false,
        };
        if again {
            self.power_step = Step::Due;
        }
    }
}

impl Rules {
    /// Not zero: with a zero the drive would never arrive. What the wire cannot carry was refused before.
    fn speed(&self, velocity: f64) -> u32 {
        ((velocity * self.velocity).abs().round() as u32).max(1)
    }

    /// With its direction, and not zero.
    fn signed_speed(&self, velocity: f64) -> i32 {
        let speed = self.speed(velocity) as i32;
        if velocity * self.velocity < 0.0 { -speed } else { speed }
    }

    fn acceleration(&self, acceleration: f64) -> u32 {
        ((acceleration * self.acceleration).abs().round() as u32).clamp(1, MOST_PER_REV as u32)
    }

    /// How a drive that stands at `demand` is sent to a position. What it makes of a position behind the end of its
    /// counts is not documented: it may go round the other way. There it is sent by the distance.
    fn target(&self, position: f64, demand: i64) -> Target {
        let target = self.position(position, demand);
        let way = target.wrapping_sub(demand as i32);
        match (demand as i32).checked_add(way) {
            Some(_) => Target::Absolute(target),
            None => Target::Relative(way),
        }
    }

    /// The count of a rotary axis wraps around, in the drive as here.
    fn position(&self, position: f64, demand: i64) -> i32 {
        let from = if self.units.modulo.is_some() { demand } else { 0 };
        let counts = ((position - self.units.offset) * self.units.counts_per_unit).round();
        let way = (counts - from as f64) as i32;
        (from + i64::from(way)) as i32
    }
}

/// A motion that the drive makes until its end.
fn is_begun(motion: Motion) -> bool {
    matches!(motion, Motion::Move { .. } | Motion::Velocity { .. } | Motion::Home)
}

/// What the application may command in native mode while the master keeps the drive running: something, and not its
/// power.
fn is_motion(output: &NativeOutput) -> bool {
    let word = output.outputs.command;
    word != command::IDLE && word & (command::ENABLE | command::DISABLE | command::RESET_ALARM) == 0
}
