//! EtherCAT, both directions: bytes <-> values.
//!
//! Knows no state, clock, socket or allocation, and does not interpret a message.
//!
//! | file | what |
//! |---|---|
//! | `frame` | frames, datagrams, working counters |
//! | `registers` | the registers of a slave controller |
//! | `mailbox`, `sdo` | mailbox messages, emergencies; reading and writing objects |
//! | `sii` | the slave information (EEPROM) |

use std::fmt;

pub mod frame;
pub mod mailbox;
pub mod registers;
pub mod sdo;
pub mod sii;

/// A code in hexadecimal digits, with `0x` so many, and its name if it has one.
fn write_code(f: &mut fmt::Formatter<'_>, code: u32, width: usize, name: Option<&str>) -> fmt::Result {
    write!(f, "{code:#0width$x}")?;
    name.map_or(Ok(()), |name| write!(f, " {name}"))
}
