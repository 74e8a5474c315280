//! Multicast groups on loopback.

use super::*;
use crate::net::link::tests::{descriptors, wakes};
use crate::net::set_option;
use crate::rt::testing::in_own_process;

/// A group that no other test has.
fn group(x: u8, number: u8) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(239, 71, x, number), 41136)
}

fn carrier(x: u8, groups: usize) -> (Udp, Arc<dyn Groups>) {
    let udp = Udp::bind(address(x, 1), &UdpOptions { groups, ..options(4) }).unwrap();
    let groups = udp.groups().unwrap();
    (udp, groups)
}

/// The datagrams to groups leave by the loopback interface.
fn sender(x: u8, host: u8) -> UdpSocket {
    let socket = peer(x, host);
    let interface = libc::in_addr { s_addr: address(x, host).ip().to_bits().to_be() };
    set_option(&socket, libc::IPPROTO_IP, libc::IP_MULTICAST_IF, interface).unwrap();
    socket
}

#[test]
fn multicast_is_received_from_join_to_leave() {
    let (mut udp, groups) = carrier(20, 2);
    let drive = sender(20, 9);
    let from = address(20, 9);
    let (first, second) = (group(20, 1), group(20, 2));
    drive.send_to(&[0], first).unwrap();
    groups.join(first).unwrap();
    drive.send_to(&[1], first).unwrap();
    // The loop finds the socket and what has come there meanwhile.
    assert_eq!(receive(&mut udp, 1), [(from, vec![1], false)]);
    drive.send_to(&[2], first).unwrap();
    assert!(wakes(udp.fd(), 60 * crate::time::S));
    drive.send_to(&[3], address(20, 1)).unwrap();
    drive.send_to(&[4], second).unwrap();
    let mut got = receive(&mut udp, 2);
    got.sort();
    assert_eq!(got, [(from, vec![2], false), (from, vec![3], false)]);
    // Joined twice, left twice.
    groups.join(first).unwrap();
    groups.join(second).unwrap();
    groups.leave(first);
    drive.send_to(&[5], first).unwrap();
    drive.send_to(&[6], second).unwrap();
    let mut got = receive(&mut udp, 2);
    got.sort();
    assert_eq!(got, [(from, vec![5], false), (from, vec![6], false)]);
    groups.leave(first);
    groups.leave(first);
    drive.send_to(&[7], first).unwrap();
    drive.send_to(&[8], second).unwrap();
    assert_eq!(receive(&mut udp, 1), [(from, vec![8], false)]);
    assert_eq!(udp.dropped(), 0);
}

#[test]
fn two_masters_of_a_host_each_get_a_copy() {
    let (mut first, its_groups) = carrier(21, 1);
    let (mut second, other_groups) = carrier(22, 1);
    its_groups.join(group(21, 1)).unwrap();
    other_groups.join(group(21, 1)).unwrap();
    sender(21, 9).send_to(&[7], group(21, 1)).unwrap();
    for udp in [&mut first, &mut second] {
        assert_eq!(receive(udp, 1), [(address(21, 9), vec![7], false)]);
    }
}

#[test]
fn thousands_of_joins_and_leaves_leave_nothing_behind() {
    in_own_process("net::udp::tests::groups::thousands_of_joins_and_leaves_leave_nothing_behind", || {
        let before = descriptors();
        let (mut udp, groups) = carrier(25, 3);
        let drive = sender(25, 9);
        for round in 0..3_000_u32 {
            let group = group(25, (round % 3) as u8);
            groups.join(group).unwrap();
            if round % 7 == 0 {
                drive.send_to(&[9], group).unwrap();
                assert_eq!(receive(&mut udp, 1), [(address(25, 9), vec![9], false)]);
            }
            groups.leave(group);
            drive.send_to(&[8], group).unwrap();
        }
        assert_eq!(udp.receive(&mut |_| ()).unwrap(), 0, "nobody has joined them");
        // The carrier goes first.
        drop(udp);
        for _ in 0..1_000 {
            groups.join(group(25, 1)).unwrap();
            groups.leave(group(25, 1));
            groups.leave(group(25, 9));
        }
        drop((groups, drive));
        assert_eq!(descriptors(), before);
    });
}
