//! What moves memory, locked memory included: huge pages, swap, compaction, statistics.
//!
//! Sources: Documentation/admin-guide/mm/transhuge.rst, Documentation/admin-guide/sysctl/vm.rst and kernel.rst.

use super::facts::{Facts, Root};
use super::finding::{Area, Finding, write};
use super::kernel::Sysctl;

/// All of them.
pub(super) fn check(facts: &Facts) -> Vec<Finding> {
    let root = &facts.root;
    let mut findings = vec![huge_pages(root), swap(root)];
    findings.extend(SYSCTLS.iter().map(|sysctl| sysctl.check(root)));
    findings
}

const SYSCTLS: [Sysctl; 4] = [
    Sysctl {
        area: Area::Memory,
        name: "compaction",
        path: "vm/compact_unevictable_allowed",
        wanted: 0,
        or_more: false,
        why: "at 1 the kernel may move locked pages to free large blocks, and the loop takes a page fault on \
             them",
    },
    Sysctl {
        area: Area::Memory,
        name: "NUMA balancing",
        path: "kernel/numa_balancing",
        wanted: 0,
        or_more: false,
        why: "it unmaps pages to see which core uses them; the loop takes a page fault on each",
    },
    Sysctl {
        area: Area::Memory,
        name: "NMI watchdog",
        path: "kernel/nmi_watchdog",
        wanted: 0,
        or_more: false,
        why: "the hard-lockup detector interrupts every core with a non-maskable interrupt every few seconds",
    },
    Sysctl {
        area: Area::Memory,
        name: "statistics",
        path: "vm/stat_interval",
        wanted: 10,
        or_more: true,
        why: "a worker on every core updates memory statistics at this interval, s",
    },
];

fn huge_pages(root: &Root) -> Finding {
    let mut finding = Finding::about(
        Area::Memory,
        "huge pages",
        "madvise or never",
        "collapsing small pages into a huge one unmaps them for a moment; fieldbeat switches that off for \
         itself where it locks the whole process, but not for other programs",
    );
    let path = "sys/kernel/mm/transparent_hugepage/enabled";
    if !root.has(path) && root.has("sys/kernel/mm") {
        return finding.good("not built into this kernel");
    }
    let Some(text) = finding.read(root, path) else { return finding };
    match text.split(['[', ']']).nth(1) {
        Some("always") => finding.poor("always").fix(write("madvise", path), write("always", path)),
        Some(mode) => finding.good(mode),
        None => finding.unknown(format!("/{path} says {text}")),
    }
}

/// The vm.swappiness of rt-config/host/99-fieldbeat-sysctl.conf.
const SWAPPINESS: u32 = 10;

fn swap(root: &Root) -> Finding {
    let mut finding = Finding::about(
        Area::Memory,
        "swap",
        format!("none, or vm.swappiness {SWAPPINESS} at most"),
        "locked memory is never swapped; other memory of the application is, and its threads then feed the \
         loop late",
    );
    let path = "proc/swaps";
    let Some(text) = finding.read(root, path) else { return finding };
    let areas: Vec<&str> = text.lines().skip(1).filter_map(|line| line.split_whitespace().next()).collect();
    if areas.is_empty() {
        return finding.good("none");
    }
    let swappiness = root.get("proc/sys/vm/swappiness");
    let found = format!("{}, swappiness {}", areas.join(", "), swappiness.as_deref().unwrap_or("not known"));
    match swappiness.and_then(|value| value.parse::<u32>().ok()) {
        Some(value) if value <= SWAPPINESS => finding.good(found),
        Some(value) => finding.poor(found).fix(
            format!("sudo swapoff -a\nor sudo sysctl -w vm.swappiness={SWAPPINESS}"),
            format!("sudo swapon -a\nor sudo sysctl -w vm.swappiness={value}"),
        ),
        None => finding.poor(found).fix("sudo swapoff -a", "sudo swapon -a"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Verdict::{Good, Poor, Unknown};
    use crate::facts::testing::Host;

    #[test]
    fn huge_pages_by_request_only_are_good() {
        let path = "sys/kernel/mm/transparent_hugepage/enabled";
        let check = |files: &[(&str, &str)]| huge_pages(&Host::new(files).0.root);
        let always = check(&[(path, "[always] madvise never\n")]);
        assert_eq!((always.verdict, always.fix.unwrap()), (Poor, format!("echo madvise | sudo tee /{path}")));
        assert_eq!(check(&[(path, "always [madvise] never\n")]).found, "madvise");
        assert_eq!(check(&[(path, "always madvise never\n")]).verdict, Unknown);
        assert_eq!(check(&[("sys/kernel/mm/ksm/run", "0")]).verdict, Good);
        assert_eq!(check(&[]).verdict, Unknown);
    }

    #[test]
    fn swap_is_poor_unless_it_is_reluctant() {
        let swaps = ("proc/swaps", "Filename\tType\n/dev/sda2 partition 8388604 0 -2\n");
        let check = |files: &[(&str, &str)]| swap(&Host::new(files).0.root);
        assert_eq!(check(&[("proc/swaps", "Filename\t\t\t\tType\n")]).found, "none");
        let eager = check(&[swaps, ("proc/sys/vm/swappiness", "60\n")]);
        assert_eq!((eager.verdict, eager.found.as_str()), (Poor, "/dev/sda2, swappiness 60"));
        assert!(eager.undo.unwrap().ends_with("vm.swappiness=60"));
        assert_eq!(check(&[swaps, ("proc/sys/vm/swappiness", "10\n")]).verdict, Good);
        assert_eq!(check(&[swaps]).verdict, Poor);
        assert_eq!(check(&[]).verdict, Unknown);
    }

    #[test]
    fn every_setting_here_is_one_of_the_sample_file() {
        let file = include_str!("../files/99-fieldbeat-sysctl.conf");
        for sysctl in &SYSCTLS {
            let line = format!("-{} = {}\n", sysctl.path.replace('/', "."), sysctl.wanted);
            assert!(file.contains(&line), "{line}");
        }
    }
}
