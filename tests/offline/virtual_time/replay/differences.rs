//! What differs is named, by its cycle and its drive; and the in-loop task is repeated like everything else.

use std::sync::atomic::{AtomicU64, Ordering};

use fieldbeat::axis::{Command, EventKind, Move, Outcome, Profile, Row, StopCause, Target};
use fieldbeat::bus::linudp::LinUdpPlan;
use fieldbeat::sim::WorldOptions;
use fieldbeat::time::US;
use fieldbeat::{Axes, Cycle, CyclePlan, Flow, Guard, Master, Plan, Simulation, Wait};
use fieldbeat_core::inputs::entry::{Head, Kind};
use fieldbeat_replay::machine::TaskOf;
use fieldbeat_replay::{Replay, Verdict};

use super::{Log, replay};
use crate::virtual_time::oracle::machine::{Kind as KindOf, Machine, Shape, plan as machine_plan};
use crate::virtual_time::support::{MASTER, all_simulated, drive};

const DRIVES: usize = 2;

fn bus() -> LinUdpPlan {
    let drives = (0..DRIVES).map(drive).collect();
    LinUdpPlan { name: "linudp".into(), bind: MASTER, drives }
}

fn plan(wait: Wait) -> Plan {
    let guard = if wait == Wait::Spin { Guard::Fixed(40 * US) } else { Guard::Off };
    let cycle = CyclePlan { wait, guard, ..CyclePlan::default() };
    Plan { source: None, cycle, buses: vec![Box::new(bus())], groups: Vec::new() }
}

fn to(position: f64) -> Command {
    let profile = Profile { velocity: 200.0, acceleration: 5_000.0, deceleration: 5_000.0 };
    Command::Move(Move { target: Target::Absolute(position), profile })
}

