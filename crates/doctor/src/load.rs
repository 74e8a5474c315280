//! What a cycle of the plan takes on this host, and what its wires carry.

use super::finding::{Area, Finding};
use fieldbeat_core::cycle::cost::{Costs, Demand};
use fieldbeat_core::time::Ns;

/// Whether the cycles of a plan fit into its period, by these costs.
pub(super) fn check(demand: &Demand, costs: &Costs) -> Finding {
    let cost = demand.cost(costs);
    let finding = Finding::about(
        Area::Load,
        "time of a cycle",
        format!("less than {}", Ns(cost.period_ns)),
        "the kernel takes its time for each request and reply, and the loop for each drive",
    );
    let found = cost.lines().join("; ");
    let remedy = cost.remedy().replace(", or ", "\nor ");
    match (cost.refusal(), cost.warnings().as_slice()) {
        (Some(_), _) => finding.bad(found).advise(remedy),
        (None, []) => finding.good(found),
        (None, tight) => finding.poor(format!("{found}; {}", tight.join("; "))).advise(remedy),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Verdict::{Bad, Good, Poor};
    use crate::tests::assert_whole;
    use fieldbeat_core::cycle::{CyclePlan, Plan};
    use fieldbeat_core::time::MS;
    use fieldbeat_linudp::{LinUdpDrive, LinUdpPlan};

    #[test]
    fn a_cycle_that_takes_longer_than_its_period_is_bad_and_a_tight_one_poor() {
        let check = |drives: u8, period_ns: u64| {
            let drives = (1..=drives).map(|n| LinUdpDrive::new(format!("d{n}"), [127, 77, 1, n].into()));
            let bus = LinUdpPlan::new([127, 77, 0, 1].into(), drives.collect());
            let cycle = CyclePlan { period_ns, ..CyclePlan::default() };
            let plan = Plan { source: None, cycle, buses: vec![Box::new(bus)], groups: Vec::new() };
            let finding = check(&Demand::of(&plan), &Costs::default());
            assert_whole(&finding);
            finding
        };
        // 250 exchanges of 4 us, and 135 us of its own.
        assert_eq!(check(250, 2 * MS).verdict, Good);
        assert_eq!(check(200, 5 * MS / 4).verdict, Poor);
        let bad = check(250, MS);
        assert_eq!(bad.verdict, Bad);
        assert!(
            bad.found
                .starts_with("a cycle takes about 1.14 ms (send 550 us, receive 450 us, own work 135 us)")
        );
        assert_eq!(bad.fix.unwrap().lines().next(), Some("period = \"2ms\" in [cycle] fits"));
    }
}
