//! The services of a LinMot drive, over the whole machine: lists, software, error log, curves, command table, flash.

use std::any::Any;
use std::cell::{Cell, RefCell};
use std::ops::ControlFlow;
use std::time::Duration;

use fieldbeat::axis::{CallError, Command, Health, Link, State, StopCause};
use fieldbeat::bus::linudp::curve::{Curve, CurveKind, Dimension};
use fieldbeat::bus::linudp::motion::{EntryId, MotionCommand, Position, WaitTime};
use fieldbeat::bus::linudp::service::{CurvePut, Progress, Saved, ServiceError, Services};
use fieldbeat::bus::linudp::table::{Entry, Table};
use fieldbeat::sim::FaultPlan;
use fieldbeat::time::S;
use fieldbeat_core::axis::acyclic::{Carrier, Condition};
use fieldbeat_core::axis::{Answer, Call, Series};
use fieldbeat_linudp::upid::{Upid, Usage};
use fieldbeat_linudp::wire::{Refusal, RtcCommand};
use fieldbeat_sim::linudp::FlashMode;

use crate::virtual_time::carrier::Turning;
use crate::virtual_time::support::*;

fn services<'a>(carrier: &'a dyn Carrier) -> Services<'a> {
    Services::over("x0", carrier).unwrap()
}

fn go_on(_: Progress) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// A curve with a value of its own at each place.
fn curve(id: u16, setpoints: i32) -> Curve {
    Curve {
        id,
        kind: CurveKind::Time,
        name: Curve::name_bytes(&format!("curve {id}")).unwrap(),
        x_length: 50_000,
        x_dimension: Dimension::TIME,
        y_dimension: Dimension::POSITION,
        wizard: 7,
        wizard_parameters: [1, 2, 3, 4, 5, 6, u32::MAX],
        setpoints: (0..setpoints).map(|at| at * 1_000 - i32::from(id) * 31).collect(),
    }
}

fn id(id: u16) -> EntryId {
    EntryId::new(id).unwrap()
}

/// A table that fills the presence lists from one end to the other.
fn table(salt: i32) -> Table {
    let mut table = Table::new();
    for number in [1, 2, 31, 32, 63, 64, 100, 200, 254, 255] {
        let position = Position(i32::from(number) * 1_000 + salt);
        let command = match number % 2 {
            0 => MotionCommand::wait_time(WaitTime(100 + u32::from(number))),
            _ => MotionCommand::vai_predefined_go_to(position),
        };
        let next = (number < 255).then(|| id(255));
        table.insert(id(number), Entry::new(&format!("entry {number}"), command, next).unwrap());
    }
    table
}

fn kept(rig: Rig) -> Rig {
    rig.each(|_, drive| drive.axis.health = Health { bucket: 100, leak: 1, gate: 2, ..Health::default() })
}

