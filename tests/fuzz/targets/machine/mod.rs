//! A whole machine in virtual time: drives that lie, a wire that loses and repeats, an application that asks for
//! anything at any moment, and the end of it all.

pub(super) mod hostile;
mod watch;

use std::collections::VecDeque;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use fieldbeat::axis::{
    AxisPlan, Command, FoundRunning, Health, Limits, Profile, Row, StopHow, StopPlan, StopThen, StopTimeout,
    Underrun, Units,
};
use fieldbeat::bus::linudp::{
    COUNTS_PER_MM, ErrorCode, LinUdpDrive, LinUdpPlan, MonitorPlan, Native, ReplyTag, StreamCommand,
};
use fieldbeat::sim::{FaultPlan, WorldOptions};
use fieldbeat::time::{MS, US};
use fieldbeat::{CyclePlan, Flow, Master, Overrun, Plan, Simulation};
use fieldbeat_linudp::DRIVE_PORT;
use fieldbeat_sim::linudp::LinMotSettings;

use self::hostile::{HostileBus, Script, Wire};
use self::watch::Watch;
use super::commands::{command, output, row};
use super::input::Input;

const MASTER: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 1);
const RANGE: (f64, f64) = (-100.0, 200.0);
const STOP_TIMEOUT: Duration = Duration::from_millis(60);

/// Turns of the loop before the end is requested: a program is short, so that many of them can be run.
const MOST_TURNS: u64 = 400;

/// What a shutdown may take: to brake, once more in a hurry, once more where the drive went and came back, and to power
/// off; and a few cycles from one to the other.
const LONGEST_END: Duration = STOP_TIMEOUT.saturating_mul(4);
const END_TURNS: u64 = 6;

pub fn machine(data: &[u8]) {
    let mut input = Input(data);
    let mut machine = Machine::new(&mut input);
    while !input.is_over() && machine.turns < MOST_TURNS && !machine.ended {
        machine.operate(&mut input);
    }
    machine.finish();
}

/// What the in-loop task is to do in its next calls.
#[derive(Default)]
struct TaskScript {
    commands: VecDeque<(usize, Command)>,
    rows: VecDeque<(usize, Row)>,
    /// Commands that were taken: axis, id, command.
    accepted: Vec<(usize, u64, Command)>,
}

struct Machine {
    sim: Simulation,
    scripts: Vec<Arc<Mutex<Script>>>,
    wire: Arc<Mutex<Wire>>,
    task: Arc<Mutex<TaskScript>>,
    watches: Vec<Watch>,
    natives: Vec<Native>,
    drives: Vec<LinUdpDrive>,
    period_ns: u64,
    unmatched: u64,
    turns: u64,
    was_jammed: bool,
    /// The turns when the end was requested.
    asked_at: Option<u64>,
    ended: bool,
}

fn address(index: usize) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 1, 1 + index as u8), DRIVE_PORT)
}

fn drive(index: usize, input: &mut Input<'_>) -> (LinUdpDrive, LinMotSettings) {
    let features = input.word();
    let has = |bit: u16| features >> bit & 1 == 1;
    let mut axis = AxisPlan::new(format!("x{index}"), Units::millimetres(COUNTS_PER_MM));
    if has(0) {
        axis.units.modulo = Some(50.0);
    } else if !has(1) {
        axis.limits = Limits {
            position: Some(RANGE),
            velocity: Some(1_000.0),
            acceleration: Some(20_000.0),
            step: has(2).then_some(2.0),
            ..Limits::default()
        };
    }
    axis.profile = Profile { velocity: 200.0, acceleration: 5_000.0, deceleration: 5_000.0 };
    axis.divisor = if has(3) { 2 } else { 1 };
    axis.phase = if has(3) && has(4) { 1 } else { 0 };
    axis.health = Health {
        bucket: input.of(&[3, 1, 5]),
        leak: 5,
        gate: input.of(&[2, 1, 5]),
        probe_interval: Duration::from_millis(40),
    };
    axis.stop = StopPlan {
        how: input.of(&[StopHow::Ramp, StopHow::Quick, StopHow::Coast]),
        // Within the time-out from the largest speed.
        deceleration: 20_000.0,
        then: if has(5) { StopThen::Hold } else { StopThen::Disable },
        timeout: STOP_TIMEOUT,
        on_timeout: if has(6) { StopTimeout::Hold } else { StopTimeout::Disable },
        standstill: 5.0,
        standstill_for: 2,
        group: has(7).then_some(1),
    };
    axis.underrun = input.of(&[Underrun::Hold, Underrun::Stop, Underrun::Extrapolate(3)]);
    axis.on_found_running = if has(8) { FoundRunning::Refuse } else { FoundRunning::Stop };
    axis.enable_timeout = Duration::from_millis(450);
    axis.home_timeout = Duration::from_millis(300);
    axis.command_queue = 8;
    axis.stream_queue = 32;
    axis.event_queue = if input.byte() == 255 { 2 } else { 128 };
    let drive = LinUdpDrive {
        stream: input.of(&[Some(StreamCommand::Pva), Some(StreamCommand::PvaConfigured), None]),
        monitor: if has(9) { MonitorPlan::AsSet } else { MonitorPlan::Off },
        reply_tag: if has(10) { ReplyTag::Count } else { ReplyTag::Definition },
        leash: (!has(11)).then_some(20.0),
        axis,
        ..LinUdpDrive::new("", *address(index).ip())
    };
    let settings = LinMotSettings {
        start_position: 10_000,
        range: (-1_050_000, 2_050_000),
        stream_patience: 10.0,
        force_enable_bits: has(12),
        start_running: has(13),
        ..LinMotSettings::new(drive.address)
    };
    (drive, settings)
}

