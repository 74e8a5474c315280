//! Sessions with a scripted drive: its bytes are written by hand, from the fact sheet of the drives.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::sync::Mutex;
use std::time::Duration;

use super::*;
use crate::exchange::{Connection, LoopEnd, both};
use crate::plan::{Delivery, Expected, Layout};
use crate::target;
use crate::wire::tests::hex;
use fieldbeat_core::axis::acyclic::Acyclic;
use fieldbeat_core::axis::doorbell::Bells;

mod acyclic;
mod any;
mod life;
mod openings;

const PERIOD_NS: u64 = 10 * MS;
const DRIVE: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 40);
/// Nothing is waited for by this time: calls are polled.
const LIMIT: Duration = Duration::from_secs(5);

/// A message of this command in session 0x101.
fn framed(command: u8, session: u32, context: u64, data: &[u8]) -> Vec<u8> {
    let length = u16::try_from(data.len()).unwrap().to_le_bytes();
    let parts: [&[u8]; 7] =
        [&[command, 0], &length, &session.to_le_bytes(), &[0; 4], &context.to_le_bytes(), &[0; 4], data];
    parts.concat()
}

const SESSION: u32 = 0x101;

/// An unconnected message with this context.
fn rr(context: u64, message: &str) -> Vec<u8> {
    rr_with(context, message, "02 00", "")
}

/// The same with other items behind it.
fn rr_with(context: u64, message: &str, count: &str, items: &str) -> Vec<u8> {
    let message = hex(message);
    let length = u16::try_from(message.len()).unwrap().to_le_bytes();
    let head = [hex("00 00 00 00 00 00"), hex(count), hex("00 00 00 00 B2 00")].concat();
    framed(0x6F, SESSION, context, &[head, length.to_vec(), message, hex(items)].concat())
}

/// A message on the connection with this id.
fn unit(connection: &str, sequence: u16, message: &str) -> Vec<u8> {
    let message = hex(message);
    let length = u16::try_from(message.len() + 2).unwrap().to_le_bytes();
    let head = [hex("00 00 00 00 00 00 02 00 A1 00 04 00"), hex(connection), hex("B1 00")].concat();
    let data = [head, length.to_vec(), sequence.to_le_bytes().to_vec(), message].concat();
    framed(0x70, SESSION, 0, &data)
}

const IDENTIFY: &str = "01 02 20 01 24 01";
/// Vendor 60, type 0x2B, product 0xB0, revision 1.2, status 0, serial 7, "STF05-IP".
const IDENTITY_REPLY: &str =
    "81 00 00 00 3C 00 2B 00 B0 00 01 02 00 00 07 00 00 00 08 53 54 46 30 35 2D 49 50";
const PROFILE: &str = "0E 03 20 64 24 00 30 01";
/// Board 251.0, model 0xB0.
const SECOND: &str = "8E 00 00 00 00 FB 00 00 41 B0 00 01 03 4A";
/// Board 117.7: the example of the Host Command Reference.
const FIRST: &str = "8E 00 00 00 00 75 00 07 41 5F 00 01 03 4A";
/// The golden opening of the sheet, which tshark decodes without complaint.
/// Serial 1, T->O id 0x00010001, 10 ms, 16 intervals.
const OPEN: &str = "54 02 20 06 24 01 0A 0E 00 00 00 00 01 00 01 00 01 00 34 12 EE FF C0 00 02 00 00 00 10 \
     27 00 00 46 48 10 27 00 00 3A 48 01 04 20 04 24 66 2C 70 2C 65";
const OPENED: &str =
    "D4 00 00 00 13 00 01 5A 01 00 01 00 01 00 34 12 EE FF C0 00 10 27 00 00 10 27 00 00 00 00";
const CLOSE: &str = "4E 02 20 06 24 01 0A 0E 01 00 34 12 EE FF C0 00 04 00 20 04 24 66 2C 70 2C 65";
const CLOSED: &str = "CE 00 00 00 01 00 34 12 EE FF C0 00 00 00";
const PROBE: &str = "0E 03 20 01 24 01 30 01";
const PROBED: &str = "8E 00 00 00 3C 00";

/// A serial number as it stands on the wire.
fn wire(serial: u16) -> String {
    let [low, high] = serial.to_le_bytes();
    format!("{low:02X} {high:02X}")
}

/// A refusal of the opening with this serial number.
fn refused(serial: u16, status: &str) -> String {
    format!("D4 00 {status} {} 34 12 EE FF C0 00 00 00", wire(serial))
}

/// The message with this serial number, which an opening and its answer have in an id, too.
fn of(serial: u16, message: &str) -> String {
    let serial = wire(serial);
    let both = format!("{serial} 01 00 {serial} 34 12");
    message.replace("01 00 01 00 01 00 34 12", &both).replace("01 00 34 12", &format!("{serial} 34 12"))
}

/// A session with a scripted drive, and the loop's end.
struct Bench {
    session: Session,
    loop_end: LoopEnd,
    acyclic: Acyclic,
    now: Time,
    state: HandshakeState,
    out: Vec<u8>,
    /// The context of the last request.
    context: u64,
}

impl Bench {
    /// Of the second drive of a bus, at 1 ms: its first serial number is 1.
    fn new(change: impl FnOnce(&mut EthernetIpPlan)) -> Bench {
        Bench::with_groups(change, None)
    }

