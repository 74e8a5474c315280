//! A second master, noise, and whatever bytes there are.

use super::*;
use crate::FaultPlan;

/// One slave on a wire with something else.
fn on(change: impl FnOnce(&mut ProfibusSegment)) -> Bench {
    let mut segment = ProfibusSegment::new("x", 500_000, vec![LenzeSettings::new(SLAVE)]);
    change(&mut segment);
    Bench::of(&segment)
}

#[test]
fn a_second_master_and_noise_are_received_by_all() {
    let (token, request) = (vec![0xDC, 3, 3], vec![0x10, SLAVE, 3, 0x49, 0x53, 0x16]);
    let telegrams = vec![token.clone(), request.clone()];
    let foreign = ForeignSettings { telegrams, count: Some(4), ..ForeignSettings::new(3) };
    let mut bench = on(|segment| segment.foreign = Some(foreign));
    // It begins at once; the fourth telegram is answered 30 ms later.
    let mut got = Vec::new();
    while let Some(reply) = bench.take(100 * MS) {
        got.push(reply.bytes);
    }
    let asked = [&request[..], &[0x10, 3, SLAVE, 0, 0x0A, 0x16]].concat();
    assert_eq!(got, [token.clone(), asked.clone(), token, asked]);
    let noise = NoiseSettings { every_ns: 20 * MS, ..NoiseSettings::default() };
    let mut bench = on(|segment| segment.noise = Some(noise));
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
    let mut bench = on(|segment| segment.foreign = Some(ForeignSettings::listening(3)));
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
    let foreign = ForeignSettings { after_ns: 35 * MS, ..ForeignSettings::new(3) };
    let noise = NoiseSettings { every_ns: 10 * MS, ..NoiseSettings::default() };
    let segment = ProfibusSegment::new("x", 500_000, vec![LenzeSettings::new(SLAVE)]);
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
    let mut bench = on(|segment| segment.faults = FaultPlan { wrong_id: 1.0, ..FaultPlan::default() });
    let request = bench.frame(Some((60, 62)), 0x6D, &[]);
    let answer = bench.ask(&request).unwrap();
    bench.slave = SLAVE ^ 0x40;
    assert_eq!(bench.open(&answer, Some((60, 62))), (8, vec![2, 5, 0, 255, 0, 0x82]));
}

/// Bytes of a real port come when the host delivers them.
#[test]
fn behind_a_real_port_silence_says_nothing() {
    let mut bench = Bench::with(|_| ());
    bench.medium.wire.drives[0].untimed();
    let request = [0x10, SLAVE, MASTER, 0x49, 0x52, 0x16];
    // In two parts, directly behind a token at first.
    for (before, wait, answered) in [(&[0xDC, 2, 2][..], 19 * MS, true), (&[], 21 * MS, false)] {
        bench.put(&[before, &request[..2]].concat());
        bench.wait(wait);
        bench.put(&request[2..]);
        assert_eq!(bench.take(MS).is_some(), answered);
    }
    assert_eq!((bench.slave().misuse(), bench.slave().broken().gap), (Misuse::default(), 1));
}

#[test]
fn no_bytes_at_all_do_it_any_harm() {
    let mut random = fastrand::Rng::with_seed(22);
    for sd3 in [false, true] {
        let mut bench = Bench::with(|settings| (settings.link.sd3, settings.channel) = (sd3, Channel::Pkw));
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
            let sap = random.choice([60, 61, 62, 59, 58, 57, 56, 51, 50, 0, 63]).unwrap();
            let any = random.u8(..);
            let function = random.choice([0x5D, 0x7D, 0x6D, 0x46, any]).unwrap();
            let mut frame = match random.u8(..4) {
                0 => data,
                1 => bench.frame(None, function, &data),
                _ => bench.frame(Some((sap, if sap == 51 { 51 } else { 62 })), function, &data),
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
        assert!(bench.ask(&[0x10, SLAVE, MASTER, 0x49, 0x52, 0x16]).is_some());
        assert!(bench.slave().events().exchanges > 0 && bench.slave().misuse().total() > 0);
    }
}
