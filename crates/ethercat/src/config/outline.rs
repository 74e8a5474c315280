//! What a first configuration of an EtherCAT segment has, and how its drives are found.

use std::net::SocketAddrV4;

use super::tools::{failed, open};
use crate::object::Family;
use crate::plan::{KOLLMORGEN, KollmorgenDrive};
use crate::scan::{Options, ScanError, Slave, scan};
use fieldbeat_core::net::Place;
use fieldbeat_keys::outline::{Found, Known, Line, Outline, RANGE, Search, Unit, Usual};

pub(super) const OUTLINE: Outline = Outline {
    period: "2ms",
    bus: &[Line::ask("interface", "Network interface of the segment", Usual::From(interface))],
    drive: &[
        Line::ask(
            "position",
            "Position in the segment, 0 is next to this computer",
            Usual::From(|known| Some(known.index.to_string())),
        ),
        Line::ask("type", "Type of the drive: s300, s400, s600, s700 or akd", Usual::Is("s700")),
    ],
    unit: Unit::REVOLUTION,
    behind: &[
        RANGE,
        Line::ask("prbase", "Increments of one turn as a power of two, PRBASE of the drive", Usual::Is("20")),
        Line::ask("watchdog", "The drive stops after so long without its master", Usual::Is("100ms")),
    ],
    search: Search {
        question: "Look for the slaves of the segment? Their states are only read",
        usual: true,
        probes: false,
        run: search,
        port: 0,
    },
};

/// One with a cable, or else one that computers with a second port have.
fn interface(_: &Known<'_>) -> Option<String> {
    let entries = std::fs::read_dir("/sys/class/net").into_iter().flatten().flatten();
    let of_hardware = entries.filter(|entry| entry.path().join("device").exists());
    let mut names: Vec<String> =
        of_hardware.filter_map(|entry| entry.file_name().into_string().ok()).collect();
    names.sort();
    // The first one usually leads to the office.
    names.pop().or(Some("eth1".into()))
}

/// Every slave that answers.
fn search(known: &Known<'_>, _: &[SocketAddrV4], goes_on: &dyn Fn() -> bool) -> Result<Vec<Found>, String> {
    let interface = (known.answer)("interface").unwrap_or_default();
    let _lock = Place::Interface(&interface).lock().map_err(|why| format!("{interface} {why}"))?;
    let mut frames = open(&interface).map_err(|stop| stop.message)?;
    match scan(&mut *frames, Options::default(), goes_on) {
        Err(ScanError::Silent) => Ok(Vec::new()),
        Err(error) => Err(failed(&interface, error).message),
        Ok(slaves) => Ok(slaves.iter().map(found).collect()),
    }
}

/// A drive is known by the identity in its SII.
fn found(slave: &Slave) -> Found {
    let place = slave.place;
    let other = |what: String| Found { what, lines: Vec::new() };
    let Ok(sii) = &slave.sii else {
        return other(format!("a slave at position {place} whose SII is not read"));
    };
    let (identity, name) = (sii.identity, if sii.name.is_empty() { "a slave" } else { &sii.name });
    if identity.vendor != KOLLMORGEN {
        return other(format!("{name} at position {place}: no drive; write a [[bus.device]] for it"));
    }
    let families = [("s700", Family::S700), ("akd", Family::Akd)];
    let product = |family| KollmorgenDrive::new("", 0, family).slave.identity.product;
    let known = families.into_iter().find(|(_, family)| product(*family) == Some(identity.product));
    let mut lines = vec![("position", place.to_string())];
    lines.extend(known.map(|(name, _)| ("type", name.to_owned())));
    // What many slaves have says nothing of one of them.
    if sii.sound && !matches!(sii.serial, 0 | u32::MAX) {
        lines.push(("serial", format!("{:#010x}", sii.serial)));
    }
    if slave.alias != 0 {
        lines.push(("alias", slave.alias.to_string()));
    }
    Found { what: format!("{name} at position {place}"), lines }
}
