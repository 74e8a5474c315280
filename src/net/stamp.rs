//! Arrival times by the kernel's stamps, however late a socket is read (socket(7), SO_TIMESTAMPNS).

use std::io;
use std::mem::{size_of, zeroed};
use std::os::fd::{AsRawFd, OwnedFd};

use crate::rt::MonotonicClock;
use crate::time::{S, Time};

/// Lets the kernel stamp what arrives at `socket`.
pub(super) fn switch_on(socket: &OwnedFd) -> io::Result<()> {
    let on: libc::c_int = 1;
    // SAFETY: the kernel reads one int.
    let result = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_TIMESTAMPNS,
            (&raw const on).cast(),
            size_of::<libc::c_int>() as libc::socklen_t,
        )
    };
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// Reads one datagram without waiting: its arrival time, and its length; `room` has as many of its bytes as fit.
/// Its sender is written to `from`, with its length.
pub(super) fn receive<A>(
    socket: &OwnedFd,
    room: &mut [u8],
    from: Option<(&mut A, &mut libc::socklen_t)>,
) -> Option<(Time, usize)> {
    let mut piece = libc::iovec { iov_base: room.as_mut_ptr().cast(), iov_len: room.len() };
    let mut control = [0_u64; 8];
    // SAFETY: all bytes zero are an empty message.
    let mut message: libc::msghdr = unsafe { zeroed() };
    message.msg_iov = &raw mut piece;
    message.msg_iovlen = 1;
    message.msg_control = control.as_mut_ptr().cast();
    message.msg_controllen = size_of_val(&control);
    let mut length = None;
    if let Some((address, room)) = from {
        message.msg_name = (&raw mut *address).cast();
        message.msg_namelen = size_of::<A>() as libc::socklen_t;
        length = Some(room);
    }
    let flags = libc::MSG_DONTWAIT | libc::MSG_TRUNC;
    // SAFETY: the kernel writes at most the lengths of live values into them.
    let count = unsafe { libc::recvmsg(socket.as_raw_fd(), &raw mut message, flags) };
    let count = usize::try_from(count).ok()?;
    if let Some(length) = length {
        *length = message.msg_namelen;
    }
    Some((arrived_at(&message), count))
}

/// When `message` arrived, by the clock of all other stamps; now, if the kernel does not report it.
fn arrived_at(message: &libc::msghdr) -> Time {
    let now = MonotonicClock::read();
    // SAFETY: the kernel has filled the control buffer of a live message.
    let head = unsafe { libc::CMSG_FIRSTHDR(message).as_ref() };
    let Some(head) =
        head.filter(|head| (head.cmsg_level, head.cmsg_type) == (libc::SOL_SOCKET, libc::SCM_TIMESTAMPNS))
    else {
        return now;
    };
    // SAFETY: such a control message carries a timespec, wherever it is aligned.
    let stamp: libc::timespec = unsafe { libc::CMSG_DATA(head).cast::<libc::timespec>().read_unaligned() };
    // SAFETY: a timespec is plain numbers.
    let mut today: libc::timespec = unsafe { zeroed() };
    // SAFETY: the kernel writes a live value.
    unsafe { libc::clock_gettime(libc::CLOCK_REALTIME, &raw mut today) };
    let ns = |time: libc::timespec| i128::from(time.tv_sec) * 1_000_000_000 + i128::from(time.tv_nsec);
    // The wall clock may have been set meanwhile.
    let ago = u64::try_from(ns(today) - ns(stamp)).ok().filter(|ago| *ago < S);
    Time(now.0.saturating_sub(ago.unwrap_or(0)))
}
