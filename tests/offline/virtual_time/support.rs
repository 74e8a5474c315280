//! A machine in virtual time with drives that write down what they hear and say.

use std::collections::BTreeMap;
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::ops::{Deref, DerefMut};
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use fieldbeat::axis::{
    Abort, Axis, Command, CommandId, Event, EventKind, Failure, Feedback, Group, GroupCommand, Jog, Link,
    Move, Outcome, Profile, Row, StopCause, Target,
};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::{ErrorCode, LinUdpDrive, LinUdpPlan};
use fieldbeat::sim::{FaultPlan, SimDrive, World, WorldOptions};
use fieldbeat::telemetry::{Numbers, Status};
use fieldbeat::time::Time;
use fieldbeat::{Axes, Cycle, CyclePlan, Flow, Master, OpenError, Plan, Simulation};
use fieldbeat_core::bus::Opened;
use fieldbeat_core::net::{Carriers, Datagrams, Outbox, Received, Sent, StreamPeer, Streams, UdpOptions};
use fieldbeat_core::rt::Regions;
use fieldbeat_linudp::wire::{REQUEST_MAX, RESPONSE_MAX, Request, Response};
use fieldbeat_linudp::{DRIVE_PORT, MASTER_PORT};
use fieldbeat_sim::linudp::{LinMotSettings, LinMotSim, LinMots};

use crate::between::{Between, Message, Shared};

pub const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), MASTER_PORT);

/// 10 000 counts of 0.1 um are a millimetre.
pub const PER_MM: f64 = 10_000.0;

/// The range that every axis is allowed, mm.
pub const RANGE: (f64, f64) = (0.0, 200.0);

pub fn address(index: usize) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 1 + (index / 200) as u8, 1 + (index % 200) as u8), DRIVE_PORT)
}

/// One exchange as the drive saw it.
#[derive(Clone, Copy, Debug)]
pub struct Delivery {
    pub at: Time,
    pub request: Request,
    pub reply: Option<Response>,
}

/// One request as it left the master, whether or not the drive received it.
#[derive(Clone, Copy, Debug)]
pub struct Spoken {
    pub at: Time,
    pub request: Request,
}

type Tamper = Box<dyn FnMut(&mut Vec<u8>) + Send>;

/// The requests and replies of one drive, and the faults to come.
#[derive(Default)]
pub struct Tape {
    pub received: Vec<Delivery>,
    /// What went out to it since a test requested it, by `Some`.
    pub wire: Option<Vec<Spoken>>,
    /// Receives and acts, but its answers are lost.
    pub mute: bool,
    /// The operating system refuses to send to it.
    pub jammed: bool,
    /// The next look into the socket of its bus is an error. Only on the tape of the first drive.
    pub deaf_once: bool,
    /// What the operating system says that it dropped. Only on the tape of the first drive.
    pub dropped: u64,
    /// An error of the drive, to be raised with the next request.
    pub provoke: Option<ErrorCode>,
    /// Changes the next answers.
    pub tamper: Option<Tamper>,
    /// Requests handed to its bus' socket, as calls, and looks into it. Only on the tape of the first drive.
    pub sends: u64,
    pub looks: u64,
    /// The largest and smallest demand position while homed and powered, mm.
    pub demand: Option<(f64, f64)>,
}

impl Tape {
    /// The last answer that the drive gave.
    pub fn last(&self) -> Response {
        self.received.iter().rev().find_map(|received| received.reply).expect("the drive has answered")
    }
}

struct Taped {
    drive: LinMotSim,
    tape: Arc<Mutex<Tape>>,
}

impl Between for Taped {
    fn drive(&mut self) -> &mut dyn SimDrive {
        &mut self.drive
    }

