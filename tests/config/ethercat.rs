//! What only an EtherCAT segment has: places, PDOs, clocks, slaves that are no drives.

use fieldbeat::Plan;
use fieldbeat::axis::{HeldBy, Load, Unit};
use fieldbeat::config::Configuration;
use fieldbeat::time::US;
use fieldbeat_config::describe;
use fieldbeat_ethercat::mode::Mode;

use super::{keys, mistakes, read, read_all, tells_the_truth};

/// One drive with a fragment in one section: `cycle`, `bus`, its own (empty), or a `device`. It begins in line 2, 6, 9
/// or 12.
pub fn line(section: &str, fragment: &str) -> String {
    let part = |name: &str| if name == section { fragment } else { "" };
    let device = match part("device") {
        "" => String::new(),
        fragment => format!("[[bus.device]]\nname = \"io\"\n{fragment}\n"),
    };
    format!(
        "[cycle]\n{}\n[[bus]]\nprotocol = \"ethercat\"\ninterface = \"eth1\"\n{}\n\
         [[bus.drive]]\nname = \"k\"\n{}\n{device}",
        part("cycle"),
        part("bus"),
        part(""),
    )
}

#[test]
fn the_kollmorgen_sample_tells_the_truth() {
    let sample = tells_the_truth("rt-config/kollmorgen.toml", 60);
    assert_eq!(places(&read(&sample)), ["0 infeed", "1 press", "2 terminals"]);
    let common = keys(&super::machine("drive", "no_such_key = 1"));
    let of_its_own = |key: &String| !common.contains(key);
    for section in ["bus", "", "device"] {
        for key in keys(&line(section, "no_such_key = 1")).iter().filter(|key| of_its_own(key)) {
            assert!(sample.contains(key.as_str()), "{key}");
        }
    }
    for table in ["pdo", "mailbox", "buffers"] {
        for key in keys(&line("", &format!("{table}.no_such_key = 1"))) {
            assert!(sample.contains(&format!("{table}.{key}")), "{table}.{key}");
        }
    }
}

#[test]
fn the_sample_of_terminals_tells_the_truth() {
    let plan = read(&tells_the_truth("rt-config/terminals.toml", 15));
    assert_eq!(places(&plan), ["0 coupler", "1 switches", "2 valves", "3 pressure"]);
    let reported = describe(&plan);
    assert_eq!(reported[0], "m.toml: 4 devices, 1 bus");
    for line in [
        "bus ethercat: ethercat, 4 devices",
        "  device coupler: eth1, place 0; vendor 0x2, product 0x44C2C52, any revision; 0 bytes out, 0 in",
        "  device switches: eth1, place 1; vendor 0x2, product 0x3F03052, any revision; 0 bytes out, 1 in (0x1000)",
        "  device valves: eth1, place 2; vendor 0x2, product 0x7D83052, any revision; 1 byte out (0x0F00), 0 in; its \
         watchdog is as its SII has it (of most digital terminals 100 ms)",
        "  device pressure: eth1, place 3; vendor 0x2, product 0xC1E3052, any revision; 0 bytes out, 8 in (0x1180)",
    ] {
        assert!(reported.iter().any(|other| other == line), "{line}\n{reported:#?}");
    }
    // A drive need not be there; something does.
    let empty = "[[bus]]\nprotocol = \"ethercat\"\ninterface = \"eth1\"\n";
    assert_eq!(mistakes(empty), ["m.toml:1: bus.drive: missing; a bus needs at least one [[bus.drive]]"]);
}

/// Slaves by place: their names.
fn places(plan: &Plan) -> Vec<String> {
    let reported = describe(plan);
    let of = |line: &String| {
        let (name, rest) = line
            .trim_start()
            .strip_prefix("drive ")
            .or(line.trim_start().strip_prefix("device "))?
            .split_once(": ")?;
        let place = rest.split_once("place ")?.1.chars().take_while(char::is_ascii_digit).collect::<String>();
        Some(format!("{place} {name}"))
    };
    let mut places: Vec<String> = reported.iter().filter_map(of).collect();
    places.sort();
    places
}

