//! What the slaves of a segment are: the drives, and devices in front of them. The segments that have all clauses are
//! here, those that have one oddity each in `rows`.

use fieldbeat::bus::ethercat::{Area, Device, KollmorgenDrive, SlavePlan, Watchdog};
use fieldbeat::time::{MS, US};
use fieldbeat_sim::ethercat::{
    Behind, ClockKind, Coupler, DriveSettings, EthercatSegment, MailboxSettings, Model, SiiSettings,
    SlaveSettings,
};

use crate::conformance::subject::SOON;

/// The slaves of a segment.
#[derive(Clone, Copy)]
pub struct Slaves {
    /// Empty: there is nothing to them.
    pub name: &'static str,
    /// Devices in front of the drives.
    pub front: &'static [Front],
    /// What sets each drive apart.
    pub fit: fn(&mut Fitted<'_>),
    /// A read of an SII returns eight bytes.
    pub eight: bool,
    /// Cycles in which a call has ended.
    pub soon: u64,
    /// A drive that is found running is set up anew, since its watchdog is not that of its plan.
    pub rearmed: bool,
}

/// A device in front of the drives.
#[derive(Clone, Copy)]
pub struct Front {
    pub name: &'static str,
    pub model: Option<Model>,
    pub emulated: bool,
    pub outputs: &'static [Area],
    pub inputs: &'static [Area],
    /// What else sets it apart.
    pub fit: fn(&mut SlaveSettings),
}

/// A drive: its plan, its slave, and its firmware.
pub struct Fitted<'a> {
    pub plan: &'a mut KollmorgenDrive,
    pub slave: &'a mut SlaveSettings,
    pub drive: &'a mut DriveSettings,
    /// It is the last one of the segment.
    pub last: bool,
    /// It is found running.
    pub running: bool,
}

/// The control byte of outputs without a watchdog, as a real AKD has it; and with one.
pub const UNWATCHED: u8 = 0x24;
pub const WATCHED: u8 = 0x64;
/// The time of a drive for an answer, as its description would give it: a lost one costs as much.
const SDO_TIMEOUT: u64 = 100 * MS;

pub const fn area(start: u16, length: u16) -> Area {
    Area { start, length }
}

/// Drives alone.
pub const PLAIN: Slaves =
    Slaves { name: "", front: &[], fit: |_| {}, eight: false, soon: SOON, rearmed: true };

/// Slaves that compare, hold back, and answer late or not at all: what real ones do one by one, all at once.
pub const STRICT: Slaves = Slaves {
    name: "ethercat with strict slaves",
    front: &[Front { emulated: true, ..COUPLER }],
    fit: |of| {
        of.exact_managers(UNWATCHED);
        of.owned_sii();
        of.two_fmmus();
        of.branch();
        of.slave.clock = Some(ClockKind::Short);
        of.slow_sii(200 * US, 5 * MS);
        of.slave.sii.slips = true;
        of.mailbox(MailboxSettings { delay_ns: 3 * MS, delay_every: 3, lose_every: 11, resends: false });
    },
    eight: true,
    soon: 200,
    rearmed: false,
};

/// Small terminals as they can be bought, one of them with two SyncManagers a direction, without clocks and receive
/// times; and drives whose mailboxes are slow, and send again what was lost.
pub const TERMINALS: Slaves = Slaves {
    name: "ethercat with terminals",
    front: &[
        Front { name: "coupler", ..terminal(Model::Ek1100, &[], &[]) },
        Front { name: "in", ..terminal(Model::El1002, &[], &[area(0x1000, 1)]) },
        Front { name: "four", ..terminal(Model::El2004, &[area(0x0F00, 1)], &[]) },
        Front { name: "sixteen", ..terminal(Model::El2809, &[area(0x0F00, 1), area(0x0F01, 1)], &[]) },
    ],
    fit: |of| {
        slow(&mut of.slave.sii);
        of.mailbox(MailboxSettings { delay_ns: 3 * MS, delay_every: 3, lose_every: 11, resends: true });
    },
    soon: 250,
    ..PLAIN
};

