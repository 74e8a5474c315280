//! The configuration as a user meets it: every mistake on a line of its own, the samples, and the defaults.

mod errors;
mod ethercat;
mod profibus;
mod schema;

use std::collections::BTreeSet;
use std::os::unix::fs::symlink;
use std::path::Path;

use fieldbeat::axis::{FoundRunning, Health, StopThen};
use fieldbeat::config::{Configuration, load, parse};
use fieldbeat::time::{MS, S, US};
use fieldbeat::{CyclePlan, Guard, Overrun, Plan, Realtime, Wait};
use fieldbeat_config::demo::{DEMO_PLACES, DEMO_STREAMS_UP_TO_NS, demo_plan, is_demo};
use fieldbeat_config::{describe, json};
use fieldbeat_core::bus::facts::of_drives;
use fieldbeat_core::cycle::bound::stop_bound;
use fieldbeat_core::cycle::starvation;
use fieldbeat_core::rt::host::Throttling;

/// A file with one drive and a fragment in one of its sections: of LinUDP, or of the wire whose name the section begins
/// with; the whole file, or a sample; and [`FOUR`] or [`LIMITS`] with it. Behind `@` stands a period; before `-at` a
/// drive whose fragment is `bind` and address.
fn machine(section: &str, fragment: &str) -> String {
    match section {
        "file" => return fragment.to_owned(),
        "group" => return format!("{FOUR}[[group]]\n{fragment}\n"),
        "soak" => return format!("{FOUR}{fragment}\n"),
        "soak-axis" => return format!("{FOUR}[[soak.axis]]\ndrive = \"x\"\n{fragment}\n"),
        "soak-criteria" => return format!("{FOUR}[soak.criteria]\n{fragment}\n"),
        "soak-limits" => return format!("{LIMITS}[[soak.axis]]\n{fragment}\n"),
        "sample" => return std::fs::read_to_string(format!("../../rt-config/{fragment}.toml")).unwrap(),
        _ => {}
    }
    if let Some((section, period)) = section.split_once('@') {
        let period = format!("[cycle]\nperiod = \"{period}\"");
        return machine(section, fragment).replacen("[cycle]", &period, 1);
    }
    if let Some(section) = section.strip_suffix("-at") {
        let (bind, address) = fragment.split_once(' ').unwrap();
        let text = machine(section, "").replace("\"127.0.0.1\"", &format!("\"{bind}\""));
        return ["127.0.0.11", "127.0.0.21", "127.0.0.31"]
            .iter()
            .fold(text, |text, usual| text.replace(usual, address));
    }
    let (wire, text) = WIRES.iter().find(|(wire, _)| section.starts_with(wire)).unwrap();
    let own = match section[wire.len()..].trim_start_matches('-') {
        "" => "drive",
        own => own,
    };
    ["cycle", "bus", "drive"].iter().fold((*text).to_owned(), |text, name| {
        text.replace(&format!("{{{name}}}"), if *name == own { fragment } else { "" })
    })
}

/// The wires and their files, in which a fragment stands for its section.
const WIRES: [(&str, &str); 6] = [
    (
        "unidrive",
        "[cycle]\n[[bus]]\nprotocol = \"modbus-tcp\"\n{bus}\n\
         [[bus.drive]]\nname = \"u\"\naddress = \"127.0.0.21\"\n{drive}\n",
    ),
    (
        "moons",
        "[cycle]\n[[bus]]\nprotocol = \"ethernet-ip\"\nbind = \"127.0.0.1\"\n{bus}\n\
         [[bus.drive]]\nname = \"m\"\naddress = \"127.0.0.31\"\n{drive}\n",
    ),
    (
        "lenze",
        "[cycle]\nperiod = \"4ms\"\n[[bus]]\nprotocol = \"profibus-dp\"\ndevice = \"/dev/ttyS1\"\n{bus}\n\
         [[bus.drive]]\nname = \"l\"\naddress = 3\n{drive}\n[bus.defaults]\nlimits.velocity = 20\n",
    ),
    (
        "ethercat-device",
        "[cycle]\n\n[[bus]]\nprotocol = \"ethercat\"\ninterface = \"eth1\"\n\n[[bus.drive]]\nname = \"k\"\n\n\
         [[bus.device]]\nname = \"io\"\n{drive}\n",
    ),
    (
        "ethercat",
        "[cycle]\n{cycle}\n[[bus]]\nprotocol = \"ethercat\"\ninterface = \"eth1\"\n{bus}\n\
         [[bus.drive]]\nname = \"k\"\n{drive}\n",
    ),
    (
        "",
        "[cycle]\n{cycle}\n[[bus]]\nprotocol = \"linudp-v2\"\nbind = \"127.0.0.1\"\n{bus}\n\
         [[bus.drive]]\nname = \"x\"\naddress = \"127.0.0.11\"\n{drive}\n",
    ),
];

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

