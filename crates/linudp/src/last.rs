//! The last resort: the stop of LinMot drives by control words alone, when the loop cannot send one any more.
//!
//! A LinUDP drive has no watchdog: after a loop that hangs it runs to its target and stays powered. What is sent here
//! holds without the newest state of the conversation. It carries no motion command, so no count that could start one,
//! and no parameter channel. /Abort = 0 brakes by the drive's quick stop and keeps the axis controlled, so that no load
//! drops (sheet, 3.1); /Freeze would run on when it is released, and OFF3 ends in power off. The telegrams leave from
//! the socket of the loop, since a drive may obey its first master only (single-master filter), and by its port alone.
//!
//! As in the stop sequence of the master, power goes off where the stop plan says so when no standstill is seen: none
//! is seen here, since nothing is received.

use std::net::{SocketAddrV4, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

use super::plan::LinUdpDrive;
use super::wire::{ControlWord, REQUEST_MAX, Request, ResponseDef};
use fieldbeat_core::axis::plan::{StopHow, StopTimeout};
use fieldbeat_core::bus::LastResort;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::{MS, nanos};

/// For how long the last phase is repeated at least, ns: a drive takes a request within milliseconds, and switches,
/// queues of the host and a busy drive may hold one up for some more.
const REPEATED_NS: u64 = 250 * MS;

/// What the newest request that left says of the drive's power.
#[derive(Clone, Debug, Default)]
pub(super) struct PowerSent(Arc<AtomicU8>);

/// No control word was sent: the drive is not commanded.
const UNTOUCHED: u8 = 0;
const OFF: u8 = 1;
const ON: u8 = 2;

impl PowerSent {
    /// A request with this control word has left.
    pub(super) fn note(&self, control: Option<ControlWord>) {
        let Some(control) = control else { return };
        self.0.store(if control.has(ControlWord::SWITCH_ON) { ON } else { OFF }, Ordering::Relaxed);
    }

    /// Adds the memory that it touches, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.0);
    }
}

/// The last resort of the drives of one socket.
#[derive(Debug)]
pub(super) struct LastStop {
    socket: UdpSocket,
    drives: Box<[Drive]>,
    halt: Telegram,
    off: Telegram,
}

#[derive(Debug)]
struct Drive {
    address: SocketAddrV4,
    sent: PowerSent,
    /// Power goes off then, ns after the wires were taken.
    off_after_ns: Option<u64>,
    /// Its last phase has begun then.
    last_after_ns: u64,
}

/// A request of a control word alone, ready to be sent.
#[derive(Debug)]
struct Telegram {
    bytes: [u8; REQUEST_MAX],
    length: usize,
}

impl Telegram {
    fn new(control: ControlWord) -> Telegram {
        let mut bytes = [0; REQUEST_MAX];
        let request =
            Request { response_def: ResponseDef::STATUS, control: Some(control), ..Request::default() };
        let length = request.emit(&mut bytes);
        Telegram { bytes, length }
    }
}

impl LastStop {
    /// That of these drives, over a twin of their socket.
    pub(super) fn new<'a>(
        socket: UdpSocket,
        drives: impl Iterator<Item = (&'a LinUdpDrive, PowerSent)>,
    ) -> LastStop {
        let drive = |(drive, sent): (&LinUdpDrive, PowerSent)| {
            let stop = &drive.axis.stop;
            let timeout_ns = nanos(stop.timeout);
            let off_after_ns = match (stop.how, stop.on_timeout) {
                (StopHow::Coast, _) => Some(0),
                (_, StopTimeout::Disable) => Some(timeout_ns),
                (_, StopTimeout::Hold) => None,
            };
            Drive {
                address: drive.address,
                sent,
                off_after_ns,
                last_after_ns: off_after_ns.unwrap_or(timeout_ns),
            }
        };
        LastStop {
            socket,
            drives: drives.map(drive).collect(),
            halt: Telegram::new(ControlWord::ABORT),
            off: Telegram::new(ControlWord::BASE),
        }
    }
}

impl LastResort for LastStop {
    fn send(&mut self, since_ns: u64) {
        for drive in &self.drives {
            let telegram = match drive.sent.0.load(Ordering::Relaxed) {
                UNTOUCHED => continue,
                // Switch On = 1 would switch it on.
                OFF => &self.off,
                _ if drive.off_after_ns.is_some_and(|after| since_ns >= after) => &self.off,
                _ => &self.halt,
            };
            // One that the host refuses is sent again with the next turn.
            let _ = self.socket.send_to(&telegram.bytes[..telegram.length], drive.address);
        }
    }

