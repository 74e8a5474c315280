//! Whose drives, how many of which kind, and where they are. The benches own 127.90.0.0/16, and segments
//! and wires `local:bench-...`.

use std::fmt;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::str::FromStr;
use std::time::Duration;

use fieldbeat::axis::Limits;
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethercat::EthercatPlan;
use fieldbeat::bus::ethernet_ip::EthernetIpPlan;
use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
use fieldbeat::bus::modbus::ModbusPlan;
use fieldbeat::bus::profibus::ProfibusPlan;
use fieldbeat::sim::{SimBus, Simulated};
use fieldbeat_linudp::{DRIVE_PORT, MASTER_PORT};
use fieldbeat_sim::ethernet_ip::MoonsDrives;
use fieldbeat_sim::linudp::LinMots;
use fieldbeat_sim::modbus::Unidrives;
use fieldbeat_sim::profibus::ProfibusSegment;

use super::{lenze, moons, rig, segment, unidrive};

/// Drives of one /24.
const DRIVES_A_NET: usize = 200;

/// The slot time of a wire on this host, bits: the thread that answers has to be woken. At 12 Mbit/s it is 283 us.
const SLOT_BITS: u32 = 3_400;

/// Whose drives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// Those of our loop.
    Ours = 0,
    /// Those of the bare loop.
    Bare = 100,
    /// That of the client over libmodbus.
    Libmodbus = 200,
}

/// Where the master of `side` sends datagrams from.
pub fn master(side: Side) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(127, 90, side as u8, 1), MASTER_PORT)
}

/// Address of LinMot `index` of `side`.
pub fn address(side: Side, index: usize) -> SocketAddrV4 {
    let (net, host) = (1 + index / DRIVES_A_NET, 10 + index % DRIVES_A_NET);
    SocketAddrV4::new(Ipv4Addr::new(127, 90, side as u8 + net as u8, host as u8), DRIVE_PORT)
}

/// Which LinMot has this address.
pub fn index_of(address: SocketAddrV4) -> Option<usize> {
    let [_, _, net, host] = address.ip().octets().map(usize::from);
    Some((net % Side::Bare as usize).checked_sub(1)? * DRIVES_A_NET + host.checked_sub(10)?)
}

/// A LinMot as a machine might have it. A miss is counted, it does not end the measurement.
pub fn linmot(address: Ipv4Addr) -> LinUdpDrive {
    let mut drive = LinUdpDrive::new(address.to_string(), address);
    drive.axis.limits =
        Limits { position: Some((-200.0, 200.0)), velocity: Some(2_000.0), ..Limits::default() };
    drive.leash = Some(20.0);
    drive.axis.health.bucket = rig::bucket();
    drive.axis.stop.group = rig::group();
    drive.axis.enable_timeout = Duration::from_secs(60);
    drive
}

/// The drives of a machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fleet {
    /// LinMots, each in every cycle.
    pub linmots: usize,
    /// Unidrives ...
    pub unidrives: usize,
    /// ... each in every cycle of so many, as many of them in one as in the next.
    pub every: u32,
    /// Kollmorgen drives, on one segment.
    pub segment: usize,
    /// Couplers and terminals, behind these drives.
    pub terminals: usize,
    /// MOONS' drives, each in every cycle of so many as well: their interval.
    pub moons: usize,
    /// Lenze drives, four on each PROFIBUS wire, due like Unidrives.
    pub lenzes: usize,
}

impl Fleet {
    /// No drive.
    pub const NONE: Fleet =
        Fleet { linmots: 0, unidrives: 0, every: 1, segment: 0, terminals: 0, moons: 0, lenzes: 0 };

    /// LinMots only.
    pub const fn linmots(count: usize) -> Fleet {
        Fleet { linmots: count, ..Fleet::NONE }
    }

    /// Unidrives only, in every cycle.
    pub const fn unidrives(count: usize) -> Fleet {
        Fleet { unidrives: count, ..Fleet::NONE }
    }

    /// A segment of Kollmorgen drives only.
    pub const fn segment(count: usize) -> Fleet {
        Fleet { segment: count, ..Fleet::NONE }
    }

    /// A segment of so many Kollmorgen drives, and of so many couplers and terminals behind them.
    pub const fn with_terminals(drives: usize, terminals: usize) -> Fleet {
        Fleet { terminals, ..Fleet::segment(drives) }
    }

    /// MOONS' drives only, in every cycle.
    pub const fn moons(count: usize) -> Fleet {
        Fleet { moons: count, ..Fleet::NONE }
    }

    /// Lenze drives only, in every cycle.
    pub const fn lenzes(count: usize) -> Fleet {
        Fleet { lenzes: count, ..Fleet::NONE }
    }

