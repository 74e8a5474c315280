//! PROFIBUS DP (DP-V0, DP-V1) to Lenze EMF2133IB: velocity-controlled axes in turn on one half-duplex wire, of which
//! this is the only master.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |
//! | `plan` | the bus as configured |
//! | `line` | the link layer: silence, token, slot time, repetitions, the count of requests |
//! | `start_up` | a drive on its way to Data_Exchange |
//! | `profile`, `native` | control word and set point, status and actual value; native process data |
//! | `fields` | native process data as a recording shows them |
//! | `station` | the master's view of one drive |
//! | `acyclic` | parameters, in the drive's own turns |
//! | `target`, `catalogue`, `notation` | what a call is for; known codes; how people write them |
//! | `bus`, `bus_plan` | line, stations and port as one bus |
//! | `schedule` | its turns on the grid: whether they fit, and how long one waits |
//! | `check`, `describe` | what is wrong with a plan, and what `check` says of a drive |
//! | `config` | by that feature: its keys in a configuration, what a first one has, and `fieldbeat profibus` |
//! | `other` | whether another master is on the wire |
//! | `counters`, `notes`, `diagnosis` | counts, and why a drive is not in Data_Exchange |
//!
//! What follows is the reference of docs/ for its configuration.
#![doc = include_str!("../files/configuration-profibus.md")]

mod acyclic;
mod bus;
mod bus_plan;
mod catalogue;
mod check;
#[cfg(feature = "config")]
pub mod config;
pub mod counters;
mod describe;
pub mod diagnosis;
mod fields;
pub mod line;
mod native;
pub mod notation;
mod notes;
mod other;
mod plan;
mod profile;
mod schedule;
mod start_up;
pub mod station;
pub mod target;
pub mod wire;

pub use native::{NATIVE_WORDS, Native, NativeInputs, NativeOutput};
pub use plan::{
    ADDRESS_MAX, Bits, CHANNEL, DATA_MAX, DriveProfile, LEAST_SLOT_BITS, LenzeDrive, Numbers, ParameterPath,
    ProfibusPlan, RATES, RETRIES_MAX, Rs485, SLOT_MARGIN_BITS, Scale, ShownWord, StatusBit, USUAL_MAX_TSDR,
    Watchdog,
};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "profibus-dp";

/// Why a drive cannot have its address.
const ADDRESS_TAKEN: &str = "is taken by another drive; one drive per address";
