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
//! | `station` | the master's view of one drive |
//! | `acyclic` | parameters, in the drive's own turns |
//! | `target`, `catalogue`, `notation` | what a call is for; known codes; how people write them |
//! | `bus`, `bus_plan` | line, stations and port as one bus |
//! | `counters`, `notes` | counts, and why a drive is not in Data_Exchange |

mod acyclic;
mod bus;
mod bus_plan;
mod catalogue;
pub(crate) mod counters;
mod line;
mod native;
pub(crate) mod notation;
mod notes;
mod plan;
mod profile;
mod start_up;
mod station;
pub(crate) mod target;
pub(crate) mod wire;

pub use native::{NATIVE_WORDS, Native, NativeInputs, NativeOutput};
pub use plan::{
    ADDRESS_MAX, Bits, CHANNEL, DATA_MAX, DriveProfile, LEAST_SLOT_BITS, LenzeDrive, Numbers, ParameterPath,
    ProfibusPlan, RATES, RETRIES_MAX, SLOT_MARGIN_BITS, Scale, ShownWord, StatusBit, USUAL_MAX_TSDR,
    Watchdog,
};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "profibus-dp";
