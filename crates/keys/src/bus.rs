//! The keys that the buses of several protocols have.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::machine::{Claim, Machine};
use super::table::Table;
use super::value::{ENDPOINT, SOMETHING, station};

/// Stands in for an address that was refused: the plan is not handed out then.
pub const NOWHERE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0);

/// The address of this computer to which a bus is bound, with this port unless it names another one. `one`: why it
/// cannot be that of all adapters.
pub fn bind(
    table: &mut Table<'_>,
    machine: &mut Machine,
    port: u16,
    one: Option<&str>,
) -> Option<SocketAddrV4> {
    table.require("bind", "the address of the network adapter of the drives, like \"192.168.1.1\"");
    let one = one.map(|why| format!("; never 0.0.0.0, since {why}"));
    let hint = format!(
        "the IPv4 address of an adapter, like \"192.168.1.1\", or with a port other than {port}{}",
        one.as_deref().unwrap_or_default()
    );
    let fits = |bind: &SocketAddrV4| one.is_none() || !bind.ip().is_unspecified();
    let bind = table.text("bind", ENDPOINT, &hint, |text| station(text, port).filter(fits))?;
    machine.claim_bind(table, bind);
    Some(bind)
}

/// The address of a drive, like `example`, with this port unless it names another one; its bus is bound to `bind`.
pub fn address(
    table: &mut Table<'_>,
    machine: &mut Machine,
    bind: Option<Ipv4Addr>,
    (example, port): (&str, u16),
    claim: Claim,
) -> SocketAddrV4 {
    table.require("address", &format!("the address of the drive, like \"{example}\""));
    let hint = format!("the IPv4 address of a drive, like \"{example}\", or with a port other than {port}");
    let somewhere = |address: &SocketAddrV4| !address.ip().is_unspecified();
    let address = table.text("address", ENDPOINT, &hint, |text| station(text, port).filter(somewhere));
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
pub fn interface(
    table: &mut Table<'_>,
    machine: &mut Machine,
    key: &'static str,
    [missing, wrong]: [&str; 2],
) -> Option<String> {
    table.require(key, missing);
    let text = |text: &str| (!text.is_empty()).then(|| text.to_owned());
    let interface = table.text(key, SOMETHING, wrong, text)?;
    machine.claim_interface(table, key, &interface);
    Some(interface)
}

/// Motion is taken although nothing stops the drive if the master dies.
pub fn accepts_no_watchdog(table: &mut Table<'_>) -> Option<bool> {
    table.word("no_drive_watchdog", &[("accept", true), ("refuse", false)])
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
            Some(table_of(index)?.table("simulate", |table| read(table, drive, index)))
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
    let defaults = bus.sub_table("defaults");
    bus.tables("drive").into_iter().map(|table| table.over(&defaults, own)).collect()
}
