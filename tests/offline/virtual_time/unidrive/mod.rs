//! Unidrives under the whole loop in virtual time: what the conformance suite does not ask of a protocol.

mod blocks;
mod care;
mod commanding;
mod functions;
mod loss;
mod others;

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, MutexGuard};
use std::time::Duration;

use fieldbeat::axis::{Command, Failure, Feedback, Jog, Link, Outcome, Profile, StopCause};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::modbus::{
    Addressing, ControlWord, Functions, ModbusPlan, Parameter, StatusWord, Trip, UnidriveDrive, Via,
    Watchdog, Width,
};
use fieldbeat::sim::{FaultPlan, SimDrive, SimPlan, WorldOptions};
use fieldbeat::telemetry::Summary;
use fieldbeat::telemetry::{Counters, Numbers};
use fieldbeat::time::{MS, S, Time};
use fieldbeat::{Master, Plan, Simulation};
use fieldbeat_modbus::counters::OWN;
use fieldbeat_modbus::counters::Own;
use fieldbeat_modbus::wire::{Header, RegistersBuffer, Request, Response, function};
use fieldbeat_sim::modbus::{Start, UnidriveSettings, UnidriveSim};

use super::support::Paired;
use crate::between::{Between, Message, Shared};

const STOP: Command = Command::Stop { deceleration: None };
/// Another master.
const OTHER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 8, 8, 8), 8_888);

type Tamper = Box<dyn FnMut(&mut Vec<u8>) + Send>;

/// A drive, the requests that it receives, and their changes.
struct Tapped {
    drive: UnidriveSim,
    /// Every request, the handshake's too.
    received: Vec<Vec<u8>>,
    /// Changes the requests that the drive receives, and its answers.
    request: Option<Tamper>,
    reply: Option<Tamper>,
}

impl Tapped {
    /// The replies to another master.
    fn ask(&mut self, now: Time, request: Request<'_>) -> Vec<u8> {
        let mut bytes = vec![0; request.size()];
        request.emit(Header { transaction: 7, unit: 255 }, &mut bytes);
        let mut reply = Vec::new();
        assert!(self.drive.connect(now, OTHER));
        self.drive.receive(now, OTHER, &bytes, &mut reply);
        self.drive.disconnected(now, OTHER);
        reply
    }

    fn read(&mut self, now: Time, parameter: Parameter) -> u16 {
        let address = parameter.address(Addressing::Standard, Width::Word).unwrap();
        let reply = self.ask(now, Request::Read { address, count: 1 });
        match Response::parse(&reply).unwrap().1 {
            Response::Read { data } => data.word(0).unwrap(),
            other => panic!("{other:?}"),
        }
    }

    fn write(&mut self, now: Time, parameter: Parameter, value: u16) {
        let address = parameter.address(Addressing::Standard, Width::Word).unwrap();
        self.ask(now, Request::WriteOne { address, value });
    }

    /// The reference, as another master or a keypad writes it.
    fn refer(&mut self, now: Time, reference: i32) {
        let mut data = RegistersBuffer::new();
        data.push_long(reference);
        let address = Parameter::REFERENCE.address(Addressing::Standard, Width::Long).unwrap();
        self.ask(now, Request::Write { address, data: data.registers() });
    }

    fn status(&mut self, now: Time) -> StatusWord {
        StatusWord(self.read(now, Parameter::STATUS_WORD))
    }
}

/// The same, of the test and of the world.
type Tap = Shared<Tapped>;

impl Between for Tapped {
    fn drive(&mut self) -> &mut dyn SimDrive {
        &mut self.drive
    }

    fn receive(&mut self, message: Message<'_>, reply: &mut Vec<u8>) -> Option<SocketAddrV4> {
        let mut bytes = message.bytes.to_vec();
        if let Some(tamper) = &mut self.request {
            tamper(&mut bytes);
        }
        let to = Message { bytes: &bytes, ..message }.reaches(&mut self.drive, reply);
        self.received.push(bytes);
        if let Some(tamper) = &mut self.reply {
            tamper(reply);
        }
        to.filter(|_| !reply.is_empty())
    }
}

