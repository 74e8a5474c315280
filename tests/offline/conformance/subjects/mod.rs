//! The protocols, a file each.

pub mod ethercat;
pub mod ethernet_ip;
pub mod linudp;
pub mod modbus;
pub mod profibus;
