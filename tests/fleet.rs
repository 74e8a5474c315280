//! A fleet in bad weather: hundreds of drives, every fault on every wire, an application that never gives up. It holds
//! what it has to hold in every cycle, and the same seed is the same run to the last byte.
//!
//! The big one is marked ignored: it is meant for a release build, and prints how fast the simulation is. It lasts an
//! hour, or `FLEET_MINUTES`.

#[path = "support/forward.rs"]
mod forward;

use std::fmt::Write;
use std::hash::{DefaultHasher, Hasher};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use fastrand::Rng;
use fieldbeat::axis::{
    Command, Event, EventKind, Feedback, FoundRunning, Jog, Limits, Link, Move, Outcome, Profile, Row,
    StopCause, StopHow, StopPlan, StopThen, Target, Underrun,
};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethernet_ip::{EthernetIpPlan, MoonsDrive};
use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan, MonitorPlan, ReplyTag, StreamCommand};
use fieldbeat::bus::profibus::{LenzeDrive, ProfibusPlan};
use fieldbeat::sim::{Carrier, FaultPlan, SimBus, SimDrive, Simulated, WorldOptions};
use fieldbeat::telemetry::{Counters, Numbers, Status};
use fieldbeat::time::{MS, S, Time, US};
use fieldbeat::{CyclePlan, Flow, Master, Overrun, Plan, Simulation};
use fieldbeat_core::bus::Grid;
use fieldbeat_sim::ethernet_ip::{ClockSettings, MoonsSettings, MoonsSim};
use fieldbeat_sim::linudp::{LinMotSettings, LinMots};
use fieldbeat_sim::profibus::ProfibusSegment;
use nix::time::{ClockId, clock_gettime};

/// 256 LinUDP drives on one socket need a few milliseconds (a send on loopback takes 3.5 to 5 us).
const PERIOD_NS: u64 = 4 * MS;

/// Cycles.
const MINUTE: u64 = 60 * S / PERIOD_NS;
/// Where another seed is another run already.
const EARLY: u64 = MINUTE / 10;

/// Latched and connected for so many cycles, an axis has braked, whatever it did.
const BRAKED_AFTER: u32 = 100;

/// Everything that can befall a wire. A flipped bit may tell a drive anything, and nothing can be promised of it then;
/// every fourth has such a wire.
fn weather(seed: u64, flips: bool) -> FaultPlan {
    FaultPlan {
        seed,
        drop: 0.003,
        duplicate: 0.003,
        corrupt: if flips { 0.000_1 } else { 0.0 },
        delay: 0.003,
        delay_ns: 3 * MS + 500 * US,
        reorder: 0.001,
        stall: 0.000_01,
        stall_ns: 60 * MS,
        restart: 0.000_005,
        sto: 0.000_005,
        sto_ns: 300 * MS,
        wrong_id: 0.001,
        split: 0.0,
        cut: 0.0,
        segment_loss: 0.0,
        lost_byte: 0.0,
        answer_ns: 30 * US,
    }
}

fn flips(index: usize) -> bool {
    index % 4 == 3
}

