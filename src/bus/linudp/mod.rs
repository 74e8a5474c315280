//! LinMot LinUDP V2: UDP, the master on port 41136, the drives on 49360, one reply to each request.
//!
//! | file | what |
//! |---|---|
//! | `wire` | the telegram, both directions |
//! | `motion` | motion commands: header, parameters, units |
//! | `station` | the master's view of one drive: identity of replies, feedback |
//! | `orders` | what an order does, step by step |
//! | `channel` | motion command counts and their echo |
//! | `native` | unscaled process data for the application |
//! | `bus` | all drives on one socket |
//! | `plan` | the bus as configured |
//! | `sim` | the simulated drive |
//!
//! Facts: "LinUDP V2 Interface" manual 0185-1108-E 1V9 and "User Manual Motion Control SW" (SG5) 4.3.4.

pub mod bus;
mod channel;
pub mod motion;
pub mod native;
mod orders;
pub mod plan;
pub mod sim;
pub mod station;
pub mod wire;

pub use plan::{
    COUNTS_PER_MM, DRIVE_PORT, LinUdpDrive, LinUdpPlan, MASTER_PORT, MasterFilter, SimPlan, StreamCommand,
};
