//! What a session does while its connection runs, and how both end.

use super::*;

#[test]
fn a_session_on_which_nothing_is_sent_gets_a_request_and_ends_without_an_answer() {
    let mut bench = Bench::running(|_| ());
    for _ in 0..4 {
        bench.pass(29 * S);
        bench.silence();
        bench.pass(S + LOOK_NS);
        // Whatever it is, it is an answer.
        bench.trade(PROBE, "8E 00 14 00");
    }
    assert_eq!((bench.state.clone(), bench.news()), (HandshakeState::Kept, vec![]));
    bench.pass(30 * S + LOOK_NS);
    bench.request(PROBE);
    bench.pass(S + LOOK_NS);
    assert!(bench.failed().contains("that every device answers within 1 s"), "{}", bench.failed());
    // One that the drive has forgotten is given up.
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
    bench.wish(Wish::Close { generation: 1 });
    bench.request(CLOSE);
    // An opening that was cut off is closed first.
    let mut bench = Bench::opening();
    bench.lose();
    bench.register(SECOND);
    // It was not there.
    bench.trade(CLOSE, "CE 00 01 01 07 01 01 00 34 12 EE FF C0 00 00 00");
    bench.pass(S + LOOK_NS);
    bench.request(&of(2, OPEN));
}

#[test]
fn a_connection_that_has_timed_out_is_closed_and_opened_anew_after_a_pause() {
    let mut bench = Bench::running(|_| ());
    // Of no connection, and of one of before.
    for generation in [0, 2] {
        bench.wish(Wish::TimedOut { generation });
        bench.silence();
    }
    assert_eq!(bench.news(), []);
    bench.wish(Wish::TimedOut { generation: 1 });
    assert_eq!(bench.news(), [News::Closed { generation: 1 }]);
    bench.trade(CLOSE, CLOSED);
    assert_eq!(bench.news(), [READ_NOTHING]);
    bench.pass(S - 2 * LOOK_NS);
    bench.silence();
    bench.pass(2 * LOOK_NS);
    bench.trade(&of(2, OPEN), &of(2, OPENED));
    let expected = Connection { generation: 2, incoming: 0x0001_0002, ..connection() };
    assert_eq!((bench.news(), bench.note()), (vec![News::Opened(expected)], String::new()));
    // Without TCP the next session closes it.
    let mut bench = Bench::running(|_| ());
    bench.lose();
    bench.wish(Wish::TimedOut { generation: 1 });
    assert_eq!(bench.news(), [News::Closed { generation: 1 }]);
    bench.pass(10 * S);
    bench.register(SECOND);
    bench.trade(CLOSE, CLOSED);
    bench.request(&of(2, OPEN));
}

#[test]
fn the_orderly_end_closes_reports_and_unregisters() {
    let mut bench = Bench::running(|_| ());
    bench.wish(Wish::Close { generation: 1 });
    bench.request(CLOSE);
    assert_eq!(bench.news(), [], "the loop goes on until the answer");
    bench.answer(CLOSED);
    assert_eq!(bench.news(), [News::Closed { generation: 1 }]);
    bench.unregisters();
    bench.pass(100 * S);
    bench.silence();
    // It is over for good.
    bench.lose();
    let state = bench.session.begin(bench.now, &mut bench.out);
    assert_eq!(state, HandshakeState::Failed("this master has ended its session".into()));
    bench.silence();
    assert_eq!(bench.news(), []);
    // It does not wait for a drive that does not answer.
    let mut bench = Bench::running(|_| ());
    bench.wish(Wish::Close { generation: 1 });
    bench.request(CLOSE);
    bench.pass(S + LOOK_NS);
    assert_eq!(bench.news(), [News::Closed { generation: 1 }]);
    bench.unregisters();
    // During an opening it closes what may be open.
    let mut bench = Bench::opening();
    let late = rr(bench.context, OPENED);
    bench.wish(Wish::Close { generation: 0 });
    bench.request(CLOSE);
    bench.receive(&late);
    assert_eq!(bench.news(), [READ_NOTHING, News::Closed { generation: 0 }]);
    bench.answer(CLOSED);
    bench.unregisters();
    // A loop that is gone wishes it.
    let mut bench = Bench::running(|_| ());
    drop(std::mem::replace(&mut bench.loop_end, both(Bells::new(1).bell(0)).0));
    bench.pass(LOOK_NS);
    bench.trade(CLOSE, CLOSED);
    bench.unregisters();
}

#[test]
fn news_wait_for_a_loop_that_does_not_take_them() {
    let mut bench = Bench::running(|_| ());
    for _ in 0..40 {
        bench.lose();
        bench.register(SECOND);
    }
    bench.wish(Wish::TimedOut { generation: 1 });
    bench.trade(CLOSE, CLOSED);
    bench.pass(2 * S);
    // Nothing is opened that the loop would learn of late.
    bench.silence();
    let mut all = Vec::new();
    for _ in 0..4 {
        all.extend(bench.news());
        bench.pass(LOOK_NS);
    }
    assert_eq!(all.iter().filter(|news| **news == News::Closed { generation: 1 }).count(), 1);
    bench.request(&of(2, OPEN));
}
