//! What contradicts itself in a segment, or would not work with a frame every so often.

use std::ops::Range;

use super::{
    Area, Device, EthercatPlan, KollmorgenDrive, MOST_AREAS, Mapping, Owner, Setpoint, SlavePlan, Start,
    frame, is_interface,
};
use crate::TERMINAL_MAX;
use crate::mode::Mode;
use crate::object::number::{CONTROL_WORD, MODE, STATUS_WORD};
use crate::object::pdo::Entry;
use crate::object::{Family, Object, Type};
use crate::outputs::{Unowned, source};
use crate::start_up::cycle_time;
use fieldbeat_core::axis::is_plain_name;
use fieldbeat_core::axis::{Faults, FollowingError, PlanFault};
use fieldbeat_core::time::{Ns, US};

/// The period of a drive's position controller, of which the cycle of the bus is a multiple (EtherCAT manual).
const CONTROLLER_NS: u64 = 250 * US;
/// The most of them (object 35D5h).
const CONTROLLER_PERIODS: u64 = 127;
/// A SyncManager watchdog counts these (register 0400h as it is at power-on) ...
const WATCHDOG_STEP_NS: u64 = 100 * US;
/// ... in 16 bits (register 0420h).
const WATCHDOG_STEPS: u64 = u16::MAX as u64;
/// Below it are registers of the controller; digital outputs stand at 0F00h, general purpose ones at 0F10h (Beckhoff
/// ESC datasheet, section II).
const REGISTERS: u32 = 0x0F00;
/// Where a slave's memory begins (ETG.1000.4).
const MEMORY: u32 = 0x1000;
/// Process data in the memory have so many buffers in a row: one is written, one is read, one is the newest
/// (ETG.1000.4).
const BUFFERS: u32 = 3;
/// The bytes of an SDO with its header: what a drive's mailbox has room for at least.
const SDO: u16 = 16;
/// The bytes of a value that an S300 ... S700 takes by its mailbox: it knows no longer transfers (EtherCAT manual).
const EXPEDITED: usize = 4;
/// A piece of a slave's memory: its key in a configuration, its name, where it is.
type Named = (&'static str, &'static str, Range<u32>);
/// The keys that say where outputs are, and inputs.
type Keys = [&'static str; 2];
const OF_A_DRIVE: Keys = ["buffers"; 2];
const OF_A_DEVICE: Keys = ["outputs", "inputs"];

impl EthercatPlan {
    /// The mistakes, each with the place of the drive: those of the segment or of a device are put down to the
    /// first one.
    pub fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)> {
        let mut faults: Vec<(usize, PlanFault)> = Vec::new();
        for (index, drive) in self.drives.iter().enumerate() {
            faults.extend(drive.axis.faults().into_iter().map(|fault| (index, fault)));
        }
        faults.extend(self.check_names().into_iter().map(|fault| (0, fault)));
        faults.extend(self.findings(period_ns).into_iter().map(|(owner, fault)| match owner {
            Some(Owner::Drive(index)) => (index, fault),
            Some(Owner::Device(index)) => {
                let name = self.devices.get(index).map_or("", |device| device.name.as_str());
                (0, PlanFault::new("device", format!("{name}: {}: {}", fault.key, fault.message)))
            }
            None => (0, fault),
        }));
        faults
    }

    /// The names of devices; those of drives are looked at for all protocols.
    fn check_names(&self) -> Vec<PlanFault> {
        let mut found = Vec::new();
        for (index, Device { name, .. }) in self.devices.iter().enumerate() {
            let why = format!("{name:?}: its name must be 1 to 32 letters, digits, - _ or .");
            found.wrong_if(!is_plain_name(name), "device", why);
            let of_drive = self.drives.iter().any(|drive| drive.axis.name == *name);
            let is_taken = of_drive || self.devices[..index].iter().any(|other| other.name == *name);
            let why = format!("{name}: its name is taken; names are unique in the machine");
            found.wrong_if(is_taken, "device", why);
        }
        found
    }

    /// The mistakes, each with its owner, the segment or a slave; those of a drive as an axis left out.
    #[doc(hidden)]
    pub fn findings(&self, period_ns: u64) -> Vec<(Option<Owner>, PlanFault)> {
        let mut faults: Vec<_> = self.check_line(period_ns).into_iter().map(|fault| (None, fault)).collect();
        let mut last: Option<(u16, Owner)> = None;
        for (owner, slave) in self.slaves() {
            let mut found = Vec::new();
            if let Some((_, first)) = last.filter(|(place, _)| *place == slave.place) {
                let (place, first) = (slave.place, self.name_of(first));
                let rule = "each slave has its own, counted from 0 at the master";
                found.wrong("position", format!("{place} is already the place of {first}; {rule}"));
            }
            last = Some((slave.place, owner));
            match owner {
                Owner::Drive(index) => self.drives[index].check(period_ns, &mut found),
                Owner::Device(index) => self.devices[index].check(period_ns, &mut found),
            }
            faults.extend(found.into_iter().map(|fault| (Some(owner), fault)));
        }
        faults
    }

    fn check_line(&self, period_ns: u64) -> Vec<PlanFault> {
        let mut found = Vec::new();
        let why = "must be the name of a network interface, at most 15 characters like \"eth1\"; or \
                   \"local:NAME\" for simulated drives on this computer";
        found.wrong_if(!is_interface(&self.interface), "interface", why);
        let why = format!("must be above 0 and below the period of {}; half of it is usual", Ns(period_ns));
        let wrong = self.ahead_of_sync_ns.is_some_and(|ahead| ahead == 0 || ahead >= period_ns);
        found.wrong_if(wrong, "sync_ahead", why);
        found.extend(self.period_fault(period_ns).map(|why| PlanFault::new("period", why)));
        let why = "has a slave with more process data than fit into a frame";
        found.wrong_if(self.frames().is_none(), "interface", why);
        found
    }

    /// Why no drive of this segment can work in a cycle of `period_ns`, or no frame fits into it.
    fn period_fault(&self, period_ns: u64) -> Option<String> {
        let of =
            |family| self.drives.iter().find(|drive| drive.family == family).map(|drive| &drive.axis.name);
        let longest = CONTROLLER_NS * CONTROLLER_PERIODS;
        let fits = period_ns.is_multiple_of(CONTROLLER_NS) && (CONTROLLER_NS..=longest).contains(&period_ns);
        if let Some(name) = of(Family::S700).filter(|_| !fits) {
            return Some(format!(
                "drive {name} needs a period that is a whole multiple of {}, up to {}",
                Ns(CONTROLLER_NS),
                Ns(longest)
            ));
        }
        let synchronous = self.drives.iter().find(|drive| drive.slave.sync);
        if let Some(drive) = synchronous.filter(|_| cycle_time(period_ns).is_none()) {
            return Some(format!(
                "drive {} takes as its cycle 1 ... 255 times a power of ten (object 60C2h), which {} is not; \
                 use 1ms or 2ms, for example",
                drive.axis.name,
                Ns(period_ns)
            ));
        }
        let frames = self.frames().unwrap_or_default();
        let wire_ns = frame::wire_ns(&frames) + frame::wire_ns(&[frame::ACYCLIC]);
        (wire_ns >= period_ns).then(|| {
            format!("a frame of this segment takes {} on the wire; lengthen the period", Ns(wire_ns))
        })
    }
}

