//! The real-time-config channel of a LinUDP drive: its four bits of identity, in any weather.

use std::collections::HashMap;

use fieldbeat::axis::{CallError, Command, EventKind, Health, Link, NativeOwner};
use fieldbeat::bus::linudp::{MonitorPlan, Native, NativeOutput};
use fieldbeat::sim::FaultPlan;
use fieldbeat::time::MS;
use fieldbeat_core::axis::{Call, CallTicket};
use fieldbeat_linudp::upid::{Upid, call};
use fieldbeat_linudp::wire::{Refusal, RtcBlock, RtcCommand};

use crate::virtual_time::support::*;

/// Variables 1 and 2 of the command table, which nobody uses here, and two parameters.
const SCRATCH: [u16; 4] = [0x1E72, 0x1E73, 0x14BE, 0x14C0];

fn read(upid: u16) -> Call {
    call(RtcCommand::READ_RAM, upid, 0)
}

fn write(upid: u16, value: u32) -> Call {
    call(RtcCommand::WRITE_RAM, upid, value)
}

/// Links that are not lost by the losses of a test.
fn patient(rig: Rig) -> Rig {
    rig.each(|_, drive| drive.axis.health = Health { bucket: 100, leak: 1, gate: 2, ..Health::default() })
}

/// Calls back to back: posts, from `next`, as many as there is room for, and gives each end to `told`, for so many
/// turns.
fn keep_busy(
    b: &mut Bench,
    turns: u64,
    mut next: impl FnMut(usize) -> Call,
    mut reported: impl FnMut(usize, Call, Result<u64, CallError>),
) {
    let mut under_way: Vec<(usize, Call, CallTicket)> = Vec::new();
    for turn in 0.. {
        for index in 0..b.drives.len() {
            let mine = under_way.iter().filter(|(drive, ..)| *drive == index).count();
            for _ in mine..if turn < turns { 8 } else { 0 } {
                let call = next(index);
                let ticket = b.call(index, call);
                under_way.push((index, call, ticket));
            }
        }
        under_way.retain_mut(|(index, call, ticket)| match ticket.poll() {
            Some(end) => {
                reported(*index, *call, end.map(|answer| answer.value));
                false
            }
            None => true,
        });
        if turn >= turns && under_way.is_empty() {
            return;
        }
        b.step();
    }
}

#[test]
fn every_value_is_that_of_its_own_drive_and_parameter_under_random_faults() {
    for seed in 0..12 {
        let weather = FaultPlan {
            seed,
            drop: 0.05,
            duplicate: 0.03,
            delay: 0.05,
            delay_ns: MS,
            reorder: 0.02,
            ..FaultPlan::default()
        };
        let mut b = patient(Rig::new(4).faults(weather)).online();
        let value = |index: usize, upid: u16| (index as u64 + 1) << 16 | u64::from(upid);
        for index in 0..4 {
            for upid in SCRATCH {
                b.write(index, &format!("0x{upid:04X}"), value(index, upid)).unwrap();
            }
        }
        let (mut turn, mut done) = (0, HashMap::new());
        keep_busy(
            &mut b,
            2_000,
            |_| {
                turn += 1;
                read(SCRATCH[turn % SCRATCH.len()])
            },
            |index, call, end| match end {
                Ok(read) => {
                    assert_eq!(read, value(index, call.address as u16), "seed {seed}, drive {index}");
                    *done.entry(index).or_insert(0) += 1;
                }
                Err(why) => panic!("seed {seed}, drive {index}: {why}"),
            },
        );
        for index in 0..4 {
            assert!(done[&index] > 800, "seed {seed}: {} reads of drive {index}", done[&index]);
        }
    }
}

#[test]
fn an_answered_write_is_stored_in_the_drive() {
    for seed in 0..8 {
        let mut b =
            patient(Rig::new(2).faults(FaultPlan { seed, drop: 0.05, ..FaultPlan::default() })).online();
        let (mut number, mut last) = (0, [0; 2]);
        keep_busy(
            &mut b,
            1_000,
            |_| {
                number += 1;
                write(0x1E72, number)
            },
            |index, call, end| {
                assert_eq!(end, Ok(call.value), "seed {seed}");
                // In the order in which they were posted.
                assert!(call.value > last[index], "seed {seed}");
                last[index] = call.value;
            },
        );
        for (index, last) in last.into_iter().enumerate() {
            assert_eq!(b.read(index, "variable-1"), Ok(last), "seed {seed}");
        }
    }
}

