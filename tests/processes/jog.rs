//! The panel as a person uses it, in a pseudo-terminal: keys that are held as a terminal reports them, and all the ways
//! to go away from one in mid-motion.

use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::{AsFd, AsRawFd};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::Path;
use std::process::{Child, Command, ExitStatus};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{JoinHandle, sleep};
use std::time::Duration;

use fieldbeat_control::Operator;
use fieldbeat_testing::Pty;
use nix::poll::{PollFd, PollFlags, poll};

use super::operate::{SPEED, assert_rest, await_axis, config, is_left, moves, online, seen, socket_of};
use super::support::{LONG, Machine, PROGRAM, directories_of, until};
use super::{ask, master, serve, simulation, wires};

/// The right arrow key, as a terminal sends it.
const RIGHT: &[u8] = b"\x1b[C";

/// What a terminal answers to who has sent it this.
type Answer = fn(&str) -> &'static [u8];

/// One that has no keyboard protocol of kitty.
const PLAIN: Answer = |_| b"\x1b[?62c";

/// One that has it: it sets what it is to report, among it that keys go up.
const KITTY: Answer =
    |sent| if sent.contains("\x1b[>3u") { b"\x1b[?3u\x1b[?62c" } else { b"\x1b[?0u\x1b[?62c" };

/// A panel in a terminal of its own.
struct Panel {
    child: Child,
    /// The other end of its terminal.
    end: Option<File>,
    /// The reader of that end lets it go.
    hangs_up: Arc<AtomicBool>,
    reader: Option<JoinHandle<()>>,
    text: Arc<Mutex<String>>,
}

impl Panel {
    /// `fieldbeat jog CONFIG REST` in a terminal of 80x24, which is its controlling one.
    fn start(config: &Path, rest: &[&str]) -> Panel {
        Panel::start_in(PLAIN, config, rest)
    }

    /// The same in a terminal that answers so.
    fn start_in(answer: Answer, config: &Path, rest: &[&str]) -> Panel {
        let Pty { end, path } = Pty::new();
        let size = libc::winsize { ws_row: 24, ws_col: 80, ws_xpixel: 0, ws_ypixel: 0 };
        // SAFETY: the kernel reads a live value.
        assert_eq!(unsafe { libc::ioctl(end.as_raw_fd(), libc::TIOCSWINSZ, &raw const size) }, 0);
        let open = || File::options().read(true).write(true).open(&path).unwrap();
        let mut command = Command::new(PROGRAM);
        command.arg("jog").arg(config).args(rest).env("TERM", "xterm-256color");
        command.stdin(open()).stdout(open()).stderr(open());
        directories_of(&mut command, nix::unistd::geteuid().as_raw());
        // SAFETY: between fork and exec only system calls, which are async-signal-safe.
        unsafe {
            command.pre_exec(|| {
                libc::signal(libc::SIGHUP, libc::SIG_DFL);
                libc::setsid();
                libc::ioctl(0, libc::TIOCSCTTY, 0);
                Ok(())
            });
        }
        let child = command.spawn().unwrap();
        drop(command);
        let (text, hangs_up) = (Arc::<Mutex<String>>::default(), Arc::<AtomicBool>::default());
        let other = end.try_clone().unwrap();
        let (into, ends) = (Arc::clone(&text), Arc::clone(&hangs_up));
        let reader = std::thread::spawn(move || collect(other, answer, &into, &ends));
        Panel { child, end: Some(end), hangs_up, reader: Some(reader), text }
    }

    /// Nobody has the other end any more.
    fn hang_up(&mut self) {
        self.hangs_up.store(true, Ordering::Relaxed);
        self.reader.take().unwrap().join().unwrap();
        self.end = None;
    }

    fn text(&self) -> String {
        self.text.lock().unwrap().clone()
    }

    /// Waits for a text on the screen. What is blank already is not drawn, so that blanks do not count.
    #[track_caller]
    fn await_text(&self, text: &str) {
        let wanted: String = text.split(' ').collect();
        assert!(until(LONG, || plain(&self.text()).contains(&wanted)), "no {text:?}: {}", self.text());
    }

    fn press(&mut self, keys: &[u8]) {
        self.end.as_mut().unwrap().write_all(keys).unwrap();
    }

