//! The core of the loop, and what else runs on it: isolation, ticks, RCU, other real-time threads, the hyper-thread
//! next to it.
//!
//! Sources: Documentation/admin-guide/kernel-parameters.txt (isolcpus, nohz_full, rcu_nocbs), cpu-isolation of cpusets
//! in cgroup-v2.rst, Documentation/ABI/testing/sysfs-devices-system-cpu.

use super::Subject;
use super::facts::{Facts, Root, Thread};
use super::finding::{Area, Finding, lines, list, write};
use fieldbeat_core::cycle::Wait;
use fieldbeat_core::rt::RealtimeError;
use fieldbeat_core::rt::host::cores_of;

/// All of them.
pub(super) fn check(facts: &Facts, subject: &Subject) -> Vec<Finding> {
    let root = &facts.root;
    vec![
        presence(root, &facts.probes.core, subject),
        isolation(root, subject),
        ticks(root, subject),
        callbacks(root, subject),
        company(root, subject),
        sibling(root, subject),
    ]
}

const CPU: &str = "sys/devices/system/cpu";

fn presence(root: &Root, tried: &Result<(), RealtimeError>, subject: &Subject) -> Finding {
    let core = subject.core;
    let finding = Finding::about(
        Area::Core,
        "core",
        "one that is online and that this process may use",
        "the loop stays on one core: a thread that migrates starts with cold caches, and may migrate within \
         a cycle",
    );
    if let Err(error) = tried {
        let allowed = match error {
            RealtimeError::Core { allowed, .. } => allowed.clone(),
            other => other.to_string(),
        };
        let online = root.get(&format!("{CPU}/online")).unwrap_or_default();
        return finding
            .bad(format!("core {core} is not available; this process may use {allowed}, online are {online}"))
            .advise(format!("core = {} in [cycle]", allowed.rsplit(", ").next().unwrap_or("0")));
    }
    let chosen = if subject.cycle.core.is_some() { "named" } else { "the last one, by default" };
    match root.get(&format!("{CPU}/online")) {
        Some(online) => finding.good(format!("core {core} of {online}, {chosen}")),
        None => finding.good(format!("core {core}, {chosen}")),
    }
}

/// The cores but this one.
pub(super) fn others(root: &Root, core: usize) -> Vec<usize> {
    let online = root.cores(&format!("{CPU}/online")).unwrap_or_default();
    online.into_iter().filter(|other| *other != core).collect()
}

fn isolation(root: &Root, subject: &Subject) -> Finding {
    let core = subject.core;
    let mut finding = Finding::about(
        Area::Core,
        "isolation",
        format!("core {core} isolated"),
        "other threads on the same core cause kernel work there, which delays the loop whatever its priority",
    );
    let path = format!("{CPU}/isolated");
    let Some(text) = finding.read(root, &path) else { return finding };
    let isolated = cores_of(&text).unwrap_or_default();
    if isolated.contains(&core) {
        return finding.good(format!("isolated: {}", list(&isolated)));
    }
    if let Some(free) = isolated.last() {
        return finding
            .poor(format!("core {core} is not isolated, {} is", list(&isolated)))
            .fix(format!("core = {free} in [cycle]"), format!("core = {core}"));
    }
    if others(root, core).is_empty() {
        return finding
            .poor("the only core")
            .advise("no setting helps: use a computer with two cores or more");
    }
    finding.poor("no core is isolated").at_boot(format!("isolcpus=managed_irq,domain,{core}"))
}

/// rt-config/host/kernel-cmdline.txt leaves nohz_full out: it is made for threads that compute without end.
fn ticks(root: &Root, subject: &Subject) -> Finding {
    let core = subject.core;
    let spins = subject.cycle.wait == Wait::Spin;
    let mut finding = Finding::about(
        Area::Core,
        "nohz_full",
        "not this core, unless wait = \"spin\"",
        "it slows each system call, and a loop that sleeps in every cycle gains nothing: an idle core has no \
         tick",
    );
    let path = format!("{CPU}/nohz_full");
    // The file is there on every kernel with CONFIG_NO_HZ_FULL.
    if !root.has(&path) && root.has(CPU) {
        return finding.good("not built into this kernel");
    }
    let Some(text) = finding.read(root, &path) else { return finding };
    // `(null)` where none was named.
    let cores = cores_of(&text).unwrap_or_default();
    match cores.contains(&core) {
        true if spins => finding.good(format!("core {core} is in it, and the loop spins")),
        true => finding
            .poor(format!("core {core} is in it, and the loop sleeps"))
            .fix(format!("remove {core} from nohz_full= on the kernel command line, restart"), "put it back"),
        false => finding.good(format!("core {core} is not in it")),
    }
}

