//! The loop with acyclic calls.

use std::collections::VecDeque;
use std::time::Duration;

use fieldbeat::Wait;
use fieldbeat::axis::Acyclic;
use fieldbeat::time::MS;
use fieldbeat_core::axis::CallTicket;
use fieldbeat_core::net::Os;
use fieldbeat_core::rt::Granted;
use fieldbeat_linudp::upid;
use fieldbeat_linudp::wire::RtcCommand;
use serde_json::json;

use super::memory::{carrier_alone, turns};
use crate::support::fleet::{Fleet, Side};
use crate::support::null::NullNet;
use crate::support::rig::{self, Calls, Pace, Rig};
use crate::support::stats::{median, over_rounds};
use crate::support::{Report, Steal, in_turns, shown};

/// So many drives read a parameter back to back.
const READING: usize = 32;
/// Reads that are under way on each of them.
const UNDER_WAY: usize = 4;

/// Keeps every drive at reading, from outside of the loop and of what is measured.
struct Readers {
    under_way: Vec<VecDeque<CallTicket>>,
    done: u64,
}

impl Readers {
    fn new(drives: usize) -> Readers {
        Readers { under_way: (0..drives).map(|_| VecDeque::new()).collect(), done: 0 }
    }

    fn feed(&mut self, acyclics: &[Acyclic]) {
        let call = upid::call(RtcCommand::READ_RAM, 0x1E0F, 0);
        for (acyclic, under_way) in acyclics.iter().zip(&mut self.under_way) {
            while let Some(end) = under_way.front_mut().and_then(CallTicket::poll) {
                self.done += u64::from(end.is_ok());
                under_way.pop_front();
            }
            while under_way.len() < UNDER_WAY {
                match acyclic.post(call, Duration::from_secs(1)) {
                    Ok(ticket) => under_way.push_back(ticket),
                    Err(error) => rig::give_up(error),
                }
            }
        }
    }
}

/// What a parameter read back to back on each drive costs the loop, and how many come of it.
pub fn with_reads(granted: &Granted, quick: bool, report: &mut Report) -> serde_json::Value {
    let (rounds, cycles) = if quick { (7, 400) } else { (21, 1_000) };
    let steal = Steal::begin();
    let mut medians: [Vec<f64>; 3] = Default::default();
    let (mut reads, mut executed) = (0, 0);
    in_turns(rounds, 3, |what| {
        let slice = rig::on_loop_thread(|_| match what {
            0 => (turns(Fleet::linmots(READING), Pace::BackToBack, cycles), 0, 0),
            1 => reading_turns(READING, cycles),
            _ => (carrier_alone(Fleet::linmots(READING), cycles), 0, 0),
        });
        let (slice, done, in_cycles) = slice.unwrap_or_else(|error| rig::give_up(error));
        (reads, executed) = (reads + done, executed + in_cycles);
        medians[what].push(median(&slice));
    });
    let [idle, reading, carrier] = &medians;
    let of =
        |rounds: &[usize], all: &[f64]| median(&rounds.iter().map(|round| all[*round]).collect::<Vec<_>>());
    let each =
        |all: &[f64]| over_rounds(rounds, |rounds| (of(rounds, all) - of(rounds, carrier)) / READING as f64);
    let (idle, reading) = (each(idle), each(reading));
    let a_cycle = reads as f64 / (executed * READING as u64) as f64;
    let on_sockets = reads_on_sockets(granted, if quick { 300 } else { 3_000 });
    println!(
        "\n{READING} drives, each reading a parameter back to back, ns a drive and cycle without a socket; \
         steal {} ms",
        shown(steal.ms())
    );
    println!("  without reads {idle}, with them {reading}; {a_cycle:.3} reads a cycle and drive");
    println!("  on sockets at 1 kHz: {} reads a second and drive", shown(on_sockets.map(f64::round)));
    report.check(format!("a read a cycle and drive: {a_cycle:.3} >= 0.95"), a_cycle >= 0.95);
    json!({
        "reading_drives": READING,
        "loop_ns": idle.value,
        "loop_reading_ns": reading.value,
        "loop_reading_ns_interval": reading.ends(),
        "reads_a_cycle": a_cycle,
        "reads_a_second_on_sockets": on_sockets,
        "steal_ms": steal.ms(),
    })
}

/// Busy time of each cycle, ns, with reads; how many were done, in how many cycles that were executed.
fn reading_turns(drives: usize, cycles: usize) -> (Vec<f64>, u64, u64) {
    let cycle = rig::exchange_cycle(MS, Wait::Spin);
    let buses = Fleet::linmots(drives).buses(Side::Ours);
    let mut rig = Rig::new(cycle, buses, Pace::BackToBack, &NullNet, Calls::default());
    rig.enable();
    let mut readers = Readers::new(drives);
    // The channel is learned first.
    for _ in 0..8 {
        readers.feed(rig.acyclics());
        rig.turn(|_| {});
    }
    readers.done = 0;
    let executed = rig.status().executed;
    let mut one = |_| {
        readers.feed(rig.acyclics());
        rig.turn(|_| {}).busy_ns as f64
    };
    let slice = (0..cycles).map(&mut one).collect();
    (slice, readers.done, rig.status().executed - executed)
}

/// Reads a second and drive, on sockets at 1 kHz, with the simulated drives on the other core.
fn reads_on_sockets(granted: &Granted, cycles: usize) -> Option<f64> {
    let fleet = Fleet::linmots(READING);
    let _server = rig::serve(fleet.simulate(Side::Ours), granted);
    let done = rig::on_loop_thread(|_| {
        let cycle = rig::exchange_cycle(MS, Wait::Poll);
        let buses = fleet.buses(Side::Ours);
        let mut rig = Rig::new(cycle, buses, Pace::Grid, &Os::default(), Calls::default());
        rig.enable();
        let mut readers = Readers::new(READING);
        for _ in 0..cycles {
            readers.feed(rig.acyclics());
            rig.turn(|_| {});
        }
        readers.done
    });
    let done = done.ok()?;
    Some(done as f64 / READING as f64 / (cycles as f64 / 1_000.0))
}
