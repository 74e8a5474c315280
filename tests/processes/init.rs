//! `init`: a first configuration of each protocol by defaults and by answers, and against simulated drives.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpListener;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use libc::SIGINT;

use super::support::{Ended, Machine, PROGRAM, UNJUDGED, period, run};
use super::{end_once_online, limit_files, master, simulation};

/// The protocols with the drives of each.
const PROTOCOLS: [&str; 5] = ["linudp-v2", "modbus-tcp", "ethercat", "ethernet-ip", "profibus-dp"];

/// `fieldbeat init` with these arguments, and these lines as its answers.
fn init(file: &Path, arguments: &[&str], answers: impl AsRef<[u8]>) -> Ended {
    init_by(Command::new(PROGRAM), file, arguments, answers)
}

fn piped(command: &mut Command) -> Child {
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// The same, started by `program`.
pub fn init_by(mut program: Command, file: &Path, arguments: &[&str], answers: impl AsRef<[u8]>) -> Ended {
    let mut child = piped(program.arg("init").arg(file).args(arguments));
    // It may end before it has read all of them.
    let _ = child.stdin.take().unwrap().write_all(answers.as_ref());
    let output = child.wait_with_output().unwrap();
    let [out, err] = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap());
    Ended { code: output.status.code(), signal: None, out, err }
}

/// What `check` makes of a file.
pub fn check(file: &Path) -> Ended {
    run(["check".as_ref(), file.as_os_str()])
}

