//! The configuration as a user meets it: every mistake on a line of its own, the samples, and the defaults.

mod errors;
mod ethercat;
mod profibus;
mod schema;
mod slaves;
mod soak;

use std::net::Ipv4Addr;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::time::Duration;

use fieldbeat::axis::{FoundRunning, Health, OwnerLost, StopHow, StopThen, StopTimeout, Underrun, Unit};
use fieldbeat::bus::linudp::MonitorPlan;
use fieldbeat::config::{Configuration, load, parse};
use fieldbeat::time::{MS, S, US};
use fieldbeat::{CyclePlan, Guard, Overrun, Plan, Realtime, Wait};
use fieldbeat_config::demo::{DEMO_PLACES, DEMO_STREAMS_UP_TO_NS, demo_plan, is_demo};
use fieldbeat_config::{describe, json};
use fieldbeat_core::cycle::bound::{stop_bound, stop_bound_cycles};
use fieldbeat_core::cycle::starvation;
use fieldbeat_core::rt::host::Throttling;
use fieldbeat_linudp::upid::Upid;
use proptest::prelude::*;

/// One drive with a fragment in one of its sections. The fragment begins in line 2, 6 or 10.
fn machine(section: &str, fragment: &str) -> String {
    let part = |name: &str| if name == section { fragment } else { "" };
    format!(
        "[cycle]\n{}\n[[bus]]\nprotocol = \"linudp-v2\"\nbind = \"127.0.0.1\"\n{}\n\
         [[bus.drive]]\nname = \"x\"\naddress = \"127.0.0.11\"\n{}\n",
        part("cycle"),
        part("bus"),
        part("drive"),
    )
}

/// The same with a drive of another protocol or an EtherCAT line, in the sections that begin so; the whole file; and
/// [`FOUR`] with it.
fn any_machine(section: &str, fragment: &str) -> String {
    match section {
        "file" => return fragment.to_owned(),
        "group" => return format!("{FOUR}[[group]]\n{fragment}\n"),
        "soak" => return format!("{FOUR}{fragment}\n"),
        "soak-axis" => return format!("{FOUR}[[soak.axis]]\ndrive = \"x\"\n{fragment}\n"),
        "soak-criteria" => return format!("{FOUR}[soak.criteria]\n{fragment}\n"),
        _ => {}
    }
    if let Some(rest) = section.strip_prefix("moons") {
        return moons(rest.trim_start_matches('-'), fragment);
    }
    if let Some(rest) = section.strip_prefix("lenze") {
        return profibus::wire(rest.trim_start_matches('-'), fragment);
    }
    match (section.strip_prefix("unidrive"), section.strip_prefix("ethercat")) {
        (Some(rest), _) => unidrive(rest.trim_start_matches('-'), fragment),
        (_, Some(rest)) => ethercat::line(rest.trim_start_matches('-'), fragment),
        _ => machine(section, fragment),
    }
}

/// One Unidrive with a fragment in the section of its bus or in its own. The fragment begins in line 4 or 8.
fn unidrive(section: &str, fragment: &str) -> String {
    let part = |name: &str| if name == section { fragment } else { "" };
    format!(
        "[cycle]\n[[bus]]\nprotocol = \"modbus-tcp\"\n{}\n\
         [[bus.drive]]\nname = \"u\"\naddress = \"127.0.0.21\"\n{}\n",
        part("bus"),
        part(""),
    )
}

/// One MOONS' drive with a fragment in the section of its bus or in its own. The fragment begins in line 5 or 9.
fn moons(section: &str, fragment: &str) -> String {
    let part = |name: &str| if name == section { fragment } else { "" };
    format!(
        "[cycle]\n[[bus]]\nprotocol = \"ethernet-ip\"\nbind = \"127.0.0.1\"\n{}\n\
         [[bus.drive]]\nname = \"m\"\naddress = \"127.0.0.31\"\n{}\n",
        part("bus"),
        part(""),
    )
}

fn read_all(text: &str) -> Configuration {
    parse(text, "m.toml").unwrap_or_else(|errors| panic!("{errors}"))
}

fn read(text: &str) -> Plan {
    read_all(text).plan
}

fn mistakes(text: &str) -> Vec<String> {
    match parse(text, "m.toml") {
        Ok(all) => panic!("accepted: {all:?}"),
        Err(errors) => errors.iter().map(ToString::to_string).collect(),
    }
}

/// Section and fragment (`;;` is a line end), then the lines expected, two columns in and without the file's name; what
/// is four columns in goes on where the line before it ends.
const MISTAKES: &str = include_str!("mistakes.txt");

#[test]
fn every_mistake_says_where_it_is_and_what_would_be_right() {
    let mut cases: Vec<(&str, String, Vec<String>)> = Vec::new();
    for line in MISTAKES.lines().filter(|line| !line.is_empty()) {
        let (indent, text) = line.split_at(line.len() - line.trim_start().len());
        match (indent.len(), cases.last_mut()) {
            (4, Some((.., lines))) => {
                let last = lines.last_mut().unwrap();
                *last += " ";
                *last += text;
            }
            (2, Some((.., lines))) => lines.push(format!("m.toml:{text}")),
            _ => {
                let (section, fragment) = line.split_once(" | ").unwrap();
                cases.push((section, fragment.replace(" ;; ", "\n"), Vec::new()));
            }
        }
    }
    assert!(cases.len() > 100);
    for (section, fragment, expected) in cases {
        assert!(!expected.is_empty(), "{fragment} expects nothing");
        assert_eq!(mistakes(&any_machine(section, &fragment)), expected, "in {section}: {fragment}");
    }
}

#[test]
fn what_must_be_unique_is() {
    let text = r#"
[[bus]]
protocol = "linudp-v2"
bind = "127.0.0.1"
[[bus.drive]]
name = "x"
address = "127.0.0.11"
[[bus.drive]]
name = "x"
address = "127.0.0.11:50000"
[[bus.drive]]
name = "y"
address = "127.0.0.1:41136"

[[bus]]
protocol = "linudp-v2"
name = "second"
bind = "0.0.0.0"
[[bus.drive]]
name = "y"
address = "127.0.0.11"

[[bus]]
protocol = "linudp-v2"
bind = "127.0.0.11:49360"
[[bus.drive]]
name = "z"
address = "127.0.0.12"
"#;
    assert_eq!(
        mistakes(text),
        [
            "m.toml:9: bus.drive.name = \"x\": is already the drive of line 6; names are unique in the machine",
            "m.toml:10: bus.drive.address = \"127.0.0.11:50000\": is already that of the drive of line 7; one \
             drive per IP address",
            "m.toml:13: bus.drive.address = \"127.0.0.1:41136\": is the master's own address, bind of line 4; \
             give the address of the drive",
            "m.toml:18: bus.bind = \"0.0.0.0\": is taken by the bus of line 4; there is one bus per address, \
             add the drives to that bus",
            "m.toml:20: bus.drive.name = \"y\": is already the drive of line 12; names are unique in the machine",
            "m.toml:21: bus.drive.address = \"127.0.0.11\": is already that of the drive of line 7; one drive \
             per IP address",
            "m.toml:23: bus.name: missing; the bus of line 2 already has the name linudp-v2",
            "m.toml:25: bus.bind = \"127.0.0.11:49360\": is the address of the drive of line 7; give the \
             master's own address",
        ]
    );
}

