//! Why a cycle was late, without a kernel tracer: what the loop itself observed, joined by time with what the kernel
//! counted for its thread.
//!
//! | evidence | cause |
//! |---|---|
//! | page faults since the look before | page fault |
//! | awake, an involuntary switch, and it waited for its core at least half of the delay | preempted |
//! | asleep, then it waited for its core at least half of the delay beyond its usual run delay | preempted |
//! | a stage took long, and not much longer than it usually does | own work, in that stage |
//! | a stage with system calls or the in-loop task took long, and the thread ran for at least half of that | own work |
//! | any other stage, or the final spin: a gap in straight code | the host took the core |
//! | a sleep ended late with none of these, and the hypervisor's steal rose within a second | the host took the core |
//! | a sleep ended late, and the thread ran as soon as it was woken | its timer came late |
//! | a drive that is online had not answered at the deadline, and the loop itself was in time | the drive, or several |
//! | no sample around it, but page faults or involuntary switches since the look before | page fault, or preempted |
//! | the samples around it are too far apart to assign their delays, or the run time of quiet cycles varies by as much; or its record was lost | unknown |
//!
//! A bound of half, because the delay and what explains it are never measured between the same two instants.
//!
//! The times of the thread are read often: the longer a span, the less can be said of one cycle in it. Its counts are
//! dearer, and need only be known from some time before a late cycle: the loop reads its own after each late one, and
//! is disturbed so seldom otherwise that a tenth of a second before is as good as right before.

use std::collections::VecDeque;
use std::ops::Range;

use fieldbeat_core::cycle::record::{
    CycleRecord, DriveRecord, Lateness, Look, Record, Reply, SkippedRecord, Stage,
};
use fieldbeat_core::cycle::{CyclePlan, Wait};
use fieldbeat_core::rt::watch::{ThreadCounts, ThreadSample};
use fieldbeat_core::time::{MS, S, Time};

/// The cause of a late cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Cause {
    /// Something below the kernel took the core: a hypervisor, or firmware.
    Host,
    /// Another thread had the core, or the kernel throttled this one.
    Preempted,
    /// A page was not there.
    PageFault,
    /// The loop's own work in this stage.
    Work(Stage),
    /// This axis' drive answered late or not at all.
    Drive(u16),
    /// Several drives at once: something that they share.
    Drives,
    /// The thread was woken late: a core in a deep idle state, with interrupts off, in firmware, or one that a
    /// hypervisor does not own up to having taken.
    Timer,
    /// Nothing was seen.
    Unknown,
}

/// How often a cause was found, and its worst case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tally {
    /// The cause.
    pub cause: Cause,
    /// Cycles.
    pub count: u64,
    /// The longest delay, ns; 0 for a drive that did not answer.
    pub worst_ns: u64,
    /// The cycle of that.
    pub worst_cycle: u64,
}

/// A late cycle and its cause.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Judged {
    /// The cycle.
    pub index: u64,
    /// The late part.
    pub lateness: Lateness,
    /// The begin of its delay.
    pub from: Time,
    /// The end of its delay.
    pub to: Time,
    /// Why.
    pub cause: Cause,
}

/// How many of the newest judgements are kept one by one.
pub(crate) const MOST_JUDGED: usize = 1024;

/// How long after a late wake-up a rise of the steal time still explains it: it is counted in ticks of 10 ms, and read
/// some ten times a second.
const STEAL_TELLS_NS: u64 = S;

/// How fast what is usual is learned: the weight of one more value.
const SLOWLY: f64 = 0.05;

/// Up to so many times as long as usual a stage is only busy.
const USUAL: f64 = 4.0;

/// The multiple of the mean deviation of a quiet span that a run time may be off by itself.
const DOUBT: f64 = 3.0;

/// In a longer span than this one delay cannot be separated from another.
const LONGEST_SPAN_NS: u64 = 50 * MS;

/// Late cycles that wait for their sample. More at once are judged by what is known.
const MOST_PENDING: usize = 4096;

/// Samples kept: with one every 10 ms those of more than [`STEAL_TELLS_NS`].
const MOST_SAMPLES: usize = 256;