/// The drives of a machine.
fn simulated(taps: &[Tap]) -> Vec<Box<dyn SimDrive>> {
    taps.iter().map(|tap| Box::new(tap.clone()) as Box<dyn SimDrive>).collect()
}

fn address(index: usize) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 3, 1 + index as u8), 502)
}

/// A drive as most tests want it: revolutions of the motor, 8 of them a second.
fn drive(index: usize, via: Via) -> Unidrive {
    let mut drive = UnidriveDrive::new(format!("u{index}"), *address(index).ip());
    drive.axis.profile = Profile { velocity: 8.0, acceleration: 80.0, deceleration: 80.0 };
    drive.axis.stop.deceleration = 80.0;
    drive.axis.jog_deadman = None;
    drive.axis.health.probe_interval = Duration::from_millis(20);
    drive.via = via;
    drive.reply_within_ns = 5 * MS;
    let simulate = UnidriveSettings { ramps_s: (0.01, 0.01), ..UnidriveSettings::of(&drive) };
    Paired { plan: drive, simulate }
}

/// A Unidrive of a [`Bench`].
type Unidrive = Paired<UnidriveDrive, UnidriveSettings>;

const VIAS: [Via; 2] = [Via::Direct, Via::Menu0 { first: 11 }];

struct Bench {
    sim: Simulation,
    taps: Vec<Tap>,
    plan: ModbusPlan,
}

impl Bench {
    fn new(count: usize, via: Via, change: impl Fn(usize, &mut Unidrive)) -> Bench {
        Bench::beside(count, via, change, |_, _| {}, Vec::new())
    }

    /// All drives in operation.
    fn enabled(count: usize, via: Via, change: impl Fn(usize, &mut Unidrive)) -> Bench {
        let mut bench = Bench::new(count, via, change);
        bench.ready();
        bench
    }

    /// Drives that `prepare` meets before the master does, beside these buses.
    fn beside(
        count: usize,
        via: Via,
        change: impl Fn(usize, &mut Unidrive),
        prepare: impl Fn(&mut Tapped, Time),
        mut buses: Vec<Box<dyn BusPlan>>,
    ) -> Bench {
        let options = WorldOptions::default();
        let mut drives: Vec<_> = (0..count).map(|index| drive(index, via)).collect();
        drives.iter_mut().enumerate().for_each(|(index, drive)| change(index, drive));
        let tap = |drive: &Unidrive| {
            let drive = UnidriveSim::new(drive.simulate.clone());
            let mut shared = Tapped { drive, received: Vec::new(), request: None, reply: None };
            prepare(&mut shared, Time(options.start.0 - 2 * S));
            Shared::new(shared)
        };
        let taps: Vec<_> = drives.iter().map(tap).collect();
        let plan = ModbusPlan::new(drives.into_iter().map(|drive| drive.plan).collect());
        assert_eq!(plan.faults(MS), Vec::new());
        let mut drives = simulated(&taps);
        drives.extend(SimPlan::of(&buses).build().drives);
        buses.insert(0, Box::new(plan.clone()));
        let whole = Plan { buses, ..Plan::default() };
        let sim = Master::from_plan(whole).simulate_with(drives, options).expect("the machine can be built");
        Bench { sim, taps, plan }
    }

