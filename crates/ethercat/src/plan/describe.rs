//! The segment in words: what `check` says of it.

use super::{
    Area, Device, EthercatPlan, Expected, KollmorgenDrive, Mapping, Setpoint, SlavePlan, Watchdog, frame,
};
use crate::object::Family;
use crate::object::pdo::{Entry, Layout};
use crate::outputs::{Source, source};
use crate::segment::clock::window_ns;
use fieldbeat_core::axis::{HeldBy, Load};
use fieldbeat_core::time::Ns;

impl EthercatPlan {
    /// The lines of `check`: a paragraph a drive, whose first line is its address, then a line each of what else there
    /// is to say of the segment.
    pub fn describe(&self, period_ns: u64) -> Vec<String> {
        let drive = |drive: &KollmorgenDrive| {
            let mut lines = vec![self.address(&drive.slave)];
            lines.extend(drive.describe(period_ns, self.ahead_ns(period_ns)));
            lines.join("\n")
        };
        let mut paragraphs: Vec<String> = self.drives.iter().map(drive).collect();
        paragraphs.extend(self.devices.iter().map(|device| {
            format!("  device {}: {}; {}", device.name, self.address(&device.slave), device.describe())
        }));
        paragraphs.extend(self.unlisted());
        paragraphs.extend(self.describe_frame(period_ns));
        paragraphs.push(self.describe_clock(period_ns));
        paragraphs
    }

    /// How long before SYNC0 a frame leaves the master.
    pub fn ahead_ns(&self, period_ns: u64) -> u64 {
        self.ahead_of_sync_ns.unwrap_or(period_ns / 2)
    }

    fn address(&self, slave: &SlavePlan) -> String {
        format!("{}, place {}", self.interface, slave.place)
    }

    /// The gaps between the slaves that are known.
    fn unlisted(&self) -> Vec<String> {
        let mut next = 0;
        let mut gaps = Vec::new();
        for (_, slave) in self.slaves() {
            let left = "not listed: a slave there forwards the frames and is not configured";
            match slave.place.checked_sub(next) {
                None | Some(0) => {}
                Some(1) => gaps.push(format!("  place {next}: {left}")),
                Some(_) => gaps.push(format!("  places {next} ... {}: {left}", slave.place - 1)),
            }
            next = slave.place.saturating_add(1);
        }
        gaps
    }

    fn describe_frame(&self, period_ns: u64) -> Option<String> {
        let frames = self.frames()?;
        let usual: usize = frames.iter().sum();
        let all = match self.slaves().len() {
            1 => "the process data of 1 slave".to_owned(),
            slaves => format!("the process data of {slaves} slaves"),
        };
        let (what, carry) = match frames.len() {
            1 => ("one frame".to_owned(), "carries"),
            count => (format!("{count} frames"), "carry"),
        };
        let apart = if self.lrw { "" } else { ", outputs and inputs in separate datagrams (lrw = false)" };
        Some(format!(
            "  {what} every {} {carry} {all}{apart}, whatever the divisors: {usual} bytes, {} on the wire at \
             100 Mbit/s plus about 1 us per slave; with acyclic access up to {} bytes and {}",
            Ns(period_ns),
            Ns(frame::wire_ns(&frames)),
            usual + frame::ACYCLIC,
            Ns(frame::wire_ns(&frames) + frame::wire_ns(&[frame::ACYCLIC]) - frame::wire_ns(&[0])),
        ))
    }

    fn describe_clock(&self, period_ns: u64) -> String {
        let ahead = Ns(self.ahead_ns(period_ns));
        match self.slaves().into_iter().find(|(_, slave)| slave.sync) {
            Some((owner, slave)) => format!(
                "  the clock of {} (place {}) is the clock of the segment; SYNC0 comes {ahead} after the \
                 frame",
                self.name_of(owner),
                slave.place
            ),
            None => "  no clocks: each slave works when the frame passes".into(),
        }
    }
}

