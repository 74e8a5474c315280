//! The master as a program has it, with all of its threads, against the bare loop: processor time a cycle at 1 kHz, of
//! each thread, in turns of some seconds.
//!
//! The kernel's own counts (/proc/.../schedstat), which cost the threads nothing.

use std::collections::BTreeMap;
use std::fs;
use std::time::Duration;

use fieldbeat::time::MS;
use fieldbeat::{Master, Plan, Realtime, Wait};
use fieldbeat_core::rt::Granted;

use super::bare;
use super::fleet::{Fleet, Side};
use super::rig::{self, give_up};
use super::stats::{Interval, median, over_rounds};

/// Simulated drives may take so long until they are in operation.
const BRING_UP: Duration = Duration::from_secs(60);

/// The simulated drives are no part of a master.
const SIMULATED: &str = "fieldbeat-sim";

/// What came of it, ns a cycle: the mean of each round.
#[derive(Debug, Default)]
pub struct Whole {
    /// Of each thread of ours, by its name.
    pub threads: BTreeMap<String, Vec<f64>>,
    /// Of all of them.
    pub ours: Vec<f64>,
    /// Of the bare loop.
    pub bare: Vec<f64>,
}

impl Whole {
    /// Measures rounds of so many cycles each.
    pub fn measure(granted: &Granted, fleet: Fleet, rounds: usize, cycles: u64) -> Whole {
        let (mut simulated, theirs) = (fleet.simulate(Side::Ours), fleet.simulate(Side::Bare));
        simulated.drives.extend(theirs.drives);
        simulated.segments.extend(theirs.segments);
        simulated.wires.extend(theirs.wires);
        let server = rig::serve(simulated, granted);
        let mut whole = Whole::default();
        super::in_turns(rounds, 2, |who| match who {
            0 => whole.ours(fleet, cycles),
            _ => match rig::on_loop_thread(|_| bare::alone(fleet, Wait::Poll, MS, cycles)) {
                Ok(Ok(ns)) => whole.bare.push(ns as f64),
                Ok(Err(why)) => println!("a slice without the bare loop: {why}"),
                Err(error) => give_up(error),
            },
        });
        drop(server);
        whole
    }

    fn ours(&mut self, fleet: Fleet, cycles: u64) {
        let mut cycle = rig::exchange_cycle(MS, Wait::Poll);
        (cycle.realtime, cycle.priority) = (Realtime::Prefer, rig::PRIORITY);
        let plan = Plan { source: None, cycle, buses: fleet.buses(Side::Ours), groups: Vec::new() };
        let master = Master::from_plan(plan).start().unwrap_or_else(|error| give_up(error));
        master.wait_online(BRING_UP).unwrap_or_else(|error| give_up(error));
        for (name, _) in master.observers() {
            let enabled = master.axis(name).map(|mut axis| axis.enable());
            if let Err(error) = enabled.unwrap_or_else(|error| give_up(error)) {
                give_up(error);
            }
        }
        let (before, executed) = (threads(), master.status().executed);
        std::thread::sleep(Duration::from_nanos(cycles * MS));
        let (after, executed) = (threads(), master.status().executed - executed);
        let mut all = 0;
        for (id, (name, ns)) in after {
            let ns = ns - before.get(&id).map_or(0, |(_, ns)| *ns);
            all += ns;
            self.threads.entry(name).or_default().push(ns as f64 / executed.max(1) as f64);
        }
        self.ours.push(all as f64 / executed.max(1) as f64);
        master.finish();
    }

    /// Ours / bare, of the medians; rounds are drawn for its interval.
    pub fn ratio(&self) -> Option<Interval> {
        let rounds = self.ours.len().min(self.bare.len());
        let of = |rounds: &[f64], chosen: &[usize]| {
            median(&chosen.iter().map(|round| rounds[*round]).collect::<Vec<_>>())
        };
        (rounds > 0).then(|| over_rounds(rounds, |chosen| of(&self.ours, chosen) / of(&self.bare, chosen)))
    }
}

/// The threads of this process but those of simulated drives: their names, and how long each has run, ns.
fn threads() -> BTreeMap<u64, (String, u64)> {
    let read = |id: u64, file: &str| fs::read_to_string(format!("/proc/self/task/{id}/{file}")).ok();
    let ids = fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let ids = ids.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    ids.filter_map(|id| {
        let name = read(id, "comm")?.trim().to_owned();
        let ran = read(id, "schedstat")?.split_whitespace().next()?.parse().ok()?;
        (name != SIMULATED).then_some((id, (name, ran)))
    })
    .collect()
}
