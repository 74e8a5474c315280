//! What is wrong with the plan of a wire and its drives. Whether its turns fit onto the grid is in `schedule`.

use super::plan::{
    ADDRESS_MAX, CHANNEL, DATA_MAX, LEAST_SLOT_BITS, LenzeDrive, ParameterPath, ProfibusPlan, RATES,
    RETRIES_MAX, SLOT_MARGIN_BITS, ShownWord,
};
use super::wire::dp::Configuration;
use super::wire::telegram::{DU_MAX, STATION_MAX};
use fieldbeat_core::axis::{Faults, PlanFault};
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
    /// The mistakes of the wire itself.
    pub(super) fn own_faults(&self) -> Vec<PlanFault> {
        let mut faults = Vec::new();
        let why = "must be a serial port, like \"/dev/ttyS1\", or \"local:NAME\"";
        faults.wrong_if(self.device.is_empty(), "device", why);
        let place = RATES.iter().position(|rate| *rate == self.rate);
        faults.wrong_if(place.is_none(), "rate", format_args!("must be {} bit/s", rates()));
        let why = format!("must be 0 ... {ADDRESS_MAX}, the address of this master");
        faults.wrong_if(self.address > ADDRESS_MAX, "address", why);
        let bits = &self.bits;
        let (least, answered) =
            (place.map_or(0, |place| LEAST_SLOT_BITS[place]), bits.max_tsdr.saturating_add(SLOT_MARGIN_BITS));
        let from = least.max(answered.saturating_add(1));
        let why = format!(
            "must be {from} ... {BITS_MAX}: above bits.max_tsdr + {SLOT_MARGIN_BITS}, and at least {least} at this \
             rate"
        );
        let wrong = bits.slot <= answered || bits.slot < least || bits.slot > BITS_MAX;
        faults.wrong_if(wrong, "bits.slot", why);
        for (key, value, from) in [
            ("bits.max_tsdr", bits.max_tsdr, u32::from(TSDR_MIN)),
            ("bits.sync", bits.sync, SYNC_BITS),
            ("bits.idle", bits.idle, SYNC_BITS),
            ("bits.idle_unanswered", bits.idle_unanswered, SYNC_BITS),
        ] {
            let wrong = !(from..=BITS_MAX).contains(&value);
            faults.wrong_if(wrong, key, format_args!("must be {from} ... {BITS_MAX} bits"));
        }
        let why = format!("must be at most {}", Ns(LATENCY_MAX_NS));
        faults.wrong_if(bits.latency_ns > LATENCY_MAX_NS, "latency", why);
        let why = format!("must be at most {RETRIES_MAX}");
        faults.wrong_if(self.retries > RETRIES_MAX, "retries", why);
        let wrong = self.gap.is_some_and(|rounds| !(1..=GAP_MAX).contains(&rounds));
        faults.wrong_if(wrong, "gap", format_args!("must be 1 ... {GAP_MAX} rounds, or \"off\""));
        let wrong = self.highest_address > STATION_MAX || self.highest_address <= self.address;
        let why = format!("must be above the master's own address, up to {STATION_MAX}");
        faults.wrong_if(wrong, "highest_address", why);
        let (least, most) = (Ns(*CONTROL_RANGE_NS.start()), Ns(*CONTROL_RANGE_NS.end()));
        let wrong = !CONTROL_RANGE_NS.contains(&self.global_control_ns);
        faults.wrong_if(wrong, "global_control", format_args!("must be {least} ... {most}"));
        faults
    }

    /// The contradictions between the wire and the plan of one of its drives.
    pub(super) fn drive_faults(&self, drive: &LenzeDrive) -> Vec<PlanFault> {
        let (mut faults, max_tsdr) = (drive.faults(), self.bits.max_tsdr);
        let why = "is the master's own address; give the one that is set at the module";
        faults.wrong_if(drive.address == self.address, "address", why);
        let why = format!("must be below bits.max_tsdr = {max_tsdr}, by which it has to answer");
        faults.wrong_if(u32::from(drive.min_tsdr) >= max_tsdr, "min_tsdr", why);
        faults
    }
}

impl LenzeDrive {
    /// The contradictions, and settings that would not work; those of every axis, and those that depend on the wire,
    /// left out.
    pub fn faults(&self) -> Vec<PlanFault> {
        let mut faults = Vec::new();
        let why = format!("must be 0 ... {ADDRESS_MAX}");
        faults.wrong_if(self.address > ADDRESS_MAX, "address", why);
        self.start_up_faults(&mut faults);
        self.data_faults(&mut faults);
        faults.extend(self.watchdog_fault());
        faults.extend(self.parameter_fault());
        faults.extend(self.axis.position_faults());
        faults.extend(self.axis.torque_fault("the drive takes speeds, no torques"));
        let coasts = "a drive whose outputs fail, by its watchdog too, may coast";
        faults.extend(self.axis.dropped_fault(coasts));
        self.speed_faults(&mut faults);
        faults
    }

