//! Drives behind a coupler with small digital terminals, one of them with two SyncManagers a direction, all without
//! clocks and receive times; SIIs that return four bytes, slowly and at first from another address; and mailboxes that
//! are slow, and send again what was lost.

use fieldbeat::bus::ethercat::{Area, Device, KollmorgenDrive, SlavePlan};
use fieldbeat::sim::ethercat::{
    ClockKind, Coupler, EthercatSegment, MailboxSettings, Model, SiiSettings, SlaveSettings,
};
use fieldbeat::time::{MS, US};

use super::Front;

/// A coupler, two inputs, four outputs, and sixteen outputs in two areas.
const MODELS: [Model; 4] = [Model::Ek1100, Model::El1002, Model::El2004, Model::El2809];
pub const FRONT: Front = Front { slaves: MODELS.len(), outputs: 3, inputs: 1 };
/// The time of a drive for an answer, as its description would give it.
const SDO_TIMEOUT: u64 = 100 * MS;
/// Cycles in which a call has ended, with one lost answer.
pub const SOON: u64 = 250;

/// Plans a drive for its slow mailbox.
pub fn fit(plan: &mut KollmorgenDrive) {
    plan.slave.sdo_timeout_ns = SDO_TIMEOUT;
}

/// Adds the terminals in front of the drives.
pub fn surround(segment: &mut EthercatSegment) {
    let EthercatSegment { plan, settings, devices, .. } = segment;
    for drive in &plan.drives {
        let mailbox = MailboxSettings { delay_ns: 3 * MS, delay_every: 3, lose_every: 11, resends: true };
        let slave = SlaveSettings { sii: sii(), mailbox, ..SlaveSettings::default() };
        settings.slaves.insert(drive.slave.place, slave);
    }
    for (place, model) in (0..).zip(MODELS) {
        let slave = SlaveSettings {
            model: Some(model),
            clock: Some(ClockKind::None),
            sii: sii(),
            ..SlaveSettings::default()
        };
        settings.slaves.insert(place, slave);
        let area = |start| Area { start, length: 1 };
        let (outputs, inputs) = match model {
            Model::El1002 => (Vec::new(), vec![area(0x1000)]),
            Model::El2004 => (vec![area(0x0F00)], Vec::new()),
            Model::El2809 => (vec![area(0x0F00), area(0x0F01)], Vec::new()),
            _ => (Vec::new(), Vec::new()),
        };
        let slave = SlavePlan { outputs, inputs, ..SlavePlan::new(place) };
        plan.devices.push(Device { name: model.name().to_owned(), slave });
        devices.push(Coupler::default());
    }
}

fn sii() -> SiiSettings {
    SiiSettings { busy_ns: 500 * US, loading_ns: 20 * MS, slips: true, ..SiiSettings::default() }
}
