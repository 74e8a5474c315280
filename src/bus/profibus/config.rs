//! `protocol = "profibus-dp"`.

use toml::de::DeValue;

use super::PROTOCOL;
use super::check::{
    BITS_MAX, CONTROL_RANGE_NS, GAP_MAX, LATENCY_MAX_NS, SYNC_BITS, TSDR_MIN, USER_PRM_MAX, rates,
};
use super::plan::{
    ADDRESS_MAX, Bits, DATA_MAX, DriveProfile, LenzeDrive, Numbers, ParameterPath, ProfibusPlan, RATES,
    RETRIES_MAX, Rs485, SLOT_MARGIN_BITS, Scale, ShownWord, StatusBit, Watchdog,
};
use super::wire::telegram::STATION_MAX;
use crate::axis::feedback::MONITOR_CHANNELS;
use crate::axis::{Unit, is_plain_name};
use crate::bus::{BusPlan, Grid};
use crate::keys::bus::drive_tables;
use crate::keys::drive::{Counts, axis};
use crate::keys::machine::Machine;
use crate::keys::table::{Table, integer, number, time};
use crate::keys::value::alternatives;
use crate::time::MS;

const COUNTS: Counts =
    Counts { what: "revolutions of the motor", unit: Unit::Revolution, per_unit: 1.0, wire: 1.0 };
/// The units of a shown word.
const UNITS: [&str; 9] = ["", "%", "A", "V", "Hz", "rpm", "Nm", "W", "°C"];

/// Reads a `[[bus]]`.
pub fn bus(table: &mut Table<'_>, machine: &mut Machine) -> Box<dyn BusPlan> {
    let name = machine.bus_name(table, PROTOCOL);
    let device = device(table, machine);
    let rate = table.read("rate", |value| {
        let rate = integer(value).and_then(|rate| u32::try_from(rate).ok());
        rate.filter(|rate| RATES.contains(rate)).ok_or_else(|| format!("must be {} bit/s", rates()))
    });
    let rate = rate.unwrap_or(ProfibusPlan::RATE);
    let mut drives = drive_tables(table, &["name", "address"]);
    let default = ProfibusPlan::new("", rate, Vec::new());
    let plan = ProfibusPlan {
        name,
        rate,
        address: table
            .integer("address", 0..=ADDRESS_MAX.into(), "the address of this master, 2 unless given")
            .unwrap_or(default.address),
        bits: bits(table, default.bits),
        retries: table
            .integer("retries", 1..=RETRIES_MAX.into(), "how often a request without an answer is repeated")
            .unwrap_or(default.retries),
        token: table.flag("token").unwrap_or(default.token),
        gap: gap(table).unwrap_or(default.gap),
        highest_address: table
            .integer("highest_address", 1..=STATION_MAX.into(), "up to it another master is looked for")
            .unwrap_or(default.highest_address),
        global_control_ns: table
            .time("global_control", CONTROL_RANGE_NS, "how often Global_Control is sent")
            .unwrap_or(default.global_control_ns),
        echo: table.flag("echo").unwrap_or(default.echo),
        rs485: table
            .word("rs485", &[("adapter", Rs485::Adapter), ("driver", Rs485::Driver)])
            .unwrap_or(default.rs485),
        drives: drives.iter_mut().map(|table| drive(table, machine)).collect(),
        device: device.clone().unwrap_or_default(),
    };
    table.later("simulate");
    for fault in plan.own_faults() {
        // Missing, or already reported.
        if fault.key != "device" || device.is_some() {
            table.fault(fault.key, fault.message);
        }
    }
    let mut is_wrong = false;
    for (index, (table, drive)) in drives.iter().zip(&plan.drives).enumerate() {
        let same = plan.drives[..index].iter().any(|other| other.address == drive.address);
        for fault in plan.drive_faults(drive) {
            is_wrong = true;
            table.fault(fault.key, fault.message);
        }
        if same && table.gives("address") {
            is_wrong = true;
            table.fault("address", super::ADDRESS_TAKEN);
        }
    }
    if !is_wrong {
        let grid = Grid { period_ns: machine.period_ns, deadline_ns: machine.deadline_ns };
        for (index, fault) in plan.schedule_faults(grid) {
            drives[index].fault(fault.key, fault.message);
        }
    }
    drives.into_iter().for_each(Table::finish);
    Box::new(plan)
}

