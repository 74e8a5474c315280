//! Configurations: any file is read or its mistakes are reported, and a plan that was read can run.

use std::fmt::Write;

use fieldbeat::axis::{Command, Move, Row, Target};
use fieldbeat::config::{ConfigErrors, Configuration, parse};
use fieldbeat::sim::WorldOptions;
use fieldbeat::time::US;
use fieldbeat::{Flow, Master, Wait};
use fieldbeat_config::demo::demo_plan;
use fieldbeat_config::describe;
use fieldbeat_config::duration;
use fieldbeat_core::cycle::bound::stop_bound;

use super::input::Input;

const FILE: &str = "m.toml";

/// Cycles that an accepted machine runs.
const TURNS: u64 = 40;

/// More room in the queues than this is allowed, and not worth the time here.
const MOST_ENTRIES: usize = 20_000;

pub fn config(data: &[u8]) {
    let text = String::from_utf8_lossy(data);
    let _ = duration(&text);
    read(&text);
}

pub fn config_keys(data: &[u8]) {
    let mut input = Input(data);
    if input.byte() == 255 {
        let (drives, period_ns, place) = (input.word().into(), input.long().into(), input.byte().into());
        return verdict("", demo_plan(drives, period_ns, place));
    }
    let mut machine = Document::sample(input.below(2));
    while !input.is_over() {
        machine.change(&mut input);
    }
    read(&machine.text());
}

fn read(text: &str) {
    let result = parse(text, FILE);
    if let (Err(first), Err(again)) = (&result, &parse(text, FILE)) {
        assert_eq!(first, again, "the same text has the same mistakes");
    }
    verdict(text, result);
}

fn verdict(text: &str, result: Result<Configuration, ConfigErrors>) {
    match result {
        Err(errors) => check_errors(text, &errors),
        Ok(configuration) => {
            let plan = &configuration.plan;
            let said = describe(plan);
            assert!(said.iter().all(|line| is_plain(line)), "{said:#?}");
            assert!((0..plan.axes().len()).all(|axis| stop_bound(plan, axis) > 0));
            run(configuration);
        }
    }
}

/// One line, and nothing in it that could play with a terminal.
fn is_plain(line: &str) -> bool {
    !line.trim().is_empty() && !line.chars().any(char::is_control)
}

/// Each mistake stands on a line of its own, with its place, and ends with what would be right.
fn check_errors(text: &str, errors: &ConfigErrors) {
    let mut last = 0;
    for error in errors.iter() {
        let line = error.line.unwrap_or(0);
        let said = error.to_string();
        assert!(is_plain(&said), "{said:?}");
        if !text.is_empty() {
            assert!((1..=text.matches('\n').count() + 1).contains(&line), "no such line: {said}");
            assert!(said.starts_with(&format!("{FILE}:{line}: ")), "{said}");
        }
        assert!(line >= last, "in the order of the file: {errors}");
        last = line;
        let message = &error.message;
        // A mistake of syntax is reported in the words of the parser.
        let remedy = message.starts_with("must ") || message.contains("; ");
        let whole = !message.trim_end().ends_with([';', ':', ',', '=']);
        assert!(error.key.is_none() || remedy && whole, "no remedy: {said}");
    }
    assert!(errors.iter().count() > 0);
    assert_eq!(errors.to_string().lines().count(), errors.iter().count());
}

