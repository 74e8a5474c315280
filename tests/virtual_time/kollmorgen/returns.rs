//! Drives that come back: after a while without frames, and after a tool has run over their segment.

use fieldbeat::axis::{Command, EventKind, Jog, Link, Outcome};
use fieldbeat::config::{Configuration, parse};
use fieldbeat::sim::WorldOptions;
use fieldbeat::{Master, Simulation};

use super::{LINE, UP};

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
        for t in 0..3_000 {
            sim.step();
            for (axis, end) in ends.iter_mut().enumerate() {
                while let Some(event) = sim.axis(axis).event() {
                    if std::env::var("SHOW").is_ok() {
                        println!("{delay} {t} axis {axis}: {event}");
                    }
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
