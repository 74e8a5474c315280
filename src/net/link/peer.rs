//! Where a connection leads, and whose handshake or session it has.

use std::net::{Ipv4Addr, SocketAddrV4};

use crate::net::session::{Session, SessionPeer};
use crate::net::stream::{Greeting, StreamPeer};

/// Where a connection leads, and how long its steps may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Target {
    /// The address that the peer listens at.
    pub address: SocketAddrV4,
    /// The address of this host that it leaves from.
    pub bind: Option<Ipv4Addr>,
    /// The longest opening, ns.
    pub connect_ns: u64,
    /// The longest handshake, ns.
    pub greeting_ns: u64,
    /// The pause after a first failure, ns.
    pub least_pause_ns: u64,
    /// The longest pause, ns.
    pub most_pause_ns: u64,
    /// Sent bytes that are not acknowledged for so long break it, ns.
    pub unacknowledged_ns: u64,
}

/// Whose bytes a connection has outside the loop.
#[derive(Debug)]
pub enum Handler {
    /// A handshake, before the loop gets it.
    Handshake(Box<dyn Greeting>),
    /// A session, which keeps it.
    Session(Box<dyn Session>),
}

/// A peer of either kind.
#[derive(Debug)]
pub struct Peer {
    pub(super) target: Target,
    pub(super) handler: Handler,
}

impl From<StreamPeer> for Peer {
    fn from(peer: StreamPeer) -> Peer {
        let target = Target {
            address: peer.address,
            bind: peer.bind,
            connect_ns: peer.connect_ns,
            greeting_ns: peer.greeting_ns,
            least_pause_ns: peer.least_pause_ns,
            most_pause_ns: peer.most_pause_ns,
            unacknowledged_ns: peer.unacknowledged_ns,
        };
        Peer { target, handler: Handler::Handshake(peer.greeting) }
    }
}

impl From<SessionPeer> for Peer {
    fn from(peer: SessionPeer) -> Peer {
        let target = Target {
            address: peer.address,
            bind: peer.bind,
            connect_ns: peer.connect_ns,
            // A session has its own timeouts.
            greeting_ns: 0,
            least_pause_ns: peer.least_pause_ns,
            most_pause_ns: peer.most_pause_ns,
            unacknowledged_ns: peer.unacknowledged_ns,
        };
        Peer { target, handler: Handler::Session(peer.session) }
    }
}

impl Peer {
    /// Where it is.
    pub fn target(&self) -> &Target {
        &self.target
    }
}
