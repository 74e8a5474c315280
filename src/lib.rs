//! Fieldbeat: a hard-real-time cyclic master for servo drives.

pub mod axis;
pub mod bus;
pub mod cycle;
pub mod net;
pub mod rt;
pub mod sim;
pub mod time;
