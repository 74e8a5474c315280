use super::*;
use crate::LenzeDrive;
use crate::other::Sign;
use crate::wire::telegram::Malformed;
use fieldbeat_core::time::{MS, US};

const SLAVE: u8 = 7;
/// The sheet's Data_Exchange with 12 bytes, and its reply.
const REQUEST: [u8; 21] =
    [0x68, 0x0F, 0x0F, 0x68, 0x07, 0x02, 0x7D, 0x10, 0x3D, 0, 0, 0, 0, 0, 0, 0x04, 0x7F, 0x10, 0, 0x66, 0x16];
const REPLY: [u8; 21] = [
    0x68, 0x0F, 0x0F, 0x68, 0x02, 0x07, 0x08, 0x20, 0x3D, 0, 0, 0, 0x06, 0x8F, 0xB0, 0x02, 0x37, 0x10, 0,
    0xFC, 0x16,
];
const TOKEN: [u8; 3] = [0xDC, 2, 2];

/// A line at 1.5 Mbit/s, whose port was just opened, and the time.
struct Rig {
    line: Line,
    now: Time,
}

impl Rig {
    fn new(change: impl FnOnce(&mut ProfibusPlan)) -> Rig {
        let mut plan = ProfibusPlan::new("/dev/ttyS1", 1_500_000, vec![LenzeDrive::new("x", SLAVE)]);
        change(&mut plan);
        let mut rig = Rig { line: Line::new(&plan), now: Time(MS) };
        rig.line.opened(rig.now, true);
        rig
    }

    /// The wire is claimed.
    fn up(change: impl FnOnce(&mut ProfibusPlan)) -> Rig {
        let mut rig = Rig::new(change);
        rig.now = rig.now + 10 * MS;
        for _ in 0..2 {
            assert_eq!(rig.line.ready(rig.now), Ready::Claim);
            assert!(!rig.line.is_up());
            assert_eq!(rig.send(), TOKEN);
            rig.idle();
        }
        assert_eq!(rig.line.ready(rig.now), Ready::Free);
        rig
    }

    /// Lets the telegram to be sent leave.
    fn send(&mut self) -> Vec<u8> {
        let bytes = self.line.to_send().to_vec();
        assert!(self.line.sent(self.now, bytes.len()));
        bytes
    }

    /// The line is looked at when it wants to be.
    fn idle(&mut self) {
        self.now = self.line.look_at(true).expect("it waits for something");
    }

    fn request(&mut self) {
        let expected = Expected::exchange(SLAVE, 2, 12);
        let request = self.line.request(0, |out| {
            out[..REQUEST.len()].copy_from_slice(&REQUEST);
            Some((REQUEST.len(), expected))
        });
        assert_eq!(request, Some(&REQUEST[..]));
        assert_eq!(self.send(), REQUEST);
    }

    fn arrive(&mut self, bytes: &[u8]) {
        self.line.room()[..bytes.len()].copy_from_slice(bytes);
        self.line.received(self.now, bytes.len());
    }

    fn incoming(&mut self) -> Option<Incoming<'_>> {
        self.line.incoming(self.now)
    }

    /// The reply arrives so many us later, and is the answer to the request.
    #[track_caller]
    fn is_answered(&mut self, after_us: u64) {
        self.now = self.now + after_us * US;
        self.arrive(&REPLY);
        assert_eq!(self.incoming(), answer());
    }

    /// The reply arrives, and answers nothing.
    #[track_caller]
    fn is_late(&mut self) {
        self.arrive(&REPLY);
        assert_eq!(self.incoming(), Some(Incoming::Other(Other::Unrelated(Unrelated::Late, Some(SLAVE)))));
    }

    /// An idle time of 22 us follows.
    #[track_caller]
    fn idles(&mut self) {
        assert_eq!(self.line.ready(self.now + 21 * US), Ready::Wait);
        assert_eq!(self.line.ready(self.now + 23 * US), Ready::Free);
    }

    /// The slot time is over, and the request fails or is repeated.
    #[track_caller]
    fn is_overdue(&mut self, instead: Instead, failed: bool) {
        self.idle();
        assert_eq!(self.line.ready(self.now), Ready::Overdue { job: Job::Drive(0), instead, failed });
        if !failed {
            assert_eq!(self.line.ready(self.now), Ready::Resend);
            assert_eq!(self.send(), REQUEST);
        }
    }
}

fn answer() -> Option<Incoming<'static>> {
    let data = &REPLY[7..19];
    Some(Incoming::Answer(Job::Drive(0), Answer::Data { high: false, data }))
}

#[test]
fn the_first_telegram_waits_for_the_time_out_of_silence() {
    let mut rig = Rig::new(|_| ());
    // Tto of address 2: ten slot times of 300 bits.
    let silent = 10 * 200 * US;
    for _ in 0..5 {
        rig.now = rig.now + silent - US;
        assert_eq!(rig.line.ready(rig.now), Ready::Wait);
        rig.arrive(&[0xDC, 9, 9]);
        assert_eq!(rig.incoming(), Some(Incoming::Other(Other::Master { address: 9, sign: Sign::Token })));
        assert_eq!(rig.incoming(), None);
    }
    rig.now = rig.now + silent;
    assert_eq!(rig.line.ready(rig.now), Ready::Claim);
}

