//! Clocks and timers, and the host that this one may run on.
//!
//! Sources: Documentation/timers/timekeeping.rst, vdso(7), proc_stat(5),
//! Documentation/ABI/testing/sysfs-devices-clocksource.

use super::Subject;
use super::facts::{Facts, Root};
use super::finding::{Area, Finding, write};
use super::kernel::Sysctl;
use fieldbeat_core::rt::host::steal_of;

/// All of them.
pub(super) fn check(facts: &Facts, subject: &Subject) -> Vec<Finding> {
    let root = &facts.root;
    vec![
        source(root),
        read(facts.probes.clock_read_ns),
        TIMER_MIGRATION.check(root),
        hypervisor(root),
        steal(root, subject),
    ]
}

const CLOCKSOURCE: &str = "sys/devices/system/clocksource/clocksource0";

/// Those that the C library reads without a system call.
const FAST: [&str; 7] = [
    "tsc",
    "kvm-clock",
    "hyperv_clocksource_tsc_page",
    "arch_sys_counter",
    "riscv_clocksource",
    "timebase",
    "tod",
];

/// Those behind a bus, some of which also count too coarsely.
const SLOW: [&str; 5] = ["hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit"];

fn source(root: &Root) -> Finding {
    let mut finding = Finding::about(
        Area::Clock,
        "clocksource",
        "the processor's own counter (tsc, arch_sys_counter, kvm-clock ...)",
        "the loop reads the clock several times a cycle; other sources cost microseconds a read or are too \
         coarse; the kernel falls back to them when it does not trust the counter",
    );
    let path = format!("{CLOCKSOURCE}/current_clocksource");
    let Some(current) = finding.read(root, &path) else { return finding };
    if FAST.contains(&current.as_str()) {
        return finding.good(current);
    }
    let available = root.get(&format!("{CLOCKSOURCE}/available_clocksource")).unwrap_or_default();
    let finding = match available.split_whitespace().find(|source| FAST.contains(source)) {
        Some(better) => finding.fix(write(better, &path), write(&current, &path)),
        None => finding
            .advise("dmesg | grep -i -e tsc -e clocksource    shows why; newer firmware often fixes it"),
    };
    if SLOW.contains(&current.as_str()) { finding.bad(current) } else { finding.poor(current) }
}

/// A read in the vDSO takes 20 to 60 ns, a system call some hundreds.
const SLOW_READ_NS: f64 = 200.0;

fn read(ns: f64) -> Finding {
    let finding = Finding::about(
        Area::Clock,
        "clock read",
        format!("below {SLOW_READ_NS} ns"),
        "each cycle reads it several times, and a final spin all the time",
    );
    let found = format!("{ns:.0} ns");
    match ns < SLOW_READ_NS {
        true => finding.good(found),
        false => finding.poor(found).advise(
            "see the clocksource above; in a container or under a tracer each read may be a system call",
        ),
    }
}

const TIMER_MIGRATION: Sysctl = Sysctl {
    area: Area::Clock,
    name: "timer migration",
    path: "kernel/timer_migration",
    wanted: 0,
    or_more: false,
    why: "at 1 the kernel may move a timer to another core; the loop is then woken by an inter-processor \
         interrupt",
};

fn hypervisor(root: &Root) -> Finding {
    let mut finding = Finding::about(
        Area::Clock,
        "virtual machine",
        "none",
        "its host runs other work on the same processors, and no setting in this machine changes that",
    );
    let remedy = "on the host, pin this machine's processors to cores of their own\n\
                  or run on bare metal";
    let kind = root.get("sys/hypervisor/type").or_else(|| root.get("sys/class/dmi/id/sys_vendor"));
    let by = |kind: Option<String>| kind.map_or_else(|| "yes".to_owned(), |kind| format!("yes, {kind}"));
    if root.has("sys/hypervisor/type") || root.has("proc/device-tree/hypervisor") {
        return finding.poor(by(kind)).advise(remedy);
    }
    let path = "proc/cpuinfo";
    let Some(info) = finding.read(root, path) else { return finding };
    // x86 only: bit 31 of CPUID 1, which hypervisors set.
    let Some(flags) = info.lines().find_map(|line| line.strip_prefix("flags")) else {
        return finding.unknown("this processor does not report it");
    };
    match flags.split_whitespace().any(|flag| flag == "hypervisor") {
        true => finding.poor(by(kind)).advise(remedy),
        false => finding.good("none detected"),
    }
}

