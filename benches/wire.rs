//! The nanoseconds of one exchange without a socket: LinUDP encode, station and decode, for an axis in operation.
//!
//! - `exchange`: what the loop does for a drive and cycle: build the request in place, note that it was sent, take the reply
//!   in (identity, states, units, feedback, native process data).
//! - `encode`, `encode motion`, `decode`: the telegram alone.
//!
//! Positions change with every reply, and the cycle with every request, so that nothing can be computed beforehand.

#[allow(dead_code, reason = "each bench uses a part of it")]
mod support;

use std::hint::black_box;
use std::net::Ipv4Addr;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use criterion::{Criterion, Throughput};
use fieldbeat::axis::{Link, State, Verb};
use fieldbeat::bus::linudp::motion::{Acceleration, MotionCommand, Position, Velocity};
use fieldbeat::bus::linudp::native::Native;
use fieldbeat::bus::linudp::station::Station;
use fieldbeat::bus::linudp::wire::{
    ControlWord, MainState, REQUEST_MAX, RESPONSE_MAX, Request, RequestDef, Response, ResponseDef, StateVar,
    StatusWord,
};
use fieldbeat::bus::{Counters, Cycle, Order, Slot};
use fieldbeat::time::{MS, Time, US};
use serde_json::{Value, json};
use support::stats::Interval;
use support::{Args, Report, rig};

/// Budget of `exchange`, ns.
const EXCHANGE_NS: f64 = 60.0;
const PERIOD_NS: u64 = MS;

/// A station, and a drive that answers it from memory.
struct Exchanged {
    station: Station,
    /// Kept, as an application would.
    _native: Native,
    slot: Slot,
    request: [u8; REQUEST_MAX],
    reply: [u8; RESPONSE_MAX],
    reply_length: usize,
    cycle: Cycle,
}

impl Exchanged {
    /// Where the actual position is in a cyclic reply: behind definitions, status and state.
    const POSITION: std::ops::Range<usize> = 12..16;

    /// An axis in operation and moving.
    fn operational() -> Exchanged {
        let (station, native, _acyclic) = Station::new(&rig::drive(Ipv4Addr::new(127, 90, 1, 10)));
        let mut exchanged = Exchanged {
            station,
            _native: native,
            slot: Slot { due: true, link: Link::Online, ..Slot::default() },
            request: [0; REQUEST_MAX],
            reply: [0; RESPONSE_MAX],
            reply_length: 0,
            cycle: Cycle { index: 0, grid: Time(0), period_ns: PERIOD_NS, deadline: Time(PERIOD_NS / 2) },
        };
        exchanged.answer(RequestDef::NONE, MainState::READY_TO_SWITCH_ON);
        exchanged.turn();
        exchanged.slot.order = Order { serial: 1, verb: Some(Verb::Enable) };
        exchanged.answer(RequestDef::CONTROL, MainState::READY_TO_SWITCH_ON);
        (0..3).for_each(|_| exchanged.turn());
        exchanged.answer(RequestDef::CONTROL, MainState::OPERATION_ENABLED);
        (0..3).for_each(|_| exchanged.turn());
        assert_eq!(exchanged.slot.report.state, State::OperationEnabled);
        assert_eq!(exchanged.slot.progress.end, Some(Ok(())));
        exchanged
    }

    /// What the drive answers from now on.
    fn answer(&mut self, request_def: RequestDef, state: MainState) {
        self.reply_length = reply(request_def, state).emit(&mut self.reply);
    }

    /// One exchange.
    fn turn(&mut self) {
        self.cycle.index += 1;
        self.cycle.grid = self.cycle.grid + PERIOD_NS;
        self.cycle.deadline = self.cycle.grid + PERIOD_NS / 2;
        let sent_at = self.cycle.grid + 5 * US;
        black_box(self.station.prepare(&self.cycle, &mut self.slot, &mut self.request));
        black_box(&self.request);
        self.station.sent(sent_at, self.cycle.deadline, &mut self.slot);
        let position = (self.cycle.index as i32).wrapping_mul(100);
        self.reply[Self::POSITION].copy_from_slice(&position.to_le_bytes());
        let reply = black_box(&self.reply[..self.reply_length]);
        self.station.take(sent_at + 40 * US, reply, true, &mut self.slot);
        black_box(&self.slot);
    }
}

