//! Drives that come back: after a while without frames, and after a tool has run over their segment.

use fieldbeat::axis::{Command, EventKind, Jog, Link, Outcome, StopCause};
use fieldbeat::config::{Configuration, parse};
use fieldbeat::sim::ethercat::EthercatSim;
use fieldbeat::sim::{SimSegment, WorldOptions};
use fieldbeat::time::Time;
use fieldbeat::{Master, Simulation};
use fieldbeat_ethercat::wire::frame::{BROADCAST, Builder, Command as Frame, FRAME_MAX};
use fieldbeat_ethercat::wire::registers::{AlState, AlStatus, address};

use super::{LINE, Machine, UP, plan};

/// Two drives of one stop group that turn by velocities.
fn group() -> Simulation {
    let text = format!(
        "[cycle]\nperiod = \"1ms\"\n[[bus]]\nprotocol = \"ethercat\"\ninterface = \"{LINE}\"\n[bus.defaults]\n\
         pdo.outputs = \"0x1702\"\nwatchdog = \"500ms\"\nlimits = {{ velocity = 50, acceleration = 5000 }}\n\
         profile = {{ velocity = 20, acceleration = 400 }}\n\
         stop = {{ how = \"ramp\", deceleration = 400, then = \"disable\", group = \"g\" }}\n\
         [[bus.drive]]\nname = \"k\"\n[[bus.drive]]\nname = \"l\"\n"
    );
    let Configuration { plan, simulation, .. } = parse(&text, "group.toml")
        .unwrap_or_else(|errors| panic!("{:?}", errors.iter().map(ToString::to_string).collect::<Vec<_>>()));
    Master::from_plan(plan).simulate_with(simulation.build(), WorldOptions::default()).expect("it is sound")
}

fn jog() -> Command {
    Command::Jog(Jog { velocity: 10.0, acceleration: 400.0 })
}

#[test]
fn a_drive_that_was_deaf_is_online_only_when_the_master_takes_it_down_no_more() {
    for delay in (0..40).chain([60, 100, 200, 400]) {
        let mut sim = group();
        let is_up = |sim: &Simulation| (0..2).all(|axis| sim.feedback(axis).link == Link::Online);
        assert!(sim.run_until(UP, is_up));
        for axis in 0..2 {
            sim.execute(axis, Command::Enable, 5_000).unwrap();
            sim.axis(axis).post(jog()).unwrap();
        }
        sim.run(100);
        sim.world().deafen(LINE, 0, true);
        sim.run(10);
        sim.world().deafen(LINE, 0, false);
        assert!(sim.run_until(20_000, |sim| sim.feedback(0).link == Link::Online));
        sim.run(delay);
        for axis in 0..2 {
            let _ = sim.execute(axis, Command::Reset, 9_000).unwrap();
        }
        let ids = [0, 1].map(|axis| sim.axis(axis).post(Command::Enable).unwrap());
        let mut ends = [None; 2];
        // What the master does to a slave by itself begins within the next 500 cycles.
        let mut left = 500;
        while left > 0 {
            sim.step();
            left -= u32::from(ends.iter().all(Option::is_some));
            for (axis, end) in ends.iter_mut().enumerate() {
                while let Some(event) = sim.axis(axis).event() {
                    if let EventKind::Ended { id, outcome, .. } = event.kind
                        && id == ids[axis]
                    {
                        *end = Some(outcome);
                    }
                }
            }
        }
        assert_eq!(ends, [Some(Outcome::Done); 2], "{delay} ms after it was online: {:?}", sim.feedback(0));
        assert_eq!([0, 1].map(|axis| sim.feedback(axis).stopped), [None; 2], "{delay} ms");
    }
}

/// Frames of a tool, one in a cycle; they do not come to this master.
fn run_over(machine: &mut Machine, frames: &[(Frame, Vec<u8>)]) {
    for (command, data) in frames {
        let mut room = [0; FRAME_MAX];
        let mut frame = Builder::new(&mut room, BROADCAST, [0x30; 6]).unwrap();
        frame.push_with(*command, 7, data).unwrap();
        let length = frame.finish();
        let world = machine.sim.world();
        world.look(LINE, |line: &mut EthercatSim, now: Time| line.pass(now, &mut room[..length])).unwrap();
        machine.run(1);
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
        machine.post(0, super::jog(5.0));
        machine.run(300);
        run_over(&mut machine, &frames);
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
        machine.post(0, super::jog(5.0));
        machine.run(300);
        machine.assert_turns(0, 5.0);
    }
}