#[test]
fn slaves_stand_in_the_order_of_the_file_unless_they_say_where() {
    let text = r#"
[[bus]]
protocol = "ethercat"
interface = "local:line"
[[bus.drive]]
name = "a"
[[bus.device]]
name = "io"
[[bus.drive]]
name = "b"
[[bus.device]]
name = "far"
position = 7
[[bus.drive]]
name = "c"
"#;
    let plan = read(text);
    assert_eq!(places(&plan), ["0 a", "1 io", "2 b", "7 far", "8 c"]);
    let reported = describe(&plan);
    let gap = "  places 3 ... 6: not listed: a slave there forwards the frames and is not configured";
    assert!(reported.iter().any(|line| line == gap), "{reported:#?}");
    assert_eq!(plan.buses[0].devices(), ["io", "far"]);
    assert_eq!(
        mistakes(&text.replace("position = 7", "position = 1")),
        [
            "m.toml:13: bus.device.position = 1: 1 is already the place of io; each slave has its own, \
             counted from 0 at the master",
            "m.toml:14: bus.drive.position: 2 is already the place of b; each slave has its own, counted from \
             0 at the master",
        ]
    );
}

#[test]
fn names_and_interfaces_are_unique_in_the_machine() {
    let text = r#"
[[bus]]
protocol = "ethercat"
interface = "eth1"
[[bus.drive]]
name = "a"
[[bus.device]]
name = "a"
[[bus]]
protocol = "ethercat"
name = "second"
interface = "eth1"
[[bus.device]]
name = "io"
[[bus.drive]]
name = "io"
[[bus.drive]]
position = 0
name = "b"
"#;
    assert_eq!(
        mistakes(text),
        [
            "m.toml:8: bus.device.name = \"a\": is already the drive of line 6; names are unique in the machine",
            "m.toml:12: bus.interface = \"eth1\": is already that of the bus of line 4; there is one bus \
             per interface, add the drives to that bus",
            "m.toml:13: bus.device.position: 0 is already the place of b; each slave has its own, counted \
             from 0 at the master",
            "m.toml:14: bus.device.name = \"io\": is already the drive of line 16; names are unique in the machine",
        ]
    );
    // No slaves of its own: nothing else is reported.
    assert_eq!(
        mistakes("[[bus]]\nprotocol = \"ethercat\"")[..],
        [
            "m.toml:1: bus.interface: missing; the network interface of the segment, like \"eth1\", or \
             \"local:NAME\" for simulated slaves on this computer",
            "m.toml:1: bus.drive: missing; a bus needs at least one [[bus.drive]]",
        ]
    );
}

#[test]
fn only_a_bus_with_a_clock_can_lead_the_grid() {
    let leading = |reference: &str, drive: &str| {
        let text = line("", drive).replace("[cycle]\n", &format!("[cycle]\nreference = \"{reference}\"\n"));
        text + "[[bus]]\nprotocol = \"modbus-tcp\"\n[[bus.drive]]\nname = \"u\"\naddress = \"127.0.0.21\"\n"
    };
    let plan = read(&leading("ethercat", ""));
    assert_eq!(plan.cycle.reference.as_deref(), Some("ethercat"));
    let says = |plan: &Plan, what: &str| describe(plan).iter().any(|line| line == what);
    assert!(says(&plan, "  its clock leads: the grid follows it ([cycle] reference)"));
    assert!(says(&read(&line("", "")), "  its clock follows the grid ([cycle] reference would let it lead)"));
    for (reference, drive, message) in [
        ("ethercta", "", "is not a bus of this machine; use \"ethercat\""),
        ("modbus-tcp", "", "is a bus without a clock (modbus-tcp); use \"ethercat\""),
        (
            "ethercat",
            "sync = false",
            "is a bus without a clock (ethercat); no bus here has a clock, leave it out",
        ),
    ] {
        let expected = format!("m.toml:2: cycle.reference = \"{reference}\": {message}");
        assert_eq!(mistakes(&leading(reference, drive)), [expected]);
    }
}

