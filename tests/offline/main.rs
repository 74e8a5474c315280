//! What needs no socket, no other process and no clock of the host: its result is the same on every host and in every
//! run. One program, so that the library is linked once for all of it.
//!
//! | module | what |
//! |---|---|
//! | `config` | configurations: every mistake by its line, the samples, the defaults |
//! | `conformance` | what every bus must do, clause by clause |
//! | `virtual_time` | the whole machine in virtual time |
//! | `codecs` | the codec of the master against that of the simulated drives, for each protocol |
//! | `between` | simulated drives with something between them and the world |
//! | `proposing` | buses that build requests which never leave |

mod between;
mod codecs;
mod config;
mod conformance;
#[path = "../support/forward.rs"]
mod forward;
mod proposing;
mod virtual_time;
