//! A machine's TOML file, read into a checked [`Plan`]. Everything that can be found out before anything is sent is
//! found out here, and every mistake names its file, line and key, and says what would be right.
//!
//! | file | what |
//! |---|---|
//! | `reader` | a table, read key by key; unknown keys, ranges, words, places of mistakes |
//! | `value` | times with units, addresses, did-you-mean |
//! | `error` | the mistakes |
//! | `cycle` | `[cycle]`, and what would starve the host |
//! | `drive` | the keys that every `[[bus.drive]]` has |
//! | `linudp` | the keys of `protocol = "linudp-v2"` |
//! | `modbus` | the keys of `protocol = "modbus-tcp"` |
//! | `ethercat`, `ethercat_device` | the keys of `protocol = "ethercat"`; those of slaves that are no drives |
//! | `ethercat_values` | areas of memory, objects and PDOs as people write them |
//! | `faults` | the faults of simulated drives |
//! | `describe` | a plan in words |
//! | `json` | a plan as one JSON object |
//! | `linmot_table` | a LinMot drive's command table as a file of its own |
//! | `linmot_curve` | a LinMot drive's curve as a file of its own |
//!
//! What follows is the reference of docs/, where users read it.
#![doc = include_str!("../../docs/src/configuration.md")]
#![doc = include_str!("../../docs/src/configuration-linudp.md")]
#![doc = include_str!("../../docs/src/configuration-modbus.md")]
#![doc = include_str!("../../docs/src/configuration-ethercat.md")]

mod cycle;
mod describe;
mod drive;
mod error;
mod ethercat;
mod ethercat_device;
mod ethercat_values;
mod faults;
mod json;
pub mod linmot_curve;
pub mod linmot_table;
mod linudp;
mod modbus;
mod reader;
mod value;

use std::collections::HashMap;
use std::fs::{self, File, Metadata};
use std::io::{self, Read};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

pub use describe::describe;
pub use error::{ConfigError, ConfigErrors};
pub use json::json;

pub use crate::cycle::starvation;

use crate::bus::BusPlan;
use crate::cycle::{CyclePlan, GroupPlan, Plan};
use crate::master::{Master, Setup};
use crate::time::{MS, S, US};
use reader::{Page, Place, Table};

/// The sample that runs everywhere, without privileges or hardware.
const DEMO: &str = include_str!("../../rt-config/demo.toml");
/// Where it stands: what the plan of the demo has as its source.
pub const DEMO_FILE: &str = "rt-config/demo.toml";

/// Reads the configuration at `path`.
pub fn load(path: impl AsRef<Path>) -> Result<Plan, ConfigErrors> {
    let (file, text) = read(path.as_ref(), "an existing configuration, for example rt-config/demo.toml")?;
    parse(&text, &file)
}

impl Master {
    /// Reads and checks a configuration.
    pub fn from_file(path: impl AsRef<Path>) -> Result<Setup, ConfigErrors> {
        Ok(Master::from_plan(load(path.as_ref())?))
    }
}

/// The most that a configuration, a curve or a table may have, bytes: a hundred times what 256 drives need.
const LONGEST: u64 = 16 << 20;

/// The one pipe that is read: its writer is there, and somebody asked for it by this name.
const STANDARD_INPUT: &str = "/dev/stdin";

/// A file's name and text; `kind` says what kind of file it should be, with an example.
fn read(path: &Path, kind: &str) -> Result<(String, String), ConfigErrors> {
    let file = path.display().to_string();
    let bytes =
        regular(path, kind).map_err(|why| whole_file(&file, None, format!("cannot read {file}: {why}")))?;
    // NUL is UTF-8, but in no text: UTF-16 has it in every other place, a binary file sooner or later.
    let text_to = bytes.iter().position(|byte| *byte == 0);
    let valid_to = std::str::from_utf8(&bytes).err().map(|error| error.valid_up_to());
    match [text_to, valid_to].into_iter().flatten().min() {
        Some(end) => {
            let line = bytes[..end].iter().filter(|byte| **byte == b'\n').count() + 1;
            Err(whole_file(&file, Some(line), "not UTF-8 text; save the file as UTF-8 text".into()))
        }
        None => Ok((file, String::from_utf8_lossy(&bytes).into_owned())),
    }
}

