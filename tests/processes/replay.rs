//! A recording with the wire, and `fieldbeat replay` of it.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::sleep;
use std::time::Duration;

use fieldbeat_core::cycle::REVISION;
use fieldbeat_record::log::records::{Records, Unsound};
use fieldbeat_record::recording::reading::Wrong;
use mcap::records::Record;

use super::support::{Ended, LONG, Machine, PROGRAM, Program, run, until};
use super::{master, online, recordings, serve};

fn replay(file: &Path, rest: &[&str]) -> Ended {
    run(["replay", file.to_str().unwrap()].into_iter().chain(rest.iter().copied()))
}

/// Options for a recording with the wire.
fn with_wire(file: &Path) -> [&str; 3] {
    ["--record", file.to_str().unwrap(), "--record-wire"]
}

/// A run of two drives, recorded for more than five chunks; ended by SIGINT, or killed.
fn recorded(machine: &Machine, signal: i32) -> PathBuf {
    let config = machine.plain(2);
    let _sim = serve(&config);
    let file = machine.path("x.mcap");
    let running = online(&config, &with_wire(&file));
    let size = || fs::metadata(&file).map_or(0, |facts| facts.len());
    for _ in 0..5 {
        let before = size();
        assert!(until(LONG, || size() > before));
    }
    let ended = running.end_by(signal);
    if signal == libc::SIGINT {
        let recording = ended.out.lines().find(|line| line.contains(file.to_str().unwrap())).unwrap();
        // The log of the wire is whole even where the host was too slow for all records of the cycles.
        let (_, rest) = recording.split_once(" of them for `fieldbeat replay`").unwrap();
        ended.expect(if rest.ends_with(" records are missing") { 1 } else { 0 });
    }
    file
}

#[test]
fn a_demo_with_all_protocols_is_repeated_bit_by_bit() {
    let machine = Machine::new(242);
    let file = machine.path("demo.mcap");
    let demo = ["demo", "--for", "8s", "--drives", "2", "--json"];
    let summary = run(demo.into_iter().chain(with_wire(&file))).json();
    // On a busy computer drives may be lost; the record is one all the same.
    let [recorded] = &summary["recordings"].as_array().unwrap()[..] else { panic!("{summary}") };
    let wire = &recorded["wire"];
    assert!(wire["bytes"].as_u64() > Some(10_000) && wire["cut_at"].is_null(), "{recorded}");
    let ended = replay(&file, &["--json"]);
    ended.expect(0);
    let verdict = ended.json();
    assert_eq!((&verdict["equal"], &verdict["difference"]), (&true.into(), &serde_json::Value::Null));
    assert!(verdict["telegrams"].as_u64() > Some(100), "{verdict}");
    let half = (verdict["last"].as_u64().unwrap() / 2).to_string();
    let ended = replay(&file, &["--until", &half]);
    assert!(
        ended.expect(0).out.contains(", 10 drives: ") && ended.out.contains("are equal"),
        "{}",
        ended.out
    );
    // It is a recording like every other.
    let text = run(["blackbox", file.to_str().unwrap()]).expect(0).out.clone();
    assert!(text.lines().nth(1).unwrap().starts_with("the end of the recording, in cycle "), "{text}");
}

#[test]
fn a_killed_master_leaves_a_file_that_is_readable_and_repeated_up_to_its_last_chunk() {
    let machine = Machine::new(120);
    let file = recorded(&machine, libc::SIGKILL);
    let (entries, wrong) = recordings::read(&file);
    assert!(matches!(wrong, Some(Wrong::Cut)), "{wrong:?}");
    let cycles: Vec<u64> = (entries.iter().filter(|entry| entry.topic.name == "/cycle"))
        .map(|entry| entry.number("cycle"))
        .collect();
    assert!(cycles.len() > 100 && cycles.is_sorted(), "{}", cycles.len());
    let ended = run(["export", file.to_str().unwrap(), "--csv", "-"]);
    assert!(ended.expect(1).err.contains("its end is missing"), "{ended:?}");
    assert_eq!(ended.out.lines().count() as u64, recordings::count(&entries, "/axes/d0") + 1);
    assert_eq!(ended.err.lines().count(), 1);

    let ended = replay(&file, &[]);
    assert!(ended.expect(0).out.contains("are equal"), "{}", ended.out);
    assert!(ended.err.contains("ends with cycle ") && ended.err.lines().count() == 1, "{}", ended.err);
    let verdict = replay(&file, &["--json"]).expect(0).json();
    assert_eq!((&verdict["equal"], &verdict["cut"]), (&true.into(), &"it ends within a record".into()));
}