/// The rows of a table: section and fragment (`;;` is a line end, and goes on with the fragment where it begins a
/// line), then what is expected, two columns in, its own indentation behind `|`; what is four columns in goes on where
/// the line before it ends.
fn rows(table: &str) -> Vec<(&str, String, Vec<String>)> {
    let mut rows: Vec<(&str, String, Vec<String>)> = Vec::new();
    for line in table.lines().filter(|line| !line.is_empty()) {
        let (indent, text) = line.split_at(line.len() - line.trim_start().len());
        match (indent.len(), rows.last_mut()) {
            (4, Some((.., lines))) => {
                let last = lines.last_mut().unwrap();
                *last += " ";
                *last += text;
            }
            (2, Some((.., lines))) => lines.push(text.strip_prefix('|').unwrap_or(text).to_owned()),
            (_, Some((_, fragment, _))) if text.starts_with(";; ") => {
                *fragment += &format!(" {text}").replace(" ;; ", "\n");
            }
            _ => {
                let (section, fragment) = line.split_once(" | ").unwrap();
                rows.push((section, fragment.replace(" ;; ", "\n"), Vec::new()));
            }
        }
    }
    rows
}

#[test]
fn every_mistake_says_where_it_is_and_what_would_be_right() {
    let cases = rows(include_str!("mistakes.txt"));
    assert!(cases.len() > 500);
    for (section, fragment, expected) in cases {
        let said = mistakes(&machine(section, &fragment));
        let expected: Vec<String> = expected.iter().map(|line| format!("m.toml:{line}")).collect();
        assert_eq!(said, expected, "in {section}: {fragment}");
    }
}

/// What a file says stands in its plan, or in that of the simulated machine or of the soak test.
#[test]
fn values_arrive_where_they_belong() {
    let cases = rows(include_str!("values.txt"));
    assert!(cases.len() > 30);
    for (section, fragment, expected) in cases {
        let Configuration { plan, simulation, soak, .. } = read_all(&machine(section, &fragment));
        let all = format!("{plan:?} {simulation:?} {soak:?}");
        for part in expected {
            assert!(all.contains(&part), "in {section}: {fragment}\n{part}\n{all}");
        }
    }
}

/// `==` before a section: the whole description; `=`: these lines of it in this order; else parts of it.
#[test]
fn a_plan_is_described_in_words() {
    let cases = rows(include_str!("words.txt"));
    assert!(cases.len() > 25);
    for (section, fragment, expected) in cases {
        let name = section.trim_start_matches('=');
        let said = describe(&read(&machine(name, &fragment)));
        match section.len() - name.len() {
            2 => assert_eq!(said, expected, "{fragment}"),
            1 => {
                let mut said_in_turn = said.iter();
                for line in expected {
                    assert!(said_in_turn.any(|other| *other == line), "{fragment}\n{line}\n{said:#?}");
                }
            }
            _ => {
                let said = said.join("\n");
                expected.iter().for_each(|part| assert!(said.contains(part), "{fragment}\n{part}\n{said}"));
            }
        }
    }
}

/// The samples without their comments, as they were when replies of LinUDP counted in their own cycle only: what each
/// does otherwise now (`+`), and the keys by which a drive does as before (`-`).
#[test]
fn samples_of_an_earlier_version_load_and_the_keys_of_the_changelog_restore_what_they_did() {
    let cases = rows(include_str!("before.txt"));
    for (name, keys, expected) in &cases {
        let text = std::fs::read_to_string(format!("config/before/{name}.toml")).unwrap();
        let restored = text.replace("[[bus.drive]]\n", &format!("[[bus.drive]]\n{keys}\n"));
        let [now, before] = [text, restored].map(|text| describe(&read(&text)));
        let only = |sign: &str, these: &[String], those: &[String]| -> Vec<String> {
            // The next drives have the same lines; and what follows from the rule of a link is not its rule.
            let is_rule = |line: &&String| !line.contains("one miss in ");
            let only = these.iter().filter(|line| !those.contains(line)).filter(is_rule);
            only.map(|line| format!("{sign} {}", line.trim_start()))
                .collect::<BTreeSet<_>>()
                .into_iter()
                .collect()
        };
        let differs = [only("-", &before, &now), only("+", &now, &before)].concat();
        assert_eq!(differs, *expected, "{name}");
    }
    assert_eq!(cases.len(), std::fs::read_dir("config/before").unwrap().count());
}