/// A few cycles of the machine, with an application that wants everything of it.
fn run(Configuration { mut plan, simulation, .. }: Configuration) {
    let axes: Vec<_> = plan.axes().into_iter().cloned().collect();
    let entries = |axis: &fieldbeat::axis::AxisPlan| {
        axis.command_queue + axis.stream_queue + axis.event_queue + axis.sample_queue
    };
    if axes.iter().map(entries).sum::<usize>() > MOST_ENTRIES {
        return;
    }
    if plan.cycle.period_ns > 250 * US {
        // A spin is 50 ns of virtual time.
        plan.cycle.wait = Wait::Poll;
    }
    let setup = Master::from_plan(plan).with_simulation(simulation);
    let mut sim = setup.simulate(WorldOptions::default()).expect("what was accepted can run");
    for turn in 0..TURNS {
        for (index, axis) in axes.iter().enumerate() {
            let middle = axis.limits.position.map_or(0.0, |(low, high)| low + (high - low) / 2.0);
            let motion = |target| Command::Move(Move { target, profile: axis.profile });
            let command = match (turn + index as u64) % 8 {
                0 => Command::Enable,
                1 => Command::Home,
                2 => motion(Target::Absolute(middle)),
                3 => motion(Target::Relative(1.0)),
                4 => Command::Follow,
                5 => Command::Stop { deceleration: None },
                6 => Command::ResetFault,
                _ => Command::Reset,
            };
            let _ = sim.axis(index).post(command);
            let _ = sim.axis(index).push_row(Row { position: middle, ..Row::default() });
            while let Some(event) = sim.axis(index).event() {
                assert!(is_plain(&event.to_string()));
            }
        }
        if turn == TURNS - 4 {
            sim.stop();
        }
        let flow = sim.step();
        let status = sim.status();
        assert_eq!(status.planned, status.executed + status.skipped, "{status:?}");
        if flow == Flow::End {
            break;
        }
    }
    for drive in sim.finish().drives {
        let c = drive.counters;
        assert_eq!(c.sent, c.answered + c.missed, "{}: {c:?}", drive.name);
    }
}

/// A configuration as tables of keys and values, all of them text.
struct Document(Vec<Section>);

struct Section {
    header: String,
    entries: Vec<(String, String)>,
}

impl Document {
    /// One of the sample files, with its commented defaults as keys.
    fn sample(which: usize) -> Document {
        let text =
            [include_str!("../../../rt-config/demo.toml"), include_str!("../../../rt-config/linmot.toml")]
                [which];
        let mut sections = Vec::new();
        for line in text.lines() {
            let line = line.strip_prefix("# ").unwrap_or(line);
            if line.starts_with('[') {
                sections.push(Section { header: line.to_owned(), entries: Vec::new() });
            } else if let (Some((key, value)), Some(section)) = (line.split_once(" = "), sections.last_mut())
                && !key.contains(' ')
            {
                section.set(key, value);
            }
        }
        // Two drives are enough to have something in common; the bus whose clock leads is not one of them.
        sections.truncate(5);
        for section in &mut sections {
            section.entries.retain(|(key, _)| key != "reference");
        }
        Document(sections)
    }

    fn text(&self) -> String {
        let mut text = String::new();
        for section in &self.0 {
            let _ = writeln!(text, "{}", section.header);
            for (key, value) in &section.entries {
                let _ = writeln!(text, "{key} = {value}");
            }
        }
        text
    }