#[test]
fn the_lists_name_all_parameters_and_those_that_were_changed() {
    let mut b = Rig::new(1).online();
    let turning = Turning::new(&mut b, 0);
    let services = services(&turning);
    let all = services.upids(Upid(0), &mut go_on).unwrap();
    assert!(all.windows(2).all(|pair| pair[0].upid < pair[1].upid) && all.len() > 50);
    let monitor = all.iter().find(|item| item.upid == Upid(0x20A8)).unwrap();
    assert!(monitor.usage.has(Usage::RAM_READ | Usage::RAM_WRITE | Usage::ROM_WRITE));
    let some = services.upids(Upid(0x2000), &mut go_on).unwrap();
    assert_eq!(some[..], all[all.len() - some.len()..]);
    let mut reported = Vec::new();
    let broken = services.upids(Upid(0x1000), &mut |progress| {
        reported.push(progress);
        if reported.len() == 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert!(matches!(broken, Err(ServiceError::BrokenOff { .. })), "{broken:?}");
    assert!(
        reported.len() == 2 && reported[0].done >= 0x1000 && reported[1].done > reported[0].done,
        "{reported:?}"
    );
    let article = services.text(Upid(0x000C)).unwrap();
    assert!(article.len() > 8 && article.is_ascii(), "{article}");
    let before = services.modified_upids(Upid(0), &mut go_on).unwrap();
    drop(services);
    drop(turning);
    b.write(0, "predefined-velocity.rom", 123_456).unwrap();
    let turning = Turning::new(&mut b, 0);
    let after = self::services(&turning).modified_upids(Upid(0), &mut go_on).unwrap();
    assert_eq!(after.len(), before.len() + 1);
    assert!(after.contains(&(Upid(0x14BE), 123_456)));
}

#[test]
fn curves_and_tables_round_trip_to_the_byte_while_replies_are_lost() {
    for seed in 0..4 {
        let weather = FaultPlan { seed, drop: 0.05, ..FaultPlan::default() };
        let mut b = kept(Rig::new(2).faults(weather)).online();
        let turning = Turning::new(&mut b, 0);
        let services = services(&turning);
        for (curve, how) in [
            (curve(1, 2), CurvePut::Add),
            (curve(100, 1_000), CurvePut::Add),
            (Curve { name: Curve::name_bytes("another").unwrap(), ..curve(100, 1_000) }, CurvePut::Modify),
            (curve(1, 300), CurvePut::Rebuild),
        ] {
            assert_eq!(services.plan_curve(&curve), Ok(how), "seed {seed}");
            services.put_curve(&curve, &mut go_on).unwrap();
            assert_eq!(services.curve(curve.id, &mut go_on), Ok(Some(curve)), "seed {seed}");
        }
        assert_eq!(services.curves(), Ok(vec![1, 100]));
        // What was rebuilt took the other one along.
        assert_eq!(services.curve(100, &mut go_on).unwrap().unwrap().name(), Some("another"));
        assert_eq!(services.curve(2, &mut go_on), Ok(None));
        for table in [table(0), table(5), Table::new(), table(9)] {
            services.put_table(&table, &mut go_on).unwrap();
            assert_eq!(services.table(&mut go_on), Ok(table), "seed {seed}");
        }
    }
}

#[test]
fn a_transfer_sends_no_telegram_more_and_skips_no_slot() {
    let run = |busy: bool| {
        let mut b = Rig::new(3).online();
        (0..3).for_each(|index| b.tape(index).wire = Some(Vec::new()));
        let begun = b.status().executed;
        if busy {
            let turning = Turning::new(&mut b, 0);
            services(&turning).put_curve(&curve(5, 500), &mut go_on).unwrap();
            services(&turning).put_table(&table(1), &mut go_on).unwrap();
        }
        let turns = b.status().executed - begun;
        let sent: Vec<usize> = (0..3).map(|index| b.tape(index).wire.as_ref().unwrap().len()).collect();
        (b, turns, sent)
    };
    let (b, turns, sent) = run(true);
    // 500 setpoints there and back are more than a thousand steps.
    assert!(turns > 1_200, "{turns}");
    assert_eq!(sent, [turns as usize; 3]);
    assert_eq!(b.status().skipped, 0);
    let (mut idle, ..) = run(false);
    idle.run(turns);
    let looks = |b: &Bench| (b.looks(), b.sends());
    assert_eq!(looks(&b), looks(&idle), "looks into the socket, and hand-overs to it");
}

#[test]
fn a_transfer_that_is_broken_off_leaves_what_was_there() {
    for at in [0, 1, 17, 18, 19, 40, 117] {
        let mut b = Rig::new(1).online();
        let turning = Turning::new(&mut b, 0);
        let services = services(&turning);
        let (old, other) = (curve(3, 100), curve(4, 30));
        services.put_curve(&old, &mut go_on).unwrap();
        services.put_curve(&other, &mut go_on).unwrap();
        for new in [Curve { x_length: 9, ..curve(3, 100) }, curve(3, 120), curve(9, 120)] {
            let mut broken = |progress: Progress| match progress.what == "write" && progress.done > at {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            };
            let put = services.put_curve(&new, &mut broken);
            assert!(matches!(put, Err(ServiceError::BrokenOff { .. })), "at {at}: {put:?}");
            assert_eq!(services.curves(), Ok(vec![3, 4]), "at {at}");
            assert_eq!(services.curve(3, &mut go_on), Ok(Some(old.clone())), "at {at}");
            assert_eq!(services.curve(4, &mut go_on), Ok(Some(other.clone())), "at {at}");
        }
    }
    for at in 0..12 {
        let mut b = Rig::new(1).online();
        let turning = Turning::new(&mut b, 0);
        let services = services(&turning);
        let old = table(0);
        services.put_table(&old, &mut go_on).unwrap();
        let mut new = table(3);
        new.remove(&id(64));
        new.insert(id(7), Entry::new("seven", MotionCommand::no_operation(), None).unwrap());
        let mut broken = |progress: Progress| match progress.what == "write" && progress.done >= at {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        };
        let put = services.put_table(&new, &mut broken);
        // The last look comes when all is written.
        assert!(
            matches!(put, Err(ServiceError::BrokenOff { .. })) || at > 5 && put.is_ok(),
            "at {at}: {put:?}"
        );
        let is = services.table(&mut go_on).unwrap();
        assert_eq!(is, if put.is_ok() { new } else { old }, "at {at}");
    }
}

#[test]
fn a_restart_in_the_middle_of_a_transfer_leaves_what_flash_holds() {
    for at in [1, 5, 30, 80, 150, 230] {
        let mut b = Rig::new(1).online();
        let turning = Turning::new(&mut b, 0);
        let (saved, unsaved) = (curve(3, 100), curve(4, 100));
        services(&turning).put_curve(&saved, &mut go_on).unwrap();
        services(&turning).save_curves().unwrap();
        drop(turning);
        let turning = Turning::with(&mut b, 0, |b, turn| {
            if turn == at {
                b.world().restart(address(0));
            }
        });
        let put = services(&turning).put_curve(&unsaved, &mut go_on);
        let why = put.expect_err("it restarted in the middle of it");
        assert!(why.to_string().contains("restarted meanwhile"), "at {at}: {why}");
        assert_eq!(services(&turning).curves(), Ok(vec![3]), "at {at}");
        assert_eq!(services(&turning).curve(3, &mut go_on), Ok(Some(saved)), "at {at}");
    }
}

#[test]
fn flash_is_saved_through_a_silence_that_loses_the_link_and_what_was_saved_outlives_a_restart() {
    for flash in [FlashMode::Silent, FlashMode::Mute, FlashMode::Busy] {
        let mut b = Rig::new(1)
            .each(move |_, drive| {
                drive.simulate.flash_time_ns = 60 * S;
                drive.simulate.flash = flash;
            })
            .online();
        let turning = Turning::new(&mut b, 0);
        services(&turning).put_curve(&curve(3, 100), &mut go_on).unwrap();
        services(&turning).put_table(&table(0), &mut go_on).unwrap();
        let saved = if flash == FlashMode::Mute { Saved::Silently } else { Saved::Acknowledged };
        assert_eq!(services(&turning).save_curves(), Ok(saved));
        assert_eq!(services(&turning).save_table(), Ok(saved));
        // Each of them once.
        assert!((120_000..125_000).contains(&turning.turns()), "{}", turning.turns());
        drop(turning);
        let lost = b.kinds(0).iter().any(|kind| format!("{kind:?}").contains("Lost"));
        assert_eq!(lost, flash != FlashMode::Busy);
        b.world().restart(address(0));
        b.run(20);
        b.until("it is back", 2_000, |b| b.feedback(0).status.state == State::SwitchOnDisabled);
        let turning = Turning::new(&mut b, 0);
        assert_eq!(services(&turning).curve(3, &mut go_on), Ok(Some(curve(3, 100))));
        assert_eq!(services(&turning).table(&mut go_on), Ok(table(0)));
    }
}

#[test]
fn an_expected_silence_of_a_drive_stops_no_other_drive() {
    let mut b = Rig::new(2).each(|_, drive| drive.axis.stop.group = Some(0)).ready();
    b.done(0, Command::Disable);
    b.done(1, to(10.0));
    let motion = b.post(1, slowly_to(190.0));
    let turning = Turning::new(&mut b, 0);
    services(&turning).save_curves().unwrap();
    drop(turning);
    assert_eq!(b.feedback(0).stopped, Some(StopCause::LinkLost), "it was silent, and says so");
    assert_eq!((b.feedback(1).stopped, b.outcome(1, motion)), (None, None));
    assert!(b.feedback(1).status.moving);
    // One that was not requested takes its group along, as ever.
    b.world().unplug(address(0));
    b.run(50);
    assert_eq!(b.feedback(1).stopped, None, "it is latched already, and off");
    b.world().plug(address(0));
    b.until("it is back", 2_000, |b| b.feedback(0).link == Link::Online);
    b.done(0, Command::Reset);
    b.world().unplug(address(0));
    b.stopped(1, 100);
}

/// A carrier some of whose calls fail: never sent, or done and their answers lost.
struct Failing<'a> {
    carrier: &'a dyn Carrier,
    /// What becomes of the call of this number.
    fails: Box<Fates<'a>>,
    calls: RefCell<usize>,
    /// All that were sent.
    sent: RefCell<Vec<Call>>,
    bequeathed: RefCell<Vec<Call>>,
}

/// What becomes of the call of a number.
type Fates<'a> = dyn Fn(usize, &Call) -> Option<Fate> + 'a;

/// What becomes of a call.
#[derive(Clone, Copy)]
enum Fate {
    Unsent(CallError),
    Unheard(CallError),
    /// The drive answers something else.
    Says(fn(Answer) -> Answer),
}

impl<'a> Failing<'a> {
    fn new(carrier: &'a dyn Carrier, fails: impl Fn(usize, &Call) -> Option<Fate> + 'a) -> Failing<'a> {
        Failing {
            carrier,
            fails: Box::new(fails),
            calls: RefCell::default(),
            sent: RefCell::default(),
            bequeathed: RefCell::default(),
        }
    }

    /// The commands of this kind that were sent.
    fn sent(&self, command: RtcCommand) -> usize {
        self.sent.borrow().iter().filter(|call| is(call, command)).count()
    }
}

