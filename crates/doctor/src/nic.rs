//! The network interface of a bus: which interrupts it has, and what delays them.
//!
//! Sources: Documentation/networking/scaling.rst and napi.rst, ethtool(8).

use std::io;

use super::Subject;
use super::ethtool::{Coalescing, Nic};
use super::facts::{Facts, Root};
use super::finding::{Finding, write};
use super::interrupts::Served;

/// All of them, for the interface `name`, but for what only IP has.
pub(super) fn check(facts: &Facts, bus: &str, name: &str, subject: &Subject) -> Vec<Finding> {
    let root = &facts.root;
    let served = Served {
        bus,
        interrupts: interrupts(root, name),
        why: "otherwise each packet, those of others on this network included, interrupts the loop's core",
        none: "a virtual interface",
    };
    let mut findings =
        vec![served.affinity(root, subject), served.threads(root, subject), deferral(root, bus, name)];
    findings.extend(facts.probes.nic(name).map(|nic| coalescing(bus, name, &nic.coalescing)));
    findings
}

/// The same of IP: whether the interface `name` merges packets.
pub(super) fn check_ip(facts: &Facts, bus: &str, name: &str) -> Option<Finding> {
    facts.probes.nic(name).map(|nic| offloads(bus, name, nic))
}

/// The interrupts of an interface that are in use. Those of a virtio device belong to the PCI device above it; a VLAN,
/// bond or bridge has those of the interfaces below it.
fn interrupts(root: &Root, name: &str) -> Vec<u32> {
    let device = format!("sys/class/net/{name}/device");
    let numbers = |directory: &str| -> Vec<u32> {
        root.names(directory).iter().filter_map(|number| number.parse().ok()).collect()
    };
    let own = numbers(&format!("{device}/msi_irqs"));
    let of_parent = || numbers(&format!("{device}/../msi_irqs"));
    let line = || root.get(&format!("{device}/irq"))?.parse().ok().filter(|irq: &u32| *irq > 0);
    let mut all = if own.is_empty() { of_parent() } else { own };
    if all.is_empty() {
        all.extend(line());
    }
    let lower = root.names(&format!("sys/class/net/{name}"));
    all.extend(
        lower
            .iter()
            .filter_map(|entry| entry.strip_prefix("lower_"))
            .flat_map(|lower| interrupts(root, lower)),
    );
    all.retain(|irq| root.has(&format!("proc/irq/{irq}")));
    all
}

/// Packets may be left in the card's ring on purpose, for a timer to fetch them.
fn deferral(root: &Root, bus: &str, name: &str) -> Finding {
    let finding = Finding::network(
        bus,
        "deferred interrupts",
        "0 (gro_flush_timeout, napi_defer_hard_irqs)",
        "with both, packets wait in the network card for a timer instead of an interrupt",
    );
    let path = |file: &str| format!("sys/class/net/{name}/{file}");
    let [flush, defer] = [path("gro_flush_timeout"), path("napi_defer_hard_irqs")];
    let (flush_ns, times) = match (root.text(&flush), root.text(&defer)) {
        (Ok(flush_ns), Ok(times)) => (flush_ns, times),
        // The older of both came with Linux 3.19, the other with 5.8.
        (_, Err(error)) if error.kind() == io::ErrorKind::NotFound && root.has(&path("mtu")) => {
            return finding.good("this kernel does not defer them");
        }
        (Err(error), _) | (_, Err(error)) => return finding.unread(&flush, &error),
    };
    match flush_ns == "0" || times == "0" {
        true => finding.good("off"),
        false => finding
            .poor(format!("{times} times, for up to {flush_ns} ns"))
            .fix(write(0, &defer), write(times, &defer)),
    }
}

/// Below this no reply is late for it.
const COALESCING_US: u32 = 10;

fn coalescing(bus: &str, name: &str, said: &io::Result<Coalescing>) -> Finding {
    let finding = Finding::network(
        bus,
        "coalescing",
        &format!("rx and tx {COALESCING_US} us at most, not adaptive"),
        "the network card collects packets for this time before it interrupts: it adds to every round trip",
    );
    let Coalescing { rx_us, tx_us, adaptive_rx, adaptive_tx } = match said {
        Ok(said) => *said,
        Err(error) => return finding.unknown(format!("the driver of {name} does not report it ({error})")),
    };
    let adaptive = if adaptive_rx || adaptive_tx { ", adaptive" } else { "" };
    let found = format!("rx {rx_us} us, tx {tx_us} us{adaptive}");
    if rx_us.max(tx_us) <= COALESCING_US && adaptive.is_empty() {
        return finding.good(found);
    }
    // A setting that stands already is left out: some drivers refuse the whole command over one that they do not know.
    let (mut set, mut back) = (format!("sudo ethtool -C {name}"), format!("sudo ethtool -C {name}"));
    for (side, adaptive, us) in [("rx", adaptive_rx, rx_us), ("tx", adaptive_tx, tx_us)] {
        if adaptive {
            set += &format!(" adaptive-{side} off");
            back += &format!(" adaptive-{side} on");
        }
        if us > COALESCING_US {
            set += &format!(" {side}-usecs {COALESCING_US}");
            back += &format!(" {side}-usecs {us}");
        }
    }
    finding.poor(found).fix(set, back)
}

