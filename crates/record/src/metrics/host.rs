//! For whom a request was meant, by its Host header. A web page from elsewhere can have its own name bound to this
//! computer's address and then read what is answered (DNS rebinding); the name in the header gives it away.

use std::net::{IpAddr, Ipv6Addr};

use fieldbeat_core::rt::host;

/// The value of a Host header (RFC 9110, 7.2), without its port: several may lead here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Meant<'a> {
    /// A name or an address; one of IPv6 without its brackets.
    pub name: &'a str,
    is_v6: bool,
}

impl<'a> Meant<'a> {
    /// `None`: it is none.
    pub fn parse(value: &'a [u8]) -> Option<Meant<'a>> {
        let value = std::str::from_utf8(value).ok()?.trim_matches([' ', '\t']);
        let (name, rest, is_v6) = match value.strip_prefix('[') {
            Some(literal) => {
                let (name, rest) = literal.split_once(']')?;
                (name, rest, true)
            }
            None => {
                let (name, rest) = value.split_at(value.find(':').unwrap_or(value.len()));
                (name, rest, false)
            }
        };
        let is_port = |port: &str| port.bytes().all(|byte| byte.is_ascii_digit()) && port.len() <= 5;
        let port = rest.is_empty() || rest.strip_prefix(':').is_some_and(is_port);
        let name_is_whole = if is_v6 { name.parse::<Ipv6Addr>().is_ok() } else { is_name(name) };
        (port && name_is_whole).then_some(Meant { name, is_v6 })
    }

    fn address(self) -> Option<IpAddr> {
        self.name.parse().ok().filter(|address: &IpAddr| address.is_ipv6() == self.is_v6)
    }
}

/// Whether it may be the name of a computer, or an address of IPv4.
pub(crate) fn is_name(name: &str) -> bool {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    !name.is_empty() && name.bytes().all(plain)
}

/// The names of an endpoint.
#[derive(Debug)]
pub struct Names {
    names: Vec<String>,
}

impl Default for Names {
    fn default() -> Names {
        Names { names: [String::from("localhost")].into_iter().chain(host::name()).collect() }
    }
}

impl Names {
    /// One more.
    pub fn add(&mut self, name: String) {
        self.names.push(name);
    }

    /// Whether a request was meant for this endpoint; `local`: the address that it came to. An address is no name that
    /// somebody else could have bound to it.
    pub fn are_ours(&self, meant: Meant<'_>, local: IpAddr) -> bool {
        match meant.address() {
            Some(address) => {
                let address = address.to_canonical();
                address.is_loopback() || address == local.to_canonical()
            }
            None => {
                // A name may be written with the dot of the root.
                let name = meant.name.strip_suffix('.').unwrap_or(meant.name);
                self.names.iter().any(|ours| ours.eq_ignore_ascii_case(name))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn our_addresses_and_names_are_ours_in_every_form_and_no_others() {
        let mut names = Names::default();
        names.add("press1".into());
        let own = host::name().unwrap();
        let v4: IpAddr = [192, 168, 1, 1].into();
        let v6: IpAddr = "fd00::1".parse().unwrap();
        let is_ours = |host: &str, local| {
            Meant::parse(host.as_bytes()).is_some_and(|meant| names.are_ours(meant, local))
        };
        for (form, hosts) in [
            ("this host", &["localhost", "LocalHost:9464", "localhost.", &own][..]),
            ("a name of the plan", &["press1:9464", "Press1"]),
            (
                "the loopback",
                &["127.0.0.1", "127.3.2.1:9464", "[::1]", "[::1]:9464", "[0:0:0:0:0:0:0:1]:9464"],
            ),
            ("the local address", &[" 192.168.1.1:1 ", "[::ffff:192.168.1.1]"]),
        ] {
            for host in hosts {
                assert!(is_ours(host, v4), "{form}: {host}");
            }
        }
        assert!(is_ours("[fd00::1]:9464", v6) && !is_ours("[fd00::2]:9464", v6));
        for (wrong, hosts) in [
            ("no name", &["", ":", ":9464"][..]),
            ("another name", &["evil.example", "evil.example:9464", "a@localhost", "localhost/"]),
            (
                "ours is its begin",
                &["localhost.evil.example", "press1.evil.example", "127.0.0.1.evil.example"],
            ),
            ("another address", &["192.168.1.2", "0.0.0.0"]),
            ("brackets", &["::1", "[::1", "::1]", "[127.0.0.1]", "[localhost]", "[::1]x"]),
            ("no port", &["localhost:x", "localhost:123456"]),
        ] {
            for host in hosts {
                assert!(!is_ours(host, v4), "{wrong}: {host}");
            }
        }
        assert!(!Meant::parse(b"local\xffhost").is_some_and(|meant| names.are_ours(meant, v4)));
    }
}
