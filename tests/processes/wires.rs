//! Drives of each other protocol than LinMots' as a user meets them: against simulated ones in a process of their own.

use std::path::{Path, PathBuf};

use libc::SIGTERM;
use serde_json::{Value, json};

use super::support::{LONG, Machine, assert_sums, drive, run, until};
use super::{ask, assert_left, await_status, end_once_online, master, metrics, patient_cycle, simulation};

/// A question of the shell, `fieldbeat param WHAT CONFIG REST`: its exit code, and what is said.
type Question = (&'static str, &'static str, i32, &'static [&'static str]);

#[track_caller]
fn ask_all(config: &Path, questions: &[Question]) {
    for &(what, rest, code, parts) in questions {
        let ended = ask(&format!("param {what}"), config, rest);
        match code {
            0 => {
                let out = &ended.expect(0).out;
                assert!(parts.iter().all(|part| out.contains(part)), "{what} {rest}: no {parts:?}: {out}");
            }
            1 => ended.failed(parts),
            _ => ended.refused(parts),
        }
    }
}

/// The life of a machine: its master is there first and says what is missing, its drives come, get requests through it,
/// are killed, and come back. Then they get requests of masters of the shell's own, each of which leaves them as they
/// were. Returns the summary of the run.
#[track_caller]
fn lives(config: &Path, missing: &str, protocols: &[(&str, &str)], questions: &[Question]) -> Value {
    let mut master = master(config, &["--json"]);
    master.await_text(missing);
    let sim = simulation(config);
    master.await_text("all drives online");
    ask_all(config, questions);
    sim.kill();
    let mut await_all = |what: &str| {
        protocols.iter().for_each(|(name, _)| master.await_text(&format!("drive {name}: {what}")));
    };
    await_all("lost");
    let _sim = simulation(config);
    await_all("back online");
    master.signal(SIGTERM);
    let summary = master.end().expect(1).json();
    assert_sums(&summary);
    for (name, protocol) in protocols {
        let drive = drive(&summary, name);
        assert_eq!(
            (&drive["protocol"], &drive["stopped"]),
            (&json!(protocol), &json!("link lost")),
            "{drive}"
        );
        assert!(drive["losses"].as_u64() >= Some(1) && drive["fault"].is_null(), "{drive}");
    }
    ask_all(config, questions);
    summary
}

/// One LinMot and two Unidrives of one address.
fn unidrives(machine: &Machine) -> PathBuf {
    let (bind, linmot, unidrive) = (machine.ip(1), machine.ip(10), machine.ip(20));
    let soon = Machine::LOST_SOON;
    machine.write(
        "mixed.toml",
        format!(
            "{}[[bus]]\nprotocol = \"linudp-v2\"\nbind = \"{bind}\"\n\
             [[bus.drive]]\nname = \"x\"\naddress = \"{linmot}\"\n{soon}\n\
             [[bus]]\nprotocol = \"modbus-tcp\"\n\
             [bus.defaults]\ndivisor = 4\n{soon}\nwatchdog.timeout = \"10s\"\n\
             [[bus.drive]]\nname = \"u\"\naddress = \"{unidrive}:1502\"\nphase = 1\n\
             [[bus.drive]]\nname = \"v\"\naddress = \"{unidrive}:1503\"\nphase = 3\n\
             via = \"menu-0\"\nsimulate = {{ split = 1 }}\n",
            patient_cycle()
        ),
    )
}

