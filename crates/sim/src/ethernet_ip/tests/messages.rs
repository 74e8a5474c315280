//! Explicit messages: objects, class 3 and its repetitions, type 1 and type 2.

use super::*;

/// Sends on the class 3 connection: the reply behind the encapsulation.
fn connected(bench: &mut Bench, count: u16, message: &str) -> Vec<u8> {
    let message = hex(message);
    let mut data = hex("00 00 00 00 00 00 02 00 A1 00 04 00");
    data.extend(bench.id.to_le_bytes());
    data.extend([0xB1, 0]);
    data.extend((message.len() as u16 + 2).to_le_bytes());
    data.extend(count.to_le_bytes());
    data.extend(message);
    let reply = bench.raw(MASTER, &frame(0x70, bench.session, &data));
    if reply.is_empty() { reply } else { reply[44..].to_vec() }
}

const READ: &str = "3C 03 20 64 24 01 30 01 00 02 88 01 00 00 00 00";
const WRITE_A: &str = "3C 03 20 64 24 01 30 01 00 02 9E 31 00 00 00 0A";
const WRITE_B: &str = "3C 03 20 64 24 01 30 01 00 02 9E 31 00 00 00 0B";

fn register(bench: &mut Bench) -> Vec<u8> {
    bench.vendor("00 02 9F 31 00 00 00 00").1[4..].to_vec()
}

#[test]
fn a_repeated_message_gets_its_reply_again_and_is_not_carried_out_again() {
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward::messages());
    assert_eq!(connected(&mut bench, 0, READ), [0; 0], "the first one is not 0");
    let first = connected(&mut bench, 1, WRITE_A);
    assert_eq!(first, hex("01 00 BC 00 00 00 00 02 9E 31 00 00 00 00"));
    assert_eq!(register(&mut bench), [0, 0, 0, 0x0A]);
    assert_eq!(connected(&mut bench, 1, WRITE_B), first);
    assert_eq!(connected(&mut bench, 1, "0E 03 20 01 24 01 30 01"), first, "even another one");
    assert_eq!(register(&mut bench), [0, 0, 0, 0x0A]);
    connected(&mut bench, 9, WRITE_B);
    assert_eq!(register(&mut bench), [0, 0, 0, 0x0B], "a jump");
    connected(&mut bench, 3, WRITE_A);
    assert_eq!(register(&mut bench), [0, 0, 0, 0x0A], "a step back");
    assert_eq!(bench.sim.ignored(), Ignored { repeated: 3, ..Ignored::default() });
}

#[test]
fn a_message_to_nothing_gets_no_reply() {
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward::messages());
    bench.id += 1;
    assert_eq!(connected(&mut bench, 1, READ), [0; 0]);
    bench.id -= 1;
    // Another connection of the same host.
    let other = SocketAddrV4::new(*MASTER.ip(), 50_000);
    let session = bench.connect(other);
    let mut data = hex("00 00 00 00 00 00 02 00 A1 00 04 00");
    data.extend(bench.id.to_le_bytes());
    data.extend(hex("B1 00 04 00 01 00 0E 00"));
    assert_eq!(bench.raw(other, &frame(0x70, session, &data)), [0; 0]);
    bench.message(&Forward::messages().close());
    assert_eq!(connected(&mut bench, 1, READ), [0; 0], "closed");
    assert_eq!(bench.sim.ignored(), Ignored { unknown_connection: 2, wrong_source: 1, ..Ignored::default() });
}

#[test]
fn a_class_3_connection_times_out_or_stays_and_ends_with_its_tcp() {
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward { us: (100_000, 100_000), multiplier: 2, ..Forward::messages() });
    bench.pass(9 * S);
    assert_ne!(connected(&mut bench, 1, READ), [0; 0]);
    bench.pass(1_600 * MS - 1);
    assert_ne!(connected(&mut bench, 1, READ), [0; 0], "a repetition feeds, too");
    bench.pass(1_600 * MS);
    assert_eq!((bench.sim.connections().1, bench.sim.hangs_up(MASTER)), (0, true));
    let mut stays = Bench::new(|settings| settings.network.messages_time_out = false);
    stays.open(&Forward::messages());
    stays.pass(100 * S);
    assert_eq!(stays.sim.connections(), (1, 1));
    stays.sim.disconnected(stays.now, MASTER);
    assert_eq!(stays.sim.connections(), (0, 0));
}