impl KollmorgenDrive {
    fn describe(&self, period_ns: u64, ahead_ns: u64) -> Vec<String> {
        let family = match self.family {
            Family::S700 => "S300 ... S700",
            Family::Akd => "AKD",
        };
        let mut lines =
            vec![format!("{family}, {}{}", self.slave.identity.describe(), self.slave.unchecked())];
        lines.push(match self.slave.identity.describe_own() {
            own if own.is_empty() => {
                "known by its position only: an equal drive in its place is taken for it (serial, alias or \
                 identification; fieldbeat pin)"
                    .into()
            }
            own => format!("known by its {own}; with another one it stays not connected"),
        });
        lines.push(self.describe_pdos());
        lines.extend(self.describe_rest());
        lines.extend(self.setpoint().map(|setpoint| self.describe_setpoint(setpoint)));
        let native = "its targets are the application's, by native outputs (setpoints = \"native\")";
        let unchecked = "its increments per turn (608Fh) are not compared with prbase (check_prbase = false)";
        let absolute = "has its reference without a homing: its encoder is absolute (absolute = true)";
        let said = [
            self.native.then_some(native),
            self.setpoint().map(commands),
            (!self.check_prbase).then_some(unchecked),
            self.absolute.then_some(absolute),
        ];
        lines.extend(said.into_iter().flatten().map(str::to_owned));
        lines.push(self.describe_sync(period_ns, ahead_ns));
        let shown: Vec<String> = self.show.into_iter().flatten().map(entry).collect();
        if !shown.is_empty() {
            lines.push(format!("shows {}, read through its mailbox in turn", shown.join(", ")));
        }
        lines.push(format!("if the master dies: {}", self.describe_death()));
        lines
    }

    fn describe_pdos(&self) -> String {
        let how = match self.mapping {
            Mapping::Fixed => "selected by 1C12h and 1C13h",
            Mapping::Free => "mapped by the master",
            Mapping::AsIs => "as the drive is set (mapping = \"as-is\")",
        };
        format!("writes {}; reads {}; {how}", pdo(&self.outputs), pdo(&self.inputs))
    }

    /// The objects in its outputs besides control word and setpoint.
    fn describe_rest(&self) -> Option<String> {
        let rest = self.outputs.entries.iter().filter_map(|one| {
            let carried = match source(self, *one).ok()? {
                Source::Control | Source::Setpoint => return None,
                Source::Mode => "the mode".to_owned(),
                Source::Actual => "the actual position".to_owned(),
                Source::Configured(raw) => one.kind.number(raw).to_string(),
                Source::Own => "as the drive has it".to_owned(),
                Source::Zero => "0".to_owned(),
            };
            Some(format!("{} = {carried}", entry(*one)))
        });
        let rest: Vec<String> = rest.collect();
        (!rest.is_empty()).then(|| format!("its outputs also carry {}", rest.join(", ")))
    }

    fn describe_setpoint(&self, setpoint: Setpoint) -> String {
        let scaling = &self.scaling;
        let what = match setpoint {
            Setpoint::Position(object) => {
                format!("positions by {object}, {} increments per turn", scaling.increments())
            }
            Setpoint::Velocity(object) => {
                format!("velocities by {object}, {:.6} rpm a count", scaling.rpm_per_count)
            }
            Setpoint::Torque(object) => {
                format!("torques by {object}, {} per mille a count", scaling.permille_per_count)
            }
        };
        let mode = self.mode().map_or_else(String::new, |mode| {
            let name = mode.name().map_or_else(String::new, |name| format!(" ({name})"));
            format!("mode {:#04X}{name}: ", mode.0 as u8)
        });
        format!("{mode}{what}")
    }

    fn describe_sync(&self, period_ns: u64, ahead_ns: u64) -> String {
        let window = Ns(window_ns(period_ns).unsigned_abs());
        let fault = "the second interrupt in a row outside it is fault F28";
        match self.slave.sync {
            true => format!(
                "its cycle is SYNC0 every {}, {} after the frame; its window is {window}: {fault}",
                Ns(period_ns),
                Ns(ahead_ns)
            ),
            false => format!(
                "its cycle is the frame itself (sync = false): the lateness of the master counts against its \
                 window of {window}: {fault}; its cycle time 60C2h is not written: give it in start_up if the drive \
                 needs it"
            ),
        }
    }