/// The bytes of a regular file that is not too long, or of standard input by its name. Anything else is refused without
/// being opened: opening a pipe waits for its writer, and some devices act on being opened. Else why not, and the
/// remedy.
fn regular(path: &Path, kind: &str) -> Result<Vec<u8>, String> {
    let failed = |error: io::Error| unreadable(&error, kind);
    let about = fs::metadata(path).map_err(failed)?;
    if about.file_type().is_fifo() && path == Path::new(STANDARD_INPUT) {
        return bounded(io::stdin().lock(), kind);
    }
    fit(&about, kind)?;
    // It may have been replaced meanwhile: it is opened without waiting, and looked at again.
    let file = File::options().read(true).custom_flags(libc::O_NONBLOCK).open(path).map_err(failed)?;
    fit(&file.metadata().map_err(failed)?, kind)?;
    bounded(file, kind)
}

/// Files of /proc say that they have 0 bytes, and a pipe does not say: more than `LONGEST` is noticed while it is read.
fn bounded(from: impl Read, kind: &str) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    from.take(LONGEST + 1).read_to_end(&mut bytes).map_err(|error| unreadable(&error, kind))?;
    match bytes.len() as u64 > LONGEST {
        true => Err(too_long(kind)),
        false => Ok(bytes),
    }
}

fn fit(about: &Metadata, kind: &str) -> Result<(), String> {
    let is = about.file_type();
    match () {
        () if is.is_dir() => Err(format!("Is a directory; name {kind}")),
        () if is.is_fifo() => {
            Err(format!("it is a pipe; write its content to a file, or pipe it into {STANDARD_INPUT}"))
        }
        () if !is.is_file() => Err(format!("it is a device or a socket; name {kind}")),
        () if about.len() > LONGEST => Err(too_long(kind)),
        () => Ok(()),
    }
}

fn too_long(kind: &str) -> String {
    format!("it has more than {} MiB; name {kind}", LONGEST >> 20)
}

/// Reads the configuration `text`; messages call it `file`.
pub fn parse(text: &str, file: &str) -> Result<Plan, ConfigErrors> {
    let page = Page::new(file, text);
    let entries = page.parse()?;
    let plan = machine(Table::root(&page, &entries));
    page.verdict()?;
    Ok(Plan { source: Some(PathBuf::from(file)), ..plan })
}

/// A time as people write it, on the command line as in a file: a number and its unit, `"250us"`, `"0.5s"`, `"8h"`.
/// Spaces around both and between them do not matter, as in `"1 ms"`; a number without a unit is refused.
pub fn duration(text: &str) -> Result<Duration, String> {
    let ns = value::duration(text);
    ns.map(Duration::from_nanos)
        .ok_or_else(|| "write a number with its unit: ns, us, ms, s, min or h, for example 10s".into())
}

/// So many demos can run on one computer at a time, each with addresses of its own.
pub const DEMO_PLACES: usize = 8;

/// Whether the file at `path` is the configuration that `fieldbeat demo` has built in, as far as it can be read.
pub fn is_demo(path: impl AsRef<Path>) -> bool {
    regular(path.as_ref(), "").is_ok_and(|bytes| bytes == DEMO.as_bytes())
}

