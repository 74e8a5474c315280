//! The link layer.

use proptest::collection::vec;
use proptest::prelude::*;

use super::super::fc::FunctionCode;
use super::super::sap::Service;
use super::super::telegram::{DU_MAX, Malformed, SC, token};
use super::*;

/// The reply of a slave to a request.
fn reply_to(request: Head, fc: u8) -> Head {
    Head { da: request.sa, sa: request.da, dsap: request.ssap, ssap: request.dsap, fc: FunctionCode(fc) }
}

#[test]
fn pyprofibus_fdl_status_and_token() {
    let request = Service::FdlStatus.head(SLAVE, MASTER, true, true);
    golden("10 07 02 49 52 16", request, &[]);
    golden("10 02 07 00 09 16", reply_to(request, 0x00), &[]);
    assert_eq!(token(MASTER, MASTER).to_vec(), hex("DC 02 02"));
    let read = Next::Telegram { telegram: Telegram::Token { da: MASTER, sa: MASTER }, size: 3 };
    assert_eq!(Next::parse(&token(MASTER, MASTER)), read);
}

#[test]
fn pyprofibus_diagnosis_of_eight_bytes_is_the_same_as_sd2_and_sd3() {
    let head = reply_to(Service::SlaveDiag.head(SLAVE, MASTER, true, false), 0x08);
    let data = hex("02 05 00 FF 00 82");
    golden("68 0B 0B 68 82 87 08 3E 3C 02 05 00 FF 00 82 13 16", head, &data);
    let sd3 = hex("A2 82 87 08 3E 3C 02 05 00 FF 00 82 13 16");
    assert_eq!(frame(&sd3), Frame { head, data: &data });
}

