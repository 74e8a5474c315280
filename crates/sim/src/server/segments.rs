//! A segment behind a real socket: on a network interface, or local to this host.

use std::io;
use std::os::fd::BorrowedFd;
use std::sync::Mutex;

use nix::sys::epoll::{Epoll, EpollEvent, EpollFlags};

use super::sockets::SharedBus;
use super::{BusStats, lock};
use crate::SimSegment;
use crate::fault::Way;
use crate::wire::Wire;
use fieldbeat_core::net::Frames;
use fieldbeat_core::net::local::{self, Local};
use fieldbeat_core::net::packet::Packet;
use fieldbeat_core::time::Time;

/// A segment, its wire and its socket.
pub(super) struct Segment {
    wire: Wire,
    carrier: Box<dyn Frames>,
}

impl Segment {
    pub(super) fn open(segment: Box<dyn SimSegment>) -> io::Result<Segment> {
        Ok(Segment { carrier: carrier(&*segment)?, wire: Wire::new(segment) })
    }
}

impl SharedBus for Segment {
    fn stats(&self) -> BusStats {
        BusStats::new(self.wire.segment().interface())
    }

    fn watch(&self, epoll: &Epoll, token: u64) -> nix::Result<()> {
        let Some(fd) = self.carrier.fd() else { return Ok(()) };
        // SAFETY: the carrier keeps its descriptor open, and the epoll has forgotten it when it is closed.
        let fd = unsafe { BorrowedFd::borrow_raw(fd) };
        epoll.add(fd, EpollEvent::new(EpollFlags::EPOLLIN, token))
    }

    fn next_due(&self) -> Option<Time> {
        self.wire.next_due()
    }

    /// Takes one frame and puts it under way, through the faults.
    fn ready(&mut self, _number: u32, room: &mut [u8], _epoll: &Epoll, _token: u64, stats: &Mutex<BusStats>) {
        let Some((now, length)) = self.carrier.receive(room) else { return };
        // Longer than any frame: there is none.
        let Some(frame) = room.get(..length) else { return };
        self.wire.depart(Way::Request, now, now, frame);
        let mut stats = lock(stats);
        stats.received += 1;
        stats.injected = self.wire.injected();
    }

    /// Everything that is due by now: frames through the segment, and back to the kernel. A frame passes the
    /// segment at its arrival time, however late this thread runs: otherwise the slaves' clocks would show the
    /// delay. Its time on the segment is a part of this thread's time.
    fn run_due(&mut self, stats: &Mutex<BusStats>) {
        if self.wire.next_due().is_none() {
            return;
        }
        let now = self.carrier.now();
        while let Some((at, way, mut parcel)) = self.wire.take(now) {
            match way {
                Way::Request => {
                    let comes_back = self.wire.pass(at, now, &mut parcel.bytes);
                    let mut stats = lock(stats);
                    stats.lost += u64::from(!comes_back);
                    stats.injected = self.wire.injected();
                }
                Way::Reply => {
                    let sent = self.carrier.send(&parcel.bytes).is_ok();
                    let mut stats = lock(stats);
                    *(if sent { &mut stats.answered } else { &mut stats.unsent }) += 1;
                }
            }
            self.wire.recycle(way, parcel);
        }
    }
}