/// Drives of every kind of plan.
fn drive(index: usize) -> LinUdpDrive {
    let [high, low] = (index as u16).to_be_bytes();
    let mut drive = LinUdpDrive::new(format!("x{index}"), Ipv4Addr::new(10, 1, high, low));
    let axis = &mut drive.axis;
    axis.limits = Limits {
        position: Some((0.0, 200.0)),
        velocity: Some(1_000.0),
        acceleration: Some(20_000.0),
        ..Limits::default()
    };
    axis.profile = Profile { velocity: 200.0, acceleration: 5_000.0, deceleration: 5_000.0 };
    axis.stop = StopPlan {
        how: [StopHow::Ramp, StopHow::Quick, StopHow::Ramp, StopHow::Coast][index / 4 % 4],
        then: [StopThen::Disable, StopThen::Hold][index / 2 % 2],
        deceleration: 5_000.0,
        // Every second four stop together.
        group: (index / 4).is_multiple_of(2).then_some(index as u16 / 4),
        ..axis.stop
    };
    axis.underrun = [Underrun::Stop, Underrun::Hold, Underrun::Extrapolate(3)][index % 3];
    axis.on_found_running = [FoundRunning::Stop, FoundRunning::Refuse][usize::from(index.is_multiple_of(5))];
    axis.stream_queue = 64;
    // Some jogs are let go of, the others run until something replaces them.
    axis.jog_deadman = [None, Some(Duration::from_millis(200))][usize::from(index.is_multiple_of(8))];
    drive.leash = Some(20.0);
    drive.reply_tag = ReplyTag::WORDS[index % 3].1;
    drive.monitor = if index.is_multiple_of(7) { MonitorPlan::AsSet } else { MonitorPlan::Off };
    drive.stream = Some([StreamCommand::Pva, StreamCommand::PvConfigured][index % 2]);
    drive
}

/// How it is simulated.
fn simulated(index: usize, seed: u64, drive: &LinUdpDrive) -> LinMotSettings {
    LinMotSettings {
        faults: weather(seed * 1_000 + index as u64, flips(index)),
        start_position: 100_000,
        range: (-50_000, 2_050_000),
        stream_period_ns: PERIOD_NS,
        start_running: index.is_multiple_of(6),
        ..LinMotSettings::new(drive.address)
    }
}

fn fleet(drives: usize, seed: u64) -> Simulation {
    let drives: Vec<_> = (0..drives).map(drive).collect();
    let simulation = drives.iter().enumerate().map(|(index, drive)| simulated(index, seed, drive)).collect();
    let cycle =
        CyclePlan { period_ns: PERIOD_NS, overrun: Overrun::Skip { max_skip: 3 }, ..CyclePlan::default() };
    let bus = LinUdpPlan::new(Ipv4Addr::new(10, 0, 0, 1), drives);
    let plan = Plan { source: None, cycle, buses: vec![Box::new(bus)], groups: Vec::new() };
    let options = WorldOptions { seed, wake_ns: 50 * US, ..WorldOptions::default() };
    let setup = Master::from_plan(plan).with_simulation(LinMots(simulation));
    setup.simulate(options).expect("the fleet can be built")
}

/// What the application knows of one axis.
struct Axis {
    random: Rng,
    posted: u64,
    /// Commands without an end.
    open: Vec<u64>,
    enabled: bool,
    /// Rows of the stream that are still to be pushed.
    rows: u32,
    next: Row,
    /// For so many cycles it has been latched and connected.
    latched: u32,
    /// Motions that came to their end.
    done: u64,
}

impl Axis {
    fn new(seed: u64) -> Axis {
        Axis {
            random: Rng::with_seed(seed),
            posted: 0,
            open: Vec::new(),
            enabled: false,
            rows: 0,
            next: Row::default(),
            latched: 0,
            done: 0,
        }
    }

    fn saw(&mut self, event: &Event) -> Result<(), String> {
        match event.kind {
            EventKind::Ended { id, command, outcome } => {
                let place = self.open.iter().position(|open| *open == id.0);
                let place =
                    place.ok_or_else(|| format!("{event}, though it had ended or was never posted"))?;
                self.open.swap_remove(place);
                self.enabled |= command == Command::Enable.name() && outcome == Outcome::Done;
                self.done +=
                    u64::from(["move", "follow", "home"].contains(&command) && outcome == Outcome::Done);
            }
            EventKind::Stopped(_) => (self.enabled, self.rows) = (false, 0),
            _ => {}
        }
        Ok(())
    }

