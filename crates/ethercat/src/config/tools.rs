//! `fieldbeat ethercat`: the slaves of an EtherCAT segment.

use std::fmt::Write;
use std::io;

use clap::{Args, Subcommand};
use serde_json::{Value, json};

use crate::scan::{Errors, Information, Options, ScanError, Slave, Unread, scan};
use crate::wire::frame::ETHERTYPE;
use crate::wire::sii::Protocols;
use fieldbeat_core::net::frames::Unsent;
use fieldbeat_core::net::{Carriers, Frames, Os, Place};
use fieldbeat_core::rt::rights::grant;
use fieldbeat_tools::{Program, Stop, Tool, arguments, table};

/// The commands that this protocol adds.
pub const TOOLS: &[Tool] = &[Tool {
    name: "ethercat",
    about: "The slaves of an EtherCAT segment",
    subcommands: Ethercat::augment_subcommands,
    run: |matches, program| match arguments(matches)? {
        Ethercat::Scan(scan) => scan.run(program),
    },
}];

#[derive(Debug, Subcommand)]
enum Ethercat {
    /// Lists the slaves of a segment with their states and the content of their SII; changes nothing.
    Scan(Scan),
}

#[derive(Debug, Args)]
struct Scan {
    /// The network interface, for example eth1.
    interface: String,
    /// Also read the SII of slaves in SAFEOP and OP, and of those whose processor owns it.
    #[arg(long)]
    sii: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Scan {
    fn run(self, program: &dyn Program) -> Result<(), Stop> {
        let interface = &self.interface;
        // Next to a master of this host it would read while that one writes.
        let _lock =
            Place::Interface(interface).lock().map_err(|why| Stop::usage(format!("{interface} {why}")))?;
        let mut frames = open(interface)?;
        let options = Options { sii: self.sii };
        let slaves = scan(&mut *frames, options, &|| !program.is_interrupted())
            .map_err(|error| failed(&self.interface, error))?;
        if self.json {
            let slaves: Vec<Value> = slaves.iter().map(object).collect();
            program.print(&json!({ "interface": self.interface, "slaves": slaves }))
        } else {
            program.print(&text(&slaves))
        }
    }
}

/// The frames of an interface; the error says what is missing, and how to get it.
pub(super) fn open(interface: &str) -> Result<Box<dyn Frames>, Stop> {
    Os::default().frames(interface, ETHERTYPE).map_err(|error| {
        Stop::usage(match error.kind() {
            io::ErrorKind::PermissionDenied => {
                let granting = grant("cap_sys_nice,cap_ipc_lock,cap_net_raw");
                format!(
                    "no right for raw frames on {interface} (CAP_NET_RAW); grant it: {granting}, or use sudo"
                )
            }
            io::ErrorKind::NotFound | io::ErrorKind::InvalidInput => error.to_string(),
            _ => format!(
                "cannot open {interface} for EtherCAT: {error}; ip link shows which interfaces there are"
            ),
        })
    })
}

pub(super) fn failed(interface: &str, error: ScanError) -> Stop {
    Stop::failed(match error {
        // Not every driver says so itself, and the kernel may take a second to.
        ScanError::Unsent(_) | ScanError::Silent if is_unplugged(interface) => {
            format!("{interface}: no cable, or nothing with power at its other end; plug it in")
        }
        ScanError::Unsent(Unsent::Down) if interface.starts_with("local:") => {
            format!("{interface}: nothing serves this segment; start it: fieldbeat sim CONFIG")
        }
        ScanError::Unsent(Unsent::Down) => {
            format!("{interface}: the interface is down; set it up: sudo ip link set {interface} up")
        }
        other => format!("{interface}: {other}"),
    })
}

/// It is up, and has no cable. Of one that is down nothing can be read there.
fn is_unplugged(interface: &str) -> bool {
    let carrier = std::fs::read_to_string(format!("/sys/class/net/{interface}/carrier"));
    carrier.is_ok_and(|carrier| carrier.trim() == "0")
}

/// The table, and below it what stands in no column.
fn text(slaves: &[Slave]) -> String {
    const HEAD: [&str; 14] = [
        "place", "station", "state", "name", "vendor", "product", "revision", "serial", "mailbox", "out",
        "in", "clock", "links", "FMMU/SM",
    ];
    let mut text = table(HEAD, slaves.iter().map(row));
    for slave in slaves {
        for note in notes(slave) {
            let _ = write!(text, "\nplace {}: {note}", slave.place);
        }
    }
    text
}

fn row(slave: &Slave) -> [String; 14] {
    let number = |number: u32| format!("{number:#010x}");
    let none = || "-".to_owned();
    let sii = slave.sii.as_ref().ok();
    let of = |read: fn(&Information) -> u32| sii.map_or_else(none, |sii| number(read(sii)));
    let (outputs, inputs) = slave.process_data();
    [
        slave.place.to_string(),
        format!("{:#06x}", slave.station),
        state(slave),
        sii.map(|sii| sii.name.clone()).filter(|name| !name.is_empty()).unwrap_or_else(none),
        of(|sii| sii.identity.vendor),
        of(|sii| sii.identity.product),
        of(|sii| sii.identity.revision),
        of(|sii| sii.serial),
        sii.map_or_else(none, mailbox),
        outputs.to_string(),
        inputs.to_string(),
        clock(slave).map_or_else(none, |bits| format!("{bits} bit")),
        links(slave),
        format!("{}/{}", slave.fmmus.len(), slave.managers.len()),
    ]
}

fn state(slave: &Slave) -> String {
    let status = slave.status;
    let name = status.state().map_or_else(|| format!("{:#04x}", status.0 & 0x0F), |state| state.to_string());
    name + if slave.has_error() { " error" } else { "" }
}

/// What is spoken there, and the bytes of both.
fn mailbox(sii: &Information) -> String {
    let Some([out, input]) = sii.mailbox else { return "-".to_owned() };
    let sizes = if out.length == input.length {
        out.length.to_string()
    } else {
        format!("{}/{}", out.length, input.length)
    };
    format!("{} {sizes}", protocols(sii.protocols).join(","))
}

fn protocols(protocols: Protocols) -> Vec<&'static str> {
    let names = ["AoE", "EoE", "CoE", "FoE", "SoE", "VoE"];
    names
        .into_iter()
        .enumerate()
        .filter(|(bit, _)| protocols.0 >> bit & 1 != 0)
        .map(|(_, name)| name)
        .collect()
}

