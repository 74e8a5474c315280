//! Why a connection is not open, in words: each with its remedy.

use std::net::SocketAddrV4;

use crate::net::stream::{Broken, StreamPeer};
use crate::time::Ns;

/// When a connection broke.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum During {
    Opening,
    Handshake,
    Session,
}

pub(super) fn no_answer(peer: SocketAddrV4, waited_ns: u64) -> String {
    format!(
        "no answer from {peer} within {}: look at the address, the cable and the drive's power",
        Ns(waited_ns)
    )
}

pub(super) fn no_handshake(peer: SocketAddrV4, waited_ns: u64) -> String {
    format!(
        "{peer} accepts connections, but does not answer within {}: is it the right port of the right \
         device?",
        Ns(waited_ns)
    )
}

pub(super) fn broken(target: &StreamPeer, why: Broken, when: During) -> String {
    let peer = target.address;
    match why {
        Broken::Closed | Broken::Failed(libc::ECONNRESET | libc::EPIPE) | Broken::Absent
            if when == During::Session =>
        {
            format!("{peer} has ended the connection")
        }
        Broken::Closed | Broken::Failed(libc::ECONNRESET | libc::EPIPE) | Broken::Absent => format!(
            "{peer} ends the connection at once: its connections may all be in use, or it may not accept \
             this computer"
        ),
        Broken::Failed(libc::ECONNREFUSED) => {
            format!(
                "refused: nobody listens at {peer}; look at the address, the port, and whether the service \
                 is enabled"
            )
        }
        Broken::Failed(libc::ETIMEDOUT) if when == During::Handshake => {
            format!("{peer} was lost during the handshake: look at the cable and the drive's power")
        }
        Broken::Failed(libc::ETIMEDOUT) if when == During::Session => {
            format!("{peer} was lost: look at the cable and the drive's power")
        }
        Broken::Failed(libc::ETIMEDOUT) => no_answer(peer, target.connect_ns),
        Broken::Failed(libc::EHOSTUNREACH) => {
            format!(
                "no device has the address of {peer}: look at the address, the cable and the drive's power"
            )
        }
        Broken::Failed(libc::ENETUNREACH) => {
            format!(
                "no network leads to {peer}: look at the address and at this computer's interfaces (ip \
                 address)"
            )
        }
        Broken::Failed(errno) => {
            let error = std::io::Error::from_raw_os_error(errno);
            match target.bind {
                Some(bind) if errno == libc::EADDRNOTAVAIL => format!(
                    "no connection to {peer} from {bind}: this host has no such address; `ip -4 addr` lists \
                     those it has, put one of them into bind"
                ),
                // Of a loopback address, or of another network.
                Some(bind) if errno == libc::EINVAL => format!(
                    "no connection to {peer} from {bind}: they are not on one network; put the address of \
                     the drive's network into bind"
                ),
                _ => format!("no connection to {peer}: {error}"),
            }
        }
    }
}