#[test]
fn unidrives_next_to_a_linmot_come_answer_requests_are_lost_and_come_back() {
    let machine = Machine::new(113);
    let config = unidrives(&machine);
    let missing = format!("drive u: not connected: refused: nobody listens at {}:1502", machine.ip(20));
    let summary = lives(
        &config,
        &missing,
        &[("x", "linudp-v2"), ("u", "modbus-tcp"), ("v", "modbus-tcp")],
        &[
            ("set", "u 01.022 100.5rpm", 0, &["u 01.022: 100.5 rpm (raw 1005, 0x3ED)\n"]),
            ("set", "v 01.022 100.5", 0, &["v 01.022: 100.5 rpm (raw 1005, 0x3ED)\n"]),
            ("get", "v preset-reference-2 --json", 0, &["\"raw\":1005", "\"value\":1005"]),
            (
                "set",
                "u 20.021 12345 -5 0x10",
                0,
                &["u 20.021: 12345 (0x3039)\nu 20.022: -5 (0xFFFFFFFB)\nu 20.023: 16 (0x10)\n"],
            ),
            ("set", "v 20.021 12345 12345 12345 --json", 0, &["[{\"address\":\"20.021\"", "\"raw\":12345"]),
            ("get", "v 20.021 --count 3", 0, &["v 20.021: 12345 (0x3039)\nv 20.022: 12345 ", "v 20.023: "]),
            ("get", "u 20.021.word --count 2", 0, &["u 20.021.word: 12345 ", "u 20.022.word: -5 (0xFFFB)\n"]),
            (
                "set",
                "v 01.022 1.5 60000.0 2.5",
                1,
                &["write 01.023 = 60000.0 rpm ", "; those before it were written"],
            ),
            ("get", "v 01.022 --count 3", 0, &["v 01.022: 1.5 rpm (raw 15, 0xF)\nv 01.023: 0.0 rpm "]),
            (
                "set",
                "u 01.022 1.5 fast",
                2,
                &["drive u: write 01.023: fast is not a value of this parameter"],
            ),
            ("get", "u 20.021 --count 61", 2, &["write 1 to 60 parameters of 32 bits at once"]),
            ("get", "u 20.039 --count 4", 1, &["read 20.039 ... 20.042: exception 02h"]),
            ("set", "x 0x14BE 1 2", 2, &["drive x: write 0x14BE: this drive reads and writes one parameter"]),
            ("list", "u 06", 0, &["06.042  16 read write  ", "control-word\n"]),
            ("list", "v 4.15 --json", 0, &["4.15.005", "4.15.009", "4.15.013"]),
            ("set", "u 03.002 5", 1, &["the drive did not take it and gave no error code"]),
            ("get", "u 18.011", 1, &["exception 02h no such parameter"]),
            ("list", "u 99", 1, &["menu 99 has no parameters"]),
            ("get", "u 6.42", 2, &["not an address of this drive; write 06.042"]),
            ("list", "u", 2, &["drive u lists by menu; name one, like 06"]),
            ("list", "u 06.042", 2, &["06.042: not a menu"]),
            ("list", "u 06 --values", 2, &["leave --modified, --values and --from out"]),
            ("list", "x 06", 2, &["drive x has no menus; leave 06 out"]),
        ],
    );
    let count = |name: &str, key: &str| drive(&summary, name)[key].as_u64().unwrap();
    for name in ["u", "v"] {
        // In one cycle, each with its divisor.
        assert!(count(name, "sent") * 2 < count("x", "sent"), "{summary}");
        let reopened = &drive(&summary, name)["protocol_counters"]["reopened"];
        assert!(reopened.as_u64() >= Some(1), "{summary}");
    }
}

/// The name of a segment that no other test has.
pub fn line(machine: &Machine) -> String {
    format!("local:processes-{}-{}", std::process::id(), machine.ip(0).octets()[2])
}

/// A segment of a drive for velocities and one for positions.
pub fn kollmorgens(interface: &str) -> String {
    format!(
        "{}reference = \"ethercat\"\n\
         [[bus]]\nprotocol = \"ethercat\"\ninterface = \"{interface}\"\nsimulate = {{ drift_ppm = [30] }}\n\
         [bus.defaults]\n{}\nwatchdog = \"6s\"\n\
         [[bus.drive]]\nname = \"turns\"\n\
         [[bus.drive]]\nname = \"moves\"\npdo.outputs = \"0x1701\"\n",
        patient_cycle(),
        Machine::LOST_SOON
    )
}

#[test]
fn a_segment_of_kollmorgens_comes_up_answers_requests_is_lost_and_comes_back() {
    let machine = Machine::new(170);
    let line = line(&machine);
    let summary = lives(
        &machine.write("line.toml", kollmorgens(&line)),
        &format!("drive turns: not connected: nothing serves {line}: start it: fieldbeat sim CONFIG"),
        &[("turns", "ethercat"), ("moves", "ethercat")],
        &[
            ("get", "turns 0x6041:0", 0, &["turns 0x6041:0: "]),
            ("get", "turns device-name", 0, &["turns device-name: S700\n"]),
            ("set", "moves 0x6081:0 1000", 0, &[]),
            ("get", "moves profile-velocity --json", 0, &["\"raw\":1000"]),
            ("list", "turns", 0, &["0x6041:0", "status-word"]),
            ("get", "turns 0x7777:0.u16", 1, &["turns: read 0x7777:0", "0x06020000 no such object"]),
            ("get", "turns banana", 2, &["read banana: not an address of this drive; write 0x6041:0"]),
            ("set", "turns 0x6041:0 3", 2, &["cannot be written"]),
            ("get", "nobody 0x6041:0", 2, &["has no drive nobody; it has turns, moves"]),
        ],
    );
    for name in ["turns", "moves"] {
        let brought_up = &drive(&summary, name)["protocol_counters"]["brought_up"];
        assert!(brought_up.as_u64() >= Some(2), "{summary}");
    }
    // The grid has followed its clock.
    let reference = &summary["cycle"]["reference"];
    assert_eq!(reference["bus"], "ethercat");
    assert!(reference["samples"].as_u64() > Some(0), "{reference}");
}

