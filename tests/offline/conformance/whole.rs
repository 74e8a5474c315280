//! The bus under the whole loop: link health, the stop sequence, and what the loop may count on.

use std::time::Duration;

use fieldbeat::axis::{
    Abort, Command, Failure, FoundRunning, Health, Link, NativeOwner, Outcome, State, StopCause, StopHow,
    StopThen,
};
use fieldbeat::sim::{FaultPlan, WorldOptions};
use fieldbeat::time::{MS, Time, US};

use crate::conformance::line::PERIOD;
use crate::conformance::machine::Machine;
use crate::conformance::subject::{Can, Subject, not_applicable};
use crate::conformance::wire::Delivery;

pub fn good_exchanges_in_a_row_bring_the_link_up(subject: &'static dyn Subject) {
    let gate = 6;
    let mut m = Machine::new(subject, 1, |_, drive| drive.axis.health = Health { gate, ..Health::default() });
    if m.can.shared {
        return answers_in_a_row(m, u64::from(gate));
    }
    if m.can.own_clock {
        return not_applicable(subject, "an answer for each good exchange", "a packet counts for several");
    }
    let answered = |m: &Machine| m.tape(0, |tape| tape.taken);
    // All but one, then a miss: they have to begin again.
    m.until("almost up", 1_000, |m| answered(m) == u64::from(gate) - 1);
    assert_eq!(m.feedback(0).link, Link::Qualifying);
    m.mute(0, true);
    m.until("not up after all", 10, |m| m.feedback(0).link == Link::Unseen);
    m.mute(0, false);
    let before = answered(&m);
    m.until("up", 1_000, |m| m.feedback(0).link == Link::Online);
    assert_eq!(answered(&m) - before, u64::from(gate));
}

/// The same where frames come back in each cycle, of whatever they are the answers.
fn answers_in_a_row(mut m: Machine, gate: u64) {
    let first = |m: &mut Machine| {
        m.until("the first answer", 8_000, |m| m.feedback(0).link == Link::Qualifying);
    };
    first(&mut m);
    m.run(gate - 2);
    assert_eq!(m.feedback(0).link, Link::Qualifying);
    m.mute(0, true);
    m.until("not up after all", 10, |m| m.feedback(0).link == Link::Unseen);
    m.mute(0, false);
    first(&mut m);
    m.run(gate - 2);
    assert_eq!(m.feedback(0).link, Link::Qualifying);
    m.run(1);
    assert_eq!(m.feedback(0).link, Link::Online);
}

pub fn unseen_and_lost_drives_are_probed_once_per_interval(subject: &'static dyn Subject) {
    let interval = 40;
    let health = Health { probe_interval: Duration::from_millis(interval), ..Health::default() };
    let mut m = Machine::new(subject, 3, |_, drive| drive.axis.health = health);
    if m.can.own_clock {
        return not_applicable(subject, "probes", "requests go at the agreed rate, whatever the link");
    }
    let shared = m.can.shared;
    m.plug(0, false);
    m.mute(1, true);
    m.until("the third online", if shared { 8_000 } else { 100 }, |m| m.feedback(2).link == Link::Online);
    m.run(1_000);
    assert_eq!((m.feedback(1).link, m.received(0)), (Link::Unseen, 0));
    let rarely = |m: &Machine, from: usize| {
        let requested = m.asked_in(1, from);
        assert!(requested.windows(2).all(|pair| pair[1] - pair[0] >= interval), "{requested:?}");
        requested.len()
    };
    // A drive without a connection gets no requests.
    let requested = if m.can.stream || m.can.bytes { 0..=0 } else { 24..=26 };
    assert!(shared || requested.contains(&rarely(&m, 0)));
    m.mute(1, false);
    m.until("it online", 10_000, |m| m.feedback(1).link == Link::Online);
    m.mute(1, true);
    m.until("it lost", 100, |m| m.feedback(1).link == Link::Lost);
    m.run(2);
    let received = m.received(1);
    m.run(1_000);
    // What has been in operation is sent its exchanges.
    let requested = if m.can.bytes { 24..=26 } else { requested };
    // On a line the frames pass all the same; the exchanges are counted below.
    assert!(shared || requested.contains(&rarely(&m, received)));
    // Who answers lost nothing by it.
    let end = m.sim.finish();
    let living = end.drives[2].counters;
    let least = 1_800 / u64::from(1 + subject.can().answers_after);
    assert!(living.missed == 0 && living.sent > least, "{living:?}");
    for drive in &end.drives[..2] {
        let c = drive.counters;
        assert!(
            c.sent + c.unsent < 150 + u64::from(shared) * 200 && c.sent - c.answered - c.missed <= 1,
            "{c:?}"
        );
    }
}

