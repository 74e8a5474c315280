//! What a drive says, in user units: only what it said, only when it said it.

use fieldbeat::axis::{Command, DriveStatus, Units};
use fieldbeat_core::bus::Slot;

use crate::conformance::line::Line;
use crate::conformance::rules::{matches_report, near};
use crate::conformance::subject::{Drive, Subject, not_applicable};

/// The drive's own units, another scale, another zero, another direction.
fn various(index: usize, drive: &mut Drive) {
    let units = drive.axis.units;
    drive.axis.units = [
        units,
        Units { counts_per_unit: -units.counts_per_unit, ..units },
        Units { offset: 7.0 * drive.start, ..units },
        Units { counts_per_unit: -units.counts_per_unit, offset: -3.0 * drive.start, ..units },
    ][index];
}

/// The same of a drive that has no place.
fn various_speeds(index: usize, drive: &mut Drive) {
    drive.axis.units.counts_per_unit *= [1.0, -1.0, 2.0, -0.5][index];
}

fn varied(subject: &'static dyn Subject) -> Line {
    Line::with(subject, 4, if subject.can().positions { various } else { various_speeds })
}

fn assert_as_said(line: &Line, index: usize) {
    let (report, said) = (&line.slots[index].status, line.said(index));
    let units = line.drives[index].axis.units;
    assert!(matches_report(report, said, &units), "drive {index}: {report:?}, {said:?}");
    assert_eq!(report.moving, said.moving, "drive {index}: {:?}", report.state);
    assert!(said.homed.is_none_or(|homed| homed == report.homed), "drive {index}: {:?}", report.state);
    // Where the power comes and goes with the motion, what is enabled may have none, but nothing has it unseen.
    let powered = report.state.is_powered();
    assert!(powered == said.powered || powered && !line.can.positions, "drive {index}: {:?}", report.state);
}

pub fn a_report_is_what_the_drive_said_in_user_units(subject: &'static dyn Subject) {
    let mut line = varied(subject);
    let at_power_on = line.drives.iter().map(|drive| drive.start).collect::<Vec<_>>();
    line.online();
    for (index, start) in at_power_on.into_iter().enumerate() {
        if line.said(index).position.is_none() {
            assert!(!line.can.positions && line.slots[index].status.position.is_nan(), "it has none");
            continue;
        }
        let units = line.drives[index].axis.units;
        let counts = (start * units.counts_per_unit).round() as i64;
        assert!(near(line.slots[index].status.position, units.position(counts)), "drive {index}");
    }
    // All the way up, through a move, and down again.
    let motion = if line.can.positions { line.by(0, 0.2) } else { line.go(0) };
    for command in
        [Command::Enable, Command::Home, motion, Command::Stop { deceleration: None }, Command::Disable]
    {
        if command == Command::Home && !line.can.home {
            continue;
        }
        for index in 0..4 {
            line.order(index, command);
        }
        let begin = line.index;
        line.until("the end of all", 5_000, |line| {
            for index in (0..4).filter(|index| line.seen[*index].fresh) {
                assert_as_said(line, index);
            }
            let goes_on = matches!(command, Command::Jog(_)) && line.index - begin > 500;
            goes_on || (0..4).all(|index| line.end(index) == Some(Ok(())))
        });
    }
}

pub fn velocity_is_the_way_made_in_user_units_a_second(subject: &'static dyn Subject) {
    let mut line = varied(subject);
    line.ready();
    for seconds in [0.5, -0.5] {
        for index in 0..4 {
            let jog = line.jog(index, f64::signum(seconds));
            let command = if line.can.positions { line.by(index, seconds) } else { jog };
            line.order(index, command);
        }
        line.turns(300);
        for index in 0..4 {
            let (report, cruise) = (line.slots[index].status, line.profile(index).velocity);
            let off = (report.velocity - cruise * seconds.signum()).abs();
            let in_target = report.in_target && line.can.positions;
            assert!(off < cruise * 0.02 && !in_target, "drive {index}: {report:?}, profile {cruise}");
        }
        for index in 0..4 {
            if !line.can.positions {
                line.order(index, Command::Stop { deceleration: None });
            }
            assert_eq!(line.ended(index), Ok(()));
        }
        line.turns(100);
        for index in 0..4 {
            let (report, cruise) = (line.slots[index].status, line.profile(index).velocity);
            assert!(report.velocity.abs() < cruise * 0.01 && report.in_target, "standing: {report:?}");
        }
    }
}

