//! EtherNet/IP: implementations of others at either end, and Wireshark's dissector in between.
//!
//! | file | what |
//! |---|---|
//! | `adapter` | our master, and a class 1 adapter of cm-ethernetip |
//! | `scanners` | class 1 scanners of st-ethernet-ip and ethernetip, and our simulated drive |
//! | `clients` | explicit messages of pycomm3 and cpppo, and our simulated drive |
//! | `dissector` | our master and our simulated drives, and what tshark sees |
//! | `programs` | their programs |

mod adapter;
mod clients;
mod dissector;
mod scanners;

use std::net::Ipv4Addr;

use fieldbeat::bus::ethernet_ip::{EthernetIpPlan, MoonsDrive};
use fieldbeat::time::MS;
use fieldbeat::{CyclePlan, Plan, Realtime};

use crate::support::{LONG, skipping};

/// Command words.
const ENABLE: i64 = 0x2;
const RELATIVE: i64 = 0x8;
const ABSOLUTE: i64 = 0x10;

/// The inputs that status and absolute position are.
const STATUS: usize = 0;
const POSITION: usize = 6;
const ENABLED: i64 = 0x1;
const MOVING: i64 = 0x10;

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
    let cycle = CyclePlan {
        period_ns: 2 * MS,
        receive_deadline: 0.8,
        realtime: Realtime::Off,
        ..CyclePlan::default()
    };
    skipping(EthernetIpPlan::new(bind, drives), cycle)
}
