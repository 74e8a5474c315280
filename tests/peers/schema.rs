//! The schema of the configuration in the hands of others: the validator of Python's jsonschema, the linter taplo, and
//! the language server tombi, by which editors complete keys. `.ci/run` installs them below `target/peers`.

use std::collections::BTreeSet;
use std::fs;
use std::path::PathBuf;
use std::process::{Command, Output};

use fieldbeat::config::parse;
use fieldbeat_config::schema;
use serde_json::Value;

use crate::peer::Peer;
use crate::support::{Machine, checkout};

fn tool(name: &str) -> PathBuf {
    checkout("target/peers/python/bin").join(name)
}

/// The sample configurations with their texts.
fn samples() -> Vec<(PathBuf, String)> {
    let entries = fs::read_dir(checkout("rt-config")).unwrap().map(|entry| entry.unwrap().path());
    let is_machine = |path: &PathBuf| path.extension().is_some_and(|end| end == "toml");
    let texts = entries.filter(is_machine).map(|path| (path.clone(), fs::read_to_string(&path).unwrap()));
    // A command table of a drive is none.
    let all: Vec<_> = texts.filter(|(_, text)| text.contains("[[bus]]")).collect();
    assert!(all.len() > 6);
    all
}

/// The dotted names of the keys below a table of the schema.
fn keys(table: &Value, before: &str, found: &mut Vec<String>) {
    for (name, key) in table["properties"].as_object().into_iter().flatten() {
        found.push(format!("{before}{name}"));
        keys(key, &format!("{before}{name}."), found);
    }
}

const VALUES: [&str; 22] = [
    "true",
    "false",
    "0",
    "1",
    "-1",
    "5",
    "300",
    "99999999999",
    "1.5",
    "-0.5",
    "\"off\"",
    "\"1ms\"",
    "\"2 s\"",
    "\"x\"",
    "\"\"",
    "\"0x1702\"",
    "\"127.0.0.9\"",
    "[]",
    "[1, 2]",
    "[\"a\"]",
    "{}",
    "[{}]",
];

/// What the reader says where it refuses a value by its form alone, or a key.
const BY_FORM: [&str; 6] = [
    "no such key",
    "cannot be shared",
    "must be true or false",
    "must be a whole number",
    "must be a number;",
    "must be a table",
];

/// A sample with one to three lines changed, added, renamed or left out.
fn changed(text: &str, schema: &Value, random: &mut fastrand::Rng) -> String {
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    for _ in 0..random.usize(1..=3) {
        let at = random.usize(..lines.len());
        let line = lines[at].clone();
        let value = VALUES[random.usize(..VALUES.len())];
        if line.starts_with('[') {
            let before = lines[..at].iter().rev().find_map(|line| line.strip_prefix("protocol = \""));
            let protocol = before.map_or("", |rest| rest.split('"').next().unwrap());
            let pointer = match line.split('#').next().unwrap().trim() {
                "[cycle]" => "/properties/cycle".to_owned(),
                "[bus.defaults]" | "[[bus.drive]]" => {
                    format!("/definitions/{protocol}/properties/drive/items")
                }
                "[[bus.device]]" => format!("/definitions/{protocol}/properties/device/items"),
                _ => continue,
            };
            let mut known = Vec::new();
            // An earlier change may have taken the protocol away.
            let Some(table) = schema.pointer(&pointer) else { continue };
            keys(table, "", &mut known);
            lines.insert(at + 1, format!("{} = {value}", known[random.usize(..known.len())]));
        } else if let Some((key, _)) = line.split_once(" = ").filter(|_| !line.starts_with('#')) {
            lines[at] = match random.usize(..4) {
                0 => String::new(),
                1 => format!("{key}x = {value}"),
                _ => format!("{key} = {value}"),
            };
        }
    }
    lines.join("\n")
}