    fn receive(&mut self, message: Message<'_>, reply: &mut Vec<u8>) -> Option<SocketAddrV4> {
        let mut tape = self.tape.lock().unwrap();
        if let Some(code) = tape.provoke.take() {
            self.drive.provoke(code.0);
        }
        let to = message.reaches(&mut self.drive, reply);
        let answer = to.and_then(|_| Response::parse(reply).ok());
        if let Some(answer) = &answer
            && let (Some(status), Some(demand)) = (answer.status, answer.demand)
            && status.homed()
            && status.operation_enabled()
        {
            let demand = f64::from(demand) / PER_MM;
            let (low, high) = tape.demand.unwrap_or((demand, demand));
            tape.demand = Some((low.min(demand), high.max(demand)));
        }
        if let Ok(request) = Request::parse(message.bytes) {
            tape.received.push(Delivery { at: message.now, request, reply: answer });
        }
        if let (Some(tamper), Some(_)) = (&mut tape.tamper, to) {
            tamper(reply);
        }
        to.filter(|_| !tape.mute)
    }
}

/// The plan of a LinUDP bus whose simulated drives are taped.
#[derive(Debug)]
struct TapedBus {
    plan: LinUdpPlan,
    tapes: Vec<SharedTape>,
}

#[derive(Clone)]
struct SharedTape(Arc<Mutex<Tape>>);

impl std::fmt::Debug for SharedTape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("SharedTape")
    }
}

impl BusPlan for TapedBus {
    crate::forward_bus_plan!(plan);

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        let tapes = self.tapes.clone();
        self.plan.open(period_ns, &Jammable { carriers, tapes })
    }
}

/// Carriers that fail where a tape says so, and write down what they send.
struct Jammable<'a> {
    carriers: &'a dyn Carriers,
    tapes: Vec<SharedTape>,
}

impl Carriers for Jammable<'_> {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        let inner = self.carriers.datagrams(bind, options)?;
        Ok(Box::new(JammableCarrier { inner, tapes: self.tapes.clone() }))
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        self.carriers.streams(peers)
    }
}

struct JammableCarrier {
    inner: Box<dyn Datagrams>,
    tapes: Vec<SharedTape>,
}

impl Datagrams for JammableCarrier {
    crate::forward! { this => this.inner;
        fn fd(&self) -> Option<RawFd>;
        fn batch(&self) -> usize;
    }

    fn send(&mut self, outbox: &mut Outbox) {
        for (index, tape) in self.tapes.iter().enumerate() {
            if outbox.sent(index) == Sent::Posted && tape.0.lock().unwrap().jammed {
                // No buffer space available.
                outbox.note(index, Sent::Failed(105));
            }
        }
        self.tapes[0].0.lock().unwrap().sends += 1;
        self.inner.send(outbox);
        for (index, tape) in self.tapes.iter().enumerate() {
            if let Sent::At(at) = outbox.sent(index)
                && let Some(wire) = &mut tape.0.lock().unwrap().wire
            {
                let request = Request::parse(outbox.bytes(index)).expect("the master's own telegram");
                wire.push(Spoken { at, request });
            }
        }
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        if std::mem::take(&mut self.tapes[0].0.lock().unwrap().deaf_once) {
            // Connection refused, as an ICMP message leaves behind.
            return Err(io::Error::from_raw_os_error(111));
        }
        self.tapes[0].0.lock().unwrap().looks += 1;
        self.inner.receive(take)
    }

    fn dropped(&self) -> u64 {
        self.inner.dropped() + self.tapes[0].0.lock().unwrap().dropped
    }

    fn memory(&self, _regions: &mut Regions) {}
}

/// A drive as most tests want it: 1 kHz, 0 ... 200 mm, homes to 0, starts 10 mm away from it.
pub fn drive(index: usize) -> LinUdpDrive {
    let mut drive = LinUdpDrive::new(format!("x{index}"), *address(index).ip());
    let axis = &mut drive.axis;
    axis.limits.position = Some(RANGE);
    (axis.limits.velocity, axis.limits.acceleration) = (Some(1_000.0), Some(20_000.0));
    axis.profile = Profile { velocity: 200.0, acceleration: 5_000.0, deceleration: 5_000.0 };
    (axis.stop.deceleration, axis.stop.timeout) = (5_000.0, Duration::from_secs(2));
    axis.home_timeout = Duration::from_secs(30);
    // Jogs without a button to hold.
    axis.jog_deadman = None;
    drive.leash = Some(20.0);
    drive
}

