//! `fieldbeat profibus`: the stations of a PROFIBUS wire.

use std::os::fd::{BorrowedFd, RawFd};
use std::thread::sleep;
use std::time::Duration;

use clap::{Args, Subcommand};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use serde_json::{Value, json};

use super::scan::{Found, ScanError, scan};
use crate::check::{LATENCY_MAX_NS, rates};
use crate::plan::{ADDRESS_MAX, Bits, ProfibusPlan, RATES, Rs485};
use crate::wire::dp::{Diagnosis, DiagnosisStatus};
use fieldbeat_core::net::{Carriers, Os, Place};
use fieldbeat_core::rt::MonotonicClock;
use fieldbeat_core::time::MS;
use fieldbeat_tools::{Program, Stop, Tool, arguments, table};

/// The commands that this protocol adds.
pub const TOOLS: &[Tool] = &[Tool {
    name: "profibus",
    about: "The stations of a PROFIBUS wire",
    subcommands: Profibus::augment_subcommands,
    run: |matches, program| match arguments(matches)? {
        Profibus::Scan(scan) => scan.run(program),
    },
}];

/// What a port may add before a byte is read while nothing is known of it, ms.
pub(super) const SCAN_LATENCY_MS: u64 = 20;

#[derive(Debug, Subcommand)]
enum Profibus {
    /// Lists the stations that answer, with their ident numbers and masters; changes nothing. It listens first, and
    /// sends nothing while another master uses the wire.
    Scan(Scan),
}

#[derive(Debug, Args)]
struct Scan {
    /// The serial port, for example /dev/ttyS1; or `local:NAME`, a simulated wire of this host.
    device: String,
    /// The rate of the wire, bit/s.
    #[arg(long, value_name = "BITS", default_value_t = ProfibusPlan::RATE, value_parser = rate)]
    rate: u32,
    /// The own address: no station is looked for there. 0 is that of a programming device. Not that of a master that
    /// has died while its drives turn: a diagnosis from there feeds their watchdogs.
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u8).range(0..=i64::from(ADDRESS_MAX)))]
    address: u8,
    /// What the port adds before a byte is read, ms: an answer is waited for so much longer.
    #[arg(
        long, value_name = "MS", default_value_t = SCAN_LATENCY_MS,
        value_parser = clap::value_parser!(u64).range(0..=LATENCY_MAX_NS / MS)
    )]
    latency: u64,
    /// The driver of the port switches the direction of the wire, and not the adapter by itself.
    #[arg(long)]
    driver: bool,
    /// The adapter returns what is sent.
    #[arg(long)]
    echo: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

fn rate(text: &str) -> Result<u32, String> {
    let rate = text.parse().ok().filter(|rate| RATES.contains(rate));
    rate.ok_or_else(|| format!("must be {} bit/s", rates()))
}

impl Scan {
    /// The wire as it is scanned.
    fn plan(&self) -> ProfibusPlan {
        let plan = ProfibusPlan::new(&self.device, self.rate, Vec::new());
        ProfibusPlan {
            address: self.address,
            bits: Bits { latency_ns: self.latency * MS, ..plan.bits },
            rs485: if self.driver { Rs485::Driver } else { Rs485::Adapter },
            echo: self.echo,
            ..plan
        }
    }

    fn run(self, program: &dyn Program) -> Result<(), Stop> {
        let (device, plan) = (&self.device, self.plan());
        let found = stations(&plan, &|| !program.is_interrupted()).map_err(Stop::usage)?;
        let found = found.map_err(|error| match error {
            ScanError::Port(why) => Stop::usage(why),
            other => Stop::failed(format!("{device}: {other}")),
        })?;
        if self.json {
            let stations: Vec<Value> = found.iter().map(object).collect();
            program.print(&json!({ "device": device, "rate": self.rate, "stations": stations }))
        } else {
            program.print(&text(&found))
        }
    }
}

/// The stations of the wire of `plan`, as long as `goes_on` is true. The outer error: its port cannot be used.
pub(super) fn stations(
    plan: &ProfibusPlan,
    goes_on: &dyn Fn() -> bool,
) -> Result<Result<Vec<Found>, ScanError>, String> {
    let device = &plan.device;
    let _lock = Place::Port(device).lock().map_err(|why| format!("{device} {why}"))?;
    let port = Os::default().serial(device, &plan.line());
    let mut port = port.map_err(|error| format!("cannot use {device}: {error}"))?;
    let mut wait = |fd, most_ns| {
        pause(fd, most_ns);
        goes_on().then(MonotonicClock::read)
    };
    Ok(scan(&mut *port, plan, &mut wait))
}

