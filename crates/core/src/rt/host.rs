//! Facts about this host for a summary: without kernel, preemption model and stolen time, a latency says little.
//!
//! Plain functions over /proc and /sys, for normal threads (they open files and allocate). What this kernel does
//! not report is `None`, never a guess.

use std::fs;
use std::path::PathBuf;

use nix::unistd::User;

/// The name of this host (/proc/sys/kernel/hostname).
pub fn name() -> Option<String> {
    line("/proc/sys/kernel/hostname")
}

/// The release of the kernel, e.g. `6.12.1-rt7` (/proc/sys/kernel/osrelease).
pub fn kernel() -> Option<String> {
    line("/proc/sys/kernel/osrelease")
}

/// The preemption model: `PREEMPT_RT`, `PREEMPT_DYNAMIC (full)`, `PREEMPT_DYNAMIC`, `PREEMPT`, or `none or voluntary`.
///
/// The mode in brackets is the present setting of PREEMPT_DYNAMIC; only a reader of debugfs can know it.
pub fn preemption() -> Option<String> {
    preemption_by(line)
}

/// The same, by whatever reads a file.
pub fn preemption_by(line: impl Fn(&str) -> Option<String>) -> Option<String> {
    // Exists, with 1 in it, on PREEMPT_RT kernels only.
    if line("/sys/kernel/realtime").as_deref() == Some("1") {
        return Some("PREEMPT_RT".to_owned());
    }
    let model = preemption_of(&line("/proc/version")?);
    let mode = line("/sys/kernel/debug/sched/preempt").and_then(|modes| chosen(&modes));
    Some(match mode {
        Some(mode) if model == "PREEMPT_DYNAMIC" => format!("{model} ({mode})"),
        _ => model.to_owned(),
    })
}

/// The model of the first processor (`model name` of /proc/cpuinfo), or of the board where there is a device tree.
pub fn cpu() -> Option<String> {
    let info = fs::read_to_string("/proc/cpuinfo").ok()?;
    cpu_of(&info).or_else(|| line("/proc/device-tree/model"))
}

/// Time that the hypervisor gave to others while this machine wanted to run, ms since boot, of one core or (`None`)
/// of all together (`steal` of /proc/stat, proc(5)). Counted by ticks: as coarse as 10 ms. 0 on bare metal.
pub fn steal_ms(core: Option<usize>) -> Option<u64> {
    steal_ms_of(&fs::read_to_string("/proc/stat").ok()?, core)
}

/// As [`steal_ms`], of a text of /proc/stat.
pub(super) fn steal_ms_of(stat: &str, core: Option<usize>) -> Option<u64> {
    // SAFETY: takes no pointer and has no precondition.
    let ticks_per_s = u64::try_from(unsafe { libc::sysconf(libc::_SC_CLK_TCK) }).ok().filter(|hz| *hz > 0)?;
    Some(steal_of(stat, core)? * 1_000 / ticks_per_s)
}

/// The cores that are online, in order (/sys/devices/system/cpu/online).
pub fn online_cores() -> Option<Vec<usize>> {
    cores_of(&line("/sys/devices/system/cpu/online")?)
}

/// How much of a core real-time threads may take: `runtime_us` of every `period_us`
/// (/proc/sys/kernel/sched_rt_runtime_us and sched_rt_period_us, sched(7)).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Throttling {
    /// The budget, us; `None` = not limited (-1).
    pub runtime_us: Option<u64>,
    /// The period that it is refilled in, us.
    pub period_us: u64,
}

/// The throttling of real-time threads as set.
///
/// Since Linux 6.12 it binds only kernels built with CONFIG_RT_GROUP_SCHED. On all of them each core has a "fair
/// server" besides: by default 50 ms of every second for normal threads that real-time threads starve, which this
/// setting does not switch off (/sys/kernel/debug/sched/fair_server). Either way a loop that never sleeps loses about 5
/// %.
pub fn rt_throttling() -> Option<Throttling> {
    throttling_of(
        &line("/proc/sys/kernel/sched_rt_runtime_us")?,
        &line("/proc/sys/kernel/sched_rt_period_us")?,
    )
}

/// The speed of a network interface, Mbit/s; `None`: it has none, or is down (/sys/class/net/NAME/speed).
pub fn link_speed(interface: &str) -> Option<u64> {
    line(&format!("/sys/class/net/{interface}/speed"))?.parse().ok().filter(|speed| *speed > 0)
}

/// Where files of this program go if nobody says otherwise: the state directory of the service, or that of the user.
pub fn state_directory() -> PathBuf {
    let of = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    of("STATE_DIRECTORY").or_else(|| Some(of("XDG_STATE_HOME")?.join("fieldbeat"))).unwrap_or_else(|| {
        // Never a directory that others may write to.
        let home = User::from_uid(nix::unistd::geteuid()).ok().flatten().map(|user| user.dir);
        of("HOME").or(home).unwrap_or_default().join(".local/state/fieldbeat")
    })
}

/// A file's text without surrounding white space and the NUL that ends device-tree strings.
fn line(path: &str) -> Option<String> {
    let text = fs::read_to_string(path).ok()?;
    Some(text.trim_matches(|c: char| c.is_whitespace() || c == '\0').to_owned())
}