impl Machine {
    fn new(input: &mut Input<'_>) -> Machine {
        let features = input.byte();
        // Long periods: an exchange is an exchange, and the drive's own times pass in fewer of them.
        let period_ns = [10 * MS, 5 * MS, 10 * MS, 10 * MS][usize::from(features & 3)];
        let cycle = CyclePlan {
            period_ns,
            overrun: if features & 4 == 0 { Overrun::Skip { max_skip: 3 } } else { Overrun::Stop },
            ..CyclePlan::default()
        };
        let count = if features & 8 == 0 { 1 } else { 2 };
        let options = WorldOptions {
            seed: 1,
            // Every third wake-up is too late for its slot.
            wake_ns: if features & 16 == 0 { 0 } else { period_ns * 3 / 8 },
            ..WorldOptions::default()
        };
        let (mut drives, mut simulated): (Vec<_>, Vec<_>) =
            (0..count).map(|index| drive(index, input)).unzip();
        for (drive, settings) in drives.iter_mut().zip(&mut simulated) {
            let every_ns = period_ns * u64::from(drive.axis.divisor);
            settings.stream_period_ns = every_ns;
            drive.stream = drive.stream.filter(|command| command.takes(every_ns));
        }
        let bus = HostileBus::new(LinUdpPlan::new(MASTER, drives.clone()));
        let (scripts, wire) = (bus.scripts.clone(), Arc::clone(&bus.wire));
        let simulated = bus.simulated(simulated);
        let plan = Plan { source: None, cycle, buses: vec![Box::new(bus)], groups: Vec::new() };
        let task = Arc::new(Mutex::new(TaskScript::default()));
        let inside = Arc::clone(&task);
        let setup = Master::from_plan(plan).with_task(move |_, axes| {
            let mut script = inside.lock().unwrap();
            if let Some((axis, command)) = script.commands.pop_front()
                && let Ok(id) = axes.command(axis, command)
            {
                script.accepted.push((axis, id.0, command));
            }
            if let Some((axis, row)) = script.rows.pop_front() {
                axes.follow(axis, row);
            }
        });
        let mut sim = setup.simulate_with(simulated, options).expect("the machine can be built");
        let natives = (0..count).map(|axis| *sim.axis(axis).native().expect("a LinUDP axis")).collect();
        Machine {
            sim,
            natives,
            scripts,
            wire,
            task,
            watches: drives.iter().cloned().map(Watch::new).collect(),
            drives,
            period_ns,
            unmatched: 0,
            turns: 0,
            was_jammed: false,
            asked_at: None,
            ended: false,
        }
    }

