//! The system calls that threads may still make, each list with its reason. What is refused fails with EPERM, so that a
//! library that tries a newer call first sees no "there is none": both are listed.

use libc::c_long;

use super::Only;

/// The calls of the C library and the standard library on every thread.
pub const OF_EVERY_THREAD: &[c_long] = &[
    // Memory; and how many cores there are, for its arenas.
    libc::SYS_sched_getaffinity,
    libc::SYS_brk,
    libc::SYS_madvise,
    libc::SYS_mmap,
    libc::SYS_mprotect,
    libc::SYS_mremap,
    libc::SYS_munmap,
    // The seeds of hash tables, and of the allocator.
    libc::SYS_getrandom,
    // Locks, channels, `park`.
    libc::SYS_futex,
    libc::SYS_sched_yield,
    // Clocks, where the vDSO cannot read them, and sleeps.
    libc::SYS_clock_gettime,
    libc::SYS_clock_nanosleep,
    libc::SYS_nanosleep,
    // Who it is. Nobody expects these to fail: a refusal would read as a number.
    libc::SYS_getegid,
    libc::SYS_geteuid,
    libc::SYS_getgid,
    libc::SYS_getpid,
    libc::SYS_getppid,
    libc::SYS_gettid,
    libc::SYS_getuid,
    // What is open already: messages to standard error, pipes and sockets.
    libc::SYS_close,
    libc::SYS_read,
    libc::SYS_write,
    libc::SYS_writev,
    // Handlers of signals, and what aborts.
    libc::SYS_restart_syscall,
    libc::SYS_rt_sigaction,
    libc::SYS_rt_sigprocmask,
    libc::SYS_rt_sigreturn,
    libc::SYS_sigaltstack,
    libc::SYS_tgkill,
    // The end.
    libc::SYS_exit,
    libc::SYS_exit_group,
];

/// The additional calls of a thread that starts others.
pub const TO_START_THREADS: &[c_long] = &[
    // One or the other, by the C library.
    libc::SYS_clone,
    libc::SYS_clone3,
    libc::SYS_rseq,
    libc::SYS_set_robust_list,
    // The name of the thread.
    libc::SYS_prctl,
    // The size of its stack.
    libc::SYS_prlimit64,
];

/// The additional calls of a server, on sockets that are open.
pub const TO_SERVE: &[c_long] = &[
    // Its clients.
    libc::SYS_accept4,
    libc::SYS_getpeername,
    libc::SYS_getsockname,
    libc::SYS_getsockopt,
    libc::SYS_recvfrom,
    libc::SYS_recvmsg,
    libc::SYS_sendmsg,
    libc::SYS_sendto,
    libc::SYS_setsockopt,
    libc::SYS_shutdown,
    // Which of them has said something.
    libc::SYS_epoll_ctl,
    libc::SYS_epoll_pwait,
    libc::SYS_ppoll,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_epoll_wait,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_poll,
    // O_NONBLOCK, by either.
    libc::SYS_fcntl,
    libc::SYS_ioctl,
    // How many descriptors may be open.
    libc::SYS_prlimit64,
    // The length of a file that is read: facts about the host.
    libc::SYS_fstat,
    libc::SYS_lseek,
    libc::SYS_newfstatat,
    libc::SYS_statx,
];

/// The additional calls of the scope to find and reach the masters of this computer.
pub const TO_REACH_A_MASTER: &[c_long] = &[
    libc::SYS_connect,
    // A display in the master's own process.
    libc::SYS_socketpair,
    // The directories with their sockets.
    libc::SYS_getdents64,
    // The whole path of the configuration.
    libc::SYS_getcwd,
    libc::SYS_readlinkat,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_readlink,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_lstat,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_stat,
];

/// Opens what exists, for reading.
const fn to_read(call: c_long, argument: u8) -> Only {
    let mask = (libc::O_ACCMODE | libc::O_CREAT | libc::O_TRUNC) as u32;
    Only { call, argument, mask, value: libc::O_RDONLY as u32 }
}

/// Files that exist may be opened for reading.
pub const READING: &[Only] = &[
    to_read(libc::SYS_openat, 2),
    // As musl has it.
    #[cfg(target_arch = "x86_64")]
    to_read(libc::SYS_open, 1),
];

/// A socket is one to a process of this computer.
pub const UNIX_SOCKETS: &[Only] =
    &[Only { call: libc::SYS_socket, argument: 0, mask: u32::MAX, value: libc::AF_UNIX as u32 }];
