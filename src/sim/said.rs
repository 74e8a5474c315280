//! What a drive sends unasked in one run, in buffers that are used again.

use std::net::SocketAddrV4;

use super::SimDrive;
use crate::time::{Time, US};

/// The shortest time between two runs of a drive, ns: a mistake of a drive shall not stop the time.
pub(super) const SHORTEST_RUN_NS: u64 = US;

/// The messages of one run.
#[derive(Debug, Default)]
pub(super) struct Said {
    bytes: Vec<u8>,
    /// Socket, destination, and the end of its bytes.
    messages: Vec<(usize, SocketAddrV4, usize)>,
}

impl Said {
    /// Runs `drive` and takes down what it sends.
    pub(super) fn run(&mut self, now: Time, drive: &mut dyn SimDrive) {
        self.bytes.clear();
        self.messages.clear();
        drive.run(now, &mut |socket, to, bytes| {
            self.bytes.extend_from_slice(bytes);
            self.messages.push((socket, to, self.bytes.len()));
        });
    }

    /// The messages in their order: socket, destination, bytes.
    pub(super) fn messages(&self) -> impl Iterator<Item = (usize, SocketAddrV4, &[u8])> {
        let mut begin = 0;
        self.messages.iter().map(move |(socket, to, end)| {
            let bytes = &self.bytes[begin..*end];
            begin = *end;
            (*socket, *to, bytes)
        })
    }
}
