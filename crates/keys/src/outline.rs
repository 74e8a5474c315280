//! What a first configuration of a protocol has: which keys are asked for, with what as their defaults, and how the
//! drives on a bus are found. Each protocol defines its own in its package; `fieldbeat init` carries them out. What a
//! key means and takes is known from the schema, and whether an answer is right from the reader: neither stands here.

use std::net::{Ipv4Addr, SocketAddrV4};

use nix::ifaddrs::getifaddrs;

use crate::value::{endpoint, station};
use fieldbeat_core::net::Place;

/// The most addresses that are probed one by one.
const MOST_PROBED: usize = 254;

/// What a first configuration of a protocol has.
#[derive(Clone, Copy, Debug)]
pub struct Outline {
    /// The period of its cycle.
    pub period: &'static str,
    /// The keys of `[[bus]]`.
    pub bus: &'static [Line],
    /// The keys that each drive has for itself, but for its name.
    pub drive: &'static [Line],
    /// The unit that its drives have by default.
    pub unit: Unit,
    /// The keys behind those that the drives of all protocols have.
    pub behind: &'static [Line],
    /// How its drives are found.
    pub search: Search,
}

/// A key that is written.
#[derive(Clone, Copy, Debug)]
pub struct Line {
    /// The key, with dots.
    pub key: &'static str,
    /// What is asked.
    pub question: &'static str,
    /// Its default.
    pub usual: Usual,
    /// Only if that key has that value.
    pub only_if: Option<(&'static str, &'static str)>,
}

/// The default of a key, as somebody would type it.
#[derive(Clone, Copy, Debug)]
pub enum Usual {
    /// This one.
    Is(&'static str),
    /// By what is known already.
    From(fn(&Known<'_>) -> Option<String>),
    /// Without an answer the key is left out.
    Optional,
    /// There is none: somebody has to know.
    Needed,
}

/// Of a drive that is moved to positions.
pub const RANGE: Line =
    Line::ask("limits.position", "Allowed range, like [0, 100] (none: any)", Usual::Optional);

/// Of a bus that is bound to an address of this computer.
pub const BIND: Line =
    Line::ask("bind", "Address of this computer on the network of the drives", Usual::From(own_address));
/// Of a drive with an IP address.
pub const ADDRESS: Line = Line::ask("address", "Address of the drive", Usual::From(neighbour));

/// What is known already.
pub struct Known<'a> {
    /// The place of the drive on its bus.
    pub index: usize,
    /// The unit of its drives by default.
    pub unit: Unit,
    /// The answers so far: those of the drive, then those of its bus.
    pub answer: &'a dyn Fn(&str) -> Option<String>,
}

impl std::fmt::Debug for Known<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Known").field("index", &self.index).finish_non_exhaustive()
    }
}

/// The unit of length that drives have by default.
#[derive(Clone, Copy, Debug)]
pub struct Unit {
    /// Its name.
    pub name: &'static str,
    /// What of the drive is counted in one unit, as a question.
    pub counts: &'static str,
    /// How many of these are one unit of this name.
    pub scale: &'static str,
}

impl Unit {
    /// Revolutions of the motor.
    pub const REVOLUTION: Unit =
        Unit { name: "rev", counts: "Revolutions of the motor in one unit", scale: "1" };
}

