//! Locks of what has one master: a network interface, a serial port, or the address of a drive.
//!
//! A lock is a listening Unix socket with an abstract address (unix(7)). It needs no right, leaves nothing in the file
//! system, and the kernel releases it when its process ends, however that ends; a child does not inherit it. Abstract
//! addresses belong to a network namespace, as interfaces do: the lock does not reach into another namespace or to
//! another host. Any user of this host may bind such an address without being a master: a directory would need an
//! owner whom all users trust, and a service that makes it. It is refused then, too: the message names that process and
//! its user, and to go on next to a possible master is worse.

use std::io;
use std::net::SocketAddrV4;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::thread::sleep;
use std::time::{Duration, Instant};

use nix::net::if_::if_nametoindex;
use nix::sys::socket::{
    AddressFamily, SockFlag, SockType, UnixAddr, connect, getsockopt, socket, sockopt::PeerCredentials,
};
use thiserror::Error;

use super::local;
use crate::errors::{no_descriptor, user};
use crate::rt::child::GUARDIAN;

/// A lock is released within this time after its master has ended: a process that is just being started has a copy of
/// it until it executes its program, and a process that was killed may take a moment to die.
const RELEASED_WITHIN: Duration = Duration::from_millis(100);

/// The guardian of a master that has died keeps its locks until the drives are stopped. So long is waited for that: a
/// service that starts again at once does not fail.
const GUARDED_WITHIN: Duration = Duration::from_secs(10);

/// The resource of one master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place<'a> {
    /// A network interface, or `local:NAME`.
    Interface(&'a str),
    /// The address of a drive, whatever is spoken there.
    Drive(SocketAddrV4),
    /// A serial port, or `local:NAME`.
    Port(&'a str),
}

/// A place that is locked for as long as this lives; or a place that needs no lock.
#[derive(Debug, Default)]
pub struct Lock(Option<UnixListener>);

impl Lock {
    /// Something is locked.
    pub fn is_held(&self) -> bool {
        self.0.is_some()
    }

    /// The descriptor that holds it: it is free once no process has this descriptor.
    pub fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.0.as_ref().map(AsFd::as_fd)
    }
}

/// Why a place cannot be locked. The message follows the name of the place.
#[derive(Error)]
pub enum Refused {
    /// This process has locked it.
    #[error("is in use by another master or bus of this process: end that one first")]
    Own,
    /// Another process has locked it.
    #[error("is in use by another master, process {pid}{name}: end that one first")]
    Process {
        /// The id.
        pid: i32,
        /// The name in parentheses, if it can be read.
        name: String,
    },
    /// The guardian of a master keeps it locked.
    #[error(
        "is kept by the guardian (process {pid}) of a master that has died or hangs, which stops the drives: start \
         again in some seconds; if that master hangs, end that master first"
    )]
    Guardian {
        /// The id.
        pid: i32,
    },
    /// A process of another user has locked it, or has taken the name of its lock.
    #[error(
        "is in use by process {pid}{name} of {user}: have that master ended first; if it is none, it only holds the \
         name (`sudo ss -xap` lists its @fieldbeat- socket): `sudo kill {pid}`"
    )]
    Other {
        /// The id.
        pid: i32,
        /// The name in parentheses, if it can be read.
        name: String,
        /// The user, in words.
        user: String,
    },
    /// A process has locked it that this one cannot see.
    #[error(
        "is in use by another master, whose process is not visible from here: end that one first (`sudo ss \
         -xap` lists its @fieldbeat- socket)"
    )]
    Unseen,
    /// The operating system refused.
    #[error(
        "cannot be locked for this master: {0}; {remedy}",
        remedy = no_descriptor(.0).unwrap_or("let this program open Unix sockets (RestrictAddressFamilies)")
    )]
    Failed(io::Error),
}
crate::debug_as_display!(Refused);

impl Place<'_> {
    /// The abstract address. An interface counts by its number, a port by its own path: each may have several names.
    /// `None`: there is no such interface or port, and nobody can use it.
    fn key(self) -> Option<String> {
        Some(match self {
            Place::Interface(interface) => match local::name(interface) {
                // As long as the prefix of the segment's own address, so that each of its names fits.
                Some(name) => format!("fieldbeat-owner/{name}"),
                None => format!("fieldbeat-interface/{}", if_nametoindex(interface).ok()?),
            },
            Place::Drive(address) => format!("fieldbeat-drive/{address}"),
            Place::Port(port) => match local::name(port) {
                Some(_) => format!("fieldbeat-port/{port}"),
                None => format!("fieldbeat-port/{}", std::fs::canonicalize(port).ok()?.display()),
            },
        })
    }

    /// Locks it. For normal threads: a place in use is tried again for a moment.
    pub fn lock(self) -> Result<Lock, Refused> {
        let Some(key) = self.key() else { return Ok(Lock::default()) };
        // A name that is too long is no segment's; opening it says so.
        let Ok(address) = SocketAddr::from_abstract_name(&key) else { return Ok(Lock::default()) };
        let begun = Instant::now();
        loop {
            match UnixListener::bind_addr(&address) {
                Ok(socket) => return Ok(Lock(Some(socket))),
                Err(error) if error.kind() == io::ErrorKind::AddrInUse => {}
                Err(error) => return Err(Refused::Failed(error)),
            }
            if begun.elapsed() > RELEASED_WITHIN {
                match used_by(owner(&key)) {
                    Refused::Guardian { .. } if begun.elapsed() < GUARDED_WITHIN => sleep(RELEASED_WITHIN),
                    refused => return Err(refused),
                }
            }
            sleep(RELEASED_WITHIN / 20);
        }
    }
}

