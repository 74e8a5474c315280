//! How the kernel schedules: preemption, what real-time threads may take of a core, and settings of sysctl(8).
//!
//! Sources: sched(7); Documentation/scheduler/sched-rt-group.rst, Documentation/admin-guide/sysctl/kernel.rst and
//! vm.rst.

use std::io::ErrorKind;

use super::Subject;
use super::facts::{Facts, Root};
use super::finding::{Area, Finding, keep, write};
use fieldbeat_core::cycle::starvation;
use fieldbeat_core::rt::host::{Throttling, preemption_by, throttling_of};
use fieldbeat_core::time::Ns;

/// All of them.
pub(super) fn check(facts: &Facts, subject: &Subject) -> Vec<Finding> {
    let root = &facts.root;
    vec![preemption(root), throttling(root, subject), fair_server(root, subject)]
}

/// The share of normal threads came with this version (kernel/sched/fair.c, `fair_server`).
const FAIR_SERVER_SINCE: (u32, u32) = (6, 12);

const PREEMPT: &str = "sys/kernel/debug/sched/preempt";

fn preemption(root: &Root) -> Finding {
    let finding = Finding::about(
        Area::Kernel,
        "preemption",
        "PREEMPT_RT",
        "other kernels keep the latency short on average, without a bound; no plan is refused for it, since \
         realtime = \"require\" concerns rights only: --measure shows whether this host carries the period",
    );
    let Some(model) = preemption_by(|path| root.get(path.trim_start_matches('/'))) else {
        return finding.unknown("/proc/version cannot be read");
    };
    if model == "PREEMPT_RT" {
        return finding.good(model);
    }
    // What it is set to now, if this user may see it, else what it was started with.
    let now = model.split_once('(').map(|(_, mode)| mode.trim_end_matches(')'));
    let started = root.boot("preempt");
    let full = now.or(started.as_deref()) == Some("full");
    let finding = match (now, &started) {
        (None, Some(mode)) if model == "PREEMPT_DYNAMIC" => finding.poor(format!("{model} ({mode}) at boot")),
        _ => finding.poor(&model),
    };
    let rt = "install a kernel with PREEMPT_RT (Debian: apt install linux-image-rt-amd64)";
    let back = "choose the old kernel in the boot loader";
    if full || !model.starts_with("PREEMPT_DYNAMIC") {
        return finding.fix(rt, back);
    }
    // At run time only where it is known what to go back to.
    let (step, undo) = match now {
        Some(old) => (write("full", PREEMPT), write(old, PREEMPT)),
        None => {
            ("preempt=full on the kernel command line".to_owned(), "remove preempt=full again".to_owned())
        }
    };
    finding.fix(format!("{rt}\nor at least {step}"), format!("{back}\n{undo}"))
}

fn throttling(root: &Root, subject: &Subject) -> Finding {
    let finding = Finding::about(
        Area::Kernel,
        "RT throttling",
        "a budget that this plan never uses up",
        "real-time threads that use up their budget lose the core until the period ends; the rest of the \
         period keeps a shell usable when a loop never sleeps",
    );
    let file = |name: &str| root.text(&format!("proc/sys/kernel/{name}"));
    let (runtime, period) = match (file("sched_rt_runtime_us"), file("sched_rt_period_us")) {
        (Ok(runtime), Ok(period)) => (runtime, period),
        (Err(error), _) | (_, Err(error)) => {
            return finding.unread("proc/sys/kernel/sched_rt_runtime_us", &error);
        }
    };
    let Some(limits) = throttling_of(&runtime, &period) else {
        return finding.unknown(format!("/proc/sys/kernel/sched_rt_runtime_us says {runtime}"));
    };
    let set = |value: &str| format!("sudo sysctl -w kernel.sched_rt_runtime_us={value}");
    let Some(runtime_us) = limits.runtime_us else {
        return finding.good("off (-1)");
    };
    let found = share(runtime_us * 1_000, limits.period_us * 1_000);
    if runtime_us == 0 {
        return finding.bad(format!("{found}: no real-time thread may run")).fix(set("950000"), set("0"));
    }
    if starvation(&subject.cycle, &limits).is_some() {
        return finding.bad(format!("{found}, and this plan spins for more than half of every period")).fix(
            format!("wait = \"poll\" or a shorter guard in [cycle]\nor, on a core of its own, {}", set("-1")),
            set(&runtime),
        );
    }
    finding.good(found)
}

