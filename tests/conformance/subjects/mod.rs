//! The protocols, a file each.

pub mod linudp;
pub mod toy;
