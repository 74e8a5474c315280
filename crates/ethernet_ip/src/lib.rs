//! EtherNet/IP to MOONS' (Applied Motion) STF and SSDC: class 1 packets on UDP 2222, sessions on TCP 44818.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |
//! | `plan` | the bus as configured |
//! | `check` | what is wrong with the plan of a drive, and what `check` says of it |
//! | `bus_plan` | the plan as every protocol's |
//! | `config` | by that feature: its keys in a configuration, what a first one has, and `fieldbeat ethernet-ip` |
//! | `notation`, `target` | how people write addresses and values of a drive; what an acyclic call does, as numbers |
//! | `session` | the session of one drive on the link thread: it opens connections, and carries out acyclic calls |
//! | `exchange` | what passes between session and loop |
//! | `profile`, `edges` | what is desired as outputs, and what the packets prove; the command word as a machine of edges |
//! | `station` | the master's view of one drive: its connection, its packets, its report |
//! | `native`, `fields`, `counters` | native process data, and as a recording shows them; counts |
//! | `bus` | stations, sessions and one socket as one bus |
//! | `diagnosis` | why a drive is not online |
//!
//! What follows is the reference of docs/ for its configuration.
#![doc = include_str!("../files/configuration-ethernet-ip.md")]

mod bus;
mod bus_plan;
mod check;
#[cfg(feature = "config")]
pub mod config;
mod counters;
pub mod diagnosis;
mod edges;
pub mod exchange;
mod fields;
mod native;
pub mod notation;
pub mod plan;
mod profile;
pub mod session;
pub mod station;
pub mod target;
pub mod wire;

pub use native::{Native, NativeInputs, NativeOutput, NativeProfile};
pub use plan::{
    Access, Delivery, EnableInput, EthernetIpPlan, Expected, Explicit, Homing, HomingMethod, IO_PORT, Layout,
    MoonsDrive, Originator, PORT, Version, Watchdog,
};
pub use wire::assembly::{Condition, Inputs, IoCode, Letters, NoIoCode, Outputs, command, status};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "ethernet-ip";