/// A datagram in the log of a recording.
struct Sent {
    cycle: u64,
    drive: usize,
    /// Where its bytes are in the file.
    at: std::ops::Range<usize>,
}

/// The same recording in chunks that are not compressed, of 100 messages each.
fn uncompressed(bytes: &[u8]) -> Vec<u8> {
    let options = mcap::WriteOptions::new().compression(None).chunk_size(None);
    let mut out = options.create(std::io::Cursor::new(Vec::new())).unwrap();
    let mut messages = 0;
    let end: Result<Option<()>, Unsound> = Records::new(bytes).find(|record| {
        match record {
            Record::Schema { header, data } => {
                let _ = out.add_schema_with_id(header.id, &header.name, &header.encoding, &data)?;
            }
            Record::Channel(of) => {
                let encoding = &of.message_encoding;
                let _ = out.add_channel_with_id(of.id, of.schema_id, &of.topic, encoding, &of.metadata)?;
            }
            Record::Message { header, data } => {
                out.write_to_known_channel(&header, &data)?;
                messages += 1;
                if messages % 100 == 0 {
                    out.flush()?;
                }
            }
            Record::Metadata(metadata) => out.write_metadata(&metadata)?,
            _ => {}
        }
        Ok(None)
    });
    assert!(end.unwrap().is_none());
    out.finish().unwrap();
    out.into_inner().into_inner()
}

/// The first datagram that was sent in a cycle behind the first chunk. The checksum of its chunk is taken away.
fn sent(file: &mut [u8]) -> Sent {
    let summary = mcap::Summary::read(file).unwrap().unwrap();
    let wire = summary.channels.values().find(|channel| channel.topic == "/wire").unwrap().id;
    let mut chunks = summary.chunk_indexes[1..].iter().map(|chunk| chunk.chunk_start_offset as usize);
    chunks.find_map(|chunk| sent_in(file, chunk, wire)).expect("a datagram was sent")
}

/// The same of this chunk.
fn sent_in(file: &mut [u8], chunk: usize, wire: u16) -> Option<Sent> {
    fn number(bytes: &[u8]) -> u64 {
        bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte))
    }
    // Behind opcode, length, times and size: the checksum, no name of a compression, and the length of the records.
    file[chunk + 33..][..4].fill(0);
    let (mut record, end) = (chunk + 49, chunk + 49 + number(&file[chunk + 41..][..8]) as usize);
    while record < end {
        // A message has a head of 22 bytes, which begins with its channel.
        let (opcode, data) = (file[record], record + 9);
        record = data + number(&file[record + 1..][..8]) as usize;
        if opcode != mcap::records::op::MESSAGE || number(&file[data..][..2]) != u64::from(wire) {
            continue;
        }
        // Behind the key of the field is its length, of seven bits a byte.
        let length = file[data + 23..].iter().take_while(|byte| **byte >= 0x80).count() + 1;
        let (mut entry, mut cycle) = (data + 23 + length, None);
        while entry < record {
            let (head, payload) = (number(&file[entry..][..8]), entry + 8);
            let size = (head >> 16 & 0xFFFF) as usize;
            let word = file.get(payload..payload + 8).map_or(0, number);
            match (head & 0x1F, cycle) {
                (2, _) => cycle = Some(word),
                (9, Some(cycle)) => {
                    let drive = (word >> 48 & 0x3FF) as usize;
                    return Some(Sent { cycle, drive, at: payload + 8..payload + size });
                }
                _ => {}
            }
            entry = payload + size.next_multiple_of(8);
        }
    }
    None
}

