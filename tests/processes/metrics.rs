//! `--metrics`: the numbers of a running master over HTTP, and clients that mean no good.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::time::Duration;

use fieldbeat::axis::Link;
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
use fieldbeat::bus::modbus::{ModbusPlan, UnidriveDrive};
use fieldbeat::sim::SimPlan;
use fieldbeat::sim::modbus::Unidrives;
use fieldbeat::telemetry::Status;
use fieldbeat::telemetry::Summary;
use fieldbeat::telemetry::metrics::Endpoint;
use fieldbeat::time::MS;
use fieldbeat::{CyclePlan, Master, Overrun, Plan, Realtime};
use fieldbeat_modbus::counters::OWN;
use libc::SIGINT;

use super::support::{LONG, Machine, Program, assert_sums, carried, patient, served, until};
use super::{assert_silent, master, serve, socket};

/// Where the endpoint is, by what the program says.
pub fn endpoint(program: &mut Program) -> SocketAddr {
    program.await_text("/metrics\n");
    let err = program.err();
    let address = err.split("metrics at http://").nth(1).and_then(|rest| rest.split('/').next());
    address.and_then(|address| address.parse().ok()).unwrap_or_else(|| panic!("{err}"))
}

fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(LONG)).unwrap();
    stream
}

/// Everything that is answered to `request`.
fn ask(address: SocketAddr, request: &[u8]) -> String {
    let mut stream = connect(address);
    stream.write_all(request).unwrap();
    let mut text = String::new();
    // A reset after the answer is no concern: it tells of bytes that nobody wanted to read.
    let _ = stream.read_to_string(&mut text);
    text
}

