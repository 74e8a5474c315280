//! Settings that can be tried at run time, and their effect here: each one off and on, in short slices in turns, and
//! then the plan itself.
//!
//! | file | what |
//! |---|---|
//! | `mod` | what is compared |
//! | `results` | what was measured |
//! | `findings` | what follows from it |
//! | `setting`, `slice` | one slice: a thread set up in one way |
//! | `costs` | what an exchange of each medium costs |
//! | `glance` | what this host carries, in half a second |
//!
//! It measures wake-ups and what the kernel takes for an exchange: the parts of a cycle that the host decides. The
//! loop's own work comes on top.

mod costs;
mod findings;
mod glance;
mod results;
mod setting;
mod slice;

pub use glance::{Glance, glance};

use self::findings::{HELPS, HURTS};
pub(super) use self::findings::{percent, word};
pub use self::results::{Carries, CostOf, Factor, Latency, Measured, Noise, Untried};
use super::Subject;
use super::facts::on_a_thread;
use super::stats::{Interval, Sample};
use fieldbeat_core::cycle::Guard;
use fieldbeat_core::cycle::cost::Demand;
use fieldbeat_core::rt::thread::{fifo, permitted_cores};
use fieldbeat_core::rt::{GuardTuner, Realtime, RealtimeError, host, memory};
use fieldbeat_core::time::{MS, S, US};
use setting::Setting;

/// How thoroughly.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Effort {
    /// About so long in all, ns.
    pub span_ns: u64,
    /// The share of late cycles that the machine tolerates.
    pub miss_rate: f64,
}

impl Default for Effort {
    /// 50 s, which are enough cycles at 1 ms to resolve one late in a thousand, the wanted share.
    fn default() -> Effort {
        Effort { span_ns: 50 * S, miss_rate: 1e-3 }
    }
}

/// The running measurement, for a display.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress<'a> {
    /// The measured setting.
    pub what: &'a str,
    /// The share of all that is done.
    pub done: f64,
}

/// One way to run, and its wake-ups.
struct Contender {
    setting: Setting,
    period_ns: u64,
    guard: GuardTuner,
    sample: Sample,
}

impl Contender {
    fn new(setting: Setting, period_ns: u64, plan: Guard) -> Contender {
        let guard = match (setting.guarded, plan) {
            (false, _) => GuardTuner::fixed(0),
            (true, Guard::Fixed(ns)) => GuardTuner::fixed(ns),
            (true, Guard::Auto | Guard::Off) => GuardTuner::auto(period_ns),
        };
        Contender { setting, period_ns, guard, sample: Sample::new() }
    }

    fn run(&mut self, cycles: u64) -> Result<(), RealtimeError> {
        let first = self.sample.count() == 0;
        let slice = slice::wake_ups(&self.setting, self.period_ns, cycles, &mut self.guard, first)?;
        self.sample.push(slice);
        Ok(())
    }

    fn latency(&self) -> Latency {
        let quantile = |q| self.sample.quantile(q).map(|interval| interval.value);
        let (p50_ns, p99_ns) = (quantile(0.5), quantile(0.99));
        Latency { count: self.sample.count(), p50_ns, p99_ns, max_ns: self.sample.max() }
    }
}

/// Rounds of a competition: so many slices each, for their intervals.
const ROUNDS: u64 = 12;
const FEWEST_ROUNDS: u64 = 3;
/// Cycles of a slice, at least.
const FEWEST_CYCLES: u64 = 5;

/// Shares of the whole span.
const NOISE: f64 = 0.04;
const FACTOR: f64 = 0.07;
const CORES: f64 = 0.08;
const PERIODS: f64 = 0.6;

/// Factors are compared at the plan's period, or at this one where that is longer: slices have to hold some cycles.
const LONGEST_PERIOD_NS: u64 = 10 * MS;

/// A measurement that is under way.
struct Bench<'a> {
    subject: &'a Subject,
    effort: Effort,
    report: &'a mut dyn FnMut(Progress<'_>),
    /// The part of the span that is done.
    done_ns: f64,
    /// As the plan would run here.
    base: Setting,
    /// Slices that ran as planned, at the plan's period: late cycles, and cycles.
    planned: Vec<(usize, usize)>,
}

