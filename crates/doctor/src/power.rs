//! How fast the core runs, and how deep it sleeps.
//!
//! Sources: Documentation/admin-guide/pm/cpufreq.rst, cpuidle.rst (idle states, PM QoS and /dev/cpu_dma_latency).

use super::Subject;
use super::facts::{Facts, Root};
use super::finding::{Area, Finding, keep, lines, write};
use fieldbeat_core::time::{Ns, US};

/// All of them.
pub(super) fn check(facts: &Facts, subject: &Subject) -> Vec<Finding> {
    vec![governor(&facts.root, subject), idle(&facts.root, subject)]
}

fn governor(root: &Root, subject: &Subject) -> Finding {
    let finding = Finding::about(
        Area::Power,
        "governor",
        "performance",
        "others lower the clock of a mostly idle core, as the loop's is, and raise it again too late",
    );
    let path = format!("sys/devices/system/cpu/cpu{}/cpufreq/scaling_governor", subject.core);
    match root.text(&path) {
        Ok(governor) if governor == "performance" => finding.good(governor),
        Ok(governor) => finding
            .fix(format!("{}\n{}", write("performance", &path), keep("tuned/")), write(&governor, &path))
            .poor(governor),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => finding
            .unknown("the kernel does not control this core's frequency; in a virtual machine the host may"),
        Err(error) => finding.unread(&path, &error),
    }
}

/// An idle state.
struct State {
    number: String,
    name: String,
    exit_us: u64,
}

/// The largest share of what counts as late that a wake-up from idle may take.
const SHARE: u64 = 10;

fn idle(root: &Root, subject: &Subject) -> Finding {
    let core = subject.core;
    let most_us = (subject.cycle.late_ns() / SHARE / US).max(1);
    let finding = Finding::about(
        Area::Power,
        "idle states",
        format!("none that takes longer than {most_us} us to leave"),
        "the core sleeps when the loop's timer fires, and leaving the idle state adds to every wake-up; a \
         tenth of the late limit is allowed for it",
    );
    let directory = format!("sys/devices/system/cpu/cpu{core}/cpuidle");
    let state = |number: String| {
        let file = |name: &str| root.get(&format!("{directory}/{number}/{name}"));
        let enabled = file("disable").is_none_or(|disabled| disabled == "0");
        let (name, exit_us) = (file("name")?, file("latency")?.parse().ok()?);
        enabled.then_some(State { number, name, exit_us })
    };
    let numbers = root.names(&directory).into_iter().filter(|name| name.starts_with("state"));
    let mut states: Vec<State> = numbers.filter_map(state).collect();
    if states.is_empty() {
        return finding.unknown(
            "the kernel does not control this core's idle states; in a virtual machine the host does",
        );
    }
    // The bound that somebody holds open keeps all cores out of what takes longer. Not everybody may read it.
    let bound = root.word("dev/cpu_dma_latency").ok().and_then(|us| u64::try_from(us).ok());
    states.retain(|state| bound.is_none_or(|bound| state.exit_us <= bound));
    states.sort_by_key(|state| state.exit_us);
    let held = match bound {
        Some(bound) if bound < i32::MAX as u64 / 2 => format!(", /dev/cpu_dma_latency held at {bound} us"),
        _ => String::new(),
    };
    let Some(deepest) = states.last() else { return finding.good(format!("none{held}")) };
    let found = format!("down to {}, {} to leave{held}", deepest.name, Ns(deepest.exit_us * US));
    let deep: Vec<&State> = states.iter().filter(|state| state.exit_us > most_us).collect();
    if deep.is_empty() {
        return finding.good(found);
    }
    let each = |value| lines(&deep, |state| write(value, &format!("{directory}/{}/disable", state.number)));
    let fix = format!("{}\n{}", each(1), keep("tuned/"));
    finding.poor(found).fix(fix, each(0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Verdict::{Good, Poor, Unknown};
    use crate::facts::testing::{Host, subject};

    #[test]
    fn the_governor_is_put_back_to_what_it_was() {
        let path = "sys/devices/system/cpu/cpu3/cpufreq/scaling_governor";
        let check = |files: &[(&str, &str)]| governor(&Host::new(files).0.root, &subject());
        assert_eq!(check(&[(path, "performance\n")]).verdict, Good);
        let saving = check(&[(path, "schedutil\n")]);
        assert_eq!((saving.verdict, saving.found.as_str()), (Poor, "schedutil"));
        assert!(saving.fix.unwrap().starts_with(&format!("echo performance | sudo tee /{path}\n")));
        assert_eq!(saving.undo.unwrap(), format!("echo schedutil | sudo tee /{path}"));
        assert_eq!(check(&[]).verdict, Unknown);
    }

    const STATES: [(&str, &str); 7] = [
        ("sys/devices/system/cpu/cpu3/cpuidle/state0/name", "POLL\n"),
        ("sys/devices/system/cpu/cpu3/cpuidle/state0/latency", "0\n"),
        ("sys/devices/system/cpu/cpu3/cpuidle/state1/name", "C1\n"),
        ("sys/devices/system/cpu/cpu3/cpuidle/state1/latency", "2\n"),
        ("sys/devices/system/cpu/cpu3/cpuidle/state2/name", "C6\n"),
        ("sys/devices/system/cpu/cpu3/cpuidle/state2/latency", "133\n"),
        ("sys/devices/system/cpu/cpu3/cpuidle/state2/disable", "0\n"),
    ];

    #[test]
    fn deep_states_are_named_unless_they_are_off_or_out_of_bounds() {
        let plan = subject();
        let host = || Host::new(&STATES);
        let deep = idle(&host().0.root, &plan);
        assert_eq!((deep.verdict, deep.found.as_str()), (Poor, "down to C6, 133 us to leave"));
        assert!(
            deep.fix
                .unwrap()
                .starts_with("echo 1 | sudo tee /sys/devices/system/cpu/cpu3/cpuidle/state2/disable")
        );
        let off = host().with(&[("sys/devices/system/cpu/cpu3/cpuidle/state2/disable", "1\n")]);
        let off = idle(&off.0.root, &plan);
        assert_eq!((off.verdict, off.found.as_str()), (Good, "down to C1, 2 us to leave"));

        let held = host();
        std::fs::create_dir_all(held.0.root.0.join("dev")).unwrap();
        std::fs::write(held.0.root.0.join("dev/cpu_dma_latency"), 0_i32.to_ne_bytes()).unwrap();
        assert_eq!(
            idle(&held.0.root, &plan).found,
            "down to POLL, 0 to leave, /dev/cpu_dma_latency held at 0 us"
        );
        assert_eq!(idle(&Host::new(&[]).0.root, &plan).verdict, Unknown);
    }
}
