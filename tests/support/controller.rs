//! A machine controller as somebody may write one: it enables and homes its axes and sends them on a long way. A test
//! program plays it in a process of its own, so that it can be stopped and killed in mid-motion.

use std::path::{Path, PathBuf};
use std::process;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::Duration;

use fieldbeat::Master;
use fieldbeat::axis::{Axis, AxisError, Command, Move, Profile, Target};
use fieldbeat::telemetry::Summary;
use serde_json::Value;

use super::{Ended, LONG, Machine, Program, again, until};

/// What the axes do, mm/s.
pub const VELOCITY: f64 = 50.0;
/// Where a move ends, mm: half a minute away.
pub const TARGET: f64 = 1500.0;
/// How the master stops them, mm/s²: for two seconds ...
const DECELERATION: f64 = 25.0;
/// ... and so many mm.
pub const RAMP: f64 = VELOCITY * VELOCITY / (2.0 * DECELERATION);
/// How far a jog runs ahead, mm.
const LEASH: f64 = 20.0;

/// A configuration for it; `defaults` are more lines of `[bus.defaults]`.
pub fn config(machine: &Machine, file: &str, drives: usize, cycle: &str, defaults: &str) -> PathBuf {
    let defaults = format!(
        "limits = {{ position = [0, 2000] }}\nsimulate = {{ start = 10 }}\nno_drive_watchdog = \"accept\"\n\
         leash = {LEASH}\njog_deadman = \"30s\"\n\
         stop.deceleration = {DECELERATION}\nstop.timeout = \"10s\"\n{defaults}"
    );
    machine.config(file, drives, cycle, &defaults)
}

/// What it says when its axes move.
const UNDER_WAY: &str = "under way";

/// How the axes of a controller move.
#[derive(Clone, Copy, Debug)]
pub enum Way {
    /// To [`TARGET`].
    Move,
    /// Until somebody stops them.
    Jog,
}

/// One as a child of the test program: `test` [`play`]s it if it has a role.
pub fn child(test: &str, way: Way, config: &Path) -> process::Command {
    again(test, &format!("{way:?} {}", config.display()))
}

/// Starts one and waits until its axes move.
pub fn start(child: &mut process::Command) -> Program {
    let mut controller = Program::spawn(child);
    controller.await_text(UNDER_WAY);
    controller
}

/// The controller itself, in its own process: until SIGINT or SIGTERM.
pub fn play(role: &str) {
    let (way, config) = role.split_once(' ').unwrap();
    let ended = Arc::new(AtomicBool::new(false));
    for signal in [libc::SIGINT, libc::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&ended)).unwrap();
    }
    let master = Master::from_file(config).unwrap().start().unwrap();
    let mut axes = set_all_out(&master, way == "Jog");
    println!("{UNDER_WAY}");

    let mut reported = vec![false; axes.len()];
    while !ended.load(Ordering::Relaxed) {
        for (axis, reported) in axes.iter_mut().zip(&mut reported) {
            // Whatever stops an axis, it tries to go on.
            if !*reported && axis.feedback().stopped.is_some() {
                *reported = true;
                println!("{}", axis.enable().unwrap_err());
            }
        }
        sleep(Duration::from_millis(5));
    }
    println!("{}", serde_json::to_string(&Summary::from(&master.finish())).unwrap());
}

/// Enables, homes and sends all axes of `master` on their long way.
pub fn set_all_out(master: &Master, jog: bool) -> Vec<Axis> {
    master.wait_online(LONG).unwrap();
    let mut axes: Vec<_> = master.observers().iter().map(|(name, _)| master.axis(name).unwrap()).collect();
    for axis in &mut axes {
        axis.enable().unwrap();
        axis.home().unwrap();
    }
    axes.iter_mut().for_each(|axis| set_out(axis, jog).unwrap());
    // By then they are as fast as they will be.
    assert!(until(LONG, || axes.iter().all(|axis| axis.feedback().status.position > 10.0)));
    axes
}

/// Sends `axis` on its long way.
pub fn set_out(axis: &mut Axis, jog: bool) -> Result<(), AxisError> {
    if jog {
        return axis.jog(VELOCITY).map(drop);
    }
    let profile = Profile { velocity: VELOCITY, ..axis.profile() };
    axis.post(Command::Move(Move { target: Target::Absolute(TARGET), profile })).map(drop)
}

/// The summary of a controller that ended in order.
pub fn summary(ended: &Ended) -> Value {
    let line = ended.expect(0).out.lines().find(|line| line.starts_with('{'));
    serde_json::from_str(line.unwrap_or_else(|| panic!("no summary: {ended:?}"))).unwrap()
}
