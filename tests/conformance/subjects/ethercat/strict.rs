//! The strict segment: a coupler without a processor in front, the last drive behind a port of its own, and slaves
//! that compare, hold back, and answer late or not at all.

use fieldbeat::bus::ethercat::{Device, KollmorgenDrive, SlavePlan, Watchdog};
use fieldbeat::sim::ethercat::{
    Behind, ClockKind, Coupler, EthercatSegment, MailboxSettings, Model, SiiSettings, SlaveSettings,
};
use fieldbeat::time::{MS, US};

/// The position of the coupler, and so many slaves in front of the drives.
const COUPLER: u16 = 0;
pub const FRONT: usize = 1;
/// The time of a drive for an answer, as its description would give it: a lost one costs as much.
const SDO_TIMEOUT: u64 = 100 * MS;
/// Cycles in which a call has ended, with one lost answer.
pub const SOON: u64 = 200;
/// The control byte of outputs without a watchdog, as a real AKD has it.
const UNWATCHED: u8 = 0x24;

/// Plans a drive for what its slave insists on.
pub fn fit(plan: &mut KollmorgenDrive) {
    if plan.slave.watchdog != Watchdog::Off {
        plan.slave.watchdog = Watchdog::AsDelivered;
        plan.accept_no_watchdog = true;
    }
    plan.slave.sdo_timeout_ns = SDO_TIMEOUT;
}

/// Adds the coupler, and makes every slave as strict as can be.
pub fn surround(segment: &mut EthercatSegment) {
    let EthercatSegment { plan, drives, settings, .. } = segment;
    let last = plan.drives.iter().map(|drive| drive.slave.place).max();
    let slaves = &mut settings.slaves;
    for (KollmorgenDrive { slave, .. }, drive) in plan.drives.iter().zip(drives) {
        let behind = (Some(slave.place) == last).then_some(Behind { place: COUPLER, port: 2 });
        // Without an FMMU for its AL status a running drive is not joined.
        let fmmus = if drive.running_rpm.is_some() { 3 } else { 2 };
        slaves.insert(slave.place, strict(behind, fmmus));
    }
    slaves.insert(COUPLER, SlaveSettings { model: Some(Model::Ek1100), ..SlaveSettings::default() });
    segment.plan.devices.push(Device { name: "coupler".into(), slave: SlavePlan::new(COUPLER) });
    segment.devices.push(Coupler::default());
}

fn strict(behind: Option<Behind>, fmmus: u8) -> SlaveSettings {
    SlaveSettings {
        exact_managers: true,
        output_control: Some(UNWATCHED),
        clock: Some(ClockKind::Short),
        fmmus: Some(fmmus),
        sii: SiiSettings {
            owned_by_slave: true,
            read_in_preop: true,
            eight: true,
            busy_ns: 200 * US,
            loading_ns: 5 * MS,
            slips: true,
            ..SiiSettings::default()
        },
        mailbox: MailboxSettings { delay_ns: 3 * MS, delay_every: 3, lose_every: 11, resends: false },
        behind,
        ..SlaveSettings::default()
    }
}