/// The demo with so many LinMots, 1 ... 128, two Unidrives and two Kollmorgens, and this period. A period that no
/// Kollmorgen takes, as 333 us, leaves them out. `place`, below [`DEMO_PLACES`], chooses the addresses: 127.77.x.y and
/// `local:demo` at 0, 127.241.x.y and `local:demo-2` at 1, and so on.
pub fn demo_plan(drives: usize, period_ns: u64, place: usize) -> Result<Plan, ConfigErrors> {
    if !(1..=128).contains(&drives) {
        return Err(whole_file(DEMO_FILE, None, format!("{drives} drives: the demo has 1 to 128")));
    }
    if place >= DEMO_PLACES {
        return Err(whole_file(DEMO_FILE, None, format!("place {place}: there are {DEMO_PLACES}")));
    }
    // Each has a name of its own in messages, and so a control socket of its own.
    let file = if place == 0 { DEMO_FILE.to_owned() } else { format!("{DEMO_FILE}#{}", place + 1) };
    parse(&demo_text(drives, period_ns, place), &file)
}

/// The demo's file up to its first drive, with the period replaced, then as many drives as wanted: all that they share
/// stands in `[bus.defaults]`. In a cycle too fast for its streaming command a drive is due every few cycles only; in
/// one too slow for it there are no streams. Then the bus of the Unidrives, with exchanges as many milliseconds apart
/// as in the file, and the EtherCAT segment as it is.
fn demo_text(drives: usize, period_ns: u64, place: usize) -> String {
    const LINE: &str = "[[bus]]\nprotocol = \"ethercat\"";
    /// What a simulated LinMot tolerates without a setpoint: longer than a busy computer holds this process up.
    const PATIENCE_NS: u64 = 2 * S;
    let head = DEMO.split("[[bus.drive]]").next().unwrap_or(DEMO);
    let tail = DEMO.match_indices("[[bus]]").nth(1).map_or("", |(at, _)| &DEMO[at..]);
    // What an S700 takes and can be given.
    let has_line = match period_ns {
        ..3_000_000 => period_ns.is_multiple_of(250 * US) && period_ns != 2_750 * US,
        _ => period_ns.is_multiple_of(MS) && period_ns < 32 * MS,
    };
    let tail = if has_line { tail } else { tail.split(LINE).next().unwrap_or(tail) };
    let period_ns = period_ns.max(1);
    let every = (8 * MS / period_ns.max(50 * US)).max(2);
    let divisor = (400 * US).div_ceil(period_ns.max(50 * US));
    let setpoints = (PATIENCE_NS / (period_ns * divisor)).clamp(20, 1_000);
    let streams = if period_ns <= DEMO_STREAMS_UP_TO_NS { "stream =" } else { "stream = \"off\" # stream =" };
    let mut text = head
        .replace("period = \"1ms\"", &format!("period = \"{period_ns}ns\""))
        .replace("[bus.defaults]", &format!("[bus.defaults]\ndivisor = {divisor}"))
        .replace("stream_patience = 1000", &format!("stream_patience = {setpoints}"))
        .replace("stream_depth = 1000", &format!("stream_depth = {setpoints}"))
        .replace("\nstream =", &format!("\n{streams}"))
        .replace("reference =", if has_line { "reference =" } else { "# reference =" });
    for drive in 1..=drives {
        text += &format!("[[bus.drive]]\nname = \"a{drive}\"\naddress = \"127.77.0.{}\"\n\n", drive + 10);
    }
    for line in tail.lines() {
        match line {
            "divisor = 8" => text += &format!("divisor = {every}"),
            "phase = 2" => text += &format!("phase = {}", every / 4),
            "phase = 6" => text += &format!("phase = {}", every * 3 / 4),
            _ => text += line,
        }
        text.push('\n');
    }
    if place > 0 {
        text = text.replace("127.77.", &format!("127.{}.", 240 + place));
        text = text.replace("\"local:demo\"", &format!("\"local:demo-{}\"", place + 1));
    }
    text
}

/// The longest period in which the demo's LinMots take a stream (LinUDP V2 manual, PVA streaming: 0.4 ... 10 ms).
pub const DEMO_STREAMS_UP_TO_NS: u64 = 10 * MS;

