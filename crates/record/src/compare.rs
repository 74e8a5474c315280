//! Two runs compared: whether this one is worse, better, or not different from an earlier one.
//!
//! Successive cycles are not independent, so that intervals from the sheer number of cycles would be far too narrow.
//! They come from the parts of each run: the parts are drawn again and again, with replacement, and the quantile of
//! each draw is taken (block bootstrap). Two runs differ where their intervals are apart.

use std::collections::BTreeSet;

use serde::Serialize;

use super::archive::Archive;
use fieldbeat_core::time::Ns;
use fieldbeat_telemetry::bins::Bins;
use fieldbeat_telemetry::signals::{ROUND_TRIP, WAKE};

/// Draws for an interval.
const DRAWS: usize = 400;

/// The interval holds so much of the draws.
const HELD: f64 = 0.95;

/// With fewer parts than this nothing is said.
const FEWEST_PARTS: usize = 6;

/// A value, and where it may lie by chance.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Interval {
    /// Of the whole run.
    pub value: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// The result of the comparison.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// The interval of this run is below that of the earlier one.
    Better,
    /// The intervals overlap.
    Same,
    /// The interval of this run is above that of the earlier one.
    Worse,
}

/// One quantity of two runs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Compared {
    /// The compared quantity.
    pub what: String,
    /// Values are shares, not ns.
    pub share: bool,
    /// This run.
    pub this: Interval,
    /// The earlier one.
    pub earlier: Interval,
    /// The conclusion.
    pub verdict: Verdict,
}

impl Verdict {
    /// In one word.
    pub fn word(self) -> &'static str {
        match self {
            Verdict::Better => "better",
            Verdict::Same => "same",
            Verdict::Worse => "worse",
        }
    }
}

impl Interval {
    /// As people read it.
    pub fn text(&self, share: bool) -> String {
        let one = |value: f64| if share { percent(value) } else { Ns(three(value)).to_string() };
        format!("{} ({} ... {})", one(self.value), one(self.low), one(self.high))
    }
}

fn three(ns: f64) -> u64 {
    fieldbeat_core::time::three_digits(ns.round() as u64)
}

/// A share as per cent.
pub fn percent(share: f64) -> String {
    match share * 100.0 {
        0.0 => "0 %".to_owned(),
        ..0.001 => "< 0.001 %".to_owned(),
        percent @ ..0.1 => format!("{percent:.3} %"),
        percent => format!("{percent:.2} %"),
    }
}

