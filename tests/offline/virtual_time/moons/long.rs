//! An hour of packets by two clocks.

use fieldbeat::time::{S, US};
use fieldbeat_sim::ethernet_ip::ClockSettings;

use super::*;

/// Whatever a clock drifts and shakes: no miss, no burst, no drift of what the loop sends.
fn hold(seconds: u64) {
    let clock = |index: u64| ClockSettings {
        drift_ppm: [100, -100, 0, 37][index as usize % 4],
        jitter_ns: 300 * US,
        seed: index,
    };
    let drives: Vec<_> = (0..4)
        .map(|index| {
            let mut drive = drive(index);
            (drive.axis.divisor, drive.axis.phase) = (4, index as u32);
            drive
        })
        .collect();
    let taps: Vec<_> = (0..)
        .zip(&drives)
        .map(|(index, drive)| tap(MoonsSettings { clock: clock(index), ..MoonsSettings::of(drive) }))
        .collect();
    let mut m = Moons::of(drives, taps, Originator::at(BIND), WorldOptions::default());
    m.online();
    m.run(100);
    let cycles = seconds * S / MS;
    let sent = |m: &Moons| m.taps.iter().map(|tap| tap.lock().sent).collect::<Vec<_>>();
    for tap in &m.taps {
        tap.lock().came.clear();
    }
    let before = sent(&m);
    for done in (0..cycles).step_by(10_000) {
        m.run(10_000.min(cycles - done));
        for index in 0..4 {
            let tap = &m.taps[index];
            let came = std::mem::take(&mut tap.lock().came);
            // One in each own slot: none is missing, no two are nearer.
            let slots: Vec<u64> = came.iter().map(|came| m.slot(came.at)).collect();
            assert!(slots.windows(2).all(|pair| pair[1] - pair[0] == 4), "drive {index}");
            assert_eq!(slots.first().map(|slot| slot % 4), Some(index as u64));
        }
    }
    for (index, (now, before)) in sent(&m).into_iter().zip(before).enumerate() {
        let should = cycles / 4;
        let off = (now - before).abs_diff(should);
        assert!(off <= 2 + should / 5_000, "drive {index}: {} packets instead of {should}", now - before);
    }
    let end = m.sim.finish();
    for drive in &end.drives {
        let c = drive.counters;
        assert!(drive.losses == 0 && c.missed <= 4, "{c:?}");
        assert_eq!((c.late, c.duplicate, c.malformed, c.foreign), (0, 0, 0, 0), "{c:?}");
    }
    assert_eq!((end.status.skipped, end.status.planned), (0, end.status.executed));
}

#[test]
fn two_minutes_of_two_clocks_pass_without_a_miss_a_burst_or_a_drift() {
    hold(120);
}

#[test]
#[ignore = "an hour of virtual time: in a release build"]
fn an_hour_of_two_clocks_passes_without_a_miss_a_burst_or_a_drift() {
    hold(3_600);
}
