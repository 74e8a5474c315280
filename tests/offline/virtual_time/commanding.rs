//! Parameters that command a drive: an application's write of one never reaches a drive whose power is on.
//!
//! The scenarios are the same for every protocol. They look at the drive itself: which writes it has received, and
//! whether its power was on.

use std::collections::BTreeMap;
use std::time::Duration;

use fieldbeat::Simulation;
use fieldbeat::axis::{
    Acyclic, CallError, Command, CommandId, EventKind, Failure, Link, NativeOwner, Outcome, ParameterError,
};
use fieldbeat::bus::linudp::MainState;
use fieldbeat::sim::FaultPlan;
use fieldbeat::time::{MS, S};
use fieldbeat_core::axis::{Call, CallTicket, PostError};
use fieldbeat_linudp::wire::{RtcBlock, RtcCommand};

use crate::virtual_time::carrier::LIMIT;
use crate::virtual_time::kollmorgen::{self, Machine};
use crate::virtual_time::support::{Bench, Rig, RigDrive};

/// A machine of one drive.
pub trait Subject {
    /// A parameter that commands the drive and has no effect while its power is off, and two values of it.
    const WATCHED: (&'static str, [u64; 2]);
    /// Others that may command it.
    const COMMANDING: &'static [&'static str];
    /// One that does not.
    const HARMLESS: (&'static str, u64);

    /// The calls that write the watched parameter.
    fn writes(acyclic: &Acyclic, value: u64) -> Vec<Call> {
        let call = acyclic.notation().write(Self::WATCHED.0, value);
        vec![call.unwrap_or_else(|error| panic!("{error}"))]
    }

    fn sim(&mut self) -> &mut Simulation;

    /// The drive's power is on, as the drive itself has it.
    fn is_on(&mut self) -> bool;

    /// How many writes of [`WATCHED`](Self::WATCHED) the drive has received so far.
    fn received(&mut self) -> usize;
}

/// A subject under way.
struct Run<S> {
    subject: S,
    ends: BTreeMap<CommandId, Outcome>,
    /// The application owns the control word: the rule does not apply.
    native: bool,
    written: usize,
    /// The calls under way that only prepare a write.
    parts: Vec<CallTicket>,
}

impl<S: Subject> Run<S> {
    fn new(subject: S) -> Run<S> {
        let mut run = Run { subject, ends: BTreeMap::new(), native: false, written: 0, parts: Vec::new() };
        run.until("online", 20_000, |run| run.subject.sim().feedback(0).link == Link::Online);
        run
    }

    /// One cycle, in which no write of the watched parameter meets a drive whose power is on.
    fn step(&mut self) {
        let (on, received) = (self.subject.is_on(), self.subject.received());
        self.subject.sim().step();
        self.parts.retain_mut(|part| part.poll().is_none());
        while let Some(event) = self.subject.sim().axis(0).event() {
            if let EventKind::Ended { id, outcome, .. } = event.kind {
                self.ends.insert(id, outcome);
            }
        }
        let met = self.subject.received() > received && (on || self.subject.is_on());
        assert!(!met || self.native, "a write reached a drive whose power is on");
    }

    fn steps(&mut self, count: u64) {
        (0..count).for_each(|_| self.step());
    }

    fn until(&mut self, what: &str, most: u64, mut done: impl FnMut(&mut Run<S>) -> bool) {
        for _ in 0..most {
            if done(self) {
                return;
            }
            self.step();
        }
        panic!("not within {most} cycles: {what}; {:?}", self.subject.sim().feedback(0));
    }

    fn post(&mut self, command: Command) -> CommandId {
        self.subject.sim().axis(0).post(command).unwrap_or_else(|error| panic!("{error}"))
    }

    fn ended(&mut self, id: CommandId) -> Outcome {
        self.until("the end of a command", 20_000, |run| run.ends.contains_key(&id));
        self.ends[&id]
    }

    fn done(&mut self, command: Command) {
        let id = self.post(command);
        assert_eq!(self.ended(id), Outcome::Done, "{command:?}");
    }

    fn acyclic(&mut self) -> Acyclic {
        self.subject.sim().axis(0).acyclic().clone()
    }

    fn call(&mut self, address: &str, value: u64) -> Call {
        self.acyclic().notation().write(address, value).unwrap_or_else(|error| panic!("{address}: {error}"))
    }

