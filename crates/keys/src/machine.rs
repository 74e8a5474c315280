//! What must be unique in the whole machine.

use std::collections::HashMap;
use std::net::{Ipv4Addr, SocketAddrV4};

use super::page::Place;
use super::table::Table;
use super::value::{self, SHORT_NAME, plain_name};

use crate::keys;

keys! {
    NAME "name" = "(the protocol)": "name in messages and in `reference`; unique in the machine";
}

/// What must be unique in the whole machine, and where it was seen first.
#[derive(Debug, Default)]
pub struct Machine {
    /// Drives, and devices that are none: which, and where.
    names: HashMap<String, (&'static str, Place)>,
    buses: HashMap<String, Place>,
    addresses: HashMap<Ipv4Addr, Vec<(SocketAddrV4, Claim, Place)>>,
    binds: Vec<(SocketAddrV4, Place)>,
    interfaces: HashMap<String, Place>,
    /// The period of the cycle.
    pub period_ns: u64,
    /// The end of its window, ns after the slot.
    pub deadline_ns: u64,
    /// Why the period of the cycle does not suit a bus.
    pub periods: Vec<String>,
    /// Stop groups by id, with their members.
    groups: Vec<(String, Vec<Place>)>,
}

/// Where `what` was seen before; if it was not, it is from now on `here`.
fn seen_at(seen: &mut HashMap<String, Place>, what: &str, here: Place) -> Option<Place> {
    let first = seen.get(what).cloned();
    if first.is_none() {
        seen.insert(what.to_owned(), here);
    }
    first
}

/// What distinguishes a drive from the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Claim {
    /// Its IP address: that is what a datagram says.
    Host,
    /// Address and port: it has a connection of its own.
    Port,
}

impl Machine {
    /// Nothing of it is known yet but the period of its cycle, and the end of its window.
    pub fn new(period_ns: u64, deadline_ns: u64) -> Machine {
        Machine { period_ns, deadline_ns, ..Machine::default() }
    }

    /// The name of a `kind`, a drive or a device.
    pub fn claim_name(&mut self, table: &Table<'_>, kind: &'static str, name: &str) {
        if name.is_empty() {
            return; // Missing or wrong, and already reported.
        }
        if let Some((kind, first)) = self.names.get(name) {
            table.fault("name", format!("is already the {kind} of {first}; names are unique in the machine"));
        } else {
            self.names.insert(name.to_owned(), (kind, table.place("name")));
        }
    }

    /// The interface of a bus without IP, or its port, as `key` says.
    pub fn claim_interface(&mut self, table: &Table<'_>, key: &'static str, interface: &str) {
        if let Some(first) = seen_at(&mut self.interfaces, interface, table.place(key)) {
            let remedy = format!("there is one bus per {key}, add the drives to that bus");
            table.fault(key, format!("is already that of the bus of {first}; {remedy}"));
        }
    }

    /// The bus' name, or its protocol's where it has none.
    pub fn bus_name(&mut self, table: &mut Table<'_>, protocol: &str) -> String {
        let name = table.text(NAME, SHORT_NAME, "1 to 32 letters, digits, - _ or .", plain_name);
        let name = name.unwrap_or_else(|| protocol.to_owned());
        if let Some(first) = seen_at(&mut self.buses, &name, table.place("name")) {
            table.fault(
                "name",
                match table.gives("name") {
                    true => format!("is already the bus of {first}; names are unique in the machine"),
                    false => format!("missing; the bus of {first} already has the name {name}"),
                },
            );
        }
        name
    }

    /// The address of this computer to which a bus is bound, `bind`: no other bus may have it.
    pub fn claim_bind(&mut self, table: &Table<'_>, bind: SocketAddrV4) {
        let overlaps = |other: &SocketAddrV4| {
            let everywhere = bind.ip().is_unspecified() || other.ip().is_unspecified();
            other.port() == bind.port() && (everywhere || other.ip() == bind.ip())
        };
        if let Some((_, first)) = self.binds.iter().find(|(other, _)| overlaps(other)) {
            table.fault(
                "bind",
                format!(
                    "is taken by the bus of {first}; there is one bus per address, add the drives to that bus"
                ),
            );
        }
        let drives = self.addresses.get(bind.ip()).into_iter().flatten();
        let mut hosts = drives.filter(|(_, claim, _)| *claim == Claim::Host);
        if let Some((.., drive)) = hosts.find(|(address, ..)| *address == bind) {
            table.fault(
                "bind",
                format!("is the address of the drive of {drive}; give the master's own address"),
            );
        }
        self.binds.push((bind, table.place("bind")));
    }

    /// The address of a drive: no other drive may have it, as far as `claim` says.
    pub fn claim_address(&mut self, table: &Table<'_>, address: SocketAddrV4, claim: Claim) {
        let by_host = |other: &Claim| claim == Claim::Host || *other == Claim::Host;
        let known = self.addresses.entry(*address.ip()).or_default();
        let mut binds = self.binds.iter().filter(|_| claim == Claim::Host);
        if let Some((_, first)) = binds.find(|(bind, _)| *bind == address) {
            table.fault(
                "address",
                format!("is the master's own address, bind of {first}; give the address of the drive"),
            );
        } else if let Some((_, other, first)) =
            known.iter().find(|(taken, other, _)| by_host(other) || *taken == address)
        {
            let each = if by_host(other) { "IP address" } else { "address and port" };
            table.fault("address", format!("is already that of the drive of {first}; one drive per {each}"));
        } else {
            known.push((address, claim, table.place("address")));
        }
    }

    /// The id of a stop group.
    pub fn group(&mut self, table: &Table<'_>, name: String) -> u16 {
        let place = table.place("group");
        let index = match self.groups.iter_mut().position(|(known, _)| *known == name) {
            Some(index) => {
                self.groups[index].1.push(place);
                index
            }
            None => {
                self.groups.push((name, vec![place]));
                self.groups.len() - 1
            }
        };
        u16::try_from(index).unwrap_or(u16::MAX)
    }

    /// A group of one is a slip of the pen, and the axes that should stop together would not.
    pub fn check_groups(&self, root: &Table<'_>) {
        for (name, members) in &self.groups {
            if let [only] = members.as_slice() {
                let others =
                    self.groups.iter().map(|(other, _)| other.as_str()).filter(|other| other != name);
                let hint = match value::closest(name, others) {
                    Some(meant) => format!("did you mean \"{meant}\"? "),
                    None => String::new(),
                };
                root.report(
                    only,
                    format!("no other drive is in this group; {hint}leave it out to stop alone"),
                );
            }
        }
    }
}
