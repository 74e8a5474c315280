//! What an ordinary user may not do, and is told.

use super::support::{Machine, Program, as_ordinary_user};
use super::{assert_silent, end_once_online, serve, socket};

#[test]
fn required_rights_that_are_missing_are_named_and_nothing_is_sent() {
    let machine = Machine::new(20);
    let config = machine.config("strict.toml", 2, "realtime = \"require\"", "");
    let drives = [socket(machine.drive(0)), socket(machine.drive(1))];
    let mut command = as_ordinary_user(&machine);
    let program = command.get_program().to_string_lossy().into_owned();
    let ended = Program::spawn(command.arg("run").arg(&config).args(["--for", "1s"])).end();
    ended.refused(&[
        "no right for SCHED_FIFO 80 (RLIMIT_RTPRIO is 0)",
        "sudo setcap cap_sys_nice,cap_ipc_lock+ep ",
        &program,
        "or set realtime = \"prefer\"",
    ]);
    drives.iter().for_each(assert_silent);
}

#[test]
fn an_ordinary_user_is_told_once_that_the_numbers_are_not_real_time() {
    let machine = Machine::new(21);
    let config = machine.config("m.toml", 1, "realtime = \"prefer\"", "");
    let _sim = serve(&config);
    let user = |arguments: &[&str]| {
        let mut command = as_ordinary_user(&machine);
        end_once_online(Program::spawn(command.arg("run").arg(&config).args(arguments)))
    };
    let ended = user(&["--json"]);
    ended.expect(0);
    let summary = ended.json();
    assert_eq!(
        (&summary["realtime"]["policy"], &summary["realtime"]["memory_locked"]),
        (&"SCHED_OTHER".into(), &false.into())
    );
    let reported: Vec<&str> = ended.err.lines().filter(|line| line.contains("not real-time")).collect();
    assert_eq!(reported.len(), 2, "one a right: {}", ended.err);
    assert_eq!(summary["realtime"]["missing"].as_array().unwrap().len(), 2);
    for (line, right) in reported.iter().zip(["SCHED_FIFO 80", "memory"]) {
        assert!(line.starts_with("fieldbeat: not real-time: no right ") && line.contains(right), "{line}");
    }
    let ended = user(&[]);
    ended.expect(0);
    assert!(ended.out.contains("These numbers are not real-time:"), "{}", ended.out);
}