/// The key of the changelog by which there is no guardian, as before there was one.
#[test]
fn samples_of_an_earlier_version_have_a_guardian_which_one_key_leaves_out() {
    for name in ["linmot", "gantry"] {
        let text = std::fs::read_to_string(format!("config/before/{name}.toml")).unwrap();
        let restored = text.replace("[cycle]\n", "[cycle]\nguardian_after = \"off\"\n");
        let [now, before] = [text, restored].map(|text| describe(&read(&text)));
        let dies = |lines: &[String]| {
            let line = lines.iter().find_map(|line| line.trim_start().strip_prefix("if the master dies: "));
            line.unwrap().to_owned()
        };
        assert!(
            dies(&now).starts_with("stops within ") && now.join("\n").contains("\n  a guardian, a process")
        );
        assert!(dies(&before).starts_with("a LinUDP drive has no watchdog, a move runs to its target"));
        let rest = |lines: &[String]| -> Vec<String> {
            let is_of_it = |line: &&String| line.contains("guardian") || line.contains("if the master dies");
            lines.iter().filter(|line| !is_of_it(line)).cloned().collect()
        };
        assert_eq!(rest(&now), rest(&before), "{name}");
    }
}

#[test]
fn files_that_cannot_be_read_say_so() {
    let error = |path: &Path| load(path).unwrap_err().to_string();
    let remedy = "name an existing configuration, for example rt-config/demo.toml";
    assert_eq!(
        error("no/such.toml".as_ref()),
        format!("cannot read no/such.toml: No such file or directory; {remedy}")
    );
    assert_eq!(error("config".as_ref()), format!("cannot read config: Is a directory; {remedy}"));
    // What `fn main() -> Result<(), Box<dyn Error>>` prints.
    let shown = format!("{:?}", Box::<dyn std::error::Error>::from(load("config").unwrap_err()));
    assert_eq!(shown, error("config".as_ref()));
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
    symlink(std::fs::canonicalize("../../rt-config/demo.toml").unwrap(), path("demo.toml")).unwrap();
    assert!(load(path("demo.toml")).is_ok() && is_demo(path("demo.toml")));
    assert!(!is_demo("../../rt-config/linmot.toml") && !is_demo(path("pipe")));
}

