//! The link thread: opens, initialises and closes the connections and ports of a master, so that the loop never has to;
//! and keeps those of sessions.
//!
//! A normal thread off the loop's core. It never waits for one peer: every descriptor is non-blocking, and one `epoll`
//! waits for all of them and for the next due instant. A descriptor changes owners by two wait-free rings per carrier.
//! The loop writes an eventfd when it returns one, and only then: the loop looks for new ones by itself.

use std::fmt;
use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Wake, Waker};
use std::thread::{Builder, JoinHandle};

use nix::errno::Errno;
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::eventfd::{EfdFlags, EventFd};

use crate::rt::{self, MonotonicClock};
use crate::time::{MS, Time};

/// The most events of one turn; the others are reported by the next one, first.
const EVENTS: usize = 64;

/// The most that is read from a connection in one turn: the answers of a handshake are short.
const ROOM: usize = 2_048;

/// The event of no socket.
const BELL: u64 = u64::MAX;

/// Wakes up the link thread, and keeps it alive.
#[derive(Debug)]
pub(in crate::net) struct Bell(Arc<LinkThread>);

impl Bell {
    pub(super) fn new(thread: &Arc<LinkThread>) -> Bell {
        Bell(Arc::clone(thread))
    }

    pub fn ring(&self) {
        self.0.shared.wake_up();
    }

    /// Whether the thread has ended although there is a carrier: it panicked.
    pub fn has_ended(&self) -> bool {
        self.0.shared.gone.load(Ordering::Relaxed)
    }

    /// Makes the sessions run. It does not keep the thread alive.
    pub fn waker(&self) -> Waker {
        Arc::clone(&self.0.shared).into()
    }
}

impl Drop for Bell {
    fn drop(&mut self) {
        self.ring();
    }
}

/// The thread, from the side of others. It ends with the last [`Bell`].
#[derive(Debug)]
pub(in crate::net) struct LinkThread {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

pub(super) struct Shared {
    bell: EventFd,
    /// The thread is to end.
    ended: AtomicBool,
    /// It has ended, requested or not.
    gone: AtomicBool,
    /// The sessions are to run: something was posted to one.
    woken: AtomicBool,
    arrivals: Mutex<Vec<Box<dyn Duty>>>,
}

impl fmt::Debug for Shared {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Shared").field("gone", &self.gone).finish_non_exhaustive()
    }
}

impl Shared {
    pub fn wake_up(&self) {
        // An eventfd refuses a 1 only when it is about to overflow, and then the thread wakes up all the same.
        let _ = self.bell.write(1);
    }
}

impl Wake for Shared {
    fn wake(self: Arc<Self>) {
        self.woken.store(true, Ordering::Release);
        self.wake_up();
    }
}

/// The work of the thread for one carrier.
pub(super) trait Duty: Send {
    /// When time alone makes something happen next.
    fn next_due(&self) -> Option<Time>;

    /// Descriptor `index` of this carrier is ready.
    fn happened(&mut self, index: usize, events: EpollFlags, hand: &mut Hand<'_>);

    /// Looks at its queues and at the time, after each wait; `woken`: and at those of its sessions. False: the loop's
    /// side is gone, and with it this.
    fn turn(&mut self, woken: bool, hand: &mut Hand<'_>) -> bool;
}

/// The thread's tools, in the hand of one carrier.
pub(super) struct Hand<'a> {
    pub epoll: &'a Epoll,
    /// Room to read into.
    pub bytes: &'a mut [u8],
    /// Of the carriers of this thread.
    id: u32,
}

impl Hand<'_> {
    /// The event token of descriptor `index`.
    pub fn token(&self, index: usize) -> u64 {
        u64::from(self.id) << 32 | index as u64
    }
}

