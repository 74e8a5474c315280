//! The serial port of a bus: its driver, what it delays, and on which cores it is served.
//!
//! Received bytes reach a program in two steps: the interrupt of the UART, or of the USB host controller, puts them
//! into a buffer, and a worker of the kernel (system_unbound_wq) takes them from there (tty_flip_buffer_push() and
//! flush_to_ldisc() in drivers/tty/tty_buffer.c).
//!
//! Sources: Documentation/ABI/testing/sysfs-tty, Documentation/core-api/workqueue.rst, drivers/usb/serial/ftdi_sio.c.

use super::Subject;
use super::core::others;
use super::facts::{Facts, Root};
use super::finding::{Finding, list, write};
use super::interrupts::{Served, numbers};
use super::tty::Untried;
use super::way::Port;
use fieldbeat_core::cycle::{Plan, Wait};
use fieldbeat_core::net::tty::{Tried, is_near};
use fieldbeat_core::net::{Rs485, local};
use fieldbeat_core::rt::Realtime;
use fieldbeat_core::time::{Ns, US};

/// All of them, for each port.
pub(super) fn check(facts: &Facts, subject: &Subject) -> Vec<Finding> {
    subject.ports.iter().flat_map(|port| of_port(facts, port, subject)).collect()
}

/// Why a port of this plan gets no byte on this host while the loop spins, and what to do about it; `None` if it does.
pub fn blocked(plan: &Plan) -> Option<String> {
    let subject = Subject::of(plan);
    subject.ports.iter().find_map(|port| blocked_port(&Root("/".into()), port, &subject))
}

type Outcome = Result<Tried, Untried>;

fn of_port(facts: &Facts, port: &Port, subject: &Subject) -> Vec<Finding> {
    let (root, tried) = (&facts.root, facts.probes.port(&port.path));
    let (presence, name) = presence(root, port, tried);
    let Some(name) = name else { return vec![presence] };
    let served = served(root, port, &name);
    let mut findings = vec![presence, rate(root, port, &name, tried), direction(port, tried)];
    findings.extend(latency_timer(root, port, &name));
    findings.extend(trigger(root, port, &name));
    // A device whose interrupt is not known is not one without.
    if served.interrupts.is_empty() && root.has(&format!("sys/class/tty/{name}/device")) {
        let finding = Finding::network(&port.bus, "interrupts", "on other cores", served.why);
        findings.push(finding.unknown("no file says which one is this port's: see /proc/interrupts"));
    } else {
        findings.extend([served.affinity(root, subject), served.threads(root, subject)]);
    }
    findings.extend([worker(root, port, subject), window(root, port, subject)]);
    findings
}

/// The finding, and the kernel's name of the port if there is more to say of it.
fn presence(root: &Root, port: &Port, tried: Option<&Outcome>) -> (Finding, Option<String>) {
    let path = &port.path;
    let finding = Finding::network(
        &port.bus,
        "serial port",
        &format!("{path}, for the master alone"),
        "the telegrams of the bus leave and return through it",
    );
    if local::name(path).is_some() {
        return (finding.good("on this computer: simulated, nothing to tune"), None);
    }
    let Some(name) = name_of(root, path) else {
        let remedy = "plug in its adapter; `ls -l /dev/serial/by-id` lists those that are there";
        return (finding.bad(format!("no port {path}")).advise(remedy), None);
    };
    let found =
        [Some(name.clone()), driver(root, &name)].into_iter().flatten().collect::<Vec<_>>().join(", ");
    let finding = match tried {
        _ if root.get(&format!("sys/class/tty/{name}/console")).as_deref() == Some("Y") => {
            finding.bad(format!("{found}; the kernel writes its messages there")).fix(
                format!("remove console={name} from the kernel command line, restart"),
                format!("put console={name} back"),
            )
        }
        Some(Err(Untried::InUse(who))) => finding
            .poor(format!("{found}; in use by {who}"))
            .advise("end it, unless it is the master of this plan"),
        Some(Err(Untried::Refused(error))) if error.kind() == std::io::ErrorKind::PermissionDenied => {
            finding.bad(format!("{found}; this user may not use it")).fix(
                "sudo usermod -aG dialout USER, and log in again\n(`ls -l` shows its group)",
                "sudo gpasswd -d USER dialout",
            )
        }
        _ => finding.good(found),
    };
    (finding, Some(name))
}