/// A drive and a terminal are others than the configuration says, and the SII of another terminal arms no watchdog.
#[test]
fn a_faulty_slave_is_named_once_and_a_device_is_accessed_through_its_master_only() {
    let machine = Machine::new(174);
    let io =
        |name| format!("[[bus.device]]\nname = \"{name}\"\noutputs = {{ start = 0x1000, length = 1 }}\n");
    let lamp = io("lamp") + "simulate.output_control = 0x24\n";
    let good = kollmorgens(&line(&machine)) + &lamp + &io("io");
    let wrong = good.replace("name = \"moves\"", "name = \"moves\"\nproduct = 0x3000700");
    let _sim = simulation(&machine.write("good.toml", good));
    let config = machine.write("line.toml", wrong + "product = 0x99\n");

    let mut master = master(&config, &["--json", "--metrics", &format!("{}:0", machine.ip(1))]);
    let address = metrics::endpoint(&mut master);
    let why =
        "place 1: its product is 0x03000600, not 0x03000700: correct product, or the order of the segment";
    let moves = format!("drive moves: not connected: {why}");
    let named = [
        moves.as_str(),
        "device io: not in operation: place 3: its product is 0x",
        "device lamp: place 2: its SII arms no watchdog",
    ];
    named.iter().for_each(|line| master.await_text(line));
    await_status(&config, |summary| drive(summary, "turns")["link"] == "online");
    // The counters of a device are those of a drive.
    let of = |what: &str| {
        let sample = format!("fieldbeat_device_protocol_events_total{{device=\"lamp\",what=\"{what}\"}}");
        metrics::Page::parse(&metrics::scrape(address)).value(&sample)
    };
    assert!(until(LONG, || of("brought_up") >= 1.0));
    assert_eq!(of("mailbox_silent"), 0.0);
    let beside = ask("param get", &config, "io 0x1018:1");
    assert!(beside.expect(1).err.contains("read 0x1018:1: the slave has no mailbox"), "{}", beside.err);
    let ended = master.end_by(SIGTERM);
    for line in named {
        assert_eq!(ended.err.matches(line).count(), 1, "{line}: {}", ended.err);
    }
    let summary = ended.json();
    // It is tried again, and that it was refused stays its reason.
    assert_eq!(drive(&summary, "moves")["not_connected"], why);
    assert!(drive(&summary, "turns")["not_connected"].is_null(), "its neighbour is there");
    let [lamp, io] = [0, 1].map(|index| &summary["devices"][index]);
    assert!(lamp["protocol_counters"]["brought_up"].as_u64() >= Some(1), "{lamp}");
    assert!(io["name"] == "io" && io["not_operational"].as_str().unwrap().starts_with("place 3: "), "{io}");

    let alone = ask("param get", &config, "io 0x1018:1");
    let why = "io is not a drive: only a running master can access it";
    assert!(alone.expect(1).err.contains(why), "{}", alone.err);
    ask("param get", &config, "moves 0x6041:0").failed(&["drive moves cannot be reached: place 1: "]);
}

/// Two drives: a revolution is 100 mm.
pub fn moons(machine: &Machine) -> PathBuf {
    let [bind, feeder, turret] = [1, 40, 41].map(|host| machine.ip(host));
    machine.write(
        "moons.toml",
        format!(
            "{}[[bus]]\nprotocol = \"ethernet-ip\"\nbind = \"{bind}\"\n[bus.defaults]\nunits = \"mm\"\nscale \
             = 0.01\ndivisor = 4\nfresh_within = \"400ms\"\nfirst_within = \"20s\"\n{}\neffect_within = \
             \"5s\"\nlimits = {{ position = [-100, 2000], velocity = 500, acceleration = 5000 \
             }}\nstop.deceleration = 500\njog_deadman = \"off\"\nsetpoint_age = 4000\nhoming = {{ method = \
             \"seek\", input = \"2L\", velocity = 100, acceleration = 1000, distance = -50 \
             }}\n[[bus.drive]]\nname = \"feeder\"\naddress = \"{feeder}\"\nsimulate = {{ zs = \"5s\" \
             }}\n[[bus.drive]]\nname = \"turret\"\naddress = \"{turret}\"\nencoder = true\nphase = \
             2\nexplicit = \"connected\"\nsimulate = {{ model = \"SSDC\", zs = \"5s\" }}\n",
            patient_cycle(),
            Machine::LOST_SOON
        ),
    )
}