/// A machine with its log; it is emptied by `work`, which runs commands one after the other.
fn recorded(
    wait: Wait,
    task: Option<fn(&Cycle, &mut Axes<'_>)>,
    work: impl FnOnce(&mut Simulation),
) -> Vec<u64> {
    let log = Log::default();
    let mut setup = Master::from_plan(plan(wait)).with_simulation(all_simulated(&bus()));
    if let Some(task) = task {
        setup = setup.with_task(task);
    }
    let options = WorldOptions { wake_ns: 30 * US, ..WorldOptions::default() };
    let mut sim = log.of(setup).simulate(options).unwrap();
    work(&mut sim);
    drop(sim);
    let mut words = log.words();
    assert_eq!(words.len(), 1);
    words.remove(0)
}

/// Both axes are enabled and homed, the first one makes a move.
fn moves(sim: &mut Simulation) {
    assert!(sim.run_until(200, |sim| sim.status().online == DRIVES as u32));
    for command in [Command::Enable, Command::Home] {
        for axis in 0..DRIVES {
            assert_eq!(sim.execute(axis, command, 3_000), Ok(Some(Outcome::Done)));
        }
    }
    assert_eq!(sim.execute(0, to(50.0), 1_000), Ok(Some(Outcome::Done)));
}

/// The entries of a log: heads with their payloads.
fn entries(words: &[u64]) -> Vec<(Head, Vec<u64>)> {
    let (mut at, mut all) = (0, Vec::new());
    while at < words.len() {
        let head = Head::of(words[at]).unwrap();
        all.push((head, words[at + 1..][..head.words()].to_vec()));
        at += 1 + head.words();
    }
    all
}

fn words(entries: &[(Head, Vec<u64>)]) -> Vec<u64> {
    entries
        .iter()
        .flat_map(|(head, payload)| std::iter::once(head.word()).chain(payload.iter().copied()))
        .collect()
}

fn verdict(words: Vec<u64>) -> Verdict {
    replay(plan(Wait::Poll), words, TaskOf::Nobody).run()
}

/// The cycle of each entry.
fn cycles(entries: &[(Head, Vec<u64>)]) -> Vec<u64> {
    let mut cycle = 0;
    let of = |(head, payload): &(Head, Vec<u64>)| {
        if head.kind == Kind::Cycle {
            cycle = payload[0];
        }
        cycle
    };
    entries.iter().map(of).collect()
}

#[test]
fn a_command_that_was_dropped_is_missed_in_the_next_telegram_of_its_drive() {
    let words_of_run = recorded(Wait::Poll, None, moves);
    let entries = entries(&words_of_run);
    assert_eq!(words(&entries), words_of_run);
    // The last command is the move of x0.
    let last = entries.iter().rposition(|(head, _)| head.kind == Kind::Queue).unwrap();
    let cycle = cycles(&entries)[last];
    let without = without_the_last_element(&words_of_run);
    let difference = verdict(without.clone()).difference.expect("the move is not made");
    // To the end of the record, it stands.
    let mut machine = replay(plan(Wait::Poll), without, TaskOf::Nobody).past_differences();
    assert_eq!(machine.run().last, verdict(words_of_run).last);
    assert_eq!(machine.verdict().difference.as_ref(), Some(&difference));
    let ends = machine.events.iter().filter(|(_, event)| matches!(event.kind, EventKind::Ended { .. }));
    assert_eq!(ends.count(), 2 * DRIVES, "the move has no end");
    assert_eq!((difference.cycle, difference.drive.as_deref()), (cycle + 1, Some("x0")), "{difference}");
    let telegrams = difference.telegrams.as_ref().unwrap();
    assert_ne!(telegrams.recorded[telegrams.first()], telegrams.repeated[telegrams.first()]);
    let text = difference.to_string();
    assert!(text.starts_with(&format!("cycle {}: drive x0: another telegram: byte ", cycle + 1)), "{text}");
}

/// The log without its last element of a queue: the look for it found nothing.
fn without_the_last_element(words_of_run: &[u64]) -> Vec<u64> {
    let mut entries = entries(words_of_run);
    let last = entries.iter().rposition(|(head, _)| head.kind == Kind::Queue).unwrap();
    let (head, _) = entries.remove(last);
    entries[last].0.looks += head.looks + 1;
    words(&entries)
}

#[test]
fn the_drive_of_a_telegram_is_named_on_each_wire() {
    for kind in [KindOf::LinMot, KindOf::Unidrive, KindOf::Kollmorgen, KindOf::Moons, KindOf::Lenze] {
        let shape = Shape { free_writes: false, ..Shape::of(kind) };
        let log = Log::default();
        let mut machine = Machine::new(shape, Some(log.clone()));
        for _ in 0..5_000 {
            machine.step();
            if machine.online() {
                break;
            }
        }
        (0..50).for_each(|_| machine.step());
        machine.sim.axis(1).post(Command::Enable).unwrap();
        (0..200).for_each(|_| machine.step());
        drop(machine);
        let words = log.words().remove(0);
        let of = |words| replay(machine_plan(shape), words, TaskOf::Nobody).run();
        assert!(of(words.clone()).is_equal(), "{kind:?}");
        let difference = of(without_the_last_element(&words)).difference.expect("it is not enabled");
        let name = machine_plan(shape).axes()[1].name.clone();
        assert_eq!(difference.drive, Some(name), "{kind:?}: {difference}");
    }
}

#[test]
fn a_reply_with_another_byte_leads_to_another_telegram_of_its_drive() {
    let original = entries(&recorded(Wait::Poll, None, moves));
    assert!(verdict(words(&original)).is_equal());
    let cycles = cycles(&original);
    let last = original.iter().rposition(|(head, _)| head.kind == Kind::Queue).unwrap();
    // The replies of x0 around its move: its port is that of all, its address ends with 1.
    let of_x0 = |(_, (head, payload)): &(usize, &(Head, Vec<u64>))| {
        head.kind == Kind::DatagramIn && payload[0] >> 16 & 0xFF == 1
    };
    let replies: Vec<usize> = (original.iter().enumerate().filter(of_x0))
        .map(|(place, _)| place)
        .filter(|place| *place > last)
        .take(3)
        .collect();
    let mut found = 0;
    for place in replies {
        for byte in 0..16 {
            let mut changed = original.clone();
            changed[place].1[1 + byte / 8] ^= 0x80 << (8 * (byte % 8));
            let Some(difference) = verdict(words(&changed)).difference else { continue };
            assert!(difference.cycle > cycles[place], "{difference} from cycle {}", cycles[place]);
            if difference.telegrams.is_some() {
                assert_eq!(difference.drive.as_deref(), Some("x0"), "{difference}");
                found += 1;
            }
        }
    }
    assert!(found >= 3, "{found} of 48 bytes make a difference");
}

#[test]
fn a_plan_without_one_of_the_drives_sends_fewer_telegrams() {
    let words = recorded(Wait::Poll, None, moves);
    let mut fewer = bus();
    fewer.drives.remove(1);
    let plan = Plan { buses: vec![Box::new(fewer)], ..plan(Wait::Poll) };
    let difference = replay(plan, words, TaskOf::Nobody).run().difference.unwrap();
    assert!(difference.to_string().ends_with("a telegram is recorded that is not sent"), "{difference}");
}

#[test]
fn a_spinning_loop_is_repeated_without_its_idle_turns() {
    let words = recorded(Wait::Spin, None, moves);
    let verdict = replay(plan(Wait::Spin), words.clone(), TaskOf::Nobody).run();
    assert!(verdict.is_equal(), "{verdict:?}");
    let cycles = verdict.last.unwrap();
    let readings = entries(&words).iter().filter(|(head, _)| head.kind == Kind::Clock).count() as u64;
    // 8 stages, and a turn or two for each reply; a turn takes 100 ns, the window is half a millisecond long.
    assert!(readings < 14 * cycles, "{readings} readings of the clock in {cycles} cycles");
}

fn streams(cycle: &Cycle, axes: &mut Axes<'_>) {
    if cycle.index == 900 {
        axes.command(0, to(30.0)).unwrap();
    }
    if cycle.index == 1_500 {
        axes.command(0, Command::Follow).unwrap();
    }
    if (1_500..1_600).contains(&cycle.index) {
        let position = axes.feedback(0).unwrap().status.demand;
        axes.follow(0, Row { position, last: cycle.index == 1_599, ..Row::default() });
    }
}

/// Ends with a stop.
fn with_task(sim: &mut Simulation) {
    assert!(sim.run_until(200, |sim| sim.status().online == DRIVES as u32));
    for command in [Command::Enable, Command::Home] {
        assert_eq!(sim.execute(0, command, 800), Ok(Some(Outcome::Done)));
    }
    assert!(sim.status().executed < 900, "{}", sim.status().executed);
    sim.run(1_000);
    sim.stop();
    while sim.step() == Flow::Continue {}
}

#[test]
fn the_in_loop_task_is_repeated_from_the_log_or_compared_with_it() {
    let words = recorded(Wait::Poll, Some(streams), with_task);
    let of = |task| replay(plan(Wait::Poll), words.clone(), task);
    let mut from_log = of(TaskOf::Log);
    assert!(from_log.run().is_equal());
    let commands = |replay: &Replay| replay.events.len();
    assert!(commands(&from_log) > 3);
    let mut from_code = of(TaskOf::Code(Box::new(streams)));
    assert_eq!(from_code.run(), from_log.run());
    assert_eq!(from_code.events, from_log.events);

    let other = |cycle: &Cycle, axes: &mut Axes<'_>| {
        if cycle.index == 900 {
            axes.command(0, to(31.0)).unwrap();
        }
    };
    let difference = of(TaskOf::Code(Box::new(other))).run().difference.unwrap();
    assert_eq!(difference.to_string(), "cycle 900: the in-loop task requests something else");
    let none = of(TaskOf::Nobody).run().difference.unwrap();
    assert_eq!(none.cycle, 900, "{none}");
}