    fn over_after_ns(&self) -> u64 {
        let last = self.drives.iter().map(|drive| drive.last_after_ns).max().unwrap_or(0);
        last.saturating_add(REPEATED_NS)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use fieldbeat_core::net::Datagrams;
    use fieldbeat_core::net::UdpOptions;
    use fieldbeat_core::net::udp::Udp;
    use fieldbeat_core::time::S;

    /// Sheet, 2.3 and 3.1: a control word alone, and the status word in reply.
    const ABORT: [u8; 10] = [0x01, 0, 0, 0, 0x01, 0, 0, 0, 0x2F, 0];
    const SWITCH_OFF: [u8; 10] = [0x01, 0, 0, 0, 0x01, 0, 0, 0, 0x3E, 0];

    /// A drive's socket, and the last resort of a master that has one drive with this stop plan.
    struct Bench {
        drive: UdpSocket,
        master: Udp,
        last: LastStop,
        sent: PowerSent,
    }

    impl Bench {
        fn new(how: StopHow, on_timeout: StopTimeout) -> Bench {
            let drive = UdpSocket::bind("127.0.0.1:0").unwrap();
            drive.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
            let options = UdpOptions { peers: 1, waiting: 0, room: 128, dscp: 0, groups: 0 };
            let master = Udp::bind("127.0.0.1:0".parse().unwrap(), &options).unwrap();
            let mut plan = LinUdpDrive::new("x", [127, 0, 0, 1].into());
            plan.address.set_port(drive.local_addr().unwrap().port());
            let stop = &mut plan.axis.stop;
            (stop.how, stop.on_timeout, stop.timeout) = (how, on_timeout, Duration::from_secs(3));
            let sent = PowerSent::default();
            let last = LastStop::new(master.twin().unwrap().unwrap(), [(&plan, sent.clone())].into_iter());
            Bench { drive, master, last, sent }
        }

        /// What the drive gets so long after the wires were taken.
        fn gets(&mut self, since_ns: u64) -> Vec<u8> {
            self.last.send(since_ns);
            let mut bytes = [0; 64];
            let (length, from) = self.drive.recv_from(&mut bytes).unwrap();
            let of_loop = self.master.twin().unwrap().unwrap().local_addr().unwrap();
            assert_eq!(from, of_loop, "a drive may obey this address only");
            bytes[..length].to_vec()
        }
    }

    #[test]
    fn a_powered_drive_is_halted_and_held_and_then_switched_off_if_its_plan_says_so() {
        let mut bench = Bench::new(StopHow::Ramp, StopTimeout::Disable);
        bench.sent.note(Some(ControlWord::HOME));
        assert_eq!(bench.gets(0), ABORT);
        assert_eq!(bench.gets(3 * S - 1), ABORT);
        assert_eq!(bench.gets(3 * S), SWITCH_OFF);
        assert_eq!(bench.last.over_after_ns(), 3 * S + REPEATED_NS);

        let mut bench = Bench::new(StopHow::Quick, StopTimeout::Hold);
        bench.sent.note(Some(ControlWord::ON));
        assert_eq!((bench.gets(0), bench.gets(3_600 * S)), (ABORT.to_vec(), ABORT.to_vec()));
        assert_eq!(bench.last.over_after_ns(), 3 * S + REPEATED_NS);

        let mut bench = Bench::new(StopHow::Coast, StopTimeout::Hold);
        bench.sent.note(Some(ControlWord::ON));
        assert_eq!(bench.gets(0), SWITCH_OFF);
        assert_eq!(bench.last.over_after_ns(), REPEATED_NS);
    }

    #[test]
    fn a_drive_that_is_off_is_not_switched_on_and_one_that_is_not_commanded_gets_nothing() {
        let mut bench = Bench::new(StopHow::Ramp, StopTimeout::Hold);
        bench.sent.note(None);
        bench.last.send(0);
        bench.drive.set_nonblocking(true).unwrap();
        assert!(bench.drive.recv(&mut [0; 64]).is_err());
        bench.drive.set_nonblocking(false).unwrap();
        for word in [ControlWord::ON, ControlWord::ACKNOWLEDGE] {
            bench.sent.note(Some(word));
        }
        assert_eq!(bench.gets(0), SWITCH_OFF);
        // A request without a control word changes nothing.
        bench.sent.note(Some(ControlWord::ON));
        bench.sent.note(None);
        assert_eq!(bench.gets(0), ABORT);
    }
}