/// The same two; the first turns when the master comes, and takes no stop.
pub fn faulty(machine: &Machine, file: &str) -> PathBuf {
    let text = std::fs::read_to_string(moons(machine)).unwrap();
    let text = text.replace("stop.deceleration = 500", "stop = { deceleration = 5000, timeout = \"500ms\" }");
    let faulty = "simulate = { zs = \"5s\", running = 20.0, ignores_stops = true }";
    machine.write(file, text.replacen("simulate = { zs = \"5s\" }", faulty, 1))
}

#[test]
fn moons_drives_come_answer_requests_are_lost_and_come_back() {
    let machine = Machine::new(165);
    lives(
        &moons(&machine),
        &format!("drive turret: not connected: refused: nobody listens at {}:44818", machine.ip(41)),
        &[("feeder", "ethernet-ip"), ("turret", "ethernet-ip")],
        &[
            ("set", "feeder AC 100", 0, &["feeder AC: 100 rev/s² (raw 600, 0x258)\n"]),
            ("set", "feeder AC 600 --raw", 0, &["feeder AC: 100 rev/s² (raw 600, 0x258)\n"]),
            ("get", "feeder AC --json", 0, &["\"value\":600"]),
            ("set", "turret R:3 -600", 0, &[]),
            ("get", "turret R:3 --json", 0, &["\"value\":-600"]),
            ("get", "turret 0x01/1/7.text", 0, &["10-IP"]),
            ("list", "feeder", 0, &["AC "]),
            ("get", "feeder 0x77/1/1.u16", 1, &["feeder", "0x77/1/1"]),
            ("set", "turret SC 5", 2, &["turret", "the drive only reports this"]),
            ("get", "turret XY", 2, &["turret", "not an address of this drive"]),
        ],
    );
}

#[test]
fn a_drive_that_ignores_its_stops_is_named_with_what_was_tried_and_the_run_has_failed_although_it_was_ended()
{
    let machine = Machine::new(160);
    let config = faulty(&machine, "faulty.toml");
    let _sim = simulation(&config);
    let report = machine.path("report");
    let ended = end_once_online(master(&config, &["--json", "--report", report.to_str().unwrap()]));
    assert_left(
        &ended,
        &[
            "drive feeder still moves at the end (OperationEnabled at ",
            "ramp, quick stop and power off were requested and had no effect",
            "hardware enable (STO)",
        ],
    );
    let summary = ended.json();
    let left = |name| drive(&summary, name)["at_end"].clone();
    let all = json!(["ramp", "quick stop", "power off"]);
    assert_eq!(left("feeder"), json!({ "condition": "moving", "requested": all }));
    assert_eq!(left("turret")["condition"], "off");
    let failures = summary["failures"].as_array().unwrap();
    let named =
        failures.iter().filter(|failure| failure["what"].as_str().unwrap().starts_with("drive feeder "));
    assert_eq!(named.count(), 1, "{failures:?}");
    let page = std::fs::read_to_string(report.join("index.html")).unwrap();
    assert!(page.contains("drive feeder still moves at the end"));
}

/// Two drives on a wire of this host, `device`. `more` are further keys of the wire.
pub fn lenzes(device: &str, more: &str) -> String {
    format!(
        "{}[[bus]]\nprotocol = \"profibus-dp\"\ndevice = \"{device}\"\nlatency = \"3ms\"\n{more}\n\
         [bus.defaults]\ndivisor = 16\nlimits = {{ velocity = 25, acceleration = 50 }}\n\
         stop = {{ deceleration = 50, standstill_for = 5 }}\njog_deadman = \"off\"\nwatchdog = \"6s\"\n\
         health = {{ bucket = \"2s\", leak = 1 }}\n\
         [[bus.drive]]\nname = \"infeed\"\naddress = 3\n\
         [[bus.drive]]\nname = \"outfeed\"\naddress = 4\nphase = 8\n",
        patient_cycle()
    )
}

/// The name of a wire that no other test has.
pub fn wire(machine: &Machine) -> String {
    format!("local:lenze-{}-{}", std::process::id(), machine.ip(0).octets()[2])
}

