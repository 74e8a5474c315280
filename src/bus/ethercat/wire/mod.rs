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

pub mod frame;
pub mod mailbox;
pub mod registers;
pub mod sdo;
pub mod sii;
