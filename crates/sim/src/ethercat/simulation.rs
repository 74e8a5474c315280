//! The segment of a plan, simulated: its slaves, and the content of their EEPROMs.

use super::analogue::Analogue;
use super::codec::frame::ETHERTYPE;
use super::codec::mailbox::SDO_SIZE;
use super::codec::objects::{Object, Pdo};
use super::codec::registers::{AlState, Fmmu, SyncManager};
use super::codec::sii::{COE, Identity};
use super::coupler::Terminals;
use super::sii::{Contents, Mailboxes};
use super::topology::Topology;
use super::{
    Application, ClockKind, Coupler, Drive, DriveSettings, Esc, Left, Model, Segment, SegmentSettings,
    Settings, SlaveSettings,
};
use crate::{FaultPlan, SimBus, SimSegment, Simulated};
use fieldbeat_core::axis::PlanFault;
use fieldbeat_core::time::{MS, Time, US};
use fieldbeat_ethercat::{
    Area, Device, EthercatPlan, Expected, Family, KollmorgenDrive, Layout, Mapping, Owner, SlavePlan,
    is_interface,
};

/// The Ethertype of a frame, and the index of its first datagram.
const TYPE: std::ops::Range<usize> = 12..14;
const INDEX: usize = 17;
/// The offset of the data of the first datagram.
const DATA: usize = 26;
/// The delay until the firmware reads the mailbox and AL control: one interrupt of a drive (EtherCAT manual).
const REACTION_NS: u64 = 250 * US;
/// The clocks of neighbouring slaves were switched on so far apart.
const CLOCKS_APART_NS: u64 = 617 * MS + 1_234;
/// The use of the FMMUs: outputs, inputs, the state of the mailbox.
const FMMUS: [u8; 3] = [1, 2, 3];
/// The name of every slave that is not a drive.
const IO: &str = "I/O";
/// Where another master had the outputs of the first slave in the logical address space: our own may be there too.
const LOGICAL: u32 = 0x0001_0000;
/// Buffers below it are the outputs of a digital terminal, with this control byte.
const MEMORY: u16 = 0x1000;
const DIGITAL: u8 = 0x44;
/// That of outputs whose watchdog is armed as delivered.
const WATCHED: u8 = SyncManager::OUTPUTS | SyncManager::WATCHDOG;

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
            drives: plan
                .drives
                .iter()
                .map(|drive| DriveSettings {
                    serial: drive.slave.identity.serial.unwrap_or_default(),
                    ..DriveSettings::new(drive.family)
                })
                .collect(),
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
        let wire = wire.into_iter().chain(self.behind_faults());
        wire.into_iter().chain(devices.flat_map(|(device, coupler)| coupler.faults(device))).collect()
    }

    fn build(&self, to: &mut Simulated) {
        to.segments.push(Box::new(EthercatSim::new(self)));
    }
}

impl EthercatSegment {
    /// Slaves that are behind a port at which no frame would come to them in their position.
    fn behind_faults(&self) -> Vec<(Option<String>, PlanFault)> {
        let last = self.plan.slaves().last().map_or(0, |(_, slave)| slave.place);
        let mut topology = Topology::line(vec![0; usize::from(last) + 1]);
        let behind = |place| self.settings.slaves.get(&place).and_then(|own: &SlaveSettings| own.behind);
        let slaves = self
            .plan
            .slaves()
            .into_iter()
            .filter_map(|(owner, slave)| Some((owner, slave.place, behind(slave.place)?)));
        slaves
            .filter(|(_, place, behind)| !topology.put((*place).into(), *behind))
            .map(|(owner, place, behind)| {
                let why = format!(
                    "port {} of position {} does not lead to position {place}: a frame leaves by ports 3, 1 \
                     and 2, and comes back before it leaves by the next",
                    behind.port, behind.place
                );
                (Some(self.plan.name_of(owner).to_owned()), PlanFault::new("simulate.behind", why))
            })
            .collect()
    }

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
        Coupler {
            outputs: terminals(device.slave.output_bytes()),
            inputs: terminals(device.slave.input_bytes()),
        }
    }

    /// Terminal counts that do not fit the process data of `device`.
    fn faults(self, device: &Device) -> impl Iterator<Item = (Option<String>, PlanFault)> {
        let sides = [
            ("simulate.outputs", self.outputs, device.slave.output_bytes()),
            ("simulate.inputs", self.inputs, device.slave.input_bytes()),
        ];
        let wrong = sides.into_iter().filter(|(_, there, bytes)| there.bytes() != *bytes);
        wrong.map(|(key, there, bytes)| {
            let Terminals { digital, analogue } = there;
            let why = format!(
                "digital = {digital} and analogue = {analogue} are {} bytes, and the device has {bytes}; \
                 make them equal",
                there.bytes(),
            );
            (Some(device.name.clone()), PlanFault::new(key, why))
        })
    }
}

