//! What the tests of this folder share.

use std::net::SocketAddrV4;
use std::sync::{Arc, Mutex};

/// Who is connected to the drive of a test, each with the begin of a request. It has no patience with whoever serves the drive.
#[derive(Clone, Default)]
pub struct Peers(Arc<Mutex<Vec<Peer>>>);

struct Peer {
    address: SocketAddrV4,
    come: Vec<u8>,
}

impl Peers {
    /// How many there are.
    pub fn count(&self) -> usize {
        self.0.lock().unwrap().len()
    }

    /// The one who is connected longest.
    pub fn first(&self) -> Option<SocketAddrV4> {
        self.0.lock().unwrap().first().map(|peer| peer.address)
    }

    /// One more, if there are fewer than `most`.
    pub fn connect(&self, from: SocketAddrV4, most: usize) -> bool {
        let mut peers = self.0.lock().unwrap();
        let room = peers.len() < most;
        if room {
            peers.push(Peer { address: from, come: Vec::new() });
        }
        room
    }

    /// The whole requests, of two bytes each, that stand there with these.
    pub fn requests(&self, from: SocketAddrV4, bytes: &[u8]) -> Vec<[u8; 2]> {
        let mut peers = self.0.lock().unwrap();
        let peer = peers.iter_mut().find(|peer| peer.address == from).expect("nobody unknown speaks");
        peer.come.extend_from_slice(bytes);
        let (whole, rest) = peer.come.as_chunks();
        let (whole, rest) = (whole.to_vec(), rest.to_vec());
        peer.come = rest;
        whole
    }

    /// One fewer.
    pub fn disconnected(&self, from: SocketAddrV4) {
        let mut peers = self.0.lock().unwrap();
        let before = peers.len();
        peers.retain(|peer| peer.address != from);
        assert_eq!(peers.len() + 1, before, "a connection ends once");
    }
}
