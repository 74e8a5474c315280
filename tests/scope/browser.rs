//! The page in Chromium: it draws, triggers, zooms, measures, exports, and attaches again. `.ci/run` installs the
//! browser, the library that drives it, and the reader of MCAP.

use std::path::{Path, PathBuf};
use std::process::Command;

use fieldbeat::time::MS;
use libc::SIGINT;
use serde_json::{Value, json};

use crate::peer::Peer;
use crate::program::address;
use crate::support::{LONG, Machine, Program, carried, checkout, served, simulated, until};

const BROWSER: &str = "/usr/bin/chromium";

/// A browser.
struct Browser(Peer);

impl Browser {
    fn start(machine: &Machine) -> Browser {
        let mut node = Command::new("node");
        node.arg(checkout("tests/scope/browser.cjs")).arg(BROWSER).arg(machine.path("profile"));
        node.env("NODE_PATH", checkout("target/peers/node_modules"));
        Browser(Peer::start(node, machine.path("browser.txt")))
    }

    /// What a command of the script is answered.
    fn ask(&mut self, line: &str) -> Value {
        let answer: Value = serde_json::from_str(&self.0.ask(line)).unwrap();
        assert!(answer["failed"].is_null(), "{line}: {answer}");
        answer
    }

    fn number(&mut self, expression: &str) -> f64 {
        let value = self.ask(&format!("eval {expression}"));
        value.as_f64().unwrap_or_else(|| panic!("{expression}: {value}"))
    }

    fn wait(&mut self, expression: &str) {
        self.ask(&format!("wait {expression}"));
    }
}

/// A master, its drives, its page in a browser.
struct Running {
    machine: Machine,
    config: PathBuf,
    drives: Option<fieldbeat::sim::server::SimServer>,
    master: Option<Program>,
    scope: Program,
    browser: Browser,
}

impl Running {
    fn start(test: u8, drives: usize, control: bool) -> Running {
        Running::with(test, drives, control, "")
    }

    /// `cycle` are lines of `[cycle]`.
    fn with(test: u8, drives: usize, control: bool, cycle: &str) -> Running {
        let machine = Machine::new(test);
        let config = machine.config("m.toml", drives, cycle, Machine::LOST_SOON);
        let served = served(|| simulated(&config));
        let name = config.to_str().unwrap();
        let (run, page): (&[&str], &[&str]) =
            if control { (&["run", name, "--allow-control"], &["--control"]) } else { (&["run", name], &[]) };
        let mut master = Program::start(run);
        master.await_text("all drives online");
        let mut scope = Program::start(["scope", name, "--listen", "0"].iter().chain(page));
        let _ = address(&mut scope);
        let url = scope.out().trim().strip_prefix("scope at ").unwrap().to_owned();
        let mut browser = Browser::start(&machine);
        browser.ask(&format!("open {url}"));
        browser.wait("globalThis.scope?.store.written > 200");
        Running { machine, config, drives: Some(served), master: Some(master), scope, browser }
    }

    fn end(mut self) {
        assert_eq!(self.browser.ask("errors"), json!([]));
        self.scope.signal(SIGINT);
        self.scope.end().expect(0);
        let master = self.master.unwrap();
        let ended = master.end_by(SIGINT);
        assert!(ended.out.contains("; 0 telemetry records and 0 events lost"), "{}", ended.out);
    }
}

/// Pixels of the first plot that have neither the colour of the paper nor of its grid: lines are drawn.
const INKED: &str = "(() => { const canvas = document.querySelector('.plot canvas'); \
    const { data } = canvas.getContext('2d').getImageData(60, 0, canvas.width - 80, canvas.height - 30); \
    let inked = 0; \
    for (let at = 0; at < data.length; at += 4) \
    { \
        const colour = data.slice(at, at + 3); \
        if (data[at + 3] > 200 && Math.max(...colour) - Math.min(...colour) > 60) inked++; \
    } \
    return inked; })()";