/// The kernel's name of port `path`, if it is there: `ttyUSB0` for `/dev/serial/by-id/usb-...`.
fn name_of(root: &Root, path: &str) -> Option<String> {
    root.resolved(path)?.file_name()?.to_str().map(str::to_owned)
}

/// The directories of the port's device and of what it is plugged into, the nearest first.
fn above(root: &Root, name: &str) -> Vec<String> {
    let (Some(top), Some(device)) =
        (root.resolved(""), root.resolved(&format!("sys/class/tty/{name}/device")))
    else {
        return Vec::new();
    };
    let inside = device.ancestors().filter_map(|directory| directory.strip_prefix(&top).ok()?.to_str());
    inside.take_while(|directory| directory.starts_with("sys/devices/")).map(str::to_owned).collect()
}

/// Above a UART there are, from Linux 6.5 on, two devices without a driver of their own
/// (drivers/tty/serial/serial_base_bus.c).
fn driver(root: &Root, name: &str) -> Option<String> {
    let mut drivers =
        above(root, name).into_iter().filter_map(|device| root.link(&format!("{device}/driver")));
    drivers.find(|driver| driver != "port" && driver != "ctrl")
}

/// The interrupts that serve the port: the UART's, or those of the host controller that it is plugged into.
fn served<'a>(root: &Root, port: &'a Port, name: &str) -> Served<'a> {
    let number = |path: String| root.get(&path)?.parse().ok().filter(|irq: &u32| *irq > 0);
    let of_device = |device: &String| {
        let messages = root.names(&format!("{device}/msi_irqs"));
        let all: Vec<u32> = messages.iter().filter_map(|irq| irq.parse().ok()).collect();
        if all.is_empty() { number(format!("{device}/irq")).into_iter().collect() } else { all }
    };
    let devices = above(root, name);
    let mut interrupts = Vec::from_iter(number(format!("sys/class/tty/{name}/irq")));
    if interrupts.is_empty() {
        interrupts = devices.iter().map(of_device).find(|all| !all.is_empty()).unwrap_or_default();
    }
    if interrupts.is_empty() {
        // A host controller that is no PCI device: `dwc2_hsotg:usb1` in the last column.
        let has = |bus: &str| devices.iter().any(|device| device.rsplit('/').next() == Some(bus));
        let is_bus =
            |last: &str| last.rsplit_once(':').is_some_and(|(_, bus)| bus.starts_with("usb") && has(bus));
        let table = root.get("proc/interrupts").unwrap_or_default();
        let lines = table.lines().filter(|line| line.split_whitespace().last().is_some_and(is_bus));
        interrupts = lines.filter_map(|line| line.trim().split(':').next()?.parse().ok()).collect();
    }
    interrupts.retain(|irq| root.has(&format!("proc/irq/{irq}")));
    Served {
        bus: &port.bus,
        interrupts,
        why: "otherwise received bytes interrupt the loop's core, or wait for it where threads handle \
             interrupts",
        none: "no real port",
    }
}

fn rate(root: &Root, port: &Port, name: &str, tried: Option<&Outcome>) -> Finding {
    let wanted = port.line.rate;
    let finding = Finding::network(
        &port.bus,
        "rate",
        &format!("{wanted} bit/s, 0.3 % off at most"),
        "the stations read the bits of each other by their own clocks",
    );
    if let Some(divided) = divided(root, name, wanted).filter(|rate| !is_near(wanted, *rate)) {
        return finding
            .poor(format!("its clock divides to {divided} bit/s, whatever its driver reports"))
            .advise("another port or rate, unless this UART also divides by fractions");
    }
    match tried {
        Some(Ok(Tried { refused: Some(why), .. })) => {
            finding.bad(why.clone()).advise("use another adapter, or a rate that this one supports")
        }
        Some(Ok(Tried { rate, .. })) => finding.good(format!("{rate} bit/s set and read back")),
        Some(Err(Untried::InUse(_))) => finding.unknown("the port is in use, and is not disturbed"),
        Some(Err(Untried::Hidden)) => {
            finding.unknown("this user does not see whether somebody uses the port: run the doctor as root")
        }
        Some(Err(Untried::Refused(error))) => finding.unknown(error.to_string()),
        None => finding.unknown("the port was not tried"),
    }
}