fn unreadable(error: &io::Error, kind: &str) -> String {
    let reason = match error.raw_os_error() {
        Some(number) => nix::errno::Errno::from_raw(number).desc().to_owned(),
        None => error.to_string(),
    };
    match error.kind() {
        io::ErrorKind::PermissionDenied => format!("{reason}; let this user read it"),
        _ => format!("{reason}; name {kind}"),
    }
}

fn whole_file(file: &str, line: Option<usize>, message: String) -> ConfigErrors {
    ConfigError { file: file.to_owned(), line, key: None, value: None, message }.into()
}

/// Reads a `[[bus]]`.
type ReadBus = fn(&mut Table<'_>, &mut Machine, &CyclePlan) -> Box<dyn BusPlan>;

/// One word a protocol; the next one is one line more.
const PROTOCOLS: [(&str, ReadBus); 3] = [
    (crate::bus::linudp::PROTOCOL, linudp::bus),
    (crate::bus::modbus::PROTOCOL, modbus::bus),
    (crate::bus::ethercat::PROTOCOL, ethercat::bus),
];

/// Stands in for an address that was refused: the plan is not handed out then.
const NOWHERE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0);

fn machine(mut root: Table<'_>) -> Plan {
    let cycle = root.table("cycle", cycle::cycle);
    let mut machine = Machine { period_ns: cycle.period_ns, ..Machine::default() };
    if !root.gives("bus") {
        root.fault("bus", "missing; a machine needs a [[bus]] with at least one [[bus.drive]]");
    }
    let mut buses: Vec<Box<dyn BusPlan>> = Vec::new();
    for mut table in root.tables("bus") {
        table.require(
            "protocol",
            "\"linudp-v2\" is LinMot LinUDP V2, \"modbus-tcp\" Nidec Unidrive, \"ethercat\" Kollmorgen S300 ... S700",
        );
        if let Some(read) = table.word("protocol", &PROTOCOLS) {
            buses.push(read(&mut table, &mut machine, &cycle));
            table.finish();
        }
    }
    machine.check_groups(&root);
    cycle::check_reference(&root, &cycle, &buses);
    for message in machine.periods {
        root.fault("cycle.period", message);
    }
    let drives = buses.iter().map(|bus| bus.axes().len()).sum();
    cycle::check_period(&root, &cycle, drives);
    let mut plan = Plan { source: None, cycle, buses, groups: Vec::new() };
    if let Some(why) = plan.black_box_fault() {
        root.fault("cycle.black_box", why);
    }
    for mut table in root.tables("group") {
        let group = group(&mut table, &plan);
        plan.groups.extend(group);
        table.finish();
    }
    root.finish();
    plan
}

/// The kernel sends nothing between a loopback address and the world, and says so only when it is too late.
fn reachable(table: &mut Table<'_>, bind: Option<Ipv4Addr>, address: SocketAddrV4) {
    let Some(bind) = bind else { return };
    let (near, far) = (bind.is_loopback(), address.ip().is_loopback());
    if near != far {
        let adapter = if near { "bind to the adapter of the drive's network" } else { "bind to 127.0.0.1" };
        table.fault("address", format!("cannot be reached from bind = \"{bind}\"; {adapter}"));
    }
}

/// The drives of a bus, each over its `[bus.defaults]`; `read` gets its place, too.
fn drives<D>(bus: &mut Table<'_>, mut read: impl FnMut(&mut Table<'_>, usize) -> D) -> Vec<D> {
    let mut drives = Vec::new();
    for (index, mut table) in drive_tables(bus, &["name", "address"]).into_iter().enumerate() {
        drives.push(read(&mut table, index));
        table.finish();
    }
    drives
}

