//! A machine's TOML file, read into a checked [`Plan`]. Everything that can be found out before anything is sent is
//! found out here, and every mistake names its file, line and key, and says what would be right.
//!
//! | file | what |
//! |---|---|
//! | `cycle` | `[cycle]`, and what would starve the host |
//! | `describe` | a plan in words |
//! | `json` | a plan as one JSON object |
//! | `reference` | the tables of the manual |
//! | `schema` | the JSON schema of a configuration |
//! | `demo` | the plan of `fieldbeat demo` |
//! | `soak` | `[soak]`: the moves and criteria of a soak test |
//!
//! Each protocol reads its own keys, in its package; what all of them have is in `fieldbeat-keys`.
//!
//! What follows is the reference of docs/, where users read it.
#![doc = include_str!("../files/configuration.md")]

mod cycle;
pub mod demo;
pub mod describe;
pub mod json;
mod reference;
pub mod schema;
pub mod soak;

use std::path::{Path, PathBuf};
use std::time::Duration;

pub use self::describe::describe;
pub use self::json::json;
pub use self::reference::reference;
pub use self::schema::schema;
pub use fieldbeat_keys::error::{ConfigError, ConfigErrors};

use self::soak::SoakPlan;
use fieldbeat_core::bus::BusPlan;
use fieldbeat_core::cycle::{GroupPlan, Plan};
use fieldbeat_keys::Protocol;
use fieldbeat_keys::file;
use fieldbeat_keys::form::Form;
use fieldbeat_keys::keys;
use fieldbeat_keys::machine::Machine;
use fieldbeat_keys::page::Page;
use fieldbeat_keys::table::{Table, list};
use fieldbeat_keys::value::{self, SHORT_NAME, plain_name};
use fieldbeat_sim::SimPlan;

keys! {
    CYCLE "cycle" = "none": "the cycle that all buses share";
    BUS "bus" = "(at least one)": "the buses: one `[[bus]]` each";
    PROTOCOL "protocol" = "-": "`\"linudp-v2\"` (LinMot), `\"modbus-tcp\"` (Nidec Unidrive), "
        "`\"ethercat\"` (Kollmorgen), `\"ethernet-ip\"` (MOONS') or `\"profibus-dp\"` (Lenze)";
    GROUP "group" = "none": "axes that act together: one `[[group]]` each";
    NAME "name" = "-": "name of the group";
    AXES "axes" = "-": "names of its drives, like `[\"x\", \"y\"]`, in the order of its rows; they share "
        "divisor, phase and stop group";
}

/// All protocols; the next one is a package, and one line more.
pub const PROTOCOLS: [Protocol; 5] = [
    fieldbeat_linudp::config::REGISTERED,
    fieldbeat_modbus::config::REGISTERED,
    fieldbeat_ethercat::config::REGISTERED,
    fieldbeat_ethernet_ip::config::REGISTERED,
    fieldbeat_profibus::config::REGISTERED,
];

/// What a file holds.
#[derive(Debug)]
pub struct Configuration {
    /// The machine.
    pub plan: Plan,
    /// Its drives, when they are simulated.
    pub simulation: SimPlan,
    /// How a soak test moves its axes, and what it has to keep to.
    #[doc(hidden)]
    pub soak: SoakPlan,
}

/// Reads the configuration at `path`.
pub fn load(path: impl AsRef<Path>) -> Result<Configuration, ConfigErrors> {
    load_machine(path).map(|loaded| loaded.configuration)
}

/// A configuration, and its text for a record.
#[derive(Debug)]
pub struct Loaded {
    /// What it holds.
    pub configuration: Configuration,
    /// The file, as messages call it.
    pub file: String,
    /// Its text.
    pub text: String,
}

/// Reads the configuration at `path`, and keeps its text.
pub fn load_machine(path: impl AsRef<Path>) -> Result<Loaded, ConfigErrors> {
    let (file, text) =
        file::read(path.as_ref(), "an existing configuration, for example rt-config/demo.toml")?;
    Ok(Loaded { configuration: parse(&text, &file)?, file, text })
}