fn fair_server(root: &Root, subject: &Subject) -> Finding {
    let finding = Finding::about(
        Area::Kernel,
        "fair server",
        "a plan that leaves normal threads more than this",
        "it gives the core to normal threads that a loop starves, whatever RT throttling is set to",
    );
    let version = root.get("proc/sys/kernel/osrelease").and_then(|release| version(&release));
    if version.is_some_and(|version| version < FAIR_SERVER_SINCE) {
        return finding.good("none before Linux 6.12");
    }
    let path = format!("sys/kernel/debug/sched/fair_server/cpu{}/runtime", subject.core);
    let number = |path: &str| Some(root.get(path)?.parse::<u64>().ok());
    let runtime_ns = match root.text(&path) {
        Ok(text) => text.parse::<u64>().ok(),
        Err(error) if error.kind() == ErrorKind::NotFound && !root.has("sys/kernel/debug/sched") => {
            return finding.unknown("debugfs is not mounted, or this user may not read it");
        }
        Err(error) => return finding.unread(&path, &error),
    };
    let period_ns = number(&path.replace("runtime", "period")).flatten();
    let (Some(runtime_ns), Some(period_ns)) = (runtime_ns, period_ns) else {
        return finding.unknown(format!("/{path} holds no number"));
    };
    let found = share(runtime_ns, period_ns);
    let left = Throttling {
        runtime_us: Some(period_ns.saturating_sub(runtime_ns) / 1_000),
        period_us: period_ns / 1_000,
    };
    if runtime_ns > 0 && starvation(&subject.cycle, &left).is_some() {
        return finding
            .poor(format!("{found}, and this plan spins for more than half of every period"))
            .fix(write(0, &path), write(runtime_ns, &path));
    }
    finding.good(format!("{found}, for starving normal threads"))
}

fn share(part_ns: u64, whole_ns: u64) -> String {
    format!("{} of every {}", Ns(part_ns), Ns(whole_ns))
}

/// Of a release like `6.12.1-rt7`.
fn version(release: &str) -> Option<(u32, u32)> {
    let mut numbers = release.split(|c: char| !c.is_ascii_digit());
    Some((numbers.next()?.parse().ok()?, numbers.next()?.parse().ok()?))
}

/// A number that sysctl(8) sets, as rt-config/host/99-fieldbeat-sysctl.conf has it.
pub(super) struct Sysctl {
    pub area: Area,
    pub name: &'static str,
    /// The path below /proc/sys.
    pub path: &'static str,
    pub wanted: i64,
    /// Whether more is good, too.
    pub or_more: bool,
    pub why: &'static str,
}