/// The tables of the drives of a bus, each over its `[bus.defaults]` but for the keys that are its `own`.
fn drive_tables<'a>(bus: &mut Table<'a>, own: &'static [&'static str]) -> Vec<Table<'a>> {
    let defaults = bus.sub_table("defaults");
    if !bus.gives("drive") {
        bus.fault("drive", "missing; a bus needs at least one [[bus.drive]]");
    }
    bus.tables("drive").into_iter().map(|table| table.over(&defaults, own)).collect()
}

/// A `[[group]]`: axes that act together.
fn group(table: &mut Table<'_>, plan: &Plan) -> Option<GroupPlan> {
    table.require("name", "the name by which programs use the group");
    table.require("axes", "the names of its drives, like [\"x\", \"y\"]");
    let name = table.text("name", "1 to 32 letters, digits, - _ or .", drive::plain_name);
    let axes = table.read("axes", |value| {
        let names = value.as_array().map(|array| array.iter().map(|name| name.get_ref().as_str()));
        let names: Option<Vec<&str>> = names.and_then(Iterator::collect);
        names
            .ok_or("must be the names of drives, like [\"x\", \"y\"]".into())
            .map(|names| names.into_iter().map(str::to_owned).collect::<Vec<_>>())
    });
    let group = GroupPlan { name: name?, axes: axes? };
    if plan.groups.iter().any(|other| other.name == group.name) {
        table.fault("name", "is taken by another group; names are unique");
    }
    if let Some(why) = group.fault(&plan.axes()) {
        table.fault("axes", why);
    }
    Some(group)
}

/// What must be unique in the whole machine, and where it was seen first.
#[derive(Debug, Default)]
struct Machine {
    /// Drives, and devices that are none: which, and where.
    names: HashMap<String, (&'static str, Place)>,
    buses: HashMap<String, Place>,
    addresses: HashMap<Ipv4Addr, Vec<(SocketAddrV4, Claim, Place)>>,
    binds: Vec<(SocketAddrV4, Place)>,
    interfaces: HashMap<String, Place>,
    /// The period of the cycle.
    period_ns: u64,
    /// Why the period of the cycle does not suit a bus.
    periods: Vec<String>,
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
enum Claim {
    /// Its IP address: that is what a datagram says.
    Host,
    /// Address and port: it has a connection of its own.
    Port,
}

impl Machine {
    /// The name of a `kind`, a drive or a device.
    fn claim_name(&mut self, table: &Table<'_>, kind: &'static str, name: &str) {
        if name.is_empty() {
            return; // Missing or wrong, and already reported.
        }
        if let Some((kind, first)) = self.names.get(name) {
            table.fault("name", format!("is already the {kind} of {first}; names are unique in the machine"));
        } else {
            self.names.insert(name.to_owned(), (kind, table.place("name")));
        }
    }

    /// The interface of a bus without IP.
    fn claim_interface(&mut self, table: &Table<'_>, interface: &str) {
        if let Some(first) = seen_at(&mut self.interfaces, interface, table.place("interface")) {
            let remedy = "there is one bus per interface, add the drives to that bus";
            table.fault("interface", format!("is already that of the bus of {first}; {remedy}"));
        }
    }

    /// The bus' name, or its protocol's where it has none.
    fn bus_name(&mut self, table: &mut Table<'_>, protocol: &str) -> String {
        let name = table.text("name", "1 to 32 letters, digits, - _ or .", drive::plain_name);
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

    fn claim_bind(&mut self, table: &Table<'_>, bind: SocketAddrV4) {
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

    fn claim_address(&mut self, table: &Table<'_>, address: SocketAddrV4, claim: Claim) {
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
    fn group(&mut self, table: &Table<'_>, name: String) -> u16 {
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
    fn check_groups(&self, root: &Table<'_>) {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_demo_is_the_sample_file() {
        let sample = parse(DEMO, DEMO_FILE).unwrap();
        let built = demo_plan(8, 1_000_000, 0).unwrap();
        assert_eq!(format!("{sample:?}"), format!("{built:?}"));
    }
}
