//! EtherCAT with CoE to Kollmorgen S300, S400, S600 and S700: one frame serves all drives of a segment.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |
//! | `mode`, `faults` | modes of operation; numbers of faults |
//! | `object` | objects of a drive: what is known of them, how people write them, the contents of its PDOs |
//! | `plan` | the segment as configured |
//! | `config` | by that feature: its keys in a configuration, what a first one has, and `fieldbeat ethercat` |
//! | `counters` | counters that only EtherCAT has |
//! | `diagnosis` | why a drive is not online |
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
#![doc = include_str!("../files/configuration-ethercat.md")]

pub mod counters;
pub mod faults;
pub mod mode;
pub mod object;
pub mod scan;
pub mod wire;

mod bus;
#[cfg(feature = "config")]
pub mod config;
pub mod diagnosis;
mod fields;
pub mod image;
pub mod native;
mod other;
pub mod outputs;
pub mod plan;
pub mod profile;
pub mod segment;
pub mod service;
pub mod sii;
pub mod slot;
pub mod start_up;
pub mod station;

pub use native::{
    Native, NativeInputs, NativeOutput, PDO_MAX, TERMINAL_MAX, TerminalError, TerminalInputs, Terminals,
};
pub use plan::is_interface;
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
