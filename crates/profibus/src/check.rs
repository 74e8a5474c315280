//! What is wrong with the plan of a wire and its drives. Whether its turns fit onto the grid is in `schedule`.

use super::plan::{
    ADDRESS_MAX, CHANNEL, DATA_MAX, LEAST_SLOT_BITS, LenzeDrive, ParameterPath, ProfibusPlan, RATES,
    RETRIES_MAX, SLOT_MARGIN_BITS,
};
use super::wire::dp::Configuration;
use super::wire::telegram::{DU_MAX, STATION_MAX};
use fieldbeat_core::axis::{FollowingError, HeldBy, Load, PlanFault};
use fieldbeat_core::time::{MS, Ns, S};

/// The most bits that a time of the wire has.
pub(super) const BITS_MAX: u32 = 65_535;
/// Tsyn, bits: a slave waits for so much silence.
pub(super) const SYNC_BITS: u32 = 33;
/// A slave answers no sooner, bits.
pub(super) const TSDR_MIN: u8 = 11;
/// The most bytes of User_Prm: those of Set_Prm less 7.
pub(super) const USER_PRM_MAX: usize = DATA_MAX - 7;
/// The most rounds between two searches for another master.
pub(super) const GAP_MAX: u32 = 100;
/// The longest time of a driver between a byte and its reading, ns.
pub(super) const LATENCY_MAX_NS: u64 = 100 * MS;
/// The longest time from one turn of a drive to the next one that it may want, ns: 65535 times 100 us.
pub(super) const INTERVAL_MAX_NS: u64 = 65_535 * 100_000;
/// How often Global_Control may be sent, ns.
pub(super) const CONTROL_RANGE_NS: std::ops::RangeInclusive<u64> = MS..=10 * S;
/// The largest count of a set point, which has 16 bits.
const COUNT_MAX: f64 = i16::MAX as f64;

/// `9600, 19200 ... or 12000000`.
pub(super) fn rates() -> String {
    let (last, others) = RATES.split_last().unwrap_or((&0, &[]));
    let others: Vec<String> = others.iter().map(u32::to_string).collect();
    format!("{} or {last}", others.join(", "))
}

impl ProfibusPlan {
    /// What is wrong with the wire itself.
    pub(super) fn own_faults(&self) -> Vec<PlanFault> {
        let mut faults = Vec::new();
        let mut wrong = |key, message: String| faults.push(PlanFault::new(key, message));
        if self.device.is_empty() {
            wrong("device", "must be a serial port, like \"/dev/ttyS1\", or \"local:NAME\"".into());
        }
        let place = RATES.iter().position(|rate| *rate == self.rate);
        if place.is_none() {
            wrong("rate", format!("must be {} bit/s", rates()));
        }
        if self.address > ADDRESS_MAX {
            wrong("address", format!("must be 0 ... {ADDRESS_MAX}, the address of this master"));
        }
        let bits = &self.bits;
        let (least, answered) =
            (place.map_or(0, |place| LEAST_SLOT_BITS[place]), bits.max_tsdr.saturating_add(SLOT_MARGIN_BITS));
        if bits.slot <= answered || bits.slot < least || bits.slot > BITS_MAX {
            wrong(
                "bits.slot",
                format!(
                    "must be {} ... {BITS_MAX}: above bits.max_tsdr + {SLOT_MARGIN_BITS}, and at least \
                     {least} at this rate",
                    least.max(answered.saturating_add(1))
                ),
            );
        }
        for (key, value, from) in [
            ("bits.max_tsdr", bits.max_tsdr, u32::from(TSDR_MIN)),
            ("bits.sync", bits.sync, SYNC_BITS),
            ("bits.idle", bits.idle, SYNC_BITS),
            ("bits.idle_unanswered", bits.idle_unanswered, SYNC_BITS),
        ] {
            if !(from..=BITS_MAX).contains(&value) {
                wrong(key, format!("must be {from} ... {BITS_MAX} bits"));
            }
        }
        if bits.latency_ns > LATENCY_MAX_NS {
            wrong("latency", format!("must be at most {}", Ns(LATENCY_MAX_NS)));
        }
        if self.retries > RETRIES_MAX {
            wrong("retries", format!("must be at most {RETRIES_MAX}"));
        }
        if self.gap.is_some_and(|rounds| !(1..=GAP_MAX).contains(&rounds)) {
            wrong("gap", format!("must be 1 ... {GAP_MAX} rounds, or \"off\""));
        }
        if self.highest_address > STATION_MAX || self.highest_address <= self.address {
            wrong("highest_address", format!("must be above the master's own address, up to {STATION_MAX}"));
        }
        if !CONTROL_RANGE_NS.contains(&self.global_control_ns) {
            let (least, most) = CONTROL_RANGE_NS.into_inner();
            wrong("global_control", format!("must be {} ... {}", Ns(least), Ns(most)));
        }
        faults
    }