/// Looks for drives by what is known of their bus, at these addresses where they are probed, for as long as it may go
/// on. It reads and moves nothing. The error is one line.
pub type Run = fn(&Known<'_>, &[SocketAddrV4], &dyn Fn() -> bool) -> Result<Vec<Found>, String>;

/// How drives are found.
#[derive(Clone, Copy, Debug)]
pub struct Search {
    /// The question whether to look for them; it says what that does.
    pub question: &'static str,
    /// Unless something else is answered.
    pub usual: bool,
    /// Addresses are asked for, and probed one by one.
    pub probes: bool,
    /// Looks for them.
    pub run: Run,
    /// The port of addresses that name none.
    pub port: u16,
}

/// What was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found {
    /// In words.
    pub what: String,
    /// The keys that it has for itself; none if it is no drive of this protocol.
    pub lines: Vec<(&'static str, String)>,
}

impl Line {
    /// A key that is asked for.
    pub const fn ask(key: &'static str, question: &'static str, usual: Usual) -> Line {
        Line { key, question, usual, only_if: None }
    }

    /// Only if that key has that value.
    pub const fn only_if(self, key: &'static str, value: &'static str) -> Line {
        Line { only_if: Some((key, value)), ..self }
    }
}

/// An address on the network of `bind`, for a drive that is not known: .10, .11 and so on.
pub fn neighbour(known: &Known<'_>) -> Option<String> {
    let bind = (known.answer)("bind").and_then(|bind| endpoint(&bind, 0));
    let [a, b, c, _] = bind.map_or(Ipv4Addr::new(192, 168, 1, 1), |bind| *bind.ip()).octets();
    let host = u8::try_from(known.index).ok()?.checked_add(10)?;
    Some(Ipv4Addr::new(a, b, c, host).to_string())
}

/// An address of this computer that drives may be able to reach.
pub fn own_address(_: &Known<'_>) -> Option<String> {
    let addresses = getifaddrs().into_iter().flatten().filter_map(|interface| interface.address);
    let mut own = addresses.filter_map(|address| Some(address.as_sockaddr_in()?.ip()));
    Some(own.find(|ip| !ip.is_loopback()).unwrap_or(Ipv4Addr::new(192, 168, 1, 1)).to_string())
}

/// Who answers at an address that is probed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// Nobody.
    None,
    /// A drive of the protocol: what it is, with its article.
    Drive(&'static str),
    /// Something else: what it is, with its article.
    Other(&'static str),
}

/// An address, without the port that is usual.
pub fn shown(address: SocketAddrV4, usual_port: u16) -> String {
    if address.port() == usual_port { address.ip().to_string() } else { address.to_string() }
}

/// What is at these addresses, one after the other as long as `goes_on`; `ask` says who answers there, and the serial
/// number of a drive. One of a master of this host is left alone, and named.
pub fn probed<N: ToString>(
    addresses: &[SocketAddrV4],
    usual_port: u16,
    goes_on: &dyn Fn() -> bool,
    mut ask: impl FnMut(SocketAddrV4) -> (Answer, Option<N>),
) -> Vec<Found> {
    let at = |address: &SocketAddrV4| {
        let shown = shown(*address, usual_port);
        let other = |what| Some(Found { what, lines: Vec::new() });
        match Place::Drive(*address).lock().map(|_lock| ask(*address)) {
            Err(why) => other(format!("{shown} {why}")),
            Ok((Answer::None, _)) => None,
            Ok((Answer::Other(what), _)) => other(format!("{what} at {shown}")),
            Ok((Answer::Drive(what), serial)) => {
                let what = format!("{what} at {shown}");
                let serial = serial.map(|serial| ("serial", serial.to_string()));
                Some(Found { what, lines: [("address", shown)].into_iter().chain(serial).collect() })
            }
        }
    };
    addresses.iter().take_while(|_| goes_on()).filter_map(at).collect()
}

/// The own address of `bind`; any without it.
pub fn own(known: &Known<'_>, port: u16) -> SocketAddrV4 {
    let bind = (known.answer)("bind").and_then(|bind| endpoint(&bind, port));
    bind.unwrap_or(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port))
}

/// Addresses as people write several: `192.168.1.10-14 192.168.1.20`.
pub fn addresses(text: &str, port: u16) -> Result<Vec<SocketAddrV4>, String> {
    let wrong = |part: &str| format!("\"{part}\": write addresses like 192.168.1.10, or 192.168.1.10-14");
    let mut all = Vec::new();
    for part in text.split([' ', ',']).filter(|part| !part.is_empty()) {
        let (first, last) = part.split_once('-').map_or((part, None), |(first, last)| (first, Some(last)));
        let first = station(first, port).ok_or_else(|| wrong(part))?;
        let [a, b, c, from] = first.ip().octets();
        let to = last.map_or(Ok(from), str::parse::<u8>).ok().filter(|to| *to >= from);
        for host in from..=to.ok_or_else(|| wrong(part))? {
            let address = SocketAddrV4::new(Ipv4Addr::new(a, b, c, host), first.port());
            if !all.contains(&address) {
                all.push(address);
            }
        }
    }
    match all.len() {
        0 => Err(wrong("")),
        count if count > MOST_PROBED => Err(format!("{count} addresses: at most {MOST_PROBED} are probed")),
        _ => Ok(all),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_single_ones_and_ranges() {
        let read =
            |text| addresses(text, 502).map(|all| all.iter().map(ToString::to_string).collect::<Vec<_>>());
        assert_eq!(read("10.0.0.5").unwrap(), ["10.0.0.5:502"]);
        assert_eq!(
            read("10.0.0.5-7, 10.0.0.6 10.0.1.1:503").unwrap(),
            ["10.0.0.5:502", "10.0.0.6:502", "10.0.0.7:502", "10.0.1.1:503"]
        );
        for text in ["", " ", "drive", "10.0.0.7-5", "10.0.0.5-300", "10.0.0.5-", "10.0.0.5-10.0.0.7"] {
            assert!(read(text).unwrap_err().contains("write addresses like"), "{text}");
        }
        assert!(read("10.0.0.0-255").unwrap_err().contains("at most 254"));
    }

    #[test]
    fn a_drive_is_proposed_on_the_network_of_the_master() {
        let on = |bind: Option<&str>, index| {
            let answer = |key: &str| bind.filter(|_| key == "bind").map(str::to_owned);
            neighbour(&Known { index, unit: Unit::REVOLUTION, answer: &answer })
        };
        assert_eq!(on(Some("10.1.2.1:2222"), 2).as_deref(), Some("10.1.2.12"));
        assert_eq!(on(None, 0).as_deref(), Some("192.168.1.10"));
        assert_eq!(on(None, 246), None);
    }
}