/// The rate that a plain UART makes of `wanted`: its clock by 16 and by a whole number. Its driver reports the wanted
/// one in any case (serial8250_do_set_termios()).
fn divided(root: &Root, name: &str, wanted: u32) -> Option<u32> {
    let number = |file: &str| root.get(&format!("sys/class/tty/{name}/{file}"))?.parse::<u32>().ok();
    // PORT_8250 ... PORT_16550A (linux/serial_core.h).
    number("type").filter(|kind| (1..=4).contains(kind))?;
    let most = number("uartclk").filter(|clock| *clock > 0)? / 16;
    Some(most / most.saturating_add(wanted / 2).checked_div(wanted)?.max(1))
}

fn direction(port: &Port, tried: Option<&Outcome>) -> Finding {
    let by_driver = port.line.rs485 == Rs485::Driver;
    let finding = Finding::network(
        &port.bus,
        "RS-485 direction",
        if by_driver { "switched by the driver" } else { "switched by the adapter" },
        "a transceiver that goes on sending cuts off the answer, and one that never sends leaves the wire \
         silent",
    );
    match tried {
        _ if !by_driver => finding.good("by the adapter, as configured"),
        Some(Ok(Tried { switches: true, .. })) => finding.good("by the driver (TIOCSRS485)"),
        Some(Ok(_)) => finding
            .bad("its driver cannot (TIOCSRS485)")
            .advise("rs485 = \"adapter\", if the adapter switches by itself; else use another one"),
        _ => finding.unknown("the port was not tried"),
    }
}

/// FTDI adapters hold back what is less than 62 bytes.
fn latency_timer(root: &Root, port: &Port, name: &str) -> Option<Finding> {
    let path = format!("sys/bus/usb-serial/devices/{name}/latency_timer");
    let before = root.get(&path)?;
    let finding = Finding::network(
        &port.bus,
        "latency timer",
        "1 ms",
        "the adapter hands over the end of a telegram only after this time; the master requests 1 ms when it \
         opens the port, which not every driver grants",
    );
    Some(match before == "1" {
        true => finding.good("1 ms"),
        false => finding.poor(format!("{before} ms")).fix(write(1, &path), write(&before, &path)),
    })
}

/// With bytes of this length or longer, an interrupt for each costs little.
const LONG_BYTE_NS: u64 = 20 * US;

/// A UART reports a few bytes at the end of a telegram only when nothing has followed for the time of 4 more.
fn trigger(root: &Root, port: &Port, name: &str) -> Option<Finding> {
    let path = format!("sys/class/tty/{name}/rx_trig_bytes");
    let before = root.get(&path)?;
    let wait = Ns(port.line.span_ns(4));
    let finding = Finding::network(
        &port.bus,
        "receive trigger",
        "1 byte, where bytes take 20 us or longer",
        "below its trigger the UART waits for the time of 4 more bytes before it reports the end of a \
         telegram",
    );
    Some(match before == "1" || port.line.span_ns(1) < LONG_BYTE_NS {
        true => finding.good(format!("{before} bytes; the end of a telegram waits for {wait} at most")),
        false => finding
            .poor(format!("{before} bytes: the end of a telegram waits for {wait}"))
            .fix(write(1, &path), write(&before, &path)),
    })
}

/// Where the workers of the kernel may run that no core is named for. One for ports alone can only have fewer.
const WORKERS: &str = "sys/devices/virtual/workqueue/cpumask";