#[test]
fn lenzes_come_answer_requests_are_lost_and_come_back_and_the_run_reports_the_wire() {
    let machine = Machine::new(201);
    let device = wire(&machine);
    let summary = lives(
        &machine.write("lenze.toml", lenzes(&device, "")),
        &format!("drive infeed: not connected: nobody simulates the wire {device}: start `fieldbeat sim`"),
        &[("infeed", "profibus-dp"), ("outfeed", "profibus-dp")],
        &[
            ("set", "infeed C0039/2 15", 0, &["infeed C0039/2: 15.0000 Hz (raw 150000, 0x249F0)\n"]),
            ("get", "infeed C0039/2 --json", 0, &["\"raw\":150000"]),
            // As warm as the simulated drive is unless its configuration says otherwise.
            ("get", "outfeed C0061", 0, &["43.0000 °C (raw 430000, 0x68FB0)"]),
            ("list", "outfeed", 0, &["C0039/2"]),
            ("set", "infeed C0061 1", 2, &["infeed", "the drive only reports this"]),
            ("get", "outfeed 12.5", 2, &["outfeed", "not an address of this drive"]),
        ],
    );
    let load = summary["buses"][0]["load_percent"].as_f64().unwrap();
    assert!(load > 0.0 && load < 100.0, "{summary}");
    for name in ["infeed", "outfeed"] {
        let counters = &drive(&summary, name)["protocol_counters"];
        let count = |key: &str| counters[key].as_u64().unwrap_or_else(|| panic!("no {key}: {counters}"));
        // Slave_Diag, Set_Prm, Chk_Cfg, Slave_Diag: twice.
        assert!(count("start_ups") >= 8 && count("wire_us") > 0, "{counters}");
        // A late answer of one drive in the turn of the other is late.
        assert_eq!((count("second_master"), count("wrong_station")), (0, 0), "{counters}");
        // An answer of a drive that its host holds up collides with the retry.
        let broken = count("wrong_check").max(count("wrong_length"));
        assert!(count("retries") <= count("slot_times") && broken <= count("slot_times"), "{counters}");
    }
}

#[test]
fn an_unusable_wire_is_named_in_one_line_with_the_remedy() {
    for (words, code, parts) in [
        ("ethercat scan eth-none-here", 2, &["there is no network interface eth-none-here", "ip link"][..]),
        ("ethercat scan local:", 2, &["a name has 1 to"]),
        ("ethercat scan local:nobody", 1, &["nothing serves this segment; start it: fieldbeat sim CONFIG"]),
        ("ethercat scan", 2, &["<INTERFACE>; see `fieldbeat ethercat scan --help`"]),
        ("ethernet-ip scan drive", 2, &["an IPv4 address like 192.168.1.40"]),
        (
            "ethernet-ip scan 127.0.0.1 --bind 192.0.2.1",
            2,
            &["cannot ask from 192.0.2.1: ", "ip address shows the addresses of this computer"],
        ),
        (
            "profibus scan /dev/no-such-port",
            2,
            &["there is no serial port /dev/no-such-port", "ls -l /dev/serial/by-id"],
        ),
        ("profibus scan /dev/null", 2, &["/dev/null is no serial port"]),
        ("profibus scan /dev/ttyS1 --rate 115200", 2, &["9600", "12000000 bit/s"]),
    ] {
        let ended = run(words.split(' '));
        match code {
            1 => ended.failed(parts),
            _ => ended.refused(parts),
        }
    }
    let machine = Machine::new(175);
    let none = machine.write("none.toml", kollmorgens("eth-none-77"));
    master(&none, &[]).end().refused(&["there is no network interface eth-none-77"]);
    ask("param get", &none, "turns 0x6041:0").refused(&["there is no network interface eth-none-77"]);
    ask("sim", &none, "").refused(&["name the interface at the other end of its cable"]);

    // An adapter may be plugged in later: the run waits for it, and names it once for both drives at its end.
    let missing = machine.write("missing.toml", lenzes("/dev/no-such-port", ""));
    let mut master = master(&missing, &["--for", "2s"]);
    let why = "there is no serial port /dev/no-such-port: plug in its adapter, or look at the path (ls -l \
               /dev/serial/by-id)";
    master.await_text(&format!("drive infeed: not connected: {why}"));
    let ended = master.end();
    let last = ended.expect(1).err_but_host().lines().last().unwrap();
    assert_eq!(last, format!("fieldbeat: not online: infeed, outfeed ({why})"));
}
