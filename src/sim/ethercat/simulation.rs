//! The segment of a plan, simulated: its slaves, and the content of their EEPROMs.

use super::coupler::Terminals;
use super::sii::{Access, Contents, Mailboxes, Pdo};
use super::{Coupler, Drive, DriveSettings, Esc, Segment, SegmentSettings, Settings};
use crate::axis::PlanFault;
use crate::bus::ethercat::object::Family;
use crate::bus::ethercat::object::pdo::Layout;
use crate::bus::ethercat::wire::frame::ETHERTYPE;
use crate::bus::ethercat::wire::registers::{Features, Fmmu, SyncManager};
use crate::bus::ethercat::wire::sii::{Identity, Use};
use crate::bus::ethercat::{
    Area, Device, EthercatPlan, Expected, KollmorgenDrive, Mapping, Owner, SlavePlan, is_interface,
};
use crate::sim::{FaultPlan, SimBus, SimSegment, Simulated};
use crate::time::{MS, Time, US};

/// The Ethertype of a frame, and the index of its first datagram.
const TYPE: std::ops::Range<usize> = 12..14;
const INDEX: usize = 17;
/// Its data, after its header.
const DATA: usize = 26;
/// The delay until the firmware reads the mailbox and AL control: one interrupt of a drive (EtherCAT manual).
const REACTION_NS: u64 = 250 * US;
/// The time of an EEPROM command (assumed).
const SII_NS: u64 = 100 * US;
/// The clocks of neighbouring slaves were switched on so far apart.
const CLOCKS_APART_NS: u64 = 617 * MS + 1_234;
/// CoE, in the protocols of the SII.
const COE: u16 = 1 << 2;
/// The use of the FMMUs: outputs, inputs, the state of the mailbox.
const FMMUS: [u8; 3] = [1, 2, 3];
/// The name of every slave that is not a drive.
const IO: &str = "I/O";
/// Where another master had the outputs of the first slave in the logical address space: our own may be there too.
const LOGICAL: u32 = 0x0001_0000;
/// The slave at each position that the plan leaves out: a coupler (Beckhoff EK1100) without terminals.
const PLAIN: Identity = Identity { vendor: 2, product: 0x044C_2C52, revision: 0x0011_0000 };

/// The simulated segment of a bus: slaves that fit its plan, as these settings say.
#[derive(Clone, Debug)]
pub struct EthercatSegment {
    /// The plan of the bus.
    pub plan: EthercatPlan,
    /// The segment as a whole.
    pub settings: SegmentSettings,
    /// The drives, in the order of the plan.
    pub drives: Vec<DriveSettings>,
    /// The terminals of the devices, in the order of the plan.
    pub devices: Vec<Coupler>,
}

impl From<EthercatPlan> for EthercatSegment {
    /// Slaves with default settings.
    fn from(plan: EthercatPlan) -> EthercatSegment {
        EthercatSegment {
            settings: SegmentSettings::default(),
            drives: plan.drives.iter().map(|drive| DriveSettings::new(drive.family)).collect(),
            devices: plan.devices.iter().map(Coupler::of).collect(),
            plan,
        }
    }
}

impl From<&EthercatPlan> for EthercatSegment {
    fn from(plan: &EthercatPlan) -> EthercatSegment {
        plan.clone().into()
    }
}

impl SimBus for EthercatSegment {
    fn faults(&self) -> Vec<(Option<String>, PlanFault)> {
        let wire = self.interface_fault().map(|why| (None, PlanFault::new("simulate.interface", why)));
        let devices = self.plan.devices.iter().zip(&self.devices);
        wire.into_iter().chain(devices.flat_map(|(device, coupler)| coupler.faults(device))).collect()
    }

    fn build(&self, to: &mut Simulated) {
        to.segments.push(Box::new(EthercatSim::new(self)));
    }
}

impl EthercatSegment {
    fn interface_fault(&self) -> Option<&'static str> {
        let far = self.settings.interface.as_deref()?;
        if self.plan.is_local() {
            Some("needs a real interface; simulated drives on this computer have none, leave it out")
        } else if far == self.plan.interface {
            Some("is the master's own interface; name the one at the other end of the cable")
        } else {
            (!is_interface(far)).then_some("must be a network interface, like \"eth2\"")
        }
    }
}

impl Coupler {
    /// Terminals for the process data of a device.
    pub fn of(device: &Device) -> Coupler {
        Coupler { outputs: terminals(device.slave.outputs), inputs: terminals(device.slave.inputs) }
    }

    /// What does not fit the process data of `device`.
    fn faults(self, device: &Device) -> impl Iterator<Item = (Option<String>, PlanFault)> {
        let sides = [
            ("simulate.outputs", self.outputs, device.slave.outputs),
            ("simulate.inputs", self.inputs, device.slave.inputs),
        ];
        let wrong = sides.into_iter().filter(|(_, there, area)| there.bytes() != usize::from(area.length));
        wrong.map(|(key, there, area)| {
            let Terminals { digital, analogue } = there;
            let why = format!(
                "digital = {digital} and analogue = {analogue} are {} bytes, and the device has {}; make them equal",
                there.bytes(),
                area.length
            );
            (Some(device.name.clone()), PlanFault::new(key, why))
        })
    }
}