impl Carrier for Failing<'_> {
    fn run(&self, calls: &[Call], limit: Duration) -> Series {
        let mut all = Series::default();
        for call in calls {
            let number = self.calls.replace_with(|calls| *calls + 1);
            let fate = (self.fails)(number, call);
            if let Some(Fate::Unsent(error)) = fate {
                return Series { failed: Some(error), ..all };
            }
            self.sent.borrow_mut().push(*call);
            let one = self.carrier.run(&[*call], limit);
            match fate {
                Some(Fate::Unheard(error)) => return Series { failed: Some(error), ..all },
                Some(Fate::Says(change)) => all.answers.extend(one.answers.into_iter().map(change)),
                _ => all.answers.extend(one.answers),
            }
            if one.failed.is_some() {
                return Series { failed: one.failed, ..all };
            }
        }
        all
    }

    crate::forward! { this => this.carrier;
        fn condition(&self) -> Result<Condition, CallError>;
        fn claim(&self) -> Result<Box<dyn Any + Send>, CallError>;
        fn capacity(&self) -> usize;
        fn pause(&self, time: Duration);
    }

    fn bequeath(&self, calls: &[Call]) -> Result<(), CallError> {
        *self.bequeathed.borrow_mut() = calls.to_vec();
        Ok(())
    }
}

