//! The network to the drives of a bus: its interface, neighbour entries, socket buffers, connection tracking. A bus
//! without IP has an interface of its own, and nothing else.
//!
//! Sources: arp(7), socket(7), ip-neighbour(8), Documentation/networking/nf_conntrack-sysctl.rst.

use std::net::SocketAddrV4;

use super::Subject;
use super::facts::{Facts, Root};
use super::finding::{Finding, lines};
use super::nic;
use super::way::{Line, Wire};

/// All of them, for each bus.
pub(super) fn check(facts: &Facts, subject: &Subject) -> Vec<Finding> {
    let of_wires = subject.wires.iter().flat_map(|wire| bus(facts, wire, subject));
    of_wires.chain(subject.lines.iter().flat_map(|own| line(facts, own, subject))).collect()
}

fn bus(facts: &Facts, wire: &Wire, subject: &Subject) -> Vec<Finding> {
    let root = &facts.root;
    let local = *wire.local.ip();
    let found = facts.probes.interface(local);
    let mut findings = vec![interface(root, wire, found)];
    if local.is_loopback() {
        findings.push(
            Finding::network(&wire.bus, "drives", "", "").good("on this computer: loopback, nothing to tune"),
        );
    } else if let Some(name) = found {
        findings.extend(nic::check(facts, &wire.bus, name, subject));
        findings.extend(nic::check_ip(facts, &wire.bus, name));
        findings.push(neighbours(root, wire, name));
    }
    findings.extend([
        buffer(root, wire, "send buffer", "wmem_max", wire.options.send_buffer()),
        buffer(root, wire, "receive buffer", "rmem_max", wire.options.receive_buffer()),
        tracking(root, wire),
    ]);
    findings
}

fn line(facts: &Facts, line: &Line, subject: &Subject) -> Vec<Finding> {
    let (root, name) = (&facts.root, line.interface.as_str());
    let wanted = format!("{name}, with the segment plugged in");
    let finding = Finding::network(
        &line.bus,
        "interface",
        &wanted,
        "the frames of the bus leave and return through it",
    );
    // The kernel's own names have no colon.
    if name.contains(':') {
        return vec![finding.good("on this computer: simulated, nothing to tune")];
    }
    if !root.has(&format!("sys/class/net/{name}")) {
        let remedy = "`ip link` lists those that this computer has; set interface to one of them";
        return vec![finding.bad(format!("no interface {name}")).advise(remedy)];
    }
    let mut findings = vec![state(root, finding, name)];
    findings.extend(nic::check(facts, &line.bus, name, subject));
    findings.push(alone(facts, line));
    findings
}

/// Nothing but the bus uses its interface.
fn alone(facts: &Facts, line: &Line) -> Finding {
    let name = &line.interface;
    let finding = Finding::network(
        &line.bus,
        "IP addresses",
        &format!("none on {name}"),
        "packets of the kernel take time on the same segment, and the slaves forward them",
    );
    let of_line = facts.probes.addresses.iter().filter(|(_, own)| own == name);
    let addresses: Vec<String> = of_line.map(|(address, _)| address.to_string()).collect();
    match addresses.is_empty() {
        true => finding.good("none"),
        false => finding.poor(addresses.join(", ")).fix(
            format!("sudo ip addr flush dev {name}"),
            format!("sudo ip addr add ADDRESS/BITS dev {name}"),
        ),
    }
}

fn interface(root: &Root, wire: &Wire, found: Option<&str>) -> Finding {
    let local = wire.local.ip();
    let wanted = format!("{local} on an interface of this computer, with its cable plugged in");
    let finding = Finding::network(
        &wire.bus,
        "interface",
        &wanted,
        "the bus sends from this address and receives its replies there",
    );
    if local.is_unspecified() {
        return finding
            .poor("0.0.0.0: the kernel chooses the address")
            .advise("bind = the address of the interface that leads to the drives");
    }
    let Some(name) = found else {
        // All of 127.0.0.0/8 is this computer.
        if local.is_loopback() {
            return finding.good(format!("lo has {local}"));
        }
        return finding
            .bad(format!("no interface has {local}"))
            .advise("`ip -4 addr` lists those that this computer has; set bind to one of them");
    };
    state(root, finding, name)
}