#[test]
fn a_reply_that_does_not_fit_is_refused_and_a_message_that_does_not_is_dropped() {
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward { ncp: (0x43F4, 0x4214), ..Forward::messages() });
    assert_eq!(connected(&mut bench, 1, "01 02 20 01 24 01"), hex("01 00 81 00 11 00"));
    assert_eq!(connected(&mut bench, 2, "0E 03 20 01 24 01 30 01"), hex("02 00 8E 00 00 00 3C 00"));
    let mut bench = Bench::new(|_| {});
    bench.open(&Forward { ncp: (0x4208, 0x43F4), ..Forward::messages() });
    assert_eq!(connected(&mut bench, 1, "0E 03 20 01 24 01 30 01"), [0; 0]);
    assert_eq!(bench.sim.ignored().wrong_length, 1);
}

#[test]
fn what_does_not_exist_is_refused_as_the_sheet_says() {
    let mut bench = Bench::new(|_| {});
    let mut status = |message: &str| {
        let reply = bench.message(&hex(message));
        assert_eq!((reply[0], reply[3], reply.len()), (hex(message)[0] | 0x80, 0, 4), "{message}");
        reply[2]
    };
    assert_eq!(status("0E 03 20 01 24 01 30 63"), 0x14);
    assert_eq!(status("0E 03 20 77 24 01 30 01"), 0x05);
    assert_eq!(status("0E 03 20 01 24 02 30 01"), 0x05);
    assert_eq!(status("0E 00"), 0x05);
    assert_eq!(status("4B 03 20 01 24 01 30 01"), 0x08);
    assert_eq!(status("52 02 20 06 24 01 0A 0E"), 0x08);
    assert_eq!(status("0E 03 91 02 41 42 24 01"), 0x04);
    assert_eq!(status("0E 09 20 01 24 01"), 0x26);
    assert_eq!(status("10 03 20 04 24 70 30 03 00"), 0x13);
    assert_eq!(status(&format!("10 03 20 04 24 70 30 03 {}", "00 ".repeat(65))), 0x15);
    assert_eq!(status(&format!("10 03 20 04 24 70 30 03 {}", "00 ".repeat(64))), 0x00);
    assert_eq!(status("10 03 20 04 24 65 30 03 00"), 0x0E);
    assert_eq!(status("10 03 20 04 24 70 30 04 00"), 0x0E);
    assert_eq!(status("3C 03 20 64 24 01 30 02 00 02 88 01 00 00 00 00"), 0x14);
    assert_eq!(status("3C 02 20 64 24 01 00 02 88 01 00 00 00 00"), 0x14);
    assert_eq!(status("3C 03 20 64 24 02 30 01 00 02 88 01 00 00 00 00"), 0x05);
}

#[test]
fn the_objects_say_what_the_drive_is() {
    let mut bench = Bench::new(|settings| settings.identity.serial = Some(0x0102_0304));
    let identity = "3C 00 2B 00 01 00 01 01 00 00 04 03 02 01 08 53 54 46 31 30 2D 49 50";
    for (message, size, begin) in [
        ("01 02 20 01 24 01", 23, identity),
        ("0E 03 20 01 24 01 30 06", 4, "04 03 02 01"),
        ("0E 03 20 04 24 65 30 04", 2, "38 00"),
        ("0E 03 20 04 24 65 30 03", 56, ""),
        ("0E 03 20 04 24 64 30 03", 30, "02 00 00 0A"),
        ("0E 03 20 04 24 66 30 04", 2, "02 00"),
        ("0E 03 20 F5 24 01 30 05", 22, "02 00 00 0A 00 FF FF FF"),
        ("0E 03 20 F6 24 02 30 01", 4, "64 00 00 00"),
        ("0E 03 20 48 24 01 30 05", 1, "2F"),
        ("0E 03 20 64 24 00 30 01", 10, "00 FB 00 00 41 B0 00 01 03 4A"),
    ] {
        let reply = bench.message(&hex(message));
        assert_eq!((&reply[1..4], reply.len()), (&[0, 0, 0][..], 4 + size), "{message}");
        assert!(reply[4..].starts_with(&hex(begin)), "{message}: {reply:02X?}");
    }
    // The outputs can be set while nobody owns them.
    assert_eq!(bench.message(&hex("0E 03 20 04 24 70 30 03"))[4..], [0; 64]);
    let set = hex(&format!("10 03 20 04 24 70 30 03 02 {}", "00 ".repeat(63)));
    assert_eq!((bench.message(&set), bench.status()), (hex("90 00 00 00"), 1));
    bench.open(&Forward::default());
    assert_eq!(bench.message(&set), hex("90 00 0C 00"));
}

