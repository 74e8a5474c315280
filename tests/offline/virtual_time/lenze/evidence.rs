//! Done is what the drive reports: nothing is while its answers come from memory, and nothing it is sent reaches it.

use fieldbeat::EventKind;
use fieldbeat::axis::{Command, Outcome, State};
use fieldbeat_sim::profibus::ProfibusSegment;

use super::tap::TapWire;
use super::turns::{STOP, jog};
use super::{Lenze, cycle, wire};

/// Shorter than the drive's watchdog, which nobody feeds meanwhile.
const FROZEN: u64 = 50;

#[test]
fn no_command_is_done_by_answers_from_memory() {
    for (command, turns, faulty) in [
        (Command::Enable, false, false),
        (Command::Disable, false, false),
        (STOP, true, false),
        (Command::QuickStop, true, false),
        (Command::ResetFault, false, true),
    ] {
        let bus = wire(12_000_000, 2);
        let mut segment = ProfibusSegment::of(&bus);
        segment.drives.iter_mut().for_each(|drive| drive.motor.ramps_s = (0.01, 0.01, 0.01));
        let taps = TapWire::new(segment);
        let mut m = Lenze::on(bus, cycle(), taps.wire());
        m.online();
        if command != Command::Enable {
            m.done(0, Command::Enable);
        }
        if turns {
            m.post(0, jog(8.0));
            m.until("its velocity", 2_000, |sim| (sim.feedback(0).status.velocity - 8.0).abs() < 0.05);
        }
        if faulty {
            taps.drives[0].lock().drive.provoke(0x2310);
            m.until("its fault", 2_000, |sim| sim.feedback(0).status.fault == 0x2310);
        }
        m.sim.run(50);
        while m.sim.axis(0).event().is_some() {}
        taps.drives[0].lock().frozen = true;
        let id = m.sim.axis(0).post(command).unwrap();
        let mut end = None;
        for turn in 0..2_000 {
            m.sim.run(1);
            while let Some(event) = m.sim.axis(0).event() {
                if let EventKind::Ended { id: ended, outcome, .. } = event.kind
                    && ended == id
                {
                    end = Some(outcome);
                }
            }
            if turn < FROZEN {
                assert_eq!(end, None, "{command:?} in cycle {turn} of answers from memory");
            } else if turn == FROZEN {
                taps.drives[0].lock().frozen = false;
            }
            if end.is_some() {
                break;
            }
        }
        assert_eq!(end, Some(Outcome::Done), "{command:?}: {:?}", m.feedback(0));
        let now = m.sim.world().now();
        let mut tap = taps.drives[0].lock();
        let (truth, state) = (tap.drive.truth(now), tap.drive.axis_state());
        match command {
            Command::Enable => assert_eq!(state, State::OperationEnabled),
            Command::Disable => assert!(!truth.powered),
            Command::ResetFault => assert_eq!(state, State::SwitchOnDisabled),
            _ => assert!(truth.velocity.abs() < 0.1, "{command:?}: {truth:?}"),
        }
    }
}