fn device(table: &mut Table<'_>, machine: &mut Machine) -> Option<String> {
    table.require("device", "a serial port, like \"/dev/ttyS1\", or \"local:NAME\"");
    let hint = "a serial port, like \"/dev/ttyS1\", or \"local:NAME\", a simulated wire on this host";
    let device = table.text("device", hint, |text| (!text.is_empty()).then(|| text.to_owned()))?;
    machine.claim_interface(table, "device", &device);
    Some(device)
}

fn bits(table: &mut Table<'_>, default: Bits) -> Bits {
    let latency_ns = table.time("latency", ..=LATENCY_MAX_NS, "what the driver adds before a byte is read");
    table.table("bits", |table| {
        let mut bits = |key, least: u32, hint, default| {
            table.integer(key, i128::from(least)..=BITS_MAX.into(), hint).unwrap_or(default)
        };
        let max_tsdr = bits(
            "max_tsdr",
            TSDR_MIN.into(),
            "the slowest drive answers within so many bits",
            default.max_tsdr,
        );
        Bits {
            slot: bits(
                "slot",
                1,
                "an answer has begun after so many bits",
                default.slot.max(max_tsdr + SLOT_MARGIN_BITS + 1),
            ),
            max_tsdr,
            sync: bits("sync", SYNC_BITS, "the silence before a request, bits", default.sync),
            idle: bits("idle", SYNC_BITS, "the silence after an answer, bits", default.idle),
            idle_unanswered: bits(
                "idle_unanswered",
                SYNC_BITS,
                "the silence after a request that nobody answers, bits",
                max_tsdr.max(SYNC_BITS),
            ),
            latency_ns: latency_ns.unwrap_or(default.latency_ns),
        }
    })
}

fn gap(table: &mut Table<'_>) -> Option<Option<u32>> {
    table.read("gap", |value| match (value.as_str(), integer(value)) {
        (Some("off"), _) => Ok(None),
        (_, Some(rounds)) if (1..=i128::from(GAP_MAX)).contains(&rounds) => Ok(Some(rounds as u32)),
        _ => {
            Err(format!("must be 1 ... {GAP_MAX} rounds between two searches for another master, or \"off\""))
        }
    })
}

fn drive(table: &mut Table<'_>, machine: &mut Machine) -> LenzeDrive {
    let axis = axis(table, machine, COUNTS);
    table.require("address", "the address that is set at the module, 0 ... 125");
    let address = table.integer("address", 0..=ADDRESS_MAX.into(), "the address that is set at the module");
    let default = LenzeDrive::new("", address.unwrap_or(ADDRESS_MAX));
    let profile = table
        .word("words", &[("drivecom", DriveProfile::Drivecom), ("profidrive", DriveProfile::Profidrive)])
        .unwrap_or_default();
    let channel = table.flag("channel").unwrap_or(default.channel);
    table.later("simulate");
    LenzeDrive {
        axis,
        address: default.address,
        ident: table
            .integer("ident", 0..=0xFFFF, "the ident number of the module, as its GSD has it")
            .unwrap_or(default.ident),
        user_prm: bytes(table, "user_prm", USER_PRM_MAX).unwrap_or(default.user_prm),
        configuration: bytes(table, "configuration", DATA_MAX).unwrap_or(default.configuration),
        watchdog: watchdog(table, default.watchdog),
        min_tsdr: table
            .integer("min_tsdr", 0..=255, "the drive answers no sooner, bits; 0: it keeps what it has")
            .unwrap_or(default.min_tsdr),
        group: groups(table).unwrap_or(default.group),
        profile,
        channel,
        parameters: parameters(table, channel),
        ramp_bits: table.flag("ramp_bits").unwrap_or(default.ramp_bits),
        enable_bit: enable_bit(table).unwrap_or(profile.usual_enable_bit()),
        scale: scale(table, default.scale),
        further: table.integers("further", DATA_MAX / 2, u16::MAX),
        show: table.read("monitor", monitor).unwrap_or(default.show),
        fault_at: table
            .read("fault_at", |value| match (value.as_str(), integer(value)) {
                (Some("off"), _) => Ok(None),
                (_, Some(at @ 0..=242)) => Ok(Some(at as u8)),
                _ => Err("must be a byte of the extended diagnosis, 0 ... 242, or \"off\"".into()),
            })
            .unwrap_or(default.fault_at),
        extended_diagnosis: table
            .integer("extended_diagnosis", 0..=238, "its most bytes, Max_Diag_Data_Len of its GSD less 6")
            .unwrap_or(default.extended_diagnosis),
    }
}

