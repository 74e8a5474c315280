//! Simulated drives between which and the world somebody listens: all that passes, whatever the master makes of it.

use std::net::SocketAddrV4;
use std::sync::{Arc, Mutex};

use fieldbeat::sim::{SimDrive, SimSegment, SimSerial, Simulated};
use fieldbeat::time::Time;

use crate::between::{Between, Message, Sender, Shared};

/// What passed: when, and the bytes.
pub type Passed = Vec<(Time, Vec<u8>)>;

/// What was sent to a drive, and by it; of a segment its frames, as they came to it and as they returned.
#[derive(Clone, Debug, Default)]
pub struct Both {
    pub to: Passed,
    pub from: Passed,
}

type Log = Arc<Mutex<Both>>;

/// The logs of a machine: those of its drives by address, then of its segments, then of the drives of its serial wires.
#[derive(Debug, Default)]
pub struct Logs {
    drives: Vec<(SocketAddrV4, Log)>,
    segments: Vec<Log>,
    serial: Vec<Log>,
}

impl Logs {
    /// Listens to all of these drives; of those with several sockets, to this one.
    pub fn of(simulated: &mut Simulated, socket: usize) -> Logs {
        let mut logs = Logs::default();
        for drive in std::mem::take(&mut simulated.drives) {
            let log = Log::default();
            logs.drives.push((drive.address(), Arc::clone(&log)));
            let socket = if drive.more_sockets().is_empty() { 0 } else { socket };
            simulated.drives.push(Box::new(Shared::new(Drive { socket, drive, log })));
        }
        for segment in std::mem::take(&mut simulated.segments) {
            let log = Log::default();
            logs.segments.push(Arc::clone(&log));
            simulated.segments.push(Box::new(Segment { segment, log }));
        }
        for wire in &mut simulated.wires {
            for drive in std::mem::take(&mut wire.drives) {
                let log = Log::default();
                logs.serial.push(Arc::clone(&log));
                wire.drives.push(Box::new(Serial { drive, log }));
            }
        }
        logs
    }

    /// Of the drive at this address.
    pub fn drive(&self, address: SocketAddrV4) -> Both {
        let (_, log) = self.drives.iter().find(|(other, _)| *other == address).expect("there is a drive");
        log.lock().unwrap().clone()
    }

    /// Of the only segment.
    pub fn segment(&self) -> Both {
        self.segments[0].lock().unwrap().clone()
    }

    /// Of the first drive of the only serial wire.
    pub fn serial(&self) -> Both {
        self.serial[0].lock().unwrap().clone()
    }
}

struct Drive {
    drive: Box<dyn SimDrive>,
    /// Which of its sockets is listened to.
    socket: usize,
    log: Log,
}

impl Between for Drive {
    fn drive(&mut self) -> &mut dyn SimDrive {
        &mut *self.drive
    }

    fn run(&mut self, now: Time, send: &mut Sender<'_>) {
        let Drive { drive, socket, log } = self;
        drive.run(now, &mut |from, to, bytes| {
            if from == *socket {
                log.lock().unwrap().from.push((now, bytes.to_vec()));
            }
            send(from, to, bytes);
        });
    }

    fn receive(&mut self, message: Message<'_>, reply: &mut Vec<u8>) -> Option<SocketAddrV4> {
        let to = message.reaches(&mut *self.drive, reply);
        if message.socket == self.socket {
            let mut log = self.log.lock().unwrap();
            log.to.push((message.now, message.bytes.to_vec()));
            if to.is_some() {
                log.from.push((message.now, reply.clone()));
            }
        }
        to
    }
}

struct Segment {
    segment: Box<dyn SimSegment>,
    log: Log,
}

impl SimSegment for Segment {
    crate::forward_sim_line!(this => *this.segment);

    crate::forward! { this => this.segment;
        fn interface(&self) -> &str;
        fn own_interface(&self) -> Option<&str>;
        fn slaves(&self) -> usize;
        fn advance(&mut self, now: Time);
        fn restart(&mut self, now: Time, place: usize);
    }

    fn pass(&mut self, now: Time, frame: &mut [u8]) -> bool {
        let mut log = self.log.lock().unwrap();
        log.to.push((now, frame.to_vec()));
        let returns = self.segment.pass(now, frame);
        if returns {
            log.from.push((now, frame.to_vec()));
        }
        returns
    }
}

struct Serial {
    drive: Box<dyn SimSerial>,
    log: Log,
}

impl SimSerial for Serial {
    fn receive(&mut self, now: Time, bytes: &[u8]) {
        self.log.lock().unwrap().to.push((now, bytes.to_vec()));
        self.drive.receive(now, bytes);
    }

    crate::forward! { this => this.drive;
        fn next_due(&self) -> Option<Time>;
        fn mislabel(&self, telegram: &mut [u8]);
        fn restart(&mut self, now: Time);
        fn open_sto(&mut self, until: Time);
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) {
        let begin = out.len();
        self.drive.run(now, out);
        if out.len() > begin {
            self.log.lock().unwrap().from.push((now, out[begin..].to_vec()));
        }
    }
}
