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
//! | `describe` | a plan in words |
//! | `linmot_table` | a LinMot drive's command table as a file of its own |
//! | `linmot_curve` | a LinMot drive's curve as a file of its own |
//!
//! # The file
//!
//! `[cycle]`, all keys optional:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `period` | `"1ms"` | period of the loop, 50 us ... 1 s |
//! | `core` | the last | core of the loop |
//! | `priority` | `80` | SCHED_FIFO priority |
//! | `guard` | `"off"` | final spin before each grid point: `"off"`, a time, or `"auto"` (calibrated) |
//! | `receive_deadline` | `0.5` | replies are taken until this share of the period |
//! | `wait` | `"poll"` | `"spin"` asks the socket again and again instead of sleeping |
//! | `overrun` | `"skip"` | keep the grid and skip the slots; `"stop"` at the first |
//! | `max_skip` | `10` | more than so many slots skipped in a row are a stop |
//! | `realtime` | `"prefer"` | `"require"` refuses to start without the rights, `"off"` is an ordinary thread |
//! | `memory` | `"process"` | what is locked: the whole process, or the loop's `"own"` |
//! | `task_budget` | none | longest the in-loop task may run |
//! | `heartbeat` | none | longest the application may be silent while an axis is enabled; longer stops all that are |
//! | `late` | a tenth of the period | a cycle that begins later than this after its grid point, or spends longer in a stage, is counted as late, with its cause |
//! | `black_box` | `"2s"` | how much of the past is kept, and written to a file at a fault or a lost drive |
//!
//! `[[bus]]`: `protocol`, `name` (default: the protocol), the keys of the protocol, `[bus.defaults]`, and one
//! `[[bus.drive]]` a drive. **What stands in `[bus.defaults]` holds for every drive of this bus that does not say
//! otherwise**, sub-tables key by key; `name` and `address` are each drive's own.
//!
//! `[[bus.drive]]`, lengths in the drive's units:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `name` | - | unique in the machine |
//! | `address` | - | see the protocol |
//! | `units` | `"mm"` | `"mm"` or `"rev"` |
//! | `scale` | the protocol's, for mm | drive counts in one unit; LinUDP 10000 a mm |
//! | `invert` | `false` | turn the direction round |
//! | `offset` | `0` | position of the drive's count zero |
//! | `modulo` | none | length of one turn of a rotary axis |
//! | `limits.position` | none | `[lowest, highest]` |
//! | `limits.velocity`, `limits.acceleration` | none | units/s, units/s² |
//! | `limits.step` | none | largest distance between two streamed rows |
//! | `profile.velocity` | `100` mm/s, `1` rev/s | of moves that name none; at most the limit |
//! | `profile.acceleration` | `1000` mm/s², `10` rev/s² | at most the limit |
//! | `profile.deceleration` | `profile.acceleration` | |
//! | `divisor`, `phase` | `1`, `0` | an exchange every so many cycles, in which of them |
//! | `health.bucket` | `5` | so many misses in a row are a lost link |
//! | `health.leak` | `20` | so many good exchanges in a row outweigh one miss |
//! | `health.gate` | `10` | so many good exchanges in a row bring a link up |
//! | `health.probe_interval` | `"100ms"` | how often an absent drive is asked |
//! | `stop.how` | `"ramp"` | or the drive's own `"quick"` stop, or `"coast"` |
//! | `stop.deceleration` | `profile.deceleration` | of the ramp; may be more than the limit |
//! | `stop.then` | `"disable"` | power off at standstill, or `"hold"` (default where `held_by = "drive"`) |
//! | `stop.timeout` | `"3s"` | longest time to standstill |
//! | `stop.on_timeout` | `"disable"` | without standstill by then: power off, or `"hold"` (default as above) |
//! | `stop.standstill` | `5` mm/s, `0.05` rev/s | slower than this ... |
//! | `stop.standstill_for` | `20` | ... for so many good exchanges |
//! | `stop.group` | none | drives that name the same group stop together |
//! | `load` | `"level"` | `"vertical"`: the load drops when nothing holds it |
//! | `held_by` | - | what holds a vertical load: the drive's `"brake"`, or the powered `"drive"` alone, which is then never powered off |
//! | `setpoint_age` | `10` | cycles; a cyclic velocity setpoint that is older stops the axis |
//! | `jog_deadman` | `"500ms"` | a jog that is not renewed for so long is stopped; `"off"`: it runs until replaced |
//! | `underrun` | `"stop"` | what an empty stream does: or `"hold"`, or `{ extrapolate = n }` exchanges |
//! | `on_found_running` | `"stop"` | a drive found enabled: stop it, or `"refuse"` to touch it |
//! | `enable_timeout` | `"5s"` | longest time for Enable, Disable, ResetFault |
//! | `home_timeout` | `"60s"` | longest time for Home |
//! | `command_queue`, `stream_queue`, `event_queue` | `64`, `1024`, `256` | room in entries |
//! | `parameter_queue` | `64` | room for acyclic calls |
//! | `sample_queue` | `0` | room for the feedback of every cycle; 0 keeps only the newest |
//!
//! `[[group]]`, axes that act together: `name`, and `axes`, the names of its drives in the order of its rows. They share divisor,
//! phase and stop group.
//!
//! `protocol = "linudp-v2"`:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `bind` (bus) | - | the adapter's own address, `"192.168.1.1"` or with another port than 41136 |
//! | `send` (bus) | `"batch"` | one system call for all requests, or one `"each"` with its own stamp |
//! | `address` | - | `"192.168.1.10"` or with another port than 49360 |
//! | `stream` | `"pva"` if the period fits, else `"off"` | [command](crate::bus::linudp::StreamCommand) of streamed motion |
//! | `monitor` | `false` | ask for the monitoring channels too: up to four [variables](crate::bus::linudp::upid::KNOWN) by name or UPID, to which the drive is set (in RAM) whenever it comes online; `true`: whatever is set in the drive |
//! | `reply_tag` | `false` | number the requests through the parameter channel |
//! | `no_drive_watchdog` | `"refuse"` | jogs and cyclic velocities are refused, or `"accept"`ed with a `leash` |
//! | `leash` | - | how far these run ahead, and on if the master dies; at most the range |
//! | `simulate` | below | the drive when it is simulated |
//!
//! `simulate`:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `seed` | `0` | of the random faults; each drive adds its place in the file |
//! | `drop`, `duplicate`, `corrupt`, `delay`, `reorder`, `stall`, `restart`, `inhibit`, `wrong_id` | `0` | how likely a datagram meets this fault, 0 ... 1; `inhibit` opens the hardware enable (STO) |
//! | `delay_by` | one period of the drive | how much later a delayed datagram comes |
//! | `stall_for` | `"100ms"` | how long a stalled drive is silent |
//! | `inhibit_for` | `"100ms"` | how long the hardware enable stays open |
//! | `answer_time` | `"0us"` | from a request to its answer |
//! | `padding` | `14` | shortest payload, bytes: `0`, `14` or `64` |
//! | `filter` | `"none"` | which masters it answers: all, a `"single"` one, or the one with this address |
//! | `range` | `limits.position` and 5 units more, else 1000 units both ways | mechanical range |
//! | `home` | `0`, or the low end of the range | where the home switch is |
//! | `start` | the middle of the range | position at power-on |
//! | `mass` | `1` | kg |
//! | `stream_period` | one period of the drive | set in the drive for the configured streaming commands |
//! | `stream_patience` | `2.5` | periods without a setpoint before a stream ends in error 0083h |
//! | `stream_depth` | `8` | setpoints that a stream holds; one more ends it in error 0082h |
//! | `force_enable_bits` | `false` | bits 1-5 of the control word are forced to 1 |
//! | `running` | `false` | comes up enabled and moving, as if another master had died |
//! | `config_time` | `"0us"` | how long a command on the parameter channel takes; "busy" is answered meanwhile |
//! | `flash_time` | `"500ms"` | how long a save into flash takes, a single parameter a 500th of it; real drives took 39 ... 75 s |
//! | `flash` | `"silent"` | answers nothing while it saves; `"mute"`: nor says afterwards how it went; `"busy"`: answers that it is |
//! | `unknown_commands` | `"refuse"` | error 0081h at a motion command that it has no use for; `"ignore"` |
//! | `extend_sign` | `false` | values of less than 32 bits carry their sign in the bits above |

