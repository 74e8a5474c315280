//! One bus alone, with its drives in a virtual world: a clause plays the loop by hand, and every call is refereed.

use std::collections::VecDeque;
use std::f64::consts::TAU;
use std::net::SocketAddrV4;

use fieldbeat::Cycle;
use fieldbeat::axis::{Command, Failure, Jog, Link, Move, NativeOwner, Profile, Row, State, Target};
use fieldbeat::bus::BusPlan;
use fieldbeat::sim::{FaultPlan, World, WorldOptions};
use fieldbeat::telemetry::Unmatched;
use fieldbeat::time::{MS, Time, US};
use fieldbeat_core::bus::{Bus, DriveFacts, Ends, Exchange, Grid, Opened, ReplyWithin, Slot, Waits};
use fieldbeat_core::drive::machine::{Machine, NumberedRow};
use fieldbeat_core::rt::{Clock, PollSet};
use fieldbeat_sim::world::WorldClock;

use crate::conformance::rules::{self, SlotChange};
use crate::conformance::subject::{Can, Drive, Said, Subject};
use crate::conformance::wire::Wire;

pub const PERIOD: u64 = MS;
/// The same, with the usual window.
pub const GRID: Grid = Grid { period_ns: PERIOD, deadline_ns: PERIOD / 2 };
/// Replies are taken in until here.
pub const WINDOW: u64 = 500 * US;
/// From one end of the wire to the other.
pub const LATENCY: u64 = 20 * US;
/// Good exchanges in a row that bring a link up, and misses in a row that lose it, as the loop's defaults.
const GATE: u32 = 10;
const BUCKET: u32 = 5;
/// The most readings of the clock in one call of a bus.
const READINGS: u64 = 64;
/// Cycles of the pause before a connection is opened anew that are skipped in one go: a multiple of every divisor.
const SKIPPED: u64 = 120;
/// The longest that any order takes here, cycles.
const LONG: u64 = 20_000;

/// What the last cycle brought to one drive, as the loop found it when it judged.
#[derive(Clone, Copy, Debug)]
pub struct Seen {
    /// `Idle`: nothing was closed in this cycle.
    pub exchange: Exchange,
    pub fresh: bool,
    pub suspect: bool,
    pub restarted: bool,
}

impl Seen {
    pub fn answered(&self) -> bool {
        matches!(self.exchange, Exchange::Answered { .. } | Exchange::OwnClock { .. })
    }

    pub fn missed(&self) -> bool {
        self.exchange == Exchange::Missed
    }

    /// Answered, and a round-trip sample: the time from the send to the taking in, ns.
    pub fn round_trip(&self) -> Option<u64> {
        match self.exchange {
            Exchange::Answered { sent_at, at, suspect: false } => Some(at.since(sent_at)),
            _ => None,
        }
    }
}

pub struct Line {
    pub can: Can,
    pub drives: Vec<Drive>,
    pub wire: Wire,
    pub world: World,
    pub bus: Box<dyn Bus>,
    pub ends: Ends,
    pub slots: Vec<Slot>,
    /// What commands each drive.
    pub machines: Vec<Machine>,
    /// What the last cycle brought to each drive.
    pub seen: Vec<Seen>,
    /// Drives that are never due, whatever their schedule says.
    pub asleep: Vec<bool>,
    /// What a drive that follows is fed with, a row an exchange.
    pub rows: Vec<VecDeque<Row>>,
    /// The cycle that is next.
    pub index: u64,
    /// What reports say is held against what the drives said. Off where bits are flipped on the way.
    pub honest: bool,
    /// How often each request is built.
    pub builds: u32,
    clock: WorldClock,
    poll_set: PollSet,
    origin: Time,
    /// When the last two requests of each drive left.
    sent_at: Vec<[Time; 2]>,
    row_number: u64,
    /// The row given has not gone out yet: it must not be replaced.
    held: Vec<bool>,
    in_a_row: Vec<(u32, u32)>,
}

impl Line {
    /// So many drives as usual.
    pub fn new(subject: &'static dyn Subject, count: usize) -> Line {
        Line::with(subject, count, |_, _| {})
    }

