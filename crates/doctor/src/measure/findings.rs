//! What follows from the results for the plan.

use super::results::{Carries, Measured, Noise};
use crate::Subject;
use crate::finding::{Area, Finding};
use crate::stats::Interval;
use fieldbeat_core::time::Ns;
use fieldbeat_record::summary::plural;

impl Measured {
    /// The findings for the plan.
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
                    "interrupts, firmware and the host of a virtual machine take the core from a thread that \
                     never sleeps, whatever its priority"
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
                    Some(shortest) if shortest > period_ns => {
                        format!("period = \"{}\" in [cycle]\nor ", key(shortest))
                    }
                    _ => String::new(),
                };
                let fix = fix + "fix what is poor, use what helps below, and measure again";
                finding.bad(found).advise(fix)
            }
            () if at_most > miss_rate => finding.unknown(format!(
                "{found}; certain only after {enough} cycles without a late one (--for), or with a larger \
                 --miss-rate"
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
                "the shortest period tried at which, as at all longer ones, {} of the cycles at most were \
                 late",
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
pub fn percent(share: f64) -> String {
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

pub(super) const HELPS: &str = "helps";

pub(super) const HURTS: &str = "hurts";

/// The meaning of a ratio of latencies with its interval.
pub fn word(ratio: &Interval) -> &'static str {
    match ratio {
        Interval { high, .. } if *high < 0.95 => HELPS,
        Interval { low, .. } if *low > 1.05 => HURTS,
        _ => "undecided",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Verdict::{Bad, Good, Poor, Unknown};
    use crate::facts::testing::subject;
    use crate::measure::slice::GAP_NS;
    use fieldbeat_core::cycle::cost::Costs;
    use fieldbeat_core::time::{MS, S, US};

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
            costs: Costs::default().into(),
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