fn offloads(bus: &str, name: &str, nic: &Nic) -> Finding {
    let finding = Finding::network(
        bus,
        "offloads",
        "gro and lro off",
        "both collect packets of one stream before they deliver them; a cycle has one packet a drive",
    );
    let known = [("gro", &nic.gro), ("lro", &nic.lro)];
    if let Some((what, Err(error))) = known.iter().find(|(_, said)| said.is_err()) {
        return finding.unknown(format!("the driver of {name} does not report {what} ({error})"));
    }
    let on: Vec<&str> =
        known.iter().filter(|(_, said)| matches!(said, Ok(true))).map(|(what, _)| *what).collect();
    if on.is_empty() {
        return finding.good("gro and lro off");
    }
    let set = |word: &str| {
        let each = on.iter().map(|what| format!(" {what} {word}")).collect::<String>();
        format!("sudo ethtool -K {name}{each}")
    };
    finding.poor(format!("{} on", on.join(" and "))).fix(set("off"), set("on"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Verdict::{Good, Poor, Unknown};
    use crate::facts::testing::Host;

    const BUS: &str = "linmot";

    #[test]
    fn interrupts_are_found_on_the_card_above_it_or_on_its_line() {
        let known = [("proc/irq/31/spurious", ""), ("proc/irq/32/spurious", "")];
        let check = |files: &[(&str, &str)]| interrupts(&Host::new(&known).with(files).0.root, "eth0");
        let own = ["31", "32", "33"].map(|irq| (format!("sys/class/net/eth0/device/msi_irqs/{irq}"), "msix"));
        let own: Vec<(&str, &str)> = own.iter().map(|(path, text)| (path.as_str(), *text)).collect();
        // 33 is not in use.
        assert_eq!(check(&own), [31, 32]);
        assert_eq!(
            check(&[("sys/class/net/eth0/msi_irqs/32", ""), ("sys/class/net/eth0/device/x", "")]),
            [32]
        );
        assert_eq!(check(&[("sys/class/net/eth0/device/irq", "31\n")]), [31]);
        let below = [("sys/class/net/eth0/lower_eth1/x", ""), ("sys/class/net/eth1/device/irq", "32\n")];
        assert_eq!(check(&below), [32]);
        assert_eq!(check(&[("sys/class/net/eth0/device/irq", "0\n")]), [0_u32; 0]);
        assert_eq!(check(&[]), [0_u32; 0]);
    }

    #[test]
    fn packets_do_not_wait_for_a_timer() {
        let check = |flush: &str, defer: &str| {
            let files = [
                ("sys/class/net/eth0/gro_flush_timeout", flush),
                ("sys/class/net/eth0/napi_defer_hard_irqs", defer),
            ];
            deferral(&Host::new(&files).0.root, BUS, "eth0")
        };
        assert_eq!(check("0\n", "0\n").verdict, Good);
        assert_eq!(check("20000\n", "0\n").verdict, Good);
        let late = check("20000\n", "2\n");
        assert_eq!(
            (late.verdict, late.undo.as_deref()),
            (Poor, Some("echo 2 | sudo tee /sys/class/net/eth0/napi_defer_hard_irqs"))
        );
        let old = Host::new(&[("sys/class/net/eth0/mtu", "1500")]);
        assert_eq!(deferral(&old.0.root, BUS, "eth0").verdict, Good);
        assert_eq!(deferral(&Host::new(&[]).0.root, BUS, "eth0").verdict, Unknown);
    }

    #[test]
    fn coalescing_is_short_and_steady() {
        let check = |rx_us, tx_us, adaptive_rx| {
            let said = Coalescing { rx_us, tx_us, adaptive_rx, adaptive_tx: false };
            coalescing(BUS, "eth0", &Ok(said))
        };
        assert_eq!(check(3, 0, false).found, "rx 3 us, tx 0 us");
        assert_eq!(check(3, 0, false).verdict, Good);
        let long = check(50, 3, true);
        assert_eq!((long.verdict, long.found.as_str()), (Poor, "rx 50 us, tx 3 us, adaptive"));
        assert_eq!(long.fix.unwrap(), "sudo ethtool -C eth0 adaptive-rx off rx-usecs 10");
        assert_eq!(long.undo.unwrap(), "sudo ethtool -C eth0 adaptive-rx on rx-usecs 50");
        let silent = coalescing(BUS, "eth0", &Err(io::Error::from_raw_os_error(libc::EOPNOTSUPP)));
        assert_eq!(silent.verdict, Unknown);
    }

    #[test]
    fn offloads_are_switched_off_by_name() {
        let nic = |gro, lro| Nic { coalescing: Err(io::ErrorKind::Unsupported.into()), gro, lro };
        let check = |gro, lro| offloads(BUS, "eth0", &nic(gro, lro));
        assert_eq!(check(Ok(false), Ok(false)).verdict, Good);
        assert_eq!(check(Ok(true), Ok(false)).fix.unwrap(), "sudo ethtool -K eth0 gro off");
        assert_eq!(check(Ok(true), Ok(true)).undo.unwrap(), "sudo ethtool -K eth0 gro on lro on");
        assert_eq!(check(Ok(true), Err(io::ErrorKind::Unsupported.into())).verdict, Unknown);
    }
}
