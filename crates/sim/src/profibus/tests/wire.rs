//! Several slaves on a wire, a second master, noise, and whatever bytes there are.

use super::*;
use crate::FaultPlan;

#[test]
fn each_of_several_slaves_answers_for_itself() {
    let segment = ProfibusSegment::new("x", 12_000_000, [7, 9, 125].map(LenzeSettings::new).into());
    let mut bench = Bench::of(&segment);
    let mut bits = [None; 3];
    let addresses = [7, 9, 125];
    for (bit, address) in bits.iter_mut().zip(addresses) {
        (bench.slave, bench.fcb) = (address, None);
        bench.up();
        *bit = bench.fcb;
    }
    for round in 0..50 {
        for (k, address) in addresses.into_iter().enumerate() {
            (bench.slave, bench.fcb) = (address, bits[k]);
            bench.words([0x06, 0x07, 0x0F, 0x7F][round.min(3)], 0x400 * (k as i16 + 1));
            bits[k] = bench.fcb;
        }
        bench.wait(8 * MS);
    }
    for k in 0..3 {
        let now = bench.now;
        let rpm = bench.sim(k).truth(now).velocity * 60.0;
        assert!((rpm - 93.75 * (k as f64 + 1.0)).abs() < 1.0, "{rpm}");
        assert_eq!((bench.sim(k).misuse(), bench.sim(k).broken()), (Misuse::default(), Broken::default()));
    }
}

#[test]
fn a_second_master_and_noise_are_received_by_all() {
    let mut segment = ProfibusSegment::new("x", 500_000, vec![LenzeSettings::new(SLAVE)]);
    let request = vec![0x10, SLAVE, 3, 0x49, 0x53, 0x16];
    segment.foreign = Some(ForeignSettings {
        telegrams: vec![vec![0xDC, 3, 3], request],
        count: Some(4),
        ..ForeignSettings::new(3)
    });
    let mut bench = Bench::of(&segment);
    // It begins at once; the fourth telegram is answered 30 ms later.
    let mut got = Vec::new();
    while let Some(reply) = bench.take(100 * MS) {
        got.push(reply.bytes);
    }
    let status = [0x10, 3, SLAVE, 0, 0x0A, 0x16];
    let asked = [&[0x10, SLAVE, 3, 0x49, 0x53, 0x16][..], &status].concat();
    assert_eq!(got, [vec![0xDC, 3, 3], asked.clone(), vec![0xDC, 3, 3], asked]);
    let noise = NoiseSettings { every_ns: 20 * MS, ..NoiseSettings::default() };
    let mut bench = Bench::of(&ProfibusSegment { noise: Some(noise), foreign: None, ..segment });
    bench.wait(1_000 * MS);
    let mut room = [0; 1_000];
    let now = bench.now;
    assert!(bench.medium.read(now, &mut room) > 50);
    let Broken { start, length, sum, end, extension, gap, unsynchronised } = bench.sim(0).broken();
    let all = start + length + sum + end + extension + gap + unsynchronised;
    assert!((10..=100).contains(&all), "{all}");
    assert_eq!(bench.sim(0).misuse(), Misuse::default());
}

#[test]
fn a_master_that_keeps_to_the_rules_claims_a_silent_wire_gives_way_and_answers_a_search() {
    let foreign = Some(ForeignSettings::listening(3));
    let segment = ProfibusSegment::new("x", 500_000, vec![LenzeSettings::new(SLAVE)]);
    let mut bench = Bench::of(&ProfibusSegment { foreign, ..segment });
    let (token, search) = (vec![0xDC, 3, 3], vec![0x10, 4, 3, 0x49, 0x50, 0x16]);
    // Twelve slot times of 116 bits.
    let time_out = bench.line.bits_ns(12 * 116);
    let claim = Reply { bytes: token.clone(), after: time_out };
    assert_eq!(bench.take(2 * time_out).as_ref(), Some(&claim));
    let mut next = || bench.take(MS).map(|reply| reply.bytes);
    assert_eq!(
        [next(), next(), next(), next()],
        [&token, &search, &token, &search].map(|one| Some(one.clone()))
    );
    // Another one has the token.
    for _ in 0..3 {
        bench.put(&[0xDC, 2, 2]);
        assert_eq!(bench.take(time_out / 10 * 9), None);
    }
    let answer = bench.ask(&[0x10, 3, 2, 0x49, 0x4E, 0x16]);
    assert_eq!(answer, Some(vec![0x10, 2, 3, 0x20, 0x25, 0x16]), "a master without a token");
    // Silence since that, of which the bench has waited for some.
    let again = bench.take(time_out).unwrap();
    assert_eq!((again.bytes, again.after + bench.line.bits_ns(33)), (claim.bytes, claim.after));
}