#[test]
fn a_task_whose_commands_find_no_room_for_their_ends_is_repeated() {
    static REFUSED: AtomicU64 = AtomicU64::new(0);
    /// Each move replaces the one before, which is an event.
    fn hurries(cycle: &Cycle, axes: &mut Axes<'_>) {
        if cycle.index >= 900 {
            let refused = axes.command(0, to(30.0 + (cycle.index % 2) as f64)).is_err();
            REFUSED.fetch_add(refused.into(), Ordering::Relaxed);
        }
    }
    let refused = || REFUSED.swap(0, Ordering::Relaxed);
    // The application takes no events while its machine runs on.
    let words = recorded(Wait::Poll, Some(hurries), with_task);
    let of = |task| replay(plan(Wait::Poll), words.clone(), task).run();
    let recorded = refused();
    assert!((100..1_000).contains(&recorded), "{recorded}");
    let by_code = of(TaskOf::Code(Box::new(hurries)));
    assert!(by_code.is_equal(), "{by_code:?}");
    assert_eq!(refused(), recorded);
    assert_eq!(of(TaskOf::Log), by_code);
}

#[test]
fn a_task_that_panics_panics_again() {
    fn panics(cycle: &Cycle, _axes: &mut Axes<'_>) {
        assert!(cycle.index != 300, "on purpose");
    }
    let words = recorded(Wait::Poll, Some(panics), |sim| sim.run(600));
    let mut machine = replay(plan(Wait::Poll), words, TaskOf::Log);
    assert!(machine.run_until(|machine| machine.feedback(0).stopped.is_some()));
    assert_eq!((machine.cycle(), machine.feedback(0).stopped), (Some(300), Some(StopCause::Task)));
    assert!(machine.run().is_equal());
}

