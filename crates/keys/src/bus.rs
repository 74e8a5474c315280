//! The keys that the buses of several protocols have.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::key::Key;
use super::machine::{Claim, Machine};
use super::table::Table;
use super::value::{ENDPOINT, SOMETHING, station};

use crate::keys;

keys! {
    DEFAULTS "defaults" = "none": "the table `[bus.defaults]`: keys for all drives of this bus";
    DRIVE "drive" = "(at least one)": "the drives: one `[[bus.drive]]` each";
    DEVICE "device" = "none": "slaves that are no drives: one `[[bus.device]]` each";
    SIMULATED_WIRE "simulate" = "none": "the segment or wire when it is simulated, see below";
    SIMULATE "simulate" = "none": "the drive when it is simulated, see below and in the section of the "
        "protocol";
}

/// Stands in for an address that was refused: the plan is not handed out then.
pub const NOWHERE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0);

/// The address of this computer to which a bus is bound, with this port unless it names another one. `one`: why it
/// cannot be that of all adapters.
pub fn bind(
    table: &mut Table<'_>,
    machine: &mut Machine,
    (key, port): (Key, u16),
    one: Option<&str>,
) -> Option<SocketAddrV4> {
    let one = one.map(|why| format!("; never 0.0.0.0, since {why}"));
    let hint = format!(
        "the IPv4 address of an adapter, like \"192.168.1.1\", or with a port other than {port}{}",
        one.as_deref().unwrap_or_default()
    );
    let fits = |bind: &SocketAddrV4| one.is_none() || !bind.ip().is_unspecified();
    let bind = table.text(key, ENDPOINT, &hint, |text| station(text, port).filter(fits))?;
    machine.claim_bind(table, bind);
    Some(bind)
}

/// The address of a drive, like `example`, with this port unless it names another one; its bus is bound to `bind`.
pub fn address(
    table: &mut Table<'_>,
    machine: &mut Machine,
    bind: Option<Ipv4Addr>,
    key: Key,
    (example, port): (&str, u16),
    claim: Claim,
) -> SocketAddrV4 {
    let hint = format!("the IPv4 address of a drive, like \"{example}\", or with a port other than {port}");
    let somewhere = |address: &SocketAddrV4| !address.ip().is_unspecified();
    let address = table.text(key, ENDPOINT, &hint, |text| station(text, port).filter(somewhere));
    let Some(address) = address else { return NOWHERE };
    machine.claim_address(table, address, claim);
    if let Some(bind) = bind.filter(|bind| !bind.is_unspecified()) {
        reachable(table, bind, address);
    }
    address
}

/// The kernel sends nothing between a loopback address and the world, and says so only when it is too late.
fn reachable(table: &Table<'_>, bind: Ipv4Addr, address: SocketAddrV4) {
    let (near, far) = (bind.is_loopback(), address.ip().is_loopback());
    if near != far {
        let adapter = if near { "bind to the adapter of the drive's network" } else { "bind to 127.0.0.1" };
        table.fault("address", format!("cannot be reached from bind = \"{bind}\"; {adapter}"));
    }
}

/// The interface of a bus without IP, or its port, as `key` says.
pub fn interface(table: &mut Table<'_>, machine: &mut Machine, key: Key, wrong: &str) -> Option<String> {
    let text = |text: &str| (!text.is_empty()).then(|| text.to_owned());
    let interface = table.text(key, SOMETHING, wrong, text)?;
    machine.claim_interface(table, key.name, &interface);
    Some(interface)
}

/// Motion is taken although nothing stops the drive if the master dies.
pub fn accepts_no_watchdog(table: &mut Table<'_>, key: Key) -> Option<bool> {
    table.word(key, &[("accept", true), ("refuse", false)])
}

/// The drives of a bus, each over its `[bus.defaults]`; `read` gets its place, too.
pub fn drives<D>(bus: &mut Table<'_>, mut read: impl FnMut(&mut Table<'_>, usize) -> D) -> Vec<D> {
    let mut drives = Vec::new();
    for (index, mut table) in drive_tables(bus, &["name", "address", "serial"]).into_iter().enumerate() {
        drives.push(read(&mut table, index));
        table.finish();
    }
    drives
}

/// How the drives of a bus that is read otherwise are simulated; `read` reads the key `simulate` of one. Of more drives
/// than there are tables, the others are like the first one.
pub fn simulated<D, S>(
    bus: &mut Table<'_>,
    drives: &[D],
    mut read: impl FnMut(&mut Table<'_>, &D, usize) -> S,
) -> Vec<S> {
    let tables = drive_tables(bus, &[]);
    let table_of = |index| tables.get(index).or(tables.first()).map(Table::again);
    let drives = drives.iter().enumerate();
    drives
        .filter_map(|(index, drive)| {
            Some(simulated_slave(&mut table_of(index)?, |table| read(table, drive, index)))
        })
        .collect()
}

/// The tables of the drives of a bus, each over its `[bus.defaults]` but for the keys that are its `own`.
pub fn drive_tables<'a>(bus: &mut Table<'a>, own: &'static [&'static str]) -> Vec<Table<'a>> {
    if !bus.gives("drive") {
        bus.fault("drive", "missing; a bus needs at least one [[bus.drive]]");
    }
    drive_tables_if_any(bus, own)
}

/// The same of a bus that may have no drive.
pub fn drive_tables_if_any<'a>(bus: &mut Table<'a>, own: &'static [&'static str]) -> Vec<Table<'a>> {
    let defaults = bus.sub_table(DEFAULTS);
    bus.tables(DRIVE).into_iter().map(|table| table.over(&defaults, own)).collect()
}

/// The tables of the devices of a bus that are no drives.
pub fn devices<'a>(bus: &mut Table<'a>) -> Vec<Table<'a>> {
    bus.tables(DEVICE)
}

/// Reads how the wire of a bus is simulated.
pub fn simulated_wire<'a, T>(bus: &mut Table<'a>, read: impl FnOnce(&mut Table<'a>) -> T) -> T {
    bus.table(SIMULATED_WIRE, read)
}

/// Reads how a slave is simulated, drive or not.
pub fn simulated_slave<'a, T>(slave: &mut Table<'a>, read: impl FnOnce(&mut Table<'a>) -> T) -> T {
    slave.table(SIMULATE, read)
}
