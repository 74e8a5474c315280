//! What is recorded, topic by topic. Each message has the cycle and the time of the loop's own clock; times are in ns,
//! positions in the unit of their axis. What has a number and a name stands there as both.

use std::borrow::Cow;
use std::num::NonZeroU32;

use super::schema::{Fields, Get, Names, Table, Visit, identifier};
use fieldbeat_core::axis::{
    BegunBy, Command, EventKind, Jog, Link, MONITOR_CHANNELS, Move, Outcome, State, StopCause, Target,
};
use fieldbeat_core::bus::native::NativeLayout;
use fieldbeat_core::cycle::record::{
    CommandRecord, CommandStep, CycleRecord, DriveRecord, Lateness, MonitorRecord, ReferenceRecord, Reply,
    SkippedRecord, Stage,
};
use fieldbeat_core::logged::{LinkEvent, LinkPassed};
use fieldbeat_telemetry::causes::Judged;

/// A record and the instant of its cycle.
#[derive(Default)]
pub struct At<T> {
    /// The slot.
    pub cycle: u64,
    /// The grid point, ns of CLOCK_MONOTONIC.
    pub monotonic_ns: u64,
    /// The record.
    pub of: T,
}

const STATES: Names = Names { name: "State", values: || State::ALL.map(State::name).to_vec() };
const LINKS: Names = Names { name: "Link", values: || Link::ALL.map(Link::name).to_vec() };
const STEPS: Names = Names { name: "Step", values: || CommandStep::ALL.map(CommandStep::name).to_vec() };
const CAUSES: Names = Names {
    name: "StopCause",
    values: || std::iter::once("not stopped").chain(StopCause::ALL.map(StopCause::name)).collect(),
};
const COMMANDS: Names = Names {
    name: "Command",
    values: || std::iter::once("no command").chain(Command::NAMES.into_iter().skip(1)).collect(),
};
const EXCHANGES: Names = Names { name: "Exchange", values: || Reply::ALL.map(Reply::name).to_vec() };

type List<T> = Vec<(Cow<'static, str>, Get<At<T>>)>;

/// Fields behind those that every message has.
fn table<T>(name: &str, fields: List<T>) -> Table<At<T>> {
    let mut all: List<T> = vec![
        ("cycle".into(), Get::U64(|at| at.cycle)),
        ("monotonic_ns".into(), Get::U64(|at| at.monotonic_ns)),
    ];
    all.extend(fields);
    Table::new(name, all)
}

/// The fields of every message, alone.
pub fn every() -> Table<At<()>> {
    table("Every", Vec::new())
}

/// A drive in an executed cycle.
#[derive(Default)]
pub struct AxisRecord {
    /// The report of the loop.
    pub drive: DriveRecord,
    /// On a rotary axis: the length of a turn.
    pub modulo: Option<f64>,
}

/// `/axes/NAME`: one drive in an executed cycle.
pub fn axis() -> Table<At<AxisRecord>> {
    Table::of("Axis")
}

impl Fields for At<AxisRecord> {
    #[inline(always)]
    fn visit(&self, to: &mut impl Visit) {
        let At { cycle, monotonic_ns, of: AxisRecord { drive, modulo } } = self;
        let ns = |measured: Option<NonZeroU32>| measured.map_or(0, NonZeroU32::get);
        to.u64("cycle", *cycle);
        to.u64("monotonic_ns", *monotonic_ns);
        to.f64("position", drive.reported(drive.position));
        to.f64("demand", drive.reported(drive.demand));
        to.f64("following_error", drive.following_error(*modulo));
        to.f32("velocity", drive.reported(drive.velocity.into()) as f32);
        to.f32("current", drive.reported(drive.current.into()) as f32);
        to.named("state", drive.state as u32, &STATES);
        to.named("link", drive.link as u32, &LINKS);
        to.named("stopped", drive.stopped.map_or(0, |cause| cause as u32), &CAUSES);
        to.named("command", drive.command.into(), &COMMANDS);
        to.bool("moving", drive.moving());
        to.bool("sto_open", drive.sto_open());
        to.u32("fault", drive.fault);
        to.u32("warning", drive.warning);
        to.named("exchange", drive.reply as u32, &EXCHANGES);
        to.u32("sent_after_ns", ns(drive.phase_ns));
        to.u32("send_jitter_ns", ns(drive.jitter_ns));
        to.u32("rtt_ns", ns(drive.rtt_ns));
        to.u32("age_ns", ns(drive.age_ns));
    }
}

/// `/axes/NAME/monitors`: its monitored variables, each under its own name; not a number where it was not reported.
pub fn monitors(names: &[Option<String>; MONITOR_CHANNELS]) -> Table<At<MonitorRecord>> {
    const VALUES: [fn(&At<MonitorRecord>) -> f64; MONITOR_CHANNELS] =
        [|at| value(at, 0), |at| value(at, 1), |at| value(at, 2), |at| value(at, 3)];
    let mut fields: List<MonitorRecord> = Vec::new();
    for (name, get) in names.iter().zip(VALUES) {
        let Some(name) = name else { continue };
        fields.push((unused(identifier(name), &fields), Get::F64(get)));
    }
    table("Monitors", fields)
}

/// This name, or one after it, that no other field of the message has.
fn unused<T>(mut name: String, fields: &List<T>) -> Cow<'static, str> {
    while ["cycle", "monotonic_ns"].contains(&&*name) || fields.iter().any(|(known, _)| *known == name) {
        name.push_str("_2");
    }
    name.into()
}

