//! Common parts of the tests of this folder.

use std::net::SocketAddrV4;
use std::sync::{Arc, Mutex};

use super::{FaultPlan, SimLine};
use crate::time::Time;

/// The peers connected to the drive of a test, each with the begin of a request. It never waits for a peer.
#[derive(Clone, Default)]
pub struct Peers(Arc<Mutex<Vec<Peer>>>);

struct Peer {
    address: SocketAddrV4,
    come: Vec<u8>,
}

impl Peers {
    /// How many peers there are.
    pub fn count(&self) -> usize {
        self.0.lock().unwrap().len()
    }

    /// The peer that has been connected longest.
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

    /// The whole requests, of two bytes each, that these bytes complete.
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

/// Two slaves; each one that is reached and receives adds 1 to the second byte of a frame, and both report the
/// faults injected.
#[derive(Default)]
pub struct Tally {
    faults: FaultPlan,
    name: String,
    own: Option<String>,
    cut: Option<usize>,
    deaf: [bool; 2],
    pub passed: usize,
    pub lived: Time,
    pub restarts: [usize; 2],
    pub inhibited: [Time; 2],
}

impl Tally {
    pub const TYPE: u16 = 0x88A4;

    pub fn new(name: impl Into<String>, faults: FaultPlan) -> Tally {
        Tally { name: name.into(), faults, ..Tally::default() }
    }

    /// At this interface.
    pub fn at(self, own: &str) -> Tally {
        Tally { own: Some(own.into()), ..self }
    }
}

impl SimLine for Tally {
    fn interface(&self) -> &str {
        &self.name
    }

    fn own_interface(&self) -> Option<&str> {
        self.own.as_deref()
    }

    fn ethertype(&self) -> u16 {
        Self::TYPE
    }

    fn faults(&self) -> FaultPlan {
        self.faults.clone()
    }

    fn slaves(&self) -> usize {
        2
    }

    fn delay_ns(&self) -> u64 {
        700
    }

    fn pass(&mut self, now: Time, frame: &mut [u8]) -> bool {
        self.live(now);
        self.passed += 1;
        let reached = self.cut.unwrap_or(2);
        frame[1] += self.deaf[..reached].iter().filter(|deaf| !**deaf).count() as u8;
        reached > 0
    }

    fn mislabel(&self, frame: &mut [u8]) {
        frame[0] ^= 0x80;
    }

    fn live(&mut self, now: Time) {
        self.lived = now;
    }

    fn cut(&mut self, place: Option<usize>) {
        self.cut = place;
    }

    fn deafen(&mut self, place: usize, deaf: bool) {
        self.deaf[place] = deaf;
    }

    fn restart(&mut self, _now: Time, place: usize) {
        self.restarts[place] += 1;
    }

    fn inhibit(&mut self, place: usize, until: Time) {
        self.inhibited[place] = until;
    }
}