/// The driver of the interface `name`, and whether it is up.
fn state(root: &Root, finding: Finding, name: &str) -> Finding {
    let file = |file: &str| root.get(&format!("sys/class/net/{name}/{file}"));
    // Reading it fails while the interface is switched off.
    let carrier = file("carrier");
    let driver = root.link(&format!("sys/class/net/{name}/device/driver"));
    let speed = file("speed").filter(|speed| !speed.starts_with('-')).map(|speed| format!("{speed} Mbit/s"));
    let parts = [Some(name.to_owned()), driver, speed].into_iter().flatten().collect::<Vec<_>>().join(", ");
    match carrier.as_deref() {
        Some("1") => finding.good(format!("{parts}, up")),
        Some(_) => {
            finding.poor(format!("{parts}, no carrier")).advise("plug in the cable, switch on the drives")
        }
        None if root.has(&format!("sys/class/net/{name}")) => finding
            .poor(format!("{parts}, down"))
            .fix(format!("sudo ip link set {name} up"), format!("sudo ip link set {name} down")),
        None => finding.good(parts),
    }
}

/// Entries with these flags are never requested again (`NUD_PERMANENT` in /proc/net/arp, ATF_COM | ATF_PERM).
const PERMANENT: &str = "0x6";

fn neighbours(root: &Root, wire: &Wire, interface: &str) -> Finding {
    let mut finding = Finding::network(
        &wire.bus,
        "neighbour entries",
        "a permanent one for each drive",
        "other entries expire: the kernel then resolves the drive's hardware address again during the run, \
         and requests to an absent drive wait in the socket's buffer",
    );
    let path = "proc/net/arp";
    let Some(table) = finding.read(root, path) else { return finding };
    // Address, hardware type, flags, hardware address, mask, device.
    let entry = |drive: &SocketAddrV4| {
        let lines = table.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
        let ip = drive.ip().to_string();
        lines
            .filter(|fields| fields.len() == 6)
            .find(|fields| fields[0] == ip && fields[5] == interface)
            .map(|fields| (fields[2].to_owned(), fields[3].to_owned()))
    };
    let mut missing = Vec::new();
    for drive in &wire.drives {
        match entry(drive) {
            Some((flags, _)) if flags == PERMANENT => {}
            // An entry without flags has no address yet.
            Some((flags, hardware)) if flags != "0x0" => missing.push((drive.ip(), hardware)),
            _ => missing.push((drive.ip(), "MAC".to_owned())),
        }
    }
    let all = wire.drives.len();
    if missing.is_empty() {
        return finding.good(format!("all {all} permanent"));
    }
    let mut fix = lines(&missing, |(ip, hardware)| {
        format!("sudo ip neigh replace {ip} lladdr {hardware} dev {interface} nud permanent")
    });
    if missing.iter().any(|(_, hardware)| hardware == "MAC") {
        fix += "\n(MAC: the hardware address on the drive's label)";
    }
    finding
        .poor(format!("{} of {all} permanent", all - missing.len()))
        .fix(fix, lines(&missing, |(ip, _)| format!("sudo ip neigh del {ip} dev {interface}")))
}

fn buffer(root: &Root, wire: &Wire, name: &str, limit: &str, wanted: usize) -> Finding {
    let mut finding = Finding::network(
        &wire.bus,
        name,
        &format!("{wanted} bytes or more (net.core.{limit})"),
        "it holds datagrams while the loop is delayed or a drive is absent; the kernel silently cuts it to \
         this limit",
    );
    let path = format!("proc/sys/net/core/{limit}");
    let Some(text) = finding.read(root, &path) else { return finding };
    let set = |value: &dyn std::fmt::Display| format!("sudo sysctl -w net.core.{limit}={value}");
    match text.parse::<usize>() {
        Ok(most) if most >= wanted => finding.good(format!("{wanted} of at most {most} bytes")),
        Ok(most) => finding.poor(format!("cut to {most} bytes")).fix(set(&wanted), set(&most)),
        Err(_) => finding.unknown(format!("/{path} says {text}")),
    }
}

fn tracking(root: &Root, wire: &Wire) -> Finding {
    let mut finding = Finding::network(
        &wire.bus,
        "connection tracking",
        "not for the drives' datagrams",
        "every datagram is looked up in a table, under locks shared with all other traffic, and is dropped \
         when the table is full",
    );
    if !root.has("proc/sys/net/netfilter/nf_conntrack_max") {
        return finding.good("not loaded");
    }
    let path = "proc/net/nf_conntrack";
    let Some(table) = finding.read(root, path) else { return finding };
    let of = |drive: &&SocketAddrV4| {
        let (address, port) = (format!("dst={}", drive.ip()), format!("dport={}", drive.port()));
        table.lines().any(|line| {
            let has = |wanted: &str| line.split_whitespace().any(|word| word == wanted);
            has(&address) && has(&port)
        })
    };
    let tracked: Vec<&SocketAddrV4> = wire.drives.iter().filter(of).collect();
    let Some(first) = tracked.first() else {
        // Whether a rule exempts them cannot be read, and without traffic there is no entry.
        return match is_bound(root, wire.local) {
            true => finding.good("loaded; the master runs, and no drive is in its table"),
            false => finding
                .unknown("loaded, and no drive is in its table: run the doctor again while the master runs"),
        };
    };
    let port = first.port();
    let own = wire.local.port();
    finding.poor(format!("{} of {} drives are in its table", tracked.len(), wire.drives.len())).fix(
        format!(
            "sudo nft add table ip fieldbeat\n\
             sudo nft 'add chain ip fieldbeat sent {{ type filter hook output priority raw; }}'\n\
             sudo nft 'add chain ip fieldbeat received {{ type filter hook prerouting priority raw; }}'\n\
             sudo nft add rule ip fieldbeat sent udp dport {port} notrack\n\
             sudo nft add rule ip fieldbeat received udp dport {own} notrack"
        ),
        "sudo nft delete table ip fieldbeat",
    )
}

