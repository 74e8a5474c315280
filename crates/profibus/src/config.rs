//! `protocol = "profibus-dp"`.

mod outline;
pub mod scan;
mod telegrams;
mod tools;

pub use self::tools::TOOLS;

use fieldbeat_keys::Protocol;
use std::ops::RangeInclusive;

use toml::de::DeValue;

use super::PROTOCOL;
use super::check::{
    BITS_MAX, CONTROL_RANGE_NS, GAP_MAX, INTERVAL_MAX_NS, LATENCY_MAX_NS, SYNC_BITS, TSDR_MIN, USER_PRM_MAX,
    rates,
};
use super::plan::{
    ADDRESS_MAX, Bits, DATA_MAX, DriveProfile, LenzeDrive, Numbers, ParameterPath, ProfibusPlan, RATES,
    RETRIES_MAX, Rs485, SLOT_MARGIN_BITS, Scale, ShownWord, StatusBit,
};
use super::wire::telegram::STATION_MAX;
use fieldbeat_core::axis::{Faults, is_plain_name};
use fieldbeat_core::bus::{BusPlan, Grid};
use fieldbeat_core::time::MS;
use fieldbeat_keys::bus::{accepts_no_watchdog, drive_tables, interface};
use fieldbeat_keys::drive::{Counts, axis};
use fieldbeat_keys::form::Form;
use fieldbeat_keys::machine::Machine;
use fieldbeat_keys::table::{Table, integer, list, number, set};
use fieldbeat_keys::value::{SHORT_NAME, alternatives};

/// This protocol, for the list of all of them.
pub const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "Lenze with EMF2133IB",
    read: bus,
    reference: include_str!("../files/configuration-profibus.md"),
    specimen: SPECIMEN,
    outline: outline::OUTLINE,
    telegrams: telegrams::TELEGRAMS,
};

/// The units of a shown word.
const UNITS: [&str; 9] = ["", "%", "A", "V", "Hz", "rpm", "Nm", "W", "°C"];

/// What its device is, where it is missing and where it is wrong.
const DEVICE: [&str; 2] = [
    "a serial port, like \"/dev/ttyS1\", or \"local:NAME\"",
    "a serial port, like \"/dev/ttyS1\", or \"local:NAME\", a simulated wire on this host",
];

/// With each table that may be missing.
pub const SPECIMEN: &str = "device = \"local:x\"\n[[bus.drive]]\nname = \"x\"\naddress = 3\n";

