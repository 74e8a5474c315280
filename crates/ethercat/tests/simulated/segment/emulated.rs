//! Slaves without a processor, whose controller copies AL control to AL status; and what is acknowledged.

use super::*;
use fieldbeat_ethercat::wire::registers::AlStatus;

/// A coupler, and terminals of a byte either way.
fn simple() -> Rig {
    let mut plan = EthercatPlan { devices: vec![coupler(0), coupler(1)], ..drives(0) };
    (plan.devices[0].slave.outputs, plan.devices[0].slave.inputs) = (Vec::new(), Vec::new());
    Rig::io(&plan, Settings { emulated: true, ..Settings::default() })
}

impl Rig {
    fn al_status(&mut self, place: u16) -> AlStatus {
        let [low, high] = self.peek(place, address::AL_STATUS, 2)[..] else { panic!() };
        AlStatus(u16::from_le_bytes([low, high]))
    }
}

#[test]
fn a_slave_without_a_processor_comes_up_and_goes_down_and_never_shows_an_acknowledgement() {
    // As another master has left it: just switched on, acknowledged by it, in operation.
    for left in [0x01, 0x11, 0x12, 0x14, 0x18, 0x08] {
        let mut rig = simple();
        rig.run(1);
        for place in 0..2 {
            rig.poke(place, address::AL_CONTROL, &[left, 0]);
        }
        for _ in 0..2_000 {
            rig.run(1);
            let shown = [rig.al_status(0), rig.al_status(1)];
            let is_plain = |status: &AlStatus| !status.error() || status.0 == u16::from(left);
            assert!(shown.iter().all(is_plain), "{left:#04x}: {shown:?} {:?}", rig.note(0));
        }
        assert_eq!([rig.al_status(0), rig.al_status(1)], [AlStatus(8); 2], "{left:#04x}: {:?}", rig.note(0));
        assert!((0..2).all(|index| rig.line.is_operational(index)));
        rig.down(200);
        assert_eq!([rig.al_status(0), rig.al_status(1)], [AlStatus(1); 2]);
    }
}

#[test]
fn an_error_is_acknowledged_in_the_state_that_shows_it_before_init_is_requested() {
    let mut rig = Rig::new(&drives(1));
    rig.poke(0, address::AL_CONTROL, &[8, 0]);
    rig.cycle.grid = rig.cycle.grid + MS;
    assert_eq!(rig.al_status(0), AlStatus(0x11), "it refuses OP");
    let mut written = Vec::new();
    while rig.al(0) != AlState::PreOp {
        rig.run(1);
        let control = rig.peek(0, address::AL_CONTROL, 1)[0];
        if written.last() != Some(&control) {
            written.push(control);
        }
        assert!(rig.cycle.index < 2_000, "{:?}", rig.note(0));
    }
    assert_eq!(written, [8, 0x11, 1, 2]);
    rig.all_up(2_000);
    rig.down(200);
    assert_eq!((rig.al_status(0), rig.peek(0, address::AL_CONTROL, 1)[0]), (AlStatus(1), 1));
}
