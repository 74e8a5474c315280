//! EtherCAT to Kollmorgen drives of the S700: one frame for all of them. A velocity setpoint (1702h), or a position
//! setpoint (1701h).

pub mod rows;
pub mod slaves;

use std::any::Any;
use std::ops::Range;

use fieldbeat::Time;
use fieldbeat::axis::{AxisPlan, Profile, Unit, Units};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethercat::{EthercatPlan, Family, KollmorgenDrive, Object, Start, Type, Watchdog};
use fieldbeat::sim::{SimPlan, SimSegment, Simulated};
use fieldbeat::time::MS;
use fieldbeat_core::bus::cia402::{ControlCommand as Operation, ControlWord, StatusWord};
use fieldbeat_core::net::frames::MAC;
use fieldbeat_ethercat::faults::Fault;
use fieldbeat_ethercat::object::long::Target as _;
use fieldbeat_ethercat::object::{Target, pdo};
use fieldbeat_ethercat::wire::frame::{Command, FrameError, datagrams};
use fieldbeat_ethercat::wire::registers::{AlState, AlStatus};
use fieldbeat_ethercat::wire::sdo::AbortCode;
use fieldbeat_sim::ethercat::{DriveSettings, EthercatSegment, EthercatSim, SlaveSettings};

use fieldbeat::Axis;
use fieldbeat::bus::ethercat;
use slaves::{Fitted, Slaves};

use crate::conformance::line::PERIOD;
use crate::conformance::subject::{Calls, Can, Drive, Said, Subject};

/// By what the drives are led, and which slaves the segment is made of.
pub struct EtherCat {
    pub positions: bool,
    pub slaves: Slaves,
}

const LINE: &str = "local:conformance";
/// rpm to find home with: the drive's own take a while.
const HOMING_RPM: f64 = 300.0;
/// Velocity of the profile, revolutions a second.
const VELOCITY: f64 = 4.0;
/// Slower is standstill, revolutions a second.
const STANDSTILL: f64 = 0.05;
/// Bytes of each drive: control word and setpoint; AL status, position, torque, status word.
const OUTPUTS: usize = 6;
const AL: usize = 2;
const INPUTS: usize = 8;
/// The bit of an Ethernet address that the first slave sets.
const PASSED: u8 = 1 << 1;
/// Where the Ethernet address of the sender stands.
const SENDER: usize = 6;
/// Who sent a frame, and its number: the data of its first datagram, whose length and flags stand here.
const MARK: Range<usize> = 26..34;
const LENGTH: usize = 22;
/// In front of all datagrams; of each, in front of its data, and the counter behind them.
const FRONT: usize = 16;
const HEADER: usize = 10;
const COUNTER: usize = 2;
/// In the upper byte of a datagram's length.
const CIRCULATED: u8 = 1 << 6;
/// The profile velocity, of a mode that is not used here.
const FREE: Target = Target { object: Object::new(0x6081, 0), kind: Some(Type::U32), complete: false };
/// So many counts a step may be off by its own rounding.
const ROUNDED: i64 = 4;

fn increments() -> f64 {
    KollmorgenDrive::new("x", 0, Family::S700).scaling.increments()
}

/// Setpoint and control word.
fn outputs(request: &[u8]) -> Option<(i64, ControlWord)> {
    let [a, b, c, d, low, high] = *request.first_chunk::<OUTPUTS>()?;
    Some((i32::from_le_bytes([a, b, c, d]).into(), ControlWord(u16::from_le_bytes([low, high]))))
}

/// Where the data of each datagram stand.
fn places(frame: &[u8]) -> Vec<Range<usize>> {
    let lengths = datagrams(frame).into_iter().flatten().flatten().map(|datagram| datagram.data.len());
    let place = |end: &mut usize, length| {
        let begin = *end + HEADER;
        *end = begin + length + COUNTER;
        Some(begin..begin + length)
    };
    lengths.scan(FRONT, place).collect()
}

impl EtherCat {
    fn drive(
        &self,
        index: usize,
        count: usize,
        drive: &Drive,
    ) -> (KollmorgenDrive, DriveSettings, SlaveSettings) {
        let place = self.place(index, count) as u16;
        let mut plan = KollmorgenDrive::new(&drive.axis.name, place, Family::S700);
        if self.positions {
            let layout = |pdo| pdo::fixed(Family::S700).into_iter().find(|layout| layout.pdo == pdo);
            plan.outputs = layout(0x1701).expect("it has this PDO");
        }
        plan.fit();
        plan.axis = drive.axis.clone();
        // What moves by itself needs it.
        plan.slave.watchdog =
            if drive.jog || drive.follow { Watchdog::After(100 * MS) } else { Watchdog::Off };
        let mut slave = self.slaves.usual();
        let (last, running) = (index == 0, drive.running);
        let mut settings = DriveSettings {
            position: (drive.start * drive.axis.units.counts_per_unit).round() as i32,
            ramps_rpm_s: (40_000, 40_000),
            running_rpm: drive.running.then_some(60.0 * VELOCITY),
            ..DriveSettings::new(Family::S700)
        };
        let (of_slave, of_drive) = (&mut slave, &mut settings);
        (self.slaves.fit)(&mut Fitted { plan: &mut plan, slave: of_slave, drive: of_drive, last, running });
        let raw = (HOMING_RPM / plan.scaling.rpm_per_count).round() as u64;
        plan.slave.start_up.push(Start::new(Object::new(0x6099, 1), Type::U32, raw));
        // In increments it is the same for all units.
        let turns = drive.axis.units.counts_per_unit.abs() / increments();
        plan.axis.stop.standstill = STANDSTILL / turns;
        (plan, settings, slave)
    }