    /// So many drives, each changed.
    pub fn with(subject: &'static dyn Subject, count: usize, change: impl Fn(usize, &mut Drive)) -> Line {
        let drives = drives(subject, count, change);
        let (wire, simulated) = Wire::new(subject, &drives);
        let options = WorldOptions { latency_ns: LATENCY, ..WorldOptions::default() };
        let world = World::new(simulated, options).expect("each drive has its own address");
        let Opened { bus, ends, .. } = wire.open(PERIOD, &world).expect("the bus can be opened");
        let facts = wire.facts(GRID).drives;
        let machine =
            |(drive, facts): (&Drive, DriveFacts)| Machine::new(&drive.axis, facts.capabilities, PERIOD);
        let machines = drives.iter().zip(facts).map(machine).collect();
        let idle = Seen { exchange: Exchange::Idle, fresh: false, suspect: false, restarted: false };
        Line {
            can: subject.can(),
            clock: world.clock(),
            origin: world.now() + 2 * PERIOD,
            world,
            wire,
            machines,
            bus,
            ends,
            slots: vec![Slot::default(); count],
            seen: vec![idle; count],
            asleep: vec![false; count],
            rows: vec![VecDeque::new(); count],
            index: 0,
            honest: true,
            builds: 1,
            poll_set: PollSet::default(),
            sent_at: vec![[Time(0); 2]; count],
            row_number: 0,
            held: vec![false; count],
            in_a_row: vec![(0, 0); count],
            drives,
        }
    }

    // The calls of a bus, refereed.

    /// The cycle that is next.
    pub fn cycle(&self) -> Cycle {
        let grid = self.origin + self.index * PERIOD;
        Cycle { index: self.index, grid, period_ns: PERIOD, deadline: grid + WINDOW }
    }

    /// Chooses who is due and what they follow, and has the requests built.
    pub fn prepare(&mut self) {
        let cycle = self.cycle();
        for index in 0..self.slots.len() {
            let (axis, slot) = (&self.drives[index].axis, &mut self.slots[index]);
            let scheduled = cycle.index % u64::from(axis.divisor) == u64::from(axis.phase);
            slot.due = scheduled && !self.asleep[index] && !matches!(slot.exchange, Exchange::Owed { .. });
            let machine = &mut self.machines[index];
            let following = slot.due && machine.command() == Some(Command::Follow) && !self.held[index];
            if following && let Some(row) = self.rows[index].pop_front() {
                self.row_number += 1;
                self.held[index] = true;
                machine.input.row = Some(NumberedRow { number: self.row_number, row });
            }
        }
        self.propose(&cycle);
        for _ in 0..self.builds {
            self.build(&cycle);
        }
    }

    /// What the drive machines want with the send of `cycle`.
    pub fn propose(&mut self, cycle: &Cycle) {
        for (machine, slot) in self.machines.iter_mut().zip(&mut self.slots) {
            if slot.due || slot.exchange == Exchange::Queued {
                machine.propose(cycle.grid, slot);
            }
        }
    }

    /// Has the requests built, for `cycle`.
    pub fn build(&mut self, cycle: &Cycle) {
        let (sends, before) = (self.wire.log().sends, self.slots.clone());
        let begin = self.world.now();
        self.bus.prepare(cycle, &mut self.slots);
        let span = (begin, self.world.now());
        assert_eq!(self.wire.log().sends, sends, "nothing is sent while preparing");
        assert!(span.1.since(span.0) <= self.readings(), "preparing does not wait");
        for (before, after) in before.iter().zip(&self.slots) {
            SlotChange { before, after, span }.prepare();
        }
    }

    /// Hands over what was built.
    pub fn send(&mut self) {
        let (cycle, before) = (self.cycle(), self.slots.clone());
        let begin = self.world.now();
        self.bus.send(&cycle, &mut self.slots);
        let span = (begin, self.world.now());
        assert!(span.1.since(span.0) <= self.readings(), "sending does not wait");
        for (before, after) in before.iter().zip(&self.slots) {
            SlotChange { before, after, span }.send(&cycle, &self.can);
        }
        self.note_sent(&before);
        self.accounts();
    }

    /// What has left since the slots were as `before`.
    fn note_sent(&mut self, before: &[Slot]) {
        for (index, (before, after)) in before.iter().zip(&self.slots).enumerate() {
            if let Some(sent_at) = after.exchange.sent_at()
                && before.exchange.sent_at() != Some(sent_at)
            {
                self.sent_at[index] = [self.sent_at[index][1], sent_at];
                self.held[index] = false;
            }
        }
        for (machine, slot) in self.machines.iter_mut().zip(&mut self.slots) {
            if let Some(grid) = slot.gone.grid.take() {
                machine.commit(grid);
            }
        }
    }