impl SlavePlan {
    /// The mistakes of its memory and its watchdog.
    fn check(&self, period_ns: u64, keys: Keys, found: &mut Vec<PlanFault>) {
        self.check_memory(keys, found);
        let Some(watchdog_ns) = self.watchdog.ns() else { return };
        let (steps, gap_ns) = (watchdog_ns / WATCHDOG_STEP_NS, period_ns.saturating_mul(2));
        let is_whole = watchdog_ns.is_multiple_of(WATCHDOG_STEP_NS) && (1..=WATCHDOG_STEPS).contains(&steps);
        let step = Ns(WATCHDOG_STEP_NS);
        let why = format!("must be a whole multiple of {step} (register 0420h); use 100us ... 6553.5ms");
        found.wrong_if(!is_whole, "watchdog", why);
        let (after, gap) = (Ns(watchdog_ns), Ns(gap_ns));
        let what = "without outputs, and one lost frame makes a gap of two periods";
        let why = format!("trips after {after} {what}, {gap}; allow more than that");
        found.wrong_if(is_whole && watchdog_ns <= gap_ns, "watchdog", why);
    }

    fn check_memory(&self, keys: Keys, found: &mut Vec<PlanFault>) {
        for (key, name, areas) in [(keys[0], "outputs", &self.outputs), (keys[1], "inputs", &self.inputs)] {
            let bytes: usize = areas.iter().map(|area| usize::from(area.length)).sum();
            let why = match () {
                () if areas.len() > MOST_AREAS => {
                    format!("has {} areas of {name}; a slave has at most {MOST_AREAS} here", areas.len())
                }
                () if bytes > TERMINAL_MAX => {
                    format!("has {bytes} bytes of {name} in all; a slave has at most {TERMINAL_MAX} here")
                }
                () if areas.iter().any(|area| area.length == 0) => {
                    format!("has {name} without a byte; leave them out")
                }
                () => continue,
            };
            found.wrong(key, why);
        }
        let areas = self.areas(keys);
        for (index, (key, name, bytes)) in areas.iter().enumerate() {
            let wrong = match () {
                () if bytes.start < REGISTERS => Some("would overwrite its registers, 0x0000 ... 0x0EFF"),
                () if *key == "mailbox" && bytes.start < MEMORY => {
                    Some("would not be in its memory, which begins at 0x1000")
                }
                () if bytes.end > 1 << 16 => Some("go beyond its memory, which ends at 0xFFFF"),
                () => None,
            };
            if let Some(wrong) = wrong {
                found.wrong(key, format!("its {} {wrong}", what(name, bytes)));
            }
            for (.., other, taken) in &areas[..index] {
                if bytes.start < taken.end && taken.start < bytes.end {
                    found.wrong(key, self.overlap(name, bytes, other, taken));
                }
            }
        }
    }