    fn tap(&self, index: usize) -> MutexGuard<'_, Tapped> {
        self.taps[index].lock()
    }

    fn now(&self) -> Time {
        self.sim.world().now()
    }

    fn feedback(&self, index: usize) -> Feedback {
        self.sim.feedback(index)
    }

    fn run(&mut self, cycles: u64) {
        self.sim.run(cycles);
    }

    fn until(&mut self, what: &str, most: u64, mut done: impl FnMut(&Bench) -> bool) {
        for _ in 0..most {
            if done(self) {
                return;
            }
            self.sim.step();
        }
        panic!("not within {most} cycles: {what}; {:?}", self.feedback(0));
    }

    fn online(&mut self) {
        let count = self.taps.len();
        self.until("all online", 20_000, |b| (0..count).all(|index| b.feedback(index).link == Link::Online));
    }

    fn outcome(&mut self, index: usize, command: Command) -> Outcome {
        self.sim.execute(index, command, 40_000).unwrap().unwrap_or_else(|| panic!("no end of {command:?}"))
    }

    fn done(&mut self, index: usize, command: Command) {
        assert_eq!(self.outcome(index, command), Outcome::Done, "{command:?}");
    }

    fn failed(&mut self, index: usize, command: Command) -> Failure {
        match self.outcome(index, command) {
            Outcome::Failed(failure) => failure,
            other => panic!("{command:?}: {other}"),
        }
    }

    fn ready(&mut self) {
        self.online();
        for index in 0..self.taps.len() {
            self.done(index, Command::Enable);
        }
    }

    /// Turning at this speed.
    fn turning(&mut self, index: usize, velocity: f64) {
        self.sim.axis(index).post(Command::Jog(Jog { velocity, acceleration: 80.0 })).unwrap();
        self.until("its speed", 2_000, |b| (b.feedback(index).status.velocity - velocity).abs() < 0.1);
    }

    fn stopped(&mut self, index: usize, most: u64) -> StopCause {
        self.until("a stop", most, |b| b.feedback(index).stopped.is_some());
        self.feedback(index).stopped.unwrap()
    }

    /// The whole way back.
    fn recover(&mut self, index: usize) {
        for command in [Command::ResetFault, Command::Reset, Command::Enable] {
            self.done(index, command);
        }
        self.turning(index, 2.0);
        self.done(index, STOP);
    }

    fn finish(self) -> Numbers {
        self.sim.finish()
    }
}

/// The reference that a request writes, unless the drive does not know its function.
fn reference(request: &[u8]) -> Option<i32> {
    let addresses = [Parameter::REFERENCE, Parameter::new(0, 11)]
        .map(|parameter| parameter.address(Addressing::Standard, Width::Long).unwrap());
    match Request::parse(request).ok()?.1 {
        Request::Write { address, data } | Request::ReadWrite { write: address, data, .. } => {
            data.long(addresses.iter().position(|one| *one == address)?)
        }
        _ => None,
    }
}

/// What is not zero of what only Modbus counts.
fn own(counters: &Counters) -> Vec<(&'static str, u64)> {
    let all = OWN.iter().zip(counters.own).map(|(own, count)| (own.key, count));
    all.filter(|(_, count)| *count > 0).collect()
}

fn key(own: Own) -> &'static str {
    OWN[own as usize].key
}

#[test]
fn a_value_refused_by_the_drive_is_detected_and_ends_the_command() {
    for via in VIAS {
        for read_write in [true, false] {
            let what = format!("{via:?}, function 23: {read_write}");
            let functions = if read_write { Functions::ReadWrite } else { Functions::Apart };
            let mut b = Bench::enabled(1, via, |_, drive| drive.functions = functions);
            // A reference that no drive takes, in every request that has one, as its last value.
            b.tap(0).request = Some(Box::new(|request| {
                if reference(request).is_some() {
                    let at = request.len() - 4;
                    request[at..].copy_from_slice(&i32::MAX.to_be_bytes());
                }
            }));
            let jog = Command::Jog(Jog { velocity: 4.0, acceleration: 80.0 });
            assert_eq!(b.failed(0, jog), Failure::NotTaken, "{what}");
            b.tap(0).request = None;
            let counters = b.finish().drives[0].counters;
            let counted = if read_write { Own::NotTaken } else { Own::WrittenShort };
            assert!(counters.own[counted as usize] > 0, "{what}: {:?}", own(&counters));
            let others = own(&counters).into_iter().filter(|(name, _)| *name != key(counted));
            assert_eq!(others.collect::<Vec<_>>(), [], "{what}");
        }
    }
}

#[test]
fn an_over_current_trip_is_reset_as_soon_as_the_drive_takes_it_and_not_before() {
    let mut b = Bench::enabled(1, Via::Direct, |_, _| {});
    b.tap(0).drive.provoke(Trip::OVER_CURRENT.0);
    let begin = b.now();
    b.stopped(0, 100);
    // The stop sequence runs to its end before anything else is taken.
    b.run(100);
    b.tap(0).received.clear();
    b.done(0, Command::ResetFault);
    let took = b.now().since(begin);
    assert!((10 * S..11 * S).contains(&took), "after {took} ns");
    let received = std::mem::take(&mut b.tap(0).received);
    let resets = received.iter().filter(|request| {
        let control = Parameter::CONTROL_WORD.address(Addressing::Standard, Width::Word);
        match Request::parse(request) {
            Ok((_, Request::ReadWrite { write, data, .. })) if Some(write) == control => {
                ControlWord(data.word(0).unwrap()).has(ControlWord::RESET)
            }
            _ => false,
        }
    });
    assert!((1..100).contains(&resets.count()), "only when it can help");
    b.recover(0);
}