fn steal(root: &Root, subject: &Subject) -> Finding {
    let core = subject.core;
    let mut finding = Finding::about(
        Area::Clock,
        "stolen time",
        "none",
        "time in which this core was ready to run and the host of the virtual machine ran something else, in \
         ticks",
    );
    let path = "proc/stat";
    let Some(stat) = finding.read(root, path) else { return finding };
    let Some(stolen) = steal_of(&stat, Some(core)) else {
        return finding.unknown(format!("/{path} has no such column for core {core}"));
    };
    let label = format!("cpu{core}");
    let line = stat.lines().find(|line| line.split_whitespace().next() == Some(&label)).unwrap_or_default();
    // Guest times are within user times.
    let total: u64 =
        line.split_whitespace().skip(1).take(8).filter_map(|ticks| ticks.parse::<u64>().ok()).sum();
    if stolen == 0 {
        return finding.good(format!("none on core {core} since boot"));
    }
    let share = stolen as f64 * 100.0 / total.max(1) as f64;
    finding.poor(format!("{share:.3} % of core {core} since boot")).advise("as for the virtual machine")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Verdict::{Bad, Good, Poor, Unknown};
    use crate::facts::testing::{Host, subject};

    #[test]
    fn a_clock_behind_a_bus_is_bad() {
        let current = "sys/devices/system/clocksource/clocksource0/current_clocksource";
        let available = "sys/devices/system/clocksource/clocksource0/available_clocksource";
        let check = |files: &[(&str, &str)]| source(&Host::new(files).0.root);
        for name in ["tsc\n", "arch_sys_counter\n", "kvm-clock\n"] {
            assert_eq!(check(&[(current, name)]).verdict, Good, "{name}");
        }
        let hpet = check(&[(current, "hpet\n"), (available, "hpet acpi_pm \n")]);
        assert!(hpet.verdict == Bad && hpet.fix.unwrap().contains("dmesg") && hpet.undo.is_none());
        let pm = check(&[(current, "acpi_pm\n"), (available, "tsc hpet acpi_pm \n")]);
        assert_eq!(pm.fix.unwrap(), format!("echo tsc | sudo tee /{current}"));
        assert_eq!(pm.undo.unwrap(), format!("echo acpi_pm | sudo tee /{current}"));
        assert_eq!(check(&[(current, "xen\n")]).verdict, Poor);
        assert_eq!(check(&[]).verdict, Unknown);
    }

    #[test]
    fn a_read_by_system_call_is_poor() {
        assert_eq!((read(25.4).verdict, read(25.4).found.as_str()), (Good, "25 ns"));
        assert_eq!(read(1_200.0).verdict, Poor);
    }

    #[test]
    fn a_hypervisor_shows_itself_in_three_ways() {
        let check = |files: &[(&str, &str)]| hypervisor(&Host::new(files).0.root);
        let guest = ("proc/cpuinfo", "processor\t: 0\nflags\t\t: fpu hypervisor sse\n");
        assert_eq!(check(&[guest]).found, "yes");
        assert_eq!(check(&[guest, ("sys/class/dmi/id/sys_vendor", "QEMU\n")]).found, "yes, QEMU");
        assert_eq!(check(&[("sys/hypervisor/type", "xen\n")]).found, "yes, xen");
        assert_eq!(check(&[("proc/device-tree/hypervisor/compatible", "linux,kvm")]).verdict, Poor);
        assert_eq!(check(&[("proc/cpuinfo", "flags\t\t: fpu sse\n")]).verdict, Good);
        assert_eq!(check(&[("proc/cpuinfo", "BogoMIPS\t: 108.00\n")]).verdict, Unknown);
        assert_eq!(check(&[]).verdict, Unknown);
    }

    #[test]
    fn stolen_time_is_that_of_the_core() {
        let check = |text: &str| steal(&Host::new(&[("proc/stat", text)]).0.root, &subject());
        assert_eq!(check("cpu3 50 0 50 890 0 0 0 10 7 0\n").found, "1.000 % of core 3 since boot");
        assert_eq!(check("cpu2 1 1 1 1 1 1 1 9\ncpu3 50 0 50 900 0 0 0 0 0 0\n").verdict, Good);
        assert_eq!(check("cpu3 1 2 3 4\n").verdict, Unknown);
        assert_eq!(steal(&Host::new(&[]).0.root, &subject()).verdict, Unknown);
    }
}