    fn with_groups(change: impl FnOnce(&mut EthernetIpPlan), groups: Option<Arc<dyn Groups>>) -> Bench {
        let drives = [Ipv4Addr::new(10, 0, 0, 39), DRIVE]
            .map(|ip| MoonsDrive { expected: Expected::ANY, ..MoonsDrive::new("x", ip) })
            .into();
        let mut plan = EthernetIpPlan::new(Ipv4Addr::new(10, 0, 0, 1), drives);
        plan.originator = Originator { vendor: 0x1234, serial: 0x00C0_FFEE };
        change(&mut plan);
        let (loop_end, end) = both(Bells::new(1).bell(0));
        let (acyclic, port) = Acyclic::alone(16, target::commanding(), Arc::new(crate::notation::Addresses));
        let session = Session::new(&plan, 1, PERIOD_NS, end, port, groups);
        let (now, state) = (Time(MS), HandshakeState::More);
        Bench { session, loop_end, acyclic, now, state, out: Vec::new(), context: 0 }
    }

    /// With the drive changed only.
    fn of_drive(change: impl FnOnce(&mut MoonsDrive)) -> Bench {
        Bench::new(|plan| change(&mut plan.drives[1]))
    }

    /// One that has just registered and identified a drive of the second version.
    fn registered(change: impl FnOnce(&mut MoonsDrive)) -> Bench {
        let mut bench = Bench::of_drive(change);
        bench.register(SECOND);
        bench
    }

    /// One whose opening is under way.
    fn opening() -> Bench {
        let mut bench = Bench::registered(|_| ());
        bench.request(OPEN);
        bench
    }

    /// One whose class 1 connection is open; its loop has received that.
    fn running(change: impl FnOnce(&mut MoonsDrive)) -> Bench {
        let mut bench = Bench::registered(change);
        bench.trade(OPEN, OPENED);
        bench.news();
        bench
    }

    /// TCP is open, and the session registered and identified, with this profile code.
    fn register(&mut self, profile: &str) {
        self.begin();
        self.trade(IDENTIFY, IDENTITY_REPLY);
        self.trade(PROFILE, profile);
    }

    fn begin(&mut self) {
        self.state = self.session.begin(self.now, &mut self.out);
        self.context += 1;
        assert_eq!(self.taken(), framed(0x65, 0, self.context, &hex("01 00 00 00")));
        self.receive(&framed(0x65, SESSION, self.context, &hex("01 00 00 00")));
    }

    /// The sent bytes.
    fn taken(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.out)
    }

    /// Just this unconnected message was sent.
    #[track_caller]
    fn request(&mut self, message: &str) {
        self.context += 1;
        assert_eq!(self.taken(), rr(self.context, message));
    }

    #[track_caller]
    fn silence(&mut self) {
        assert_eq!(self.taken(), Vec::<u8>::new());
    }

    /// These bytes arrive, each on its own.
    fn receive(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.state = self.session.take(self.now, &[*byte], &mut self.out);
        }
    }

    /// The answer to the last unconnected request.
    fn answer(&mut self, message: &str) {
        self.receive(&rr(self.context, message));
    }

    /// Just this was sent, and is answered with that.
    #[track_caller]
    fn trade(&mut self, message: &str, answer: &str) {
        self.request(message);
        self.answer(answer);
    }

    /// The loop wishes something, and the session sees it.
    fn wish(&mut self, wish: Wish) {
        self.loop_end.wish(wish);
        self.pass(LOOK_NS);
    }

    /// The session was unregistered, and nothing else sent.
    #[track_caller]
    fn unregisters(&mut self) {
        assert_eq!(self.taken(), framed(0x66, SESSION, 0, &[]));
    }

    /// Lets `ns` pass, with a look at each due instant.
    fn pass(&mut self, ns: u64) {
        let until = self.now + ns;
        while let Some(due) = self.session.next_due().filter(|due| *due <= until) {
            self.now = due.max(self.now);
            self.look();
            if let HandshakeState::Failed(_) = self.state {
                return;
            }
        }
        self.now = until;
    }

    fn look(&mut self) {
        self.state = self.session.run(self.now, &mut self.out);
        if self.session.phase == Phase::Absent {
            // As its carrier does.
            self.out.clear();
        }
    }

    fn lose(&mut self) {
        self.session.closed(self.now, "lost");
        self.out.clear();
    }

    /// The news that the loop has received.
    fn news(&mut self) -> Vec<News> {
        std::iter::from_fn(|| self.loop_end.news()).collect()
    }

    fn note(&self) -> String {
        self.session.notes().get(0).unwrap_or_default()
    }

    #[track_caller]
    fn says(&self, part: &str) {
        assert!(self.note().contains(part), "{part}: {}", self.note());
    }

    #[track_caller]
    fn failed(&self) -> &str {
        match &self.state {
            HandshakeState::Failed(why) => why,
            other => panic!("{other:?}"),
        }
    }
}

fn connection() -> Connection {
    Connection {
        generation: 1,
        outgoing: 0x5A01_0013,
        incoming: 0x0001_0001,
        destination: SocketAddrV4::new(DRIVE, 2222),
        source: DRIVE,
        outgoing_api_ns: PERIOD_NS,
        incoming_api_ns: PERIOD_NS,
        timeout_ns: 160 * MS,
        outputs: Outputs::Owned,
        version: Version::V2,
        layout: Layout::Manual,
    }
}

const READ_NOTHING: News = News::Read(Facts { homed: None });