/// The socket at the segment's end of the cable.
fn carrier(segment: &dyn SimSegment) -> io::Result<Box<dyn Frames>> {
    let interface = segment.interface();
    let Some(name) = local::name(interface) else {
        let Some(own) = segment.own_interface() else {
            let message = format!(
                "cannot simulate the segment on {interface}: name the interface at the other end of its \
                 cable, or use one like {}line",
                local::PREFIX
            );
            return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
        };
        return Ok(Box::new(Packet::serve(own, segment.ethertype())?));
    };
    match Local::serve(name) {
        Ok(local) => Ok(Box::new(local)),
        Err(error) if error.kind() == io::ErrorKind::AddrInUse => {
            let message = format!(
                "{interface} is taken: another simulation serves it; end it, or give the segment another name"
            );
            Err(io::Error::new(error.kind(), message))
        }
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;
    use crate::fault::Injected;
    use crate::server::{ServerOptions, SimServer};
    use crate::testing::Tally;
    use crate::{FaultPlan, Simulated};

    use fieldbeat_core::net::{Carriers, Os};

    /// A segment that no other test has.
    fn name(what: &str) -> String {
        format!("{}server-{what}-{}", local::PREFIX, std::process::id())
    }

    fn start(name: &str) -> io::Result<SimServer> {
        serve(Tally::new(name, FaultPlan::default()))
    }

    fn serve(segment: Tally) -> io::Result<SimServer> {
        let segments: Vec<Box<dyn SimSegment>> = vec![Box::new(segment)];
        SimServer::start(Simulated { segments, ..Simulated::default() }, ServerOptions::default())
    }

    fn receive(carrier: &mut dyn Frames, patience: Duration) -> Option<Vec<u8>> {
        let (begin, mut room) = (Instant::now(), [0; 64]);
        loop {
            match carrier.receive(&mut room) {
                Some((_, length)) => return Some(room[..length].to_vec()),
                None if begin.elapsed() > patience => return None,
                None => std::thread::sleep(Duration::from_micros(50)),
            }
        }
    }

    const LONG: Duration = Duration::from_secs(60);
    const SHORT: Duration = Duration::from_millis(20);

    #[test]
    fn a_line_answers_each_frame_and_counts() {
        let name = name("answers");
        let mut server = start(&name).unwrap();
        let mut master = Os::default().frames(&name, Tally::TYPE).unwrap();
        for number in 0..20 {
            master.send(&[number, 0, 9]).unwrap();
            assert_eq!(receive(&mut *master, LONG), Some(vec![number, 2, 9]));
        }
        // Longer than any frame.
        master.send(&vec![0; 70_000]).unwrap();
        master.send(&[99, 0]).unwrap();
        assert_eq!(receive(&mut *master, LONG), Some(vec![99, 2]));
        server.end();
        let [stats] = &server.buses()[..] else { panic!() };
        assert_eq!((stats.interface.as_str(), stats.received, stats.answered), (name.as_str(), 21, 21));
        assert_eq!((stats.lost, stats.unsent, stats.injected), (0, 0, Injected::default()));
        assert!(server.stats().is_empty());
        assert!(master.send(&[1]).is_err(), "it is closed");
    }

    #[test]
    #[ignore = "makes a network of its own: needs root"]
    fn a_line_at_the_other_end_of_a_cable_answers_the_same_way() {
        use nix::sched::{CloneFlags, unshare};
        unshare(CloneFlags::CLONE_NEWNET).expect("it runs as root");
        for arguments in ["link add near0 type veth peer name far0", "link set near0 up", "link set far0 up"]
        {
            let done = std::process::Command::new("ip").args(arguments.split(' ')).status().unwrap();
            assert!(done.success(), "ip {arguments}");
        }
        let mut server = serve(Tally::new("near0", FaultPlan::default()).at("far0")).unwrap();
        let mut master = Os::default().frames("near0", Tally::TYPE).unwrap();
        let mut frame = [0xFF; 29];
        frame[12..14].copy_from_slice(&Tally::TYPE.to_be_bytes());
        for _ in 0..20 {
            frame[1] = 0;
            master.send(&frame).unwrap();
            frame[1] = 2;
            assert_eq!(receive(&mut *master, LONG).as_deref(), Some(&frame[..]));
        }
        assert!(receive(&mut *master, SHORT).is_none());
        server.end();
        assert_eq!((server.buses()[0].received, server.buses()[0].answered), (20, 20));
    }

    #[test]
    fn a_segment_that_is_served_already_or_has_no_other_end_is_refused() {
        let name = name("twice");
        let first = start(&name).unwrap();
        let error = start(&name).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::AddrInUse);
        assert!(error.to_string().contains("another simulation serves it"), "{error}");
        drop(first);
        assert!(start(&name).is_ok());
        let error = start("eth9").unwrap_err();
        assert!(error.to_string().contains("the other end of its cable"), "{error}");
    }
}
