//! README.md and docs/: what a reader copies from there works, and what they say of keys, pages and commands is whole.
//!
//! | code block | what is checked |
//! |---|---|
//! | `toml` | it is a whole configuration and is accepted |
//! | `toml,PART` | it is accepted behind the lines that [`PARTS`] has for it |
//! | `toml,table`, `csv` | it is a command table, a curve |
//! | `sh` | commands, options, examples, tests and benches exist |
//! | `console` | the same of each line behind `$` |
//! | `console,run` | the commands run, against the simulated drives of the demo, and print what stands there |
//! | `rust` | it compiles: src/files.rs includes the page as a doctest |
//!
//! The tests own 127.p.250.0/23, p from the process as in `tests/support`.

mod support;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process;

use fieldbeat::axis::{Command, Link, Outcome};
use fieldbeat::config::linmot::curve as curve_file;
use fieldbeat::config::linmot::table as table_file;
use fieldbeat::config::{self, Configuration};
use fieldbeat::sim::WorldOptions;
use fieldbeat::{Master, Simulation};
use fieldbeat_core::bus::diagnosis::Row;
use support::{Ended, Machine, PROGRAM, Program, UNJUDGED, checkout};

/// What completes a part of a configuration.
const PARTS: [(&str, &str); 5] = [
    (
        "linmot",
        "[[bus]]\nprotocol = \"linudp-v2\"\nbind = \"127.0.0.1\"\n\
         [[bus.drive]]\nname = \"x\"\naddress = \"127.0.0.2\"\n",
    ),
    (
        "unidrive",
        "[[bus]]\nprotocol = \"modbus-tcp\"\n[[bus.drive]]\nname = \"x\"\naddress = \"127.0.0.2\"\n",
    ),
    (
        "kollmorgen",
        "[[bus]]\nprotocol = \"ethercat\"\ninterface = \"local:docs\"\n[[bus.drive]]\nname = \"x\"\n",
    ),
    (
        "moons",
        "[[bus]]\nprotocol = \"ethernet-ip\"\nbind = \"127.0.0.1\"\n\
         [[bus.drive]]\nname = \"x\"\naddress = \"127.0.0.2\"\n",
    ),
    (
        "lenze",
        "[[bus]]\nprotocol = \"profibus-dp\"\ndevice = \"local:docs\"\nrate = 12000000\n\
         [[bus.drive]]\nname = \"x\"\naddress = 3\nlimits.velocity = 20\n",
    ),
];

/// A Markdown file, named by its path in the checkout.
struct Page {
    name: String,
    text: String,
}

impl Page {
    fn read(name: &str) -> Page {
        let text = fs::read_to_string(checkout(name)).unwrap_or_else(|error| panic!("{name}: {error}"));
        Page { name: name.to_owned(), text }
    }

    /// Its fenced code blocks.
    fn blocks(&self) -> Vec<Block<'_>> {
        let mut blocks = Vec::new();
        let mut open: Option<(usize, Block<'_>)> = None;
        for (number, line) in (1..).zip(self.text.lines()) {
            match (open.take(), line.trim_start().strip_prefix("```")) {
                (None, Some(info)) => {
                    // In a list the whole block is indented.
                    let indent = line.len() - line.trim_start().len();
                    open = Some((indent, Block { page: &self.name, line: number, info, lines: Vec::new() }));
                }
                (Some((_, block)), Some("")) => blocks.push(block),
                (Some((indent, mut block)), _) => {
                    block.lines.push(line.get(indent..).unwrap_or_default());
                    open = Some((indent, block));
                }
                (None, None) => {}
            }
        }
        assert!(open.is_none(), "{}: a code block without an end", self.name);
        blocks
    }
}

/// A fenced code block.
struct Block<'a> {
    page: &'a str,
    /// Of its opening fence.
    line: usize,
    /// What stands behind the opening fence.
    info: &'a str,
    lines: Vec<&'a str>,
}

impl Block<'_> {
    fn is(&self, language: &str) -> bool {
        self.info.split(',').next() == Some(language)
    }

    /// The word behind the language.
    fn part(&self) -> Option<&str> {
        self.info.split_once(',').map(|(_, part)| part)
    }

    fn place(&self) -> String {
        format!("{}:{}", self.page, self.line)
    }
}

