//! What is split, held up, lost and repeated on a stream, and a plug that is out.

use super::*;

#[test]
fn a_lost_segment_comes_after_the_hosts_timeout_and_what_follows_waits_behind_it() {
    let mut rig = Rig::open(1);
    let lossy = |segment_loss| FaultPlan { segment_loss, ..FaultPlan::default() };
    // The request is lost once, the seed says.
    let seed = (0..).find(|seed| {
        let mut losses = Injector::new(FaultPlan { seed: *seed, ..lossy(0.5) }, Carrier::Stream);
        let mut queue = Queue::new(4);
        let request = Datagram { from: drive(9), to: drive(0), bytes: &[1] };
        losses.pass(Way::Request, Time(0), Time(0), request, |_| {}, &mut queue);
        queue.next_due() == Some(Time(RETRANSMISSION_NS))
    });
    let plan = FaultPlan { seed: seed.unwrap(), ..lossy(0.5) };
    assert!(rig.world.set_faults(drive(0), plan));
    let begin = rig.world.now();
    rig.request(0, 1).unwrap();
    rig.world.set_faults(drive(0), FaultPlan::default());
    rig.pass(MS);
    rig.request(0, 2).unwrap();
    let mut set = PollSet::default();
    assert!(!rig.world.clock().wait(&mut set, begin + RETRANSMISSION_NS + 2 * LATENCY - 1));
    assert!(rig.world.clock().wait(&mut set, begin + S));
    assert_eq!(rig.world.now(), begin + RETRANSMISSION_NS + 2 * LATENCY);
    rig.pass(0);
    assert_eq!(rig.received[0], [1, 2, 2, 3]);
    // From now on nothing waits.
    let begin = rig.world.now();
    rig.request(0, 3).unwrap();
    assert!(rig.world.clock().wait(&mut set, begin + S));
    assert_eq!(rig.world.now(), begin + 2 * LATENCY);
}

#[test]
fn a_segment_lost_again_and_again_comes_after_doubled_timeouts_unless_its_connection_is_closed() {
    let mut rig = Rig::open(1);
    let all = FaultPlan { segment_loss: 1.0, ..FaultPlan::default() };
    assert!(rig.world.set_faults(drive(0), all));
    rig.request(0, 1).unwrap();
    assert_eq!(rig.world.injected(drive(0)).unwrap().segments, 10);
    rig.world.set_faults(drive(0), FaultPlan::default());
    let begin = rig.world.now();
    let timeouts = (1 << 10) - 1;
    assert!(!rig.world.clock().wait(&mut PollSet::default(), begin + timeouts * RETRANSMISSION_NS - MS));
    rig.carrier.abandon(0, "it takes too long");
    rig.open[0] = false;
    rig.opened(0);
    rig.request(0, 2).unwrap();
    rig.pass(S);
    // The handshake is the second request that the drive gets.
    assert_eq!((&rig.received[0][..], rig.connected(0)), (&[2, 3][..], 1));
}

#[test]
fn a_short_loss_of_the_plug_loses_no_request_and_a_long_one_no_reply_that_is_under_way() {
    let mut rig = Rig::open(1);
    rig.request(0, 1).unwrap();
    assert!(rig.world.unplug(drive(0)));
    rig.pass(100 * MS);
    rig.request(0, 2).unwrap();
    rig.pass(100 * MS);
    assert!(rig.received[0].is_empty() && rig.broken.is_empty());
    assert!(rig.world.plug(drive(0)));
    rig.request(0, 3).unwrap();
    rig.pass(MS);
    assert_eq!(rig.received[0], [1, 2, 2, 3, 3, 4]);
    // It is no longer counted as silent.
    rig.pass(2 * S);
    rig.request(0, 4).unwrap();
    rig.world.advance(LATENCY);
    assert!(rig.world.unplug(drive(0)));
    rig.pass(3 * S);
    // Its host has acknowledged all that was sent.
    assert!(rig.received[0].len() == 6 && rig.broken.is_empty());
    assert!(rig.world.plug(drive(0)));
    rig.pass(MS);
    assert_eq!(rig.received[0][6..], [4, 5]);
}

#[test]
fn a_long_loss_of_the_plug_breaks_the_connection_and_it_comes_back_with_the_plug() {
    let mut rig = Rig::open(1);
    assert!(rig.world.unplug(drive(0)));
    rig.request(0, 1).unwrap();
    let begin = rig.world.now();
    // As long as the peer's host may not acknowledge, from when it should have.
    assert!(!rig.world.clock().wait(&mut PollSet::default(), begin + S + LATENCY - 1));
    rig.pass(MS);
    assert_eq!(rig.broken, [(0, Broken::Failed(libc::ETIMEDOUT))]);
    rig.pass(10 * S);
    let note = rig.carrier.notes().get(0).unwrap();
    assert!(note.contains("no answer"), "{note}");
    // The drive knows nothing of it yet ...
    assert_eq!(rig.connected(0), 1);
    assert!(rig.world.plug(drive(0)));
    assert_eq!(rig.connected(0), 0);
    let back = rig.world.now();
    assert!(rig.opened(0).since(back) < 4 * S);
    rig.request(0, 2).unwrap();
    rig.pass(MS);
    // ... and never gets what was sent on the old one.
    assert_eq!(rig.received[0], [2, 3]);
}

#[test]
fn without_the_plug_the_wire_takes_a_window_and_no_more() {
    let mut rig = Rig::open(1);
    assert!(rig.world.unplug(drive(0)));
    let taken = (0..2 * WINDOW).filter(|_| {
        let taken = rig.request(0, 1).unwrap().1;
        rig.world.advance(LATENCY);
        taken > 0
    });
    assert_eq!(taken.count(), WINDOW / 2);
    assert!(rig.world.plug(drive(0)));
    rig.pass(MS);
    assert_eq!(rig.received[0].len(), WINDOW);
    assert_eq!(rig.request(0, 1).unwrap().1, 2);
}