#[test]
fn a_run_is_repeated_up_to_a_cycle_and_looked_at_there() {
    let words = recorded(Wait::Poll, None, moves);
    let mut machine = replay(plan(Wait::Poll), words, TaskOf::Nobody).until(120);
    let verdict = machine.run();
    assert_eq!((verdict.last, verdict.is_equal()), (Some(120), true));
    assert!(!machine.step());
    assert!(machine.status().executed <= 121 && machine.status().online == DRIVES as u32);
}

#[test]
fn a_record_that_goes_on_after_the_end_of_the_repeated_run_is_not_equal() {
    let ended = recorded(Wait::Poll, None, |sim| {
        moves(sim);
        sim.stop();
        while sim.step() == Flow::Continue {}
    });
    assert!(verdict(ended.clone()).is_equal());
    let mut entries = entries(&ended);
    let last = *cycles(&entries).last().unwrap();
    // Behind the look at the wires, with which the loop has ended.
    entries.push((Head { kind: Kind::Cycle, looks: 1, bytes: 8, after_ns: 0 }, vec![last + 1]));
    let longer = words(&entries);
    let found = verdict(longer.clone());
    let other = found.other_inputs.clone().unwrap();
    assert_eq!((found.is_equal(), other.cycle), (false, last + 1), "{other}");
    // Up to there they are.
    assert!(replay(plan(Wait::Poll), longer, TaskOf::Nobody).until(last).run().is_equal());
}

#[test]
fn a_run_is_repeated_up_to_a_slot_that_was_passed_over() {
    let words = recorded(Wait::Poll, None, |sim| {
        sim.run(100);
        sim.world().delay_next_wake(10_200 * US);
        sim.run(100);
    });
    // Ten were passed over from about cycle 100 on.
    let mut machine = replay(plan(Wait::Poll), words, TaskOf::Nobody).until(104);
    let verdict = machine.run();
    assert!(verdict.is_equal() && verdict.last >= Some(104), "{verdict:?}");
    assert_eq!(machine.cycle(), verdict.last);
}
