//! The fuzz targets: plain functions of bytes that panic when something does not hold.
//!
//! | target | what the bytes are |
//! |---|---|
//! | `telegram` | a datagram, for every parser of what comes from a wire |
//! | `modbus_wire` | a stream of Modbus TCP, for every parser of it; as text, an address and a value of a parameter |
//! | `modbus` | a program for a Modbus bus on one connection: commands, replies good and bad, a connection that ends |
//! | `ethercat_wire` | a frame of EtherCAT, a mailbox message, words of an EEPROM |
//! | `ethercat_mailbox` | a program for the mailbox of a slave: transfers, and a slave that answers as it likes |
//! | `ethercat_sii` | the answers of a slave's EEPROM |
//! | `ethercat` | a program for an EtherCAT bus on one line: commands, and frames that come back as they like |
//! | `ethernet_ip_wire` | a datagram or a stream of EtherNet/IP, for every parser of it |
//! | `profibus_wire` | what arrives on a PROFIBUS, for every parser of it |
//! | `channel` | a program for the parameter channel: calls posted, cancelled and forgotten, on a bad wire |
//! | `files` | the text of a curve or of a command table |
//! | `recording` | damage to a recording with its log |
//! | `config` | the text of a configuration |
//! | `config_keys` | a program that changes the sample configurations key by key |
//! | `machine` | a program for a whole machine in virtual time: a hostile drive, and an application in a hurry |
//!
//! Two drivers run them: `main.rs`, a plain test, and libFuzzer (`libfuzzer/`). A program is read by [`input::Input`],
//! which makes sense of any bytes, so that whatever a fuzzer changes is a program again.

#[path = "../../support/forward.rs"]
mod forward;

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