#[test]
#[ignore = "needs chromium, node and playwright-core"]
fn the_page_draws_triggers_measures_and_attaches_again() {
    let mut running = Running::start(40, 3, false);
    let browser = &mut running.browser;
    // It draws: a line across the plot, with the value that the drive reports.
    browser.wait("scope.plots[0].uplot.data[0].length > 100");
    browser.wait(&format!("{INKED} > 200"));
    assert_eq!(browser.ask("eval scope.plots.length"), 4);
    assert_eq!(browser.ask("eval document.querySelector('#status-text').textContent"), "connected");
    assert_eq!(browser.ask("eval document.querySelector('#access').textContent"), "read-only");
    assert_eq!(browser.ask("eval document.querySelectorAll('#axes tbody tr').length"), 3);
    browser.wait("document.querySelector('#axes td.state').textContent.length > 3");
    // Each cycle once, in its order; what is left out is what the loop skipped.
    let disorder = "(() => { let disorder = 0; for (let i = scope.store.oldest + 1; i < scope.store.written; \
         i++) disorder += scope.store.cycle(i) <= scope.store.cycle(i - 1); return disorder; })()";
    assert_eq!(browser.number(disorder), 0.0);

    // It triggers on an edge of the loop's wake-up latency, with a quarter of the window before it.
    let level = browser.number(
        "(() => { const id = 0; const of = []; for (let i = scope.store.oldest; i < scope.store.written; \
         i++) of.push(scope.store.max(id, i)); return of.sort((a, b) => a - b)[Math.floor(of.length / 2)]; \
         })()",
    );
    for step in ["set #window 0.2", "set #source 0", "set #edge rising", "set #pre 0.25", "set #mode normal"]
    {
        browser.ask(step);
    }
    browser.ask(&format!("set #level {level}"));
    browser.ask("click #single");
    browser.wait("scope.view.held && scope.view.triggered");
    let view = browser.ask(
        "eval (() => { const { view } = scope; const at = view.data.at(view.origin); \
         const pre = (view.origin - view.from) / (view.to - view.from); \
         return [view.data.min(0, at - 1), view.data.max(0, at), pre]; })()",
    );
    let [before, after, pre] = [0, 1, 2].map(|place| view[place].as_f64().unwrap());
    assert!(before < level && level <= after && (pre - 0.25).abs() < 1e-6, "{view} around {level}");

    // Cursors measure, a selection zooms, a key goes back.
    browser.ask("key c");
    assert!(
        browser.ask("eval document.querySelector('#measured').innerText").as_str().unwrap().contains("B − A")
    );
    browser.ask("drag 0.25 0.75");
    let zoomed = browser.number("scope.view.to - scope.view.from");
    assert!((0.095..0.105).contains(&zoomed), "{zoomed}");
    browser.ask("key Escape");
    assert!((browser.number("scope.view.to - scope.view.from") - 0.2).abs() < 1e-9);

    // An event triggers: the drives are lost, and their axes' links with them.
    browser.ask("set #source event");
    browser.ask("click #single");
    // On a busy host an event of its own may come first.
    browser.wait("/^(armed|held, cycle)/.test(document.querySelector('#trigger-state').textContent)");
    running.drives.take().unwrap().stop();
    browser.wait("scope.view.held && scope.view.triggered");
    browser.wait("document.querySelector('#events').innerText.includes('link lost')");
    browser.wait("document.querySelector('#axes td.state').textContent.includes('link lost')");
    running.drives = Some(served(|| simulated(&running.config)));

    // The master ends: the page says so, and goes on with the next one.
    let first = running.master.take().unwrap();
    first.signal(SIGINT);
    drop(first.end());
    browser.wait("document.querySelector('#status-text').textContent.includes('waiting for the master')");
    let second = running.master.insert(Program::start(["run", running.config.to_str().unwrap()]));
    second.await_text("all drives online");
    let pid = second.pid();
    browser.wait(&format!("scope.machine.pid === {pid} && scope.store.written > 100"));
    assert_eq!(browser.ask("eval document.querySelector('#status-text').textContent"), "connected");
    running.end();
}