pub fn the_stop_request_is_on_the_wire_within_its_bound(subject: &'static dyn Subject) {
    for (divisor, phase, bucket, how) in [
        (1, 0, 5, StopHow::Ramp),
        (1, 0, 1, StopHow::Quick),
        (3, 2, 3, StopHow::Ramp),
        (4, 1, 2, StopHow::Quick),
    ] {
        let every = divisor * (1 + subject.can().answers_after);
        // On a line no drive is silent alone and receives.
        // More than a half-duplex wire takes in one window.
        let count = match subject.can() {
            Can { shared: true, .. } => 1,
            Can { half_duplex: true, .. } => 4,
            _ => 2,
        };
        let mut m = Machine::new(subject, count, |index, drive| {
            drive.axis.health.bucket = bucket;
            drive.axis.stop.how = how;
            if index == 0 {
                (drive.axis.divisor, drive.axis.phase) = (every, phase);
            }
        });
        let ids = m.moving();
        // The last good exchange is that of the request before the silence.
        let received = m.received(0);
        m.until("one more exchange", if m.can.whole { 20 } else { 100 }, |m| {
            m.received(0) > received && m.feedback(0).age == 0
        });
        let received = m.received(0);
        // A packet that answers nothing is taken in with the next send.
        let last_good = m.asked_in(0, received - 1)[0] + u64::from(m.can.own_clock);
        m.late(0);
        let bound = m.stop_bound(0);
        m.run(bound + 50);
        let requests: Vec<_> =
            m.tape(0, |tape| tape.received.iter().map(|received| received.request.clone()).collect());
        let stop = (received..requests.len()).find(|n| subject.requests_stop(&requests[..*n], &requests[*n]));
        let stop = stop.map(|n| n - received);
        let stop = stop.unwrap_or_else(|| panic!("no stop request: {how:?}"));
        let lost = m.asked_in(0, received)[stop] - last_good;
        let what = format!("divisor {every}, bucket {bucket}, {how:?}: after {lost} cycles, bound {bound}");
        assert!(lost <= bound, "{what}");
        assert!(stop as u64 >= u64::from(bucket), "too soon: {what}");
        assert_eq!(m.feedback(0).stopped, Some(StopCause::LinkLost));
        assert_eq!(m.outcome(0, ids[0]), Some(Outcome::Aborted(Abort::Stopped(StopCause::LinkLost))));
        // It received the stop, and stands.
        m.until("standstill", 1_000, |m| m.tape(0, |tape| !tape.said().moving));
        let neighbour =
            (1..count).all(|index| m.feedback(index).stopped.is_none() && m.feedback(index).status.moving);
        assert!(neighbour, "its neighbour goes on");
    }
}

pub fn divisor_and_phase_choose_the_slots(subject: &'static dyn Subject) {
    let schedule = [(1, 0), (2, 1), (5, 3)];
    let least = 1 + subject.can().answers_after;
    let mut m = Machine::new(subject, 3, |index, drive| {
        let (divisor, phase) = schedule[index];
        (drive.axis.divisor, drive.axis.phase) = (divisor * least, phase);
    });
    m.ready();
    if m.can.shared {
        // So that no two requests are the same.
        for index in 0..3 {
            m.post(index, m.changing(index));
        }
        m.run(100);
    }
    let received = [0, 1, 2].map(|index| m.received(index));
    m.run(500);
    for (index, (divisor, phase)) in schedule.into_iter().enumerate() {
        let mut requested = m.asked_in(index, received[index]);
        let every = u64::from(divisor * least);
        if m.can.shared {
            // The frames go in each of them: what they tell the drive is another from slot to slot.
            let requests = m.tape(index, |tape| tape.received[received[index] - 1..].to_vec());
            let mut anew = requests.windows(2).map(|pair| pair[0].request != pair[1].request);
            requested.retain(|_| anew.next() == Some(true));
        }
        assert!(
            requested.iter().all(|slot| slot % every == u64::from(phase)),
            "drive {index}: {requested:?}"
        );
        assert!(requested.len() as u64 >= 500 / every, "drive {index}: {} requests", requested.len());
    }
}