#[test]
fn a_run_is_repeated_and_the_first_telegram_that_differs_is_named_by_cycle_and_drive() {
    let machine = Machine::new(223);
    let file = recorded(&machine, libc::SIGINT);
    let ended = replay(&file, &[]);
    assert!(ended.expect(0).out.contains("2 drives") && ended.err.is_empty(), "{}{}", ended.out, ended.err);
    let beyond = replay(&file, &["--until", "99999999"]);
    assert!(beyond.expect(1).err.contains("before cycle 99999999: the run ended there"), "{}", beyond.err);

    let whole = fs::read(&file).unwrap();
    let mut bytes = uncompressed(&whole);
    let Sent { cycle, drive, at } = sent(&mut bytes);
    let other = machine.write("other.mcap", &bytes);
    // The data of the file have their checksum, too: at its end.
    replay(&other, &["--until", &cycle.to_string()]).expect(0);
    let was = bytes[at.start + 1];
    bytes[at.start + 1] ^= 0x10;
    fs::write(&other, &bytes).unwrap();
    let what = format!(
        "cycle {cycle}: drive d{drive}: another telegram: byte 1 of {} is {was:02x}, recorded was {:02x}",
        at.len(),
        was ^ 0x10
    );
    let ended = replay(&other, &[]);
    assert_eq!(ended.expect(1).err, format!("fieldbeat: {}: {what}\n", other.display()));
    assert!(ended.out.contains(" are equal before the difference"), "{}", ended.out);
    let verdict = replay(&other, &["--json"]).expect(1).json();
    let expected = serde_json::json!({ "cycle": cycle, "drive": format!("d{drive}"), "what": what });
    assert_eq!((&verdict["equal"], &verdict["difference"]), (&false.into(), &expected));

    // What is no recording is refused, and a broken one is repeated as far as it goes.
    let toml = &b"[cycle]\nperiod = \"1ms\"\n"[..];
    for (path, parts) in [
        (machine.path("none.mcap"), ["cannot read", "none.mcap"]),
        (machine.path(""), ["cannot read", ""]),
        (machine.write("foreign.mcap", toml), ["has no wire to repeat", "it is no MCAP file"]),
        (machine.write("short.mcap", &whole[..20]), ["has no wire to repeat", "it ends within a record"]),
    ] {
        replay(&path, &[]).refused(&[parts[0], parts[1], "--record-wire"]);
    }
    fs::write(&other, &whole[..whole.len() * 2 / 3]).unwrap();
    let cut = replay(&other, &[]);
    assert!(cut.err.contains("it ends within a record"), "{}", cut.err);
    // Nor is there a cycle before the first chunk.
    let summary = mcap::Summary::read(&whole).unwrap().unwrap();
    fs::write(&other, &whole[..summary.chunk_indexes[0].chunk_start_offset as usize + 20]).unwrap();
    let empty = replay(&other, &["--json"]);
    assert!(empty.expect(1).err.contains("has no cycle: it ends within a record"), "{empty:?}");
    assert_eq!((&empty.json()["last"], &empty.json()["equal"]), (&serde_json::Value::Null, &false.into()));

    // The version and the revision of the loop are written in clear, behind their keys and lengths.
    let find = |from: usize, text: &[u8]| {
        from + text.len() + whole[from..].windows(text.len()).position(|bytes| bytes == text).unwrap()
    };
    let begin = find(0, b"fieldbeat.wire");
    let at = find(begin, b"\x08\0\0\0revision") + 4;
    assert_eq!(whole[at..at + 1], REVISION.to_string().into_bytes());
    let mut old = whole.clone();
    old[at] = b'9';
    fs::write(&other, old).unwrap();
    replay(&other, &[]).refused(&[
        &format!("was recorded by version {}", env!("CARGO_PKG_VERSION")),
        "whose loop has revision 9 (layout 3)",
        "repeat it with that one",
    ]);
    // The plan in it, of the same length and with another value.
    let at = find(begin, b"priority: ");
    let mut old = whole.clone();
    old[at] = if old[at] == b'9' { b'8' } else { b'9' };
    fs::write(&other, old).unwrap();
    let repeated = replay(&other, &[]);
    let said = &repeated.expect(0).err;
    assert!(said.contains("its plan is another one to this program: ") && said.contains("here `"), "{said}");
}