#[test]
fn a_line_takes_its_values_from_the_file() {
    let text = r#"
[cycle]
period = "500us"
[[bus]]
protocol = "ethercat"
interface = "local:line"
sync_ahead = "100us"
lrw = false
simulate = { drift_ppm = [0, -20.5], line_delay = "1us", short_clocks = true, settling = 1024, drop = 0.25 }
[bus.defaults]
prbase = 16
check_prbase = false
[[bus.drive]]
name = "k"
units = "mm"
scale = 0.5
offset = 3
vendor = "0x6A"
product = "any"
revision = 0x10
pdo = { outputs = { pdo = "0x1704", objects = ["0x607A:0.i32", "0x6040:0.u16"] }, inputs = "0x1B03" }
mode = 0x85
watchdog = "off"
no_drive_watchdog = "accept"
mailbox.out = [0x1400, 128]
buffers.inputs = 0x1180
sync = false
check_sii = false
start_up = [{ object = "0x35D5:1", value = 2 }, { object = "0x3612:0.i16", value = "-1" }]
monitor = ["torque", "0x6061:0"]
home_method = -1
rated_current = 4.5
simulate = { start = 13, home = "none", dialect = "manual", max_speed = 3000 }
[[bus.drive]]
name = "free"
pdo = { outputs = ["0x6071:0", "0x6040"], inputs = ["status-word", "0x2F00:3.u32"] }
load = "vertical"
held_by = "brake"
"#;
    let Configuration { plan, simulation, .. } = read_all(text);
    let axes = plan.axes();
    assert_eq!((axes[0].units.unit, axes[0].units.counts_per_unit), (Unit::Millimetre, 32_768.0));
    assert_eq!((axes[1].units.unit, axes[1].units.counts_per_unit), (Unit::Revolution, 65_536.0));
    assert_eq!(axes[1].load, Load::Vertical(HeldBy::Brake));
    let all = format!("{:?}{:?}", plan.buses[0], simulation.buses[0]);
    for part in [
        "lrw: false, ahead_of_sync_ns: Some(100000)",
        "sync: false, check_sii: false",
        "check_prbase: false",
        "prbase: 16, resolution_turns: 1",
        "drift_ppm: [0.0, -20.5], delay_ns: 1000, short_clocks: true",
        "drop: 0.25",
        "Expected { vendor: Some(106), product: None, revision: Some(16) }",
        "mailbox: Some([Area { start: 5120, length: 128 }, Area { start: 7168, length: 16 }])",
        "outputs: [Area { start: 4352, length: 6 }], inputs: [Area { start: 4480, length: 8 }], watchdog: Off, \
         sync: false",
        "Start { object: Object { index: 13781, sub: 1 }, kind: I32, raw: 2, string: [] }",
        "Start { object: Object { index: 13842, sub: 0 }, kind: I16, raw: 65535, string: [] }",
        &format!("mode: Some({:?})", Mode::TRAJECTORY),
        "rated_current: Some(4.5)",
        "accept_no_watchdog: true",
        "home_method: Some(-1)",
        "position: 327680",
        "home_turns: None",
        "dialect: Manual",
        "max_rpm: 3000.0",
        "Layout { pdo: 5632, entries: [Entry { object: Object { index: 24689, sub: 0 }, kind: I16 }",
        "mapping: Free",
    ] {
        assert!(all.contains(part), "{part}\n{all}");
    }
}

#[test]
fn what_is_not_looked_at_is_said() {
    let reported = |section, fragment: &str| describe(&read(&line(section, fragment))).join("\n");
    for (section, fragment, words) in [
        (
            "bus",
            "lrw = false",
            "outputs and inputs in separate datagrams (lrw = false), whatever the divisors: 122 bytes",
        ),
        (
            "",
            "check_prbase = false",
            "\n    its increments per turn (608Fh) are not compared with prbase (check_prbase = false)\n",
        ),
        (
            "",
            "check_sii = false",
            "any revision, its SII is not compared with the configuration (check_sii = false)\n",
        ),
        (
            "device",
            "check_sii = false",
            "any revision, its SII is not compared with the configuration (check_sii = false); 0 bytes",
        ),
    ] {
        assert!(reported(section, fragment).contains(words), "{words}\n{}", reported(section, fragment));
        assert!(!reported(section, "").contains(words));
    }
    // What ends the motion, or the outputs, if the master dies.
    let velocities = "so velocities and torques are refused (no_drive_watchdog = \"refuse\")";
    let keeps = "it keeps its last setpoint (no_drive_watchdog = \"accept\")";
    let (accept, holds) = ("no_drive_watchdog = \"accept\"", "holds its last position setpoint under power");
    let sii = "its watchdog is as its SII has it (of an AKD none), ";
    let outputs = "outputs = { start = 0x0F00, length = 1 }\n";
    for (section, fragment, words) in [
        ("", "".to_owned(), format!("{sii}{velocities}")),
        ("", accept.to_owned(), format!("{sii}without one {keeps}")),
        ("", "pdo.outputs = \"0x1701\"".into(), format!("{sii}without one it {holds}")),
        ("", "check_sii = false".into(), format!("its watchdog is off, {velocities}")),
        ("", "watchdog = \"off\"".into(), format!("its watchdog is off, {velocities}")),
        ("", format!("watchdog = \"off\"\n{accept}"), format!("its watchdog is off, so {keeps}")),
        ("", "watchdog = \"100ms\"".into(), "the drive stops by itself within 100 ms without a frame".into()),
        (
            "device",
            outputs.into(),
            "its watchdog is as its SII has it (of most digital terminals 100 ms)".into(),
        ),
        ("device", format!("{outputs}watchdog = \"50ms\""), "its outputs go off within 50 ms".into()),
        ("device", format!("{outputs}watchdog = \"off\""), "only the device itself ends its outputs".into()),
    ] {
        assert!(reported(section, &fragment).contains(&words), "{words}\n{}", reported(section, &fragment));
    }
    // A text of an AKD goes in segments.
    let long = "type = \"akd\"\nstart_up = [{ object = \"0x2F00:1.text\", value = \"abcdefgh\" }]";
    read(&line("", long));
}

