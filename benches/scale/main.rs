//! What a drive costs, 1 to 256 of them.
//!
//! - **The loop without a socket**: the real engine, bus and stations over a null carrier that answers from memory. A
//!   cycle is everything from the end of one sleep to the begin of the next: send, receive, health, exchange, prepare,
//!   records and feedback. Cycles follow each other without sleeping, and once more paced at 1 kHz with the core asleep
//!   in between, where caches are cold. The carrier's own time is measured alone, in turns with the loop, and taken
//!   off. A segment of Kollmorgen drives shares one frame: it is brought up once for each length, and answers from
//!   memory from then on. The clock jumps over what a PROFIBUS wire is waited for.
//! - **The loop with acyclic calls**: the same, with a parameter read back to back on each of 32 drives, in turns with
//!   the loop without them; and how many reads a second that comes to, there and on sockets at 1 kHz.
//! - **The loop on sockets** against a bare `sendto` / `recvfrom` loop over the same bytes, cycle by cycle in turns:
//!   time from waking up until done, and processor time.
//! - **LinMots and Unidrives together**: 32 LinMots in every cycle and 32 Unidrives in every eighth, as many in one as
//!   in the next, in one cycle at 1 kHz: nothing planned is left out, each exchange is closed; and the same against a
//!   bare loop.
//! - **All kinds together**: 32 LinMots and 8 Kollmorgens in every cycle, 32 MOONS' drives, 8 Unidrives and 4 Lenze
//!   drives in every fourth, in one cycle at 1 kHz.
//! - **MOONS' drives on sockets**: the send phase against a bare loop over the same bytes, and the age of feedback.
//! - **Segments on a socket of this host**: what one of 16 drives and one of 8 drives, couplers and terminals take at
//!   1 kHz, and one of drives against a bare loop over the same bytes.
//! - **A wire on a port of this host**: what 4 Lenze drives at 12 Mbit/s take at 1 kHz, and against a bare loop over
//!   the same bytes: the send phase, the time until done, processor time.
//! - **The whole process**: processor time a cycle of all threads of a master at 1 kHz, by thread, against the bare
//!   loop alone at 1 kHz, in turns.
//! - **System calls a cycle**, counted at full speed where the loop makes them: in its clock and its carrier. That
//!   these counters see every call is proved by running the loop once more under `strace`, whose count must be the
//!   same. Held to their budget are those that the loop makes whenever replies come.
//! - With `--count`, in place of all that: **instructions a drive and cycle** of the loop without a socket, and its
//!   system calls and allocations, each with its budget in `benches/budgets.csv`; and those a slave and cycle of a
//!   segment of 8 drives and 56 couplers and terminals, whose outputs change in each cycle. Counted once more: drives
//!   that stand, drives whose status changes in each exchange, the default mapping of a Unidrive, the threads of
//!   telemetry and of a recording; and the worst cycle of a hundred in which all drives are lost, have a fault, or get
//!   a command at once, alone and in stop groups of two; and a carrier on sockets alone.

mod carriers;
mod counted;
mod memory;
mod reads;
mod sockets;
#[path = "../support/mod.rs"]
#[allow(dead_code, reason = "each bench uses a part of it")]
mod support;
mod traced;

use std::process::ExitCode;

use counted::{COMPARED, counted, scenarios};
use memory::{StandingSegments, Without, slice_of, slice_of_wires, without_socket};
use reads::with_reads;
use serde_json::json;
use sockets::{
    all_kinds, on_sockets, packets_on_sockets, segments_on_sockets, together, whole_process, wire_on_port,
};
use support::budgets::Budgets;
use support::fleet::Fleet;
use support::{Args, Report, count, rig};
use traced::{TRACED, strace, traced};

