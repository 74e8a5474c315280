//! What a recording says of its machine besides the messages: as metadata of the file, and as that of its channels.

use std::collections::{BTreeMap, HashMap};

use serde::{Deserialize, Serialize};

use fieldbeat_core::axis::{FaultNames, MONITOR_CHANNELS};
use fieldbeat_core::bus::facts::of_drives;
use fieldbeat_core::bus::native::NativeLayout;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::cycle::record::{DriveRecord, Record};
use fieldbeat_core::rt::host;

/// The metadata record about the machine.
pub const MACHINE: &str = "fieldbeat";

/// The metadata record at the end: whether anything is missing.
pub const END: &str = "fieldbeat end";

/// The key of the version of the program.
pub const PROGRAM: &str = "program";

/// The key of the protocol of an axis, in the metadata of its channel.
const PROTOCOL: &str = "protocol";

/// The key of its unit.
pub const UNIT: &str = "unit";

/// The key of why a file was written.
pub const WHY: &str = "why";

/// The key of the cycle in which that was.
pub const CYCLE: &str = "cycle";

/// The key of the date at which a black box was written.
pub const WRITTEN: &str = "written";

/// The version of what the messages mean. Fields may be added without a new one.
pub const FORMAT: &str = "1";

/// A machine.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Machine {
    /// Metadata of the file.
    pub about: BTreeMap<String, String>,
    /// The axes, in the order of the plan.
    pub axes: Vec<AxisAbout>,
    /// The period of the cycle.
    pub period_ns: u64,
}

/// An axis.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct AxisAbout {
    /// The name.
    pub name: String,
    /// Metadata of its channel.
    pub about: BTreeMap<String, String>,
    /// The length of a turn of a rotary axis.
    pub modulo: Option<f64>,
    /// Names and units of its monitored variables.
    pub monitor: [Option<(String, String)>; MONITOR_CHANNELS],
    /// The description of its native process data, if they are recorded.
    #[serde(skip)]
    pub native: Option<NativeLayout>,
    /// Names of the codes of its drive.
    #[serde(skip)]
    pub faults: Faults,
}

/// Names of the codes of a drive.
#[derive(Clone, Debug)]
pub enum Faults {
    /// All that its protocol knows.
    Known(FaultNames),
    /// Those of a list.
    Listed(BTreeMap<u32, String>),
}

impl AxisAbout {
    /// The protocol of its drive.
    pub fn protocol(&self) -> Option<&str> {
        self.about.get(PROTOCOL).map(String::as_str)
    }
}

impl Default for Faults {
    fn default() -> Faults {
        Faults::Listed(BTreeMap::new())
    }
}

impl Faults {
    /// The name of a code.
    pub fn name(&self, code: u32) -> Option<String> {
        match self {
            Faults::Known(names) => names(code).map(str::to_owned),
            Faults::Listed(names) => names.get(&code).cloned(),
        }
    }
}

impl Machine {
    /// Names the fault of a drive's record in the metadata: it may have come before the first event of a file.
    pub fn name_fault(&mut self, record: &Record) {
        let Record::Drive(DriveRecord { axis, fault: code @ 1.., .. }) = *record else { return };
        let Some(axis) = self.axes.get_mut(usize::from(axis)) else { return };
        let key = format!("{FAULT}{code:#06x}");
        if !axis.about.contains_key(&key)
            && let Some(name) = axis.faults.name(code)
        {
            axis.about.insert(key, name);
        }
    }

    /// The machine of a plan, recorded by a program of this version, with the text of its configuration if that can be
    /// read.
    pub fn of(plan: &Plan, version: &str) -> Machine {
        let cycle = &plan.cycle;
        let mut about = of_cycle(version, cycle.period_ns, cycle.deadline_ns(), cycle.late_ns());
        let host = [("kernel", host::kernel()), ("preemption", host::preemption()), ("cpu", host::cpu())];
        let source = plan.source.as_ref();
        let more = host.into_iter().chain([
            ("host", host::name()),
            ("reference", cycle.reference.clone()),
            ("machine", source.map(|path| path.display().to_string())),
            ("configuration", source.and_then(|path| std::fs::read_to_string(path).ok())),
        ]);
        about.extend(more.filter_map(|(key, value)| Some((key.to_owned(), value?))));
        let facts = plan.facts();
        let axes = plan.axes().into_iter().zip(of_drives(&facts));
        let axes = axes.map(|(axis, (bus, drive))| AxisAbout {
            name: axis.name.clone(),
            about: of_axis(&axis.units.unit.to_string(), bus.protocol),
            modulo: axis.units.modulo,
            monitor: drive.monitored.clone().map(|channel| channel.map(|of| (of.name, of.unit.to_owned()))),
            native: None,
            faults: Faults::Known(bus.fault_names),
        });
        let mut axes: Vec<AxisAbout> = axes.collect();
        for (axis, layout) in plan.native_layouts().into_iter().flatten() {
            axes[axis].native = Some(layout);
        }
        Machine { about, axes, period_ns: cycle.period_ns }
    }
}

/// The prefix of the keys under which the metadata of an axis' channel name a code.
const FAULT: &str = "fault ";

/// The codes that the metadata of an axis' channel name, and their names.
pub fn faults_of(about: &HashMap<String, String>) -> impl Iterator<Item = (u32, &String)> {
    let code = |key: &str| u32::from_str_radix(key.strip_prefix(FAULT)?.strip_prefix("0x")?, 16).ok();
    about.iter().filter_map(move |(key, name)| Some((code(key)?, name)))
}

/// The entries of every machine.
pub fn of_cycle(program: &str, period_ns: u64, deadline_ns: u64, late_ns: u64) -> BTreeMap<String, String> {
    [
        ("format", FORMAT.to_owned()),
        (PROGRAM, program.to_owned()),
        ("period_ns", period_ns.to_string()),
        ("deadline_ns", deadline_ns.to_string()),
        ("late_ns", late_ns.to_string()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into()
}

/// The description of an axis in its channel.
pub fn of_axis(unit: &str, protocol: &str) -> BTreeMap<String, String> {
    [
        (UNIT, unit.to_owned()),
        ("unit_velocity", format!("{unit}/s")),
        ("unit_current", "A".to_owned()),
        (PROTOCOL, protocol.to_owned()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into()
}
