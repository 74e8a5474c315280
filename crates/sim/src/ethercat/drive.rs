//! The firmware of a drive behind its slave controller: states of the bus, process data, CiA 402, modes, faults.
//!
//! Knows no register, no frame and no working counter: the slave controller asks whether a state may be entered,
//! passes the messages of its mailbox, and calls it at each cyclic interrupt. The drive has no clock: on each call
//! it advances by the time since the last one.
//!
//! Assumed, because the manuals are silent: units of ramps, the power stage when OP is left, which faults are
//! stopped before power goes, F28 at once when OP is requested too early, and the defaults of the settings.
//!
//! | file | what |
//! |---|---|
//! | `drive` | its states on the bus, and its progress from one instant to the next |
//! | `process` | process data |
//! | `power` | the power stage and its faults |
//! | `motion` | how its modes use setpoints |
//! | `shown` | status words and actual values |
//! | `sdo` | SDOs |

mod motion;
mod power;
mod process;
mod sdo;
mod shown;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::f64::consts::TAU;

use self::motion::Track;
use super::Application;
use super::codec::cia402::{self, control, rises};
use super::codec::objects::number::*;
use super::codec::objects::{
    INPUT_PDO, OUTPUT_PDO, Object, Pdo, RESET, category, error_register, fault, has_mode, mode,
};
use super::codec::registers::{AlState, code};
use super::mailbox::Mailbox;
use super::mapping::Mapping;
use super::objects::Objects;
use super::settings::DriveSettings;
use super::sync::{QUANTA_MAX, QUANTUM_NS, Sync};
use crate::Truth;
use crate::physics::PlantPlan;
use crate::power::{Aim, PowerDrive, PowerPlan, RPM, Reset, set_bits};
use fieldbeat_core::axis::State;
use fieldbeat_core::time::{MS, S, Time};
use fieldbeat_ethercat::Family;

/// Bandwidth of the position controller, Hz.
const BANDWIDTH_HZ: f64 = 60.0;
/// Within this of its setpoint a speed is reached, rad/s, and a position, rad (assumed).
const REACHED: (f64, f64) = (5.0 * RPM, TAU / 1e3);
/// rpm/s of a quick stop and of the reaction to a fault (assumed).
const STOP_RPM_S: f64 = 50_000.0;
/// rpm of one count of 2070h:2 (CAN manual).
const INCREMENTAL_RPM: f64 = 1_875.0 / 262_144.0;
/// The target of a drive that comes up running, turns.
const FAR_TURNS: f64 = 1_000.0;

/// The largest torque at all, and in each direction.
const TORQUE_LIMITS: [Object; 3] = [MAXIMUM_TORQUE, POSITIVE_TORQUE, NEGATIVE_TORQUE];

/// Method 35: the present position is home (CiA 402).
const HOME_HERE: i64 = 35;

/// The progress of homing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Homing {
    Idle,
    Moving,
    Done,
    Failed,
}

/// One simulated drive.
#[derive(Debug)]
pub struct Drive {
    settings: DriveSettings,
    objects: Objects,
    mapping: Mapping,
    mailbox: Mailbox,
    /// The modes that it is still in one after the other, each until then, before that of 6060h.
    leaving: VecDeque<(i8, Time)>,
    sync: Sync,
    power: PowerDrive<u16>,
    al: AlState,
    /// Why it left OP by itself.
    dropped: Option<u16>,
    state: State,
    /// The last control word that was followed, since OP.
    control: Option<u16>,
    /// `None`: its objects have no valid value.
    pub(super) cycle_ns: Option<u64>,
    track: Track,
    /// The target of profile position and homing.
    goal: Option<Aim>,
    /// The outputs of a cycle, while they are evaluated.
    values: Vec<(Object, i64)>,
    acknowledged: bool,
    homing: Homing,
}

impl Drive {
    /// Switched on, in INIT.
    pub fn new(settings: DriveSettings) -> Drive {
        let mut drive = Drive {
            objects: Objects::new(&settings),
            mapping: Mapping::new(),
            mailbox: Mailbox::new(settings.dialect, settings.long_sdos.map(usize::from)),
            leaving: VecDeque::new(),
            sync: Sync::new(settings.interrupts_to_sync),
            power: power_drive(&settings),
            al: AlState::Init,
            dropped: None,
            state: State::SwitchOnDisabled,
            control: None,
            cycle_ns: None,
            track: Track::hold(0.0),
            goal: None,
            values: Vec::new(),
            acknowledged: false,
            homing: Homing::Idle,
            settings,
        };
        drive.set_up();
        if let Some(rpm) = drive.settings.running_rpm {
            drive.run(rpm);
        }
        drive
    }