#[test]
fn a_line_in_words() {
    let text = r#"
[[bus]]
protocol = "ethercat"
name = "portal"
interface = "eth1"
[bus.defaults]
watchdog = "20ms"
[[bus.drive]]
name = "x"
[[bus.drive]]
name = "y"
[[bus.device]]
name = "io"
outputs = [{ start = 0x0F00, length = 1 }, { start = 0x0F01, length = 1 }]
inputs = { start = 0x1100, length = 2 }
[[bus.drive]]
name = "z"
position = 4
type = "akd"
product = "any"
pdo = { outputs = "0x1724", inputs = "0x1B24" }
monitor = ["torque"]
watchdog = "off"
load = "vertical"
held_by = "brake"
"#;
    let reported = describe(&read(text));
    let of_bus: Vec<&str> = reported
        .iter()
        .map(String::as_str)
        .skip_while(|line| !line.starts_with("bus portal"))
        .take_while(|line| !line.starts_with("one master each"))
        .filter(|line| {
            !["an exch", "link up", "stop: ", "stopped", "limits:", "a move is", "its following"]
                .iter()
                .any(|all| line.trim().starts_with(all))
        })
        .collect();
    assert_eq!(of_bus.join("\n"), DESCRIPTION.trim().replace("\n        ", " "));
}

/// What is eight columns in goes on where the line before it ends.
const DESCRIPTION: &str = r#"
bus portal: ethercat, 3 drives
  drive x: eth1, place 0
    S300 ... S700, vendor 0x6A, product 0x3000600, any revision
    writes 1702h = 0x606B:0 velocity-setpoint, 0x6040:0 control-word (6 bytes); reads 1B03h = 0x6064:0 position,
        0x6077:0 torque, 0x6041:0 status-word (8 bytes); selected by 1C12h and 1C13h
    mode 0x80 (digital velocity): velocities by 0x606B:0, 0.228882 rpm a count
    takes velocities, jogs and homing; no moves, no streams
    its cycle is SYNC0 every 1 ms, 500 us after the frame; its window is 320 us: the second interrupt in a row outside
        it is fault F28
    if the master dies: the drive stops by itself within 20 ms without a frame (SyncManager watchdog) and switches its
        power off
  drive y: eth1, place 1; else as x
  drive z: eth1, place 4
    AKD, vendor 0x6A, any product, any revision
    writes 1724h = 0x607A:0 target-position, 0x6040:0 control-word, 0x60B2:0 torque-feed-forward (8 bytes); reads 1B24h
        = 0x6064:0 position, 0x6041:0 status-word (6 bytes); selected by 1C12h and 1C13h
    its outputs also carry 0x60B2:0 torque-feed-forward = 0
    mode 0x08 (cyclic synchronous position): positions by 0x607A:0, 1048576 increments per turn
    takes moves, streams, jogs, velocities and homing
    its cycle is SYNC0 every 1 ms, 500 us after the frame; its window is 320 us: the second interrupt in a row outside
        it is fault F28
    shows 0x6077:0 torque, read through its mailbox in turn
    if the master dies: its watchdog is off, so it holds its last position setpoint under power; without power only the
        brake holds the load
    vertical load: power goes off at standstill, or by the time-out; set the drive to close its brake before its power
        stage goes off
  device io: eth1, place 2; any vendor, any product, any revision; 2 bytes out (1 at 0x0F00, 1 at 0x0F01), 2 in
        (0x1100); its watchdog is as its SII has it (of most digital terminals 100 ms)
  place 3: not listed: a slave there forwards the frames and is not configured
  one frame every 1 ms carries the process data of 4 slaves, whatever the divisors: 148 bytes, 13.76 us on the wire at
        100 Mbit/s plus about 1 us per slave; with acyclic access up to 428 bytes and 36.16 us
  the clock of x (place 0) is the clock of the segment; SYNC0 comes 500 us after the frame
  its clock follows the grid ([cycle] reference would let it lead)
