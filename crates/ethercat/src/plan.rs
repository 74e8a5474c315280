//! One segment as configured.
//!
//! | file | what |
//! |---|---|
//! | `faults` | what of it contradicts itself, or would not work |
//! | `describe` | the segment in words |
//! | `frame` | how long its frame is |
//! | `slave` | what every slave has, drive or not |

mod describe;
mod faults;
mod frame;
mod slave;

pub use slave::FIRST_STATION;
pub use slave::{Area, Expected, MOST_AREAS, SlavePlan, Start, Watchdog};

use super::mode::Mode;
use super::object::pdo::{self, Entry, Layout};
use super::object::{Family, Object, Type};
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::axis::is_plain_name;
use fieldbeat_core::axis::{AxisPlan, MonitorChannel, Units};
use fieldbeat_core::bus::variant::Variant;

/// The slaves of one segment, behind one interface.
#[derive(Clone, Debug)]
pub struct EthercatPlan {
    /// The name in messages.
    pub name: String,
    /// The network interface, like `eth1`; `local:NAME` is a segment of simulated drives on this host, without an
    /// interface.
    pub interface: String,
    /// The drives, in slot order.
    pub drives: Vec<KollmorgenDrive>,
    /// The other slaves: couplers and terminals.
    pub devices: Vec<Device>,
    /// All slaves know LRW: outputs and inputs go in one datagram. Else in two.
    pub lrw: bool,
    /// Where in the period of SYNC0 a frame leaves the master, ns before it. Default: half of the period.
    pub ahead_of_sync_ns: Option<u64>,
}

/// One drive.
#[derive(Clone, Debug)]
pub struct KollmorgenDrive {
    /// The settings of every axis. Counts are increments of the motor.
    pub axis: AxisPlan,
    /// The settings for the segment.
    pub slave: SlavePlan,
    /// Which objects it has.
    pub family: Family,
    /// The outputs that the master writes to it in each frame.
    pub outputs: Layout,
    /// The inputs that the master reads.
    pub inputs: Layout,
    /// Where the PDOs come from.
    pub mapping: Mapping,
    /// The mode of operation: it decides which target in `outputs` is the setpoint. Default: that of the first target
    /// in them, [`Setpoint::mode`].
    pub mode: Option<Mode>,
    /// All targets are the application's, by native outputs: the master makes no setpoint.
    pub native: bool,
    /// How its numbers are scaled.
    pub scaling: Scaling,
    /// Compares its increments a turn (608Fh) with [`Scaling::prbase`], if it reports any.
    pub check_prbase: bool,
    /// Velocities and torques are taken although the master arms no watchdog.
    pub accept_no_watchdog: bool,
    /// The mode of operation of `Home`: method 6098h, written before. `None`: as the drive is set.
    pub home_method: Option<i8>,
    /// The encoder is absolute: its position is that of the machine without a homing. Else it has its reference if
    /// 1002h says so; without that object, if this master saw its homing attained.
    pub absolute: bool,
    /// Objects that it shows besides, read by its mailbox in turns: plain counts, of the unit that is known of each.
    pub show: [Option<Entry>; MONITOR_CHANNELS],
}

/// Where the PDOs of a drive come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mapping {
    /// One of its fixed ones each, selected by 1C12h and 1C13h.
    #[default]
    Fixed,
    /// The master maps the objects into 16xxh and 1Axxh first.
    Free,
    /// As the drive is set: nothing is written.
    AsIs,
}

/// How the numbers of a drive are scaled. What no public document says is a setting.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scaling {
    /// Increments a turn as a power of two (PRBASE). Default 20.
    pub prbase: u8,
    /// rpm of a count of the velocity setpoint. Default of S300 ... S700: increments per 250 us, as its sister AX2000
    /// has it; of an AKD 0.001 (both assumed).
    pub rpm_per_count: f64,
    /// Per mille of the rated torque or current of a count of the torque setpoint (assumed: 1).
    pub permille_per_count: f64,
    /// Motor current of 1000 per mille, A; to report the current. Default: not reported.
    pub rated_current: Option<f64>,
}

/// The kind of the setpoint in the process data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Setpoint {
    /// A position: 60C1h:1 or 607Ah.
    Position(Object),
    /// A velocity: 606Bh or 60FFh.
    Velocity(Object),
    /// A torque or current: 6074h or 6071h.
    Torque(Object),
}

/// A slave that is no drive: its process data are the application's.
#[derive(Clone, Debug)]
pub struct Device {
    /// The name, unique in the machine.
    pub name: String,
    /// The settings for the segment.
    pub slave: SlavePlan,
}

