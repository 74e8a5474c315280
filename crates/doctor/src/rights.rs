//! What this user may do: the loop's priority, the memory lock, and the real-time budget of its control group.

use super::Subject;
use super::facts::{Facts, Program, Root};
use super::finding::{Area, Finding, write};
use fieldbeat_core::rt::rights::{amount, program, setcap};
use fieldbeat_core::rt::{Denied, Memory, Realtime};

/// All of them.
pub(super) fn check(facts: &Facts, subject: &Subject) -> Vec<Finding> {
    let probes = &facts.probes;
    vec![
        fifo(&probes.fifo, subject),
        memory(&probes.memory, subject),
        group_budget(&facts.root, probes.fifo.is_ok(), subject),
        program_file(probes.program),
        filters(&probes.filters),
    ]
}

fn fifo(tried: &Result<(), Denied>, subject: &Subject) -> Finding {
    let policy = format!("SCHED_FIFO {}", subject.cycle.priority);
    let finding = Finding::about(
        Area::Rights,
        "scheduling",
        format!("the right to {policy}"),
        "an ordinary thread shares its core with all others: its latency has no bound",
    );
    match tried {
        Ok(()) => finding.good(format!("{policy} granted")),
        Err(denied) => refused(finding, denied, subject),
    }
}

fn memory(tried: &Result<(), Denied>, subject: &Subject) -> Finding {
    let (name, wanted) = match subject.cycle.memory {
        Memory::Process => ("memory lock", "the right to lock the whole process"),
        Memory::Own => ("memory lock", "the right to lock the memory of the loop"),
    };
    let why = "a page that is not in memory costs the loop a page fault, and a disk access if it was dropped";
    let finding = Finding::about(Area::Rights, name, wanted, why);
    match tried {
        Ok(()) => finding.good("granted"),
        Err(denied) => refused(finding, denied, subject),
    }
}

/// A right that the plan needs, and that this user does not have.
fn refused(finding: Finding, denied: &Denied, subject: &Subject) -> Finding {
    let limits = "rt-config/host/99-fieldbeat-limits.conf (logins), fieldbeat.service (a service)";
    let undo = format!("sudo setcap -r {}", program());
    let granting = format!("{}\nor {limits}", setcap());
    let (found, finding) = match denied {
        Denied::Fifo { limit, .. } => {
            (format!("refused: RLIMIT_RTPRIO is {limit}"), finding.fix(granting, undo))
        }
        Denied::Memlock { need_kib, limit_kib } => (
            format!("refused: {} needed, RLIMIT_MEMLOCK is {limit_kib} KiB", amount(*need_kib)),
            finding.fix(granting, undo),
        ),
        Denied::FifoGroup { .. } => (
            "refused although CAP_SYS_NICE is held: a control group or a container forbids it".to_owned(),
            finding.advise(
                "start from the root control group, outside the container\n\
                 or add rt_group_sched=0 to the kernel command line, where the kernel supports it",
            ),
        ),
        Denied::Call { call, error } => {
            (format!("refused: {call}: {error}"), finding.advise(format!("see `man 2 {call}`")))
        }
    };
    match subject.cycle.realtime {
        Realtime::Off => finding.poor(format!("{found}; not needed with realtime = \"off\"")),
        Realtime::Prefer | Realtime::Require => finding.bad(found),
    }
}

/// Whoever may execute a file with capabilities has them.
fn program_file(file: Program) -> Finding {
    let finding = Finding::about(
        Area::Rights,
        "program file",
        "no capabilities, or only for a group",
        "whoever may execute it may run real-time threads, lock memory and send raw frames",
    );
    match file {
        Program { is_capable: false, .. } => finding.good("no capabilities"),
        Program { is_for_all: false, .. } => finding.good("capabilities, not for everybody"),
        Program { .. } => finding
            .fix(
                format!("{}\nwith the capabilities that it had (getcap {})", setcap(), program()),
                format!("sudo chmod 755 {}", program()),
            )
            .poor("capabilities for everybody"),
    }
}