#[test]
fn addresses_are_ipv4_and_within_reach() {
    let wrong = |bind: &str, address: &str| {
        let text =
            machine("", "").replace("127.0.0.11", address).replace("\"127.0.0.1\"", &format!("\"{bind}\""));
        mistakes(&text)
    };
    let hint = |key, what| {
        let port = if what == "an adapter" { ("192.168.1.1", 41136) } else { ("192.168.1.10", 49360) };
        format!(
            "{key}: must be the IPv4 address of {what}, like \"{}\", or with a port other than {}",
            port.0, port.1
        )
    };
    for address in ["::1", "drive.local", "0.0.0.0", "255.255.255.255", "224.0.0.1", "10.0.0.2:0", "10.0.0"] {
        let expected = hint(format!("m.toml:9: bus.drive.address = \"{address}\""), "a drive");
        assert_eq!(wrong("10.0.0.1", address), [expected]);
    }
    for bind in ["::1", "eth0", "255.255.255.255", "10.0.0.1:0"] {
        let expected = hint(format!("m.toml:5: bus.bind = \"{bind}\""), "an adapter");
        assert_eq!(wrong(bind, "10.0.0.2"), [expected]);
    }
    assert_eq!(
        wrong("127.0.0.1", "10.0.0.2"),
        ["m.toml:9: bus.drive.address = \"10.0.0.2\": cannot be reached from bind = \"127.0.0.1\"; bind to \
             the adapter of the drive's network"]
    );
    assert_eq!(
        wrong("10.0.0.1", "127.0.0.2"),
        [
            "m.toml:9: bus.drive.address = \"127.0.0.2\": cannot be reached from bind = \"10.0.0.1\"; bind to 127.0.0.1"
        ]
    );
}

#[test]
fn a_lonely_group_that_looks_like_another_is_named() {
    let drive = |name: &str, last: u8, group: &str| {
        format!("[[bus.drive]]\nname = \"{name}\"\naddress = \"127.0.0.{last}\"\nstop.group = \"{group}\"\n")
    };
    let text =
        machine("", "") + &drive("y", 12, "gantry") + &drive("z", 13, "gantry") + &drive("w", 14, "gantyr");
    assert_eq!(
        mistakes(&text),
        ["m.toml:22: bus.drive.stop.group = \"gantyr\": no other drive is in this group; did you mean \
             \"gantry\"? leave it \
          out to stop alone"]
    );
}

#[test]
fn files_that_cannot_be_read_say_so() {
    let error = |path: &Path| load(path).unwrap_err().to_string();
    let remedy = "name an existing configuration, for example rt-config/demo.toml";
    assert_eq!(
        error("no/such.toml".as_ref()),
        format!("cannot read no/such.toml: No such file or directory; {remedy}")
    );
    assert_eq!(error("src".as_ref()), format!("cannot read src: Is a directory; {remedy}"));
    // What `fn main() -> Result<(), Box<dyn Error>>` prints.
    let shown = format!("{:?}", Box::<dyn std::error::Error>::from(load("src").unwrap_err()));
    assert_eq!(shown, error("src".as_ref()));
    let device = format!("cannot read /dev/zero: it is a device or a socket; {remedy}");
    assert_eq!(error("/dev/zero".as_ref()), device);

    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name);
    for (name, bytes, line) in [
        ("latin1.toml", &b"[cycle]\n# \xb5s\n"[..], 2),
        ("program", b"\x7fELF\x02\x01\x01\0\0\0", 1),
        ("utf16.toml", b"\n\n[\0c\0y\0", 3),
    ] {
        std::fs::write(path(name), bytes).unwrap();
        let expected =
            format!("{}:{line}: not UTF-8 text; save the file as UTF-8 text", path(name).display());
        assert_eq!(error(&path(name)), expected);
    }

    // Nobody writes into the pipe: opening it would wait for ever.
    let pipe = std::ffi::CString::new(path("pipe").as_os_str().as_encoded_bytes()).unwrap();
    // SAFETY: takes a string that ends in NUL, and a number.
    assert_eq!(unsafe { libc::mkfifo(pipe.as_ptr(), 0o600) }, 0);
    symlink("pipe", path("link")).unwrap();
    for name in ["pipe", "link"] {
        let path = path(name);
        let what = "it is a pipe; write its content to a file, or pipe it into /dev/stdin";
        assert_eq!(error(&path), format!("cannot read {}: {what}", path.display()));
    }
    for (size, what) in
        [((16 << 20) + 1, format!("it has more than 16 MiB; {remedy}")), (16 << 20, String::new())]
    {
        let file = std::fs::File::create(path("long.toml")).unwrap();
        file.set_len(size).unwrap();
        let said = error(&path("long.toml"));
        assert!(said.contains(&what) && (what.is_empty() == said.contains(":1: not UTF-8")), "{said}");
    }
    let curve = fieldbeat::config::linmot::curve::load(path("pipe")).unwrap_err().to_string();
    assert!(curve.contains("it is a pipe"), "{curve}");
    symlink(std::fs::canonicalize("rt-config/demo.toml").unwrap(), path("demo.toml")).unwrap();
    assert!(load(path("demo.toml")).is_ok() && is_demo(path("demo.toml")));
    assert!(!is_demo("rt-config/linmot.toml") && !is_demo(path("pipe")));
}

#[test]
fn a_file_that_is_no_toml_is_one_mistake() {
    let prose = "Dear reader,\n\nthis is no configuration.\n# A heading\nIt is a letter, and it is long.\n";
    let object = "{\n  \"cycle\": {\n    \"period\": \"1ms\",\n    \"core\": 3\n  }\n}\n";
    let program = "#include <stdio.h>\nint main(void)\n{\n    puts(\"hello\");\n    return 0;\n}\n";
    let yaml = "cycle:\n  period: 1ms\n  core: 3\nbus:\n  - protocol: linudp-v2\n";
    for text in [prose, object, program, yaml] {
        let mistakes = mistakes(text);
        assert_eq!(mistakes.len(), 1, "{mistakes:#?}");
        assert!(
            mistakes[0].starts_with("m.toml:") && mistakes[0].ends_with("is this a TOML file?"),
            "{mistakes:?}"
        );
    }
    // One that is TOML but for a few slips has all of them named.
    let slips = machine("drive", "divisor = 1ms\nphase = 2ms\nscale = 1 2\n");
    let said = mistakes(&slips);
    assert_eq!(said.len(), 3, "{said:#?}");
    assert!(!said.iter().any(|line| line.contains("is this a TOML file?")), "{said:#?}");
}

#[test]
fn a_plan_as_json_has_every_key() {
    let plan = load("rt-config/demo.toml").unwrap().plan;
    let said = json(&plan, &[]);
    let keys =
        |value: &serde_json::Value| -> Vec<String> { value.as_object().unwrap().keys().cloned().collect() };
    assert_eq!(keys(&said), ["buses", "cycle", "drives", "errors", "groups", "source"]);
    assert_eq!(said["source"], "rt-config/demo.toml");
    assert_eq!((&said["cycle"]["period_ns"], &said["errors"]), (&1_000_000.into(), &serde_json::json!([])));
    let drives = said["drives"].as_array().unwrap();
    let axes = plan.axes();
    assert_eq!(drives.len(), axes.len());
    let words = describe(&plan).join("\n");
    for (index, (drive, axis)) in drives.iter().zip(&axes).enumerate() {
        assert_eq!(
            keys(drive),
            [
                "address",
                "bus",
                "divisor",
                "drive_watchdog_ns",
                "held_by",
                "if_master_dies",
                "limits",
                "load",
                "name",
                "period_ns",
                "phase",
                "protocol",
                "reply_within_ns",
                "stop",
                "stop_bound_cycles",
                "stop_bound_ns",
                "stops_with",
                "unit",
            ]
        );
        assert_eq!(keys(&drive["stop"]), ["deceleration", "how", "on_timeout", "then", "timeout_ns"]);
        assert_eq!(keys(&drive["limits"]), ["acceleration", "position", "step", "torque", "velocity"]);
        let bound = stop_bound(&plan, index);
        assert_eq!(drive["name"], axis.name.as_str());
        assert_eq!(
            (&drive["stop_bound_cycles"], &drive["stop_bound_ns"]),
            (&bound.into(), &(bound * MS).into())
        );
        let (address, death) =
            (drive["address"].as_str().unwrap(), drive["if_master_dies"].as_str().unwrap());
        assert!(
            words.contains(&format!("drive {}: {address}", axis.name)) && words.contains(death),
            "{drive}"
        );
        assert!(drive["stops_with"].as_array().unwrap().contains(&drive["name"]), "{drive}");
        // A LinUDP drive has no watchdog, the others of the demo have one.
        assert_eq!(drive["drive_watchdog_ns"].is_null(), drive["protocol"] == "linudp-v2", "{drive}");
    }
    let mistakes = parse("[cycle]\nperod = 1\n[[bus]]\n", "m.toml").unwrap_err();
    let first = serde_json::to_value(mistakes.iter().next().unwrap()).unwrap();
    assert_eq!(keys(&first), ["file", "key", "line", "message", "value"]);
    assert_eq!(
        (&first["file"], &first["line"], &first["key"]),
        (&"m.toml".into(), &2.into(), &"cycle.perod".into())
    );
}

