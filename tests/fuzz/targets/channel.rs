//! The parameter channel of one drive: calls, alone and in series, that are posted, cancelled and forgotten at any
//! moment, on a wire that loses, repeats and delays, to a drive that restarts, falls silent and is written to by
//! somebody else.
//!
//! Every call carries a value of its own, and the drive makes its answer of that value and keeps a ledger of what it
//! carried out. So an answer says whose it is, whatever the channel's four bits of identity say.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddrV4;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use fieldbeat::axis::{AxisPlan, CallError, Command, Health, Link, NativeOwner, Units};
use fieldbeat::bus::linudp::{
    COUNTS_PER_MM, LinUdpDrive, LinUdpPlan, MonitorPlan, Native, NativeOutput, ReplyTag,
};
use fieldbeat::sim::{FaultPlan, SimDrive, WorldOptions};
use fieldbeat::time::{MS, Time, US};
use fieldbeat::{CyclePlan, Master, Overrun, Plan, Simulation};
use fieldbeat_core::axis::acyclic::Carrier;
use fieldbeat_core::axis::{Answer, Call, CallTicket, PostError};
use fieldbeat_linudp::rtc::UNACKNOWLEDGED;
use fieldbeat_linudp::upid::{Upid, call};
use fieldbeat_linudp::wire::{Request, Response, RtcBlock, RtcCommand, RtcStatus};
use fieldbeat_sim::linudp::{FlashMode, LinMotSettings};

use super::input::Input;
use super::machine::hostile::HostileBus;

/// Long, so that the times of the channel pass in few cycles.
const PERIOD_NS: u64 = 10 * MS;
const CAPACITY: usize = 6;

/// A program is short, so that many of them can be run.
const MOST_TURNS: u64 = 400;

/// The longest that a call of this target is given, in cycles.
const LONGEST: u64 = 60;

/// Replies that may come once more: fewer than there are counts, or no master could tell them apart.
const REMEMBERED: usize = 4;

/// Commands that a drive carries out without any trace but their answer, and those that change how it is.
const PLAIN: [RtcCommand; 8] = [
    RtcCommand::READ_RAM,
    RtcCommand::WRITE_RAM,
    RtcCommand::START_LIST,
    RtcCommand::NEXT_ITEM,
    RtcCommand::GET_CURVE,
    RtcCommand::GET_CURVE_DATA,
    RtcCommand::ERROR_COUNTERS,
    RtcCommand::DELETE_CURVES,
];
const GRAVE: [RtcCommand; 4] =
    [RtcCommand::STOP_SOFTWARE, RtcCommand::START_SOFTWARE, RtcCommand::SAVE_CURVES, RtcCommand::RESTART];

pub fn channel(data: &[u8]) {
    let mut input = Input(data);
    let mut bench = Bench::new(&mut input);
    while !input.is_over() && bench.turn < MOST_TURNS {
        bench.operate(&mut input);
    }
    bench.finish();
}

/// What the drive makes of a plain call: its status and its value.
fn answer_to(value: u32) -> (u8, u32) {
    let status = match value % 8 {
        0 => 0xC0,
        1 => RtcStatus::BLOCK_NOT_FINISHED,
        _ => RtcStatus::DONE,
    };
    (status, value ^ 0xA5A5_5A5A)
}

/// What the drive has done.
#[derive(Debug, Default)]
struct Ledger {
    /// The block that its stored count is from.
    stored: RtcBlock,
    carried_out: BTreeSet<u32>,
    /// So often it has begun anew, or its software was stopped or started.
    restarts: u64,
    said: VecDeque<Vec<u8>>,
    /// So many replies more are lost.
    silence: u32,
}

/// The simulated drive, with answers of its own to plain calls.
struct LedgerDrive {
    drive: Box<dyn SimDrive>,
    ledger: Arc<Mutex<Ledger>>,
}