#[test]
fn an_unwritable_recording_is_refused_before_anything_is_sent_and_leaves_no_file() {
    let machine = Machine::new(122);
    let config = machine.plain(1);
    let missing = machine.path("missing/x.mcap");
    master(&config, &with_wire(&missing)).end().refused(&["cannot record to", "x.mcap"]);
    master(&config, &["--record-wire"]).end().refused(&["--record <FILE>"]);
    let file = machine.path("x.mcap");
    let window = [&with_wire(&file)[..], &["--record-window", "1s"]].concat();
    master(&config, &window).end().refused(&["leave out --record-window, or --record-wire"]);
    assert!(!file.exists());

    // Without the wire there is nothing to repeat.
    let _sim = serve(&config);
    let running = online(&config, &["--record", file.to_str().unwrap()]);
    // Its address is taken meanwhile.
    let second = machine.path("second.mcap");
    master(&config, &with_wire(&second)).end().refused(&["is in use by another master", "end that one"]);
    assert!(!second.exists());
    running.end_by(libc::SIGINT).expect(0);
    let remedy = "; record the run with --record FILE --record-wire";
    replay(&file, &[]).refused(&["x.mcap has no wire to repeat", remedy]);
    run(["export", file.to_str().unwrap(), "--pcapng"]).refused(&["x.mcap has no telegrams", remedy]);
    assert!(!machine.path("x.pcapng").exists());
}

#[test]
fn the_last_seconds_of_the_wire_are_in_the_black_box_and_exported_as_a_capture() {
    let machine = Machine::new(29);
    let boxes = machine.path("boxes");
    let mut demo = Program::start([
        "demo".as_ref(),
        "--for".as_ref(),
        "60s".as_ref(),
        "--json".as_ref(),
        "--period".as_ref(),
        "2ms".as_ref(),
        "--black-box-wire".as_ref(),
        "--black-box".as_ref(),
        boxes.as_os_str(),
    ]);
    demo.await_text("all drives online");
    // Longer than the black box.
    sleep(Duration::from_secs(3));
    demo.signal(libc::SIGUSR1);
    demo.await_text("black box: ");
    let summary = demo.end_by(libc::SIGINT).json();
    let file = summary["black_boxes"][0]["path"].as_str().unwrap().to_owned();
    let capture = machine.path("x.pcapng");
    run(["export", &file, "--pcapng", capture.to_str().unwrap()]).expect(0);
    let printed = run(["decode", capture.to_str().unwrap()]).expect(0).out.clone();
    let (lines, last) = printed.trim_end().rsplit_once('\n').unwrap();
    for protocol in ["ethercat", "ethernet-ip", "linudp-v2", "modbus-tcp", "profibus-dp"] {
        assert!(last.contains(protocol), "{last}");
    }
    // Each line begins with its time: two seconds and a piece, up to the file.
    let seconds = |line: &str| {
        let time = line.split_whitespace().find(|word| word.contains(':')).unwrap().trim_end_matches('Z');
        let parts = time.rsplit('T').next().unwrap().split(':').map(|part| part.parse::<f64>().unwrap());
        parts.fold(0.0, |sum, part| 60.0 * sum + part)
    };
    let (begin, end) = (seconds(lines.lines().next().unwrap()), seconds(lines.lines().last().unwrap()));
    let span = (end - begin).rem_euclid(86_400.0);
    assert!((1.5..10.0).contains(&span), "{span} s");
    run(["replay", &file]).refused(&["the wire of the last seconds", "--record FILE --record-wire"]);
}

