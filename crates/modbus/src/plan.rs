//! A Modbus TCP bus as configured and checked.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::parameter::{Addressing, Parameter, Width};
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::axis::{AxisPlan, MonitorChannel, Units};
use fieldbeat_core::bus::variant::Variant;
use fieldbeat_core::time::{MS, S};

/// Where a drive listens unless Pr S.15.005 says otherwise (SI-Ethernet guide).
pub const PORT: u16 = 502;

/// Drives that are each on a connection of their own.
#[derive(Clone, Debug, PartialEq)]
pub struct ModbusPlan {
    /// The name in messages.
    pub name: String,
    /// The address of this host that its connections leave from; `None`: whichever leads to a drive.
    pub bind: Option<Ipv4Addr>,
    /// The drives; one address and port each.
    pub drives: Vec<UnidriveDrive>,
}

/// One Unidrive.
#[derive(Clone, Debug, PartialEq)]
pub struct UnidriveDrive {
    /// The settings of every protocol's axis. The drive counts revolutions of the motor: `scale` says how many are one
    /// unit.
    pub axis: AxisPlan,
    /// Where the drive listens.
    pub address: SocketAddrV4,
    /// The serial number; `None`: whatever answers there is taken.
    pub serial: Option<u64>,
    /// Where that is read, in each handshake: the lower nine digits, and those above them, 32 bits each.
    pub serial_from: [Parameter; 2],
    /// The unit id; `None`: 255, and 0 where that is not answered.
    pub unit: Option<u8>,
    /// The slot of its Ethernet interface: 4 is the onboard one, 1 ... 3 have an SI-Ethernet option.
    pub slot: u8,
    /// How parameters become addresses, as Pr S.15.013 is set.
    pub addressing: Addressing,
    /// Which parameters are exchanged.
    pub map: Map,
    /// How they are reached.
    pub via: Via,
    /// By which functions they are written and read.
    pub functions: Functions,
    /// A reply counts for so long, ns. A Unidrive answers from a background task, without a guaranteed time.
    pub reply_within_ns: u64,
    /// The watchdog that stops the drive if the master dies.
    pub watchdog: Watchdog,
    /// The drive is set to what the master needs: menu 0 when a connection begins, the rest with the first command that
    /// needs it. Without that it is only looked whether it is so.
    pub set_up: bool,
}

/// The cyclic parameters (SI-PROFIBUS guide: words 06.042 and 10.040).
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// The control word.
    pub control: Mapped,
    /// The speed reference, in decimals of rpm.
    pub reference: Mapped,
    /// The status word.
    pub status: Mapped,
    /// The speed feedback, in decimals of rpm.
    pub speed: Mapped,
    /// The number of the last trip.
    pub trip: Option<Mapped>,
    /// The additional values that the drive shows.
    pub show: [Option<Mapped>; MONITOR_CHANNELS],
    /// The additional values that are read for the native process data.
    pub also: Vec<Mapped>,
}

/// One parameter and what its number means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mapped {
    /// Which one.
    pub parameter: Parameter,
    /// 16 or 32 bits.
    pub width: Width,
    /// Implied decimal places; never on the wire.
    pub decimals: u32,
}

impl Mapped {
    /// A parameter of the catalogue; one that it does not have is taken for 16 bits without decimals.
    pub fn new(parameter: Parameter) -> Mapped {
        match parameter.known() {
            Some(known) => Mapped { parameter, width: known.width, decimals: known.decimals },
            None => Mapped { parameter, width: Width::Word, decimals: 0 },
        }
    }

    /// The value in the drive's units.
    pub fn value(&self, raw: i32) -> f64 {
        f64::from(raw) / 10_f64.powi(self.decimals as i32)
    }

    /// The count for `value`, not rounded.
    pub fn raw(&self, value: f64) -> f64 {
        value * 10_f64.powi(self.decimals as i32)
    }
}

impl Default for Map {
    /// Words 06.042 and 10.040, preset reference 01.021, speed 03.002, trip 10.020; the load 04.020 is shown.
    fn default() -> Map {
        let mapped = |menu, number| Mapped::new(Parameter::new(menu, number));
        Map {
            control: mapped(6, 42),
            reference: mapped(1, 21),
            status: mapped(10, 40),
            speed: mapped(3, 2),
            trip: Some(mapped(10, 20)),
            show: [Some(mapped(4, 20)), None, None, None],
            also: Vec::new(),
        }
    }
}

/// How the cyclic parameters are reached. They lie far apart, and a request has one block to write and one to read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Via {
    /// Where they are: a block to write and a block to read in each exchange, in turns.
    #[default]
    Direct,
    /// The drive is set up (Pr 22.001 ... 22.080) to show them side by side in menu 0, from Pr 00.`first` on: all of
    /// them in each exchange. Taken from the drive's description, not tried on one.
    Menu0 {
        /// The first of them.
        first: u8,
    },
}

/// The Modbus functions of the cyclic exchange.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Functions {
    /// FC23; FC16 and FC03 in turns where the drive refuses FC23, ignores it, or closes the connection on it.
    #[default]
    Auto,
    /// FC23, which writes and reads.
    ReadWrite,
    /// FC16 and FC03 in turns.
    Apart,
}