#[test]
#[ignore = "needs chromium, node, playwright-core and the Python library mcap"]
fn shown_signals_are_exported_to_csv_and_to_mcap() {
    let mut running = Running::start(41, 2, false);
    let browser = &mut running.browser;
    browser.ask("click #run");
    browser.wait("scope.view.held");
    let seen = browser.ask(
        "eval (() => { const { view } = scope; const [first, last] = view.range; const { data } = view; \
         const position = scope.valueAt(scope.plots[0].signals[1], view.to); \
         return [last - first, data.cycle(first), data.cycle(last - 1), position]; })()",
    );
    let [count, first, last, position] = [0, 1, 2, 3].map(|place| seen[place].as_f64().unwrap());
    let [csv, mcap] = ["seen.csv", "seen.mcap"].map(|file| running.machine.path(file));
    let name = browser.ask(&format!("save #csv {}", csv.display()));
    assert!(name.as_str().unwrap().ends_with(".csv"), "{name}");
    let text = std::fs::read_to_string(&csv).unwrap();
    let lines: Vec<Vec<&str>> = text.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(lines[0][..4], ["time [s]", "cycle", "\"d0 demand [mm]\"", "\"d0 position [mm]\""]);
    assert_eq!(lines.len() as f64, count + 1.0);
    let number = |line: usize, column: usize| lines[line][column].parse::<f64>().unwrap();
    assert_eq!((number(1, 1), number(lines.len() - 1, 1)), (first, last));
    assert_eq!(number(lines.len() - 1, 3), position);

    browser.ask(&format!("save #mcap {}", mcap.display()));
    let read = read_mcap(&mcap);
    assert_eq!(read["topics"], json!(["/axes/d0", "/axes/d1", "/cycle"]));
    assert_eq!(read["messages"].as_f64(), Some(3.0 * count));
    assert_eq!((read["first"].as_f64(), read["last"].as_f64()), (Some(first), Some(last)));
    assert_eq!(read["position"].as_f64(), Some(position));
    let age = read["age_s"].as_f64().unwrap();
    assert!((0.0..3600.0).contains(&age), "its times are dates: {age} s ago");
    running.end();
}

