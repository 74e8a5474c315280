//! As many exchanges as the formula has: whole turns that begin inside the windows, each as long as rate, bytes,
//! MaxTsdr and idle time make it.

use fieldbeat::CyclePlan;
use fieldbeat::bus::Grid;
use fieldbeat::bus::profibus::ProfibusPlan;
use fieldbeat::telemetry::Counters;
use fieldbeat::time::{MS, S, US};

use super::{Lenze, cycle, wire};

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

fn answered(counters: &[Counters]) -> u64 {
    counters.iter().map(|counters| counters.answered).sum()
}

#[test]
fn a_wire_carries_the_exchanges_that_the_formula_allows() {
    let wide = cycle();
    let usual = CyclePlan::default();
    // 12 bytes each way.
    let table = [(1_500_000, 3, &usual, 500 * US, 2_000), (12_000_000, 9, &wide, 800 * US, 8_000)];
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
        let measured = run(WHOLE / MS) - run(0);
        assert_eq!(measured, bus.exchanges_within(WHOLE, grid), "{rate}: {} a second", measured / 6);
    }
}
