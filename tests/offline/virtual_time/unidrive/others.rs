//! Another master on the same drive: named within a bound, and nothing else is taken for one.

use super::*;

/// An exchange that only reads comes after 16 others, and three of those, with a write between two, are proof; in the
/// direct mapping the values of a report come in turns.
const BOUND: u64 = 60;

#[test]
fn a_power_off_by_another_master_is_reported_as_such_and_not_as_a_missing_hardware_enable() {
    for via in VIAS {
        let mut b = Bench::enabled(1, via, |_, _| {});
        b.turning(0, 4.0);
        let begun = b.sim.status().executed;
        b.until("a stop", BOUND, |b| {
            let now = b.now();
            b.tap(0).write(now, Parameter::CONTROL_WORD, ControlWord::IDLE.0);
            b.feedback(0).stopped.is_some()
        });
        let took = b.sim.status().executed - begun;
        assert_eq!(b.feedback(0).stopped, Some(StopCause::OtherMaster), "{via:?}");
        assert!(!b.feedback(0).status.sto_open && took > 2, "{via:?}: {took} cycles");
        // It is gone.
        b.until("power off", 5_000, |b| !b.feedback(0).status.state.is_powered());
        b.run(3_000);
        assert!(!b.tap(0).status(b.now()).active(), "it stays off");
        b.recover(0);
    }
}

#[test]
fn a_keypad_and_a_short_loss_of_the_hardware_enable_are_no_other_master() {
    for via in VIAS {
        let mut b = Bench::enabled(1, via, |_, _| {});
        b.turning(0, 4.0);
        // A key that is held, ten times a second, and once in a while the control word.
        for n in 0..60 {
            let now = b.now();
            b.tap(0).refer(now, 2_000 + n);
            if n % 30 == 7 {
                b.tap(0).write(now, Parameter::CONTROL_WORD, ControlWord::FORWARD.0 | ControlWord::NOT_STOP);
            }
            b.run(100);
            assert_eq!(b.feedback(0).stopped, None, "{via:?}, {n}");
        }
        assert!(b.sim.world().open_sto(address(0), 30 * MS));
        assert_eq!(b.stopped(0, 100), StopCause::StoOpen, "{via:?}");
    }
}

#[test]
fn a_drive_that_a_living_master_commands_is_not_taken_over() {
    for via in VIAS {
        let mut b = Bench::new(1, via, |_, drive| drive.simulate.start = Start::Running(300.0));
        for reference in 0..2_000 {
            let now = b.now();
            b.tap(0).refer(now, 3_000 + reference % 100);
            b.run(1);
        }
        assert_eq!(b.feedback(0).link, Link::Online);
        assert_eq!(b.feedback(0).stopped, Some(StopCause::OtherMaster), "{via:?}");
        assert!(b.tap(0).status(b.now()).active(), "{via:?}: it runs on");
        let writes = |request: &Vec<u8>| request[7] == function::READ_WRITE && request[10..12] != [0, 0];
        assert!(!b.tap(0).received.iter().any(writes), "{via:?}: nothing was written");
    }
}

#[test]
fn another_drive_of_the_same_kind_is_read_and_never_written_also_after_a_reconnect() {
    let (own, other) = (7_000_000_001, 7_000_000_002);
    let settings = |plan: &UnidriveDrive, serial| UnidriveSettings { serial, ..UnidriveSettings::of(plan) };
    for via in VIAS {
        // Two that were exchanged.
        let mut b = Bench::new(2, via, |index, drive| {
            drive.plan.serial = Some([own, other][index]);
            drive.simulate = settings(&drive.plan, [other, own][index]);
        });
        b.run(3_000);
        let reads =
            |b: &Bench, index: usize| b.tap(index).received.iter().all(|all| all[7] == function::READ);
        for index in 0..2 {
            assert_eq!(b.feedback(index).link, Link::Unseen, "{via:?}");
            assert!(reads(&b, index) && !b.tap(index).received.is_empty(), "{via:?}");
        }
        let end = b.sim.finish();
        let why = end.drives[0].not_connected.clone().unwrap_or_default();
        let expected = "its serial number is 7000000002, not 7000000001: drives or cables are exchanged";
        assert!(why.contains(expected), "{why}");
        // One in its place while the master runs, and then itself again.
        let mut b = Bench::enabled(1, via, |_, drive| {
            drive.plan.serial = Some(own);
            drive.simulate = settings(&drive.plan, own);
        });
        for (serial, link) in [(other, Link::Lost), (own, Link::Online)] {
            let simulated = UnidriveSim::new(settings(&b.plan.drives[0], serial));
            b.tap(0).drive = simulated;
            b.tap(0).received.clear();
            assert!(b.sim.world().restart(address(0)));
            b.run(6_000);
            assert_eq!(b.feedback(0).link, link, "{via:?}");
            assert_eq!(reads(&b, 0), link == Link::Lost, "{via:?}");
        }
    }
}