fn is(call: &Call, command: RtcCommand) -> bool {
    call.service == u32::from(command.0)
}

/// The software of the drive runs: a save is refused as long as it does.
fn runs(b: &mut Bench) -> bool {
    b.run(100);
    b.feedback(0).status.state == State::SwitchOnDisabled
}

#[test]
fn the_software_runs_again_after_any_loss() {
    // The answer to the stop; the save; both, and then the first attempts to start it.
    let lost: [&Fates<'_>; 3] = [
        &|_, call| is(call, RtcCommand::STOP_SOFTWARE).then_some(Fate::Unheard(CallError::TimedOut)),
        &|_, call| is(call, RtcCommand::SAVE_CURVES).then_some(Fate::Unheard(CallError::TimedOut)),
        &|number, call| match RtcCommand(call.service as u8) {
            RtcCommand::SAVE_CURVES => Some(Fate::Unsent(CallError::TimedOut)),
            RtcCommand::START_SOFTWARE if number < 12 => Some(Fate::Unsent(CallError::NotOnline)),
            _ => None,
        },
    ];
    for (at, lost) in lost.into_iter().enumerate() {
        let mut b = Rig::new(1).online();
        let turning = Turning::new(&mut b, 0);
        let failing = Failing::new(&turning, lost);
        let error = services(&failing).save_curves().unwrap_err();
        assert!(matches!(error, ServiceError::Call { error: CallError::TimedOut, .. }), "{at}: {error}");
        assert!(failing.bequeathed.borrow().is_empty(), "{at}: taken back");
        drop(failing);
        drop(turning);
        assert!(runs(&mut b), "{at}");
    }
}

