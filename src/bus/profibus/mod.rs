//! PROFIBUS DP (DP-V0, DP-V1) to Lenze EMF2133IB: velocity-controlled axes in turn on one half-duplex wire.
//!
//! | file | what |
//! |---|---|
//! | `plan` | the bus as configured |

mod acyclic;
mod plan;

pub use plan::{
    ADDRESS_MAX, Bits, CHANNEL, DATA_MAX, DriveProfile, LEAST_SLOT_BITS, LenzeDrive, Numbers, ParameterPath,
    ProfibusPlan, RATES, RETRIES_MAX, SLOT_MARGIN_BITS, Scale, ShownWord, StatusBit, USUAL_MAX_TSDR,
    Watchdog, lengths,
};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "profibus-dp";
