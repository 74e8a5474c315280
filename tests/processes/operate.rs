//! A master that lets others operate its axes, and those who do: real processes and sockets. The rules themselves are
//! held in virtual time, next to them.

use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use fieldbeat_control::{AskError, Ended, OperateError, OperationState, Operator, Order, Watched};
use libc::SIGTERM;

use super::support::{LONG, Machine, drive, until};
use super::{ask, master, serve};

/// Lines for axes that jog without having been homed. The dead-man time of the loop is one that no host exceeds: what
/// ends a jog here are the rules above it.
pub const AXES: &str = "limits = { velocity = 2000, acceleration = 20000 }\nno_drive_watchdog = \"accept\"\n\
                        leash = 20\njog_deadman = \"30s\"\nstop.timeout = \"20s\"";

/// Of the jogs here, mm/s.
pub const SPEED: f64 = 20.0;

/// A configuration whose name is its own, so that its control socket is found by it.
pub fn config(machine: &Machine, test: &str) -> PathBuf {
    machine.config(&format!("{test}-{}.toml", std::process::id()), 2, "", AXES)
}

/// The control socket of the master of `config`, once it listens.
pub fn socket_of(config: &Path) -> PathBuf {
    let user = nix::unistd::geteuid();
    let directory = std::env::temp_dir().join(format!("fieldbeat-tests-{user}/fieldbeat"));
    let stem = config.file_stem().unwrap().to_string_lossy().into_owned();
    let mut found = None;
    let mut look = || {
        let entries = std::fs::read_dir(&directory).into_iter().flatten().flatten().map(|entry| entry.path());
        found = entries
            .filter(|path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(&stem)))
            .find(|path| UnixStream::connect(path).is_ok());
        found.is_some()
    };
    assert!(until(LONG, &mut look), "no control socket");
    found.unwrap()
}

/// How the axes are, as anybody may see it.
pub fn seen(watcher: &mut Operator) -> OperationState {
    watcher.state(u64::MAX).unwrap()
}

/// Waits until axis 0 is so, and meanwhile looks at it as its operator.
#[track_caller]
pub fn await_axis(watcher: &mut Operator, is: impl Fn(&OperationState) -> bool) {
    let mut last = OperationState::default();
    let mut look = || {
        last = seen(watcher);
        is(&last)
    };
    assert!(until(LONG, &mut look), "{last:?}");
}

pub fn online(state: &OperationState) -> bool {
    state.axes[0].link == "online"
}

/// It follows a jog.
pub fn moves(state: &OperationState) -> bool {
    state.axes[0].velocity.is_some_and(|velocity| velocity.abs() > 0.5 * SPEED)
}

/// Its operator has left: it stands without power.
pub fn is_left(state: &OperationState) -> bool {
    state.operator.is_none() && !state.axes[0].powered && !moves(state)
}

/// It stands, and goes on standing.
#[track_caller]
pub fn assert_rest(watcher: &mut Operator) {
    await_axis(watcher, |state| !moves(state) && state.axes[0].commands.is_empty());
    let position = seen(watcher).axes[0].position.unwrap();
    for _ in 0..100 {
        std::thread::sleep(Duration::from_millis(10));
        let state = seen(watcher);
        assert!((state.axes[0].position.unwrap() - position).abs() < 0.5, "{position}: {state:?}");
    }
}

/// Becomes the operator, and enables and homes axis 0.
pub fn operator(path: &Path, name: &str) -> Operator {
    let mut operator = Operator::remote(path).unwrap();
    await_axis(&mut operator, online);
    let mut proceed = || {
        // The axes may still be stopped after their last operator.
        if operator.take(name).is_err() {
            return false;
        }
        let axis = &seen(&mut operator).axes[0];
        let order = match () {
            () if !axis.commands.is_empty() || axis.stopping => return false,
            () if axis.stopped.is_some() => Order::Reset,
            () if !axis.operational => Order::Enable,
            () if !axis.homed => Order::Home,
            () => return true,
        };
        let _ = operator.command(0, order);
        std::thread::sleep(Duration::from_millis(50));
        false
    };
    assert!(until(LONG, &mut proceed), "{:?}", seen(&mut operator));
    operator
}

