//! A process of its own that outlives this one: how it is started, and what it does to itself.
//!
//! It is started by `posix_spawn`, never by `fork`: a copy of this process would break its locked memory. It gets
//! descriptors by their numbers, and no signal. It starts itself once more, so that it is nobody's child here: a
//! program that waits for its children does not find it.

use std::ffi::{CStr, CString, OsString};
use std::io;
use std::os::fd::{AsRawFd, BorrowedFd, FromRawFd, OwnedFd, RawFd};
use std::os::unix::ffi::OsStringExt;
use std::path::Path;

use nix::errno::Errno;
use nix::fcntl::OFlag;
use nix::spawn::{PosixSpawnAttr, PosixSpawnFileActions, PosixSpawnFlags, posix_spawn};
use nix::sys::signal::{SigSet, Signal, kill};
use nix::sys::stat::Mode;
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::{ForkResult, Pid, fork, setsid};

/// The name of the guardian of a master (comm, proc(5)).
pub const GUARDIAN: &CStr = c"fb-guardian";

/// The number of the first descriptor that a process gets from this one with so many, above all of theirs: each is put
/// in its place before another one needs that.
fn first_of(descriptors: &[BorrowedFd<'_>]) -> RawFd {
    descriptors.iter().map(AsRawFd::as_raw_fd).fold(libc::STDERR_FILENO, RawFd::max) + 1
}

/// A process that was started. Once it is [detached](detach), or has failed, it is to be [reaped](Child::reap).
#[derive(Debug)]
pub struct Child(Pid);

impl Child {
    /// Takes its end; one that has not [detached](detach) itself, as a program that knows nothing of that, is killed.
    pub fn reap(self, is_detached: bool) {
        // One that somebody else has taken is not there any more.
        if !is_detached && waitpid(self.0, Some(WaitPidFlag::WNOHANG)) == Ok(WaitStatus::StillAlive) {
            let _ = kill(self.0, Signal::SIGKILL);
        }
        // Whoever waits for all children of this process may have found it first.
        while waitpid(self.0, None) == Err(Errno::EINTR) {}
    }
}

/// Starts `program` with these descriptors, at consecutive numbers; `arguments` gets the first one. Its standard ones
/// are /dev/null, and all signals are blocked.
///
/// # Errors
///
/// It cannot be started.
pub fn spawn(
    program: &Path,
    descriptors: &[BorrowedFd<'_>],
    arguments: impl FnOnce(RawFd) -> Vec<CString>,
) -> io::Result<Child> {
    let first = first_of(descriptors);
    let mut files = PosixSpawnFileActions::init()?;
    // First, since one of them may have the number of a standard one that is closed here.
    for (number, descriptor) in (first..).zip(descriptors) {
        files.add_dup2(descriptor.as_raw_fd(), number)?;
    }
    for (number, flags) in [
        (libc::STDIN_FILENO, OFlag::O_RDONLY),
        (libc::STDOUT_FILENO, OFlag::O_WRONLY),
        (libc::STDERR_FILENO, OFlag::O_WRONLY),
    ] {
        files.add_open(number, "/dev/null", flags, Mode::empty())?;
    }
    let mut attributes = PosixSpawnAttr::init()?;
    attributes.set_flags(PosixSpawnFlags::POSIX_SPAWN_SETSIGMASK | PosixSpawnFlags::POSIX_SPAWN_SETSIGDEF)?;
    attributes.set_sigmask(&SigSet::all())?;
    // Ignored ones stay ignored over the start of a program, and those of a fault are not to be.
    let mut faults = SigSet::empty();
    [Signal::SIGSEGV, Signal::SIGBUS, Signal::SIGCHLD].into_iter().for_each(|signal| faults.add(signal));
    attributes.set_sigdefault(&faults)?;
    let variable = |(name, value): (OsString, OsString)| {
        CString::new([name.into_vec(), value.into_vec()].join(&b'=')).ok()
    };
    let environment: Vec<CString> = std::env::vars_os().filter_map(variable).collect();
    Ok(Child(posix_spawn(program, &files, &attributes, &arguments(first), &environment)?))
}

/// The same process as a child of nobody here, in a session of its own: no terminal stops it. Called by the program at
/// its start, while it has one thread.
///
/// # Errors
///
/// It cannot be started once more.
pub fn detach(name: &CStr) -> io::Result<()> {
    // SAFETY: the process has one thread, and so a copy of it is whole.
    if let ForkResult::Parent { .. } = unsafe { fork()? } {
        // SAFETY: ends the process without its handlers: all of it goes on in the copy.
        unsafe { libc::_exit(0) };
    }
    setsid()?;
    nix::sys::prctl::set_name(name)?;
    Ok(())
}

/// The descriptors that it got, from number `first` on. All others are closed. To be called once, before any other is
/// opened.
pub fn received(first: RawFd, count: usize) -> io::Result<Vec<OwnedFd>> {
    let end = i32::try_from(count).ok().and_then(|count| first.checked_add(count));
    let Some(end) = end.filter(|_| first > libc::STDERR_FILENO) else {
        return Err(io::ErrorKind::InvalidInput.into());
    };
    for (from, to) in [(libc::STDERR_FILENO + 1, first - 1), (end, i32::MAX)] {
        if from <= to {
            close_all(from, to);
        }
    }
    let open = |number: RawFd| {
        // SAFETY: takes two numbers.
        Errno::result(unsafe { libc::fcntl(number, libc::F_GETFD) })?;
        // SAFETY: it is open, and nobody else in this process knows its number.
        Ok(unsafe { OwnedFd::from_raw_fd(number) })
    };
    (first..end).map(open).collect()
}

/// Closes descriptors from one number to another.
fn close_all(from: RawFd, to: RawFd) {
    // SAFETY: takes three numbers; nobody in this process has such a descriptor.
    if unsafe { libc::syscall(libc::SYS_close_range, from, to, 0) } == 0 {
        return;
    }
    // A kernel before 5.9.
    let numbers = std::fs::read_dir("/proc/self/fd").into_iter().flatten().flatten();
    let numbers: Vec<RawFd> = numbers.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).collect();
    for number in numbers.into_iter().filter(|number| (from..=to).contains(number)) {
        // SAFETY: as above.
        unsafe { libc::close(number) };
    }
}

/// A descriptor of a process, readable once that has ended (pidfd_open(2)).
///
/// # Errors
///
/// There is none, or the kernel is older than 5.3.
pub fn process_descriptor(process: u32) -> io::Result<OwnedFd> {
    // SAFETY: takes two numbers.
    let number = Errno::result(unsafe { libc::syscall(libc::SYS_pidfd_open, process, 0) })?;
    // SAFETY: new, and so nobody else's.
    Ok(unsafe { OwnedFd::from_raw_fd(number as RawFd) })
}