#[test]
fn each_broken_byte_has_its_name() {
    let good = hex("68 07 07 68 FF 82 46 3A 3E 00 00 3F 16");
    let malformed = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = good.clone();
        change(&mut bytes);
        match Next::parse(&bytes) {
            Next::Malformed { why, drop } => (why, drop),
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(malformed(&|b| b[0] = 0x00), (Malformed::Start, 3), "up to the second 68");
    assert_eq!(malformed(&|b| b[2] = 8), (Malformed::Length, 1));
    assert_eq!(malformed(&|b| b[3] = 0x69), (Malformed::Length, 1));
    for le in [0, 3, 250, 255] {
        assert_eq!(malformed(&|b| b[1..3].fill(le)), (Malformed::Length, 1));
    }
    assert_eq!(malformed(&|b| b[9] = 2), (Malformed::Check, 13));
    assert_eq!(malformed(&|b| b[11] = 0x40), (Malformed::Check, 13));
    assert_eq!(malformed(&|b| b[12] = 0x17), (Malformed::End, 13));
    // Access points that the telegram has no room for, and a token that cannot have one.
    for text in ["10 87 02 49 D2 16", "68 04 04 68 87 82 6D 3C B2 16", "DC 82 02"] {
        let bytes = hex(text);
        let drop = bytes.len();
        assert_eq!(Next::parse(&bytes), Next::Malformed { why: Malformed::Length, drop }, "{text}");
    }
}

#[test]
fn all_that_fits_is_sent_and_nothing_more() {
    let plain = Service::DataExchange.head(SLAVE, MASTER, false, true);
    let with_saps = Service::SetPrm.head(SLAVE, MASTER, false, true);
    for (head, most) in [(plain, DU_MAX), (with_saps, DU_MAX - 2)] {
        for size in 0..=MAX {
            let data = vec![0x5A; size];
            let mut out = [0; MAX];
            match head.emit(&data, &mut out) {
                Some(bytes) => assert_eq!(frame(&out[..bytes]), Frame { head, data: &data }),
                None => assert!(size > most),
            }
            assert_eq!(head.emit(&data, &mut out).is_some(), size <= most, "{size}");
        }
    }
}

/// All that is found in bytes which arrive in pieces, by one who drops what is to be dropped. Noise in a row is
/// one entry with its length.
#[derive(Debug, PartialEq, Default)]
struct Seen {
    all: Vec<(String, usize)>,
    left: usize,
}

fn pieces(bytes: &[u8], cuts: &[usize]) -> Seen {
    let mut seen = Seen::default();
    let (mut start, mut known) = (0, 0);
    for end in cuts.iter().copied().chain([bytes.len()]) {
        known = end.min(bytes.len()).max(known);
        loop {
            let (what, size) = match Next::parse(&bytes[start..known]) {
                Next::Incomplete { at_least } => {
                    assert!(at_least > 0 && known - start + at_least <= MAX);
                    break;
                }
                Next::Telegram { telegram, size } => (format!("{telegram:?}"), size),
                Next::Malformed { why: Malformed::Start, drop } => ("noise".to_owned(), drop),
                Next::Malformed { why, drop } => (format!("{why:?}"), drop),
            };
            assert!((1..=known - start).contains(&size), "progress, within what there is");
            start += size;
            match seen.all.last_mut() {
                Some((last, sum)) if *last == "noise" && what == "noise" => *sum += size,
                _ => seen.all.push((what, size)),
            }
        }
    }
    seen.left = bytes.len() - start;
    seen
}

/// A telegram, or part of one, or noise.
fn any_bytes() -> impl Strategy<Value = Vec<u8>> {
    let head = (0..128_u8, 0..127_u8, any::<Option<u8>>(), any::<Option<u8>>(), any::<u8>())
        .prop_map(|(da, sa, dsap, ssap, fc)| Head { da, sa, dsap, ssap, fc: FunctionCode(fc) });
    let whole = (head, vec(any::<u8>(), 0..40)).prop_map(|(head, data)| emitted(|out| head.emit(&data, out)));
    let changed =
        (whole.clone(), any::<prop::sample::Index>(), any::<u8>()).prop_map(|(mut bytes, at, value)| {
            let at = at.index(bytes.len());
            bytes[at] = value;
            bytes
        });
    let cut = (whole.clone(), any::<prop::sample::Index>()).prop_map(|(mut bytes, at)| {
        bytes.truncate(at.index(bytes.len()));
        bytes
    });
    prop_oneof![
        4 => whole,
        2 => changed,
        1 => cut,
        1 => Just(vec![SC]),
        1 => (0..128_u8, 0..128_u8).prop_map(|(da, sa)| token(da, sa).to_vec()),
        1 => vec(any::<u8>(), 0..20),
    ]
}

proptest! {
    #[test]
    fn a_telegram_is_read_as_it_was_written(
        da in 0..128_u8, sa in 0..127_u8, dsap: Option<u8>, ssap: Option<u8>, fc: u8,
        data in vec(any::<u8>(), 0..=DU_MAX - 2),
    ) {
        let head = Head { da, sa, dsap, ssap, fc: FunctionCode(fc) };
        let bytes = emitted(|out| head.emit(&data, out));
        prop_assert_eq!(frame(&bytes), Frame { head, data: &data });
        // Nothing that is cut off is a telegram, and what is missing is stated.
        for size in 1..bytes.len() {
            match Next::parse(&bytes[..size]) {
                Next::Incomplete { at_least } if size < 4 => prop_assert!(size + at_least <= bytes.len()),
                Next::Incomplete { at_least } => prop_assert_eq!(size + at_least, bytes.len()),
                other => panic!("{other:?}"),
            }
        }
    }

    #[test]
    fn one_wrong_bit_in_a_telegram_is_found(
        data in vec(any::<u8>(), 1..60), at: prop::sample::Index, bit in 0..8,
    ) {
        let head = Service::DataExchange.head(SLAVE, MASTER, false, true);
        let mut bytes = emitted(|out| head.emit(&data, out));
        let at = at.index(bytes.len());
        bytes[at] ^= 1_u8 << bit;
        // A changed length in both places would be the next telegram's bytes; one bit is never that.
        let is_malformed = matches!(Next::parse(&bytes), Next::Malformed { .. });
        prop_assert!(is_malformed, "byte {at}: {:?}", Next::parse(&bytes));
    }

    #[test]
    fn what_is_found_does_not_depend_on_how_it_arrives(
        parts in vec(any_bytes(), 0..8), cuts in vec(0..300_usize, 0..12),
    ) {
        let bytes = parts.concat();
        let whole = pieces(&bytes, &[]);
        let mut cuts = cuts;
        cuts.sort_unstable();
        prop_assert_eq!(&pieces(&bytes, &cuts), &whole);
        let every_byte: Vec<usize> = (0..bytes.len()).collect();
        prop_assert_eq!(&pieces(&bytes, &every_byte), &whole);
        let sizes: usize = whole.all.iter().map(|(_, size)| size).sum();
        prop_assert_eq!(sizes + whole.left, bytes.len(), "every byte is counted once");
    }
}
