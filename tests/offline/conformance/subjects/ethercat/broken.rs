//! A bus whose frames are not as the segment has made them: the clauses find it.

use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;

use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethercat::EthercatPlan;
use fieldbeat::{OpenError, Time};
use fieldbeat_core::bus::Bus;
use fieldbeat_core::net::frames::Unsent;
use fieldbeat_core::net::{Carriers, Datagrams, Frames, StreamPeer, Streams, UdpOptions};
use fieldbeat_core::rt::Regions;
use fieldbeat_ethercat::wire::registers::{AlState, AlStatus};

use super::{AL, COUNTER, INPUTS, OUTPUTS, image};

/// A drive that takes part adds so much to the counter.
const COUNTS: u16 = 3;

/// What only a bus whose drives share a frame can get wrong.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Defect {
    /// The first two drives of the line have each other's inputs.
    GivesAnothersInputs,
    /// They have each other's outputs.
    GivesAnothersOutputs,
    /// A drive that took no part is there, with what it said last.
    CountsTheMissing,
    /// If one took no part, none did.
    MissesAllWithOne,
    /// Each drive has what it said a frame ago.
    IsAFrameBehind,
}

/// A bus with a defect: it works on frames that are not as the line has made them.
#[derive(Debug)]
pub struct Broken {
    pub plan: EthercatPlan,
    pub defect: Defect,
}

impl BusPlan for Broken {
    crate::forward_bus_plan!(plan);

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        let drives = self.plan.drives.len();
        self.plan.open(period_ns, &Misusing { carriers, defect: self.defect, drives })
    }
}

struct Misusing<'a> {
    carriers: &'a dyn Carriers,
    defect: Defect,
    drives: usize,
}

impl Carriers for Misusing<'_> {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        self.carriers.datagrams(bind, options)
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        self.carriers.streams(peers)
    }

    fn frames(&self, interface: &str, ethertype: u16) -> io::Result<Box<dyn Frames>> {
        let frames = self.carriers.frames(interface, ethertype)?;
        Ok(Box::new(Misused { frames, defect: self.defect, kept: vec![[0; AL + INPUTS]; self.drives] }))
    }
}

struct Misused {
    frames: Box<dyn Frames>,
    defect: Defect,
    /// What each place of the line said last in OP.
    kept: Vec<[u8; AL + INPUTS]>,
}

fn operates(said: &[u8; AL + INPUTS]) -> bool {
    AlStatus(said[0].into()).state() == Some(AlState::Op)
}

impl Misused {
    fn spoil_outputs(&self, frame: &mut [u8]) {
        let Some(image) = image(frame).filter(|_| self.defect == Defect::GivesAnothersOutputs) else {
            return;
        };
        let (first, others) = frame[image].split_at_mut(OUTPUTS);
        first.swap_with_slice(&mut others[..OUTPUTS]);
    }

    fn spoil_inputs(&mut self, frame: &mut [u8]) {
        let Some(image) = image(frame) else { return };
        let inputs = image.start + self.kept.len() * OUTPUTS..image.end;
        let (said, behind) = frame[inputs.start..].split_at_mut(inputs.len());
        let (said, _) = said.as_chunks_mut::<{ AL + INPUTS }>();
        let before = self.kept.clone();
        for (kept, said) in self.kept.iter_mut().zip(said.iter()) {
            if operates(said) {
                *kept = *said;
            }
        }
        let gone = said.iter().zip(&before).filter(|(said, kept)| !operates(said) && operates(kept)).count();
        let is_whole = said.iter().chain(&before).all(operates);
        match self.defect {
            Defect::GivesAnothersInputs if is_whole => said.swap(0, 1),
            Defect::IsAFrameBehind if is_whole => said.copy_from_slice(&before),
            Defect::CountsTheMissing if gone > 0 => {
                let counter = u16::from_le_bytes([behind[0], behind[1]]) + COUNTS * gone as u16;
                behind[..COUNTER].copy_from_slice(&counter.to_le_bytes());
                said.copy_from_slice(&self.kept);
            }
            Defect::MissesAllWithOne if gone > 0 => {
                behind[..COUNTER].fill(0);
                said.fill([0; AL + INPUTS]);
            }
            _ => {}
        }
    }
}

impl Frames for Misused {
    fn fd(&self) -> Option<RawFd> {
        self.frames.fd()
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        let mut frame = frame.to_vec();
        self.spoil_outputs(&mut frame);
        self.frames.send(&frame)
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        let (at, length) = self.frames.receive(room)?;
        if let Some(frame) = room.get_mut(..length) {
            self.spoil_inputs(frame);
        }
        Some((at, length))
    }

    fn now(&mut self) -> Time {
        self.frames.now()
    }

    fn mac(&self) -> [u8; 6] {
        self.frames.mac()
    }

    fn memory(&self, regions: &mut Regions) {
        self.frames.memory(regions);
    }
}