/// Joins late cycles and samples.
#[derive(Clone, Debug)]
pub struct Causes {
    late_ns: u64,
    deadline_ns: u64,
    /// It sleeps while it waits for replies.
    polls: bool,
    /// Between two samples each: what is not yet explained by it.
    spans: VecDeque<Span>,
    newest: Option<ThreadSample>,
    /// Time that the loop could have run while something else had its core, in all samples, ns.
    taken_ns: u64,
    pending: VecDeque<Late>,
    /// The last drive that was online and missed an exchange: its cycle, and its axis.
    missed: Option<(u64, u16)>,
    /// The last executed cycle.
    last: CycleRecord,
    /// The counts that the last late cycle had looked at, and when.
    looked: Option<(Time, Look)>,
    /// Cycles since the newest sample, and whether one of them was late.
    cycles: u64,
    late: bool,
    /// The times that a cycle usually runs, waits for the core, and takes in each of its stages, ns.
    usual_ns: f64,
    usual_delay_ns: f64,
    /// By how much the run time of a quiet cycle differs from that, as the mean of spans, ns.
    deviation_ns: f64,
    usual_stage_ns: [f64; 6],
    /// There is an in-loop task.
    task: bool,
    tallies: Vec<Tally>,
    judged: VecDeque<Judged>,
    /// How many there were.
    judgements: u64,
}

/// The kernel's counts between two samples.
#[derive(Clone, Copy, Debug)]
struct Span {
    from: Time,
    to: Time,
    /// Waited for the core beyond the usual, ns.
    delay_ns: u64,
    /// Ran beyond the usual, ns.
    run_ns: u64,
    /// The part of that which may be missing, since cycles do not all run equally long, ns.
    doubt_ns: u64,
    /// The newest counts at its begin.
    counts: ThreadCounts,
    /// By how much the steal time was found risen at its end, ms.
    steal_ms: u64,
}

/// A late cycle.
#[derive(Clone, Copy, Debug)]
struct Late {
    index: u64,
    lateness: Lateness,
    from: Time,
    to: Time,
    /// It was awake all the while.
    straight: bool,
    /// The look before it and its own.
    looks: (Option<(Time, Look)>, Option<Look>),
    /// The cause, if it is that a drive had not answered.
    drive: Option<Cause>,
}

impl Causes {
    /// For the loop of this plan, with an in-loop task or none.
    #[doc(hidden)]
    pub fn new(cycle: &CyclePlan, task: bool) -> Causes {
        Causes {
            late_ns: cycle.late_ns(),
            deadline_ns: cycle.deadline_ns(),
            polls: cycle.wait == Wait::Poll,
            spans: VecDeque::with_capacity(MOST_SAMPLES),
            newest: None,
            taken_ns: 0,
            pending: VecDeque::new(),
            missed: None,
            looked: None,
            cycles: 0,
            late: false,
            usual_ns: 0.0,
            usual_delay_ns: 0.0,
            deviation_ns: 0.0,
            last: CycleRecord::default(),
            usual_stage_ns: [0.0; 6],
            task,
            tallies: Vec::with_capacity(16),
            judged: VecDeque::with_capacity(MOST_JUDGED),
            judgements: 0,
        }
    }

    /// Looks at that of a drive.
    #[inline]
    pub(crate) fn drive(&mut self, drive: &DriveRecord) {
        // Mostly it has answered.
        if drive.reply == Reply::Missed
            && drive.was_online()
            && self.missed.is_none_or(|(cycle, _)| cycle != drive.index)
        {
            self.missed = Some((drive.index, drive.axis));
        }
    }

    /// Looks at one record.
    #[doc(hidden)]
    pub fn record(&mut self, record: &Record) {
        match record {
            Record::Drive(drive) => self.drive(drive),
            Record::Monitor(_)
            | Record::Reference(_)
            | Record::Command(_)
            | Record::Event(_)
            | Record::Native(_) => {}
            Record::Cycle(record) => {
                self.cycles += 1;
                self.last = *record;
                if let Some(lateness) = record.lateness(self.late_ns, self.deadline_ns) {
                    self.cycle(record, lateness);
                }
                for (usual, ns) in self.usual_stage_ns.iter_mut().zip(record.stages_ns) {
                    // An outlier counts as no more than the double, or it would soon be usual.
                    let ns = f64::from(ns);
                    let ns = if *usual == 0.0 { ns } else { ns.min(2.0 * *usual) };
                    *usual += SLOWLY * (ns - *usual);
                }
            }
            Record::Skipped(record) if record.woke_late => self.skipped(record),
            Record::Skipped(record) if record.late => self.overrun(record),
            Record::Skipped(_) => self.late = true,
        }
    }