#[test]
fn defaults_are_what_the_documentation_says() {
    let spelled = r#"
[cycle]
period = "1ms"
priority = 80
guard = "off"
receive_deadline = 0.5
wait = "poll"
overrun = "skip"
max_skip = 10
max_skip_rate = 0.2
realtime = "prefer"
memory = "process"
[[bus]]
protocol = "linudp-v2"
name = "linudp-v2"
bind = "127.0.0.1:41136"
send = "batch"
[[bus.drive]]
name = "x"
address = "127.0.0.11:49360"
units = "mm"
scale = 10000
invert = false
offset = 0
profile = { velocity = 100, acceleration = 1000, deceleration = 1000 }
in_position = { window = 0.5, for = 10, timeout = "1s" }
divisor = 1
phase = 0
health = { bucket = 5, leak = 20, gate = 10, probe_interval = "100ms" }
underrun = "stop"
on_found_running = "stop"
on_owner_lost = "stop"
enable_timeout = "5s"
home_timeout = "60s"
command_queue = 64
stream_queue = 1024
event_queue = 256
sample_queue = 0
parameter_queue = 64
stream = "pva"
monitor = false
reply_tag = "definition"
inhibit_after = "10ms"
no_drive_watchdog = "refuse"
[bus.drive.stop]
how = "ramp"
deceleration = 1000
then = "disable"
timeout = "3s"
on_timeout = "disable"
standstill = 5
standstill_for = 20
[bus.drive.simulate]
seed = 0
drop = 0
duplicate = 0
corrupt = 0
delay = 0
delay_by = "1ms"
reorder = 0
stall = 0
stall_for = "100ms"
restart = 0
wrong_id = 0
answer_time = "0us"
padding = 14
filter = "none"
range = [-1000, 1000]
home = 0
start = 0
mass = 1
stream_period = "1ms"
status_lag = "0us"
force_enable_bits = false
running = false
config_time = "0us"
flash_time = "500ms"
flash = "silent"
unknown_commands = "refuse"
extend_sign = false
"#;
    let all = read_all(&machine("", ""));
    assert_eq!(format!("{all:#?}"), format!("{:#?}", read_all(spelled)));
    let plan = all.plan;
    assert_eq!(plan.cycle, CyclePlan::default());
    assert_eq!(plan.axes()[0].health, Health::default());
}

#[test]
fn values_arrive_where_they_belong() {
    let plan = read(&machine(
        "cycle",
        "period = \"2ms\"\ncore = 3\nguard = \"150us\"\nwait = \"spin\"\noverrun = \"stop\"\nrealtime = \"require\"\n\
         task_budget = \"0.2ms\"\nreceive_deadline = 0.4",
    ));
    let cycle = &plan.cycle;
    assert_eq!((cycle.period_ns, cycle.core, cycle.guard), (2 * MS, Some(3), Guard::Fixed(150 * US)));
    assert_eq!((cycle.wait, cycle.overrun, cycle.realtime), (Wait::Spin, Overrun::Stop, Realtime::Require));
    assert_eq!((cycle.task_budget_ns, cycle.receive_deadline), (Some(200 * US), 0.4));

    let plan = read(&machine(
        "drive",
        "units = \"rev\"\nscale = 1000\ninvert = true\noffset = 0.5\nmodulo = 1\ndivisor = 4\nphase = 3\n\
         limits = { velocity = 0.5, acceleration = 5, step = 0.1 }\n\
         stop = { how = \"quick\", then = \"hold\", on_timeout = \"hold\", timeout = \"250ms\" }\n\
         underrun = { extrapolate = 3 }\non_found_running = \"refuse\"\n\
         on_owner_lost = \"finish\"\nno_drive_watchdog = \"accept\"\nleash = 0.25",
    ));
    let axis = plan.axes()[0];
    assert_eq!((axis.units.unit, axis.units.counts_per_unit), (Unit::Revolution, -1000.0));
    assert_eq!((axis.units.offset, axis.units.modulo), (0.5, Some(1.0)));
    assert_eq!((axis.divisor, axis.phase), (4, 3));
    // A default profile keeps inside the limits, and the stop takes its deceleration.
    assert_eq!(
        (axis.profile.velocity, axis.profile.acceleration, axis.profile.deceleration),
        (0.5, 5.0, 5.0)
    );
    assert_eq!((axis.stop.deceleration, axis.stop.standstill), (5.0, 0.05));
    assert_eq!((axis.stop.how, axis.stop.then), (StopHow::Quick, StopThen::Hold));
    assert_eq!((axis.stop.on_timeout, axis.stop.timeout), (StopTimeout::Hold, Duration::from_millis(250)));
    assert_eq!((axis.underrun, axis.on_found_running), (Underrun::Extrapolate(3), FoundRunning::Refuse));
    assert_eq!(axis.on_owner_lost, OwnerLost::Finish);
    assert!(format!("{plan:?}").contains("leash: Some(0.25)"));
}

#[test]
fn what_a_drive_shows_besides_is_named_or_numbered() {
    let upid = |number| Some(Upid(number));
    for (value, monitor) in [
        ("false", MonitorPlan::Off),
        ("true", MonitorPlan::AsSet),
        ("[\"demand-velocity\"]", MonitorPlan::Sources([upid(0x1E0F), None, None, None])),
        (
            "[\"core-temperature\", \"0x1E10\", \"1D51h\", 0x1B93]",
            MonitorPlan::Sources([upid(0x1BCD), upid(0x1E10), upid(0x1D51), upid(0x1B93)]),
        ),
        // One that has no name here is one all the same.
        ("[65535]", MonitorPlan::Sources([upid(0xFFFF), None, None, None])),
    ] {
        let plan = read(&machine("drive", &format!("monitor = {value}\nparameter_queue = 3")));
        assert!(format!("{plan:?}").contains(&format!("monitor: {monitor:?}")), "{value}: {plan:?}");
        assert_eq!(plan.axes()[0].parameter_queue, 3);
    }
}

#[test]
fn a_simulated_drive_speaks_user_units() {
    let all = read_all(&machine(
        "drive",
        "invert = true\noffset = 10\nlimits.position = [0, 100]\n\
         simulate = { seed = 7, start = 10, home = 30, filter = \"10.0.0.1\", padding = 64, delay_by = \"3ms\" }",
    ));
    let text = format!("{:?}", all.simulation);
    for part in [
        "start_position: 0,",
        "home_position: -200000,",
        // 5 mm more than the limits on both sides.
        "range: (-950000, 150000)",
        &format!("filter: Fixed({})", Ipv4Addr::new(10, 0, 0, 1)),
        "padding: 64",
        "seed: 7",
        "delay_ns: 3000000",
    ] {
        assert!(text.contains(part), "{part} in {text}");
    }
}

#[test]
fn bus_defaults_fill_in_key_by_key() {
    let Configuration { plan, simulation, .. } = read_all(
        r#"
[[bus]]
protocol = "linudp-v2"
bind = "127.0.0.1"
[bus.defaults]
limits = { velocity = 300, acceleration = 3000 }
stop = { deceleration = 9000, group = "all" }
no_drive_watchdog = "accept"
leash = 20
simulate.seed = 5
[[bus.drive]]
name = "x"
address = "127.0.0.11"
[[bus.drive]]
name = "y"
address = "127.0.0.12"
limits.velocity = 200
stop = { then = "hold", group = "other" }
no_drive_watchdog = "refuse"
[[bus.drive]]
name = "z"
address = "127.0.0.13"
[[bus.drive]]
name = "w"
address = "127.0.0.14"
stop.group = "other"
"#,
    );
    let axes = plan.axes();
    assert_eq!((axes[0].limits.velocity, axes[1].limits.velocity), (Some(300.0), Some(200.0)));
    assert_eq!(axes[1].limits.acceleration, Some(3000.0));
    assert_eq!((axes[1].stop.deceleration, axes[1].stop.then), (9000.0, StopThen::Hold));
    let groups: Vec<_> = axes.iter().map(|axis| axis.stop.group).collect();
    assert_eq!(groups, [Some(0), Some(1), Some(0), Some(1)]);
    let (text, simulated) = (format!("{plan:?}"), format!("{simulation:?}"));
    // One seed for all would lose the same datagrams everywhere.
    for seed in 5..=8 {
        assert_eq!(simulated.matches(&format!("seed: {seed},")).count(), 1);
    }
    assert_eq!((text.matches("leash: Some(20.0)").count(), text.matches("leash: None").count()), (3, 1));
}

