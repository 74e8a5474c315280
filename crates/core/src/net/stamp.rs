//! Arrival times by the kernel's stamps, however late a socket is read (socket(7), SO_TIMESTAMPNS).

use std::io::IoSliceMut;
use std::os::fd::{AsRawFd, OwnedFd};

use nix::sys::socket::{ControlMessageOwned, MsgFlags, SockaddrLike, recvmsg};
use nix::time::{ClockId, clock_gettime};

use crate::rt::MonotonicClock;
use crate::time::{S, Time};

/// Reads one datagram without waiting: its arrival time, its length, and its sender; `room` has as many of its bytes as
/// fit.
pub(super) fn receive<A: SockaddrLike>(
    socket: &OwnedFd,
    room: &mut [u8],
) -> Option<(Time, usize, Option<A>)> {
    let mut control = [0; 64];
    let mut pieces = [IoSliceMut::new(room)];
    let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_TRUNC;
    let message = recvmsg::<A>(socket.as_raw_fd(), &mut pieces, Some(&mut control), flags).ok()?;
    let now = MonotonicClock::read();
    let stamp = message.cmsgs().ok()?.find_map(|message| match message {
        ControlMessageOwned::ScmTimestampns(stamp) => Some(stamp),
        _ => None,
    });
    let ns = |seconds: i64, ns: i64| i128::from(seconds) * i128::from(S) + i128::from(ns);
    // By the clock of all other stamps; now, if the kernel does not report it, or the wall clock was set meanwhile.
    let ago = stamp.zip(clock_gettime(ClockId::CLOCK_REALTIME).ok()).and_then(|(stamp, today)| {
        let ago = ns(today.tv_sec(), today.tv_nsec()) - ns(stamp.tv_sec(), stamp.tv_nsec());
        u64::try_from(ago).ok().filter(|ago| *ago < S)
    });
    Some((Time(now.0.saturating_sub(ago.unwrap_or(0))), message.bytes, message.address))
}