    fn change(&mut self, input: &mut Input<'_>) {
        let what = input.byte() % 16;
        let at = input.below(self.0.len().max(1));
        match what {
            // A key that is known, with a value that it may have, in a table that may have it.
            0..=7 => {
                let (header, key, values) = KEYS[input.below(KEYS.len())];
                let fitting: Vec<usize> = (0..self.0.len())
                    .filter(|index| {
                        self.0[*index].header == header
                            || header == DRIVE && self.0[*index].header == DEFAULTS
                    })
                    .collect();
                let value = match input.byte() {
                    wild @ 0..32 => WILD[usize::from(wild)].to_owned(),
                    32..64 => format!("{:?}", input.number()),
                    64..80 => {
                        format!("\"{}{}\"", input.word(), input.of(&["ns", "us", "ms", "s", "min", "h"]))
                    }
                    80..96 => format!("[{:?}, {:?}]", input.number(), input.number()),
                    usual => values[usize::from(usual) % values.len()].to_owned(),
                };
                if !fitting.is_empty() {
                    let section = fitting[at % fitting.len()];
                    self.0[section].set(key, &value);
                }
            }
            8 => {
                if let Some(section) = self.0.get_mut(at)
                    && !section.entries.is_empty()
                {
                    let gone = input.below(section.entries.len());
                    section.entries.remove(gone);
                }
            }
            9 => {
                let name = input.below(4);
                let mut drive = Section { header: DRIVE.into(), entries: Vec::new() };
                drive.set("name", &format!("\"n{name}\""));
                drive.set("address", &format!("\"127.77.0.{}\"", 100 + name));
                self.0.push(drive);
            }
            10 => {
                let name = input.below(4);
                let mut bus = Section { header: BUS.into(), entries: Vec::new() };
                bus.set("protocol", "\"linudp-v2\"");
                bus.set("name", &format!("\"b{name}\""));
                bus.set("bind", &format!("\"127.77.0.{}\"", 1 + name));
                self.0.push(bus);
            }
            11 => {
                if self.0.len() > 1 {
                    self.0.remove(at);
                }
            }
            12 => self.0.truncate(at + 1),
            // Slips of the pen.
            13 => {
                if let Some(section) = self.0.get_mut(at) {
                    slip(&mut section.header, input);
                }
            }
            _ => {
                if let Some(section) = self.0.get_mut(at)
                    && !section.entries.is_empty()
                {
                    let entry = input.below(section.entries.len());
                    let (key, value) = &mut section.entries[entry];
                    slip(if what == 14 { key } else { value }, input);
                }
            }
        }
    }
}

impl Section {
    /// The key has this value, whatever it had before; a dotted key lies in an inline table as well as before it.
    fn set(&mut self, key: &str, value: &str) {
        match self.entries.iter_mut().find(|(known, _)| known == key) {
            Some(entry) => value.clone_into(&mut entry.1),
            None => {
                // TOML knows a table once: `stop = { ... }` or `stop.how`.
                let table = key.split('.').next().unwrap_or(key);
                self.entries.retain(|(known, _)| {
                    known != table && (key != table || known.split('.').next() != Some(table))
                });
                self.entries.push((key.to_owned(), value.to_owned()));
            }
        }
    }
}

/// One character more, less, or another.
fn slip(text: &mut String, input: &mut Input<'_>) {
    let at = input.below(text.len() + 1);
    if !text.is_char_boundary(at) {
        return;
    }
    match input.byte() {
        0 => drop(text.pop()),
        1 if at < text.len() => drop(text.remove(at)),
        c => text.insert(at, char::from(c)),
    }
}

const CYCLE: &str = "[cycle]";
const BUS: &str = "[[bus]]";
const DEFAULTS: &str = "[bus.defaults]";
const DRIVE: &str = "[[bus.drive]]";

/// Values that fit nowhere, or at an edge.
const WILD: [&str; 32] = [
    "0",
    "-1",
    "1",
    "true",
    "false",
    "\"\"",
    "[]",
    "{}",
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1e308",
    "5e-324",
    "1e18",
    "\"1ns\"",
    "\"0s\"",
    "\"999999h\"",
    "9223372036854775807",
    "-9223372036854775808",
    "0xFFFFFFFF",
    "1_000",
    "[1, 2, 3]",
    "[0, 0]",
    "[-1e9, 1e9]",
    "{ a = 1 }",
    "\"\\u001b[2J\"",
    "'x'",
    "1979-05-27",
    "\"off\"",
    "\"stop\"",
    "[[1], [2]]",
];

