//! Settings that can be tried at run time, and their effect here: each one off and on, in short slices in turns, and
//! then the plan itself.
//!
//! | file | what |
//! |---|---|
//! | `mod` | what is compared, and the results |
//! | `slice` | one slice: a thread set up in one way |
//! | `glance` | what this host carries, in half a second |
//!
//! It measures wake-ups, the part of a cycle that the host decides; the loop's own work comes on top.

mod glance;
mod slice;

pub use glance::{Glance, MOST_DISTURBED, glance};
use serde::Serialize;

use super::Subject;
use super::facts::on_a_thread;
use super::finding::{Area, Finding};
use super::stats::{Interval, Sample, over_rounds};
use crate::cycle::Guard;
use crate::rt::thread::{fifo, permitted_cores};
use crate::rt::{GuardTuner, Realtime, RealtimeError, host, memory};
use crate::telemetry::summary::plural;
use crate::time::{MS, Ns, S, US};
use slice::Setting;

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

/// What is being measured, for whoever waits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress<'a> {
    /// What.
    pub what: &'a str,
    /// The share of all that is done.
    pub done: f64,
}

/// What was measured. Serialised, its keys are stable; values are in ns unless the key says otherwise; what the sample
/// does not support is null.
#[derive(Clone, Debug, Serialize)]
pub struct Measured {
    /// The wanted share of late cycles.
    pub miss_rate: f64,
    /// The period that the factors and cores were measured at.
    pub period_ns: u64,
    /// The plan had SCHED_FIFO.
    pub fifo: bool,
    /// What each thing is worth.
    pub factors: Vec<Factor>,
    /// What could not be tried.
    pub untried: Vec<Untried>,
    /// What takes the core from a thread that never sleeps.
    pub noise: Noise,
    /// The plan at its own period, over all slices that ran as planned.
    pub plan: Carries,
    /// The plan at other periods, shortest first; its own one among them.
    pub periods: Vec<Carries>,
    /// The shortest of these periods that was carried, and so were all longer ones.
    pub shortest_period_ns: Option<u64>,
    /// Time that the hypervisor took from all cores meanwhile, ms.
    pub steal_ms: Option<u64>,
}

/// One thing, without and with.
#[derive(Clone, Debug, Serialize)]
pub struct Factor {
    /// What.
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
    fn remedy(without: &Setting, with: &Setting) -> String {
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
    /// What.
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
    fn of(period_ns: u64, late_ns: u64, slices: &[(usize, usize)]) -> Carries {
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
    fn is_carried(&self, miss_rate: f64) -> bool {
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
    tell: &'a mut dyn FnMut(Progress<'_>),
    /// So much of the span is done.
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
    tell: &mut dyn FnMut(Progress<'_>),
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

    let mut bench = Bench { subject, effort: *effort, tell, done_ns: 0.0, base, planned: Vec::new() };
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
        steal_ms: steal_before.and_then(|before| Some(host::steal_ms(None)?.saturating_sub(before))),
    })
}

impl Bench<'_> {
    fn factor_period_ns(&self) -> u64 {
        self.subject.cycle.period_ns.min(LONGEST_PERIOD_NS)
    }

    /// So many of a contender's slices fit into what the cores are given.
    fn most_cores(&self) -> usize {
        let slot_ns = self.factor_period_ns() * FEWEST_CYCLES * FEWEST_ROUNDS;
        let slots = self.effort.span_ns as f64 * CORES / slot_ns as f64;
        (slots as usize).saturating_sub(1).max(1)
    }