fn worker(root: &Root, port: &Port, subject: &Subject) -> Finding {
    let core = subject.core;
    let mut finding = Finding::network(
        &port.bus,
        "workers",
        &format!("on other cores than {core}"),
        "one of them hands received bytes to the loop: a normal thread, which never runs under a loop that \
         spins on its core",
    );
    let Some(mask) = finding.read(root, WORKERS) else { return finding };
    let Some(cores) = cores_of_mask(&mask) else { return finding.unknown(format!("/{WORKERS} says {mask}")) };
    if !cores.contains(&core) {
        return finding.good(format!("on {}", list(&cores)));
    }
    let finding = finding.poor(format!("on {}, which has core {core}", list(&cores)));
    match moved(root, core) {
        Some(away) => finding.fix(away, write(mask, WORKERS)),
        None => finding.advise("no setting helps: this is the only core"),
    }
}

/// The command that keeps the workers off `core`.
fn moved(root: &Root, core: usize) -> Option<String> {
    let away = others(root, core);
    (!away.is_empty()).then(|| write(mask_of(&away), WORKERS))
}

fn window(root: &Root, port: &Port, subject: &Subject) -> Finding {
    let finding = Finding::network(
        &port.bus,
        "receive window",
        "it sleeps, or other cores serve the port",
        "what serves a port has no time on a core whose loop spins",
    );
    match blocked_port(root, port, subject) {
        Some(_) => finding
            .bad(format!("the loop spins on core {}, which serves the port", subject.core))
            .advise("wait = \"poll\" in [cycle]\nor what is said of interrupts and workers above"),
        None if subject.cycle.wait == Wait::Poll => finding.good("it sleeps"),
        None => finding.good("it spins, and other cores serve the port, as far as is known"),
    }
}

/// Why a spinning loop gets nothing from `port`. What is not known is no reason.
fn blocked_port(root: &Root, port: &Port, subject: &Subject) -> Option<String> {
    let spins = subject.cycle.wait == Wait::Spin && subject.cycle.realtime != Realtime::Off;
    if !spins || local::name(&port.path).is_some() {
        return None;
    }
    let core = subject.core;
    let name = root.resolved(&port.path).and_then(|device| Some(device.file_name()?.to_str()?.to_owned()));
    let interrupts = name
        .and_then(|name| served(root, port, &name).on(root, core).ok())
        .filter(|on_core| !on_core.is_empty());
    let works_here =
        root.get(WORKERS).and_then(|mask| cores_of_mask(&mask)).is_some_and(|on| on.contains(&core));
    let servants =
        [interrupts.map(|on_core| numbers(&on_core)), works_here.then(|| "workers of the kernel".into())];
    let servants: Vec<String> = servants.into_iter().flatten().collect();
    (!servants.is_empty()).then(|| {
        format!(
            "{}: {} is served on core {core} ({}), where the loop spins in its receive window and lets no \
             byte through; use wait = \"poll\", or move them to other cores: fieldbeat doctor says how",
            port.bus,
            port.path,
            servants.join(", "),
        )
    })
}

/// A mask as the kernel writes it, the cores 31 ... 0 last: `ff,ffffffff`.
fn cores_of_mask(mask: &str) -> Option<Vec<usize>> {
    let mut cores = Vec::new();
    for (group, bits) in mask.split(',').rev().enumerate() {
        let bits = u32::from_str_radix(bits.trim(), 16).ok()?;
        cores.extend((0..32).filter(|bit| bits & (1 << bit) != 0).map(|bit| 32 * group + bit));
    }
    Some(cores)
}

fn mask_of(cores: &[usize]) -> String {
    let groups = cores.iter().max().map_or(1, |last| last / 32 + 1);
    let bits = |group: usize| {
        let of_group = cores.iter().filter(|core| *core / 32 == group);
        format!("{:x}", of_group.fold(0_u32, |bits, core| bits | 1 << (core % 32)))
    };
    (0..groups).rev().map(bits).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests;
