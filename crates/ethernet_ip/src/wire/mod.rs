//! EtherNet/IP to MOONS' drives, the scanner's side: bytes <-> values.
//!
//! Knows no state, clock or socket, and does not interpret a message. What the loop uses (`io`, `assembly`) allocates
//! nothing; requests of a session are appended to a buffer of its own.
//!
//! | file | what |
//! |---|---|
//! | `encapsulation` | the header of 24 bytes, sessions, who is there |
//! | `cpf` | items: what a message is addressed with, and socket addresses |
//! | `cip` | requests and replies to an object, paths, status codes by name |
//! | `connection` | opening and closing of connections |
//! | `io` | class 1 packets |
//! | `assembly` | what class 1 packets of these drives carry |
//! | `message`, `opcodes` | these drives' own messages, and what they can say |
//!
//! Everything is little-endian, except socket addresses, the drives' own messages and their profile code.

pub mod assembly;
pub mod cip;
pub mod connection;
pub mod cpf;
pub mod encapsulation;
pub mod io;
pub mod message;
pub mod opcodes;

use fieldbeat_core::bus::reader::Reader;

#[cfg(test)]
pub(crate) mod tests;
