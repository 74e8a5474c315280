//! Drives that come back: after a while without frames, and after a tool has run over their segment.

use fieldbeat::axis::{Command, Link, StopCause};
use fieldbeat_ethercat::wire::frame::Command as Frame;
use fieldbeat_ethercat::wire::registers::{AlState, AlStatus, address};

use super::{LINE, Machine, jog, plan};

#[test]
fn a_drive_that_received_nothing_is_online_only_after_its_take_down_has_ended() {
    let mut plan = plan(2);
    plan.drives.iter_mut().for_each(|drive| drive.axis.stop.group = Some(0));
    for delay in (0..40).chain([60, 100, 200, 400]) {
        let mut machine = Machine::enabled(plan.clone());
        (0..2).for_each(|axis| machine.post(axis, jog(10.0)));
        machine.run(100);
        machine.sim.world().deafen(LINE, 0, true);
        machine.run(10);
        machine.sim.world().deafen(LINE, 0, false);
        machine.until("it is back", 20_000, |machine| machine.feedback(0).link == Link::Online);
        machine.run(delay);
        for axis in 0..2 {
            let _ = machine.ended(axis, Command::Reset);
        }
        (0..2).for_each(|axis| machine.post(axis, Command::Enable));
        // What the master does to a slave by itself begins within the next 500 cycles.
        machine.run(1_000);
        for axis in 0..2 {
            let feedback = machine.feedback(axis);
            let holds = feedback.is_operational() && feedback.stopped.is_none();
            assert!(holds, "{delay} ms after it was online: {feedback:?}");
        }
    }
}

#[test]
fn a_segment_that_a_tool_has_run_over_is_set_up_again_and_the_tool_is_named() {
    let state = |al| (Frame::Bwr(address::AL_CONTROL), AlStatus::request(al).0.to_le_bytes().to_vec());
    let no_fmmus = (Frame::Bwr(address::FMMU), vec![0; 64]);
    // Outputs and inputs of all slaves at logical address 0, as in a process image of its own.
    let fmmu = |bytes: u8, at: [u8; 2], kind| [0, 0, 0, 0, bytes, 0, 0, 7, at[0], at[1], 0, kind, 1, 0, 0, 0];
    let own_fmmus = [fmmu(6, [0x00, 0x11], 2), fmmu(8, [0x40, 0x11], 1), [0; 16], [0; 16]].concat();
    let fmmus = (Frame::Bwr(address::FMMU), own_fmmus);
    let watchdog = (Frame::Bwr(address::WATCHDOG), vec![0; 2]);
    let managers = (Frame::Bwr(address::sync_manager(2)), vec![0; 16]);
    let addresses = [(0, 1), (1, 2)]
        .map(|(place, station)| (Frame::Apwr(0_u16.wrapping_sub(place), address::STATION), vec![station, 0]));
    let [first, second] = addresses;
    for (what, frames) in [
        ("a scan", vec![state(AlState::Init)]),
        ("to SAFEOP", vec![state(AlState::SafeOp)]),
        ("a scan to PREOP", vec![state(AlState::Init), state(AlState::PreOp)]),
        ("FMMUs cleared", vec![no_fmmus.clone()]),
        ("to SAFEOP with FMMUs of its own", vec![state(AlState::SafeOp), fmmus.clone()]),
        ("FMMUs of its own in OP", vec![fmmus]),
        ("no watchdog", vec![watchdog, state(AlState::SafeOp)]),
        ("SyncManagers cleared", vec![no_fmmus.clone(), managers, state(AlState::Init)]),
        ("addresses of its own in SAFEOP", vec![first.clone(), second.clone(), state(AlState::SafeOp)]),
        ("addresses of its own", vec![state(AlState::Init), first, second, no_fmmus]),
    ] {
        let mut machine = Machine::enabled(plan(2));
        machine.post(0, jog(5.0));
        machine.run(300);
        // One in a cycle; they do not come to this master.
        for (command, data) in &frames {
            machine.pass(*command, data);
            machine.run(1);
        }
        machine.until(what, 3_000, |machine| (0..2).all(|axis| machine.feedback(axis).stopped.is_some()));
        machine.until("standstill", 3_000, |machine| machine.drive(0, |drive| drive.rpm().abs() < 1.0));
        // One in SAFEOP is online until its settings were read back.
        machine.run(500);
        machine.online();
        // A slave whose frames it has taken away, or that is in INIT, is lost before that is known.
        let stopped = [0, 1].map(|axis| machine.feedback(axis).stopped);
        let is_lost = ["FMMUs", "cleared", "addresses", "scan"].iter().any(|part| what.contains(part));
        let expected = |cause| cause == StopCause::OtherMaster || is_lost && cause == StopCause::LinkLost;
        assert!(stopped.iter().flatten().all(|cause| expected(*cause)), "{what}: {stopped:?}");
        let remarks = machine.sim.remarks();
        let is_named = stopped == [Some(StopCause::OtherMaster); 2];
        assert!(
            is_named || remarks.iter().any(|remark| remark.contains("another master, or a tool")),
            "{what}: {remarks:?}"
        );
        for axis in 0..2 {
            machine.recover(axis);
        }
        machine.post(0, jog(5.0));
        machine.run(300);
        machine.assert_turns(0, 5.0);
    }
}
