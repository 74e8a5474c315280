use super::*;
use crate::testing::hex;

/// A row: what the master writes; the SDO that has to be carried out, if any, as data to write and the value read; the
/// answer. A message is counter and type, service, command and so on, filled up to 16 bytes; or in full after `00`.
type Row<'a> = (&'a str, Option<(Option<&'a str>, &'a str)>, &'a str);

/// A message of a row.
fn message(text: &str) -> Vec<u8> {
    let bytes = hex(text);
    let [kind, service, body @ ..] = &bytes[..] else { return bytes };
    if *kind == 0 {
        return bytes[1..].to_vec();
    }
    let length = (2 + body.len()).max(10);
    let mut message = [&[length as u8, 0, 0, 0, 0, *kind, 0, *service][..], body].concat();
    message.resize(6 + length, 0);
    message
}

/// Passes messages through a mailbox, one after the other.
fn exchange(mut mailbox: Mailbox, rows: &[Row<'_>]) {
    for (sent, requested, answer) in rows {
        let request = mailbox.take(&message(sent));
        let data = request.as_ref().map(|request| request.data.clone());
        assert_eq!(data, requested.map(|(data, _)| data.map(hex)), "{sent}");
        if let (Some(request), Some((_, result))) = (request, requested) {
            mailbox.answer(&request, Ok(hex(result)));
        }
        let answers = [mailbox.next(), mailbox.next()].map(Option::unwrap_or_default);
        assert_eq!(answers, [message(answer), Vec::new()], "{sent}");
    }
}

fn standard(room: Option<usize>) -> Mailbox {
    Mailbox::new(Dialect::Standard, room)
}

/// An SDO that reads a value.
const fn read(value: &str) -> Option<(Option<&str>, &str)> {
    Some((None, value))
}

/// An SDO that writes.
const fn write(data: &str) -> Option<(Option<&str>, &str)> {
    Some((Some(data), ""))
}

#[test]
fn answers_are_those_of_a_real_drive_and_of_the_manual_to_the_byte() {
    let (request, value) =
        ("00 0A00 0000 00 13 0020 40 001C 00 00000000", "00 0A00 0000 00 13 0030 4F 001C 00 04000000");
    let rows = [
        (request, read("04"), value),
        // A repetition.
        (request, None, ""),
        // Unused bytes are old memory.
        ("23 20 40 001C00", read("11223344"), "23 30 43 001C00 11223344"),
        ("33 20 40 001C00", read("5566"), "33 30 4B 001C00 55663344"),
    ];
    exchange(standard(None), &rows);
    let selected = "00 0E00 0000 00 03 0020 60 121C 01 00000000";
    exchange(Mailbox::new(Dialect::Manual, None), &[("03 20 2B 121C01 0417", write("0417"), selected); 2]);
    let mut mailbox = standard(None);
    (0..100).for_each(|_| mailbox.report(0x4310, 8, 1));
    assert_eq!(mailbox.next(), Some(hex("0A00 0000 00 03 0010 1043 08 01 00000000")));
    assert_eq!(mailbox.queue.len(), QUEUE - 1);
}

#[test]
fn what_a_slave_with_expedited_sdos_cannot_do_is_refused_by_its_code() {
    for (sent, answer) in [
        // Aborts, which have the service of a request: commands of longer transfers, and complete access.
        ("13 20 21 121C01", "13 20 80 121C01 01000405"),
        ("13 20 60 121C01", "13 20 80 121C01 01000405"),
        ("13 20 01 121C01", "13 20 80 121C01 01000405"),
        ("13 20 50 121C01", "13 20 80 121C01 04000106"),
        ("13 20 33 121C01", "13 20 80 121C01 04000106"),
        // An abort has no answer.
        ("13 20 80 121C01", ""),
        // Errors of the mailbox: protocol, service, size, and a message that is too short.
        ("12 20 2B 121C01", "00 0400 0000 00 10 0100 0200 000000000000"),
        ("13 90 2B 121C01", "00 0400 0000 00 10 0100 0400 000000000000"),
        ("00 C800 0000 00 13 0020 2B121C01 04170000", "00 0400 0000 00 10 0100 0800 000000000000"),
        ("00 0E00 0000 00 13 0020 2B121C01 04170000", "00 0400 0000 00 10 0100 0800 000000000000"),
        ("00 0A00 0000 00 13 0020 2B121C01 041700", "00 0400 0000 00 00 0100 0600 000000000000"),
        // SDO information: there is no dictionary.
        ("43 80 01000000 0100", "43 80 07000000 23000008"),
    ] {
        exchange(standard(None), &[(sent, None, answer)]);
    }
}

#[test]
fn long_values_are_read_and_written_at_once_or_in_segments_as_they_fit() {
    let long = "000102030405060708090A0B0C0D0E0F 10111213";
    let rows = [
        // All subindices: 16 bytes in the answer, and four of seven in the last segment.
        ("13 20 50 001C00", read(long), "13 30 51 001C00 14000000 000102030405060708090A0B0C0D0E0F"),
        ("23 20 60 001C00", None, "23 30 07 10111213"),
        ("33 20 70 001C00", None, "33 20 80 001C00 01000405"),
        // A short one is expedited all the same.
        ("43 20 40 001C00", read("07"), "43 30 4F 001C00 07000000"),
        // Written in one message of more than 16 bytes, all subindices.
        ("53 20 31 121C01 06000000 010004170909", write("010004170909"), "53 30 60 121C01"),
        // Longer than what was written.
        ("00 2800 0000 00 63 0020 31121C01 06000000 0100", None, "00 0400 0000 00 60 0100 0800 000000000000"),
        // Written in segments.
        ("13 20 21 081000 0A000000", None, "13 30 60 081000"),
        ("23 20 00 01010101010101", None, "23 30 20"),
        ("33 20 19 020202", write("01010101010101 020202"), "33 30 30"),
    ];
    exchange(standard(Some(32)), &rows);
}

#[test]
fn a_transfer_that_goes_wrong_ends() {
    let write = ("13 20 21 081000 0A000000", None, "13 30 60 081000");
    let read = ("13 20 40 081000", read("00010203040506070809"), "13 30 41 081000 0A000000");
    for (first, next, second, answer) in [
        // A toggle that does not change, more than announced, less than announced.
        (write, "00", "23 20 10", "23 20 80 000000 00000305"),
        (write, "00", "23 20 00 0000000000000000000000", "23 20 80 000000 10000706"),
        (write, "00", "23 20 01", "23 20 80 000000 10000706"),
        (read, "60", "23 20 70", "23 20 80 000000 00000305"),
        // The master gives up.
        (write, "00", "23 20 80", ""),
        (read, "60", "23 20 80", ""),
    ] {
        let third = format!("33 20 {next}");
        let gone = (&third[..], None, "33 20 80 000000 01000405");
        exchange(standard(Some(16)), &[first, (second, None, answer), gone]);
    }
    // More than announced at once, and more than there can be.
    for sent in ["13 20 21 081000 00000000 01", "13 20 21 081000 FFFFFFFF"] {
        exchange(standard(Some(32)), &[(sent, None, "13 20 80 081000 10000706")]);
    }
}

#[test]
fn a_value_of_40_bytes_takes_as_many_segments_as_the_mailbox_needs() {
    let text: Vec<u8> = (0..40).collect();
    for (room, segments) in [(1_024, 0), (56, 0), (55, 1), (32, 2), (16, 6)] {
        let mut mailbox = standard(Some(room));
        let request = mailbox.take(&message("13 20 40 081000")).unwrap();
        mailbox.answer(&request, Ok(text.clone()));
        let (mut got, mut count) = (mailbox.next().unwrap()[16..].to_vec(), 0);
        while got.len() < 40 {
            let next = ["23 20 60", "33 20 70"][count % 2];
            assert_eq!(mailbox.take(&message(next)), None);
            let answer = mailbox.next().unwrap();
            let unused = if answer.len() == 16 { usize::from(answer[8] >> 1 & 7) } else { 0 };
            got.extend(&answer[9..answer.len() - unused]);
            count += 1;
            assert_eq!(answer[8] & 1 != 0, got.len() == 40);
        }
        assert_eq!((&got, count), (&text, segments), "{room}");
    }
}