/// Reads the configuration `text`; messages call it `file`.
pub fn parse(text: &str, file: &str) -> Result<Configuration, ConfigErrors> {
    parse_changed(text, file, |_, _| {})
}

/// The same with a change to the plan before it is checked as a whole.
fn parse_changed(
    text: &str,
    file: &str,
    change: impl FnOnce(&mut Plan, &Table<'_>),
) -> Result<Configuration, ConfigErrors> {
    let page = Page::new(file, text);
    let entries = page.parse()?;
    let mut read = machine(Table::root(&page, &entries), change);
    page.verdict()?;
    read.plan.source = Some(PathBuf::from(file));
    Ok(read)
}

/// A time as people write it, on the command line as in a file: a number and its unit, `"250us"`, `"0.5s"`, `"8h"`.
/// Spaces around both and between them do not matter, as in `"1 ms"`; a number without a unit is refused.
pub fn duration(text: &str) -> Result<Duration, NotATime> {
    value::duration(text).map(Duration::from_nanos).ok_or(NotATime)
}

/// The text is no time.
#[derive(Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("write a number with its unit: ns, us, ms, s, min or h, for example 10s or 1h30min")]
pub struct NotATime;
fieldbeat_core::debug_as_display!(NotATime);

fn machine(mut root: Table<'_>, change: impl FnOnce(&mut Plan, &Table<'_>)) -> Configuration {
    let cycle = root.table(CYCLE, cycle::cycle);
    let mut machine = Machine::new(cycle.period_ns, cycle.deadline_ns());
    if !root.gives("bus") {
        root.fault("bus", "missing; a machine needs a [[bus]] with at least one [[bus.drive]]");
    }
    let readers = PROTOCOLS.map(|protocol| (protocol.name, protocol.read));
    let mut buses: Vec<Box<dyn BusPlan>> = Vec::new();
    let mut tables: Vec<(String, Table<'_>)> = Vec::new();
    for mut table in root.tables(BUS) {
        if let Some(read) = table.word(PROTOCOL, &readers) {
            let bus = read(&mut table, &mut machine);
            tables.push((bus.name().to_owned(), table));
            buses.push(bus);
        }
    }
    machine.check_groups(&root);
    for message in machine.periods {
        root.fault("cycle.period", message);
    }
    let mut plan = Plan { source: None, cycle, buses, groups: Vec::new() };
    change(&mut plan, &root);
    let mut simulation = SimPlan::default();
    // The drives are simulated as the change made them; a bus that it left out has none.
    for bus in &plan.buses {
        if let Some(at) = tables.iter().position(|(name, _)| name == bus.name()) {
            let (_, table) = tables.remove(at);
            simulation.read(&mut table.again(), &**bus, plan.cycle.period_ns);
            table.finish();
        }
    }
    cycle::check_reference(&root, &plan);
    cycle::check_period(&root, &plan.cycle, plan.axes().len());
    if let Some(why) = plan.black_box_fault() {
        root.fault("cycle.black_box", why);
    }
    for mut table in root.tables(GROUP) {
        let group = group(&mut table, &plan);
        plan.groups.extend(group);
        table.finish();
    }
    let soak = root.table("soak", |table| soak::soak(table, &plan));
    root.finish();
    Configuration { plan, simulation, soak }
}

/// A `[[group]]`: axes that act together.
fn group(table: &mut Table<'_>, plan: &Plan) -> Option<GroupPlan> {
    let name = table.text(NAME, SHORT_NAME, "1 to 32 letters, digits, - _ or .", plain_name);
    let axes = table.read(AXES, Form::Text(None).any_list(), |value| {
        let names = list(value, .., |name| name.as_str().map(str::to_owned));
        names.ok_or("must be the names of drives, like [\"x\", \"y\"]".into())
    });
    let group = GroupPlan { name: name?, axes: axes? };
    if plan.groups.iter().any(|other| other.name == group.name) {
        table.fault("name", "is taken by another group; names are unique");
    }
    if let Some(why) = group.fault(&plan.axes()) {
        table.fault("axes", why);
    }
    Some(group)
}
