//! The form in which a class 1 connection is requested: what no public source says of the drives is tried.
//!
//! | unknown | tried |
//! |---|---|
//! | data for the configuration assembly | none, then two zero bytes |
//! | connection size of a heartbeat | the size that the drive names, else 2, 6, 0 |
//! | the small or the large request | small, then large |

use crate::plan::{Access, MoonsDrive};
use crate::wire::cip::Status;

/// Connection sizes of heartbeats: with the sequence count, with run/idle too, with neither.
const HEARTBEATS: [u8; 3] = [2, 6, 0];
/// The configuration data of the second attempt.
const ZEROS: [u8; 2] = [0; 2];

/// The form of the next request.
#[derive(Clone, Debug)]
pub(super) struct Form {
    configured: Option<Vec<u8>>,
    heartbeat: Option<u8>,
    zeros: bool,
    /// Of `HEARTBEATS`.
    size: usize,
    /// One bit for each of them.
    tried: u8,
    large: bool,
    /// It was repeated with another serial number.
    repeated: bool,
}

impl Form {
    /// The first one.
    pub(super) fn new(drive: &MoonsDrive) -> Form {
        Form {
            configured: drive.configuration.clone(),
            heartbeat: drive.heartbeat,
            zeros: false,
            size: 0,
            tried: 1,
            large: false,
            repeated: false,
        }
    }

    /// The data for the configuration assembly.
    pub(super) fn configuration(&self) -> &[u8] {
        match &self.configured {
            Some(data) => data,
            None if self.zeros => &ZEROS,
            None => &[],
        }
    }

    /// The connection size of our packets, if they are heartbeats.
    pub(super) fn heartbeat(&self) -> u8 {
        self.heartbeat.or(HEARTBEATS.get(self.size).copied()).unwrap_or(HEARTBEATS[0])
    }

    /// Whether the request is a large one.
    pub(super) fn is_large(&self) -> bool {
        self.large
    }

    /// It was accepted: the next opening begins with it.
    pub(super) fn accepted(&mut self) {
        self.tried = 1 << self.size;
        self.repeated = false;
    }

    /// The drive refused it. True if another form is left to be tried at once; else it starts again after a pause.
    pub(super) fn refused(&mut self, access: Access, status: &Status) -> bool {
        let next = match status.failure() {
            None if status.general == Status::NO_SERVICE && !self.large => {
                self.large = true;
                true
            }
            Some(Status::CONFIGURATION_SIZE | Status::CONFIGURATION | Status::NOT_CONFIGURED) => {
                let other = self.configured.is_none() && !self.zeros;
                self.zeros |= other;
                other
            }
            Some(Status::OUTGOING_SIZE | Status::SIZE) if access != Access::Owner => {
                self.next_size(status.size)
            }
            // The number is of a connection that the drive has not forgotten.
            Some(Status::IN_USE) => !std::mem::replace(&mut self.repeated, true),
            _ => false,
        };
        if !next {
            (self.zeros, self.size, self.tried, self.large, self.repeated) = (false, 0, 1, false, false);
        }
        next
    }

    fn next_size(&mut self, wanted: Option<u16>) -> bool {
        if self.heartbeat.is_some() {
            return false;
        }
        let untried = |place: &usize| self.tried & 1 << place == 0;
        let named = HEARTBEATS.iter().position(|size| wanted == Some(u16::from(*size))).filter(untried);
        let Some(place) = named.or_else(|| (0..HEARTBEATS.len()).find(untried)) else { return false };
        self.size = place;
        self.tried |= 1 << place;
        true
    }
}
