//! Whether the host carried the period of a run: shares of late cycles, skipped slots and unanswered exchanges.

use std::fmt;

use serde::Serialize;

use super::plural;
use crate::archive::Archive;
use crate::compare::percent;
use fieldbeat_core::cycle::record::Stage;
use fieldbeat_core::cycle::{CyclePlan, Shares};
use fieldbeat_core::time::{Ns, S};
use fieldbeat_telemetry::bins::Bins;
use fieldbeat_telemetry::histograms::{Histograms, SAMPLES_BEYOND};

/// Whether the host carried the period.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Carried {
    /// It did: no share is larger than tolerated.
    pub carried: bool,
    /// The period, ns.
    pub period_ns: u64,
    /// The share of each kind that was found, and the largest one tolerated.
    pub shares: [Share; 3],
    /// The period that would have been carried, as far as this run can tell; null: this one, none that is a second or
    /// shorter, or what was unanswered has nothing to do with the period.
    pub would_be_ns: Option<u64>,
    /// The loop had all that makes it real-time.
    pub realtime: bool,
}

/// A share of a run that was not as planned.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Share {
    /// `late`, `skipped` or `unanswered`.
    pub what: &'static str,
    /// Cycles, slots or exchanges that were.
    pub count: u64,
    /// Of so many.
    pub of: u64,
    /// The largest share that is tolerated, 0 ... 1.
    pub tolerated: f64,
    /// The drive that it is about; null: the loop.
    pub drive: Option<String>,
}

impl Share {
    /// The share, 0 ... 1.
    pub fn value(&self) -> f64 {
        self.count as f64 / self.of.max(1) as f64
    }

    /// It is larger than tolerated. A few of a short run say nothing, unless none is tolerated.
    pub fn is_exceeded(&self) -> bool {
        let enough = self.tolerated == 0.0 || self.count as f64 >= SAMPLES_BEYOND;
        enough && self.value() > self.tolerated
    }
}

/// `57 % skipped`, `0.02 % unanswered by x`.
impl fmt::Display for Share {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Share { what, drive, .. } = self;
        write!(f, "{} {what}", percent(self.value()))?;
        drive.as_ref().filter(|_| self.count > 0).map_or(Ok(()), |drive| write!(f, " by {drive}"))
    }
}

/// The counts and measurements of the loop in a run.
#[derive(Debug)]
pub(super) struct Course<'a> {
    pub planned: u64,
    pub executed: u64,
    pub skipped: u64,
    /// Each drive, with its exchanges while it was online: answered, and not.
    pub drives: Vec<(&'a str, u64, u64)>,
    pub wake: Bins,
    pub stages: Vec<Bins>,
    pub realtime: bool,
}

/// Whether the loop was under this policy, and had all that it requires.
pub(super) fn is_realtime(policy: &str, missing: &[String]) -> bool {
    policy.starts_with("SCHED_FIFO") && missing.is_empty()
}

/// The bins of the loop's quantities: wake-up latency, and the stages.
pub(super) fn bins(histograms: &Histograms) -> (Bins, Vec<Bins>) {
    let stages = Stage::ALL.iter().map(|stage| Bins::of(histograms.stage(*stage)));
    (Bins::of(&histograms.wake), stages.collect())
}

impl Carried {
    pub(super) fn of(cycle: &CyclePlan, course: &Course<'_>) -> Carried {
        let Shares { late, skipped, unanswered } = cycle.tolerated;
        let share = |what, count, of, tolerated| Share { what, count, of, tolerated, drive: None };
        let of_drives = course.drives.iter().map(|(name, answered, missed)| Share {
            drive: Some((*name).to_owned()),
            ..share("unanswered", *missed, answered + missed, unanswered)
        });
        let worst = of_drives.max_by(|one, other| one.value().total_cmp(&other.value()));
        // Skipped slots are among the wake-ups, as late ones.
        let began_late = course.wake.above(cycle.late_ns()).saturating_sub(course.skipped);
        let shares = [
            share("late", began_late, course.executed, late),
            share("skipped", course.skipped, course.planned, skipped),
            worst.unwrap_or_else(|| share("unanswered", 0, 0, unanswered)),
        ];
        let [late, skipped, _] = &shares;
        let of_loop = late.is_exceeded() || skipped.is_exceeded();
        Carried {
            carried: !shares.iter().any(Share::is_exceeded),
            period_ns: cycle.period_ns,
            would_be_ns: if of_loop { would_be_ns(cycle, course) } else { None },
            shares,
            realtime: course.realtime,
        }
    }