#[test]
fn a_plan_as_json_has_every_key() {
    let plan = load("../../rt-config/demo.toml").unwrap().plan;
    let said = json(&plan, &[]);
    let keys =
        |value: &serde_json::Value| -> Vec<String> { value.as_object().unwrap().keys().cloned().collect() };
    assert_eq!(keys(&said), ["buses", "cycle", "drives", "errors", "groups", "source"]);
    assert_eq!(said["source"], "../../rt-config/demo.toml");
    assert_eq!((&said["cycle"]["period_ns"], &said["errors"]), (&1_000_000.into(), &serde_json::json!([])));
    let drives = said["drives"].as_array().unwrap();
    let axes = plan.axes();
    assert_eq!(drives.len(), axes.len());
    let words = describe(&plan).join("\n");
    for (index, (drive, axis)) in drives.iter().zip(&axes).enumerate() {
        let expected = "address bus divisor drive_watchdog_ns held_by if_master_dies limits load name \
             period_ns phase protocol reply_within_ns stop stop_bound_cycles stop_bound_ns stops_with unit";
        assert_eq!(keys(drive).join(" "), expected);
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
    let all = read_all(&machine("", ""));
    assert_eq!(format!("{all:#?}"), format!("{:#?}", read_all(include_str!("defaults.toml"))));
    let plan = all.plan;
    assert_eq!(plan.cycle, CyclePlan::default());
    assert_eq!(plan.axes()[0].health, Health::default());
}

#[test]
fn a_file_that_says_little_is_a_plan_built_in_code() {
    use fieldbeat::bus::ethernet_ip::{EthernetIpPlan, MoonsDrive};
    use fieldbeat::bus::modbus::UnidriveDrive;
    use fieldbeat_sim::modbus::UnidriveSettings;
    let usual = UnidriveDrive::new("u", [127, 0, 0, 21].into());
    let mut settings = UnidriveSettings::of(&usual);
    let faults = &mut settings.faults;
    (faults.delay_ns, faults.stall_ns, faults.sto_ns) = (MS, 100 * MS, 100 * MS);
    let Configuration { plan, simulation, .. } = read_all(&machine("unidrive", ""));
    assert!(format!("{plan:?}").contains(&format!("{usual:?}")));
    assert!(format!("{simulation:?}").contains(&format!("{settings:?}")));
    let usual = MoonsDrive::new("m", [127, 0, 0, 31].into());
    let bus = EthernetIpPlan::new([127, 0, 0, 1].into(), vec![usual]);
    let plan = read(&machine("moons", ""));
    assert!(format!("{plan:?}").contains(&format!("{bus:?}")), "{plan:?}");
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
        for (axis, (_, drive)) in plan.axes().into_iter().zip(of_drives(&plan.facts())) {
            let every_ns = period_ns * u64::from(axis.divisor);
            assert!(drive.watchdog_ns.is_none_or(|ns| ns > every_ns), "{period_ns}: {}", axis.name);
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
    assert!(error.ends_with("cycle.period = \"10000ns\": must be at least 50 us"), "{error}");
}

#[test]
fn the_samples_tell_the_truth() {
    // What drives of every protocol have is told at length in the first one.
    let common = keys(&machine("drive", "no_such_key = 1"));
    // The sample, how many keys it has at least, and the sections and tables of which no key is left out: the reader's
    // own list of them is in the sample.
    for (name, least, places) in [
        ("linmot", 50, "cycle, bus, drive"),
        ("unidrive", 45, "unidrive, unidrive map, unidrive watchdog"),
        ("moons", 25, "moons, moons-bus, moons homing, moons enable_input"),
        ("lenze", 50, "lenze, lenze-bus, lenze-bus bits., lenze parameters"),
        (
            "kollmorgen",
            60,
            "ethercat, ethercat-bus, ethercat-device, ethercat pdo., ethercat mailbox., ethercat buffers.",
        ),
        ("terminals", 15, ""),
    ] {
        let sample = tells_the_truth(&format!("../../rt-config/{name}.toml"), least);
        for place in places.split(", ").filter(|place| !place.is_empty()) {
            // With its dot the name of the table stands before the key.
            let (section, table) = place.split_once(' ').unwrap_or((place, ""));
            let before = if table.ends_with('.') { table } else { "" };
            let dot = if table.is_empty() || !before.is_empty() { "" } else { "." };
            let all = keys(&machine(section, &format!("{table}{dot}no_such_key = 1")));
            let is_of_all = |key: &String| name != "linmot" && table.is_empty() && common.contains(key);
            for key in all.iter().filter(|key| !is_of_all(key)) {
                assert!(sample.contains(&format!("{before}{key}")), "{name}: {place}: {key}");
            }
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

/// x and y stop together and exchange together; z does neither, v only exchanges with them.
const FOUR: &str = include_str!("four.toml");

/// A LinMot within limits, one without, a Unidrive within and one without.
const LIMITS: &str = include_str!("limits.toml");

/// What only the drive holds stays on unless the file says otherwise, and that would be refused.
#[test]
fn a_load_that_only_the_drive_holds_stays_under_power() {
    assert_eq!(read(FOUR).axes()[1].stop.then, StopThen::Hold);
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

/// A sample with values replaced, so that every reader meets what it does not expect: a plan that can be put into
/// words, or mistakes of one printable line each.
#[test]
fn a_mangled_sample_never_panics() {
    let wild = "|0|-1|1e308|-1e308|5e-324|9223372036854775807|0xffff_ffff|nan|inf|true|[]|[[]]|[0, 1]|{}|\
         [-1e300, 1e300]|{ extrapolate = 1 }|{ velocity = 1e300 }|\"\"|\"x\"|\"1ms\"|\"18446744073s\"|\"off\"|\
         \"0.0.0.0\"|\"127.77.0.1:41136\"|1979-05-27|\"\"\"\n\u{1b}[2J\"\"\"|\"\u{202e}\"";
    let wild: Vec<&str> = wild.split('|').collect();
    let samples = [
        include_str!("../../../rt-config/linmot.toml"),
        include_str!("../../../rt-config/kollmorgen.toml"),
        include_str!("../../../rt-config/lenze.toml"),
    ];
    let mut random = fastrand::Rng::with_seed(1);
    for run in 0..300 {
        let sample = samples[run % 3].replace("\n# stop", "\nstop").replace("\n# sim", "\nsim");
        let mut lines: Vec<String> = sample.lines().map(str::to_owned).collect();
        for _ in 0..random.usize(1..6) {
            let (line, value) = (random.usize(..lines.len()), wild[random.usize(..wild.len())]);
            if let Some((key, _)) = lines[line].clone().split_once('=') {
                lines[line] = format!("{}= {value}", key.trim_start_matches("# "));
            }
        }
        match parse(&lines.join("\n"), "m.toml") {
            Ok(all) => assert!(describe(&all.plan).len() > 3),
            Err(errors) => assert!(!errors.iter().any(|error| error.to_string().contains(char::is_control))),
        }
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