/// A simulated segment.
///
/// A position between two slaves that the plan leaves out has a coupler (EK1100) without terminals, a mailbox or a
/// clock.
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
                let plain = Device { name: String::new(), slave: SlavePlan::new(slaves.len() as u16) };
                slaves.push(device(&plain, Coupler::default(), &settings));
            }
            slaves.push(match owner {
                Owner::Drive(index) => drive(&plan.drives[index], &segment.drives[index], &settings, logical),
                Owner::Device(index) => device(&plan.devices[index], segment.devices[index], &settings),
            });
            logical += slave.output_bytes() as u32;
        }
        let mut line = Segment::new(slaves);
        for (place, own) in &settings.slaves {
            if let Some(behind) = own.behind {
                line.put((*place).into(), behind);
            }
            if let Some(to) = own.wired_to {
                line.wire((*place).into(), to.into());
            }
        }
        EthercatSim { segment: line, interface: plan.interface.clone(), settings }
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

    fn open_sto(&mut self, place: usize, until: Time) {
        if let Some(drive) = self.drive(place) {
            drive.open_sto(until);
        }
    }
}

/// A slave of a plan with this content of its SII, with device emulation if it is `plain` and not set otherwise, and as
/// another master has left it.
fn slave(
    segment: &SegmentSettings,
    own: SlaveSettings,
    slave: &SlavePlan,
    mut contents: Contents,
    plain: bool,
    application: Box<dyn Application>,
) -> Esc {
    let place = usize::from(slave.place);
    contents.alias = own.alias.or(slave.identity.alias).unwrap_or_default();
    let clock = own.clock.unwrap_or(match (slave.sync, segment.short_clocks) {
        (false, _) => ClockKind::None,
        (true, true) => ClockKind::Short,
        (true, false) => ClockKind::Long,
    });
    let usual = Settings::default();
    let mut esc = Esc::new(
        Settings {
            features: match clock {
                ClockKind::None => 0x0180,
                ClockKind::Short => 0x0184,
                ClockKind::Long => 0x018C,
            },
            receive_times: own.clock != Some(ClockKind::None),
            fmmus: own.fmmus.unwrap_or(usual.fmmus),
            ports: own.model.map_or(usual.ports, Model::ports),
            device_id: segment.device_ids.then_some(slave.place),
            identification: own.identification.or(slave.identity.identification),
            sii: own.sii.content.of(contents.image()),
            sii_access: own.sii,
            clock_ns: (place as u64 + 1) * CLOCKS_APART_NS,
            drift_ppm: segment.drift_ppm.get(place).or(segment.drift_ppm.last()).copied().unwrap_or(0.0),
            settling: segment.settling,
            emulated: own.emulated.unwrap_or(own.model.map_or(plain, Model::is_emulated)),
            mailbox: own.mailbox,
            managers: if own.exact_managers { contents.managers } else { Vec::new() },
            reaction_ns: REACTION_NS,
            delay_ns: segment.delay_ns,
        },
        application,
    );
    if let Some(left) = &own.left {
        esc.leave(left);
    }
    esc
}

/// The settings of the slave at a position.
fn own(segment: &SegmentSettings, place: u16) -> SlaveSettings {
    segment.slaves.get(&place).cloned().unwrap_or_default()
}

fn drive(plan: &KollmorgenDrive, settings: &DriveSettings, segment: &SegmentSettings, logical: u32) -> Esc {
    let (settings, mut own) = (drive_settings(plan, settings.clone()), own(segment, plan.slave.place));
    let (name, outputs) = match settings.family {
        // Whether its SII arms the watchdog is assumed; that of an AKD was captured.
        Family::S700 => ("S700", WATCHED),
        Family::Akd => ("AKD", SyncManager::OUTPUTS),
    };
    let contents = Contents {
        name,
        identity: settings.identity,
        serial: settings.serial,
        alias: 0,
        mailboxes: plan.slave.mailbox.map(mailboxes),
        fmmus: FMMUS.to_vec(),
        managers: managers(&plan.slave, own.output_control.unwrap_or(outputs)),
        inputs: vec![(pdo(&plan.inputs), 3)],
        outputs: vec![(pdo(&plan.outputs), 2)],
    };
    let unwatched =
        |manager: &SyncManager| SyncManager { control: manager.control & !SyncManager::WATCHDOG, ..*manager };
    let Area { start, length } = plan.slave.outputs.first().copied().unwrap_or_default();
    let mut running = Left {
        al: (AlState::Op as u16, 0),
        managers: contents.managers.iter().map(|manager| unwatched(manager).to_bytes()).collect(),
        fmmus: vec![Fmmu::bytes(logical, length, start, Fmmu::WRITE).to_bytes()],
        unwatched: true,
        ..Left::default()
    };
    let (is_running, left) = (settings.running_rpm.is_some(), own.left.take());
    let drive = Drive::new(settings);
    running.sync0_ns = drive.cycle_ns.and_then(|cycle_ns| u32::try_from(cycle_ns).ok());
    let mut esc = slave(segment, own, &plan.slave, contents, false, Box::new(drive));
    if is_running && running.sync0_ns.is_some() {
        esc.leave(&running);
    }
    left.iter().for_each(|left| esc.leave(left));
    esc
}

