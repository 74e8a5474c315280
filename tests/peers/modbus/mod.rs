//! Modbus TCP: two other implementations, libmodbus and pymodbus, at either end, and Wireshark's dissector in between.
//!
//! `programs` are their servers and clients, run by lines of text. Both servers have one register for each address,
//! where a drive has one parameter: what is exchanged with them must not overlap, so that of 32-bit parameters next to
//! each other only every second one is used.

mod clients;
mod dissector;
mod loss;
mod masters;

use std::net::SocketAddrV4;
use std::process::Command;

use fieldbeat::Plan;
use fieldbeat::bus::modbus::{ModbusPlan, UnidriveDrive};
use fieldbeat::sim::SimDrive;
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::time::S;
use fieldbeat_sim::modbus::{UnidriveSettings, UnidriveSim};

use crate::peer::Peer;
use crate::support::{LONG, Machine, checkout, command, ordinary_cycle, skipping};

/// Anybody may listen here.
const PORT: u16 = 1502;

/// Whose program it is.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Library {
    /// C, of the distribution.
    Libmodbus,
    /// Python, below `target/peers`.
    Pymodbus,
}

impl Library {
    /// Starts its program `what`, `server` or `client`, for this address.
    fn start(self, what: &str, machine: &Machine, address: SocketAddrV4, options: &[&str]) -> Peer {
        let source = checkout("tests/peers/modbus/programs").join(what);
        let mut program = match self {
            Library::Libmodbus => {
                let built = machine.path(what);
                let source = source.with_extension("c");
                let (source, out) = (source.to_str().unwrap(), built.to_str().unwrap());
                command(&["cc", "-O1", "-Wall", "-Wextra", "-Werror", "-o", out, source, "-lmodbus"]);
                Command::new(built)
            }
            Library::Pymodbus => {
                let mut python = Command::new(checkout("target/peers/python/bin/python"));
                python.arg(source.with_extension("py"));
                python
            }
        };
        program.arg(address.ip().to_string()).arg(address.port().to_string()).args(options);
        Peer::start(program, machine.path(&format!("{what}.err")))
    }
}

impl Peer {
    /// What a server's registers hold from here on.
    fn registers(&mut self, address: u16, count: usize) -> Vec<u16> {
        let numbers = self.numbers(&format!("get {address} {count}"));
        numbers.into_iter().map(|number| number.try_into().unwrap()).collect()
    }

    /// Lets a server's registers hold these values from here on.
    fn set(&mut self, address: u16, values: &[u16]) {
        let values: Vec<String> = values.iter().map(u16::to_string).collect();
        assert_eq!(self.ask(&format!("set {address} {}", values.join(" "))), "ok");
    }
}

/// The registers of a 32-bit value.
fn long(value: i32) -> [u16; 2] {
    [(value >> 16) as u16, value as u16]
}

/// Simulated drives.
fn serve(settings: impl IntoIterator<Item = UnidriveSettings>) -> SimServer {
    let drive = |settings| Box::new(UnidriveSim::new(settings)) as Box<dyn SimDrive>;
    let drives: Vec<_> = settings.into_iter().map(drive).collect();
    SimServer::start(drives, ServerOptions::default()).unwrap()
}

/// A drive for a busy computer: nothing is missed because somebody was slow.
fn drive(address: SocketAddrV4) -> UnidriveDrive {
    let mut drive = UnidriveDrive::new("m", *address.ip());
    drive.address = address;
    drive.reply_within_ns = 5 * S;
    drive.watchdog.timeout_ns = Some(20 * S);
    drive.axis.health.bucket = 1000;
    drive.axis.enable_timeout = LONG;
    drive.axis.jog_deadman = None;
    drive
}

/// A machine of this drive, with 500 exchanges a second.
fn plan(drive: UnidriveDrive) -> Plan {
    skipping(ModbusPlan::new(vec![drive]), ordinary_cycle())
}