    fn start_up_faults(&self, faults: &mut Vec<PlanFault>) {
        let why = format!("must be at most {USER_PRM_MAX} bytes: Set_Prm has 7 before them");
        faults.wrong_if(self.user_prm.len() > USER_PRM_MAX, "user_prm", why);
        let why = format!("must be {TSDR_MIN} ... 255 bits, or 0: the drive keeps its own");
        faults.wrong_if((1..TSDR_MIN).contains(&self.min_tsdr), "min_tsdr", why);
        let why = format!("must be at most {}", Ns(INTERVAL_MAX_NS));
        faults.wrong_if(self.min_slave_interval_ns > INTERVAL_MAX_NS, "min_slave_interval", why);
        let most = DU_MAX - 8;
        let wrong = usize::from(self.extended_diagnosis) > most;
        faults.wrong_if(wrong, "extended_diagnosis", format_args!("must be at most {most} bytes"));
        let wrong = self.enable_bit.is_some_and(|bit| bit.bit > 15);
        faults.wrong_if(wrong, "enable_bit", "must be a bit of the status word, 0 ... 15");
    }

    /// Identifier bytes, and the words in what they make.
    fn data_faults(&self, faults: &mut Vec<PlanFault>) {
        if self.configuration.len() > DATA_MAX {
            return faults.wrong("configuration", format_args!("must be at most {DATA_MAX} bytes"));
        }
        let Some((inputs, outputs)) = Configuration(&self.configuration).sizes() else {
            let why =
                "is no list of identifier bytes: its last module lacks bytes; look at the GSD of the module";
            return faults.wrong("configuration", why);
        };
        let made = format!("gives {outputs} bytes of outputs and {inputs} of inputs");
        if inputs > DATA_MAX || outputs > DATA_MAX {
            let why = format!("{made}; a telegram has {DATA_MAX} at most");
            return faults.wrong("configuration", why);
        }
        // Control word and set point are two words.
        let least = self.process_at() + 4;
        if outputs < least || inputs < least {
            let with = if self.channel { format!("a channel of {CHANNEL} bytes, ") } else { String::new() };
            let why = format!(
                "{made}; {with}control word and set point, status word and actual value need {least} each: 0xF3, 0xF1 \
                 are a channel and two words"
            );
            return faults.wrong("configuration", why);
        }
        let words = |bytes: usize| (bytes - self.process_at()) / 2;
        let (outputs, inputs) = (words(outputs), words(inputs));
        for (key, word, words, of, zero) in [
            ("set_point_word", self.scale.set_point, outputs, "outputs", "control"),
            ("actual_word", self.scale.actual, inputs, "inputs", "status"),
        ] {
            let last = words - 1;
            let why = format!("must be a word of the {of}, 1 ... {last}; word 0 is the {zero} word");
            faults.wrong_if(!(1..words).contains(&usize::from(word)), key, why);
        }
        let most = outputs.saturating_sub(2);
        let why = format!("must be at most {most} words: so many outputs has the configuration besides");
        faults.wrong_if(self.further.len() > most, "further", why);
        for (index, ShownWord { name, word, per_count, .. }) in self.show.iter().flatten().enumerate() {
            if usize::from(*word) >= inputs {
                let last = inputs - 1;
                faults.wrong("monitor", format_args!("word {word} is none of the inputs, 0 ... {last}"));
            } else if !(*per_count != 0.0 && per_count.is_finite()) {
                faults.wrong("monitor", "per_count must be a finite number other than 0");
            } else if self.show.iter().flatten().take(index).any(|other| other.name == *name) {
                faults.wrong("monitor", format_args!("{name} is there twice; each has its own name"));
            }
        }
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

    /// A set point is a count of 16 bits.
    fn speed_faults(&self, faults: &mut Vec<PlanFault>) {
        let (full_count, full_rpm) = (self.scale.full_count, self.scale.full_rpm);
        let why = "must be 1 ... 32767, the count of the full speed; 16384 is 0x4000";
        faults.wrong_if(full_count <= 0, "full_count", why);
        let positive = full_rpm > 0.0 && full_rpm.is_finite();
        faults.wrong_if(!positive, "full_rpm", "must be above 0: the full speed, as C0011 has it");
        let scale = self.counts_per_velocity().abs();
        if !(full_count > 0 && positive && scale > 0.0 && scale.is_finite()) {
            return; // Reported for every axis, or above.
        }
        let (unit, most) = (self.axis.units.unit, COUNT_MAX / scale);
        for (key, value) in self.axis.velocities() {
            let why = format!(
                "{value} {unit}/s are more than a set point of 16 bits holds, {most:.4} {unit}/s; change it, or check \
                 scale, full_count and full_rpm"
            );
            faults.wrong_if(value * scale > COUNT_MAX, key, why);
        }
        let why = format!("missing; a set point of 16 bits needs one, up to {most:.4} {unit}/s");
        faults.wrong_if(self.axis.limits.velocity.is_none(), "limits.velocity", why);
    }
}
