//! LinMot LinUDP V2: UDP, the master on port 41136, the drives on 49360, one reply to each request.
//!
//! | file | what |
//! |---|---|
//! | `wire` | the telegram, both directions |
//! | `motion` | motion commands: the catalogue, constructors, units |
//! | `curve` | time curves and encoder cams |
//! | `table` | the drive's command table |
//! | `station` | the master's view of one drive: identity of replies, feedback |
//! | `profile` | what is desired as blocks of a request, and what replies prove |
//! | `channel` | the motion command interface: counts and their echo |
//! | `other` | another master's commands, by their counts |
//! | `rtc` | the real-time-config channel: one acyclic call after the other, in the requests that go out anyway |
//! | `service` | what a drive offers besides its parameters: curves, command table, error log, software, flash |
//! | `upid`, `notation` | parameters by number and name; how people write and list them |
//! | `native`, `fields` | unscaled process data for the application, and as a recording shows them |
//! | `bus` | all drives on one socket |
//! | `last` | their stop without the loop |
//! | `plan` | the bus as configured |
//! | `config` | its keys in a configuration |
//! | `outline` | what a first configuration of it has, and how its drives are found |
//! | `tools` | `fieldbeat linmot` |
//!
//! Facts: "LinUDP V2 Interface" manual 0185-1108-E 1V9 and "User Manual Motion Control SW" (SG5) 4.3.4.
//!
//! What follows is the reference of docs/ for its configuration.
#![cfg_attr(feature = "config", doc = include_str!("../../../docs/src/configuration-linudp.md"))]

pub(crate) mod bus;
mod channel;
#[cfg(feature = "config")]
mod config;
pub mod curve;
mod fields;
mod last;
pub mod motion;
pub(crate) mod native;
pub(crate) mod notation;
mod other;
#[cfg(feature = "cli")]
mod outline;
pub(crate) mod plan;
mod profile;
pub(crate) mod rtc;
pub mod service;
pub(crate) mod station;
pub mod table;
#[cfg(feature = "cli")]
mod tools;
pub(crate) mod upid;
pub(crate) mod wire;

use super::Protocol;
pub(crate) use rtc::UNACKNOWLEDGED;

pub use motion::stream::StreamCommand;
pub use native::{Native, NativeInputs, NativeOutput};
pub use plan::{COUNTS_PER_MM, DRIVE_PORT, LinUdpDrive, LinUdpPlan, MASTER_PORT, MonitorPlan, ReplyTag};
pub use wire::{ControlWord, ErrorCode, MainState, MotionBlock, StateVar, StatusWord, WarnWord};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "linudp-v2";

/// This protocol, for the list of all of them.
pub(super) const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "LinMot LinUDP V2",
    #[cfg(feature = "config")]
    read: config::bus,
    #[cfg(feature = "config")]
    reference: include_str!("../../../docs/src/configuration-linudp.md"),
    #[cfg(feature = "config")]
    specimen: config::SPECIMEN,
    #[cfg(feature = "cli")]
    outline: outline::OUTLINE,
    #[cfg(feature = "cli")]
    tools: tools::TOOLS,
};