mod cycle;
mod describe;
mod drive;
mod error;
pub mod linmot_curve;
pub mod linmot_table;
mod linudp;
mod reader;
mod value;

use std::collections::HashMap;
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::{Path, PathBuf};
use std::time::Duration;

pub use cycle::starvation;
pub use describe::{describe, stop_bound_cycles};
pub use error::{ConfigError, ConfigErrors};

use crate::bus::BusPlan;
use crate::cycle::{GroupPlan, Plan};
use crate::time::US;
use reader::{Page, Place, Table};

/// The sample that runs everywhere, without privileges or hardware.
const DEMO: &str = include_str!("../../rt-config/demo.toml");
/// Where it stands, for messages.
const DEMO_FILE: &str = "rt-config/demo.toml";

/// Reads the configuration at `path`.
pub fn load(path: impl AsRef<Path>) -> Result<Plan, ConfigErrors> {
    let (file, text) = read(path.as_ref(), "an existing configuration, for example rt-config/demo.toml")?;
    parse(&text, &file)
}

/// A file's name and text; `kind` says what kind of file it should be, with an example.
fn read(path: &Path, kind: &str) -> Result<(String, String), ConfigErrors> {
    let file = path.display().to_string();
    let bytes = std::fs::read(path).map_err(|error| unreadable(&file, &error, kind))?;
    match String::from_utf8(bytes) {
        Ok(text) => Ok((file, text)),
        Err(error) => {
            let valid = &error.as_bytes()[..error.utf8_error().valid_up_to()];
            let line = valid.iter().filter(|byte| **byte == b'\n').count() + 1;
            Err(whole_file(&file, Some(line), "not UTF-8; save the file as UTF-8 text".into()))
        }
    }
}

