//! The guardian: a process that stops the drives without a watchdog of their own once this one cannot, since it was
//! killed, has crashed, or does not run.
//!
//! It gets the sockets and the locks of these drives, what they are to be sent ([`LastResort`]), the word that owns the
//! wires, and a descriptor of this process. Here it is started and ended; [`role`] is what it does.

mod role;

use std::ffi::CString;
use std::io::{self, Read};
use std::net::Shutdown;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, IntoRawFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::sys::socket::{MsgFlags, recv};

pub use self::role::guardian_main;
use fieldbeat_core::bus::LastResort;
use fieldbeat_core::bus::last::LastDrive;
use fieldbeat_core::errors::no_descriptor;
use fieldbeat_core::rt::{Realtime, RealtimePlan, Wires, Words, child};

/// The first argument of a program that is to be a guardian. Programs of another layout do not know it.
const ROLE: &str = concat!("--fieldbeat-guardian-", env!("CARGO_PKG_VERSION"));

/// The message of a guardian once it watches.
const READY: &[u8] = b"ready";

/// It has so long to start: a busy host starts programs slowly.
const STARTS_WITHIN: Duration = Duration::from_secs(10);

/// A guardian that has nothing left to do ends within this time.
const ENDS_WITHIN: Duration = Duration::from_secs(1);

/// This program calls [`guardian_main`].
static HAS_ROLE: AtomicBool = AtomicBool::new(false);

/// Why there is no guardian, although drives need one. The text says what that means, and what to do.
#[derive(Clone, thiserror::Error)]
#[non_exhaustive]
pub enum NoGuardian {
    /// It is not wanted.
    #[error("no guardian (guardian_after = \"off\"): {UNGUARDED}")]
    Off,
    /// Nothing can be started as one.
    #[error(
        "no guardian: {UNGUARDED}; call `guardian_main()` first in `main`, or name the program `fieldbeat` \
         (`Setup::with_guardian`)"
    )]
    NoProgram,
    /// It could not be started.
    #[error("no guardian: {UNGUARDED}; {} cannot be one: {why}", program.display())]
    Failed {
        /// The program.
        program: PathBuf,
        /// Why.
        why: String,
    },
    /// It ends with this process, whose end is that of its PID namespace.
    #[error(
        "the guardian ends with this process, the first one of its PID namespace (a container): {UNGUARDED}; start it \
         by an init, such as that of `docker run --init`"
    )]
    First,
    /// It has ended before its master.
    #[error(
        "the guardian has ended before its master: {UNGUARDED}; look at what has killed it, and start again"
    )]
    Ended,
}

fieldbeat_core::debug_as_display!(NoGuardian);

/// The consequence of a missing guardian.
const UNGUARDED: &str = "if this process is killed, a LinMot moves on to its target and stays powered";

/// The numbers that a guardian gets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Numbers {
    /// The first descriptor, and how many there are.
    first: i32,
    count: usize,
    /// Sockets of drives.
    resorts: usize,
    /// There is memory that outlives the process.
    has_records: bool,
    after_ns: u64,
    /// The priority of the loop, 0: an ordinary thread.
    priority: u8,
    core: Option<usize>,
    /// The process that it guards, for lists of processes.
    process: u32,
}

impl Numbers {
    fn to_argument(self) -> String {
        let Numbers { first, count, resorts, has_records, after_ns, priority, core, process } = self;
        let core = core.map_or(-1, |core| core as i64);
        let (records, layout) = (u8::from(has_records), layout());
        format!("{first},{count},{resorts},{records},{after_ns},{priority},{core},{process},{layout}")
    }

    fn from_argument(argument: &str) -> Option<Numbers> {
        let numbers: Option<Vec<i64>> = argument.split(',').map(|number| number.parse().ok()).collect();
        let &[first, count, resorts, records, after_ns, priority, core, process, layout] = &numbers?[..]
        else {
            return None;
        };
        Some(Numbers {
            first: first.try_into().ok()?,
            count: count.try_into().ok()?,
            resorts: resorts.try_into().ok()?,
            has_records: records == 1,
            after_ns: after_ns.try_into().ok()?,
            priority: priority.try_into().ok()?,
            core: core.try_into().ok(),
            process: process.try_into().ok().filter(|_| layout == self::layout())?,
        })
    }
}

/// The version that two programs have to agree on: it changes with the layout or the meaning of what they share.
const LAYOUT: i64 = 1;

fn layout() -> i64 {
    LAYOUT << 32 | (size_of::<LastDrive>() << 16 | size_of::<Words>()) as i64
}

/// A guardian, as its master knows it.
#[derive(Debug)]
pub(crate) struct Guardian {
    /// The end of this says that it is ready, and, closed, that it has ended.
    link: UnixStream,
    wires: Wires,
}

