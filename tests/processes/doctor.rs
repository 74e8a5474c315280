//! What the program says of this host. What it finds here is this host's, so that these tests look at the form of it,
//! at the exit code, and at what they made so themselves.

use std::process::Command;

use serde_json::Value;

use super::support::{self, CABLE_NET, Cable, Ended, Machine, PROGRAM, Program, as_ordinary_user, run};

/// The exit code is that of the verdict, and both forms end with the same one.
fn assert_consistent(ended: &Ended) -> Value {
    let report = ended.json();
    let findings = report["findings"].as_array().unwrap();
    let count = |verdict: &str| findings.iter().filter(|finding| finding["verdict"] == verdict).count();
    for verdict in ["good", "poor", "bad", "unknown"] {
        assert_eq!(report["counts"][verdict], count(verdict), "{report}");
    }
    assert_eq!(report["ready"], count("bad") == 0);
    ended.expect(if count("bad") == 0 { 0 } else { 1 });
    for finding in findings {
        for key in ["name", "found", "wanted", "why"] {
            assert!(finding[key].is_string(), "{finding}");
        }
        if finding["verdict"] == "poor" || finding["verdict"] == "bad" {
            assert!(finding["fix"].is_string(), "{finding}");
        }
    }
    report
}

fn finding<'a>(report: &'a Value, name: &str) -> &'a Value {
    let findings = report["findings"].as_array().unwrap();
    let found = findings.iter().find(|finding| finding["name"] == name);
    found.unwrap_or_else(|| panic!("no {name}: {report}"))
}

#[test]
fn a_host_is_examined_with_and_without_a_configuration() {
    let alone = assert_consistent(&run(["doctor", "--json", "--period", "2ms", "-p", "70"]));
    assert_eq!(
        (&alone["subject"]["period_ns"], &alone["subject"]["priority"]),
        (&2_000_000.into(), &70.into())
    );
    assert_eq!((&alone["subject"]["config"], &alone["measured"]), (&Value::Null, &Value::Null));

    let machine = Machine::new(31);
    let config = machine.plain(2).display().to_string();
    let whole = assert_consistent(&run(["doctor", &config, "--json"]));
    assert_eq!(whole["subject"]["config"], config.as_str());
    assert!(finding(&whole, "linudp-v2: drives")["found"].as_str().unwrap().contains("nothing to tune"));
    let text = run(["doctor", &config]);
    for part in ["kernel\n", "rights\n", "clocksource", "network\n", "linudp-v2: send buffer"] {
        assert!(text.out.contains(part), "no {part}: {}", text.out);
    }
    let verdict = text.out.lines().last().unwrap();
    assert_eq!(verdict.starts_with("ready"), text.code == Some(0), "{verdict}");
    assert_eq!(text.err, "");
}

/// All keys of an object, and of the first element of each list in it.
fn keys(value: &Value, path: &str) -> Vec<String> {
    match value {
        Value::Object(map) => {
            map.iter().flat_map(|(key, value)| keys(value, &format!("{path}.{key}"))).collect()
        }
        Value::Array(list) if !list.is_empty() => keys(&list[0], path),
        _ => vec![path.trim_start_matches('.').to_owned()],
    }
}