    fn noise(&mut self) -> Result<Noise, RealtimeError> {
        let span_ns = self.effort.span_ns as f64 * NOISE;
        (self.tell)(Progress { what: "hardware noise", done: 0.0 });
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
        let periods = ladder(own);
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
                let done = self.done_ns / self.effort.span_ns as f64;
                (self.tell)(Progress { what, done: done.min(1.0) });
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

/// Periods around the plan's: two shorter ones, and two longer ones where they do not take all the time.
fn ladder(own: u64) -> Vec<u64> {
    let shorter = [own / 4, own / 2].into_iter().filter(|period_ns| *period_ns >= 50 * US);
    let longer = [own * 2, own * 4].into_iter().filter(|period_ns| *period_ns <= LONGEST_PERIOD_NS);
    shorter.chain([own]).chain(longer).collect()
}

impl Measured {
    /// What follows for the plan.
    pub fn findings(&self, subject: &Subject) -> Vec<Finding> {
        vec![self.hardware_noise(subject), self.late_cycles(), self.shortest(subject)]
    }

    fn hardware_noise(&self, subject: &Subject) -> Finding {
        let late_ns = subject.cycle.late_ns();
        let Noise { looked_ns, gap_ns, gaps, longest_ns, taken_ns } = self.noise;
        let finding = Finding::about(
            Area::Measured,
            "hardware noise",
            format!("no gap of {} or more", Ns(late_ns)),
            match self.fifo {
                true => {
                    "interrupts, firmware and the host of a virtual machine take the core from a thread that never \
                     sleeps, whatever its priority"
                }
                false => "without SCHED_FIFO, other programs take the core too",
            },
        );
        let share = taken_ns as f64 * 100.0 / looked_ns.max(1) as f64;
        let found = match gaps {
            0 => format!("no gap above {} in {}", Ns(gap_ns), Ns(looked_ns)),
            count => format!(
                "{} above {} in {}, the longest {}, {share:.3} % of the time",
                plural(count, "gap"),
                Ns(gap_ns),
                Ns(looked_ns),
                Ns(longest_ns)
            ),
        };
        match longest_ns < late_ns {
            true => finding.good(found),
            false => finding.poor(found).advise(
                "isolate the core, and move interrupts to other cores\n\
                 `rtla hwnoise` separates firmware (SMI) from interrupts\n\
                 in a virtual machine, pin its processors on its host",
            ),
        }
    }

    fn late_cycles(&self) -> Finding {
        let Carries { period_ns, late_ns, cycles, late, share, at_most } = self.plan;
        let miss_rate = self.miss_rate;
        let finding = Finding::about(
            Area::Measured,
            format!("late cycles at {}", Ns(period_ns)),
            format!("{} at most", percent(miss_rate)),
            format!(
                "a wake-up more than {} after its grid point is late, and so is a skipped slot",
                Ns(late_ns)
            ),
        );
        let found = format!(
            "{late} of {cycles} ({}); the true share is {} at most (95 % confidence)",
            percent(share),
            percent(at_most)
        );
        let enough = (3.0 / miss_rate).ceil();
        match () {
            () if share > miss_rate => {
                let fix = match self.shortest_period_ns {
                    Some(shortest) if shortest > period_ns => format!("period = \"{}\" in [cycle]\nor ", key(shortest)),
                    _ => String::new(),
                };
                let fix = fix + "fix what is poor, use what helps below, and measure again";
                finding.bad(found).advise(fix)
            }
            () if at_most > miss_rate => finding.unknown(format!(
                "{found}; certain only after {enough} cycles without a late one (--for), or with a larger --miss-rate"
            )),
            () => finding.good(found),
        }
    }

    fn shortest(&self, subject: &Subject) -> Finding {
        let period_ns = subject.cycle.period_ns;
        let finding = Finding::about(
            Area::Measured,
            "shortest period",
            format!("{} or shorter", Ns(period_ns)),
            format!(
                "the shortest period tried at which, as at all longer ones, {} of the cycles at most were late",
                percent(self.miss_rate)
            ),
        );
        let carried = self
            .shortest_period_ns
            .and_then(|shortest| self.periods.iter().find(|period| period.period_ns == shortest));
        match carried {
            Some(Carries { period_ns: shortest, late_ns, cycles, late, at_most, .. }) => {
                let found = format!(
                    "{} (late limit {}: {late} of {cycles}, {} at most)",
                    Ns(*shortest),
                    Ns(*late_ns),
                    percent(*at_most)
                );
                match *shortest <= period_ns {
                    true if *at_most > self.miss_rate => finding
                        .unknown(format!("{found}; too few cycles to be certain, a longer --for gives more")),
                    true => finding.good(found),
                    false => finding.poor(found).advise("as for the late cycles"),
                }
            }
            None => finding.poor("none of the periods tried").advise("as for the late cycles"),
        }
    }
}

/// A time as the configuration has it: `4ms`.
fn key(ns: u64) -> String {
    Ns(ns).to_string().replace(' ', "")
}

/// A share as a person reads it: two digits, and 0 is 0.
pub(super) fn percent(share: f64) -> String {
    let percent = share * 100.0;
    let digits = match percent {
        0.0 => 0,
        10.0.. => 0,
        _ => (1.0 - percent.log10().floor()).clamp(0.0, 9.0) as usize,
    };
    let text = format!("{percent:.digits$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    format!("{text} %")
}

const HELPS: &str = "helps";
const HURTS: &str = "hurts";

/// What a ratio with its interval says of latency.
pub(super) fn word(ratio: &Interval) -> &'static str {
    match ratio {
        Interval { high, .. } if *high < 0.95 => HELPS,
        Interval { low, .. } if *low > 1.05 => HURTS,
        _ => "undecided",
    }
}

#[cfg(test)]
mod tests {
    use super::super::facts::testing::subject;
    use super::slice::GAP_NS;
    use super::*;
    use crate::doctor::Verdict::{Bad, Good, Poor, Unknown};

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

    fn measured(plan: &[(usize, usize)], periods: &[(u64, usize)]) -> Measured {
        let of =
            |(period_ns, late): &(u64, usize)| Carries::of(*period_ns, period_ns / 10, &[(*late, 10_000)]);
        let periods: Vec<Carries> = periods.iter().map(of).collect();
        let shortest = periods.iter().rev().take_while(|period| period.is_carried(1e-3)).last();
        Measured {
            miss_rate: 1e-3,
            period_ns: MS,
            fifo: true,
            factors: Vec::new(),
            untried: Vec::new(),
            noise: Noise { looked_ns: S, gap_ns: GAP_NS, gaps: 2, longest_ns: 30 * US, taken_ns: 50 * US },
            plan: Carries::of(MS, 100 * US, plan),
            shortest_period_ns: shortest.map(|period| period.period_ns),
            periods,
            steal_ms: Some(0),
        }
    }

    #[test]
    fn late_cycles_are_judged_by_what_the_sample_supports() {
        let late = |plan: &[(usize, usize)]| measured(plan, &[(MS, 50), (2 * MS, 0)]).late_cycles();
        let good = late(&[(0, 1_000); 10]);
        assert_eq!((good.verdict, good.name.as_str()), (Good, "late cycles at 1 ms"));
        assert_eq!(good.found, "0 of 10000 (0 %); the true share is 0.03 % at most (95 % confidence)");
        let few = late(&[(0, 1_000)]);
        assert_eq!(few.verdict, Unknown);
        assert!(
            few.found.contains("0.3 % at most") && few.found.contains("only after 3000 cycles"),
            "{}",
            few.found
        );
        let bad = late(&[(2, 1_000); 10]);
        assert_eq!(
            (bad.verdict, bad.fix.unwrap().lines().next()),
            (Bad, Some("period = \"2ms\" in [cycle]"))
        );
    }

    #[test]
    fn the_shortest_period_has_no_gap_above_it() {
        let shortest = |periods: &[(u64, usize)]| measured(&[(0, 10_000)], periods).shortest(&subject());
        let all = shortest(&[(250 * US, 0), (500 * US, 11), (MS, 2), (2 * MS, 0)]);
        assert_eq!(all.verdict, Good);
        assert!(all.found.starts_with("1 ms (late limit 100 us: 2 of 10000, "), "{}", all.found);
        // As often as wanted, but it may as well be more often.
        let unsure = shortest(&[(MS, 10), (2 * MS, 0)]);
        assert!(unsure.verdict == Unknown && unsure.found.contains("too few cycles"), "{unsure:?}");
        assert_eq!(shortest(&[(MS, 11), (2 * MS, 0)]).verdict, Poor);
        assert_eq!(shortest(&[(MS, 0), (2 * MS, 11)]).found, "none of the periods tried");
    }

    #[test]
    fn noise_matters_from_where_cycles_are_late() {
        let mut measured = measured(&[(0, 1)], &[]);
        let quiet = measured.hardware_noise(&subject());
        assert_eq!(quiet.verdict, Good);
        assert_eq!(quiet.found, "2 gaps above 10 us in 1 s, the longest 30 us, 0.005 % of the time");
        measured.noise.longest_ns = 100 * US;
        assert_eq!(measured.hardware_noise(&subject()).verdict, Poor);
    }

    #[test]
    fn periods_lie_around_the_plans_and_take_their_time() {
        assert_eq!(ladder(MS), [250 * US, 500 * US, MS, 2 * MS, 4 * MS]);
        assert_eq!(ladder(50 * US), [50 * US, 100 * US, 200 * US]);
        assert_eq!(ladder(S), [250 * MS, 500 * MS, S]);
    }

    #[test]
    fn shares_show_two_digits() {
        for (share, text) in [
            (0.0, "0 %"),
            (1e-3, "0.1 %"),
            (2.996e-4, "0.03 %"),
            (0.0123, "1.2 %"),
            (0.5, "50 %"),
            (1.0, "100 %"),
        ] {
            assert_eq!(percent(share), text);
        }
    }
}