    /// What always holds.
    fn check(&mut self, feedback: &Feedback) -> Result<(), String> {
        // What was found running and is refused was never ours to stop.
        let ours = feedback.stopped.is_some_and(|cause| cause != StopCause::FoundRunning);
        let latched = ours && feedback.link == Link::Online;
        self.latched = if latched { self.latched + 1 } else { 0 };
        match feedback.status.moving && self.latched > BRAKED_AFTER {
            true => Err(format!("latched, and moves: {feedback:?}")),
            false => Ok(()),
        }
    }

    /// The commands of the application in this cycle, and the rows that it pushes.
    fn act(&mut self, axis: &mut fieldbeat::Axis, feedback: &Feedback) {
        if let Some(command) = self.wants(feedback)
            && let Ok(id) = axis.post(command)
        {
            self.posted += 1;
            assert_eq!(id.0, self.posted);
            self.open.push(id.0);
        }
        while self.rows > 0 && axis.stream_room() > 0 {
            self.rows -= 1;
            let row = Row { last: self.rows == 0, ..self.next };
            // Out of its range, or the axis has been stopped: whatever is left of the stream runs empty.
            if axis.push_row(row).is_err() {
                self.rows = 0;
            }
            self.next.position += self.next.velocity * PERIOD_NS as f64 * 1e-9;
        }
    }

    /// The next command of the application, if there is one.
    fn wants(&mut self, feedback: &Feedback) -> Option<Command> {
        if feedback.link != Link::Online {
            return None;
        }
        if !self.open.is_empty() {
            // Now and then it changes its mind.
            return (self.random.u16(..500) == 0).then(|| self.motion(feedback));
        }
        match feedback.stopped {
            _ if self.random.u8(..20) != 0 => None,
            // Not every application knows that its axis is stopped.
            Some(_) if self.random.u8(..3) == 0 => Some(self.motion(feedback)),
            Some(_) if feedback.status.fault != 0 => Some(Command::ResetFault),
            Some(_) => Some(Command::Reset),
            None if feedback.status.fault != 0 => Some(Command::ResetFault),
            None if !self.enabled => Some(Command::Enable),
            None if !feedback.status.homed => Some(Command::Home),
            None => Some(self.motion(feedback)),
        }
    }

    fn motion(&mut self, feedback: &Feedback) -> Command {
        let random = &mut self.random;
        let acceleration = random.f64() * 9_000.0 + 1_000.0;
        let velocity = random.f64() * 280.0 + 20.0;
        let profile = Profile { velocity, acceleration, deceleration: acceleration };
        match random.u8(..40) {
            0 => Command::Home,
            1 => Command::Disable,
            2 => Command::QuickStop,
            3 | 4 => Command::Stop { deceleration: None },
            5..12 => {
                Command::Jog(Jog { velocity: [-0.25, 0.25][random.usize(..2)] * velocity, acceleration })
            }
            12..20 => {
                let velocity = if feedback.status.demand > 100.0 { -velocity / 4.0 } else { velocity / 4.0 };
                self.rows = random.u32(20..400);
                self.next = Row { position: feedback.status.demand, velocity, ..Row::default() };
                Command::Follow
            }
            20..26 => Command::Move(Move { target: Target::Relative(random.f64() * 80.0 - 40.0), profile }),
            _ => Command::Move(Move { target: Target::Absolute(random.f64() * 200.0), profile }),
        }
    }
}

/// What is left of a run: the same seed leaves the same.
#[derive(Debug, PartialEq)]
struct Left {
    /// Digest of all that was delivered until [`EARLY`].
    early: u64,
    /// How things stood when the other run ended.
    then: Standing,
    last: Standing,
    end: Numbers,
}

/// How a run stands.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Standing {
    /// Of all that was delivered.
    digest: u64,
    delivered: u64,
    /// How many events there were, and a hash of them.
    events: (u64, u64),
    /// Moves, streams and homings that were done.
    done: u64,
    status: Status,
}

