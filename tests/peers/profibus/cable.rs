//! A cable between two pseudo-terminals, a port at either end, and the telegrams that have passed it.
//!
//! It has no bit times and no parity: bytes, and their order.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, AsRawFd};
use std::os::unix::fs::OpenOptionsExt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use fieldbeat_testing::Pty;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use super::telegrams::Telegram;

/// Who has sent a telegram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum By {
    Master,
    Drive,
}

/// Bytes in the order in which they came, in the pieces in which they came.
type Passed = Arc<Mutex<Vec<(By, Vec<u8>)>>>;

pub struct Cable {
    /// The paths of the ports at its ends.
    pub master: String,
    pub drives: String,
    passed: Passed,
    cut: Arc<AtomicBool>,
    pump: Option<JoinHandle<()>>,
}

/// A pseudo-terminal, and its port, which is open so that nobody who closes it ends it.
struct End {
    near: Pty,
    _port: File,
}

impl End {
    fn new() -> End {
        let near = Pty::new();
        let mut options = OpenOptions::new();
        let port = options.read(true).write(true).custom_flags(libc::O_NOCTTY).open(&near.path).unwrap();
        // SAFETY: all bytes zero are valid settings; the calls take a live value and a descriptor that is open.
        unsafe {
            let mut settings = std::mem::zeroed();
            assert_eq!(libc::tcgetattr(port.as_raw_fd(), &raw mut settings), 0);
            libc::cfmakeraw(&raw mut settings);
            assert_eq!(libc::tcsetattr(port.as_raw_fd(), libc::TCSANOW, &raw const settings), 0);
        }
        End { near, _port: port }
    }
}

impl Cable {
    pub fn new() -> Cable {
        let ends = [End::new(), End::new()];
        let [master, drives] = ends.each_ref().map(|end| end.near.path.clone());
        let (passed, cut) = (Passed::default(), Arc::new(AtomicBool::new(false)));
        let (record, is_cut) = (Arc::clone(&passed), Arc::clone(&cut));
        let pump = std::thread::spawn(move || {
            let priority = libc::sched_param { sched_priority: super::PRIORITY };
            // SAFETY: the kernel reads a live value.
            let set = unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const priority) };
            assert_eq!(set, 0, "{}", io::Error::last_os_error());
            while !is_cut.load(Ordering::Relaxed) {
                carry(&ends, &record);
            }
        });
        Cable { master, drives, passed, cut, pump: Some(pump) }
    }

    /// The telegrams so far.
    pub fn telegrams(&self) -> Vec<(By, Vec<u8>)> {
        let mut telegrams = Vec::new();
        let mut rests = [Vec::new(), Vec::new()];
        for (by, bytes) in &*self.passed.lock().unwrap() {
            let rest = &mut rests[*by as usize];
            rest.extend_from_slice(bytes);
            while let Some(length) = length(rest).filter(|length| *length <= rest.len()) {
                telegrams.push((*by, rest.drain(..length).collect()));
            }
        }
        telegrams
    }

    /// Whether the master got an answer of each of these stations before it sent the next telegram. On a busy computer
    /// it does not always wait for so long, and talks while the slave does.
    pub fn is_in_turns(&self, stations: &[u8]) -> bool {
        self.telegrams().windows(2).all(|pair| {
            let [(by, request), (next, _)] = pair else { unreachable!() };
            let is_request = |of: Telegram| stations.contains(&of.to);
            *by == By::Drive || *next == By::Drive || !Telegram::of(request).is_some_and(is_request)
        })
    }

    /// Those of the master.
    pub fn requests(&self) -> Vec<Vec<u8>> {
        let of_master = |(by, telegram)| (by == By::Master).then_some(telegram);
        self.telegrams().into_iter().filter_map(of_master).collect()
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.cut.store(true, Ordering::Relaxed);
        self.pump.take().unwrap().join().unwrap();
    }
}

/// Waits for bytes, and hands on what has come.
fn carry([master, drives]: &[End; 2], record: &Passed) {
    let mut waits = [master, drives].map(|end| PollFd::new(end.near.end.as_fd(), PollFlags::POLLIN));
    // Now and then it is looked whether the cable is cut.
    poll(&mut waits, PollTimeout::from(20_u8)).unwrap();
    let has_come = waits.map(|wait| wait.any().unwrap());
    for (by, from, to) in [(By::Master, master, drives), (By::Drive, drives, master)] {
        if has_come[by as usize] {
            let mut bytes = [0; 512];
            let count = (&from.near.end).read(&mut bytes).unwrap();
            record.lock().unwrap().push((by, bytes[..count].to_vec()));
            (&to.near.end).write_all(&bytes[..count]).unwrap();
        }
    }
}

/// How long the telegram is that begins with these bytes; `None`: more of them are needed to say.
fn length(bytes: &[u8]) -> Option<usize> {
    Some(match *bytes {
        [] | [0x68] => return None,
        [0x10, ..] => 6,
        [0x68, length, ..] => usize::from(length) + 6,
        [0xA2, ..] => 14,
        [0xDC, ..] => 3,
        [0xE5, ..] => 1,
        [other, ..] => panic!("{other:#x} begins no telegram"),
    })
}