    fn overlap(&self, name: &str, bytes: &Range<u32>, other: &str, taken: &Range<u32>) -> String {
        let remedy = match (self.outputs.as_slice(), self.inputs.as_slice()) {
            ([Area { start: out, length }], [Area { start, .. }])
                if name == "inputs" && other == "outputs" && out < start =>
            {
                let most = u32::from(start - out) / BUFFERS;
                format!(
                    "; the three buffers of the outputs have room for {most} bytes each, not for {length}; \
                     use fewer, or"
                )
            }
            _ => ";".into(),
        };
        format!("its {} overlap its {}{remedy} move them apart", what(name, bytes), what(other, taken))
    }

    /// The areas of its memory: the key, the name, where. Nothing where there is none.
    fn areas(&self, [outputs, inputs]: Keys) -> Vec<Named> {
        let span = |area: Area, times: u32| {
            let start = u32::from(area.start);
            let times = if start < MEMORY { 1 } else { times };
            start..start + times * u32::from(area.length)
        };
        let [out, read] = self.mailbox.unwrap_or_default();
        let process = |key, name, areas: &[Area]| -> Vec<Named> {
            areas.iter().map(|area| (key, name, span(*area, BUFFERS))).collect()
        };
        let mailboxes = vec![("mailbox", "requests", span(out, 1)), ("mailbox", "answers", span(read, 1))];
        let all =
            [mailboxes, process(outputs, "outputs", &self.outputs), process(inputs, "inputs", &self.inputs)];
        all.into_iter().flatten().filter(|(.., bytes)| !bytes.is_empty()).collect()
    }
}

/// A piece of its memory in words.
fn what(name: &str, bytes: &Range<u32>) -> String {
    format!("{name} at {:#06X} ... {:#06X}", bytes.start, bytes.end - 1)
}

impl KollmorgenDrive {
    /// The mistakes of the drive, those of its axis left out.
    fn check(&self, period_ns: u64, found: &mut Vec<PlanFault>) {
        self.slave.check(period_ns, OF_A_DRIVE, found);
        self.check_layouts(found);
        found.extend(self.mode_fault().map(|why| PlanFault::new("mode", why)));
        self.check_scaling(period_ns, found);
        match self.slave.mailbox {
            None => found.wrong("mailbox", "missing; a drive is configured through it"),
            Some(areas) if areas.iter().any(|area| area.length < SDO) => {
                found.wrong("mailbox", format!("is too small for a request, which has {SDO} bytes"));
            }
            Some(_) => {}
        }
        let long = self.slave.start_up.iter().find(|start| start.bytes() > EXPEDITED);
        if let Some(start) = long.filter(|_| self.family == Family::S700) {
            found.wrong("start_up", too_long(start));
        }
        let trips = "a drive whose watchdog trips, or that loses the cycle (F28), stops and then switches \
                     its power off";
        found.extend(self.axis.dropped_fault(trips));
        for Entry { object, .. } in self.show.iter().flatten().filter(|entry| entry.kind.is_string()) {
            found.wrong("monitor", format!("{object} is a text; monitor objects with numbers"));
        }
    }

