//! As many exchanges as the formula has: whole turns that begin inside the windows, each as long as rate, bytes,
//! MaxTsdr and idle time make it.

use fieldbeat::bus::profibus::ProfibusPlan;
use fieldbeat::telemetry::{Counters, Summary};
use fieldbeat::time::{MS, S, US};
use fieldbeat::{CyclePlan, Plan};
use fieldbeat_core::bus::Grid;
use fieldbeat_core::rt::Granted;
use fieldbeat_profibus::counters::Own;

use super::{Lenze, cycle, own, wire};

/// A time in which the pattern of turns and windows repeats itself.
const WHOLE: u64 = 6 * S;

/// A wire on which each drive waits for its next turn all the time, and is answered as late as it may be.
fn full(rate: u32, drives: usize, cycle: &CyclePlan) -> (Lenze, ProfibusPlan) {
    let mut bus = wire(rate, drives);
    // What the master sends itself is no exchange.
    (bus.token, bus.gap, bus.global_control_ns) = (false, None, 10 * S);
    let max_tsdr = bus.bits.max_tsdr as u16;
    let lenze = Lenze::with(bus.clone(), cycle.clone(), |segment| {
        segment.drives.iter_mut().for_each(|drive| drive.link.answer_bits = Some(max_tsdr));
    });
    (lenze, bus)
}

/// Exchanges, and the time that they took on the wire, µs.
fn answered(counters: &[Counters]) -> [u64; 2] {
    let sum = |of: fn(&Counters) -> u64| counters.iter().map(of).sum();
    [sum(|counters| counters.answered), sum(|counters| own(counters, Own::WireUs))]
}

#[test]
fn a_wire_carries_the_exchanges_that_the_formula_allows() {
    let wide = cycle();
    let usual = CyclePlan::default();
    // 12 bytes each way.
    let table = [
        (500_000, 3, &wide, 800 * US, 834),
        (1_500_000, 3, &usual, 500 * US, 2_000),
        (12_000_000, 9, &wide, 800 * US, 8_000),
    ];
    for (rate, drives, cycle, deadline_ns, a_second) in table {
        let grid = Grid { period_ns: MS, deadline_ns };
        let run = |cycles: u64| {
            let (mut m, _) = full(rate, drives, cycle);
            m.online();
            m.sim.run(100 + cycles);
            let counters = m.finish();
            for counters in &counters {
                let Counters { sent, answered, missed, late, malformed, .. } = *counters;
                assert!(missed + late + malformed == 0 && sent - answered <= 1, "{rate}: {counters:?}");
            }
            answered(&counters)
        };
        let (_, bus) = full(rate, drives, cycle);
        assert_eq!(bus.exchanges_within(S, grid), a_second, "{rate}");
        // The same run, so much longer.
        let (until, from) = (run(WHOLE / MS), run(0));
        let [measured, wire_us] = [until[0] - from[0], until[1] - from[1]];
        assert_eq!(measured, bus.exchanges_within(WHOLE, grid), "{rate}: {} a second", measured / 6);
        let idle_ns = bus.line().bits_ns(bus.bits.idle.into());
        assert_eq!(wire_us / measured, (bus.usual_turn_ns(0) - idle_ns) / US, "{rate}: us of an exchange");
    }
}

#[test]
fn the_latency_of_a_port_is_no_time_on_the_wire() {
    let mut bus = wire(1_500_000, 1);
    (bus.bits.latency_ns, bus.drives[0].axis.divisor) = (3 * MS, 16);
    let idle_ns = bus.line().bits_ns(bus.bits.idle.into());
    let most_us = (bus.usual_turn_ns(0) - bus.bits.latency_ns - idle_ns).div_ceil(US);
    // The answer comes behind the window, and is read with the next one.
    let mut m = Lenze::new(bus, CyclePlan { receive_deadline: 0.3, ..CyclePlan::default() });
    m.online();
    let counters = |m: &Lenze| m.sim.numbers().drives[0].counters;
    let before = counters(&m);
    m.sim.run(1_600);
    let after = counters(&m);
    let count = after.answered - before.answered;
    let wire_us = own(&after, Own::WireUs) - own(&before, Own::WireUs);
    assert!(count >= 99 && wire_us <= count * most_us, "{wire_us} us of {count}, {most_us} at most");
}

#[test]
fn the_summary_states_the_bus_load() {
    let (mut m, bus) = full(12_000_000, 9, &cycle());
    m.online();
    m.sim.run(3_000);
    let measured = m.sim.measured().clone();
    let numbers = m.sim.finish();
    let plan = Plan { cycle: cycle(), buses: vec![Box::new(bus)], ..Plan::default() };
    let granted = Granted { policy: "", priority: 0, core: None, memory_locked: false, missing: Vec::new() };
    let summary = Summary::of(&plan, &numbers, &measured, &granted, None);
    // Eight exchanges of 105 us in each cycle, behind a start-up with less.
    let json = serde_json::to_value(&summary).unwrap();
    let load = json["buses"][0]["load_percent"].as_f64().unwrap();
    assert!(load > 75.0 && load < 84.0, "{load}");
    assert!(summary.to_string().contains(&format!("\nbus profibus-dp: bus load {load:.1} %\n")), "{summary}");
}
