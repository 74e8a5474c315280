//! The parameter channel: the sheet's jobs, their handshake, their errors.

use super::*;

/// In Data_Exchange with such a channel.
fn bench(channel: Channel) -> Bench {
    Bench::online(|settings| (settings.channel, settings.job_ns) = (channel, 20 * MS))
}

fn job(bench: &mut Bench, job: [u8; 8]) -> [u8; 8] {
    bench.cycle(job, 0, 0).0
}

/// The answer to a job, which takes its time; the one in between.
fn done(bench: &mut Bench, bytes: [u8; 8]) -> ([u8; 8], [u8; 8]) {
    let before = job(bench, bytes);
    assert_eq!(job(bench, bytes), before, "not yet");
    bench.wait(20 * MS);
    (before, job(bench, bytes))
}

/// The answer to a PKW job, with job 0 before.
fn pkw(bench: &mut Bench, bytes: [u8; 8]) -> [u8; 8] {
    assert_eq!(job(bench, [0; 8]), [0; 8]);
    let (before, answer) = done(bench, bytes);
    assert_eq!(before, [0; 8]);
    answer
}

#[test]
fn pkw_jobs_are_answered_as_in_the_sheet() {
    let mut bench = bench(Channel::Pkw);
    let vectors = [
        ([0x10, 0x3D, 0, 0, 0, 0, 0, 0], [0x20, 0x3D, 0, 0, 0, 0x06, 0x8F, 0xB0]),
        ([0x17, 0xCF, 0, 0, 0, 0, 0, 0], [0x77, 0xCF, 0, 0, 0, 0, 0, 0]),
        ([0x30, 0x27, 0, 0, 0, 0x16, 0xF3, 0], [0x20, 0x27, 0, 0, 0, 0x16, 0xF3, 0]),
        // C0039/2: an array of double words; then its element as one.
        ([0x80, 0x27, 2, 0, 0, 0, 0x27, 0x10], [0x50, 0x27, 2, 0, 0, 0, 0x27, 0x10]),
        ([0x60, 0x27, 2, 0, 0, 0, 0, 0], [0x50, 0x27, 2, 0, 0, 0, 0x27, 0x10]),
        ([0x60, 0x27, 1, 0, 0, 0, 0, 0], [0x50, 0x27, 1, 0, 0, 0x16, 0xF3, 0]),
        // A word is in the last two bytes: C0093, 2133.
        ([0x10, 0x5D, 0, 0, 0, 0, 0, 0], [0x10, 0x5D, 0, 0, 0, 0, 0x08, 0x55]),
    ];
    for (request, answer) in vectors {
        assert_eq!(pkw(&mut bench, request), answer, "{request:02X?}");
    }
    let error = |bench: &mut Bench, request: [u8; 8]| {
        let [id, _, _, _, rest @ ..] = pkw(bench, request);
        assert_eq!(id >> 4, 7);
        i32::from_be_bytes(rest)
    };
    assert_eq!(error(&mut bench, [0x30, 0x3D, 0, 0, 0, 0, 0, 1]), 1, "read-only");
    assert_eq!(error(&mut bench, [0x30, 0x03, 0, 0, 0, 0, 0xFF, 0xFF]), 2, "limit");
    assert_eq!(error(&mut bench, [0x60, 0x27, 4, 0, 0, 0, 0, 0]), 3, "subcode");
    assert_eq!(error(&mut bench, [0x10, 0x27, 1, 0, 0, 0, 0, 0]), 3, "no array job");
    assert_eq!(error(&mut bench, [0x60, 0x3D, 0, 0, 0, 0, 0, 0]), 4, "no array");
    assert_eq!(error(&mut bench, [0x20, 0x27, 0, 0, 0, 0, 0, 1]), 5, "a word for a double word");
    assert_eq!(bench.slave().misuse(), Misuse::default());
    assert_eq!(error(&mut bench, [0x40, 0x27, 0, 0, 0, 0, 0, 1]), 0x17);
    assert_eq!(bench.slave().misuse(), Misuse { job: 1, ..Misuse::default() });
}

#[test]
fn a_pkw_answer_stays_and_is_refreshed_until_the_job_changes() {
    let mut bench = bench(Channel::Pkw);
    let read = [0x10, 0x33, 0, 0, 0, 0, 0, 0];
    assert_eq!(pkw(&mut bench, read), [0x20, 0x33, 0, 0, 0, 0, 0, 0]);
    bench.enable();
    for _ in 0..60 {
        bench.cycle(read, 0x7F, 0x4000);
        bench.wait(10 * MS);
    }
    let (answer, _) = bench.cycle(read, 0x7F, 0x4000);
    let rpm = i32::from_be_bytes([answer[4], answer[5], answer[6], answer[7]]);
    assert!((rpm - 1_500 * 10_000).abs() < 10_000, "{rpm}");
    // A write is done once.
    let before = bench.slave().eeprom_writes();
    let write = [0x30, 0x27, 0, 0, 0, 0, 0, 5];
    pkw(&mut bench, write);
    for _ in 0..5 {
        assert_eq!(job(&mut bench, write)[0], 0x20);
    }
    assert_eq!(bench.slave().eeprom_writes(), before + 1);
    // The same job again is none, without job 0 before.
    job(&mut bench, write);
    assert_eq!(bench.slave().eeprom_writes(), before + 1);
    assert_eq!(bench.slave().misuse(), Misuse::default());
    // Another job while one is under way.
    job(&mut bench, [0x10, 0x0B, 0, 0, 0, 0, 0, 0]);
    job(&mut bench, [0x10, 0x0C, 0, 0, 0, 0, 0, 0]);
    assert_eq!(bench.slave().misuse(), Misuse { job: 1, ..Misuse::default() });
}