/// A drive that fits its plan: with the PDOs that are not mapped first, and, unless it was set otherwise, with the
/// identity of the plan.
fn drive_settings(plan: &KollmorgenDrive, mut settings: DriveSettings) -> DriveSettings {
    if settings.identity == DriveSettings::new(settings.family).identity {
        settings.identity = expected(plan.slave.identity, settings.identity);
    }
    if let Some([_, input]) = plan.slave.mailbox {
        let is_longer = usize::from(input.length) > SDO_SIZE;
        settings.long_sdos = (is_longer || settings.long_sdos.is_some()).then_some(input.length);
    }
    if plan.mapping != Mapping::Free {
        for layout in [&plan.outputs, &plan.inputs] {
            settings.layouts.retain(|own| own.index != layout.pdo);
            settings.layouts.push(pdo(layout));
        }
    }
    if plan.mapping == Mapping::AsIs || settings.running_rpm.is_some() {
        settings.selected = (plan.outputs.pdo, plan.inputs.pdo);
    }
    settings
}

fn device(plan: &Device, coupler: Coupler, segment: &SegmentSettings) -> Esc {
    let (own, has_mailbox) = (own(segment, plan.slave.place), plan.slave.mailbox.is_some());
    let (mut contents, application): (Contents, Box<dyn Application>) = match own.model {
        Some(Model::El3102) => {
            let contents = Model::El3102.contents();
            (contents.clone(), Box::new(Analogue::new(contents)))
        }
        Some(model) => (model.contents(), Box::new(model.terminals())),
        None => {
            let identity = expected(plan.slave.identity, Model::Ek1100.identity());
            let mut contents = coupler.contents(IO, identity);
            let is_digital = plan.slave.outputs.first().is_some_and(|area| area.start < MEMORY);
            let usual = if is_digital { DIGITAL } else { WATCHED };
            contents.managers = managers(&plan.slave, own.output_control.unwrap_or(usual));
            contents.mailboxes = plan.slave.mailbox.map(mailboxes);
            // Those of the mailboxes are the first two.
            let first = if has_mailbox { 2 } else { 0 };
            let pdos = contents.inputs.iter_mut().chain(&mut contents.outputs);
            pdos.for_each(|(_, manager)| *manager += first);
            (contents, Box::new(coupler))
        }
    };
    contents.serial = own.serial.or(plan.slave.identity.serial).unwrap_or(contents.serial);
    slave(segment, own, &plan.slave, contents, !has_mailbox, application)
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

/// The SyncManagers of a slave: mailboxes first, then process data, with this control byte of its outputs. Without
/// mailboxes one for missing process data is left out.
fn managers(slave: &SlavePlan, output_control: u8) -> Vec<SyncManager> {
    let manager = |area: Area, control| SyncManager::on(area.start, area.length, control);
    let mailboxes = slave.mailbox.into_iter().flat_map(|[out, input]| {
        [manager(out, SyncManager::MAILBOX_OUT), manager(input, SyncManager::MAILBOX_IN)]
    });
    let all = |areas: &[Area]| match areas {
        [] if slave.mailbox.is_some() => vec![Area::default()],
        areas => areas.to_vec(),
    };
    let process = [(all(&slave.outputs), output_control), (all(&slave.inputs), SyncManager::INPUTS)];
    let each = |(areas, control): (Vec<Area>, u8)| areas.into_iter().map(move |area| manager(area, control));
    mailboxes.chain(process.into_iter().flat_map(each)).collect()
}

/// The PDO that a plan describes.
fn pdo(layout: &Layout) -> Pdo {
    let entries = layout.entries.iter();
    let entry = entries
        .map(|entry| (Object::new(entry.object.index, entry.object.sub), 8 * entry.kind.bytes() as u8));
    Pdo { index: layout.pdo, entries: entry.collect() }
}

/// Terminals for so many bytes: digital ones as far as there can be so many.
fn terminals(bytes: usize) -> Terminals {
    match bytes {
        0..=31 => Terminals { digital: 8 * bytes as u8, analogue: 0 },
        bytes => Terminals { digital: 8 * (bytes % 2) as u8, analogue: (bytes / 2).min(255) as u8 },
    }
}

#[cfg(test)]
mod tests;
