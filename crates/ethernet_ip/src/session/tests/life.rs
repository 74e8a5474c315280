//! What a session does while its connection runs, and how both end.

use super::*;

#[test]
fn a_session_on_which_nothing_is_sent_gets_a_request() {
    let mut bench = Bench::running(|_| ());
    for _ in 0..4 {
        bench.pass(29 * S);
        bench.silence();
        bench.pass(S + LOOK_NS);
        bench.request(PROBE);
        // Whatever it is, it is an answer.
        bench.answer("8E 00 14 00");
    }
    assert_eq!((bench.state.clone(), bench.news()), (HandshakeState::Kept, vec![]));
    bench.pass(30 * S + LOOK_NS);
    bench.request(PROBE);
    bench.pass(S + LOOK_NS);
    assert!(bench.failed().contains("that every device answers within 1 s"), "{}", bench.failed());
}

#[test]
fn a_session_that_the_drive_has_forgotten_is_given_up() {
    let mut bench = Bench::running(|_| ());
    bench.pass(30 * S + LOOK_NS);
    bench.request(PROBE);
    let mut refusal = framed(0x6F, SESSION, bench.context, &[]);
    refusal[8] = 0x64;
    bench.receive(&refusal);
    assert_eq!(bench.failed(), "the drive refuses a message: invalid session handle (0x0064)");
}

#[test]
fn the_end_of_tcp_is_not_that_of_the_connection() {
    let mut bench = Bench::running(|_| ());
    bench.lose();
    bench.pass(60 * S);
    assert_eq!(bench.news(), []);
    // The next session finds it open, and reads again what the loop has to know.
    bench.register(SECOND);
    bench.silence();
    assert_eq!((bench.state.clone(), bench.news()), (HandshakeState::Kept, vec![READ_NOTHING]));
    bench.pass(10 * S);
    bench.silence();
    // Closed from the new session, by the triad of before.
    bench.loop_end.wish(Wish::Close { generation: 1 });
    bench.pass(LOOK_NS);
    bench.request(CLOSE);
}

#[test]
fn an_opening_that_was_cut_off_by_the_end_of_tcp_is_closed_first() {
    let mut bench = Bench::of_drive(|_| ());
    bench.register(SECOND);
    bench.request(OPEN);
    bench.lose();
    bench.register(SECOND);
    bench.request(CLOSE);
    // It was not there.
    bench.answer("CE 00 01 01 07 01 01 00 34 12 EE FF C0 00 00 00");
    bench.pass(S + LOOK_NS);
    bench.request(&open(2));
}

#[test]
fn a_connection_that_has_timed_out_is_closed_and_opened_anew_after_a_pause() {
    let mut bench = Bench::running(|_| ());
    // Of no connection, and of one of before.
    for generation in [0, 2] {
        bench.loop_end.wish(Wish::TimedOut { generation });
        bench.pass(LOOK_NS);
        bench.silence();
    }
    assert_eq!(bench.news(), []);
    bench.loop_end.wish(Wish::TimedOut { generation: 1 });
    bench.pass(LOOK_NS);
    assert_eq!(bench.news(), [News::Closed { generation: 1 }]);
    assert!(bench.note().contains("packets have ended"), "{}", bench.note());
    bench.request(CLOSE);
    bench.answer(CLOSED);
    assert_eq!(bench.news(), [READ_NOTHING]);
    bench.pass(S - 2 * LOOK_NS);
    bench.silence();
    bench.pass(2 * LOOK_NS);
    bench.request(&open(2));
    bench.answer(&opened(2));
    let news = bench.news();
    let expected = Connection { generation: 2, incoming: 0x0001_0002, ..connection() };
    assert_eq!(news, [News::Opened(expected)]);
    assert_eq!(bench.note(), "");
}

#[test]
fn a_connection_that_times_out_without_tcp_is_closed_by_the_next_session() {
    let mut bench = Bench::running(|_| ());
    bench.lose();
    bench.loop_end.wish(Wish::TimedOut { generation: 1 });
    bench.pass(LOOK_NS);
    assert_eq!(bench.news(), [News::Closed { generation: 1 }]);
    bench.pass(10 * S);
    bench.register(SECOND);
    bench.request(CLOSE);
    bench.answer(CLOSED);
    bench.request(&open(2));
}

