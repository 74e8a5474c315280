//! Modbus TCP to Nidec Unidrive M700, M701 and M702: speed-controlled axes, one connection each.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |
//! | `parameter`, `notation` | parameters of a drive: addresses, what is known of them, how people write them |
//! | `words`, `trips` | control word and status word, trip numbers |
//! | `plan`, `mapping` | the bus as configured; its cyclic parameters as blocks |
//! | `check` | what is wrong with the plan of a drive, and what `check` says of it |
//! | `config` | by that feature: its keys in a configuration, what a first one has |
//! | `handshake` | the handshake on a new connection before the loop gets it |
//! | `station` | the master's view of one drive |
//! | `identity`, `pace`, `calls`, `native`, `counters` | matching of replies, whether they come in the window, calls, native data, counts |
//! | `fields` | native data as a recording shows them |
//! | `read_write` | whether the drive has FC23 |
//! | `setup`, `echo` | settings before the first request to move, values that the drive has accepted |
//! | `other` | another master's values |
//! | `bus` | stations and connections as one bus |
//! | `diagnosis` | why a drive is not online |
//!
//! What follows is the reference of docs/ for its configuration.
#![doc = include_str!("../files/configuration-modbus.md")]

pub mod counters;
pub mod mapping;
pub mod native;
pub mod notation;
pub mod parameter;
pub mod trips;
pub mod wire;
pub mod words;

mod bus;
mod calls;
mod check;
#[cfg(feature = "config")]
pub mod config;
pub mod diagnosis;
mod echo;
mod fields;
pub mod handshake;
mod identity;
mod other;
mod pace;
mod plan;
mod profile;
mod read_write;
mod setup;
pub mod station;

pub use mapping::{Block, Mapping, Role};
pub use native::{Native, NativeInputs, NativeOutput};
pub use parameter::{Addressing, Parameter, ParseError, Width};
pub use plan::{Functions, Map, Mapped, ModbusPlan, PORT, UnidriveDrive, Via, WATCHDOG_MAX_NS, Watchdog};
pub use trips::Trip;
pub use words::{ControlWord, StatusWord};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "modbus-tcp";