    /// The time has come at which the bus wants to be polled.
    fn poll(&mut self, now: Time) {
        let (cycle, before) = (self.cycle(), self.slots.clone());
        let (begin, sends) = (self.world.now(), self.wire.log().sends);
        self.bus.poll(&cycle, now, &mut self.slots);
        let span = (begin, self.world.now());
        assert!(span.1.since(span.0) <= self.readings(), "polling does not wait");
        for (before, after) in before.iter().zip(&self.slots) {
            SlotChange { before, after, span }.poll(&cycle, &self.can);
        }
        let left =
            self.slots.iter().zip(&before).filter(|(slot, b)| slot.counters.sent > b.counters.sent).count();
        assert!(left <= 1 && (left == 0 || self.wire.log().sends > sends), "one request at a time");
        assert!(self.bus.waits(&cycle, &self.slots).poll_at > now, "polled at {now}");
        self.note_sent(&before);
        self.accounts();
    }

    /// When the bus wants to be polled in this window.
    fn poll_at(&self) -> Option<Time> {
        let at = self.bus.waits(&self.cycle(), &self.slots).poll_at;
        assert!(at == Waits::NEVER || self.can.half_duplex, "nothing but a reply ends what it waits for");
        Some(at).filter(|at| *at < self.cycle().deadline)
    }

    /// Takes in what has come. True if the window has nothing more to wait for.
    pub fn receive(&mut self) -> bool {
        let (cycle, before) = (self.cycle(), self.slots.clone());
        let (begin, sends) = (self.world.now(), self.wire.log().sends);
        self.bus.receive(&cycle, &mut self.slots);
        let span = (begin, self.world.now());
        assert!(span.1.since(span.0) <= self.readings(), "receiving does not wait");
        assert_eq!(self.wire.log().sends, sends, "nothing is sent while receiving");
        for (before, after) in before.iter().zip(&self.slots) {
            SlotChange { before, after, span }.receive(&self.can);
        }
        self.accounts();
        !self.owes()
    }

    fn readings(&self) -> u64 {
        // A bus that stamps each request on its own reads once for each.
        (READINGS + self.slots.len() as u64) * WorldOptions::default().read_ns
    }

    /// Whether the window of the present cycle is to stay open.
    pub fn owes(&self) -> bool {
        let cycle = self.cycle();
        self.poll_at().is_some() || self.slots.iter().any(|slot| slot.exchange.is_waited_for(&cycle))
    }

    /// How long a packet of its first drive counts, ns; `None`: it has no clock of its own.
    pub fn fresh_within_ns(&self) -> Option<u64> {
        let reply = self.wire.facts(GRID).drives.first().map(|drive| drive.reply_within);
        if let Some(ReplyWithin::OwnClock(ns)) = reply { Some(ns) } else { None }
    }

    fn accounts(&self) {
        let log = self.wire.log();
        for (slot, tape) in self.slots.iter().zip(&log.drives) {
            rules::accounts(slot, tape, &self.can);
        }
        let Unmatched { datagrams, dropped, errors } = self.bus.numbers().unmatched;
        // Whose bytes are noise nobody can tell.
        let datagrams = if self.can.bytes { log.unmatched } else { datagrams };
        assert_eq!((datagrams, dropped, errors), (log.unmatched, 0, 0), "unmatched");
    }

    // The loop.

    /// One cycle.
    pub fn turn(&mut self) {
        self.prepare();
        self.clock.sleep_until(self.cycle().grid);
        self.send();
        self.window();
        self.judge();
    }

    /// Takes in until all is closed or the deadline has passed. As in the loop, a window that owes nothing is none.
    pub fn window(&mut self) {
        let deadline = self.cycle().deadline;
        let mut open = self.owes();
        while open {
            let (now, poll_at) = (self.clock.now(), self.poll_at());
            let over = now >= deadline;
            if !over && poll_at.is_some_and(|at| at <= now) {
                self.poll(now);
                open = self.owes();
                continue;
            }
            if !over {
                self.poll_set.fill([self.bus.fd()]);
                self.clock.wait(&mut self.poll_set, poll_at.unwrap_or(deadline));
            }
            open = !self.receive() && !over;
        }
    }