pub fn one_lost_drive_leaves_the_others_untouched(subject: &'static dyn Subject) {
    let mut m = Machine::new(subject, 3, |_, _| {});
    let ids = m.moving();
    m.plug(1, false);
    assert_eq!(m.stopped(1, 100), StopCause::LinkLost);
    for _ in 0..1_000 {
        m.step();
        for index in [0, 2] {
            let feedback = m.feedback(index);
            // What says a part is not all of it.
            let parts = if m.can.whole { 1 } else { 4 };
            // Now and then no packet comes between two requests.
            let oldest = 2 * parts * m.drives[index].axis.divisor - 1 + u32::from(m.can.own_clock);
            assert!(feedback.age < oldest && feedback.stopped.is_none(), "axis {index}: {feedback:?}");
        }
    }
    assert!([0, 2].iter().all(|index| m.outcome(*index, ids[*index]).is_none()), "they go on");
    for index in [0, 2] {
        m.done(index, Command::Stop { deceleration: None });
    }
    let end = m.sim.finish();
    for index in [0, 2] {
        let c = end.drives[index].counters;
        // Before there was a connection, the first look may have met none.
        let unsent = match m.can {
            Can { stream: true, .. } | Can { sessions: true, .. } => c.unsent.saturating_sub(1),
            // And before a line was up, no request could leave.
            Can { shared: true, .. } | Can { bytes: true, .. } => 0,
            _ => c.unsent,
        };
        // Before the first request nothing had come that could answer it.
        let missed = c.missed.saturating_sub(m.can.own_clock.into());
        let troubled = (missed, unsent, c.late, c.duplicate, c.malformed, c.foreign);
        assert_eq!((troubled, end.drives[index].losses), ((0, 0, 0, 0, 0, 0), 0), "axis {index}");
        assert_eq!(end.drives[index].peaks.rtt.ns > 0, m.can.round_trip, "axis {index}");
    }
}

pub fn a_lost_drive_comes_back_by_the_application_only_and_homed_is_read_again(
    subject: &'static dyn Subject,
) {
    // What comes back is the same drive, or one that was switched off meanwhile and knows nothing any more.
    for restarted in [false, true] {
        let mut m = Machine::new(subject, 1, |_, drive| {
            let range = (-1e3 * drive.start, 1e3 * drive.start);
            drive.axis.limits.position = subject.can().positions.then_some(range);
        });
        m.moving();
        m.plug(0, false);
        assert_eq!(m.stopped(0, 100), StopCause::LinkLost);
        m.run(300);
        if restarted {
            m.restart(0);
            m.run(500);
        }
        m.plug(0, true);
        m.until("off", 5_000, |m| {
            m.feedback(0).link == Link::Online && !m.feedback(0).status.state.is_powered()
        });
        m.run(500);
        let feedback = m.feedback(0);
        assert_eq!(feedback.stopped, Some(StopCause::LinkLost), "it stays latched");
        assert!(!feedback.status.state.is_powered() && !feedback.status.moving, "{feedback:?}");
        for command in [Command::Enable, m.go(0)] {
            assert_eq!(m.failed(0, command), Failure::Latched(StopCause::LinkLost));
        }
        m.done(0, Command::Reset);
        m.done(0, Command::Enable);
        let said = m.tape(0, |tape| tape.said().homed);
        assert!(said.is_none_or(|homed| homed == m.feedback(0).status.homed));
        // Where nothing shows that it was not restarted, its reference is open.
        if (restarted || m.can.sessions) && m.can.home && m.can.positions {
            let command = m.by(0, 0.05);
            assert_eq!(m.failed(0, command), Failure::NotHomed);
            m.done(0, Command::Home);
        }
        m.move_about(0);
    }
}