    /// The same of a run as a file has it, with all that went before it.
    pub fn of_archive(cycle: &CyclePlan, run: &Archive) -> Carried {
        let counts = &run.counts;
        let drives = run
            .drives
            .iter()
            .map(|drive| (drive.name.as_str(), drive.exchanges.answered, drive.exchanges.unanswered_online));
        let course = Course {
            planned: counts.planned,
            executed: counts.executed,
            skipped: counts.skipped,
            drives: drives.collect(),
            wake: run.wake.bins.clone(),
            stages: run.stages.iter().map(|stage| stage.bins.clone()).collect(),
            realtime: is_realtime(&run.host.policy, &run.host.missing),
        };
        Carried::of(cycle, &course)
    }

    /// The part that is not carried, as an error that says what to do.
    pub fn failure(&self) -> Option<String> {
        let keys: Vec<String> = self.exceeded().map(|share| format!("max_{}_share", share.what)).collect();
        let period =
            self.would_be_ns.map(|ns| format!("period = \"{}\"", Ns(ns).to_string().replace(' ', "")));
        let by_drive = self.exceeded().all(|share| share.drive.is_some());
        let remedy = match (period, by_drive) {
            (Some(period), _) => {
                format!(
                    "set {period} in [cycle], or give the loop its rights and a core of its own (`fieldbeat doctor`)"
                )
            }
            (None, true) => {
                "the drive's line in the summary says what of its exchanges was late or lost".to_owned()
            }
            (None, false) => "give the loop its rights and a core of its own (`fieldbeat doctor`)".to_owned(),
        };
        (!self.carried)
            .then(|| format!("{self}; {remedy}; in [cycle], {} = 1 judges nothing", keys.join(" = 1, ")))
    }

    fn exceeded(&self) -> impl Iterator<Item = &Share> {
        self.shares.iter().filter(|share| share.is_exceeded())
    }
}

/// The shortest whole power of two of this period at which as many cycles begin in time as is tolerated: `None` if that
/// is this one, or beyond a second or what was measured.
fn would_be_ns(cycle: &CyclePlan, course: &Course<'_>) -> Option<u64> {
    let at = |bins: &Bins, tolerated: f64| {
        let ns = bins.rank(1.0 - tolerated).unwrap_or(0);
        (!Bins::is_cut_off(ns)).then_some(ns)
    };
    let waiting = Stage::Receive as usize;
    let own = course.stages.iter().enumerate().filter(|(stage, _)| *stage != waiting).map(|(_, bins)| bins);
    // Late by a share of the period, unless the configuration says from when on.
    let late = match cycle.late_ns {
        Some(_) => 0,
        None => {
            at(&course.wake, cycle.tolerated.late)?.saturating_mul(cycle.period_ns / cycle.late_ns().max(1))
        }
    };
    // A slot is executed if the loop begins it within half of the receive window, and ends the one before.
    let begin = at(&course.wake, cycle.tolerated.skipped)?;
    let window = 2.0 * begin as f64 / cycle.receive_deadline;
    let work = own.map(|bins| at(bins, cycle.tolerated.skipped)).sum::<Option<u64>>()?;
    let wanted = late.max(window as u64).max(begin + work);
    let longer = std::iter::successors(Some(cycle.period_ns), |ns| ns.checked_mul(2));
    longer.take_while(|ns| *ns <= S).find(|ns| *ns >= wanted).filter(|ns| *ns > cycle.period_ns)
}

