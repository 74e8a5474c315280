//! `fieldbeat ethernet-ip`: the devices on a network.

use std::fmt::Write;
use std::net::{Ipv4Addr, SocketAddrV4};

use clap::{Args, Subcommand};
use serde_json::{Value, json};

use super::scan::{Device, ScanError, scan};
use crate::check::VENDOR_NAME;
use crate::plan::{Expected, PORT};
use crate::wire::encapsulation::Identity;
use fieldbeat_keys::value::station;
use fieldbeat_tools::{Program, Stop, Tool, arguments, table};

/// The commands that this protocol adds.
pub const TOOLS: &[Tool] = &[Tool {
    name: "ethernet-ip",
    about: "The EtherNet/IP devices on a network",
    subcommands: EthernetIp::augment_subcommands,
    run: |matches, program| match arguments(matches)? {
        EthernetIp::Scan(scan) => scan.run(program),
    },
}];

#[derive(Debug, Subcommand)]
enum EthernetIp {
    /// Lists the devices that answer ListIdentity, by a broadcast or at given addresses; changes nothing.
    Scan(Scan),
}

#[derive(Debug, Args)]
struct Scan {
    /// The addresses to ask, each with a port if it is not 44818. Without any, all devices on the network are asked by
    /// a broadcast.
    #[arg(value_name = "TARGET", value_parser = target)]
    targets: Vec<SocketAddrV4>,
    /// The address of this computer to ask from. Without it, the routes of this computer decide.
    #[arg(long, value_name = "IP")]
    bind: Option<Ipv4Addr>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

fn target(text: &str) -> Result<SocketAddrV4, String> {
    let fine = |address: &SocketAddrV4| !address.ip().is_unspecified();
    station(text, PORT).filter(fine).ok_or_else(|| {
        "write an IPv4 address like 192.168.1.40, with a port other than 44818 behind a colon".into()
    })
}

impl Scan {
    fn run(self, program: &dyn Program) -> Result<(), Stop> {
        let from = self.bind.unwrap_or(Ipv4Addr::UNSPECIFIED);
        let devices = scan(from, &self.targets, &|| !program.is_interrupted());
        let devices = devices.map_err(|error| match error {
            ScanError::Bind(_) => Stop::usage(error),
            other => Stop::failed(other),
        })?;
        if self.json {
            let devices: Vec<Value> = devices.iter().map(object).collect();
            program.print(&json!({ "devices": devices }))?;
        } else {
            program.print(&text(&devices))?;
        }
        let answered = |target: &&SocketAddrV4| devices.iter().any(|device| device.from.ip() == target.ip());
        let silent: Vec<String> = self
            .targets
            .iter()
            .filter(|target| !answered(target) && !is_broadcast(target))
            .map(ToString::to_string)
            .collect();
        match silent.is_empty() {
            true => Ok(()),
            false => Err(Stop::failed(format!(
                "no answer from {}; check power, cable and address",
                silent.join(", ")
            ))),
        }
    }
}

/// Nobody answers from the address of a whole network.
fn is_broadcast(target: &SocketAddrV4) -> bool {
    target.ip().octets()[3] == 255
}

/// The table, and below it what stands in no column.
fn text(devices: &[Device]) -> String {
    const HEAD: [&str; 8] = ["address", "name", "vendor", "type", "product", "revision", "serial", "state"];
    let mut text = table(HEAD, devices.iter().map(row));
    for device in devices.iter().filter(|device| device.claims.ip() != device.from.ip()) {
        let _ = write!(text, "\n{} says that it is at {}", device.from.ip(), device.claims);
    }
    text
}

fn row(device: &Device) -> [String; 8] {
    let Identity { vendor: by, device_type, product_code, revision, serial, name, .. } = &device.identity;
    [
        device.from.ip().to_string(),
        if name.is_empty() { "-".to_owned() } else { name.clone() },
        vendor(*by).map_or_else(|| by.to_string(), |name| format!("{by} ({name})")),
        device_type.to_string(),
        product_code.to_string(),
        format!("{}.{}", revision.0, revision.1),
        format!("{serial:#010x}"),
        state(device.state).map_or_else(|| device.state.to_string(), str::to_owned),
    ]
}

/// The vendors of these drives.
pub(super) fn vendor(number: u16) -> Option<&'static str> {
    (number == Expected::VENDOR).then_some(VENDOR_NAME)
}

/// The state of a device (EtherNet/IP, volume 2, ListIdentity).
fn state(number: u8) -> Option<&'static str> {
    Some(match number {
        0 => "nonexistent",
        1 => "self-testing",
        2 => "standby",
        3 => "operational",
        4 => "recoverable fault",
        5 => "unrecoverable fault",
        0xFF => "unknown",
        _ => return None,
    })
}

/// A device as JSON.
fn object(device: &Device) -> Value {
    let Device { from, claims, identity, state: code } = device;
    json!({
        "address": from.ip().to_string(),
        "claimed_address": claims.to_string(),
        "name": identity.name,
        "vendor": identity.vendor,
        "vendor_name": vendor(identity.vendor),
        "device_type": identity.device_type,
        "product": identity.product_code,
        "revision": format!("{}.{}", identity.revision.0, identity.revision.1),
        "serial": identity.serial,
        "status": identity.status,
        "state": code,
        "state_name": state(*code),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_stand_in_a_table_that_says_where_one_is_elsewhere() {
        let claims = SocketAddrV4::new([10, 10, 10, 10].into(), 44_818);
        let device = Device { claims, ..crate::config::scan::specimen() };
        let identity = Identity { vendor: 1, name: String::new(), ..device.identity.clone() };
        let other = Device { claims: device.from, identity, state: 9, from: device.from };
        let rows: Vec<String> = text(&[device.clone(), other]).lines().map(str::to_owned).collect();
        assert_eq!(rows.len(), 4);
        let words = |row: usize| rows[row].split_whitespace().collect::<Vec<_>>().join(" ");
        assert_eq!(words(0), "address name vendor type product revision serial state");
        assert_eq!(
            words(1),
            "192.168.1.40 STF05-IP 60 (Applied Motion Products) 43 176 251.3 0x00c0ffee operational"
        );
        assert_eq!(words(2), "192.168.1.40 - 1 43 176 251.3 0x00c0ffee 9");
        assert_eq!(rows[3], "192.168.1.40 says that it is at 10.10.10.10:44818");
        let json = object(&device);
        assert_eq!((&json["serial"], &json["state_name"]), (&0xC0FFEE.into(), &"operational".into()));
        // Targets have the usual port unless they name another one.
        assert_eq!(target("192.168.1.40"), Ok(SocketAddrV4::new([192, 168, 1, 40].into(), PORT)));
        assert_eq!(target("192.168.1.40:5").map(|target| target.port()), Ok(5));
        for text in ["", "0.0.0.0", "drive", "192.168.1.40:0", "::1"] {
            assert!(target(text).is_err(), "{text}");
        }
    }
}