    /// Enables axis 0, and homes it unless it is. Where the host is so late that the panel takes a key for one that
    /// stops, it begins anew.
    #[track_caller]
    fn enable(&mut self, watcher: &mut Operator) {
        let mut proceed = || {
            let axis = &seen(watcher).axes[0];
            let key = match () {
                () if !axis.commands.is_empty() || axis.stopping => return false,
                () if axis.stopped.is_some() => b"r",
                () if !axis.operational => b"e",
                () if !axis.homed => b"h",
                () => return true,
            };
            self.press(key);
            // The panel learns of it, too.
            sleep(Duration::from_millis(300));
            false
        };
        assert!(until(LONG, &mut proceed), "{:?}: {}", seen(watcher).axes[0], self.text());
    }

    /// Holds a key as a keyboard does until the axis moves, and for some repeats more. Where the host is so late that
    /// it looks as if it were let go, it is let go and held again; where the panel was silent for so long that the axis
    /// is off, it is enabled first.
    #[track_caller]
    fn hold_until_moving(&mut self, watcher: &mut Operator) {
        let mut hold = || {
            self.enable(watcher);
            sleep(Duration::from_millis(600));
            self.press(RIGHT);
            sleep(Duration::from_millis(400));
            (0..60).any(|_| {
                self.press(RIGHT);
                sleep(Duration::from_millis(30));
                moves(&seen(watcher))
            })
        };
        assert!(until(LONG, &mut hold), "it never moves: {}", self.text());
    }

    fn signal(&self, signal: i32) {
        // SAFETY: takes two numbers; the child has not been waited for, so that its id is its own.
        assert_eq!(unsafe { libc::kill(self.child.id() as i32, signal) }, 0);
    }

    /// Its end, and what it has written.
    #[track_caller]
    fn end(mut self) -> (ExitStatus, String) {
        let mut status = None;
        let ended = until(LONG, || {
            status = self.child.try_wait().unwrap();
            status.is_some()
        });
        assert!(ended, "still running: {}", self.text());
        if self.end.is_some() {
            // The reader ends with the last of what was written.
            self.reader.take().unwrap().join().unwrap();
        }
        (status.unwrap(), self.text())
    }
}

/// What was written without control sequences and blanks.
fn plain(text: &str) -> String {
    let mut plain = String::new();
    let mut characters = text.chars();
    while let Some(character) = characters.next() {
        match character {
            '\x1b' => {
                // Up to its final byte.
                let begins = characters.next() == Some('[');
                let _ = begins && characters.any(|c| c.is_ascii_alphabetic());
            }
            c if !c.is_whitespace() => plain.push(c),
            _ => {}
        }
    }
    plain
}

/// All that comes, up to the end of the last process that has the terminal, or until it is to let go.
fn collect(mut end: File, answer: Answer, into: &Mutex<String>, ends: &AtomicBool) {
    let mut bytes = [0; 4096];
    while !ends.load(Ordering::Relaxed) {
        let mut looked = [PollFd::new(end.as_fd(), PollFlags::POLLIN)];
        if poll(&mut looked, 10_u8).unwrap() == 0 {
            continue;
        }
        let Ok(count @ 1..) = end.read(&mut bytes) else { return };
        let said = String::from_utf8_lossy(&bytes[..count]).into_owned();
        let mut text = into.lock().unwrap();
        text.push_str(&said);
        if said.contains("\x1b[c") {
            let _ = end.write_all(answer(&text));
        }
    }
}

impl Drop for Panel {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The terminal has its own screen again, and its cursor.
#[track_caller]
fn assert_given_back(text: &str) {
    let left = text.rfind("\x1b[?1049l").unwrap_or_else(|| panic!("the screen is not given back: {text:?}"));
    assert!(text[left..].contains("\x1b[?25h"), "no cursor: {text:?}");
}

/// The last lines say that axis 0 was left without power.
#[track_caller]
fn assert_left_off(text: &str) {
    assert_given_back(text);
    let last = text.rsplit("axis d0: ").next().unwrap();
    assert!(last.starts_with("power off at "), "{text:?}");
}

/// How somebody goes away while the axis moves.
struct Away {
    how: &'static str,
    goes: fn(&mut Panel),
    /// The panel goes on.
    stays: bool,
}

impl Away {
    const fn ends(how: &'static str, goes: fn(&mut Panel)) -> Away {
        Away { how, goes, stays: false }
    }