pub fn a_restart_in_mid_motion_ends_latched_and_nothing_moves_by_itself(subject: &'static dyn Subject) {
    let mut m = Machine::new(subject, 2, |_, _| {});
    let ids = m.moving();
    m.restart(0);
    m.stopped(0, 1_000);
    assert!(matches!(m.outcome(0, ids[0]), Some(Outcome::Aborted(_) | Outcome::Failed(_))));
    m.until("it is online", if m.can.sessions { 40_000 } else { 5_000 }, |m| {
        m.feedback(0).link == Link::Online
    });
    m.run(200);
    for _ in 0..1_000 {
        m.step();
        let (feedback, said) = (m.feedback(0), m.tape(0, |tape| tape.said()));
        assert!(feedback.stopped.is_some() && !said.powered && !said.moving, "{feedback:?}, {said:?}");
    }
    assert_eq!(m.restarts, u32::from(!m.can.sessions), "reported once");
    m.recover(0);
    m.move_about(0);
    assert_eq!((m.feedback(1).stopped, m.outcome(1, ids[1])), (None, None), "its neighbour goes on");
}

/// Neither the loss of its link nor anything else stops it before: what the drive was commanded to do before it
/// restarted is not sent to it again, not even in the first telegrams.
pub fn a_restart_that_nothing_else_shows_brings_no_power_back(subject: &'static dyn Subject) {
    if subject.can().sessions {
        return not_applicable(subject, "a restart within the bucket of its link", "its session ends first");
    }
    let mut m = Machine::new(subject, 2, |_, drive| drive.axis.health.bucket = 100_000);
    m.moving();
    m.restart(0);
    // Its last reply of before is the newest one for a while.
    m.until("the drive reports itself off", 5_000, |m| !m.tape(0, |tape| tape.said()).powered);
    m.until("it is stopped", 5_000, |m| {
        let said = m.tape(0, |tape| tape.said());
        assert!(!said.powered && !said.moving, "{said:?}, {:?}", m.feedback(0));
        m.feedback(0).stopped.is_some()
    });
}

pub fn found_running_is_stopped_or_left_alone_as_its_plan_says(subject: &'static dyn Subject) {
    if subject.can().comes_up_off {
        return not_applicable(subject, "a drive found running", "to bring it up takes its power");
    }
    let mut m = Machine::new(subject, 2, |index, drive| {
        drive.running = true;
        drive.axis.on_found_running = [FoundRunning::Stop, FoundRunning::Refuse][index];
    });
    m.online();
    for index in 0..2 {
        assert_eq!(m.feedback(index).stopped, Some(StopCause::FoundRunning));
    }
    m.until("power off", 2_000, |m| !m.feedback(0).status.state.is_powered());
    let (received, still) = m.tape(0, |tape| {
        let standing = tape.all_said().into_iter().rev();
        let standing = standing.skip_while(|said| !said.powered);
        (tape.received.len(), standing.take_while(|said| said.powered && !said.moving).count())
    });
    assert!(still >= 20, "of {received} requests only {still} between standstill and power off");
    m.run(500);
    let (feedback, said) = (m.feedback(1), m.tape(1, |tape| tape.said()));
    assert!(said.powered && said.moving && feedback.status.moving, "only read: {feedback:?}");
    for command in [Command::Enable, m.go(1)] {
        assert_eq!(m.failed(1, command), Failure::Latched(StopCause::FoundRunning));
    }
    assert!(m.tape(1, |tape| tape.said().moving));
    // It is the application that decides.
    m.done(1, Command::Stop { deceleration: None });
    assert!(m.tape(1, |tape| tape.said().powered && !tape.said().moving));
    if m.can.shared {
        // Without power it was set up.
        m.online();
    }
    if m.can.rearmed {
        is_set_up_anew(&mut m);
    }
    for index in 0..2 {
        m.done(index, Command::Reset);
        m.done(index, Command::Enable);
        m.move_about(index);
    }
}

/// What was taken over without its watchdog is not switched on again: it is set up anew once its power is off, and
/// nobody else notices.
fn is_set_up_anew(m: &mut Machine) {
    m.done(1, Command::Reset);
    let Failure::Unsupported(why) = m.failed(1, Command::Enable) else { panic!("{:?}", m.feedback(1)) };
    assert!(why.len() > 10, "{why}");
    assert!(m.tape(1, |tape| tape.said().powered && !tape.said().moving), "it stands as it was stopped");
    m.done(1, Command::Disable);
    let alone = |m: &Machine| {
        let neighbour = m.feedback(0);
        assert_eq!((neighbour.link, neighbour.age), (Link::Online, 0), "{neighbour:?}");
    };
    m.until("it is set up anew", 4_000, |m| {
        alone(m);
        m.feedback(1).link != Link::Online
    });
    m.until("it comes back by itself", 4_000, |m| {
        alone(m);
        m.feedback(1).link == Link::Online
    });
    let feedback = m.feedback(1);
    assert!(!feedback.status.state.is_powered(), "{feedback:?}");
    assert_eq!(feedback.stopped, Some(StopCause::LinkLost), "and waits for the application");
}

