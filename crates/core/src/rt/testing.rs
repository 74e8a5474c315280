//! Common parts of the tests of this folder: things that must not happen to the process that runs all the other
//! tests.

use std::process::Command;

use nix::sys::resource::{Resource, setrlimit};
use nix::unistd::{Gid, Uid, geteuid, setgid, setgroups, setuid};

/// Set in the child of [`in_own_process`].
const CHILD: &str = "FIELDBEAT_TEST_CHILD";

/// Runs `body` in a process of its own: starts this test program again for the one test `name`, whose failure is ours.
pub(crate) fn in_own_process(name: &str, body: impl FnOnce()) {
    if std::env::var_os(CHILD).is_some() {
        return body();
    }
    let output = Command::new(std::env::current_exe().unwrap())
        .args([name, "--exact", "--include-ignored", "--nocapture"])
        .env(CHILD, "1")
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    assert!(text.contains("1 passed"), "no test of the name {name}: {text}");
}

/// Gives up root, with all its capabilities, for the calling process (`nobody` is 65534 on every distribution).
pub(super) fn become_ordinary() {
    if geteuid().is_root() {
        setgroups(&[]).unwrap();
        setgid(Gid::from_raw(65534)).unwrap();
        setuid(Uid::from_raw(65534)).unwrap();
    }
}

/// Sets RLIMIT_MEMLOCK, in bytes. False if refused: to raise it takes CAP_SYS_RESOURCE, which root in a container or a
/// small virtual machine may lack.
#[must_use]
pub(super) fn limit_memlock(bytes: u64) -> bool {
    setrlimit(Resource::RLIMIT_MEMLOCK, bytes, bytes).is_ok()
}

/// Sets RLIMIT_RTPRIO. False if refused, as above.
#[must_use]
pub(super) fn limit_rtprio(priority: u64) -> bool {
    setrlimit(Resource::RLIMIT_RTPRIO, priority, priority).is_ok()
}

/// The memory that this process has locked, KiB.
pub(super) fn locked_kib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmLck:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}