#[test]
fn the_orderly_end_closes_reports_and_unregisters() {
    let mut bench = Bench::running(|_| ());
    bench.loop_end.wish(Wish::Close { generation: 1 });
    bench.pass(LOOK_NS);
    bench.request(CLOSE);
    assert_eq!(bench.news(), [], "the loop goes on until the answer");
    bench.answer(CLOSED);
    assert_eq!(bench.news(), [News::Closed { generation: 1 }]);
    assert_eq!(bench.taken(), framed(0x66, SESSION, 0, &[]));
    bench.pass(100 * S);
    bench.silence();
    // It is over for good.
    bench.lose();
    let state = bench.session.begin(bench.now, &mut bench.out);
    assert_eq!(state, HandshakeState::Failed("this master has ended its session".into()));
    bench.silence();
    assert_eq!(bench.news(), []);
}

#[test]
fn the_orderly_end_does_not_wait_for_a_drive_that_does_not_answer() {
    let mut bench = Bench::running(|_| ());
    bench.loop_end.wish(Wish::Close { generation: 1 });
    bench.pass(LOOK_NS);
    bench.request(CLOSE);
    bench.pass(S + LOOK_NS);
    assert_eq!(bench.news(), [News::Closed { generation: 1 }]);
    assert_eq!(bench.taken(), framed(0x66, SESSION, 0, &[]));
}

#[test]
fn the_orderly_end_without_a_session_is_reported_at_once_and_made_up_for() {
    let mut bench = Bench::running(|_| ());
    bench.lose();
    bench.loop_end.wish(Wish::Close { generation: 1 });
    bench.pass(LOOK_NS);
    assert_eq!(bench.news(), [News::Closed { generation: 1 }]);
    // Should there be time for it, the drive is not left with the connection; what it is does not matter.
    bench.begin();
    bench.request(IDENTIFY);
    bench.answer(IDENTITY_REPLY);
    bench.request(CLOSE);
    bench.answer(CLOSED);
    assert_eq!(bench.taken(), framed(0x66, SESSION, 0, &[]));
    assert_eq!(bench.news(), []);
}

#[test]
fn the_orderly_end_during_an_opening_closes_what_may_be_open() {
    let mut bench = Bench::of_drive(|_| ());
    bench.register(SECOND);
    bench.request(OPEN);
    let late = rr(bench.context, OPENED);
    bench.loop_end.wish(Wish::Close { generation: 0 });
    bench.pass(LOOK_NS);
    bench.request(CLOSE);
    bench.receive(&late);
    assert_eq!(bench.news(), [READ_NOTHING, News::Closed { generation: 0 }]);
    bench.answer(CLOSED);
    assert_eq!(bench.taken(), framed(0x66, SESSION, 0, &[]));
}

#[test]
fn a_session_whose_loop_is_gone_ends_in_order() {
    let mut bench = Bench::running(|_| ());
    let (other, _) = both();
    drop(std::mem::replace(&mut bench.loop_end, other));
    bench.pass(LOOK_NS);
    bench.request(CLOSE);
    bench.answer(CLOSED);
    assert_eq!(bench.taken(), framed(0x66, SESSION, 0, &[]));
}

#[test]
fn news_wait_for_a_loop_that_does_not_take_them() {
    let mut bench = Bench::running(|_| ());
    for _ in 0..40 {
        bench.lose();
        bench.register(SECOND);
    }
    bench.loop_end.wish(Wish::TimedOut { generation: 1 });
    bench.pass(LOOK_NS);
    bench.request(CLOSE);
    bench.answer(CLOSED);
    bench.pass(2 * S);
    // Nothing is opened that the loop would learn of late.
    bench.silence();
    let mut all = Vec::new();
    for _ in 0..4 {
        all.extend(bench.news());
        bench.pass(LOOK_NS);
    }
    assert_eq!(all.iter().filter(|news| **news == News::Closed { generation: 1 }).count(), 1);
    bench.request(&open(2));
}
