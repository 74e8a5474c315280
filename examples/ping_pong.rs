//! A task inside the cycle: two axes of the sample configuration chase each other. An axis that arrives is sent
//! back by code that runs on the real-time thread, one cycle after its feedback came in.
//!
//!     cargo run --release --example ping_pong

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use fieldbeat::axis::{Move, Target};
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::{Command, Master};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // First: this program is the guardian of its master, too.
    fieldbeat::guardian_main();
    let setup = Master::from_file("rt-config/demo.toml")?;
    let _drives = SimServer::start(setup.simulation().build(), ServerOptions::default())?;
    let profile = setup.plan().axes()[0].profile;

    // What the task needs is allocated here: nothing may be allocated inside the cycle.
    let turns = Arc::new(AtomicU32::new(0));
    let counted = Arc::clone(&turns);
    let mut far = [false; 2];
    let mut not_before = [0; 2];
    let setup = setup.with_task(move |cycle, axes| {
        for index in 0..2 {
            let Some(feedback) = axes.feedback(index) else { continue };
            let standing = feedback.is_operational() && feedback.status.homed && !feedback.status.moving;
            if standing && cycle.index >= not_before[index] {
                far[index] = !far[index];
                let target = Target::Absolute(if far[index] { 300.0 } else { 100.0 });
                if axes.command(index, Command::Move(Move { target, profile })).is_ok() {
                    counted.fetch_add(1, Ordering::Relaxed);
                }
                // The drive needs a few cycles until it reports motion.
                not_before[index] = cycle.index + 50;
            }
        }
    });

    let master = setup.start()?;
    master.wait_online(Duration::from_secs(5))?;
    for name in ["a1", "a2"] {
        let mut axis = master.axis(name)?;
        axis.enable()?;
        axis.home()?;
    }
    std::thread::sleep(Duration::from_secs(5));
    println!("{} moves sent from inside the cycle", turns.load(Ordering::Relaxed));
    Ok(())
}
