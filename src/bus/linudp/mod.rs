//! LinMot LinUDP V2: UDP, the master on port 41136, the drives on 49360, one reply to each request.
//!
//! | file | what |
//! |---|---|
//! | `wire` | the telegram, both directions |
//! | `motion` | motion commands: header, parameters, units |
//! | `station` | the master's view of one drive |
//! | `bus` | all drives on one socket |
//! | `plan` | the bus as configured |
//! | `sim` | the simulated drive |
//!
//! Facts: "LinUDP V2 Interface" manual 0185-1108-E 1V9 and "User Manual Motion Control SW" (SG5) 4.3.4.

pub mod plan;

pub use plan::{DRIVE_PORT, LinUdpDrive, LinUdpPlan, MASTER_PORT, MasterFilter, SimPlan, StreamCommand};
