//! A Modbus TCP bus as configured and checked.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::mapping::Mapping;
use super::parameter::{Addressing, Parameter, Width};
use super::station::REFERENCES_IN_A_ROW;
use crate::axis::feedback::MONITOR_CHANNELS;
use crate::axis::{AxisPlan, HeldBy, Load, MonitorChannel, PlanFault, Unit, Units};
use crate::time::{MS, Ns, S};

/// Where a drive listens unless Pr S.15.005 says otherwise (SI-Ethernet guide).
pub const PORT: u16 = 502;

/// Drives that are each on a connection of their own.
#[derive(Clone, Debug, PartialEq)]
pub struct ModbusPlan {
    /// Its name in messages.
    pub name: String,
    /// The address of this host that its connections leave from; `None`: whichever leads to a drive.
    pub bind: Option<Ipv4Addr>,
    /// The drives; one address and port each.
    pub drives: Vec<UnidriveDrive>,
}

/// One Unidrive.
#[derive(Clone, Debug, PartialEq)]
pub struct UnidriveDrive {
    /// What every protocol's axis has. The drive counts revolutions of the motor: `scale` says how many are one unit.
    pub axis: AxisPlan,
    /// Where the drive listens.
    pub address: SocketAddrV4,
    /// Its unit id; `None`: 255, and 0 where that is not answered.
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
    /// What stops the drive if the master dies.
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
    /// What the drive shows besides.
    pub show: [Option<Mapped>; MONITOR_CHANNELS],
    /// What is read besides, for the native process data.
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

    /// Its value in the drive's units.
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

/// What makes the drive stop by itself when nothing comes any more.
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

/// A host repeats a lost segment that nothing follows after so long at the earliest, ns (Linux: TCP_RTO_MIN, and the
/// drive's host may take as long or longer) ...
const REPEATED_NS: u64 = 200 * MS;
/// ... and its reply is there by then, on a local network.
const REPEATED_BY_NS: u64 = REPEATED_NS + 10 * MS;
/// How long a reply counts by default, ns: one lost frame does not cost the link.
const USUAL_REPLY_NS: u64 = 250 * MS;

/// What a keypad watchdog waits for, ns (assumed).
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
}