    /// All of them.
    pub fn drives(self) -> usize {
        self.linmots + self.unidrives + self.segment + self.moons + self.lenzes
    }

    /// How many Unidrives are due in a cycle.
    pub fn due_unidrives(self) -> usize {
        self.unidrives / self.every as usize
    }

    /// The bus of its LinMots on `side`.
    pub fn linudp(self, side: Side) -> LinUdpPlan {
        let drives = (0..self.linmots).map(|index| linmot(*address(side, index).ip()));
        LinUdpPlan::new(*master(side).ip(), drives.collect())
    }

    /// The bus of its Unidrives on `side`.
    pub fn modbus(self, side: Side) -> ModbusPlan {
        let drive = |index: usize| {
            let mut drive = unidrive::drive(*address(side, index).ip());
            drive.axis.divisor = self.every;
            drive.axis.phase = index as u32 % self.every;
            drive
        };
        ModbusPlan::new((0..self.unidrives).map(drive).collect())
    }

    /// The bus of its MOONS' drives on `side`.
    pub fn ethernet_ip(self, side: Side) -> EthernetIpPlan {
        let drive = |index: usize| {
            let mut drive = moons::drive(*address(side, index).ip());
            drive.axis.divisor = self.every;
            drive.axis.phase = index as u32 % self.every;
            drive
        };
        EthernetIpPlan::new(*master(side).ip(), (0..self.moons).map(drive).collect())
    }

    /// Its segment on `side`.
    pub fn ethercat(self, side: Side) -> EthercatPlan {
        segment::plan(&format!("local:bench-{}", side as u8), self.segment, self.terminals)
    }

    /// Its wires on `side`.
    pub fn profibus(self, side: Side) -> Vec<ProfibusPlan> {
        let wires = lenze::wires(&format!("local:bench-wire-{}", side as u8), self.lenzes);
        let on_this_host = |mut plan: ProfibusPlan| {
            plan.bits.slot = SLOT_BITS;
            plan.in_turn(self.every)
        };
        wires.into_iter().map(on_this_host).collect()
    }

    /// Its buses on `side`: LinMots first.
    pub fn buses(self, side: Side) -> Vec<Box<dyn BusPlan>> {
        let mut buses: Vec<Box<dyn BusPlan>> = Vec::new();
        if self.linmots > 0 {
            buses.push(Box::new(self.linudp(side)));
        }
        if self.unidrives > 0 {
            buses.push(Box::new(self.modbus(side)));
        }
        if self.segment > 0 {
            buses.push(Box::new(self.ethercat(side)));
        }
        if self.moons > 0 {
            buses.push(Box::new(self.ethernet_ip(side)));
        }
        buses.extend(self.profibus(side).into_iter().map(|wire| Box::new(wire) as Box<dyn BusPlan>));
        buses
    }

    /// Its drives on `side`, simulated.
    pub fn simulate(self, side: Side) -> Simulated {
        let mut simulated = Simulated::default();
        LinMots::of(&self.linudp(side)).build(&mut simulated);
        Unidrives(self.modbus(side).drives.iter().map(unidrive::simulated).collect()).build(&mut simulated);
        if self.segment > 0 {
            segment::simulated(&self.ethercat(side)).build(&mut simulated);
        }
        MoonsDrives::of(&self.ethernet_ip(side)).build(&mut simulated);
        for wire in self.profibus(side) {
            ProfibusSegment::of(&wire).build(&mut simulated);
        }
        simulated
    }
}

/// As [`FromStr`] takes it: `32+32/8+16+56+0+4`.
impl fmt::Display for Fleet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Fleet { linmots, unidrives, every, segment, terminals, moons, lenzes } = self;
        write!(f, "{linmots}+{unidrives}/{every}+{segment}+{terminals}+{moons}+{lenzes}")
    }
}

impl FromStr for Fleet {
    type Err = ();

    fn from_str(text: &str) -> Result<Fleet, ()> {
        let (linmots, rest) = text.split_once('+').ok_or(())?;
        let (unidrives, rest) = rest.split_once('/').ok_or(())?;
        let (every, rest) = rest.split_once('+').ok_or(())?;
        let (segment, rest) = rest.split_once('+').ok_or(())?;
        let (terminals, rest) = rest.split_once('+').ok_or(())?;
        let (moons, lenzes) = rest.split_once('+').ok_or(())?;
        let number = |text: &str| text.parse::<usize>().map_err(|_| ());
        Ok(Fleet {
            linmots: number(linmots)?,
            unidrives: number(unidrives)?,
            every: every.parse().map_err(|_| ())?,
            segment: number(segment)?,
            terminals: number(terminals)?,
            moons: number(moons)?,
            lenzes: number(lenzes)?,
        })
    }
}
