//! A PROFIBUS wire on its port, and the least that any master of it has to do for an exchange.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::io::{self, ErrorKind, Read, Write};
use std::net::SocketAddrV4;
use std::os::fd::{BorrowedFd, RawFd};
use std::os::unix::net::UnixStream;
use std::rc::Rc;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::Waker;

use fieldbeat::Wait;
use fieldbeat::bus::profibus::ProfibusPlan;
use fieldbeat::time::Time;
use fieldbeat_core::net::{
    Broken, Carriers, Datagrams, LinkNotes, Os, Serial, SerialLine, Streams, UdpOptions,
};
use fieldbeat_core::rt::{MonotonicClock, Regions};

use super::bare::unless_blocked;
use super::rig::{self, Calls, Pace, Rig};

/// In a telegram with data: how long it is, beyond the bytes around it; its destination, its function code, and the bit
/// there that is another one in each new request of a station.
const LENGTH: usize = 1;
const AROUND: usize = 6;
const DA: usize = 4;
const FC: usize = 6;
const FCB: u8 = 0x20;
/// The begin of one, and the longest.
const SD2: u8 = 0x68;
const MAX: usize = 255;
/// A destination with a service access point is no Data_Exchange.
const HAS_SAP: u8 = 0x80;

/// The wire of our loop, which has brought its drives into operation and is left standing. Their last requests are sent
/// again, each as a new one.
pub struct BareWire {
    port: Rc<UnixStream>,
    /// By drive: whose slot it is due in, and its request.
    requests: Vec<(u32, Vec<u8>)>,
    /// The slot of the grid, and which drive is next in it.
    phase: u32,
    next: usize,
    sent: Time,
    /// The last request is not answered; its slot time is over so long after it was sent.
    owes: bool,
    within_ns: u64,
    answer: [u8; MAX],
    filled: usize,
    /// The wire is idle for so long before each request.
    idle_ns: u64,
    free_at: Time,
    _rig: Rig,
}

impl BareWire {
    /// The wire of `plan` with all drives in operation.
    pub fn open(plan: &ProfibusPlan, wait: Wait, period_ns: u64) -> io::Result<BareWire> {
        let taps = Taps::default();
        let cycle = rig::exchange_cycle(period_ns, wait);
        let mut rig = Rig::new(cycle, vec![Box::new(plan.clone())], Pace::Grid, &taps, Calls::default());
        rig.enable();
        let tap = taps.tap.into_inner().ok_or(ErrorKind::NotFound)?;
        let tap = tap.lock().unwrap_or_else(PoisonError::into_inner);
        let fd = tap.net.fd().ok_or(ErrorKind::NotFound)?;
        // SAFETY: the carrier keeps its descriptor open while it is locked.
        let port: UnixStream = unsafe { BorrowedFd::borrow_raw(fd) }.try_clone_to_owned()?.into();
        port.set_nonblocking(true)?;
        let requests = plan.drives.iter().map(|drive| {
            let request = tap.requests.get(&drive.address).ok_or(ErrorKind::NotFound)?;
            Ok((drive.axis.phase, request.clone()))
        });
        let requests: Vec<_> = requests.collect::<io::Result<_>>()?;
        let longest = requests.iter().map(|(_, request)| request.len()).max().unwrap_or(0);
        let within_ns = plan.line().span_ns(longest) + plan.slot_ns();
        Ok(BareWire {
            port: Rc::new(port),
            requests,
            phase: 0,
            next: 0,
            sent: Time(0),
            owes: false,
            within_ns,
            answer: [0; MAX],
            filled: 0,
            idle_ns: plan.line().bits_ns(plan.bits.idle.max(plan.bits.sync).into()),
            free_at: Time(0),
            _rig: rig,
        })
    }

    /// Until when the slot time of the last request lasts; `None`: it is answered, or that is over.
    pub fn overdue_at(&self, now: Time) -> Option<Time> {
        let at = self.sent + self.within_ns;
        (self.owes && now < at).then_some(at)
    }

    /// Its port.
    pub fn port(&self) -> Rc<UnixStream> {
        Rc::clone(&self.port)
    }

    /// Sends the first request of this slot, behind an answer that came too late. How many drives are due in it.
    pub fn begin(&mut self, phase: u32) -> io::Result<usize> {
        while self.owes && self.read()? {
            self.filled = 0;
        }
        (self.phase, self.next) = (phase, 0);
        let due = self.requests.iter().filter(|(of, _)| *of == phase).count();
        self.send()?;
        Ok(due)
    }