impl Sysctl {
    pub fn check(&self, root: &Root) -> Finding {
        let Sysctl { area, name, wanted, .. } = *self;
        let or_more = if self.or_more { " or more" } else { "" };
        let mut finding = Finding::about(area, name, format!("{wanted}{or_more}"), self.why);
        let path = format!("proc/sys/{}", self.path);
        // What is not built in has no file.
        if !root.has(&path) {
            return finding.good("this kernel has no such setting");
        }
        let Some(text) = finding.read(root, &path) else { return finding };
        match text.parse::<i64>() {
            Ok(value) if value == wanted || (self.or_more && value > wanted) => finding.good(text),
            Ok(_) => {
                let key = self.path.replace('/', ".");
                let set = |value: &str| format!("sudo sysctl -w {key}={value}");
                let fix = format!("{}\n{}", set(&wanted.to_string()), keep("99-fieldbeat-sysctl.conf"));
                finding.poor(text.as_str()).fix(fix, set(&text))
            }
            Err(_) => finding.unknown(format!("/{path} says {text}")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Verdict::{Bad, Good, Poor, Unknown};
    use crate::facts::testing::{Host, subject};
    use fieldbeat_core::cycle::Wait;

    const DYNAMIC: (&str, &str) = ("proc/version", "Linux version 6.18.0 (a@b) #1 SMP PREEMPT_DYNAMIC @0\n");

    #[test]
    fn preemption_is_judged_by_the_mode_that_is_known() {
        let check = |files: &[(&str, &str)]| preemption(&Host::new(files).0.root);
        assert_eq!(check(&[("sys/kernel/realtime", "1\n")]).verdict, Good);
        assert_eq!(check(&[]).verdict, Unknown);

        let blind = check(&[DYNAMIC]);
        assert_eq!((blind.verdict, blind.found.as_str()), (Poor, "PREEMPT_DYNAMIC"));
        assert!(blind.fix.unwrap().contains("preempt=full on the kernel command line"));

        let started = check(&[DYNAMIC, ("proc/cmdline", "quiet preempt=full")]);
        assert_eq!(started.found, "PREEMPT_DYNAMIC (full) at boot");
        assert!(!started.fix.unwrap().contains("preempt="));

        let lazy = check(&[DYNAMIC, ("sys/kernel/debug/sched/preempt", "none voluntary full (lazy)\n")]);
        assert_eq!(lazy.found, "PREEMPT_DYNAMIC (lazy)");
        assert!(lazy.fix.unwrap().contains("echo full | sudo tee /sys/kernel/debug/sched/preempt"));
        assert!(lazy.undo.unwrap().contains("echo lazy | sudo tee /sys/kernel/debug/sched/preempt"));

        let old = check(&[("proc/version", "Linux version 4.19.0 #1 SMP Debian 4.19.1")]);
        assert_eq!((old.verdict, old.found.as_str()), (Poor, "none or voluntary"));
    }

    fn budget(runtime: &str) -> [(&str, &str); 2] {
        [
            ("proc/sys/kernel/sched_rt_runtime_us", runtime),
            ("proc/sys/kernel/sched_rt_period_us", "1000000\n"),
        ]
    }

    #[test]
    fn throttling_refuses_a_plan_that_spins_and_a_budget_of_nothing() {
        let mut plan = subject();
        let check = |runtime: &str, plan: &Subject| throttling(&Host::new(&budget(runtime)).0.root, plan);
        assert_eq!(check("950000\n", &plan).found, "950 ms of every 1 s");
        assert_eq!(check("950000\n", &plan).verdict, Good);
        assert_eq!(check("-1\n", &plan).verdict, Good);
        assert_eq!(check("much\n", &plan).verdict, Unknown);
        assert_eq!(throttling(&Host::new(&[]).0.root, &plan).verdict, Unknown);
        let nothing = check("0\n", &plan);
        assert_eq!(
            (nothing.verdict, nothing.undo.as_deref()),
            (Bad, Some("sudo sysctl -w kernel.sched_rt_runtime_us=0"))
        );
        plan.cycle.wait = Wait::Spin;
        plan.cycle.receive_deadline = 0.8;
        let spinning = check("950000\n", &plan);
        assert_eq!(spinning.verdict, Bad);
        assert!(spinning.fix.unwrap().contains("kernel.sched_rt_runtime_us=-1"));
        assert_eq!(check("-1\n", &plan).verdict, Good);
    }

    #[test]
    fn the_fair_server_matters_to_a_loop_that_starves_others() {
        let mut plan = subject();
        let runtime = "sys/kernel/debug/sched/fair_server/cpu3/runtime";
        let period = "sys/kernel/debug/sched/fair_server/cpu3/period";
        let check = |files: &[(&str, &str)], plan: &Subject| fair_server(&Host::new(files).0.root, plan);
        let usual = [(runtime, "50000000\n"), (period, "1000000000\n")];
        assert_eq!(check(&usual, &plan).found, "50 ms of every 1 s, for starving normal threads");
        assert_eq!(check(&usual, &plan).verdict, Good);
        plan.cycle.wait = Wait::Spin;
        plan.cycle.receive_deadline = 0.8;
        let spinning = check(&usual, &plan);
        assert_eq!(spinning.verdict, Poor);
        assert_eq!(spinning.fix.unwrap(), format!("echo 0 | sudo tee /{runtime}"));
        assert_eq!(spinning.undo.unwrap(), format!("echo 50000000 | sudo tee /{runtime}"));
        assert_eq!(check(&[(runtime, "0"), (period, "1000000000")], &plan).verdict, Good);

        assert_eq!(check(&[("proc/sys/kernel/osrelease", "6.1.0-13-amd64\n")], &plan).verdict, Good);
        assert_eq!(check(&[("proc/sys/kernel/osrelease", "6.18.44\n")], &plan).verdict, Unknown);
        assert_eq!(check(&[("sys/kernel/debug/sched/preempt", "(full)")], &plan).verdict, Unknown);
    }

    #[test]
    fn a_setting_is_as_wanted_or_named_with_both_commands() {
        let setting = |or_more: bool| Sysctl {
            area: Area::Memory,
            name: "x",
            path: "vm/x",
            wanted: 10,
            or_more,
            why: "",
        };
        let check =
            |text: &str, or_more: bool| setting(or_more).check(&Host::new(&[("proc/sys/vm/x", text)]).0.root);
        assert_eq!(check("10\n", false).verdict, Good);
        assert_eq!(check("11\n", true).verdict, Good);
        assert_eq!(check("9\n", true).verdict, Poor);
        let more = check("11\n", false);
        assert_eq!((more.verdict, more.undo.as_deref()), (Poor, Some("sudo sysctl -w vm.x=11")));
        assert!(more.fix.unwrap().starts_with("sudo sysctl -w vm.x=10\n"));
        assert_eq!(check("ten\n", false).verdict, Unknown);
        assert_eq!(setting(false).check(&Host::new(&[]).0.root).verdict, Good);
    }
}
