//! Drives with their own clock, whose stop may wait for an idle packet: in all phases of a held command.

use fieldbeat::bus::ethernet_ip::{MoonsDrive, command};

use crate::virtual_time::moons::{Moons, drive, jog};

const STOPS: u32 = command::STOP | command::STOP_FAST | command::DISABLE;

/// Drives of a stop group: the first one is lost, the second one has to stop with it.
fn drives(divisors: [u32; 2], phase: u32, bucket: u32) -> Vec<MoonsDrive> {
    let with = |(index, divisor): (usize, u32)| {
        let mut drive = drive(index);
        drive.axis.health.bucket = bucket;
        (drive.axis.divisor, drive.axis.phase) = (divisor, (index as u32 + phase) % divisor);
        drive.axis.stop.group = Some(1);
        drive
    };
    divisors.into_iter().enumerate().map(with).collect()
}

/// Silence so many cycles after another speed was given to both: the cycles from the last packet of the first one to
/// the stop of each.
fn stopped(divisors: [u32; 2], phase: u32, bucket: u32, after: u64) -> ([u64; 2], u64) {
    let mut m = Moons::new(drives(divisors, phase, bucket));
    m.ready();
    for index in 0..2 {
        m.post(index, jog(1.0));
    }
    m.run(200);
    for index in 0..2 {
        m.post(index, jog(2.0));
    }
    m.run(after);
    m.mute(0, true);
    let before = [0, 1].map(|index| m.count(index));
    let bound = m.bound(0);
    let mut last = m.feedback(0).cycle - u64::from(m.feedback(0).age);
    for _ in 0..bound + 40 {
        m.run(1);
        let feedback = m.feedback(0);
        if feedback.age == 0 {
            last = feedback.cycle;
        }
    }
    let stops = [0, 1].map(|index| {
        let came = m.came(index, before[index]);
        let stop = came.iter().find(|came| came.word & STOPS != 0);
        let stop = stop.unwrap_or_else(|| panic!("drive {index} of {divisors:?} got no stop"));
        m.slot(stop.at) - last
    });
    (stops, bound)
}

#[test]
fn a_stop_leaves_within_its_bound_in_every_phase_of_a_held_command() {
    for (divisors, bucket) in [([1, 1], 1), ([1, 4], 5), ([2, 1], 3), ([4, 2], 2), ([5, 4], 1)] {
        let mut longest = 0;
        let mut stated = 0;
        // A command, and idle behind it, take four packets; and each phase of the schedule.
        let most = divisors[0].max(divisors[1]);
        let phases = (0..=8 * u64::from(most)).flat_map(|after| (0..most).map(move |phase| (after, phase)));
        for (after, phase) in phases {
            let (stops, bound) = stopped(divisors, phase, bucket, after);
            for (index, cycles) in stops.into_iter().enumerate() {
                assert!(
                    cycles <= bound,
                    "{divisors:?}, bucket {bucket}, {after} cycles after the command: drive {index} got its stop \
                     after {cycles} cycles, not {bound}"
                );
                longest = longest.max(cycles);
            }
            stated = bound;
        }
        // A stop one cycle later would break it.
        assert_eq!(longest, stated, "{divisors:?}, bucket {bucket}: no stop came as late as its bound");
    }
}