#[test]
fn a_stream_command_is_chosen_only_where_it_fits() {
    let chosen = |period: &str, drive: &str| {
        let text = machine("drive", drive).replace("[cycle]", &format!("[cycle]\nperiod = \"{period}\""));
        format!("{:?}", read(&text))
    };
    assert!(chosen("400us", "").contains("stream: Some(Pva)"));
    assert!(chosen("399us", "").contains("stream: None"));
    assert!(chosen("10ms", "").contains("stream: Some(Pva)"));
    assert!(chosen("10.001ms", "").contains("stream: None"));
    assert!(chosen("1ms", "divisor = 11").contains("stream: None"));
    assert!(chosen("1ms", "divisor = 2\nstream = \"p\"").contains("stream: Some(P)"));
    assert!(chosen("1ms", "stream = \"off\"").contains("stream: None"));
}

#[test]
fn the_demo_has_as_many_drives_as_wanted() {
    for (drives, period_ns, divisor) in [(1, 250 * US, 2), (8, MS, 1), (128, MS, 1)] {
        let plan = demo_plan(drives, period_ns, 0).unwrap().plan;
        let [linmots, unidrives] = [0, 1].map(|bus| plan.buses[bus].axes());
        assert_eq!((linmots.len(), unidrives.len(), plan.cycle.period_ns), (drives, 2, period_ns));
        // Its streaming command takes a setpoint every 0.4 ms at most.
        assert!(linmots.iter().all(|axis| axis.divisor == divisor));
        // As many milliseconds between two exchanges as in the file, in different cycles.
        assert!(unidrives.iter().all(|axis| u64::from(axis.divisor) * period_ns == 8 * MS));
        assert_eq!(unidrives[1].phase - unidrives[0].phase, unidrives[0].divisor / 2);
        assert_eq!(plan.cycle.realtime, Realtime::Prefer);
    }
    for period_ns in [50 * US, 333 * US, 2_750 * US, 3 * MS, 10 * MS] {
        let plan = demo_plan(1, period_ns, 0).unwrap().plan;
        let unidrives = plan.buses[1].axes();
        assert_ne!(unidrives[0].phase, unidrives[1].phase, "{period_ns}");
        // No Kollmorgen takes the others.
        let leads = period_ns.is_multiple_of(MS);
        assert_eq!((plan.buses.len(), plan.cycle.reference.is_some()), (if leads { 5 } else { 4 }, leads));
    }
    // The turns of its PROFIBUS wire fit at any of these: a plan in which they do not is refused.
    for period_ns in [50 * US, 250 * US, 333 * US, MS, 2 * MS, 3 * MS, 4 * MS, 8 * MS, 10 * MS, 16 * MS] {
        let plan = demo_plan(1, period_ns, 0).unwrap().plan;
        let lenzes = plan.buses.last().unwrap().axes();
        let [first, second] = lenzes[..] else { panic!("{lenzes:?}") };
        assert!((20 * MS..=33 * MS).contains(&(u64::from(first.divisor) * period_ns)), "{period_ns}");
        assert_eq!((second.divisor, second.phase), (first.divisor, first.divisor / 2), "{period_ns}");
    }
    // Up to the longest cycle that there is, no drive's watchdog expires between two exchanges.
    for period_ns in [50 * MS, 333 * MS, 500 * MS, 751 * MS, S] {
        let plan = demo_plan(1, period_ns, 0).unwrap().plan;
        for bus in &plan.buses {
            for (index, axis) in bus.axes().into_iter().enumerate() {
                let every_ns = period_ns * u64::from(axis.divisor);
                let watchdog_ns = bus.drive_watchdog_ns(index);
                assert!(watchdog_ns.is_none_or(|ns| ns > every_ns), "{period_ns}: {}", axis.name);
            }
        }
        // A segment that does not take the period is left out, and no other bus.
        let left_out = usize::from(plan.buses.iter().all(|bus| bus.name() != "ethercat"));
        assert_eq!(plan.buses.len(), 5 - left_out, "{period_ns}");
    }
    // What a busy computer is allowed is stated in time.
    for period_ns in [MS, 4 * MS, 8 * MS] {
        let plan = demo_plan(1, period_ns, 0).unwrap().plan;
        assert_eq!(plan.cycle.overrun, Overrun::Skip { max_skip: S / period_ns });
        for axis in plan.axes() {
            assert_eq!(
                (u64::from(axis.health.bucket), axis.health.leak),
                (S.div_ceil(period_ns * u64::from(axis.divisor)), 1)
            );
        }
    }
    // A stream is taken up to 10 ms; a longer period has none.
    let streams = |period_ns| format!("{:?}", demo_plan(1, period_ns, 0).unwrap()).contains("stream: Some(");
    assert_eq!((streams(DEMO_STREAMS_UP_TO_NS), streams(16 * MS)), (true, false));
    // No two places share an address or a segment.
    let places: Vec<String> =
        (0..DEMO_PLACES).map(|place| format!("{:?}", demo_plan(1, MS, place).unwrap())).collect();
    for (place, text) in places.iter().enumerate() {
        for other in (0..DEMO_PLACES).filter(|other| *other != place) {
            let net = if other == 0 { 77 } else { 240 + other };
            assert!(!text.contains(&format!("127.{net}.")), "{place} has addresses of {other}");
        }
    }
    assert_eq!(demo_plan(0, MS, 0).unwrap_err().to_string(), "0 drives: the demo has 1 to 128");
    assert_eq!(demo_plan(129, MS, 0).unwrap_err().to_string(), "129 drives: the demo has 1 to 128");
    let error = demo_plan(8, 10 * US, 0).unwrap_err().to_string();
    assert!(
        error.ends_with("cycle.period = \"10000ns\": must be at least 50 us; 1ms is 1000 cycles a second"),
        "{error}"
    );
}

#[test]
fn the_linmot_sample_tells_the_truth() {
    let sample = tells_the_truth("rt-config/linmot.toml", 50);
    // No key is left out: the reader's own list of them is in the sample.
    for section in ["cycle", "bus", "drive"] {
        for key in keys(&machine(section, "no_such_key = 1")) {
            assert!(sample.contains(&key), "{key}");
        }
    }
}

#[test]
fn the_unidrive_sample_tells_the_truth() {
    let sample = tells_the_truth("rt-config/unidrive.toml", 45);
    // What drives of every protocol have is told at length in the other one.
    let common = keys(&machine("drive", "no_such_key = 1"));
    let of_its_own = |key: &String| !common.contains(key);
    for key in keys(&unidrive("", "no_such_key = 1")).iter().filter(|key| of_its_own(key)) {
        assert!(sample.contains(key.as_str()), "{key}");
    }
    for table in ["map", "watchdog"] {
        for key in keys(&unidrive("", &format!("{table}.no_such_key = 1"))) {
            assert!(sample.contains(&key), "{key}");
        }
    }
}

#[test]
fn the_moons_sample_tells_the_truth() {
    let sample = tells_the_truth("rt-config/moons.toml", 25);
    let common = keys(&machine("drive", "no_such_key = 1"));
    let of_its_own = |key: &String| !common.contains(key);
    for key in keys(&moons("", "no_such_key = 1")).iter().filter(|key| of_its_own(key)) {
        assert!(sample.contains(key.as_str()), "{key}");
    }
    for key in keys(&moons("bus", "no_such_key = 1")) {
        assert!(sample.contains(key.as_str()), "{key}");
    }
    for table in ["homing", "enable_input"] {
        for key in keys(&moons("", &format!("{table}.no_such_key = 1"))) {
            assert!(sample.contains(&key), "{key}");
        }
    }
}

