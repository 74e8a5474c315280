//! Lost TCP segments: what the usual settings make of them, and what `check` says of it.

use super::*;

/// A drive with an exchange every 8 ms whose replies count for so long, in the usual settings otherwise.
fn bench(reply_within_ns: u64) -> Bench {
    Bench::enabled(1, VIAS[1], |_, drive| {
        (drive.axis.divisor, drive.reply_within_ns) = (8, reply_within_ns);
    })
}

fn losing(b: &Bench, seed: u64, segment_loss: f64) {
    assert!(b.sim.world().set_faults(address(0), FaultPlan { seed, segment_loss, ..FaultPlan::default() }));
}

/// Segments lost in four minutes, and how often the link was.
fn lost(reply_within_ns: u64) -> (u64, u64) {
    let mut b = bench(reply_within_ns);
    losing(&b, 5, 0.005);
    b.run(240_000);
    let segments = b.sim.world().injected(address(0)).unwrap().segments;
    (segments, b.finish().drives[0].losses)
}

/// A lone segment is repeated after 200 ms: what does not wait for it loses the link by nearly each of them.
#[test]
fn a_lost_segment_costs_no_link_in_the_usual_settings() {
    let usual = UnidriveDrive::new("u", Ipv4Addr::LOCALHOST).reply_within_ns;
    let (segments, links) = lost(usual);
    assert!(segments > 100 && links <= segments / 50, "{links} links of {segments} segments");
    let (segments, links) = lost(50 * MS);
    assert!(segments > 100 && links > segments / 2, "{links} links of {segments} segments");
}

/// As `check` says: 210 ms and a turn later at most.
#[test]
fn a_stop_behind_a_lost_segment_leaves_when_it_was_repeated() {
    let mut b = bench(250 * MS);
    b.turning(0, 4.0);
    b.tap(0).received.clear();
    losing(&b, 0, 0.3);
    let segments = |b: &Bench| b.sim.world().injected(address(0)).unwrap().segments;
    b.until("a lost one", 100, |b| segments(b) > 0);
    assert_eq!(segments(&b), 1, "the seed says so");
    let begin = b.now();
    // Nothing after it is lost.
    losing(&b, 0, 0.0);
    b.sim.axis(0).post(STOP).unwrap();
    let slower = |b: &Bench| {
        b.tap(0).received.iter().any(|request| reference(request).is_some_and(|count| count < 2_400))
    };
    b.until("the stop", 1_000, slower);
    let after = b.now().since(begin);
    assert!((200 * MS..210 * MS + 8 * MS).contains(&after), "{after} ns");
    assert_eq!((b.feedback(0).stopped, b.feedback(0).link), (None, Link::Online));
}