#[test]
fn a_user_without_rights_is_warned_and_measures_with_stable_keys() {
    let machine = Machine::new(32);
    let mut command = as_ordinary_user(&machine);
    let program = command.get_program().to_string_lossy().into_owned();
    let words = ["doctor", "--measure", "--for", "1s", "--json"];
    let ended = Program::spawn(command.args(words)).end();
    let report = assert_consistent(&ended);
    ended.expect(1);
    for (name, found) in [("scheduling", "RLIMIT_RTPRIO is 0"), ("memory lock", "RLIMIT_MEMLOCK is 64 KiB")] {
        let finding = finding(&report, name);
        assert_eq!(finding["verdict"], "bad", "{finding}");
        assert!(finding["found"].as_str().unwrap().contains(found), "{finding}");
        let fix = finding["fix"].as_str().unwrap();
        assert!(fix.contains("setcap cap_sys_nice,cap_ipc_lock+ep") && fix.contains(&program), "{finding}");
    }
    let last = ended.err.lines().last().unwrap();
    assert!(last.starts_with("fieldbeat: not ready: "), "{last}");

    let measured = &report["measured"];
    assert_eq!(measured["fifo"], false);
    let untried: Vec<&str> =
        measured["untried"].as_array().unwrap().iter().filter_map(|one| one["name"].as_str()).collect();
    assert!(untried.contains(&"SCHED_FIFO 80") && untried.contains(&"memory lock"), "{untried:?}");
    // Every slot of every period is in it, and of the plan's own period those of the other comparisons too.
    let periods = measured["periods"].as_array().unwrap();
    assert_eq!(periods.len(), 5);
    for period in periods {
        assert!(period["late"].as_u64() <= period["cycles"].as_u64(), "{period}");
        assert!(period["at_most"].as_f64() >= period["share"].as_f64(), "{period}");
        assert_eq!(period["late_ns"].as_u64().unwrap() * 10, period["period_ns"].as_u64().unwrap());
    }
    assert!(measured["plan"]["cycles"].as_u64() > periods[2]["cycles"].as_u64(), "{measured}");
    let mut factors = measured["factors"].as_array().unwrap().iter();
    let guard = factors.find(|factor| factor["name"] == "final spin (guard)").unwrap();
    // Slots that a busy computer passed over count, too, so that both may have more than was requested.
    for side in ["without", "with"] {
        assert!(guard[side]["count"].as_u64() >= Some(15), "{guard}");
    }

    // What this host does not give, and what it could try, comes and goes: their own keys are not looked at.
    let short = |key: String| {
        let cut = |part: &&str| Some(key[..key.find(part)? + part.len()].to_owned());
        ["_ratio", "untried"].iter().find_map(cut).unwrap_or(key.clone())
    };
    let mut have: Vec<String> = keys(&report, "").into_iter().map(short).collect();
    have.sort();
    have.dedup();
    let want = "counts.bad counts.good counts.poor counts.unknown findings.area findings.fix findings.found \
         findings.name findings.undo findings.verdict findings.wanted findings.why host.cpu host.kernel \
         measured.costs.exchanges_ns.datagram measured.costs.exchanges_ns.frame \
         measured.costs.exchanges_ns.stream measured.costs.exchanges_ns.telegram \
         measured.factors.fix measured.factors.name measured.factors.p50_ratio measured.factors.p99_ratio \
         measured.factors.with.count measured.factors.with.max_ns measured.factors.with.p50_ns \
         measured.factors.with.p99_ns measured.factors.without.count measured.factors.without.max_ns \
         measured.factors.without.p50_ns measured.factors.without.p99_ns measured.fifo measured.miss_rate \
         measured.noise.gap_ns measured.noise.gaps measured.noise.longest_ns measured.noise.looked_ns \
         measured.noise.taken_ns measured.period_ns measured.periods.at_most measured.periods.cycles \
         measured.periods.late measured.periods.late_ns measured.periods.period_ns measured.periods.share \
         measured.plan.at_most measured.plan.cycles measured.plan.late measured.plan.late_ns \
         measured.plan.period_ns measured.plan.share measured.shortest_period_ns measured.steal_ms \
         measured.untried ready subject.config subject.core subject.late_ns subject.period_ns \
         subject.priority";
    let want: Vec<&str> = want.split_whitespace().collect();
    assert_eq!(have, want, "keys are stable: programs read them");
}

#[test]
fn a_mistake_is_one_line_and_a_core_that_is_not_there_is_no_mistake() {
    let machine = Machine::new(33);
    let config = machine.plain(1).display().to_string();
    let missing = machine.path("missing.toml").display().to_string();
    let broken = machine.write("broken.toml", "[cycle\n").display().to_string();
    for (arguments, part) in [
        (&[missing.as_str()][..], "missing.toml: No such file or directory; name an existing"),
        (&[&broken], "broken.toml:1: "),
        (&[&config, "--period", "1ms"], "cannot be used with"),
        (&["--period", "10us"], "a period is 50us ... 1s"),
        (&["--priority", "100"], "100 is not in 1..=99"),
        (&["--for", "5s"], "required arguments were not provided: --measure"),
        (&["--measure", "--for", "1ms"], "a measurement takes 1s ... 10min"),
        (&["--measure", "--miss-rate", "0"], "above 0 and below 1"),
    ] {
        run(["doctor"].iter().chain(arguments)).refused(&[part]);
    }
    let ended = run(["doctor", "--core", "1000", "--measure", "--for", "1s"]);
    ended.expect(1);
    assert!(ended.out.contains("core 1000 is not available"), "{}", ended.out);
    assert!(ended.err.contains("fieldbeat: not measured: core 1000 is not one that this process may run on"));
    assert!(ended.out.lines().last().unwrap().starts_with("not ready: "), "{}", ended.out);
}