/// Reads the configuration `text`; messages call it `file`.
pub fn parse(text: &str, file: &str) -> Result<Plan, ConfigErrors> {
    let page = Page::new(file, text);
    let entries = page.parse()?;
    let plan = machine(Table::root(&page, &entries));
    page.verdict()?;
    Ok(Plan { source: Some(PathBuf::from(file)), ..plan })
}

/// A time as people write it, on the command line as in a file: `"250us"`, `"0.5s"`, `"8h"`.
pub fn duration(text: &str) -> Result<Duration, String> {
    let ns = value::duration(text);
    ns.map(Duration::from_nanos)
        .ok_or_else(|| "write a number with its unit: ns, us, ms, s, min or h, for example 10s".into())
}

/// The demo with so many drives, 1 ... 128, and this period.
pub fn demo_plan(drives: usize, period_ns: u64) -> Result<Plan, ConfigErrors> {
    if !(1..=128).contains(&drives) {
        return Err(whole_file(DEMO_FILE, None, format!("{drives} drives: the demo has 1 to 128")));
    }
    parse(&demo_text(drives, period_ns), DEMO_FILE)
}

/// The demo's file up to its first drive, with the period replaced, and then as many drives as wanted: all that they
/// share stands in `[bus.defaults]`. In a cycle too fast for its streaming command a drive is due every few cycles only.
fn demo_text(drives: usize, period_ns: u64) -> String {
    let head = DEMO.split("[[bus.drive]]").next().unwrap_or(DEMO);
    let divisor = (400 * US).div_ceil(period_ns.max(50 * US));
    let mut text = head
        .replace("period = \"1ms\"", &format!("period = \"{period_ns}ns\""))
        .replace("[bus.defaults]", &format!("[bus.defaults]\ndivisor = {divisor}"));
    for drive in 1..=drives {
        text += &format!("[[bus.drive]]\nname = \"a{drive}\"\naddress = \"127.77.0.{}\"\n\n", drive + 10);
    }
    text
}