fn value(at: &At<MonitorRecord>, channel: usize) -> f64 {
    at.of.shown.values()[channel].unwrap_or(f64::NAN)
}

/// The native process data of a drive.
#[derive(Debug, Default)]
pub struct NativeValues {
    /// When the inputs were taken in, ns of CLOCK_MONOTONIC; 0: none were.
    pub received_at_ns: u64,
    /// Those of the inputs, then those of the outputs; not a number where they do not have it.
    pub values: Vec<f64>,
    /// As received.
    pub inputs: Vec<u8>,
    /// As sent.
    pub outputs: Vec<u8>,
}

/// `/axes/NAME/native`: what a drive has received and was sent in a cycle, as bytes and, as far as their layout is
/// known, as numbers.
pub fn native(layout: &NativeLayout) -> Table<At<NativeValues>> {
    let mut fields: List<NativeValues> = vec![
        ("received_at_ns".into(), Get::U64(|at| at.of.received_at_ns)),
        ("inputs".into(), Get::Bytes(|at| &at.of.inputs)),
        ("outputs".into(), Get::Bytes(|at| &at.of.outputs)),
    ];
    let inputs = layout.inputs.iter().map(|field| format!("in_{}", field.name));
    let outputs = layout.outputs.iter().map(|field| format!("out_{}", field.name));
    for (item, name) in inputs.chain(outputs).enumerate() {
        fields.push((unused(identifier(&name), &fields), Get::Item(|at| &at.of.values, item)));
    }
    table("Native", fields)
}

/// `/cycle`: one executed cycle, and how long its stages took.
pub fn cycle() -> Table<At<CycleRecord>> {
    const STAGES: [fn(&At<CycleRecord>) -> u32; 6] = [
        |at| at.of.stages_ns[0],
        |at| at.of.stages_ns[1],
        |at| at.of.stages_ns[2],
        |at| at.of.stages_ns[3],
        |at| at.of.stages_ns[4],
        |at| at.of.stages_ns[5],
    ];
    let mut fields: List<CycleRecord> = vec![
        ("wake_ns".into(), Get::U32(|at| at.of.wake_ns)),
        ("jitter_ns".into(), Get::U32(|at| at.of.jitter_ns)),
    ];
    let stages = Stage::ALL.iter().zip(STAGES);
    fields.extend(stages.map(|(stage, get)| (format!("{}_ns", stage.name()).into(), Get::U32(get))));
    fields.extend([
        ("missed".into(), Get::U32(|at: &At<CycleRecord>| at.of.missed.into())),
        ("spun".into(), Get::Bool(|at| at.of.spun)),
    ]);
    table("Cycle", fields)
}