/// Measures how well this host suits `subject`, and reports its progress. Takes about as long as `effort`
/// says.
///
/// Other threads of this process should sleep: they would be measured, too. Locks of memory that it holds are lost.
///
/// # Errors
///
/// The core cannot be had, or a right that was there a moment ago is not there any more.
pub fn measure(
    subject: &Subject,
    effort: &Effort,
    report: &mut dyn FnMut(Progress<'_>),
) -> Result<Measured, RealtimeError> {
    let steal_before = host::steal_ms(None);
    let priority = subject.cycle.priority;
    let wanted = subject.cycle.realtime != Realtime::Off;
    let may_fifo = on_a_thread(|| fifo(priority)).map_err(|denied| denied.to_string());
    let may_lock = memory::lock_process().map_err(|denied| denied.to_string());
    memory::unlock_process();
    let may_hold = slice::hold_awake().map(drop).map_err(|error| {
        format!(
            "/dev/cpu_dma_latency: {error}; run the doctor as root, or let this user write it (chmod, udev)"
        )
    });
    let base = Setting {
        core: subject.core,
        fifo: (wanted && may_fifo.is_ok()).then_some(priority),
        guarded: subject.cycle.guard != Guard::Off,
        locked: wanted && may_lock.is_ok(),
        awake: false,
    };
    let things = [
        (
            "/dev/cpu_dma_latency at 0".to_owned(),
            may_hold,
            [false, true].map(|awake| Setting { awake, ..base }),
        ),
        ("final spin (guard)".to_owned(), Ok(()), [false, true].map(|guarded| Setting { guarded, ..base })),
        (
            format!("SCHED_FIFO {priority}"),
            may_fifo,
            [None, Some(priority)].map(|fifo| Setting { fifo, ..base }),
        ),
        ("memory lock".to_owned(), may_lock, [false, true].map(|locked| Setting { locked, ..base })),
    ];
    let others: Vec<usize> = permitted_cores().into_iter().filter(|core| *core != subject.core).collect();

    let mut bench = Bench { subject, effort: *effort, report, done_ns: 0.0, base, planned: Vec::new() };
    let noise = bench.noise()?;
    let (mut factors, mut untried) = (Vec::new(), Vec::new());
    for (name, may, [without, with]) in things {
        match may {
            Ok(()) => factors.extend(bench.compare(&name, without, &[(name.clone(), with)], FACTOR)?),
            Err(why) => untried.push(Untried { name, why }),
        }
    }
    let (tried, left_out) = others.split_at(others.len().min(bench.most_cores()));
    let cores: Vec<(String, Setting)> = (tried.iter())
        .map(|core| (format!("core {core} instead of {}", base.core), Setting { core: *core, ..base }))
        .collect();
    if cores.is_empty() {
        let why = "this process may use no other core".to_owned();
        untried.push(Untried { name: "other cores".to_owned(), why });
    } else {
        factors.extend(bench.compare("cores", base, &cores, CORES)?);
    }
    if !left_out.is_empty() {
        let why = "no time left; a longer --for gives more".to_owned();
        untried.push(Untried { name: format!("{} more cores", left_out.len()), why });
    }
    let done = bench.done();
    (bench.report)(Progress { what: "costs of an exchange", done });
    let interfaces = subject.demand.as_ref().map_or_else(Vec::new, Demand::interfaces);
    let (costs, left_out) = costs::costs(&bench.base, &interfaces)?;
    untried.extend(left_out.into_iter().map(|why| Untried { name: "cost of an exchange".to_owned(), why }));
    let periods = bench.periods()?;
    let late_ns = subject.cycle.late_ns();
    let plan = Carries::of(subject.cycle.period_ns, late_ns, &bench.planned);
    let carried = periods.iter().rev().take_while(|period| period.is_carried(effort.miss_rate));
    Ok(Measured {
        miss_rate: effort.miss_rate,
        period_ns: bench.factor_period_ns(),
        fifo: base.fifo.is_some(),
        factors,
        untried,
        noise,
        plan,
        shortest_period_ns: carried.last().map(|period| period.period_ns),
        periods,
        costs: costs.into(),
        steal_ms: steal_before.and_then(|before| Some(host::steal_ms(None)?.saturating_sub(before))),
    })
}

impl Bench<'_> {
    fn factor_period_ns(&self) -> u64 {
        self.subject.cycle.period_ns.min(LONGEST_PERIOD_NS)
    }

    /// The share of the span that is done.
    fn done(&self) -> f64 {
        (self.done_ns / self.effort.span_ns as f64).min(1.0)
    }

    /// The number of a contender's slices that fit into the time of the cores.
    fn most_cores(&self) -> usize {
        let slot_ns = self.factor_period_ns() * FEWEST_CYCLES * FEWEST_ROUNDS;
        let slots = self.effort.span_ns as f64 * CORES / slot_ns as f64;
        (slots as usize).saturating_sub(1).max(1)
    }

    fn noise(&mut self) -> Result<Noise, RealtimeError> {
        let span_ns = self.effort.span_ns as f64 * NOISE;
        (self.report)(Progress { what: "hardware noise", done: 0.0 });
        self.done_ns += span_ns;
        slice::gaps(&self.base, span_ns as u64)
    }

    /// `without` against each of `with`, in turns.
    fn compare(
        &mut self,
        what: &str,
        without: Setting,
        with: &[(String, Setting)],
        share: f64,
    ) -> Result<Vec<Factor>, RealtimeError> {
        let settings = std::iter::once(without).chain(with.iter().map(|(_, setting)| *setting));
        let all: Vec<(Setting, u64)> = settings.map(|setting| (setting, self.factor_period_ns())).collect();
        let contenders = self.compete(what, &all, share)?;
        let [without, rivals @ ..] = contenders.as_slice() else { return Ok(Vec::new()) };
        let ratio = |rival: &Contender, q: f64| {
            let finite = |ratio: &Interval| ratio.low.is_finite() && ratio.high.is_finite();
            rival.sample.ratio(&without.sample, q).filter(finite)
        };
        let factor = |((name, setting), rival): (&(String, Setting), &Contender)| {
            let (p50_ratio, p99_ratio) = (ratio(rival, 0.5), ratio(rival, 0.99));
            let words: Vec<&str> = [p50_ratio, p99_ratio].iter().flatten().map(word).collect();
            let helps = words.contains(&HELPS) && !words.contains(&HURTS);
            let fix = (helps && *setting != self.base).then(|| Factor::remedy(&without.setting, setting));
            Factor {
                name: name.clone(),
                without: without.latency(),
                with: rival.latency(),
                p50_ratio,
                p99_ratio,
                fix,
            }
        };
        Ok(with.iter().zip(rivals).map(factor).collect())
    }

    /// The plan at shorter and longer periods, with as many cycles each. What is late is the same share of each period.
    fn periods(&mut self) -> Result<Vec<Carries>, RealtimeError> {
        let (own, late_ns) = (self.subject.cycle.period_ns, self.subject.cycle.late_ns());
        let periods = periods_around(own);
        let all: Vec<(Setting, u64)> = periods.iter().map(|period_ns| (self.base, *period_ns)).collect();
        let contenders = self.compete("periods", &all, PERIODS)?;
        let carries = |contender: &Contender| {
            let period_ns = contender.period_ns;
            let late_ns = (u128::from(late_ns) * u128::from(period_ns) / u128::from(own)) as u64;
            Carries::of(period_ns, late_ns, &contender.sample.beyond(late_ns))
        };
        Ok(contenders.iter().map(carries).collect())
    }

    /// Runs contenders in turns for a share of the span, each round beginning with another one, so that none always
    /// follows the same rival.
    fn compete(
        &mut self,
        what: &str,
        settings: &[(Setting, u64)],
        share: f64,
    ) -> Result<Vec<Contender>, RealtimeError> {
        let guard = self.subject.cycle.guard;
        let mut contenders: Vec<Contender> =
            settings.iter().map(|(setting, period_ns)| Contender::new(*setting, *period_ns, guard)).collect();
        let span_ns = self.effort.span_ns as f64 * share;
        let turn_ns: u64 = contenders.iter().map(|contender| contender.period_ns).sum();
        let cycles = (span_ns as u64 / (ROUNDS * turn_ns)).max(FEWEST_CYCLES);
        let rounds = (span_ns as u64 / (cycles * turn_ns)).max(FEWEST_ROUNDS);
        let count = contenders.len();
        for round in 0..rounds as usize {
            for turn in 0..count {
                let contender = &mut contenders[(round + turn) % count];
                let done = self.done();
                (self.report)(Progress { what, done });
                contender.run(cycles)?;
                self.done_ns += span_ns * contender.period_ns as f64 / (turn_ns * rounds) as f64;
            }
        }
        let (own, late_ns) = (self.subject.cycle.period_ns, self.subject.cycle.late_ns());
        let planned = contenders.iter().filter(|one| one.setting == self.base && one.period_ns == own);
        self.planned.extend(planned.flat_map(|one| one.sample.beyond(late_ns)));
        Ok(contenders)
    }
}

/// Around the plan's: two shorter ones, and two longer ones where they do not take all the time.
fn periods_around(own: u64) -> Vec<u64> {
    let shorter = [own / 4, own / 2].into_iter().filter(|period_ns| *period_ns >= 50 * US);
    let longer = [own * 2, own * 4].into_iter().filter(|period_ns| *period_ns <= LONGEST_PERIOD_NS);
    shorter.chain([own]).chain(longer).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn periods_lie_around_the_plans_and_take_their_time() {
        assert_eq!(periods_around(MS), [250 * US, 500 * US, MS, 2 * MS, 4 * MS]);
        assert_eq!(periods_around(50 * US), [50 * US, 100 * US, 200 * US]);
        assert_eq!(periods_around(S), [250 * MS, 500 * MS, S]);
    }
}
