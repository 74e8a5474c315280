//! The layout of the log: entries of whole 64-bit words, little-endian in files.
//!
//! | bits of the first word | content |
//! |---|---|
//! | 0 to 4 | the [`Kind`] |
//! | 5 to 15 | so many looks before this one found what is usual |
//! | 16 to 31 | bytes of the payload, which follows in whole words |
//! | 32 to 63 | the time of the entry: ns after the time of the entry before it, signed |
//!
//! An entry without a time of its own has a difference of 0. A difference that does not fit is written by a
//! [`Kind::Base`] before the entry, and more looks than fit by a [`Kind::Gap`].

use crate::time::Time;

/// The kind of an entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    /// A number of further looks that found the usual. No payload.
    Gap,
    /// A word: the time from which the next difference counts.
    Base,
    /// A slot of the grid begins. A word: its index.
    Cycle,
    /// The clock was read. No payload.
    Clock,
    /// Descriptors that were waited for. A bit each: set, it was not readable.
    Wait,
    /// A value from another thread, or the result of a look. A word: its source; then its words.
    Value,
    /// An element that has come into a queue. A word: the queue, and 1 in its upper half if one more follows; then the
    /// words of the element.
    Queue,
    /// A call of the in-loop task. A word, 0; then its words.
    Task,
    /// A datagram came. A word: [`peer`], 1 in bit 48 if it was cut off, and the bus in bits 58 to 63; then its bytes.
    DatagramIn,
    /// A datagram left at this time. A word: the index of its drive in bits 48 to 57, and its bus in bits 58 to 63, as
    /// of all that is sent; [`peer`] below. Then its bytes.
    DatagramOut,
    /// The same, but it did not leave. A word more before the bytes: the error, or 0 without any.
    DatagramUnsent,
    /// Bytes came on a connection. A word: which, in bits 48 to 63; then the bytes.
    BytesIn,
    /// Bytes were handed to a connection at this time. Two words: which, and how many were taken; then the bytes.
    BytesOut,
    /// The same, but the connection cannot be used. Two words: which, and why; then the bytes.
    BytesUnsent,
    /// Nothing can be received on a connection. Two words: which, and why.
    Broken,
    /// A frame came. A word: its bus, and its length on the wire; then its bytes.
    FrameIn,
    /// A frame left at this time. A word: its bus; then its bytes.
    FrameOut,
    /// The same, but it did not leave. A word more before the bytes: why.
    FrameUnsent,
    /// Nothing could be received. Two words: the bus, and the error of the operating system.
    Failed,
}

impl Kind {
    /// All of them, each at its number.
    pub const ALL: [Kind; 19] = [
        Kind::Gap,
        Kind::Base,
        Kind::Cycle,
        Kind::Clock,
        Kind::Wait,
        Kind::Value,
        Kind::Queue,
        Kind::Task,
        Kind::DatagramIn,
        Kind::DatagramOut,
        Kind::DatagramUnsent,
        Kind::BytesIn,
        Kind::BytesOut,
        Kind::BytesUnsent,
        Kind::Broken,
        Kind::FrameIn,
        Kind::FrameOut,
        Kind::FrameUnsent,
        Kind::Failed,
    ];

    /// Whether it is a telegram that left, or was to leave.
    pub fn is_sent(self) -> bool {
        use Kind::{BytesOut, BytesUnsent, DatagramOut, DatagramUnsent, FrameOut, FrameUnsent};
        matches!(self, DatagramOut | DatagramUnsent | BytesOut | BytesUnsent | FrameOut | FrameUnsent)
    }

    /// In words.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Gap | Kind::Base => "a mark of the log",
            Kind::Cycle => "the begin of a cycle",
            Kind::Clock => "a reading of the clock",
            Kind::Wait => "the end of a wait",
            Kind::Value => "a value from another thread",
            Kind::Queue => "elements of a queue",
            Kind::Task => "a call of the in-loop task",
            Kind::DatagramIn => "a received datagram",
            Kind::DatagramOut | Kind::DatagramUnsent => "a sent datagram",
            Kind::BytesIn => "received bytes",
            Kind::BytesOut | Kind::BytesUnsent => "sent bytes",
            Kind::Broken => "the end of a connection",
            Kind::FrameIn => "a received frame",
            Kind::FrameOut | Kind::FrameUnsent => "a sent frame",
            Kind::Failed => "an error of a carrier",
        }
    }
}

/// The most looks in one entry.
pub const MOST_LOOKS: u64 = (1 << 11) - 1;
/// The most bytes of a payload.
pub const MOST_BYTES: usize = u16::MAX as usize;

/// The first word of an entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Head {
    /// The kind.
    pub kind: Kind,
    /// Looks before it, at most [`MOST_LOOKS`].
    pub looks: u64,
    /// Bytes of its payload, at most [`MOST_BYTES`].
    pub bytes: usize,
    /// The time, ns after the one before it.
    pub after_ns: i32,
}

impl Head {
    /// As a word.
    #[inline]
    pub fn word(self) -> u64 {
        self.kind as u64
            | self.looks << 5
            | (self.bytes as u64) << 16
            | u64::from(self.after_ns.cast_unsigned()) << 32
    }

    /// The head that a word is; `None`: it is none.
    pub fn of(word: u64) -> Option<Head> {
        Some(Head {
            kind: *Kind::ALL.get((word & 0x1F) as usize)?,
            looks: word >> 5 & MOST_LOOKS,
            bytes: (word >> 16 & 0xFFFF) as usize,
            after_ns: ((word >> 32) as u32).cast_signed(),
        })
    }

    /// Words of its payload.
    pub fn words(self) -> usize {
        self.bytes.div_ceil(size_of::<u64>())
    }
}

/// `at` as a difference to `before`; `None`: it does not fit.
#[inline]
pub fn after_ns(before: Time, at: Time) -> Option<i32> {
    i32::try_from(at.0.wrapping_sub(before.0).cast_signed()).ok()
}

/// An address and its port in the lower 48 bits of a word.
#[inline]
pub fn peer(address: std::net::SocketAddrV4) -> u64 {
    u64::from(address.ip().to_bits()) << 16 | u64::from(address.port())
}

/// The bus and the drive, connection or message of it in the upper 16 bits of a word.
#[inline]
pub fn of_bus(bus: u8, index: usize) -> u64 {
    u64::from(bus) << 58 | (index as u64 & 0x3FF) << 48
}

/// Both of such a word.
pub fn place_of(word: u64) -> (usize, usize) {
    ((word >> 58) as usize, (word >> 48 & 0x3FF) as usize)
}

/// The address of such a word.
pub fn peer_of(word: u64) -> std::net::SocketAddrV4 {
    std::net::SocketAddrV4::new(((word >> 16) as u32).into(), word as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heads_and_peers_pass_through_words() {
        for (number, kind) in Kind::ALL.into_iter().enumerate() {
            assert_eq!(kind as usize, number);
            let head = Head { kind, looks: MOST_LOOKS, bytes: MOST_BYTES, after_ns: -7 };
            assert_eq!(Head::of(head.word()), Some(head));
            let head = Head { kind, looks: 1, bytes: 9, after_ns: i32::MAX };
            assert_eq!((Head::of(head.word()), head.words()), (Some(head), 2));
        }
        assert_eq!(Head::of(Kind::ALL.len() as u64), None);
        let address = "127.77.0.1:49360".parse().unwrap();
        assert_eq!(peer_of(1 << 63 | peer(address)), address);
        assert_eq!(after_ns(Time(5), Time(3)), Some(-2));
        assert_eq!(after_ns(Time(0), Time(1 << 40)), None);
    }
}
