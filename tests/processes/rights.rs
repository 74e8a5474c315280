//! The restrictions of an ordinary user, and their messages.

use std::fs::{File, Permissions};
use std::os::fd::AsRawFd;
use std::os::unix::fs::PermissionsExt;

use super::support::{Machine, Program, as_ordinary_user};
use super::wires::kollmorgens;
use super::{assert_silent, end_once_online, serve, socket};

#[test]
fn a_right_that_is_missing_is_named_with_the_remedy_and_nothing_is_sent() {
    let machine = Machine::new(20);
    let strict = machine.config("strict.toml", 2, "realtime = \"require\"", "");
    let strict = strict.to_str().unwrap();
    let segment = machine.write("lo.toml", kollmorgens("lo"));
    // A port that nobody but root may open.
    let master = File::options().read(true).write(true).open("/dev/ptmx").unwrap();
    let mut number: libc::c_uint = 0;
    // SAFETY: the kernel writes one number.
    assert_eq!(unsafe { libc::ioctl(master.as_raw_fd(), libc::TIOCGPTN, &raw mut number) }, 0);
    let port = format!("/dev/pts/{number}");
    std::fs::set_permissions(&port, Permissions::from_mode(0o000)).unwrap();

    let drives = [socket(machine.drive(0)), socket(machine.drive(1))];
    let program = as_ordinary_user(&machine).get_program().to_string_lossy().into_owned();
    let real_time = [
        "no right for SCHED_FIFO 80 (RLIMIT_RTPRIO is 0)",
        "sudo setcap cap_sys_nice,cap_ipc_lock+ep ",
        &program,
        "or set realtime = \"prefer\"",
    ];
    let of_port = format!("no right to use {port}");
    for (arguments, parts) in [
        (&["run", strict, "--for", "1s"][..], &real_time[..]),
        (&["linmot", "command", strict, "d0", "no-operation"], &real_time[..]),
        (
            &["run", segment.to_str().unwrap()],
            &["cannot use interface lo", "CAP_NET_RAW", "cap_net_raw+ep /"],
        ),
        (
            &["ethercat", "scan", "lo"],
            &[
                "no right for raw frames on lo (CAP_NET_RAW); grant it: sudo groupadd -f realtime && ",
                "sudo setcap cap_sys_nice,cap_ipc_lock,cap_net_raw+ep /",
            ],
        ),
        (&["profibus", "scan", &port], &[&of_port, "dialout"]),
    ] {
        Program::spawn(as_ordinary_user(&machine).args(arguments)).end().refused(parts);
    }
    drives.iter().for_each(assert_silent);
}

#[test]
fn an_ordinary_user_is_warned_once_that_the_numbers_are_not_real_time() {
    let machine = Machine::new(21);
    let config = machine.config("m.toml", 1, "realtime = \"prefer\"", "");
    let _sim = serve(&config);
    let user = |arguments: &[&str]| {
        let mut command = as_ordinary_user(&machine);
        end_once_online(Program::spawn(command.arg("run").arg(&config).args(arguments)))
    };
    let ended = user(&["--json"]);
    let summary = ended.expect(0).json();
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
    assert!(ended.expect(0).out.contains("These numbers are not real-time:"), "{}", ended.out);
}
