//! What a first configuration of Lenze drives has, and how they are found: by the live list of the wire.

use std::net::SocketAddrV4;

use super::scan::ScanError;
use super::tools::{SCAN_LATENCY_MS, stations};
use crate::plan::{Bits, ProfibusPlan};
use fieldbeat_core::time::MS;
use fieldbeat_keys::outline::{Found, Known, Line, Outline, Search, Unit, Usual};

pub(super) const OUTLINE: Outline = Outline {
    period: "10ms",
    bus: &[
        Line::ask("device", "Serial port of the wire", Usual::Is("/dev/ttyS1")),
        Line::ask("rate", "Rate of the wire, bit/s", Usual::Is("1500000")),
    ],
    drive: &[Line::ask(
        "address",
        "Address that is set at the module",
        Usual::From(|known| Some((known.index + 3).to_string())),
    )],
    unit: Unit::REVOLUTION,
    behind: &[
        Line::ask("ident", "Ident number of the module, as its GSD has it", Usual::Is("0x0082")),
        Line::ask("full_rpm", "Speed at the full set point, C0011, rpm", Usual::Is("1500")),
        Line::ask("watchdog", "The drive stops after so long without its master", Usual::Is("100ms")),
    ],
    search: Search {
        question: "Look for the stations? The wire is listened to first; with another master on it nothing \
             is sent",
        usual: true,
        probes: false,
        run: search,
        port: 0,
    },
};

/// Every station that answers.
fn search(known: &Known<'_>, _: &[SocketAddrV4], goes_on: &dyn Fn() -> bool) -> Result<Vec<Found>, String> {
    let device = (known.answer)("device").unwrap_or_default();
    let rate = (known.answer)("rate").and_then(|rate| rate.parse().ok()).unwrap_or(ProfibusPlan::RATE);
    let plan = ProfibusPlan::new(&device, rate, Vec::new());
    let bits = Bits { latency_ns: SCAN_LATENCY_MS * MS, ..plan.bits };
    let plan = ProfibusPlan { address: 0, bits, ..plan };
    let stations = match stations(&plan, goes_on)? {
        Err(ScanError::Silent) => return Ok(Vec::new()),
        other => other.map_err(|error| format!("{device}: {error}"))?,
    };
    let found = stations.iter().map(|station| {
        let ident = station.diagnosis().map(|diagnosis| diagnosis.ident);
        let mut lines = vec![("address", station.address.to_string())];
        lines.extend(ident.map(|ident| ("ident", format!("{ident:#06x}"))));
        let what = match ident {
            Some(ident) => format!("station {} with the ident number {ident:#06x}", station.address),
            None => format!("station {}", station.address),
        };
        Found { what, lines }
    });
    Ok(found.collect())
}