/// Bit for bit: no number is no number.
fn same(a: &DriveStatus, b: &DriveStatus) -> bool {
    format!("{a:?}") == format!("{b:?}")
}

pub fn each_answer_is_fresh_once_and_silence_is_not(subject: &'static dyn Subject) {
    let mut line = Line::made_ready(subject, 1);
    let mut before = line.slots[0].status;
    let opened = line.wire.log().drives[0].opened;
    let (mut unfinished, mut answered) = (0, 0);
    for turn in 0..if line.can.stream { 2_000 } else { 200 } {
        line.mute(0, if line.can.stream { turn % 400 > 390 } else { turn % 7 > 4 });
        line.turn();
        let seen = line.seen[0];
        answered += u64::from(seen.answered());
        unfinished += u64::from(seen.answered() && !seen.fresh);
        assert!(seen.answered() || !seen.fresh, "{seen:?}");
        let report = line.slots[0].status;
        assert_eq!(report.at > before.at, seen.fresh, "{report:?}");
        assert!(seen.fresh || same(&report, &before), "held as it was");
        before = report;
    }
    // A part is not all of it; else the first answer on a connection may be one.
    assert!(line.can.whole || (answered - unfinished) * 4 > answered, "{unfinished} of {answered}");
    let opened = line.wire.log().drives[0].opened - opened;
    let parts = !line.can.whole || line.can.own_clock;
    assert!((unfinished <= opened || parts) && (!line.can.stream || opened > 2), "{unfinished} of {opened}");
}

pub fn a_restart_is_noticed_once_and_what_was_known_is_forgotten(subject: &'static dyn Subject) {
    let mut line = Line::made_ready(subject, 2);
    line.order(0, line.go(0));
    line.turns(300);
    let cruise = line.profile(0).velocity;
    for silent in [0, 20] {
        line.restart(0);
        // Reported at once, or in the middle of its start.
        line.mute(0, true);
        line.turns(silent);
        line.mute(0, false);
        let mut noticed = 0;
        for _ in 0..if line.can.stream || line.can.shared || line.can.sessions { 4_000 } else { 1_000 } {
            line.turn();
            noticed += u32::from(line.seen[0].restarted);
            assert!(!line.seen[1].restarted, "its neighbour");
            if line.seen[0].fresh {
                assert_as_said(&line, 0);
                let velocity = line.slots[0].status.velocity;
                assert!(
                    noticed == 0 && !line.can.sessions
                        || !line.can.positions
                        || velocity.abs() < cruise * 1.05,
                    "a jump of the position is no velocity: {velocity}"
                );
            }
        }
        // On a connection that was opened again nothing says why the one before has ended.
        assert_eq!(noticed, u32::from(!line.can.sessions), "silent for {silent} cycles");
        let Slot { status: report, .. } = &line.slots[0];
        assert!(!report.state.is_powered() && !report.moving, "{report:?}");
    }
    // It can be brought up as ever; that its positions begin anew with a homing is no velocity either.
    line.done(0, Command::Enable);
    if line.can.home {
        line.order(0, Command::Home);
        line.until("the end of a homing", 20_000, |line| {
            let velocity = line.slots[0].status.velocity;
            assert!(velocity.abs() < cruise * 2.0, "{velocity} while homing");
            line.end(0) == Some(Ok(()))
        });
    }
    line.move_about(0);
}

pub fn homed_is_what_the_drive_says_after_a_restart_too(subject: &'static dyn Subject) {
    let mut line = Line::made_ready(subject, 1);
    if !line.can.home {
        return not_applicable(subject, "homed after a restart", "its drives are referenced by nature");
    }
    assert!(line.slots[0].status.homed);
    line.plug(0, false);
    line.turns(100);
    line.restart(0);
    line.turns(500);
    line.plug(0, true);
    line.online();
    assert!(!line.slots[0].status.homed);
}
