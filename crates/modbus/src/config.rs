//! `protocol = "modbus-tcp"`.

mod outline;
mod telegrams;

/// It adds no command to the program.
pub const TOOLS: &[fieldbeat_tools::Tool] = &[];

use fieldbeat_keys::Protocol;
use std::net::Ipv4Addr;

use toml::de::DeValue;

use super::PROTOCOL;
use super::parameter::{Addressing, Parameter, Width, catalogue};
use super::plan::{Functions, Map, Mapped, ModbusPlan, PORT, UnidriveDrive, Via, WATCHDOG_MAX_NS, Watchdog};
use fieldbeat_core::bus::BusPlan;
use fieldbeat_core::time::{MS, S, US};
use fieldbeat_keys::bus::{accepts_no_watchdog, address, drives};
use fieldbeat_keys::drive::{Counts, axis};
use fieldbeat_keys::form::Form;
use fieldbeat_keys::keys;
use fieldbeat_keys::machine::{Claim, Machine};
use fieldbeat_keys::table::{Table, elements, integer, set};
use fieldbeat_keys::value::{HOST, unknown};

keys! {
    BIND "bind" = "none": "address of the network adapter that the connections leave from: "
        "`\"192.168.1.1\"`. Without it the routes of this computer decide. A drive that accepts one "
        "computer only sees this address";
    ADDRESS "address" = "-": "address of the drive: `\"192.168.1.20\"`, or with another port than 502. One "
        "drive per address and port";
    SERIAL "serial" = "any": "required serial number, up to eighteen digits, read in each handshake before "
        "anything is written. A drive with another one stays not connected, and one line has both. Without "
        "it whatever drive answers at the address is taken. `fieldbeat pin` writes it";
    UNIT "unit" = "(255, then 0)": "Modbus unit id of the drive, 0 ... 255; without the key, 255 is tried "
        "first and 0 if that is not answered";
    SLOT "slot" = "4": "slot of the Ethernet interface: 4 is the onboard one (M700, M702), 1 ... 3 has an "
        "SI-Ethernet option (M701)";
    ADDRESSING "addressing" = "standard": "how parameters become Modbus addresses, as Pr S.15.013 is set: "
        "`\"standard\"` has 100 a menu, `\"modified\"` 256";
    FUNCTION "function" = "auto": "Modbus functions of the exchange: `\"23\"` writes and reads in one "
        "request, `\"16+3\"` in two, in turns. `\"auto\"` uses FC23, and FC16 and FC3 for the rest of the "
        "run with a drive that refuses FC23, ignores it or closes the connection on it";
    REPLY_WITHIN "reply_within" = "250ms": "longest time to a reply; nothing else is sent to this drive "
        "meanwhile. Without a reply for twice as long, the connection is closed and opened again. Below "
        "210 ms one lost frame costs the link: TCP repeats it after 200 ms. With a `watchdog.timeout` "
        "below 250 ms and two exchanges, the default is shorter by these, and at least half the time-out";
    SET_UP "set_up" = "true": "before the first Enable, sets the drive's RAM to what the master needs; "
        "`false` only verifies it";
    CONTROL "control" = "06.042": "control word";
    REFERENCE "reference" = "01.021": "speed setpoint";
    STATUS "status" = "\"10.040\"": "status word";
    SPEED "speed" = "03.002": "speed feedback";
    TRIP "trip" = "\"10.020\"": "number of the last trip, or `\"off\"`";
    MONITOR "monitor" = "[\"04.020\"]": "up to four parameters that are shown with the feedback, or `false`";
    ALSO_READ "also_read" = "[]": "further parameters for the native process data; ranges as `\"20.021 ... "
        "20.030\"`";
    SERIAL_FROM "serial_from" = "[\"11.052\", \"11.053\"]": "where it is read (assumed): the lower nine "
        "digits, and those above them, two parameters of 32 bits";
    VIA "via" = "direct": "`\"direct\"` reads and writes one block of parameters in each request, in "
        "turns. `\"menu-0\"` sets the drive to show all of them in menu 0, and each request carries all. "
        "`{ menu_0 = 11 }` begins at Pr 00.011";
    TIMEOUT "timeout" = "500ms": "the drive trips after so long without Modbus traffic (Pr S.15.009); "
        "`\"off\"` leaves that parameter as it is";
    KEYPAD "keypad" = "false": "the watchdog in bit 14 of the control word, about 1 s";
    NO_DRIVE_WATCHDOG "no_drive_watchdog" = "refuse": "a drive with neither watchdog is not enabled, or is "
        "with `\"accept\"`";
}

/// This protocol, for the list of all of them.
pub const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "Nidec Unidrive",
    read: bus,
    outline: outline::OUTLINE,
    telegrams: telegrams::TELEGRAMS,
};

