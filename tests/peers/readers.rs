//! What programs that others wrote make of what we write for them: HdrHistogram's JavaScript port of our distributions,
//! and the parsers of Prometheus' Python client of our metrics. `.ci/run` installs both below `target/peers`.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::{Command, Stdio};

use crate::support::{LONG, Machine, Program, checkout, simulated, until};
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::telemetry::{Histograms, Peak, Quantity};
use fieldbeat::time::MS;
use fieldbeat_core::cycle::record::{CycleRecord, DriveRecord, Record, measured};
use fieldbeat_record::hgrm::distribution;
use libc::SIGINT;

/// What `command` prints about `input`.
fn tell(command: &mut Command, input: &str) -> String {
    let mut child = (command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn())
        .unwrap_or_else(|error| panic!("{command:?}: {error}; .ci/run installs it"));
    child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Latencies with a long tail. Their number is prime, so that no quantile falls between two of them, where the last bit
/// of a division decides; the largest is the upper end of its bin.
fn samples() -> Vec<u64> {
    let mut random = fastrand::Rng::with_seed(7);
    let tail = |random: &mut fastrand::Rng| (20_000.0 * (6.0 * random.f64().powi(8)).exp()) as u64;
    (1..10_007).map(|_| tail(&mut random) + random.u64(..5_000)).chain([(1 << 24) - 1]).collect()
}

/// Our distribution of the samples, as latencies of the loop or as round trips of a drive, and that of the other
/// implementation with so many digits.
fn distributions(digits: u8, quantity: impl Fn(&Histograms) -> &Quantity) -> (String, String) {
    let samples = samples();
    let mut histograms = Histograms::new(1);
    for ns in &samples {
        let cycle = CycleRecord { wake_ns: u32::try_from(*ns).unwrap(), ..CycleRecord::default() };
        let drive = DriveRecord { rtt_ns: measured(*ns), ..DriveRecord::default() };
        histograms.enter(&Record::Cycle(cycle), MS);
        histograms.enter(&Record::Drive(drive), MS);
    }
    let ours = distribution(quantity(&histograms), Peak { ns: *samples.last().unwrap(), index: 10_006 });
    let script = format!(
        "const h = require('hdr-histogram-js').build({{ lowestDiscernibleValue: 1, highestTrackableValue: \
         60000000, numberOfSignificantValueDigits: {digits}, bitBucketSize: 64 }}); \
         require('fs').readFileSync(0, 'utf8').trim().split('\\n').forEach((ns) => \
         h.recordValue(Number(ns))); process.stdout.write(h.outputPercentileDistribution(5, 1000));"
    );
    let lines: String = samples.iter().map(|ns| format!("{ns}\n")).collect();
    let mut node = Command::new("node");
    let theirs =
        tell(node.args(["-e", &script]).env("NODE_PATH", checkout("target/peers/node_modules")), &lines);
    (ours, theirs)
}

#[test]
#[ignore = "needs node and hdr-histogram-js"]
fn distributions_of_the_loop_are_those_of_another_implementation() {
    let (ours, theirs) = distributions(3, |histograms| &histograms.wake);
    assert_eq!(ours, theirs);
}

/// They have as many decimals as digits, we always have those of a nanosecond.
#[test]
#[ignore = "needs node and hdr-histogram-js"]
fn distributions_of_drives_are_those_of_another_implementation() {
    let numbers = |text: &str| -> Vec<Vec<f64>> {
        let numbers = |line: &str| {
            line.split_whitespace().filter_map(|word| word.trim_matches([',', ']']).parse().ok()).collect()
        };
        text.lines().map(numbers).collect()
    };
    let (ours, theirs) = distributions(2, |histograms| &histograms.drives[0].rtt);
    let (ours, theirs) = (numbers(&ours), numbers(&theirs));
    assert_eq!(ours.len(), theirs.len());
    for (ours, theirs) in ours.iter().zip(&theirs) {
        assert_eq!(ours.len(), theirs.len());
        assert!(ours.iter().zip(theirs).all(|(a, b)| (a - b).abs() <= 0.005 + 1e-9), "{ours:?} {theirs:?}");
    }
}

#[test]
#[ignore = "needs python3 and prometheus_client"]
fn the_parsers_of_prometheus_read_the_metrics() {
    let machine = Machine::new(40);
    let config = machine.showing();
    let _sim = SimServer::start(simulated(&config), ServerOptions::default()).unwrap();
    let endpoint = format!("{}:9464", machine.ip(1));
    let run = ["run", config.to_str().unwrap(), "--metrics", &endpoint];
    let mut program = Program::start(run);
    program.await_text("all drives online");
    let page = |accepted: &str| {
        let mut stream = TcpStream::connect(&endpoint).unwrap();
        let request = format!("GET /metrics HTTP/1.1\r\nHost: {endpoint}\r\nAccept: {accepted}\r\n\r\n");
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer.split_once("\r\n\r\n").map(|(_, page)| page.to_owned()).unwrap()
    };
    assert!(until(LONG, || page("*/*").contains("drive-timer")), "{}", page("*/*"));
    let (strict, plain) = (page("application/openmetrics-text"), page("text/plain"));
    program.end_by(SIGINT).expect(0);
    // The strict one of OpenMetrics, and that of the older format, which many agents still speak.
    let script = "import sys\nfrom prometheus_client.openmetrics import parser as strict\nfrom \
         prometheus_client import parser as old\npage, plain = sys.stdin.read().split('# BEHIND\\n')\nfor \
         family in strict.text_string_to_metric_families(page):\n\x20   for sample in family.samples: \
         print(sample.name, sample.labels.get('drive', '-'), family.type)\nfor family in \
         old.text_string_to_metric_families(plain):\n\x20   for sample in family.samples: print('old', \
         sample.name, family.type)\n";
    let python = checkout("target/peers/python/bin/python3");
    let reported = tell(Command::new(python).args(["-c", script]), &format!("{strict}# BEHIND\n{plain}"));
    for line in [
        "fieldbeat_cycles_executed_total - counter",
        "fieldbeat_wake_up_seconds_bucket - histogram",
        "fieldbeat_drive_round_trip_seconds_count d1 histogram",
        "fieldbeat_axes_online - gauge",
        "fieldbeat_loop_info - info",
        "fieldbeat_drive_monitor d1 gauge",
        "fieldbeat_drive_monitor_max d1 gauge",
        "old fieldbeat_drive_requests_sent_total counter",
        "old fieldbeat_stage_seconds_bucket histogram",
        "old fieldbeat_loop_info gauge",
    ] {
        assert!(reported.lines().any(|reported| reported == line), "no \"{line}\": {reported}");
    }
}