/// The keys that are said to be valid in the section of a mistaken one.
fn keys(text: &str) -> Vec<String> {
    let error = mistakes(text).concat();
    let (_, keys) = error.rsplit_once("valid here: ").unwrap();
    keys.split(", ").map(str::to_owned).collect()
}

/// The commented keys of a sample are said to show the defaults: taking away the "# " must change nothing.
fn tells_the_truth(file: &str, least: usize) -> String {
    let sample = std::fs::read_to_string(file).unwrap();
    let is_key = |line: &str| {
        let key = line.split(" = ").next().unwrap_or_default();
        line.contains(" = ") && key.chars().all(|c| c.is_ascii_lowercase() || c == '_' || c == '.')
    };
    let spelled: String = sample
        .lines()
        .map(|line| match line.strip_prefix("# ").filter(|rest| is_key(rest)) {
            Some(default) => format!("{default}\n"),
            None => format!("{line}\n"),
        })
        .collect();
    assert!(spelled.lines().filter(|line| is_key(line)).count() > least);
    let (short, full) = (read_all(&sample), read_all(&spelled));
    assert_eq!(format!("{:#?}", short.plan.buses), format!("{:#?}", full.plan.buses));
    assert_eq!(format!("{:#?}", short.simulation), format!("{:#?}", full.simulation));
    assert_eq!(short.plan.cycle, full.plan.cycle);
    assert_eq!(short.soak, full.soak);
    sample
}

#[test]
fn the_plan_in_words() {
    let text = r#"
[cycle]
period = "2ms"
guard = "auto"
[[bus]]
protocol = "linudp-v2"
name = "portal"
bind = "192.168.1.1"
[[bus.drive]]
name = "x"
address = "192.168.1.11"
limits = { position = [-10, 10.5], velocity = 100 }
stop = { group = "xy", deceleration = 500 }
[[bus.drive]]
name = "y"
address = "192.168.1.12"
divisor = 3
phase = 1
health.bucket = 4
stop = { group = "xy", how = "coast" }
stream = "off"
on_owner_lost = "finish"
no_drive_watchdog = "accept"
leash = 7.5
[[bus.drive]]
name = "z"
address = "192.168.1.13"
[[bus.drive]]
name = "w"
address = "192.168.1.14"
"#;
    let plan = read(text);
    assert_eq!(describe(&plan).join("\n"), DESCRIPTION.trim().replace("\n        ", " "));
    // x: 5 misses, then y's turn within 3 cycles. y: 4 misses every 3 cycles, then x and y in the next.
    let axes = plan.axes();
    assert_eq!([0, 1, 2].map(|index| stop_bound_cycles(axes[index], &axes)), [8, 13, 6]);
}

/// What is eight columns in goes on where the line before it ends.
const DESCRIPTION: &str = r#"
m.toml: 4 drives, 1 bus
cycle: every 2 ms (500 Hz), on the last core, SCHED_FIFO 80 and all memory of the process locked if this host grants it
  wakes with a calibrated final spin, takes replies by poll until 1 ms into the cycle
  an overrun skips slots and keeps the grid, more than 10 in a row or 20 of the last 100
        stop all axes
  a loop that gives no sign of life for 500 ms is stuck: its watch takes the wires, and the run
        has failed
  a cycle that is late by more than 200 us is counted with its cause
bus portal: linudp-v2, 4 drives
  drive x: 192.168.1.1:41136 -> 192.168.1.11:49360
    streams "pva", a setpoint every 2 ms (the drive takes 400 us ... 10 ms)
    a late reply is recognised by its response definition, one of eight in turn; a hardware enable (STO) counts as
        missing after 10 ms
    if the master dies: a LinUDP drive has no watchdog, a move runs to its target, jogs and cyclic velocities are
        refused, a stream ends in the drive's own underflow error
    an exchange every cycle (2 ms)
    link up after 10 good exchanges in a row, lost after 5 misses in a row: the stop request is on the wire within 8
        cycles (16 ms) of the last good one; with slots skipped lost after 40 ms at the latest; stop together: x, y
    stop: ramp at 500 mm/s²; at standstill (below 5 mm/s for 20 exchanges) power off; without it after 3 s
        the drive's quick stop, after 6 s power off
    stopped by a velocity setpoint older than 10 cycles (20 ms) and by a jog not renewed for 500 ms
    limits: -10 ... 10.5 mm, 100 mm/s
    a move is done within 0.5 mm of its target for 10 exchanges (20 ms); it has failed 1 s after the end of its
        demand
    stopped by a following error of rows above 5.5 mm (limits.following_error)
  drive y: 192.168.1.1:41136 -> 192.168.1.12:49360
    no streams (stream = "off")
    a late reply is recognised by its response definition, one of eight in turn; a hardware enable (STO) counts as
        missing after 10 ms
    if the master dies: a LinUDP drive has no watchdog, a move runs to its target, a jog or cyclic velocity runs at
        most 7.5 mm further
    an exchange every 3 cycles (6 ms), phase 1
    link up after 10 good exchanges in a row, lost after 4 misses in a row: the stop request is on the wire within 13
        cycles (26 ms) of the last good one; with slots skipped lost after 68 ms at the latest; stop together: x, y
    stop: power off at once
    stopped by a velocity setpoint older than 10 cycles (20 ms) and by a jog not renewed for 500 ms
    a program that drops the axis lets it go on to the end of what was commanded
    limits: only the drive's own
    a move is done within 0.5 mm of its target for 10 exchanges (60 ms); it has failed 1 s after the end of its
        demand
    its following error is not watched here: that needs limits.velocity or limits.following_error
  drive z: 192.168.1.1:41136 -> 192.168.1.13:49360
    streams "pva", a setpoint every 2 ms (the drive takes 400 us ... 10 ms)
    a late reply is recognised by its response definition, one of eight in turn; a hardware enable (STO) counts as
        missing after 10 ms
    if the master dies: a LinUDP drive has no watchdog, a move runs to its target, jogs and cyclic velocities are
        refused, a stream ends in the drive's own underflow error
    an exchange every cycle (2 ms)
    link up after 10 good exchanges in a row, lost after 5 misses in a row: the stop request is on the wire within 6
        cycles (12 ms) of the last good one; with slots skipped lost after 40 ms at the latest
    stop: ramp at 1000 mm/s²; at standstill (below 5 mm/s for 20 exchanges) power off; without it after 3 s
        the drive's quick stop, after 6 s power off
    stopped by a velocity setpoint older than 10 cycles (20 ms) and by a jog not renewed for 500 ms
    limits: only the drive's own
    a move is done within 0.5 mm of its target for 10 exchanges (20 ms); it has failed 1 s after the end of its
        demand
    its following error is not watched here: that needs limits.velocity or limits.following_error
  drive w: 192.168.1.1:41136 -> 192.168.1.14:49360; else as z
one master each: another one of this host that has one of these interfaces or drives is named, and the start
        refused
the black box holds the last 2 s in 0.4 MB, written to a file at a fault, a lost drive, another stop, and SIGUSR1
Fieldbeat is not a safety function: the machine needs its own STO / emergency stop.
"#;