    /// In operation, as another master has left it: at a velocity, or on a profile position with a far target.
    fn run(&mut self, rpm: f64) {
        let outputs = self.selected(OUTPUT_PDO);
        let has = |object| outputs.is_some_and(|outputs| outputs.place(object).is_some());
        let count = (rpm / self.settings.rpm_per_count).round() as i64;
        let (own, setpoint) = match () {
            () if has(VELOCITY_SETPOINT) => (mode::DIGITAL_VELOCITY, VELOCITY_SETPOINT),
            () if has(TARGET_VELOCITY) => (mode::PROFILE_VELOCITY, TARGET_VELOCITY),
            () => (mode::PROFILE_POSITION, PROFILE_VELOCITY),
        };
        self.objects.set(MODE, own.into());
        self.objects.set(setpoint, count);
        let word = cia402::ENABLE_OPERATION;
        self.objects.set(CONTROL_WORD, word.into());
        self.start_sync();
        (self.al, self.state, self.control) = (AlState::Op, State::OperationEnabled, Some(word));
        if own == mode::PROFILE_POSITION {
            let (up, down) = (self.ramp(ACCELERATION), self.ramp(DECELERATION));
            let place = FAR_TURNS * TAU * rpm.signum();
            self.goal = Some(Aim::GoTo { place, speed: rpm.abs() * RPM, up, down });
        }
        self.refresh();
    }

    /// Cyclic interrupts come from now on. Without objects for its cycle it finds that by them.
    fn start_sync(&mut self) {
        match self.objects.is_settable(CYCLE_UNITS) && self.objects.is_settable(CYCLE_POWER) {
            true => self.sync.start(self.cycle_ns),
            false => self.sync.measure(),
        }
    }

    fn set_up(&mut self) {
        self.cycle_ns = self.interpolation_ns();
        self.limit_torque();
        self.hold();
        self.refresh();
    }

    /// The state of the bus that it is in.
    pub fn al_state(&self) -> AlState {
        self.al
    }

    /// The state of its power stage.
    pub fn axis_state(&self) -> State {
        self.state
    }

    /// The code of the present fault.
    pub fn fault(&self) -> Option<u16> {
        self.power.fault()
    }

    /// Whether the drive follows the cycle of the bus: warning n17 is gone.
    pub fn is_synchronous(&self) -> bool {
        self.sync.synchronous
    }

    /// Whether the drive has its reference.
    pub fn is_homed(&self) -> bool {
        self.power.homed
    }

    /// The true state of the motor, in increments.
    pub fn truth(&self) -> Truth {
        self.power.truth(self.state.is_powered(), TAU / self.per_turn())
    }

    /// Speed of the motor, rpm.
    pub fn rpm(&self) -> f64 {
        self.power.speed() / RPM
    }

    /// The actual position before it is cut to 32 bits.
    pub fn position(&self) -> i64 {
        counts(self.power.position(), self.per_turn())
    }

    /// Raises the fault with a code.
    pub fn provoke(&mut self, code: u16) {
        self.fail(code);
    }

    /// Opens the hardware enable (STO) until then.
    pub fn open_sto(&mut self, until: Time) {
        self.power.open_sto(until);
    }

    fn enter(&mut self, state: AlState) {
        let left = std::mem::replace(&mut self.al, state);
        if left == AlState::Op {
            self.lock_setpoints();
        }
        match state {
            AlState::Init | AlState::Boot => {
                self.sync.start(None);
                self.mailbox.reset();
            }
            AlState::PreOp => self.sync.start(None),
            AlState::SafeOp if left == AlState::PreOp => {
                // Clears warnings and faults that are not fatal (EtherCAT manual).
                self.clear_fault();
                self.start_sync();
            }
            AlState::SafeOp => {}
            AlState::Op => self.control = None,
        }
    }

