//! What `check` says of a drive on a PROFIBUS wire.

use super::plan::{CHANNEL, DriveProfile, LenzeDrive, ParameterPath, ProfibusPlan, Rs485};
use fieldbeat_core::axis::MonitorChannel;
use fieldbeat_core::bus::{Grid, unwatched};
use fieldbeat_core::time::{Ns, S};

const WEARS: &str =
    "a parameter that is written again and again wears the drive's EEPROM, unless saving is off: C0003 = 0";

impl ProfibusPlan {
    /// Drive `index` beyond its axis; the first line is its address.
    pub(super) fn describe_drive(&self, index: usize) -> String {
        let Some(drive) = self.drives.get(index) else { return String::new() };
        let mut lines = vec![format!("{}, address {}", self.device, drive.address)];
        lines.push(format!(
            "known by its address and the ident number {:#06x} of its module: an equal one there is taken for it",
            drive.ident
        ));
        lines.extend(self.describe_turn(index, drive));
        lines.push(self.describe_start_up(drive));
        lines.push(format!(
            "takes velocities, {} rpm at a count of {}; no moves, no streams, no homing",
            drive.scale.full_rpm, drive.scale.full_count
        ));
        lines.push(drive.describe_parameters());
        if drive.parameters != ParameterPath::None {
            lines.push(WEARS.to_owned());
        }
        lines.extend(MonitorChannel::names(drive.shown()).map(|names| format!("shows {names}")));
        lines.push(format!("if the master dies: {}", drive.describe_death()));
        lines.join("\n")
    }

    /// The wire itself, behind its drives.
    pub(super) fn describe_wire(&self) -> String {
        let bits = &self.bits;
        let direction = match self.rs485 {
            Rs485::Adapter => "the adapter",
            Rs485::Driver => "the driver by RTS",
        };
        let echo = if self.echo { ", the own echo is skipped" } else { "" };
        format!(
            "  wire: {} bit/s, 8E1, this master at address {}: a telegram at a time, {direction} switches \
             its direction{echo}; slot time {} ({} bits), MaxTsdr {} bits, {} at most",
            self.rate,
            self.address,
            Ns(self.slot_ns()),
            bits.slot,
            bits.max_tsdr,
            match self.retries {
                1 => "one repetition".to_owned(),
                retries => format!("{retries} repetitions"),
            },
        )
    }

    /// The turns on the grid.
    pub(super) fn describe_round(&self, grid: Grid) -> String {
        let every_ns = |drive: &LenzeDrive| grid.period_ns as f64 * f64::from(drive.axis.divisor);
        let planned: f64 = self.drives.iter().map(|drive| S as f64 / every_ns(drive)).sum();
        let [usual, worst] = self.loads(grid);
        format!(
            "  turns: {planned:.0} exchanges/s, where {} would begin inside the windows; bus load {usual:.1} \
             %, {worst:.1} % in a round with a slot time, a repetition and an acyclic telegram",
            self.exchanges_within(S, grid),
        )
    }

    fn describe_turn(&self, index: usize, drive: &LenzeDrive) -> Option<String> {
        let (outputs, inputs) = drive.lengths()?;
        let all: u64 = (0..self.drives.len()).map(|index| self.usual_turn_ns(index)).sum();
        let with =
            if drive.channel { format!(", {CHANNEL} of them the parameter channel") } else { String::new() };
        let latency = match self.bits.latency_ns {
            0 => String::new(),
            more => format!(" and up to {} in its port", Ns(more)),
        };
        let least = match drive.min_slave_interval_ns {
            0 => String::new(),
            least => format!("; not more often than every {}", Ns(least)),
        };
        Some(format!(
            "its turn: {outputs} bytes of outputs and {inputs} of inputs{with}; {} on the wire{latency}, {} at \
             most; all drives in turn {}{least}",
            Ns(self.wire_ns(index)),
            Ns(self.longest_turn_ns(index)),
            Ns(all),
        ))
    }

    fn describe_start_up(&self, drive: &LenzeDrive) -> String {
        let state = match drive.profile {
            DriveProfile::Drivecom => "DRIVECOM",
            DriveProfile::Profidrive => "PROFIdrive",
        };
        format!(
            "start-up takes it over: Set_Prm ({} bytes of User_Prm) for ident number {:#06X} locks it to \
             this master, and its outputs are 0 until Data_Exchange: a motor that turned by another master \
             coasts; one that another master has locked is left alone, and named; {state} words",
            drive.user_prm.len(),
            drive.ident,
        )
    }
}

impl LenzeDrive {
    fn describe_parameters(&self) -> String {
        match self.parameters {
            ParameterPath::None => "no parameters (parameters.path = \"none\")".to_owned(),
            ParameterPath::Pkw { .. } => "parameters by the PKW channel in the process data".to_owned(),
            ParameterPath::Drivecom => "parameters by the DRIVECOM channel in the process data".to_owned(),
            ParameterPath::Msac1 { slot, index, .. } => {
                format!("parameters by MSAC1, slot {slot}, index {index}, in place of its own Data_Exchange")
            }
        }
    }

    fn describe_death(&self) -> String {
        match self.watchdog_ns() {
            Some(within) => format!(
                "stops within {} by its own watchdog, which Set_Prm sets and its diagnosis has to show as on \
                 before it is enabled; what it does then is the drive's setting",
                Ns(within)
            ),
            None => unwatched(self.watchdog.accept_none).to_owned(),
        }
    }
}
