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
use fieldbeat_keys::key::Key;
use fieldbeat_keys::keys;
use fieldbeat_keys::machine::Machine;
use fieldbeat_keys::table::{Table, integer, list, number, set};
use fieldbeat_keys::value::{SHORT_NAME, alternatives};

keys! {
    DEVICE "device" = "-": "serial port: `\"/dev/ttyS1\"`; or `\"local:NAME\"`, a simulated wire on this "
        "host";
    RATE "rate" = "1500000": "bit/s: 9600, 19200, 45450, 93750, 187500, 500000, 1500000, 3000000, 6000000 "
        "or 12000000. The driver's rate is read back; more than 0.3 % off is refused";
    OWN_ADDRESS "address" = "2": "address of this master, 0 ... 125";
    RETRIES "retries" = "1": "how often a request without a correct answer is repeated, 1 ... 15";
    TOKEN "token" = "true": "sends a token to itself in each round, as a bus monitor expects it. The token "
        "is claimed in any case";
    GAP "gap" = "100": "rounds between two searches for another master, 1 ... 100; or `\"off\"`";
    HIGHEST_ADDRESS "highest_address" = "126": "up to it another master is looked for";
    GLOBAL_CONTROL "global_control" = "100ms": "how often Global_Control with Operate is sent, 1 ms ... 10 "
        "s";
    ECHO "echo" = "false": "the adapter returns what the master sends; that is skipped. An adapter that "
        "does so unannounced is named by a remark";
    RS485 "rs485" = "adapter": "who switches the direction of the wire: `\"adapter\"` by itself, "
        "`\"driver\"` by RTS";
    LATENCY "latency" = "0us": "what the port's driver adds before a byte is read, at most 100 ms: it "
        "extends the slot time. USB adapters add milliseconds, and so do simulated drives on a busy "
        "computer";
    MAX_TSDR "max_tsdr" = "(60 up to 187.5 kbit/s but 250 at 45.45, then 100, 150, 250, 450, 800)":
        "MaxTsdr: the slowest drive begins to answer after so many bits, `MaxTsdr_` of its GSD";
    BITS_SLOT "slot" = "(100 up to 187.5 kbit/s but 640 at 45.45, then 200, 300, 400, 600, 1000)":
        "slot time Tsl, bits: an answer has begun by then. More than `bits.max_tsdr` + 15";
    SYNC "sync" = "33": "Tsyn, bits: silence before each request";
    IDLE "idle" = "33": "Tid1, bits: silence after an answer and after a token";
    IDLE_UNANSWERED "idle_unanswered" = "(`bits.max_tsdr`)": "Tid2, bits: silence after a request that "
        "nobody answers, at least 33";
    ADDRESS "address" = "-": "address that is set at the module, 0 ... 125; one drive per address";
    IDENT "ident" = "0x0082": "ident number of the module. The default is that of the module before it, "
        "2130IB: look into the GSD";
    USER_PRM "user_prm" = "[0x80, 0, 0]": "User_Prm, up to 237 bytes. The first byte has the bits of "
        "DP-V1: 0x80 enables it, 0x04 counts the watchdog in 1 ms";
    CONFIGURATION "configuration" = "[0xF3, 0xF1]": "identifier bytes of Chk_Cfg. The default is 4 words "
        "of parameter channel and 2 words of process data in both directions";
    WATCHDOG "watchdog" = "100ms": "the drive stops when it is not addressed for this time, up to 650 s "
        "(65 s in 1 ms); or `\"off\"`. Set_Prm sets it, and it has to show in the diagnosis before the "
        "drive is enabled";
    NO_DRIVE_WATCHDOG "no_drive_watchdog" = "refuse": "a drive without `watchdog` is not enabled, or is "
        "with `\"accept\"`";
    MIN_TSDR "min_tsdr" = "11": "the drive answers no sooner, bits: 11 ... 255; 0: it keeps what it has";
    MIN_SLAVE_INTERVAL "min_slave_interval" = "0us": "the drive is not addressed again sooner, from the "
        "begin of one turn to that of the next: Min_Slave_Intervall of its GSD, in units of 100 µs there. "
        "A `divisor` that asks for more is refused, and a turn that follows a late one waits";
    WORDS "words" = "drivecom": "state machine of control word and status word: `\"drivecom\"`, or "
        "`\"profidrive\"`";
    CHANNEL "channel" = "true": "the process data begin with a parameter channel of 8 bytes, whether it is "
        "used or not";
    RAMP_BITS "ramp_bits" = "true": "bits 4 to 6 of the control word let the ramp generator follow the set "
        "point (0x007F); without them the run value is 0x000F";
    FURTHER "further" = "[]": "further words of the outputs, until the application writes others in native "
        "mode";
    MONITOR "monitor" = "false": "up to four words of the inputs that are shown with the feedback: `{ name "
        "= \"torque\", word = 2, per_count = 0.0061, signed = true, unit = \"%\" }`; `per_count`, `signed` "
        "and `unit` may be left out. Units: %, A, V, Hz, rpm, Nm, W, °C";
    FAULT_AT "fault_at" = "1": "the fault code is the word at this byte of the extended diagnosis, 0 ... "
        "242, counted from its header; or `\"off\"`";
    EXTENDED_DIAGNOSIS "extended_diagnosis" = "3": "most bytes of the extended diagnosis, for the time of "
        "a turn: Max_Diag_Data_Len of the GSD less 6";
    GROUPS "groups" = "[]": "groups of Global_Control that the drive belongs to, 1 ... 8. This master "
        "addresses all of them";
    PAUSE "pause" = "true": "with `\"pkw\"`: between two jobs there is none, until the drive shows that it "
        "knows; `false`: only between two jobs of the same code";
    SLOT "slot" = "0": "slot of the module, with `\"msac1\"`";
    INDEX "index" = "47": "index of the data block, with `\"msac1\"`";
    AXIS "axis" = "0": "axis in a parameter request, 0 or 1, with `\"msac1\"`";
    NUMBERS "numbers" = "from-top": "index of a code, with `\"msac1\"`: `\"from-top\"` is 24575 - code, "
        "`\"code\"` the code itself";
    PATH "path" = "(`\"drivecom\"`, `\"none\"` without `channel`)": "how parameters are read and written: "
        "`\"drivecom\"` or `\"pkw\"` in the channel, `\"msac1\"` by DP-V1, `\"none\"`";
    ENABLE_BIT "enable_bit" = "(`4` with DRIVECOM)": "bit of the status word that shows the hardware "
        "enable: a number, `{ bit = 12, set = false }` if it is enabled while the bit is clear, or "
        "`\"off\"`. None with PROFIdrive";
    SET_POINT_WORD "set_point_word" = "1": "word of the outputs that is the set point; word 0 is the "
        "control word";
    ACTUAL_WORD "actual_word" = "1": "word of the inputs that is the actual value; word 0 is the status "
        "word";
    FULL_COUNT "full_count" = "16384": "count of the set point and of the actual value at the full speed";
    FULL_RPM "full_rpm" = "1500": "full speed, as C0011 has it, rpm. Nothing compares them: where C0011 is "
        "written, by `param` too, the drive turns at the same set point by another speed, and the limits "
        "do not know. Change both";
}

