//! The fuzz targets: plain functions of bytes that panic when something does not hold.
//!
//! Two drivers run them: `main.rs`, a plain test, and libFuzzer (`libfuzzer/`). A program is read by [`input::Input`],
//! which makes sense of any bytes, so that whatever a fuzzer changes is a program again.

#[path = "../../support/forward.rs"]
mod forward;

mod capture;
mod channel;
mod commanded;
mod commands;
mod config;
mod ethercat;
mod ethercat_mailbox;
mod ethercat_sii;
mod ethercat_wire;
mod ethernet_ip_wire;
mod files;
mod input;
mod machine;
mod modbus;
mod modbus_wire;
mod profibus_wire;
mod recording;
mod telegram;

pub use capture::capture;
pub use channel::channel;
pub use config::{config, config_keys};
pub use ethercat::ethercat;
pub use ethercat_mailbox::ethercat_mailbox;
pub use ethercat_sii::ethercat_sii;
pub use ethercat_wire::ethercat_wire;
pub use ethernet_ip_wire::ethernet_ip_wire;
pub use files::files;
pub use machine::machine;
pub use modbus::modbus;
pub use modbus_wire::modbus_wire;
pub use profibus_wire::profibus_wire;
pub use recording::recording;
pub use telegram::telegram;
