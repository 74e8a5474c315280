//! Telegrams of a protocol in a capture: where each ends, and what it says. Each protocol has its own in its package,
//! made of the codecs of its master; `fieldbeat decode` and `fieldbeat export --pcapng` find them by what carries them.

use std::fmt::{self, Write};

/// What passes the wire of a protocol by one carrier.
#[derive(Clone, Copy, Debug)]
pub struct Telegrams {
    /// What carries them.
    pub carrier: Carrier,
    /// What is at the front of the bytes of a carrier; those of a frame or a datagram are one telegram as a rule.
    pub front: fn(&[u8]) -> Front,
    /// A telegram in words; `None`: it is none of this protocol.
    pub words: fn(&[u8], Way) -> Option<Words>,
}

/// A carrier of telegrams.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Carrier {
    /// Ethernet frames of this Ethertype.
    Frames(u16),
    /// UDP datagrams to this port of a drive, and from there.
    Datagrams(u16),
    /// TCP connections to this port of a drive.
    Streams(u16),
    /// A serial wire.
    Serial,
}

/// Which way a telegram goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// From a master to a drive.
    ToDrive,
    /// From a drive to a master.
    FromDrive,
    /// Neither is known.
    Unknown,
}

/// What is at the front of bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Front {
    /// Nothing, or the beginning of a telegram.
    Incomplete,
    /// A telegram of so many bytes.
    Telegram(usize),
    /// So many bytes that are no telegram.
    Foreign(usize),
}

impl Front {
    /// All of them are one telegram: of frames and datagrams.
    pub fn whole(bytes: &[u8]) -> Front {
        match bytes.len() {
            0 => Front::Incomplete,
            size => Front::Telegram(size),
        }
    }
}

/// A telegram in words.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Words {
    /// The stations from which and to which it goes, on a serial wire.
    pub stations: Option<[u8; 2]>,
    /// Its fields.
    pub text: String,
}

impl Words {
    /// Begins with what it is.
    pub fn new(what: impl fmt::Display) -> Words {
        Words { stations: None, text: what.to_string() }
    }

    /// One more field.
    pub fn field(&mut self, field: impl fmt::Display) {
        self.then(", ", field);
    }

    /// One more part behind `between`.
    pub fn then(&mut self, between: &str, part: impl fmt::Display) {
        // A text takes whatever is written.
        let _ = write!(self.text, "{between}{part}");
    }

    /// These bytes in hexadecimal, if there are any.
    pub fn bytes(&mut self, bytes: &[u8]) {
        if !bytes.is_empty() {
            self.then(": ", Hex(bytes));
        }
    }
}

/// Bytes in hexadecimal.
#[derive(Clone, Copy, Debug)]
pub struct Hex<'a>(pub &'a [u8]);

impl fmt::Display for Hex<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (place, byte) in self.0.iter().enumerate() {
            write!(f, "{}{byte:02x}", if place == 0 { "" } else { " " })?;
        }
        Ok(())
    }
}