    fn step(&mut self, dt_ns: u64) {
        let at = self.power.now();
        while self.leaving.front().is_some_and(|(_, until)| *until <= at) {
            self.leaving.pop_front();
            self.hold();
        }
        if self.sync.pass(at) {
            self.lose_sync();
        }
        if !self.power.is_enabled() {
            self.state = match self.state {
                State::FaultReactionActive => State::Fault,
                State::SwitchedOn | State::OperationEnabled | State::QuickStopActive => {
                    State::SwitchOnDisabled
                }
                state => state,
            };
        }
        let aim = self.aim(at);
        self.power.step(aim, dt_ns);
        self.watch(aim);
        if self.power.is_standing() {
            self.state = match self.state {
                State::QuickStopActive => State::SwitchOnDisabled,
                State::FaultReactionActive => State::Fault,
                state => state,
            };
        }
    }

    /// In SAFEOP or OP.
    fn is_cyclic(&self) -> bool {
        matches!(self.al, AlState::SafeOp | AlState::Op)
    }

    /// The mode of operation that it is in.
    pub fn mode(&self) -> i8 {
        self.leaving.front().map_or(self.objects.get(MODE) as i8, |(mode, _)| *mode)
    }

    /// 6060h was another one until now.
    fn change_mode(&mut self, before: i8) {
        match self.settings.mode_delay_ns {
            0 => self.hold(),
            delay_ns => self.leaving.push_back((before, self.power.now() + delay_ns)),
        }
    }

    /// The cycle time by 60C2h, if it is a multiple of 250 us that the drive can have.
    fn interpolation_ns(&self) -> Option<u64> {
        let units = u64::try_from(self.objects.get(CYCLE_UNITS)).ok()?;
        let power = u32::try_from(self.objects.get(CYCLE_POWER) + 9).ok()?;
        let cycle_ns = units.checked_mul(10_u64.checked_pow(power)?)?;
        let fits = cycle_ns % QUANTUM_NS == 0 && (1..=QUANTA_MAX).contains(&(cycle_ns / QUANTUM_NS));
        fits.then_some(cycle_ns)
    }

    /// The least of its limits in either direction: one of 0 leaves it without a torque.
    fn limit_torque(&mut self) {
        let limits = TORQUE_LIMITS.into_iter().filter(|limit| self.objects.has(*limit));
        let least = limits.map(|limit| self.objects.get(limit)).min().unwrap_or_default();
        self.power.limit_torque(Some(self.torque(least as f64)));
    }

    /// N m of per mille.
    fn torque(&self, permille: f64) -> f64 {
        permille / 1e3 * self.settings.motor.rated_nm
    }

    /// User units a turn.
    fn per_turn(&self) -> f64 {
        let ratio = |over, under| self.objects.get(over) as f64 / self.objects.get(under).max(1) as f64;
        ratio(FEED, FEED_TURNS) * ratio(FACTOR, DIVISOR)
    }

    /// The angle of a position of 32 bits: the one nearest to the motor's.
    fn place_of(&self, position: i64) -> f64 {
        let now = self.position();
        let way = (position as i32).wrapping_sub(now as i32);
        self.power.zero + now.saturating_add(way.into()) as f64 / self.per_turn() * TAU
    }
}

impl Application for Drive {
    /// Enters a state of the bus if it may, or returns why not. No transition waits without an error: the drive is
    /// synchronous, or it refuses.
    fn may_enter(&mut self, now: Time, state: AlState) -> Result<(), u16> {
        use AlState::{Boot, Init, Op, PreOp, SafeOp};
        self.advance(now);
        match (self.al, state) {
            (from, to) if from == to => return Ok(()),
            (_, Init) | (Init | SafeOp | Op, PreOp) | (Op, SafeOp) => {}
            // A hardware reset.
            (Init, Boot) => self.restart(now),
            (PreOp, SafeOp) if self.sizes().0 == 0 || self.sizes().1 == 0 => {
                return Err(code::SYNC_MANAGER);
            }
            (PreOp, SafeOp) => {}
            (SafeOp, Op) if !self.sync.synchronous => {
                self.fail(fault::SYNCHRONISATION);
                return Err(code::SYNCHRONISATION);
            }
            (SafeOp, Op) => {}
            _ => return Err(code::INVALID_REQUEST),
        }
        self.enter(state);
        Ok(())
    }