/// Whether somebody has this UDP address: the second column of /proc/net/udp, an address as this processor stores it.
fn is_bound(root: &Root, local: SocketAddrV4) -> bool {
    let wanted = format!("{:08X}:{:04X}", u32::from_ne_bytes(local.ip().octets()), local.port());
    let table = root.get("proc/net/udp").unwrap_or_default();
    table.lines().any(|line| line.split_whitespace().nth(1) == Some(&wanted))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::Verdict::{Bad, Good, Poor, Unknown};
    use crate::facts::testing::{Host, subject};
    use fieldbeat_core::net::UdpOptions;

    /// Two drives behind eth0.
    pub fn wire() -> Wire {
        Wire {
            bus: "linmot".into(),
            local: "192.168.1.1:41136".parse().unwrap(),
            options: UdpOptions { peers: 2, waiting: 5, room: 128, dscp: 0, groups: 0 },
            drives: vec!["192.168.1.11:49360".parse().unwrap(), "192.168.1.12:49360".parse().unwrap()],
        }
    }

    #[test]
    fn the_interface_is_the_one_that_has_the_address() {
        let check = |local: &str, found, files: &[(&str, &str)]| {
            let wire = Wire { local: local.parse().unwrap(), ..wire() };
            interface(&Host::new(files).0.root, &wire, found)
        };
        let carrier = "sys/class/net/eth0/carrier";
        let up =
            check("192.168.1.1:1", Some("eth0"), &[(carrier, "1\n"), ("sys/class/net/eth0/speed", "1000\n")]);
        assert_eq!((up.verdict, up.found.as_str()), (Good, "eth0, 1000 Mbit/s, up"));
        assert_eq!(up.name, "linmot: interface");
        let unplugged =
            check("192.168.1.1:1", Some("eth0"), &[(carrier, "0\n"), ("sys/class/net/eth0/speed", "-1\n")]);
        assert_eq!((unplugged.verdict, unplugged.found.as_str()), (Poor, "eth0, no carrier"));
        let down = check("192.168.1.1:1", Some("eth0"), &[("sys/class/net/eth0/mtu", "1500")]);
        assert_eq!(down.fix.unwrap(), "sudo ip link set eth0 up");
        assert_eq!(check("192.168.1.1:1", None, &[]).verdict, Bad);
        assert_eq!(check("0.0.0.0:1", None, &[]).verdict, Poor);
        assert_eq!(check("127.77.0.1:1", None, &[]).verdict, Good);
    }

    #[test]
    fn a_line_has_an_interface_for_itself() {
        let check = |interface: &str, files: &[(&str, &str)]| {
            let own = Line { bus: "portal".into(), interface: interface.into() };
            line(&Host::new(files).0, &own, &subject())
        };
        let carrier = [("sys/class/net/eth1/carrier", "1\n"), ("sys/class/net/eth1/speed", "100\n")];
        let up = check("eth1", &carrier);
        assert_eq!((up[0].verdict, up[0].found.as_str()), (Good, "eth1, 100 Mbit/s, up"));
        assert_eq!(up[0].name, "portal: interface");
        let alone = up.last().unwrap();
        assert_eq!((alone.name.as_str(), alone.verdict), ("portal: IP addresses", Good));
        // eth0 has one.
        let shared = check("eth0", &[("sys/class/net/eth0/carrier", "0\n")]);
        assert_eq!((shared[0].verdict, shared[0].found.as_str()), (Poor, "eth0, no carrier"));
        let alone = shared.last().unwrap();
        assert_eq!((alone.verdict, alone.found.as_str()), (Poor, "192.168.1.1"));
        assert_eq!(alone.fix.as_deref(), Some("sudo ip addr flush dev eth0"));
        let gone = check("eth2", &carrier);
        assert_eq!((gone.len(), gone[0].verdict, gone[0].found.as_str()), (1, Bad, "no interface eth2"));
        assert_eq!(check("local:line", &[])[0].verdict, Good);
    }

    #[test]
    fn neighbours_are_permanent_or_named_with_their_hardware_address() {
        let head = "IP address       HW type     Flags       HW address            Mask     Device\n";
        let check = |lines: &str| {
            let table = format!("{head}{lines}");
            neighbours(&Host::new(&[("proc/net/arp", &table)]).0.root, &wire(), "eth0")
        };
        let one = "192.168.1.11  0x1  0x6  00:1a:4e:00:00:0b  *  eth0\n";
        let two = "192.168.1.12  0x1  0x6  00:1a:4e:00:00:0c  *  eth0\n";
        assert_eq!(check(&format!("{one}{two}")).found, "all 2 permanent");
        let learned = check(&format!("{one}{}", two.replace("0x6", "0x2")));
        assert_eq!((learned.verdict, learned.found.as_str()), (Poor, "1 of 2 permanent"));
        assert_eq!(
            learned.fix.unwrap(),
            "sudo ip neigh replace 192.168.1.12 lladdr 00:1a:4e:00:00:0c dev eth0 nud permanent"
        );
        assert_eq!(learned.undo.unwrap(), "sudo ip neigh del 192.168.1.12 dev eth0");
        // Not there, still being resolved, or on another wire.
        for lines in [
            one.to_owned(),
            format!("{one}{}", two.replace("0x6", "0x0")),
            format!("{one}{}", two.replace("eth0", "eth1")),
        ] {
            let finding = check(&lines);
            assert!(finding.fix.unwrap().contains("192.168.1.12 lladdr MAC dev eth0"), "{lines}");
        }
        assert_eq!(neighbours(&Host::new(&[]).0.root, &wire(), "eth0").verdict, Unknown);
    }

    #[test]
    fn a_buffer_that_is_cut_is_poor() {
        let check = |files: &[(&str, &str)]| {
            buffer(&Host::new(files).0.root, &wire(), "send buffer", "wmem_max", 18_432)
        };
        assert_eq!(
            check(&[("proc/sys/net/core/wmem_max", "212992\n")]).found,
            "18432 of at most 212992 bytes"
        );
        let cut = check(&[("proc/sys/net/core/wmem_max", "8192\n")]);
        assert_eq!((cut.verdict, cut.fix.as_deref()), (Poor, Some("sudo sysctl -w net.core.wmem_max=18432")));
        assert_eq!(cut.undo.unwrap(), "sudo sysctl -w net.core.wmem_max=8192");
        assert_eq!(check(&[("proc/sys/net/core/wmem_max", "?")]).verdict, Unknown);
        assert_eq!(check(&[]).verdict, Unknown);
    }

    #[test]
    fn tracking_is_seen_by_its_entries_only() {
        let loaded = ("proc/sys/net/netfilter/nf_conntrack_max", "65536\n");
        let check = |files: &[(&str, &str)]| tracking(&Host::new(files).0.root, &wire());
        assert_eq!(check(&[]).found, "not loaded");
        assert_eq!(check(&[loaded]).verdict, Unknown);
        let entry = "ipv4 2 udp 17 29 src=192.168.1.1 dst=192.168.1.11 sport=41136 dport=49360 \
             src=192.168.1.11 ...\n";
        let table = ("proc/net/nf_conntrack", entry);
        let tracked = check(&[loaded, table]);
        assert_eq!((tracked.verdict, tracked.found.as_str()), (Poor, "1 of 2 drives are in its table"));
        assert!(tracked.fix.unwrap().contains("udp dport 49360 notrack"));
        // Nothing of ours in it, although the master runs.
        let empty = ("proc/net/nf_conntrack", "");
        let address = if cfg!(target_endian = "little") { "0101A8C0" } else { "C0A80101" };
        let socket = format!(
            "  sl  local_address rem_address\n  77: {address}:A0B0 00000000:0000 07 00000000:00000000\n"
        );
        assert_eq!(check(&[loaded, empty]).verdict, Unknown);
        assert_eq!(check(&[loaded, empty, ("proc/net/udp", &socket)]).verdict, Good);
        assert_eq!(
            check(&[loaded, empty, ("proc/net/udp", &socket.replace("A0B0", "A0B1"))]).verdict,
            Unknown
        );
        // 192.168.1.110 is not 192.168.1.11.
        let other = entry.replace("192.168.1.11 ", "192.168.1.110 ");
        assert_eq!(check(&[loaded, ("proc/net/nf_conntrack", &other)]).verdict, Unknown);
    }

    #[test]
    fn loopback_needs_no_tuning() {
        let host = Host::new(&[]);
        let local = Wire { local: "127.77.0.1:41136".parse().unwrap(), ..wire() };
        let findings = bus(&host.0, &local, &subject());
        assert!(findings.iter().any(|finding| finding.found.contains("loopback, nothing to tune")));
        assert!(!findings.iter().any(|finding| finding.name.contains("interrupts")));
    }
}