#[test]
fn a_missing_hardware_enable_is_reported_when_the_drive_does_not_come_up() {
    for via in VIAS {
        let mut b = Bench::new(1, via, |_, drive| drive.simulate.hardware_enable = false);
        b.online();
        assert_eq!(b.failed(0, Command::Enable), Failure::StoOpen);
        b.until("that it is shown", 50, |b| {
            b.feedback(0).status.sto_open && !b.feedback(0).status.state.is_powered()
        });
        // It leaves with the next request.
        b.run(2);
        let control = ControlWord(b.tap(0).read(b.now(), Parameter::CONTROL_WORD));
        assert!(!control.has(ControlWord::ENABLE), "it does not come up when the enable comes back");
    }
}

/// Runs by its terminals, at 300 rpm, for two seconds.
fn by_terminals(shared: &mut Tapped, now: Time) {
    shared.write(now, Parameter::REFERENCE_SELECTOR, 3);
    shared.refer(now, 3_000);
    shared.write(now, Parameter::new(6, 30), 1);
    let status = shared.status(now + 2 * S);
    assert!(status.active() && !status.zero_speed(), "{status:?}");
    shared.received.clear();
}

#[test]
fn a_restart_between_two_connections_is_noticed_though_nothing_was_acknowledged_meanwhile() {
    for via in VIAS {
        // The link is not lost by then: nobody else stops it.
        let mut b = Bench::enabled(1, via, |_, drive| drive.axis.health.bucket = 100_000);
        b.turning(0, 4.0);
        // From now on only handshakes are answered: they neither read nor write anything by function 23.
        b.tap(0).reply = Some(Box::new(|reply| {
            if reply.get(7) == Some(&function::READ_WRITE) {
                reply.clear();
            }
        }));
        let received = |b: &Bench| {
            let received = &b.tap(0).received;
            received.iter().filter(|request| request[7] == function::READ_WRITE && request[11] > 0).count()
        };
        b.run(2);
        let before = received(&b);
        b.until("a request on another connection", 2_000, |b| received(b) > before);
        assert!(b.sim.world().restart(address(0)));
        b.tap(0).reply = None;
        b.until("what was lost is known", 5_000, |b| b.feedback(0).stopped.is_some());
        for _ in 0..2_000 {
            b.sim.step();
            let control = ControlWord(b.tap(0).read(b.now(), Parameter::CONTROL_WORD));
            assert!(!control.has_any(ControlWord::ANY_RUN), "{via:?}: on again by itself: {control:?}");
        }
        b.recover(0);
    }
}
/// One thing that befalls one reply: what the protocol counts of it, and whether the connection is lost.
type Mischief = (&'static str, fn(&mut Vec<u8>), &'static [Own], bool);

const MISCHIEF: [Mischief; 9] = [
    ("answers twice", |reply| reply.extend_from_within(..), &[], false),
    ("garbage", |reply| *reply = vec![0xA5; 40], &[Own::Garbage], true),
    ("another unit", |reply| reply[6] = 7, &[Own::WrongUnit, Own::GivenUp], true),
    ("another function", |reply| reply[7] = function::READ, &[Own::WrongFunction, Own::GivenUp], true),
    ("fewer registers than were requested", shortened, &[Own::WrongLength, Own::GivenUp], true),
    ("a count that lies", |reply| reply[8] ^= 2, &[Own::WrongLength, Own::GivenUp], true),
    ("another transaction", |reply| reply[0] ^= 0x40, &[Own::GivenUp], true),
    ("busy", |reply| refuse(reply, 6), &[Own::Exceptions], false),
    ("cut off in mid-frame", |_| {}, &[Own::CutOff], true),
];

