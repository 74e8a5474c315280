//! Modbus TCP to Nidec Unidrive M700, M701 and M702: speed-controlled axes, one connection each.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |
//! | `parameter`, `notation` | parameters of a drive: addresses, what is known of them, how people write them |
//! | `words`, `trips` | control word and status word, trip numbers |
//! | `plan`, `mapping` | the bus as configured; its cyclic parameters as blocks |
//! | `check` | what is wrong with the plan of a drive, and what `check` says of it |
//! | `config` | its keys in a configuration |
//! | `outline` | what a first configuration of it has, and how its drives are found |
//! | `handshake` | the handshake on a new connection before the loop gets it |
//! | `station` | the master's view of one drive |
//! | `identity`, `pace`, `calls`, `native`, `counters` | matching of replies, whether they come in the window, calls, native data, counts |
//! | `fields` | native data as a recording shows them |
//! | `read_write` | whether the drive has FC23 |
//! | `setup`, `echo` | settings before the first request to move, values that the drive has accepted |
//! | `other` | another master's values |
//! | `bus` | stations and connections as one bus |
//!
//! What follows is the reference of docs/ for its configuration.
#![cfg_attr(feature = "config", doc = include_str!("../../../docs/src/configuration-modbus.md"))]

pub(crate) mod counters;
pub(crate) mod mapping;
pub(crate) mod native;
pub(crate) mod notation;
pub(crate) mod parameter;
pub(crate) mod trips;
pub(crate) mod wire;
pub(crate) mod words;

pub(crate) mod bus;
mod calls;
mod check;
#[cfg(feature = "config")]
mod config;
mod echo;
mod fields;
pub(crate) mod handshake;
mod identity;
mod other;
#[cfg(feature = "cli")]
mod outline;
mod pace;
mod plan;
mod profile;
mod read_write;
mod setup;
pub(crate) mod station;

use super::Protocol;
pub use mapping::{Block, Mapping, Role};
pub use native::{Native, NativeInputs, NativeOutput};
pub use parameter::{Addressing, Parameter, ParseError, Width};
pub use plan::{Functions, Map, Mapped, ModbusPlan, PORT, UnidriveDrive, Via, WATCHDOG_MAX_NS, Watchdog};
pub use trips::Trip;
pub use words::{ControlWord, StatusWord};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "modbus-tcp";

/// This protocol, for the list of all of them.
pub(super) const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "Nidec Unidrive",
    #[cfg(feature = "config")]
    read: config::bus,
    #[cfg(feature = "config")]
    reference: include_str!("../../../docs/src/configuration-modbus.md"),
    #[cfg(feature = "config")]
    specimen: config::SPECIMEN,
    #[cfg(feature = "cli")]
    outline: outline::OUTLINE,
    #[cfg(feature = "cli")]
    tools: &[],
};