    /// Takes what the master wrote to the mailbox; true with the next message for it in `reply`, which may be an
    /// emergency in place of the answer: the answer is then left for [`message`](Self::message).
    fn mailbox(&mut self, request: &[u8], reply: &mut Vec<u8>) -> bool {
        if matches!(self.al, AlState::Init | AlState::Boot) {
            return false;
        }
        if let Some(request) = self.mailbox.take(request) {
            let answer = self.obey_sdo(&request);
            self.mailbox.answer(&request, answer);
        }
        self.message(reply)
    }

    /// The next message for the master, whenever its mailbox is empty; false if there is none.
    fn message(&mut self, reply: &mut Vec<u8>) -> bool {
        reply.clear();
        let message = self.mailbox.next();
        reply.extend(message.iter().flatten());
        message.is_some()
    }

    /// A cyclic interrupt: outputs count in OP, inputs are written in SAFEOP and OP. Areas that are shorter than
    /// the PDOs are ignored.
    fn process(&mut self, now: Time, outputs: &[u8], inputs: &mut [u8]) {
        self.advance(now);
        if !self.is_cyclic() {
            return;
        }
        if self.sync.interrupt(now) {
            self.lose_sync();
        }
        if self.al == AlState::Op {
            self.take(now, outputs);
        }
        self.refresh();
        self.give(inputs);
    }

    /// Advances to `now`. Without cyclic interrupts it has to be called now and then: otherwise the drive does not
    /// notice that they are missing.
    fn advance(&mut self, now: Time) {
        while let Some(dt_ns) = self.power.advance(now) {
            self.step(dt_ns);
        }
    }

    /// Why it left OP by itself, once: it is in SAFEOP now.
    fn dropped(&mut self) -> Option<u16> {
        self.dropped.take()
    }

    fn actual(&mut self, inputs: &mut [u8]) {
        self.refresh();
        self.give(inputs);
    }

    /// Without power on its motor; unless it is running.
    fn left_in(&mut self, state: AlState) {
        if self.al != state {
            self.al = state;
            match self.is_cyclic() {
                true => self.start_sync(),
                false => self.sync.start(None),
            }
        }
    }

    /// Power came back: everything volatile is lost, the motor goes on turning as it did.
    fn restart(&mut self, now: Time) {
        self.advance(now);
        self.objects = Objects::new(&self.settings);
        self.mapping = Mapping::new();
        self.mailbox.reset();
        self.leaving.clear();
        self.sync.start(None);
        (self.al, self.dropped, self.state) = (AlState::Init, None, State::SwitchOnDisabled);
        self.control = None;
        self.power.restart();
        self.set_up();
    }

    /// The answer to P->S with SyncManagers of these lengths. A real AKD distinguishes outputs, and so inputs
    /// (assumed).
    fn check_sizes(&self, outputs: usize, inputs: usize) -> Result<(), u16> {
        let wanted = self.sizes();
        match self.settings.family {
            _ if (outputs, inputs) == wanted => Ok(()),
            Family::S700 => Err(code::SYNC_MANAGER),
            Family::Akd if outputs != wanted.0 => Err(code::OUTPUTS),
            Family::Akd => Err(code::INPUTS),
        }
    }

    fn drive(&mut self) -> Option<&mut Drive> {
        Some(self)
    }
}

/// The power drive of these settings, at its position.
fn power_drive(settings: &DriveSettings) -> PowerDrive<u16> {
    let motor = &settings.motor;
    let mut power = PowerDrive::new(PowerPlan {
        plant: PlantPlan {
            mass_kg: motor.inertia_kgm2,
            range: (f64::NEG_INFINITY, f64::INFINITY),
            bandwidth_hz: BANDWIDTH_HZ,
            damping: 1.0,
            feed_forward: 1.0,
            peak_force_n: motor.peak_permille / 1e3 * motor.rated_nm,
            friction_n: motor.friction_nm,
        },
        max_speed: motor.max_rpm * RPM,
        hardware_enable: settings.hardware_enable,
        scan_ns: None,
    });
    power.zero = -f64::from(settings.position) / f64::from(settings.increments()) * TAU;
    power
}

/// The count of an angle.
fn counts(angle: f64, per_turn: f64) -> i64 {
    (angle / TAU * per_turn).round() as i64
}
