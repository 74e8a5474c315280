//! MSAC1 and parameter requests.

use super::*;

const SAPS: Option<(u8, u8)> = Some((51, 51));

fn bench(change: impl FnOnce(&mut AcyclicSettings)) -> Bench {
    Bench::online(|settings| change(&mut settings.acyclic))
}

/// The answer to a request, behind the polls that it takes.
fn ask(bench: &mut Bench, data: &[u8]) -> Vec<u8> {
    // The cycle goes on meanwhile, for the watchdog.
    bench.words(0, 0);
    let mut answer = bench.srd(SAPS, data).unwrap();
    for _ in 0..10 {
        if answer.0 == 8 {
            return answer.1;
        }
        assert_eq!(answer, (0xE5, vec![]));
        answer = bench.srd(SAPS, &[]).unwrap();
    }
    panic!("no answer to {data:02X?}");
}

/// The response to a parameter request.
fn request(bench: &mut Bench, data: &[u8]) -> Vec<u8> {
    let write = [&[0x5F, 0, 47, data.len() as u8], data].concat();
    assert_eq!(ask(bench, &write), write[..4]);
    bench.wait(5 * MS);
    let answer = ask(bench, &[0x5E, 0, 47, 240]);
    assert_eq!((&answer[..3], usize::from(answer[3])), (&[0x5E, 0, 47][..], answer.len() - 4));
    answer[4..].to_vec()
}

/// Section 3 of the sheet, bytes of the wire. The frame count bit of each new request is the other one.
#[test]
fn the_telegrams_of_the_sheet_are_answered_as_the_sheet_has_it() {
    let write = "68 13 13 68 87 82 5C 33 33 5F 00 2F 0A 01 01 00 01 10 00 5F C2 00 00 97 16";
    let poll = "68 05 05 68 87 82 7C 33 33 EB 16";
    let written = "68 09 09 68 82 87 08 33 33 5F 00 2F 0A 0F 16";
    let read = "68 09 09 68 87 82 5C 33 33 5E 00 2F F0 48 16";
    let busy = "68 09 09 68 82 87 08 33 33 DE 80 B5 00 8A 16";
    let value = "68 13 13 68 82 87 08 33 33 5E 00 2F 0A 01 01 00 01 43 01 00 06 8F B0 9A 16";
    let mut bench = bench(|_| ());
    // The bit has to be clear next.
    if bench.fcb == Some(true) {
        bench.exchange(&[0; 12]);
    }
    let mut step = |request: &str, answer: &str, wait| {
        assert_eq!(bench.ask(&hex(request)), Some(hex(answer)), "{request}");
        bench.wait(wait);
    };
    step(write, "E5", 0);
    step(poll, written, 0);
    step(read, "E5", 0);
    step(poll, busy, 5 * MS);
    step(read, "E5", 0);
    step(poll, value, 0);
    assert_eq!(bench.slave().misuse(), Misuse::default());
}

#[test]
fn a_request_into_another_one_finds_no_resource_or_a_busy_drive() {
    let mut bench = bench(|settings| settings.busy_ns = 50 * MS);
    let write = hex("5F 00 2F 0A 01 01 00 01 10 00 5F C2 00 00");
    assert_eq!(bench.srd(SAPS, &write), Some((0xE5, vec![])));
    assert_eq!(bench.srd(SAPS, &write), Some((2, vec![])));
    assert_eq!(bench.slave().misuse(), Misuse { acyclic: 1, ..Misuse::default() });
    assert_eq!(bench.srd(SAPS, &[]).unwrap().1, write[..4]);
    assert_eq!(ask(&mut bench, &write), [0xDF, 0x80, 0xC2, 0]);
    assert_eq!(ask(&mut bench, &[0x5E, 0, 47, 240]), [0xDE, 0x80, 0xB5, 0]);
    bench.wait(50 * MS);
    // Nobody has read the response: no other request takes its place.
    assert_eq!(ask(&mut bench, &write), [0xDF, 0x80, 0xB5, 0]);
    // Too short for the response, which then still is there.
    assert_eq!(ask(&mut bench, &[0x5E, 0, 47, 9]), [0xDE, 0x80, 0xB1, 0]);
    assert_eq!(ask(&mut bench, &[0x5E, 0, 47, 10])[..4], [0x5E, 0, 47, 10]);
    assert_eq!(ask(&mut bench, &[0x5E, 0, 47, 240]), [0xDE, 0x80, 0xB5, 0], "it is read");
    assert_eq!(ask(&mut bench, &write), write[..4]);
}