impl LinkThread {
    /// Starts the thread, on any core but the loop's.
    pub fn start(core_of_loop: Option<usize>) -> io::Result<Arc<LinkThread>> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        let bell = EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?;
        epoll.add(&bell, EpollEvent::new(EpollFlags::EPOLLIN, BELL))?;
        let shared = Arc::new(Shared {
            bell,
            ended: AtomicBool::new(false),
            gone: AtomicBool::new(false),
            woken: AtomicBool::new(false),
            arrivals: Mutex::default(),
        });
        let end = Gone(Arc::clone(&shared));
        let mut worker =
            Worker { epoll, shared: Arc::clone(&shared), duties: Vec::new(), next_id: 0, bytes: [0; ROOM] };
        let thread = Builder::new().name("fb-link".into()).spawn(move || {
            // Dropped last, also by a panic.
            let _end = end;
            // Serial ports are opened again.
            rt::thread::file_thread(core_of_loop);
            worker.run();
        })?;
        Ok(Arc::new(LinkThread { shared, thread: Some(thread) }))
    }

    /// Takes over a carrier.
    pub(super) fn add(&self, duty: Box<dyn Duty>) {
        self.shared.arrivals.lock().unwrap_or_else(PoisonError::into_inner).push(duty);
        self.shared.wake_up();
    }

    pub(super) fn shared(&self) -> &Arc<Shared> {
        &self.shared
    }
}

impl Drop for LinkThread {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Release);
        self.shared.wake_up();
        if let Some(thread) = self.thread.take() {
            // Not long: the thread waits for the eventfd only. A panic of a handshake has been printed by it.
            let _ = thread.join();
        }
        // What it did not take over, because it had ended before.
        let left = std::mem::take(&mut *self.shared.arrivals.lock().unwrap_or_else(PoisonError::into_inner));
        drop(left);
    }
}

/// Held by the thread: reports its end to the loop.
struct Gone(Arc<Shared>);

impl Drop for Gone {
    fn drop(&mut self) {
        self.0.gone.store(true, Ordering::Relaxed);
    }
}

/// The state that the thread owns.
struct Worker {
    epoll: Epoll,
    shared: Arc<Shared>,
    /// Each with its id.
    duties: Vec<(u32, Box<dyn Duty>)>,
    next_id: u32,
    bytes: [u8; ROOM],
}

impl Worker {
    fn run(&mut self) {
        let mut events = [EpollEvent::empty(); EVENTS];
        loop {
            let count = match self.epoll.wait(&mut events, self.timeout()) {
                Ok(count) => count,
                Err(Errno::EINTR) => 0,
                // The descriptor and the buffer are our own, so that no other error is possible.
                Err(_) => return,
            };
            for event in &events[..count] {
                match event.data() {
                    // Read to clear it; every turn looks at all carriers.
                    BELL => drop(self.shared.bell.read()),
                    token => self.happened(token, event.events()),
                }
            }
            // Behind the read: it may have cleared the wake-up of the end along with an earlier one.
            if self.shared.ended.load(Ordering::Acquire) {
                return;
            }
            self.take_in();
            // Behind the read, too. Whoever sets it has written to his queue before, so that the sessions see that.
            let woken = self.shared.woken.swap(false, Ordering::AcqRel);
            let Worker { epoll, bytes, duties, .. } = self;
            duties.retain_mut(|(id, duty)| {
                duty.turn(woken, &mut Hand { epoll, bytes: &mut bytes[..], id: *id })
            });
        }
    }

    /// Until the next due instant, in the milliseconds of `epoll_wait`, rounded up. A minute more often does not
    /// matter.
    fn timeout(&self) -> EpollTimeout {
        match self.duties.iter().filter_map(|(_, duty)| duty.next_due()).min() {
            None => EpollTimeout::NONE,
            Some(due) => {
                let ms = due.since(MonotonicClock::read()).div_ceil(MS);
                EpollTimeout::from(u16::try_from(ms).unwrap_or(u16::MAX))
            }
        }
    }

    fn happened(&mut self, token: u64, events: EpollFlags) {
        let (id, index) = ((token >> 32) as u32, token as u32 as usize);
        let Worker { epoll, bytes, duties, .. } = self;
        if let Some((_, duty)) = duties.iter_mut().find(|(other, _)| *other == id) {
            duty.happened(index, events, &mut Hand { epoll, bytes, id });
        }
    }

    /// Takes over new carriers.
    fn take_in(&mut self) {
        for duty in self.shared.arrivals.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
            self.duties.push((self.next_id, duty));
            self.next_id = self.next_id.wrapping_add(1);
        }
    }
}
