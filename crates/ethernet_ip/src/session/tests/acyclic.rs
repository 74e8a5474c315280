//! Acyclic calls, unconnected and on a class 3 connection.

use super::*;
use crate::target::{BROKEN, NOT_READ, Target};
use crate::wire::opcodes::{opcode, parameter};
use fieldbeat_core::axis::acyclic::long::Target as _;
use fieldbeat_core::axis::acyclic::{Answer, Call, CallTicket, long};

const VENDOR: &str = "3C 03 20 64 24 01 30 01";
const READ: &str = "3C 03 20 64 24 01 30 01 00 02 84 1E 00 00 00 00";
const READ_REPLY: &str = "BC 00 00 00 00 02 84 1E 02 58 00 00";
const WRITE: &str = "3C 03 20 64 24 01 30 01 00 02 83 1E 02 58 00 00";
/// Of class 3, with serial number 2: as tshark decodes it without complaint, like READ on it.
const CONNECT: &str = "54 02 20 06 24 01 0A 0E 00 00 00 00 02 00 01 00 02 00 34 12 EE FF C0 00 03 00 00 00 \
     40 42 0F 00 F4 43 40 42 0F 00 F4 43 A3 02 20 02 24 01";
const CONNECTED: &str =
    "D4 00 00 00 14 00 01 5A 02 00 01 00 02 00 34 12 EE FF C0 00 40 42 0F 00 40 42 0F 00 00 00";
const DISCONNECT: &str = "4E 02 20 06 24 01 0A 0E 02 00 34 12 EE FF C0 00 02 00 20 02 24 01";
/// The ids of both directions.
const OURS: &str = "14 00 01 5A";
const THEIRS: &str = "02 00 01 00";

fn ac(flash: bool) -> Target {
    Target::Parameter { index: parameter("AC").unwrap().index, flash }
}

impl Bench {
    fn post(&mut self, call: Call) -> CallTicket {
        let ticket = self.acyclic.post(call, LIMIT).unwrap();
        // Its waker runs the session.
        self.look();
        ticket
    }

    /// Posts one that reads, or that commands the drive.
    fn post_read(&mut self) -> CallTicket {
        self.post(ac(false).read())
    }

    fn post_write(&mut self) -> CallTicket {
        self.post(ac(false).write(600))
    }

    /// Posts a call that is sent as this, answered with this, and returns the result.
    #[track_caller]
    fn call(&mut self, call: Call, request: &str, answer: &str) -> Result<u64, CallError> {
        let mut ticket = self.post(call);
        self.request(request);
        assert_eq!(ticket.poll(), None);
        self.answer(answer);
        ticket.poll().expect("ended").map(|Answer { status, address, value }| {
            assert_eq!((status, address), (0, call.address));
            value
        })
    }
}

/// Nobody's outputs are taken for a parameter. The drive itself is read for what the loop knows of its power.
#[test]
fn without_a_class_1_connection_nothing_is_opened_and_only_a_drive_without_power_is_commanded() {
    const STATUS: &str = "3C 03 20 64 24 01 30 01 00 02 84 80 00 00 00 00";
    let mut bench = Bench::registered(|drive| drive.cyclic = false);
    bench.pass(10 * S);
    bench.silence();
    assert_eq!(bench.call(ac(false).read(), READ, READ_REPLY), Ok(600));
    for (status, ends) in [
        ("BC 00 00 00 00 02 84 80 00 01 00 00", Some(Err(CallError::Commands))),
        ("BC 00 20 00", Some(Err(CallError::Refused(0x20)))),
        ("BC 00 00 00 00 02 84 80 00 00 00 00", None),
    ] {
        let mut ticket = bench.post_write();
        bench.trade(STATUS, status);
        if ends.is_none() {
            bench.trade(WRITE, "BC 00 00 00 00 02 83 1E 00 00 00 00");
        }
        bench.silence();
        let end = ticket.poll().map(|end| end.map(|answer| answer.value));
        assert_eq!(end, ends.or(Some(Ok(0))), "{status}");
    }
    assert!(matches!(bench.session.io, Io::Closed { .. }) && bench.news() == [READ_NOTHING]);
}