/// The pages of the book, without its table of contents.
fn book() -> Vec<Page> {
    let mut names: Vec<String> = fs::read_dir(checkout("docs/src"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.ends_with(".md") && name != "SUMMARY.md")
        .collect();
    names.sort();
    names.iter().map(|name| Page::read(&format!("docs/src/{name}"))).collect()
}

/// All that a user reads.
fn pages() -> Vec<Page> {
    let others = ["README.md", "rt-config/host/README.md", "rt-config/grafana/README.md"];
    others.map(Page::read).into_iter().chain(book()).collect()
}

#[test]
fn every_configuration_is_accepted() {
    let mut whole = 0;
    for page in pages() {
        for block in page.blocks().iter().filter(|block| block.is("toml")) {
            let (text, place) = (block.lines.join("\n"), block.place());
            let result = match block.part() {
                None => {
                    whole += 1;
                    config::parse(&text, &place).map(drop)
                }
                Some("table") => table_file::parse(&text, &place).map(drop),
                Some(part) => {
                    let known = PARTS.iter().find(|(name, _)| *name == part);
                    let before = known.unwrap_or_else(|| panic!("{place}: {part}")).1;
                    config::parse(&format!("{before}{text}"), &place).map(drop)
                }
            };
            result.unwrap_or_else(|mistakes| panic!("{mistakes}"));
        }
        for block in page.blocks().iter().filter(|block| block.is("csv")) {
            curve_file::parse(&block.lines.join("\n"), &block.place()).unwrap();
        }
    }
    assert!(whole > 1, "{whole}");
}

/// Without a socket and without a clock: addresses and cores of a sample are nobody's here.
#[test]
fn every_machine_comes_up_in_virtual_time() {
    for page in pages() {
        for block in page.blocks().iter().filter(|block| block.info == "toml") {
            let Configuration { plan, simulation, .. } =
                config::parse(&block.lines.join("\n"), &block.place()).unwrap();
            let axes = plan.axes().len();
            let setup = Master::from_plan(plan).with_simulation(simulation);
            let mut machine = setup.simulate(WorldOptions::default()).unwrap();
            let online =
                |machine: &Simulation| (0..axes).all(|axis| machine.feedback(axis).link == Link::Online);
            assert!(machine.run_until(60_000, online), "{}", block.place());
            for axis in 0..axes {
                let ended = machine.execute(axis, Command::Enable, 60_000).unwrap();
                assert_eq!(ended, Some(Outcome::Done), "{}: axis {axis}", block.place());
            }
        }
    }
}

/// Runs the program in the checkout.
fn run(arguments: &[&str]) -> Ended {
    Program::spawn(process::Command::new(PROGRAM).args(arguments).current_dir(checkout(""))).end()
}

/// The words of a command up to a comment, a pipe or a redirection.
fn words(line: &str) -> Vec<&str> {
    line.split_whitespace()
        .take_while(|word| !matches!(*word, "#" | "|" | ">" | "2>" | "&" | "||" | ";"))
        .collect()
}

/// What is wrong with a command of this project; other commands pass.
fn mistake(line: &str) -> Option<String> {
    let words = words(line);
    let words = if words.first() == Some(&"sudo") { &words[1..] } else { &words[..] };
    let arguments = match words {
        ["fieldbeat" | "target/release/fieldbeat", arguments @ ..] => arguments,
        ["cargo", "run", "--release", "--", arguments @ ..] => arguments,
        ["cargo", ..] => {
            let named = words.windows(2).filter_map(|pair| match *pair {
                ["--example", name] => Some(vec![format!("examples/{name}.rs")]),
                ["--bench", name] => {
                    Some(vec![format!("benches/{name}.rs"), format!("benches/{name}/main.rs")])
                }
                ["--test", name] => Some(vec![format!("tests/{name}.rs"), format!("tests/{name}/main.rs")]),
                _ => None,
            });
            let missing = |files: &Vec<String>| files.iter().all(|file| !checkout(file).exists());
            return named.filter(missing).map(|files| format!("there is no {}", files[0])).next();
        }
        _ => return None,
    };
    if !is_built(arguments) {
        return None;
    }
    // clap reads up to it, option by option and value by value, and then does nothing but print.
    let ended = run(&[arguments, &["--help"]].concat());
    (ended.code != Some(0)).then_some(ended.err)
}

/// Commands of features outside the default ones exist where they were built.
fn is_built(arguments: &[&str]) -> bool {
    let by_feature = [("jog", cfg!(feature = "jog")), ("scope", cfg!(feature = "scope"))];
    by_feature.iter().all(|(command, is_built)| *is_built || arguments.first() != Some(command))
}

#[test]
fn every_command_exists() {
    for wrong in ["run m.toml --no-such", "no-such", "run m.toml --for never", "linmot curve no-such"] {
        assert!(mistake(&format!("fieldbeat {wrong}")).is_some(), "{wrong}");
    }
    assert!(mistake("cargo bench --bench no-such").is_some());
    let mut commands = 0;
    for page in pages() {
        for block in page.blocks() {
            let lines = block.lines.iter().filter_map(|line| match block.info {
                "sh" => Some(*line),
                _ if block.is("console") => line.strip_prefix("$ "),
                _ => None,
            });
            for line in lines {
                commands += 1;
                assert_eq!(mistake(line), None, "{}: {line}", block.place());
            }
        }
    }
    assert!(commands > 30, "{commands}");
}

#[test]
fn no_command_and_no_option_is_left_out() {
    fn visit(path: &[&str], page: &str) {
        let help = run(&[path, &["--help"]].concat()).out;
        // What stands in front of the subcommands.
        let usage = help.lines().find_map(|line| line.strip_prefix("Usage: ")?.split_once("<COMMAND>"));
        let before: Vec<&str> = usage.map_or(Vec::new(), |(before, _)| {
            before.split_whitespace().filter_map(|word| word.strip_prefix('<')?.strip_suffix('>')).collect()
        });
        let mut in_commands = false;
        for line in help.lines() {
            in_commands = match line {
                "Commands:" => true,
                _ if !line.is_empty() && !line.starts_with(' ') => false,
                _ => in_commands,
            };
            let Some(first) = line.split_whitespace().next().map(|word| word.trim_end_matches(',')) else {
                continue;
            };
            let is_entry = line.starts_with("  ") && !line.starts_with("    ");
            if in_commands && is_entry && first != "help" {
                let command = [path, &before, &[first]].concat();
                assert!(page.contains(&format!("`fieldbeat {}", command.join(" "))), "{}", command.join(" "));
                visit(&command, page);
            }
            for option in
                line.split_whitespace().filter(|word| word.starts_with("--") && line.trim().starts_with('-'))
            {
                let option = option.trim_end_matches([',', ']', '.']).split(['=', '[']).next().unwrap();
                assert!(
                    ["--help", "--version"].contains(&option) || page.contains(option),
                    "{path:?}: {option}"
                );
            }
        }
    }
    visit(&[], &Page::read("docs/src/commands.md").text);
}

/// The simulated drives of the demo at addresses of this process.
struct Drives {
    _machine: Machine,
    _program: Program,
    names: [(&'static str, String); 3],
}

impl Drives {
    fn start() -> Drives {
        let machine = Machine::new(250);
        let [_, p, _, _] = machine.ip(0).octets();
        let config = machine.path("demo.toml");
        let names = [
            ("rt-config/demo.toml", config.display().to_string()),
            ("127.77.", format!("127.{p}.25")),
            ("local:demo", format!("local:docs-{}", process::id())),
        ];
        let text = fs::read_to_string(checkout("rt-config/demo.toml")).unwrap();
        // On any host, whatever that carries.
        let text = text.replace("[cycle]\n", &format!("[cycle]\n{UNJUDGED}"));
        fs::write(&config, names[1..].iter().fold(text, |text, (ours, theirs)| text.replace(ours, theirs)))
            .unwrap();
        let mut program = Program::start(["sim".as_ref(), config.as_os_str()]);
        program.await_text("listening");
        Drives { _machine: machine, _program: program, names }
    }

    /// A command as the page has it, here.
    fn here(&self, text: &str) -> String {
        text.replace(self.names[0].0, &self.names[0].1)
    }

    /// What it printed, as the page has it.
    fn there(&self, text: &str) -> String {
        self.names.iter().fold(text.to_owned(), |text, (ours, theirs)| text.replace(theirs, ours))
    }
}

/// Whether `printed` is `expected`, where `...` stands for any lines.
fn matches(expected: &[&str], printed: &[&str]) -> bool {
    match (expected, printed) {
        ([], []) => true,
        (["...", rest @ ..], _) => (0..=printed.len()).any(|skipped| matches(rest, &printed[skipped..])),
        ([first, expected @ ..], [line, printed @ ..]) => first == line && matches(expected, printed),
        _ => false,
    }
}

#[test]
fn sessions_print_what_stands_there() {
    assert!(
        matches(&["a", "...", "d"], &["a", "b", "d"])
            && !matches(&["a", "..."], &["b"])
            && !matches(&["a"], &[])
    );
    let drives = Drives::start();
    let mut commands = 0;
    for page in pages() {
        for block in page.blocks().iter().filter(|block| block.info == "console,run") {
            for session in block
                .lines
                .split(|line| line.starts_with("$ "))
                .skip(1)
                .zip(block.lines.iter().filter_map(|line| line.strip_prefix("$ fieldbeat ")))
            {
                let (expected, command) = session;
                commands += 1;
                let here = drives.here(command);
                let ended = run(&words(&here));
                let printed = drives.there(&(ended.out + &ended.err));
                let lines: Vec<&str> = printed.lines().collect();
                assert!(matches(expected, &lines), "{}: {command} printed\n{printed}", block.place());
            }
        }
    }
    assert!(commands > 5, "{commands}");
}

/// The keys that the reader accepts below `table`, by its own list of them: it is given one that does not exist.
/// `machine` is a configuration with one line more in that table, `at` the table's path.
fn accepted(machine: &dyn Fn(&str) -> String, at: &str, table: &str) -> BTreeSet<String> {
    let wrong = format!("{table}no_such_key");
    let mistakes =
        config::parse(&machine(&format!("{wrong} = 1")), "m.toml").expect_err("no such key").to_string();
    let valid = mistakes.lines().find_map(|line| {
        line.strip_prefix("m.toml:")?
            .split_once(&format!(": {at}.{wrong}: no such key; "))?
            .1
            .split_once("valid here: ")
    });
    match valid {
        // `defaults` has the keys of a drive, and a section of its own.
        Some((_, keys)) if table != "defaults." => {
            keys.split(", ").flat_map(|key| accepted(machine, at, &format!("{table}{key}."))).collect()
        }
        _ => BTreeSet::from([table.trim_end_matches('.').to_owned()]),
    }
}

/// The keys in the first columns of these tables, but for tables whose own keys stand there, too.
fn listed(reference: &[(String, String)], sections: &[&str]) -> BTreeSet<String> {
    let tables = reference.iter().filter(|(section, _)| sections.contains(&section.as_str()));
    let rows = tables.flat_map(|(_, table)| table.lines());
    let cells = rows.filter_map(|row| Some(row.strip_prefix("| `")?.split_once("` |")?.0));
    let names: BTreeSet<&str> = cells.flat_map(|keys| keys.split("`, `")).collect();
    let is_table = |name: &str| names.iter().any(|other| other.starts_with(&format!("{name}.")));
    names.iter().filter(|name| !is_table(name)).map(|name| (*name).to_owned()).collect()
}

#[test]
fn the_reference_has_the_keys_that_the_reader_accepts() {
    let reference = fieldbeat_config::reference();
    let part = |part: &str| PARTS.iter().find(|(name, _)| *name == part).unwrap().1;
    let linmot = part("linmot");
    let hold = |sections: &[&str], at: &str, simulated: &[&str], machine: &dyn Fn(&str) -> String| {
        let mut listed = self::listed(&reference, sections);
        if !simulated.is_empty() {
            listed.remove("simulate");
            let keys = self::listed(&reference, simulated);
            listed.extend(keys.iter().map(|key| format!("simulate.{key}")));
        }
        let accepted = accepted(machine, at, "");
        assert!(accepted.len() > 1, "{sections:?}: {accepted:?}");
        assert_eq!(listed, accepted, "the reference, and the reader of {sections:?}");
    };
    let of = |table: &str| {
        let table = table.to_owned();
        move |line: &str| format!("{linmot}{table}\n{line}")
    };
    hold(&["cycle"], "cycle", &[], &of("[cycle]"));
    hold(&["group"], "group", &[], &of("[[group]]"));
    hold(&["soak.axis"], "soak.axis", &[], &of("[[soak.axis]]\ndrive = \"x\""));
    hold(&["soak.criteria"], "soak.criteria", &[], &of("[soak.criteria]"));
    for (name, machine) in PARTS {
        let protocol = machine.split('"').nth(1).unwrap();
        let own = |path: &str| format!("{protocol} {path}");
        let (head, tail) = machine.split_once("[[bus.drive]]").unwrap();
        // The faults of a segment are those of its bus.
        let is_segment = matches!(name, "kollmorgen" | "lenze");
        let (bus, wire) = (own("bus"), own("bus.simulate"));
        let wire: &[&str] = if is_segment { &[&wire, "simulate"] } else { &[] };
        let of_bus = |line: &str| format!("{head}{line}\n[[bus.drive]]{tail}");
        hold(&["bus", &bus], "bus", wire, &of_bus);
        let (drive, simulated) = (own("bus.drive"), own("bus.drive.simulate"));
        let simulated: &[&str] = if is_segment { &[&simulated] } else { &[&simulated, "simulate"] };
        let of_drive = |line: &str| format!("{head}[[bus.drive]]{tail}{line}");
        hold(&["bus.drive", &drive], "bus.drive", simulated, &of_drive);
        if name == "kollmorgen" {
            let (device, simulated) = (own("bus.device"), own("bus.device.simulate"));
            let of_device = |line: &str| format!("{head}[[bus.drive]]{tail}[[bus.device]]\n{line}");
            hold(&[&device], "bus.device", &[&simulated], &of_device);
        }
    }
}

/// With `UPDATE_REFERENCE=1` in the environment the pages are written.
#[test]
fn the_tables_of_keys_are_those_of_the_reader() {
    let reference = fieldbeat_config::reference();
    let mut missing: BTreeSet<&str> = reference.iter().map(|(section, _)| section.as_str()).collect();
    for page in pages() {
        let mut text = page.text.clone();
        for (section, table) in &reference {
            let marker = format!("<!-- keys of {section} -->\n\n");
            let Some((before, behind)) = text.split_once(&marker) else { continue };
            missing.remove(section.as_str());
            let rows: String =
                behind.split_inclusive('\n').take_while(|line| line.starts_with('|')).collect();
            text = format!("{before}{marker}{table}{}", &behind[rows.len()..]);
        }
        if text != page.text {
            let is_wanted = std::env::var_os("UPDATE_REFERENCE").is_some();
            assert!(is_wanted, "{}: UPDATE_REFERENCE=1 cargo test --test docs writes its tables", page.name);
            fs::write(checkout(&page.name), text).unwrap();
        }
    }
    assert!(missing.is_empty(), "in no page: {missing:?}");
}

#[test]
fn every_counter_of_a_protocol_is_explained() {
    let page = Page::read("docs/src/diagnosis.md");
    let plans = PARTS.map(|(_, machine)| config::parse(machine, "m.toml").unwrap().plan);
    let counters: Vec<_> = plans.iter().flat_map(|plan| plan.own_counters().concat()).collect();
    assert!(counters.len() > 20, "{counters:?}");
    for counter in counters {
        assert!(page.text.contains(&format!("`{}`", counter.key)), "{}", counter.key);
    }
}

#[test]
fn the_tables_of_diagnosis_are_those_of_the_protocols() {
    let page = Page::read("docs/src/diagnosis.md");
    let plans = PARTS.map(|(_, machine)| config::parse(machine, "m.toml").unwrap().plan);
    let tables: Vec<_> = plans.iter().flat_map(|plan| plan.facts()).map(|bus| bus.diagnosis).collect();
    assert!(tables.len() >= 5 && tables.iter().all(|rows| rows.len() > 1));
    for rows in tables {
        let cells = |Row { symptom, says, remedy, .. }: &Row| format!("| {symptom} | {says} | {remedy} |\n");
        let table: String = rows.iter().map(cells).collect();
        assert!(page.text.contains(&format!("|---|---|---|\n{table}\n")), "not in diagnosis.md:\n{table}");
    }
}

/// What `](` leads to in running text.
fn links(page: &Page) -> Vec<String> {
    let mut fenced = false;
    let prose = page.text.lines().filter(|line| {
        let fence = line.trim_start().starts_with("```");
        fenced ^= fence;
        !fenced && !fence
    });
    let text: Vec<&str> = prose.collect();
    let text = text.join("\n");
    text.split("](").skip(1).filter_map(|rest| Some(rest.split_once(')')?.0.to_owned())).collect()
}

/// The anchor of a heading, as the book has it.
fn anchor(heading: &str) -> String {
    let kept = heading.trim().to_lowercase();
    kept.chars()
        .filter_map(|c| match c {
            ' ' => Some('-'),
            c if c.is_alphanumeric() || matches!(c, '-' | '_') => Some(c),
            _ => None,
        })
        .collect()
}

#[test]
fn links_lead_somewhere() {
    let mut seen = 0;
    for page in
        pages().iter().chain([&Page::read("docs/src/SUMMARY.md"), &Page::read("tests/fuzz/README.md")])
    {
        for link in links(page) {
            if link.starts_with("http") {
                continue;
            }
            seen += 1;
            let (file, place) = link.split_once('#').unwrap_or((&link, ""));
            let folder = Path::new(&page.name).parent().unwrap();
            let target = if file.is_empty() { PathBuf::from(&page.name) } else { folder.join(file) };
            assert!(checkout(target.to_str().unwrap()).exists(), "{}: {link}", page.name);
            if !place.is_empty() {
                let target = Page::read(target.to_str().unwrap());
                let headings =
                    target.text.lines().filter_map(|line| line.trim_start_matches('#').strip_prefix(' '));
                assert!(headings.map(anchor).any(|anchor| anchor == place), "{}: {link}", page.name);
            }
        }
    }
    assert!(seen > 20, "{seen}");
}

#[test]
fn the_book_has_every_page() {
    let linked: BTreeSet<String> = links(&Page::read("docs/src/SUMMARY.md")).into_iter().collect();
    let pages = book().into_iter().map(|page| page.name.trim_start_matches("docs/src/").to_owned());
    assert_eq!(linked, pages.collect());
}

#[test]
fn every_page_with_rust_in_it_is_compiled() {
    let library = fs::read_to_string(checkout("src/files.rs")).unwrap();
    let mut seen = 0;
    for page in pages() {
        if page.blocks().iter().any(|block| block.is("rust")) {
            seen += 1;
            assert!(library.contains(&format!("include_str!(\"../{}\")", page.name)), "{}", page.name);
        }
    }
    assert!(seen > 0);
}

/// The source of a path as this book writes it: `core/bus/contract.rs`.
fn source(path: &str) -> PathBuf {
    let (package, file) = path.split_once('/').unwrap();
    checkout("crates").join(package).join("src").join(file)
}

#[test]
fn the_walks_of_the_architecture_name_files_and_functions_that_are_there() {
    let text = fs::read_to_string(checkout("docs/src/architecture.md")).unwrap();
    let walks = |from: &str, to: &str| text.split_once(from).unwrap().1.split_once(to).unwrap().0.to_owned();
    let to_wire = walks("## From a command to the wire", "## From the wire to the feedback");
    let from_wire = walks("## From the wire to the feedback", "## Exchanges");
    let mut seen = 0;
    for step in [&to_wire, &from_wire].into_iter().flat_map(|walk| steps(walk)) {
        let (mut folder, mut texts) = (String::new(), String::new());
        for name in step.split('`').skip(1).step_by(2) {
            if name.ends_with(".rs") {
                let short = source_of(&folder, name);
                let path = source(&short);
                texts = fs::read_to_string(&path).unwrap_or_else(|_| panic!("{name}: {}", path.display()))
                    + &texts;
                folder = short.rsplit_once('/').unwrap().0.to_owned();
                continue;
            }
            let function = name.rsplit("::").next().unwrap();
            let is_there = ["fn ", "struct ", "enum ", "    "].iter().any(|kind| {
                texts.match_indices(&format!("{kind}{function}")).any(|(at, found)| {
                    !texts[at + found.len()..].starts_with(|c: char| c.is_alphanumeric() || c == '_')
                })
            });
            assert!(is_there || name == "Motion::Move", "`{name}` is not in {step}");
            seen += 1;
        }
    }
    assert!(seen > 100, "{seen}");
    let protocols = ["LinMot", "Kollmorgen", "Unidrive", "MOONS'", "Lenze"];
    for (walk, protocol) in [&to_wire, &from_wire].iter().flat_map(|walk| protocols.map(|name| (walk, name)))
    {
        assert!(walk.contains(protocol), "no walk of a {protocol}");
    }
    for (walk, of_all, most) in [(&to_wire, 0, 15), (&from_wire, 5, 10)] {
        let lists = walk.split(":\n\n").skip(1);
        let mut files: Vec<_> = lists.map(|list| steps(list).concat().matches(".rs`").count()).collect();
        let of_all = files.remove(of_all);
        assert!(files.iter().all(|count| of_all + count <= most), "{of_all}, and {files:?} files");
    }
}

/// Numbered items, each as one line.
fn steps(walk: &str) -> Vec<String> {
    let mut steps: Vec<String> = Vec::new();
    for line in walk.lines() {
        let is_next = line.split_once(". ").is_some_and(|(number, _)| number.parse::<u32>().is_ok());
        match (is_next, line.starts_with("   "), steps.last_mut()) {
            (true, ..) => steps.push(line.to_owned()),
            (_, true, Some(step)) => step.push_str(line),
            _ => {}
        }
    }
    steps
}

/// A file next to the one before it may be named by itself, or by its path from the package on.
fn source_of(folder: &str, name: &str) -> String {
    let package = name.split('/').next().unwrap();
    let is_whole = name.contains('/') && checkout("crates").join(package).is_dir();
    if is_whole { name.to_owned() } else { format!("{folder}/{name}") }
}

/// What a module of the core uses stands below it in the table. Between packages cargo sees to that.
#[test]
fn the_modules_of_the_core_point_down() {
    let text = fs::read_to_string(checkout("docs/src/architecture.md")).unwrap();
    let table = text.split_once("Inside of `core`, from the top:").unwrap().1;
    let rows =
        table.lines().skip_while(|line| !line.starts_with("| `")).take_while(|line| line.starts_with('|'));
    let modules: Vec<String> = rows.map(|row| row.split('`').nth(1).unwrap().to_owned()).collect();
    let place = |name: &str| modules.iter().position(|module| module == name);
    let mut seen = 0;
    for (own, module) in modules.iter().enumerate() {
        let mut files = Vec::new();
        let source = source(&format!("core/{module}"));
        if source.is_dir() {
            texts(&source, &mut files);
        }
        files.extend([source.with_extension("rs")].into_iter().filter(|file| file.exists()));
        assert!(!files.is_empty(), "{module} is gone");
        for file in files.iter().filter(|file| !file.to_string_lossy().contains("tests")) {
            let text = fs::read_to_string(file).unwrap();
            let code = text.split("#[cfg(test)]\nmod ").next().unwrap();
            let lines = code.lines().filter(|line| !line.trim_start().starts_with("//"));
            let text: String = lines.collect::<Vec<_>>().join("\n");
            for (at, _) in text.match_indices("crate::") {
                let name: String =
                    text[at + 7..].chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                if let Some(used) = place(&name) {
                    seen += 1;
                    assert!(used >= own, "{} uses {name}, which stands above {module}", file.display());
                }
            }
        }
    }
    assert!(seen > 100, "{seen}");
}

#[test]
fn the_architecture_names_no_file_that_is_gone() {
    let text = fs::read_to_string(checkout("docs/src/architecture.md")).unwrap();
    let mut seen = 0;
    for name in text.split('`').skip(1).step_by(2) {
        let package = name.split('/').next().unwrap_or_default();
        if name.contains('/') && checkout("crates").join(package).is_dir() && !name.contains(' ') {
            seen += 1;
            assert!(source(name).exists(), "{name}");
        }
    }
    assert!(seen > 40, "{seen}");
}

/// The text files of the checkout that people read, by their paths in it.
fn texts(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap_or_default();
        if path.is_dir() {
            if name != "target" && name != "corpus" && (!name.starts_with('.') || name == ".ci") {
                texts(&path, found);
            }
        } else if matches!(path.extension().and_then(|end| end.to_str()), Some("rs" | "toml" | "md"))
            || name == "run"
        {
            found.push(path);
        }
    }
}
