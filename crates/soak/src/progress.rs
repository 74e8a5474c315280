//! What is known of a soak test so far, over all the processes that ran it. Written as its checkpoint.

use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use super::Soak;
use super::mover::STOPPED;
use super::samples::{Process, Sample};
use fieldbeat_core::axis::{SilenceFaults, State, StopCause};
use fieldbeat_record::archive::{Archive, Drive};
use fieldbeat_telemetry::{Happened, Marks};

/// The form of the checkpoint. Another one is refused.
pub const FORMAT: u32 = 1;

/// A test so far.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Progress {
    /// The form of the file.
    pub format: u32,
    /// The configuration, as it was read.
    pub configuration: String,
    /// How long it is to run, ns.
    pub length_ns: u64,
    /// The processes that ran it, the present one last.
    pub processes: Vec<Process>,
    /// The axes, in the order of the plan.
    pub axes: Vec<AxisProgress>,
    /// Checkpoints that could not be written.
    pub files_lost: u64,
    /// The measurements; `None`: nothing yet.
    pub run: Option<Archive>,
}

/// An axis so far.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct AxisProgress {
    /// It is to move.
    pub moves: bool,
    /// Moves that came to their end, or velocities or swings that have begun.
    pub cycles: u64,
    /// Why it moves no longer, in the process that was first.
    pub given_up: Option<String>,
    /// Faults that the pauses between the processes caused, or that stood through them and are counted before, and the
    /// stops by them: they do not count.
    #[serde(default)]
    pub faults_of_pauses: u64,
    /// Likewise; and those by the group of a drive that was found running, before the axis was enabled.
    #[serde(default)]
    pub stops_of_pauses: u64,
}

impl AxisProgress {
    /// It was stopped, and moves no longer by that.
    pub fn was_stopped(&self) -> bool {
        self.given_up.as_ref().is_some_and(|why| why.starts_with(STOPPED))
    }

    /// The faults that do not count of a process, by its marks up to when the axis was enabled: a fault of these, which
    /// the pause before has caused, or the one that has `stood` through it, with the stop by it, and stops by the
    /// group. One by which the axis was given up counts.
    fn excuse(
        &mut self,
        is_of_pause: Option<SilenceFaults>,
        stood: Option<u32>,
        given_up: Option<&str>,
        marks: &Marks,
    ) {
        let enabled = Happened::State(State::OperationEnabled.to_string());
        let stopped = |cause: StopCause| Happened::Stopped(cause.to_string());
        let before = marks.iter().map(|mark| &mark.what).take_while(|what| **what != enabled);
        let before: Vec<_> = before.collect();
        let by_group = before.iter().filter(|what| ***what == stopped(StopCause::Group)).count() as u64;
        // A drive that comes online after the stop may be found enabled.
        let is_last =
            marks.iter().filter(|mark| mark.what == stopped(StopCause::Group)).count() as u64 == by_group;
        let of_group = format!("{STOPPED}{}", StopCause::Group);
        let counts = is_last && given_up.is_some_and(|why| why.starts_with(&of_group));
        self.stops_of_pauses += by_group.saturating_sub(u64::from(counts));
        // A drive that was seen without a fault has a new one.
        let faulty = [State::Fault, State::FaultReactionActive, State::NotReadyToSwitchOn, State::Unknown];
        let is_faulty = |state: &String| faulty.iter().any(|faulty| faulty.to_string() == *state);
        let found = before.iter().take_while(|what| !matches!(what, Happened::State(of) if !is_faulty(of)));
        let stood = stood.filter(|code| found.clone().any(|what| **what == Happened::Fault(*code)));
        let excused =
            |code: u32| stood == Some(code) || is_of_pause.is_some_and(|is_of_pause| is_of_pause(code));
        let mut before = before.into_iter();
        let has_fault = before.any(|what| matches!(what, Happened::Fault(code) if excused(*code)));
        self.faults_of_pauses += u64::from(has_fault);
        self.stops_of_pauses +=
            u64::from(has_fault && before.any(|what| *what == stopped(StopCause::DriveFault)));
    }
}

impl Progress {
    /// A test that begins.
    pub fn new(configuration: String, length_ns: u64) -> Progress {
        Progress {
            format: FORMAT,
            configuration,
            length_ns,
            processes: Vec::new(),
            axes: Vec::new(),
            files_lost: 0,
            run: None,
        }
    }

    /// Machine time so far, ns.
    pub fn ran_ns(&self) -> u64 {
        self.run.as_ref().map_or(0, Archive::length_ns)
    }

    /// Machine time that is left, ns.
    pub fn left_ns(&self) -> u64 {
        self.length_ns.saturating_sub(self.ran_ns())
    }

    /// Begins a process.
    pub fn begin(&mut self) {
        let (began_s, from_ns) = (now_s(), self.ran_ns());
        self.processes.push(Process { began_s, seen_s: began_s, from_ns, ..Process::default() });
    }

