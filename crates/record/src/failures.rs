//! What counts as a failure of a drive while it runs, for those who keep what led up to it.

use fieldbeat_core::axis::{Fault, FaultNames, Link, StopCause};
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::cycle::record::DriveRecord;

/// The drives as they were last seen.
#[derive(Debug)]
pub struct Failures(Vec<LastState>);

#[derive(Debug)]
struct LastState {
    name: String,
    fault_names: FaultNames,
    link: Link,
    fault: u32,
    stopped: Option<StopCause>,
}

impl Failures {
    /// Of the machine of `plan`.
    pub fn of(plan: &Plan) -> Failures {
        let axes = plan.axes().into_iter().zip(plan.fault_names());
        let known = |(axis, fault_names): (&fieldbeat_core::axis::AxisPlan, FaultNames)| LastState {
            name: axis.name.clone(),
            fault_names,
            link: Link::default(),
            fault: 0,
            stopped: None,
        };
        Failures(axes.map(known).collect())
    }

    /// Of drives with these names.
    pub fn of_names(names: &[&str]) -> Failures {
        let known = |name: &&str| LastState {
            name: (*name).to_owned(),
            fault_names: |_| None,
            link: Link::default(),
            fault: 0,
            stopped: None,
        };
        Failures(names.iter().map(known).collect())
    }

    /// The new failure: a lost link, a fault, a stop that is not that of the end.
    pub fn see(&mut self, drive: &DriveRecord) -> Option<String> {
        let known = self.0.get_mut(usize::from(drive.axis))?;
        let before = (known.link, known.fault, known.stopped);
        (known.link, known.fault, known.stopped) = (drive.link, drive.fault, drive.stopped);
        let (link, fault, stopped) = before;
        let what = if drive.link == Link::Lost && link != Link::Lost {
            "link lost".to_owned()
        } else if drive.fault != 0 && fault == 0 {
            format!("fault {}", Fault::new(drive.fault, known.fault_names))
        } else {
            let cause = drive.stopped.filter(|cause| stopped.is_none() && *cause != StopCause::Shutdown)?;
            format!("stopped: {cause}")
        };
        Some(format!("drive {}: {what}", known.name))
    }
}