impl LedgerDrive {
    /// The drive below counts along: a plain call is to it a command that does nothing.
    fn ask(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        let Ok(mut request) = Request::parse(bytes) else {
            return self.drive.receive(now, from, bytes, reply);
        };
        let requested = request.config;
        let plain = requested.filter(|block| !GRAVE.contains(&RtcCommand(block.code)));
        if let Some(block) = plain {
            request.config = Some(RtcBlock { code: RtcCommand::NO_OPERATION.0, ..block });
        }
        let mut quiet = bytes.to_vec();
        request.emit(&mut quiet);
        let to = self.drive.receive(now, from, &quiet, reply)?;
        let (Some(requested), Ok(mut response)) = (requested, Response::parse(reply)) else {
            return Some(to);
        };
        let Some(answer) = &mut response.config else { return Some(to) };
        let mut ledger = self.ledger.lock().unwrap();
        // Not taken if it is busy with the one before.
        if answer.count() == requested.count() && ledger.stored.count() != requested.count() {
            ledger.stored = requested;
            ledger.carried_out.insert(requested.value());
            match RtcCommand(requested.code) {
                RtcCommand::RESTART => {
                    (ledger.stored, ledger.restarts) = (RtcBlock::default(), ledger.restarts + 1);
                }
                // From without it looks the same.
                RtcCommand::STOP_SOFTWARE | RtcCommand::START_SOFTWARE => ledger.restarts += 1,
                _ => {}
            }
        }
        let stored = ledger.stored;
        if answer.status() == RtcStatus::Done && stored.code != RtcCommand::NO_OPERATION.0 {
            let (status, value) = answer_to(stored.value());
            let [_, low, high] = RtcBlock::call(0, RtcCommand::NO_OPERATION, 0, value).words;
            answer.words = [stored.index(), low, high];
            if !GRAVE.contains(&RtcCommand(stored.code)) {
                answer.code = status;
            }
        }
        response.emit(reply);
        ledger.said.push_front(reply.clone());
        ledger.said.truncate(REMEMBERED);
        Some(to)
    }
}

impl SimDrive for LedgerDrive {
    crate::forward_sim_drive!(drive);

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        let to = self.ask(now, from, bytes, reply)?;
        let mut ledger = self.ledger.lock().unwrap();
        let received = ledger.silence == 0;
        ledger.silence = ledger.silence.saturating_sub(1);
        received.then_some(to)
    }

    fn restart(&mut self, now: Time) {
        let mut ledger = self.ledger.lock().unwrap();
        (ledger.stored, ledger.restarts) = (RtcBlock::default(), ledger.restarts + 1);
        self.drive.restart(now);
    }
}

/// A call whose ticket is held.
#[derive(Debug)]
struct Posted {
    call: Call,
    ticket: CallTicket,
    /// Turns of the loop.
    at: u64,
    limit: u64,
    cancelled: Option<u64>,
    /// Of which series, and the place in it.
    series: Option<(u64, usize)>,
}

struct Bench {
    sim: Simulation,
    bus: BusHandles,
    native: Native,
    held: Vec<Posted>,
    turn: u64,
    /// The value of the next call; no two have the same.
    next: u32,
    series: u64,
    /// The place of the call in each series that failed first.
    failed: BTreeMap<u64, usize>,
    /// Series of which a ticket was dropped: they may have failed there.
    forgotten: BTreeSet<u64>,
    /// When a value stood in a request for the first time.
    sent: BTreeMap<u32, u64>,
    last_block: Option<RtcBlock>,
    /// The last turn in which the link was not online.
    offline: u64,
    native_used: bool,
    /// The last turns in which a native block went out, and in which datagrams overtook others.
    native_at: u64,
    disorder_at: u64,
    disorder: bool,
    /// The application looks at its tickets now and then only.
    lazy: bool,
    /// The longest that everything posted so far may take.
    owed: u64,
}

/// What is shared with the bus while the machine runs.
struct BusHandles {
    wire: Arc<Mutex<super::machine::hostile::Wire>>,
    ledger: Arc<Mutex<Ledger>>,
    drive: SocketAddrV4,
    master: SocketAddrV4,
}

