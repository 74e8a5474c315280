//! The wire against simulated drives, in virtual time.

mod scan;
mod segment;
mod service;
mod station;