#[test]
fn a_unidrive_in_words() {
    let text = r#"
[[bus]]
protocol = "modbus-tcp"
[bus.defaults]
divisor = 8
stop.group = "all"
[[bus.drive]]
name = "direct"
address = "192.168.1.21"
[[bus.drive]]
name = "menu"
address = "192.168.1.21:1502"
phase = 4
via = { menu_0 = 11 }
monitor = false
reply_within = "100us"
watchdog = { timeout = "off", keypad = true }
set_up = false
[[bus.drive]]
name = "unwatched"
address = "192.168.1.22"
function = "16+3"
watchdog.timeout = "off"
no_drive_watchdog = "accept"
stop.group = "own"
divisor = 1
[[bus.drive]]
name = "refused"
address = "192.168.1.23"
function = "23"
watchdog.timeout = "off"
stop.group = "own"
[[bus]]
protocol = "linudp-v2"
bind = "192.168.1.1"
[[bus.drive]]
name = "x"
address = "192.168.1.11"
stop.group = "own"
"#;
    let plan = read(text);
    let reported = describe(&plan);
    let of = |name: &str| {
        let begin = reported.iter().position(|line| line.starts_with(&format!("  drive {name}: "))).unwrap();
        let rest = reported[begin + 1..].iter().take_while(|line| line.starts_with("    "));
        std::iter::once(&reported[begin]).chain(rest).map(|line| line.trim_start()).collect::<Vec<_>>()
    };
    assert_eq!(
        of("direct"),
        [
            "drive direct: 192.168.1.21:502",
            "one request every 8 ms writes what changed and reads a part: status and speed within 3 requests, \
             all parameters within 12 requests",
            "by FC23; a drive that refuses or ignores it is written by FC16 and read by FC03 in turns (no_fc23 \
             counts that)",
            "a reply counts for 250 ms; after 500 ms of silence its connection is opened again, with pauses: a \
             stop request leaves with the first exchange on the new one, and until then only the drive's own \
             watchdog stops it",
            "one lost frame delays an exchange by 200 ms, since TCP repeats it no sooner, and the link stays up: \
             a stop request that waits for it leaves 218 ms later at most; a frame lost twice costs the link",
            "takes velocities; no moves, no streams, no homing",
            "shows percentage-load",
            "if the master dies: the drive trips within 500 ms and its motor coasts (Pr 4.15.009, set by the \
             master before it is enabled)",
            "an exchange every 8 cycles (8 ms), phase 0",
            "link up after 10 good exchanges in a row, lost after 5 misses in a row: the stop request is on \
             the wire within 1290 cycles (1.29 s) of the last good one, if it still answers; with slots \
             skipped lost after 2.574 s at the latest; stop together: direct, menu",
            "stop: ramp at 10 rev/s²; at standstill (below 0.05 rev/s for 20 exchanges) power off; without it \
             after 3 s the drive's quick stop, after 6 s power off",
            "stopped by a velocity setpoint older than 10 cycles (10 ms) and by a jog not renewed for 500 ms",
            "limits: only the drive's own",
        ]
    );
    for (name, line) in [
        (
            "menu",
            "one request every 8 ms writes and reads all parameters, in a row in menu 0 from Pr 00.011 (the \
             master sets Pr 22.011 and those after it)",
        ),
        (
            "menu",
            "set_up = false: the master writes no settings, and enables the drive only if they are as needed",
        ),
        ("menu", "if the master dies: the drive trips within 1 s and its motor coasts (the keypad watchdog)"),
        (
            "menu",
            "one lost frame costs the link: TCP repeats it after 200 ms at the earliest; reply_within from 210 ms \
             on would wait for it",
        ),
        ("unwatched", "writing (FC16) and reading (FC03) take turns"),
        ("refused", "by FC23 and no other function"),
        (
            "unwatched",
            "if the master dies: nothing stops the drive: it keeps its last speed (no_drive_watchdog = \"accept\")",
        ),
        (
            "refused",
            "if the master dies: nothing would stop the drive, so it is not enabled (no_drive_watchdog = \"refuse\")",
        ),
    ] {
        assert!(of(name).contains(&line), "{line}\n{:#?}", of(name));
    }
    assert!(!of("menu").iter().any(|line| line.starts_with("shows")));
    // A reply of 250 ms is owed for 250 cycles behind that of its request, so that with a divisor of 8 a turn takes 256
    // at most. direct: 8 until it is asked, 4 turns, 250, then menu's turn of 8. menu: 5 turns of 8, then that of
    // direct. unwatched: 1, 4 turns of 251, 250, then refused's turn. refused: 8, 4 of 256, 250, then unwatched's.
    // x: 5, then refused's.
    let bounds = [0, 1, 2, 3, 4].map(|index| stop_bound(&plan, index));
    let (direct, unwatched) = (8 + 4 * 256 + 250, 1 + 4 * 251 + 250);
    assert_eq!(bounds, [direct + 8, 5 * 8 + 256, unwatched + 256, direct + 251, 5 + 256]);
}

#[test]
fn values_of_a_unidrive_arrive_where_they_belong() {
    use fieldbeat::bus::modbus::{Mapped, Parameter, UnidriveDrive};
    use fieldbeat::sim::modbus::UnidriveSettings;
    let usual = UnidriveDrive::new("u", [127, 0, 0, 21].into());
    let mut settings = UnidriveSettings::of(&usual);
    let faults = &mut settings.faults;
    (faults.delay_ns, faults.stall_ns, faults.inhibit_ns) = (MS, 100 * MS, 100 * MS);
    let Configuration { plan, simulation, .. } = read_all(&unidrive("", ""));
    assert!(format!("{plan:?}").contains(&format!("{usual:?}")));
    assert!(format!("{simulation:?}").contains(&format!("{settings:?}")));
    let text = unidrive(
        "",
        "unit = 1\nslot = 3\naddressing = \"modified\"\nvia = \"menu-0\"\nfunction = \"16+3\"\n\
         reply_within = \"20ms\"\nset_up = false\n\
         units = \"mm\"\nscale = 0.5\ninvert = true\n\
         map.control = { parameter = \"06.042\", bits = 32 }\nmap.speed = { parameter = \"18.011\", bits = \
             16, decimals = 2 }\n\
         map.trip = \"off\"\nmonitor = [\"dc-bus-voltage\", \"04.001\"]\nalso_read = [\"20.021 ... 20.023\", \
             \"05.001\"]\n\
         watchdog = { timeout = \"off\", keypad = true }\nno_drive_watchdog = \"accept\"\n\
         simulate = { running = -2, rated_speed = 1500, fc23 = false, menu_0 = false, connections = 2, cut = 0.5, \
         split = 0.25 }",
    );
    let reported = format!("{:?}", read_all(&text));
    let long = |menu, number| format!("{:?}", Mapped::new(Parameter::new(menu, number)));
    for part in [
        "unit: Some(1), slot: 3, addressing: Modified",
        "counts_per_unit: -0.5",
        "control: Mapped { parameter: Parameter { slot: 0, menu: 6, number: 42 }, width: Long, decimals: 0 }",
        "speed: Mapped { parameter: Parameter { slot: 0, menu: 18, number: 11 }, width: Word, decimals: 2 }",
        "trip: None",
        &format!("show: [Some({}), Some({}), None, None]", long(5, 5), long(4, 1)),
        &format!("also: [{}, {}, {}, {}]", long(20, 21), long(20, 22), long(20, 23), long(5, 1)),
        "via: Menu0 { first: 1 }, functions: Apart, reply_within_ns: 20000000",
        "Watchdog { timeout_ns: None, keypad: true, accept_none: true }, set_up: false",
        "split: 0.25, cut: 0.5",
        "connections: 2, read_write: Refused, registers: 120, menu_zero: false, drive_units: [1]",
        "rated_rpm: 1500.0",
        // 2 mm/s backwards are a revolution a second of an inverted motor.
        "start: Running(60.0)",
    ] {
        assert!(reported.contains(part), "{part} in {reported}");
    }
}