/// A simulated segment.
///
/// A position between two slaves that the plan leaves out has a coupler without terminals, a mailbox or a clock.
#[derive(Debug)]
pub struct EthercatSim {
    segment: Segment,
    interface: String,
    settings: SegmentSettings,
}

impl EthercatSim {
    /// Slaves that fit a plan, with default settings, just switched on.
    pub fn of(plan: &EthercatPlan) -> EthercatSim {
        EthercatSim::new(&plan.into())
    }

    /// As set up, just switched on.
    pub fn new(segment: &EthercatSegment) -> EthercatSim {
        let (plan, settings) = (&segment.plan, segment.settings.clone());
        let (mut slaves, mut logical) = (Vec::new(), LOGICAL);
        for (owner, slave) in plan.slaves() {
            while slaves.len() < slave.place.into() {
                let coupler = Coupler::default();
                slaves.push(coupler.slave(IO, PLAIN, hardware(&settings, slaves.len(), false)));
            }
            let hardware = hardware(&settings, slaves.len(), slave.sync);
            slaves.push(match owner {
                Owner::Drive(index) => drive(&plan.drives[index], &segment.drives[index], hardware, logical),
                Owner::Device(index) => device(&plan.devices[index], segment.devices[index], hardware),
            });
            logical += u32::from(slave.outputs.length);
        }
        EthercatSim { segment: Segment::new(slaves), interface: plan.interface.clone(), settings }
    }

    /// The segment itself.
    pub fn segment(&mut self) -> &mut Segment {
        &mut self.segment
    }

    /// The slave at `place`, counted from 0 at the master.
    pub fn slave(&mut self, place: usize) -> Option<&mut Esc> {
        self.segment.slave(place)
    }

    /// The drive at `place`.
    pub fn drive(&mut self, place: usize) -> Option<&mut Drive> {
        self.segment.slave(place).and_then(Esc::drive)
    }
}

impl SimSegment for EthercatSim {
    fn interface(&self) -> &str {
        &self.interface
    }

    fn own_interface(&self) -> Option<&str> {
        self.settings.interface.as_deref()
    }

    fn ethertype(&self) -> u16 {
        ETHERTYPE
    }

    fn faults(&self) -> FaultPlan {
        self.settings.faults.clone()
    }

    fn slaves(&self) -> usize {
        self.segment.slaves()
    }

    fn delay_ns(&self) -> u64 {
        self.segment.delay_ns()
    }

    /// A slave forwards EtherCAT only, as delivered.
    fn pass(&mut self, now: Time, frame: &mut [u8]) -> bool {
        self.segment.pass(now, frame);
        frame.get(TYPE) == Some(&ETHERTYPE.to_be_bytes()) && self.segment.is_reached()
    }

    fn mislabel(&self, frame: &mut [u8]) {
        // A number far from those in use. Its sender stays: another sender is another master.
        for at in [INDEX, DATA + 6] {
            if let Some(byte) = frame.get_mut(at) {
                *byte ^= 0x80;
            }
        }
    }

    fn advance(&mut self, now: Time) {
        self.segment.advance(now);
    }

    fn cut(&mut self, place: Option<usize>) {
        self.segment.cut(place);
    }

    fn deafen(&mut self, place: usize, deaf: bool) {
        if let Some(slave) = self.segment.slave(place) {
            slave.deafen(deaf);
        }
    }

    fn restart(&mut self, now: Time, place: usize) {
        if let Some(slave) = self.segment.slave(place) {
            slave.restart(now);
        }
    }

    fn inhibit(&mut self, place: usize, until: Time) {
        if let Some(drive) = self.drive(place) {
            drive.inhibit(until);
        }
    }
}

/// The controller of the slave at `place`.
fn hardware(segment: &SegmentSettings, place: usize, clock: bool) -> Settings {
    let features = match (clock, segment.short_clocks) {
        (false, _) => 0x0180,
        (true, true) => 0x0184,
        (true, false) => 0x018C,
    };
    let drift_ppm = segment.drift_ppm.get(place).or(segment.drift_ppm.last()).copied().unwrap_or(0.0);
    let usual = Settings::default();
    Settings {
        features: Features(features),
        fmmus: segment.fmmus.get(place).or(segment.fmmus.last()).copied().unwrap_or(usual.fmmus),
        device_id: segment.device_ids.then_some(place as u16),
        sii_access: Access { busy_ns: SII_NS, ..Access::default() },
        clock_ns: (place as u64 + 1) * CLOCKS_APART_NS,
        drift_ppm,
        settling: segment.settling,
        reaction_ns: REACTION_NS,
        delay_ns: segment.delay_ns,
        ..usual
    }
}

