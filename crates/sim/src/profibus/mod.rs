//! The simulated Lenze drives with PROFIBUS module EMF2133IB: slaves of DP-V0 and DP-V1 on one wire, and strict.
//!
//! Knows the fact sheet, not the master's line; its byte code is its own.
//!
//! | file | what |
//! |---|---|
//! | `settings`, `config` | the properties of a wire and of its drives; their keys |
//! | `telegram`, `receiver` | telegrams as bytes; the silence before them and inside |
//! | `link` | which requests are answered, when, and which from memory |
//! | `misuse` | what a master did that it must not |
//! | `slave`, `prm` | states, diagnosis, watchdog; Set_Prm and Chk_Cfg as bytes |
//! | `channel` | the parameter channel: PKW and DRIVECOM |
//! | `acyclic`, `request` | MSAC1; parameter requests |
//! | `codes` | the parameters |
//! | `drive` | control word and status word, ramp, motor, faults |
//! | `others` | a second master, noise |
//!
//! Where the sheet is silent it takes the strict side, or has a setting; `slave`, `drive`, `channel`, `acyclic` and
//! `request` name their choices. What a master meets first:
//!
//! | case | what the drive does |
//! |---|---|
//! | a request without 33 bits of silence before it | is ignored |
//! | outputs before Global_Control with Operate | do not count |
//! | a retry | is answered from memory; its data are ignored |
//! | its watchdog expires | outputs are zero: the drive coasts; it waits for parameters |
//! | a parameter write | goes to the EEPROM as long as C0003 is 1 |

mod acyclic;
mod channel;
mod codes;
pub(super) mod config;
mod drive;
mod link;
mod misuse;
mod others;
mod prm;
mod receiver;
mod request;
mod settings;
mod slave;
mod telegram;

pub use self::misuse::Misuse;
pub use self::others::{ForeignMaster, Noise};
pub use self::receiver::Broken;
pub use self::settings::{
    AcyclicSettings, Channel, DpSettings, ForeignSettings, InputWord, LenzeMotorSettings, LenzeSettings,
    LinkSettings, NoiseSettings, OutputWord, PowerSettings, ProfibusSegment, Safe, UserPrm,
};
pub use self::slave::{DpState, Events};

use self::link::Link;
use self::receiver::Receiver;
use self::slave::Slave;
use crate::{SerialWire, SimBus, SimSerial, Simulated, Truth};
use fieldbeat_core::axis::{PlanFault, State};
use fieldbeat_core::net::SerialLine;
use fieldbeat_core::time::Time;
use fieldbeat_profibus::{LenzeDrive, ParameterPath, ProfibusPlan};

impl ProfibusSegment {
    /// Drives with default settings for each of the bus.
    pub fn of(plan: &ProfibusPlan) -> ProfibusSegment {
        let of = |drive| LenzeSettings { last_master: plan.address, ..LenzeSettings::of(drive) };
        let drives = plan.drives.iter().map(of).collect();
        let segment = ProfibusSegment::new(plan.device.clone(), plan.rate, drives);
        ProfibusSegment { echo: plan.echo, ..segment }
    }

    /// The wire with its drives, in their order, and behind them the second master and the noise.
    pub fn wire(&self) -> SerialWire {
        let line = self.line();
        let drives =
            self.drives.iter().map(|drive| Box::new(LenzeSim::new(drive, line)) as Box<dyn SimSerial>);
        let foreign = |of| Box::new(ForeignMaster::new(of, line)) as Box<dyn SimSerial>;
        let foreign = self.foreign.clone().map(foreign);
        let noise = self.noise.map(|of| Box::new(Noise::new(of)) as Box<dyn SimSerial>);
        SerialWire {
            port: self.port.clone(),
            own_port: self.own_port.clone(),
            line,
            echo: self.echo,
            faults: self.faults.clone(),
            drives: drives.chain(foreign).chain(noise).collect(),
        }
    }
}

impl SimBus for ProfibusSegment {
    fn faults(&self) -> Vec<(Option<String>, PlanFault)> {
        let mut faults = Vec::new();
        for drive in &self.drives {
            let channel = if drive.channel == Channel::None { 0 } else { 8 };
            let (outputs, inputs) = (channel + 2 * drive.outputs.len(), channel + 2 * drive.inputs.len());
            // A last byte may be no word: it means nothing, and is 0.
            let fits = |size: usize, words: usize| size >= words && size - words < 2;
            let sizes = prm::sizes(&drive.configuration);
            if !sizes.is_some_and(|sizes| fits(sizes.0, outputs) && fits(sizes.1, inputs)) {
                let message = format!(
                    "the configuration of the drive at address {} is not that of {outputs} bytes of outputs \
                     and {inputs} of inputs: correct one of them",
                    drive.address
                );
                faults.push((None, PlanFault::new("simulate", message)));
            }
        }
        faults
    }

    fn build(&self, to: &mut Simulated) {
        to.wires.push(self.wire());
    }
}

