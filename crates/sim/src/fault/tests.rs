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
        inhibit: 0.01,
        inhibit_ns: 3,
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
fn no_fault_is_no_fault() {
    let (arrived, injected, restarts) = run(FaultPlan::default(), Way::Request, 1_000);
    assert_eq!((injected, restarts), (Injected::default(), 0));
    let numbers: Vec<_> = (0..1_000u64).map(|n| (n * 1_000, MASTER, n.to_le_bytes().to_vec())).collect();
    assert_eq!(arrived, numbers);
}

#[test]
fn the_same_seed_makes_the_same_faults_and_another_seed_others() {
    let (first, counts, _) = run(stormy(), Way::Reply, 5_000);
    assert_eq!((&first, counts), (&run(stormy(), Way::Reply, 5_000).0, counts));
    assert_ne!(first, run(FaultPlan { seed: 8, ..stormy() }, Way::Reply, 5_000).0);
}

#[test]
fn the_faults_of_streams_change_nothing_for_datagrams() {
    for way in [Way::Request, Way::Reply] {
        let plan = FaultPlan { split: 1.0, cut: 1.0, segment_loss: 1.0, ..stormy() };
        assert_eq!(run(plan, way, 2_000), run(stormy(), way, 2_000));
    }
}

#[test]
fn the_two_directions_do_not_disturb_each_other() {
    let reply = Datagram { from: DRIVE, to: MASTER, bytes: &[1, 2, 3] };
    let drain = |queue: &mut Queue| {
        std::iter::from_fn(|| queue.pop(Time(u64::MAX))).map(|(due, p)| (due, p.from, p.bytes)).collect()
    };
    let (mut alone, mut mixed) =
        (Injector::new(stormy(), Carrier::Datagrams), Injector::new(stormy(), Carrier::Datagrams));
    let mut queue = Queue::new(8);
    for n in 0..1_000 {
        alone.pass(Way::Reply, Time(n), Time(n), reply, <[u8]>::reverse, &mut queue);
        let expected: Vec<_> = drain(&mut queue);
        for _ in 0..n % 3 {
            let request = Datagram { from: MASTER, to: DRIVE, bytes: &[4] };
            mixed.pass(Way::Request, Time(n), Time(n), request, <[u8]>::reverse, &mut queue);
            let _: Vec<_> = drain(&mut queue);
        }
        mixed.pass(Way::Reply, Time(n), Time(n), reply, <[u8]>::reverse, &mut queue);
        let got: Vec<_> = drain(&mut queue);
        assert_eq!(got, expected);
    }
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
fn each_fault_does_what_its_name_says() {
    let number = |bytes: &[u8]| u64::from_le_bytes(bytes.try_into().unwrap());
    let only = |f: fn(&mut FaultPlan)| {
        let mut plan = FaultPlan { seed: 1, delay_ns: 1_500, answer_ns: 100, ..FaultPlan::default() };
        f(&mut plan);
        run(plan, Way::Reply, 1_000)
    };
    let sent = |n: usize| n as u64;

    let (arrived, i, _) = only(|plan| plan.drop = 0.5);
    assert_eq!(arrived.len() as u64, 1_000 - i.dropped);

    let (arrived, i, _) = only(|plan| plan.corrupt = 1.0);
    assert_eq!(i.corrupted, 1_000);
    assert!(arrived.iter().enumerate().all(|(n, a)| (number(&a.2) ^ sent(n)).count_ones() == 1));

    let (arrived, i, _) = only(|plan| plan.delay = 1.0);
    assert_eq!(i.delayed, 1_000);
    assert!(arrived.iter().enumerate().all(|(n, a)| a.0 == sent(n) * 1_000 + 1_600));

    let (arrived, i, _) = only(|plan| plan.duplicate = 1.0);
    assert_eq!((i.duplicated, arrived.len()), (1_000, 2_000));

    let (arrived, i, _) = only(|plan| plan.reorder = 1.0);
    assert_eq!(i.reordered, 500);
    assert!(arrived.iter().enumerate().all(|(n, a)| number(&a.2) == sent(n) ^ 1));

    let (arrived, i, _) = only(|plan| plan.wrong_id = 0.5);
    let wrong = arrived.iter().filter(|a| a.1 == wrong_port(DRIVE)).count() as u64;
    assert!(wrong == i.wrong_id && (400..600).contains(&wrong));
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

#[test]
fn whatever_overtakes_whatever_arrives_in_its_order() {
    let mut random = fastrand::Rng::with_seed(3);
    let (mut queue, mut model) = (Queue::new(1_000), Vec::new());
    for n in 0..5_000_u64 {
        let due = n + if random.u8(..4) == 0 { random.u64(..50) } else { 10 };
        let bytes = n.to_le_bytes();
        let parcel = queue.parcel(Datagram { from: MASTER, to: DRIVE, bytes: &bytes });
        queue.push(Time(due), parcel);
        model.push((due, n));
        if random.u8(..8) == 0 {
            model.sort_unstable();
            let (come, left) = model.split_at(model.partition_point(|(due, _)| *due <= n));
            for (due, number) in come {
                let (at, parcel) = queue.pop(Time(n)).unwrap();
                assert_eq!((at, &parcel.bytes[..]), (Time(*due), &number.to_le_bytes()[..]));
                queue.recycle(parcel);
            }
            assert_eq!(queue.next_due(), left.first().map(|(due, _)| Time(*due)));
            model = left.to_vec();
        }
    }
}