/// The files in the directory of a machine.
fn files(machine: &Machine) -> Vec<String> {
    let entries = fs::read_dir(machine.path("")).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

#[test]
fn the_defaults_of_every_protocol_pass_check_and_every_key_has_its_comment() {
    let machine = Machine::new(243);
    for protocol in PROTOCOLS {
        let file = machine.path(&format!("{protocol}.toml"));
        init(&file, &["--yes", "--protocol", protocol], "").expect(0);
        let ended = check(&file);
        ended.expect(0);
        assert!(ended.out.contains("1 drive"), "{ended:?}");
        let text = fs::read_to_string(&file).unwrap();
        let mut keys = 0;
        for (before, line) in text.lines().zip(text.lines().skip(1)) {
            if !line.is_empty() && !line.starts_with(['#', '[']) {
                keys += 1;
                assert!(before.starts_with("# "), "{protocol}: {line}");
            }
        }
        assert!(keys > 12, "{text}");
    }
}

/// Odd names are quoted, or refused and prompted for again.
#[test]
fn several_drives_with_odd_names_pass_check_for_every_protocol() {
    let machine = Machine::new(244);
    for protocol in PROTOCOLS {
        let file = machine.path(&format!("{protocol}.toml"));
        // The questions of a bus, whether to search, how many drives; then of the first one its name, the others of it,
        // and of the next ones whether they are as the one before.
        let bus = match protocol {
            "modbus-tcp" => "\n",
            "profibus-dp" => "/dev/ttyS1\n\n",
            "ethercat" => "eth7\n",
            _ => "192.168.7.1\n",
        };
        let own = if protocol == "ethercat" { "\n\n" } else { "\n" };
        // So many questions have the drives of a protocol in common.
        let shared = match protocol {
            "linudp-v2" => 11,
            "modbus-tcp" => 10,
            _ => 12,
        };
        let mut answers = format!("{bus}no\nmany\n4\n");
        for (index, name) in ["true", "3.25", "größe_1", "a b\n[x]\nx-1"].into_iter().enumerate() {
            let rest = if index == 0 { "\n".repeat(shared) } else { "yes\n".to_owned() };
            answers += &format!("{name}\n{own}{rest}");
        }
        let ended = init(&file, &["--protocol", protocol], &answers);
        ended.expect(0);
        assert!(ended.out.contains("must be a whole number, 1 to 128"), "{}", ended.out);
        assert_eq!(ended.out.matches("must be 1 to 32 letters").count(), 2, "{}", ended.out);
        let plan = fieldbeat::config::load(&file).unwrap_or_else(|why| panic!("{why}")).plan;
        let names: Vec<String> = plan.axes().iter().map(|axis| axis.name.clone()).collect();
        assert_eq!(names, ["true", "3.25", "größe_1", "x-1"], "{protocol}");
        check(&file).expect(0);
    }
}

#[test]
fn a_wrong_answer_is_explained_by_the_reader_and_prompted_for_again() {
    let machine = Machine::new(245);
    let file = machine.path("machine.toml");
    let answers = "7\nlinudp-v2\n300.1.1.1\n127.0.0.1\nmaybe\nno\n1\nx\n192.168.1.10\n\
         127.0.0.10\nrev\n\n4096\n-2\n2\n\n3\n1.5\n\nslow\nquick\n\nvertical\n\nbrake\n[9, \
         1]\n[-3, 12]\naccept\n\n0.5\n";
    let ended = init(&file, &[], answers);
    ended.expect(0);
    for part in [
        "  must be one of linudp-v2, modbus-tcp",
        "must be the IPv4 address of an adapter",
        "  must be yes or no",
        "cannot be reached from bind",
        "  must be given",
        "must rise: [lowest, highest]",
        "must be above 0",
        "must be \"ramp\", \"quick\" or \"coast\"",
    ] {
        assert!(ended.out.contains(part), "{part}:\n{}", ended.out);
    }
    let plan = fieldbeat::config::load(&file).unwrap().plan;
    let axis = plan.axes()[0];
    assert_eq!((axis.limits.position, axis.limits.velocity), (Some((-3.0, 12.0)), Some(2.0)));
    let text = fs::read_to_string(&file).unwrap();
    for line in ["held_by = \"brake\"", "leash = 0.5", "scale = 4096", "profile.velocity = 1.5"] {
        assert!(text.lines().any(|own| own == line), "{line}:\n{text}");
    }
}

/// By default the accelerations suit the velocity. A ramp that takes longer than a stop may is refused at its own
/// question; and what is no text ends nothing.
#[test]
fn a_ramp_that_is_too_long_and_an_invalid_text_are_prompted_for_again() {
    let machine = Machine::new(252);
    for (deceleration, complaints) in [("", 0), ("100\n", 1)] {
        let file = machine.path(&format!("machine-{complaints}.toml"));
        let name = b"M\xfcller\nx\n\n".as_slice();
        let rest = format!("\n\n2000\n\n\n\n\n{deceleration}\n\n\n\n");
        let answers = [b"192.168.7.1\nno\n1\n", name, rest.as_bytes()].concat();
        let ended = init(&file, &["--protocol", "linudp-v2"], answers);
        ended.expect(0);
        let complaint = "takes 20 s, longer than 3 s; allow more, or raise stop.deceleration";
        assert_eq!(ended.out.matches(complaint).count(), complaints, "{}", ended.out);
        assert!(ended.out.contains("must be 1 to 32 letters"), "{}", ended.out);
        check(&file).expect(0);
        let axis = fieldbeat::config::load(&file).unwrap().plan.axes()[0].clone();
        assert_eq!((axis.limits.velocity, axis.limits.acceleration), (Some(2_000.0), Some(10_000.0)));
        assert_eq!(axis.stop.deceleration, 10_000.0);
    }
}

#[test]
fn init_replaces_a_file_on_request_only_and_prints_what_it_cannot_write() {
    let machine = Machine::new(246);
    let file = machine.write("machine.toml", "mine");
    let defaults = ["--yes", "--protocol", "modbus-tcp"];
    init(&file, &defaults, "").refused(&["machine.toml is there already", "--force"]);
    assert_eq!(fs::read_to_string(&file).unwrap(), "mine");
    let link = machine.path("link.toml");
    symlink(machine.path("nowhere"), &link).unwrap();
    init(&link, &defaults, "").refused(&["link.toml is there already"]);
    assert!(!machine.path("nowhere").exists());
    // Known before a question; on a disk that is full by then the answers are not lost.
    let ended = init(&file.join("machine.toml"), &["--protocol", "modbus-tcp"], "");
    ended.refused(&["machine.toml cannot be written: ", "name a file where this user may write"]);
    assert!(ended.out.is_empty(), "{}", ended.out);
    let mut full = Command::new(PROGRAM);
    limit_files(&mut full, 200);
    let ended = init_by(full, &machine.path("other.toml"), &defaults, "");
    assert!(ended.expect(1).out.contains("\nprotocol = \"modbus-tcp\"\n"), "{}", ended.out);
    assert!(ended.err.contains("cannot be written") && ended.err.lines().count() == 1, "{}", ended.err);
    init(&file, &["--yes", "--protocol", "modbus-tcp", "--force"], "").expect(0);
    check(&file).expect(0);
}

#[test]
fn answers_that_make_no_valid_file_are_not_lost() {
    let machine = Machine::new(250);
    let file = machine.path("machine.toml");
    let answers = format!(
        "127.0.0.1\nno\n1\nlift\n127.0.0.10\n\n\n\n\n\n\ncoast\n\nvertical\nbrake\n{}",
        "\n".repeat(20)
    );
    let ended = init(&file, &["--protocol", "linudp-v2"], &answers);
    for part in ["would let a vertical load drop", "nothing is written; the text is above"] {
        assert!(ended.expect(2).err.contains(part), "{part}: {ended:?}");
    }
    for line in ["period = \"2ms\"", "name = \"lift\"", "stop.how = \"coast\"", "held_by = \"brake\""] {
        assert!(ended.out.lines().any(|own| own == line), "{line}: {}", ended.out);
    }
    assert!(files(&machine).is_empty(), "{:?}", files(&machine));
}

#[test]
fn answers_that_end_in_the_middle_and_ctrl_c_write_nothing() {
    let machine = Machine::new(247);
    let file = machine.path("machine.toml");
    for answers in ["", "2\n", "2\n\nno\n1\nname\n"] {
        let ended = init(&file, &[], answers);
        assert_eq!(ended.expect(1).err, "fieldbeat: the answers have ended; nothing is written\n");
    }
    let mut command = Command::new(PROGRAM);
    let mut child = piped(command.arg("init").arg(&file));
    let mut input = child.stdin.take().unwrap();
    input.write_all(b"modbus-tcp\n").unwrap();
    // The answer is repeated where it is not typed: the signals are caught by then.
    let mut out = BufReader::new(child.stdout.take().unwrap());
    let mut line = String::new();
    while !line.contains("Protocol") {
        line.clear();
        assert!(out.read_line(&mut line).unwrap() > 0, "it has ended");
    }
    // SAFETY: takes two numbers; the child has not been waited for, so that its id is its own.
    assert_eq!(unsafe { libc::kill(child.id() as i32, SIGINT) }, 0);
    assert_eq!(child.wait().unwrap().code(), Some(1));
    let mut said = String::new();
    child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert!(said.contains("interrupted; nothing is written"), "{said}");
    assert!(files(&machine).is_empty(), "{:?}", files(&machine));
    drop(input);
}

#[test]
fn init_without_a_search_result_offers_manual_entry() {
    let machine = Machine::new(249);
    for (protocol, bus, says) in [
        ("ethercat", "nosuch0\n", "nosuch0"),
        ("ethercat", "local:nobody-serves-this\n", "start it: fieldbeat sim CONFIG"),
        ("profibus-dp", "/dev/no-such-port\n\n", "/dev/no-such-port"),
        ("ethernet-ip", "192.0.2.77\n", "cannot ask from 192.0.2.77"),
    ] {
        let file = machine.path(&format!("{}.toml", says.len()));
        let answers = format!("{bus}yes\n{}", "\n".repeat(30));
        let ended = init(&file, &["--protocol", protocol], &answers);
        ended.expect(0);
        let line = ended.out.lines().find(|line| line.starts_with("  ")).unwrap_or_default();
        assert!(line.contains(says), "{says}:\n{}", ended.out);
        assert!(ended.out.contains("Type in what you know."), "{}", ended.out);
        check(&file).expect(0);
    }
}

/// The file as it was written, patient with a busy computer.
fn patient(file: &Path) -> PathBuf {
    let text = fs::read_to_string(file).unwrap();
    // Comments name all of them.
    let is = |protocol: &str| text.contains(&format!("protocol = \"{protocol}\""));
    // The turns of a wire whose slaves may answer 3 ms late.
    let period = if is("profibus-dp") { "40ms".to_owned() } else { period() };
    let cycle = format!(
        "period = \"{period}\"\nreceive_deadline = 0.8\nmax_skip = \"30s\"\nmax_skip_rate = 1.0\n{UNJUDGED}"
    );
    let lines = text.lines().map(|line| match line {
        "watchdog = \"100ms\"" => "watchdog = \"6s\"\n".to_owned(),
        "protocol = \"profibus-dp\"" => format!("{line}\nlatency = \"3ms\"\n"),
        line if line.starts_with("period = ") => cycle.clone(),
        line => format!("{line}\n"),
    });
    // A connection of class 1 ends after 512 packets.
    let bucket = if is("ethernet-ip") { "500ms" } else { "5s" };
    let text: String = lines.collect();
    let health = format!("[bus.defaults]\nhealth = {{ bucket = \"{bucket}\", leak = 1 }}\n[[bus.drive]]");
    let path = file.with_extension("patient.toml");
    fs::write(&path, text.replacen("[[bus.drive]]", &health, 1)).unwrap();
    path
}

/// Writes a file by hand, starts its drives, finds them again and runs their master with what
/// was found.
fn starts_its_drives(test: u8, protocol: &str, bus: impl Fn(&Machine) -> String, search: &str, says: &str) {
    let machine = Machine::new(test);
    let (by_hand, by_search) = (machine.path("hand.toml"), machine.path("found.toml"));
    let bus = bus(&machine);
    let rest = "\n".repeat(30);
    init(&by_hand, &["--protocol", protocol], format!("{bus}no\n2\n{rest}")).expect(0);
    let simulated = simulation(&patient(&by_hand));
    let search = search.replace("NET", machine.ip(0).to_string().trim_end_matches(".0"));
    let ended = init(&by_search, &["--protocol", protocol], format!("{bus}{search}{rest}"));
    ended.expect(0);
    let named = ended.out.lines().filter(|line| line.starts_with("  ") && line.contains(says));
    assert_eq!(named.count(), 2, "{}", ended.out);
    // By what the drives are known is found only by a search.
    let identity = ["product", "serial", "# required product", "# required serial"];
    let is_else = |line: &&str| !identity.iter().any(|key| line.starts_with(key));
    let found = fs::read_to_string(&by_search).unwrap();
    let found: Vec<&str> = found.lines().filter(is_else).collect();
    assert_eq!(found, fs::read_to_string(&by_hand).unwrap().lines().collect::<Vec<_>>());
    end_once_online(master(&patient(&by_search), &[])).expect(0);
    simulated.end_by(SIGINT).expect(0);
}

fn bind(machine: &Machine) -> String {
    format!("{}\n", machine.ip(1))
}

#[test]
fn linmots_are_probed_and_run() {
    starts_its_drives(250, "linudp-v2", bind, "yes\nNET.10-12\n", "a LinMot at");
}

#[test]
#[ignore = "needs root: simulates drives at the port of Modbus, which is below 1024"]
fn unidrives_are_probed_and_run() {
    starts_its_drives(251, "modbus-tcp", bind, "yes\nNET.10-12\n", "a Unidrive at");
}

#[test]
fn a_unidrive_is_distinguished_from_other_modbus_servers() {
    let machine = Machine::new(236);
    let [drive, zeros, refusing] = [20, 21, 22].map(|host| format!("{}:1502", machine.ip(host)));
    let config = format!(
        "[cycle]\nperiod = \"16ms\"\nrealtime = \"off\"\n[[bus]]\nprotocol = \"modbus-tcp\"\n\
         [[bus.drive]]\nname = \"u\"\naddress = \"{drive}\"\nlimits = {{ velocity = 20 }}\n"
    );
    let simulated = simulation(&machine.write("drives.toml", config));
    // Servers of one request: two registers of 0, and an exception.
    let servers = [(&zeros, &[3, 4, 0, 0, 0, 0][..]), (&refusing, &[0x83, 2])].map(|(address, pdu)| {
        let listener = TcpListener::bind(address).unwrap();
        std::thread::spawn(move || {
            let mut stream = listener.accept().unwrap().0;
            let mut request = [0; 12];
            stream.read_exact(&mut request).unwrap();
            let head = [request[0], request[1], 0, 0, 0, pdu.len() as u8 + 1, request[6]];
            stream.write_all(&[&head, pdu].concat()).unwrap();
        })
    });
    let file = machine.path("machine.toml");
    let answers = format!("\nyes\n{zeros} {drive} {refusing}\n{}", "\n".repeat(30));
    let ended = init(&file, &["--protocol", "modbus-tcp"], &answers);
    ended.expect(0);
    servers.into_iter().for_each(|server| server.join().unwrap());
    let lines: Vec<&str> = ended.out.lines().filter(|line| line.starts_with("  a ")).collect();
    let other = "  a Modbus server that is no Unidrive with the standard addressing at";
    let expected =
        [format!("{other} {zeros}"), format!("  a Unidrive at {drive}"), format!("{other} {refusing}")];
    assert_eq!(lines, expected, "{}", ended.out);
    let text = fs::read_to_string(&file).unwrap();
    assert_eq!(text.matches("[[bus.drive]]").count(), 1, "{text}");
    assert!(text.contains(&format!("address = \"{drive}\"")), "{text}");
    simulated.end_by(SIGINT).expect(0);
}

#[test]
fn kollmorgens_are_found_and_run() {
    let local = |_: &Machine| format!("local:init-{}\n", std::process::id());
    starts_its_drives(252, "ethercat", local, "yes\n", "at position");
}

/// Another slave is named, and the drive behind it has its position.
#[test]
fn a_terminal_is_listed_and_left_out() {
    let machine = Machine::new(239);
    let interface = format!("local:init-io-{}", std::process::id());
    let segment = format!(
        "[cycle]\nperiod = \"16ms\"\nrealtime = \"off\"\n[[bus]]\nprotocol = \"ethercat\"\ninterface = \
         \"{interface}\"\n[[bus.device]]\nname = \"io\"\noutputs = {{ start = 0x1000, length = 1 \
         }}\n[[bus.drive]]\nname = \"x\"\n"
    );
    let simulated = simulation(&machine.write("segment.toml", segment));
    let file = machine.path("machine.toml");
    let ended = init(&file, &["--protocol", "ethercat"], format!("{interface}\nyes\n{}", "\n".repeat(30)));
    ended.expect(0);
    assert!(ended.out.contains("at position 0: no drive; write a [[bus.device]]"), "{}", ended.out);
    let text = fs::read_to_string(&file).unwrap();
    assert!(text.contains("position = 1\n") && !text.contains("bus.device"), "{text}");
    check(&file).expect(0);
    simulated.end_by(SIGINT).expect(0);
}

#[test]
fn moons_drives_are_found_and_run() {
    starts_its_drives(253, "ethernet-ip", bind, "yes\n", "STF10-IP at");
}

#[test]
fn lenzes_are_found_and_run() {
    let local = |_: &Machine| format!("local:init-dp-{}\n\n", std::process::id());
    starts_its_drives(254, "profibus-dp", local, "yes\n", "with the ident number");
}