/// Lets a fleet live for so many cycles and shuts it down; `then`: the cycle in which it is looked at besides.
fn live(drives: usize, seed: u64, cycles: u64, then: u64) -> Left {
    let mut sim = fleet(drives, seed);
    let mut random = Rng::with_seed(seed);
    let mut axes: Vec<_> = (0..drives).map(|_| Axis::new(random.u64(..))).collect();
    let (mut reported, mut hasher, mut line) = (0, DefaultHasher::new(), String::new());
    let mut stopping = false;
    let (mut early, mut stood, mut flow) = (None, None, Flow::Continue);
    let standing = |sim: &Simulation, reported, hasher: &DefaultHasher, axes: &[Axis]| Standing {
        digest: sim.world().digest(),
        delivered: sim.world().delivered(),
        events: (reported, hasher.finish()),
        done: axes.iter().map(|axis| axis.done).sum(),
        status: *sim.status(),
    };
    while flow == Flow::Continue {
        if random.u16(..5_000) == 0 {
            sim.world().delay_next_wake(random.u64(..6 * PERIOD_NS));
        }
        flow = sim.step();
        let status = *sim.status();
        assert_eq!(status.planned, status.executed + status.skipped, "seed {seed}: {status:?}");
        if status.planned >= EARLY {
            early.get_or_insert_with(|| sim.world().digest());
        }
        if status.planned >= then {
            stood.get_or_insert_with(|| standing(&sim, reported, &hasher, &axes));
        }
        let over = status.planned >= cycles;
        if over && !std::mem::replace(&mut stopping, over) {
            sim.stop();
        }
        for (index, axis) in axes.iter_mut().enumerate() {
            let wrong = |what| panic!("seed {seed}, cycle {}, axis {index}: {what}", status.planned);
            while let Some(event) = sim.axis(index).event() {
                axis.saw(&event).unwrap_or_else(wrong);
                reported += 1;
                line.clear();
                write!(line, "{index} {event:?}").expect("a string takes everything");
                hasher.write(line.as_bytes());
            }
            let feedback = sim.feedback(index);
            if !flips(index) {
                axis.check(&feedback).unwrap_or_else(wrong);
            }
            if !over {
                axis.act(sim.axis(index), &feedback);
            }
        }
    }
    for (index, axis) in axes.iter().enumerate() {
        assert!(axis.open.is_empty(), "seed {seed}, axis {index}: no end of {:?}", axis.open);
    }
    let samples: Vec<u64> = sim.measured().histograms.drives.iter().map(|drive| drive.rtt.len()).collect();
    assert_eq!(sim.measured().histograms.wake.len(), sim.status().planned, "seed {seed}");
    let last = standing(&sim, reported, &hasher, &axes);
    let end = sim.finish();
    assert_accounts(&end, &samples, seed);
    let long = "it was long enough";
    Left { early: early.expect(long), then: stood.expect(long), last, end }
}

/// Every exchange came to one end, and nothing was lost on the way to the application.
fn assert_accounts(end: &Numbers, samples: &[u64], seed: u64) {
    for (drive, samples) in end.drives.iter().zip(samples) {
        let c = drive.counters;
        // The last one may have been sent in the last cycle but one of a divisor.
        assert_eq!(c.sent, c.answered + c.missed, "seed {seed}, {}: {c:?}", drive.name);
        assert!(
            c.suspect <= c.answered && *samples <= c.answered - c.suspect,
            "seed {seed}, {}: {c:?}",
            drive.name
        );
        assert!(
            !drive.feedback.status.state.is_powered() || drive.feedback.link != Link::Online,
            "seed {seed}: {drive:?}"
        );
    }
    let missed: u64 = end.drives.iter().map(|drive| drive.counters.missed + drive.counters.unsent).sum();
    assert_eq!(end.status.missed, missed, "seed {seed}");
    assert_eq!((end.status.lost_events, end.status.lost_records), (0, 0), "seed {seed}");
}

/// A run, and the processor time that it took: on a shared machine the only time that means something.
fn timed(drives: usize, cycles: u64, then: u64) -> (Left, Duration) {
    let clock =
        || Duration::from(clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).expect("every Linux has it"));
    let begun = clock();
    (live(drives, 1, cycles, then), clock() - begun)
}