fn bytes(table: &mut Table<'_>, key: &'static str, most: usize) -> Option<Vec<u8>> {
    let bytes = table.integers(key, most, u16::from(u8::MAX));
    table.gives(key).then(|| bytes.into_iter().map(|byte| byte as u8).collect())
}

fn watchdog(table: &mut Table<'_>, default: Watchdog) -> Watchdog {
    let hint = "the drive stops when it is not addressed for this time; or \"off\"";
    let timeout_ns = table.read("watchdog", |value| match value.as_str() {
        Some("off") => Ok(None),
        _ => time(value, &(MS..), hint).map(Some),
    });
    let accept = table.word("no_drive_watchdog", &[("accept", true), ("refuse", false)]);
    Watchdog {
        timeout_ns: timeout_ns.unwrap_or(default.timeout_ns),
        accept_none: accept.unwrap_or(default.accept_none),
    }
}

/// Groups of Global_Control, a bit each.
fn groups(table: &mut Table<'_>) -> Option<u8> {
    table.read("groups", |value| {
        let bit = |value: &DeValue<'_>| match integer(value) {
            Some(group @ 1..=8) => Some(1_u8 << (group - 1)),
            _ => None,
        };
        let array = value.as_array().map(|array| array.iter().map(|group| bit(group.get_ref())));
        let mask = array.and_then(|mut bits| bits.try_fold(0, |mask, bit| Some(mask | bit?)));
        mask.ok_or("must be a list of groups of Global_Control, 1 ... 8".into())
    })
}

fn parameters(table: &mut Table<'_>, channel: bool) -> ParameterPath {
    table.table("parameters", |table| {
        let msac1 = |table: &mut Table<'_>| ParameterPath::Msac1 {
            slot: table.integer("slot", 0..=254, "the slot of the module").unwrap_or(0),
            index: table.integer("index", 0..=254, "the index of the data block").unwrap_or(47),
            axis: table.integer("axis", 0..=1, "the axis in a parameter request").unwrap_or(0),
            numbers: table
                .word("numbers", &[("from-top", Numbers::FromTop), ("code", Numbers::Code)])
                .unwrap_or_default(),
        };
        let by_msac1 = msac1(table);
        let words = [
            ("drivecom", ParameterPath::Drivecom),
            ("pkw", ParameterPath::Pkw),
            ("msac1", by_msac1),
            ("none", ParameterPath::None),
        ];
        let usual = if channel { ParameterPath::Drivecom } else { ParameterPath::None };
        let path = table.word("path", &words).unwrap_or(usual);
        if path != by_msac1 {
            for key in ["slot", "index", "axis", "numbers"] {
                if table.gives(key) {
                    table.fault(key, "concerns path = \"msac1\" only; leave it out");
                }
            }
        }
        path
    })
}