pub fn a_fault_of_the_drive_latches_its_axis(subject: &'static dyn Subject) {
    let mut m = Machine::new(subject, 2, |_, _| {});
    let ids = m.moving();
    let Some(telegram) = subject.fault(&m.tape(0, |tape| tape.reply())) else {
        return not_applicable(subject, "a fault of the drive", "nothing on its wire brings it about");
    };
    m.meddle(0, telegram);
    assert_eq!(m.stopped(0, 50), StopCause::DriveFault);
    assert_eq!(m.ended(0, ids[0]), Outcome::Aborted(Abort::Stopped(StopCause::DriveFault)));
    m.until("the fault", 500, |m| m.feedback(0).status.state == State::Fault);
    m.until(
        "its number",
        if m.can.shared {
            200
        } else if m.can.bytes {
            // It comes with a turn of its own.
            10
        } else if m.can.whole {
            1
        } else {
            50
        },
        |m| m.feedback(0).status.fault != 0,
    );
    // The stop sequence runs to its end before anything else is taken.
    m.run(100);
    m.recover(0);
    assert_eq!(m.feedback(0).status.fault, 0);
    assert_eq!((m.feedback(1).stopped, m.outcome(1, ids[1])), (None, None), "its neighbour goes on");
}

/// A stormy run: what went over the wire, in numbers and each request to each drive, and how it ended.
#[derive(PartialEq)]
struct Stormy {
    digest: u64,
    delivered: u64,
    requests: Vec<Vec<(Time, Vec<u8>)>>,
    end: String,
}

fn storm(subject: &'static dyn Subject, seed: u64, proposals: Option<u64>) -> Stormy {
    let options = WorldOptions { seed, wake_ns: 60_000, ..WorldOptions::default() };
    let mut m = Machine::proposing(subject, 3, |_, _| {}, options, proposals);
    // A connection that is lost is opened by a handshake, which has to pass as well.
    let rate = if m.can.stream { 0.1 } else { 1.0 };
    for index in 0..3 {
        let plan = FaultPlan {
            seed: seed + index as u64,
            drop: 0.03 * rate,
            duplicate: 0.05,
            corrupt: 0.005 * rate,
            delay: 0.05,
            delay_ns: MS,
            restart: 0.000_3,
            ..FaultPlan::default()
        };
        m.faults(index, plan);
    }
    let mut natives: Vec<_> = (0..3).map(|index| subject.native(m.sim.axis(index))).collect();
    for cycle in 0..3_000_u64 {
        if cycle % 5 == 0 {
            natives.iter_mut().for_each(|write| write(cycle as u16));
        }
        if cycle % 1_000 == 700 {
            m.world().delay_next_wake(3 * MS + 100 * US);
        }
        let index = (cycle / 50 % 3) as usize;
        if cycle % 50 == 0 {
            let motion = if m.can.positions { m.by(index, 0.05) } else { m.go(index) };
            let commands = [
                Command::Reset,
                Command::ResetFault,
                Command::Enable,
                Command::Home,
                motion,
                Command::Native(NativeOwner::Master),
                Command::Native(NativeOwner::Application),
            ];
            let command = commands[(cycle / 150 % 7) as usize];
            // One that the drive cannot do is refused at once.
            if command != Command::Home || m.can.home {
                m.post(index, command);
            }
        }
        m.step();
        m.assert_grid();
    }
    let (digest, delivered) = (m.world().digest(), m.world().delivered());
    let request = |received: &Delivery| (received.at, received.request.clone());
    let requests = |index| m.tape(index, |tape| tape.received.iter().map(request).collect());
    let requests = (0..3).map(requests).collect();
    for index in 0..3 {
        m.faults(index, FaultPlan::default());
    }
    if m.can.stream {
        m.until("all back", 20_000, |m| (0..3).all(|index| m.feedback(index).link == Link::Online));
    }
    m.sim.stop();
    m.until_end(20_000);
    let end = m.sim.finish();
    for drive in &end.drives {
        let c = drive.counters;
        assert_eq!(c.sent, c.answered + c.missed, "nothing is owed at the end: {c:?}");
        assert!(!drive.feedback.status.state.is_powered(), "{:?}", drive.feedback);
    }
    assert_eq!(end.status.planned, end.status.executed + end.status.skipped);
    // A slave that faults keep out of operation misses nothing, but nothing is sent to it.
    let unanswered: u64 = end.drives.iter().map(|drive| drive.counters.missed + drive.counters.unsent).sum();
    assert!(end.status.skipped > 0 && unanswered > 0, "{:?}", end.status);
    Stormy { digest, delivered, requests, end: format!("{end:?}") }
}