fn main() -> ExitCode {
    if let Some(fleet) = std::env::var(TRACED).ok().and_then(|fleet| fleet.parse().ok()) {
        traced(fleet);
        return ExitCode::SUCCESS;
    }
    let scenarios = scenarios();
    if count::is_child(&scenarios, counted) {
        return ExitCode::SUCCESS;
    }
    let args = Args::parse("scale");
    if args.count {
        return count::gate("scale", &args, &scenarios);
    }
    let budgets = Budgets::read().unwrap_or_else(|why| rig::give_up(why));
    let granted = rig::introduce("scale: what a drive costs");
    let mut report = Report::default();
    let drives: &[usize] = if args.quick { &COMPARED } else { &[1, 2, 4, 8, 16, 32, 64, 128, 256] };
    let of = |fleet: fn(usize) -> Fleet| move |count, what, cycles| slice_of(fleet(count), what, cycles);
    let without = without_socket("LinMots", args.quick, drives, of(Fleet::linmots));
    let unidrives = without_socket("Unidrives", args.quick, drives, of(Fleet::unidrives));
    let moons = without_socket("MOONS' drives", args.quick, drives, of(Fleet::moons));
    let segments: &[usize] = if args.quick { &[1, 8, 64] } else { &[1, 2, 4, 8, 16, 32, 64] };
    let mut standing = StandingSegments::new(segments);
    let in_segments = without_socket("drives of one segment", args.quick, segments, |count, what, cycles| {
        standing.slice(count, what, cycles)
    });
    drop(standing);
    let on_wires = without_socket("Lenze drives", args.quick, drives, slice_of_wires);
    let reads = with_reads(&granted, args.quick, &mut report);
    let on_sockets = on_sockets(&granted, args.quick, drives, &budgets, &mut report);
    let together = together(&granted, args.quick, &budgets, &mut report);
    let all_kinds = all_kinds(&granted, args.quick, &budgets, &mut report);
    let packets = packets_on_sockets(&granted, args.quick, &budgets, &mut report);
    let segments_on_sockets = segments_on_sockets(&granted, args.quick, &budgets, &mut report);
    let wire_on_port = wire_on_port(&granted, args.quick, &budgets, &mut report);
    let whole = whole_process(&granted, args.quick);
    strace(&granted, args.quick, &mut report);
    for (((drives, without), unidrives), on) in drives.iter().zip(without).zip(unidrives).zip(on_sockets) {
        report.append(json!({
            "drives": drives,
            "loop_ns": without.back_to_back.value,
            "loop_ns_interval": without.back_to_back.ends(),
            "loop_paced_ns": without.paced.value,
            "loop_paced_ns_interval": without.paced.ends(),
            "carrier_ns": without.carrier,
            "unidrive_loop_ns": unidrives.back_to_back.value,
            "unidrive_loop_ns_interval": unidrives.back_to_back.ends(),
            "unidrive_loop_paced_ns": unidrives.paced.value,
            "unidrive_loop_paced_ns_interval": unidrives.paced.ends(),
            "unidrive_carrier_ns": unidrives.carrier,
            "sockets_ns": on.ours,
            "bare_ns": on.bare,
            "sockets_ratio": on.ratio.map(|ratio| ratio.value),
            "sockets_ratio_interval": on.ratio.map(|ratio| ratio.ends()),
            "sockets_cpu_ns": on.ours_cpu,
            "bare_cpu_ns": on.bare_cpu,
            "sockets_cpu_ratio": on.cpu_ratio.map(|ratio| ratio.value),
            "syscalls_per_cycle": on.calls,
            "steal_ms": on.steal_ms,
        }));
    }
    let of_kind = |key: &str, drives: &usize, without: Without| {
        json!({
            key: drives,
            "loop_ns": without.back_to_back.value,
            "loop_ns_interval": without.back_to_back.ends(),
            "loop_paced_ns": without.paced.value,
            "loop_paced_ns_interval": without.paced.ends(),
            "carrier_ns": without.carrier,
        })
    };
    for (drives, without) in segments.iter().zip(in_segments) {
        report.append(of_kind("segment_drives", drives, without));
    }
    report.append(reads);
    for (key, costs) in [("moons_drives", moons), ("lenze_drives", on_wires)] {
        for (drives, without) in drives.iter().zip(costs) {
            report.append(of_kind(key, drives, without));
        }
    }
    report.append(together);
    report.append(all_kinds);
    report.append(packets);
    segments_on_sockets.into_iter().for_each(|segment| report.append(segment));
    wire_on_port.into_iter().for_each(|wire| report.append(wire));
    whole.into_iter().for_each(|whole| report.append(whole));
    report.finish(&args)
}
