//! Paths A and B.

use super::*;

/// The page of the vendor: 43 degrees.
const READ_C0061: [u8; 8] = [0x10, 0x3D, 0, 0, 0, 0, 0, 0];

#[test]
fn pkw_without_a_pause_goes_from_code_to_code_and_pauses_before_the_same_one() {
    const READ_C0039_2: [u8; 8] = [0x60, 0x27, 2, 0, 0, 0, 0, 0];
    for (pause, expected) in [
        (false, vec![READ_C0061, READ_C0039_2, READ_C0061, [0; 8], READ_C0061]),
        (true, vec![READ_C0061, [0; 8], READ_C0039_2, [0; 8], READ_C0061, [0; 8], READ_C0061]),
    ] {
        let mut side = Side::new(ParameterPath::Pkw { pause });
        side.rest(2, [0; 8]);
        let (mut seen, mut shown) = (Vec::new(), [0; 8]);
        let mut tickets = [C0061, C0039_2, C0061, C0061].map(|address| side.read(address));
        let [others @ .., last] = &mut tickets;
        let end = side.by_channel(last, |out| {
            if seen.last() != Some(&out) {
                seen.push(out);
            }
            // What the drive does is shown in the next exchange; it counts the jobs that it has received.
            let id = [0, 2, 0, 0, 0, 0, 5, 0][usize::from(out[0] >> 4)];
            let value = [0, 0, 0, seen.len() as u8];
            let reply = [&[id << 4 | out[0] & 0xF, out[1], out[2], 0], &value[..]].concat();
            std::mem::replace(&mut shown, if id == 0 { [0; 8] } else { reply.try_into().unwrap() }).into()
        });
        assert_eq!(seen, expected, "{pause}");
        assert_eq!(end, Ok(seen.len() as u64));
        let ends = others.each_mut().map(|ticket| ticket.poll().unwrap().unwrap().value);
        assert_eq!(ends, if pause { [1, 3, 5] } else { [1, 2, 3] });
    }
}

#[test]
fn pkw_takes_the_answer_to_its_own_code_only_and_errors_by_direction() {
    let mut side = Side::new(PKW);
    for (service, address, value, job, answer, expected) in [
        // Element jobs of a subcode; 7 is "write word" from the master, and "error" from the drive.
        (WRITE, C0039_2, 1_504_000, "80270200 0016F300", "50270200 0016F300", Ok(1_504_000)),
        (WRITE, C0039_2, 9, "80270200 00000009", "70270200 00000002", Err(2)),
        (WRITE, C0039_2, 9, "80270200 00000009", "80270200 00000000", Err(0x0B)),
        // A reply of 16 bits is what it says, with the sign of its code; and contradicts an address of 32.
        (READ, C0039_2, 0, "60270200 00000000", "40270200 0000FFFF", Ok(0xFFFF_FFFF)),
        (READ, C0061, 0, "103D0000 00000000", "103D0000 0000002B", Ok(43)),
        (READ, code(61, 0, Kind::U32), 0, "103D0000 00000000", "103D0000 0000002B", Err(0x5000_0742)),
        (READ, code(61, 0, Kind::I16), 0, "103D0000 00000000", "203D0000 00068FB0", Err(0x5000_0343)),
        (READ, code(61, 0, Kind::I16), 0, "103D0000 00000000", "103D0000 0000FFFE", Ok(0xFFFE)),
        (WRITE, code(150, 1, Kind::U16), 0x1_0007, "70960100 00000007", "40960100 00000007", Ok(0x1_0007)),
        (WRITE, code(150, 0, Kind::I16), 0xFFFE, "20960000 0000FFFE", "10960000 0000FFFE", Ok(0xFFFE)),
        (READ, code(1999, 0, Kind::Own), 0, "17CF0000 00000000", "77CF0000 00000000", Err(0)),
        // The sheet's write of C0039, and an element of the FPBA manual.
        (WRITE, code(39, 0, Kind::Own), 1_504_000, "30270000 0016F300", "20270000 0016F300", Ok(1_504_000)),
        (READ, code(0x54, 0x0B, Kind::Own), 0, "60540B00 00000000", "40540B00 00000064", Ok(100)),
        // No ids of a value.
        (READ, C0061, 0, "103D0000 00000000", "303D0000 00068FB0", Err(BROKEN)),
        (READ, C0061, 0, "103D0000 00000000", "603D0000 00068FB0", Err(BROKEN)),
        (READ, C0061, 0, "103D0000 00000000", "903D0000 00068FB0", Err(BROKEN)),
    ] {
        let [job, answer] = [job, answer].map(hex);
        let mut ticket = side.post(service, address, value);
        let mut turn = 0;
        let end = side.by_channel(&mut ticket, |out| {
            if out == [0; 8] {
                return Some(out);
            }
            assert_eq!(out, job);
            turn += 1;
            // Those to another code, or another subcode, and one that is lost.
            let mut reply = answer;
            match turn {
                1 => reply[0] ^= 1,
                2 | 3 => reply[turn - 1] ^= 4,
                4 => return None,
                _ => {}
            }
            Some(reply)
        });
        assert_eq!(end, expected.map_err(CallError::Refused), "{answer:02X?}");
    }
    let mut ticket = side.read(code(0x1000, 0, Kind::Own));
    let end = side.by_channel(&mut ticket, Some);
    assert_eq!(end, Err(CallError::Refused(super::super::super::target::UNREACHABLE)));
}