/// A bit, `{ bit = 12, set = false }`, or `"off"`.
fn enable_bit(table: &mut Table<'_>) -> Option<Option<StatusBit>> {
    const FORMS: &str = "must be a bit of the status word, 0 ... 15, { bit = 12, set = false }, or \"off\"";
    table.read("enable_bit", |value| {
        let bit = |value: &DeValue<'_>| match integer(value) {
            Some(bit @ 0..=15) => Some(bit as u8),
            _ => None,
        };
        if value.as_str() == Some("off") {
            return Ok(None);
        }
        let Some(parts) = value.as_table() else {
            return bit(value).map(|bit| Some(StatusBit { bit, set: true })).ok_or(FORMS.into());
        };
        let set = parts.get("set").map_or(Some(true), |set| set.get_ref().as_bool());
        let known = parts.iter().all(|(key, _)| matches!(&**key.get_ref(), "bit" | "set"));
        let bit = parts.get("bit").and_then(|value| bit(value.get_ref())).filter(|_| known);
        bit.zip(set).map(|(bit, set)| Some(StatusBit { bit, set })).ok_or(FORMS.into())
    })
}

fn scale(table: &mut Table<'_>, default: Scale) -> Scale {
    let word = |table: &mut Table<'_>, key, hint, default| {
        table.integer(key, 1..=(DATA_MAX / 2) as i128, hint).unwrap_or(default)
    };
    Scale {
        set_point: word(table, "set_point_word", "behind the control word, word 0", default.set_point),
        actual: word(table, "actual_word", "behind the status word, word 0", default.actual),
        full_count: table
            .integer("full_count", 1..=i16::MAX.into(), "the count of the full speed")
            .unwrap_or(default.full_count),
        full_rpm: table
            .number("full_rpm", 1e-3..=1e6, "the full speed, as C0011 has it, rpm")
            .unwrap_or(default.full_rpm),
    }
}

/// Up to four words of the inputs, or `false`.
fn monitor(value: &DeValue<'_>) -> Result<[Option<ShownWord>; MONITOR_CHANNELS], String> {
    let mut show = [const { None }; MONITOR_CHANNELS];
    if value.as_bool() == Some(false) {
        return Ok(show);
    }
    let array = value.as_array().filter(|array| (1..=MONITOR_CHANNELS).contains(&array.len()));
    let array = array.ok_or("must be false, or up to four words like [{ name = \"torque\", word = 2 }]")?;
    for (channel, value) in show.iter_mut().zip(array) {
        *channel = Some(shown(value.get_ref())?);
    }
    Ok(show)
}

fn shown(value: &DeValue<'_>) -> Result<ShownWord, String> {
    const FORMS: &str = "must be words like { name = \"torque\", word = 2, per_count = 0.0061, signed = true, unit = \
        \"%\" }";
    let parts = value.as_table().ok_or(FORMS)?;
    let mut word = ShownWord { name: String::new(), word: 0, per_count: 1.0, signed: false, unit: "" };
    for (key, value) in parts {
        let value = value.get_ref();
        match &**key.get_ref() {
            "name" => word.name = value.as_str().filter(|name| is_plain_name(name)).ok_or(FORMS)?.to_owned(),
            "word" => word.word = integer(value).and_then(|word| u8::try_from(word).ok()).ok_or(FORMS)?,
            "per_count" => word.per_count = number(value).ok_or(FORMS)?,
            "signed" => word.signed = value.as_bool().ok_or(FORMS)?,
            "unit" => {
                let unit = value.as_str().and_then(|unit| UNITS.into_iter().find(|known| *known == unit));
                word.unit = unit.ok_or_else(|| format!("has a unit that must be {}", alternatives(UNITS)))?;
            }
            _ => return Err(FORMS.into()),
        }
    }
    if word.name.is_empty() || !parts.contains_key("word") { Err(FORMS.into()) } else { Ok(word) }
}