#[test]
fn a_restart_ends_the_call_under_way_and_what_follows_is_of_the_new_life() {
    for at in 0..40 {
        let mut b = Rig::new(1).each(|_, drive| drive.simulate.config_time_ns = 10 * MS).online();
        b.write(0, "variable-1", 77).unwrap();
        let mut tickets: Vec<_> = (0..3).map(|_| b.call(0, read(0x1E72))).collect();
        b.run(at);
        b.world().restart(address(0));
        let ends: Vec<_> =
            tickets.iter_mut().map(|ticket| b.call_ended(ticket).map(|answer| answer.value)).collect();
        for end in &ends {
            assert!(matches!(end, Ok(77 | 0) | Err(CallError::Restarted)), "at {at}: {ends:?}");
        }
        // A second report proves the restart; what is under way then ends with it, too.
        let after = match b.read(0, "variable-1") {
            Err(CallError::Restarted) => b.read(0, "variable-1"),
            after => after,
        };
        assert_eq!(after, Ok(0), "at {at}: it was in RAM");
    }
}

#[test]
fn an_application_that_uses_the_channel_natively_ends_the_call_under_way() {
    let mut b = Rig::new(1).each(|_, drive| drive.simulate.config_time_ns = 50 * MS).ready();
    let mut native: Box<Native> = b.sim.axis(0).native().unwrap();
    b.post(0, Command::Native(NativeOwner::Master));
    b.run(5);
    let mut ticket = b.call(0, read(0x20A8));
    b.run(10);
    let block = RtcBlock::call(9, RtcCommand::READ_RAM, 0x20A9, 0);
    native.write(NativeOutput { config: Some(block), ..NativeOutput::default() }).unwrap();
    assert_eq!(b.call_ended(&mut ticket), Err(CallError::Native));
    assert_eq!(b.read(0, "0x20A8"), Ok(0x1E0F), "learned anew");
}

#[test]
fn monitored_variables_are_in_the_feedback_in_their_units_or_raw_and_a_refused_one_is_reported_once() {
    let sources = [Some(Upid(0x1E0E)), None, Some(Upid(0x1BCD)), Some(Upid(0x1E0F))];
    // One that the drive does not have, one of unknown meaning, and the temperature of the motor.
    let others = [Some(Upid(0x9999)), Some(Upid(0x1B8D)), Some(Upid(0x1BF3)), None];
    let mut b = Rig::new(2)
        .each(move |index, drive| drive.monitor = MonitorPlan::Sources([sources, others][index]))
        .ready();
    b.done(0, to(10.0));
    b.post(0, slowly_to(190.0));
    b.run(200);
    for _ in 0..50 {
        b.step();
        let feedback = b.feedback(0);
        let [position, none, temperature, velocity] = feedback.status.monitor;
        assert_eq!((position, none), (Some(feedback.status.demand), None));
        assert_eq!(temperature, Some(40.0));
        assert_near(velocity.unwrap(), feedback.status.velocity, 0.2);
        let shown = [None, Some(f64::from(0x8000_1B8D_u32)), Some(30.39), None];
        assert_eq!(b.feedback(1).status.monitor, shown);
    }
    let refused = |kind: &EventKind| match kind {
        EventKind::MonitorRefused { channel, status } => Some((*channel, *status)),
        _ => None,
    };
    let reported: Vec<_> = b.kinds(1).iter().filter_map(refused).collect();
    assert_eq!(reported, [(0, Refusal::OutOfRange.code().into())], "once");
    // A drive that was restarted has forgotten, and is written again.
    b.world().restart(address(0));
    b.until("it has forgotten", 200, |b| b.feedback(0).status.monitor == [None; 4]);
    b.until("it is written again", 2_000, |b| b.feedback(0).status.monitor[2] == Some(40.0));
    assert_eq!(b.feedback(0).link, Link::Online);
}

#[test]
fn any_monitored_variable_set_in_the_drive_is_shown_raw_and_kept() {
    let mut b = Rig::new(1).each(|_, drive| drive.monitor = MonitorPlan::AsSet).online();
    b.run(10);
    // The status word of a drive that is switched off, on its fourth channel by default.
    assert!(b.feedback(0).status.monitor[3].is_some_and(|word| word == word.trunc()));
    assert!(
        b.tape(0).received.iter().all(|received| received.request.config.is_none_or(|block| block.code == 0))
    );
}