#[test]
fn stopped_drive_software_is_reported_and_restarted_by_a_later_call() {
    for save_too in [false, true] {
        let mut b = Rig::new(1).online();
        let turning = Turning::new(&mut b, 0);
        let failing = Failing::new(&turning, |_, call| {
            let lost = is(call, RtcCommand::START_SOFTWARE) || save_too && is(call, RtcCommand::SAVE_TABLE);
            lost.then_some(Fate::Unsent(CallError::NotOnline))
        });
        let error = services(&failing).save_table().unwrap_err();
        let ServiceError::Stopped { failed, .. } = &error else { panic!("{error}") };
        assert_eq!(failed.is_some(), save_too);
        assert!(error.to_string().contains("`fieldbeat linmot software start`"), "{error}");
        assert!(matches!(failing.bequeathed.borrow()[..], [call] if is(&call, RtcCommand::START_SOFTWARE)));
    }
}

#[test]
fn software_that_was_stopped_on_purpose_stays_stopped() {
    let mut b = Rig::new(1).online();
    let turning = Turning::new(&mut b, 0);
    services(&turning).stop_software().unwrap();
    turning.pause(Duration::from_millis(100));
    services(&turning).save_table().unwrap();
    drop(turning);
    assert!(!runs(&mut b));
    let turning = Turning::new(&mut b, 0);
    services(&turning).start_software().unwrap();
    // At once: its status may still be that of before.
    services(&turning).save_table().unwrap();
    drop(turning);
    assert!(runs(&mut b));
}

/// Breaks off the `most`th look at what is said to go on.
fn breaking(what: &'static str, mut most: usize) -> impl FnMut(Progress) -> ControlFlow<()> {
    move |progress| {
        most -= usize::from(progress.what == what && most > 0);
        if most == 0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }
}

#[test]
fn a_table_that_is_broken_off_is_put_back_with_as_few_steps_as_that_takes() {
    let mut b = Rig::new(1).online();
    let turning = Turning::new(&mut b, 0);
    let old = table(0);
    services(&turning).put_table(&old, &mut go_on).unwrap();
    // Four entries differ: before the first one, behind the third, and when all are written.
    for (what, at, deleted, written) in [("write", 1, 0, 0), ("write", 4, 6, 6), ("read", 1, 8, 8)] {
        let failing = Failing::new(&turning, |_, _| None);
        let put = services(&failing).put_table(&table(3), &mut breaking(what, at));
        assert!(matches!(put, Err(ServiceError::BrokenOff { .. })), "{what} {at}: {put:?}");
        assert_eq!(failing.sent(RtcCommand::DELETE_TABLE), 0, "{what} {at}");
        assert_eq!(failing.sent(RtcCommand::DELETE_ENTRY), deleted, "{what} {at}");
        assert_eq!(failing.sent(RtcCommand::WRITE_ENTRY), written, "{what} {at}");
        assert_eq!(services(&turning).table(&mut go_on), Ok(old.clone()), "{what} {at}");
    }
}

#[test]
fn an_incomplete_restore_is_reported_with_its_losses() {
    let mut b = Rig::new(1).online();
    let turning = Turning::new(&mut b, 0);
    services(&turning).put_table(&table(0), &mut go_on).unwrap();
    for id in [3, 4] {
        services(&turning).put_curve(&curve(id, 20), &mut go_on).unwrap();
    }
    let half = |put: Result<(), ServiceError>| {
        let error = put.unwrap_err();
        assert!(matches!(error, ServiceError::Half { .. }), "{error}");
        assert!(error.to_string().ends_with("what was not saved is lost"), "{error}");
    };
    // The link goes in the middle of it for good ...
    for which in [RtcCommand::WRITE_ENTRY_DATA, RtcCommand::ADD_CURVE_DATA] {
        let down = Cell::new(false);
        let failing = Failing::new(&turning, |_, call| {
            down.set(down.get() || is(call, which));
            down.get().then_some(Fate::Unsent(CallError::NotOnline))
        });
        half(match which {
            RtcCommand::WRITE_ENTRY_DATA => services(&failing).put_table(&table(1), &mut go_on),
            _ => services(&failing).put_curve(&curve(3, 30), &mut go_on),
        });
    }
    // ... or what was put back is not what is read.
    let failing = Failing::new(&turning, |_, call| {
        let changed = Fate::Says(|answer| Answer { value: answer.value ^ 1, ..answer });
        is(call, RtcCommand::GET_CURVE_DATA).then_some(changed)
    });
    services(&turning).put_curve(&curve(4, 20), &mut go_on).unwrap();
    half(services(&failing).put_curve(&Curve { x_length: 7, ..curve(4, 20) }, &mut go_on));
}