#[test]
fn values_of_a_moons_drive_arrive_where_they_belong() {
    use fieldbeat::bus::ethernet_ip::{EthernetIpPlan, MoonsDrive};
    let usual = MoonsDrive::new("m", [127, 0, 0, 31].into());
    let bus = EthernetIpPlan::new([127, 0, 0, 1].into(), vec![usual]);
    let plan = read(&moons("", ""));
    assert!(format!("{plan:?}").contains(&format!("{bus:?}")), "{plan:?}");
    let bus_keys = "originator = { vendor = 60, serial = 7 }\ndscp = 43\nsend = \"each\"";
    let text = moons(
        "",
        "divisor = 10\nsteps_per_rev = 10000\nunits = \"mm\"\nscale = 0.2\ninvert = true\n\
         version = \"v2\"\nlayout = \"page\"\ndelivery = \"multicast\"\ninput_rpi = \"5ms\"\n\
         timeout_multiplier = 64\nfresh_within = \"20ms\"\nfirst_within = \"2s\"\nconfiguration = [1, 0]\n\
         explicit = \"connected\"\nhold = 3\neffect_within = \"300ms\"\n\
         watchdog = \"1s\"\nno_drive_watchdog = \"accept\"\n\
         enable_input = { input = 3, closed = false }\nhomed_register = \"3\"\nencoder = 4000\njog = false\n\
         homing = { method = \"find\", input = \"2L\", velocity = 5, acceleration = 50, distance = -20 }",
    )
    .replace("bind = \"127.0.0.1\"\n", &format!("bind = \"127.0.0.1\"\n{bus_keys}\n"));
    let reported = format!("{:?}", read(&text));
    for part in [
        "originator: Originator { vendor: 60, serial: 7 }, dscp: 43, send: Each",
        // 0.2 revolutions of 10000 steps in a millimetre.
        "counts_per_unit: -2000.0",
        "steps_per_revolution: 10000.0, address: 127.0.0.31:44818",
        "version: Some(V2), layout: Page, delivery: Multicast, input_rpi_ns: Some(5000000), multiplier: Some(4)",
        "fresh_within_ns: Some(20000000), first_within_ns: 2000000000, configuration: Some([1, 0]), heartbeat: None",
        "explicit: Connected, hold: 3, effect_within_ns: 300000000",
        "Watchdog { within_ns: Some(1000000000), accept_none: true }",
        "enable_input: Some(EnableInput { number: 3, closed: false })",
        "Homing { method: Find, input: 19634, velocity: 5.0, acceleration: 50.0, distance: -20.0 }",
        "homed_register: Some(51), encoder: true, encoder_counts_per_step: 0.4, jog: false",
    ] {
        assert!(reported.contains(part), "{part} in {reported}");
    }
    let listening = format!("{:?}", read(&moons("", "connection = \"listen-only\"\nheartbeat = 6")));
    assert!(listening.contains("connection: ListenOnly"), "{listening}");
    assert!(
        listening.contains("delivery: Multicast") && listening.contains("heartbeat: Some(6)"),
        "{listening}"
    );
}

#[test]
fn a_simulated_moons_drive_is_as_its_keys_say() {
    let all = read_all(&moons(
        "",
        "divisor = 10\nsteps_per_rev = 10000\ninvert = true\n\
         enable_input = { input = 3, closed = false }\n\
         homing = { method = \"seek\", input = \"2L\", velocity = 5, acceleration = 50, distance = -20 }\n\
         simulate = { seed = 9, model = \"SSDC\", drift_ppm = -30, jitter = \"50us\", tick = \"2ms\", zs = \"200ms\", \
         za = 15, edges = \"strict\", ownership = \"kept\", configuration = \"required\", inactivity = \"0s\", \
         range = [-1, 50], home = [10, 10.5], start = 3, running = 2, alarm = 512 }",
    ));
    let text = format!("{:?}", all.simulation);
    for part in [
        "kind: StepServo",
        "clock: ClockSettings { drift_ppm: -30, jitter_ns: 50000, seed: 9 }",
        "inactivity_s: 0",
        "configuration: Required",
        "tick_ns: 2000000, ownership: Kept",
        "edges: Strict, idle: Ignored, zs_ms: 200, za: 15",
        "persistent_alarm: 512",
        // 10000 steps a revolution, inverted.
        "limits: Some((-500000, 10000))",
        "home: Some(HomeSwitch { at: Wired { input: 2, closed: true }, range: (-100000, -105000) })",
        "enable: Some(Wired { input: 3, closed: false })",
        "steps: 10000, encoder: None, start: -30000",
        "running: Some(-20000.0)",
    ] {
        assert!(text.contains(part), "{part} in {text}");
    }
}

#[test]
fn addresses_of_moons_drives_are_hosts_of_their_own() {
    let with = |bind: &str, address: &str| {
        mistakes(&moons("", "").replace("127.0.0.1\"", bind).replace("127.0.0.31\"", address))
    };
    for bind in ["0.0.0.0", "224.0.0.1", "10.0.0.1:0", "adapter"] {
        let hint = "must be the IPv4 address of an adapter, like \"192.168.1.1\", or with a port other than 2222; \
            never 0.0.0.0, since drives compare it";
        let bind_key = format!("{bind}\"");
        assert_eq!(with(&bind_key, "127.0.0.31\""), [format!("m.toml:4: bus.bind = \"{bind}\": {hint}")]);
    }
    let own = "is the master's own address, bind; give that of the drive";
    assert_eq!(
        with("127.0.0.1\"", "127.0.0.1\""),
        [format!("m.toml:8: bus.drive.address = \"127.0.0.1\": {own}")]
    );
    let far = "cannot be reached from bind = \"127.0.0.1\"; bind to the adapter of the drive's network";
    assert_eq!(
        with("127.0.0.1\"", "10.0.0.1\""),
        [format!("m.toml:8: bus.drive.address = \"10.0.0.1\": {far}")]
    );
    let second = moons("", "") + "[[bus.drive]]\nname = \"n\"\naddress = \"127.0.0.31:5000\"\n";
    assert_eq!(
        mistakes(&second),
        [
            "m.toml:12: bus.drive.address = \"127.0.0.31:5000\": is already that of the drive of line 8; one drive per \
          IP address"
        ]
    );
    let group = moons("", "delivery = \"multicast\"").replace("127.0.0.1\"", "127.0.0.1:2223\"");
    assert_eq!(
        mistakes(&group),
        ["m.toml:9: bus.drive.delivery = \"multicast\": needs the port 2222 in bind: packets of a group \
          come to no other one"]
    );
}

#[test]
fn a_connection_of_its_own_is_told_by_address_and_port() {
    let drive =
        |name: &str, address: &str| format!("[[bus.drive]]\nname = \"{name}\"\naddress = \"{address}\"\n");
    let text = unidrive("", "")
        + &drive("v", "127.0.0.21:1502")
        + &drive("w", "127.0.0.21:502")
        + "[[bus]]\nprotocol = \"linudp-v2\"\nbind = \"127.0.0.1\"\n"
        + &drive("x", "127.0.0.21")
        + "[[bus]]\nprotocol = \"modbus-tcp\"\nname = \"second\"\n"
        + &drive("y", "127.0.0.21:503");
    assert_eq!(
        mistakes(&text),
        [
            "m.toml:14: bus.drive.address = \"127.0.0.21:502\": is already that of the drive of line 7; one drive \
            per address and port",
            "m.toml:20: bus.drive.address = \"127.0.0.21\": is already that of the drive of line 7; one drive \
             per IP address",
        ]
    );
    for address in ["::1", "0.0.0.0", "224.0.0.1", "10.0.0.2:0", "u.local"] {
        let text = unidrive("", "").replace("127.0.0.21", address);
        let hint =
            "must be the IPv4 address of a drive, like \"192.168.1.20\", or with a port other than 502";
        assert_eq!(mistakes(&text), [format!("m.toml:7: bus.drive.address = \"{address}\": {hint}")]);
    }
    assert_eq!(
        mistakes("[[bus]]\nprotocol = \"modbus-tcp\"\n[[bus.drive]]\nname = \"u\""),
        ["m.toml:3: bus.drive.address: missing; the address of the drive, like \"192.168.1.20\""]
    );
}

/// x and y stop together and exchange together; z does neither, v only exchanges with them.
const FOUR: &str = r#"
[cycle]
heartbeat = "250ms"
[[bus]]
protocol = "linudp-v2"
bind = "127.0.0.1"
[[bus.drive]]
name = "x"
address = "127.0.0.11"
stop.group = "xy"
load = "vertical"
held_by = "brake"
jog_deadman = "off"
health.bucket = 3
[[bus.drive]]
name = "y"
address = "127.0.0.12"
stop.group = "xy"
load = "vertical"
held_by = "drive"
[[bus.drive]]
name = "z"
address = "127.0.0.13"
divisor = 2
[[bus.drive]]
name = "v"
address = "127.0.0.14"
"#;