    /// The test with what this process has done so far: its run, and its axes. `self` is what was before the process,
    /// and its samples.
    pub fn with(&self, run: &Archive, soak: &Soak) -> Progress {
        let mut all = self.clone();
        if let Some(process) = all.processes.last_mut() {
            (process.seen_s, process.ran_ns) = (now_s(), run.length_ns());
        }
        all.axes.resize(soak.movers().len().max(all.axes.len()), AxisProgress::default());
        for (axis, mover) in all.axes.iter_mut().zip(soak.movers()) {
            axis.moves = mover.moves();
            axis.cycles += mover.cycles();
            if axis.given_up.is_none() {
                axis.given_up = mover.given_up().map(str::to_owned);
            }
        }
        let before = self.run.as_ref();
        let axes = all.axes.iter_mut().zip(soak.movers()).zip(&run.drives);
        for (index, ((axis, mover), drive)) in axes.enumerate() {
            let stood = before.and_then(|run| standing_fault(run.drives.get(index)?));
            axis.excuse(mover.of_pause(), stood, mover.given_up(), &drive.motion.marks);
        }
        match &mut all.run {
            Some(before) => before.append(run),
            none => *none = Some(run.clone()),
        }
        all
    }

    /// Samples this process.
    pub fn sample(&mut self, at_ns: u64) {
        if let Some(process) = self.processes.last_mut() {
            process.take(Sample::now(at_ns));
        }
    }

    /// Time of the clock that nothing was measured in, between two processes, s.
    pub fn gaps_s(&self) -> u64 {
        self.processes.windows(2).map(|pair| pair[1].gap_after(&pair[0])).sum()
    }
}

/// The code of the fault that a drive had when its process ended.
fn standing_fault(drive: &Drive) -> Option<u32> {
    drive.fault.as_ref()?;
    let codes = drive.motion.marks.iter().filter_map(|mark| match mark.what {
        Happened::Fault(code) => Some(code),
        _ => None,
    });
    codes.last()
}

fn now_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::axis::{Link, Units};
    use fieldbeat_core::drive::record::DriveRecord;
    use fieldbeat_telemetry::Motion;

    #[test]
    fn a_pause_has_caused_a_fault_of_silence_before_the_first_enable_and_no_other_one() {
        use State::{Fault, OperationEnabled, SwitchOnDisabled};
        let stopped = Some(StopCause::DriveFault);
        let enabled = (OperationEnabled, 0, None);
        let group = (SwitchOnDisabled, 0, Some(StopCause::Group));
        let by_group = Some("stopped: stop group, begun by y: link lost");
        // That of the process before.
        let stood = Some(20);
        for (course, given_up, faults, stops) in [
            // It was found, and again once it was reset; another one.
            (&[(Fault, 20, stopped)][..], None, 1, 1),
            (&[(Fault, 20, stopped), (SwitchOnDisabled, 0, None), (Fault, 20, stopped)], None, 1, 1),
            (&[(SwitchOnDisabled, 0, None), (Fault, 20, stopped)], None, 0, 0),
            (&[(Fault, 21, stopped)], None, 0, 0),
            (&[(Fault, 30, stopped), (SwitchOnDisabled, 0, None), enabled], None, 1, 1),
            (&[(Fault, 30, None), (SwitchOnDisabled, 0, None), enabled], None, 1, 0),
            // Another fault, one of a drive that moved again, and none.
            (&[(Fault, 9, stopped), enabled], None, 0, 0),
            (&[enabled, (Fault, 30, stopped)], Some("stopped: drive fault"), 0, 0),
            (&[enabled], None, 0, 0),
            // By the group of a drive that was found running, and of one that is lost, in motion or before.
            (&[group, (SwitchOnDisabled, 0, None), enabled], None, 0, 1),
            (&[group, (SwitchOnDisabled, 0, None), enabled, group], by_group, 0, 1),
            (&[enabled, (OperationEnabled, 0, Some(StopCause::Group))], by_group, 0, 0),
            (&[group], None, 0, 1),
            (&[group], by_group, 0, 0),
            (&[group, (OperationEnabled, 0, Some(StopCause::Group))], by_group, 0, 0),
        ] {
            let mut motion = Motion::new(&[Units::millimetres(1.0)]);
            for (index, (state, fault, stopped)) in course.iter().copied().enumerate() {
                let (index, link) = (index as u64, Link::Online);
                motion.enter(&DriveRecord { index, link, state, fault, stopped, ..DriveRecord::default() });
            }
            let mut axis = AxisProgress::default();
            axis.excuse(Some(|code| code == 30), stood, given_up, &motion.axes().next().unwrap().marks);
            assert_eq!((axis.faults_of_pauses, axis.stops_of_pauses), (faults, stops), "{course:?}");
        }
    }
}
