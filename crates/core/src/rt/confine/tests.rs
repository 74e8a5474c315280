use std::fs::File;

use super::*;
use crate::rt::testing::in_own_process;

/// Why a call failed; `None`: it did not.
fn refused<T>(result: io::Result<T>) -> Option<i32> {
    result.err().and_then(|error| error.raw_os_error())
}

/// Whether the calling thread may open a file for reading, and for writing.
fn opens() -> [Option<i32>; 2] {
    [refused(File::open("/dev/null")), refused(File::options().write(true).open("/dev/null"))]
}

fn socket(family: i32, kind: i32) -> io::Result<()> {
    // SAFETY: plain numbers.
    match unsafe { libc::socket(family, kind, 0) } {
        -1 => Err(io::Error::last_os_error()),
        descriptor => {
            // SAFETY: it is ours and nobody else knows it.
            unsafe { libc::close(descriptor) };
            Ok(())
        }
    }
}

/// execve(2) of what does not exist.
fn execute() -> io::Result<()> {
    let [path, end] = [c"/no/such/program".as_ptr(), std::ptr::null()];
    // SAFETY: a path and two empty lists; if it returns, it has failed.
    unsafe { libc::execve(path, [end].as_ptr(), [end].as_ptr()) };
    Err(io::Error::last_os_error())
}

fn no_new_privileges() -> bool {
    nix::sys::prctl::get_no_new_privs().unwrap()
}

/// The capabilities of the calling thread: permitted, effective, ambient.
fn capabilities() -> [u64; 3] {
    let status = std::fs::read_to_string("/proc/thread-self/status").unwrap();
    ["CapPrm:", "CapEff:", "CapAmb:"].map(|name| {
        let set = status.lines().find_map(|line| line.strip_prefix(name)).unwrap();
        u64::from_str_radix(set.trim(), 16).unwrap()
    })
}

fn on_a_thread<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    std::thread::scope(|scope| scope.spawn(work).join().unwrap())
}

const EPERM: Option<i32> = Some(libc::EPERM);

#[test]
#[cfg_attr(
    not(any(target_arch = "x86_64", target_arch = "aarch64", target_arch = "riscv64")),
    ignore = "needs filters of system calls for this architecture"
)]
fn a_filter_refuses_what_it_does_not_list_to_its_thread_and_to_those_that_it_starts() {
    let before = no_new_privileges();
    on_a_thread(|| {
        let calls = [OF_EVERY_THREAD, TO_START_THREADS].concat();
        assert_eq!(opens(), [None; 2]);
        allow_only(&calls, READING).unwrap();
        assert_eq!(opens(), [None, EPERM]);
        assert!(no_new_privileges());
        let started = std::thread::Builder::new().name("started".to_owned()).spawn(opens).unwrap();
        assert_eq!(started.join().unwrap(), [None, EPERM]);
    });
    assert_eq!((opens(), no_new_privileges()), ([None; 2], before));
}

#[test]
#[cfg_attr(
    not(any(target_arch = "x86_64", target_arch = "aarch64", target_arch = "riscv64")),
    ignore = "needs filters of system calls for this architecture"
)]
fn a_server_writes_no_file_executes_nothing_and_makes_no_socket_but_to_a_master() {
    can_filter().unwrap();
    for server in [Server::Metrics, Server::Control, Server::Scope] {
        on_a_thread(|| {
            assert_eq!(refused(execute()), Some(libc::ENOENT));
            let who = || (nix::unistd::geteuid(), nix::unistd::getegid(), nix::unistd::getpid());
            let before = who();
            serve_only(server).unwrap();
            assert_eq!(who(), before, "what says whom a request is for");
            assert_eq!(opens(), [None, EPERM], "{server:?}");
            let new = std::env::temp_dir().join(format!("fieldbeat-new-{}", std::process::id()));
            assert_eq!(refused(File::create_new(new)), EPERM, "{server:?}");
            assert_eq!(refused(execute()), EPERM, "{server:?}");
            for (family, kind) in [(libc::AF_PACKET, libc::SOCK_RAW), (libc::AF_INET, libc::SOCK_DGRAM)] {
                assert_eq!(refused(socket(family, kind)), EPERM, "{server:?}");
            }
            let unix = (server != Server::Scope).then_some(libc::EPERM);
            assert_eq!(refused(socket(libc::AF_UNIX, libc::SOCK_STREAM)), unix, "{server:?}");
            let starts = std::thread::Builder::new().spawn(|| ()).is_ok();
            assert_eq!(starts, server != Server::Metrics, "{server:?}");
        });
    }
}

#[test]
fn a_confined_thread_gains_no_rights_by_a_file_and_leaves_other_threads_alone() {
    let before = (no_new_privileges(), capabilities());
    on_a_thread(|| {
        give_up_rights(Keep::Nothing);
        let kept = if memlock_limit().is_some() { 1 << Capability::IpcLock as u32 } else { 0 };
        assert!(no_new_privileges());
        assert!(capabilities().into_iter().all(|set| set & !kept == 0));
        // Again is no error, and takes nothing more.
        give_up_rights(Keep::Files);
        assert!(capabilities().into_iter().all(|set| set & !kept == 0));
    });
    assert_eq!((no_new_privileges(), capabilities()), before);
}

#[test]
#[ignore = "needs root: capabilities to keep, and a file of another user"]
fn root_keeps_what_files_and_locked_memory_need() {
    use crate::rt::testing::limit_memlock;
    in_own_process("rt::confine::tests::root_keeps_what_files_and_locked_memory_need", || {
        let others = tempfile::tempdir().unwrap();
        std::os::unix::fs::chown(others.path(), Some(65534), Some(65534)).unwrap();
        let (files, memory) = (1 << Capability::DacOverride as u32, 1 << Capability::IpcLock as u32);
        // To lift a limit takes a right that root in a container may lack.
        let growing = if limit_memlock(libc::RLIM_INFINITY) { 0 } else { memory };
        on_a_thread(|| {
            give_up_rights(Keep::Files);
            assert_eq!(capabilities(), [files | growing, files | growing, 0]);
            assert_eq!(refused(File::create(others.path().join("by root"))), None);
            give_up_rights(Keep::Nothing);
            assert_eq!(capabilities(), [growing, growing, 0]);
            assert_eq!(refused(File::create(others.path().join("by nobody"))), Some(libc::EACCES));
        });
        assert!(limit_memlock(64 << 10));
        crate::rt::memory::lock_process().unwrap();
        on_a_thread(|| {
            give_up_rights(Keep::Nothing);
            assert_eq!(capabilities(), [memory, memory, 0]);
            // Far beyond the limit: it would be refused, and an allocation ends the process then.
            assert_eq!(vec![1_u8; 32 << 20].iter().filter(|byte| **byte == 1).count(), 32 << 20);
        });
    });
}