fn callbacks(root: &Root, subject: &Subject) -> Finding {
    let core = subject.core;
    let mut finding = Finding::about(
        Area::Core,
        "rcu_nocbs",
        format!("core {core} in it"),
        "otherwise RCU callbacks of the whole system also run on this core; with it they run in threads on \
         other cores",
    );
    let path = "proc/cmdline";
    let Some(words) = finding.read(root, path) else { return finding };
    // nohz_full implies it.
    let names = |key: &str| root.boot(key).and_then(|cores| cores_of(&cores)).unwrap_or_default();
    let all = words.split_whitespace().any(|word| word == "rcu_nocbs" || word == "rcu_nocbs=all");
    if all || names("rcu_nocbs").contains(&core) || names("nohz_full").contains(&core) {
        return finding.good(format!("core {core} is in it"));
    }
    finding.poor(format!("core {core} is not in it")).at_boot(format!("rcu_nocbs={core}"))
}

/// Real-time threads that may run on the core. Each core has its own of the kernel at 99 (migration/N); these have the
/// highest priority, and are short.
fn company(root: &Root, subject: &Subject) -> Finding {
    let (core, priority) = (subject.core, subject.cycle.priority);
    let finding = Finding::about(
        Area::Core,
        "other FIFO threads",
        format!("none of priority {priority} or above on core {core}"),
        "the loop waits for each of them until it sleeps",
    );
    if !root.shows_everybody() {
        return finding.unknown("this user, or this container, does not see all processes");
    }
    let stopper = format!("migration/{core}");
    let here = |thread: &Thread| {
        thread.is_real_time() && thread.cores.contains(&core) && !(thread.kernel && thread.name == stopper)
    };
    let threads: Vec<Thread> = root.threads().into_iter().filter(here).collect();
    // SCHED_DEADLINE comes before every priority (sched(7)).
    let precedes = |thread: &&Thread| thread.policy == libc::SCHED_DEADLINE || thread.priority >= priority;
    let above: Vec<&Thread> = threads.iter().filter(precedes).collect();
    let below = threads.len() - above.len();
    if above.is_empty() {
        return finding.good(match below {
            0 => "none".to_owned(),
            count => format!("{count} below priority {priority}"),
        });
    }
    let name = |thread: &&Thread| {
        format!("{} ({}, {} {})", thread.name, thread.tid, thread.policy(), thread.priority)
    };
    let found = above.iter().map(name).collect::<Vec<_>>().join(", ");
    let away = list(&others(root, core));
    let mine = || above.iter().filter(|thread| !thread.kernel);
    match mine().next() {
        Some(_) if !away.is_empty() => finding.poor(found).fix(
            lines(mine(), |thread| format!("sudo taskset -pc {away} {}", thread.tid)),
            lines(mine(), |thread| format!("sudo taskset -pc {} {}", list(&thread.cores), thread.tid)),
        ),
        _ => finding
            .poor(found)
            .advise(format!("priority = {} in [cycle]", highest(&above).saturating_add(1).min(98))),
    }
}

fn highest(threads: &[&Thread]) -> u8 {
    threads.iter().map(|thread| thread.priority).max().unwrap_or(0)
}