#[test]
fn every_kind_of_call_is_sent_as_the_manual_says() {
    let mut bench = Bench::running(|_| ());
    let command = |name, field| Target::Command { code: opcode(name).unwrap().code, field };
    let register = Target::Register(b'3');
    // The examples of the Host Command Reference 920-0002 W.
    for (call, payload, answer, value) in [
        (ac(false).read(), "00 02 84 1E 00 00 00 00", "00 02 84 1E 02 58 00 00", 600),
        (ac(false).write(600), "00 02 83 1E 02 58 00 00", "00 02 83 1E 00 09 00 00", 9),
        (ac(true).write(600), "00 02 83 9E 02 58 00 00", "00 02 83 9E 00 09 00 00", 9),
        (register.read(), "00 02 9F 33 00 00 00 00", "00 02 9F 33 FF FF FF FE", 0xFFFF_FFFE),
        (register.write(0xFFFF_FFFE), "00 02 9E 33 FF FF FF FE", "00 02 9E 33 00 09 00 00", 9),
        (Target::Absolute.read(), "00 02 88 01 00 00 00 00", "00 02 88 01 87 65 43 21", 0x8765_4321),
        (Target::Encoder.read(), "00 02 88 00 00 00 00 00", "00 02 88 00 00 00 00 07", 7),
        (Target::AlarmHistory.read(), "00 02 87 00 00 00 00 00", "00 02 87 00 00 00 00 03", 3),
        (Target::Output(1).write(1), "00 02 8B 81 00 00 00 00", "00 02 8B 81 00 09 00 00", 9),
        (Target::Output(1).write(0), "00 02 8B 01 00 00 00 00", "00 02 8B 01 00 09 00 00", 9),
        (Target::Kill.write(0), "00 02 98 00 00 00 00 00", "00 02 98 00 00 09 00 00", 9),
        (Target::Stop.write(1), "00 02 A3 01 00 00 00 00", "00 02 A3 01 00 09 00 00", 9),
        (Target::AlarmReset.write(0), "00 02 8E 00 00 00 00 00", "00 02 8E 00 02 00 00 00", 0x200),
        (Target::LoadProgram.write(0), "00 02 A1 00 00 00 00 00", "00 02 A1 00 00 00 00 00", 0),
        (Target::SaveSegment.write(12), "00 02 A2 0C 00 00 00 00", "00 02 A2 0C 00 00 00 00", 0),
        (command("AC", 0).write(600), "00 01 00 1E 00 00 02 58", "00 01 00 1E 00 09 00 00", 9),
        (command("DI", 0).write(-1_i64 as u64), "00 01 00 B6 FF FF FF FF", "00 01 00 B6 00 09 00 00", 9),
        (command("FS", 0).write(0x52B2), "00 01 00 6B 00 00 52 B2", "00 01 00 6B 00 19 00 00", 0x19),
        (command("RX", b'3').write(5), "00 01 33 AE 00 00 00 05", "00 01 33 AE 00 09 00 00", 9),
    ] {
        let result = bench.call(call, &format!("{VENDOR} {payload}"), &format!("BC 00 00 00 {answer}"));
        assert_eq!(result, Ok(value), "{payload}");
    }
    let attribute = Target::attribute(1, 1, 2).unwrap();
    // A class of 16 bits, and the class itself.
    let class = Target::attribute(0x300, 0, 1).unwrap();
    let (eight, bytes) = (0x0102_0304_0506_0708, "10 03 20 01 24 01 30 02 08 07 06 05 04 03 02 01");
    for (call, request, answer, value) in [
        (attribute.read(), "0E 03 20 01 24 01 30 02", "8E 00 00 00 2B 01", 0x012B),
        (attribute.write(eight), bytes, "90 00 00 00", eight),
        (class.read(), "0E 04 21 00 00 03 24 00 30 01", "8E 00 00 00", 0),
    ] {
        assert_eq!(bench.call(call, request, answer), Ok(value), "{request}");
    }
}

