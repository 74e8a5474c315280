//! The plan of `fieldbeat demo`.

use std::iter;
use std::path::Path;

use super::cycle::period_fault;
use super::{Configuration, parse_changed};
use fieldbeat_core::bus::variant::Variant;
use fieldbeat_core::cycle::{Overrun, Plan};
use fieldbeat_core::time::MS;
use fieldbeat_keys::error::ConfigErrors;
use fieldbeat_keys::file::{regular, whole_file};
use fieldbeat_keys::page::Place;

/// The sample that runs everywhere, without privileges or hardware.
const DEMO: &str = include_str!("../files/demo.toml");
/// Where it stands: what the plan of the demo has as its source.
pub const DEMO_FILE: &str = "rt-config/demo.toml";

/// So many demos can run on one computer at a time, each with addresses of its own.
pub const DEMO_PLACES: usize = 8;

/// Whether the file at `path` is the configuration that `fieldbeat demo` has built in, as far as it can be read.
pub fn is_demo(path: impl AsRef<Path>) -> bool {
    regular(path.as_ref(), "").is_ok_and(|bytes| bytes == DEMO.as_bytes())
}

/// The demo with so many drives on its first bus, 1 ... 128, and this period. A bus that does not take the period is
/// left out, and the clock of a bus that is left out does not lead. `place`, below [`DEMO_PLACES`], chooses the
/// addresses: 127.77.x.y, `local:demo` and `local:demo-wire` at 0, 127.241.x.y, `local:demo-2` and `local:demo-wire-2`
/// at 1, and so on.
pub fn demo_plan(drives: usize, period_ns: u64, place: usize) -> Result<Configuration, ConfigErrors> {
    if !(1..=128).contains(&drives) {
        return Err(whole_file(DEMO_FILE, None, format!("{drives} drives: the demo has 1 to 128")));
    }
    let Some(place) = u8::try_from(place).ok().filter(|place| usize::from(*place) < DEMO_PLACES) else {
        return Err(whole_file(DEMO_FILE, None, format!("place {place}: there are {DEMO_PLACES}")));
    };
    // Each has a name of its own in messages, and so a control socket of its own.
    let file = if place == 0 { DEMO_FILE.to_owned() } else { format!("{DEMO_FILE}#{}", place + 1) };
    parse_changed(DEMO, &file, |plan, root| {
        let wanted = Variant { was_ns: plan.cycle.period_ns, period_ns, drives: None, place };
        let period =
            Place::in_row(root.place("cycle.period").line, "cycle.period", &format!("\"{period_ns}ns\""));
        if let Some(why) = period_fault(period_ns) {
            return root.report(&period, why);
        }
        vary(plan, &wanted, drives);
        for bus in &plan.buses {
            for (_, fault) in bus.faults(period_ns).into_iter().chain(bus.turn_faults(plan.cycle.grid())) {
                root.report(&period, format!("bus {}: {} {}", bus.name(), fault.key, fault.message));
            }
        }
    })
}

/// What of the plan depends on its period, its place and the number of its drives.
fn vary(plan: &mut Plan, wanted: &Variant, drives: usize) {
    let counts = iter::once(Some(drives)).chain(iter::repeat(None));
    let variants =
        plan.buses.iter().zip(counts).map(|(bus, drives)| bus.variant(&Variant { drives, ..*wanted }));
    plan.buses = variants.flatten().collect();
    let cycle = &mut plan.cycle;
    cycle.period_ns = wanted.period_ns;
    // Stated as a time in the file.
    if let Overrun::Skip { max_skip } = &mut cycle.overrun {
        *max_skip = max_skip.saturating_mul(wanted.was_ns).div_ceil(wanted.period_ns);
    }
    cycle.reference.take_if(|leading| plan.buses.iter().all(|bus| bus.name() != leading));
}

/// The longest period in which the demo's LinMots take a stream (LinUDP V2 manual, PVA streaming: 0.4 ... 10 ms).
pub const DEMO_STREAMS_UP_TO_NS: u64 = 10 * MS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_demo_is_the_sample_file() {
        let sample = crate::parse(DEMO, DEMO_FILE).unwrap();
        let built = demo_plan(8, 1_000_000, 0).unwrap();
        assert_eq!(format!("{sample:?}"), format!("{built:?}"));
    }
}
