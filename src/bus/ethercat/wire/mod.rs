//! EtherCAT, both directions: bytes <-> values.
//!
//! Knows no state, clock, socket or allocation, and does not judge what a message means.
//!
//! | file | what |
//! |---|---|
//! | `frame` | frames, datagrams, working counters |
//! | `registers` | what stands in a slave controller, and where |
//! | `mailbox`, `sdo` | mailbox messages, emergencies; reading and writing objects |
//! | `sii` | what a slave says of itself |

pub mod frame;
pub mod mailbox;
pub mod registers;
pub mod sdo;
pub mod sii;
