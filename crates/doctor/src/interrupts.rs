//! The interrupts of what a bus is connected by: on which cores they run, and which threads handle them.
//!
//! Source: Documentation/core-api/irq/irq-affinity.rst.

use std::io;

use super::Subject;
use super::core::others;
use super::facts::{Root, Thread};
use super::finding::{Finding, lines, list, write};
use fieldbeat_core::cycle::Wait;
use fieldbeat_core::rt::host::cores_of;

/// The interrupts that serve a bus.
#[derive(Debug)]
pub(super) struct Served<'a> {
    /// The bus' name.
    pub bus: &'a str,
    /// Their numbers.
    pub interrupts: Vec<u32>,
    /// Why they belong on other cores than the loop's.
    pub why: &'a str,
    /// The part that has none.
    pub none: &'a str,
}

/// The priority that the kernel gives interrupt threads (kernel/irq/manage.c, sched_set_fifo).
const USUAL_PRIORITY: u8 = 50;

impl Served<'_> {
    /// Those that run on `core`: where they go now, as older kernels report only where they may. Otherwise the file
    /// that cannot be read.
    pub fn on(&self, root: &Root, core: usize) -> Result<Vec<u32>, (String, io::Error)> {
        let mut on_core = Vec::new();
        for irq in &self.interrupts {
            let now = root.text(&format!("proc/irq/{irq}/effective_affinity_list"));
            let now = now.or_else(|_| root.text(&path(*irq))).map_err(|error| (path(*irq), error))?;
            if cores_of(&now).is_some_and(|cores| cores.contains(&core)) {
                on_core.push(*irq);
            }
        }
        Ok(on_core)
    }

    pub fn affinity(&self, root: &Root, subject: &Subject) -> Finding {
        let Served { bus, interrupts, why, none } = self;
        let core = subject.core;
        let finding = Finding::network(bus, "interrupts", &format!("on other cores than {core}"), why);
        if interrupts.is_empty() {
            return finding.good(format!("none of its own: {none}"));
        }
        let on_core = match self.on(root, core) {
            Ok(on_core) => on_core,
            Err((path, error)) => return finding.unread(&path, &error),
        };
        if on_core.is_empty() {
            return finding.good(format!("{} elsewhere", numbers(interrupts)));
        }
        let away = list(&others(root, core));
        let finding = finding.poor(format!("{} on core {core}", numbers(&on_core)));
        if away.is_empty() {
            return finding.advise("no setting helps: this is the only core");
        }
        let before = |irq| root.get(&path(irq)).unwrap_or_else(|| core.to_string());
        let moved = lines(&on_core, |irq| write(&away, &path(*irq)));
        finding.fix(
            format!("{moved}\nor irqaffinity={away} on the kernel command line"),
            lines(&on_core, |irq| write(before(*irq), &path(*irq))),
        )
    }

    /// On PREEMPT_RT, and with threadirqs, interrupts are handled by threads.
    pub fn threads(&self, root: &Root, subject: &Subject) -> Finding {
        let Served { bus, interrupts, none, .. } = self;
        let (core, priority) = (subject.core, subject.cycle.priority);
        let finding = Finding::network(
            bus,
            "interrupt threads",
            &format!("SCHED_FIFO {USUAL_PRIORITY} or above, away from a core whose loop spins"),
            "a reply is delivered only after they ran; on the core of a spinning loop of higher priority \
             they never run",
        );
        if interrupts.is_empty() {
            return finding.good(format!("none: {none}"));
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
            return finding
                .poor(format!("{}, on core {core} below a loop that spins", names(&starved)))
                .advise(
                    "move its interrupts to another core, as above; their threads follow\n\
                 or set wait = \"poll\" in [cycle]",
                );
        }
        finding.good(names(&threads.iter().collect::<Vec<_>>()))
    }
}

fn path(irq: u32) -> String {
    format!("proc/irq/{irq}/smp_affinity_list")
}

/// In words.
pub(super) fn numbers(interrupts: &[u32]) -> String {
    let all = interrupts.iter().map(u32::to_string).collect::<Vec<_>>().join(", ");
    format!("irq {all}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Verdict::{Good, Poor, Unknown};
    use crate::facts::testing::{Host, KTHREADD, subject};

    const ONLINE: (&str, &str) = ("sys/devices/system/cpu/online", "0-3\n");

    fn served(interrupts: &[u32]) -> Served<'static> {
        Served {
            bus: "linmot",
            interrupts: interrupts.into(),
            why: "it is slow",
            none: "a virtual interface",
        }
    }

    #[test]
    fn interrupts_belong_on_other_cores() {
        let check = |files: &[(&str, &str)], irqs: &[u32]| {
            served(irqs).affinity(&Host::new(files).0.root, &subject())
        };
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
        let check = |host: Host, plan: &Subject| served(&[31]).threads(&host.0.root, plan);
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
}