fn drive(plan: &KollmorgenDrive, settings: &DriveSettings, hardware: Settings, logical: u32) -> Esc {
    let settings = drive_settings(plan, settings.clone());
    let contents = Contents {
        name: match settings.family {
            Family::S700 => "S700",
            Family::Akd => "AKD",
        },
        identity: settings.identity,
        serial: settings.serial,
        mailboxes: plan.slave.mailbox.map(mailboxes),
        fmmus: FMMUS.to_vec(),
        managers: managers(&plan.slave),
        inputs: vec![pdo(&plan.inputs, 3)],
        outputs: vec![pdo(&plan.outputs, 2)],
        ..Contents::default()
    };
    let is_running = settings.running_rpm.is_some();
    let mut esc = Esc::new(Settings { sii: contents.image(), ..hardware }, Box::new(Drive::new(settings)));
    if is_running {
        let managers: Vec<_> =
            managers(&plan.slave).into_iter().map(|(manager, _)| manager.unwatched()).collect();
        let Area { start, length } = plan.slave.outputs;
        esc.run(&managers, Fmmu::bytes(logical, length, start, true));
    }
    esc
}

/// A drive that fits its plan: with the PDOs that are not mapped first, and, unless it was set otherwise, with the
/// identity of the plan.
fn drive_settings(plan: &KollmorgenDrive, mut settings: DriveSettings) -> DriveSettings {
    if settings.identity == DriveSettings::new(settings.family).identity {
        settings.identity = expected(plan.slave.identity, settings.identity);
    }
    if let Some([_, input]) = plan.slave.mailbox {
        settings.long_sdos = settings.long_sdos.map(|_| input.length);
    }
    if plan.mapping != Mapping::Free {
        for layout in [&plan.outputs, &plan.inputs] {
            settings.layouts.retain(|own| own.pdo != layout.pdo);
            settings.layouts.push(layout.clone());
        }
    }
    if plan.mapping == Mapping::AsIs || settings.running_rpm.is_some() {
        settings.selected = (plan.outputs.pdo, plan.inputs.pdo);
    }
    settings
}

fn device(plan: &Device, coupler: Coupler, hardware: Settings) -> Esc {
    let slave = &plan.slave;
    let mut contents = coupler.contents(IO, expected(slave.identity, PLAIN));
    contents.managers = managers(slave);
    contents.mailboxes = slave.mailbox.map(mailboxes);
    if slave.mailbox.is_some() {
        // Theirs are the first two.
        contents.inputs.iter_mut().chain(&mut contents.outputs).for_each(|pdo| pdo.manager += 2);
    }
    Esc::new(Settings { sii: contents.image(), ..hardware }, Box::new(coupler))
}

/// The expected numbers, and those of `other` where none is expected.
fn expected(expected: Expected, other: Identity) -> Identity {
    Identity {
        vendor: expected.vendor.unwrap_or(other.vendor),
        product: expected.product.unwrap_or(other.product),
        revision: expected.revision.unwrap_or(other.revision),
    }
}

fn mailboxes([out, input]: [Area; 2]) -> Mailboxes {
    Mailboxes { out: (out.start, out.length), input: (input.start, input.length), protocols: COE }
}

/// Its SyncManagers: mailboxes first. Without them one for missing process data is left out.
fn managers(slave: &SlavePlan) -> Vec<(SyncManager, Use)> {
    let manager = |area: Area, control, usage| {
        (SyncManager { start: area.start, length: area.length, control, activate: 1 }, usage)
    };
    let mailboxes = slave.mailbox.into_iter().flat_map(|[out, input]| {
        [
            manager(out, SyncManager::MAILBOX_OUT, Use::MailboxOut),
            manager(input, SyncManager::MAILBOX_IN, Use::MailboxIn),
        ]
    });
    let process = [
        manager(slave.outputs, SyncManager::OUTPUTS | SyncManager::WATCHDOG, Use::Outputs),
        manager(slave.inputs, SyncManager::INPUTS, Use::Inputs),
    ];
    mailboxes.chain(process.into_iter().filter(|(m, _)| slave.mailbox.is_some() || m.length > 0)).collect()
}

fn pdo(layout: &Layout, manager: u8) -> Pdo {
    let entries = layout.entries.iter();
    let entry = entries.map(|entry| (entry.object.index, entry.object.sub, 8 * entry.kind.bytes() as u8));
    Pdo { index: layout.pdo, manager, entries: entry.collect() }
}

/// Terminals for so many bytes: digital ones as far as there can be so many.
fn terminals(area: Area) -> Terminals {
    match area.length {
        0..=31 => Terminals { digital: 8 * area.length as u8, analogue: 0 },
        bytes => Terminals { digital: 8 * (bytes % 2) as u8, analogue: (bytes / 2).min(255) as u8 },
    }
}

#[cfg(test)]
mod tests;