impl Guardian {
    /// Starts one for a loop that has not begun. `records` are the memory that outlives this process; `after_ns` is how
    /// long the loop may give no sign of life.
    pub(crate) fn start(
        program: Option<PathBuf>,
        wires: &Wires,
        last_resorts: &[LastResort],
        records: Option<BorrowedFd<'_>>,
        after_ns: u64,
        realtime: &RealtimePlan,
    ) -> Result<Guardian, NoGuardian> {
        let program = match program {
            Some(program) => program,
            // This very program, even if another one has taken its name since.
            None if HAS_ROLE.load(Ordering::Relaxed) => "/proc/self/exe".into(),
            None => return Err(NoGuardian::NoProgram),
        };
        let started = Guardian::begin(&program, wires, last_resorts, records, after_ns, realtime);
        started.map_err(|why| {
            let remedy = no_descriptor(&why).map(|remedy| format!("; {remedy}")).unwrap_or_default();
            NoGuardian::Failed { program, why: format!("{why}{remedy}") }
        })
    }

    fn begin(
        program: &Path,
        wires: &Wires,
        last_resorts: &[LastResort],
        records: Option<BorrowedFd<'_>>,
        after_ns: u64,
        realtime: &RealtimePlan,
    ) -> io::Result<Guardian> {
        let (link, theirs) = UnixStream::pair()?;
        let process = std::process::id();
        let master = child::process_descriptor(process)?;
        let words = wires.words().descriptor().ok_or(io::ErrorKind::Unsupported)?;
        let mut descriptors = vec![words, master.as_fd(), theirs.as_fd()];
        descriptors.extend(records);
        for last in last_resorts {
            descriptors.push(last.socket.as_fd());
            descriptors.push(last.drives.descriptor().ok_or(io::ErrorKind::Unsupported)?);
        }
        descriptors.extend(last_resorts.iter().flat_map(|last| &last.locks).map(AsFd::as_fd));
        let numbers = Numbers {
            first: 0,
            count: descriptors.len(),
            resorts: last_resorts.len(),
            has_records: records.is_some(),
            after_ns,
            priority: if realtime.realtime == Realtime::Off { 0 } else { realtime.priority },
            core: realtime.core_to_be(),
            process,
        };
        let arguments = |first| {
            let numbers = Numbers { first, ..numbers }.to_argument();
            ["fieldbeat-guardian".to_owned(), ROLE.to_owned(), numbers]
                .map(|argument| CString::new(argument).unwrap_or_default())
                .into()
        };
        let child = child::spawn(program, &descriptors, arguments)?;
        drop(theirs);
        let said = read(&link, STARTS_WITHIN, |said| said.starts_with(READY));
        child.reap(said == READY);
        match &*said {
            // Not before: its end is that of a loop which has not begun.
            READY => Ok(Guardian { link, wires: wires.clone() }),
            b"" => Err(io::Error::other(
                "it has ended, or does not answer: it is no `fieldbeat` of this version, and calls no \
                 `guardian_main`",
            )),
            _ => Err(io::Error::other(String::from_utf8_lossy(&said).into_owned())),
        }
    }

    /// Why it does not stop the drives if this process is killed.
    pub(crate) fn lack(&self) -> Option<NoGuardian> {
        let flags = MsgFlags::MSG_PEEK | MsgFlags::MSG_DONTWAIT;
        match recv(self.link.as_raw_fd(), &mut [0], flags) {
            Ok(0) | Err(Errno::ECONNRESET) if !self.wires.have_ended() => Some(NoGuardian::Ended),
            // The kernel kills what is left of a namespace; a process that hangs is guarded all the same.
            _ if std::process::id() == 1 => Some(NoGuardian::First),
            _ => None,
        }
    }
}

impl Drop for Guardian {
    /// Waits for its end, if nothing is left to be done: until then it has the locks of the drives. If a loop is left
    /// behind, the link to it stays open: it is closed by a process that becomes another program.
    fn drop(&mut self) {
        // A loop that has never begun does not end them itself.
        if self.wires.signs() == 0 {
            let _ = self.wires.end();
        }
        match self.wires.have_ended() {
            true => {
                let _ = self.link.shutdown(Shutdown::Write);
                read(&self.link, ENDS_WITHIN, |_| false);
            }
            false => drop(self.link.try_clone().map(OwnedFd::from).map(IntoRawFd::into_raw_fd)),
        }
    }
}

/// The messages of a guardian until `enough`, up to its end, or to a time limit.
fn read(mut link: &UnixStream, limit: Duration, enough: impl Fn(&[u8]) -> bool) -> Vec<u8> {
    let begun = Instant::now();
    let (mut said, mut bytes) = (Vec::new(), [0; 256]);
    while !enough(&said) {
        let left = limit.saturating_sub(begun.elapsed());
        if left.is_zero() || link.set_read_timeout(Some(left)).is_err() {
            break;
        }
        match link.read(&mut bytes) {
            Ok(0) => break,
            Ok(length) => said.extend_from_slice(&bytes[..length]),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(_) => break,
        }
    }
    said
}
