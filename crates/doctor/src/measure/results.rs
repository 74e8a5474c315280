//! What was measured.

use std::collections::BTreeMap;

use serde::Serialize;

use super::setting::Setting;
use crate::stats::{Interval, over_rounds};
use fieldbeat_core::cycle::cost::{Costs, MEDIA};

/// The measurements. Serialised, their keys are stable; values are in ns unless the key says otherwise; what the sample
/// does not support is null.
#[derive(Clone, Debug, Serialize)]
pub struct Measured {
    /// The wanted share of late cycles.
    pub miss_rate: f64,
    /// The period that the factors and cores were measured at.
    pub period_ns: u64,
    /// The plan had SCHED_FIFO.
    pub fifo: bool,
    /// The effect of each setting.
    pub factors: Vec<Factor>,
    /// The settings that could not be tried.
    pub untried: Vec<Untried>,
    /// The interruptions of a thread that never sleeps.
    pub noise: Noise,
    /// The plan at its own period, over all slices that ran as planned.
    pub plan: Carries,
    /// The plan at other periods, shortest first; its own one among them.
    pub periods: Vec<Carries>,
    /// The shortest of these periods that was carried, and so were all longer ones.
    pub shortest_period_ns: Option<u64>,
    /// The kernel's time for an exchange.
    pub costs: CostOf,
    /// Time that the hypervisor took from all cores meanwhile, ms.
    pub steal_ms: Option<u64>,
}

/// The kernel's time to hand a request over and to take its reply in, ns; stated where it could not be measured.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CostOf {
    /// By what the exchange is: `datagram`, `stream`, `frame`, `telegram`; to send and to receive, ns.
    pub exchanges_ns: BTreeMap<&'static str, [u64; 2]>,
    /// The time of an interface's driver for a frame, ns.
    pub drivers_ns: BTreeMap<String, u64>,
    /// The same for estimates.
    #[serde(skip)]
    pub costs: Costs,
}

impl From<Costs> for CostOf {
    fn from(costs: Costs) -> CostOf {
        let exchanges = MEDIA.into_iter().zip(&costs.exchanges);
        CostOf {
            exchanges_ns: exchanges.map(|(name, of)| (name, [of.send_ns, of.receive_ns])).collect(),
            drivers_ns: costs.drivers.iter().cloned().collect(),
            costs,
        }
    }
}

/// One thing, without and with.
#[derive(Clone, Debug, Serialize)]
pub struct Factor {
    /// The name of the setting.
    pub name: String,
    /// Wake-up latency without it.
    pub without: Latency,
    /// Wake-up latency with it.
    pub with: Latency,
    /// Median with / without.
    pub p50_ratio: Option<Interval>,
    /// 99 % quantile with / without.
    pub p99_ratio: Option<Interval>,
    /// How to have it, where it helps and the plan has it not.
    pub fix: Option<String>,
}

impl Factor {
    /// How to have what only `with` has.
    pub(super) fn remedy(without: &Setting, with: &Setting) -> String {
        match () {
            () if with.core != without.core => format!("core = {} in [cycle]", with.core),
            () if with.awake && !without.awake => {
                "hold /dev/cpu_dma_latency, as tuned does with the profile of rt-config/host/tuned/"
                    .to_owned()
            }
            () if with.guarded && !without.guarded => {
                "guard = \"auto\" in [cycle]; it costs its share of the core".to_owned()
            }
            () => "realtime = \"require\" in [cycle]".to_owned(),
        }
    }
}

/// Wake-up latency.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Latency {
    /// Wake-ups.
    pub count: usize,
    /// Median.
    pub p50_ns: Option<f64>,
    /// 99 % quantile.
    pub p99_ns: Option<f64>,
    /// Longest.
    pub max_ns: Option<u64>,
}

/// Something that could not be tried.
#[derive(Clone, Debug, Serialize)]
pub struct Untried {
    /// The name of the setting.
    pub name: String,
    /// Why, with the remedy.
    pub why: String,
}

/// Interruptions of a thread that looks at the clock without pause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Noise {
    /// For so long it looked.
    pub looked_ns: u64,
    /// A longer look counts.
    pub gap_ns: u64,
    /// How many did.
    pub gaps: u64,
    /// The longest.
    pub longest_ns: u64,
    /// All of them.
    pub taken_ns: u64,
}

/// How a period is carried.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Carries {
    /// The period.
    pub period_ns: u64,
    /// From when on a wake-up was late.
    pub late_ns: u64,
    /// Wake-ups, passed-over slots among them.
    pub cycles: usize,
    /// Late ones.
    pub late: usize,
    /// Their share.
    pub share: f64,
    /// The share that may lie behind this sample, at most, with 95 % confidence.
    pub at_most: f64,
}

impl Carries {
    /// Of slices with so many late of so many cycles.
    pub(super) fn of(period_ns: u64, late_ns: u64, slices: &[(usize, usize)]) -> Carries {
        let sum = |slices: &mut dyn Iterator<Item = (usize, usize)>| {
            slices.fold((0, 0), |(late, cycles), (more, all)| (late + more, cycles + all))
        };
        let (late, cycles) = sum(&mut slices.iter().copied());
        let share = |(late, cycles): (usize, usize)| late as f64 / cycles.max(1) as f64;
        // Late cycles come in bursts, so that slices are drawn and not cycles; and few or none of them say less than
        // the slices show.
        let drawn = over_rounds(slices.len(), |chosen| {
            share(sum(&mut chosen.iter().filter_map(|slice| slices.get(*slice).copied())))
        });
        let at_most = drawn.high.max(poisson_bound(late) / cycles.max(1) as f64).min(1.0);
        Carries { period_ns, late_ns, cycles, late, share: share((late, cycles)), at_most }
    }

    /// Whether it was late no more often than wanted.
    pub(super) fn is_carried(&self, miss_rate: f64) -> bool {
        self.cycles > 0 && self.share <= miss_rate
    }
}

/// The upper end of a one-sided 95 % interval of a Poisson mean of which `count` were seen: 3 for none ("rule of
/// three"). By Wilson and Hilferty's cube root, within a per cent.
fn poisson_bound(count: usize) -> f64 {
    const Z: f64 = 1.645;
    let n = count as f64 + 1.0;
    (n * (1.0 - 1.0 / (9.0 * n) + Z / (3.0 * n.sqrt())).powi(3)).max(3.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::time::{MS, US};

    #[test]
    fn the_bound_of_few_is_that_of_poisson() {
        // Tables of the Poisson distribution: 95 % one-sided upper limits.
        for (count, bound) in [(0, 2.996), (1, 4.744), (2, 6.296), (5, 10.513), (10, 16.962), (100, 118.1)] {
            let ours = poisson_bound(count);
            assert!((ours / bound - 1.0).abs() < 0.01, "{count}: {ours} {bound}");
        }
    }

    #[test]
    fn a_sample_never_says_more_than_it_holds() {
        let none = Carries::of(MS, 100 * US, &[(0, 500); 6]);
        assert_eq!((none.cycles, none.late, none.share, none.at_most), (3_000, 0, 0.0, 0.001));
        // One bad slice of six: the burst may come again.
        let burst = Carries::of(MS, 100 * US, &[(0, 500), (60, 500), (0, 500), (0, 500), (0, 500), (0, 500)]);
        assert_eq!((burst.late, burst.share), (60, 0.02));
        assert!(burst.at_most > 0.03, "{}", burst.at_most);
        let empty = Carries::of(MS, 100 * US, &[]);
        assert!(empty.at_most == 1.0 && !empty.is_carried(1.0), "{empty:?}");
    }
}