    /// The mistakes of the process data that the station needs.
    fn check_layouts(&self, found: &mut Vec<PlanFault>) {
        let pdos = [
            ("pdo.outputs", &self.outputs, self.slave.output_bytes(), CONTROL_WORD, "control word", true),
            ("pdo.inputs", &self.inputs, self.slave.input_bytes(), STATUS_WORD, "status word", false),
        ];
        for (key, layout, bytes, word, name, is_output) in pdos {
            let wanted = if is_output { "16xxh or 17xxh" } else { "1Axxh or 1Bxxh" };
            let why = format!("{:04X}h has the other direction; use one of {wanted}", layout.pdo);
            found.wrong_if(layout.is_output() != is_output, key, why);
            if layout.place(word).is_none() {
                found.wrong(key, format!("has no {name}; map {word}"));
            } else if !layout.entries.contains(&Entry { object: word, kind: Type::U16 }) {
                found.wrong(key, format!("has a {name} of another type; write {word}.u16"));
            }
            if let Some(entry) = layout.entries.iter().find(|entry| entry.kind.is_string()) {
                found.wrong(key, format!("{} is a text; process data have numbers only", entry.object));
            }
            let twice = |(at, object): &(usize, Object)| layout.place(*object) != Some(*at);
            if let Some((_, object)) = layout.places().map(|(at, entry)| (at, entry.object)).find(twice) {
                found.wrong(key, format!("has {object} twice"));
            }
            let (pdo, free) = (layout.pdo, if is_output { "1600h" } else { "1A00h" });
            let why = format!("{pdo:04X}h is fixed, and mapping = \"free\" writes to it; use {free}");
            found.wrong_if(self.mapping == Mapping::Free && pdo & 0x0100 != 0, key, why);
            let size = layout.size();
            found.wrong_if(bytes != size, key, format!("has {size} bytes, and its buffer has {bytes}"));
        }
        for entry in &self.outputs.entries {
            if let Err(why) = source(self, *entry) {
                found.wrong("pdo.outputs", self.unowned(*entry, why));
            }
        }
        let why = "has no setpoint; map one of 0x60C1:1 or 0x607A:0 (position), 0x606B:0 or 0x60FF:0 \
                   (velocity), 0x6074:0 or 0x6071:0 (torque)";
        found.wrong_if(self.targets().next().is_none() && !self.native, "pdo.outputs", why);
        if let Some((object, kind)) = self.setpoint().map(Setpoint::shape) {
            let why = format!("has a setpoint of another type; write {object}.{}", kind.name());
            found.wrong_if(!self.outputs.entries.contains(&Entry { object, kind }), "pdo.outputs", why);
        }
    }

    /// Why nobody writes this entry of its outputs.
    fn unowned(&self, Entry { object, .. }: Entry, why: Unowned) -> String {
        let mode = self.mode().map_or(0, |mode| mode.0 as u8);
        match why {
            Unowned::Followed => format!(
                "has {object}, which mode {mode:#04X} may follow besides the setpoint, and the master drives \
                 one of them; leave one out"
            ),
            Unowned::Blind => format!(
                "has {object}, which mode {mode:#04X} does not follow, so that it has to be the actual \
                 position (32 bits); map 0x6064:0 into pdo.inputs, or leave {object} out"
            ),
            Unowned::Unexplained => format!(
                "has {object}, a setpoint of the manufacturer that the master does not drive; leave it out, \
                 or give its value in start_up"
            ),
        }
    }

    fn mode_fault(&self) -> Option<String> {
        let Some(mode) = self.mode else {
            let is_carried = self.outputs.place(MODE).is_some() && self.mode().is_none();
            return is_carried
                .then(|| "missing: pdo.outputs carries it (0x6060:0), and has no target".into());
        };
        let (is_known, has, position) = match self.family {
            Family::S700 => (mode.is_of_s700(), "3, 4, 7, 0x80, 0x82 and 0x85", "0x85 or 7"),
            Family::Akd => (mode.is_of_akd(), "3, 4, 7 and 8", "8 or 7"),
        };
        let target = match mode {
            _ if !is_known => {
                // Drives of CiA 402 of others are described as an AKD.
                let is_akds = self.family == Family::S700 && mode.is_of_akd();
                let hint = if is_akds { "; type = \"akd\" has it" } else { "" };
                let what = "is not a mode of this drive that the master drives; it drives";
                return Some(format!("{what} {has}{hint}"));
            }
            _ if self.native || self.setpoint().is_some() => return None,
            Mode::PROFILE_POSITION => {
                return Some(format!(
                    "profile position takes a target only by a handshake, which the master does not make: \
                     nothing would move; use {position}, or setpoints = \"native\" if the application makes \
                     it"
                ));
            }
            Mode::HOMING => {
                return Some(
                    "homing is the mode of the command Home, which sets it by itself; leave mode out".into(),
                );
            }
            Mode::PROFILE_VELOCITY => "0x60FF:0",
            Mode::TORQUE => "0x6071:0",
            Mode::INTERPOLATED => "0x60C1:1",
            Mode::CYCLIC_POSITION => "0x607A:0",
            Mode::DIGITAL_VELOCITY => "0x606B:0 or 0x60FF:0",
            Mode::DIGITAL_CURRENT => "0x6074:0 or 0x6071:0",
            Mode::TRAJECTORY => "0x60C1:1 or 0x607A:0",
            _ => {
                return Some(format!(
                    "follows no target that the master drives: nothing would move; use one of {has}, or \
                     setpoints = \"native\" if the application drives it"
                ));
            }
        };
        Some(format!("follows {target}, which pdo.outputs does not have; map it, or leave mode out"))
    }