/// The watchdog that makes the drive stop by itself when no requests come any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Watchdog {
    /// Pr S.15.009 is set to this, ns: the drive trips without Modbus traffic for so long. Unit and action are assumed
    /// (ms, trip). The master arms it before it enables the drive, and disarms it (0) at its orderly end. `None`: left
    /// as it is.
    pub timeout_ns: Option<u64>,
    /// Bit 14 of the control word: the drive trips if that is not written again within about 1 s (assumed).
    pub keypad: bool,
    /// Velocities are taken although neither of them is there.
    pub accept_none: bool,
}

impl Default for Watchdog {
    /// The time-out, half a second.
    fn default() -> Watchdog {
        Watchdog { timeout_ns: Some(500 * MS), keypad: false, accept_none: false }
    }
}

/// How long a reply counts by default, ns: one lost frame does not cost the link.
const USUAL_REPLY_NS: u64 = 250 * MS;

/// After so many references in a row it is the control word's turn, for the drive's watchdogs.
pub(super) const REFERENCES_IN_A_ROW: u32 = 8;

/// The time of a keypad watchdog, ns (assumed).
pub const KEYPAD_WATCHDOG_NS: u64 = S;
/// The longest time that Pr S.15.009 can be set to, ns: 16 bits of whole ms (assumed).
pub const WATCHDOG_MAX_NS: u64 = u16::MAX as u64 * MS;

impl Watchdog {
    /// After how long at the latest.
    pub fn within_ns(&self) -> Option<u64> {
        let keypad = self.keypad.then_some(KEYPAD_WATCHDOG_NS);
        self.timeout_ns.into_iter().chain(keypad).min()
    }
}

impl ModbusPlan {
    /// A bus of these drives.
    pub fn new(drives: Vec<UnidriveDrive>) -> ModbusPlan {
        ModbusPlan { name: super::PROTOCOL.into(), bind: None, drives }
    }

    /// This bus in another machine.
    pub(super) fn variant(&self, wanted: &Variant) -> Option<ModbusPlan> {
        let mut plan = self.clone();
        plan.bind = plan.bind.map(|bind| wanted.address(bind));
        plan.drives = wanted.hosts(&self.drives, |drive| (&mut drive.axis, &mut drive.address));
        for drive in &mut plan.drives {
            let was_ns = wanted.was_ns.saturating_mul(drive.axis.divisor.into());
            let is_usual =
                drive.reply_within_ns == UnidriveDrive::usual_reply_within(&drive.watchdog, was_ns);
            wanted.schedule(&mut drive.axis, 0);
            if is_usual {
                let every_ns = wanted.every_ns(&drive.axis);
                drive.reply_within_ns = UnidriveDrive::usual_reply_within(&drive.watchdog, every_ns);
            }
        }
        Some(plan)
    }
}

impl UnidriveDrive {
    /// No serial number is larger: eighteen digits.
    pub const SERIAL_MAX: u64 = 1_000_000_000_000_000_000;
    /// The count of the higher part of a serial number.
    #[doc(hidden)]
    pub const SERIAL_PART: u64 = 1_000_000_000;

    /// A drive at this address, in revolutions of its motor, with everything else as it is when a configuration says
    /// nothing of it.
    pub fn new(name: impl Into<String>, address: Ipv4Addr) -> UnidriveDrive {
        let address = SocketAddrV4::new(address, PORT);
        UnidriveDrive {
            axis: AxisPlan::new(name, Units::revolutions(1.0)),
            address,
            serial: None,
            serial_from: Parameter::SERIAL,
            unit: None,
            slot: 4,
            addressing: Addressing::Standard,
            map: Map::default(),
            via: Via::default(),
            functions: Functions::default(),
            reply_within_ns: USUAL_REPLY_NS,
            watchdog: Watchdog::default(),
            set_up: true,
        }
    }

    /// How long a reply counts by default with this watchdog and an exchange every `period_ns`. The drive receives
    /// nobody while a reply is waited for, and the next request follows in its turn: by then its watchdog must not
    /// have run out.
    pub fn usual_reply_within(watchdog: &Watchdog, period_ns: u64) -> u64 {
        let Some(timeout) = watchdog.timeout_ns else { return USUAL_REPLY_NS };
        // A cycle of rounding is at most a period.
        USUAL_REPLY_NS.min(timeout.saturating_sub(period_ns.saturating_mul(2)).max(timeout / 2))
    }

    /// A speed in user units/s as revolutions a minute.
    pub fn rpm(&self, velocity: f64) -> f64 {
        velocity * self.axis.units.counts_per_unit * 60.0
    }

    /// Revolutions a minute in user units/s.
    pub fn velocity(&self, rpm: f64) -> f64 {
        rpm / 60.0 / self.axis.units.counts_per_unit
    }

    /// The drive's own time-out for Modbus traffic.
    pub(super) fn time_out(&self) -> Parameter {
        Parameter::new(15, 9).in_slot(self.slot)
    }

    /// The additional values that it shows, for people.
    pub(super) fn shown(&self) -> [Option<MonitorChannel>; MONITOR_CHANNELS] {
        self.map.show.map(|mapped| {
            let parameter = mapped?.parameter;
            let (name, unit) = match parameter.known() {
                Some(known) => (known.name.to_owned(), known.unit),
                None => (parameter.to_string(), ""),
            };
            Some(MonitorChannel { name, unit })
        })
    }
}