    fn describe_death(&self) -> String {
        let held = match self.axis.load {
            Load::Vertical(HeldBy::Brake) => "; without power only the brake holds the load",
            Load::Vertical(HeldBy::Drive) => "; without power nothing holds the load",
            Load::Level => "",
        };
        let what = match self.slave.ending() {
            Watchdog::After(ns) => {
                return format!(
                    "the drive stops by itself within {} without a frame (SyncManager watchdog) and switches \
                     its power off{held}",
                    Ns(ns)
                );
            }
            Watchdog::AsDelivered => "its watchdog is as its SII has it (of an AKD none)",
            Watchdog::Off => "its watchdog is off",
        };
        let end = match (self.setpoint(), self.accept_no_watchdog) {
            (Some(Setpoint::Position(_)), _) => "holds its last position setpoint under power",
            (_, true) => "keeps its last setpoint (no_drive_watchdog = \"accept\")",
            (_, false) => {
                return format!(
                    "{what}, so velocities and torques are refused (no_drive_watchdog = \"refuse\"){held}"
                );
            }
        };
        let may = if self.slave.ending() == Watchdog::AsDelivered { "without one it" } else { "so it" };
        format!("{what}, {may} {end}{held}")
    }
}

/// The commands that it can carry out, in words.
fn commands(setpoint: Setpoint) -> &'static str {
    match setpoint {
        Setpoint::Position(_) => "takes moves, streams, jogs, velocities and homing",
        Setpoint::Velocity(_) => "takes velocities, jogs and homing; no moves, no streams",
        Setpoint::Torque(_) => "takes torques and homing; no velocities, no moves, no streams",
    }
}

fn pdo(layout: &Layout) -> String {
    let entries: Vec<String> = layout.entries.iter().map(|one| entry(*one)).collect();
    format!("{:04X}h = {} ({} bytes)", layout.pdo, entries.join(", "), layout.size())
}

/// An object with its name, or with its type where it has none.
fn entry(Entry { object, kind }: Entry) -> String {
    match object.known() {
        Some(known) => format!("{object} {}", known.name),
        None => format!("{object}.{}", kind.name()),
    }
}

impl Expected {
    fn describe(self) -> String {
        let number = |what, number: Option<u32>| match number {
            Some(number) => format!("{what} {number:#X}"),
            None => format!("any {what}"),
        };
        let Expected { vendor, product, revision, .. } = self;
        [("vendor", vendor), ("product", product), ("revision", revision)]
            .map(|(what, value)| number(what, value))
            .join(", ")
    }

    /// By what it is known from others of its kind; empty: by its position only.
    fn describe_own(self) -> String {
        let Expected { serial, alias, identification, .. } = self;
        let own = [
            serial.map(|serial| format!("serial number {serial:#010x}")),
            alias.map(|alias| format!("alias {alias}")),
            identification.map(|identification| format!("identification {identification}")),
        ];
        own.into_iter().flatten().collect::<Vec<_>>().join(", ")
    }
}

impl SlavePlan {
    /// The watchdog as it will be: without its SII nothing is delivered.
    fn ending(&self) -> Watchdog {
        match self.watchdog {
            Watchdog::AsDelivered if !self.check_sii => Watchdog::Off,
            watchdog => watchdog,
        }
    }

    /// That nobody looks whether its memory is where the plan has it.
    fn unchecked(&self) -> &'static str {
        if self.check_sii {
            ""
        } else {
            ", its SII is not compared with the configuration (check_sii = false)"
        }
    }
}

impl Device {
    fn describe(&self) -> String {
        let SlavePlan { identity, outputs, .. } = &self.slave;
        let end = match self.slave.ending() {
            _ if outputs.is_empty() => String::new(),
            Watchdog::After(ns) => format!("; its outputs go off within {} without a frame", Ns(ns)),
            Watchdog::AsDelivered => {
                "; its watchdog is as its SII has it (of most digital terminals 100 ms)".into()
            }
            Watchdog::Off => "; its watchdog is off, so only the device itself ends its outputs".into(),
        };
        let bytes = if self.slave.output_bytes() == 1 { "byte" } else { "bytes" };
        let unchecked = self.slave.unchecked();
        let own = match identity.describe_own() {
            own if own.is_empty() => own,
            own => format!(", {own}"),
        };
        format!(
            "{}{own}{unchecked}; {} {bytes} out{}, {} in{}{end}",
            identity.describe(),
            self.slave.output_bytes(),
            places(outputs),
            self.slave.input_bytes(),
            places(&self.slave.inputs),
        )
    }
}

/// Where process data are.
fn places(areas: &[Area]) -> String {
    let place = |area: &Area| match areas {
        [_] => format!("{:#06X}", area.start),
        _ => format!("{} at {:#06X}", area.length, area.start),
    };
    match areas {
        [] => String::new(),
        areas => format!(" ({})", areas.iter().map(place).collect::<Vec<_>>().join(", ")),
    }
}
