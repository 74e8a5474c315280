//! The settings of a simulated drive: its firmware, its motor, its answers.

use std::collections::BTreeMap;

use super::codec::objects::{Object, Pdo, fixed_pdos, mode};
use super::codec::sii::Identity;
use super::slave::SlaveSettings;
use crate::FaultPlan;
use fieldbeat_ethercat::Family;

/// How a drive answers an SDO. Both are reported of real ones, and a master must read both.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Dialect {
    /// As in the standard and a real AKD: length 10, service 3, the counter returned.
    #[default]
    Standard,
    /// As the drive's manual prints it: length 14, service 2, no counter.
    Manual,
}

/// A simulated drive. Where no document says what it does, the default is the strict side, and assumed.
#[derive(Clone, Debug, PartialEq)]
pub struct DriveSettings {
    /// The drive family: its objects and modes.
    pub family: Family,
    /// The identity.
    pub identity: Identity,
    /// The serial number. Default 0.
    pub serial: u32,
    /// How it answers an SDO.
    pub dialect: Dialect,
    /// Bytes of the mailbox that the master reads, of a drive that supports more than SDOs of four bytes: normal
    /// and segmented ones, and complete access. Default: 1024 of an AKD, and none of the others.
    pub long_sdos: Option<u16>,
    /// The PDOs that can be selected.
    pub layouts: Vec<Pdo>,
    /// The PDOs selected as delivered: outputs, inputs.
    pub selected: (u16, u16),
    /// Increments per turn as a power of two, 1 ... 31. Default 20.
    pub prbase: u8,
    /// Turns to which its increments in 608Fh refer: the value there is larger by this factor. Default 1.
    pub resolution_turns: u32,
    /// The position at power-on, increments. Default 0.
    pub position: i32,
    /// rpm per count of 606Bh, 606Ch, 60FFh, 6081h and 6099h. Default: increments per 250 us, as its sister AX2000
    /// has it; of an AKD 0.001.
    pub rpm_per_count: f64,
    /// Per mille of the rated current per count of 6074h. Default 1.
    pub permille_per_count: f64,
    /// rpm/s up and down: 6083h and 6084h as delivered, in these units like 609Ah (assumed). Default 10 000.
    pub ramps_rpm_s: (u32, u32),
    /// Position of the home switch, turns from the motor at power-on; `None`: nowhere. Default 0.5.
    pub home_turns: Option<f64>,
    /// Cyclic interrupts inside the window, one after the other, until the drive is synchronous. Default 100.
    pub interrupts_to_sync: u32,
    /// Objects of its family that it does not have, by their index. Default: none.
    pub without: Vec<u16>,
    /// Objects that it does not let be written, by their index. Default: none but those of its family.
    pub read_only: Vec<u16>,
    /// The delay from 6060h to the change of mode and of 6061h, ns. Default 0.
    pub mode_delay_ns: u64,
    /// The drive comes up in OP and in operation, turning at so many rpm, as if another master had died with its
    /// watchdog off. Default: it comes up in INIT and stands still.
    pub running_rpm: Option<f64>,
    /// The hardware enable (STO) is wired and closed. Default true.
    pub hardware_enable: bool,
    /// The motor and its load.
    pub motor: MotorSettings,
}

/// Increments per 250 us as rpm, with 2^20 increments a turn.
const RPM_PER_COUNT: f64 = 4_000.0 * 60.0 / (1 << 20) as f64;
/// A name of 40 bytes.
pub(super) const AKD: &str = "AKD-P00306-NBEC-0000 (a simulated drive)";
/// Vendor of all of them.
const KOLLMORGEN: u32 = 0x6A;

/// Values of objects, each with index and subindex in one number.
macro_rules! values {
    ($($object:literal: $value:expr;)*) => {
        vec![$((Object::of($object), $value)),*]
    };
}

impl DriveSettings {
    /// A drive with default settings.
    pub fn new(family: Family) -> DriveSettings {
        let (product, rpm_per_count, selected) = match family {
            Family::S700 => (0x0300_0600, RPM_PER_COUNT, (0x1702, 0x1B03)),
            Family::Akd => (0x0041_4B44, 0.001, (0x1701, 0x1B01)),
        };
        DriveSettings {
            family,
            identity: Identity { vendor: KOLLMORGEN, product, ..Identity::default() },
            serial: 0,
            dialect: Dialect::default(),
            long_sdos: (family == Family::Akd).then_some(1_024),
            layouts: fixed_pdos(family),
            selected,
            prbase: 20,
            resolution_turns: 1,
            position: 0,
            rpm_per_count,
            permille_per_count: 1.0,
            ramps_rpm_s: (10_000, 10_000),
            home_turns: Some(0.5),
            interrupts_to_sync: 100,
            without: Vec::new(),
            read_only: Vec::new(),
            mode_delay_ns: 0,
            running_rpm: None,
            hardware_enable: true,
            motor: MotorSettings::default(),
        }
    }

    /// Increments per turn.
    pub(super) fn increments(&self) -> u32 {
        1 << self.prbase.clamp(1, 31)
    }

