//! The settings of a simulated Unidrive: its network interface, its motor, and its state at the start.

use std::net::SocketAddrV4;

use crate::FaultPlan;
use fieldbeat_core::time::MS;

/// A simulated Unidrive. Where no document says what the drive does, the default is the strict side, and assumed.
#[derive(Clone, Debug, PartialEq)]
pub struct UnidriveSettings {
    /// The address that it listens at.
    pub address: SocketAddrV4,
    /// The serial number, up to eighteen digits. Default 0.
    pub serial: u64,
    /// The faults between it and the master.
    pub faults: FaultPlan,
    /// The Modbus side.
    pub interface: Interface,
    /// The motor and its load.
    pub motor: MotorSettings,
    /// Seconds to 1000 rpm and from there to standstill: Pr 02.011 and 02.021 as delivered. Default 0.2 each.
    pub ramps_s: (f64, f64),
    /// The drive at its first start. Default: idle.
    pub start: Start,
    /// The hardware enable (safe torque off) is wired and closed. Default true.
    pub hardware_enable: bool,
    /// From power-on until it listens, ns. Default 500 ms.
    pub boot_ns: u64,
    /// Saved parameters, menu and number, that differ from the values as delivered; menu 15 is that of the Ethernet
    /// interface. Unknown ones are ignored, values out of range are clamped.
    pub commissioned: Vec<([u8; 2], i32)>,
}

impl UnidriveSettings {
    /// A drive with default settings.
    pub fn new(address: SocketAddrV4) -> UnidriveSettings {
        UnidriveSettings {
            address,
            serial: 0,
            faults: FaultPlan::default(),
            interface: Interface::default(),
            motor: MotorSettings::default(),
            ramps_s: (0.2, 0.2),
            start: Start::default(),
            hardware_enable: true,
            boot_ns: 500 * MS,
            commissioned: Vec::new(),
        }
    }
}

/// The Modbus side of a simulated Unidrive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Interface {
    /// Addresses are made of 256 parameters a menu: Pr S.15.013 as delivered. Default: of 100.
    pub modified: bool,
    /// The slot of the Ethernet interface: 4 on M700 and M702, that of the option module on M701. Its unit id, too.
    pub slot: u8,
    /// The most connections at a time; further ones are refused. Default 4, assumed.
    pub connections: usize,
    /// The reaction to FC23. Default: served.
    pub read_write: ReadWrite,
    /// Menu 0 shows what Pr 22.001 ... 22.080 say. Without it there is no menu 0. Default true.
    pub menu_zero: bool,
    /// The unit ids of the drive. Default 0 and 255 (SI-Ethernet guide).
    pub drive_units: Vec<u8>,
    /// Of several requests that come at once all are answered, in order. False: the first one only.
    pub pipelining: bool,
}

impl Default for Interface {
    fn default() -> Interface {
        Interface {
            modified: false,
            slot: 4,
            connections: 4,
            read_write: ReadWrite::default(),
            menu_zero: true,
            drive_units: vec![0, 255],
            pipelining: true,
        }
    }
}

/// The reaction of a server to FC23. Other servers than a Unidrive are known to do each of these.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ReadWrite {
    /// It writes, then reads.
    #[default]
    Served,
    /// Up to so many registers, both directions together; more are exception 02.
    UpTo(u16),
    /// Exception 01.
    Refused,
    /// Nothing: no answer.
    Ignored,
    /// It ends the connection.
    Closes,
}

/// The motor and its load, in SI units.
#[derive(Clone, Debug, PartialEq)]
pub struct MotorSettings {
    /// Rated speed, rpm, over 0: Pr 05.008 and the maximum reference 01.006 as delivered. Default 3000.
    pub rated_rpm: f64,
    /// Rated torque, N m, over 0: 100 % load. Default 5.
    pub rated_nm: f64,
    /// Inertia of everything that turns, kg m^2, over 0. Default 0.005.
    pub inertia_kgm2: f64,
    /// Load torque at rated speed, N m; it grows with speed. Default 1.5.
    pub load_nm: f64,
    /// Dry friction, N m. Default 0.1.
    pub friction_nm: f64,
}

impl Default for MotorSettings {
    fn default() -> MotorSettings {
        MotorSettings {
            rated_rpm: 3000.0,
            rated_nm: 5.0,
            inertia_kgm2: 0.005,
            load_nm: 1.5,
            friction_nm: 0.1,
        }
    }
}

/// A drive at its first start; after a restart it is idle.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Start {
    /// Healthy and switched off.
    #[default]
    Idle,
    /// With this trip, which can be reset.
    Tripped(u16),
    /// Enabled by the control word of a master that has disappeared, and running at this speed, rpm; negative is
    /// reverse, 0 is standstill.
    Running(f64),
}