    /// Posts a write of the watched parameter, with another value each time.
    fn post_watched(&mut self) -> Result<CallTicket, PostError> {
        let (_, values) = S::WATCHED;
        self.written += 1;
        let acyclic = self.acyclic();
        let calls = S::writes(&acyclic, values[self.written % 2]);
        if let [call] = calls[..] {
            return acyclic.post(call, LIMIT);
        }
        let mut tickets = acyclic.post_series(&calls, LIMIT)?;
        let last = tickets.pop().expect("there is a call");
        self.parts.extend(tickets);
        Ok(last)
    }

    fn call_ended(&mut self, mut ticket: CallTicket) -> Result<u64, CallError> {
        for _ in 0..5_000 {
            if let Some(end) = ticket.poll() {
                return end.map(|answer| answer.value).map_err(of_one);
            }
            self.step();
        }
        panic!("a call without an end");
    }

    /// How a write of the watched parameter ends.
    fn write(&mut self) -> Result<(), CallError> {
        let ticket = self.post_watched().map_err(|error| of_one(error.into()))?;
        self.call_ended(ticket).map(drop)
    }
}

/// Refused for one of several parameters is refused.
fn of_one(error: CallError) -> CallError {
    match error {
        CallError::CommandsAt(_) => CallError::Commands,
        error => error,
    }
}

/// Every write that may command the drive is refused while power is on, in the words of the parameter; any other is
/// carried out.
pub fn refuses_while_on<S: Subject>(subject: S) {
    let mut run = Run::new(subject);
    assert_eq!(run.write(), Ok(()), "off");
    run.done(Command::Enable);
    let received = run.subject.received();
    for address in S::COMMANDING.iter().chain([&S::WATCHED.0]) {
        let parameters = run.acyclic().parameters();
        let refused = parameters.post_write(address, 1_u8).unwrap_err();
        assert!(matches!(refused, ParameterError::Failed { why: CallError::Commands, .. }), "{refused}");
        let text = refused.to_string();
        let parts =
            [*address, "write", "may command the drive", "disable the axis first, or use native mode"];
        assert!(parts.iter().all(|part| text.contains(part)), "{text}");
        assert_eq!(text.lines().count(), 1);
        // Together with others, none of them is carried out.
        let (harmless, value) = S::HARMLESS;
        let calls = [run.call(harmless, value), run.call(address, 1)];
        let refused = run.acyclic().post_series(&calls, LIMIT).unwrap_err();
        assert!(matches!(refused, PostError::Refused { why: CallError::Commands, .. }), "{refused}");
    }
    let call = run.call(S::HARMLESS.0, S::HARMLESS.1);
    let ticket = run.acyclic().post(call, LIMIT).unwrap();
    assert_eq!(run.call_ended(ticket), Ok(S::HARMLESS.1));
    assert_eq!(run.subject.received(), received);
    run.done(Command::Disable);
    assert_eq!(run.write(), Ok(()), "off again");

    // Native mode: exempt where the application owns the control word.
    run.done(Command::Enable);
    run.post(Command::Native(NativeOwner::Master));
    run.steps(20);
    assert_eq!(run.write(), Err(CallError::Commands));
    run.done(Command::QuickStop);
    run.native = true;
    run.post(Command::Native(NativeOwner::Application));
    run.steps(20);
    assert_eq!(run.write(), Ok(()), "native");
    run.done(Command::QuickStop);
    run.native = false;
    run.steps(20);
    if run.subject.is_on() {
        assert_eq!(run.write(), Err(CallError::Commands));
    }
}

/// A write and an enable in the same cycle and in neighbouring ones, in both orders: one waits for the other, or is
/// refused.
pub fn never_meet<S: Subject>(subject: S) {
    let mut run = Run::new(subject);
    let mut ends = BTreeMap::new();
    for gap in (0..=8).chain([11]) {
        for write_first in [true, false] {
            for cancel in [None, Some(0), Some(1), Some(3)] {
                let mut ticket = if write_first { Some(run.post_watched()) } else { None };
                run.steps(if write_first { gap } else { 0 });
                let enable = run.post(Command::Enable);
                run.steps(if write_first { 0 } else { gap });
                let mut ticket = ticket.take().unwrap_or_else(|| run.post_watched());
                if let Some(after) = cancel {
                    run.steps(after);
                    // Its ticket is dropped: nobody waits for it any more.
                    ticket = Err(PostError::Refused { axis: String::new(), why: CallError::Cancelled });
                }
                assert_eq!(run.ended(enable), Outcome::Done, "gap {gap}, write first: {write_first}");
                let end = ticket.map_err(|error| of_one(error.into()));
                let end = end.and_then(|ticket| run.call_ended(ticket));
                let end = end.map(drop);
                let known = matches!(end, Ok(()) | Err(CallError::Commands | CallError::Cancelled));
                assert!(known, "gap {gap}, write first: {write_first}: {end:?}");
                *ends.entry(format!("{end:?}")).or_insert(0) += 1;
                run.steps(30);
                run.done(Command::Disable);
            }
        }
    }
    assert!(ends.len() == 3, "no race at all: {ends:?}");
}

/// Random sequences of everything that switches power or writes.
pub fn never_in_any_sequence<S: Subject>(subject: S, seed: u64, length: usize) {
    let mut run = Run::new(subject);
    let mut random = fastrand::Rng::with_seed(seed);
    let mut tickets = Vec::new();
    let (mut done, mut refused) = (0, 0);
    let mut count = |end: Result<(), CallError>| match end {
        Ok(()) => done += 1,
        Err(_) => refused += 1,
    };
    for _ in 0..length {
        match random.u32(0..12) {
            0..=1 => drop(run.post(Command::Enable)),
            2..=3 => drop(run.post(Command::Disable)),
            4 => drop(run.post(Command::QuickStop)),
            5..=7 => match run.post_watched() {
                Ok(ticket) => tickets.push(ticket),
                Err(_) => count(Err(CallError::Commands)),
            },
            8 => {
                let call = run.call(S::HARMLESS.0, S::HARMLESS.1);
                // The queue may be full.
                tickets.extend(run.acyclic().post(call, LIMIT).ok());
            }
            9 if !tickets.is_empty() => drop(tickets.swap_remove(random.usize(0..tickets.len()))),
            10 => {
                // Native mode, and back out of it. What is posted in it ends in it.
                let power_off = run.post(Command::Disable);
                run.ended(power_off);
                for ticket in tickets.drain(..) {
                    count(run.call_ended(ticket).map(drop));
                }
                run.native = true;
                run.post(Command::Native(NativeOwner::Application));
                run.steps(random.u64(0..20));
                if random.bool() {
                    count(run.write());
                }
                run.done(Command::Disable);
                run.native = false;
            }
            _ => {}
        }
        run.steps(random.u64(0..40));
        if random.u32(0..8) == 0 {
            // Long enough for power to come on.
            run.steps(400);
        }
        tickets.retain_mut(|ticket| match ticket.poll() {
            Some(end) => {
                count(end.map(drop));
                false
            }
            None => true,
        });
    }
    assert!(done > 0 && refused > 0, "seed {seed}: {done} carried out, {refused} not");
}

// LinMot: every telegram stands on the tape.

struct LinMot {
    bench: Bench,
    received: usize,
    on: bool,
}

impl LinMot {
    fn new(rig: Rig) -> LinMot {
        LinMot { bench: rig.start(), received: 0, on: false }
    }

