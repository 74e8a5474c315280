//! EtherNet/IP to MOONS' (Applied Motion) STF and SSDC: class 1 packets on UDP 2222, sessions on TCP 44818.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |
//! | `plan` | the bus as configured |
//! | `check` | what is wrong with the plan of a drive, and what `check` says of it |
//! | `bus_plan` | the plan as every protocol's |
//! | `config` | its keys in a configuration |
//! | `notation` | how people write addresses and values of a drive |
//! | `tools`, `scan` | `fieldbeat ethernet-ip` |
//! | `target` | what an acyclic call does, as numbers |
//! | `session` | the session of a drive on the link thread, and its acyclic calls |
//! | `exchange` | what passes between session and loop |
//!
//! What follows is the reference of docs/ for its configuration.
#![cfg_attr(feature = "config", doc = include_str!("../../../docs/src/configuration-ethernet-ip.md"))]

pub(crate) mod bus;
mod bus_plan;
mod check;
#[cfg(feature = "config")]
mod config;
#[allow(dead_code, reason = "the bus that uses it follows")]
pub(crate) mod exchange;
pub(crate) mod notation;
pub(crate) mod plan;
mod profile;
#[cfg(feature = "cli")]
mod scan;
#[allow(dead_code, reason = "the bus that uses it follows")]
pub(crate) mod session;
#[allow(dead_code, reason = "the bus that uses it follows")]
pub(crate) mod target;
#[cfg(feature = "cli")]
mod tools;
#[allow(dead_code, reason = "the bus that uses it follows")]
pub(crate) mod wire;

use super::Protocol;
pub use plan::{
    Access, Delivery, EnableInput, EthernetIpPlan, Explicit, Homing, HomingMethod, IO_PORT, Layout,
    MoonsDrive, Originator, PORT, Version, Watchdog,
};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "ethernet-ip";

/// This protocol, for the list of all of them.
pub(super) const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "MOONS' STF and SSDC",
    #[cfg(feature = "config")]
    read: config::bus,
    #[cfg(feature = "cli")]
    tools: tools::TOOLS,
};