#[test]
#[ignore = "needs root and iproute2: network namespaces"]
fn fixes_of_the_doctor_can_be_applied_and_undone() {
    let machine = Machine::new(34).on(CABLE_NET);
    let config = machine.config("m.toml", 1, "", "");
    let cable = Cable::new(34, &[11]);
    let doctor = || {
        let mut command = Command::new(PROGRAM);
        command.arg("doctor").arg(&config).arg("--json");
        assert_consistent(&Program::spawn(&mut Cable::enter(&cable.master, &command)).end())
    };
    let follow = |advice: &Value| {
        let line = advice.as_str().unwrap().lines().next().unwrap();
        let line =
            line.replace("sudo ip", &format!("ip -n {}", cable.master)).replace("MAC", "02:00:00:00:00:0b");
        support::command(&line.split(' ').collect::<Vec<_>>());
    };
    let report = doctor();
    assert_eq!(finding(&report, "linudp-v2: interface")["verdict"], "good");
    assert_eq!(finding(&report, "linudp-v2: interrupts")["found"], "none of its own: a virtual interface");
    let before = finding(&report, "linudp-v2: neighbour entries").clone();
    assert_eq!((&before["verdict"], &before["found"]), (&"poor".into(), &"0 of 1 permanent".into()));
    follow(&before["fix"]);
    assert_eq!(finding(&doctor(), "linudp-v2: neighbour entries")["verdict"], "good");
    follow(&before["undo"]);
    assert_eq!(*finding(&doctor(), "linudp-v2: neighbour entries"), before);
    cable.plug("down");
    let unplugged = doctor();
    let found = finding(&unplugged, "linudp-v2: interface")["found"].as_str().unwrap();
    assert!(found.starts_with("wire, ") && found.ends_with(", no carrier"), "{found}");
}

/// Before anything is sent: no drive is there.
#[test]
fn a_plan_that_takes_longer_than_its_period_is_refused_by_stated_and_by_measured_costs() {
    let machine = Machine::new(197);
    let with = |line: &str| {
        let cycle = format!("period = \"500us\"\nreceive_deadline = 0.5\n{line}");
        machine.config("large.toml", 200, &cycle, "health = { bucket = \"1s\", leak = 1 }")
    };
    let ended = |words: &[&str]| {
        let mut command = Command::new(PROGRAM);
        command.args(words).env("XDG_STATE_HOME", machine.path("state"));
        Program::spawn(command.env("XDG_RUNTIME_DIR", machine.path("run"))).end()
    };
    let config = with("").display().to_string();
    let refused =
        ["a cycle takes about 910 us", "more than its period of 500 us (by stated costs; ", "= \"2ms\""];
    for words in
        [["check", &config, "--json"].as_slice(), &["run", &config, "--for", "1s"], &["check", &config]]
    {
        let ended = ended(words);
        ended.expect(2);
        assert!(refused.iter().all(|part| ended.err.contains(part)), "{words:?}: {}", ended.err);
        assert_eq!(ended.err.lines().count(), 1, "{}", ended.err);
    }
    with("cost = \"warn\"");
    let warned = ended(&["check", &config]);
    warned.expect(0);
    assert!(warned.out.contains("on this host: tight: a cycle takes about 910 us"), "{}", warned.out);
    with("cost = \"off\"");
    let silent = ended(&["check", &config]);
    silent.expect(0);
    assert!(!silent.out.contains("on this host: "), "{}", silent.out);
    assert_eq!(ended(&["check", &config, "--json"]).expect(0).json()["cost"], Value::Null);

    // What was measured takes the place of what was stated.
    with("");
    let measured = ended(&["doctor", &config, "--measure", "--for", "1s", "--json"]);
    let report = assert_consistent(&measured);
    assert!(measured.err.contains("kept in ") && machine.path("state/fieldbeat/doctor.json").exists());
    let kept = std::fs::read_to_string(machine.path("state/fieldbeat/costs")).unwrap();
    let [send_ns, receive_ns] =
        [0, 1].map(|which| report["measured"]["costs"]["exchanges_ns"]["datagram"][which].as_u64().unwrap());
    assert!(kept.contains(&format!("datagram {send_ns} {receive_ns}\n")), "{kept}");
    let cost = ended(&["check", &config, "--json"]).json()["cost"].clone();
    assert_eq!((&cost["measured"], &cost["usual_ns"]["send"]), (&true.into(), &(200 * send_ns).into()));
    // Of another host, or damaged, it is none.
    std::fs::write(machine.path("state/fieldbeat/costs"), kept.replacen("host ", "host other ", 1)).unwrap();
    assert_eq!(ended(&["check", &config, "--json"]).expect(2).json()["cost"]["measured"], false);
}

#[test]
fn a_core_that_this_host_lacks_is_refused_by_check_as_by_run() {
    let machine = Machine::new(198);
    let config = machine.config("core.toml", 1, "core = 1000", "").display().to_string();
    for words in [["check", &config].as_slice(), &["check", &config, "--json"], &["run", &config]] {
        let ended = run(words.iter().copied());
        ended.expect(2);
        assert!(
            ended.err.contains("core 1000 is not one that this process may run on: set `core` to one of "),
            "{}",
            ended.err
        );
    }
}