pub const IO: Front =
    Front { name: "io", model: None, emulated: false, outputs: &[], inputs: &[], fit: |_| {} };
pub const COUPLER: Front = Front { name: "coupler", model: Some(Model::Ek1100), ..IO };

const fn terminal(model: Model, outputs: &'static [Area], inputs: &'static [Area]) -> Front {
    let fit = |slave: &mut SlaveSettings| {
        slave.clock = Some(ClockKind::None);
        slow(&mut slave.sii);
    };
    Front { model: Some(model), emulated: true, outputs, inputs, fit, ..IO }
}

/// Slow, and at first from another address.
fn slow(sii: &mut SiiSettings) {
    (sii.busy_ns, sii.loading_ns, sii.slips) = (500 * US, 20 * MS, true);
}

fn bytes<'a>(areas: impl Iterator<Item = &'a Area>) -> usize {
    areas.map(|area| usize::from(area.length)).sum()
}

impl Slaves {
    /// Bytes of the outputs in front of the drives.
    pub fn outputs(&self) -> usize {
        bytes(self.front.iter().flat_map(|device| device.outputs))
    }

    /// The same of the inputs, without AL status.
    pub fn inputs(&self) -> usize {
        bytes(self.front.iter().flat_map(|device| device.inputs))
    }

    /// A slave that is like all others here.
    pub fn usual(&self) -> SlaveSettings {
        let sii = SiiSettings { eight: self.eight, ..SiiSettings::default() };
        SlaveSettings { sii, ..SlaveSettings::default() }
    }

    /// Adds the devices in front of the drives.
    pub fn add_front(&self, segment: &mut EthercatSegment) {
        for (place, front) in (0..).zip(self.front) {
            let (outputs, inputs) = (front.outputs.to_vec(), front.inputs.to_vec());
            let device = Device {
                name: front.name.into(),
                slave: SlavePlan { outputs, inputs, ..SlavePlan::new(place) },
            };
            segment.devices.push(Coupler::of(&device));
            segment.plan.devices.push(device);
            let mut own =
                SlaveSettings { model: front.model, emulated: Some(front.emulated), ..self.usual() };
            (front.fit)(&mut own);
            segment.settings.slaves.insert(place, own);
        }
    }
}

impl Fitted<'_> {
    /// It compares its SyncManagers with its SII, where its outputs have this control byte: the plan leaves that.
    pub fn exact_managers(&mut self, control: u8) {
        (self.slave.exact_managers, self.slave.output_control) = (true, Some(control));
        self.watchdog_of_its_sii();
    }

    pub fn watchdog_of_its_sii(&mut self) {
        (self.plan.slave.watchdog, self.plan.accept_no_watchdog) = (Watchdog::AsDelivered, true);
    }

    /// Its processor has the SII, and reads it on the way to PREOP.
    pub fn owned_sii(&mut self) {
        (self.slave.sii.owned_by_slave, self.slave.sii.read_in_preop) = (true, true);
    }

    pub fn slow_sii(&mut self, busy_ns: u64, loading_ns: u64) {
        (self.slave.sii.busy_ns, self.slave.sii.loading_ns) = (busy_ns, loading_ns);
    }

    /// It has none for its AL status; without that a running drive is not joined.
    pub fn two_fmmus(&mut self) {
        self.slave.fmmus = Some(if self.running { 3 } else { 2 });
    }

    /// The last one is behind a port of its own of the first device.
    pub fn branch(&mut self) {
        self.slave.behind = self.last.then_some(Behind { place: 0, port: 2 });
    }

    /// Its mailbox answers like this; its plan has the time for an answer.
    pub fn mailbox(&mut self, mailbox: MailboxSettings) {
        (self.slave.mailbox, self.plan.slave.sdo_timeout_ns) = (mailbox, SDO_TIMEOUT);
    }
}
