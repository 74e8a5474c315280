use super::*;
use std::net::Ipv4Addr;

const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 41136);
const DRIVE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2), 49360);

#[test]
fn the_counters_account_for_every_request() {
    let stormy = FaultPlan {
        seed: 7,
        drop: 0.1,
        duplicate: 0.1,
        corrupt: 0.1,
        delay: 0.1,
        delay_ns: 900,
        reorder: 0.1,
        stall: 0.01,
        stall_ns: 5_000,
        restart: 0.01,
        sto: 0.01,
        sto_ns: 3,
        wrong_id: 0.1,
        answer_ns: 100,
        ..FaultPlan::default()
    };
    let (mut injector, mut queue) = (Injector::new(stormy, Carrier::Datagrams), Queue::new(64));
    let (mut arrived, mut restarts) = (0, 0);
    // One a microsecond, and time for the last ones to arrive.
    for n in 0..20_100_u64 {
        let now = Time(n * 1_000);
        if n < 20_000 {
            let request = Datagram { from: MASTER, to: DRIVE, bytes: &n.to_le_bytes() };
            let fault = injector.pass(Way::Request, now, now, request, <[u8]>::reverse, &mut queue);
            restarts += u64::from(fault == Some(DriveFault::Restart));
        }
        while let Some((_, parcel)) = queue.pop(now) {
            arrived += 1;
            queue.recycle(parcel);
        }
    }
    assert_eq!((queue.next_due(), queue.overflowed()), (None, 0));
    let i = injector.injected();
    assert_eq!(restarts, i.restarts);
    // One may still be held back at the end.
    let missing = 20_000 + i.duplicated - i.dropped - i.stalled - i.restarts - arrived;
    assert!(missing <= 1, "{missing}");
    for (name, count) in [
        ("drop", i.dropped),
        ("duplicate", i.duplicated),
        ("corrupt", i.corrupted),
        ("delay", i.delayed),
        ("reorder", i.reordered),
    ] {
        assert!((1_000..2_500).contains(&count), "{name}: {count}");
    }
    assert!(i.stalls > 50 && i.stalled >= 4 * i.stalls && i.restarts > 50, "{i:?}");
    assert_eq!(i.wrong_id, 0);
}

#[test]
fn the_queue_is_ordered_bounded_and_uses_its_buffers_again() {
    let mut queue = Queue::new(3);
    for (due, byte) in [(30, 1), (10, 2), (30, 3), (20, 4)] {
        let parcel = queue.parcel(Datagram { from: MASTER, to: DRIVE, bytes: &[byte] });
        queue.push(Time(due), parcel);
    }
    assert_eq!((queue.overflowed(), queue.next_due()), (1, Some(Time(10))));
    assert!(queue.pop(Time(9)).is_none());
    let order: Vec<_> = std::iter::from_fn(|| queue.pop(Time(99))).map(|(_, p)| p.bytes[0]).collect();
    assert_eq!(order, [2, 1, 3]);
}