    /// What the loop makes of the cycle; then the next one is next.
    pub fn judge(&mut self) {
        let Cycle { grid, deadline, .. } = self.cycle();
        for index in 0..self.slots.len() {
            let slot = &mut self.slots[index];
            self.machines[index].observe(grid, slot.notices.restarted, slot);
            if self.honest && slot.notices.fresh && !slot.status.suspect {
                let tape = &self.wire.log().drives[index];
                // A packet of a drive with its own clock came since the request before the last one, and was a cycle
                // longer on its way at most, as what led to it was.
                let [before, last] = self.sent_at[index];
                let since = if self.can.own_clock { before - 2 * PERIOD } else { last };
                rules::honest(slot, tape, &self.drives[index], &self.can, since);
            }
            let (good, missed) = &mut self.in_a_row[index];
            let exchange = match slot.exchange {
                Exchange::Idle | Exchange::Missed => Exchange::Idle,
                Exchange::Owed { reply_by, .. } if reply_by > deadline => slot.exchange,
                Exchange::Queued => slot.exchange,
                closed @ Exchange::OwnClock { fresh_until, .. } if grid < fresh_until => {
                    slot.counters.answered += 1;
                    slot.exchange = Exchange::Idle;
                    (*good, *missed) = (*good + 1, 0);
                    closed
                }
                Exchange::Owed { .. } | Exchange::OwnClock { .. } | Exchange::Absent { .. } => {
                    slot.counters.missed += 1;
                    slot.exchange = Exchange::Missed;
                    (*good, *missed) = (0, *missed + 1);
                    Exchange::Missed
                }
                closed => {
                    let answered = closed != Exchange::Unsent;
                    (*good, *missed) = if answered { (*good + 1, 0) } else { (0, *missed + 1) };
                    slot.exchange = Exchange::Idle;
                    closed
                }
            };
            slot.link = match slot.link {
                Link::Unseen | Link::Lost if *good > 0 => Link::Qualifying,
                Link::Qualifying if *good >= GATE => Link::Online,
                Link::Qualifying if *missed > 0 => Link::Lost,
                Link::Online if *missed >= BUCKET => Link::Lost,
                same => same,
            };
            slot.notices.monitor_fresh = false;
            self.seen[index] = Seen {
                exchange,
                fresh: std::mem::take(&mut slot.notices.fresh),
                suspect: slot.status.suspect,
                restarted: std::mem::take(&mut slot.notices.restarted),
            };
        }
        self.accounts();
        self.index += 1;
    }

    pub fn turns(&mut self, count: u64) {
        for _ in 0..count {
            self.turn();
        }
    }

    /// Turns until `done`; fails after `most`.
    pub fn until(&mut self, what: &str, most: u64, mut done: impl FnMut(&Line) -> bool) -> u64 {
        for turn in 0..most {
            if done(self) {
                return turn;
            }
            self.turn();
        }
        panic!("not within {most} cycles: {what}; {:?}", self.slots);
    }

    /// Turns until nothing is owed and all drives are due next, where they share a schedule.
    pub fn settle(&mut self) {
        self.until("a cycle to begin with", 1_000, |line| {
            let owed = |slot: &Slot| matches!(slot.exchange, Exchange::Owed { .. } | Exchange::Queued);
            let due =
                |drive: &Drive| line.index % u64::from(drive.axis.divisor) == u64::from(drive.axis.phase);
            line.drives.iter().all(due) && !line.slots.iter().any(owed)
        });
        if self.can.own_clock {
            // No window was open for what has left.
            self.world.advance(2 * LATENCY);
        }
    }

    /// One cycle, and long enough after it for requests to be received.
    pub fn turn_and_hear(&mut self) {
        self.turn();
        // A telegram takes the time of its bits.
        self.world.advance(if self.can.bytes { 10 * LATENCY } else { 2 * LATENCY });
    }

    /// The drives have been seen; those on a line are in operation there.
    pub fn meet(&mut self) {
        if self.can.shared {
            self.online();
        }
        self.turns(40);
    }

    pub fn online(&mut self) {
        let most = match self.can {
            Can { sessions: true, .. } => 40_000,
            Can { shared: true, .. } => 8_000,
            _ => 1_000,
        };
        self.until("all online", most, |line| line.slots.iter().all(|slot| slot.link == Link::Online));
    }