#[test]
fn what_is_due_before_the_first_moment_does_not_come_all_at_once() {
    let segment = ProfibusSegment::new("x", 500_000, vec![LenzeSettings::new(SLAVE)]);
    let foreign = ForeignSettings { after_ns: 35 * MS, ..ForeignSettings::new(3) };
    let noise = NoiseSettings { every_ns: 10 * MS, ..NoiseSettings::default() };
    let segment = ProfibusSegment { foreign: Some(foreign), noise: Some(noise), ..segment };
    let mut bench = Bench::since(Time(1_000 * START.0), &segment);
    let count = |bench: &Bench, place: usize| {
        let device: &dyn Any = &*bench.medium.wire.drives[place];
        let noise = device.downcast_ref::<Noise>().map(|noise| noise.bursts);
        noise.or(device.downcast_ref::<ForeignMaster>().map(|master| master.sent)).unwrap()
    };
    assert_eq!((count(&bench, 1), count(&bench, 2)), (0, 0));
    bench.wait(35 * MS - 1);
    assert_eq!(count(&bench, 1), 0);
    bench.wait(100 * MS);
    assert_eq!(count(&bench, 1), 10);
    assert!((5..30).contains(&count(&bench, 2)));
}

#[test]
fn a_wrong_identity_is_a_whole_answer_of_somebody_else() {
    let faults = FaultPlan { wrong_id: 1.0, ..FaultPlan::default() };
    let segment = ProfibusSegment::new("x", 500_000, vec![LenzeSettings::new(SLAVE)]);
    let mut bench = Bench::of(&ProfibusSegment { faults, ..segment });
    let request = bench.frame(Some((60, 62)), 0x6D, &[]);
    let answer = bench.ask(&request).unwrap();
    bench.slave = SLAVE ^ 0x40;
    assert_eq!(bench.open(&answer, Some((60, 62))), (8, vec![2, 5, 0, 255, 0, 0x82]));
}

#[test]
fn lost_bytes_of_either_side_are_damage_and_no_misuse() {
    let faults = FaultPlan { seed: 3, lost_byte: 0.3, ..FaultPlan::default() };
    let segment = ProfibusSegment::new("x", 500_000, vec![LenzeSettings::new(SLAVE)]);
    let mut bench = Bench::of(&ProfibusSegment { faults, ..segment });
    let request = bench.frame(Some((60, 62)), 0x6D, &[]);
    let whole = [2, 5, 0, 255, 0, 0x82];
    let answers = (0..200).filter_map(|_| bench.ask(&request));
    let (good, bad): (Vec<_>, Vec<_>) = answers.partition(|bytes| bytes.len() == 17);
    assert!(good.iter().all(|bytes| bytes[9..15] == whole));
    assert!((60..140).contains(&good.len()) && bad.len() > 20, "{} {}", good.len(), bad.len());
    let shortened = bench.medium.injected().shortened;
    assert_eq!(shortened as usize, 200 - good.len());
    assert_eq!(bench.sim(0).misuse(), Misuse::default());
}

/// Bytes of a real port come when the host delivers them.
#[test]
fn behind_a_real_port_silence_says_nothing() {
    let mut bench = Bench::with(|_| ());
    bench.medium.wire.drives[0].untimed();
    let request = [0x10, SLAVE, MASTER, 0x49, 0x52, 0x16];
    // In two parts, and directly behind a token.
    bench.put(&[0xDC, 2, 2, 0x10, SLAVE]);
    bench.wait(19 * MS);
    bench.put(&request[2..]);
    assert!(bench.take(MS).is_some());
    bench.put(&request[..2]);
    bench.wait(21 * MS);
    bench.put(&request[2..]);
    assert!(bench.take(MS).is_none());
    assert_eq!((bench.slave().misuse(), bench.slave().broken().gap), (Misuse::default(), 1));
}

#[test]
fn no_bytes_at_all_do_it_any_harm() {
    let mut random = fastrand::Rng::with_seed(22);
    for sd3 in [false, true] {
        let mut bench = Bench::with(|settings| {
            settings.link.sd3 = sd3;
            settings.channel = Channel::Pkw;
        });
        let saps = [60, 61, 62, 59, 58, 57, 56, 51, 50, 0, 63];
        for round in 0..4_000 {
            if round % 200 == 0 {
                (bench.fcb, bench.slave) = (None, SLAVE);
                bench.set_prm(&PRM);
                bench.chk_cfg(&[0xF3, 0xF1]);
                bench.wait(2 * MS);
                bench.control(0, 0);
            }
            let length = if random.bool() { 12 } else { random.usize(..20) };
            let data: Vec<u8> = (0..length).map(|_| random.u8(..)).collect();
            let sap = saps[random.usize(..saps.len())];
            let function = [0x5D, 0x7D, 0x6D, 0x46, random.u8(..)][random.usize(..5)];
            let from = if sap == 51 { 51 } else { 62 };
            let mut frame = match random.u8(..4) {
                0 => data.clone(),
                1 => bench.frame(None, function, &data),
                _ => bench.frame(Some((sap, from)), function, &data),
            };
            if random.u8(..4) == 0 && !frame.is_empty() {
                let at = random.usize(..frame.len());
                frame[at] ^= 1 << random.u8(..8);
            }
            if random.u8(..8) == 0 {
                frame.truncate(frame.len() / 2);
            }
            if !frame.is_empty() {
                bench.ask(&frame);
            }
        }
        let frame = [0x10, SLAVE, MASTER, 0x49, 0x52, 0x16];
        assert!(bench.ask(&frame).is_some());
        assert!(bench.slave().events().exchanges > 0 && bench.slave().misuse().total() > 0);
    }
}