#[test]
fn who_holds_the_load_and_who_watches_the_application_is_said() {
    let plan = read(&format!("{FOUR}[[group]]\nname = \"g\"\naxes = [\"y\", \"x\"]\n"));
    let reported = describe(&plan).join("\n");
    for line in [
        "  a silence of the application of 250 ms stops all enabled axes",
        "    vertical load: power goes off at standstill, or by the time-out; set the drive to close its \
         brake before its power stage goes off",
        "    vertical load: only the powered drive holds it, so the master never powers it off",
        "    stopped by a velocity setpoint older than 10 cycles (10 ms); a jog runs until something replaces it",
        "group g: y, x act in the same cycle, all or none; 3 rounds with a missed exchange of any of \
             them stop the group in motion",
    ] {
        assert!(reported.contains(line), "{line}\n{reported}");
    }
    // What only the drive holds stays on unless the file says otherwise, and that would be refused.
    assert_eq!(plan.axes()[1].stop.then, fieldbeat::axis::StopThen::Hold);
}

#[test]
fn a_plan_built_in_code_is_checked_by_the_same_rules() {
    use fieldbeat::axis::{HeldBy, Load, StopHow};
    use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
    use fieldbeat::{GroupPlan, Plan};
    let mut drive = LinUdpDrive::new("x", [127, 0, 0, 11].into());
    drive.axis.load = Load::Vertical(HeldBy::Brake);
    drive.axis.stop.how = StopHow::Coast;
    (drive.axis.units.counts_per_unit, drive.axis.phase) = (0.0, 1);
    let nameless = LinUdpDrive::new("../y", [127, 0, 0, 12].into());
    let bus = LinUdpPlan::new([127, 0, 0, 1].into(), vec![drive.clone(), drive, nameless]);
    let groups = vec![GroupPlan { name: "g".into(), axes: vec!["x".into(), "w".into()] }];
    let cycle = CyclePlan { period_ns: 0, receive_deadline: 1.0, ..CyclePlan::default() };
    let plan = Plan { source: None, cycle, buses: vec![Box::new(bus)], groups };
    let reported = plan.check().unwrap_err().to_string();
    for part in [
        "cycle: a receive deadline of 1 is not a share",
        "cycle: a period of 0 is outside",
        "drive x: its name is taken",
        "drive \"../y\": its name must be 1 to 32 letters, digits, - _ or .",
        "drive x: scale: must be a finite number",
        "drive x: phase: must be below divisor = 1",
        "drive x: stop.how: would let a vertical load drop",
        "drive x: address: is taken by another drive",
        "group g: there is no drive w",
    ] {
        assert!(reported.contains(part), "{part}\n{reported}");
    }
    let refused = fieldbeat::Master::from_plan(plan).start().unwrap_err().to_string();
    assert_eq!(refused, reported, "and nothing was opened");
}

#[test]
fn spinning_under_throttling_starves_the_host() {
    let throttled = Throttling { runtime_us: Some(950_000), period_us: 1_000_000 };
    let free = Throttling { runtime_us: None, ..throttled };
    let plan =
        |guard, wait, receive_deadline| CyclePlan { guard, wait, receive_deadline, ..CyclePlan::default() };
    let harmless = [
        plan(Guard::Off, Wait::Spin, 0.5),
        plan(Guard::Fixed(500 * US), Wait::Poll, 0.5),
        plan(Guard::Auto, Wait::Spin, 0.25),
    ];
    for cycle in &harmless {
        assert_eq!(starvation(cycle, &throttled), None, "{cycle:?}");
    }
    let starving = [
        plan(Guard::Off, Wait::Spin, 0.6),
        plan(Guard::Fixed(501 * US), Wait::Poll, 0.4),
        plan(Guard::Auto, Wait::Spin, 0.5),
    ];
    for cycle in &starving {
        assert!(starvation(cycle, &throttled).is_some(), "{cycle:?}");
        assert_eq!(starvation(cycle, &free), None);
        assert_eq!(starvation(&CyclePlan { realtime: Realtime::Off, ..cycle.clone() }, &throttled), None);
    }
    assert_eq!(
        starvation(&starving[2], &throttled).unwrap(),
        "cycle: guard (250 us) and spinning receive (500 us) would hold the core for 750 us of every 1 ms, \
         and this kernel \
         takes it away from real-time threads after 950 ms of every 1 s; use wait = \"poll\" or a shorter \
             guard, or on a \
         core of its own: sysctl kernel.sched_rt_runtime_us=-1"
    );
}

/// Whatever stands in the file: a plan that can be put into words, or mistakes of one printable line each.
fn never_panics(text: &str) {
    match parse(text, "m.toml") {
        Ok(all) => assert!(describe(&all.plan).len() > 3),
        Err(errors) => {
            assert!(errors.iter().count() > 0);
            for line in errors.iter().map(ToString::to_string) {
                assert!(!line.contains(char::is_control), "{line:?}");
            }
        }
    }
}

proptest! {
    #[test]
    fn arbitrary_text_never_panics(text in "(?s).{0,200}") {
        never_panics(&text);
    }

    #[test]
    fn arbitrary_toml_never_panics(lines in prop::collection::vec("(\\[{0,2}|[a-z\"_.]{1,8} ?= \
        ?)[\\PC\n]{0,20}\\]{0,2}", 0..20)) {
        never_panics(&lines.join("\n"));
    }

    /// A sample with values, keys and headers replaced, so that every reader meets what it does not expect.
    #[test]
    fn a_mangled_sample_never_panics(
        changes in prop::collection::vec(
            (
                any::<prop::sample::Index>(),
                prop::sample::select(vec![
                    "", "0", "-1", "1e308", "-1e308", "5e-324", "9223372036854775807", "0xffff_ffff", "nan", "inf",
                    "true",
                    "[]", "[[]]", "[0, 1]", "[-1e300, 1e300]", "{}", "{ extrapolate = 1 }", "{ velocity = 1e300 }",
                    "\"\"", "\"x\"", "\"1ms\"", "\"18446744073s\"", "\"0.0.0.0\"", "\"127.77.0.1:41136\"", "\"off\"",
                    "1979-05-27", "\"\"\"\n\u{1b}[2J\"\"\"", "\"\u{202e}\"",
                ]),
            ),
            1..6,
        ),
        which in 0_usize..3,
    ) {
        let samples = [
            include_str!("../../rt-config/linmot.toml"),
            include_str!("../../rt-config/kollmorgen.toml"),
            include_str!("../../rt-config/lenze.toml"),
        ];
        let sample = samples[which].replace("\n# stop", "\nstop").replace("\n# sim", "\nsim");
        let mut lines: Vec<String> = sample.lines().map(str::to_owned).collect();
        for (line, value) in changes {
            let line = line.index(lines.len());
            if let Some((key, _)) = lines[line].clone().split_once('=') {
                lines[line] = format!("{}= {value}", key.trim_start_matches("# "));
            }
        }
        never_panics(&lines.join("\n"));
    }
}

#[test]
fn one_drive_of_a_machine_is_moved_in_the_machine_s_cycle_and_read_in_any() {
    let cycle = "overrun = \"stop\"\nrealtime = \"require\"\nblack_box = \"5s\"\npriority = 70";
    let text = machine("cycle", cycle) + "[[bus.drive]]\nname = \"y\"\naddress = \"127.0.0.12\"\n";
    let plan = read(&text);
    let names = |plan: &Plan| plan.axes().iter().map(|axis| axis.name.clone()).collect::<Vec<_>>();
    let alone = plan.alone("y").unwrap();
    assert_eq!((&alone.cycle, names(&alone)), (&plan.cycle, vec!["y".to_owned()]));
    assert_eq!((alone.cycle.overrun, alone.cycle.realtime), (Overrun::Stop, Realtime::Require));
    assert_eq!(alone.axes()[0].on_found_running, FoundRunning::Refuse);
    let reaching = plan.reaching("y").unwrap();
    assert_eq!((reaching.cycle.realtime, names(&reaching)), (Realtime::Off, vec!["y".to_owned()]));
    assert!(plan.alone("z").is_none() && plan.reaching("z").is_none());
}