#[test]
fn a_curve_that_was_not_there_is_gone_again_and_the_others_are_not() {
    let mut b = Rig::new(1).online();
    let turning = Turning::new(&mut b, 0);
    services(&turning).put_curve(&curve(4, 20), &mut go_on).unwrap();
    // The first time that it is read back something else comes.
    let failing = Failing::new(&turning, |_, call| {
        let wrong = is(call, RtcCommand::GET_CURVE_DATA) && call.address == 9;
        wrong.then_some(Fate::Says(|answer| Answer { value: answer.value ^ 1, ..answer }))
    });
    let put = services(&failing).put_curve(&curve(9, 20), &mut go_on);
    assert!(matches!(put, Err(ServiceError::Content { .. })), "{put:?}");
    assert_eq!(services(&turning).curves(), Ok(vec![4]));
    assert_eq!(services(&turning).curve(4, &mut go_on), Ok(Some(curve(4, 20))));
}

#[test]
fn an_entry_that_is_none_is_replaced() {
    for refused in [false, true] {
        let mut b = Rig::new(1).online();
        let turning = Turning::new(&mut b, 0);
        services(&turning).put_table(&table(0), &mut go_on).unwrap();
        // Until entry 64 is deleted, a part of it is missing.
        let healed = Cell::new(false);
        let failing = Failing::new(&turning, |_, call| {
            let of = call.address == 64;
            healed.set(healed.get() || of && is(call, RtcCommand::DELETE_ENTRY));
            match RtcCommand(call.service as u8) {
                RtcCommand::GET_ENTRY if of && !healed.get() && refused => {
                    Some(Fate::Unheard(CallError::Refused(Refusal::WrongSize.code().into())))
                }
                RtcCommand::GET_ENTRY_DATA if of && !healed.get() => {
                    Some(Fate::Says(|answer| Answer { value: 0x1111_1111, ..answer }))
                }
                _ => None,
            }
        });
        let none = services(&failing).table(&mut go_on).unwrap_err();
        assert!(none.to_string().contains("command table entry 64"), "{none}");
        services(&failing).put_table(&table(0), &mut go_on).unwrap();
        assert_eq!(failing.sent(RtcCommand::WRITE_ENTRY), 1, "only this one");
        assert_eq!(services(&turning).table(&mut go_on), Ok(table(0)));
    }
}

#[test]
fn answers_that_contradict_the_question_are_not_believed() {
    let mut b = Rig::new(1).online();
    let turning = Turning::new(&mut b, 0);
    services(&turning).put_curve(&curve(7, 20), &mut go_on).unwrap();
    let wrong = |result: ServiceError, why: &str| {
        assert!(matches!(result, ServiceError::Content { .. }), "{result}");
        assert!(result.to_string().contains(why), "{result}");
    };
    // The id stands in the upper half of the 8th piece.
    let pieces = Cell::new(0);
    let failing = Failing::new(&turning, |_, call| {
        pieces.set(pieces.get() + usize::from(is(call, RtcCommand::GET_CURVE_INFO)));
        let eighth = is(call, RtcCommand::GET_CURVE_INFO) && pieces.get() == 8;
        eighth.then_some(Fate::Says(|answer| Answer { value: 3 << 16, ..answer }))
    });
    wrong(services(&failing).curve(7, &mut go_on).unwrap_err(), "says that it is curve 3");
    let failing = Failing::new(&turning, |_, call| {
        is(call, RtcCommand::GET_CURVE_INFO).then_some(Fate::Says(|answer| Answer { status: 0, ..answer }))
    });
    wrong(services(&failing).curve(7, &mut go_on).unwrap_err(), "ends too early");
}

#[test]
fn a_presence_list_is_known_by_its_command_whatever_offset_the_drive_gives() {
    let mut b = Rig::new(1).online();
    let turning = Turning::new(&mut b, 0);
    services(&turning).put_table(&table(0), &mut go_on).unwrap();
    let entries = services(&turning).entries().unwrap();
    assert!(!entries.is_empty());
    let failing = Failing::new(&turning, |_, call| {
        let third = is(call, RtcCommand(RtcCommand::PRESENCE_0.0 + 2));
        third.then_some(Fate::Says(|answer| Answer { address: 7, ..answer }))
    });
    assert_eq!(services(&failing).entries(), Ok(entries));
}
