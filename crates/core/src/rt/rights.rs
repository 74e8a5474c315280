//! What this process may do, and the messages for what it may not: limits and capabilities, read before they are
//! needed, and refusals that end with their remedy.
//!
//! Knows nothing of plans: whether a refusal is an error is for `thread` to say.

use std::fs;
use std::io;

use nix::sys::resource::{RLIM_INFINITY, Resource, getrlimit};

/// The priority that the remedies grant: above every sensible loop, below the kernel's own threads at 99 (migration,
/// watchdog), which must be able to interrupt it.
const GRANTED_RTPRIO: u8 = 95;

/// A capability (capabilities(7)); the value is its bit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Capability {
    /// CAP_DAC_OVERRIDE: files of other users, whatever their mode.
    DacOverride = 1,
    /// CAP_IPC_LOCK: lock any amount of memory.
    IpcLock = 14,
    /// CAP_SYS_NICE: any scheduling policy and priority.
    SysNice = 23,
}

/// A right that is missing. The text is one line and ends with the remedy.
#[derive(thiserror::Error)]
pub enum Denied {
    /// The user may not use SCHED_FIFO at this priority.
    #[error(
        "no right for SCHED_FIFO {priority} (RLIMIT_RTPRIO is {limit}): run `{}`, or put `@realtime - rtprio \
         {GRANTED_RTPRIO}` into /etc/security/limits.d/ and log in anew as a member of the group realtime",
        setcap()
    )]
    Fifo {
        /// The requested priority.
        priority: u8,
        /// The highest priority allowed, 0 = none.
        limit: u64,
    },
    /// The kernel refuses SCHED_FIFO to a privileged thread: it checks more than capabilities.
    #[error(
        "SCHED_FIFO {priority} is refused although CAP_SYS_NICE is held: a control group without real-time \
         budget or a container's system call filter forbids it; start from the root control group (or set \
         its cpu.rt_runtime_us), outside the container"
    )]
    FifoGroup {
        /// The requested priority.
        priority: u8,
    },
    /// The user may not lock so much memory.
    #[error(
        "no right to lock {} (RLIMIT_MEMLOCK is {limit_kib} KiB): run `{}`, or put \
         `@realtime - memlock unlimited` into /etc/security/limits.d/ and log in again as a member of the \
         group realtime",
        amount(*.need_kib),
        setcap()
    )]
    Memlock {
        /// The required size, KiB. `None`: without /proc this process does not know its own.
        need_kib: Option<u64>,
        /// The highest allowed size, KiB.
        limit_kib: u64,
    },
    /// A system call failed for another reason.
    #[error("{call} failed: {error}; see `man 2 {call}`")]
    Call {
        /// The name of the call.
        call: &'static str,
        /// The kernel's error.
        error: io::Error,
    },
}
crate::debug_as_display!(Denied);

/// An amount of memory.
pub fn amount(kib: Option<u64>) -> String {
    match kib {
        Some(kib) => format!("{kib} KiB of memory"),
        None => "the memory of this process, whose size only /proc says".to_owned(),
    }
}

/// True if the calling thread holds `capability` with effect on the whole machine. Inside a user namespace (a rootless
/// container) it does not, whatever its sets say: RT priorities and memory locks are checked against the initial one.
pub(super) fn holds(capability: Capability) -> bool {
    let initial_namespace = fs::read_to_string("/proc/self/uid_map").is_ok_and(|map| is_initial(&map));
    initial_namespace
        && fs::read_to_string("/proc/thread-self/status")
            .is_ok_and(|status| effective(&status) & (1 << capability as u64) != 0)
}

/// The highest priority that RLIMIT_RTPRIO allows, 0 = none (getrlimit(2)).
#[allow(clippy::unnecessary_cast, reason = "rlim_t has 32 bits on 32-bit systems")]
pub(super) fn rtprio_limit() -> u64 {
    getrlimit(Resource::RLIMIT_RTPRIO).map_or(0, |(soft, _)| soft as u64)
}

/// The bytes that RLIMIT_MEMLOCK allows to lock; `None` = any number.
#[allow(clippy::unnecessary_cast, reason = "rlim_t has 32 bits on 32-bit systems")]
pub(super) fn memlock_limit() -> Option<u64> {
    getrlimit(Resource::RLIMIT_MEMLOCK)
        .map_or(Some(0), |(soft, _)| (soft != RLIM_INFINITY).then_some(soft as u64))
}

/// One mapping of all 2^32 - 1 users onto themselves (user_namespaces(7)).
fn is_initial(uid_map: &str) -> bool {
    uid_map.split_whitespace().eq(["0", "0", "4294967295"])
}

fn effective(status: &str) -> u64 {
    status
        .lines()
        .find_map(|line| line.strip_prefix("CapEff:"))
        .and_then(|set| u64::from_str_radix(set.trim(), 16).ok())
        .unwrap_or(0)
}

/// The command that grants both rights to this very program.
pub fn setcap() -> String {
    grant("cap_sys_nice,cap_ipc_lock")
}

/// The command that grants these capabilities, and no others, to this very program, for its owner and members of the
/// group `realtime`: whoever may execute it has them. The group comes first, since a new one would take them away again
/// (chown(2)).
pub fn grant(capabilities: &str) -> String {
    let program = program();
    format!(
        "sudo groupadd -f realtime && sudo chgrp realtime {program} && sudo chmod 750 {program} && sudo setcap \
         {capabilities}+ep {program}"
    )
}

/// This very program, quoted for a shell.
pub fn program() -> String {
    let program = std::env::current_exe().map_or("PROGRAM".to_owned(), |path| path.display().to_string());
    let plain = |c: char| c.is_ascii_alphanumeric() || "/._-+".contains(c);
    let quote = if program.chars().all(plain) { "" } else { "'" };
    format!("{quote}{program}{quote}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_capabilities() {
        let status =
            "Name:\tx\nCapPrm:\t0000000000000000\nCapEff:\t0000000000804000\nCapBnd:\t000001ffffffffff\n";
        assert_eq!(effective(status), 1 << 14 | 1 << 23);
        assert_eq!(effective("Name:\tx\n"), 0);
    }

    #[test]
    fn a_container_without_root_is_not_the_initial_namespace() {
        assert!(is_initial("         0          0 4294967295\n"));
        assert!(!is_initial("         0       1000          1\n"));
        assert!(!is_initial("0 1000 1\n1 100000 65536\n"));
    }

    #[test]
    fn refusals_name_the_limit_and_this_program() {
        let program = std::env::current_exe().unwrap_or_default().display().to_string();
        for (denied, limit) in [
            (Denied::Fifo { priority: 80, limit: 20 }, "RLIMIT_RTPRIO is 20"),
            (
                Denied::Memlock { need_kib: Some(100_000), limit_kib: 8_192 },
                "no right to lock 100000 KiB of memory (RLIMIT_MEMLOCK is 8192 KiB)",
            ),
            (
                Denied::Memlock { need_kib: None, limit_kib: 64 },
                "lock the memory of this process, whose size only /proc says (RLIMIT_MEMLOCK is 64 KiB)",
            ),
        ] {
            let text = denied.to_string();
            assert!(text.contains(limit), "{text}");
            assert!(
                text.contains("setcap cap_sys_nice,cap_ipc_lock+ep ") && text.contains(&program),
                "{text}"
            );
            assert!(!text.contains('\n') && !text.contains("  "), "{text}");
        }
    }
}