/// Reads a `[[bus]]`.
pub fn bus(table: &mut Table<'_>, machine: &mut Machine) -> Box<dyn BusPlan> {
    let name = machine.bus_name(table, PROTOCOL);
    let bind = bind(table);
    let drives = drives(table, |table, _| drive(table, machine, bind));
    Box::new(ModbusPlan { name, bind, drives })
}

fn bind(table: &mut Table<'_>) -> Option<Ipv4Addr> {
    let hint = "the IPv4 address of an adapter, like \"192.168.1.1\", without a port; leave it out for \
         whichever leads to the drives";
    // The port is the kernel's choice.
    let own = |text: &str| text.parse().ok().filter(|ip: &Ipv4Addr| !ip.is_unspecified());
    table.text(BIND, HOST, hint, |text| own(text).filter(|ip| !ip.is_multicast() && !ip.is_broadcast()))
}

fn drive(table: &mut Table<'_>, machine: &mut Machine, bind: Option<Ipv4Addr>) -> UnidriveDrive {
    let axis = axis(table, machine, Counts::revolutions(1.0));
    let address = address(table, machine, bind, ADDRESS, ("192.168.1.20", PORT), Claim::Port);
    let period_ns = machine.period_ns.saturating_mul(u64::from(axis.divisor));
    let mut drive = UnidriveDrive { axis, address, ..UnidriveDrive::new("", *address.ip()) };
    let serials = 0..=UnidriveDrive::SERIAL_MAX.into();
    set(&mut drive.serial, table.integer_or_any(SERIAL, serials));
    set(&mut drive.serial_from, serial_from(table));
    drive.unit = table.integer(UNIT, 0..=255);
    set(&mut drive.slot, table.integer(SLOT, 1..=4));
    let words = [("standard", Addressing::Standard), ("modified", Addressing::Modified)];
    set(&mut drive.addressing, table.word(ADDRESSING, &words));
    map(table, &mut drive.map);
    set(&mut drive.via, via(table));
    let words = [("auto", Functions::Auto), ("23", Functions::ReadWrite), ("16+3", Functions::Apart)];
    set(&mut drive.functions, table.word(FUNCTION, &words));
    let reply_within_ns = table.time(REPLY_WITHIN, 100 * US..=10 * S);
    watchdog(table, &mut drive.watchdog);
    set(&mut drive.set_up, table.flag(SET_UP));
    let usual_ns = UnidriveDrive::usual_reply_within(&drive.watchdog, period_ns);
    drive.reply_within_ns = reply_within_ns.unwrap_or(usual_ns);
    table.later("simulate");
    table.faults(drive.faults(period_ns));
    drive
}

fn map(table: &mut Table<'_>, map: &mut Map) {
    table.table("map", |table| {
        let mut read = |place: &mut Mapped, key| set(place, table.read(key, parameter_form(), one));
        read(&mut map.control, CONTROL);
        read(&mut map.reference, REFERENCE);
        read(&mut map.status, STATUS);
        read(&mut map.speed, SPEED);
        let trip = table.read(TRIP, parameter_form(), |value| match value.as_str() {
            Some("off") => Ok(None),
            _ => one(value).map(Some),
        });
        set(&mut map.trip, trip);
    });
    let wrong = "must be false, or up to four parameters like [\"04.020\", \"dc-bus-voltage\"]";
    set(&mut map.show, table.some_of(MONITOR, parameter_form(), wrong, one));
    set(&mut map.also, table.read(ALSO_READ, parameter_form().any_list(), also_read));
}

/// Parameters, and ranges of them.
fn also_read(value: &DeValue<'_>) -> Result<Vec<Mapped>, String> {
    let wrong = "must be a list of parameters like [\"20.021 ... 20.030\", \"05.005\"]";
    let spans: Result<Vec<_>, _> = elements(value, ..).ok_or(wrong)?.map(span).collect();
    spans.map(|spans| spans.concat())
}

/// Exactly one parameter.
fn one(value: &DeValue<'_>) -> Result<Mapped, String> {
    match span(value)?.as_slice() {
        [mapped] => Ok(*mapped),
        _ => Err("must be one parameter; ranges go into also_read".into()),
    }
}

const FORMS: &str = "must be a parameter like \"06.042\" or \"control-word\", or { parameter = \"18.011\", \
    bits = 32, decimals = 1 }";

/// What [`span`] takes.
fn parameter_form() -> Form {
    let bits = Form::numbers([16, 32]);
    let decimals = Form::integer(0..=9);
    Form::Text(None).or(Form::Fields(vec![
        ("parameter", Form::Text(None), true),
        ("bits", bits, false),
        ("decimals", decimals, false),
    ]))
}