#[test]
fn the_refusal_of_a_drive_keeps_its_status() {
    let mut bench = Bench::running(|_| ());
    let attribute = Target::attribute(1, 1, 99).unwrap().read();
    for (call, request, answer, status) in [
        (attribute, "0E 03 20 01 24 01 30 63", "8E 00 14 00", 0x14),
        (attribute, "0E 03 20 01 24 01 30 63", "8E 00 1F 01 34 12", 0x0112_341F),
        // Answers that are none to this message.
        (ac(false).read(), READ, "BC 00 00 00 00 02 84 1F 02 58 00 00", BROKEN),
        (ac(false).read(), READ, "BC 00 00 00 00 02 84 1E 02 58", BROKEN),
    ] {
        assert_eq!(bench.call(call, request, answer), Err(CallError::Refused(status)), "{answer}");
    }
    // The encapsulation's; the session goes on.
    let mut ticket = bench.post_read();
    bench.request(READ);
    let mut refusal = framed(0x6F, SESSION, bench.context, &[]);
    refusal[8] = 3;
    bench.receive(&refusal);
    assert_eq!(ticket.poll(), Some(Err(CallError::Refused(0x0200_0003))));
    assert_eq!(bench.state, HandshakeState::Kept);
}

#[test]
fn a_long_attribute_is_read_and_written_in_parts() {
    let mut bench = Bench::running(|_| ());
    let name = Target::attribute(1, 1, 7).unwrap();
    let part = |service, value| Call { service, address: name.pack(), value };
    let calls = [name.read(), part(long::SIZE, 0), part(long::PART, 8), part(long::PART, 16)];
    let mut tickets = bench.acyclic.post_series(&calls, LIMIT).unwrap();
    bench.look();
    bench.trade("0E 03 20 01 24 01 30 07", "8E 00 00 00 0B 53 54 46 30 35 2D 49 50 20 20 20");
    let mut end = |ticket: usize| tickets[ticket].poll().unwrap().map(|answer| answer.value.to_le_bytes());
    assert_eq!(end(0), Ok(*b"\x0BSTF05-I"));
    assert_eq!(end(1), Ok([12, 0, 0, 0, 0, 0, 0, 0]));
    assert_eq!(end(2), Ok(*b"P   \0\0\0\0"));
    assert_eq!(end(3), Err(CallError::Refused(NOT_READ)));
    let calls = long::write(name.pack(), b"\x09ABCDEFGHI");
    let mut tickets = bench.acyclic.post_series(&calls, LIMIT).unwrap();
    bench.look();
    bench.trade("10 03 20 01 24 01 30 07 09 41 42 43 44 45 46 47 48 49", "90 00 00 00");
    assert!(tickets.iter_mut().all(|ticket| matches!(ticket.poll(), Some(Ok(_)))));
}

#[test]
fn a_call_that_commands_the_drive_is_refused_while_the_loop_guards() {
    let mut bench = Bench::running(|_| ());
    assert!(!bench.loop_end.guard(false));
    // Posted before the guard, and built after it.
    let mut ticket = bench.acyclic.post(ac(false).write(600), LIMIT).unwrap();
    assert!(!bench.loop_end.guard(true));
    bench.look();
    bench.silence();
    assert_eq!(ticket.poll(), Some(Err(CallError::Commands)));
    // Then on submission; what commands nothing is served.
    assert!(bench.acyclic.post(ac(false).write(600), LIMIT).is_err());
    assert_eq!(bench.call(ac(false).read(), READ, READ_REPLY), Ok(600));
    // Right before the frame is built, too: a call that waits for its connection.
    let mut bench = Bench::running(|drive| drive.explicit = Explicit::Connected);
    let mut ticket = bench.post_write();
    bench.request(CONNECT);
    bench.loop_end.guard(true);
    bench.answer(CONNECTED);
    bench.silence();
    assert_eq!(ticket.poll(), Some(Err(CallError::Commands)));
    assert!(!bench.loop_end.guard(true));
}

