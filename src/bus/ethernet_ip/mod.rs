//! EtherNet/IP to MOONS' (Applied Motion) STF and SSDC: class 1 packets on UDP 2222, sessions on TCP 44818.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |
//! | `plan` | the bus as configured |
//! | `target` | what an acyclic call does, as numbers |
//! | `session` | the session of a drive on the link thread, and its acyclic calls |
//! | `exchange` | what passes between session and loop |

pub(crate) mod exchange;
pub(crate) mod plan;
pub(crate) mod session;
pub(crate) mod target;
pub(crate) mod wire;

pub(crate) use plan::{Access, Layout, Version};

/// The protocol's name in configurations.
pub(crate) const PROTOCOL: &str = "ethernet-ip";
