//! Lost TCP segments on real sockets: our master and our simulated drive, and a socket filter that loses what comes.
//!
//! Both ends are sockets of this program. The filter acts before the segment is acknowledged, as a bad cable would.

use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::time::Duration;

use fieldbeat::Master;
use fieldbeat::axis::Health;
use fieldbeat::bus::modbus::UnidriveDrive;
use fieldbeat::time::MS;
use fieldbeat_sim::modbus::UnidriveSettings;
use nix::sys::socket::{SockaddrIn, getpeername, getsockname};

use super::{PORT, drive, plan, serve};
use crate::support::{LONG, Machine, until};

/// Of so many segments one is lost.
const ONE_OF: u32 = 100;
/// So many are waited for.
const LOST: u32 = 30;

/// The descriptors of this program's ends of connections with `address`.
fn ends(address: SocketAddrV4) -> Vec<RawFd> {
    let all = std::fs::read_dir("/proc/self/fd").unwrap().flatten();
    let is_end = |fd: &RawFd| {
        let own = getsockname::<SockaddrIn>(*fd).ok().map(SocketAddrV4::from);
        let peer = getpeername::<SockaddrIn>(*fd).ok().map(SocketAddrV4::from);
        peer.is_some() && [own, peer].contains(&Some(address))
    };
    all.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).filter(is_end).collect()
}

/// Loses one of [`ONE_OF`] segments that come to this socket. A connection that has ended meanwhile loses nothing.
fn lose(fd: RawFd) {
    let one = |code: u32, jt, jf, k| libc::sock_filter { code: code as u16, jt, jf, k };
    let random = (libc::SKF_AD_OFF + 56) as u32; // SKF_AD_RANDOM
    let mut filter = [
        one(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, 0, 0, random),
        one(libc::BPF_JMP | libc::BPF_JGE | libc::BPF_K, 0, 1, u32::MAX / ONE_OF),
        one(libc::BPF_RET | libc::BPF_K, 0, 0, u32::MAX),
        one(libc::BPF_RET | libc::BPF_K, 0, 0, 0),
    ];
    let program = libc::sock_fprog { len: filter.len() as u16, filter: filter.as_mut_ptr() };
    // SAFETY: the kernel reads a program of four instructions, which outlives the call.
    unsafe {
        libc::setsockopt(
            fd,
            libc::SOL_SOCKET,
            libc::SO_ATTACH_FILTER,
            (&raw const program).cast(),
            size_of_val(&program) as libc::socklen_t,
        );
    }
}

/// Segments that this socket's host has repeated.
fn repeated(fd: RawFd) -> u32 {
    // SAFETY: all-zero bytes are a tcp_info: it has numbers only.
    let mut info: libc::tcp_info = unsafe { std::mem::zeroed() };
    let mut length = size_of_val(&info) as libc::socklen_t;
    let at = (&raw mut info).cast();
    // SAFETY: the kernel writes at most so many bytes, and the structure outlives the call.
    unsafe { libc::getsockopt(fd, libc::IPPROTO_TCP, libc::TCP_INFO, at, &raw mut length) };
    info.tcpi_total_retrans
}

/// How many segments were repeated, and how often the link was lost, if a reply counts for so long.
fn lost(test: u8, reply_within_ns: u64) -> (u32, u64) {
    let machine = Machine::new(test);
    let address = SocketAddrV4::new(machine.ip(11), PORT);
    let mut drive = drive(address);
    (drive.reply_within_ns, drive.axis.divisor) = (reply_within_ns, 4);
    drive.axis.health = Health::default();
    let _server = serve([UnidriveSettings::new(address)]);
    let master = Master::from_plan(plan(drive)).start().unwrap();
    master.wait_online(LONG).unwrap();
    let (mut before, mut all) = (Vec::new(), 0);
    let enough = until(LONG * 3, || {
        master.alive();
        let now: Vec<(RawFd, u32)> = ends(address).into_iter().map(|fd| (fd, repeated(fd))).collect();
        for (fd, count) in &now {
            lose(*fd);
            let known = before.iter().find(|(other, _)| other == fd).map_or(0, |(_, count)| *count);
            // A connection that is opened again begins at 0.
            all += if *count >= known { count - known } else { *count };
        }
        before = now;
        std::thread::sleep(Duration::from_millis(5));
        all >= LOST
    });
    let losses = master.finish().end.drives[0].losses;
    assert!(enough, "{all} segments repeated, {losses} links lost");
    (all, losses)
}

/// A segment that is lost twice in a row costs it all the same.
#[test]
#[ignore = "needs root: a socket filter, which a kernel may refuse to others"]
fn a_lost_segment_costs_no_link_with_the_usual_time_of_a_reply() {
    let usual = UnidriveDrive::new("m", [127, 0, 0, 1].into()).reply_within_ns;
    let (segments, links) = lost(23, usual);
    println!("{links} links lost by {segments} segments");
    assert!(links * 5 <= segments.into(), "{links} links lost by {segments} segments");
    let (segments, links) = lost(24, 50 * MS);
    println!("{links} links lost by {segments} segments");
    assert!(links * 5 >= segments.into(), "{links} links lost by {segments} segments");
}