/// This protocol, for the list of all of them.
pub const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "Lenze with EMF2133IB",
    read: bus,
    outline: outline::OUTLINE,
    telegrams: telegrams::TELEGRAMS,
};

/// The units of a shown word.
const UNITS: [&str; 9] = ["", "%", "A", "V", "Hz", "rpm", "Nm", "W", "°C"];

/// Reads a `[[bus]]`.
pub fn bus(table: &mut Table<'_>, machine: &mut Machine) -> Box<dyn BusPlan> {
    let name = machine.bus_name(table, PROTOCOL);
    let device = interface(table, machine, DEVICE, "a serial port, like \"/dev/ttyS1\", or \"local:NAME\"");
    let rate = table.read(RATE, Form::numbers(RATES.map(i128::from)), |value| {
        let rate = integer(value).and_then(|rate| u32::try_from(rate).ok());
        rate.filter(|rate| RATES.contains(rate)).ok_or_else(|| format!("must be {} bit/s", rates()))
    });
    let mut plan = ProfibusPlan::new("", rate.unwrap_or(ProfibusPlan::RATE), Vec::new());
    let addresses = 0..=ADDRESS_MAX.into();
    set(&mut plan.address, table.integer(OWN_ADDRESS, addresses));
    bits(table, &mut plan.bits);
    set(&mut plan.retries, table.integer(RETRIES, 1..=RETRIES_MAX.into()));
    set(&mut plan.token, table.flag(TOKEN));
    set(&mut plan.gap, integer_or_off(table, GAP, 1..=GAP_MAX.into()));
    set(&mut plan.highest_address, table.integer(HIGHEST_ADDRESS, 1..=STATION_MAX.into()));
    set(&mut plan.global_control_ns, table.time(GLOBAL_CONTROL, CONTROL_RANGE_NS));
    set(&mut plan.echo, table.flag(ECHO));
    set(&mut plan.rs485, table.word(RS485, &[("adapter", Rs485::Adapter), ("driver", Rs485::Driver)]));
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
    set(&mut bits.latency_ns, table.time(LATENCY, ..=LATENCY_MAX_NS));
    table.table("bits", |table| {
        let mut read = |place: &mut u32, key, least: u32| {
            set(place, table.integer(key, i128::from(least)..=BITS_MAX.into()));
        };
        read(&mut bits.max_tsdr, MAX_TSDR, TSDR_MIN.into());
        // The others follow it.
        bits.slot = bits.slot.max(bits.max_tsdr + SLOT_MARGIN_BITS + 1);
        bits.idle_unanswered = bits.max_tsdr.max(SYNC_BITS);
        read(&mut bits.slot, BITS_SLOT, 1);
        read(&mut bits.sync, SYNC, SYNC_BITS);
        read(&mut bits.idle, IDLE, SYNC_BITS);
        read(&mut bits.idle_unanswered, IDLE_UNANSWERED, SYNC_BITS);
    });
}