impl UnidriveDrive {
    /// A drive at this address, in revolutions of its motor, with everything else as it is when a configuration says
    /// nothing of it.
    pub fn new(name: impl Into<String>, address: Ipv4Addr) -> UnidriveDrive {
        let units = Units { unit: Unit::Revolution, counts_per_unit: 1.0, offset: 0.0, modulo: None };
        let address = SocketAddrV4::new(address, PORT);
        UnidriveDrive {
            axis: AxisPlan::new(name, units),
            address,
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

    /// What it shows besides, for people.
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

    /// What contradicts itself, or would not work with an exchange every `period_ns`; what every axis has left out.
    pub fn faults(&self, period_ns: u64) -> Vec<PlanFault> {
        let mut faults: Vec<PlanFault> = Mapping::new(self).err().into_iter().collect();
        faults.extend(self.position_faults());
        faults.extend(self.speed_faults());
        faults.extend(self.watchdog_faults(period_ns));
        let mut wrong = |key, message: &str| faults.push(PlanFault::new(key, message));
        if self.reply_within_ns == 0 || self.reply_within_ns > 10 * S {
            wrong("reply_within", "must be above 0 and at most 10 s");
        }
        if self.slot == 0 || self.slot > 4 {
            wrong(
                "slot",
                "must be the slot of the Ethernet interface: 4 onboard, 1 ... 3 an SI-Ethernet option",
            );
        }
        if self.axis.limits.torque.is_some() {
            wrong(
                "limits.torque",
                "has no effect: the drive takes speed setpoints, no torques; leave it out",
            );
        }
        if self.axis.load == Load::Vertical(HeldBy::Drive) {
            wrong(
                "held_by",
                "a Unidrive that trips, by its watchdog too, coasts, and the load drops; name a brake: \
                 held_by = \"brake\"",
            );
        }
        faults
    }

    /// What only a drive with a position could do.
    fn position_faults(&self) -> Vec<PlanFault> {
        let units = &self.axis.units;
        [
            ("limits.position", self.axis.limits.position.is_some()),
            ("limits.step", self.axis.limits.step.is_some()),
            ("modulo", units.modulo.is_some()),
            ("offset", units.offset != 0.0),
        ]
        .into_iter()
        .filter(|(_, given)| *given)
        .map(|(key, _)| {
            PlanFault::new(key, "concerns positions, and this protocol has speeds only; leave it out")
        })
        .collect()
    }

    /// A reference is a whole number of `10^-decimals` rpm, with its sign in the control word.
    fn speed_faults(&self) -> Vec<PlanFault> {
        let axis = &self.axis;
        if axis.units.counts_per_unit == 0.0 || !axis.units.counts_per_unit.is_finite() {
            return Vec::new(); // Reported for every axis.
        }
        let reference = &self.map.reference;
        let ends = (1, reference.width.range(true).1 as i32);
        let (least, most) = (reference.value(ends.0), reference.value(ends.1));
        let mut faults = Vec::new();
        for (key, value) in
            [("profile.velocity", Some(axis.profile.velocity)), ("limits.velocity", axis.limits.velocity)]
        {
            let Some(rpm) = value.map(|value| self.rpm(value).abs()) else { continue };
            if !(least..=most).contains(&rpm) {
                let why = format!(
                    "{rpm} rpm of the motor are outside the range of the drive, {least} ... {most} rpm; \
                     change it or check scale"
                );
                faults.push(PlanFault::new(key, why));
            }
        }
        if reference.width == Width::Word && axis.limits.velocity.is_none() {
            let why = format!("missing; a reference of 16 bits needs one, up to {most} rpm of the motor");
            faults.push(PlanFault::new("limits.velocity", why));
        }
        faults
    }

    fn watchdog_faults(&self, period_ns: u64) -> Vec<PlanFault> {
        let mut faults = Vec::new();
        let mut wrong = |key, message| faults.push(PlanFault::new(key, message));
        // Any request is traffic. The next one follows in its turn, when the reply no longer counts at the latest.
        let silent_ns = period_ns.saturating_add(period_ns.max(self.reply_within_ns));
        match self.watchdog.timeout_ns {
            Some(ns) if ns == 0 || ns > WATCHDOG_MAX_NS || !ns.is_multiple_of(MS) => {
                wrong("watchdog.timeout", "must be in whole milliseconds; use 1ms ... 65535ms".to_owned());
            }
            Some(ns) if ns < silent_ns => wrong(
                "watchdog.timeout",
                format!(
                    "trips the drive after {} without traffic, but {} may pass until the next request; allow \
                     more, exchange more often, or lower reply_within",
                    Ns(ns),
                    Ns(silent_ns)
                ),
            ),
            _ => {}
        }
        let written_ns = self.control_written_every(period_ns);
        if self.watchdog.keypad && KEYPAD_WATCHDOG_NS < written_ns.saturating_mul(2) {
            wrong(
                "watchdog.keypad",
                format!(
                    "trips the drive when its control word is not written for {}, but {} may pass between two \
                     writes; exchange more often, or use the timeout",
                    Ns(KEYPAD_WATCHDOG_NS),
                    Ns(written_ns)
                ),
            );
        }
        faults
    }

    /// The control word is written at least this often, ns, while nothing is lost.
    fn control_written_every(&self, period_ns: u64) -> u64 {
        // Where control word and reference are apart, the reference goes first for a while. Acyclic calls take turns
        // with all of it, and so does reading in a drive without FC23.
        let blocks = Mapping::new(self).map_or(1, |mapping| mapping.writes().len() as u64);
        let turns = if blocks > 1 { u64::from(REFERENCES_IN_A_ROW) + 1 } else { 1 };
        period_ns.saturating_mul(4 * turns)
    }

    /// What `check` says of it beyond its axis; the first line is its address.
    pub fn describe(&self, bind: Option<Ipv4Addr>, period_ns: u64) -> String {
        let every = Ns(period_ns.saturating_mul(self.axis.divisor.into()));
        let mut lines = vec![match bind {
            Some(bind) => format!("{bind} -> {}", self.address),
            None => self.address.to_string(),
        }];
        lines.extend(self.describe_exchange(every));
        lines.push(
            match self.functions {
                Functions::Auto => {
                    "by FC23; a drive that refuses or ignores it is written by FC16 and read by FC03 in turns \
                     (no_fc23 counts that)"
                }
                Functions::ReadWrite => "by FC23 and no other function",
                Functions::Apart => "writing (FC16) and reading (FC03) take turns",
            }
            .to_owned(),
        );
        lines.push(format!(
            "a reply counts for {}; after {} of silence its connection is opened again, with pauses: a stop \
             request leaves with the first exchange on the new one, and until then only the drive's own \
             watchdog stops it",
            Ns(self.reply_within_ns),
            Ns(2 * self.reply_within_ns)
        ));
        lines.push(self.describe_loss(every.0));
        lines.push("takes velocities; no moves, no streams, no homing".to_owned());
        let shown: Vec<String> = self.shown().into_iter().flatten().map(|channel| channel.name).collect();
        if !shown.is_empty() {
            lines.push(format!("shows {}", shown.join(", ")));
        }
        if !self.set_up {
            lines.push(
                "set_up = false: the master writes no settings, and enables the drive only if they are as \
                 needed"
                    .to_owned(),
            );
        }
        lines.push(format!("if the master dies: {}", self.describe_death()));
        lines.join("\n")
    }

    /// Which blocks go with a request.
    fn describe_exchange(&self, every: Ns) -> Option<String> {
        let mapping = Mapping::new(self).ok()?;
        let all = "writes and reads all parameters";
        Some(match (self.via, mapping.turns()) {
            (Via::Menu0 { first }, _) => format!(
                "one request every {every} {all}, in a row in menu 0 from Pr 00.{first:03} (the master sets \
                 Pr 22.{first:03} and those after it)"
            ),
            (Via::Direct, 1) => format!("one request every {every} {all}"),
            (Via::Direct, turns) => format!(
                "one request every {every} writes what changed and reads a part: {}, all parameters within {}",
                match mapping.hot() {
                    1 => "status and speed in two of three".to_owned(),
                    hot => format!("status and speed within {}", count(hot + 1, "request")),
                },
                count(turns, "request"),
            ),
        })
    }

    /// What one lost frame costs. A host repeats it after [`REPEATED_NS`], after the doubled time if it is lost again.
    fn describe_loss(&self, every_ns: u64) -> String {
        let repeated = Ns(REPEATED_NS);
        let within_ns = self.reply_within_ns;
        if within_ns >= REPEATED_BY_NS {
            return format!(
                "one lost frame delays an exchange by {repeated}, since TCP repeats it no sooner, and the link \
                 stays up: a stop request that waits for it leaves {} later at most; a frame lost twice costs \
                 the link",
                Ns(REPEATED_BY_NS + every_ns)
            );
        }
        // The connection is given up after twice the time; else the requests of the meantime are misses.
        let misses = 1 + (REPEATED_BY_NS - within_ns) / every_ns.max(1);
        let is_lost = 2 * within_ns < REPEATED_BY_NS || misses >= u64::from(self.axis.health.bucket);
        let costs = if is_lost { "the link".to_owned() } else { count(misses as usize, "exchange") };
        let remedy = match self.watchdog.timeout_ns {
            Some(timeout_ns) if timeout_ns < REPEATED_BY_NS + 2 * every_ns => format!(
                "; reply_within from {} on would wait for it, with a watchdog.timeout from {} on",
                Ns(REPEATED_BY_NS),
                Ns(REPEATED_BY_NS + 2 * every_ns)
            ),
            _ => format!("; reply_within from {} on would wait for it", Ns(REPEATED_BY_NS)),
        };
        format!("one lost frame costs {costs}: TCP repeats it after {repeated} at the earliest{remedy}")
    }

    fn describe_death(&self) -> String {
        let done =
            if self.set_up { "set by the master before it is enabled" } else { "which must be set to it" };
        let timeout = format!("Pr {}.15.009, {done}", self.slot);
        let how = match self.watchdog {
            Watchdog { timeout_ns: Some(_), keypad: true, .. } => {
                format!("{timeout}, and the keypad watchdog")
            }
            Watchdog { timeout_ns: Some(_), .. } => timeout,
            _ => "the keypad watchdog".to_owned(),
        };
        match self.watchdog.within_ns() {
            Some(within) => format!("the drive trips within {} and its motor coasts ({how})", Ns(within)),
            None if self.watchdog.accept_none => {
                "nothing stops the drive: it keeps its last speed (no_drive_watchdog = \"accept\")".to_owned()
            }
            None => "nothing would stop the drive, so it is not enabled (no_drive_watchdog = \"refuse\")"
                .to_owned(),
        }
    }
}

fn count(number: usize, what: &str) -> String {
    format!("{number} {what}{}", if number == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests;