/// Waits until the descriptor is readable, or for so many ns, rounded up to whole milliseconds.
fn pause(fd: Option<RawFd>, most_ns: u64) {
    let ms = most_ns.div_ceil(MS);
    let Some(fd) = fd else { return sleep(Duration::from_millis(ms)) };
    // SAFETY: the carrier holds it, and is borrowed by the caller.
    let fd = unsafe { BorrowedFd::borrow_raw(fd) };
    let most = PollTimeout::try_from(ms).unwrap_or(PollTimeout::MAX);
    // A signal wakes it early: the caller decides whether to go on.
    let _ = poll(&mut [PollFd::new(fd, PollFlags::POLLIN)], most);
}

fn text(found: &[Found]) -> String {
    table(["address", "ident", "configuration", "master", "watchdog", "state"], found.iter().map(row))
}

fn row(found: &Found) -> [String; 6] {
    let seen = found.diagnosis();
    let watchdog = |seen: Diagnosis<'_>| if seen.status.has(DiagnosisStatus::WD_ON) { "on" } else { "off" };
    let cells = [
        seen.map(|seen| format!("{:#06x}", seen.ident)),
        seen.map(|_| configuration(&found.configuration)),
        seen.and_then(|seen| Some(seen.master?.to_string())),
        seen.map(|seen| watchdog(seen).to_owned()),
    ];
    let [ident, configuration, master, watchdog] = cells.map(|cell| cell.unwrap_or_else(|| "-".to_owned()));
    let none = || "answers without a diagnosis: no slave of DP".to_owned();
    let state = seen.as_ref().map_or_else(none, state);
    [found.address.to_string(), ident, configuration, master, watchdog, state]
}

/// Its identifier bytes, as a configuration has them.
fn configuration(bytes: &[u8]) -> String {
    let bytes: Vec<String> = bytes.iter().map(|byte| format!("0x{byte:02X}")).collect();
    if bytes.is_empty() { "-".to_owned() } else { format!("[{}]", bytes.join(", ")) }
}

/// What its master, or whoever is to become it, has to know.
fn state(seen: &Diagnosis<'_>) -> String {
    let status = seen.status.without(DiagnosisStatus::ALWAYS | DiagnosisStatus::WD_ON);
    let mut words: Vec<String> = status.names().map(str::to_owned).collect();
    if words.is_empty() {
        words.push("in operation".to_owned());
    }
    words.extend(seen.fault().filter(|fault| *fault != 0).map(|fault| format!("fault {fault:#06x}")));
    words.join(", ")
}

/// A station as JSON.
fn object(found: &Found) -> Value {
    let seen = found.diagnosis();
    json!({
        "address": found.address,
        "ident": seen.map(|seen| seen.ident),
        "configuration": (!found.configuration.is_empty()).then_some(&found.configuration),
        "master": seen.and_then(|seen| seen.master),
        "watchdog": seen.map(|seen| seen.status.has(DiagnosisStatus::WD_ON)),
        "status": seen.map(|seen| seen.status.names().collect::<Vec<_>>()),
        "extended": seen.map(|seen| seen.extended),
        "fault": seen.and_then(|seen| seen.fault()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stations_stand_in_a_table_and_a_rate_is_one_of_the_ten() {
        let found = |address, status: u32, master, fault: u16| {
            let status = [&status.to_le_bytes()[..3], &[master]].concat();
            let data = [&status[..], &[0, 0x82, 3], &fault.to_be_bytes()].concat();
            Found { address, data, configuration: vec![0xF3, 0xF1] }
        };
        let waits = DiagnosisStatus::PRM_REQ | DiagnosisStatus::ALWAYS;
        let runs = DiagnosisStatus::WD_ON | DiagnosisStatus::ALWAYS;
        let silent = Found { address: 126, data: Vec::new(), configuration: Vec::new() };
        let found = [found(3, waits, 255, 0), found(14, runs, 2, 0x2310), silent];
        let lines: Vec<String> = text(&found).lines().map(str::to_owned).collect();
        let words = |row: usize| lines[row].split_whitespace().collect::<Vec<_>>().join(" ");
        assert_eq!(words(0), "address ident configuration master watchdog state");
        assert_eq!(words(1), "3 0x0082 [0xF3, 0xF1] - off parametrisation requested");
        assert_eq!(words(2), "14 0x0082 [0xF3, 0xF1] 2 on in operation, fault 0x2310");
        assert_eq!(words(3), "126 - - - - answers without a diagnosis: no slave of DP");
        let json = object(&found[1]);
        assert_eq!(
            (&json["ident"], &json["master"], &json["fault"]),
            (&0x82.into(), &2.into(), &0x2310.into())
        );
        assert_eq!(json["configuration"], json!([0xF3, 0xF1]));
        assert_eq!(object(&found[2])["ident"], Value::Null);
        assert_eq!(rate("500000"), Ok(500_000));
        assert!(rate("115200").unwrap_err().contains("1500000"));
    }
}
