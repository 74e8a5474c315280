//! EtherNet/IP: implementations of others at either end, and Wireshark's dissector in between.

mod adapter;
mod clients;
mod dissector;
mod scanners;

use std::net::Ipv4Addr;

use fieldbeat::Plan;
use fieldbeat::bus::ethernet_ip::{EthernetIpPlan, MoonsDrive};
use fieldbeat::sim::SimDrive;
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::time::MS;
use fieldbeat_sim::ethernet_ip::{MoonsSettings, MoonsSim};

use crate::support::{LONG, ordinary_cycle, skipping};

/// Command words.
const ENABLE: i64 = 0x2;
const RELATIVE: i64 = 0x8;
const ABSOLUTE: i64 = 0x10;

/// The inputs that status and absolute position are.
const STATUS: usize = 0;
const POSITION: usize = 6;
const ENABLED: i64 = 0x1;
const MOVING: i64 = 0x10;

/// Simulated drives.
fn serve(settings: impl IntoIterator<Item = MoonsSettings>) -> SimServer {
    let drive = |settings| Box::new(MoonsSim::new(settings)) as Box<dyn SimDrive>;
    let drives: Vec<_> = settings.into_iter().map(drive).collect();
    SimServer::start(drives, ServerOptions::default()).unwrap()
}

/// A drive for a busy computer: its packets count for long, and its commands may take long.
fn drive(name: &str, address: Ipv4Addr) -> MoonsDrive {
    let mut drive = MoonsDrive::new(name, address);
    drive.axis.divisor = 5;
    drive.axis.health.bucket = 100;
    drive.axis.jog_deadman = None;
    drive.axis.enable_timeout = LONG;
    drive.fresh_within_ns = Some(500 * MS);
    drive.first_within_ns = 20_000 * MS;
    drive.effect_within_ns = 10_000 * MS;
    drive
}

/// A machine of these drives, with a packet to each every 10 ms.
fn plan(bind: Ipv4Addr, drives: Vec<MoonsDrive>) -> Plan {
    skipping(EthernetIpPlan::new(bind, drives), ordinary_cycle())
}
