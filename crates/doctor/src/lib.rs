//! The doctor: how well this host suits real time, and how to fix what does not. It changes nothing itself.
//!
//! | file | what |
//! |---|---|
//! | `facts` | what this host reports: files, and probes for what no file says |
//! | `ethtool`, `tty` | settings of a network interface, and of a serial port |
//! | `way` | how a bus meets the network |
//! | `finding` | the result of a check |
//! | `kernel`, `rights`, `core`, `power`, `clock`, `memory` | the checks: facts in, findings out |
//! | `network`, `nic`, `port`, `interrupts` | the same for each bus, with a configuration only |
//! | `load` | what a cycle of the plan takes |
//! | `measure` | settings that can be tried at run time, and their effect here |
//! | `stats` | quantiles and ratios with intervals; the benches use them too |
//! | `report` | findings and measurements as text and as JSON |
//!
//! # Ready or not
//!
//! A host is **not ready** if one finding is [`Verdict::Bad`]: the master would refuse to start, would not be
//! real-time, or would fail for certain. That is a right that is missing (unless `realtime = "off"`), a control group
//! without real-time budget, a plan that starves its core, a core or an address that does not exist, a clock that is
//! slow to read, and, if it was measured, a share of late cycles above the wanted one. [`Verdict::Poor`] is advice; a
//! kernel without PREEMPT_RT is poor and not bad: it guarantees no bound, but refuses nothing either, so measure. What
//! is not known is [`Verdict::Unknown`] and refuses nothing.

mod clock;
mod core;
mod ethtool;
mod facts;
mod finding;
mod interrupts;
mod kernel;
mod load;
mod measure;
mod memory;
mod network;
mod nic;
pub mod port;
mod power;
mod report;
mod rights;
pub mod stats;
mod tty;
mod way;

use std::path::PathBuf;

pub use way::{Line, Port, Wire};

pub use finding::{Area, Finding, Verdict};
pub use measure::{
    Carries, CostOf, Effort, Factor, Glance, Latency, Measured, Noise, Progress, Untried, glance, measure,
};
pub use report::{Carried, Counts, Host, Report};

use fieldbeat_core::cycle::cost::{Costs, Demand};
use fieldbeat_core::cycle::{CyclePlan, OnCost, Plan};
use fieldbeat_core::rt::thread::default_core;
use way::Way;

/// The plan that the host is to run.
#[derive(Clone, Debug, PartialEq)]
pub struct Subject {
    /// Where the plan came from.
    pub source: Option<PathBuf>,
    /// The cycle.
    pub cycle: CyclePlan,
    /// The core of the loop: that of the plan, or the one that the loop would take.
    pub core: usize,
    /// The wires of its buses.
    pub wires: Vec<Wire>,
    /// Those of its buses that have no IP addresses.
    pub lines: Vec<Line>,
    /// The serial ports of its buses.
    pub ports: Vec<Port>,
    /// Which exchanges its cycles have; `None`: nothing is known of its drives, or nobody wants an estimate.
    pub demand: Option<Demand>,
}

impl Subject {
    /// A whole machine.
    pub fn of(plan: &Plan) -> Subject {
        let grid = plan.cycle.grid();
        let demand = (plan.cycle.cost != OnCost::Ignore).then(|| Demand::of(plan));
        let mut subject =
            Subject { source: plan.source.clone(), demand, ..Subject::cycle(plan.cycle.clone()) };
        for way in plan.buses.iter().filter_map(|bus| Way::of(bus.as_ref(), grid)) {
            match way {
                Way::Wire(wire) => subject.wires.push(wire),
                Way::Line(line) => subject.lines.push(line),
                Way::Port(port) => subject.ports.push(port),
            }
        }
        subject
    }

    /// A cycle alone: nothing is known of its drives.
    pub fn cycle(cycle: CyclePlan) -> Subject {
        // Every computer has a core 0, whatever its kernel reports.
        let core = cycle.core.or_else(default_core).unwrap_or(0);
        Subject {
            source: None,
            cycle,
            core,
            wires: Vec::new(),
            lines: Vec::new(),
            ports: Vec::new(),
            demand: None,
        }
    }
}

/// Looks at this host. Takes a fraction of a second: a thread of its own tries the core and the priority for a moment,
/// and the memory lock of the plan is taken and released, with all other locks of this process; so not in a
/// process whose loop is running.
pub fn examine(subject: &Subject) -> Vec<Finding> {
    let mut findings = judge(&facts::Facts::of_this_host(subject), subject);
    findings.extend(subject.demand.as_ref().map(|demand| load::check(demand, &Costs::of_this_host())));
    findings
}

fn judge(facts: &facts::Facts, subject: &Subject) -> Vec<Finding> {
    let mut findings = kernel::check(facts, subject);
    findings.extend(rights::check(facts, subject));
    findings.extend(core::check(facts, subject));
    findings.extend(power::check(facts, subject));
    findings.extend(clock::check(facts, subject));
    findings.extend(memory::check(facts));
    findings.extend(network::check(facts, subject));
    findings.extend(port::check(facts, subject));
    findings
}

#[cfg(test)]
pub(crate) mod tests {

    use super::*;
    use fieldbeat_linudp::{LinUdpDrive, LinUdpPlan};

    /// Asserts the parts that a finding always has.
    pub(crate) fn assert_whole(finding: &Finding) {
        assert!(!finding.found.is_empty() && !finding.why.is_empty(), "{finding:?}");
        // What is not as it should be says what to do.
        let wrong = matches!(finding.verdict, Verdict::Poor | Verdict::Bad);
        assert_eq!(wrong, finding.fix.is_some(), "{finding:?}");
        // Behind its label it fits into 100 columns.
        let mut commands = [&finding.fix, &finding.undo].into_iter().flatten().flat_map(|text| text.lines());
        assert!(commands.all(|line| line.chars().count() <= 84), "{finding:?}");
    }

    #[test]
    fn this_host_is_examined_by_any_user() {
        let bus =
            LinUdpPlan::new([127, 77, 0, 1].into(), vec![LinUdpDrive::new("x", [127, 77, 0, 11].into())]);
        let subject = Subject::of(&Plan {
            source: None,
            cycle: CyclePlan::default(),
            buses: vec![Box::new(bus)],
            groups: Vec::new(),
        });
        assert_eq!(subject.wires.len(), 1);
        let findings = examine(&subject);
        let areas: Vec<Area> = findings.iter().map(|finding| finding.area).collect();
        assert!(areas.is_sorted() && areas.last() == Some(&Area::Load), "{areas:?}");
    }
}
