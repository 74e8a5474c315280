//! Time curves run: positions at several instants, scales, and their errors.

use super::store::curve;
use super::*;

/// Homed at 0, with curve 5: to 10 mm and on to 40 mm in one second.
fn bench() -> Bench {
    let mut bench = Bench::homed();
    assert_eq!(bench.add_curve(&curve(5, &[0, CM, 4 * CM])), DONE);
    bench
}

#[test]
fn a_curve_is_stretched_as_the_command_says() {
    const CM: i64 = 100_000;
    // Command, fields behind the id; start of the motor; demand at these instants.
    type Demands<'a> = &'a [(u64, i64)];
    let clauses: [(u16, &[i64], i64, Demands<'_>); 6] = [
        // Offset, twice the time, half the amplitude backwards; it begins where it says, not where the motor is.
        (0x044, &[0, 20_000, -500], 0, &[(500, -CM / 4), (1_000, -CM / 2), (2_000, -2 * CM)]),
        (0x044, &[CM, 5_000, 1_000], CM, &[(250, 2 * CM), (500, 5 * CM)]),
        // In a time of its own.
        (0x045, &[CM, 200_000, 1_000], CM, &[(1_000, 2 * CM), (2_000, 5 * CM)]),
        // From where the motor is; to a target from there; and that in a time.
        (0x041, &[], 3 * CM, &[(500, 4 * CM), (1_000, 7 * CM)]),
        (0x042, &[-5 * CM], 3 * CM, &[(500, CM), (1_000, -5 * CM)]),
        (0x043, &[-5 * CM, 200_000], 3 * CM, &[(1_000, CM), (2_000, -5 * CM), (3_000, -5 * CM)]),
    ];
    for (id, fields, start, demands) in clauses {
        let mut bench = bench();
        bench.ends_at(go_to(start as i32, VAD));
        bench.runs_through(motion(id, &[&[5], fields].concat()), demands);
    }
}

impl Bench {
    /// The demand so many ms behind the command.
    fn runs_through(&mut self, command: Motion, demands: &[(u64, i64)]) {
        self.command(command);
        let from = self.now;
        for (ms, demand) in demands {
            self.now = from + (ms - 1) * MS;
            let report = self.exchange(None);
            assert_eq!(
                (report.error, i64::from(report.demand)),
                (errors::NONE, *demand),
                "{command:?} at {ms} ms"
            );
        }
    }
}

#[test]
fn a_stopped_curve_does_not_go_on_and_an_armed_one_does_not_begin() {
    let mut bench = bench();
    for stop in [control::NO_FREEZE, control::NO_ABORT] {
        bench.command_for(motion(0x041, &[5]), 300 * MS);
        bench.state(control::ON & !stop);
        let stood = bench.until_standing();
        bench.control = control::ON;
        bench.wait(S);
        let report = bench.exchange(None);
        assert_eq!((report.demand, report.error), (stood.demand, errors::NONE));
    }
    // Nor one that another motion takes over from; and a move after it waits for its end.
    bench.command_for(motion(0x041, &[5]), 300 * MS);
    bench.command(go_to(0, VAD));
    assert_eq!(bench.until_standing().demand, 0);
    bench.command(motion(0x040, &[5]));
    assert!(bench.command(move_by(0x018, 0, VAD)).has(status::EVENT_HANDLER));
    bench.wait(998 * MS);
    assert_eq!(bench.exchange(None).demand, 4 * CM);
    assert_eq!(bench.until_standing().demand, 0);
    // One for the trigger stays armed.
    let armed = bench.command(motion(0x04A, &[5, CM.into()]));
    assert!(armed.has(status::EVENT_HANDLER) && !armed.has(status::MOTION_ACTIVE));
    bench.wait(10 * S);
    let cleared = bench.command(motion(0x008, &[]));
    assert_eq!((cleared.demand, cleared.has(status::EVENT_HANDLER)), (0, false));
}

#[test]
fn a_curve_is_modified_in_ram_by_motion_commands() {
    let mut bench = bench();
    // The last setpoint, then the length: 20 mm in half a second. While it runs, as it was.
    bench.command(motion(0x040, &[5]));
    bench.command(motion(0x054, &[5, 8, (2 * CM).into()]));
    bench.command(motion(0x052, &[5, 32, 50_000]));
    assert_eq!(bench.until_standing().demand, 4 * CM);
    bench.ends_at(go_to(0, VAD));
    bench.runs_through(motion(0x040, &[5]), &[(250, CM.into()), (500, (2 * CM).into())]);
}