/// Vendor of all Kollmorgen drives.
pub const KOLLMORGEN: u32 = 0x6A;
/// Where a drive's mailboxes are (EtherCAT manual).
const MAILBOXES: [u16; 2] = [0x1800, 0x1C00];
/// The bytes of a mailbox that a drive of the S300 ... S700 looks at.
const S700_MAILBOX: u16 = 16;
const AKD_MAILBOX: u16 = 1024;
/// Where a drive's outputs and inputs are (those of an AKD; assumed for the others).
const BUFFERS: [u16; 2] = [0x1100, 0x1140];
/// Increments per 250 us as rpm, with 2^20 increments a turn.
const RPM_PER_COUNT: f64 = 4_000.0 * 60.0 / (1 << 20) as f64;

/// In front of the name of a segment that has no interface.
const LOCAL: &str = "local:";
/// The longest name of a network interface, bytes (IFNAMSIZ without its end).
const INTERFACE_MAX: usize = 15;

/// Whether a segment can be behind this: an interface as the kernel names one, or a name of this computer's own.
pub fn is_interface(text: &str) -> bool {
    let is_kernels = || {
        let odd = |c: char| c == '/' || c == ':' || c.is_whitespace() || c.is_control();
        (1..=INTERFACE_MAX).contains(&text.len()) && !text.contains(odd) && !matches!(text, "." | "..")
    };
    text.strip_prefix(LOCAL).map_or_else(is_kernels, is_plain_name)
}

impl EthercatPlan {
    /// A segment of these drives.
    pub fn new(interface: impl Into<String>, drives: Vec<KollmorgenDrive>) -> EthercatPlan {
        EthercatPlan {
            name: super::PROTOCOL.into(),
            interface: interface.into(),
            drives,
            devices: Vec::new(),
            lrw: true,
            ahead_of_sync_ns: None,
        }
    }

    /// The drives are simulated ones on this computer, without an interface.
    pub fn is_local(&self) -> bool {
        self.interface.starts_with(LOCAL)
    }

    /// All slaves in their order on the segment, drives first where two have one place.
    pub fn slaves(&self) -> Vec<(Owner, &SlavePlan)> {
        let drives = self.drives.iter().enumerate().map(|(index, drive)| (Owner::Drive(index), &drive.slave));
        let devices =
            self.devices.iter().enumerate().map(|(index, device)| (Owner::Device(index), &device.slave));
        let mut all: Vec<_> = drives.chain(devices).collect();
        all.sort_by_key(|(_, slave)| slave.place);
        all
    }

    /// The name of a slave of this line.
    pub fn name_of(&self, owner: Owner) -> &str {
        match owner {
            Owner::Drive(index) => &self.drives[index].axis.name,
            Owner::Device(index) => &self.devices[index].name,
        }
    }

    /// This segment in another machine; `None` if it does not take the period, or is to have other drives.
    pub(super) fn variant(&self, wanted: &Variant) -> Option<EthercatPlan> {
        if wanted.drives.is_some() {
            return None;
        }
        let mut plan = self.clone();
        plan.interface = wanted.interface(&plan.interface);
        plan.drives.iter_mut().for_each(|drive| wanted.schedule(&mut drive.axis, 0));
        plan.findings(wanted.period_ns).is_empty().then_some(plan)
    }
}

/// The owner of a slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// The drive with this index.
    Drive(usize),
    /// The device with this index.
    Device(usize),
}

impl Default for Owner {
    fn default() -> Owner {
        Owner::Drive(0)
    }
}

impl Setpoint {
    /// The target that this object is; `None`: it is none.
    pub(super) const fn new(object: Object) -> Option<Setpoint> {
        Some(match object {
            Object { index: 0x60C1, sub: 1.. } | Object { index: 0x607A, sub: 0 } => {
                Setpoint::Position(object)
            }
            Object { index: 0x606B | 0x60FF, sub: 0 } => Setpoint::Velocity(object),
            Object { index: 0x6074 | 0x6071, sub: 0 } => Setpoint::Torque(object),
            _ => return None,
        })
    }

    /// A drive in this mode follows it from cycle to cycle (CiA 402-2; the vendor modes of S300 ... S700 are assumed to
    /// follow whichever target of their kind is in the process data).
    pub(super) const fn is_followed(self, mode: Mode) -> bool {
        match self {
            Setpoint::Position(Object { index: 0x60C1, .. }) => {
                matches!(mode, Mode::INTERPOLATED | Mode::TRAJECTORY)
            }
            Setpoint::Position(_) => matches!(mode, Mode::CYCLIC_POSITION | Mode::TRAJECTORY),
            Setpoint::Velocity(Object { index, .. }) => {
                matches!((index, mode), (0x60FF, Mode::PROFILE_VELOCITY) | (_, Mode::DIGITAL_VELOCITY))
            }
            Setpoint::Torque(Object { index, .. }) => {
                matches!((index, mode), (0x6071, Mode::TORQUE) | (_, Mode::DIGITAL_CURRENT))
            }
        }
    }

    /// The object, and the type that it has.
    pub const fn shape(self) -> (Object, Type) {
        match self {
            Setpoint::Position(object) | Setpoint::Velocity(object) => (object, Type::I32),
            Setpoint::Torque(object) => (object, Type::I16),
        }
    }

