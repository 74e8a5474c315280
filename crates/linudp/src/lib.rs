//! LinMot LinUDP V2: UDP, the master on port 41136, the drives on 49360, one reply to each request.
//!
//! | file | what |
//! |---|---|
//! | `wire` | the telegram, both directions |
//! | `motion` | motion commands: the catalogue, constructors, units |
//! | `curve` | time curves and encoder cams |
//! | `table` | the drive's command table |
//! | `name` | names of curves and of entries of the table, as the drive holds them |
//! | `station` | the master's view of one drive: identity of replies, feedback |
//! | `profile` | what is desired as blocks of a request, and what replies prove |
//! | `channel` | the motion command interface: counts and their echo |
//! | `other` | another master's commands, by their counts |
//! | `rtc` | the real-time-config channel: one acyclic call after the other, in the requests that go out anyway |
//! | `service` | what a drive offers besides its parameters: curves, command table, error log, software, flash |
//! | `upid`, `notation` | parameters by number and name; how people write and list them |
//! | `counters` | what only this protocol counts |
//! | `native`, `fields` | unscaled process data for the application, and as a recording shows them |
//! | `bus` | all drives on one socket |
//! | `diagnosis` | why a drive is not online |
//! | `last` | their stop without the loop |
//! | `plan` | the bus as configured |
//! | `config` | by that feature: its keys in a configuration, what a first one has, its curves and command tables as files, and `fieldbeat linmot` |
//!
//! Facts: "LinUDP V2 Interface" manual 0185-1108-E 1V9 and "User Manual Motion Control SW" (SG5) 4.3.4.
//!
//! What follows is the reference of docs/ for its configuration.
#![doc = include_str!("../files/configuration-linudp.md")]

mod bus;
mod channel;
#[cfg(feature = "config")]
pub mod config;
mod counters;
pub mod curve;
pub mod diagnosis;
mod fields;
mod last;
pub mod motion;
mod name;
pub mod native;
pub mod notation;
mod other;
pub mod plan;
mod profile;
pub mod rtc;
pub mod service;
pub mod station;
pub mod table;
pub mod upid;
pub mod wire;

pub use rtc::UNACKNOWLEDGED;

pub use motion::stream::StreamCommand;
pub use native::{Native, NativeInputs, NativeOutput};
pub use plan::{
    COUNTS_PER_MM, DRIVE_PORT, LinUdpDrive, LinUdpPlan, MASTER_PORT, MonitorPlan, ReplyTag, Serial,
};
pub use wire::{ControlWord, ErrorCode, MainState, MotionBlock, StateVar, StatusWord, WarnWord};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "linudp-v2";