    /// Numbers that the wire could not carry.
    fn check_scaling(&self, period_ns: u64, found: &mut Vec<PlanFault>) {
        let scaling = &self.scaling;
        let wrong = !(1..=31).contains(&scaling.prbase);
        found.wrong_if(wrong, "prbase", "must be 1 ... 31; 20 makes 1048576 increments per turn");
        for (key, value) in [
            ("velocity_rpm_per_count", scaling.rpm_per_count),
            ("torque_permille_per_count", scaling.permille_per_count),
            ("rated_current", scaling.rated_current.unwrap_or(1.0)),
        ] {
            found.wrong_if(!(value > 0.0 && value.is_finite()), key, "must be above 0");
        }
        let least = 1_000.0 / f64::from(i16::MAX);
        let is_torque = matches!(self.setpoint(), Some(Setpoint::Torque(_)));
        let why = format!("must be at least {least:.4}, so that 16 bits hold the rated torque");
        found.wrong_if(is_torque && scaling.permille_per_count < least, "torque_permille_per_count", why);
        let is_position = matches!(self.setpoint(), Some(Setpoint::Position(_)));
        let is_given = matches!(self.axis.limits.following_error, FollowingError::Most(_));
        let why = "concerns a demand of positions, and this drive gets none from the master; leave it out";
        found.wrong_if(is_given && !is_position, "limits.following_error", why);
        if self.axis.units.counts_per_unit == 0.0 || !self.axis.units.counts_per_unit.is_finite() {
            return; // Reported for every axis.
        }
        for (key, value) in self.axis.velocities() {
            found.extend(self.velocity_fault(value, period_ns).map(|why| PlanFault::new(key, why)));
        }
    }

    /// Why this velocity does not go over the wire, user units/s.
    fn velocity_fault(&self, velocity: f64, period_ns: u64) -> Option<String> {
        let (rpm, most) = (self.rpm(velocity).abs(), f64::from(i32::MAX));
        let per_count = self.scaling.rpm_per_count;
        if matches!(self.setpoint(), Some(Setpoint::Velocity(_)))
            && !(1.0..=most).contains(&(rpm / per_count))
        {
            return Some(format!(
                "{rpm} rpm of the motor are outside the range of the 32-bit setpoint, {per_count} ... {} \
                 rpm; change it, or check scale and velocity_rpm_per_count",
                per_count * most
            ));
        }
        // Farther, and nobody knows which way round it was.
        let way = (velocity * self.axis.units.counts_per_unit).abs() * period_ns as f64 / 1e9;
        (way >= most).then(|| {
            format!(
                "{rpm} rpm of the motor are more than half of its 32-bit counts in one cycle; lower it, \
                or check scale and prbase"
            )
        })
    }
}

impl Device {
    fn check(&self, period_ns: u64, found: &mut Vec<PlanFault>) {
        self.slave.check(period_ns, OF_A_DEVICE, found);
        let mute = self.slave.mailbox.is_none() && !self.slave.start_up.is_empty();
        let why = "is written through the mailbox, and the device has none; give its mailbox";
        found.wrong_if(mute, "start_up", why);
        let is_small = self.slave.mailbox.is_some_and(|[out, _]| out.length <= SDO);
        let long = self.slave.start_up.iter().find(|start| start.bytes() > EXPEDITED);
        if let Some(start) = long.filter(|_| is_small) {
            found.wrong("start_up", too_long(start));
        }
    }
}

/// Why an object cannot be written through a mailbox of one SDO.
fn too_long(start: &Start) -> String {
    format!(
        "{} has {} bytes, and the mailbox of this slave takes values of at most {EXPEDITED}; leave it out",
        start.object,
        start.bytes()
    )
}