    fn segment(&self, drives: &[Drive]) -> EthercatSegment {
        let drive = |(index, drive)| self.drive(index, drives.len(), drive);
        let (plans, settings, slaves): (Vec<_>, _, Vec<_>) = drives.iter().enumerate().map(drive).collect();
        let places: Vec<u16> = plans.iter().map(|plan| plan.slave.place).collect();
        let mut segment = EthercatSegment { drives: settings, ..EthercatPlan::new(LINE, plans).into() };
        segment.settings.slaves = places.into_iter().zip(slaves).collect();
        self.slaves.add_front(&mut segment);
        segment
    }
}

impl Subject for EtherCat {
    fn name(&self) -> &'static str {
        match (self.slaves.name, self.positions) {
            ("", true) => "ethercat with positions",
            ("", false) => "ethercat with velocities",
            (name, _) => name,
        }
    }

    fn can(&self) -> Can {
        Can {
            positions: self.positions,
            home: true,
            jog: true,
            follow: self.positions,
            picks: !self.positions,
            identified: true,
            round_trip: true,
            whole: true,
            shared: true,
            rearmed: self.slaves.rearmed,
            ..Can::default()
        }
    }

    fn axis(&self, name: &str) -> AxisPlan {
        let units =
            Units { unit: Unit::Revolution, counts_per_unit: increments(), offset: 0.0, modulo: None };
        let mut axis = AxisPlan::new(name, units);
        let ramp = 10.0 * VELOCITY;
        axis.profile = Profile { velocity: VELOCITY, acceleration: ramp, deceleration: ramp };
        axis.stop.deceleration = ramp;
        axis.jog_deadman = None;
        axis
    }

    fn plan(&self, drives: &[Drive]) -> Box<dyn BusPlan> {
        Box::new(self.segment(drives).plan)
    }

    fn simulated(&self, drives: &[Drive]) -> Simulated {
        SimPlan::from(self.segment(drives)).build()
    }

    fn place(&self, index: usize, count: usize) -> usize {
        self.slaves.front.len() + count - 1 - index
    }

    fn piece(&self, now: Time, frame: &[u8], index: usize, count: usize) -> Option<(Vec<u8>, Vec<u8>)> {
        let mut all = datagrams(frame).ok()?.flatten();
        let image = all.find(|datagram| matches!(datagram.command(), Some(Command::Lrw(_))))?;
        let front = &self.slaves;
        let place = count - 1 - index;
        let request = image.data.get(front.outputs() + place * OUTPUTS..)?.first_chunk::<OUTPUTS>()?;
        let behind = front.outputs() + count * OUTPUTS + front.front.len() * AL + front.inputs();
        let inputs = behind + place * (AL + INPUTS);
        let reply = image.data.get(inputs..)?.first_chunk::<{ AL + INPUTS }>()?;
        let status = AlStatus(u16::from_le_bytes([reply[0], reply[1]]));
        // With few FMMUs it is not there, and the status word is never zero.
        let there = match status.state() {
            Some(state) => state >= AlState::SafeOp,
            None => reply[AL + INPUTS - 2..] != [0; 2],
        };
        let reply = [&reply[..], &now.0.to_le_bytes()].concat();
        Some((request.to_vec(), if there { reply } else { Vec::new() }))
    }

    fn native(&self, axis: &mut Axis) -> Box<dyn FnMut(u16)> {
        let mut native = axis.native::<ethercat::Native>().expect("it was not taken");
        Box::new(move |number| {
            // Halt, which means nothing without power.
            let control = i64::from(number % 2) << 8;
            if let Some(output) = native.output(&[(Object::new(0x6040, 0), control)]) {
                let _ = native.write(output);
            }
        })
    }

    fn said(&self, before: Option<Said>, request: &[u8], reply: &[u8]) -> Option<Said> {
        let (setpoint, control) = outputs(request)?;
        let [al, _, a, b, c, d, _, _, low, high] = *reply.first_chunk::<{ AL + INPUTS }>()?;
        let at = Time(u64::from_le_bytes(*reply.last_chunk()?));
        let status = StatusWord(u16::from_le_bytes([low, high]));
        let position = i64::from(i32::from_le_bytes([a, b, c, d]));
        let powered = status.state().is_powered();
        let since = before.and_then(|before| Some((before.at?, before.position?)));
        let speed = |(last, place): (Time, i64)| {
            (position - place) as f64 / increments() * 1e9 / at.since(last) as f64
        };
        let turns = since.is_some_and(|since| speed(since).abs() > STANDSTILL);
        let homes = control.has(ControlWord::START);
        let operates = control.has(Operation::EnableOperation.word().0);
        let leads = operates && AlStatus(al.into()).state().map_or(powered, |state| state == AlState::Op);
        let demand = if self.positions && leads && !homes { setpoint } else { position };
        let led = match self.positions {
            true => leads && before.is_some_and(|before| before.setpoint != Some(setpoint)),
            false => setpoint != 0,
        };
        // The same frame, come twice.
        let again = before.filter(|before| before.at.is_some_and(|last| at.since(last) < PERIOD / 2));
        let moving = again.map_or(powered && (led || homes || turns), |before| before.moving);
        Some(Said {
            powered,
            moving,
            homed: None,
            position: Some(position),
            demand: Some(demand),
            setpoint: self.positions.then_some(setpoint),
            at: Some(again.and_then(|before| before.at).unwrap_or(at)),
            velocity: None,
        })
    }

    fn is_strange(&self, frame: &[u8]) -> bool {
        let Some(sender) = frame.get(SENDER..).and_then(<[u8]>::first_chunk::<6>) else { return true };
        let own = [sender[0] & !PASSED, sender[1], sender[2], sender[3], sender[4], sender[5]] == MAC;
        !own || matches!(datagrams(frame), Err(FrameError::Foreign))
    }

    fn of_another(&self, frame: &[u8]) -> Vec<u8> {
        [&frame[..SENDER], &[0x20; 6], &frame[SENDER + 6..]].concat()
    }

    fn provoke(&self, line: &mut dyn SimSegment, place: usize) {
        let line: &mut dyn Any = line;
        let drive = line.downcast_mut::<EthercatSim>().and_then(|line| line.drive(place));
        drive.expect("a drive").provoke(Fault::FOLLOWING.code);
    }

    fn calls(&self) -> Calls {
        let missing = Target::parse("0x5FFF:0.u16").expect("a target");
        let refused = (missing.read(), AbortCode::NO_OBJECT.0);
        Calls { read: FREE.read(), write: FREE.write(77), refused, soon: self.slaves.soon }
    }

    fn requests_stop(&self, before: &[Vec<u8>], request: &[u8]) -> bool {
        let Some((setpoint, control)) = outputs(request) else { return false };
        let mut last: Vec<i64> =
            before.iter().rev().filter_map(|request| Some(outputs(request)?.0)).collect();
        // A frame of a cycle in which the drive is not due carries the same again.
        last.dedup();
        if control.has(ControlWord::HALT) {
            return true;
        }
        match (self.positions, last.as_slice()) {
            (true, [first, second, third, ..]) => {
                // It falls behind what it would be if it went on as before.
                let (now, step) = (setpoint - first, first - second);
                let expected = step + (step - (second - third));
                setpoint != *first && (expected - now) * step.signum() > ROUNDED
            }
            (false, [last, ..]) => setpoint.abs() < last.abs(),
            _ => false,
        }
    }

    fn fault(&self, _reply: &[u8]) -> Option<Vec<u8>> {
        // No telegram, but what happens in the drive.
        Some(Vec::new())
    }

    fn malformed(&self, frame: &[u8]) -> Vec<Vec<u8>> {
        // It ends in its first datagram, or sooner than its header says; its first datagram is longer than it.
        let changed = |at: usize, bits: u8| [&frame[..at], &[frame[at] ^ bits], &frame[at + 1..]].concat();
        vec![frame[..20].to_vec(), frame[..frame.len() - 30].to_vec(), changed(23, 0x04)]
    }

    fn foreign(&self, frame: &[u8]) -> Vec<Vec<u8>> {
        // Of another master behind the same interface; with a number that was never sent; the same, gone round besides.
        let changed = |at: usize| {
            let mut changed = frame.to_vec();
            changed[at] ^= 0x80;
            changed
        };
        let mut round = changed(MARK.end - 1);
        round[LENGTH + 1] |= CIRCULATED;
        vec![changed(MARK.start), changed(MARK.end - 1), round]
    }

    fn circulated(&self, frame: &[u8]) -> Option<Vec<u8>> {
        let mut round = frame.to_vec();
        let number = round.get_mut(MARK)?.last_chunk_mut::<4>()?;
        let next = u32::from_le_bytes(*number).wrapping_add(1);
        *number = next.to_le_bytes();
        for at in places(frame) {
            round[at.start - HEADER + 1] = next as u8;
            round[at.start - HEADER + 7] |= CIRCULATED;
        }
        Some(round)
    }
}