/// A parameter that is known, or one with its size in a table: or several in a row, `"20.021 ... 20.030"`.
fn span(value: &DeValue<'_>) -> Result<Vec<Mapped>, String> {
    let size = Size::of(value)?;
    let text =
        value.as_table().map_or(value, |table| table.get("parameter").map_or(value, |text| text.get_ref()));
    let text = text.as_str().ok_or(FORMS)?;
    let Some((first, last)) = text.split_once("...") else { return Ok(vec![size.mapped(parameter(text)?)?]) };
    let (first, last) = (parameter(first.trim())?, parameter(last.trim())?);
    if (first.slot, first.menu) != (last.slot, last.menu) || first.number > last.number {
        return Err("must rise within one menu; like \"20.021 ... 20.030\"".into());
    }
    (first.number..=last.number).map(|number| size.mapped(Parameter { number, ..first })).collect()
}

fn parameter(text: &str) -> Result<Parameter, String> {
    let named = || catalogue::named(text, false).map(|known| known.parameter);
    text.parse().ok().or_else(named).ok_or_else(|| {
        let names = catalogue::all().filter(|known| known.parameter.slot == 0).map(|known| known.name);
        unknown("parameter", text, names, FORMS)
    })
}

/// What a file says of the size of parameters.
#[derive(Clone, Copy, Debug, Default)]
struct Size {
    width: Option<Width>,
    decimals: Option<u32>,
}

impl Size {
    /// Nothing, unless `value` is a table.
    fn of(value: &DeValue<'_>) -> Result<Size, String> {
        let Some(table) = value.as_table() else { return Ok(Size::default()) };
        let mut size = Size::default();
        for (key, value) in table {
            let key: &str = key.get_ref();
            match (key, integer(value.get_ref())) {
                ("parameter", _) => {}
                ("bits", Some(16)) => size.width = Some(Width::Word),
                ("bits", Some(32)) => size.width = Some(Width::Long),
                ("bits", _) => return Err("must have bits = 16 or bits = 32".into()),
                ("decimals", Some(decimals @ 0..=9)) => size.decimals = u32::try_from(decimals).ok(),
                ("decimals", _) => return Err("must have decimals = 0 ... 9".into()),
                _ => return Err(FORMS.into()),
            }
        }
        if table.contains_key("parameter") { Ok(size) } else { Err(FORMS.into()) }
    }

    /// A parameter of this size; what the file does not say is known, or a mistake.
    fn mapped(self, parameter: Parameter) -> Result<Mapped, String> {
        let known = parameter.known();
        let width = self.width.or(known.map(|known| known.width)).ok_or_else(|| {
            format!(
                "{parameter} is not known here; write {{ parameter = \"{parameter}\", bits = .., decimals = \
                 .. }} if your drive has it"
            )
        })?;
        let decimals = self.decimals.or(known.map(|known| known.decimals)).unwrap_or(0);
        Ok(Mapped { parameter, width, decimals })
    }
}

/// The two parameters with a serial number.
fn serial_from(table: &mut Table<'_>) -> Option<[Parameter; 2]> {
    table.read(SERIAL_FROM, Form::Text(None).list(2, 2), |value| {
        let wrong = "must be two parameters like [\"11.052\", \"11.053\"]";
        let mut both = elements(value, 2..=2).ok_or(wrong)?;
        let mut next = || both.next().and_then(DeValue::as_str).ok_or(FORMS.to_owned()).and_then(parameter);
        Ok([next()?, next()?])
    })
}

/// `"direct"`, `"menu-0"`, or `{ menu_0 = 11 }`: from that place on.
fn via(table: &mut Table<'_>) -> Option<Via> {
    const FORMS: &str = "must be \"direct\", \"menu-0\", or { menu_0 = 11 } for menu 0 from Pr 00.011 on";
    let from = Form::Fields(vec![("menu_0", Form::integer(1..=80), true)]);
    table.read(VIA, Form::words(["direct", "menu-0"]).or(from), |value| match value.as_str() {
        Some("direct") => Ok(Via::Direct),
        Some("menu-0") => Ok(Via::Menu0 { first: 1 }),
        Some(_) => Err(FORMS.into()),
        None => {
            let only = value.as_table().filter(|table| table.len() == 1);
            let first = only.and_then(|table| integer(table.get("menu_0")?.get_ref()));
            let first = first.filter(|first| (1..=80).contains(first)).map(|first| first as u8);
            first.map(|first| Via::Menu0 { first }).ok_or(FORMS.into())
        }
    })
}

fn watchdog(table: &mut Table<'_>, watchdog: &mut Watchdog) {
    table.table("watchdog", |table| {
        set(&mut watchdog.timeout_ns, table.time_or_off(TIMEOUT, MS..=WATCHDOG_MAX_NS));
        set(&mut watchdog.keypad, table.flag(KEYPAD));
    });
    set(&mut watchdog.accept_none, accepts_no_watchdog(table, NO_DRIVE_WATCHDOG));
}