/// Replies of the 9400 manual and of the EMF2133IB: what the call says of the value behind it.
#[test]
fn drivecom_answers_say_what_the_value_is() {
    for (reply, value, kind) in [
        ("11005FC2 002B0000", 43, Kind::I16),
        ("11005FC2 FFFB0000", 0xFFFF_FFFB, Kind::I16),
        ("01005FC2 2B000000", 43, Kind::I8),
        ("31005FC2 00068FB0", 430_000, Kind::Own),
        ("00005FC2 00068FB0", 430_000, Kind::Own),
    ] {
        let mut side = Side::new(ParameterPath::Drivecom);
        side.rest(2, [0; 8]);
        let mut ticket = side.read(C0061);
        let end = loop {
            let Sent::Exchange(out) = side.turn() else { panic!("a channel") };
            let mut answer = hex(reply);
            answer[0] |= out[0] & 0x40;
            side.access.channel_answered(if out[0] & 7 == 0 { &[0; 8] } else { &answer });
            if let Some(end) = ticket.poll() {
                break end.unwrap();
            }
        };
        let address = super::super::super::target::learned(C0061, kind);
        assert_eq!((end.value, end.address), (value, address), "{reply}");
    }
    // Three bytes are nothing.
    let mut side = Side::new(ParameterPath::Drivecom);
    let mut ticket = side.read(C0061);
    let end = side.by_channel(&mut ticket, |out| {
        let mut reply = hex("21005FC2 00002B00");
        reply[0] |= out[0] & 0x40;
        Some(if out[0] & 7 == 0 { [out[0], 0, 0, 0, 0, 0, 0, 0] } else { reply })
    });
    assert_eq!(end, Err(CallError::Refused(BROKEN)));
}

#[test]
fn drivecom_begins_against_what_the_drive_shows() {
    // One that still shows the bit of a master before, and follows at once, later, or not at all.
    for follows in [Some(0), Some(1), Some(3), None] {
        let mut side = Side::new(ParameterPath::Drivecom);
        let (mut shown, mut acted) = (0x40, 0);
        let mut behind = std::collections::VecDeque::from(vec![0x40; follows.unwrap_or(0)]);
        let mut ticket = side.read(C0061);
        let end = side.by_channel(&mut ticket, |out| {
            if out[0] & 7 == 0 && follows.is_some() {
                behind.push_back(out[0] & 0x40);
                shown = behind.pop_front().unwrap();
            }
            if out[0] & 7 == 0 || out[0] & 0x40 == shown {
                return Some([shown, 0, 0, 0, 0, 0, 0, 0]);
            }
            acted += 1;
            Some([out[0] & 0x40, out[1], out[2], out[3], 0, 0, 0, 9])
        });
        assert_eq!((end, acted), (Ok(9), 1), "{follows:?}");
    }
    // One wrong answer does not keep it from its first job.
    let mut side = Side::new(ParameterPath::Drivecom);
    side.rest(1, [0x40, 0, 0, 0, 0, 0, 0, 0]);
    let mut ticket = side.read(C0061);
    let end = side.by_channel(&mut ticket, |out| {
        Some(if out[0] & 7 == 0 { [0; 8] } else { [out[0] & 0x40, out[1], out[2], out[3], 0, 0, 0, 1] })
    });
    assert_eq!(end, Ok(1));
    assert!(side.now < Time(30 * MS), "{}", side.now.0);
}

#[test]
fn a_write_whose_answer_is_lost_is_uncertain_and_never_written_again() {
    for path in [PKW, ParameterPath::Drivecom] {
        // Ten exchanges are lost, and the job stands; then the drive is gone.
        let mut side = Side::new(path);
        side.rest(3, [0; 8]);
        let mut ticket = side.write(C0039_2, 1_504_000);
        let Sent::Exchange(job) = side.turn() else { panic!("a channel") };
        assert_ne!(job, [0; 8]);
        for _ in 0..10 {
            side.access.lost(Turn::DataExchange);
            assert_eq!(side.turn(), Sent::Exchange(job));
        }
        side.access.ended();
        assert_eq!(ticket.poll(), Some(Err(CallError::TimedOut)), "{path:?}");
        for _ in 0..10 {
            assert_eq!(side.turn(), Sent::Exchange([0; 8]), "{path:?}");
            side.access.channel_answered(&[0; 8]);
        }
        assert!(side.access.is_idle());
        // What reads can be repeated by who wants it; what was not sent waits for the drive.
        let mut ticket = side.read(C0061);
        side.turn();
        side.access.ended();
        assert_eq!(ticket.poll(), Some(Err(CallError::Restarted)));
        let mut ticket = side.write(C0039_2, 5);
        side.access.advance(side.now, Link::Online, true, false);
        side.access.ended();
        assert_eq!(ticket.poll(), None);
        assert_eq!(side.turn(), Sent::Exchange([0; 8]));
        side.access.channel_answered(&[0; 8]);
        assert!(matches!(side.turn(), Sent::Exchange(job) if job[7] == 5));
    }
}

fn hex(text: &str) -> [u8; 8] {
    let digits: String = text.split_whitespace().collect();
    u64::from_str_radix(&digits, 16).expect("hexadecimal").to_be_bytes()
}