/// Its bits.
fn clock(slave: &Slave) -> Option<u8> {
    slave.features.has_clock().then_some(if slave.features.has_long_clock() { 64 } else { 32 })
}

/// The ports with a link; a link that frames do not take is in brackets.
fn links(slave: &Slave) -> String {
    let port = |port: u8| if slave.links.open(port) { port.to_string() } else { format!("({port})") };
    let ports: Vec<String> = (0..4).filter(|n| slave.links.link(*n)).map(port).collect();
    ports.join(" ")
}

/// What stands in no column.
fn notes(slave: &Slave) -> Vec<String> {
    let mut notes = Vec::new();
    if slave.alias != 0 {
        notes.push(format!("station alias {}", slave.alias));
    }
    if slave.has_error() || slave.code.0 != 0 {
        notes.push(format!("AL status code {}", slave.code));
    }
    if let Some(cycle) = slave.sync0_ns {
        notes.push(format!("SYNC0 every {} us", f64::from(cycle) / 1e3));
    }
    match &slave.sii {
        Ok(sii) => {
            if !sii.sound {
                notes.push("its SII is blank or damaged: the checksum is wrong".to_owned());
            }
            let (outputs, inputs) = sii.process_data();
            if (outputs, inputs) != (0, 0) && (outputs, inputs) != slave.process_data() {
                notes.push(format!("by default {outputs} bytes of outputs, {inputs} of inputs"));
            }
        }
        Err(Unread::InUse) => notes.push("SII not read in this state; --sii reads it".to_owned()),
        Err(Unread::Owned) => notes.push("SII owned by the slave's processor; --sii takes it".to_owned()),
        Err(why) => notes.push(format!("SII not read: {why}")),
    }
    notes.extend(counted(&slave.errors));
    notes
}

/// Error counters that are not zero.
fn counted(errors: &Errors) -> Vec<String> {
    let ports = [
        (errors.invalid, "invalid frames"),
        (errors.physical, "physical errors"),
        (errors.forwarded, "forwarded errors"),
        (errors.lost_links, "lost links"),
    ];
    let by_port = ports.into_iter().flat_map(|(counts, what)| {
        let counts = counts.into_iter().enumerate().filter(|(_, count)| *count > 0);
        counts.map(move |(port, count)| format!("port {port}: {} {what}", shown(count)))
    });
    let others = [(errors.processing, "malformed frames"), (errors.processor, "errors of its processor")];
    let others = others.into_iter().filter(|(count, _)| *count > 0);
    by_port.chain(others.map(|(count, what)| format!("{} {what}", shown(count)))).collect()
}

/// The counters stop at their end.
fn shown(count: u8) -> String {
    if count == u8::MAX { "255 or more".to_owned() } else { count.to_string() }
}

/// A slave as JSON.
fn object(slave: &Slave) -> Value {
    let (outputs, inputs) = slave.process_data();
    let ports: Vec<Value> = (0..4)
        .map(|port| json!({ "link": slave.links.link(port), "open": slave.links.open(port) }))
        .collect();
    let Errors { invalid, physical, forwarded, processing, processor, lost_links } = slave.errors;
    json!({
        "place": slave.place,
        "station": slave.station,
        "alias": slave.alias,
        "state": slave.status.state().map(|state| state.to_string()),
        "error": slave.has_error(),
        "emulated": slave.emulated,
        "al_status": slave.status.0,
        "al_status_code": slave.code.0,
        "al_status_text": slave.code.name(),
        "outputs": outputs,
        "inputs": inputs,
        "clock_bits": clock(slave),
        "sync0_ns": slave.sync0_ns,
        "ports": ports,
        "fmmus": slave.fmmus.len(),
        "fmmus_active": slave.fmmus.iter().filter(|fmmu| fmmu.active).count(),
        "sync_managers": slave.managers.len(),
        "errors": {
            "invalid": invalid, "physical": physical, "forwarded": forwarded,
            "processing": processing, "processor": processor, "lost_links": lost_links,
        },
        "sii": slave.sii.as_ref().ok().map(sii),
        "sii_unread": slave.sii.as_ref().err().map(Unread::to_string),
    })
}

fn sii(sii: &Information) -> Value {
    let (outputs, inputs) = sii.process_data();
    json!({
        "sound": sii.sound,
        "name": sii.name,
        "vendor": sii.identity.vendor,
        "product": sii.identity.product,
        "revision": sii.identity.revision,
        "serial": sii.serial,
        "mailbox": sii.mailbox.map(|[out, input]| json!({
            "out": { "start": out.start, "bytes": out.length },
            "in": { "start": input.start, "bytes": input.length },
            "protocols": protocols(sii.protocols),
        })),
        "outputs": outputs,
        "inputs": inputs,
    })
}
