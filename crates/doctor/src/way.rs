//! How a bus meets the network, learned without a socket: by the carrier that it opens first.

use std::io;
use std::net::SocketAddrV4;
use std::sync::{Mutex, PoisonError};

use fieldbeat_core::bus::{BusPlan, Grid};
use fieldbeat_core::net::{Carriers, Datagrams, Frames, Serial, SerialLine, UdpOptions};

/// Where a bus meets the network, as it says itself when it is opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Wire {
    /// The bus' name.
    pub bus: String,
    /// Where the master listens and sends from.
    pub local: SocketAddrV4,
    /// How its socket is opened.
    pub options: UdpOptions,
    /// Where its drives listen.
    pub drives: Vec<SocketAddrV4>,
}

/// Where a bus without IP addresses meets the network: its frames have an interface for themselves.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Line {
    /// The bus' name.
    pub bus: String,
    /// The interface.
    pub interface: String,
}

/// The serial port of a bus.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Port {
    /// The bus' name.
    pub bus: String,
    /// The port, as in the configuration.
    pub path: String,
    /// The settings.
    pub line: SerialLine,
}

/// How a bus meets the network.
pub(super) enum Way {
    Wire(Wire),
    Line(Line),
    Port(Port),
}

impl Way {
    /// That of a bus: the first carrier that it opens. Refused, so that nothing is opened.
    pub(super) fn of(bus: &dyn BusPlan, grid: Grid) -> Option<Way> {
        let noted = FirstOpened::default();
        let _ = bus.open(grid.period_ns, &noted);
        let name = bus.name().to_owned();
        Some(match noted.0.into_inner().ok()?? {
            Carrier::Datagrams(local, options) => {
                let drives = bus.facts(grid).addresses();
                Way::Wire(Wire { bus: name, local, options, drives })
            }
            Carrier::Frames(interface) => Way::Line(Line { bus: name, interface }),
            Carrier::Serial(path, line) => Way::Port(Port { bus: name, path, line }),
        })
    }
}

/// The carrier of a bus.
enum Carrier {
    Datagrams(SocketAddrV4, UdpOptions),
    Frames(String),
    Serial(String, SerialLine),
}

/// Carriers that only note what a bus opens first.
#[derive(Default)]
struct FirstOpened(Mutex<Option<Carrier>>);

impl FirstOpened {
    fn note<T>(&self, carrier: Carrier) -> io::Result<T> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(carrier);
        Err(io::ErrorKind::Unsupported.into())
    }
}

impl Carriers for FirstOpened {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        self.note(Carrier::Datagrams(bind, *options))
    }

    fn frames(&self, interface: &str, _ethertype: u16) -> io::Result<Box<dyn Frames>> {
        self.note(Carrier::Frames(interface.to_owned()))
    }

    fn serial(&self, port: &str, line: &SerialLine) -> io::Result<Box<dyn Serial>> {
        self.note(Carrier::Serial(port.to_owned(), *line))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::net::{Parity, Rs485};

    #[test]
    fn a_bus_without_addresses_is_known_by_its_interface() {
        let noted = FirstOpened::default();
        assert!(noted.frames("eth1", 0x88A4).is_err(), "nothing is opened");
        assert!(noted.frames("eth2", 0x88A4).is_err());
        let Some(Carrier::Frames(interface)) = noted.0.into_inner().unwrap() else { panic!("frames") };
        assert_eq!(interface, "eth1", "the first one counts");
    }

    #[test]
    fn a_bus_on_a_serial_port_is_known_by_its_path_and_settings() {
        let line = SerialLine { rate: 500_000, parity: Parity::Even, rs485: Rs485::Driver };
        let noted = FirstOpened::default();
        assert!(noted.serial("/dev/ttyS1", &line).is_err(), "nothing is opened");
        let Some(Carrier::Serial(path, settings)) = noted.0.into_inner().unwrap() else { panic!("a port") };
        assert_eq!((path.as_str(), settings), ("/dev/ttyS1", line));
    }
}