/// The threads that serve others run with less where the kernel lets them.
fn filters(tried: &std::io::Result<()>) -> Finding {
    let finding = Finding::about(
        Area::Rights,
        "filters",
        "system call filters (seccomp)",
        "without them the threads of metrics, scope and control socket may do all that this user may",
    );
    match tried {
        Ok(()) => finding.good("available"),
        Err(error) => finding
            .advise("allow seccomp(2) in the container, or use a kernel with CONFIG_SECCOMP_FILTER")
            .poor(format!("refused: {error}")),
    }
}

/// With CONFIG_RT_GROUP_SCHED each control group has a budget of its own, and new ones have none
/// (Documentation/scheduler/sched-rt-group.rst).
fn group_budget(root: &Root, fifo: bool, subject: &Subject) -> Finding {
    let mut finding = Finding::about(
        Area::Rights,
        "RT group budget",
        "none of its own, or more than 0",
        "with CONFIG_RT_GROUP_SCHED a control group without budget refuses SCHED_FIFO even to root",
    );
    let Some(directory) = cpu_group(root) else {
        return match fifo {
            true => finding.good("not limited"),
            false => finding.unknown("the cpu controller of cgroup v1, which would show it, is not mounted"),
        };
    };
    let path = format!("{directory}/cpu.rt_runtime_us");
    if !root.has(&path) && fifo {
        return finding.good("not limited");
    }
    let Some(runtime) = finding.read(root, &path) else { return finding };
    match runtime.parse::<i64>() {
        Ok(0) => {
            let finding = finding.fix(write(950_000, &path), write(0, &path));
            match subject.cycle.realtime {
                Realtime::Off => finding.poor("0 us: no real-time thread may run in this control group"),
                _ => finding.bad("0 us: no real-time thread may run in this control group"),
            }
        }
        Ok(-1) => finding.good("not limited (-1)"),
        Ok(us) => {
            let period = root.get(&path.replace("runtime", "period")).unwrap_or_else(|| "1000000".into());
            finding.good(format!("{us} us of every {period} us"))
        }
        Err(_) => finding.unknown(format!("/{path} says {runtime}")),
    }
}