    fn cycle(&mut self, record: &CycleRecord, lateness: Lateness) {
        let begin = record.grid + u64::from(record.wake_ns);
        let (from, to) = match lateness {
            Lateness::Wake(_) => (record.grid, begin),
            Lateness::Stage(stage, _) => {
                let before: u64 = record.stages_ns[..stage as usize].iter().map(|ns| u64::from(*ns)).sum();
                let from = begin + before;
                (from, from + u64::from(record.stages_ns[stage as usize]))
            }
            Lateness::Reply => (begin, record.grid + self.deadline_ns),
        };
        let drive = match (record.missed, self.missed) {
            (2.., _) => Some(Cause::Drives),
            (_, Some((cycle, axis))) if cycle == record.index => Some(Cause::Drive(axis)),
            _ => None,
        };
        let straight = match lateness {
            Lateness::Wake(_) => record.spun,
            Lateness::Stage(stage, _) => stage != Stage::Receive || !self.polls,
            Lateness::Reply => false,
        };
        let (index, looks) = (record.index, (self.looked, record.look));
        self.push(Late { index, lateness, from, to, straight, looks, drive });
    }

    fn skipped(&mut self, record: &SkippedRecord) {
        let (index, lateness) = (record.first, Lateness::Wake(record.given_up_ns));
        let (from, to) = (record.grid, record.grid + record.given_up_ns);
        let (straight, looks) = (record.spun, (self.looked, record.look));
        self.push(Late { index, lateness, from, to, straight, looks, drive: None });
    }

    /// A cycle passed the next grid point although none of its stages was late: the longest of them is to blame, or
    /// what came behind them.
    fn overrun(&mut self, record: &SkippedRecord) {
        let last = &self.last;
        let begin = last.grid + u64::from(last.wake_ns);
        let end = last.stages_ns.iter().fold(begin, |end, ns| end + u64::from(*ns));
        let noticed = record.grid + record.given_up_ns;
        let (stage, ns) = (Stage::ALL.into_iter().zip(last.stages_ns))
            .max_by_key(|(_, ns)| *ns)
            .unwrap_or((Stage::Publish, 0));
        let gap_ns = noticed.since(end);
        let (lateness, from, to) = if gap_ns > u64::from(ns) {
            (Lateness::Stage(Stage::Publish, gap_ns), end, noticed)
        } else {
            (Lateness::Stage(stage, u64::from(ns)), begin, end)
        };
        let (straight, looks) = (stage != Stage::Receive || !self.polls, (self.looked, record.look));
        self.push(Late { index: last.index, lateness, from, to, straight, looks, drive: None });
    }

    fn push(&mut self, late: Late) {
        self.late = true;
        self.looked = late.looks.1.map(|look| (late.to, look)).or(self.looked);
        // Nobody takes samples: in virtual time there is no kernel that counts.
        if self.newest.is_none() {
            return self.settle(&late);
        }
        if self.pending.len() == MOST_PENDING
            && let Some(first) = self.pending.pop_front()
        {
            self.settle(&first);
        }
        self.pending.push_back(late);
    }

    /// Whether a cycle was late since the newest sample.
    pub fn is_late(&self) -> bool {
        self.late
    }

    /// Takes a sample in, after all records from before it, and finds the causes that it shows.
    #[doc(hidden)]
    pub fn sample(&mut self, sample: ThreadSample) {
        if let Some(before) = self.newest.replace(sample) {
            let ran_ns = sample.run_ns.saturating_sub(before.run_ns);
            let delay_ns = sample.delay_ns.saturating_sub(before.delay_ns);
            self.taken_ns += delay_ns;
            let cycles = self.cycles as f64;
            let usual = [self.usual_ns, self.usual_delay_ns].map(|each_ns| (each_ns * cycles) as u64);
            if !self.late && self.cycles > 0 {
                if self.usual_ns != 0.0 {
                    let differs_ns = (ran_ns as f64 / cycles - self.usual_ns).abs();
                    self.deviation_ns += SLOWLY * (differs_ns - self.deviation_ns);
                }
                for (usual, ns) in [(&mut self.usual_ns, ran_ns), (&mut self.usual_delay_ns, delay_ns)] {
                    // The first undisturbed span sets it.
                    let weight = if *usual == 0.0 { 1.0 } else { SLOWLY };
                    *usual += weight * (ns as f64 / cycles - *usual);
                }
            }
            if self.spans.len() == MOST_SAMPLES {
                self.spans.pop_front();
            }
            self.spans.push_back(Span {
                from: before.at,
                to: sample.at,
                delay_ns: delay_ns.saturating_sub(usual[1]),
                run_ns: ran_ns.saturating_sub(usual[0]),
                doubt_ns: (DOUBT * self.deviation_ns * cycles) as u64,
                counts: before.counts,
                steal_ms: sample.counts.steal_ms.saturating_sub(before.counts.steal_ms),
            });
        }
        (self.cycles, self.late) = (0, false);
        // Not in the order they came: one that waits for the steal time delays no other.
        for late in std::mem::take(&mut self.pending) {
            if late.to > sample.at {
                self.pending.push_back(late);
            } else if let Some(cause) = self.seen(&late) {
                self.count(&late, cause);
            } else if late.slept() && sample.at < late.to + STEAL_TELLS_NS {
                self.pending.push_back(late);
            } else {
                self.settle(&late);
            }
        }
    }