/// Who uses a place, by the process that listens at its address.
fn used_by(owner: Option<Owner>) -> Refused {
    match owner {
        Some(Owner { pid, .. }) if pid.cast_unsigned() == std::process::id() => Refused::Own,
        // A process of a PID namespace that is not below ours has no id here.
        Some(Owner { pid, uid }) if pid > 0 => match name(pid) {
            name if name.as_bytes() == GUARDIAN.to_bytes() => Refused::Guardian { pid },
            name if uid == nix::unistd::geteuid().as_raw() => {
                Refused::Process { pid, name: in_parentheses(name) }
            }
            name => Refused::Other { pid, name: in_parentheses(name), user: user(uid) },
        },
        _ => Refused::Unseen,
    }
}

/// The owner of a lock.
#[derive(Clone, Copy, Debug)]
struct Owner {
    pid: i32,
    uid: u32,
}

/// The process that listens there (SO_PEERCRED of a connection). It never waits: a full queue is no answer.
fn owner(key: &str) -> Option<Owner> {
    let address = UnixAddr::new_abstract(key.as_bytes()).ok()?;
    let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
    let socket = socket(AddressFamily::Unix, SockType::Stream, flags, None).ok()?;
    connect(socket.as_raw_fd(), &address).ok()?;
    let of = getsockopt(&socket, PeerCredentials).ok()?;
    Some(Owner { pid: of.pid(), uid: of.uid() })
}

/// The name of a process; empty if it cannot be read.
fn name(pid: i32) -> String {
    let name = std::fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
    name.trim_end().chars().filter(|char| !char.is_control()).collect()
}

/// A name, if there is one, behind a number.
fn in_parentheses(name: String) -> String {
    if name.is_empty() { name } else { format!(" ({name})") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(place: Place<'_>) -> String {
        place.lock().unwrap_err().to_string()
    }

    #[test]
    fn a_place_is_locked_once_and_free_again_at_once() {
        let [.., a, b] = std::process::id().to_be_bytes();
        let drive = |port| Place::Drive(SocketAddrV4::new([127, 9, a, b].into(), port));
        let name = format!("local:lock-{}", std::process::id());
        for (place, other) in [(drive(502), drive(503)), (Place::Interface(&name), drive(502))] {
            let lock = place.lock().unwrap();
            assert!(lock.is_held());
            assert_eq!(refused(place), Refused::Own.to_string());
            drop(other.lock().unwrap());
            drop(lock);
            drop(place.lock().unwrap());
        }
    }

    #[test]
    fn a_process_of_another_user_is_named_with_him_and_with_what_to_do_if_it_is_no_master() {
        let (pid, uid) = (1, nix::unistd::geteuid().as_raw());
        let said = |uid| used_by(Some(Owner { pid, uid })).to_string();
        assert!(
            said(uid).contains("another master, process 1 ") && !said(uid).contains("user"),
            "{}",
            said(uid)
        );
        let other = said(4_000_000_001);
        for part in ["process 1 (", " of user 4000000001: have", "`sudo ss -xap` lists", "`sudo kill 1`"] {
            assert!(other.contains(part), "no {part}: {other}");
        }
        assert!(matches!(used_by(Some(Owner { pid: 0, uid })), Refused::Unseen));
    }

    #[test]
    fn an_interface_counts_by_its_number_and_what_does_not_exist_needs_no_lock() {
        assert_eq!(Place::Interface("lo").key().unwrap(), "fieldbeat-interface/1");
        assert!(!Place::Interface("nosuch0").lock().unwrap().is_held());
    }

    #[test]
    fn an_address_that_is_bound_without_listening_is_refused_too() {
        let [.., a, b] = std::process::id().to_be_bytes();
        let place = Place::Drive(SocketAddrV4::new([127, 9, a, b].into(), 504));
        let address = UnixAddr::new_abstract(place.key().unwrap().as_bytes()).unwrap();
        let squatter = socket(AddressFamily::Unix, SockType::Stream, SockFlag::SOCK_CLOEXEC, None).unwrap();
        nix::sys::socket::bind(squatter.as_raw_fd(), &address).unwrap();
        assert_eq!(refused(place), Refused::Unseen.to_string());
    }
}