/// The page.
pub fn scrape(address: SocketAddr) -> String {
    let answer = ask(address, b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nAccept: */*\r\n\r\n");
    let (head, body) = answer.split_once("\r\n\r\n").unwrap_or_else(|| panic!("no answer: {answer}"));
    assert!(head.starts_with("HTTP/1.1 200 OK\r\n"), "{head}");
    assert!(head.contains("\r\nContent-Type: application/openmetrics-text; version=1.0.0;"), "{head}");
    assert!(head.contains(&format!("\r\nContent-Length: {}\r\n", body.len())), "{head}");
    body.to_owned()
}

/// A page by the rules of the format: the type of each family, and the value of each sample.
#[derive(Debug, Default)]
pub struct Page {
    types: BTreeMap<String, String>,
    samples: BTreeMap<String, f64>,
}

impl Page {
    pub fn parse(text: &str) -> Page {
        let body = text.strip_suffix("# EOF\n").expect("whole");
        let mut page = Page::default();
        let mut family = String::new();
        for line in body.lines() {
            let words: Vec<&str> = line.splitn(4, ' ').collect();
            match words[..] {
                ["#", "HELP", name, help] => {
                    assert!(name.starts_with("fieldbeat_") && !help.is_empty(), "{line}");
                    family = name.to_owned();
                }
                ["#", "TYPE", name, kind] => {
                    assert_eq!(name, family);
                    assert!(page.types.insert(name.to_owned(), kind.to_owned()).is_none(), "twice: {line}");
                }
                ["#", "UNIT", name, unit] => {
                    assert!(name == family && name.ends_with(&format!("_{unit}")), "{line}");
                }
                _ => {
                    let (key, value) = line.rsplit_once(' ').unwrap();
                    let name = key.split('{').next().unwrap();
                    let suffixes: &[&str] = match page.types[&family].as_str() {
                        "counter" => &["_total"],
                        "gauge" => &[""],
                        "info" => &["_info"],
                        "histogram" => &["_sum", "_count", "_bucket"],
                        other => panic!("{other}"),
                    };
                    assert!(suffixes.iter().any(|suffix| name == format!("{family}{suffix}")), "{line}");
                    let value = value.parse().unwrap_or_else(|_| panic!("{line}"));
                    assert!(page.samples.insert(key.to_owned(), value).is_none(), "twice: {line}");
                }
            }
        }
        page
    }

    pub fn value(&self, key: &str) -> f64 {
        *self.samples.get(key).unwrap_or_else(|| panic!("no {key}: {:?}", self.samples.keys()))
    }

    /// The buckets of a histogram with these labels, cumulated; the last is all of them.
    fn buckets(&self, family: &str, labels: &str) -> Vec<f64> {
        let own = if labels.is_empty() { String::new() } else { format!(",{labels}") };
        let mut buckets: Vec<(f64, f64)> = (self.samples.iter())
            .filter_map(|(key, count)| {
                let le = key.strip_prefix(family)?.strip_prefix("_bucket{le=\"")?;
                let (le, rest) = le.split_once('"')?;
                (rest == format!("{own}}}")).then(|| (le.replace("+Inf", "inf").parse().unwrap(), *count))
            })
            .collect();
        buckets.sort_by(|a, b| a.0.total_cmp(&b.0));
        assert!(buckets.is_sorted_by(|a, b| a.1 <= b.1), "{family}: {buckets:?}");
        let (end, all) = *buckets.last().unwrap_or_else(|| panic!("no {family} {labels}"));
        let braces = if labels.is_empty() { String::new() } else { format!("{{{labels}}}") };
        assert_eq!((end, all), (f64::INFINITY, self.value(&format!("{family}_count{braces}"))));
        assert!((all > 0.0) == (self.value(&format!("{family}_sum{braces}")) > 0.0));
        buckets.into_iter().map(|(_, count)| count).collect()
    }
}

#[test]
fn a_scrape_tells_what_the_summary_tells_later() {
    let machine = Machine::new(70);
    let config = machine.plain(2);
    let _sim = serve(&config);
    let mut program = master(&config, &["--json", "--metrics", &format!("{}:0", machine.ip(1))]);
    program.await_text("all drives online");
    let address = endpoint(&mut program);
    assert_eq!(address.ip(), machine.ip(1));
    assert!(!program.err().contains("anyone on that network"), "{}", program.err());
    let first = Page::parse(&scrape(address));
    let mut second = Page::default();
    let passed = until(LONG, || {
        second = Page::parse(&scrape(address));
        second.value("fieldbeat_cycles_executed_total")
            >= first.value("fieldbeat_cycles_executed_total") + 100.0
    });
    assert!(passed, "the cycle goes on");
    for (key, value) in &first.samples {
        if key.contains("_total") || key.contains("_bucket") || key.contains("_max_") {
            assert!(second.value(key) >= *value, "{key} fell");
        }
    }
    assert_eq!(second.value("fieldbeat_axes_online"), 2.0);
    assert_eq!(second.value("fieldbeat_cycle_period_seconds"), carried() as f64 * 1e-9);
    for family in ["fieldbeat_wake_up_seconds", "fieldbeat_cycle_jitter_seconds"] {
        assert_eq!(second.buckets(family, "").len(), 16);
    }
    for stage in ["send", "receive", "evaluate", "commands", "prepare", "publish"] {
        second.buckets("fieldbeat_stage_seconds", &format!("stage=\"{stage}\""));
    }
    program.signal(SIGINT);
    let ended = program.end();
    ended.expect(0);
    let summary = ended.json();
    assert_sums(&summary);
    for (drive, name) in ["d0", "d1"].into_iter().enumerate() {
        let label = format!("drive=\"{name}\"");
        let rtt = *second.buckets("fieldbeat_drive_round_trip_seconds", &label).last().unwrap();
        second.buckets("fieldbeat_drive_send_jitter_seconds", &label);
        second.buckets("fieldbeat_drive_value_age_seconds", &label);
        let end = &summary["drives"][drive];
        assert!(0.0 < rtt && rtt <= end["rtt_ns"]["count"].as_f64().unwrap(), "{rtt}");
        for (counter, key) in
            [("requests_sent", "sent"), ("replies_in_time", "answered"), ("replies_missed", "missed")]
        {
            let scraped = second.value(&format!("fieldbeat_drive_{counter}_total{{{label}}}"));
            assert!(scraped <= end[key].as_f64().unwrap(), "{counter}: {scraped} of {end}");
        }
    }
}

#[test]
fn what_a_drive_shows_besides_has_a_gauge_while_it_does() {
    let machine = Machine::new(76);
    let config = machine.showing();
    let sim = serve(&config);
    let mut program = master(&config, &["--json", "--metrics", &format!("{}:0", machine.ip(1))]);
    program.await_text("all drives online");
    let address = endpoint(&mut program);
    let key = |family: &str, variable: &str, unit: &str| {
        format!("fieldbeat_drive_monitor{family}{{drive=\"d1\",variable=\"{variable}\",unit=\"{unit}\"}}")
    };
    let mut page = Page::default();
    let mut scraped = |done: &dyn Fn(&Page) -> bool| {
        let passed = until(LONG, || {
            page = Page::parse(&scrape(address));
            done(&page)
        });
        assert!(passed, "{:?}", page.samples.keys());
        std::mem::take(&mut page)
    };
    let timer = ["_min", "", "_max"].map(|family| key(family, "drive-timer", "us"));
    let page = scraped(&|page| page.samples.contains_key(&timer[1]));
    assert!(timer.iter().is_sorted_by_key(|key| page.value(key)), "{page:?}");
    for family in ["_min", "", "_max"] {
        assert_eq!(page.value(&key(family, "core-temperature", "C")), 40.0);
        assert_eq!(page.types[&format!("fieldbeat_drive_monitor{family}")], "gauge");
    }
    let shown = |page: &Page| page.samples.keys().filter(|key| key.contains("_monitor")).count();
    assert_eq!(shown(&page), 6, "neither the other drive nor a variable that there is not");
    // A drive that was lost shows nothing, and what it has shown stays true.
    sim.stop();
    let page = scraped(&|page| page.value("fieldbeat_axes_online") == 0.0);
    assert_eq!(shown(&page), 4, "{page:?}");
    assert_eq!(page.value(&key("_max", "core-temperature", "C")), 40.0);
    program.signal(SIGINT);
    program.end().expect(1);
}

#[test]
fn clients_that_say_nothing_or_nonsense_harm_nobody() {
    let machine = Machine::new(71);
    let config = machine.plain(1);
    let _sim = serve(&config);
    let mut program = master(&config, &["--json", "--metrics", &format!("{}:0", machine.ip(1))]);
    program.await_text("all drives online");
    let address = endpoint(&mut program);
    for (request, status) in [
        (&b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"[..], "404"),
        (b"DELETE /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n", "405"),
        (b"GET /metrics HTTP/1.1\r\nHost: evil.example\r\n\r\n", "403"),
        (b"GET /metrics HTTP/1.1\r\n\r\n", "400"),
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03", "400"),
        (&[b'A'; 5000], "431"),
    ] {
        let answer = ask(address, request);
        // What is too long may be answered by a reset.
        let reset = status == "431" && answer.is_empty();
        assert!(reset || answer.starts_with(&format!("HTTP/1.1 {status} ")), "{answer}");
    }
    // More than are served at a time.
    let silent: Vec<TcpStream> = (0..400).map(|_| connect(address)).collect();
    // Those that ask and take nothing are as silent.
    let asks = |mut stream: &TcpStream| stream.write_all(b"GET /metrics HTTP/1.0\r\n\r\n");
    silent[350..].iter().for_each(|stream| drop(asks(stream)));
    let gone = connect(address);
    gone.shutdown(std::net::Shutdown::Both).unwrap();
    Page::parse(&scrape(address));
    drop(silent);
    assert!(program.is_running());
    program.signal(SIGINT);
    let ended = program.end();
    ended.expect(0);
    assert_sums(&ended.json());
}

#[test]
fn a_taken_or_foreign_address_is_refused_before_anything_is_sent() {
    let machine = Machine::new(72);
    let config = machine.plain(1);
    let drive = socket(machine.drive(0));
    let taken = TcpListener::bind((machine.ip(2), 0)).unwrap();
    let taken = taken.local_addr().unwrap().to_string();
    // TEST-NET-1 of RFC 5737 is nobody's.
    for (address, parts) in [
        (taken.as_str(), ["Address already in use", "another program listens there"]),
        ("192.0.2.1:9464", ["Cannot assign requested address", "use an address of this computer"]),
        ("nowhere", ["'nowhere' for '--metrics <ADDR>'", "must be a port like 9464"]),
    ] {
        master(&config, &["--for", "1s", "--metrics", address]).end().refused(&parts);
    }
    assert_silent(&drive);
}

#[test]
fn whoever_opens_it_to_the_network_is_told() {
    let machine = Machine::new(73);
    let config = machine.plain(1);
    let _sim = serve(&config);
    let mut program = master(&config, &["--metrics", "0.0.0.0:0"]);
    let port = endpoint(&mut program).port();
    program.await_text("fieldbeat: anyone on that network can read the metrics");
    Page::parse(&scrape((machine.ip(9), port).into()));
    program.signal(SIGINT);
    program.end().expect(0);
}

#[test]
fn nothing_listens_unless_it_is_asked_to() {
    let machine = Machine::new(74);
    let config = machine.plain(1);
    let _sim = serve(&config);
    let threads = |program: &Program| -> Vec<String> {
        let tasks = std::fs::read_dir(format!("/proc/{}/task", program.pid())).unwrap();
        let names = tasks.map(|task| std::fs::read_to_string(task.unwrap().path().join("comm")).unwrap());
        names.map(|name| name.trim().to_owned()).collect()
    };
    for (arguments, listening) in [(&[][..], false), (&["--metrics", ":0"], true)] {
        let mut program = master(&config, arguments);
        program.await_text("all drives online");
        let names = threads(&program);
        assert_eq!(names.iter().any(|name| name == "fb-metrics"), listening, "{names:?}");
        program.signal(SIGINT);
        program.end().expect(0);
    }
}

#[test]
fn a_program_of_its_own_watches_its_machine_and_closes_the_endpoint() {
    let machine = Machine::new(75);
    let config = machine.plain(1);
    let _sim = serve(&config);
    let endpoint = Endpoint::bind((machine.ip(1), 0).into()).unwrap();
    let address = endpoint.address();
    let master = Master::from_file(&config).unwrap().start().unwrap();
    let monitor = master.monitor();
    let server = endpoint.serve(monitor.clone()).unwrap();
    master.wait_online(LONG).unwrap();
    let watched = std::thread::spawn(move || {
        assert!(until(LONG, || Summary::from(&monitor).drives[0].rtt_ns.count > 20));
        monitor
    });
    let monitor = watched.join().unwrap();
    Page::parse(&scrape(address));
    drop(server);
    assert!(until(LONG, || TcpStream::connect(address).is_err()), "it still listens");
    // Its address is free again at once.
    drop(Endpoint::bind(address).unwrap());

    let run = master.finish();
    // All but the times of the last cycle, which ends after it has been published.
    let counts = |status: Status| (status.planned, status.executed, status.skipped);
    assert_eq!(counts(monitor.status()), counts(run.end.status));
    let woken = monitor.measured(|measured| measured.histograms.wake.len());
    assert!(woken == run.end.status.planned || run.end.status.lost_records > 0, "{woken}: {run:?}");
}

#[test]
fn what_only_a_protocol_counts_and_why_a_drive_is_not_connected_is_told_under_its_name() {
    let machine = Machine::new(77);
    let drives = [0, 1].map(|index| {
        let mut drive = UnidriveDrive::new(format!("d{index}"), *machine.drive(index).ip());
        drive.address.set_port(1502);
        drive.axis.health = patient();
        (drive.reply_within_ns, drive.watchdog.timeout_ns) = (5_000 * MS, Some(20_000 * MS));
        drive
    });
    let bus = ModbusPlan::new(drives.to_vec());
    let plan = |bus: Box<dyn BusPlan>| Plan {
        source: None,
        cycle: CyclePlan {
            period_ns: carried(),
            realtime: Realtime::Off,
            overrun: Overrun::Skip { max_skip: u64::MAX },
            max_skip_rate: 1.0,
            ..CyclePlan::default()
        },
        buses: vec![bus],
        groups: Vec::new(),
    };
    let simulate = |count| {
        served(|| {
            let mut there = SimPlan::from(Unidrives::of(&bus)).build();
            there.drives.truncate(count);
            there
        })
    };
    // Only the first one is there.
    let sim = simulate(1);
    let master = Master::from_plan(plan(Box::new(bus.clone()))).start().unwrap();
    let online = |index: usize| master.observers()[index].1.feedback().link == Link::Online;
    assert!(until(LONG, || online(0) && master.not_connected(1).is_some()));
    let why = master.not_connected(1).unwrap();
    assert!(why.starts_with("refused: nobody listens at "), "{why}");
    let error = master.wait_online(Duration::ZERO).unwrap_err().to_string();
    assert!(error.contains(&format!(": d1 (not connected: {why}); look at")), "{error}");

    let endpoint = Endpoint::bind((machine.ip(1), 0).into()).unwrap();
    let address = endpoint.address();
    let _server = endpoint.serve(master.monitor()).unwrap();
    let sample = |metric: &str, labels: &str| {
        let text = scrape(address);
        assert!(!text.contains("NaN"), "{text}");
        Page::parse(&text).value(&format!("fieldbeat_drive_{metric}{{{labels}}}"))
    };
    let not_connected = || ["d0", "d1"].map(|drive| sample("not_connected", &format!("drive=\"{drive}\"")));
    assert_eq!(not_connected(), [0.0, 1.0]);
    let summary = Summary::from(&*master);
    assert_eq!(
        (&summary.drives[0].not_connected, summary.drives[1].not_connected.as_deref()),
        (&None, Some(why.as_str()))
    );
    assert_eq!((summary.drives[0].position, summary.drives[0].protocol_counters.0.len()), (None, OWN.len()));
    // It is reported as long as it is so.
    drop(sim);
    let _sim = simulate(2);
    assert!(until(LONG, || online(1) && not_connected() == [0.0, 0.0]));
    let reopened =
        |drive: &str| sample("protocol_events_total", &format!("drive=\"{drive}\",what=\"reopened\""));
    assert!(until(LONG, || reopened("d0") > 0.0));
    assert_eq!(reopened("d1"), 0.0);
    assert_eq!(master.finish().end.drives[1].not_connected, None);

    // Drives without connections and counters of their own have no samples of them.
    let linmots = vec![LinUdpDrive::new("x", *machine.drive(2).ip())];
    let master = Master::from_plan(plan(Box::new(LinUdpPlan::new(machine.ip(1), linmots)))).start().unwrap();
    let endpoint = Endpoint::bind((machine.ip(1), 0).into()).unwrap();
    let address = endpoint.address();
    let _server = endpoint.serve(master.monitor()).unwrap();
    let text = scrape(address);
    assert!(!text.contains("fieldbeat_drive_protocol_events_total{"), "{text}");
    assert!(!text.contains("fieldbeat_drive_not_connected{"), "{text}");
}
