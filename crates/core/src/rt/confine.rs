//! What a thread gives up once it needs it no longer: rights, and system calls.
//!
//! Both hold for the calling thread and for whatever it starts from then on, never for another thread, and nothing
//! takes them back. What is kept after the start, and why:
//!
//! | thread | keeps |
//! |---|---|
//! | the loop, the watch, the signals, the operation of axes, metrics, control | nothing: all is open, priorities set |
//! | the link thread | [`Keep::Files`], for a serial port that is opened again; a connection needs no right |
//! | telemetry, recorder, black box, checkpoints, the scope, who called the start | [`Keep::Files`] |
//! | simulated drives | nothing: low ports and raw frames stay open, also without a cable |
//!
//! All of them keep CAP_IPC_LOCK where a limit of locked memory is set: of a process that is locked as a whole the
//! kernel counts whatever a thread allocates from then on against that limit, unless the thread has this right.

use std::collections::BTreeMap;
use std::io;

use libc::c_long;
use seccompiler::{
    BackendError, BpfProgram, Error, SeccompAction, SeccompCmpArgLen, SeccompCmpOp, SeccompCondition,
    SeccompFilter, SeccompRule, TargetArch,
};

use super::rights::{Capability, memlock_limit};

#[cfg(any(target_arch = "x86_64", target_arch = "aarch64", target_arch = "riscv64"))]
mod calls;
/// There are no filters for this architecture.
#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64", target_arch = "riscv64")))]
mod calls {
    use super::Only;

    pub const OF_EVERY_THREAD: &[libc::c_long] = &[];
    pub const TO_START_THREADS: &[libc::c_long] = &[];
    pub const TO_SERVE: &[libc::c_long] = &[];
    pub const TO_REACH_A_MASTER: &[libc::c_long] = &[];
    pub const READING: &[Only] = &[];
    pub const UNIX_SOCKETS: &[Only] = &[];
}

pub use calls::{OF_EVERY_THREAD, TO_START_THREADS};
use calls::{READING, TO_REACH_A_MASTER, TO_SERVE, UNIX_SOCKETS};

/// The rights that a thread keeps of those of its process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Keep {
    /// Nothing.
    Nothing,
    /// CAP_DAC_OVERRIDE, if root has it: it writes where root wants a file, whoever owns the directory.
    Files,
}

/// Takes all capabilities but those that it is to `keep` from the calling thread, and lets nothing that it executes
/// gain any (PR_SET_NO_NEW_PRIVS). Whoever has none loses none.
pub fn give_up_rights(keep: Keep) {
    // Cannot fail since Linux 3.5; refused by a filter around the process, the thread is as free as that lets it be.
    let _ = nix::sys::prctl::set_no_new_privs();
    let of_files = (keep == Keep::Files).then_some(Capability::DacOverride);
    let of_memory = memlock_limit().is_some().then_some(Capability::IpcLock);
    let kept = of_files.into_iter().chain(of_memory).fold(0, |set, right| set | 1_u64 << right as u32);
    // Fewer rights than before are never refused, but by such a filter.
    let _ = keep_capabilities(kept);
}

/// Reduces the capabilities of the calling thread to those of this set (capset(2)); the ambient ones follow.
fn keep_capabilities(kept: u64) -> io::Result<()> {
    /// Effective, permitted and inheritable ones; the lower 32 of them, and the upper ones.
    type Sets = [[u32; 3]; 2];
    // _LINUX_CAPABILITY_VERSION_3 of linux/capability.h; and 0, the calling thread.
    let mut header: [u32; 2] = [0x2008_0522, 0];
    let mut sets = Sets::default();
    // SAFETY: the kernel reads and writes the header, and writes both halves of the sets.
    if unsafe { libc::syscall(libc::SYS_capget, header.as_mut_ptr(), sets.as_mut_ptr()) } != 0 {
        return Err(io::Error::last_os_error());
    }
    for (half, sets) in sets.iter_mut().enumerate() {
        for set in sets {
            *set &= (kept >> (32 * half)) as u32;
        }
    }
    // SAFETY: the kernel reads the header and both halves of the sets.
    match unsafe { libc::syscall(libc::SYS_capset, header.as_mut_ptr(), sets.as_ptr()) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// A system call that is allowed if one of its arguments, counted from 0, has this `value` where `mask` has ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Only {
    /// The number.
    pub call: c_long,
    /// The argument.
    pub argument: u8,
    /// The bits that count, of the lower 32.
    pub mask: u32,
    /// The required value.
    pub value: u32,
}

/// Who serves others, and so reads what they send.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Server {
    /// The metrics: HTTP, on one thread.
    Metrics,
    /// The control socket: a thread a conversation.
    Control,
    /// The page in the browser: HTTP and websockets, and what feeds it from a master in another process.
    Scope,
}

/// Leaves to the calling thread, and to those that it starts, what a server needs to answer on sockets that are open:
/// it opens no file for writing, executes nothing, and makes no socket; the scope makes those to masters of this
/// computer.
///
/// # Errors
///
/// As of [`allow_only`].
pub fn serve_only(server: Server) -> io::Result<()> {
    let mut calls = [OF_EVERY_THREAD, TO_SERVE].concat();
    let mut only = READING.to_vec();
    match server {
        Server::Metrics => {}
        Server::Control => calls.extend(TO_START_THREADS),
        Server::Scope => {
            calls.extend(TO_START_THREADS);
            calls.extend(TO_REACH_A_MASTER);
            only.extend(UNIX_SOCKETS);
        }
    }
    allow_only(&calls, &only)
}

/// Whether this kernel, and the container around this process, let a thread give up system calls.
///
/// # Errors
///
/// They do not, or there are no filters for this architecture.
pub fn can_filter() -> io::Result<()> {
    let tried = || allow_only(OF_EVERY_THREAD, &[]);
    std::thread::Builder::new().name("fb-filter".into()).spawn(tried)?.join().unwrap_or(Ok(()))
}

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
mod tests;