fn shortened(reply: &mut Vec<u8>) {
    reply.truncate(reply.len() - 2);
    (reply[5], reply[8]) = (reply[5] - 2, reply[8] - 2);
}

/// The drive refuses the request, by this exception.
fn refuse(reply: &mut Vec<u8>, exception: u8) {
    *reply = [&reply[..5], &[3, reply[6], reply[7] | function::EXCEPTION, exception]].concat();
}

/// How each reply counts stands in the conformance suite.
#[test]
fn each_mischief_of_a_peer_has_its_own_counter_and_moves_no_other() {
    for (via, (what, tamper, counted, lost)) in
        VIAS.into_iter().flat_map(|via| MISCHIEF.map(|one| (via, one)))
    {
        let what = format!("{via:?}, {what}");
        let mut b = Bench::enabled(2, via, |_, drive| drive.axis.health.bucket = 20);
        (0..2).for_each(|index| b.turning(index, 4.0));
        let mut once = true;
        b.tap(0).reply = Some(Box::new(move |reply| {
            if std::mem::take(&mut once) {
                tamper(reply);
            }
        }));
        let cut = if matches!(counted, [Own::CutOff]) { 1.0 } else { 0.0 };
        assert!(b.sim.world().set_faults(address(0), FaultPlan { cut, ..FaultPlan::default() }));
        b.run(1);
        b.sim.world().set_faults(address(0), FaultPlan::default());
        b.run(1_000);
        b.online();
        b.run(50);
        let end = b.finish();
        let mut expected: Vec<_> = counted.iter().map(|own| (key(*own), 1)).collect();
        expected.extend(lost.then_some((key(Own::Reopened), 1)));
        let [first, second] = [0, 1].map(|index| end.drives[index].counters);
        let mut counted = own(&first);
        expected.sort_unstable();
        counted.sort_unstable();
        assert_eq!(counted, expected, "{what}");
        assert_eq!(first.missed, u64::from(lost), "{what}: the one exchange that it hit");
        assert_eq!((own(&second), second.missed), (vec![], 0), "{what}: its neighbour");
    }
}

/// Each second, third ... request finds it busy, from the first connection on: a parameter whose turn comes in that
/// rhythm is read all the same.
#[test]
fn a_drive_that_is_busy_in_any_rhythm_is_set_up_and_reports_all_parameters() {
    for via in VIAS {
        for functions in [Functions::Auto, Functions::Apart] {
            for (rhythm, exception) in (2..10).flat_map(|rhythm| [(rhythm, 5), (rhythm, 6)]) {
                let what = format!("{via:?}, {functions:?}, each {rhythm}th, exception {exception}");
                let mut b = Bench::new(1, via, |_, drive| {
                    drive.functions = functions;
                    drive.reply_within_ns = 50 * MS;
                });
                let mut requests = 0;
                b.tap(0).reply = Some(Box::new(move |reply| {
                    requests += 1;
                    if requests % rhythm == 0 {
                        refuse(reply, exception);
                    }
                }));
                b.ready();
                b.turning(0, 4.0);
                for _ in 0..500 {
                    b.run(1);
                    let age = b.feedback(0).age;
                    assert!(age <= 20, "{what}: {age} cycles");
                }
                b.tap(0).drive.provoke(Trip::OVER_VOLTS.0);
                b.until(&what, 100, |b| b.feedback(0).status.fault == u32::from(Trip::OVER_VOLTS.0));
                b.run(100);
                b.recover(0);
                b.done(0, Command::Disable);
                let counted = own(&b.finish().drives[0].counters);
                assert!(
                    counted.iter().all(|(key, _)| *key == self::key(Own::Exceptions)),
                    "{what}: {counted:?}"
                );
            }
        }
    }
}