impl LenzeSettings {
    /// A drive with default settings as `drive` expects it: address, ident number, configuration, process data,
    /// channel, profile and scale.
    pub fn of(drive: &LenzeDrive) -> LenzeSettings {
        let mut settings = LenzeSettings::new(drive.address);
        settings.ident = drive.ident;
        settings.configuration = drive.configuration.clone();
        settings.channel = match (drive.channel, drive.parameters) {
            (false, _) => Channel::None,
            (true, ParameterPath::Pkw { .. }) => Channel::Pkw,
            (true, _) => Channel::Drivecom,
        };
        if let ParameterPath::Msac1 { slot, index, numbers, .. } = drive.parameters {
            (settings.acyclic.slot, settings.acyclic.index, settings.acyclic.numbers) =
                (slot, index, numbers);
        }
        let (outputs, inputs) = prm::sizes(&drive.configuration).unwrap_or_default();
        let words = |bytes: usize| bytes.saturating_sub(drive.process_at()) / 2;
        settings.outputs = (0..words(outputs))
            .map(|place| match place {
                0 => OutputWord::Control,
                _ if place == usize::from(drive.scale.set_point) => OutputWord::SetPoint,
                _ => OutputWord::Further,
            })
            .collect();
        settings.inputs = (0..words(inputs))
            .map(|place| match place {
                0 => InputWord::Status,
                _ if place == usize::from(drive.scale.actual) => InputWord::Speed,
                _ => InputWord::Torque,
            })
            .collect();
        settings.power.profile = drive.profile;
        settings.power.ramp_bits = drive.ramp_bits;
        settings.power.enable_bit = drive.enable_bit.map(|bit| (bit.bit, bit.set));
        settings.motor.full_count = drive.scale.full_count;
        settings.motor.full_rpm = drive.scale.full_rpm;
        settings
    }
}

/// One simulated drive with its module.
#[derive(Debug)]
pub struct LenzeSim {
    line: SerialLine,
    receiver: Receiver,
    link: Link,
    slave: Slave,
    boot_ns: u64,
    /// Does not receive until then.
    booted_at: Time,
}

impl LenzeSim {
    /// The drive as set up, on a wire of this kind, receiving. Its time begins with the first byte.
    pub fn new(settings: &LenzeSettings, line: SerialLine) -> LenzeSim {
        LenzeSim {
            line,
            receiver: Receiver::new(line),
            link: Link::new(settings.address, line, settings.link.sd3),
            slave: Slave::new(settings, line),
            boot_ns: settings.boot_ns,
            booted_at: Time(0),
        }
    }

    /// Raises a fault with this code.
    pub fn provoke(&mut self, fault: u16) {
        self.slave.drive.fail(fault);
    }

    /// Shows the bit "warning" in its status word, or does not.
    pub fn warn(&mut self, warning: bool) {
        self.slave.drive.warning = warning;
    }

    /// It has no valid data for a while (Stat_Diag), or has again.
    pub fn set_static_diagnosis(&mut self, set: bool) {
        self.slave.static_diagnosis = set;
    }

    /// Answers the next `count` requests with this function code and nothing else: 1 user error, 2 no resource, 3
    /// service not active.
    pub fn refuse(&mut self, count: u32, function: u8) {
        self.slave.refuse = (count, function & 0x0F);
    }

    /// What its master did that it must not.
    pub fn misuse(&self) -> Misuse {
        self.link.misuse
    }

    /// Telegrams that it did not take.
    pub fn broken(&self) -> Broken {
        self.receiver.broken
    }

    /// Requests that it answered from memory.
    pub fn repeated(&self) -> u64 {
        self.link.repeated
    }

    /// What it did how often.
    pub fn events(&self) -> Events {
        self.slave.events
    }

    /// Its state on the bus, and the address of its master.
    pub fn dp_state(&self) -> (DpState, Option<u8>) {
        (self.slave.state(), self.slave.master())
    }

    /// The state of its power stage.
    pub fn axis_state(&self) -> State {
        self.slave.drive.state()
    }

    /// Writes of parameters that went to the EEPROM.
    pub fn eeprom_writes(&self) -> u64 {
        self.slave.drive.codes.eeprom_writes
    }

    /// The value of a code, in counts; 0 if there is none. This counts as no telegram.
    pub fn parameter(&self, code: u16, subcode: u16) -> i32 {
        self.slave.drive.codes.get(code, subcode)
    }

    /// Its true state at `now`; its counts are revolutions. This counts as no telegram.
    pub fn truth(&mut self, now: Time) -> Truth {
        self.slave.advance(now);
        self.slave.drive.truth()
    }
}

impl SimSerial for LenzeSim {
    fn receive(&mut self, now: Time, bytes: &[u8]) {
        self.slave.advance(now);
        if now - self.line.span_ns(bytes.len()) < self.booted_at {
            return;
        }
        self.link.overlap(now, bytes.len());
        let LenzeSim { receiver, link, slave, .. } = self;
        receiver.take(now, bytes, |end, silence, bytes| link.telegram(end, silence, bytes, slave));
    }

    fn next_due(&self) -> Option<Time> {
        self.link.next_due()
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) {
        if let Some(end) = self.link.send(now, out) {
            self.receiver.sent(end);
        }
    }

    fn untimed(&mut self) {
        self.receiver.untimed();
        self.link.untimed();
    }

    fn mislabel(&self, telegram: &mut [u8]) {
        telegram::change_source(telegram);
    }

    fn restart(&mut self, now: Time) {
        self.slave.advance(now);
        self.slave.restart();
        self.link.restart();
        self.receiver.restart();
        self.booted_at = now + self.boot_ns;
    }

    fn open_sto(&mut self, until: Time) {
        self.slave.drive.open_sto(until);
    }
}

#[cfg(test)]
mod tests;