#[test]
fn several_parameters_of_a_request_have_their_results_in_turn() {
    let mut bench = bench(|_| ());
    let read = "05 01 00 03 10 00 5F C2 00 00 10 00 58 30 00 00 10 00 5F A2 00 00";
    assert_eq!(request(&mut bench, &hex(read)), hex("05 81 00 03 43 01 00 06 8F B0 44 01 00 00 42 01 08 55"));
    // C0039/2 = 150.4, C0061 is read-only, C0012 has another format, C0013 = 1 s.
    let write = "06 02 01 04 10 00 5F D8 00 02 10 00 5F C2 00 00 10 00 5F F3 00 00 10 00 5F F2 00 00 \
                 04 01 00 16 F3 00 43 01 00 00 00 00 42 01 00 01 43 01 00 00 27 10";
    assert_eq!(request(&mut bench, &hex(write)), hex("06 82 01 04 40 00 44 01 00 01 44 01 00 05 40 00"));
    let check = "07 01 00 02 10 01 5F D8 00 02 10 01 5F F2 00 00";
    assert_eq!(request(&mut bench, &hex(check)), hex("07 01 00 02 43 01 00 16 F3 00 43 01 00 00 27 10"));
    // All well: only the header.
    let write = "08 02 00 01 10 00 5F D8 00 01 43 01 00 00 00 05";
    assert_eq!(request(&mut bench, &hex(write)), hex("08 02 00 01"));
    assert_eq!(bench.slave().eeprom_writes(), 3);
    for (wrong, answer) in [
        ("09 01 02 01 10 00 5F C2 00 00", "09 81 02 01 44 01 00 19"),
        ("09 03 00 01 10 00 5F C2 00 00", "09 83 00 01 44 01 00 17"),
        ("09 01 00 02 10 00 5F C2 00 00", "09 81 00 02 44 01 00 17 44 01 00 17"),
        ("09 01 00 00", "09 81 00 00 44 01 00 17"),
        ("09 01 00 01 10 00 5F D8 00 04", "09 81 00 01 44 01 00 03"),
        ("09 01 00 01 30 00 5F D8 00 01", "09 81 00 01 44 01 00 0F"),
        ("09 01 00 01 10 02 5F D8 00 01", "09 81 00 01 44 01 00 16"),
        ("09 02 00 01 10 00 5F D8 00 01 43 01 00", "09 82 00 01 44 01 00 17"),
        ("09", "09 80 00 00"),
    ] {
        assert_eq!(request(&mut bench, &hex(wrong)), hex(answer), "{wrong}");
    }
    assert_eq!(bench.slave().misuse(), Misuse::default());
}

#[test]
fn a_text_comes_in_parts_if_it_is_too_long_for_one() {
    let text = "82S8212V_31000 simulated, with EMF2133IB PROFIBUS-DP";
    let place = |from: u8, count: u8| [1, 1, 0, 1, 0x10, count, 0x5F, 0x37, 0, from];
    let mut bench = bench(|_| ());
    assert_eq!(request(&mut bench, &place(0, 0))[4..], [0x44, 1, 0, 0x15]);
    let mut whole = Vec::new();
    while whole.len() < text.len() {
        let part = request(&mut bench, &place(whole.len() as u8, 20));
        assert_eq!((part[1], part[4]), (1, 9));
        whole.extend_from_slice(&part[6..][..usize::from(part[5])]);
    }
    assert_eq!(String::from_utf8(whole).unwrap(), text);
    assert_eq!(request(&mut bench, &place(text.len() as u8, 20))[4..], [0x44, 1, 0, 3]);
    let mut bench = self::bench(|settings| settings.text = 200);
    assert_eq!(request(&mut bench, &place(0, 1))[6..], *text.as_bytes());
}

#[test]
fn an_index_is_the_code_where_that_is_set_up() {
    let mut bench = bench(|settings| {
        (settings.numbers, settings.slot) = (fieldbeat_profibus::Numbers::Code, 2);
    });
    let write = hex("5F 02 2F 0A 01 01 00 01 10 00 00 3D 00 00");
    assert_eq!(ask(&mut bench, &write), write[..4]);
    bench.wait(5 * MS);
    assert_eq!(ask(&mut bench, &[0x5E, 2, 47, 240])[4..], hex("01 01 00 01 43 01 00 06 8F B0"));
}
