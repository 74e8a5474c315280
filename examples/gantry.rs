//! Two axes of a gantry as a group: every row of the path reaches both in the same cycle, and whatever stops one
//! stops all. Then a jog, as from an operator's button, renewed while it is held.
//!
//!     cargo run --release --example gantry

use std::f64::consts::TAU;
use std::thread::sleep;
use std::time::{Duration, Instant};

use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::{Master, Row};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // First: this program is the guardian of its master, too.
    fieldbeat::guardian_main();
    let setup = Master::from_file("rt-config/gantry.toml")?;
    let period = Duration::from_nanos(setup.plan().cycle.period_ns);
    let _drives = SimServer::start(setup.simulation().build(), ServerOptions::default())?;
    let master = setup.start()?;
    master.wait_online(Duration::from_secs(5))?;

    let mut z = master.axis("z")?;
    let mut xy = master.group("xy")?;
    xy.enable()?;
    xy.home()?;
    xy.move_to(&[250.0, 200.0])?;

    // Three circles around (200, 200) in six seconds, one row a cycle. The loop takes a row of both or of none.
    let rows = (6.0 / period.as_secs_f64()) as u32;
    let mut next = 0;
    let mut path = None;
    // A stop of the group ends the path; the wait that follows returns the reason.
    while next < rows && xy.feedback().iter().all(|axis| axis.stopped.is_none()) {
        while next < rows && xy.stream_room() > 0 {
            xy.push_rows(&circles(next, rows, period))?;
            next += 1;
        }
        if path.is_none() {
            path = Some(xy.follow()?);
        }
        sleep(Duration::from_millis(50));
    }
    if let Some(path) = path {
        xy.wait(&path, Duration::from_secs(10))?;
    }
    let [x, y] = [0, 1].map(|index| xy.axes()[index].feedback().status.position);
    println!("three circles drawn, back at {x:.2}, {y:.2} mm");

    // A button that is held for a second. If this thread hung, z would stop by itself after 200 ms.
    z.enable()?;
    z.home()?;
    z.jog(40.0)?;
    let pressed = Instant::now();
    while pressed.elapsed() < Duration::from_secs(1) {
        sleep(Duration::from_millis(20));
        z.set_velocity(40.0)?;
    }
    z.stop()?;
    println!("z jogged to {:.1} mm", z.feedback().status.position);

    let run = master.finish();
    for drive in &run.end.drives {
        println!("{}: {} at the end", drive.name, drive.feedback.status.state);
    }
    Ok(())
}

/// Row `number` of the path: where both axes are, and how fast. It begins and ends at standstill.
fn circles(number: u32, rows: u32, period: Duration) -> [Row; 2] {
    const RADIUS_MM: f64 = 50.0;
    let last = number + 1 == rows;
    let done = f64::from(number) / f64::from(rows - 1);
    let angle = 3.0 * (TAU * done - (TAU * done).sin());
    let per_second = 1.0 / (f64::from(rows - 1) * period.as_secs_f64());
    let speed = RADIUS_MM * 3.0 * TAU * (1.0 - (TAU * done).cos()) * per_second;
    let (sin, cos) = angle.sin_cos();
    let row = |position, velocity| Row { position, velocity, acceleration: 0.0, last };
    [row(200.0 + RADIUS_MM * cos, -speed * sin), row(200.0 + RADIUS_MM * sin, speed * cos)]
}