#[test]
fn the_loop_sees_a_commanding_call_until_its_end_is_known() {
    let mut bench = Bench::running(|_| ());
    let mut ticket = bench.post_write();
    bench.request(WRITE);
    assert!(bench.loop_end.guard(true), "its frame left before the guard");
    bench.answer("BC 00 00 00 00 02 83 1E 00 09 00 00");
    assert!(matches!(ticket.poll(), Some(Ok(_))));
    assert!(!bench.loop_end.guard(false));
    bench.look();
    // Cancelled or late, it may still be carried out; the answer to a later request says that it is over.
    drop(bench.post_write());
    bench.request(WRITE);
    bench.look();
    assert!(bench.loop_end.guard(false));
    bench.pass(5 * S + LOOK_NS);
    assert!(bench.loop_end.guard(false));
    bench.trade(PROBE, PROBED);
    assert!(!bench.loop_end.guard(false));
    // The same over the end of the session.
    let mut ticket = bench.post_write();
    bench.request(WRITE);
    bench.lose();
    assert_eq!(ticket.poll(), Some(Err(CallError::TimedOut)));
    assert!(bench.loop_end.guard(false));
    bench.begin();
    bench.request(IDENTIFY);
    assert!(bench.loop_end.guard(false));
    bench.answer(IDENTITY_REPLY);
    assert!(!bench.loop_end.guard(false));
}

#[test]
fn an_answer_to_a_timed_out_or_cancelled_call_is_dropped() {
    let mut bench = Bench::running(|_| ());
    let mut ticket = bench.post_read();
    bench.request(READ);
    let late = rr(bench.context, READ_REPLY);
    bench.pass(5 * S - LOOK_NS);
    assert_eq!(ticket.poll(), None);
    bench.pass(2 * LOOK_NS);
    assert_eq!(ticket.poll(), Some(Err(CallError::TimedOut)));
    // Does the drive answer anything?
    bench.request(PROBE);
    bench.receive(&late);
    assert_eq!(bench.session.unmatched, 1);
    bench.answer(PROBED);
    assert_eq!((bench.state.clone(), bench.news()), (HandshakeState::Kept, vec![]));
    let mut ticket = bench.post_read();
    bench.request(READ);
    ticket.cancel();
    bench.look();
    assert_eq!(ticket.poll(), Some(Err(CallError::Cancelled)));
    // The next one waits for that answer.
    let mut ticket = bench.post_read();
    bench.silence();
    bench.answer("BC 00 00 00 00 02 84 1E 00 01 00 00");
    assert_eq!(ticket.poll(), None);
    bench.trade(READ, "BC 00 00 00 00 02 84 1E 00 02 00 00");
    assert_eq!(ticket.poll().unwrap().unwrap().value, 2);
    assert_eq!(bench.session.unmatched, 1);
}

#[test]
fn calls_are_served_while_the_connection_is_refused_and_refused_without_a_session() {
    let mut bench = Bench::of_drive(|_| ());
    assert_eq!(bench.post_read().poll(), Some(Err(CallError::NotOnline)));
    bench.register(SECOND);
    bench.trade(OPEN, &refused(1, "01 01 06 01"));
    assert_eq!(bench.call(ac(false).read(), READ, READ_REPLY), Ok(600));
    bench.lose();
    assert_eq!(bench.post_read().poll(), Some(Err(CallError::NotOnline)));
    bench.register(SECOND);
    bench.wish(Wish::Close { generation: 0 });
    assert_eq!(bench.post_read().poll(), Some(Err(CallError::Gone)));
}