#[test]
fn the_answer_of_the_sheet_answers_at_any_split() {
    for split in 0..REPLY.len() {
        let mut rig = Rig::up(|_| ());
        rig.request();
        rig.now = rig.now + 180 * US;
        rig.arrive(&REPLY[..split]);
        assert_eq!(rig.incoming(), None);
        // What has begun is waited for, longer than a slot time.
        rig.now = rig.now + 190 * US;
        if split > 0 {
            assert_eq!(rig.line.ready(rig.line.look_at(true).unwrap() - 1), Ready::Wait);
        }
        rig.arrive(&REPLY[split..]);
        assert_eq!(rig.incoming(), answer(), "{split}");
        rig.idles();
    }
}

#[test]
fn an_answer_that_is_read_late_has_ended_by_max_tsdr() {
    let byte = 22_000 / 3;
    // Request, MaxTsdr, answer.
    let ended = 21 * byte + 100 * US + 21 * byte;
    for late in [0, 5 * US, 22 * US, 500 * US] {
        let mut rig = Rig::up(|_| ());
        rig.request();
        let end = rig.now + ended;
        rig.now = end + late;
        rig.is_answered(0);
        assert_eq!(rig.line.ready(end + 21 * US), Ready::Wait, "{late}");
        assert_eq!(rig.line.ready(end + 23 * US), Ready::Free, "{late}");
    }
    // With a slow driver, or with something behind it, the wire may have been in use until now.
    for (latency_ns, behind) in [(400 * US, &[][..]), (0, &TOKEN[..])] {
        let mut rig = Rig::up(|plan| plan.bits.latency_ns = latency_ns);
        rig.request();
        rig.now = rig.now + ended + 300 * US;
        rig.arrive(&[&REPLY, behind].concat());
        assert_eq!(rig.incoming(), answer());
        rig.idles();
    }
}

#[test]
fn a_late_reply_counts_as_late_and_postpones_the_next_telegram() {
    let mut rig = Rig::up(|plan| plan.retries = 0);
    rig.request();
    rig.is_overdue(Instead::Silence, true);
    rig.now = rig.now + US;
    rig.is_late();
    rig.idles();
    // To one that was repeated, the first answer, which is late, and the second, late by the same.
    let mut rig = Rig::up(|_| ());
    rig.request();
    rig.is_overdue(Instead::Silence, false);
    rig.is_answered(160);
    rig.now = rig.now + 154 * US;
    assert_eq!(rig.line.ready(rig.now), Ready::Wait, "for its slot time");
    rig.is_late();
    rig.idle();
    assert_eq!(rig.line.ready(rig.now), Ready::Free);
}

#[test]
fn bytes_from_before_the_request_are_no_answer() {
    let mut rig = Rig::up(|_| ());
    rig.request();
    let begin = rig.now;
    rig.is_late();
    assert_eq!(rig.incoming(), None);
    rig.now = begin + 100 * US;
    rig.arrive(&REPLY[..9]);
    assert_eq!(rig.incoming(), None);
    rig.now = begin + 153 * US;
    rig.arrive(&[0xFF, 0x33]);
    assert!(matches!(rig.incoming(), Some(Incoming::Other(Other::Malformed { expected: false, .. }))));
    assert_eq!(rig.incoming(), None);
    // It is waited for all the same.
    rig.is_answered(161);
    // Where the other end has all bytes at once, an answer may be there sooner.
    rig.line.is_timed = false;
    rig.idle();
    rig.request();
    rig.is_answered(0);
}

#[test]
fn a_broken_answer_is_named_and_nothing_behind_it_counts_until_the_wire_was_idle() {
    for (at, why) in [
        (0, Malformed::Start),
        (1, Malformed::Length),
        (3, Malformed::Length),
        (10, Malformed::Check),
        (20, Malformed::End),
    ] {
        let mut rig = Rig::up(|_| ());
        rig.request();
        let mut broken = REPLY;
        broken[at] ^= 1;
        rig.now = rig.now + 350 * US;
        rig.arrive(&broken);
        assert_eq!(rig.incoming(), Some(Incoming::Other(Other::Malformed { why, expected: true })), "{at}");
        // A rest that looks like an answer.
        rig.now = rig.now + 5 * US;
        rig.arrive(&REPLY);
        assert_eq!(rig.incoming(), None);
        assert_eq!(rig.line.ready(rig.now + 21 * US), Ready::Wait);
        rig.is_overdue(Instead::Garbage, false);
        rig.is_answered(350);
    }
}