pub fn the_same_seed_is_the_same_run_to_the_byte(subject: &'static dyn Subject) {
    let one = storm(subject, 1, None);
    assert!(one == storm(subject, 1, None), "the same seed, another run");
    assert_ne!(one.digest, storm(subject, 2, None).digest, "the digest sees what goes over the wire");
}

pub fn a_prepared_request_that_does_not_leave_has_no_effect(subject: &'static dyn Subject) {
    // So each request is built again, too, and is the same to the byte.
    for seed in 1..4 {
        let (plain, proposing) = (storm(subject, seed, None), storm(subject, seed, Some(seed)));
        for (index, (one, other)) in plain.requests.iter().zip(&proposing.requests).enumerate() {
            let differs = one.iter().zip(other).find(|(one, other)| one != other);
            assert_eq!(differs, None, "seed {seed}, drive {index}");
        }
        assert!(plain == proposing, "seed {seed}");
    }
}

pub fn the_end_of_the_master_leaves_every_drive_at_standstill_and_off(subject: &'static dyn Subject) {
    // One moves, one is held in a stop, one was only ever read, one is gone. The clock of the first slave of a line is
    // everybody's: what runs behind one that starts anew falls out of step with it.
    let (read, gone) = if subject.can().shared { (3, 2) } else { (2, 3) };
    let mut m = Machine::new(subject, 4, |index, drive| {
        drive.axis.stop.then = if index == 1 { StopThen::Hold } else { StopThen::Disable };
        drive.running = index == read;
        drive.axis.on_found_running = FoundRunning::Refuse;
    });
    m.online();
    for index in [0, 1, gone] {
        m.done(index, Command::Enable);
        if m.can.home {
            m.done(index, Command::Home);
        }
        m.post(index, m.go(index));
    }
    m.run(200);
    m.mute(1, true);
    m.stopped(1, 100);
    m.mute(1, false);
    m.plug(gone, false);
    m.run(300);
    m.sim.stop();
    m.until_end(20_000);
    let said = |index| m.tape(index, |tape| tape.said());
    assert!([0, 1].iter().all(|index| !said(*index).powered));
    let left_alone = said(read).powered && said(read).moving;
    assert!(left_alone || m.can.comes_up_off, "not ours to stop");
    let before_off = m.tape(0, |tape| tape.all_said().into_iter().rev().find(|said| said.powered));
    assert!(before_off.is_some_and(|said| !said.moving), "power went off in mid-motion");
    m.assert_grid();
    let end = m.sim.finish();
    assert!(
        end.drives.iter().all(|drive| drive.counters.sent == drive.counters.answered + drive.counters.missed)
    );
}

pub fn a_grid_with_skipped_slots_owes_nothing_for_them(subject: &'static dyn Subject) {
    let mut m = Machine::new(subject, 2, |_, _| {});
    m.moving();
    let before = *m.sim.status();
    for late in 1..=5 {
        m.world().delay_next_wake(late * PERIOD + 300 * US);
        m.run(20);
        m.assert_grid();
    }
    let status = *m.sim.status();
    assert!(status.skipped - before.skipped >= 15, "{status:?}");
    assert_eq!(status.missed, before.missed, "the drives are not charged for the loop's lateness");
    assert!((0..2).all(|index| m.feedback(index).stopped.is_none()));
}
