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
use fieldbeat_keys::machine::{Claim, Machine};
use fieldbeat_keys::table::{Table, elements, integer, set};
use fieldbeat_keys::value::{HOST, unknown};

/// This protocol, for the list of all of them.
pub const REGISTERED: Protocol = Protocol {
    name: PROTOCOL,
    drives: "Nidec Unidrive",
    read: bus,
    reference: include_str!("../files/configuration-modbus.md"),
    specimen: SPECIMEN,
    outline: outline::OUTLINE,
    telegrams: telegrams::TELEGRAMS,
};

/// With each table that may be missing.
pub const SPECIMEN: &str = "[[bus.drive]]\nname = \"x\"\naddress = \"127.0.0.2\"\n";

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
    table.text("bind", HOST, hint, |text| own(text).filter(|ip| !ip.is_multicast() && !ip.is_broadcast()))
}

fn drive(table: &mut Table<'_>, machine: &mut Machine, bind: Option<Ipv4Addr>) -> UnidriveDrive {
    let axis = axis(table, machine, Counts::revolutions(1.0));
    let address = address(table, machine, bind, ("192.168.1.20", PORT), Claim::Port);
    let period_ns = machine.period_ns.saturating_mul(u64::from(axis.divisor));
    let mut drive = UnidriveDrive { axis, address, ..UnidriveDrive::new("", *address.ip()) };
    let serials = 0..=UnidriveDrive::SERIAL_MAX.into();
    let serial = "the serial number that fieldbeat pin shows";
    set(&mut drive.serial, table.integer_or_any("serial", serials, serial));
    set(&mut drive.serial_from, serial_from(table));
    let unit = "the unit id of the drive; leave it out for 255, or 0 behind it";
    drive.unit = table.integer("unit", 0..=255, unit);
    let slot = "where its Ethernet interface is: 4 onboard, 1 ... 3 an SI-Ethernet option";
    set(&mut drive.slot, table.integer("slot", 1..=4, slot));
    let words = [("standard", Addressing::Standard), ("modified", Addressing::Modified)];
    set(&mut drive.addressing, table.word("addressing", &words));
    map(table, &mut drive.map);
    set(&mut drive.via, via(table));
    let words = [("auto", Functions::Auto), ("23", Functions::ReadWrite), ("16+3", Functions::Apart)];
    set(&mut drive.functions, table.word("function", &words));
    let reply = "the time within which a reply counts";
    let reply_within_ns = table.time("reply_within", 100 * US..=10 * S, reply);
    watchdog(table, &mut drive.watchdog);
    set(&mut drive.set_up, table.flag("set_up"));
    let usual_ns = UnidriveDrive::usual_reply_within(&drive.watchdog, period_ns);
    drive.reply_within_ns = reply_within_ns.unwrap_or(usual_ns);
    table.later("simulate");
    table.faults(drive.faults(period_ns));
    drive
}

fn map(table: &mut Table<'_>, map: &mut Map) {
    table.table("map", |table| {
        let mut read = |place: &mut Mapped, key| set(place, table.read(key, parameter_form(), one));
        read(&mut map.control, "control");
        read(&mut map.reference, "reference");
        read(&mut map.status, "status");
        read(&mut map.speed, "speed");
        let trip = table.read("trip", parameter_form(), |value| match value.as_str() {
            Some("off") => Ok(None),
            _ => one(value).map(Some),
        });
        set(&mut map.trip, trip);
    });
    let wrong = "must be false, or up to four parameters like [\"04.020\", \"dc-bus-voltage\"]";
    set(&mut map.show, table.some_of("monitor", parameter_form(), wrong, one));
    set(&mut map.also, table.read("also_read", parameter_form().any_list(), also_read));
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
    table.read("serial_from", Form::Text(None).list(2, 2), |value| {
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
    table.read("via", Form::words(["direct", "menu-0"]).or(from), |value| match value.as_str() {
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
    let hint = "the drive trips after this time without Modbus traffic; or \"off\"";
    table.table("watchdog", |table| {
        set(&mut watchdog.timeout_ns, table.time_or_off("timeout", MS..=WATCHDOG_MAX_NS, hint));
        set(&mut watchdog.keypad, table.flag("keypad"));
    });
    set(&mut watchdog.accept_none, accepts_no_watchdog(table));
}