    fn script(&self, axis: usize) -> MutexGuard<'_, Script> {
        self.scripts[axis].lock().unwrap()
    }

    /// One instruction of the program.
    fn operate(&mut self, input: &mut Input<'_>) {
        let what = input.byte();
        let axis = usize::from(what >> 7) % self.drives.len();
        match what & 0x1F {
            0..=6 => self.run(1 + u64::from(input.byte() % 24)),
            7..=10 => self.post(axis, command(input)),
            11..=13 => self.lead(axis),
            14 => self.stream(axis, input),
            15 if what & 0x60 == 0x60 => drop(self.sim.axis(axis).set_torque(f64::from(input.byte() as i8))),
            15 if what & 0x20 != 0 => drop(self.sim.axis(axis).set_velocity(f64::from(input.byte() as i8))),
            15 => match input.flag() {
                true => drop(self.sim.axis(axis).push_row(row(input))),
                false => drop(self.natives[axis].write(output(input))),
            },
            16..=19 => self.script(axis).lie(input),
            20 => self.script(axis).tell_the_truth(),
            21 => self.script(axis).silence = u32::from(input.byte()) % 16,
            22 => self.weather(axis, input),
            23 => self.say_again(axis, input),
            24 => self.stranger(axis, input),
            25 => {
                let eighths = u64::from(input.byte() % 64);
                self.sim.world().delay_next_wake(eighths * self.period_ns / 8);
            }
            26 => {
                let plugged = input.flag();
                let world = self.sim.world();
                if plugged {
                    world.plug(address(axis))
                } else {
                    world.unplug(address(axis))
                };
            }
            27 if what & 0x20 != 0 => {
                let ns = u64::from(input.byte()) * self.period_ns;
                self.sim.world().open_sto(address(axis), ns);
            }
            27 => drop(self.sim.world().restart(address(axis))),
            28 => self.script(axis).provoke = Some(ErrorCode(input.word() & 0xFF)),
            29 => {
                self.wire.lock().unwrap().jammed[axis] ^= true;
                self.was_jammed = true;
            }
            30 => {
                let mut task = self.task.lock().unwrap();
                for _ in 0..=input.below(4) {
                    match input.flag() {
                        true => task.commands.push_back((axis, command(input))),
                        false => task.rows.push_back((axis, row(input))),
                    }
                }
            }
            _ => self.stop(),
        }
    }

    fn post(&mut self, axis: usize, command: Command) {
        if !self.ended
            && let Ok(id) = self.sim.axis(axis).post(command)
        {
            self.watches[axis].accepted(id.0, command);
        }
    }

    /// Commands what the axis needs next to be ready for motions, and lets it have its time.
    fn lead(&mut self, axis: usize) {
        for _ in 0..4 {
            let feedback = self.sim.feedback(axis);
            let command = match feedback.stopped {
                Some(_) if feedback.status.fault != 0 => Command::ResetFault,
                Some(_) => Command::Reset,
                None if !feedback.is_operational() => Command::Enable,
                None if !feedback.status.homed => Command::Home,
                None => return,
            };
            let ended = self.watches[axis].ended;
            self.post(axis, command);
            let most = self.turns + 60;
            while self.turns < most && self.watches[axis].ended == ended && !self.ended {
                self.turn();
            }
        }
    }

    /// Rows as an application makes them: from where the axis is, straight on.
    fn stream(&mut self, axis: usize, input: &mut Input<'_>) {
        let begin = self.sim.feedback(axis).status.demand;
        let velocity = f64::from(input.byte() as i8);
        let seconds = self.period_ns as f64 * f64::from(self.drives[axis].axis.divisor) * 1e-9;
        let count = input.below(33);
        for n in 1..=count {
            let position = begin + velocity * seconds * n as f64;
            let row = Row { position, velocity, acceleration: 0.0, last: n == 32 };
            if self.sim.axis(axis).push_row(row).is_err() {
                break;
            }
        }
    }

    fn weather(&mut self, axis: usize, input: &mut Input<'_>) {
        let clear = FaultPlan { seed: u64::from(input.byte()), ..FaultPlan::default() };
        let period_ns = self.period_ns;
        let plan = match input.below(9) {
            0 => clear,
            1 => FaultPlan { drop: 0.3, ..clear },
            2 => FaultPlan { duplicate: 1.0, ..clear },
            3 => FaultPlan { corrupt: 0.2, ..clear },
            4 => FaultPlan { reorder: 0.5, ..clear },
            5 => FaultPlan { wrong_id: 0.5, ..clear },
            6 => FaultPlan { delay: 0.5, delay_ns: period_ns - 30 * US, ..clear },
            7 => FaultPlan { answer_ns: period_ns * 3 / 5, ..clear },
            _ => FaultPlan { answer_ns: period_ns - 25 * US + u64::from(input.byte()) * 32 * US, ..clear },
        };
        self.sim.world().set_faults(address(axis), plan);
    }

    /// An earlier reply comes once more.
    fn say_again(&mut self, axis: usize, input: &mut Input<'_>) {
        let (which, after) = (input.below(16), u64::from(input.byte()) * self.period_ns / 64);
        let reply = self.script(axis).said.get(which).cloned();
        if let Some(reply) = reply {
            self.inject(address(axis), &reply, after);
        }
    }

    /// Anything from anywhere.
    fn stranger(&mut self, axis: usize, input: &mut Input<'_>) {
        let own = address(axis);
        let from = match input.below(3) {
            0 => own,
            1 => SocketAddrV4::new(*own.ip(), own.port() ^ 1),
            _ => SocketAddrV4::new(Ipv4Addr::new(10, 0, 9, 9), own.port()),
        };
        let (after, length) = (u64::from(input.byte()) * self.period_ns / 64, input.below(200));
        let bytes = input.bytes(length);
        self.inject(from, bytes, after);
    }

    fn inject(&self, from: SocketAddrV4, bytes: &[u8], after_ns: u64) {
        let world = self.sim.world();
        let bind = LinUdpPlan::new(MASTER, Vec::new()).bind;
        world.inject(bind, from, bytes, world.now() + after_ns);
    }

    fn stop(&mut self) {
        self.asked_at.get_or_insert(self.turns);
        self.sim.stop();
    }

    fn run(&mut self, turns: u64) {
        for _ in 0..turns {
            self.turn();
        }
    }

    /// One turn of the loop, and all that has to hold behind it.
    fn turn(&mut self) {
        if self.ended {
            return;
        }
        self.turns += 1;
        self.wire.lock().unwrap().clear();
        let before = *self.sim.status();
        self.ended = self.sim.step() == Flow::End;

        let status = *self.sim.status();
        assert_eq!(status.planned, status.executed + status.skipped, "{status:?}");
        let wire = self.wire.lock().unwrap();
        for requested in &wire.requested {
            self.watches[requested.axis].requested(requested);
        }
        for (axis, id, command) in self.task.lock().unwrap().accepted.drain(..) {
            self.watches[axis].accepted(id, command);
        }
        for (axis, watch) in self.watches.iter_mut().enumerate() {
            if status.lost_events > 0 {
                watch.lost_events();
            }
            while let Some(event) = self.sim.axis(axis).event() {
                watch.event(event, status.executed);
            }
            let came: Vec<_> =
                wire.came.iter().filter(|came| came.from.ip() == address(axis).ip()).cloned().collect();
            watch.datagrams(came.len());
            if status.executed > before.executed {
                let own: Vec<_> = came.into_iter().filter(|came| came.from == address(axis)).collect();
                // A stop for an overrun comes behind the feedback of its turn.
                let whole = status.skipped == before.skipped;
                watch.feedback(self.sim.feedback(axis), &own, whole);
            }
        }
        for one in &self.watches {
            for other in &self.watches {
                one.check_group(other, status.executed);
            }
        }
        let known = |ip| (0..self.drives.len()).any(|axis| *address(axis).ip() == ip);
        self.unmatched += wire.came.iter().filter(|came| !known(*came.from.ip())).count() as u64;
    }

    /// The orderly end, within its bound, and the books of the whole run.
    fn finish(mut self) {
        if self.asked_at.is_none() {
            self.stop();
        }
        let most = LONGEST_END.as_nanos() as u64 / self.period_ns + END_TURNS;
        while !self.ended {
            self.turn();
            let since = self.turns - self.asked_at.unwrap();
            assert!(since <= most, "no end within {most} turns: {:?}", self.sim.feedback(0));
        }
        let lost = self.sim.status().lost_events;
        // Power off is ordered so long before the end, if the drive does not answer to it.
        let since = self.sim.world().now() - STOP_TIMEOUT.as_nanos() as u64 / 2;
        let end = self.sim.finish();
        let refused = self.wire.lock().unwrap().refused.clone();
        let mut missed = 0;
        for ((watch, drive), refused) in self.watches.iter().zip(&end.drives).zip(refused) {
            watch.end(drive, refused);
            missed += drive.counters.missed;
        }
        assert_eq!(end.status.missed, missed);
        assert_eq!(end.status.planned, end.status.executed + end.status.skipped);
        assert_eq!(end.buses[0].1.datagrams, self.unmatched);
        let (accepted, ended) =
            self.watches.iter().fold((0, 0), |sum, watch| (sum.0 + watch.accepted, sum.1 + watch.ended));
        assert!(accepted <= ended + lost, "{accepted} accepted, {ended} ended, {lost} events lost");
        // Where requests could not leave in time, the power off may have had its time before it was said.
        let in_time = end.status.skipped == 0 && !self.was_jammed;
        for (watch, drive) in self.watches.iter().zip(&self.drives) {
            let may_hold = drive.axis.stop.on_timeout == StopTimeout::Hold;
            assert!(may_hold || !in_time || !watch.is_left_on(since), "left on: {watch:?}");
        }
    }
}