impl Bench {
    fn new(input: &mut Input<'_>) -> Bench {
        let features = input.byte();
        let has = |bit: u8| features >> bit & 1 == 1;
        let mut axis = AxisPlan::new("x", Units::millimetres(COUNTS_PER_MM));
        axis.parameter_queue = CAPACITY;
        axis.health = Health {
            bucket: if has(0) { 3 } else { 100 },
            gate: 2,
            probe_interval: Duration::from_millis(40),
            ..Health::default()
        };
        let sources = [Some(Upid(0x1E0F)), None, Some(Upid(0x1BCD)), None];
        let drive = LinUdpDrive {
            monitor: if has(1) { MonitorPlan::Sources(sources) } else { MonitorPlan::Off },
            reply_tag: if has(2) { ReplyTag::Count } else { ReplyTag::Definition },
            stream: None,
            axis,
            ..LinUdpDrive::new("", [10, 0, 1, 1].into())
        };
        let settings = LinMotSettings {
            config_time_ns: if has(3) { 25 * MS } else { 0 },
            flash_time_ns: 150 * MS,
            flash: if has(4) { FlashMode::Busy } else { FlashMode::Silent },
            ..LinMotSettings::new(drive.address)
        };
        let plan = LinUdpPlan::new([10, 0, 0, 1].into(), vec![drive]);
        let (address, bind) = (plan.drives[0].address, plan.bind);
        let bus = HostileBus::new(plan);
        let handles =
            BusHandles { wire: Arc::clone(&bus.wire), ledger: Arc::default(), drive: address, master: bind };
        let own = |drive| {
            let ledger = Arc::clone(&handles.ledger);
            Box::new(LedgerDrive { drive, ledger }) as Box<dyn SimDrive>
        };
        let simulated: Vec<_> = bus.simulated(vec![settings]).into_iter().map(own).collect();
        let cycle = CyclePlan {
            period_ns: PERIOD_NS,
            overrun: Overrun::Skip { max_skip: 3 },
            ..CyclePlan::default()
        };
        let plan = Plan { source: None, cycle, buses: vec![Box::new(bus)], groups: Vec::new() };
        let setup = Master::from_plan(plan);
        let mut sim =
            setup.simulate_with(simulated, WorldOptions::default()).expect("the machine can be built");
        let native = *sim.axis(0).native().expect("a LinUDP axis");
        Bench {
            sim,
            bus: handles,
            native,
            held: Vec::new(),
            turn: 0,
            next: 1,
            series: 0,
            failed: BTreeMap::new(),
            forgotten: BTreeSet::new(),
            sent: BTreeMap::new(),
            last_block: None,
            offline: 0,
            native_used: false,
            native_at: 0,
            disorder_at: 0,
            disorder: false,
            lazy: has(5),
            owed: 0,
        }
    }

