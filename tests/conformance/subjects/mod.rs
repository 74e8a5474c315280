//! The protocols, a file each.

pub mod ethercat;
pub mod linudp;
pub mod modbus;
pub mod toy;
