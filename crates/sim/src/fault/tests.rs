use super::*;
use std::net::Ipv4Addr;

const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 41136);
const DRIVE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2), 49360);

fn stormy() -> FaultPlan {
    FaultPlan {
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
        split: 0.0,
        cut: 0.0,
        segment_loss: 0.0,
        lost_byte: 0.0,
        answer_ns: 100,
    }
}

type Arrived = Vec<(u64, SocketAddrV4, Vec<u8>)>;

/// Which of `count` numbered datagrams arrive, one sent each microsecond.
fn run(plan: FaultPlan, way: Way, count: u32) -> (Arrived, Injected, u64) {
    let mut injector = Injector::new(plan, Carrier::Datagrams);
    let mut queue = Queue::new(64);
    let (mut arrived, mut restarts) = (Vec::new(), 0);
    for n in 0..u64::from(count) + 100 {
        let now = Time(n * 1_000);
        if n < u64::from(count) {
            let (from, to) = if way == Way::Request { (MASTER, DRIVE) } else { (DRIVE, MASTER) };
            let bytes = &n.to_le_bytes();
            let fault =
                injector.pass(way, now, now, Datagram { from, to, bytes }, <[u8]>::reverse, &mut queue);
            restarts += u64::from(fault == Some(DriveFault::Restart));
        }
        while let Some((due, parcel)) = queue.pop(now) {
            arrived.push((due.0, parcel.from, parcel.bytes.clone()));
            queue.recycle(parcel);
        }
    }
    assert_eq!((queue.next_due(), queue.overflowed()), (None, 0));
    (arrived, injector.injected(), restarts)
}

#[test]
fn the_counters_account_for_every_request() {
    let (arrived, i, restarts) = run(stormy(), Way::Request, 20_000);
    assert_eq!(restarts, i.restarts);
    let lost = i.dropped + i.stalled + i.restarts;
    // One may still be held back at the end.
    let missing = 20_000 + i.duplicated - lost - arrived.len() as u64;
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