#[test]
#[ignore = "needs Python's jsonschema"]
fn another_validator_and_the_reader_agree() {
    let machine = Machine::new(240);
    let schema = schema();
    let file = machine.write("schema.json", schema.to_string());
    let mut python = Command::new(tool("python"));
    python.arg(checkout("tests/peers/schema.py")).arg(file);
    let mut python = Peer::start(python, machine.path("errors"));
    let mut random = fastrand::Rng::with_seed(23);
    let samples = samples();
    let (mut refused, mut by_form) = (0, 0);
    for (path, text) in &samples {
        assert_eq!(python.ask(&Value::from(text.as_str()).to_string()), "valid", "{}", path.display());
    }
    for _ in 0..3_000 {
        let (path, text) = &samples[random.usize(..samples.len())];
        let text = changed(text, &schema, &mut random);
        let verdict = python.ask(&Value::from(text.as_str()).to_string());
        let read = parse(&text, "m.toml");
        let message = read.err().map(|mistakes| mistakes.to_string()).unwrap_or_default();
        match verdict.as_str() {
            "refused" => {
                refused += 1;
                assert!(!message.is_empty(), "{}: the reader takes\n{text}", path.display());
            }
            "valid" => {
                let alone = BY_FORM.iter().any(|form| message.contains(form));
                assert!(!alone, "{}: the schema takes, the reader not: {message}\n{text}", path.display());
            }
            // The reader reads a default where a drive takes it.
            "refused in defaults" => refused += 1,
            // Two keys of one name, or a table in the place of a value.
            _ => assert!(!message.is_empty(), "{text}"),
        }
        by_form += usize::from(BY_FORM.iter().any(|form| message.contains(form)));
    }
    assert!(refused > 600 && by_form > 300, "{refused} {by_form}");
}

fn taplo(schema: &std::path::Path, file: &std::path::Path) -> Output {
    let mut taplo = Command::new(tool("taplo"));
    taplo.args(["check", "--schema"]).arg(format!("file://{}", schema.display())).arg(file);
    taplo.output().unwrap_or_else(|error| panic!("taplo: {error}; .ci/run installs it"))
}

#[test]
#[ignore = "needs taplo"]
fn taplo_takes_the_samples_and_names_what_is_wrong() {
    let machine = Machine::new(241);
    let schema = machine.write("schema.json", schema().to_string());
    for (path, _) in samples() {
        let output = taplo(&schema, &path);
        assert!(output.status.success(), "{}: {}", path.display(), String::from_utf8_lossy(&output.stderr));
    }
    let right = "[cycle]\nperiod = \"1ms\"\n[[bus]]\nprotocol = \"linudp-v2\"\nbind = \"127.0.0.1\"\n\
                 [[bus.drive]]\nname = \"x\"\naddress = \"127.0.0.2\"\n";
    assert!(taplo(&schema, &machine.write("right.toml", right)).status.success());
    for (line, says) in [
        ("divisro = 1", "'divisro' was unexpected"),
        ("divisor = 0", "0 is less than the minimum of 1"),
        ("stream = \"pp\"", "\"pp\" is not one of"),
        ("invert = 1", "1 is not of type \"boolean\""),
        // A key of another protocol.
        ("steps_per_rev = 200", "'steps_per_rev' was unexpected"),
    ] {
        let output = taplo(&schema, &machine.write("wrong.toml", format!("{right}{line}\n")));
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && said.contains(says), "{line}: {said}");
    }
}

#[test]
#[ignore = "needs tombi"]
fn an_editor_proposes_the_keys_of_the_protocol_with_their_sentences() {
    let machine = Machine::new(242);
    machine.write("schema.json", schema().to_string());
    let given = "#:schema ./schema.json\n[[bus]]\nprotocol = \"profibus-dp\"\ndevice = \"/dev/ttyS1\"\n\
                 [[bus.drive]]\nname = \"x\"\n";
    let file = machine.write("machine.toml", given);
    let mut python = Command::new(tool("python"));
    let output = python.arg(checkout("tests/peers/editor.py")).arg(tool("tombi")).arg(file).output().unwrap();
    let out = String::from_utf8(output.stdout).unwrap();
    let proposed: BTreeSet<&str> = out.lines().filter_map(|line| Some(line.split_once('\t')?.0)).collect();
    let schema = schema();
    let of_drive = &schema["definitions"]["profibus-dp"]["properties"]["drive"]["items"]["properties"];
    let mut known: BTreeSet<&str> = of_drive.as_object().unwrap().keys().map(String::as_str).collect();
    known.remove("name");
    assert_eq!(proposed, known, "{}", String::from_utf8_lossy(&output.stderr));
    let sentence = out.lines().find(|line| line.starts_with("divisor\t")).unwrap();
    assert!(sentence.contains("an exchange every so many cycles"), "{sentence}");
}