    /// All online, in operation, and homed.
    pub fn ready(&mut self) {
        self.online();
        for command in [Command::Enable, Command::Home] {
            if command == Command::Home && !self.can.home {
                continue;
            }
            for index in 0..self.slots.len() {
                self.order(index, command);
            }
            for index in 0..self.slots.len() {
                assert_eq!(self.ended(index), Ok(()), "{command:?} of drive {index}");
            }
        }
    }

    /// A line of so many drives that are ready.
    pub fn made_ready(subject: &'static dyn Subject, count: usize) -> Line {
        let mut line = Line::new(subject, count);
        line.ready();
        line
    }

    // Orders.

    /// Gives an order.
    pub fn order(&mut self, index: usize, command: impl Into<Option<Command>>) {
        self.machines[index].start(self.world.now(), command.into());
        self.held[index] = false;
    }

    /// How the order that stands has ended.
    pub fn end(&self, index: usize) -> Option<Result<(), Failure>> {
        self.machines[index].end()
    }

    /// Turns until the order that stands has ended.
    pub fn ended(&mut self, index: usize) -> Result<(), Failure> {
        let what = format!("the end of {:?}", self.machines[index].command());
        self.until(&what, LONG, |line| line.end(index).is_some());
        self.end(index).expect("it has ended")
    }

    pub fn run(&mut self, index: usize, command: Command) -> Result<(), Failure> {
        self.order(index, command);
        self.ended(index)
    }

    pub fn done(&mut self, index: usize, command: Command) {
        assert_eq!(self.run(index, command), Ok(()), "{command:?} of drive {index}");
    }

    // Motions, in parts of the way that the profile's velocity makes in a second.

    pub fn profile(&self, index: usize) -> Profile {
        self.drives[index].axis.profile
    }

    pub fn way(&self, index: usize, seconds: f64) -> f64 {
        self.profile(index).velocity * seconds
    }

    pub fn by(&self, index: usize, seconds: f64) -> Command {
        by(&self.drives[index], seconds)
    }

    /// A motion of many seconds at the profile's velocity.
    pub fn go(&self, index: usize) -> Command {
        go(&self.can, &self.drives[index])
    }

    /// A motion of many seconds in which no two reports are the same.
    pub fn changing(&self, index: usize) -> Command {
        let Profile { velocity, .. } = self.profile(index);
        match self.can.positions {
            true => self.by(index, 20.0),
            // Position is one all the way, velocity only while it changes.
            false => Command::Jog(Jog { velocity: velocity * 5.0, acceleration: velocity * 0.5 }),
        }
    }

    /// A short motion, to its end.
    pub fn move_about(&mut self, index: usize) {
        if self.can.positions {
            return self.done(index, self.by(index, 0.05));
        }
        let velocity = self.way(index, 0.5);
        self.order(index, self.jog(index, 0.5));
        self.until("its velocity", 40_000, |line| near_velocity(line, index, velocity));
        self.done(index, Command::Stop { deceleration: None });
        assert!(!self.said(index).moving, "it ends at standstill");
    }

    /// So many cycles in which nothing moves the drive.
    pub fn stands(&mut self, index: usize, cycles: u64) {
        let at = self.slots[index].status.demand;
        for _ in 0..cycles {
            self.turn();
            let report = &self.slots[index].status;
            match self.can.positions {
                true => assert_eq!(report.demand, at, "it moves"),
                false => assert!(!report.moving && !self.said(index).moving, "it turns: {report:?}"),
            }
        }
    }

    pub fn jog(&self, index: usize, seconds: f64) -> Command {
        let acceleration = self.profile(index).acceleration;
        Command::Jog(Jog { velocity: self.way(index, seconds), acceleration })
    }

    /// Rows for so many exchanges, from where the drive stands to `seconds` of way beyond, gentle at both ends.
    pub fn stream(&mut self, index: usize, seconds: f64, count: u32) -> Vec<Row> {
        self.rows_of(index, seconds, count, |x| {
            let angle = x * TAU;
            (x - angle.sin() / TAU, 1.0 - angle.cos(), TAU * angle.sin())
        })
    }

    /// The same way at one speed up to the last row.
    pub fn straight(&mut self, index: usize, seconds: f64, count: u32) -> Vec<Row> {
        self.rows_of(index, seconds, count, |x| (x, 1.0, 0.0))
    }

