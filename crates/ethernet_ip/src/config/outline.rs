//! What a first configuration of MOONS' drives has, and how they are found: by ListIdentity.

use std::net::SocketAddrV4;

use super::scan::{Device, ScanError, scan};
use super::tools::vendor;
use crate::plan::{IO_PORT, PORT};
use crate::wire::encapsulation::Identity;
use fieldbeat_keys::outline::{
    ADDRESS, BIND, Found, Known, Line, Outline, RANGE, Search, Unit, Usual, own, shown,
};

pub(super) const OUTLINE: Outline = Outline {
    period: "10ms",
    bus: &[BIND],
    drive: &[ADDRESS],
    unit: Unit::REVOLUTION,
    behind: &[
        RANGE,
        Line::ask(
            "steps_per_rev",
            "Motor steps of a revolution, as EG of the drive is set",
            Usual::Is("20000"),
        ),
        Line::ask("watchdog", "Its ZS: the drive stops after so long without its master", Usual::Is("500ms")),
    ],
    search: Search {
        question: "Look for the drives by ListIdentity, a broadcast that changes nothing?",
        usual: true,
        probes: false,
        run: search,
        port: PORT,
    },
};

/// Everything that answers: at these addresses, or without any a broadcast.
fn search(
    known: &Known<'_>,
    addresses: &[SocketAddrV4],
    goes_on: &dyn Fn() -> bool,
) -> Result<Vec<Found>, String> {
    let devices = match scan(*own(known, IO_PORT).ip(), addresses, goes_on) {
        Err(ScanError::Silent) => return Ok(Vec::new()),
        other => other.map_err(|error| error.to_string())?,
    };
    Ok(devices.iter().map(found).collect())
}

/// A drive is known by its vendor.
fn found(device: &Device) -> Found {
    let Identity { vendor: by, product_code, serial, name, .. } = &device.identity;
    let what = format!("{} at {}", name.trim(), device.from.ip());
    match vendor(*by) {
        Some(_) => {
            let mut lines = vec![("address", shown(device.from, PORT))];
            // 0 is no number.
            lines.extend((*product_code != 0).then(|| ("product", product_code.to_string())));
            lines.extend((*serial != 0).then(|| ("serial", format!("{serial:#010x}"))));
            Found { what, lines }
        }
        None => Found { what: format!("{what}, vendor {by}: none of these drives"), lines: Vec::new() },
    }
}