fn reply(request_def: RequestDef, state: MainState) -> Response {
    let operating = state == MainState::OPERATION_ENABLED;
    let on = StatusWord::OPERATION_ENABLED | StatusWord::SWITCH_ON_ACTIVE | StatusWord::MOTION_ACTIVE;
    let sub = if operating { StateVar::MOTION_ACTIVE | StateVar::HOMED } else { 0 };
    Response {
        request_def,
        response_def: ResponseDef::CYCLIC,
        // The hardware enable is there.
        status: Some(StatusWord(
            StatusWord::HOMED | StatusWord::VOLTAGE_ENABLE | if operating { on } else { 0 },
        )),
        state: Some(StateVar::new(state, sub)),
        actual: Some(123_456),
        demand: Some(123_500),
        current: Some(250),
        ..Response::default()
    }
}

fn main() -> ExitCode {
    let args = Args::parse("wire");
    println!("wire: one exchange without a socket");
    let (warm_up, measurement) = if args.quick { (200, 1_000) } else { (1_000, 5_000) };
    let output = Path::new(env!("CARGO_TARGET_TMPDIR")).join("criterion");
    let mut criterion = Criterion::default()
        .output_directory(&output)
        .without_plots()
        .warm_up_time(Duration::from_millis(warm_up))
        .measurement_time(Duration::from_millis(measurement));

    let mut group = criterion.benchmark_group("linudp-v2");
    group.throughput(Throughput::Elements(1));
    let mut exchanged = Exchanged::operational();
    group.bench_function("exchange", |bencher| bencher.iter(|| exchanged.turn()));
    let standing =
        Request { response_def: ResponseDef::CYCLIC, control: Some(ControlWord::ON), ..Request::default() };
    let ramp = Acceleration(1_000_000);
    let go_to = MotionCommand::vai_go_to(Position(123_456), Velocity(500_000), ramp, ramp);
    let moving = Request { motion: Some(go_to.block(5)), ..standing };
    let mut bytes = [0; REQUEST_MAX];
    for (name, request) in [("encode", standing), ("encode motion", moving)] {
        group.bench_function(name, |bencher| {
            bencher.iter(|| black_box(&request).emit(black_box(&mut bytes)));
        });
    }
    let mut bytes = [0; RESPONSE_MAX];
    let length = reply(RequestDef::CONTROL, MainState::OPERATION_ENABLED).emit(&mut bytes);
    group.bench_function("decode", |bencher| bencher.iter(|| Response::parse(black_box(&bytes[..length]))));
    group.finish();

    let mut report = Report::default();
    for name in ["exchange", "encode", "encode motion", "decode"] {
        let estimate = estimate(&output.join("linudp-v2").join(name).join("new/estimates.json"));
        report.enter(
            format!("linudp-v2/{name}"),
            json!({ "ns": estimate.map(|ns| ns.value), "interval": estimate.map(|ns| ns.ends()) }),
        );
        if name == "exchange" {
            report.time("linudp-v2: encode + station + decode", estimate, EXCHANGE_NS, "ns");
        }
    }
    let Counters { sent, answered, .. } = exchanged.slot.counters;
    report.count(format!("linudp-v2: sent {sent} = answered {answered}"), sent == answered);
    report.finish(&args)
}

/// What criterion found: the median, since a mean on a shared machine is that of its worst moments.
fn estimate(path: &Path) -> Option<Interval> {
    let text = std::fs::read_to_string(path).ok()?;
    let median = &serde_json::from_str::<Value>(&text).ok()?["median"];
    let bound = |name: &str| median["confidence_interval"][name].as_f64();
    Some(Interval {
        value: median["point_estimate"].as_f64()?,
        low: bound("lower_bound")?,
        high: bound("upper_bound")?,
    })
}
