//! Another master on the segment, by its frames.
//!
//! Each frame of this master begins with its mark: a frame without it was sent by somebody else. Such frames arrive
//! here behind a hub or a tap, from a master at the far end of the segment, and from another program on the same
//! interface; the source address proves nothing, since that program has the same one. They count as another master's
//! only if they are whole EtherCAT frames of one sender and one kind, and if they come again and again: the last frames
//! of a master that has ended may arrive in a burst.
//!
//! What nobody here has changed in a slave is the second evidence (`segment::slave`). A slave that leaves OP by itself
//! sets the error bit of its AL status (ETG.1000.6), one that another master takes down does not; one in INIT may have
//! restarted, unless AL control holds a request that is not from here. A station address is nobody else's than a
//! master's, as long as no other slave can stand there. Settings that read back otherwise were written by somebody, and
//! the slave is set up from INIT. Statusword and
//! mode of a drive (6041h, 6061h) are no evidence: its terminal and its own reactions change them too.

use super::image::Mark;
use super::wire::frame::{FRAME_MAX, Mac, datagrams, source};
use fieldbeat_core::net::{Frames, local};
use fieldbeat_core::time::{MS, S, Time};

/// The number of frames of one sender that are another master's ...
const FRAMES: u8 = 3;
/// ... if each comes so long after the one before, ns: not in a burst ...
const APART_NS: u64 = 5 * MS;
/// ... and no later than this, ns: the longest period that is recognised.
const WITHIN_NS: u64 = 100 * MS;
/// Without a frame for so long, ns, the other master is gone.
const GONE_NS: u64 = S;
/// Before the first frame of this master the segment is listened to for so long, ns: three frames of a master with a
/// period of up to 30 ms.
const LISTEN_NS: u64 = 100 * MS;

/// The watch for another master's frames.
#[derive(Clone, Copy, Debug, Default)]
pub struct OtherMaster {
    sender: Option<Sender>,
    /// The frames so far, and when the last one of them came.
    frames: u8,
    last: Time,
    /// When it was last proved to be there.
    proved: Option<Time>,
}

/// Who sends frames, and which: a master repeats those of its cycle, and damage is different each time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Sender {
    mac: Mac,
    /// The mark of another instance of this program.
    mark: Option<u32>,
    /// Command and address of the first datagram.
    first: (u8, u32),
}

impl Sender {
    fn of(received: &[u8]) -> Option<Sender> {
        let mac = source(received)?;
        let mut datagrams = datagrams(received).ok()?;
        let first = datagrams.next()?.ok()?;
        let whole = datagrams.all(|datagram| datagram.is_ok());
        let mark = Mark::of(received).map(|mark| mark.master);
        whole.then_some(Sender { mac, mark, first: (first.number, first.address) })
    }
}

impl OtherMaster {
    /// Takes a frame that this master has not sent. True with each frame that completes a proof.
    pub fn see(&mut self, at: Time, received: &[u8]) -> bool {
        let Some(sender) = Sender::of(received) else { return false };
        let since = at.since(self.last);
        if self.sender.is_none() || since > WITHIN_NS {
            (self.sender, self.frames, self.last) = (Some(sender), 1, at);
            return false;
        }
        // A third sender is proved once the second is silent.
        if self.sender != Some(sender) || since < APART_NS {
            return false;
        }
        (self.frames, self.last) = (self.frames.saturating_add(1), at);
        if self.frames < FRAMES {
            return false;
        }
        self.proved = Some(at);
        true
    }

    /// It was proved, and has not been silent since.
    pub fn is_there(&self, now: Time) -> bool {
        self.proved.is_some_and(|at| now.since(at) <= GONE_NS)
    }
}