/// Every key, where it stands, and values that somebody could give it.
#[rustfmt::skip]
const KEYS: &[(&str, &str, &[&str])] = &[
    (CYCLE, "period", &["\"50us\"", "\"250us\"", "\"1ms\"", "\"2ms\"", "\"10ms\"", "\"1s\""]),
    (CYCLE, "core", &["0", "3", "1023"]),
    (CYCLE, "priority", &["1", "80", "99"]),
    (CYCLE, "guard", &["\"off\"", "\"auto\"", "\"1us\"", "\"100us\""]),
    (CYCLE, "receive_deadline", &["0.05", "0.5", "0.8", "0.95"]),
    (CYCLE, "wait", &["\"poll\"", "\"spin\""]),
    (CYCLE, "overrun", &["\"skip\"", "\"stop\""]),
    (CYCLE, "max_skip", &["1", "10", "1000000"]),
    (CYCLE, "realtime", &["\"require\"", "\"prefer\"", "\"off\""]),
    (CYCLE, "memory", &["\"process\"", "\"own\""]),
    (CYCLE, "task_budget", &["\"1us\"", "\"100us\"", "\"1ms\""]),
    (CYCLE, "reference", &["\"linudp-v2\"", "\"a\""]),
    (BUS, "protocol", &["\"linudp-v2\"", "\"ethercat\""]),
    (BUS, "name", &["\"a\"", "\"b\""]),
    (BUS, "bind", &["\"127.77.0.1\"", "\"127.77.0.1:5\"", "\"0.0.0.0\"", "\"192.168.1.1\"", "\"127.77.0.11:49360\""]),
    (DRIVE, "name", &["\"x\"", "\"y\"", "\"\u{e4}chse\""]),
    (DRIVE, "address", &["\"127.77.0.11\"", "\"127.77.0.12:1\"", "\"127.77.0.1\"", "\"192.168.1.11\""]),
    (DRIVE, "units", &["\"mm\"", "\"rev\""]),
    (DRIVE, "scale", &["1e-6", "0.5", "10000", "65536", "1e12"]),
    (DRIVE, "invert", &["true", "false"]),
    (DRIVE, "offset", &["0", "-120.5", "1e300", "-1e300"]),
    (DRIVE, "modulo", &["360", "1", "1e-300", "1e300"]),
    (DRIVE, "limits.position", &["[0, 400]", "[-120, 120]", "[-214748, 214748]", "[0, 5e-324]"]),
    (DRIVE, "limits.velocity", &["2000", "1e-300", "1e300"]),
    (DRIVE, "limits.acceleration", &["20000", "1e-300", "1e300"]),
    (DRIVE, "limits.following_error", &["5", "0.0001", "1e300", "\"off\""]),
    (DRIVE, "limits.step", &["2", "1e-300", "1e300"]),
    (DRIVE, "profile.velocity", &["0.001", "200", "2147483"]),
    (DRIVE, "profile.acceleration", &["0.0001", "2000", "214748"]),
    (DRIVE, "profile.deceleration", &["0.0001", "2000", "214748"]),
    (DRIVE, "divisor", &["1", "2", "7", "1000"]),
    (DRIVE, "phase", &["0", "1", "6", "999"]),
    (DRIVE, "health.bucket", &["1", "5", "10000"]),
    (DRIVE, "health.leak", &["1", "20", "1000000"]),
    (DRIVE, "health.gate", &["1", "2", "1000000"]),
    (DRIVE, "health.probe_interval", &["\"10ms\"", "\"100ms\"", "\"10s\""]),
    (DRIVE, "stop.how", &["\"ramp\"", "\"quick\"", "\"coast\""]),
    (DRIVE, "stop.deceleration", &["0.0001", "8000", "214748"]),
    (DRIVE, "stop.then", &["\"hold\"", "\"disable\""]),
    (DRIVE, "stop.timeout", &["\"1ms\"", "\"1s\"", "\"600s\""]),
    (DRIVE, "stop.on_timeout", &["\"hold\"", "\"disable\""]),
    (DRIVE, "stop.standstill", &["5", "1e-300", "1e300"]),
    (DRIVE, "stop.standstill_for", &["1", "20", "100000"]),
    (DRIVE, "stop.group", &["\"gantry\"", "\"gantyr\""]),
    (DRIVE, "in_position.window", &["0.5", "0.0001", "1e300", "\"off\""]),
    (DRIVE, "in_position.for", &["1", "10", "\"50ms\"", "60000"]),
    (DRIVE, "in_position.timeout", &["\"1ms\"", "\"1s\"", "\"600s\""]),
    (DRIVE, "underrun", &["\"stop\"", "\"hold\"", "{ extrapolate = 3 }", "{ extrapolate = 1000 }"]),
    (DRIVE, "on_found_running", &["\"stop\"", "\"refuse\""]),
    (DRIVE, "on_owner_lost", &["\"stop\"", "\"finish\""]),
    (DRIVE, "enable_timeout", &["\"1ms\"", "\"5s\"", "\"600s\""]),
    (DRIVE, "home_timeout", &["\"1ms\"", "\"60s\"", "\"3600s\""]),
    (DRIVE, "command_queue", &["1", "64", "1000000"]),
    (DRIVE, "stream_queue", &["1", "1024", "1000000"]),
    (DRIVE, "event_queue", &["1", "256", "1000000"]),
    (DRIVE, "sample_queue", &["0", "1", "64", "1000000"]),
    (
        DRIVE,
        "stream",
        &["\"p\"", "\"pv\"", "\"p-configured\"", "\"pv-configured\"", "\"pva\"", "\"pva-configured\"", "\"off\""],
    ),
    (DRIVE, "monitor", &["true", "false"]),
    (DRIVE, "reply_within", &["1", "2", "3", "\"2ms\""]),
    (DRIVE, "reply_tag", &["\"definition\"", "\"count\"", "\"off\""]),
    (DRIVE, "no_drive_watchdog", &["\"accept\"", "\"refuse\""]),
    (DRIVE, "leash", &["20", "1e-300", "1e300"]),
    (DRIVE, "simulate.seed", &["0", "4294967295"]),
    (DRIVE, "simulate.drop", &["0.1", "1"]),
    (DRIVE, "simulate.duplicate", &["0.1", "1"]),
    (DRIVE, "simulate.corrupt", &["0.1", "1"]),
    (DRIVE, "simulate.delay", &["0.1", "1"]),
    (DRIVE, "simulate.delay_by", &["\"0s\"", "\"1ms\"", "\"10s\""]),
    (DRIVE, "simulate.reorder", &["0.1", "1"]),
    (DRIVE, "simulate.stall", &["0.1", "1"]),
    (DRIVE, "simulate.stall_for", &["\"0s\"", "\"600s\""]),
    (DRIVE, "simulate.restart", &["0.1", "1"]),
    (DRIVE, "simulate.wrong_id", &["0.1", "1"]),
    (DRIVE, "simulate.answer_time", &["\"0us\"", "\"900us\"", "\"1s\""]),
    (DRIVE, "simulate.padding", &["0", "14", "64"]),
    (DRIVE, "simulate.filter", &["\"none\"", "\"single\"", "\"10.0.0.1\""]),
    (DRIVE, "simulate.range", &["[-1, 1]", "[-1e300, 1e300]", "[0, 500]"]),
    (DRIVE, "simulate.home", &["0", "1"]),
    (DRIVE, "simulate.start", &["0", "1"]),
    (DRIVE, "simulate.mass", &["0.001", "1", "10000"]),
    (DRIVE, "simulate.stream_period", &["\"100us\"", "\"1ms\"", "\"1s\""]),
    (DRIVE, "simulate.stream_patience", &["1", "2.5", "1000"]),
    (DRIVE, "simulate.stream_depth", &["1", "8", "10000"]),
    (DRIVE, "sto_after", &["\"0us\"", "\"10ms\"", "\"60s\""]),
    (DRIVE, "simulate.status_lag", &["\"0us\"", "\"2ms\"", "\"1s\""]),
    (DRIVE, "simulate.force_enable_bits", &["true", "false"]),
    (DRIVE, "simulate.running", &["true", "false"]),
];