/// A number with four significant digits, so that one of a small unit is not rounded to nothing.
pub fn significant(value: f64) -> String {
    let digits = (3.0 - value.abs().log10().floor()).clamp(0.0, 9.0) as usize;
    // Without the sign of a zero.
    let text = format!("{:.digits$}", value + 0.0);
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// The compared values of a histogram: their name, and how they are taken.
#[derive(Clone, Copy, Debug)]
enum Measure {
    /// The value at this rank.
    Quantile(f64),
    /// The share of values above so many ns.
    Above(u64),
}

/// Compares a run with an earlier one; empty if one of them is too short.
pub fn compare(this: &Archive, earlier: &Archive) -> Vec<Compared> {
    let wakes = |run: &Archive| run.parts.iter().map(|part| part.wake.clone()).collect::<Vec<_>>();
    let measures = [
        ("p50", Measure::Quantile(0.5)),
        ("p99", Measure::Quantile(0.99)),
        ("p99.9", Measure::Quantile(0.999)),
        ("beyond the late limit", Measure::Above(this.late_ns)),
    ];
    let mut compared = of_histograms(WAKE.name, &wakes(this), &wakes(earlier), &measures);
    for (place, drive) in this.drives.iter().enumerate() {
        let Some(other) = earlier.drives.iter().position(|other| other.name == drive.name) else { continue };
        let rtts = |run: &Archive, place: usize| {
            run.parts.iter().filter_map(|part| part.rtt.get(place).cloned()).collect::<Vec<_>>()
        };
        let (ours, theirs) = (rtts(this, place), rtts(earlier, other));
        let what = format!("{} of {}", ROUND_TRIP.name, drive.name);
        compared.extend(of_histograms(&what, &ours, &theirs, &measures[..2]));
    }
    compared
}

/// In what else two runs differ: cycle, host, program and drives. A line each.
pub fn differences(this: &Archive, earlier: &Archive) -> Vec<String> {
    let facts = |run: &Archive| {
        let computer = &run.host.computer;
        let texts = [&computer.name, &computer.kernel, &computer.preemption, &computer.cpu];
        let [host, kernel, preemption, processor] =
            texts.map(|text| plain(text.as_deref().unwrap_or("unknown")));
        [
            ("period", Ns(run.period_ns).to_string()),
            ("late limit", Ns(run.late_ns).to_string()),
            ("host", host),
            ("kernel", kernel),
            ("preemption", preemption),
            ("processor", processor),
            ("policy", plain(&run.host.policy)),
            ("fieldbeat", plain(&run.program)),
        ]
    };
    let drives = |run: &Archive| -> BTreeSet<String> {
        run.drives.iter().map(|drive| plain(&format!("{} ({})", drive.name, drive.protocol))).collect()
    };
    let (ours, theirs) = (drives(this), drives(earlier));
    let only =
        |drives: &BTreeSet<String>, others| -> Vec<String> { drives.difference(others).cloned().collect() };
    let lists = [("this", only(&ours, &theirs)), ("the earlier", only(&theirs, &ours))];
    let changed = facts(this).into_iter().zip(facts(earlier)).filter(|(this, earlier)| this != earlier);
    let changed = changed.map(|((what, this), (_, earlier))| format!("{what} {this}, was {earlier}"));
    let listed = lists.into_iter().filter(|(_, drives)| !drives.is_empty());
    changed.chain(listed.map(|(run, drives)| format!("only in {run} run: {}", drives.join(", ")))).collect()
}

/// A text of a file, fit for a terminal.
fn plain(text: &str) -> String {
    text.escape_debug().to_string()
}

fn of_histograms(what: &str, ours: &[Bins], theirs: &[Bins], measures: &[(&str, Measure)]) -> Vec<Compared> {
    let [ours, theirs] = [ours, theirs].map(|parts| Blocks::of(parts).intervals(measures));
    let both = ours.into_iter().zip(theirs).zip(measures);
    both.filter_map(|((ours, theirs), (name, measure))| {
        let share = matches!(measure, Measure::Above(_));
        Some(Compared::new(format!("{what} {name}"), share, ours?, theirs?))
    })
    .collect()
}

/// The histograms of the parts on common bins.
struct Blocks {
    values: Vec<u64>,
    /// Part by part, a count for each value.
    counts: Vec<Vec<u64>>,
}

impl Blocks {
    fn of(parts: &[Bins]) -> Blocks {
        let mut all = Bins::default();
        parts.iter().for_each(|part| all.add(part));
        let values: Vec<u64> = all.list().iter().map(|(value, _)| *value).collect();
        let counts = |part: &Bins| {
            let mut counts = vec![0; values.len()];
            for (value, count) in part.list() {
                if let Ok(place) = values.binary_search(value) {
                    counts[place] = *count;
                }
            }
            counts
        };
        Blocks { counts: parts.iter().map(counts).collect(), values }
    }

    /// The value of each measure over all parts, and its interval over draws of them; `None`: there are too few parts,
    /// or the samples do not support it.
    fn intervals(&self, measures: &[(&str, Measure)]) -> Vec<Option<Interval>> {
        let parts = self.counts.len();
        if parts < FEWEST_PARTS {
            return vec![None; measures.len()];
        }
        let whole = self.draw(&vec![1; parts], measures);
        let mut drawn: Vec<Vec<f64>> = vec![Vec::new(); measures.len()];
        let mut random = fastrand::Rng::with_seed(1);
        for _ in 0..DRAWS {
            let mut times = vec![0; parts];
            (0..parts).for_each(|_| times[random.usize(..parts)] += 1);
            let values = self.draw(&times, measures);
            drawn.iter_mut().zip(values).for_each(|(drawn, value)| drawn.extend(value));
        }
        let interval = |(value, mut drawn): (Option<f64>, Vec<f64>)| {
            let value = value.filter(|_| drawn.len() > DRAWS / 2)?;
            drawn.sort_by(f64::total_cmp);
            let at = |share: f64| drawn[((drawn.len() - 1) as f64 * share).round() as usize];
            let beyond = (1.0 - HELD) / 2.0;
            Some(Interval { value, low: at(beyond).min(value), high: at(1.0 - beyond).max(value) })
        };
        whole.into_iter().zip(drawn).map(interval).collect()
    }

    /// The measures of all parts together, each taken so many times.
    fn draw(&self, times: &[u64], measures: &[(&str, Measure)]) -> Vec<Option<f64>> {
        let mut sum = vec![0; self.values.len()];
        for (counts, times) in self.counts.iter().zip(times).filter(|(_, times)| **times > 0) {
            sum.iter_mut().zip(counts).for_each(|(sum, count)| *sum += times * count);
        }
        let all = Bins::from_list(self.values.iter().copied().zip(sum));
        let of = |(_, measure): &(&str, Measure)| match *measure {
            Measure::Quantile(quantile) => all.quantile(quantile).map(|ns| ns as f64),
            Measure::Above(ns) => (all.count() > 0).then(|| all.above(ns) as f64 / all.count() as f64),
        };
        measures.iter().map(of).collect()
    }
}

impl Compared {
    fn new(what: String, share: bool, this: Interval, earlier: Interval) -> Compared {
        let verdict = match () {
            () if this.low > earlier.high => Verdict::Worse,
            () if this.high < earlier.low => Verdict::Better,
            () => Verdict::Same,
        };
        Compared { what, share, this, earlier, verdict }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::tests::archive;
    use fieldbeat_testing::runs::run;

    fn bins(values: impl Iterator<Item = u64>) -> Bins {
        let mut all = std::collections::BTreeMap::new();
        values.for_each(|value| *all.entry(value).or_insert(0) += 1);
        Bins::from_list(all)
    }

    /// Parts of a run whose level wanders: so many values a part, around `level`.
    fn parts(level: u64, wander: u64, seed: u64) -> Vec<Bins> {
        let mut random = fastrand::Rng::with_seed(seed);
        let part = |_| {
            let level = level + random.u64(..wander.max(1));
            bins((0..2_000).map(|_| level + random.u64(..1_000)))
        };
        (0..20).map(part).collect()
    }

    #[test]
    fn numbers_of_small_units_keep_their_digits() {
        let cases = [
            (0.0, "0"),
            (-0.0, "0"),
            (0.00004, "0.00004"),
            (0.000_012_34, "0.00001234"),
            (-0.5, "-0.5"),
            (1.25, "1.25"),
            (13.4, "13.4"),
            (100.0, "100"),
            (123_456.7, "123457"),
            (1e-12, "0"),
        ];
        for (value, expected) in cases {
            assert_eq!(significant(value), expected, "{value}");
        }
    }

    #[test]
    fn only_intervals_that_are_apart_differ() {
        let verdict = |ours: &[Bins], theirs: &[Bins]| {
            let compared = of_histograms("x", ours, theirs, &[("p99", Measure::Quantile(0.99))]);
            compared[0].verdict
        };
        let base = parts(10_000, 500, 1);
        assert_eq!(verdict(&parts(10_000, 500, 2), &base), Verdict::Same);
        assert_eq!(verdict(&parts(20_000, 500, 3), &base), Verdict::Worse);
        assert_eq!(verdict(&base, &parts(20_000, 500, 3)), Verdict::Better);
        // 40 000 samples would tell the medians of these apart by their number; the parts differ as much among
        // themselves.
        assert_eq!(verdict(&parts(10_000, 8_000, 4), &parts(10_500, 8_000, 5)), Verdict::Same);
    }

    #[test]
    fn short_runs_and_small_samples_are_not_judged() {
        let few = parts(10_000, 500, 1)[..5].to_vec();
        assert_eq!(of_histograms("x", &few, &few, &[("p50", Measure::Quantile(0.5))]), []);
        let small: Vec<Bins> = (0..20).map(|place| bins(place..place + 2)).collect();
        let measures = [("p50", Measure::Quantile(0.5)), ("p99.9", Measure::Quantile(0.999))];
        let names: Vec<_> =
            of_histograms("x", &small, &small, &measures).into_iter().map(|one| one.what).collect();
        assert_eq!(names, ["x p50"]);
    }

    #[test]
    fn a_run_is_the_same_as_itself_and_drives_are_compared_by_name() {
        let [x, y] = ["x", "y"].map(|name| archive(&run(name, 20_000)));
        let same = compare(&x, &x);
        assert_eq!(same.len(), 6, "{same:?}");
        assert!(same.iter().all(|one| one.verdict == Verdict::Same));
        assert_eq!(compare(&x, &y).len(), 4);
    }

    #[test]
    fn other_machines_are_distinguished() {
        let x = archive(&run("x", 20_000));
        assert_eq!(differences(&x, &x), [""; 0]);
        let mut y = archive(&run("y", 20_000));
        (y.period_ns, y.host.computer.kernel) = (2 * x.period_ns, Some("6.1.0-rt\x1b".into()));
        let kernel = x.host.computer.kernel.as_deref().unwrap_or("unknown");
        let protocol = &x.drives[0].protocol;
        let lines = [
            format!("period {}, was {}", Ns(x.period_ns), Ns(y.period_ns)),
            format!("kernel {kernel}, was 6.1.0-rt\\u{{1b}}"),
            format!("only in this run: x ({protocol})"),
            format!("only in the earlier run: y ({protocol})"),
        ];
        assert_eq!(differences(&x, &y), lines);
    }

    #[test]
    fn shares_read_naturally() {
        let texts = [0.0, 1e-6, 0.000_123, 0.5].map(percent);
        assert_eq!(texts, ["0 %", "< 0.001 %", "0.012 %", "50.00 %"]);
    }
}
