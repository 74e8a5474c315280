//! The keys of `simulate` of a bus with `protocol = "profibus-dp"`, and of its drives.

use super::{
    AcyclicSettings, Channel, DpSettings, ForeignSettings, LenzeMotorSettings, LenzeSettings, LinkSettings,
    NoiseSettings, PowerSettings, ProfibusSegment, Safe, UserPrm,
};
use crate::keys::faults;
use crate::{Carrier, FaultPlan, SimBus};
use fieldbeat_core::time::{MS, S};
use fieldbeat_keys::bus;
use fieldbeat_keys::keys;
use fieldbeat_keys::table::Table;
use fieldbeat_keys::value::SOMETHING;
use fieldbeat_profibus::{LenzeDrive, ProfibusPlan};

/// The most bytes of data in a telegram.
const DATA_MAX: usize = 244;

keys! {
    PORT "port" = "none": "serial port at the other end of the cable, where `device` is a real one";
    LOST_BYTE "lost_byte" = "0": "rate of telegrams that lose a byte";
    NOISE_EVERY "noise_every" = "none": "mean time between two bursts of noise";
    SECOND_MASTER "second_master" = "none": "address of another master on the wire";
    SECOND_MASTER_EVERY "second_master_every" = "10ms": "how often it sends its token";
    SECOND_MASTER_AFTER "second_master_after" = "0us": "when it appears";
    SECOND_MASTER_LISTENS "second_master_listens" = "false": "it keeps to the rules: claims a silent wire, "
        "answers a search, gives way";
    CONFIGURATION "configuration" = "(as the drive's)": "identifier bytes that it wants, and reads out by "
        "Get_Cfg";
    RUNNING "running" = "none": "starts enabled at this velocity, up to the full speed, as if another "
        "master had died";
    IDENT "ident" = "(as the drive's)": "ident number";
    ANSWER_BITS "answer_bits" = "(`min_tsdr`)": "time before an answer, bits";
    SD3 "sd3" = "false": "sends 8 bytes of data as SD3";
    REPLIES "replies" = "lengths": "replies in the DRIVECOM channel: `\"lengths\"` with length bits, "
        "`\"bare\"` with neither length nor service";
    JOB_TIME "job_time" = "2ms": "time that a parameter job takes in the channel";
    BRAKES_ON_FAULT "brakes_on_fault" = "false": "brakes before a fault takes its power";
    IGNORES_STOPS "ignores_stops" = "false": "once enabled, no control word takes it out of operation: a "
        "faulty firmware. It follows its set point";
    FAULT "fault" = "none": "code of a fault that cannot be reset";
    USER_PRM_LENGTH "user_prm_length" = "(any)": "length of the User_Prm that it takes";
    DPV1 "dpv1" = "true": "knows DP-V1";
    SYNC_FREEZE "sync_freeze" = "false": "knows Sync and Freeze";
    NEEDS_OPERATE "needs_operate" = "true": "outputs count only behind a Global_Control with Operate";
    READY_AFTER "ready_after" = "1ms": "time from a configuration until it is ready";
    SHOWS_LOCK "shows_lock" = "true": "its diagnosis shows another master that it is locked";
    SAFE "safe" = "inhibit": "what it does without valid outputs: `\"inhibit\"`, `\"quick stop\"` or "
        "`\"fault\"`";
    ACYCLIC_DELAY "acyclic_delay" = "1": "polls before an acyclic answer";
    ACYCLIC_TIME "acyclic_time" = "5ms": "time that a parameter request takes";
    INERTIA "inertia" = "0.005": "inertia of all rotating parts, kg m²";
    FRICTION "friction" = "0.5": "friction without power, N m";
    TEMPERATURE "temperature" = "43": "temperature of the heat sink, °C";
}

