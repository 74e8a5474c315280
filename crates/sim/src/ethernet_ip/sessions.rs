//! TCP connections and their sessions: frames put together at any split, and who may speak.
//!
//! Knows no CIP. Facts: sheet, 1.1 and 1.2; what they leave open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | a frame longer than 600 bytes | status 0x65, then the connection ends |
//! | RegisterSession with less than 4 bytes | status 0x65 |
//! | a handle that another connection has | is wrong on this one |

use std::net::SocketAddrV4;

use super::settings::NetworkSettings;
use fieldbeat_core::time::{S, Time};

/// The length of an encapsulation header.
pub(super) const HEADER: usize = 24;
/// The longest frame.
pub(super) const FRAME_MAX: usize = 600;

/// Commands.
pub(super) mod command {
    pub const NOP: u16 = 0x0000;
    pub const LIST_SERVICES: u16 = 0x0004;
    pub const LIST_IDENTITY: u16 = 0x0063;
    pub const LIST_INTERFACES: u16 = 0x0064;
    pub const REGISTER: u16 = 0x0065;
    pub const UNREGISTER: u16 = 0x0066;
    pub const SEND_RR_DATA: u16 = 0x006F;
    pub const SEND_UNIT_DATA: u16 = 0x0070;
}

/// Statuses of the encapsulation.
pub(super) mod status {
    pub const OK: u32 = 0;
    pub const COMMAND: u32 = 1;
    pub const MEMORY: u32 = 2;
    pub const DATA: u32 = 3;
    pub const SESSION: u32 = 0x64;
    pub const LENGTH: u32 = 0x65;
    pub const VERSION: u32 = 0x69;
}

/// An encapsulation header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Header {
    pub command: u16,
    pub length: u16,
    pub session: u32,
    pub status: u32,
    pub context: [u8; 8],
    pub options: u32,
}

impl Header {
    /// The header at the front; `None`: not whole yet.
    pub(super) fn parse(bytes: &[u8]) -> Option<Header> {
        let mut from = super::cip::Reader(bytes);
        Some(Header {
            command: from.u16()?,
            length: from.u16()?,
            session: from.u32()?,
            status: from.u32()?,
            context: from.take(8)?.try_into().ok()?,
            options: from.u32()?,
        })
    }

    /// The answer to it: what `write` appends, and the status that it returns.
    pub(super) fn answer(self, out: &mut Vec<u8>, write: impl FnOnce(&mut Vec<u8>) -> u32) {
        let start = out.len();
        out.extend(self.command.to_le_bytes());
        out.extend([0; 2]);
        out.extend(self.session.to_le_bytes());
        out.extend([0; 4]);
        out.extend(self.context);
        out.extend([0; 4]);
        let status = write(out);
        let length = (out.len() - start - HEADER) as u16;
        out[start + 2..start + 4].copy_from_slice(&length.to_le_bytes());
        out[start + 8..start + 12].copy_from_slice(&status.to_le_bytes());
    }
}

/// One TCP connection.
#[derive(Debug)]
struct Session {
    peer: SocketAddrV4,
    handle: Option<u32>,
    /// The bytes of an incomplete frame.
    bytes: Vec<u8>,
    active_at: Time,
    ended: bool,
}

/// All of them.
#[derive(Debug)]
pub(super) struct Sessions {
    open: Vec<Session>,
    most: usize,
    /// After so many seconds without traffic one ends; 0: never. It can be set.
    pub inactivity_s: u16,
    newest: u32,
}

impl Sessions {
    pub(super) fn new(settings: &NetworkSettings) -> Sessions {
        Sessions {
            open: Vec::new(),
            most: settings.sessions,
            inactivity_s: settings.inactivity_s,
            newest: 0x100,
        }
    }

