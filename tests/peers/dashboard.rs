//! The dashboard of `rt-config/grafana`: its structure, and Prometheus, which scrapes a demo and answers every query of
//! it, and checks the alerts.

use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::net::{SocketAddrV4, TcpStream};
use std::process::Command;
use std::time::Duration;

use libc::{SIGCONT, SIGINT};
use serde_json::Value;

use crate::support::{LONG, Machine, Program, checkout, until};

fn dashboard() -> Value {
    let text = std::fs::read_to_string(checkout("rt-config/grafana/fieldbeat.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

fn panels(dashboard: &Value) -> Vec<&Value> {
    dashboard["panels"].as_array().unwrap().iter().collect()
}

/// The queries: title of the panel, expression, and whether it is one of buckets.
fn queries(dashboard: &Value) -> Vec<(String, String, bool)> {
    let mut all = Vec::new();
    for panel in panels(dashboard) {
        for target in panel["targets"].as_array().into_iter().flatten() {
            let title = panel["title"].as_str().unwrap().to_owned();
            let expression = target["expr"].as_str().unwrap().to_owned();
            all.push((title, expression, target["format"] == "heatmap"));
        }
    }
    all
}

#[test]
fn the_dashboard_has_the_structure_that_grafana_reads() {
    let dashboard = dashboard();
    let (mut ids, mut places) = (BTreeSet::new(), Vec::new());
    for panel in panels(&dashboard) {
        assert!(ids.insert(panel["id"].as_u64().unwrap()), "{panel}");
        let of = |key: &str| panel["gridPos"][key].as_u64().unwrap();
        let (x, y, w, h) = (of("x"), of("y"), of("w"), of("h"));
        assert!(x + w <= 24, "{panel}");
        let apart = |(ox, oy, ow, oh): &(u64, u64, u64, u64)| {
            x >= ox + ow || *ox >= x + w || y >= oy + oh || *oy >= y + h
        };
        assert!(places.iter().all(apart), "{} lies over another", panel["title"]);
        places.push((x, y, w, h));
        if panel["type"] == "row" {
            continue;
        }
        assert!(!panel["description"].as_str().unwrap().is_empty(), "{panel}");
        let mut letters = BTreeSet::new();
        for target in panel["targets"].as_array().unwrap() {
            assert!(letters.insert(target["refId"].as_str().unwrap()), "{panel}");
            assert_eq!(target["datasource"]["uid"], "${datasource}", "of whoever imports it");
        }
        assert!(!letters.is_empty(), "{panel}");
    }
    let variables = dashboard["templating"]["list"].as_array().unwrap();
    let names: Vec<&str> = variables.iter().map(|variable| variable["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["datasource", "instance", "drive"]);
    assert_eq!(variables[0]["type"], "datasource");
    // Every query can be restricted to a master.
    for (title, expression, _) in queries(&dashboard) {
        assert!(expression.contains("instance=~\"$instance\""), "{title}: {expression}");
    }
}

/// What `GET path` is answered with, by a local server.
fn get(server: SocketAddrV4, path: &str) -> Option<Value> {
    let mut stream = TcpStream::connect(server).ok()?;
    // Of version 1.0, so that the answer ends with its connection.
    write!(stream, "GET {path} HTTP/1.0\r\nHost: {server}\r\n\r\n").ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    serde_json::from_str(answer.split_once("\r\n\r\n")?.1).ok()
}

/// As a part of an address.
fn encoded(text: &str) -> String {
    text.bytes().map(|byte| format!("%{byte:02X}")).collect()
}

/// The results of an expression; `None`: it was not answered.
fn query(server: SocketAddrV4, expression: &str) -> Option<Vec<Value>> {
    let answer = get(server, &format!("/api/v1/query?query={}", encoded(expression)))?;
    assert_eq!(answer["status"], "success", "{expression}: {answer}");
    answer["data"]["result"].as_array().cloned()
}

#[test]
#[ignore = "needs prometheus"]
fn prometheus_answers_every_query_of_the_dashboard() {
    let machine = Machine::new(91);
    // Of this machine alone: nobody else takes a port there meanwhile.
    let [metrics, prometheus] = [19_464, 19_090].map(|port| SocketAddrV4::new(machine.ip(1), port));
    let words = format!("demo --for 10min --drives 2 --period 16ms --metrics {metrics}");
    let mut demo = Program::start(words.split(' '));
    demo.await_text("all drives online");
    let config = machine.write(
        "prometheus.yml",
        format!(
            "global: {{ scrape_interval: 1s }}\nrule_files: [{}]\nscrape_configs:\n  - job_name: \
             fieldbeat\n    static_configs: [{{ targets: [\"{metrics}\"] }}]\n",
            checkout("rt-config/grafana/alerts.yml").display()
        ),
    );
    let _server = Program::spawn(
        Command::new("prometheus")
            .arg(format!("--config.file={}", config.display()))
            .arg(format!("--storage.tsdb.path={}", machine.path("data").display()))
            .arg(format!("--web.listen-address={prometheus}")),
    );
    // As Grafana fills them in, with an interval of several scrapes.
    let filled = |expression: &str| {
        let all = [("$instance", ".*"), ("$drive", ".*"), ("$__rate_interval", "20s")];
        all.iter().fold(expression.to_owned(), |text, (name, value)| text.replace(name, value))
    };
    let rate = "rate(fieldbeat_cycles_executed_total[20s]) > 0";
    let await_some = |expression: &str| {
        let has = || query(prometheus, expression).is_some_and(|results| !results.is_empty());
        assert!(until(LONG, has), "{expression}: nothing");
    };
    await_some(rate);
    // A host that is never late would have no causes to count by.
    demo.hold();
    std::thread::sleep(Duration::from_millis(200));
    demo.signal(SIGCONT);
    await_some("fieldbeat_late_cycles_explained_total > 0");
    let drives = ["a1", "a2", "k1", "k2", "l1", "l2", "m1", "m2", "u1", "u2"].map(String::from);
    for (title, expression, buckets) in queries(&dashboard()) {
        let mut results = Vec::new();
        until(LONG, || {
            results = query(prometheus, &filled(&expression)).unwrap_or_default();
            !results.is_empty()
        });
        assert!(!results.is_empty(), "{title}: {expression}: nothing");
        let numbers: Vec<f64> =
            results.iter().map(|result| result["value"][1].as_str().unwrap().parse().unwrap()).collect();
        // A quantile of no samples is NaN: of a drive without round trips.
        let expected = |number: &f64| *number >= 0.0 || (number.is_nan() && expression.contains("quantile"));
        assert!(numbers.iter().all(expected), "{title}: {expression}: {numbers:?}");
        let labels = |name: &str| -> BTreeSet<String> {
            results.iter().filter_map(|result| Some(result["metric"][name].as_str()?.to_owned())).collect()
        };
        if buckets {
            assert!(labels("le").len() > 5 && labels("le").contains("+Inf"), "{title}: {results:?}");
        } else if expression.contains("drive=~") && !expression.starts_with("sum(") {
            let named = labels("drive");
            assert!(
                !named.is_empty() && named.iter().all(|name| drives.contains(name)),
                "{title}: {named:?}"
            );
        }
    }
    let cycles = query(prometheus, "fieldbeat_cycle_period_seconds").unwrap();
    assert_eq!(cycles[0]["value"][1], "0.016");
    let rules = get(prometheus, "/api/v1/rules").unwrap();
    let rules = rules["data"]["groups"][0]["rules"].as_array().unwrap().clone();
    assert_eq!(rules.len(), 5, "{rules:?}");
    assert!(rules.iter().all(|rule| rule["health"] != "err"), "{rules:?}");
    demo.end_by(SIGINT);
}