/// The words behind `#` of /proc/version name the model (scripts/mkcompile_h and init/Makefile of the kernel); the
/// absence of any means PREEMPT_NONE or PREEMPT_VOLUNTARY.
fn preemption_of(version: &str) -> &'static str {
    let build = version.rsplit_once('#').map_or(version, |(_, build)| build);
    ["PREEMPT_RT", "PREEMPT_DYNAMIC", "PREEMPT"]
        .into_iter()
        .find(|model| build.split_whitespace().any(|word| word == *model))
        .unwrap_or("none or voluntary")
}

/// The word in brackets, e.g. `full` of `none voluntary (full) lazy`.
fn chosen(modes: &str) -> Option<String> {
    let (_, rest) = modes.split_once('(')?;
    let (mode, _) = rest.split_once(')')?;
    Some(mode.to_owned())
}

fn cpu_of(cpuinfo: &str) -> Option<String> {
    cpuinfo.lines().filter_map(|line| line.split_once(':')).find_map(|(key, value)| {
        (key.trim() == "model name" && !value.trim().is_empty()).then(|| value.trim().to_owned())
    })
}

/// Ticks of `steal`: the eighth number of the line `cpu` or `cpuN`.
pub fn steal_of(stat: &str, core: Option<usize>) -> Option<u64> {
    let label = core.map_or_else(|| "cpu".to_owned(), |core| format!("cpu{core}"));
    let line = stat.lines().find(|line| line.split_whitespace().next() == Some(&label))?;
    line.split_whitespace().nth(8)?.parse().ok()
}

/// A list as the kernel writes it: `0-2,5`.
pub fn cores_of(list: &str) -> Option<Vec<usize>> {
    let mut cores = Vec::new();
    for part in list.split(',').filter(|part| !part.is_empty()) {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        cores.extend(first.parse::<usize>().ok()?..=last.parse().ok()?);
    }
    Some(cores)
}

/// The throttling by the kernel's two settings, both in µs; `None`: they are no numbers.
pub fn throttling_of(runtime: &str, period: &str) -> Option<Throttling> {
    let runtime: i64 = runtime.parse().ok()?;
    Some(Throttling { runtime_us: u64::try_from(runtime).ok(), period_us: period.parse().ok()? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_the_preemption_model() {
        for (version, model) in [
            ("Linux version 6.12.9-rt (gcc 14 #2) #1 SMP PREEMPT_RT Debian 6.12.9-1", "PREEMPT_RT"),
            ("Linux version 6.18.44 (b@h) (gcc (GCC) 15.3.0) #1 SMP PREEMPT_DYNAMIC @0", "PREEMPT_DYNAMIC"),
            ("Linux version 5.4.0 (b@h) #1 SMP PREEMPT Thu Jan 1 00:00:00 UTC 2020", "PREEMPT"),
            ("Linux version 4.19.0 (b@h) #1 SMP Debian 4.19.1", "none or voluntary"),
        ] {
            assert_eq!(preemption_of(version), model, "{version}");
        }
        assert_eq!(chosen("none voluntary (full) lazy").as_deref(), Some("full"));
        assert_eq!(chosen("none"), None);
    }

    #[test]
    fn reads_the_processor_its_cores_its_steal_and_its_throttling() {
        let info = "processor\t: 0\nmodel\t\t: 1\nmodel name\t: AMD EPYC\n";
        assert_eq!(cpu_of(info).as_deref(), Some("AMD EPYC"));
        assert_eq!(cpu_of("processor\t: 0\nBogoMIPS\t: 108.00\n"), None);
        let stat =
            "cpu  10 0 20 300 4 0 5 60 0 0\ncpu0 5 0 10 150 2 0 2 20 0 0\ncpu1 5 0 10 150 2 0 3 40 0 0\n";
        assert_eq!([None, Some(1), Some(2)].map(|core| steal_of(stat, core)), [Some(60), Some(40), None]);
        // Before Linux 2.6.11 there was no such column.
        assert_eq!(steal_of("cpu 1 2 3 4 5 6 7\n", None), None);
        for (list, cores) in
            [("0-2,5", Some(vec![0, 1, 2, 5])), ("3", Some(vec![3])), ("", Some(vec![])), ("0-x", None)]
        {
            assert_eq!(cores_of(list), cores, "{list}");
        }
        let throttled = |runtime_us| Some(Throttling { runtime_us, period_us: 1_000_000 });
        assert_eq!(throttling_of("950000", "1000000"), throttled(Some(950_000)));
        assert_eq!(throttling_of("-1", "1000000"), throttled(None), "minus one is none");
        assert_eq!(throttling_of("", "1000000"), None);
    }

    #[test]
    fn this_host_reports_kernel_cores_and_steal() {
        assert!(kernel().is_some_and(|release| !release.is_empty()));
        assert!(preemption().is_some());
        let cores = online_cores().unwrap_or_default();
        assert!(!cores.is_empty());
        let all = steal_ms(None).unwrap_or(0);
        let one = cores.first().and_then(|core| steal_ms(Some(*core))).unwrap_or(0);
        assert!(one <= all + 1_000, "{one} of {all}");
    }
}
