//! The network interface of a bus: where its interrupts go, which threads handle them, and what delays them.
//!
//! Sources: Documentation/core-api/irq/irq-affinity.rst, Documentation/networking/scaling.rst and napi.rst, ethtool(8).

use std::io;

use super::Subject;
use super::core::others;
use super::ethtool::{Coalescing, Nic};
use super::facts::{Facts, Root, Thread};
use super::finding::{Finding, lines, list, write};
use crate::cycle::Wait;
use crate::rt::host::cores_of;

/// All of them, for the interface `name`, but for what only IP has.
pub(super) fn check(facts: &Facts, bus: &str, name: &str, subject: &Subject) -> Vec<Finding> {
    let root = &facts.root;
    let interrupts = interrupts(root, name);
    let mut findings = vec![
        affinity(root, bus, &interrupts, subject),
        threads(root, bus, &interrupts, subject),
        deferral(root, bus, name),
    ];
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

fn affinity(root: &Root, bus: &str, interrupts: &[u32], subject: &Subject) -> Finding {
    let core = subject.core;
    let finding = Finding::network(
        bus,
        "interrupts",
        &format!("on other cores than {core}"),
        "otherwise each packet, those of others on this network included, interrupts the loop's core",
    );
    if interrupts.is_empty() {
        return finding.good("none of its own: a virtual interface");
    }
    // Where they go now; older kernels report only where they may.
    let file = |irq: u32, name: &str| root.text(&format!("proc/irq/{irq}/{name}"));
    let mut on_core = Vec::new();
    for irq in interrupts {
        let now = file(*irq, "effective_affinity_list").or_else(|_| file(*irq, "smp_affinity_list"));
        match now {
            Ok(now) if cores_of(&now).is_some_and(|cores| cores.contains(&core)) => on_core.push(*irq),
            Ok(_) => {}
            Err(error) => return finding.unread(&format!("proc/irq/{irq}/smp_affinity_list"), &error),
        }
    }
    if on_core.is_empty() {
        return finding.good(format!("{} elsewhere", numbers(interrupts)));
    }
    let away = list(&others(root, core));
    let finding = finding.poor(format!("{} on core {core}", numbers(&on_core)));
    if away.is_empty() {
        return finding.advise("no setting helps: this is the only core");
    }
    let path = |irq: u32| format!("proc/irq/{irq}/smp_affinity_list");
    let before = |irq| root.get(&path(irq)).unwrap_or_else(|| core.to_string());
    let moved = lines(&on_core, |irq| write(&away, &path(*irq)));
    finding.fix(
        format!("{moved}\nor irqaffinity={away} on the kernel command line"),
        lines(&on_core, |irq| write(before(*irq), &path(*irq))),
    )
}

fn numbers(interrupts: &[u32]) -> String {
    let all = interrupts.iter().map(u32::to_string).collect::<Vec<_>>().join(", ");
    format!("irq {all}")
}

/// The priority that the kernel gives interrupt threads (kernel/irq/manage.c, sched_set_fifo).
const USUAL_PRIORITY: u8 = 50;

/// On PREEMPT_RT, and with threadirqs, interrupts are handled by threads.
fn threads(root: &Root, bus: &str, interrupts: &[u32], subject: &Subject) -> Finding {
    let (core, priority) = (subject.core, subject.cycle.priority);
    let finding = Finding::network(
        bus,
        "interrupt threads",
        &format!("SCHED_FIFO {USUAL_PRIORITY} or above, away from a core whose loop spins"),
        "a reply is delivered only after they ran; on the core of a spinning loop of higher priority they never run",
    );
    if interrupts.is_empty() {
        return finding.good("none: a virtual interface");
    }
    if !root.shows_everybody() {
        return finding.unknown("this user, or this container, does not see all processes");
    }
    let of_this = |thread: &Thread| thread.interrupt().is_some_and(|irq| interrupts.contains(&irq));
    let threads: Vec<Thread> = root.threads().into_iter().filter(of_this).collect();
    if threads.is_empty() {
        return finding.good("none: handled in interrupts, above every priority");
    }
    let names = |chosen: &[&Thread]| {
        let one = |thread: &&Thread| format!("{} {} {}", thread.name, thread.policy(), thread.priority);
        chosen.iter().map(one).collect::<Vec<_>>().join(", ")
    };
    let low: Vec<&Thread> = threads.iter().filter(|thread| thread.priority < USUAL_PRIORITY).collect();
    if !low.is_empty() {
        let back = |thread: &&Thread| match thread.is_real_time() {
            true => format!("sudo chrt -f -p {} {}", thread.priority, thread.tid),
            false => format!("sudo chrt -o -p 0 {}", thread.tid),
        };
        let raised = lines(&low, |thread| format!("sudo chrt -f -p {USUAL_PRIORITY} {}", thread.tid));
        return finding.poor(names(&low)).fix(raised, lines(&low, back));
    }
    let spins = subject.cycle.wait == Wait::Spin;
    let starved = |thread: &&Thread| spins && thread.priority < priority && thread.cores == [core];
    let starved: Vec<&Thread> = threads.iter().filter(starved).collect();
    if !starved.is_empty() {
        return finding.poor(format!("{}, on core {core} below a loop that spins", names(&starved))).advise(
            "move its interrupts to another core, as above; their threads follow\n\
                 or set wait = \"poll\" in [cycle]",
        );
    }
    finding.good(names(&threads.iter().collect::<Vec<_>>()))
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
    use crate::doctor::Verdict::{Good, Poor, Unknown};
    use crate::doctor::facts::testing::{Host, KTHREADD, subject};

    const BUS: &str = "linmot";

    const ONLINE: (&str, &str) = ("sys/devices/system/cpu/online", "0-3\n");

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
    fn interrupts_belong_on_other_cores() {
        let check =
            |files: &[(&str, &str)], irqs: &[u32]| affinity(&Host::new(files).0.root, BUS, irqs, &subject());
        let effective = "proc/irq/31/effective_affinity_list";
        let allowed = ("proc/irq/31/smp_affinity_list", "0-3\n");
        assert_eq!(check(&[ONLINE, (effective, "2\n"), allowed], &[31]).found, "irq 31 elsewhere");
        let here = check(&[ONLINE, (effective, "3\n"), allowed], &[31]);
        assert_eq!((here.verdict, here.found.as_str()), (Poor, "irq 31 on core 3"));
        assert!(here.fix.unwrap().starts_with("echo 0-2 | sudo tee /proc/irq/31/smp_affinity_list\n"));
        assert_eq!(here.undo.unwrap(), "echo 0-3 | sudo tee /proc/irq/31/smp_affinity_list");
        assert_eq!(check(&[ONLINE, allowed], &[31]).verdict, Poor);
        assert_eq!(
            check(&[(effective, "3\n")], &[31]).fix.unwrap(),
            "no setting helps: this is the only core"
        );
        assert_eq!(check(&[], &[31]).verdict, Unknown);
        assert_eq!(check(&[], &[]).verdict, Good);
    }

    #[test]
    fn interrupt_threads_have_their_priority_and_a_core_to_run_on() {
        let mut plan = subject();
        let host = || Host::new(&[KTHREADD]);
        let check = |host: Host, plan: &Subject| threads(&host.0.root, BUS, &[31], plan);
        assert_eq!(check(Host::new(&[]), &plan).verdict, Unknown);
        assert_eq!(check(host(), &plan).found, "none: handled in interrupts, above every priority");
        let thread = |policy, priority, cores| host().thread(9, "irq/31-eth0", true, policy, priority, cores);
        assert_eq!(check(thread(libc::SCHED_FIFO, 50, "3"), &plan).found, "irq/31-eth0 SCHED_FIFO 50");
        let low = check(thread(libc::SCHED_OTHER, 0, "0-3"), &plan);
        assert_eq!((low.verdict, low.fix.as_deref()), (Poor, Some("sudo chrt -f -p 50 9")));
        assert_eq!(low.undo.unwrap(), "sudo chrt -o -p 0 9");
        plan.cycle.wait = Wait::Spin;
        assert!(check(thread(libc::SCHED_FIFO, 50, "3"), &plan).found.ends_with("below a loop that spins"));
        assert_eq!(check(thread(libc::SCHED_FIFO, 50, "0-3"), &plan).verdict, Good);
        assert_eq!(check(thread(libc::SCHED_FIFO, 90, "3"), &plan).verdict, Good);
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