    /// What contradicts the wire in the plan of one of its drives.
    pub(super) fn drive_faults(&self, drive: &LenzeDrive) -> Vec<PlanFault> {
        let mut faults = drive.faults();
        if drive.address == self.address {
            let why = "is the master's own address; give the one that is set at the module";
            faults.push(PlanFault::new("address", why));
        }
        if u32::from(drive.min_tsdr) >= self.bits.max_tsdr {
            let why =
                format!("must be below bits.max_tsdr = {}, by which it has to answer", self.bits.max_tsdr);
            faults.push(PlanFault::new("min_tsdr", why));
        }
        faults
    }
}

impl LenzeDrive {
    /// What contradicts itself, or would not work; what every axis has, and what depends on the wire, left out.
    pub fn faults(&self) -> Vec<PlanFault> {
        let mut faults = Vec::new();
        if self.address > ADDRESS_MAX {
            faults.push(PlanFault::new("address", format!("must be 0 ... {ADDRESS_MAX}")));
        }
        faults.extend(self.start_up_faults());
        faults.extend(self.data_faults());
        faults.extend(self.watchdog_fault());
        faults.extend(self.parameter_fault());
        faults.extend(self.axis_faults());
        faults.extend(self.speed_faults());
        faults
    }

    fn start_up_faults(&self) -> Vec<PlanFault> {
        let mut faults = Vec::new();
        let mut wrong = |key, message: String| faults.push(PlanFault::new(key, message));
        if self.user_prm.len() > USER_PRM_MAX {
            wrong("user_prm", format!("must be at most {USER_PRM_MAX} bytes: Set_Prm has 7 before them"));
        }
        if self.min_tsdr != 0 && self.min_tsdr < TSDR_MIN {
            wrong("min_tsdr", format!("must be {TSDR_MIN} ... 255 bits, or 0: the drive keeps its own"));
        }
        if self.min_slave_interval_ns > INTERVAL_MAX_NS {
            wrong("min_slave_interval", format!("must be at most {}", Ns(INTERVAL_MAX_NS)));
        }
        if usize::from(self.extended_diagnosis) > DU_MAX - 8 {
            wrong("extended_diagnosis", format!("must be at most {} bytes", DU_MAX - 8));
        }
        if self.enable_bit.is_some_and(|bit| bit.bit > 15) {
            wrong("enable_bit", "must be a bit of the status word, 0 ... 15".into());
        }
        faults
    }

    /// Identifier bytes, and the words in what they make.
    fn data_faults(&self) -> Vec<PlanFault> {
        let mut faults = Vec::new();
        let mut wrong = |key, message: String| faults.push(PlanFault::new(key, message));
        if self.configuration.len() > DATA_MAX {
            wrong("configuration", format!("must be at most {DATA_MAX} bytes"));
            return faults;
        }
        let Some((inputs, outputs)) = Configuration(&self.configuration).sizes() else {
            let why =
                "is no list of identifier bytes: its last module lacks bytes; look at the GSD of the module";
            wrong("configuration", why.into());
            return faults;
        };
        if inputs > DATA_MAX || outputs > DATA_MAX {
            let made = format!("gives {outputs} bytes of outputs and {inputs} of inputs");
            wrong("configuration", format!("{made}; a telegram has {DATA_MAX} at most"));
            return faults;
        }
        // Control word and set point are two words.
        let least = self.process_at() + 4;
        if outputs < least || inputs < least {
            let (made, with) = match self.channel {
                true => (least, format!("a channel of {CHANNEL} bytes, ")),
                false => (least, String::new()),
            };
            wrong(
                "configuration",
                format!(
                    "gives {outputs} bytes of outputs and {inputs} of inputs; {with}control word and set \
                     point, status word and actual value need {made} each: 0xF3, 0xF1 are a channel and two \
                     words"
                ),
            );
            return faults;
        }
        let words = |bytes: usize| (bytes - self.process_at()) / 2;
        let (outputs, inputs) = (words(outputs), words(inputs));
        for (key, word, words, of) in [
            ("set_point_word", self.scale.set_point, outputs, "outputs"),
            ("actual_word", self.scale.actual, inputs, "inputs"),
        ] {
            if word == 0 || usize::from(word) >= words {
                let zero = if of == "outputs" { "control" } else { "status" };
                wrong(
                    key,
                    format!("must be a word of the {of}, 1 ... {}; word 0 is the {zero} word", words - 1),
                );
            }
        }
        if self.further.len() > outputs.saturating_sub(2) {
            let most = outputs.saturating_sub(2);
            let why = format!("must be at most {most} words: so many outputs has the configuration besides");
            wrong("further", why);
        }
        for (index, shown) in self.show.iter().flatten().enumerate() {
            if usize::from(shown.word) >= inputs {
                wrong("monitor", format!("word {} is none of the inputs, 0 ... {}", shown.word, inputs - 1));
            } else if !(shown.per_count != 0.0 && shown.per_count.is_finite()) {
                wrong("monitor", "per_count must be a finite number other than 0".into());
            } else if self.show.iter().flatten().take(index).any(|other| other.name == shown.name) {
                wrong("monitor", format!("{} is there twice; each has its own name", shown.name));
            }
        }
        faults
    }