/// The same seed twice at once, the second time for `again` cycles, and another seed; says what came of it, and how
/// fast.
fn twice(drives: usize, cycles: u64, again: u64) -> Left {
    let begun = Instant::now();
    let ((first, took), (second, also)) = std::thread::scope(|scope| {
        let second = scope.spawn(|| timed(drives, again, again));
        let first = timed(drives, cycles, again);
        (first, second.join().expect("the same run fails in the same way"))
    });
    let wall = begun.elapsed();
    assert_eq!(first.then, second.then);
    assert!(cycles != again || first == second, "{first:?} {second:?}");
    let other = live(drives, 2, EARLY, EARLY);
    assert_ne!(first.early, other.early, "another seed is another run");

    let status = first.end.status;
    let mut sum = Counters::default();
    for one in first.end.drives.iter().map(|drive| drive.counters) {
        sum.sent += one.sent;
        sum.answered += one.answered;
        sum.missed += one.missed;
        sum.late += one.late;
        sum.duplicate += one.duplicate;
        sum.suspect += one.suspect;
        sum.malformed += one.malformed;
        sum.foreign += one.foreign;
    }
    println!(
        "{drives} drives, {} cycles of {} ms, {} skipped",
        status.planned,
        PERIOD_NS / MS,
        status.skipped
    );
    println!("{sum:?}, lost links: {}", first.end.drives.iter().map(|drive| drive.losses).sum::<u64>());
    let last = first.last;
    println!("{} datagrams, {} events, {} motions done", last.delivered, last.events.0, last.done);
    println!("digest {:016x}", last.digest);
    for (what, planned, took) in [
        ("processor time", status.planned, took),
        ("processor time", second.end.status.planned, also),
        ("wall time, both at once", status.planned, wall),
    ] {
        let seconds = took.as_secs_f64();
        println!(
            "{seconds:.1} s {what}: {:.2} million drive-cycles a second, {:.1} times real time",
            (planned * drives as u64) as f64 * 1e-6 / seconds,
            (planned * PERIOD_NS) as f64 * 1e-9 / seconds
        );
    }
    first
}

#[test]
fn sixteen_drives_for_a_minute_twice() {
    let left = twice(16, MINUTE, MINUTE);
    assert!(left.last.done > 500, "{} motions", left.last.done);
}

/// How long the big ones last.
#[cfg(not(debug_assertions))]
fn minutes() -> u64 {
    let named = std::env::var("FLEET_MINUTES").ok();
    named.map_or(60, |minutes| minutes.parse().expect("FLEET_MINUTES is a number"))
}

/// What makes two runs of a seed differ (an address, a hash, a thread, the clock of this computer) is there from the
/// first cycle on: ten minutes of 256 drives have some thirty million datagrams to show it in.
#[test]
#[cfg(not(debug_assertions))]
#[ignore = "an hour of 256 drives, and ten minutes of it again: minutes, and only in a release build"]
fn a_fleet_for_an_hour_and_a_sixth_of_it_again() {
    let minutes = minutes();
    let left = twice(256, minutes * MINUTE, minutes * MINUTE / 6);
    assert!(left.last.done > 200_000 * minutes / 60, "{} motions", left.last.done);
}

/// A MOONS' drive, and when its last packet left.
struct Noted(MoonsSim, Arc<AtomicU64>);

impl SimDrive for Noted {
    crate::forward_sim_drive!(0);
    crate::forward! { this => this.0;
        fn more_sockets(&self) -> Vec<(Carrier, SocketAddrV4)>;
        fn next_due(&self) -> Option<Time>;
        fn receive(&mut self, now: Time, from: SocketAddrV4, bytes: &[u8], reply: &mut Vec<u8>)
            -> Option<SocketAddrV4>;
        fn receive_at(
            &mut self, at: usize, now: Time, from: SocketAddrV4, bytes: &[u8], reply: &mut Vec<u8>
        ) -> Option<SocketAddrV4>;
        fn restart(&mut self, now: Time);
    }