/// `/skipped`: slots passed over, from the one of the message on.
pub fn skipped() -> Table<At<SkippedRecord>> {
    table(
        "Skipped",
        vec![
            ("count".into(), Get::U64(|at| at.of.count)),
            ("late_ns".into(), Get::U64(|at| at.of.late_ns)),
            ("given_up_ns".into(), Get::U64(|at| at.of.given_up_ns)),
            ("woke_late".into(), Get::Bool(|at| at.of.woke_late)),
        ],
    )
}

/// `/reference`: the bus clock that leads the grid.
pub fn reference() -> Table<At<ReferenceRecord>> {
    table(
        "Reference",
        vec![
            ("reported".into(), Get::Bool(|at| at.of.error_ns.is_some())),
            ("error_ns".into(), Get::I64(|at| at.of.error_ns.unwrap_or(0).into())),
            ("step_ns".into(), Get::I64(|at| at.of.step_ns.into())),
            ("locked".into(), Get::Bool(|at| at.of.locked)),
        ],
    )
}

/// An event in words.
pub struct EventText {
    axis: u32,
    axis_name: String,
    kind: &'static str,
    text: String,
    code: u32,
    id: u64,
    command: &'static str,
    outcome: &'static str,
    code_name: String,
    register: u32,
}

impl EventText {
    /// Of axis `axis`, with the axis that began the stop and its name; `name_of` names a code of its drive.
    pub fn new(
        axis: u16,
        axis_name: &str,
        kind: &EventKind,
        begun_by: (Option<BegunBy>, Option<&str>),
        name_of: impl Fn(u32) -> Option<String>,
    ) -> EventText {
        let code_name = kind.fault().and_then(&name_of).unwrap_or_default();
        let (name, text, code) = kind.entry(name_of);
        let text = BegunBy::after(text, begun_by.0, begun_by.1);
        let (id, command, outcome) = match *kind {
            EventKind::Ended { id, command, outcome } => {
                let outcome = match outcome {
                    Outcome::Done => "done",
                    Outcome::Failed(_) => "failed",
                    Outcome::Aborted(_) => "aborted",
                };
                (id.0, command, outcome)
            }
            _ => (0, "", ""),
        };
        let register = if let EventKind::Emergency(one) = kind { one.register.into() } else { 0 };
        let (axis, axis_name) = (axis.into(), axis_name.to_owned());
        EventText { axis, axis_name, kind: name, text, code, id, command, outcome, code_name, register }
    }
}

/// `/events`: what happened to an axis, the ends of its commands among it.
pub fn events() -> Table<At<EventText>> {
    table(
        "Event",
        vec![
            ("axis".into(), Get::U32(|at| at.of.axis)),
            ("axis_name".into(), Get::Text(|at| &at.of.axis_name)),
            ("kind".into(), Get::Text(|at| at.of.kind)),
            ("text".into(), Get::Text(|at| &at.of.text)),
            ("code".into(), Get::U32(|at| at.of.code)),
            ("id".into(), Get::U64(|at| at.of.id)),
            ("command".into(), Get::Text(|at| at.of.command)),
            ("outcome".into(), Get::Text(|at| at.of.outcome)),
            ("code_name".into(), Get::Text(|at| &at.of.code_name)),
            ("register".into(), Get::U32(|at| at.of.register)),
        ],
    )
}

/// A command and the name of its axis.
pub struct CommandText {
    axis_name: String,
    record: CommandRecord,
}

impl CommandText {
    /// Of this axis.
    pub fn new(axis_name: &str, record: CommandRecord) -> CommandText {
        CommandText { axis_name: axis_name.to_owned(), record }
    }

    fn target(&self) -> f64 {
        match self.record.command() {
            Command::Move(Move { target: Target::Absolute(to) | Target::Relative(to), .. }) => to,
            _ => f64::NAN,
        }
    }

    fn is_relative(&self) -> bool {
        matches!(self.record.command(), Command::Move(Move { target: Target::Relative(_), .. }))
    }

    fn velocity(&self) -> f64 {
        match self.record.command() {
            Command::Move(Move { profile, .. }) => profile.velocity,
            Command::Jog(Jog { velocity, .. }) => velocity,
            _ => f64::NAN,
        }
    }