/// One line.
impl fmt::Display for Carried {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let period = Ns(self.period_ns);
        if self.carried {
            let [late, skipped, unanswered] = &self.shares;
            write!(f, "carried at {period}: {late}, {skipped}, {unanswered}")?;
        } else {
            write!(f, "NOT CARRIED at {period}: ")?;
            for (place, share) in self.exceeded().enumerate() {
                let between = if place == 0 { "" } else { ", " };
                let Share { count, of, tolerated, what, .. } = share;
                let noun = if *what == "unanswered" { "exchange" } else { "cycle" };
                write!(
                    f,
                    "{between}{share} ({count} of {}, tolerated {})",
                    plural(*of, noun),
                    percent(*tolerated)
                )?;
            }
        }
        if let Some(ns) = self.would_be_ns {
            write!(f, "; {} would have been", Ns(ns))?;
        }
        write!(f, "; real-time: {}", if self.realtime { "yes" } else { "no" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::time::{MS, US};

    /// 10 000 slots of 1 ms; wake-up latencies as given.
    fn course(wake: &[(u64, u64)]) -> Course<'static> {
        let short = || Bins::from_list([(20 * US, 10_000)]);
        Course {
            planned: 10_000,
            executed: 10_000,
            skipped: 0,
            drives: vec![("x", 9_990, 10), ("y", 10_000, 0)],
            wake: Bins::from_list(wake.iter().copied()),
            stages: (0..6).map(|_| short()).collect(),
            realtime: true,
        }
    }

    const QUIET: [(u64, u64); 1] = [(30 * US, 10_000)];

    #[test]
    fn a_run_within_what_is_tolerated_is_carried() {
        // Five of the late wake-ups are those of skipped slots.
        let wake = [(30 * US, 9_575), (150 * US, 425)];
        let carried = Carried::of(&CyclePlan::default(), &Course { skipped: 5, ..course(&wake) });
        let expected =
            "carried at 1 ms: 4.20 % late, 0.050 % skipped, 0.10 % unanswered by x; real-time: yes";
        assert_eq!(carried.to_string(), expected);
        assert_eq!((carried.carried, carried.failure(), carried.would_be_ns), (true, None, None));
    }

    #[test]
    fn each_share_fails_alone_with_its_key() {
        let failure = |course: Course<'_>| Carried::of(&CyclePlan::default(), &course).failure().unwrap();
        let wake = [(30 * US, 8_999), (150 * US, 1_001)];
        let late = failure(Course { realtime: false, ..course(&wake) });
        let expected =
            "NOT CARRIED at 1 ms: 10.01 % late (1001 of 10000 cycles, tolerated 10.00 %); 2 ms would";
        assert!(
            late.starts_with(expected) && late.contains("; real-time: no; set period = \"2ms\" in "),
            "{late}"
        );
        assert!(late.ends_with("; in [cycle], max_late_share = 1 judges nothing"), "{late}");
        let skipped = failure(Course { skipped: 101, executed: 9_899, ..course(&QUIET) });
        assert!(
            skipped.contains("1.01 % skipped (101 of 10000 cycles, ")
                && skipped.contains("max_skipped_share")
        );
        let unanswered = failure(Course { drives: vec![("x", 9_990, 10), ("y", 98, 10)], ..course(&QUIET) });
        assert!(unanswered.contains("9.26 % unanswered by y (10 of 108 exchanges, "), "{unanswered}");
        assert!(unanswered.contains("the drive's line") && unanswered.contains("max_unanswered_share"));
        // Nine are too few to say so, unless none is tolerated.
        let few = || Course { skipped: 9, planned: 20, ..course(&QUIET) };
        assert_eq!(Carried::of(&CyclePlan::default(), &few()).failure(), None);
        let mut strict = CyclePlan::default();
        strict.tolerated.skipped = 0.0;
        assert!(!Carried::of(&strict, &few()).carried);
    }

    #[test]
    fn the_period_that_would_have_been_is_that_of_the_wake_ups() {
        let would_be = |wake: &[(u64, u64)], change: fn(&mut CyclePlan)| {
            let mut cycle = CyclePlan::default();
            change(&mut cycle);
            Carried::of(&cycle, &Course { skipped: 5_000, ..course(wake) }).would_be_ns
        };
        // A fifth begins 300 us late: from 3 ms on, that is less than a tenth of the period.
        assert_eq!(would_be(&[(30 * US, 8_000), (300 * US, 2_000)], |_| ()), Some(4 * MS));
        // A fiftieth begins 5 ms late: the window is half of the period, and half of that may pass before a slot.
        let seldom = [(30 * US, 9_800), (5 * MS, 200)];
        assert_eq!(would_be(&seldom, |_| ()), Some(32 * MS));
        assert_eq!(would_be(&seldom, |cycle| cycle.tolerated.skipped = 0.03), None);
        // What is beyond the histogram, or takes more than a second, is not known.
        assert_eq!(would_be(&[(60 * MS, 10_000)], |_| ()), None);
        assert_eq!(would_be(&[(55 * MS, 10_000)], |cycle| cycle.receive_deadline = 0.1), None);
    }
}