    fn run(&mut self, now: Time, send: &mut dyn FnMut(usize, SocketAddrV4, &[u8])) {
        let Noted(drive, sent) = self;
        drive.run(now, &mut |socket, to, bytes| {
            sent.store(now.0, Ordering::Relaxed);
            send(socket, to, bytes);
        });
    }
}

/// MOONS' drives with clocks of their own, too fast and too slow, whose packets are late now and then: what the loop
/// sends does not drift and comes in no burst, nothing is missed, and feedback is as old as the clocks make it.
fn clocks(drives: usize, cycles: u64) {
    let drive = |index: usize| {
        let mut drive = MoonsDrive::new(format!("m{index}"), Ipv4Addr::new(10, 2, 0, 2 + index as u8));
        drive.axis.jog_deadman = None;
        drive
    };
    let bus = EthernetIpPlan::new(Ipv4Addr::new(10, 2, 0, 1), (0..drives).map(drive).collect());
    let sent: Vec<_> = (0..drives).map(|_| Arc::new(AtomicU64::new(0))).collect();
    let of = |(index, drive): (usize, &MoonsDrive)| {
        let mut settings = MoonsSettings::of(drive);
        let drift_ppm = index as i32 * 200 / drives as i32 - 100;
        settings.clock = ClockSettings { drift_ppm, jitter_ns: 500 * US, seed: index as u64 };
        Box::new(Noted(MoonsSim::new(settings), Arc::clone(&sent[index]))) as Box<dyn SimDrive>
    };
    let simulated: Vec<_> = bus.drives.iter().enumerate().map(of).collect();
    let cycle = CyclePlan { period_ns: PERIOD_NS, ..CyclePlan::default() };
    let plan = Plan { source: None, cycle, buses: vec![Box::new(bus)], groups: Vec::new() };
    let setup = Master::from_plan(plan).simulate_with(simulated, WorldOptions::default());
    let mut sim = setup.expect("the drives can be built");
    assert!(sim.run_until(10_000, |sim| (0..drives).all(|index| sim.feedback(index).link == Link::Online)));
    for index in 0..drives {
        sim.axis(index).post(Command::Enable).expect("there is room");
    }
    let is_on = |sim: &Simulation| (0..drives).all(|index| sim.feedback(index).is_operational());
    assert!(sim.run_until(1_000, is_on));
    for index in 0..drives {
        sim.axis(index).jog(0.25).expect("there is room");
    }
    let opened = sim.status().planned;
    // From the packet of the drive to the cycle that publishes it.
    let mut ages = Vec::new();
    for turn in 0..cycles {
        sim.step();
        let index = turn as usize % drives;
        ages.push(sim.world().now().since(Time(sent[index].load(Ordering::Relaxed))));
    }
    let steps = 0.25 * (cycles * PERIOD_NS) as f64 * 1e-9;
    let positions: Vec<_> = (0..drives).map(|index| sim.feedback(index).status.position).collect();
    let end = sim.finish();
    let status = end.status;
    assert_eq!((status.planned, status.skipped), (status.executed, 0));
    for (drive, position) in end.drives.iter().zip(positions) {
        let c = drive.counters;
        assert_eq!((drive.losses, c.missed, c.sent - c.answered), (0, 0, 0), "{drive:?}");
        assert_eq!((c.late, c.duplicate, c.malformed, c.foreign), (0, 0, 0, 0), "{drive:?}");
        // One in each slot since its connection was opened.
        assert!(c.sent <= status.planned && c.sent >= status.planned - opened, "{drive:?} {status:?}");
        assert!((position / steps - 1.0).abs() < 0.01, "{position} instead of {steps}");
    }
    ages.sort_unstable();
    let (p50, most) = (ages[ages.len() / 2], ages[ages.len() - 1]);
    println!("{drives} drives, {} cycles: age of feedback p50 {p50} ns, at most {most} ns", status.planned);
    assert!(p50 <= PERIOD_NS / 2 + PERIOD_NS && p50 > PERIOD_NS / 4, "{p50}");
    assert!(most <= 2 * PERIOD_NS, "{most}");
}