fn unreadable(file: &str, error: &io::Error, kind: &str) -> ConfigErrors {
    let reason = match error.raw_os_error() {
        Some(number) => nix::errno::Errno::from_raw(number).desc().to_owned(),
        None => error.to_string(),
    };
    let remedy = match error.kind() {
        io::ErrorKind::PermissionDenied => "let this user read it".to_owned(),
        _ => format!("name {kind}"),
    };
    whole_file(file, None, format!("cannot read {file}: {reason}; {remedy}"))
}

fn whole_file(file: &str, line: Option<usize>, message: String) -> ConfigErrors {
    ConfigError { file: file.to_owned(), line, key: None, value: None, message }.into()
}

fn machine(mut root: Table<'_>) -> Plan {
    let cycle = root.table("cycle", cycle::cycle);
    let mut machine = Machine::default();
    if !root.gives("bus") {
        root.fault("bus", "missing; a machine needs a [[bus]] with at least one [[bus.drive]]");
    }
    let mut buses: Vec<Box<dyn BusPlan>> = Vec::new();
    for mut table in root.tables("bus") {
        table.require("protocol", "\"linudp-v2\" is LinMot LinUDP V2");
        // One word a protocol; the next one is one line more.
        let read = table.word("protocol", &[(crate::bus::linudp::PROTOCOL, linudp::bus)]);
        if let Some(read) = read {
            buses.push(Box::new(read(&mut table, &mut machine, &cycle)));
            table.finish();
        }
    }
    machine.check_groups(&root);
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

/// A `[[group]]`: axes that act together.
fn group(table: &mut Table<'_>, plan: &Plan) -> Option<GroupPlan> {
    table.require("name", "how programs ask for it");
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
    drives: HashMap<String, Place>,
    buses: HashMap<String, Place>,
    addresses: HashMap<Ipv4Addr, (SocketAddrV4, Place)>,
    binds: Vec<(SocketAddrV4, Place)>,
    /// Stop groups by id, with their members.
    groups: Vec<(String, Vec<Place>)>,
}

impl Machine {
    fn claim_name(&mut self, table: &Table<'_>, name: &str) {
        if name.is_empty() {
            return; // Missing or wrong, and already reported.
        }
        if let Some(first) = self.drives.get(name) {
            table.fault("name", format!("is the drive of {first} already; names are unique in the machine"));
        } else {
            self.drives.insert(name.to_owned(), table.place("name"));
        }
    }

    /// The bus' name, or its protocol's where it has none.
    fn bus_name(&mut self, table: &mut Table<'_>, protocol: &str) -> String {
        let name = table.text("name", "1 to 32 letters, digits, - _ or .", drive::plain_name);
        let name = name.unwrap_or_else(|| protocol.to_owned());
        match self.buses.get(&name) {
            Some(first) if table.gives("name") => {
                table
                    .fault("name", format!("is the bus of {first} already; names are unique in the machine"));
            }
            Some(first) => {
                table.fault("name", format!("missing; the bus of {first} is called {name} already"));
            }
            None => {
                self.buses.insert(name.clone(), table.place("name"));
            }
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
                format!("is taken by the bus of {first}; one bus an address, put its drives there"),
            );
        }
        if let Some((_, drive)) = self.addresses.get(bind.ip()).filter(|(address, _)| *address == bind) {
            table.fault("bind", format!("is the drive of {drive}; give the master's own address"));
        }
        self.binds.push((bind, table.place("bind")));
    }

    /// A drive that is told from the others by its IP address.
    fn claim_address(&mut self, table: &Table<'_>, address: SocketAddrV4) {
        if let Some((_, first)) = self.binds.iter().find(|(bind, _)| *bind == address) {
            table.fault("address", format!("is the master's own, bind of {first}; give the drive's"));
        } else if let Some((_, first)) = self.addresses.get(address.ip()) {
            table.fault("address", format!("is the drive of {first} already; one drive an IP address"));
        } else {
            self.addresses.insert(*address.ip(), (address, table.place("address")));
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
        let built = demo_plan(8, 1_000_000).unwrap();
        assert_eq!(format!("{sample:?}"), format!("{built:?}"));
    }
}
