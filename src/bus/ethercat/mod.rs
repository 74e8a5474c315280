//! EtherCAT with CoE to Kollmorgen S300, S400, S600 and S700: one frame serves all drives of a segment.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |
//! | `cia402`, `faults` | control word, status word, states, transitions; numbers of faults |
//! | `object` | objects of a drive: what is known of them, how people write them, the contents of its PDOs |
//! | `plan` | the segment as configured |
//! | `config` | its keys in a configuration |
//! | `outline` | what a first configuration of it has, and how its drives are found |
//! | `tools` | `fieldbeat ethercat` |
//! | `counters` | counters that only EtherCAT has |
//! | `bus` | stations, devices and frames as one bus |
//! | `image` | the process data of the segment, and its frames |
//! | `segment` | bringing the slaves to OP, and the clock of the segment |
//! | `slot` | the acyclic slot of a frame |
//! | `sii` | reads the EEPROM of a slave, for the segment and for a scan |
//! | `service` | SDOs and emergencies of a slave |
//! | `station`, `profile` | the master's view of one drive; what is desired as outputs, and what answers prove |
//! | `outputs` | who writes each entry of the outputs of a drive |
//! | `start_up` | objects written to a drive before its process data run |
//! | `other` | another master's frames on the segment |
//! | `native` | native process data of drives, and of devices that are not drives |
//! | `fields` | those of drives as a recording shows them |
//! | `scan` | lists the slaves of a segment, for people |
//!
//! What follows is the reference of docs/ for its configuration.
#![cfg_attr(feature = "config", doc = include_str!("../../../docs/src/configuration-ethercat.md"))]

pub(crate) mod cia402;
pub(crate) mod counters;
pub(crate) mod faults;
pub(crate) mod object;
pub(crate) mod scan;
pub(crate) mod wire;

pub(crate) mod bus;
#[cfg(feature = "config")]
mod config;
mod fields;
pub(crate) mod image;
mod native;
mod other;
#[cfg(feature = "cli")]
mod outline;
mod outputs;
mod plan;
mod profile;
mod segment;
pub(crate) mod service;
pub(crate) mod sii;
pub(crate) mod slot;
mod start_up;
mod station;
#[cfg(feature = "cli")]
mod tools;

use super::Protocol;
pub use native::{
    Native, NativeInputs, NativeOutput, PDO_MAX, TERMINAL_MAX, TerminalError, TerminalInputs, Terminals,
};
pub(crate) use plan::is_interface;
pub use plan::{
    Area, Device, EthercatPlan, Expected, KOLLMORGEN, KollmorgenDrive, MOST_AREAS, Mapping, Owner, Scaling,
    Setpoint, SlavePlan, Start, Watchdog,
};

pub use object::pdo::{Entry, Layout};
pub use object::{Family, Type};
pub use wire::sdo::Object;
pub use wire::sii::Identity;

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "ethercat";

/// This protocol, for the list of all of them.
pub(super) const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "Kollmorgen S300 ... S700",
    #[cfg(feature = "config")]
    read: config::bus,
    #[cfg(feature = "config")]
    reference: include_str!("../../../docs/src/configuration-ethercat.md"),
    #[cfg(feature = "config")]
    specimen: config::SPECIMEN,
    #[cfg(feature = "cli")]
    outline: outline::OUTLINE,
    #[cfg(feature = "cli")]
    tools: tools::TOOLS,
};