/// Reads a `[[bus]]`.
pub fn bus(table: &mut Table<'_>, machine: &mut Machine) -> Box<dyn BusPlan> {
    let name = machine.bus_name(table, PROTOCOL);
    let device = interface(table, machine, "device", DEVICE);
    let rate = table.read("rate", Form::numbers(RATES.map(i128::from)), |value| {
        let rate = integer(value).and_then(|rate| u32::try_from(rate).ok());
        rate.filter(|rate| RATES.contains(rate)).ok_or_else(|| format!("must be {} bit/s", rates()))
    });
    let mut plan = ProfibusPlan::new("", rate.unwrap_or(ProfibusPlan::RATE), Vec::new());
    let addresses = 0..=ADDRESS_MAX.into();
    set(&mut plan.address, table.integer("address", addresses, "the address of this master, 2 unless given"));
    bits(table, &mut plan.bits);
    let retries = "how often a request without an answer is repeated";
    set(&mut plan.retries, table.integer("retries", 1..=RETRIES_MAX.into(), retries));
    set(&mut plan.token, table.flag("token"));
    let gap = format!("1 ... {GAP_MAX} rounds between two searches for another master");
    set(&mut plan.gap, integer_or_off(table, "gap", 1..=GAP_MAX.into(), &gap));
    let highest = "up to it another master is looked for";
    set(&mut plan.highest_address, table.integer("highest_address", 1..=STATION_MAX.into(), highest));
    let control = "how often Global_Control is sent";
    set(&mut plan.global_control_ns, table.time("global_control", CONTROL_RANGE_NS, control));
    set(&mut plan.echo, table.flag("echo"));
    set(&mut plan.rs485, table.word("rs485", &[("adapter", Rs485::Adapter), ("driver", Rs485::Driver)]));
    let mut drives = drive_tables(table, &["name", "address"]);
    let of_drives = drives.iter_mut().map(|table| drive(table, machine)).collect();
    let plan = ProfibusPlan { name, device: device.clone().unwrap_or_default(), drives: of_drives, ..plan };
    table.later("simulate");
    for fault in plan.own_faults() {
        // Missing, or already reported.
        if fault.key != "device" || device.is_some() {
            table.fault(fault.key, fault.message);
        }
    }
    let mut is_wrong = false;
    for (index, (table, drive)) in drives.iter().zip(&plan.drives).enumerate() {
        let mut faults = plan.drive_faults(drive);
        let same = plan.drives[..index].iter().any(|other| other.address == drive.address);
        faults.wrong_if(same && table.gives("address"), "address", super::ADDRESS_TAKEN);
        is_wrong |= !faults.is_empty();
        table.faults(faults);
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

fn bits(table: &mut Table<'_>, bits: &mut Bits) {
    let latency = "what the driver adds before a byte is read";
    set(&mut bits.latency_ns, table.time("latency", ..=LATENCY_MAX_NS, latency));
    table.table("bits", |table| {
        let mut read = |place: &mut u32, key, least: u32, hint| {
            set(place, table.integer(key, i128::from(least)..=BITS_MAX.into(), hint));
        };
        let tsdr = "the slowest drive answers within so many bits";
        read(&mut bits.max_tsdr, "max_tsdr", TSDR_MIN.into(), tsdr);
        // The others follow it.
        bits.slot = bits.slot.max(bits.max_tsdr + SLOT_MARGIN_BITS + 1);
        bits.idle_unanswered = bits.max_tsdr.max(SYNC_BITS);
        read(&mut bits.slot, "slot", 1, "an answer has begun after so many bits");
        read(&mut bits.sync, "sync", SYNC_BITS, "the silence before a request, bits");
        read(&mut bits.idle, "idle", SYNC_BITS, "the silence after an answer, bits");
        let unanswered = "the silence after a request that nobody answers, bits";
        read(&mut bits.idle_unanswered, "idle_unanswered", SYNC_BITS, unanswered);
    });
}

/// A whole number that is `hint`, or `"off"`.
fn integer_or_off<T: TryFrom<i128>>(
    table: &mut Table<'_>,
    key: &'static str,
    range: RangeInclusive<i128>,
    hint: &str,
) -> Option<Option<T>> {
    let number =
        |value: &DeValue<'_>| integer(value).filter(|number| range.contains(number))?.try_into().ok();
    table.read_or(key, Form::integer(range.clone()), "off", |value| {
        number(value).ok_or_else(|| format!("must be {hint}, or \"off\""))
    })
}

fn drive(table: &mut Table<'_>, machine: &mut Machine) -> LenzeDrive {
    let axis = axis(table, machine, Counts::revolutions(1.0));
    table.require("address", "the address that is set at the module, 0 ... 125");
    let address = table.integer("address", 0..=ADDRESS_MAX.into(), "the address that is set at the module");
    let mut drive = LenzeDrive { axis, ..LenzeDrive::new("", address.unwrap_or(ADDRESS_MAX)) };
    let ident = "the ident number of the module, as its GSD has it";
    set(&mut drive.ident, table.integer("ident", 0..=0xFFFF, ident));
    set(&mut drive.user_prm, table.byte_list("user_prm", USER_PRM_MAX));
    set(&mut drive.configuration, table.byte_list("configuration", DATA_MAX));
    let watchdog = "the drive stops when it is not addressed for this time; or \"off\"";
    set(&mut drive.watchdog.timeout_ns, table.time_or_off("watchdog", MS.., watchdog));
    set(&mut drive.watchdog.accept_none, accepts_no_watchdog(table));
    let tsdr = "the drive answers no sooner, bits; 0: it keeps what it has";
    set(&mut drive.min_tsdr, table.integer("min_tsdr", 0..=255, tsdr));
    let interval = "Min_Slave_Intervall of its GSD, in units of 100us there";
    let interval_ns = table.time("min_slave_interval", ..=INTERVAL_MAX_NS, interval);
    set(&mut drive.min_slave_interval_ns, interval_ns);
    set(&mut drive.group, groups(table));
    let words = [("drivecom", DriveProfile::Drivecom), ("profidrive", DriveProfile::Profidrive)];
    set(&mut drive.profile, table.word("words", &words));
    set(&mut drive.channel, table.flag("channel"));
    drive.parameters = parameters(table, drive.channel);
    set(&mut drive.ramp_bits, table.flag("ramp_bits"));
    drive.enable_bit = enable_bit(table).unwrap_or(drive.profile.usual_enable_bit());
    scale(table, &mut drive.scale);
    drive.further = table.integers("further", DATA_MAX / 2, u16::MAX);
    let wrong = "must be false, or up to four words like [{ name = \"torque\", word = 2 }]";
    set(&mut drive.show, table.some_of("monitor", shown_form(), wrong, shown));
    let fault_at = "a byte of the extended diagnosis, 0 ... 242";
    set(&mut drive.fault_at, integer_or_off(table, "fault_at", 0..=242, fault_at));
    let most = "its most bytes, Max_Diag_Data_Len of its GSD less 6";
    set(&mut drive.extended_diagnosis, table.integer("extended_diagnosis", 0..=238, most));
    table.later("simulate");
    drive
}

/// Groups of Global_Control, a bit each.
fn groups(table: &mut Table<'_>) -> Option<u8> {
    table.read("groups", Form::integer(1..=8).any_list(), |value| {
        let bit = |value: &DeValue<'_>| match integer(value) {
            Some(group @ 1..=8) => Some(1_u8 << (group - 1)),
            _ => None,
        };
        let bits = list(value, .., bit).ok_or("must be a list of groups of Global_Control, 1 ... 8")?;
        Ok(bits.into_iter().fold(0, |mask, bit| mask | bit))
    })
}

fn parameters(table: &mut Table<'_>, channel: bool) -> ParameterPath {
    table.table("parameters", |table| {
        let pkw = ParameterPath::Pkw { pause: table.flag("pause").unwrap_or(true) };
        let numbers = [("from-top", Numbers::FromTop), ("code", Numbers::Code)];
        let msac1 = ParameterPath::Msac1 {
            slot: table.integer("slot", 0..=254, "the slot of the module").unwrap_or(0),
            index: table.integer("index", 0..=254, "the index of the data block").unwrap_or(47),
            axis: table.integer("axis", 0..=1, "the axis in a parameter request").unwrap_or(0),
            numbers: table.word("numbers", &numbers).unwrap_or_default(),
        };
        let (drivecom, none) = (ParameterPath::Drivecom, ParameterPath::None);
        let words = [("drivecom", drivecom), ("pkw", pkw), ("msac1", msac1), ("none", none)];
        let path = table.word("path", &words).unwrap_or(if channel { drivecom } else { none });
        let of_msac1 = ["slot", "index", "axis", "numbers"].map(|key| (key, msac1, "msac1"));
        for (key, of, name) in [("pause", pkw, "pkw")].into_iter().chain(of_msac1) {
            if path != of && table.gives(key) {
                table.fault(key, format!("concerns path = \"{name}\" only; leave it out"));
            }
        }
        path
    })
}

/// A bit, `{ bit = 12, set = false }`, or `"off"`.
fn enable_bit(table: &mut Table<'_>) -> Option<Option<StatusBit>> {
    const FORMS: &str = "must be a bit of the status word, 0 ... 15, { bit = 12, set = false }, or \"off\"";
    let bit = || Form::integer(0..=15);
    let parts = Form::Fields(vec![("bit", bit(), true), ("set", Form::Flag, false)]);
    table.read_or("enable_bit", bit().or(parts), "off", |value| {
        let bit = |value: &DeValue<'_>| match integer(value) {
            Some(bit @ 0..=15) => Some(bit as u8),
            _ => None,
        };
        let Some(parts) = value.as_table() else {
            return bit(value).map(|bit| StatusBit { bit, set: true }).ok_or(FORMS.into());
        };
        let set = parts.get("set").map_or(Some(true), |set| set.get_ref().as_bool());
        let known = parts.iter().all(|(key, _)| matches!(&**key.get_ref(), "bit" | "set"));
        let bit = parts.get("bit").and_then(|value| bit(value.get_ref())).filter(|_| known);
        bit.zip(set).map(|(bit, set)| StatusBit { bit, set }).ok_or(FORMS.into())
    })
}

fn scale(table: &mut Table<'_>, scale: &mut Scale) {
    let words = 1..=(DATA_MAX / 2) as i128;
    let hint = "behind the control word, word 0";
    set(&mut scale.set_point, table.integer("set_point_word", words.clone(), hint));
    set(&mut scale.actual, table.integer("actual_word", words, "behind the status word, word 0"));
    let count = "the count of the full speed";
    set(&mut scale.full_count, table.integer("full_count", 1..=i16::MAX.into(), count));
    let rpm = "the full speed, as C0011 has it, rpm";
    set(&mut scale.full_rpm, table.number("full_rpm", 1e-3..=1e6, rpm));
}

/// What [`shown`] takes.
fn shown_form() -> Form {
    Form::Fields(vec![
        ("name", Form::Text(Some(SHORT_NAME)), true),
        ("word", Form::integer(0..=255), true),
        ("per_count", Form::number(..), false),
        ("signed", Form::Flag, false),
        ("unit", Form::words(UNITS), false),
    ])
}

fn shown(value: &DeValue<'_>) -> Result<ShownWord, String> {
    const FORMS: &str =
        "must be words like { name = \"torque\", word = 2, per_count = 0.0061, signed = true, unit = \"%\" }";
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
