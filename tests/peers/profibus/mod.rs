//! PROFIBUS DP: masters of others and our simulated slaves, and our master and others' decoder. Each master is at one
//! end of a cable between two pseudo-terminals, the slaves are at the other one.
//!
//! `programs` is pyprofibus, commanded by lines; profirust is the package `tests/peers/profirust`. No package has a
//! slave, and none has DP-V1: what our slaves and acyclic access do beyond DP-V0 is not judged here.

mod cable;
mod masters;
mod own;
mod telegrams;

use std::sync::{Arc, Mutex};

use fieldbeat::Time;
use fieldbeat::axis::Profile;
use fieldbeat::bus::profibus::{LenzeDrive, Numbers, ParameterPath, ProfibusPlan};
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::sim::{SimSerial, Simulated};
use fieldbeat::time::{MS, S};
use fieldbeat_profibus::wire::dp::Watchdog;
use fieldbeat_sim::profibus::{Broken, DpState, Events, LenzeSim, Misuse, ProfibusSegment};

use self::cable::Cable;

/// The address of each master.
const OWN: u8 = 2;
/// A drive with the DRIVECOM channel, one with the PKW channel, and one with neither, whose parameters are read and
/// written by DP-V1.
const DRIVECOM: u8 = 7;
const PKW: u8 = 8;
const PLAIN: u8 = 9;
/// Of the cable and of what is at its end: they are hardware, and do not wait for whatever else this computer does.
const PRIORITY: i32 = 70;
/// Longer than a busy computer makes anybody wait.
const WATCHDOG_NS: u64 = 10 * S;
/// No master is looked for at this address and beyond.
const HIGHEST: u8 = 8;

/// A wire at this port. Slow: a request takes its way through three threads of this computer and the kernel's, and
/// back.
fn plan(port: &str) -> ProfibusPlan {
    let drive = |address: u8| {
        let mut drive = LenzeDrive::new(format!("l{address}"), address);
        drive.watchdog.timeout_ns = Some(WATCHDOG_NS);
        drive.axis.profile = Profile { velocity: 5.0, acceleration: 100.0, deceleration: 100.0 };
        drive.axis.limits.velocity = Some(20.0);
        drive.axis.stop.deceleration = 100.0;
        drive.axis.jog_deadman = None;
        drive.axis.health.bucket = 1_000;
        (drive.axis.divisor, drive.axis.phase) = (100, 33 * u32::from(address - DRIVECOM));
        drive
    };
    let mut drives = vec![drive(DRIVECOM), drive(PKW), drive(PLAIN)];
    drives[1].parameters = ParameterPath::Pkw { pause: true };
    // 8 bytes each way: with SD2, or in the form that is always so long, SD3.
    (drives[2].channel, drives[2].configuration) = (false, vec![0xF3]);
    drives[2].parameters = ParameterPath::Msac1 { slot: 0, index: 47, axis: 0, numbers: Numbers::FromTop };
    let mut plan = ProfibusPlan::new(port, 1_500_000, drives);
    (plan.bits.latency_ns, plan.retries) = (30 * MS, 3);
    (plan.highest_address, plan.gap) = (HIGHEST, Some(10));
    plan
}

/// The watchdog's factors in Set_Prm.
fn watchdog_factors() -> [u8; 2] {
    Watchdog::at_least((WATCHDOG_NS / (10 * MS)) as u32).unwrap().factors
}

/// What a slave has seen of its master.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    misuse: Misuse,
    broken: Broken,
    events: Events,
    state: Option<(DpState, Option<u8>)>,
}

/// A slave that shows what it has seen.
struct Watched {
    slave: LenzeSim,
    seen: Arc<Mutex<Seen>>,
}

impl Watched {
    fn show(&self) {
        let Watched { slave, seen } = self;
        *seen.lock().unwrap() = Seen {
            misuse: slave.misuse(),
            broken: slave.broken(),
            events: slave.events(),
            state: Some(slave.dp_state()),
        };
    }
}

impl SimSerial for Watched {
    fn receive(&mut self, now: Time, bytes: &[u8]) {
        self.slave.receive(now, bytes);
        self.show();
    }

    fn next_due(&self) -> Option<Time> {
        self.slave.next_due()
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) {
        self.slave.run(now, out);
        self.show();
    }

    fn untimed(&mut self) {
        self.slave.untimed();
    }

    fn mislabel(&self, telegram: &mut [u8]) {
        self.slave.mislabel(telegram);
    }

    fn restart(&mut self, now: Time) {
        self.slave.restart(now);
    }

    fn open_sto(&mut self, until: Time) {
        self.slave.open_sto(until);
    }
}

/// The slaves of a plan, at their end of a cable.
struct Slaves {
    seen: Vec<Arc<Mutex<Seen>>>,
    _server: SimServer,
}

impl Slaves {
    fn new(plan: &ProfibusPlan, cable: &Cable) -> Slaves {
        let mut segment = ProfibusSegment::of(plan);
        segment.own_port = Some(cable.drives.clone());
        for drive in &mut segment.drives {
            // One diagnosis behind Chk_Cfg is enough.
            drive.dp.ready_ns = 0;
            drive.link.sd3 = drive.address == PLAIN;
        }
        let (mut wire, mut seen) = (segment.wire(), Vec::new());
        for (place, settings) in segment.drives.iter().enumerate() {
            let watched = Watched { slave: LenzeSim::new(settings, segment.line()), seen: Arc::default() };
            seen.push(Arc::clone(&watched.seen));
            wire.drives[place] = Box::new(watched);
        }
        let options = ServerOptions { priority: Some(PRIORITY as u8), ..ServerOptions::default() };
        let simulated = Simulated { wires: vec![wire], ..Simulated::default() };
        Slaves { seen, _server: SimServer::start(simulated, options).unwrap() }
    }

    fn seen(&self) -> Vec<Seen> {
        self.seen.iter().map(|seen| *seen.lock().unwrap()).collect()
    }

    /// Nothing that their master sent was wrong, or came to them broken. If it did not wait for each answer, what it
    /// repeats may be another telegram than before, and bytes may mix: the rest still holds.
    fn have_no_complaint(&self, cable: &Cable) {
        let in_turns = cable.is_in_turns(&[DRIVECOM, PKW, PLAIN]);
        for mut seen in self.seen() {
            if !in_turns {
                let Misuse { changed_retry, job, handshake, acyclic, .. } = seen.misuse;
                seen.misuse = Misuse { changed_retry: 0, job: 0, handshake: 0, acyclic: 0, ..seen.misuse };
                println!("talked over: {changed_retry} {job} {handshake} {acyclic} {:?}", seen.broken);
                seen.broken = Broken::default();
            }
            assert_eq!((seen.misuse, seen.broken), (Misuse::default(), Broken::default()), "{seen:?}");
        }
    }
}