/// Listens on a real interface before anything is sent there; the address of another master that has frames on it.
/// On a segment of this host frames return to their sender only, and in virtual time nothing happens meanwhile.
/// For normal threads.
pub fn listen(interface: &str, net: &mut dyn Frames) -> Option<Mac> {
    net.fd().filter(|_| local::name(interface).is_none())?;
    let (mut other, mut room, until) = (OtherMaster::default(), [0; FRAME_MAX], net.now() + LISTEN_NS);
    loop {
        if let Some((at, length)) = net.receive(&mut room) {
            if other.see(at, room.get(..length).unwrap_or_default()) {
                return other.sender.map(|sender| sender.mac);
            }
            continue;
        }
        let now = net.now();
        if now >= until {
            return None;
        }
        let left_ms = u8::try_from(until.since(now) / MS + 1).unwrap_or(u8::MAX);
        net.wait(left_ms);
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::cell::Cell;
    use std::os::fd::RawFd;

    use super::*;
    use crate::wire::frame::{BROADCAST, Builder, Command};
    use fieldbeat_core::net::frames::Unsent;
    use fieldbeat_core::rt::Regions;

    fn frame(mac: Mac, mark: Option<[u8; 8]>) -> Vec<u8> {
        let mut room = [0; FRAME_MAX];
        let mut frame = Builder::new(&mut room, BROADCAST, mac).unwrap();
        if let Some(mark) = mark {
            frame.push_with(Command::Nop, 0, &mark);
        }
        frame.push_with(Command::Brd(0x0130), 1, &[0; 2]);
        let length = frame.finish();
        room[..length].to_vec()
    }

    /// A network interface on which frames arrive at these instants, ms; time passes while it is waited for.
    pub(crate) struct Interface {
        now: Cell<Time>,
        arriving: std::collections::VecDeque<(u64, Vec<u8>)>,
        fd: Option<RawFd>,
    }

    impl Interface {
        pub(crate) fn new(arriving: Vec<(u64, Vec<u8>)>, fd: Option<RawFd>) -> Interface {
            Interface { now: Cell::new(Time(S)), arriving: arriving.into(), fd }
        }
    }

    impl Frames for Interface {
        fn fd(&self) -> Option<RawFd> {
            self.fd
        }

        fn send(&mut self, _frame: &[u8]) -> Result<Time, Unsent> {
            panic!("nothing is sent before it was listened")
        }

        fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
            let (ms, frame) = self.arriving.pop_front_if(|(ms, _)| Time(S + *ms * MS) <= self.now.get())?;
            room[..frame.len()].copy_from_slice(&frame);
            Some((Time(S + ms * MS), frame.len()))
        }

        fn now(&mut self) -> Time {
            self.now.get()
        }

        fn mac(&self) -> Mac {
            [0x10; 6]
        }

        fn memory(&self, _regions: &mut Regions) {}

        fn wait(&self, most_ms: u8) {
            assert!(most_ms > 0);
            self.now.set(self.now.get() + MS);
        }
    }

    /// Who has frames there, and for how long it was listened to, ms.
    fn found(interface: &str, fd: Option<RawFd>, arriving: Vec<(u64, Vec<u8>)>) -> (Option<Mac>, u64) {
        let mut net = Interface::new(arriving, fd);
        let mac = listen(interface, &mut net);
        (mac, net.now().since(Time(S)) / MS)
    }

    #[test]
    fn another_master_on_an_interface_is_found_before_the_first_frame() {
        let cyclic =
            |period: u64| (0..50).map(|n| (2 + n * period, frame([0x20; 6], None))).collect::<Vec<_>>();
        let other = Some([0x20; 6]);
        for (period, after) in [(1, 12), (4, 18), (10, 22), (30, 62)] {
            assert_eq!(found("eth1", Some(0), cyclic(period)), (other, after), "{period} ms");
        }
        // Another instance of this program has the address of this one.
        let own = (0..9).map(|n| (n * 5, frame([0x10; 6], Some([7; 8])))).collect();
        assert_eq!(found("eth1", Some(0), own), (Some([0x10; 6]), 10));
        for nothing in [vec![], vec![(3, frame([0x20; 6], None))], vec![(4, frame([0x20; 6], None)); 20]] {
            assert_eq!(found("eth1", Some(0), nothing), (None, LISTEN_NS / MS), "a burst at most");
        }
        // Where frames return to their sender only, and where no time passes, nobody waits.
        assert_eq!(found("local:line", Some(0), cyclic(1)), (None, 0));
        assert_eq!(found("eth1", None, cyclic(1)), (None, 0));
    }

    #[test]
    fn another_master_is_present_until_it_was_silent_for_a_second() {
        let (mut other, good) = (OtherMaster::default(), frame([0x10; 6], None));
        let begin = Time(S);
        assert!(!other.is_there(begin));
        let proofs = (0..5).filter(|n| other.see(begin + n * 10 * MS, &good)).count();
        assert_eq!(proofs, 3, "each further frame proves it again");
        assert!(other.is_there(begin + 40 * MS + S) && !other.is_there(begin + 41 * MS + S));
    }
}