/// What the Python library reads of a file, by its index and without it.
fn read_mcap(path: &Path) -> Value {
    let script = "import json, sys, time\n\
        from mcap.reader import make_reader, NonSeekingReader\n\
        seekable = list(make_reader(open(sys.argv[1], 'rb')).iter_messages())\n\
        plain = list(NonSeekingReader(open(sys.argv[1], 'rb')).iter_messages())\n\
        assert len(seekable) == len(plain), (len(seekable), len(plain))\n\
        assert make_reader(open(sys.argv[1], 'rb')).get_summary().statistics.message_count == len(plain)\n\
        assert all(schema.encoding == 'jsonschema' for schema, _, _ in plain)\n\
        of = [json.loads(m.data) for _, c, m in seekable if c.topic == '/axes/d0']\n\
        units = {c.metadata['unit_position'] for _, c, _ in plain if c.topic == '/axes/d0'}\n\
        assert units == {'mm'}, units\n\
        print(json.dumps({'topics': sorted({c.topic for _, c, _ in plain}), 'messages': len(plain), \
        'first': of[0]['cycle'], 'last': of[-1]['cycle'], 'position': of[-1]['position'], \
        'age_s': time.time() - seekable[-1][2].log_time / 1e9}))\n";
    let python = checkout("target/peers/python/bin/python3");
    let output = Command::new(python).args(["-c", script]).arg(path).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
#[ignore = "needs chromium, node and playwright-core"]
fn more_than_four_axes_are_envelopes_and_are_so_marked() {
    let mut running = Running::start(42, 5, false);
    let browser = &mut running.browser;
    let show = |axes: usize| {
        format!(
            "eval (scope.plots[0].change(scope.machine.signals.flatMap( \
             (signal, id) => signal.name === 'position' ? [id] : []).slice(0, {axes})), true)"
        )
    };
    let says = |text: &str| format!("document.querySelector('#resolution').textContent === '{text}'");
    let head = |browser: &mut Browser, file: &Path| {
        browser.ask(&format!("save #csv {}", file.display()));
        std::fs::read_to_string(file).unwrap().lines().next().unwrap().to_owned()
    };
    browser.wait(&says("each cycle"));
    browser.ask(&show(5));
    // Of whole cycles within 10 ms; a single one is no envelope.
    let period_ms = carried() / MS;
    let (cycles, is_envelope) = (10 / period_ms, 10 / period_ms > 1);
    let several = format!("least and greatest of {} ms", cycles * period_ms);
    browser.wait(&says(if is_envelope { &several } else { "each cycle" }));
    browser.wait(
        "scope.plots[0].uplot.data.length === 6 && scope.plots[0].uplot.data[5].some((y) => y !== null)",
    );
    let file = running.machine.path("seen.csv");
    assert_eq!(head(browser, &file).contains("d4 position [mm] min\""), is_envelope);
    // And back: as soon as none of the envelopes is seen any more.
    browser.ask(&show(4));
    browser.wait(&says("each cycle"));
    browser.wait("!scope.store.hasEnvelopes(...scope.view.range)");
    let head = head(browser, &file);
    assert!(head.contains("d3 position [mm]\"") && !head.contains("d4") && !head.contains("min"), "{head}");
    running.end();
}

#[test]
#[ignore = "needs chromium, node and playwright-core"]
fn lost_frames_and_late_cycles_are_shown() {
    // Each cycle is late, with such a bound.
    let mut running = Running::with(45, 4, false, "late = \"1us\"");
    let browser = &mut running.browser;
    let late = "document.querySelectorAll('#late li:not(.none)').length";
    browser.wait(&format!("{late} > 10"));
    assert!(
        browser.number("parseInt(document.querySelector('#late-count').textContent)") >= browser.number(late)
    );
    browser.wait("[...document.querySelectorAll('#late li')].every((line) => line.lastChild.textContent)");
    assert_eq!(browser.ask("eval document.querySelector('#lost').hidden"), true);
    // All signals, and nobody who reads them.
    browser.ask(
        "eval (scope.machine.signals.forEach((_, id) => id % 8 || scope.addPlot( [0, 1, 2, 3, 4, 5, 6, \
         7].map((more) => id + more).filter((id) => scope.machine.signals[id]?.name))), scope.changed(), \
         true)",
    );
    let lost = "document.querySelector('#lost')";
    let is_lost = [5, 10, 20, 40].into_iter().any(|seconds| {
        browser.ask(&format!(
            "eval (() => {{ const begun = Date.now(); while (Date.now() - begun < {seconds}000); \
             return (globalThis.ended = Date.now()); }})()"
        ));
        // Whatever came meanwhile has been read.
        browser.wait(
            "Number(BigInt(scope.machine.epoch_ns) / 1000000n) + scope.store.newestTime * 1000 > ended + 100",
        );
        browser.ask(&format!("eval {lost}.textContent")).as_str().unwrap().contains("frames lost")
    });
    assert!(is_lost);
    assert_eq!(browser.ask(&format!("eval {lost}.hidden")), false);
    running.end();
}

/// Pictures of the page are kept below `target/scope`.
#[test]
#[ignore = "needs chromium, node and playwright-core"]
fn the_page_fits_a_telephone_and_a_desk_in_both_schemes() {
    let mut running = Running::start(46, 2, true);
    let browser = &mut running.browser;
    browser.wait("scope.plots[0].uplot.data[0].length > 100");
    let pictures = checkout("target/scope");
    std::fs::create_dir_all(&pictures).unwrap();
    for (width, height) in [(400, 800), (1280, 900)] {
        for scheme in ["light", "dark"] {
            let file = pictures.join(format!("{width}x{height}-{scheme}.png"));
            browser.ask(&format!("look {} {width} {height} {scheme}", file.display()));
            let what = format!("{width}x{height} {scheme}");
            assert_eq!(browser.number("innerWidth"), f64::from(width), "{what}");
            let widest = browser.number("document.documentElement.scrollWidth");
            assert!(widest <= f64::from(width), "{what}: {widest}");
            for button in ["#run", "#stop"] {
                let places = browser.ask(&format!(
                    "eval (() => {{ const {{ left, right }} = document.querySelector('{button}') \
                     .getBoundingClientRect(); return [left, right]; }})()"
                ));
                let [left, right] = [0, 1].map(|place| places[place].as_f64().unwrap());
                assert!(
                    0.0 <= left && left < right && right <= f64::from(width),
                    "{what} {button}: {places}"
                );
            }
        }
    }
    running.end();
}

#[test]
#[ignore = "needs node"]
fn trigger_and_cursors_find_what_they_are_set_to() {
    // A copy: whatever its age, node takes files for modules that a package calls so.
    let copy = tempfile::tempdir().unwrap();
    std::fs::write(copy.path().join("package.json"), r#"{ "type": "module" }"#).unwrap();
    for of in ["tests/scope", "crates/scope/src/assets"] {
        std::fs::create_dir_all(copy.path().join(of)).unwrap();
        for file in std::fs::read_dir(checkout(of)).unwrap().map(|entry| entry.unwrap().path()) {
            std::fs::copy(&file, copy.path().join(of).join(file.file_name().unwrap())).unwrap();
        }
    }
    let mut node = Command::new("node");
    node.arg("--test").arg(copy.path().join("tests/scope/assets.mjs"));
    let output = node.output().unwrap_or_else(|error| panic!("{node:?}: {error}; .ci/run installs it"));
    let [out, err] = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    assert!(output.status.success(), "{out}{err}");
}

/// From here on the page counts the stops that it sends, and reads nothing until `readOn`.
const HOLD: &str = "eval (() => { const { send } = WebSocket.prototype; \
    const held = []; \
    let socket, read; \
    globalThis.stops = 0; \
    WebSocket.prototype.send = function (text) { \
        if (!socket) { \
            [socket, read] = [this, this.onmessage]; \
            socket.onmessage = (message) => held.push(message); \
        } \
        stops += text.includes('stop'); \
        send.call(this, text); \
    }; \
    globalThis.readOn = () => { \
        WebSocket.prototype.send = send; \
        socket.onmessage = read; \
        return held.map(read).length; \
    }; \
    return true; })()";

#[test]
#[ignore = "needs chromium, node and playwright-core"]
fn a_page_with_control_commands_an_axis_and_stops_it_when_it_leaves() {
    let mut running = Running::start(43, 1, true);
    let browser = &mut running.browser;
    assert_eq!(browser.ask("eval document.querySelector('#access').textContent"), "control");
    // The token leaves the address, and nothing keeps it that other ports or later pages see.
    assert_eq!(browser.ask("eval location.hash + location.search + document.cookie"), "");
    assert_eq!(
        browser.ask("eval JSON.stringify({ ...localStorage, ...sessionStorage }).includes('token')"),
        false
    );
    browser.ask("click #take");
    browser.wait("!document.querySelector('#orders').hidden");
    browser.wait("document.querySelector('#operated').options.length === 1");
    let state = "document.querySelector('#axes td.state').textContent";
    browser.ask("click [data-order=enable]");
    browser.wait(&format!("{state}.includes('OperationEnabled')"));
    browser.ask("click [data-order=home]");
    browser.wait("document.querySelector('#notice').textContent.includes('home')");
    browser.wait("document.querySelector('#events').innerText.includes('home (command')");
    // The stop is sent while other requests are under way, and those after it are answered.
    browser.ask("set #distance 300");
    browser.ask("click [data-step='1']");
    browser.ask("click #stop");
    browser.wait("document.querySelector('#events').innerText.includes('stop (command')");
    browser.wait("document.querySelector('#operator').textContent.startsWith('by page')");
    // Another one is sent although the page has not read the answer to the first.
    browser.ask(HOLD);
    browser.ask("click #stop");
    browser.wait("stops === 1");
    browser.wait("(globalThis.sentAt ??= performance.now()) + 100 < performance.now()");
    browser.ask("click #stop");
    browser.wait("stops === 2");
    browser.ask("eval readOn()");
    browser.ask("click #take");
    browser.wait(&format!("!{state}.includes('OperationEnabled')"));
    browser.wait("document.querySelector('#orders').hidden");
    running.end();
}

/// A page whose browser is stopped asks no more, and has left.
#[test]
#[ignore = "needs chromium, node and playwright-core"]
fn an_operator_whose_browser_dies_leaves_a_stopped_axis() {
    let mut running = Running::start(44, 1, true);
    let browser = &mut running.browser;
    browser.ask("click #take");
    browser.wait("document.querySelector('#operated').options.length === 1");
    browser.ask("click [data-order=enable]");
    browser.wait("document.querySelector('#axes td.state').textContent.includes('OperationEnabled')");
    let Running { browser, config, master, .. } = running;
    drop(browser);
    let is_off = || {
        let status = crate::support::run(["status", config.to_str().unwrap(), "--json"]).expect(0).json();
        status["summary"]["drives"][0]["state"] != "OperationEnabled"
    };
    assert!(until(LONG, is_off));
    let master = master.unwrap();
    master.signal(SIGINT);
    assert_eq!(master.end().code, Some(0));
}