    /// `shape`: way and its derivatives over the time, all of the way and of the time being 1.
    fn rows_of(
        &mut self,
        index: usize,
        seconds: f64,
        count: u32,
        shape: impl Fn(f64) -> (f64, f64, f64),
    ) -> Vec<Row> {
        let begin = if self.can.positions { self.slots[index].status.demand } else { 0.0 };
        let way = self.way(index, seconds);
        let all = f64::from(count) * (PERIOD * u64::from(self.drives[index].axis.divisor)) as f64 * 1e-9;
        let row = |n| {
            let (position, velocity, acceleration) = shape(f64::from(n) / f64::from(count));
            Row {
                position: begin + way * position,
                velocity: way * velocity / all,
                acceleration: way * acceleration / (all * all),
                last: n == count,
            }
        };
        let rows: Vec<Row> = (1..=count).map(row).collect();
        self.rows[index] = rows.iter().copied().collect();
        rows
    }

    /// Every way of being in motion that the subject knows.
    pub fn motions(&self) -> Vec<Motion> {
        let all = [
            (Motion::Move, self.can.positions),
            (Motion::Turn, !self.can.positions),
            (Motion::Jog, self.can.jog),
            (Motion::Follow, self.can.follow),
            (Motion::Home, self.can.home),
        ];
        all.into_iter().filter(|(_, can)| *can).map(|(motion, _)| motion).collect()
    }

    /// The plainest way of being in motion.
    pub fn motion(&self) -> Motion {
        if self.can.positions { Motion::Move } else { Motion::Turn }
    }

    /// Turns until the drive is in the middle of `motion`.
    pub fn set_going(&mut self, index: usize, motion: Motion) {
        if motion == Motion::Home {
            // Away from where the homing ends.
            match self.can.positions {
                true => self.done(index, self.by(index, 0.4)),
                false => self.move_about(index),
            }
        }
        let command = match motion {
            Motion::Move => self.by(index, 2.0),
            Motion::Turn => self.go(index),
            Motion::Jog => self.jog(index, 0.5),
            Motion::Follow => {
                self.stream(index, 0.1, 600);
                Command::Follow
            }
            Motion::Home => Command::Home,
        };
        self.order(index, command);
        self.until("a motion", LONG, |line| line.slots[index].status.moving);
        self.turns(50);
        assert!(self.said(index).moving && self.end(index).is_none(), "in the middle of {motion:?}");
    }

    // What befalls the wire.

    /// From here on the drive's wire has these faults.
    pub fn faults(&self, index: usize, plan: FaultPlan) {
        let usual = self.usual_answer_ns(index);
        let plan = FaultPlan { answer_ns: usual + plan.answer_ns, ..plan };
        self.wire.faults(&self.world, index, plan);
    }

    /// Pulls the drive's plug, or puts it in again.
    pub fn plug(&self, index: usize, plugged: bool) {
        self.wire.plug(&self.world, index, plugged);
    }

    /// Switches the drive off and on again.
    pub fn restart(&self, index: usize) {
        self.wire.restart(&self.world, index);
    }

    pub fn usual_answer_ns(&self, index: usize) -> u64 {
        self.wire.log().drives[index].usual.answer_ns
    }

    /// From here on a reply comes so long after the begin of the last window in which it counts. Below `WINDOW` it is
    /// in time, up to a period it comes between two windows, and beyond in the window of the next exchange.
    pub fn answer_at(&self, index: usize, ns: u64) {
        let answer_ns = u64::from(self.can.answers_after) * PERIOD + ns - 2 * LATENCY;
        let plan = FaultPlan { answer_ns, ..FaultPlan::default() };
        self.wire.faults(&self.world, index, plan);
    }

    /// From here on the drive answers as usual.
    pub fn answer_as_usual(&self, index: usize) {
        self.faults(index, FaultPlan::default());
    }

    /// What comes from `from`, as drive `index` sends it, reaches the bus so long after the begin of the next cycle.
    pub fn inject(&self, index: usize, from: SocketAddrV4, bytes: &[u8], ns: u64) {
        self.wire.inject(&self.world, index, from, bytes, self.cycle().grid + ns);
    }

    /// Another master sends this to drive `index`.
    pub fn meddle(&self, index: usize, bytes: Vec<u8>) {
        self.wire.log().drives[index].meddled = Some(bytes);
    }