/// Reads the simulated wire of a `[[bus]]` that is read otherwise.
pub fn read(table: &mut Table<'_>, plan: &ProfibusPlan, period_ns: u64) -> ProfibusSegment {
    let default = ProfibusSegment::of(plan);
    let drives = bus::simulated(table, &plan.drives, |table, drive, _| LenzeSettings {
        last_master: plan.address,
        ..settings(table, drive)
    });
    let segment = bus::simulated_wire(table, |table| ProfibusSegment {
        own_port: table.text(PORT, SOMETHING, "a serial port, like \"/dev/ttyUSB1\"", |text| {
            (!text.is_empty()).then(|| text.to_owned())
        }),
        faults: FaultPlan {
            lost_byte: table.number(LOST_BYTE, 0.0..=1.0).unwrap_or(0.0),
            ..faults(table, Carrier::Datagrams, period_ns, 0)
        },
        foreign: foreign(table),
        noise: table
            .time(NOISE_EVERY, MS..=600 * S)
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
    let address = table.integer(SECOND_MASTER, 0..=126);
    let every_ns = table.time(SECOND_MASTER_EVERY, MS..=600 * S);
    let after_ns = table.time(SECOND_MASTER_AFTER, ..=600 * S);
    let listens = table.flag(SECOND_MASTER_LISTENS).unwrap_or(false);
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
    let wanted = table.integers(CONFIGURATION, DATA_MAX, u16::from(u8::MAX));
    let wanted: Vec<u8> = wanted.into_iter().map(|byte| byte as u8).collect();
    let default = match table.gives("configuration") {
        true => LenzeSettings::of(&LenzeDrive { configuration: wanted, ..drive.clone() }),
        false => LenzeSettings::of(drive),
    };
    let full = drive.scale.full_rpm;
    let per_unit = drive.axis.units.counts_per_unit * 60.0;
    let most = (full / per_unit).abs();
    let running = table.number(RUNNING, -most..=most);
    LenzeSettings {
        ident: table.integer(IDENT, 0..=0xFFFF).unwrap_or(default.ident),
        link: LinkSettings {
            answer_bits: table.integer(ANSWER_BITS, 11..=65_535),
            sd3: table.flag(SD3).unwrap_or(default.link.sd3),
            ..default.link
        },
        dp: dp(table, default.dp),
        channel: table
            .word(REPLIES, &[("lengths", Channel::Drivecom), ("bare", Channel::DrivecomBare)])
            .filter(|_| default.channel == Channel::Drivecom)
            .unwrap_or(default.channel),
        acyclic: acyclic(table, default.acyclic),
        job_ns: table.time(JOB_TIME, ..=10 * S).unwrap_or(default.job_ns),
        power: PowerSettings {
            brakes_on_fault: table.flag(BRAKES_ON_FAULT).unwrap_or(default.power.brakes_on_fault),
            ignores_stops: table.flag(IGNORES_STOPS).unwrap_or(default.power.ignores_stops),
            persistent_fault: table.integer(FAULT, 1..=0xFFFF),
            ..default.power
        },
        motor: motor(table, default.motor),
        running: running.map(|velocity| velocity * per_unit),
        ..default
    }
}

fn dp(table: &mut Table<'_>, default: DpSettings) -> DpSettings {
    let length = table.integer(USER_PRM_LENGTH, 0..=237);
    DpSettings {
        user_prm: length.map_or(default.user_prm, UserPrm::Length),
        dpv1: table.flag(DPV1).unwrap_or(default.dpv1),
        sync_freeze: table.flag(SYNC_FREEZE).unwrap_or(default.sync_freeze),
        needs_operate: table.flag(NEEDS_OPERATE).unwrap_or(default.needs_operate),
        ready_ns: table.time(READY_AFTER, ..=600 * S).unwrap_or(default.ready_ns),
        shows_lock: table.flag(SHOWS_LOCK).unwrap_or(default.shows_lock),
        safe: table
            .word(
                SAFE,
                &[("inhibit", Safe::Inhibit), ("quick stop", Safe::QuickStop), ("fault", Safe::Fault)],
            )
            .unwrap_or(default.safe),
    }
}

fn acyclic(table: &mut Table<'_>, default: AcyclicSettings) -> AcyclicSettings {
    AcyclicSettings {
        delay: table.integer(ACYCLIC_DELAY, 0..=1_000).unwrap_or(default.delay),
        busy_ns: table.time(ACYCLIC_TIME, ..=60 * S).unwrap_or(default.busy_ns),
        ..default
    }
}

fn motor(table: &mut Table<'_>, default: LenzeMotorSettings) -> LenzeMotorSettings {
    let mut value =
        |key, range: std::ops::RangeInclusive<f64>, default| table.number(key, range).unwrap_or(default);
    LenzeMotorSettings {
        inertia_kgm2: value(INERTIA, 1e-9..=1e6, default.inertia_kgm2),
        friction_nm: value(FRICTION, 0.0..=1e5, default.friction_nm),
        temperature: value(TEMPERATURE, -50.0..=200.0, default.temperature),
        ..default
    }
}