    fn watchdog_fault(&self) -> Option<PlanFault> {
        let timeout_ns = self.watchdog.timeout_ns?;
        let unit_ns = self.watchdog_unit_ns();
        let most_ns = 255 * 255 * unit_ns;
        (timeout_ns == 0 || timeout_ns > most_ns).then(|| {
            let (least, most) = (Ns(unit_ns), Ns(most_ns));
            let why = format!("must be {least} ... {most}: two factors of 1 ... 255, in units of {least}");
            PlanFault::new("watchdog", why)
        })
    }

    fn parameter_fault(&self) -> Option<PlanFault> {
        let why = match self.parameters {
            path if path.is_channel() && !self.channel => {
                "needs channel = true, and a configuration with a parameter channel; or \"msac1\", or \
                 \"none\""
            }
            ParameterPath::Msac1 { .. } if !self.has_dpv1() => {
                "\"msac1\" needs DP-V1: bit 7 (DPV1_Enable) of the first byte of user_prm, 0x80"
            }
            _ => return None,
        };
        Some(PlanFault::new("parameters.path", why))
    }

    /// What only a drive with a position or a torque could do.
    fn axis_faults(&self) -> Vec<PlanFault> {
        let (limits, units) = (&self.axis.limits, &self.axis.units);
        let mut faults: Vec<PlanFault> = [
            ("limits.position", limits.position.is_some()),
            ("limits.step", limits.step.is_some()),
            ("limits.following_error", matches!(limits.following_error, FollowingError::Most(_))),
            ("modulo", units.modulo.is_some()),
            ("offset", units.offset != 0.0),
        ]
        .into_iter()
        .filter(|(_, given)| *given)
        .map(|(key, _)| {
            PlanFault::new(key, "concerns positions, and this protocol has speeds only; leave it out")
        })
        .collect();
        let mut wrong = |key, message: &str| faults.push(PlanFault::new(key, message));
        if limits.torque.is_some() {
            wrong("limits.torque", "has no effect: the drive takes speeds, no torques; leave it out");
        }
        if self.axis.load == Load::Vertical(HeldBy::Drive) {
            wrong(
                "held_by",
                "a drive whose outputs fail, by its watchdog too, may coast, and the load drops; name a \
                 brake: held_by = \"brake\"",
            );
        }
        faults
    }

    /// A set point is a count of 16 bits.
    fn speed_faults(&self) -> Vec<PlanFault> {
        let mut faults = Vec::new();
        let mut wrong = |key, message: String| faults.push(PlanFault::new(key, message));
        let (full_count, full_rpm) = (self.scale.full_count, self.scale.full_rpm);
        if full_count <= 0 {
            wrong("full_count", "must be 1 ... 32767, the count of the full speed; 16384 is 0x4000".into());
        }
        if !(full_rpm > 0.0 && full_rpm.is_finite()) {
            wrong("full_rpm", "must be above 0: the full speed, as C0011 has it".into());
        }
        let scale = self.counts_per_velocity().abs();
        if !(faults.is_empty() && scale > 0.0 && scale.is_finite()) {
            return faults; // Reported for every axis, or above.
        }
        let mut wrong = |key, message: String| faults.push(PlanFault::new(key, message));
        let (unit, most) = (self.axis.units.unit, COUNT_MAX / scale);
        let limit = self.axis.limits.velocity;
        for (key, value) in
            [("profile.velocity", Some(self.axis.profile.velocity)), ("limits.velocity", limit)]
        {
            if let Some(value) = value.filter(|value| *value * scale > COUNT_MAX) {
                wrong(
                    key,
                    format!(
                        "{value} {unit}/s are more than a set point of 16 bits holds, {most:.4} {unit}/s; \
                         change it, or check scale, full_count and full_rpm"
                    ),
                );
            }
        }
        if limit.is_none() {
            let why = format!("missing; a set point of 16 bits needs one, up to {most:.4} {unit}/s");
            wrong("limits.velocity", why);
        }
        faults
    }
}