    /// Sends the next request of this slot, if there is one.
    pub fn send(&mut self) -> io::Result<()> {
        let Some(place) =
            (self.next..self.requests.len()).find(|place| self.requests[*place].0 == self.phase)
        else {
            return Ok(());
        };
        let request = &mut self.requests[place].1;
        (self.next, self.filled) = (place + 1, 0);
        let (fc, check) = (request[FC], request.len() - 2);
        request[FC] = fc ^ FCB;
        request[check] = request[check].wrapping_sub(fc).wrapping_add(fc ^ FCB);
        while MonotonicClock::read() < self.free_at {
            std::hint::spin_loop();
        }
        self.owes = true;
        self.sent = MonotonicClock::read();
        (&*self.port).write_all(request)
    }

    /// Takes in what there is; if that is all of an answer, when it was there and what it took, ns.
    pub fn receive(&mut self) -> io::Result<Option<(Time, u64)>> {
        self.read()?;
        let whole = self.filled > LENGTH && self.filled >= usize::from(self.answer[LENGTH]) + AROUND;
        if !whole {
            return Ok(None);
        }
        let at = MonotonicClock::read();
        self.owes = false;
        self.free_at = at + self.idle_ns;
        Ok(Some((at, at.since(self.sent))))
    }

    /// The last answer.
    pub fn answer(&self) -> &[u8] {
        &self.answer[..self.filled]
    }

    /// Whether there was something.
    fn read(&mut self) -> io::Result<bool> {
        match unless_blocked((&*self.port).read(&mut self.answer[self.filled..]))? {
            Some(0) => Err(ErrorKind::UnexpectedEof.into()),
            Some(count) => {
                self.filled += count;
                Ok(true)
            }
            None => Ok(false),
        }
    }
}

/// A carrier, and the last Data_Exchange to each station.
struct Tap {
    net: Box<dyn Serial>,
    requests: BTreeMap<u8, Vec<u8>>,
}

struct Tapped(Arc<Mutex<Tap>>);

/// The carriers of the operating system; keeps hold of the one that is opened.
#[derive(Default)]
struct Taps {
    os: Os,
    tap: RefCell<Option<Arc<Mutex<Tap>>>>,
}

impl Carriers for Taps {
    fn datagrams(&self, _: SocketAddrV4, _: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Err(ErrorKind::Unsupported.into())
    }

    fn serial(&self, port: &str, line: &SerialLine) -> io::Result<Box<dyn Serial>> {
        let net = self.os.serial(port, line)?;
        let tap = Arc::new(Mutex::new(Tap { net, requests: BTreeMap::new() }));
        self.tap.replace(Some(Arc::clone(&tap)));
        Ok(Box::new(Tapped(tap)))
    }
}

impl Tapped {
    fn lock(&self) -> MutexGuard<'_, Tap> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Streams for Tapped {
    fn fd(&self) -> Option<RawFd> {
        self.lock().net.fd()
    }

    fn opened(&mut self) -> Option<usize> {
        self.lock().net.opened()
    }

    fn look(&mut self) {
        self.lock().net.look();
    }

    fn ready(&mut self) -> Option<usize> {
        self.lock().net.ready()
    }

    fn receive(&mut self, index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        self.lock().net.receive(index, room)
    }

    fn send(&mut self, index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        let mut tap = self.lock();
        if bytes.first() == Some(&SD2)
            && let Some(&to) = bytes.get(DA)
            && to & HAS_SAP == 0
        {
            tap.requests.insert(to, bytes.to_vec());
        }
        tap.net.send(index, bytes)
    }

    fn abandon(&mut self, index: usize, why: &'static str) {
        self.lock().net.abandon(index, why);
    }

    fn has_ended(&self) -> bool {
        self.lock().net.has_ended()
    }

    fn notes(&self) -> LinkNotes {
        self.lock().net.notes()
    }

    fn waker(&self) -> Option<Waker> {
        self.lock().net.waker()
    }

    fn memory(&self, regions: &mut Regions) {
        self.lock().net.memory(regions);
    }
}

impl Serial for Tapped {
    fn unsent(&mut self) -> Result<usize, Broken> {
        self.lock().net.unsent()
    }

    fn discard(&mut self) -> Result<(), Broken> {
        self.lock().net.discard()
    }
}