#[test]
fn telegrams_of_others_or_of_another_kind_are_no_answer() {
    let unrelated = |why, from| Some(Incoming::Other(Other::Unrelated(why, from)));
    for ((da, sa, fc), expected) in [
        ((2, 8, 0x08), unrelated(Unrelated::Turn, Some(8))),
        ((3, 7, 0x08), unrelated(Unrelated::Station, Some(7))),
        ((2, 7, 0x09), unrelated(Unrelated::Kind, Some(7))),
        ((7, 2, 0x7D), Some(Incoming::Other(Other::Own))),
        ((7, 4, 0x7D), Some(Incoming::Other(Other::Master { address: 4, sign: Sign::Request }))),
        ((2, 7, 0x38), Some(Incoming::Other(Other::Master { address: 7, sign: Sign::Request }))),
    ] {
        let mut bytes = REPLY;
        (bytes[4], bytes[5], bytes[6]) = (da, sa, fc);
        bytes[19] = bytes[4..19].iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte));
        let mut rig = Rig::up(|_| ());
        rig.request();
        rig.now = rig.now + 200 * US;
        rig.arrive(&bytes);
        assert_eq!(rig.incoming(), expected, "{bytes:02x?}");
        rig.arrive(&[telegram::SC]);
        assert_eq!(rig.incoming(), unrelated(Unrelated::Kind, None), "an acknowledgement has no data");
        // The true one counts all the same.
        rig.is_answered(0);
    }
}

#[test]
fn a_refusal_may_leave_out_the_access_points() {
    let mut rig = Rig::up(|_| ());
    let head = Service::ChkCfg.head(SLAVE, 2, true, false);
    let saps = Service::ChkCfg.saps();
    let expected = Expected::service(SLAVE, saps, true);
    for (reply, answer) in [
        (&[telegram::SC][..], Answer::Acknowledged),
        (&[0x10, 2, 7, 3, 12, 0x16], Answer::Refused(3)),
        (&[0x10, 2, 7, 0, 9, 0x16], Answer::Acknowledged),
        // NR: it was taken, and has no answer yet.
        (&[0x10, 2, 7, 9, 18, 0x16], Answer::Acknowledged),
    ] {
        assert!(rig.line.request(3, |out| Some((head.emit(&[0xF3], out)?, expected))).is_some());
        rig.send();
        rig.now = rig.now + 200 * US;
        rig.arrive(reply);
        assert_eq!(rig.incoming(), Some(Incoming::Answer(Job::Drive(3), answer)));
        rig.idle();
    }
}

#[test]
fn the_own_telegram_is_skipped_where_the_adapter_returns_it() {
    for split in [0, 5, REQUEST.len()] {
        let mut rig = Rig::up(|plan| plan.echo = true);
        rig.request();
        rig.arrive(&REQUEST[..split]);
        assert_eq!(rig.incoming(), None);
        rig.now = rig.now + 200 * US;
        rig.arrive(&[&REQUEST[split..], &REPLY[..]].concat());
        assert_eq!(rig.incoming(), answer());
    }
    // What is not the own telegram is no echo.
    let mut rig = Rig::up(|plan| plan.echo = true);
    rig.request();
    rig.arrive(&[0, 0, 0]);
    assert!(matches!(rig.incoming(), Some(Incoming::Other(Other::Malformed { .. }))));
}

#[test]
fn a_partial_write_is_continued_where_it_stopped() {
    let mut rig = Rig::up(|_| ());
    assert!(rig.line.broadcast(&super::super::wire::sap::global_control(2), &[0, 0]));
    let whole = rig.line.to_send().to_vec();
    assert!(rig.line.sent(rig.now, 4));
    rig.idle();
    assert_eq!(rig.line.ready(rig.now), Ready::Resend);
    assert_eq!(rig.line.to_send(), &whole[4..]);
    assert!(rig.line.sent(rig.now, whole.len() - 4));
    // Nobody answers it, and the wire is free behind Tid2.
    assert_eq!(rig.line.ready(rig.now), Ready::Wait);
    rig.idle();
    assert_eq!(rig.line.ready(rig.now), Ready::Free);
}

#[test]
fn another_master_with_the_own_address_is_distinguished_from_an_echoing_adapter() {
    let other = |sign| Some(Incoming::Other(Other::Master { address: 2, sign }));
    // Before its first telegram, nothing of its own can come back.
    for echo in [false, true] {
        let mut rig = Rig::new(|plan| plan.echo = echo);
        rig.arrive(&TOKEN);
        assert_eq!(rig.incoming(), other(Sign::Token));
    }

    // The adapter has returned nothing for a second.
    let mut rig = Rig::up(|_| ());
    rig.now = rig.now + 2_000 * MS;
    rig.request();
    for (bytes, sign) in [(&REQUEST[..], Sign::Request), (&TOKEN, Sign::Token)] {
        rig.arrive(bytes);
        assert_eq!(rig.incoming(), other(sign));
    }
    rig.is_answered(200);

    // It has returned one: it returns others, early or late.
    let mut rig = Rig::up(|_| ());
    rig.request();
    for later in [0, 2_000 * MS] {
        rig.now = rig.now + later;
        rig.arrive(&TOKEN);
        assert_eq!(rig.incoming(), Some(Incoming::Other(Other::Own)));
    }
}