    /// Turns until the drive answers again. A datagram does with the next exchange; a connection may have to be opened
    /// anew, after a pause and a handshake, and its first reply may not say all.
    pub fn heal(&mut self, index: usize) -> Seen {
        if !self.can.stream && !self.can.own_clock {
            return self.exchange(index);
        }
        for _ in 0..20_000 {
            let seen = self.seen[index];
            if seen.answered() && seen.fresh {
                return seen;
            }
            if self.can.stream && !self.wire.log().drives[index].open {
                self.skip();
            }
            self.turn();
        }
        panic!("no answer on a connection that was opened anew: {:?}", self.slots);
    }

    /// Skips cycles while nothing is owed: the pause before a connection is opened anew has hundreds of them, and they
    /// are all alike.
    fn skip(&mut self) {
        self.settle();
        self.index += SKIPPED;
    }

    /// Turns until the next exchange of this drive is closed.
    pub fn exchange(&mut self, index: usize) -> Seen {
        let open =
            |seen: &Seen| matches!(seen.exchange, Exchange::Idle | Exchange::Owed { .. } | Exchange::Queued);
        for _ in 0..1_000 {
            self.turn();
            if !open(&self.seen[index]) {
                return self.seen[index];
            }
        }
        panic!("drive {index} is not due");
    }

    pub fn mute(&self, index: usize, mute: bool) {
        self.wire.log().drives[index].mute = mute;
    }

    pub fn said(&self, index: usize) -> Said {
        self.wire.log().drives[index].said()
    }

    /// The last telegram with an answer of the drive, as it left.
    pub fn reply(&self, index: usize) -> Vec<u8> {
        let log = self.wire.log();
        if self.can.shared { log.frame.clone() } else { log.drives[index].reply() }
    }

    /// The number of requests that the drive has received.
    pub fn received(&self, index: usize) -> usize {
        self.wire.log().drives[index].received.len()
    }

    /// The requests that the drive has received, byte for byte.
    pub fn requests(&self, index: usize) -> Vec<Vec<u8>> {
        self.wire.log().drives[index].received.iter().map(|received| received.request.clone()).collect()
    }

    pub fn state(&self, index: usize) -> State {
        self.slots[index].status.state
    }
}

/// A way of being in motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Motion {
    Move,
    /// A jog at the profile's velocity, of a drive that takes no moves.
    Turn,
    Jog,
    Follow,
    Home,
}

/// Whether the drive reports this velocity.
pub fn near_velocity(line: &Line, index: usize, velocity: f64) -> bool {
    (line.slots[index].status.velocity - velocity).abs() < velocity.abs() * 0.02
}

/// A motion of many seconds at the velocity of the profile.
pub fn go(can: &Can, drive: &Drive) -> Command {
    let Profile { velocity, acceleration, .. } = drive.axis.profile;
    match can.positions {
        true => by(drive, 20.0),
        false => Command::Jog(Jog { velocity, acceleration }),
    }
}

/// A move by the way that the profile's velocity makes in so many seconds.
pub fn by(drive: &Drive, seconds: f64) -> Command {
    let profile = drive.axis.profile;
    Command::Move(Move { target: Target::Relative(profile.velocity * seconds), profile })
}

/// Commands of each kind, for a drive that is ready.
pub fn commands(line: &Line, index: usize) -> Vec<Command> {
    vec![
        Command::Enable,
        Command::Disable,
        Command::Home,
        line.by(index, 0.1),
        line.jog(index, 0.1),
        Command::Follow,
        Command::Torque { slope: 100.0 },
        Command::Stop { deceleration: None },
        Command::QuickStop,
        Command::ResetFault,
        Command::Native(NativeOwner::Master),
        Command::Native(NativeOwner::Application),
    ]
}

/// So many drives as a clause wants them, due as often as the protocol can.
pub fn drives(subject: &dyn Subject, count: usize, change: impl Fn(usize, &mut Drive)) -> Vec<Drive> {
    let drive = |index| {
        let mut axis = subject.axis(&format!("x{index}"));
        axis.divisor = 1 + subject.can().answers_after;
        let start = axis.profile.velocity * 0.1;
        let mut drive = Drive { axis, start, running: false, jog: true, follow: true };
        change(index, &mut drive);
        drive
    };
    (0..count).map(drive).collect()
}