#[test]
fn a_parameter_for_which_a_drive_is_always_busy_keeps_no_other_one_away() {
    for functions in [Functions::Auto, Functions::Apart] {
        let mut b = Bench::enabled(1, Via::Direct, |_, drive| drive.functions = functions);
        b.turning(0, 4.0);
        let is_trip = Arc::new(AtomicBool::new(false));
        let was_trip = is_trip.clone();
        b.tap(0).request = Some(Box::new(move |request| {
            let read = match Request::parse(request).unwrap().1 {
                Request::Read { address, .. } | Request::ReadWrite { read: address, .. } => Some(address),
                _ => None,
            };
            let parameter = read.and_then(|address| Parameter::from_address(address, Addressing::Standard));
            is_trip.store(parameter.is_some_and(|(one, _)| one == Parameter::TRIP), Ordering::Relaxed);
        }));
        b.tap(0).reply = Some(Box::new(move |reply| {
            if was_trip.load(Ordering::Relaxed) {
                refuse(reply, 6);
            }
        }));
        for _ in 0..500 {
            b.run(1);
            let age = b.feedback(0).age;
            assert!(age <= 20, "{functions:?}: {age} cycles");
        }
        let counters = b.finish().drives[0].counters;
        let [busy, given_up] = [Own::Exceptions, Own::GivenUp].map(|own| counters.own[own as usize]);
        assert!(busy > 50 && given_up == 0, "{functions:?}: {busy}, {given_up}");
    }
}

#[test]
fn a_drive_that_refuses_its_cyclic_parameters_again_and_again_gets_a_new_handshake() {
    let mut b = Bench::enabled(1, Via::Menu0 { first: 11 }, |_, _| {});
    b.tap(0).reply = Some(Box::new(|reply| refuse(reply, 2)));
    b.run(20);
    b.tap(0).reply = None;
    b.until("a link that is down", 1_000, |b| b.feedback(0).link != Link::Online);
    b.online();
    let c = b.finish().drives[0].counters;
    let exceptions = c.own[Own::Exceptions as usize];
    assert_eq!((exceptions, c.own[Own::GivenUp as usize], c.malformed), (3, 1, 0));
}

#[test]
fn a_drive_whose_master_dies_trips_and_leaves_its_motor_without_power() {
    let by_word = Watchdog { timeout_ns: None, keypad: true, accept_none: false };
    for (watchdog, within, trip) in [(Watchdog::default(), 500 * MS, 252), (by_word, S, 30)] {
        for via in VIAS {
            let mut b = Bench::enabled(1, via, |_, drive| drive.watchdog = watchdog);
            b.turning(0, 4.0);
            b.run(3_000);
            assert_eq!(b.feedback(0).stopped, None, "it is served while the master lives");
            // Nobody steps the loop any more.
            b.sim.world().advance(within - 20 * MS);
            let last = b.now();
            assert!(b.tap(0).drive.connections() > 0);
            b.sim.world().advance(100 * MS);
            // A question to it is no life sign of the master's: by then it has tripped.
            let (now, mut tap) = (b.now(), b.tap(0));
            let status = tap.status(now);
            assert!(now > last && !status.healthy() && !status.active(), "{via:?}, {watchdog:?}: {status:?}");
            assert_eq!(tap.read(now, Parameter::TRIP), trip, "{via:?}");
        }
    }
}

#[test]
fn a_drive_that_is_found_running_fails_no_run_and_neither_does_its_group() {
    let causes = |b: &Bench| [0, 1].map(|index| b.feedback(index).stopped);
    for is_provoked in [false, true] {
        let mut b = Bench::new(2, Via::Direct, |index, drive| {
            drive.plan.axis.stop.group = Some(1);
            // The other one is online by then.
            drive.simulate.boot_ns = index as u64 * S;
            drive.simulate.start = if index == 1 { Start::Running(200.0) } else { Start::Idle };
        });
        b.online();
        b.run(200);
        assert_eq!(causes(&b), [Some(StopCause::Group), Some(StopCause::FoundRunning)]);
        assert!(!Summary::from(&b.sim).has_failed());
        if is_provoked {
            // Somebody goes on with it, and it trips.
            b.done(1, Command::Reset);
            b.done(1, Command::Enable);
            b.tap(1).drive.provoke(Trip::OVER_VOLTS.0);
            b.run(50);
            assert_eq!(causes(&b), [Some(StopCause::Group), Some(StopCause::DriveFault)]);
            let summary = Summary::from(&b.sim);
            assert!(summary.drives.iter().all(|drive| drive.failed_by().is_some()) && summary.has_failed());
        }
    }
}