/// A call is under way on class 3, with number 1.
fn connected() -> (Bench, CallTicket) {
    let mut bench = Bench::running(|drive| drive.explicit = Explicit::Connected);
    let ticket = bench.post_read();
    bench.trade(CONNECT, CONNECTED);
    assert_eq!(bench.taken(), unit(OURS, 1, READ));
    (bench, ticket)
}

#[test]
fn class_3_carries_calls_one_after_the_other_and_is_kept_alive() {
    let (mut bench, mut ticket) = connected();
    // Of another connection, number, service, or unconnected.
    for stranger in [
        unit(OURS, 1, READ_REPLY),
        unit(THEIRS, 2, READ_REPLY),
        unit(THEIRS, 1, PROBED),
        rr(bench.context, READ_REPLY),
    ] {
        bench.receive(&stranger);
        assert_eq!(ticket.poll(), None);
    }
    assert_eq!(bench.session.unmatched, 4);
    bench.receive(&unit(THEIRS, 1, READ_REPLY));
    assert_eq!(ticket.poll().unwrap().unwrap().value, 600);
    let mut ticket = bench.post_read();
    assert_eq!(bench.taken(), unit(OURS, 2, READ));
    bench.receive(&unit(THEIRS, 2, READ_REPLY));
    assert!(matches!(ticket.poll(), Some(Ok(_))));
    for sequence in 3..7 {
        bench.pass(9 * S);
        bench.silence();
        bench.pass(S + LOOK_NS);
        assert_eq!(bench.taken(), unit(OURS, sequence, PROBE));
        bench.receive(&unit(THEIRS, sequence, PROBED));
    }
}

#[test]
fn a_request_on_class_3_is_repeated_once_with_its_number_and_then_the_connection_opened_anew() {
    let (mut bench, mut ticket) = connected();
    bench.pass(3 * S);
    assert_eq!(bench.taken(), unit(OURS, 1, READ));
    bench.receive(&unit(THEIRS, 1, READ_REPLY));
    assert!(matches!(ticket.poll(), Some(Ok(_))));
    // The second answer, to the first request.
    bench.receive(&unit(THEIRS, 1, READ_REPLY));
    assert_eq!(bench.session.unmatched, 1);

    let (mut bench, mut ticket) = connected();
    bench.pass(5 * S / 2 + LOOK_NS);
    assert_eq!(bench.taken(), unit(OURS, 1, READ));
    assert_eq!(ticket.poll(), None);
    bench.pass(2 * S);
    bench.silence();
    bench.pass(S);
    assert_eq!(ticket.poll(), Some(Err(CallError::TimedOut)));
    // Its end may not be known to the drive.
    bench.trade(DISCONNECT, &of(2, CLOSED));
    bench.trade(PROBE, PROBED);
    assert_eq!(bench.news(), [], "the other connection is not touched");
    let _ticket = bench.post_read();
    let again = |text: &str| text.replace("02 00 01 00 02 00", "03 00 01 00 03 00");
    bench.trade(&again(CONNECT), &again(CONNECTED));
    assert_eq!(bench.taken(), unit(OURS, 1, READ));
    // It ends with the session; the drive may not know it.
    bench.lose();
    bench.register(SECOND);
    bench.request(&DISCONNECT.replace("02 00 34 12", "03 00 34 12"));
}

#[test]
fn a_refused_class_3_connection_refuses_the_call() {
    let mut bench = Bench::running(|drive| drive.explicit = Explicit::Connected);
    let mut ticket = bench.post_read();
    bench.trade(CONNECT, &refused(2, "01 01 13 01"));
    let status = 0x0101_1301;
    assert_eq!(ticket.poll(), Some(Err(CallError::Refused(status))));
    assert_eq!(target::reason(status), "no connection left (0x0113)");
    bench.silence();
    // And one that is not answered.
    let mut ticket = bench.post_read();
    bench.context += 1;
    bench.out.clear();
    bench.pass(S + LOOK_NS);
    assert_eq!(ticket.poll(), Some(Err(CallError::TimedOut)));
    bench.request(&DISCONNECT.replace("02 00 34 12", "03 00 34 12"));
}