    /// Judges what still waits by what is known now. `late` is the loop's own count: what got lost on the way is
    /// unknown.
    #[doc(hidden)]
    pub fn finish(&mut self, late: u64) {
        for late in std::mem::take(&mut self.pending) {
            self.settle(&late);
        }
        let judged: u64 = self.tallies.iter().map(|tally| tally.count).sum();
        if let Some(lost) = late.checked_sub(judged).filter(|lost| *lost > 0) {
            self.tally(Cause::Unknown).count += lost;
        }
    }

    /// Time that the loop could have run while another thread had its core, ns (run delay, sched-stats.rst).
    pub fn taken_ns(&self) -> u64 {
        self.taken_ns
    }

    /// The causes found so far, the most frequent first.
    pub fn ranked(&self) -> Vec<Tally> {
        let mut ranked = self.tallies.clone();
        ranked.sort_by_key(|tally| std::cmp::Reverse((tally.count, tally.worst_ns)));
        ranked
    }

    /// The newest so many judgements of those that are kept, not in the order of their cycles: some wait longer than
    /// others.
    pub fn newest(&self, count: usize) -> impl Iterator<Item = &Judged> {
        self.judged.iter().skip(self.judged.len().saturating_sub(count))
    }

    /// How many judgements there were.
    pub(crate) fn judgements(&self) -> u64 {
        self.judgements
    }

    /// The judgements after the first `seen`, as far as they are kept; counts on `seen`.
    #[doc(hidden)]
    pub fn judged_after(&self, seen: &mut u64) -> impl Iterator<Item = &Judged> {
        let new = self.judgements - *seen;
        *seen = self.judgements;
        self.newest(usize::try_from(new).unwrap_or(usize::MAX))
    }

    /// The last word on a late cycle.
    fn settle(&mut self, late: &Late) {
        let stolen = |causes: &Causes| {
            let soon = causes.between(late.from, late.to + STEAL_TELLS_NS);
            causes.spans.range(soon).map(|span| span.steal_ms).sum::<u64>() > 0
        };
        let cause = match self.seen(late) {
            Some(cause) => cause,
            None if late.slept() && stolen(self) => Cause::Host,
            None if late.slept() && !self.around(late).is_empty() => Cause::Timer,
            None => late.by_looks(),
        };
        self.count(late, cause);
    }

    /// The cause, as far as the samples around it show one.
    fn seen(&mut self, late: &Late) -> Option<Cause> {
        if late.lateness == Lateness::Reply {
            return late.drive;
        }
        let begin = *self.spans.range(self.around(late)).next()?;
        if late.rose(&begin, |look| look.faults) {
            return Some(Cause::PageFault);
        }
        if late.slept() || late.rose(&begin, |look| look.switches) {
            if late.slept() && self.is_blurred(late) {
                return Some(Cause::Unknown);
            }
            if self.explains(late, |span| &mut span.delay_ns) {
                return Some(Cause::Preempted);
            }
        }
        let Lateness::Stage(stage, ns) = late.lateness else {
            return late.straight.then_some(Cause::Host);
        };
        let calls = match stage {
            Stage::Receive if late.slept() => return None,
            Stage::Send | Stage::Receive => true,
            Stage::Commands => self.task,
            Stage::Evaluate | Stage::Prepare | Stage::Publish => false,
        };
        let usual = ns as f64 <= USUAL * self.usual_stage_ns[stage as usize];
        if usual || calls && self.explains(late, |span| &mut span.run_ns) {
            return Some(Cause::Work(stage));
        }
        // Over many cycles what is usual is not known so well, nor on a host whose cores change their speed.
        let is_open = calls && (self.longest_span_ns(late) > LONGEST_SPAN_NS || self.is_in_doubt(late));
        Some(if is_open { Cause::Unknown } else { Cause::Host })
    }