/// The bus of these drives.
pub fn bus(drives: Vec<LinUdpDrive>) -> LinUdpPlan {
    LinUdpPlan { name: "linudp".into(), bind: MASTER, drives }
}

/// The simulated drive at an address as most tests want it.
pub fn simulated(drive: &LinUdpDrive) -> LinMotSettings {
    LinMotSettings {
        start_position: 100_000,
        range: (-50_000, 2_050_000),
        ..LinMotSettings::new(drive.address)
    }
}

/// The simulated drives of a bus as most tests want them.
pub fn all_simulated(plan: &LinUdpPlan) -> LinMots {
    LinMots(plan.drives.iter().map(simulated).collect())
}

/// A drive of the plan, and how it is simulated.
#[derive(Clone, Debug)]
pub struct Paired<P, S> {
    pub plan: P,
    pub simulate: S,
}

impl<P, S> Deref for Paired<P, S> {
    type Target = P;

    fn deref(&self) -> &P {
        &self.plan
    }
}

impl<P, S> DerefMut for Paired<P, S> {
    fn deref_mut(&mut self) -> &mut P {
        &mut self.plan
    }
}

/// A RigDrive of a [`Rig`].
pub type RigDrive = Paired<LinUdpDrive, LinMotSettings>;

/// The usual one.
fn linmot(index: usize) -> RigDrive {
    let plan = drive(index);
    Paired { simulate: simulated(&plan), plan }
}

/// A ramp that takes its time. The plan of the others, which promises an end within the time-out, would be refused.
pub fn weak_ramp(drive: &mut LinUdpDrive, deceleration: f64) {
    drive.axis.stop.deceleration = deceleration;
    drive.axis.limits.velocity = None;
    drive.axis.profile.velocity = deceleration * drive.axis.stop.timeout.as_secs_f64();
}