    /// The device name, 1008h: that of an AKD is a long one, since it can be read.
    pub(super) fn name(&self) -> &'static str {
        if self.family == Family::S700 { "S700" } else { AKD }
    }

    /// As much of the name as an expedited SDO has room for.
    fn short_name(&self) -> [u8; 4] {
        let mut short = *b"    ";
        short.iter_mut().zip(self.name().bytes()).for_each(|(place, byte)| *place = byte);
        short
    }

    /// Values of objects as delivered, where they are not 0, but for the numbers of subindices.
    pub(super) fn delivered(&self) -> Vec<(Object, i64)> {
        let Identity { vendor, product, revision } = self.identity;
        let increments = i64::from(self.increments());
        let (up, down) = self.ramps_rpm_s;
        let rpm = |rpm: f64| (rpm / self.rpm_per_count).round() as i64;
        let mode = match self.family {
            Family::S700 => mode::DIGITAL_VELOCITY,
            Family::Akd => mode::INTERPOLATED,
        };
        let text = |text: [u8; 4]| i64::from(u32::from_le_bytes(text));
        values! {
            0x100000: 0x0002_0192; 0x100800: text(self.short_name()); 0x100900: text(*b"1.00");
            0x100A00: text(*b"5.00"); 0x101801: vendor.into(); 0x101802: product.into();
            0x101803: revision.into(); 0x101804: self.serial.into(); 0x1C0001: 1; 0x1C0002: 2; 0x1C0003: 3;
            0x1C0004: 4; 0x1C1201: self.selected.0.into(); 0x1C1301: self.selected.1.into(); 0x1C3201: 2;
            0x1C3301: 2; 0x35D501: 4; 0x606000: mode.into(); 0x606500: increments / 4; 0x607200: 3_000;
            0x607F00: rpm(6_000.0); 0x608000: 6_000; 0x608300: up.into(); 0x608400: down.into();
            0x608100: rpm(1_000.0); 0x608F01: increments.saturating_mul(i64::from(self.resolution_turns));
            0x608F02: self.resolution_turns.into(); 0x609201: increments; 0x609202: 1; 0x609301: 1;
            0x609302: 1; 0x609800: 1; 0x609901: rpm(60.0); 0x609902: rpm(6.0); 0x609A00: 1_000;
            0x60E000: 3_000; 0x60E100: 3_000; 0x60C201: 1; 0x60C202: -3;
        }
    }
}

/// The settings of a simulated segment.
#[derive(Clone, Debug, PartialEq)]
pub struct SegmentSettings {
    /// The interface at the drives' end of the cable, where the master's is a real one.
    pub interface: Option<String>,
    /// How much faster than ours the clock of the slave at a position runs, ppm; the last value holds for all
    /// further slaves. Default: 0.
    pub drift_ppm: Vec<f64>,
    /// The delay from one slave to the next, each way, ns. Default 500.
    pub delay_ns: u64,
    /// The clocks have 32 bits. Default: they have 64.
    pub short_clocks: bool,
    /// Frames with the time of the reference in which a clock removes most of a difference to it. Default: 32. A
    /// real one, with its filters as delivered, takes about 1 000, and some thousand until it has settled (SOEM
    /// waits 15 000; assumed).
    pub settling: u16,
    /// Settings of the slave at a position.
    pub slaves: BTreeMap<u16, SlaveSettings>,
    /// Each slave shows its device id in its AL status: its position. Default: none does.
    pub device_ids: bool,
    /// The faults between the master and the first slave.
    pub faults: FaultPlan,
}

impl Default for SegmentSettings {
    fn default() -> SegmentSettings {
        SegmentSettings {
            interface: None,
            drift_ppm: Vec::new(),
            delay_ns: 500,
            short_clocks: false,
            settling: 32,
            slaves: BTreeMap::new(),
            device_ids: false,
            faults: FaultPlan::default(),
        }
    }
}

/// The motor and its load, in SI units.
#[derive(Clone, Debug, PartialEq)]
pub struct MotorSettings {
    /// Rated torque, N m, over 0: 1000 per mille. Default 5.
    pub rated_nm: f64,
    /// Largest torque, per mille of the rated torque. Default 3000.
    pub peak_permille: f64,
    /// Highest speed, rpm. Default 6000.
    pub max_rpm: f64,
    /// Inertia of everything that turns, kg m^2, over 0. Default 0.002.
    pub inertia_kgm2: f64,
    /// Dry friction, N m. Default 0.1.
    pub friction_nm: f64,
    /// A load against positive torque, N m, which a brake holds without power. A position controller gives way to it by
    /// its stiffness (it has no integral part), and works against it then. Default 0.
    pub load_nm: f64,
}

impl Default for MotorSettings {
    fn default() -> MotorSettings {
        MotorSettings {
            rated_nm: 5.0,
            peak_permille: 3_000.0,
            max_rpm: 6_000.0,
            inertia_kgm2: 0.002,
            friction_nm: 0.1,
            load_nm: 0.0,
        }
    }
}