/// A whole number, or `"off"`.
fn integer_or_off<T: TryFrom<i128>>(
    table: &mut Table<'_>,
    key: Key,
    range: RangeInclusive<i128>,
) -> Option<Option<T>> {
    let number =
        |value: &DeValue<'_>| integer(value).filter(|number| range.contains(number))?.try_into().ok();
    table.read_or(key, Form::integer(range.clone()), "off", |value| {
        number(value).ok_or_else(|| format!("must be {} ... {}", range.start(), range.end()))
    })
}

fn drive(table: &mut Table<'_>, machine: &mut Machine) -> LenzeDrive {
    let axis = axis(table, machine, Counts::revolutions(1.0));
    let address = table.integer(ADDRESS, 0..=ADDRESS_MAX.into());
    let mut drive = LenzeDrive { axis, ..LenzeDrive::new("", address.unwrap_or(ADDRESS_MAX)) };
    set(&mut drive.ident, table.integer(IDENT, 0..=0xFFFF));
    set(&mut drive.user_prm, table.byte_list(USER_PRM, USER_PRM_MAX));
    set(&mut drive.configuration, table.byte_list(CONFIGURATION, DATA_MAX));
    set(&mut drive.watchdog.timeout_ns, table.time_or_off(WATCHDOG, MS..));
    set(&mut drive.watchdog.accept_none, accepts_no_watchdog(table, NO_DRIVE_WATCHDOG));
    set(&mut drive.min_tsdr, table.integer(MIN_TSDR, 0..=255));
    let interval_ns = table.time(MIN_SLAVE_INTERVAL, ..=INTERVAL_MAX_NS);
    set(&mut drive.min_slave_interval_ns, interval_ns);
    set(&mut drive.group, groups(table));
    let words = [("drivecom", DriveProfile::Drivecom), ("profidrive", DriveProfile::Profidrive)];
    set(&mut drive.profile, table.word(WORDS, &words));
    set(&mut drive.channel, table.flag(CHANNEL));
    drive.parameters = parameters(table, drive.channel);
    set(&mut drive.ramp_bits, table.flag(RAMP_BITS));
    drive.enable_bit = enable_bit(table).unwrap_or(drive.profile.usual_enable_bit());
    scale(table, &mut drive.scale);
    drive.further = table.integers(FURTHER, DATA_MAX / 2, u16::MAX);
    let wrong = "must be false, or up to four words like [{ name = \"torque\", word = 2 }]";
    set(&mut drive.show, table.some_of(MONITOR, shown_form(), wrong, shown));
    set(&mut drive.fault_at, integer_or_off(table, FAULT_AT, 0..=242));
    set(&mut drive.extended_diagnosis, table.integer(EXTENDED_DIAGNOSIS, 0..=238));
    table.later("simulate");
    drive
}

/// Groups of Global_Control, a bit each.
fn groups(table: &mut Table<'_>) -> Option<u8> {
    table.read(GROUPS, Form::integer(1..=8).any_list(), |value| {
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
        let pkw = ParameterPath::Pkw { pause: table.flag(PAUSE).unwrap_or(true) };
        let numbers = [("from-top", Numbers::FromTop), ("code", Numbers::Code)];
        let msac1 = ParameterPath::Msac1 {
            slot: table.integer(SLOT, 0..=254).unwrap_or(0),
            index: table.integer(INDEX, 0..=254).unwrap_or(47),
            axis: table.integer(AXIS, 0..=1).unwrap_or(0),
            numbers: table.word(NUMBERS, &numbers).unwrap_or_default(),
        };
        let (drivecom, none) = (ParameterPath::Drivecom, ParameterPath::None);
        let words = [("drivecom", drivecom), ("pkw", pkw), ("msac1", msac1), ("none", none)];
        let path = table.word(PATH, &words).unwrap_or(if channel { drivecom } else { none });
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
    const FORMS: &str = "must be a bit of the status word, 0 ... 15, { bit = 12, set = false }";
    let bit = || Form::integer(0..=15);
    let parts = Form::Fields(vec![("bit", bit(), true), ("set", Form::Flag, false)]);
    table.read_or(ENABLE_BIT, bit().or(parts), "off", |value| {
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
    set(&mut scale.set_point, table.integer(SET_POINT_WORD, words.clone()));
    set(&mut scale.actual, table.integer(ACTUAL_WORD, words));
    set(&mut scale.full_count, table.integer(FULL_COUNT, 1..=i16::MAX.into()));
    set(&mut scale.full_rpm, table.number(FULL_RPM, 1e-3..=1e6));
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