    const fn stays(how: &'static str, goes: fn(&mut Panel)) -> Away {
        Away { how, goes, stays: true }
    }
}

const WAYS: [Away; 8] = [
    Away::stays("lets go", |_| {}),
    Away::stays("loses focus", |panel| panel.press(b"\x1b[O")),
    Away::ends("quits", |panel| panel.press(b"q")),
    Away::ends("Ctrl-C", |panel| panel.press(b"\x03")),
    Away::ends("hangs up", Panel::hang_up),
    Away::ends("killed", |panel| panel.signal(libc::SIGKILL)),
    Away::ends("terminated", |panel| panel.signal(libc::SIGTERM)),
    Away::stays("stopped", |panel| panel.signal(libc::SIGSTOP)),
];

#[test]
#[ignore = "needs the feature jog"]
fn any_end_of_a_held_key_ends_the_motion() {
    let machine = Machine::new(155);
    let config = config(&machine, "panel");
    let _drives = serve(&config);
    let _master = master(&config, &["--allow-control"]);
    let path = socket_of(&config);
    let mut watcher = Operator::remote(&path).unwrap();
    await_axis(&mut watcher, online);
    for Away { how, goes, stays } in WAYS {
        // All stands, and somebody else may take over.
        await_axis(&mut watcher, |state| {
            is_left(state) && state.axes.iter().all(|axis| axis.commands.is_empty())
        });
        let mut panel = Panel::start(&config, &["--axis", "d0", "--velocity", &SPEED.to_string()]);
        panel.await_text("the master (pid");
        panel.enable(&mut watcher);
        panel.hold_until_moving(&mut watcher);
        goes(&mut panel);
        await_axis(&mut watcher, |state| state.jog.is_none() && !moves(state));
        if how == "stopped" {
            // What was typed meanwhile moves nothing.
            await_axis(&mut watcher, is_left);
            panel.press(&RIGHT.repeat(100));
            panel.signal(libc::SIGCONT);
        }
        assert_rest(&mut watcher);
        if stays {
            panel.press(b"q");
        }
        let (status, text) = panel.end();
        await_axis(&mut watcher, is_left);
        match how {
            "killed" => assert_eq!(status.signal(), Some(libc::SIGKILL)),
            // It has nobody to say it to.
            "hangs up" => assert_eq!(status.code(), Some(1), "{text}"),
            _ => {
                assert_eq!(status.code(), Some(0), "{how}: {text}");
                assert_left_off(&text);
            }
        }
    }
}

#[test]
#[ignore = "needs the feature jog"]
fn alone_the_panel_is_the_master_and_stops_when_its_terminal_hangs_up() {
    let machine = Machine::new(156);
    let config = config(&machine, "alone");
    let _drives = serve(&config);
    let mut panel = Panel::start(&config, &["--velocity", &SPEED.to_string()]);
    panel.await_text("no master runs: this panel is the master");
    let mut watcher = Operator::remote(&socket_of(&config)).unwrap();
    await_axis(&mut watcher, online);
    panel.enable(&mut watcher);
    panel.hold_until_moving(&mut watcher);
    // A second panel reports who operates.
    let second = Panel::start(&config, &[]);
    let (status, text) = second.end();
    assert_eq!(status.code(), Some(1), "{text}");
    assert!(
        text.contains(&format!("fieldbeat jog (pid {}) operates this master", panel.child.id())),
        "{text}"
    );
    // The prompt comes in the motion; the key was let go meanwhile.
    panel.hold_until_moving(&mut watcher);
    panel.signal(libc::SIGHUP);
    let (status, text) = panel.end();
    assert_eq!(status.code(), Some(0), "{text}");
    assert_left_off(&text);
}

#[test]
#[ignore = "needs the feature jog"]
fn terminals_that_report_key_releases_run_while_a_key_is_pressed() {
    let machine = Machine::new(116);
    let config = config(&machine, "kitty");
    let _drives = serve(&config);
    let mut panel = Panel::start_in(KITTY, &config, &["--velocity", &SPEED.to_string()]);
    panel.await_text("no master runs: this panel is the master");
    let mut watcher = Operator::remote(&socket_of(&config)).unwrap();
    await_axis(&mut watcher, online);
    panel.enable(&mut watcher);
    // Right goes down; it goes up alone, and while shift is down.
    let down = b"\x1b[1;1:1C";
    for up in [b"\x1b[1;1:3C", b"\x1b[1;2:3C"] {
        // Without a repeat: a terminal that reports none would not run it. Where the host is late, once more.
        let mut run = || {
            panel.enable(&mut watcher);
            panel.press(up);
            sleep(Duration::from_millis(300));
            panel.press(down);
            (0..30).any(|_| {
                sleep(Duration::from_millis(30));
                moves(&seen(&mut watcher))
            })
        };
        assert!(until(LONG, &mut run), "it never moves: {}", panel.text());
        panel.press(up);
        // What still repeats belongs to the press that has ended.
        let mut rests = || {
            panel.press(b"\x1b[1;1:2C");
            sleep(Duration::from_millis(30));
            let state = seen(&mut watcher);
            state.jog.is_none() && !moves(&state)
        };
        assert!(until(LONG, &mut rests), "it goes on: {}", panel.text());
        // Unless the host held the panel for a second.
        let was_silent = plain(&panel.text()).contains("silentfortoolong");
        assert!(was_silent || seen(&mut watcher).axes[0].operational, "it is off: {}", panel.text());
    }
    panel.press(b"q");
    let (status, text) = panel.end();
    assert_eq!(status.code(), Some(0), "{text}");
    assert_left_off(&text);
}

#[test]
#[ignore = "needs the feature jog"]
fn alone_the_panel_names_what_its_black_box_wrote() {
    let machine = Machine::new(115);
    let config = config(&machine, "lost");
    let drives = serve(&config);
    let panel = Panel::start(&config, &[]);
    panel.await_text("no master runs: this panel is the master");
    let mut watcher = Operator::remote(&socket_of(&config)).unwrap();
    await_axis(&mut watcher, online);
    drop(drives);
    await_axis(&mut watcher, |state| state.axes[0].link == "lost");
    panel.signal(libc::SIGTERM);
    let (_, text) = panel.end();
    assert_given_back(&text);
    assert!(text.contains("fieldbeat: black box: ") && text.contains("link lost"), "{text:?}");
}

#[test]
#[ignore = "needs the feature jog"]
fn a_panel_that_cannot_be_says_why_in_one_line_and_gives_the_terminal_back() {
    let machine = Machine::new(157);
    let config = config(&machine, "refused");
    ask("jog", &config, "").refused(&["jog needs a terminal"]);
    ask("jog", &config, "--axis nobody").refused(&["has no axis nobody; it has d0, d1"]);
    ask("jog", &config, "--velocity 0").refused(&["--velocity must be a number above 0"]);
    ask("jog", &config, "--step nan").refused(&["--step must be a number above 0"]);
    ask("jog", &config, "--velocity 3000").refused(&["--velocity 3000: axis d0 is limited to 2000 mm/s"]);
    let file = config.to_str().unwrap();
    for (device, why) in
        [("/none", "name one of"), (file, "no input device"), ("/dev/null", "no input device")]
    {
        let device = format!("--enable-device {device}");
        ask("jog", &config, &device).refused(&[&format!("{device}: "), why]);
    }
    let _drives = serve(&config);
    let closed = master(&config, &[]);
    socket_of(&config);
    let (status, text) = Panel::start(&config, &[]).end();
    assert_eq!(status.code(), Some(1), "{text}");
    assert!(text.contains("start it with `fieldbeat run CONFIG --allow-control`"), "{text}");
    assert!(!text.contains("\x1b[?1049h"), "{text}");
    closed.end_by(libc::SIGTERM);
    // One that dies in the middle.
    let open = master(&config, &["--allow-control"]);
    socket_of(&config);
    let panel = Panel::start(&config, &[]);
    panel.await_text("any other stops");
    open.kill();
    let (status, text) = panel.end();
    assert_eq!(status.code(), Some(1), "{text}");
    assert_given_back(&text);
    assert!(text.contains("the master has ended"), "{text}");
    // Its own configuration is as wrong for a panel as for a master.
    let wrong = machine.write("wrong.toml", "");
    ask("jog", &wrong, "").refused(&["bus: missing"]);
}

#[test]
#[ignore = "needs the feature jog"]
fn a_panel_with_a_master_of_its_own_names_a_drive_that_ignores_its_stop_and_has_failed() {
    let machine = Machine::new(222);
    let config = wires::faulty(&machine, "turns.toml");
    let _sim = simulation(&config);
    let mut panel = Panel::start(&config, &[]);
    panel.await_text("no master runs: this panel is the master");
    let mut watcher = Operator::remote(&socket_of(&config)).unwrap();
    await_axis(&mut watcher, online);
    panel.press(b"q");
    let (status, text) = panel.end();
    assert_eq!(status.code(), Some(1), "{text}");
    assert!(text.contains("drive feeder still moves at the end (OperationEnabled at "), "{text}");
    assert!(!text.contains("drive turret"), "{text}");
}