"#;

/// Each in a file of its own: the cycle does not suit an S700, or any frame.
#[test]
fn a_period_has_to_suit_the_drives() {
    let reported = |period: &str, drive: &str| {
        let text = line("", drive).replace("[cycle]", &format!("[cycle]\nperiod = \"{period}\""));
        fieldbeat::config::parse(&text, "m.toml").err().map(|errors| errors.to_string())
    };
    for period in ["250us", "750us", "1ms", "2ms", "10ms"] {
        assert_eq!(reported(period, ""), None, "{period}");
    }
    let s700 = "drive k needs a period that is a whole multiple of 250 us, up to 31.75 ms";
    for period in ["100us", "300us", "1.1ms", "32ms"] {
        assert_eq!(reported(period, "").unwrap(), format!("m.toml:2: cycle.period = \"{period}\": {s700}"));
    }
    let odd = reported("3.25ms", "").unwrap();
    assert!(
        odd.contains("drive k takes as its cycle 1 ... 255 times a power of ten (object 60C2h)"),
        "{odd}"
    );
    let akd = "type = \"akd\"\nsync = false";
    assert_eq!((reported("3.25ms", akd), reported("100us", akd)), (None, None));
}

#[test]
fn a_following_error_is_that_of_positions() {
    let reported = |drive: &str| {
        fieldbeat::config::parse(&line("", drive), "m.toml").err().map(|errors| errors.to_string())
    };
    let key = "limits.following_error = 1.5";
    assert_eq!(reported(&format!("pdo.outputs = \"0x1701\"\n{key}")), None);
    let refused = reported(key).unwrap();
    assert!(
        refused.starts_with("m.toml:9: ") && refused.contains("limits.following_error = 1.5"),
        "{refused}"
    );
    assert!(refused.contains("gets none from the master; leave it out"), "{refused}");
    // Not watched is no limit.
    assert_eq!(reported("limits.following_error = \"off\""), None);
}

#[test]
fn more_slaves_than_a_frame_has_room_for_go_by_more_frames() {
    let device =
        |n| format!("[[bus.device]]\nname = \"d{n}\"\ninputs = {{ start = 0x1000, length = 250 }}\n");
    let reported = |count: usize| {
        let text = line("", "") + &(0..count).map(device).collect::<String>();
        describe(&read(&text)).join("\n")
    };
    assert!(
        reported(4).contains("one frame every 1 ms carries the process data of 5 slaves"),
        "{}",
        reported(4)
    );
    assert!(
        reported(6).contains("2 frames every 1 ms carry the process data of 7 slaves"),
        "{}",
        reported(6)
    );
}

#[test]
fn a_line_built_in_code_is_checked_by_the_same_rules() {
    use fieldbeat::bus::BusPlan;
    use fieldbeat::bus::ethercat::{Device, EthercatPlan, Family, KollmorgenDrive, SlavePlan, Watchdog};
    let drive = |place| KollmorgenDrive::new(format!("k{place}"), place, Family::S700);
    let mut plan = EthercatPlan::new("local:line", vec![drive(0), drive(1)]);
    assert_eq!(BusPlan::faults(&plan, 1_000 * US), []);
    plan.drives[1].slave.watchdog = Watchdog::After(50 * US);
    let device = |name: &str| Device {
        name: name.into(),
        slave: SlavePlan { watchdog: Watchdog::After(100 * US), ..SlavePlan::new(1) },
    };
    plan.devices = vec![device("k0"), device("a b")];
    plan.drives[0].axis.phase = 1;
    let reported: Vec<String> = BusPlan::faults(&plan, 300 * US)
        .into_iter()
        .map(|(index, fault)| format!("{index} {}: {}", fault.key, fault.message))
        .collect();
    for begin in [
        "0 phase: must be below divisor = 1",
        "0 device: k0: its name is taken",
        "0 device: \"a b\": its name must be",
        "0 period: drive k0 needs a period that is a whole multiple of 250 us",
        "1 watchdog: must be a whole multiple of 100 us",
        "0 device: k0: position: 1 is already the place of k1",
        "0 device: k0: watchdog: trips after 100 us without outputs",
    ] {
        assert!(reported.iter().any(|line| line.starts_with(begin)), "{begin}\n{reported:#?}");
    }
}
