//! Why a bus cannot be opened.

use std::io::ErrorKind;
use std::net::SocketAddrV4;

use thiserror::Error;

use crate::errors::no_descriptor;
use crate::net::lock::Refused;

/// Why a bus could not be opened. The message ends with the remedy.
#[derive(Error)]
#[non_exhaustive]
pub enum OpenError {
    /// A socket could not be opened.
    #[error("bus {bus}: cannot bind {address}: {source}; {remedy}")]
    Bind {
        /// The bus.
        bus: String,
        /// The address to bind.
        address: SocketAddrV4,
        /// The operating system's error.
        source: std::io::Error,
        /// The remedy.
        remedy: &'static str,
    },
    /// The connections of a bus could not be set up.
    #[error(
        "bus {bus}: cannot set up its connections: {source}; {}",
        no_descriptor(.source).unwrap_or("look at the limits of open files and threads (ulimit -a)")
    )]
    Streams {
        /// The bus.
        bus: String,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// An interface could not be opened.
    #[error("bus {bus}: cannot use interface {interface}: {source}; {remedy}")]
    Interface {
        /// The bus.
        bus: String,
        /// The interface.
        interface: String,
        /// The operating system's error.
        source: std::io::Error,
        /// The remedy.
        remedy: String,
    },
    /// Another master of this host uses the same interface or drive.
    #[error("bus {bus}: {what} {why}")]
    InUse {
        /// The bus.
        bus: String,
        /// The interface, or the drive with its address.
        what: String,
        /// Who uses it, and the remedy.
        why: Refused,
    },
    /// Another master already exchanges frames on the segment.
    #[error(
        "bus {bus}: another master ({mac}) already has frames on {interface}: end it, or look where the \
         cable leads"
    )]
    OtherMaster {
        /// The bus.
        bus: String,
        /// The interface.
        interface: String,
        /// The Ethernet address of that master.
        mac: String,
    },
    /// The segment is in use, and a master for one drive only would disturb it.
    #[error(
        "bus {bus}: {what}, and nothing may disturb it: go through the master that runs it; if that has \
         died, start it again with `fieldbeat run`, or switch the slave off and on"
    )]
    Running {
        /// The bus.
        bus: String,
        /// The resource in use.
        what: String,
    },
    /// The plan of a drive contradicts itself.
    #[error("bus {bus}, drive {drive}: its cyclic parameters cannot be exchanged; `check` shows why")]
    Plan {
        /// The bus.
        bus: String,
        /// The drive.
        drive: String,
    },
}
crate::debug_as_display!(OpenError);

impl OpenError {
    /// The socket of this bus could not be opened at this address.
    #[doc(hidden)]
    pub fn bind(bus: &str, address: SocketAddrV4, source: std::io::Error) -> OpenError {
        let remedy = match source.kind() {
            ErrorKind::AddrInUse => {
                "another master holds this port: end it (ss -ulpn shows which), or give this bus another \
                 bind address"
            }
            ErrorKind::AddrNotAvailable => {
                "this host has no such address: `ip -4 addr` lists those it has; put one of them into bind"
            }
            ErrorKind::PermissionDenied => "ports below 1024 need CAP_NET_BIND_SERVICE",
            _ => no_descriptor(&source).unwrap_or("look at the address in bind"),
        };
        OpenError::Bind { bus: bus.into(), address, source, remedy }
    }
}
