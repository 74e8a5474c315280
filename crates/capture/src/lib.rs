//! Captures: what passed the wires of a recorded run as pcapng, for Wireshark, and any capture in words.
//!
//! | file | what |
//! |---|---|
//! | `export` | the telegrams of a recording as a capture |
//! | `decode` | a capture in words, telegram by telegram |
//! | `stream` | the bytes of a TCP connection, from its segments |
//! | `headers` | Ethernet, IPv4, UDP and TCP, both ways |
//! | `writer`, `reader` | the file: pcapng; what is read may be classic pcap, too |
//!
//! The telegrams themselves are decoded by the codecs of the protocols' packages
//! ([`Telegrams`](fieldbeat_keys::telegram::Telegrams)).

pub mod decode;
pub mod export;
mod headers;
pub mod reader;
mod stream;
pub mod writer;

/// The link type of Ethernet frames.
pub const ETHERNET: u16 = 1;
/// Of telegrams of a serial wire, one in each packet: the first of those for private use, since the one of PROFIBUS is
/// unknown to the dissectors of many a Wireshark.
pub const USER0: u16 = 147;
/// Of telegrams of PROFIBUS, as others write them.
pub const PROFIBUS: u16 = 257;

/// The direction of a packet, as who captured it sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Direction {
    /// It was received.
    Inbound = 1,
    /// It was sent.
    Outbound = 2,
}
