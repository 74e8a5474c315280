use super::*;
use crate::testing::hex;

/// A row: what the master writes; the SDO that has to be carried out: data to write, and the value that was read; the
/// answer.
type Row<'a> = (&'a str, Option<(Option<&'a str>, &'a str)>, &'a str);

/// Passes messages through a mailbox, one after the other.
fn exchange(mut mailbox: Mailbox, rows: &[Row<'_>]) {
    for (sent, requested, answer) in rows {
        let request = mailbox.take(&hex(sent));
        let data = request.as_ref().map(|request| request.data.clone());
        let expected = requested.as_ref().map(|(data, _)| data.map(hex));
        assert_eq!(data, expected, "{sent}");
        if let (Some(request), Some((_, result))) = (request, requested) {
            mailbox.answer(&request, Ok(hex(result)));
        }
        assert_eq!(mailbox.next().unwrap_or_default(), hex(answer), "{sent}");
        assert_eq!(mailbox.next(), None, "{sent}");
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
    let value = "0A00 0000 00 13 0030 4F 001C 00 04000000";
    exchange(
        standard(None),
        &[
            ("0A00 0000 00 13 0020 40 001C 00 00000000", read("04"), value),
            // A repetition.
            ("0A00 0000 00 13 0020 40 001C 00 00000000", None, ""),
            // Unused bytes are old memory.
            (
                "0A00 0000 00 23 0020 40 001C 00 00000000",
                read("11223344"),
                "0A00 0000 00 23 0030 43 001C 00 11223344",
            ),
            (
                "0A00 0000 00 33 0020 40 001C 00 00000000",
                read("5566"),
                "0A00 0000 00 33 0030 4B 001C 00 55663344",
            ),
        ],
    );
    let selected = "0E00 0000 00 03 0020 60 121C 01 00000000";
    let select = "0A00 0000 00 03 0020 2B 121C 01 04170000";
    exchange(Mailbox::new(Dialect::Manual, None), &[(select, write("0417"), selected); 2]);
    let mut mailbox = standard(None);
    (0..100).for_each(|_| mailbox.report(0x4310, 8, 1));
    assert_eq!(mailbox.next(), Some(hex("0A00 0000 00 03 0010 1043 08 01 00000000")));
    assert_eq!(mailbox.queue.len(), QUEUE - 1);
}

#[test]
fn what_a_slave_with_expedited_sdos_cannot_do_is_refused_by_its_code() {
    for (sent, answer) in [
        // Aborts, which have the service of a request: commands of longer transfers, and complete access.
        ("0A00 0000 00 13 0020 21 121C 01 04170000", "0A00 0000 00 13 0020 80 121C 01 01000405"),
        ("0A00 0000 00 13 0020 60 121C 01 04170000", "0A00 0000 00 13 0020 80 121C 01 01000405"),
        ("0A00 0000 00 13 0020 01 121C 01 04170000", "0A00 0000 00 13 0020 80 121C 01 01000405"),
        ("0A00 0000 00 13 0020 50 121C 01 04170000", "0A00 0000 00 13 0020 80 121C 01 04000106"),
        ("0A00 0000 00 13 0020 33 121C 01 04170000", "0A00 0000 00 13 0020 80 121C 01 04000106"),
        // An abort has no answer.
        ("0A00 0000 00 13 0020 80 121C 01 04170000", ""),
        // Errors of the mailbox: protocol, service, size, and a message that is too short.
        ("0A00 0000 00 12 0020 2B 121C 01 04170000", "0400 0000 00 10 0100 0200 000000000000"),
        ("0A00 0000 00 13 0090 2B 121C 01 04170000", "0400 0000 00 10 0100 0400 000000000000"),
        ("C800 0000 00 13 0020 2B 121C 01 04170000", "0400 0000 00 10 0100 0800 000000000000"),
        ("0E00 0000 00 13 0020 2B 121C 01 04170000", "0400 0000 00 10 0100 0800 000000000000"),
        ("0A00 0000 00 13 0020 2B 121C 01 041700", "0400 0000 00 00 0100 0600 000000000000"),
        // SDO information: there is no dictionary.
        ("0800 0000 00 43 0080 01 00 0000 0100 0000", "0A00 0000 00 43 0080 07 00 0000 23000008"),
    ] {
        exchange(standard(None), &[(sent, None, answer)]);
    }
}

#[test]
fn long_values_are_read_and_written_at_once_or_in_segments_as_they_fit() {
    // 20 bytes of all subindices: 16 in the answer, and four of seven in the last segment.
    exchange(
        standard(Some(32)),
        &[
            (
                "0A00 0000 00 13 0020 50 001C 00 00000000",
                read("000102030405060708090A0B0C0D0E0F 10111213"),
                "1A00 0000 00 13 0030 51 001C 00 14000000 000102030405060708090A0B0C0D0E0F",
            ),
            ("0A00 0000 00 23 0020 60 001C 00 00000000", None, "0A00 0000 00 23 0030 07 10111213 000000"),
            // It has ended.
            ("0A00 0000 00 33 0020 70 001C 00 00000000", None, "0A00 0000 00 33 0020 80 001C 00 01000405"),
            // A short one is expedited all the same.
            (
                "0A00 0000 00 43 0020 40 001C 00 00000000",
                read("07"),
                "0A00 0000 00 43 0030 4F 001C 00 07000000",
            ),
            // Written in one message of more than 16 bytes, all subindices.
            (
                "1000 0000 00 53 0020 31 121C 01 06000000 010004170909",
                write("010004170909"),
                "0A00 0000 00 53 0030 60 121C 01 00000000",
            ),
            // Longer than what was written, and less than was announced.
            (
                "2800 0000 00 63 0020 31 121C 01 06000000 010004170909",
                None,
                "0400 0000 00 60 0100 0800 000000000000",
            ),
            // Written in segments.
            ("0A00 0000 00 13 0020 21 0810 00 0A000000", None, "0A00 0000 00 13 0030 60 0810 00 00000000"),
            ("0A00 0000 00 23 0020 00 01010101010101", None, "0A00 0000 00 23 0030 20 00000000000000"),
            (
                "0A00 0000 00 33 0020 19 020202 00000000",
                write("01010101010101020202"),
                "0A00 0000 00 33 0030 30 00000000000000",
            ),
        ],
    );
}

#[test]
fn a_transfer_that_goes_wrong_ends() {
    const BEGIN: Row<'_> =
        ("0A00 0000 00 13 0020 21 0810 00 0A000000", None, "0A00 0000 00 13 0030 60 0810 00 00000000");
    let read: Row<'_> = (
        "0A00 0000 00 13 0020 40 0810 00 00000000",
        read("00010203040506070809"),
        "0A00 0000 00 13 0030 41 0810 00 0A000000",
    );
    let gone = "0A00 0000 00 33 0020 80 000000 01000405";
    for (first, second, answer) in [
        // A toggle that does not change, more than announced, less than announced.
        (BEGIN, "0A00 0000 00 23 0020 10 00000000000000", "0A00 0000 00 23 0020 80 000000 00000305"),
        (BEGIN, "0E00 0000 00 23 0020 00 0000000000000000000000", "0A00 0000 00 23 0020 80 000000 10000706"),
        (BEGIN, "0A00 0000 00 23 0020 01 00000000000000", "0A00 0000 00 23 0020 80 000000 10000706"),
        (read, "0A00 0000 00 23 0020 70 00000000000000", "0A00 0000 00 23 0020 80 000000 00000305"),
        // The master gives up.
        (BEGIN, "0A00 0000 00 23 0020 80 00000000000000", ""),
        (read, "0A00 0000 00 23 0020 80 00000000000000", ""),
    ] {
        let third = if first.1.is_none() { "00" } else { "60" };
        let third = format!("0A00 0000 00 33 0020 {third} 00000000000000");
        exchange(standard(Some(16)), &[first, (second, None, answer), (&third, None, gone)]);
    }
    // More than announced at once, and more than there can be.
    for sent in ["0B00 0000 00 13 0020 21 0810 00 00000000 01", "0A00 0000 00 13 0020 21 0810 00 FFFFFFFF"] {
        exchange(standard(Some(32)), &[(sent, None, "0A00 0000 00 13 0020 80 0810 00 10000706")]);
    }
}

#[test]
fn a_value_of_40_bytes_takes_as_many_segments_as_the_mailbox_needs() {
    let text: Vec<u8> = (0..40).collect();
    for (room, segments) in [(1_024, 0), (56, 0), (55, 1), (32, 2), (16, 6)] {
        let mut mailbox = standard(Some(room));
        let sent = |counter: u8, command: u8| {
            [10, 0, 0, 0, 0, 3 | counter << 4, 0, 0x20, command, 8, 0x10, 0, 0, 0, 0, 0]
        };
        let request = mailbox.take(&sent(1, 0x40)).unwrap();
        mailbox.answer(&request, Ok(text.clone()));
        let (mut got, mut count) = (mailbox.next().unwrap()[16..].to_vec(), 0);
        while got.len() < 40 {
            assert_eq!(mailbox.take(&sent(2 + count % 2, 0x60 | count % 2 << 4)), None);
            let answer = mailbox.next().unwrap();
            let unused = if answer.len() == 16 { usize::from(answer[8] >> 1 & 7) } else { 0 };
            got.extend(&answer[9..answer.len() - unused]);
            count += 1;
            assert_eq!(answer[8] & 1 != 0, got.len() == 40);
        }
        assert_eq!((&got, count), (&text, segments), "{room}");
    }
}
