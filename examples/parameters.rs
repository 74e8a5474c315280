//! Parameters while the cycle runs: read and written with a blocking call, or by tickets while an axis moves; and a
//! curve that goes to a drive from a file. None of it costs the loop a cycle: it rides on the requests that go out
//! anyway.
//!
//!     cargo run --release --example parameters

use std::ops::ControlFlow;
use std::thread::sleep;
use std::time::Duration;

use fieldbeat::axis::{Move, Target};
use fieldbeat::bus::linudp::service::Services;
use fieldbeat::config::linmot::curve as curve_file;
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::{Command, Master};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // First: this program is the guardian of its master, too.
    fieldbeat::guardian_main();
    let setup = Master::from_file("rt-config/demo.toml")?;
    let _drives = SimServer::start(setup.simulation().build(), ServerOptions::default())?;
    let master = setup.start()?;
    master.wait_online(Duration::from_secs(5))?;
    let mut x = master.axis("a1")?;
    x.enable()?;
    x.home()?;

    // Blocking. The requested type interprets the raw value; an address is a number of the drive's manual, or a
    // name.
    let parameter = x.parameter();
    let gain: u16 = parameter.read("0x13A2")?;
    parameter.write("p-gain-a", gain + 10)?;
    println!("P gain {gain} -> {}", parameter.read::<u16>("p-gain-a")?);
    // The flash is unchanged: a value written to RAM is lost when the drive restarts.
    println!(
        "in flash {}, at most {}",
        parameter.read::<u16>("p-gain-a.rom")?,
        parameter.read::<u16>("p-gain-a.max")?
    );

    // By tickets, while the axis moves: nothing here waits.
    x.post(Command::Move(Move { target: Target::Absolute(300.0), profile: x.profile() }))?;
    let mut hottest = i16::MIN;
    let mut requested = parameter.post_read::<i16>("core-temperature")?;
    for _ in 0..50 {
        if let Some(answer) = requested.poll() {
            hottest = hottest.max(answer?);
            requested = parameter.post_read("core-temperature")?;
        }
        sleep(Duration::from_millis(10));
    }
    // A dropped ticket cancels its call.
    drop(requested);
    println!(
        "at {:.1} mm, {:.1} C at most on the way",
        x.feedback().status.position,
        f64::from(hottest) / 10.0
    );

    // Any thread may do the same for any drive. This curve goes to one that stands still, switched off.
    let curve = curve_file::load("rt-config/linmot-curve.csv")?;
    let y = master.parameter("a2")?;
    let services = Services::of(y.acyclic())?;
    services.require_off("writing a curve")?;
    services.put_curve(&curve, &mut |_| ControlFlow::Continue(()))?;
    println!(
        "a2 has the curves {:?}; {} has {} setpoints",
        services.curves()?,
        curve.name().unwrap_or("a curve without a name"),
        curve.setpoints.len()
    );
    drop(services);

    let status = master.finish().end.status;
    println!("{} cycles executed, {} skipped", status.executed, status.skipped);
    Ok(())
}