/// The directory of this process' group in the hierarchy of the cpu controller of cgroup v1.
fn cpu_group(root: &Root) -> Option<String> {
    let mounts = root.get("proc/self/mounts")?;
    let mount = mounts.lines().find_map(|line| {
        let mut fields = line.split_whitespace().skip(1);
        let (directory, kind, options) = (fields.next()?, fields.next()?, fields.next()?);
        (kind == "cgroup" && options.split(',').any(|option| option == "cpu")).then_some(directory)
    })?;
    let groups = root.get("proc/self/cgroup")?;
    let group = groups.lines().find_map(|line| {
        let (_, rest) = line.split_once(':')?;
        let (controllers, group) = rest.split_once(':')?;
        controllers.split(',').any(|controller| controller == "cpu").then_some(group)
    })?;
    Some(format!("{}{}", mount.trim_start_matches('/'), group.trim_end_matches('/')))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Verdict::{Bad, Good, Poor, Unknown};
    use crate::facts::testing::{Host, subject};

    #[test]
    fn a_missing_right_is_bad_and_names_both_ways() {
        let mut plan = subject();
        assert_eq!(fifo(&Ok(()), &plan).found, "SCHED_FIFO 80 granted");
        assert_eq!(memory(&Ok(()), &plan).verdict, Good);
        let denied = Err(Denied::Fifo { priority: 80, limit: 20 });
        let finding = fifo(&denied, &plan);
        assert_eq!((finding.verdict, finding.found.as_str()), (Bad, "refused: RLIMIT_RTPRIO is 20"));
        let (fix, undo) = (finding.fix.unwrap(), finding.undo.unwrap());
        assert!(fix.contains(" && sudo setcap cap_sys_nice,cap_ipc_lock+ep ") && fix.contains("limits.conf"));
        assert!(undo.starts_with("sudo setcap -r ") && undo.ends_with(&program()), "{undo}");

        let little = Err(Denied::Memlock { need_kib: Some(100_000), limit_kib: 8_192 });
        assert_eq!(
            memory(&little, &plan).found,
            "refused: 100000 KiB of memory needed, RLIMIT_MEMLOCK is 8192 KiB"
        );
        let group = fifo(&Err(Denied::FifoGroup { priority: 80 }), &plan);
        assert!(group.verdict == Bad && group.fix.unwrap().contains("root control group"));

        plan.cycle.realtime = Realtime::Off;
        assert_eq!(fifo(&denied, &plan).verdict, Poor);
    }

    #[test]
    fn a_file_with_capabilities_for_all_users_and_missing_filters_are_poor() {
        let found = |is_capable, is_for_all| program_file(Program { is_capable, is_for_all });
        assert_eq!([found(false, true), found(true, false)].map(|one| one.verdict), [Good; 2]);
        let open = found(true, true);
        assert_eq!(open.verdict, Poor);
        assert!(open.fix.unwrap().starts_with("sudo groupadd -f realtime && sudo chgrp realtime "));
        assert_eq!(filters(&Ok(())).verdict, Good);
        let refused = filters(&Err(std::io::Error::from_raw_os_error(libc::EPERM)));
        assert!(refused.verdict == Poor && refused.found.contains("not permitted"), "{refused:?}");
    }

    /// setcap(8) as the messages have it: a new group takes the capabilities of a file away, so it comes first.
    #[test]
    #[ignore = "needs root: capabilities of a file"]
    fn the_group_of_a_file_comes_before_its_capabilities() {
        use std::os::unix::fs::PermissionsExt;
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("program");
        std::fs::write(&path, "").unwrap();
        let mode = |path: &std::path::Path, mode| {
            std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).unwrap();
        };
        let grant = || {
            let done = std::process::Command::new("setcap").arg("cap_net_raw+ep").arg(&path).status();
            assert!(done.expect("libcap2-bin is installed").success());
        };
        mode(directory.path(), 0o755);
        mode(&path, 0o755);
        assert_eq!(Program::of(&path), Program { is_capable: false, is_for_all: true });
        grant();
        assert_eq!(Program::of(&path), Program { is_capable: true, is_for_all: true });
        std::os::unix::fs::chown(&path, None, Some(1)).unwrap();
        assert!(!Program::of(&path).is_capable, "the group was changed after setcap");
        mode(&path, 0o750);
        grant();
        assert_eq!(Program::of(&path), Program { is_capable: true, is_for_all: false });
        // Where nobody else gets to, nobody else executes it.
        mode(&path, 0o755);
        mode(directory.path(), 0o700);
        assert_eq!(Program::of(&path), Program { is_capable: true, is_for_all: false });
    }

    #[test]
    fn a_group_without_budget_is_bad() {
        let mounts =
            ("proc/self/mounts", "cgroup /sys/fs/cgroup/cpu,cpuacct cgroup rw,relatime,cpu,cpuacct 0 0\n");
        let group = ("proc/self/cgroup", "4:memory:/x\n3:cpu,cpuacct:/machine/a\n0::/\n");
        let path = "sys/fs/cgroup/cpu,cpuacct/machine/a/cpu.rt_runtime_us";
        let check = |files: &[(&str, &str)], fifo| group_budget(&Host::new(files).0.root, fifo, &subject());
        let none = check(&[mounts, group, (path, "0\n")], false);
        assert_eq!(none.verdict, Bad);
        assert_eq!(none.fix.unwrap(), format!("echo 950000 | sudo tee /{path}"));
        assert_eq!(check(&[mounts, group, (path, "950000\n")], true).found, "950000 us of every 1000000 us");
        assert_eq!(check(&[mounts, group, (path, "-1\n")], true).verdict, Good);
        assert_eq!(check(&[mounts, group, (path, "?\n")], true).verdict, Unknown);
        assert_eq!(check(&[mounts, group], true).verdict, Good);
        assert_eq!(check(&[mounts, group], false).verdict, Unknown);
        assert_eq!(check(&[], true).verdict, Good);
        assert_eq!(check(&[], false).verdict, Unknown);
        // At the root of its hierarchy.
        let top = ("proc/self/cgroup", "3:cpu,cpuacct:/\n");
        let of_all = "sys/fs/cgroup/cpu,cpuacct/cpu.rt_runtime_us";
        assert_eq!(check(&[mounts, top, (of_all, "0")], false).verdict, Bad);
    }
}