fn sibling(root: &Root, subject: &Subject) -> Finding {
    let core = subject.core;
    let mut finding = Finding::about(
        Area::Core,
        "hyper-threads",
        format!("nothing runs on the other hardware thread of core {core}"),
        "both share one core's execution units and caches: work on the other one slows every cycle, unseen",
    );
    let path = format!("{CPU}/cpu{core}/topology/thread_siblings_list");
    let Some(text) = finding.read(root, &path) else { return finding };
    let siblings = cores_of(&text).unwrap_or_default();
    let others: Vec<usize> = siblings.into_iter().filter(|sibling| *sibling != core).collect();
    if others.is_empty() {
        return finding.good("none");
    }
    let isolated = root.cores(&format!("{CPU}/isolated")).unwrap_or_default();
    if others.iter().all(|other| isolated.contains(other)) {
        return finding.good(format!("{} is its sibling, isolated: leave it idle", list(&others)));
    }
    let each = |value: u8| lines(&others, |other| write(value, &format!("{CPU}/cpu{other}/online")));
    finding.poor(format!("{} is its sibling, used by other threads", list(&others))).fix(each(0), each(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Verdict::{Bad, Good, Poor, Unknown};
    use crate::facts::testing::{Host, KTHREADD, subject};

    const ONLINE: (&str, &str) = ("sys/devices/system/cpu/online", "0-3\n");
    const ISOLATED: &str = "sys/devices/system/cpu/isolated";

    #[test]
    fn a_core_that_cannot_be_had_is_bad_and_names_those_that_can() {
        let host = Host::new(&[ONLINE]);
        let mut plan = subject();
        let there = presence(&host.0.root, &Ok(()), &plan);
        assert_eq!((there.verdict, there.found.as_str()), (Good, "core 3 of 0-3, named"));
        plan.cycle.core = None;
        assert!(presence(&host.0.root, &Ok(()), &plan).found.ends_with("the last one, by default"));
        assert_eq!(presence(&Host::new(&[]).0.root, &Ok(()), &plan).verdict, Good);
        let refused = Err(RealtimeError::Core { core: 9, allowed: "0, 1, 2".into() });
        plan.core = 9;
        let bad = presence(&host.0.root, &refused, &plan);
        assert_eq!(bad.verdict, Bad);
        assert_eq!(bad.found, "core 9 is not available; this process may use 0, 1, 2, online are 0-3");
        assert_eq!(bad.fix.unwrap(), "core = 2 in [cycle]");
    }

    #[test]
    fn isolation_is_that_of_the_chosen_core() {
        let check = |files: &[(&str, &str)]| isolation(&Host::new(files).0.root, &subject());
        assert_eq!(check(&[ONLINE, (ISOLATED, "2-3\n")]).verdict, Good);
        let other = check(&[ONLINE, (ISOLATED, "1-2\n")]);
        assert_eq!((other.verdict, other.fix.as_deref()), (Poor, Some("core = 2 in [cycle]")));
        let none = check(&[ONLINE, (ISOLATED, "\n")]);
        assert!(none.verdict == Poor && none.fix.unwrap().contains("isolcpus=managed_irq,domain,3 to"));
        assert_eq!(check(&[(ISOLATED, "\n")]).found, "the only core");
        assert_eq!(check(&[]).verdict, Unknown);
    }

    #[test]
    fn a_tickless_core_is_wanted_for_a_spinning_loop() {
        let file = "sys/devices/system/cpu/nohz_full";
        let mut plan = subject();
        let check = |files: &[(&str, &str)], plan: &Subject| ticks(&Host::new(files).0.root, plan);
        assert_eq!(check(&[(file, "2-3\n")], &plan).verdict, Poor);
        assert_eq!(check(&[(file, "(null)\n")], &plan).verdict, Good);
        assert_eq!(check(&[ONLINE], &plan).found, "not built into this kernel");
        assert_eq!(check(&[], &plan).verdict, Unknown);
        plan.cycle.wait = Wait::Spin;
        assert_eq!(check(&[(file, "2-3\n")], &plan).verdict, Good);
    }

    #[test]
    fn callbacks_are_off_the_core_by_either_parameter() {
        let check = |line: &str| callbacks(&Host::new(&[("proc/cmdline", line)]).0.root, &subject());
        for line in ["rcu_nocbs=3", "quiet rcu_nocbs=1-3", "nohz_full=3", "rcu_nocbs", "rcu_nocbs=all"] {
            assert_eq!(check(line).verdict, Good, "{line}");
        }
        for line in ["", "rcu_nocbs=1-2", "quiet"] {
            assert!(check(line).fix.unwrap().contains("add rcu_nocbs=3 to"), "{line}");
        }
        assert_eq!(callbacks(&Host::new(&[]).0.root, &subject()).verdict, Unknown);
    }

    #[test]
    fn others_are_counted_by_priority_and_core() {
        let init = [ONLINE, KTHREADD];
        let check = |host: Host| company(&host.0.root, &subject());
        assert_eq!(check(Host::new(&[])).verdict, Unknown);
        // Below, elsewhere, or the kernel's own of this core.
        let quiet = Host::new(&init)
            .thread(20, "migration/3", true, libc::SCHED_FIFO, 99, "3")
            .thread(21, "irq/31-eth0", true, libc::SCHED_FIFO, 50, "0-3")
            .thread(22, "other", false, libc::SCHED_FIFO, 90, "0-2");
        let finding = check(quiet);
        assert_eq!((finding.verdict, finding.found.as_str()), (Good, "1 below priority 80"));
        assert_eq!(check(Host::new(&init)).found, "none");

        let loud = check(Host::new(&init).thread(22, "jackd", false, libc::SCHED_RR, 80, "0-3"));
        assert_eq!((loud.verdict, loud.found.as_str()), (Poor, "jackd (22, SCHED_RR 80)"));
        assert_eq!(loud.fix.unwrap(), "sudo taskset -pc 0-2 22");
        assert_eq!(loud.undo.unwrap(), "sudo taskset -pc 0-3 22");

        let deadline = check(Host::new(&init).thread(23, "d", false, libc::SCHED_DEADLINE, 0, "3"));
        assert_eq!(deadline.verdict, Poor);
        // A thread of the kernel is not sent away.
        let kernel = check(Host::new(&init).thread(24, "irq/9-x", true, libc::SCHED_FIFO, 85, "3"));
        assert_eq!(kernel.fix.unwrap(), "priority = 86 in [cycle]");
    }

    #[test]
    fn a_hyper_thread_is_switched_off_by_its_number() {
        let file = "sys/devices/system/cpu/cpu3/topology/thread_siblings_list";
        let check = |files: &[(&str, &str)]| sibling(&Host::new(files).0.root, &subject());
        assert_eq!(check(&[(file, "3\n")]).found, "none");
        let open = check(&[(file, "3,7\n")]);
        assert_eq!(
            (open.verdict, open.fix.as_deref()),
            (Poor, Some("echo 0 | sudo tee /sys/devices/system/cpu/cpu7/online"))
        );
        assert_eq!(check(&[(file, "3,7\n"), (ISOLATED, "3,7")]).verdict, Good);
        assert_eq!(check(&[]).verdict, Unknown);
    }
}