    fn acceleration(&self) -> f64 {
        match self.record.command() {
            Command::Move(Move { profile, .. }) => profile.acceleration,
            Command::Jog(Jog { acceleration, .. }) | Command::Velocity { acceleration } => acceleration,
            _ => f64::NAN,
        }
    }

    fn deceleration(&self) -> f64 {
        match self.record.command() {
            Command::Move(Move { profile, .. }) => profile.deceleration,
            Command::Stop { deceleration } => deceleration.unwrap_or(f64::NAN),
            _ => f64::NAN,
        }
    }

    fn slope(&self) -> f64 {
        if let Command::Torque { slope } = self.record.command() { slope } else { f64::NAN }
    }
}

/// `/commands`: a command that the loop has taken, or that begins; its end is an event. Numbers that it does not have
/// are not a number.
pub fn commands() -> Table<At<CommandText>> {
    table(
        "Command",
        vec![
            ("axis".into(), Get::U32(|at| at.of.record.axis().into())),
            ("axis_name".into(), Get::Text(|at| &at.of.axis_name)),
            ("id".into(), Get::U64(|at| at.of.record.id.0)),
            ("step".into(), Get::Named(|at| at.of.record.step() as u32, &STEPS)),
            ("command".into(), Get::U32(|at| at.of.record.command().code().into())),
            ("command_name".into(), Get::Text(|at| at.of.record.command().name())),
            ("in_group".into(), Get::Bool(|at| at.of.record.group().is_some())),
            ("group_lead".into(), Get::U32(|at| at.of.record.group().unwrap_or(0).into())),
            ("target".into(), Get::F64(|at| at.of.target())),
            ("relative".into(), Get::Bool(|at| at.of.is_relative())),
            ("velocity".into(), Get::F64(|at| at.of.velocity())),
            ("acceleration".into(), Get::F64(|at| at.of.acceleration())),
            ("deceleration".into(), Get::F64(|at| at.of.deceleration())),
            ("torque_slope".into(), Get::F64(|at| at.of.slope())),
        ],
    )
}

const LINK_EVENTS: Names =
    Names { name: "LinkEvent", values: || LinkEvent::ALL.map(LinkEvent::name).to_vec() };

/// `/link`: what passes a connection while the link thread has it.
pub fn link() -> Table<LinkPassed> {
    Table::new(
        "Link",
        vec![
            ("monotonic_ns".into(), Get::U64(|of| of.at.0)),
            ("bus".into(), Get::U32(|of| of.bus.into())),
            ("connection".into(), Get::U32(|of| of.index.into())),
            ("address".into(), Get::U32(|of| of.peer.ip().to_bits())),
            ("port".into(), Get::U32(|of| of.peer.port().into())),
            ("event".into(), Get::Named(|of| of.event as u32, &LINK_EVENTS)),
            ("bytes".into(), Get::Bytes(|of| &of.bytes)),
        ],
    )
}

/// A late cycle in words.
pub struct LateText {
    what: &'static str,
    delay_ns: u64,
    cause: &'static str,
    stage: &'static str,
    drive: String,
}

impl LateText {
    /// As it was judged; the words of its cause are those of the summary.
    pub fn new(
        judged: &Judged,
        (cause, stage, drive): (&'static str, Option<&'static str>, Option<String>),
    ) -> LateText {
        let what = match judged.lateness {
            Lateness::Wake(_) => "wake",
            Lateness::Stage(stage, _) => stage.name(),
            Lateness::Reply => "reply",
        };
        LateText {
            what,
            delay_ns: judged.lateness.ns(),
            cause,
            stage: stage.unwrap_or_default(),
            drive: drive.unwrap_or_default(),
        }
    }
}

/// `/late`: why a cycle was late. It comes when that is known, up to a second after the cycle.
pub fn late() -> Table<At<LateText>> {
    table(
        "Late",
        vec![
            ("what".into(), Get::Text(|at| at.of.what)),
            ("delay_ns".into(), Get::U64(|at| at.of.delay_ns)),
            ("cause".into(), Get::Text(|at| at.of.cause)),
            ("stage".into(), Get::Text(|at| at.of.stage)),
            ("drive".into(), Get::Text(|at| &at.of.drive)),
        ],
    )
}