    /// Takes what is new on the tape.
    fn look(&mut self) {
        let mut tape = self.bench.tape(0);
        for received in tape.received.drain(..) {
            let is_one = |block: RtcBlock| block.code == RtcCommand::WRITE_RAM.0 && block.index() == RUN_MODE;
            self.received += usize::from(received.request.config.is_some_and(is_one));
            if let Some(state) = received.reply.and_then(|reply| reply.state) {
                self.on = state.main() >= MainState::HW_TESTS;
            }
        }
    }
}

fn linmot(faults: FaultPlan) -> LinMot {
    LinMot::new(Rig::new(1).each(|_, drive| drive.axis.health.bucket = 100_000).faults(faults))
}

const RUN_MODE: u16 = 0x1450;

impl Subject for LinMot {
    const WATCHED: (&'static str, [u64; 2]) = ("0x1450", [1, 16]);
    const COMMANDING: &'static [&'static str] = &[
        "0x145A", "0x1039", "0x170C", "0x1060", "0x1070", "0x1528", "0x1E72", "0x6300", "0x1455", "0x13C7",
        "0x30D4",
    ];
    const HARMLESS: (&'static str, u64) = ("0x13A2", 7);

    fn sim(&mut self) -> &mut Simulation {
        &mut self.bench.sim
    }

    fn is_on(&mut self) -> bool {
        self.look();
        self.on
    }

    fn received(&mut self) -> usize {
        self.look();
        self.received
    }
}

#[test]
fn a_linmot_is_not_commanded_by_parameters_while_its_power_is_on() {
    refuses_while_on(linmot(FaultPlan::default()));
    never_meet(linmot(FaultPlan::default()));
    never_meet(linmot(FaultPlan { seed: 3, drop: 0.1, ..FaultPlan::default() }));
    // Busy with each write for longer than an enable takes to bring power on.
    let busy = |_: usize, drive: &mut RigDrive| drive.simulate.config_time_ns = 20 * MS;
    never_meet(LinMot::new(Rig::new(1).each(busy)));
    for seed in 0..4 {
        let drop = if seed % 2 == 0 { 0.0 } else { 0.05 };
        never_in_any_sequence(linmot(FaultPlan { seed, drop, ..FaultPlan::default() }), seed, 150);
    }
}

#[test]
fn an_enable_waits_for_a_write_no_longer_than_its_own_time() {
    let rig = Rig::new(1).each(|_, drive| {
        drive.simulate.config_time_ns = 300 * MS;
        drive.axis.enable_timeout = Duration::from_millis(600);
    });
    let mut run = Run::new(LinMot::new(rig));
    // It is carried out in 300 ms.
    let ticket = run.post_watched().unwrap();
    run.steps(5);
    let enable = run.post(Command::Enable);
    // Others do not hold it up for ever.
    run.steps(5);
    assert!(matches!(run.post_watched(), Err(PostError::Refused { .. })));
    assert_eq!(run.call_ended(ticket), Ok(16));
    assert_eq!(run.ended(enable), Outcome::Done);
    run.done(Command::Disable);
    // Three of them in a row: only that under way is waited for.
    let tickets: Vec<_> = (0..3).map(|_| run.post_watched().unwrap()).collect();
    run.steps(5);
    let enable = run.post(Command::Enable);
    let ends: Vec<_> = tickets.into_iter().map(|ticket| run.call_ended(ticket).is_ok()).collect();
    assert_eq!(ends, [true, false, false]);
    assert_eq!(run.ended(enable), Outcome::Done);
    run.done(Command::Disable);
}

#[test]
fn a_write_still_under_way_delays_an_enable() {
    let rig = Rig::new(1).each(|_, drive| {
        drive.simulate.config_time_ns = 3 * S;
        drive.axis.enable_timeout = Duration::from_millis(600);
    });
    let mut run = Run::new(LinMot::new(rig));
    let ticket = run.post_watched().unwrap();
    run.steps(5);
    let enable = run.post(Command::Enable);
    assert_eq!(run.ended(enable), Outcome::Failed(Failure::BeingWritten));
    // Nobody waits for it any more, and the drive is busy with it all the same.
    drop(ticket);
    run.steps(20);
    let enable = run.post(Command::Enable);
    assert_eq!(run.ended(enable), Outcome::Failed(Failure::BeingWritten));
    assert!(!run.subject.is_on());
    // Once it is over that is found out without another call.
    run.steps(8_000);
    run.done(Command::Enable);
}

// Kollmorgen: the drive's mode shows what was written.

struct Kollmorgen {
    machine: Machine,
    mode: i8,
    changes: usize,
}

fn kollmorgen_drive() -> Kollmorgen {
    let mut machine = Machine::new(kollmorgen::plan(1));
    machine.online();
    let mode = machine.drive(0, |drive| drive.mode());
    Kollmorgen { machine, mode, changes: 0 }
}

impl Subject for Kollmorgen {
    const WATCHED: (&'static str, [u64; 2]) = ("0x6060:0", [3, 0x80]);
    const COMMANDING: &'static [&'static str] = &[
        "0x6040:0",
        "0x60FF:0",
        "0x607A:0",
        "0x6071:0",
        "0x60C1:1",
        "0x606B:0",
        "0x6074:0",
        "0x60B1:0.i32",
        "0x60FE:1.u32",
        "0x6093:1",
        "0x605A:0.i16",
        "0x1C12:0",
        "0x1C13:1",
        "0x1600:0.u8",
        "0x1701:1.u32",
        "0x1A00:1.u32",
        "0x1011:1.u32",
        "0x2308:0.i32",
        "0x2355:0.i32",
        "0x3500:1.u32",
        "0x35D5:1",
    ];
    const HARMLESS: (&'static str, u64) = ("0x6083:0", 7_000);

    fn sim(&mut self) -> &mut Simulation {
        &mut self.machine.sim
    }

    fn is_on(&mut self) -> bool {
        self.machine.drive(0, |drive| drive.axis_state()).is_powered()
    }

    fn received(&mut self) -> usize {
        let mode = self.machine.drive(0, |drive| drive.mode());
        self.changes += usize::from(std::mem::replace(&mut self.mode, mode) != mode);
        self.changes
    }
}

#[test]
fn a_kollmorgen_is_not_commanded_by_objects_while_its_power_is_on() {
    refuses_while_on(kollmorgen_drive());
    never_meet(kollmorgen_drive());
    for seed in 0..3 {
        never_in_any_sequence(kollmorgen_drive(), seed, 150);
    }
}