    fn ledger(&self) -> MutexGuard<'_, Ledger> {
        self.bus.ledger.lock().unwrap()
    }

    /// One instruction of the program.
    fn operate(&mut self, input: &mut Input<'_>) {
        match input.byte() % 24 {
            0..=5 => (0..=input.below(12)).for_each(|_| self.turn()),
            6..=9 => self.post(1, false, input),
            10 | 11 => {
                let calls = 1 + input.below(CAPACITY + 1);
                self.post(calls, true, input);
            }
            12 => {
                let place = input.below(2 * CAPACITY);
                if let Some(posted) = self.held.get_mut(place) {
                    posted.ticket.cancel();
                    posted.cancelled.get_or_insert(self.turn);
                }
            }
            13 => {
                let place = input.below(2 * CAPACITY);
                if place < self.held.len() {
                    self.forget(place);
                }
            }
            14 => (0..self.held.len()).for_each(|_| self.forget(0)),
            15 => self.ledger().silence = u32::from(input.byte()) % 8,
            16 | 17 => self.weather(input),
            18 => self.say_again(input),
            19 => drop(self.sim.world().restart(self.bus.drive)),
            20 => {
                let plugged = input.flag();
                let world = self.sim.world();
                if plugged {
                    world.plug(self.bus.drive)
                } else {
                    world.unplug(self.bus.drive)
                };
            }
            21 => self.bus.wire.lock().unwrap().jammed[0] ^= true,
            22 => {
                let owner = input.of(&[NativeOwner::Master, NativeOwner::Application]);
                let _ = self.sim.axis(0).post(Command::Native(owner));
            }
            _ => {
                self.native_used = true;
                let config = RtcBlock::command(input.byte(), RtcCommand::NO_OPERATION);
                let _ = self.native.write(NativeOutput { control: None, motion: None, config: Some(config) });
            }
        }
    }

    /// Drops a ticket.
    fn forget(&mut self, place: usize) {
        let posted = self.held.remove(place);
        self.forgotten.extend(posted.series.map(|(series, _)| series));
    }

    fn post(&mut self, count: usize, series: bool, input: &mut Input<'_>) {
        let calls: Vec<Call> = (0..count)
            .map(|_| {
                let grave = input.byte() >= 0xF0;
                let command = if grave { input.of(&GRAVE) } else { input.of(&PLAIN) };
                self.next += 1;
                call(command, u16::from(input.byte()) + 1, self.next)
            })
            .collect();
        let limit = u64::from(input.byte()) % LONGEST;
        let time = Duration::from_nanos(limit * PERIOD_NS);
        // A call has at least 20 exchanges.
        let limit = limit.max(20);
        let acyclic = self.sim.axis(0).acyclic();
        let tickets = match series {
            true => acyclic.post_series(&calls, time),
            false => acyclic.post(calls[0], time).map(|ticket| vec![ticket]),
        };
        // Full is an answer too.
        let Ok(tickets) = tickets else { return };
        self.series += 1;
        for (place, (call, ticket)) in calls.into_iter().zip(tickets).enumerate() {
            self.owed += limit + 4;
            let series = series.then_some((self.series, place));
            self.held.push(Posted { call, ticket, at: self.turn, limit, cancelled: None, series });
        }
    }

    fn weather(&mut self, input: &mut Input<'_>) {
        let clear = FaultPlan { seed: u64::from(input.byte()), ..FaultPlan::default() };
        let kind = input.below(6);
        self.disorder = kind >= 3;
        let plan = match kind {
            0 => clear,
            1 => FaultPlan { drop: 0.3, ..clear },
            2 => FaultPlan { duplicate: 0.5, ..clear },
            3 => FaultPlan { reorder: 0.3, ..clear },
            4 => FaultPlan { delay: 0.5, delay_ns: PERIOD_NS - 30 * US, ..clear },
            _ => FaultPlan { drop: 0.1, delay: 0.3, delay_ns: PERIOD_NS, duplicate: 0.2, ..clear },
        };
        self.sim.world().set_faults(self.bus.drive, plan);
    }

    /// One of its last replies once more, or forged: from somebody else, or with definitions that were not requested.
    fn say_again(&mut self, input: &mut Input<'_>) {
        let (which, after_ns) = (input.below(REMEMBERED), u64::from(input.byte()) * PERIOD_NS / 128);
        let Some(mut reply) = self.ledger().said.get(which).cloned() else { return };
        let mut from = self.bus.drive;
        match input.below(3) {
            0 => {}
            1 => from.set_port(from.port() ^ 1),
            _ => reply[0] ^= 0x80,
        }
        self.disorder_at = self.turn;
        let world = self.sim.world();
        world.inject(self.bus.master, from, &reply, world.now() + after_ns);
    }

    /// One turn of the loop, and all that has to hold behind it.
    fn turn(&mut self) {
        self.turn += 1;
        self.bus.wire.lock().unwrap().clear();
        self.sim.step();
        if self.disorder {
            self.disorder_at = self.turn;
        }
        self.look_at_wire();
        if self.sim.feedback(0).link != Link::Online {
            self.offline = self.turn;
        }
        if self.lazy && !self.turn.is_multiple_of(16) {
            return;
        }
        let mut held = std::mem::take(&mut self.held);
        held.retain_mut(|posted| match posted.ticket.poll() {
            Some(end) => {
                assert_eq!(posted.ticket.poll(), None, "it ended twice: {posted:?}");
                self.ended(posted, end);
                false
            }
            None => true,
        });
        self.held = held;
    }

    fn look_at_wire(&mut self) {
        let wire = self.bus.wire.lock().unwrap();
        assert!(wire.requested.len() <= 1, "the channel sends nothing of its own");
        for requested in &wire.requested {
            let Some(block) = Request::parse(&requested.bytes).unwrap().config else { continue };
            if let Some(last) = self.last_block.filter(|_| !self.native_used) {
                // A drive takes no notice of another block with the same count, which is what is wanted after a silence
                // only.
                let looks =
                    |block: &RtcBlock| (block.code, block.words) == (RtcCommand::READ_RAM.0, [0x20A8, 0, 0]);
                let asked_again = looks(&block) && (GRAVE.contains(&RtcCommand(last.code)) || looks(&last));
                assert!(
                    block.count() != last.count() || block == last || asked_again,
                    "{last:?}, then {block:?}"
                );
                assert!(block.count() < 15, "{block:?}");
            }
            self.last_block = Some(block);
            if block.code == RtcCommand::NO_OPERATION.0 && self.native_used {
                self.native_at = self.turn;
            }
            self.sent.entry(block.value()).or_insert(self.turn);
        }
    }

    /// A native block has any count it likes. For as long as its datagrams may come late, nobody can tell them from
    /// those of a call that happens to have the same one.
    fn is_blurred(&self) -> bool {
        [self.native_at, self.disorder_at].iter().all(|at| *at > 0 && self.turn - at < 12)
    }

    /// Whether a call may end so.
    fn ended(&mut self, posted: &Posted, end: Result<Answer, CallError>) {
        let value = posted.call.value as u32;
        let command = RtcCommand(posted.call.service as u8);
        let grave = GRAVE.contains(&command);
        let restarts = self.ledger().restarts;
        let carried_out = self.ledger().carried_out.contains(&value);
        let (status, answer) = answer_to(value);
        let failed_before = posted
            .series
            .is_some_and(|(series, place)| self.failed.get(&series).is_some_and(|first| *first < place));
        match end {
            // The drive was seen to boot, or came back from a long silence: whether for this, nobody can tell.
            Ok(ok) if grave && (ok == Answer::default() || ok.status == UNACKNOWLEDGED) => {
                assert!(self.sent.contains_key(&value), "{posted:?}");
            }
            Ok(_) | Err(CallError::Refused(_)) if self.is_blurred() => {}
            // It went out in the request that was ready when it was cancelled, or before.
            Ok(_) | Err(CallError::Refused(_)) => {
                assert!(carried_out, "the drive has never seen {posted:?}: {end:?}");
                let late = posted.cancelled.is_some_and(|at| self.sent[&value] > at + 1);
                assert!(!late && !failed_before, "not wanted any more: {posted:?}: {end:?}");
            }
            Err(CallError::Cancelled) => assert!(posted.cancelled.is_some(), "{posted:?}"),
            Err(CallError::Skipped) => {
                let forgotten = posted.series.is_some_and(|(series, _)| self.forgotten.contains(&series));
                assert!((failed_before || forgotten) && !carried_out, "{posted:?}");
            }
            Err(CallError::NotOnline) => assert!(self.offline + 1 >= posted.at, "{posted:?}"),
            // While the link was down, which it is at first, a drive may have forgotten the block that a call goes on
            // with.
            Err(CallError::Restarted) => {
                let goes_on =
                    matches!(command.0, 0x21 | 0x23 | 0x51 | 0x52 | 0x54 | 0x55 | 0x61 | 0x62 | 0x84 | 0x86);
                assert!(restarts > 0 || goes_on && !carried_out, "{posted:?}");
            }
            Err(CallError::TimedOut) => assert!(self.turn >= posted.at + posted.limit, "{posted:?}"),
            Err(CallError::Native) => assert!(self.native_used, "{posted:?}"),
            // What may hold a drive up is not for one whose power is on.
            Err(CallError::Powered) => assert!(grave && !carried_out, "{posted:?}"),
            // Nor is what commands it.
            Err(CallError::Commands) => assert!(!carried_out, "{posted:?}"),
            // Claimed, Full, Gone, Lost, and what is new.
            Err(_) => panic!("{posted:?}: {end:?}"),
        }
        match end {
            _ if self.is_blurred() => {}
            Ok(ok) if grave && (ok == Answer::default() || ok.status == UNACKNOWLEDGED) => {}
            Ok(ok) => {
                assert_eq!((ok.value, ok.address), (answer.into(), posted.call.address), "{posted:?}");
                assert!(grave || ok.status == u32::from(status), "{posted:?}: {ok:?}");
            }
            Err(CallError::Refused(said)) => {
                assert!(grave || said == u32::from(status), "{posted:?}: {said}")
            }
            Err(_) => {}
        }
        if let (Some((series, place)), Err(_)) = (posted.series, end) {
            self.failed.entry(series).or_insert(place);
        }
    }

    /// Clear weather: all calls come to an end, the queue is as empty as it was, and what is posted after the end of
    /// it is reported to the master.
    fn finish(mut self) {
        self.bus.wire.lock().unwrap().jammed[0] = false;
        self.ledger().silence = 0;
        self.sim.world().plug(self.bus.drive);
        self.sim.world().set_faults(self.bus.drive, FaultPlan::default());
        let most = self.turn + self.owed + 200;
        while !self.held.is_empty() {
            assert!(self.turn < most, "no end of {:?}", self.held);
            self.turn();
        }
        // What was forgotten ends as well, and leaves its place to others.
        let limit = Duration::from_nanos(PERIOD_NS);
        let calls = [call(RtcCommand::READ_RAM, 1, 0); CAPACITY];
        while self.sim.axis(0).acyclic().post_series(&calls, limit).is_err() {
            assert!(self.turn < most, "the queue stays full");
            self.turn();
        }
        let acyclic = self.sim.axis(0).acyclic().clone();
        self.sim.finish();
        assert_eq!(acyclic.condition(), Err(CallError::Gone));
        assert!(acyclic.post(calls[0], limit).is_err_and(|error| !matches!(error, PostError::Full { .. })));
    }
}