/// Orders it of axis 0. An operator who was held up for so long that it counts as gone comes again.
fn order(operator: &mut Operator, name: &str, order: Order) -> u64 {
    let mut ordered = None;
    let mut command = || {
        ordered = operator.command(0, order).ok();
        if ordered.is_none() {
            let _ = operator.take(name);
        }
        ordered.is_some()
    };
    assert!(until(LONG, &mut command), "it operates no more");
    ordered.unwrap()
}

#[test]
fn operating_a_master_that_does_not_allow_it_or_has_ended_is_refused_by_name() {
    let machine = Machine::new(154);
    let config = config(&machine, "not");
    let _drives = serve(&config);
    let closed = master(&config, &[]);
    let path = socket_of(&config);
    let refused = |error: OperateError| {
        let why = error.to_string();
        assert!(why.contains("start it with `fieldbeat run CONFIG --allow-control`"), "{why}");
    };
    refused(Operator::remote(&path).unwrap().take("x").unwrap_err());
    refused(Operator::remote(&path).unwrap().stop().unwrap_err());
    // Those who watch are so many.
    let streams: Vec<_> = (0..12).map(|_| Watched::open(&path)).collect();
    let (watched, others): (Vec<_>, Vec<_>) = streams.into_iter().partition(Result::is_ok);
    assert_eq!(watched.len(), 4);
    let why = "4 others watch this master already; end one of them";
    assert!(others.iter().all(|one| matches!(one, Err(AskError::Refused(text)) if text == why)));
    ask("status", &config, "").expect(0);
    closed.end_by(SIGTERM);
    let open = master(&config, &["--allow-control"]);
    let mut operator = operator(&socket_of(&config), "first");
    open.kill();
    let gone = until(LONG, || matches!(operator.stop(), Err(OperateError::Gone)));
    assert!(gone, "{:?}", operator.stop());
}

#[test]
fn a_run_fails_by_a_fault_that_its_operator_left_and_not_by_one_that_was_reset() {
    let machine = Machine::new(158);
    // It meets its mechanical end far inside of its limits.
    let lines = format!("{AXES}\nsimulate = {{ range = [0, 60], home = 0, start = 10 }}");
    let file = format!("fault-{}.toml", std::process::id());
    let config = machine.config(&file, 2, "", &lines);
    let _drives = serve(&config);
    for is_reset in [true, false] {
        let report = machine.path(&format!("report-{is_reset}"));
        let report = ["--report", report.to_str().unwrap()];
        let master = master(&config, &["--allow-control", "--json", report[0], report[1]]);
        let path = socket_of(&config);
        let mut operator = operator(&path, "panel");
        order(&mut operator, "panel", Order::step(300.0, 2.0 * SPEED));
        await_axis(&mut operator, |state| state.axes[0].stopped.as_deref() == Some("drive fault"));
        await_axis(&mut operator, |state| state.axes[0].commands.is_empty());
        if is_reset {
            // Where the drive does not get enough requests the reset may fail, is reported so, and is ordered again.
            let mut ends = Vec::new();
            let is_done = until(LONG, || {
                let id = order(&mut operator, "panel", Order::ResetFault);
                await_axis(&mut operator, |state| state.axes[0].commands.is_empty());
                let notices = operator.state(0).unwrap().notices;
                let end = notices.into_iter().filter_map(|notice| notice.end).find(|end| end.command == id);
                ends.push(end.expect("the end is reported to whoever ordered it").how);
                ends.last() == Some(&Ended::Done)
            });
            assert!(is_done, "{ends:?}");
            await_axis(&mut operator, |state| state.axes[0].fault.is_none());
            order(&mut operator, "panel", Order::Reset);
            await_axis(&mut operator, |state| state.axes[0].stopped.is_none());
        }
        let ended = master.end_by(SIGTERM);
        let stopped = |name: &str| drive(&ended.json(), name)["stopped"].clone();
        let page = std::fs::read_to_string(Path::new(report[1]).join("index.html")).unwrap();
        assert_eq!(page.contains("stopped: d0 (drive fault, fault 0x"), !is_reset);
        assert_eq!(page.contains("none was lost on the way or stopped"), is_reset);
        if is_reset {
            ended.expect(0);
            assert_eq!((stopped("d0"), stopped("d1")), ("shutdown".into(), "shutdown".into()));
        } else {
            let line = ended.expect(1).err.lines().last().unwrap().to_owned();
            assert!(line.contains("stopped: d0 (drive fault, fault 0x"), "{line}");
            assert_eq!((stopped("d0"), stopped("d1")), ("drive fault".into(), "shutdown".into()));
        }
    }
}
