//! Slow and fast Unidrives next to a LinMot in one cycle: whose window stays open for whom.

use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::time::US;
use fieldbeat_core::net::SendMode;

use super::*;
use crate::virtual_time::support;

/// A Unidrive that answers after so long, next to a LinMot, both in every cycle of 1 ms.
fn next_to_a_linmot(answer_ns: u64) -> Bench {
    let linudp = LinUdpPlan {
        name: "linudp".into(),
        bind: support::MASTER,
        send: SendMode::Batch,
        drives: vec![support::drive(0)],
    };
    let change = |_, drive: &mut Unidrive| drive.simulate.faults.answer_ns = answer_ns;
    let mut b = Bench::beside(1, VIAS[1], change, |_, _| {}, vec![Box::new(linudp)]);
    b.until("both online", 2_000, |b| (0..2).all(|index| b.feedback(index).link == Link::Online));
    b
}

fn answers_after(b: &Bench, answer_ns: u64) {
    assert!(b.sim.world().set_faults(address(0), FaultPlan { answer_ns, ..FaultPlan::default() }));
}

/// The ages of the LinMot's data, ns, at the end of so many cycles: the stages after the window take next to no time.
fn ages(b: &mut Bench, cycles: usize) -> Vec<u64> {
    let age = |_| {
        b.sim.step();
        assert_eq!(b.feedback(1).age, 0, "an exchange in every cycle");
        b.now().since(b.feedback(1).status.at)
    };
    (0..cycles).map(age).collect()
}

/// For how many of so many cycles the window stayed open for longer than the LinMot needs.
fn held(b: &mut Bench, cycles: usize) -> usize {
    ages(b, cycles).iter().filter(|age| **age > 20 * US).count()
}

#[test]
fn a_unidrive_that_becomes_fast_again_is_waited_for_again_and_one_that_becomes_slow_is_not() {
    let mut b = next_to_a_linmot(200 * US);
    held(&mut b, 100);
    for _ in 0..3 {
        answers_after(&b, 3_200 * US);
        // A request every fourth cycle, and eight of them.
        let open = held(&mut b, 100);
        assert!((8..=9).contains(&open), "{open}");
        assert_eq!(held(&mut b, 2_000), 0);
        answers_after(&b, 200 * US);
        held(&mut b, 100);
        assert_eq!((held(&mut b, 1_000), b.feedback(0).age), (1_000, 0));
    }
}