#[test]
fn drivecom_jobs_are_answered_as_in_the_sheet_in_both_styles() {
    let vectors = [
        ([0x31, 0, 0x5F, 0xC2, 0, 0, 0, 0], 0x31, Some([0, 0x06, 0x8F, 0xB0])),
        ([0x41, 0, 0x5F, 0xC2, 0, 0, 0, 0], 0x71, Some([0, 0x06, 0x8F, 0xB0])),
        ([0x32, 0, 0x5F, 0xD8, 0, 0x16, 0xF3, 0], 0x30, None),
        ([0x72, 0, 0x5F, 0xD8, 0, 0x16, 0xF3, 0], 0x70, None),
        // C0093 has 2 bytes, on the left.
        ([0x01, 0, 0x5F, 0xA2, 0, 0, 0, 0], 0x11, Some([0x08, 0x55, 0, 0])),
        ([0x71, 0, 0x58, 0x30, 0, 0, 0, 0], 0xF1, Some([0x06, 0x07, 0, 0])),
        ([0x32, 0, 0x5F, 0xC2, 0, 0, 0, 1], 0xB2, Some([0x06, 0x03, 0, 0])),
        ([0x71, 4, 0x5F, 0xD8, 0, 0, 0, 0], 0xF1, Some([0x06, 0x05, 0, 0x11])),
        ([0x12, 0, 0x5F, 0xD8, 0, 1, 0, 0], 0x92, Some([0x06, 0x05, 0, 0x13])),
        ([0x72, 0, 0x5F, 0xFC, 0, 0, 0xFF, 0xFF], 0xF2, Some([0x08, 0, 0, 0x31])),
        ([0x32, 0, 0x5F, 0xFC, 0xFF, 0, 0, 0], 0xB2, Some([0x08, 0, 0, 0x32])),
        ([0x77, 0, 0x5F, 0xC2, 0, 0, 0, 0], 0xF7, Some([0x06, 0x05, 0, 0x10])),
    ];
    for channel in [Channel::Drivecom, Channel::DrivecomBare] {
        let mut bench = bench(channel);
        for (request, first, data) in vectors {
            let (_, answer) = done(&mut bench, request);
            let first = if channel == Channel::Drivecom { first } else { first & 0xC0 };
            assert_eq!(answer[..4], [first, request[1], request[2], request[3]], "{request:02X?}");
            if let Some(data) = data {
                assert_eq!(answer[4..], data, "{request:02X?}");
            }
        }
        assert_eq!((bench.slave().eeprom_writes(), bench.slave().misuse()), (2, Misuse::default()));
    }
}

#[test]
fn a_drivecom_job_needs_its_handshake_bit() {
    let mut bench = bench(Channel::Drivecom);
    let read = [0x01, 0, 0x5F, 0xC2, 0, 0, 0, 0];
    let (before, answer) = done(&mut bench, read);
    assert_eq!((before, answer[0]), ([0; 8], 0x31));
    let other = [0x01, 0, 0x5F, 0xA2, 0, 0, 0, 0];
    assert_eq!((job(&mut bench, other), bench.slave().misuse().handshake), (answer, 1));
    bench.wait(20 * MS);
    assert_eq!(job(&mut bench, other), answer, "ignored");
    let mut toggled = other;
    toggled[0] ^= 0x40;
    assert_eq!(done(&mut bench, toggled), (answer, [0x51, 0, 0x5F, 0xA2, 0x08, 0x55, 0, 0]));
    // No service: what comes next acts with either bit.
    assert_eq!(job(&mut bench, [0x40, 0, 0, 0, 0, 0, 0, 0]), [0x40, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(done(&mut bench, toggled).1[0], 0x51);
}

#[test]
fn what_is_not_saved_is_lost_with_the_power() {
    let mut bench = bench(Channel::Drivecom);
    // C0003 = 0: no saving; C0039 = 2; C0012 = 3 s with saving.
    done(&mut bench, [0x32, 0, 0x5F, 0xF3, 0, 0, 0x75, 0x30]);
    done(&mut bench, [0x72, 0, 0x5F, 0xFC, 0, 0, 0, 0]);
    done(&mut bench, [0x32, 0, 0x5F, 0xD8, 0, 0, 0x4E, 0x20]);
    assert_eq!(bench.slave().eeprom_writes(), 1);
    assert_eq!(done(&mut bench, [0x71, 0, 0x5F, 0xD8, 0, 0, 0, 0]).1[4..], [0, 0, 0x4E, 0x20]);
    bench.medium.restart(bench.now, 0);
    bench.wait(500 * MS);
    bench.fcb = None;
    bench.up();
    assert_eq!(done(&mut bench, [0x31, 0, 0x5F, 0xD8, 0, 0, 0, 0]).1[4..], [0; 4]);
    assert_eq!(done(&mut bench, [0x71, 0, 0x5F, 0xF3, 0, 0, 0, 0]).1[4..], [0, 0, 0x75, 0x30]);
    assert_eq!(done(&mut bench, [0x31, 0, 0x5F, 0xFC, 0, 0, 0, 0]).1[4..], [0, 0, 0x27, 0x10]);
}