#[test]
fn the_wire_of_a_recording_is_exported_as_a_capture_which_is_printed_in_words() {
    let machine = Machine::new(146);
    let path = recorded(&machine, libc::SIGINT);
    let file = path.to_str().unwrap();
    let export = |out: &[&str]| run([&["export", file, "--pcapng"], out].concat());
    let decode = |file: &Path| run(["decode", file.to_str().unwrap()]);
    let capture = machine.path("x.pcapng");
    let said = export(&[]).expect(0).err.clone();
    let count: usize = said.rsplit(' ').nth(1).unwrap().parse().unwrap();
    assert!(said.contains("x.pcapng: ") && said.trim_end().ends_with(" packets") && count > 100, "{said}");
    let printed = decode(&capture).expect(0).out.clone();
    let lines: Vec<&str> = printed.lines().collect();
    assert_eq!(lines.len(), count + 1);
    assert_eq!(lines[count], format!("{count} telegrams: {count} linudp-v2"));
    assert!(lines[0].contains(":49360 linudp-v2: request of blocks "), "{}", lines[0]);
    let bytes = fs::read(&capture).unwrap();
    let out = Command::new(PROGRAM).args(["export", file, "--pcapng", "-"]).output().unwrap();
    assert!(out.status.success() && out.stdout == bytes && out.stderr.is_empty());

    let port = ["--port", "linudp-v2=9"];
    assert_eq!(run([&["decode", capture.to_str().unwrap()], &port[..]].concat()).expect(0).out, printed);
    let wrong = run(["decode", capture.to_str().unwrap(), "--port", "linudp=9"]);
    wrong.refused(&["write PROTOCOL=PORT, with one of linudp-v2, modbus-tcp, "]);

    // What is there is never replaced.
    export(&[]).refused(&["x.pcapng: File exists", "name another place, or remove it"]);
    let nowhere = machine.path("missing/x.pcapng");
    export(&[nowhere.to_str().unwrap()])
        .refused(&["cannot write", "name a place that this user may write to"]);
    // A recording that was cut, and a capture: up to their last sound parts.
    let whole = fs::read(&path).unwrap();
    let cut = machine.write("cut.mcap", &whole[..whole.len() * 2 / 3]);
    let ended = run(["export", cut.to_str().unwrap(), "--pcapng"]);
    let lines: Vec<&str> = ended.expect(1).err.lines().collect();
    assert!(
        lines.len() == 2 && lines[1].contains("cut.mcap: it is damaged (it ends within a record)"),
        "{lines:?}"
    );
    assert!(lines[1].ends_with("what is before that was exported"), "{lines:?}");
    let less = decode(&machine.path("cut.pcapng")).expect(0).out.lines().count();
    assert!((10..count).contains(&less), "{less} {count}");
    let cut = machine.write("cut.pcapng", &bytes[..bytes.len() - 9]);
    let ended = decode(&cut);
    assert_eq!(ended.expect(1).out.lines().count(), count);
    assert!(ended.err.contains("cut.pcapng: its end is missing") && ended.err.lines().count() == 1);
    let mut broken = bytes.clone();
    let middle = bytes.len() / 2;
    broken[middle..middle + 400].fill(0xEE);
    let ended = decode(&machine.write("broken.pcapng", broken));
    assert!(ended.expect(1).err.contains("broken.pcapng: it is damaged (") && ended.err.lines().count() == 1);
    for (path, why) in [
        (path.clone(), "x.mcap: not a capture; name one"),
        (machine.path("none"), "none: No such file or directory"),
        (machine.path(""), "Is a directory"),
        (machine.write("empty", ""), "empty: not a capture; name one"),
    ] {
        decode(&path).refused(&[why]);
    }
}