#[test]
fn thirty_two_clocks_for_a_minute() {
    clocks(32, MINUTE);
}

#[test]
#[cfg(not(debug_assertions))]
#[ignore = "an hour of 32 drives: a minute, and only in a release build"]
fn thirty_two_clocks_for_an_hour() {
    clocks(32, minutes() * MINUTE);
}

/// A whole segment of Lenze drives at 1.5 Mbit/s in turn, and LinMots in every cycle of the same loop: every slot is
/// executed, and each drive gets requests in its own ones and answers.
#[test]
fn a_segment_of_thirty_one_drives_next_to_thirty_two_linmots() {
    const CYCLES: u64 = 20_000;
    let lenze = |index: u8| {
        let mut drive = LenzeDrive::new(format!("l{index}"), 3 + index);
        drive.axis.limits.velocity = Some(20.0);
        drive.axis.jog_deadman = None;
        drive.watchdog.timeout_ns = Some(S);
        drive
    };
    let grid = Grid { period_ns: MS, deadline_ns: MS / 2 };
    let wire = ProfibusPlan::new("/dev/ttyS1", 1_500_000, (0..31).map(lenze).collect());
    let divisor = wire.least_divisor(grid).expect("they fit");
    let wire = wire.in_turn(divisor);
    assert!(wire.turn_faults(grid).is_empty() && wire.faults(MS).is_empty());
    let linmot = |index: u8| {
        let mut drive = LinUdpDrive::new(format!("x{index}"), Ipv4Addr::new(10, 1, 0, 2 + index));
        drive.axis.limits.position = Some((0.0, 200.0));
        drive
    };
    let linmots = LinUdpPlan::new(Ipv4Addr::new(10, 1, 0, 1), (0..32).map(linmot).collect());
    let mut simulated = Simulated::default();
    LinMots::of(&linmots).build(&mut simulated);
    ProfibusSegment::of(&wire).build(&mut simulated);
    let cycle = CyclePlan { period_ns: MS, ..CyclePlan::default() };
    let buses: Vec<Box<dyn BusPlan>> = vec![Box::new(linmots), Box::new(wire)];
    let plan = Plan { source: None, cycle, buses, groups: Vec::new() };
    let mut sim =
        Master::from_plan(plan).simulate_with(simulated, WorldOptions::default()).expect("it is whole");
    let all = 0..63;
    assert!(sim.run_until(60_000, |sim| all.clone().all(|index| sim.feedback(index).link == Link::Online)));
    for index in all.clone() {
        sim.axis(index).post(Command::Enable).expect("there is room");
    }
    assert!(sim.run_until(20_000, |sim| all.clone().all(|index| sim.feedback(index).is_operational())));
    for index in 32..63 {
        sim.axis(index).jog(4.0).expect("there is room");
    }
    sim.run(CYCLES);
    for index in 32..63 {
        let velocity = sim.feedback(index).status.velocity;
        assert!((velocity - 4.0).abs() < 0.1, "{index}: {velocity}");
    }
    let end = sim.finish();
    let status = end.status;
    assert_eq!((status.planned, status.skipped), (status.executed, 0));
    for (index, drive) in end.drives.iter().enumerate() {
        let c = drive.counters;
        assert_eq!((drive.losses, c.missed, c.late, c.malformed), (0, 0, 0, 0), "{drive:?}");
        let every = if index < 32 { 1 } else { u64::from(divisor) };
        assert!(c.sent >= CYCLES / every && c.sent - c.answered <= 1, "{every}: {drive:?}");
    }
    println!("{} cycles, each Lenze drive in each {divisor}th", status.planned);
}