type TaskFn = Box<dyn FnMut(&Cycle, &mut Axes<'_>) + Send>;

/// A machine to be built.
pub struct Rig {
    pub cycle: CyclePlan,
    pub drives: Vec<RigDrive>,
    pub options: WorldOptions,
    task: Option<TaskFn>,
}

impl Rig {
    pub fn new(count: usize) -> Rig {
        Rig {
            cycle: CyclePlan::default(),
            drives: (0..count).map(linmot).collect(),
            options: WorldOptions::default(),
            task: None,
        }
    }

    pub fn cycle(mut self, change: impl FnOnce(&mut CyclePlan)) -> Rig {
        change(&mut self.cycle);
        self
    }

    pub fn each(mut self, change: impl Fn(usize, &mut RigDrive)) -> Rig {
        self.drives.iter_mut().enumerate().for_each(|(index, drive)| change(index, drive));
        self
    }

    pub fn faults(self, plan: FaultPlan) -> Rig {
        self.each(|index, drive| {
            drive.simulate.faults = FaultPlan { seed: plan.seed * 1_000 + index as u64, ..plan.clone() };
        })
    }

    pub fn task(mut self, task: impl FnMut(&Cycle, &mut Axes<'_>) + Send + 'static) -> Rig {
        self.task = Some(Box::new(task));
        self
    }

    pub fn start(self) -> Bench {
        let tapes: Vec<_> = self.drives.iter().map(|_| SharedTape(Arc::default())).collect();
        let taped = |(drive, tape): (&RigDrive, &SharedTape)| {
            let drive = LinMotSim::new(drive.simulate.clone());
            Box::new(Shared::new(Taped { drive, tape: Arc::clone(&tape.0) })) as Box<dyn SimDrive>
        };
        let simulated: Vec<_> = self.drives.iter().zip(&tapes).map(taped).collect();
        let plan = bus(self.drives.iter().map(|drive| drive.plan.clone()).collect());
        let period_ns = self.cycle.period_ns;
        let bus = TapedBus { plan, tapes: tapes.clone() };
        let plan = Plan { cycle: self.cycle, buses: vec![Box::new(bus)], ..Plan::default() };
        let mut setup = Master::from_plan(plan);
        if let Some(task) = self.task {
            setup = setup.with_task(task);
        }
        // The grid begins two periods after the first look at the clock.
        let origin = self.options.start + self.options.read_ns + 2 * period_ns;
        Bench {
            sim: setup.simulate_with(simulated, self.options).expect("the machine can be built"),
            origin,
            drives: self.drives,
            tapes,
            group: None,
            members: Vec::new(),
            events: Vec::new(),
            ends: BTreeMap::new(),
            period_ns,
        }
    }

    /// Started, and all drives online.
    pub fn online(self) -> Bench {
        let mut bench = self.start();
        bench.online();
        bench
    }

    /// Started, and all drives online, enabled and homed.
    pub fn ready(self) -> Bench {
        let mut bench = self.start();
        bench.ready();
        bench
    }
}

/// A machine that runs.
pub struct Bench {
    pub sim: Simulation,
    pub drives: Vec<RigDrive>,
    tapes: Vec<SharedTape>,
    /// The axes of `members`, once they have joined.
    group: Option<Group>,
    members: Vec<usize>,
    /// All events, with their axis.
    pub events: Vec<(usize, Event)>,
    /// How each command ended, by axis and id; more than one end is a defect that every test would see.
    pub ends: BTreeMap<(usize, u64), Outcome>,
    pub period_ns: u64,
    origin: Time,
}

impl Bench {
    pub fn step(&mut self) -> Flow {
        let flow = self.sim.step();
        for index in 0..self.drives.len() {
            while let Some(event) = self.event(index) {
                if let EventKind::Ended { id, outcome, .. } = event.kind {
                    let before = self.ends.insert((index, id.0), outcome);
                    assert_eq!(before, None, "command {} of axis {index} ended twice: {outcome}", id.0);
                }
                self.events.push((index, event));
            }
        }
        flow
    }

    fn event(&mut self, index: usize) -> Option<Event> {
        match self.members.iter().position(|member| *member == index) {
            Some(place) => self.group.as_mut()?.event(place),
            None => self.sim.axis(index).event(),
        }
    }

    /// These axes are a group from now on.
    pub fn join(&mut self, members: &[usize]) -> &mut Group {
        let axes: Vec<_> = members.iter().map(|index| self.sim.take_axis(*index)).collect();
        self.members = members.to_vec();
        self.group.insert(Group::new(axes).unwrap_or_else(|refused| panic!("{refused}")))
    }

    /// The application's end of an axis that has joined no group. Its events are not followed from here on.
    pub fn take_axis(&mut self, index: usize) -> Axis {
        assert!(!self.joined());
        self.members.push(index);
        self.sim.take_axis(index)
    }

    /// The application drops it.
    pub fn drop_axis(&mut self, index: usize) {
        drop(self.take_axis(index));
    }

    /// The application drops the group.
    pub fn drop_group(&mut self) {
        drop(self.group.take());
    }

    /// The application ends the group and keeps none of its axes but this one, by its place.
    pub fn keep_member(&mut self, place: usize) -> Axis {
        self.group.take().expect("axes have joined").into_axes().swap_remove(place)
    }

    /// Whether some axes have.
    pub fn joined(&self) -> bool {
        self.group.is_some()
    }

    pub fn group(&mut self) -> &mut Group {
        self.group.as_mut().expect("axes have joined")
    }

    /// Turns until the command has ended at every member. Returns how.
    pub fn group_ended(&mut self, command: &GroupCommand) -> Vec<Outcome> {
        let members = self.members.clone();
        members.iter().zip(command.ids()).map(|(index, id)| self.ended(*index, *id)).collect()
    }

    pub fn group_done(&mut self, commands: &[Command]) {
        let command = self.group().post(commands).unwrap_or_else(|error| panic!("{error}"));
        let outcomes = self.group_ended(&command);
        assert!(outcomes.iter().all(|outcome| *outcome == Outcome::Done), "{commands:?}: {outcomes:?}");
    }

    pub fn run(&mut self, turns: u64) {
        for _ in 0..turns {
            self.step();
        }
    }

    /// Turns until `done`; fails after `most`.
    pub fn until(&mut self, what: &str, most: u64, mut done: impl FnMut(&mut Bench) -> bool) -> u64 {
        for turn in 0..most {
            if done(self) {
                return turn;
            }
            self.step();
        }
        let reported: Vec<_> =
            self.events.iter().rev().take(12).map(|(axis, e)| format!("{axis}: {e}")).collect();
        panic!("not within {most} turns: {what}; the last events, newest first: {reported:#?}");
    }

    pub fn world(&self) -> World {
        self.sim.world().clone()
    }

    /// A request of whoever comes to the drive at this instant.
    pub fn inject_request(&self, index: usize, request: Request, at: Time) {
        let mut bytes = [0; REQUEST_MAX];
        let size = request.emit(&mut bytes);
        self.sim.world().inject(address(index), MASTER, &bytes[..size], at);
    }

    /// A reply of the drive comes to the master at this instant.
    pub fn inject_reply(&self, index: usize, reply: Response, at: Time) {
        let mut bytes = [0; RESPONSE_MAX];
        let size = reply.emit(&mut bytes);
        self.sim.world().inject(MASTER, address(index), &bytes[..size], at);
    }

    pub fn tape(&self, index: usize) -> MutexGuard<'_, Tape> {
        self.tapes[index].0.lock().unwrap()
    }

    /// How often requests were handed to the socket.
    pub fn sends(&self) -> u64 {
        self.tape(0).sends
    }

    /// How often the socket was looked into.
    pub fn looks(&self) -> u64 {
        self.tape(0).looks
    }

    pub fn feedback(&self, index: usize) -> Feedback {
        self.sim.feedback(index)
    }

    pub fn status(&self) -> Status {
        *self.sim.status()
    }

    pub fn online(&mut self) -> &mut Bench {
        let count = self.drives.len();
        self.until("all online", 2_000, |b| (0..count).all(|index| b.feedback(index).link == Link::Online));
        self
    }

    /// All online, enabled and homed.
    pub fn ready(&mut self) -> &mut Bench {
        self.online();
        for command in [Command::Enable, Command::Home] {
            let ids: Vec<_> = (0..self.drives.len()).map(|index| self.post(index, command)).collect();
            for (index, id) in ids.into_iter().enumerate() {
                assert_eq!(self.ended(index, id), Outcome::Done, "{command:?} of axis {index}");
            }
        }
        self
    }

    pub fn post(&mut self, index: usize, command: Command) -> CommandId {
        self.sim.axis(index).post(command).unwrap_or_else(|error| panic!("{error}"))
    }

    pub fn outcome(&self, index: usize, id: CommandId) -> Option<Outcome> {
        self.ends.get(&(index, id.0)).copied()
    }

    /// Turns until the command has ended.
    pub fn ended(&mut self, index: usize, id: CommandId) -> Outcome {
        self.until(&format!("end of command {} of axis {index}", id.0), 40_000, |b| {
            b.outcome(index, id).is_some()
        });
        self.outcome(index, id).unwrap()
    }

    /// Posts and turns until the end.
    pub fn execute(&mut self, index: usize, command: Command) -> Outcome {
        let id = self.post(index, command);
        self.ended(index, id)
    }

    pub fn done(&mut self, index: usize, command: Command) {
        assert_eq!(self.execute(index, command), Outcome::Done, "{command:?} of axis {index}");
    }

    pub fn failed(&mut self, index: usize, command: Command) -> Failure {
        match self.execute(index, command) {
            Outcome::Failed(failure) => failure,
            other => panic!("{command:?} of axis {index} should have failed: {other}"),
        }
    }

    pub fn aborted(&mut self, index: usize, id: CommandId) -> Abort {
        match self.ended(index, id) {
            Outcome::Aborted(abort) => abort,
            other => panic!("command {} of axis {index} should have been aborted: {other}", id.0),
        }
    }

    /// Turns until the axis is latched.
    pub fn stopped(&mut self, index: usize, most: u64) -> StopCause {
        self.until("a stop", most, |b| b.feedback(index).stopped.is_some());
        self.feedback(index).stopped.unwrap()
    }

    /// Out of the latch, enabled again, homed if need be.
    pub fn recover(&mut self, index: usize) {
        self.online();
        self.done(index, Command::ResetFault);
        self.done(index, Command::Reset);
        self.done(index, Command::Enable);
        if !self.feedback(index).status.homed {
            self.done(index, Command::Home);
        }
    }

    pub fn kinds(&self, index: usize) -> Vec<EventKind> {
        self.events.iter().filter(|(axis, _)| *axis == index).map(|(_, event)| event.kind).collect()
    }

    /// The grid point of the cycle executed last.
    pub fn grid(&self) -> Time {
        let now = self.world().now();
        now - now.since(self.origin) % self.period_ns
    }

    /// The slot of the grid in which `at` lies.
    pub fn slot(&self, at: Time) -> u64 {
        at.since(self.origin) / self.period_ns
    }

    /// The newest values are as old as they say: the drive gave them in the cycle that the age names, or later.
    pub fn assert_honest(&self, index: usize) {
        let feedback = self.feedback(index);
        let since = self.grid() - u64::from(feedback.age) * self.period_ns;
        let tape = self.tape(index);
        let given = |received: &Delivery| {
            let reply = received.reply?;
            let demand = f64::from(reply.demand?) / PER_MM;
            (demand == feedback.status.demand).then_some(received.at)
        };
        let at = tape.received.iter().rev().find_map(given).expect("no value that the drive did not give");
        assert!(at >= since, "age {} in {}, but given {} ns before", feedback.age, since, since.since(at));
    }

    /// Requests the end and turns until it is there.
    pub fn shut_down(&mut self, most: u64) -> u64 {
        self.sim.stop();
        for turn in 1..=most {
            if self.step() == Flow::End {
                return turn;
            }
        }
        panic!("no end within {most} turns");
    }

    pub fn finish(self) -> Numbers {
        self.sim.finish()
    }

    /// `planned = executed + skipped`, and the histogram holds them all.
    pub fn assert_grid(&self) {
        let status = self.status();
        assert_eq!(status.planned, status.executed + status.skipped, "{status:?}");
        assert_eq!(self.sim.measured().histograms.wake.len(), status.planned, "{status:?}");
    }
}

pub fn to(position: f64) -> Command {
    fast(Target::Absolute(position))
}

pub fn by(distance: f64) -> Command {
    fast(Target::Relative(distance))
}

fn fast(target: Target) -> Command {
    with(target, 500.0, 10_000.0)
}

pub fn with(target: Target, velocity: f64, acceleration: f64) -> Command {
    Command::Move(Move { target, profile: Profile { velocity, acceleration, deceleration: acceleration } })
}

/// Slow enough to be in the middle of it for seconds.
pub fn slowly_to(position: f64) -> Command {
    with(Target::Absolute(position), 20.0, 1_000.0)
}

pub fn jog(velocity: f64) -> Command {
    Command::Jog(Jog { velocity, acceleration: 5_000.0 })
}

pub fn row(position: f64) -> Row {
    Row { position, ..Row::default() }
}

pub fn assert_near(value: f64, expected: f64, within: f64) {
    assert!((value - expected).abs() <= within, "{value} is not within {within} of {expected}");
}
