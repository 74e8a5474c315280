//! EtherNet/IP to MOONS' (Applied Motion) STF and SSDC: class 1 packets on UDP 2222, sessions on TCP 44818.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |
//! | `plan` | the bus as configured |
//! | `check` | what is wrong with the plan of a drive, and what `check` says of it |
//! | `bus_plan` | the plan as every protocol's |
//! | `config` | its keys in a configuration |
//! | `outline` | what a first configuration of it has, and how its drives are found |
//! | `notation`, `target` | how people write addresses and values of a drive; what an acyclic call does, as numbers |
//! | `tools`, `scan` | `fieldbeat ethernet-ip` |
//! | `session` | the session of one drive on the link thread: it opens connections, and carries out acyclic calls |
//! | `exchange` | what passes between session and loop |
//! | `profile`, `edges` | what is desired as outputs, and what the packets prove; the command word as a machine of edges |
//! | `station` | the master's view of one drive: its connection, its packets, its report |
//! | `native`, `fields`, `counters` | native process data, and as a recording shows them; counts |
//! | `bus` | stations, sessions and one socket as one bus |
//!
//! What follows is the reference of docs/ for its configuration.
#![cfg_attr(feature = "config", doc = include_str!("../../../docs/src/configuration-ethernet-ip.md"))]

pub(crate) mod bus;
mod bus_plan;
mod check;
#[cfg(feature = "config")]
mod config;
mod counters;
mod edges;
pub(crate) mod exchange;
mod fields;
mod native;
pub(crate) mod notation;
#[cfg(feature = "cli")]
mod outline;
pub(crate) mod plan;
mod profile;
#[cfg(feature = "cli")]
mod scan;
pub(crate) mod session;
pub(crate) mod station;
pub(crate) mod target;
#[cfg(feature = "cli")]
mod tools;
pub(crate) mod wire;

use super::Protocol;
pub use native::{Native, NativeInputs, NativeOutput, NativeProfile};
pub use plan::{
    Access, Delivery, EnableInput, EthernetIpPlan, Explicit, Homing, HomingMethod, IO_PORT, Layout,
    MoonsDrive, Originator, PORT, Version, Watchdog,
};
pub use wire::assembly::{Condition, Inputs, IoCode, Letters, NoIoCode, Outputs, command, status};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "ethernet-ip";

/// This protocol, for the list of all of them.
pub(super) const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "MOONS' STF and SSDC",
    #[cfg(feature = "config")]
    read: config::bus,
    #[cfg(feature = "config")]
    reference: include_str!("../../../docs/src/configuration-ethernet-ip.md"),
    #[cfg(feature = "config")]
    specimen: config::SPECIMEN,
    #[cfg(feature = "cli")]
    outline: outline::OUTLINE,
    #[cfg(feature = "cli")]
    tools: tools::TOOLS,
};