    /// A TCP connection begins; false if there are too many. More of them than sessions, so that each is answered.
    pub(super) fn connect(&mut self, now: Time, peer: SocketAddrV4) -> bool {
        self.disconnect(peer);
        let has_room = self.open.len() < 2 * self.most;
        if has_room {
            self.open.push(Session { peer, handle: None, bytes: Vec::new(), active_at: now, ended: false });
        }
        has_room
    }

    pub(super) fn disconnect(&mut self, peer: SocketAddrV4) {
        self.open.retain(|session| session.peer != peer);
    }

    /// Power was lost.
    pub(super) fn restart(&mut self, settings: &NetworkSettings) {
        let newest = self.newest;
        *self = Sessions::new(settings);
        self.newest = newest;
    }

    /// The number of connections.
    pub(super) fn count(&self) -> usize {
        self.open.len()
    }

    fn of(&mut self, peer: SocketAddrV4) -> Option<&mut Session> {
        self.open.iter_mut().find(|session| session.peer == peer && !session.ended)
    }

    /// The drive ends this connection after what it has answered.
    pub(super) fn end(&mut self, peer: SocketAddrV4) {
        if let Some(session) = self.of(peer) {
            session.ended = true;
        }
    }

    /// Whether the drive ends this connection.
    pub(super) fn hangs_up(&self, peer: SocketAddrV4) -> bool {
        !self.open.iter().any(|session| session.peer == peer && !session.ended)
    }

    /// Bytes came.
    pub(super) fn take(&mut self, now: Time, peer: SocketAddrV4, bytes: &[u8]) {
        if let Some(session) = self.of(peer) {
            session.bytes.extend_from_slice(bytes);
            session.active_at = now;
        }
    }

    /// The next whole frame, or one that is too long, of which only the header comes.
    pub(super) fn frame(&mut self, peer: SocketAddrV4) -> Option<(Header, Result<Vec<u8>, TooLong>)> {
        let session = self.of(peer)?;
        let header = Header::parse(&session.bytes)?;
        let end = HEADER + usize::from(header.length);
        if end > FRAME_MAX {
            session.bytes.clear();
            session.ended = true;
            return Some((header, Err(TooLong)));
        }
        if session.bytes.len() < end {
            return None;
        }
        let data = session.bytes[HEADER..end].to_vec();
        session.bytes.drain(..end);
        Some((header, Ok(data)))
    }

    /// The session of a connection.
    pub(super) fn handle(&mut self, peer: SocketAddrV4) -> Option<u32> {
        self.of(peer)?.handle
    }

    /// Registers a session: its handle and the status.
    pub(super) fn register(&mut self, peer: SocketAddrV4, data: &[u8]) -> (u32, u32) {
        if let Some(handle) = self.handle(peer) {
            return (handle, status::COMMAND);
        }
        if data.len() != 4 {
            return (0, status::LENGTH);
        }
        if data != [1, 0, 0, 0] {
            return (0, status::VERSION);
        }
        if self.open.iter().filter(|session| session.handle.is_some()).count() >= self.most {
            return (0, status::MEMORY);
        }
        self.newest = self.newest.wrapping_add(1).max(1);
        let handle = self.newest;
        if let Some(session) = self.of(peer) {
            session.handle = Some(handle);
        }
        (handle, status::OK)
    }

    /// When the next connection is silent for too long.
    pub(super) fn next_due(&self) -> Option<Time> {
        let since = self.open.iter().filter(|session| !session.ended).map(|session| session.active_at).min();
        since.filter(|_| self.inactivity_s > 0).map(|since| since + u64::from(self.inactivity_s) * S)
    }

    /// Ends those that are silent for too long.
    pub(super) fn run(&mut self, now: Time) {
        let most_ns = u64::from(self.inactivity_s) * S;
        if most_ns > 0 {
            let silent = |session: &&mut Session| now.since(session.active_at) >= most_ns;
            self.open.iter_mut().filter(silent).for_each(|session| session.ended = true);
        }
    }
}

/// A frame that is longer than the drive has room for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct TooLong;