    /// Whether a run delay was counted around `late` that may as well be another one's.
    fn is_blurred(&self, late: &Late) -> bool {
        let delay_ns: u64 = self.spans.range(self.around(late)).map(|span| span.delay_ns).sum();
        self.longest_span_ns(late) > LONGEST_SPAN_NS && delay_ns >= late.lateness.ns() / 2
    }

    /// Whether the thread may have run for at least half of the delay, by how much quiet spans differ.
    fn is_in_doubt(&self, late: &Late) -> bool {
        let most_ns = |span: &Span| span.run_ns + span.doubt_ns;
        self.spans.range(self.around(late)).map(most_ns).sum::<u64>() >= late.lateness.ns() / 2
    }

    fn longest_span_ns(&self, late: &Late) -> u64 {
        self.spans.range(self.around(late)).map(|span| span.to.since(span.from)).max().unwrap_or(0)
    }

    /// The spans that a late cycle meets.
    fn around(&self, late: &Late) -> Range<usize> {
        self.between(late.from, late.to)
    }

    /// The spans that meet this time. They follow each other without a gap, and a late cycle may wait for many of them.
    fn between(&self, from: Time, to: Time) -> Range<usize> {
        let first = self.spans.partition_point(|span| span.to <= from);
        first..self.spans.partition_point(|span| span.from < to).max(first)
    }

    /// Whether so much was counted around `late` that it explains at least half of it; then it explains no other one.
    fn explains(&mut self, late: &Late, of: fn(&mut Span) -> &mut u64) -> bool {
        let around = self.around(late);
        let near: Vec<&mut u64> = self.spans.range_mut(around).map(of).collect();
        let counted: u64 = near.iter().map(|ns| **ns).sum();
        let enough = counted > 0 && counted >= late.lateness.ns() / 2;
        if enough {
            let mut left = late.lateness.ns();
            for ns in near {
                let part = left.min(*ns);
                *ns -= part;
                left -= part;
            }
        }
        enough
    }

    fn count(&mut self, late: &Late, cause: Cause) {
        if self.judged.len() == MOST_JUDGED {
            self.judged.pop_front();
        }
        let Late { index, lateness, from, to, .. } = *late;
        self.judgements += 1;
        self.judged.push_back(Judged { index, lateness, from, to, cause });
        let tally = self.tally(cause);
        tally.count += 1;
        let ns = late.lateness.ns();
        if ns > tally.worst_ns || tally.count == 1 {
            (tally.worst_ns, tally.worst_cycle) = (ns, late.index);
        }
    }

    fn tally(&mut self, cause: Cause) -> &mut Tally {
        let place = self.tallies.iter().position(|tally| tally.cause == cause);
        let place = place.unwrap_or_else(|| {
            self.tallies.push(Tally { cause, count: 0, worst_ns: 0, worst_cycle: 0 });
            self.tallies.len() - 1
        });
        &mut self.tallies[place]
    }
}

impl Late {
    /// The delay ended a sleep: it does not show where the time went.
    fn slept(&self) -> bool {
        match self.lateness {
            Lateness::Wake(_) | Lateness::Stage(..) => !self.straight,
            Lateness::Reply => false,
        }
    }

    /// Without samples around it: what the loop itself saw counted since its look before.
    fn by_looks(&self) -> Cause {
        let (Some((_, before)), Some(own)) = self.looks else { return Cause::Unknown };
        match () {
            () if own.faults != before.faults => Cause::PageFault,
            () if own.switches != before.switches => Cause::Preempted,
            () => Cause::Unknown,
        }
    }

    /// Whether a count rose since the look before, or since the counts before if those are newer.
    fn rose(&self, span: &Span, count: fn(&Look) -> u32) -> bool {
        let (before, Some(own)) = &self.looks else { return false };
        let ThreadCounts { at, faults, switches, .. } = span.counts;
        let before =
            before.filter(|(looked, _)| *looked > at).map_or(Look { faults, switches }, |(_, look)| look);
        count(own) != count(&before)
    }
}

#[cfg(test)]
mod tests;