    /// The drive's mode for it. The vendor modes of S300 ... S700 are assumed to be 80h + OPMODE.
    pub fn mode(self, family: Family) -> Mode {
        match (family, self) {
            (Family::S700, Setpoint::Velocity(_)) => Mode::DIGITAL_VELOCITY,
            (Family::S700, Setpoint::Torque(_)) => Mode::DIGITAL_CURRENT,
            (Family::S700, Setpoint::Position(_)) => Mode::TRAJECTORY,
            (Family::Akd, Setpoint::Velocity(_)) => Mode::PROFILE_VELOCITY,
            (Family::Akd, Setpoint::Torque(_)) => Mode::TORQUE,
            (Family::Akd, Setpoint::Position(Object { index: 0x607A, .. })) => Mode::CYCLIC_POSITION,
            (Family::Akd, Setpoint::Position(_)) => Mode::INTERPOLATED,
        }
    }
}

impl Scaling {
    /// That of a drive of this family as delivered.
    pub fn of(family: Family) -> Scaling {
        let rpm_per_count = match family {
            Family::S700 => RPM_PER_COUNT,
            Family::Akd => 0.001,
        };
        Scaling { prbase: 20, rpm_per_count, permille_per_count: 1.0, rated_current: None }
    }

    /// Increments a turn.
    pub fn increments(&self) -> f64 {
        f64::from(self.prbase).exp2()
    }
}

impl KollmorgenDrive {
    /// The drive at this place of the segment, in revolutions of its motor, with everything else as it is when a
    /// configuration says nothing of it: a velocity setpoint, 1702h and 1B03h (of an AKD 1702h and 1B24h).
    pub fn new(name: impl Into<String>, place: u16, family: Family) -> KollmorgenDrive {
        let scaling = Scaling::of(family);
        let (product, inputs, mailbox) = match family {
            Family::S700 => (0x0300_0600, 0x1B03, S700_MAILBOX),
            Family::Akd => (0x0041_4B44, 0x1B24, AKD_MAILBOX),
        };
        let fixed = pdo::fixed(family);
        let layout = |pdo| fixed.iter().find(|layout| layout.pdo == pdo).cloned();
        let empty = |pdo| Layout { pdo, entries: Vec::new() };
        let outputs = layout(0x1702).unwrap_or_else(|| empty(0x1702));
        let inputs = layout(inputs).unwrap_or_else(|| empty(inputs));
        let areas = MAILBOXES.map(|start| Area { start, length: mailbox });
        let mut drive = KollmorgenDrive {
            axis: AxisPlan::new(name, Units::revolutions(scaling.increments())),
            slave: SlavePlan {
                identity: Expected {
                    vendor: Some(KOLLMORGEN),
                    product: Some(product),
                    ..Expected::default()
                },
                mailbox: Some(areas),
                sync: true,
                ..SlavePlan::new(place)
            },
            family,
            outputs,
            inputs,
            mapping: Mapping::default(),
            mode: None,
            native: false,
            scaling,
            check_prbase: true,
            accept_no_watchdog: false,
            home_method: None,
            absolute: false,
            show: [None; MONITOR_CHANNELS],
        };
        drive.fit();
        drive
    }

    /// Makes the areas as long as the PDOs.
    pub fn fit(&mut self) {
        let area = |start, layout: &Layout| match layout.size() {
            0 => Vec::new(),
            bytes => vec![Area { start, length: bytes as u16 }],
        };
        self.slave.outputs = area(BUFFERS[0], &self.outputs);
        self.slave.inputs = area(BUFFERS[1], &self.inputs);
    }

    /// The targets in its outputs.
    fn targets(&self) -> impl Iterator<Item = Setpoint> {
        self.outputs.entries.iter().filter_map(|entry| Setpoint::new(entry.object))
    }

    /// The setpoint: the target that its mode follows.
    pub fn setpoint(&self) -> Option<Setpoint> {
        let mode = self.mode().filter(|_| !self.native)?;
        self.targets().find(|target| target.is_followed(mode))
    }

    /// The additional values that it shows, for people.
    pub(super) fn shown(&self) -> [Option<MonitorChannel>; MONITOR_CHANNELS] {
        self.show.map(|shown| {
            let object = shown?.object;
            Some(match object.known() {
                Some(known) => MonitorChannel { name: known.name.to_owned(), unit: known.unit },
                None => MonitorChannel { name: format!("{:#06x}:{}", object.index, object.sub), unit: "" },
            })
        })
    }

    /// The mode that it is set to.
    pub fn mode(&self) -> Option<Mode> {
        self.mode.or_else(|| Some(self.targets().next()?.mode(self.family)))
    }

    /// A velocity in user units/s as revolutions of the motor a minute.
    pub fn rpm(&self, velocity: f64) -> f64 {
        velocity * self.axis.units.counts_per_unit / self.scaling.increments() * 60.0
    }
}
