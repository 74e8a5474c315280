//! The keys that the buses of several protocols have.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::table::Table;

/// Stands in for an address that was refused: the plan is not handed out then.
pub const NOWHERE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0);

/// The kernel sends nothing between a loopback address and the world, and says so only when it is too late.
pub fn reachable(table: &mut Table<'_>, bind: Option<Ipv4Addr>, address: SocketAddrV4) {
    let Some(bind) = bind else { return };
    let (near, far) = (bind.is_loopback(), address.ip().is_loopback());
    if near != far {
        let adapter = if near { "bind to the adapter of the drive's network" } else { "bind to 127.0.0.1" };
        table.fault("address", format!("cannot be reached from bind = \"{bind}\"; {adapter}"));
    }
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
