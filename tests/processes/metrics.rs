//! `--metrics`: the numbers of a running master over HTTP, and clients that mean no good.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};

use fieldbeat::Master;
use fieldbeat::telemetry::metrics::Endpoint;
use fieldbeat::telemetry::{Status, Summary};

use super::support::{LONG, Machine, Program, carried, until};
use super::{assert_silent, finish, master, online, socket, with_drives};

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
    page_as(address, "application/openmetrics-text", "application/openmetrics-text; version=1.0.0;")
}

/// The page of this type, for a client that accepts this.
fn page_as(address: SocketAddr, accepts: &str, kind: &str) -> String {
    let request = format!("GET /metrics HTTP/1.1\r\nHost: localhost\r\nAccept: {accepts}\r\n\r\n");
    let answer = ask(address, request.as_bytes());
    let (head, body) = answer.split_once("\r\n\r\n").unwrap_or_else(|| panic!("no answer: {answer}"));
    assert!(head.starts_with("HTTP/1.1 200 OK\r\n"), "{head}");
    assert!(head.contains(&format!("\r\nContent-Type: {kind}")), "{head}");
    assert!(head.contains(&format!("\r\nContent-Length: {}\r\n", body.len())), "{head}");
    body.to_owned()
}

/// The value of each sample of a page. Its form is held by the parsers of Prometheus.
#[derive(Debug, Default)]
pub struct Page {
    samples: BTreeMap<String, f64>,
}

impl Page {
    pub fn parse(text: &str) -> Page {
        let body = text.strip_suffix("# EOF\n").expect("whole");
        let samples = body.lines().filter(|line| !line.starts_with('#')).map(|line| {
            let (key, value) = line.rsplit_once(' ').unwrap();
            (key.to_owned(), value.parse().unwrap_or_else(|_| panic!("{line}")))
        });
        Page { samples: samples.collect() }
    }

    /// How many samples have this in their keys.
    pub fn count(&self, part: &str) -> usize {
        self.samples.keys().filter(|key| key.contains(part)).count()
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
fn a_scrape_has_the_numbers_of_the_later_summary() {
    let (machine, config, _sim) = with_drives(70, 2);
    let mut program = online(&config, &["--json", "--metrics", &format!("{}:0", machine.ip(1))]);
    let address = endpoint(&mut program);
    assert_eq!(address.ip(), machine.ip(1));
    assert!(!program.err().contains("anyone on that network"), "{}", program.err());
    let first = Page::parse(&scrape(address));
    let plain = page_as(address, "*/*", "text/plain; version=0.0.4;");
    assert!(plain.contains("# TYPE fieldbeat_cycles_executed_total counter\n"), "{plain}");
    let mut second = Page::default();
    let passed = until(LONG, || {
        second = Page::parse(&scrape(address));
        let cycles = |page: &Page| page.value("fieldbeat_cycles_executed_total");
        // The telemetry may begin later than the loop.
        let of_drive = |name| format!("fieldbeat_drive_round_trip_seconds_count{{drive=\"{name}\"}}");
        cycles(&second) >= cycles(&first) + 100.0
            && ["d0", "d1"].iter().all(|name| second.value(&of_drive(name)) > 0.0)
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
    assert_eq!((second.count("_not_connected"), second.count("_protocol_events")), (2, 2));
    let summary = finish(program);
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
fn silent_or_malformed_clients_disturb_no_other_client() {
    let (machine, config, _sim) = with_drives(71, 1);
    let mut program = online(&config, &["--json", "--metrics", &format!("{}:0", machine.ip(1))]);
    let address = endpoint(&mut program);
    let answer = ask(address, b"GET /metrics HTTP/1.1\r\nHost: evil.example\r\n\r\n");
    assert!(answer.starts_with("HTTP/1.1 403 "), "{answer}");
    // More than are served at a time.
    let silent: Vec<TcpStream> = (0..400).map(|_| connect(address)).collect();
    // Those that ask and take nothing are as silent.
    let requests = |mut stream: &TcpStream| stream.write_all(b"GET /metrics HTTP/1.0\r\n\r\n");
    silent[350..].iter().for_each(|stream| drop(requests(stream)));
    let gone = connect(address);
    gone.shutdown(std::net::Shutdown::Both).unwrap();
    Page::parse(&scrape(address));
    drop(silent);
    finish(program);
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
fn metrics_listen_on_request_only_and_a_public_address_is_warned_of() {
    let (machine, config, _sim) = with_drives(73, 1);
    let has_thread = |program: &Program| {
        let mut tasks = std::fs::read_dir(format!("/proc/{}/task", program.pid())).unwrap();
        let comm = |task: std::io::Result<std::fs::DirEntry>| task.unwrap().path().join("comm");
        tasks.any(|task| std::fs::read_to_string(comm(task)).is_ok_and(|name| name == "fb-metrics\n"))
    };
    let closed = online(&config, &["--json"]);
    assert!(!has_thread(&closed));
    finish(closed);
    let mut open = online(&config, &["--json", "--metrics", "0.0.0.0:0"]);
    assert!(has_thread(&open));
    let port = endpoint(&mut open).port();
    open.await_text("fieldbeat: anyone on that network can read the metrics");
    Page::parse(&scrape((machine.ip(9), port).into()));
    finish(open);
}

#[test]
fn a_program_of_its_own_watches_its_machine_and_closes_the_endpoint() {
    let (machine, config, _sim) = with_drives(75, 1);
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
