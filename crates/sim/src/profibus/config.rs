//! The keys of `simulate` of a bus with `protocol = "profibus-dp"`, and of its drives.

use super::{
    AcyclicSettings, Channel, DpSettings, ForeignSettings, LenzeMotorSettings, LenzeSettings, LinkSettings,
    NoiseSettings, PowerSettings, ProfibusSegment, Safe, UserPrm,
};
use crate::keys::faults;
use crate::{Carrier, FaultPlan, SimBus};
use fieldbeat_core::time::{MS, S};
use fieldbeat_keys::bus;
use fieldbeat_keys::table::Table;
use fieldbeat_keys::value::SOMETHING;
use fieldbeat_profibus::{DATA_MAX, LenzeDrive, ProfibusPlan};

/// Reads the simulated wire of a `[[bus]]` that is read otherwise.
pub fn read(table: &mut Table<'_>, plan: &ProfibusPlan, period_ns: u64) -> ProfibusSegment {
    let default = ProfibusSegment::of(plan);
    let drives = bus::simulated(table, &plan.drives, |table, drive, _| LenzeSettings {
        last_master: plan.address,
        ..settings(table, drive)
    });
    let segment = table.table("simulate", |table| ProfibusSegment {
        own_port: table.text("port", SOMETHING, "a serial port, like \"/dev/ttyUSB1\"", |text| {
            (!text.is_empty()).then(|| text.to_owned())
        }),
        faults: FaultPlan {
            lost_byte: table.number("lost_byte", 0.0..=1.0, "a probability for each telegram").unwrap_or(0.0),
            ..faults(table, Carrier::Datagrams, period_ns, 0)
        },
        foreign: foreign(table),
        noise: table
            .time("noise_every", MS..=600 * S, "the mean time between bursts of noise")
            .map(|every_ns| NoiseSettings { every_ns, ..NoiseSettings::default() }),
        drives,
        ..default
    });
    // A drive whose plan is wrong has that reported.
    if plan.drives.iter().all(|drive| drive.faults().is_empty()) {
        segment.faults().into_iter().for_each(|(_, fault)| table.fault(fault.key, fault.message));
    }
    segment
}

/// Another master, if it has an address.
fn foreign(table: &mut Table<'_>) -> Option<ForeignSettings> {
    let address = table.integer("second_master", 0..=126, "the address of another master on the wire");
    let every = "how often the other master sends its token";
    let every_ns = table.time("second_master_every", MS..=600 * S, every);
    let after_ns = table.time("second_master_after", ..=600 * S, "when the other master appears");
    let listens = table.flag("second_master_listens").unwrap_or(false);
    let address = address?;
    let default = match listens {
        true => ForeignSettings::listening(address),
        false => ForeignSettings::new(address),
    };
    Some(ForeignSettings {
        every_ns: every_ns.unwrap_or(default.every_ns),
        after_ns: after_ns.unwrap_or(default.after_ns),
        ..default
    })
}

fn settings(table: &mut Table<'_>, drive: &LenzeDrive) -> LenzeSettings {
    // It has the process data that its own configuration makes.
    let wanted = table.integers("configuration", DATA_MAX, u16::from(u8::MAX));
    let wanted: Vec<u8> = wanted.into_iter().map(|byte| byte as u8).collect();
    let default = match table.gives("configuration") {
        true => LenzeSettings::of(&LenzeDrive { configuration: wanted, ..drive.clone() }),
        false => LenzeSettings::of(drive),
    };
    let full = drive.scale.full_rpm;
    let per_unit = drive.axis.units.counts_per_unit * 60.0;
    let most = (full / per_unit).abs();
    let running = table.number("running", -most..=most, "a velocity up to the full speed, units/s");
    LenzeSettings {
        ident: table.integer("ident", 0..=0xFFFF, "the ident number of the module").unwrap_or(default.ident),
        link: LinkSettings {
            answer_bits: table.integer("answer_bits", 11..=65_535, "the time before an answer, bits"),
            sd3: table.flag("sd3").unwrap_or(default.link.sd3),
            ..default.link
        },
        dp: dp(table, default.dp),
        channel: table
            .word("replies", &[("lengths", Channel::Drivecom), ("bare", Channel::DrivecomBare)])
            .filter(|_| default.channel == Channel::Drivecom)
            .unwrap_or(default.channel),
        acyclic: acyclic(table, default.acyclic),
        job_ns: table
            .time("job_time", ..=10 * S, "how long a parameter job takes in the channel")
            .unwrap_or(default.job_ns),
        power: PowerSettings {
            brakes_on_fault: table.flag("brakes_on_fault").unwrap_or(default.power.brakes_on_fault),
            ignores_stops: table.flag("ignores_stops").unwrap_or(default.power.ignores_stops),
            persistent_fault: table.integer("fault", 1..=0xFFFF, "the code of a fault that cannot be reset"),
            ..default.power
        },
        motor: motor(table, default.motor),
        running: running.map(|velocity| velocity * per_unit),
        ..default
    }
}

fn dp(table: &mut Table<'_>, default: DpSettings) -> DpSettings {
    let length = table.integer("user_prm_length", 0..=237, "the length of the User_Prm that the drive takes");
    DpSettings {
        user_prm: length.map_or(default.user_prm, UserPrm::Length),
        dpv1: table.flag("dpv1").unwrap_or(default.dpv1),
        sync_freeze: table.flag("sync_freeze").unwrap_or(default.sync_freeze),
        needs_operate: table.flag("needs_operate").unwrap_or(default.needs_operate),
        ready_ns: table
            .time("ready_after", ..=600 * S, "from the configuration until the drive is ready")
            .unwrap_or(default.ready_ns),
        shows_lock: table.flag("shows_lock").unwrap_or(default.shows_lock),
        safe: table
            .word(
                "safe",
                &[("inhibit", Safe::Inhibit), ("quick stop", Safe::QuickStop), ("fault", Safe::Fault)],
            )
            .unwrap_or(default.safe),
    }
}

fn acyclic(table: &mut Table<'_>, default: AcyclicSettings) -> AcyclicSettings {
    AcyclicSettings {
        delay: table
            .integer("acyclic_delay", 0..=1_000, "the polls before an acyclic answer")
            .unwrap_or(default.delay),
        busy_ns: table
            .time("acyclic_time", ..=60 * S, "how long a parameter request takes")
            .unwrap_or(default.busy_ns),
        ..default
    }
}

fn motor(table: &mut Table<'_>, default: LenzeMotorSettings) -> LenzeMotorSettings {
    let mut value = |key, range: std::ops::RangeInclusive<f64>, hint, default| {
        table.number(key, range, hint).unwrap_or(default)
    };
    LenzeMotorSettings {
        inertia_kgm2: value(
            "inertia",
            1e-9..=1e6,
            "the inertia of all rotating parts, kg m²",
            default.inertia_kgm2,
        ),
        friction_nm: value("friction", 0.0..=1e5, "the friction without power, N m", default.friction_nm),
        temperature: value(
            "temperature",
            -50.0..=200.0,
            "the heat sink temperature, °C",
            default.temperature,
        ),
        ..default
    }
}