#[test]
fn parameters_are_read_written_and_saved_by_type_2() {
    let mut bench = Bench::new(|_| {});
    assert_eq!(bench.vendor("00 02 83 1E 00 64 00 00"), (0, hex("00 02 83 1E 00 00 00 00")));
    assert_eq!(bench.vendor("00 02 84 1E 00 00 00 00").1[4..6], [0, 0x64]);
    assert_eq!(bench.vendor("00 02 83 9D 00 C8 00 00").0, 0, "into the flash");
    assert_eq!(bench.vendor("00 02 84 26 00 00 00 00").1[4..6], 10_000_u16.to_be_bytes(), "EG in pairs");
    bench.vendor("00 02 83 1E 7D 01 00 00");
    assert_eq!((bench.vendor("00 02 84 1E 00 00 00 00").1[5], bench.sim.refused().out_of_range), (0x64, 1));
    assert_eq!(bench.vendor("00 02 84 80 00 00 00 00"), (0, hex("00 02 84 80 00 00 00 00")));
    assert_eq!(bench.vendor("00 02 84 7F 00 00 00 00").0, 0x20);
    bench.power_cycle();
    assert_eq!(bench.vendor("00 02 84 1E 00 00 00 00").1[4..6], 600_u16.to_be_bytes());
    assert_eq!(bench.vendor("00 02 84 1D 00 00 00 00").1[4..6], [0, 0xC8], "saved");
}

#[test]
fn a_wrong_vendor_message_is_refused() {
    let mut bench = Bench::new(|_| {});
    assert_eq!(bench.vendor("00 02 88 01 00 00 00"), (0x13, vec![]));
    assert_eq!(bench.vendor("00 02 88 01 00 00 00 00 00"), (0x15, vec![]));
    let unknown = "00 03 88 01|01 02 88 01|00 01 00 FF|00 02 11 00|00 02 88 02|00 02 9F 5A|00 02 9E 73|00 02 \
         8B 04|00 02 A2 0D";
    let unknown = unknown.split('|').map(|begin| format!("{begin} 00 00 00 00"));
    for message in unknown.chain(["00 01 00 6B 00 00 58 B2", "00 01 00 78 00 00 00 0D"].map(str::to_owned)) {
        assert_eq!(bench.vendor(&message), (0x20, vec![]), "{message}");
    }
}

#[test]
fn registers_carry_values_and_commands() {
    let mut bench = Bench::new(|_| {});
    bench.vendor("00 02 9E 33 87 65 43 21");
    assert_eq!(bench.vendor("00 02 9F 33 00 00 00 00"), (0, hex("00 02 9F 33 87 65 43 21")));
    assert_eq!(bench.vendor("00 01 37 AE 00 00 00 05").1[2], 0x37, "RX has its register in the reply");
    assert_eq!(bench.vendor("00 02 9F 37 00 00 00 00").1[4..], [0, 0, 0, 5]);
    bench.vendor("00 02 9E 44 FF FF FF 38");
    assert_eq!(bench.sim.drive.parameters.get(b"DI"), -200);
    bench.vendor("00 01 00 A5 00 00 30 39");
    assert_eq!(bench.vendor("00 02 9F 6C 00 00 00 00").1[4..], 12_345_i32.to_be_bytes());
    bench.power_cycle();
    assert_eq!(bench.sim.drive.registers, [0; 10]);
}
