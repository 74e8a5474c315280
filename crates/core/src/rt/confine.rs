//! What a thread gives up once it needs it no longer: system calls that it never makes.
//!
//! Both hold for the calling thread and for whatever it starts from then on, never for another thread, and nothing
//! takes them back.

use std::collections::BTreeMap;
use std::io;

use libc::c_long;
use seccompiler::{
    BackendError, BpfProgram, Error, SeccompAction, SeccompCmpArgLen, SeccompCmpOp, SeccompCondition,
    SeccompFilter, SeccompRule, TargetArch,
};

/// What every thread calls without being asked: the C library and Rust's own, for memory, locks, clocks and the end.
pub const OF_EVERY_THREAD: [c_long; 21] = [
    // Memory.
    libc::SYS_brk,
    libc::SYS_madvise,
    libc::SYS_mmap,
    libc::SYS_mprotect,
    libc::SYS_mremap,
    libc::SYS_munmap,
    // Locks, channels, `park`.
    libc::SYS_futex,
    libc::SYS_sched_yield,
    // Clocks, where the vDSO cannot read them, and sleeps.
    libc::SYS_clock_gettime,
    libc::SYS_clock_nanosleep,
    libc::SYS_nanosleep,
    // Its own name, number and stack: a panic prints them.
    libc::SYS_getpid,
    libc::SYS_gettid,
    libc::SYS_sigaltstack,
    // Messages to stderr; whatever was opened before.
    libc::SYS_write,
    // Handlers of signals, and what aborts.
    libc::SYS_restart_syscall,
    libc::SYS_rt_sigprocmask,
    libc::SYS_rt_sigreturn,
    libc::SYS_tgkill,
    // The end.
    libc::SYS_exit,
    libc::SYS_exit_group,
];

/// What a thread calls in addition that starts others.
pub const TO_START_THREADS: [c_long; 7] = [
    libc::SYS_clone,
    // Before glibc 2.34 it was `clone`; a refusal by EPERM is not answered by a second attempt.
    libc::SYS_clone3,
    libc::SYS_rseq,
    libc::SYS_set_robust_list,
    // Its name.
    libc::SYS_prctl,
    // The size of the main thread's stack.
    libc::SYS_prlimit64,
    libc::SYS_sched_getaffinity,
];

/// A system call that is allowed if one of its arguments, counted from 0, has this `value` where `mask` has ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Only {
    /// Its number.
    pub call: c_long,
    /// The argument.
    pub argument: u8,
    /// The bits that count, of the lower 32.
    pub mask: u32,
    /// What they have to be.
    pub value: u32,
}

/// Opens files that exist, for reading.
pub const OPEN_TO_READ: Only = Only {
    call: libc::SYS_openat,
    argument: 2,
    mask: (libc::O_ACCMODE | libc::O_CREAT | libc::O_TRUNC) as u32,
    value: libc::O_RDONLY as u32,
};

/// Refuses the calling thread, and what it starts, every system call but `calls` (seccomp(2)). A refused one fails with
/// EPERM: it is an error of the one request that led to it, and the thread goes on for the others.
///
/// The thread gains no rights by a file that it executes either (PR_SET_NO_NEW_PRIVS): without that only root may
/// install a filter. Calls through the tables of another architecture kill the process.
///
/// `only` are further ones, which are allowed with certain arguments.
///
/// # Errors
///
/// `Unsupported`: no filters for this architecture. Another one: the kernel, or the container around it, refuses
/// filters. The thread may do what it could before.
pub fn allow_only(calls: &[c_long], only: &[Only]) -> io::Result<()> {
    let unsupported = |error| io::Error::new(io::ErrorKind::Unsupported, error);
    let arch: TargetArch = std::env::consts::ARCH.try_into().map_err(unsupported)?;
    let compiled = || -> Result<BpfProgram, BackendError> {
        let mut rules: BTreeMap<_, _> = calls.iter().map(|call| (*call, Vec::new())).collect();
        for Only { call, argument, mask, value } in only {
            let (length, equals) = (SeccompCmpArgLen::Dword, SeccompCmpOp::MaskedEq(u64::from(*mask)));
            let condition = SeccompCondition::new(*argument, length, equals, u64::from(*value))?;
            rules.entry(*call).or_default().push(SeccompRule::new(vec![condition])?);
        }
        let refused = SeccompAction::Errno(libc::EPERM as u32);
        SeccompFilter::new(rules, refused, SeccompAction::Allow, arch)?.try_into()
    };
    let filter = compiled().map_err(|error| io::Error::new(io::ErrorKind::InvalidInput, error))?;
    seccompiler::apply_filter(&filter).map_err(|error| match error {
        Error::Prctl(error) | Error::Seccomp(error) => error,
        other => io::Error::other(other),
    })
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use super::*;

    /// Whether the calling thread may open a file for reading, and for writing.
    fn opens() -> [Option<i32>; 2] {
        let refused = |opened: io::Result<File>| opened.err().and_then(|error| error.raw_os_error());
        [refused(File::open("/dev/null")), refused(File::options().write(true).open("/dev/null"))]
    }

    fn no_new_privileges() -> bool {
        nix::sys::prctl::get_no_new_privs().unwrap()
    }

    #[test]
    #[cfg_attr(
        not(any(target_arch = "x86_64", target_arch = "aarch64", target_arch = "riscv64")),
        ignore = "needs filters of system calls for this architecture"
    )]
    fn a_filter_refuses_what_it_does_not_list_to_its_thread_and_to_those_that_it_starts() {
        let before = no_new_privileges();
        std::thread::spawn(|| {
            let calls = [&OF_EVERY_THREAD[..], &TO_START_THREADS, &[libc::SYS_close]].concat();
            assert_eq!(opens(), [None; 2]);
            allow_only(&calls, &[OPEN_TO_READ]).unwrap();
            assert_eq!(opens(), [None, Some(libc::EPERM)]);
            assert!(no_new_privileges());
            let started = std::thread::Builder::new().name("started".to_owned()).spawn(opens).unwrap();
            assert_eq!(started.join().unwrap(), [None, Some(libc::EPERM)]);
        })
        .join()
        .unwrap();
        assert_eq!((opens(), no_new_privileges()), ([None; 2], before));
    }

    #[test]
    #[cfg_attr(
        not(any(target_arch = "x86_64", target_arch = "aarch64", target_arch = "riscv64")),
        ignore = "needs filters of system calls for this architecture"
    )]
    fn a_filter_is_added_to_those_before_it() {
        std::thread::spawn(|| {
            let calls =
                [&OF_EVERY_THREAD[..], &[libc::SYS_close, libc::SYS_seccomp, libc::SYS_prctl]].concat();
            allow_only(&calls, &[OPEN_TO_READ]).unwrap();
            allow_only(&calls, &[]).unwrap();
            assert_eq!(opens(), [Some(libc::EPERM); 2]);
        })
        .join()
        .unwrap();
    }
}
