//! Acyclic access: a posted call ends, and the cycle goes on as without one.

use std::time::Duration;

use fieldbeat::axis::{CallError, Link};
use fieldbeat_core::axis::{Answer, Call, CallTicket, PostError};

use crate::conformance::machine::Machine;
use crate::conformance::subject::Subject;

/// Longer than any call of a subject takes.
const LIMIT: Duration = Duration::from_secs(1);

pub fn post(m: &mut Machine, index: usize, call: Call) -> CallTicket {
    m.sim.axis(index).acyclic().post(call, LIMIT).expect("there is room")
}

pub fn end(m: &mut Machine, ticket: &mut CallTicket, most: u64) -> Result<Answer, CallError> {
    for _ in 0..most {
        if let Some(result) = ticket.poll() {
            return result;
        }
        m.step();
    }
    panic!("a call has not ended within {most} cycles");
}

pub fn a_value_that_was_written_is_read_back(subject: &'static dyn Subject) {
    let soon = subject.calls().soon;
    let mut m = Machine::new(subject, 2, |_, _| ());
    m.online();
    let calls = subject.calls();
    let mut ticket = post(&mut m, 0, calls.read);
    let before = end(&mut m, &mut ticket, soon).unwrap();
    assert_eq!(ticket.poll(), None, "reported once");
    assert_ne!(before.value, calls.write.value);
    let mut ticket = post(&mut m, 0, calls.write);
    end(&mut m, &mut ticket, soon).unwrap();
    let mut tickets = [post(&mut m, 0, calls.read), post(&mut m, 1, calls.read)];
    let values = tickets.each_mut().map(|ticket| end(&mut m, ticket, soon).unwrap().value);
    assert_eq!(values, [calls.write.value, before.value], "each drive its own");
}

pub fn a_call_refused_by_the_drive_ends_with_its_status(subject: &'static dyn Subject) {
    let soon = subject.calls().soon;
    let mut m = Machine::new(subject, 1, |_, _| ());
    m.online();
    let (call, status) = subject.calls().refused;
    let mut ticket = post(&mut m, 0, call);
    assert_eq!(end(&mut m, &mut ticket, soon), Err(CallError::Refused(status)));
    let mut ticket = post(&mut m, 0, subject.calls().read);
    assert!(end(&mut m, &mut ticket, soon).is_ok(), "and the next one goes on");
}

pub fn the_first_that_fails_ends_its_series(subject: &'static dyn Subject) {
    let soon = subject.calls().soon;
    let mut m = Machine::new(subject, 1, |_, _| ());
    m.online();
    let (calls, refused) = (subject.calls(), subject.calls().refused);
    let series = [calls.read, refused.0, calls.write, calls.write];
    let mut tickets = m.sim.axis(0).acyclic().post_series(&series, LIMIT).unwrap();
    tickets.push(post(&mut m, 0, calls.read));
    let ends: Vec<_> = tickets.iter_mut().map(|ticket| end(&mut m, ticket, soon)).collect();
    assert_eq!(
        ends[1..4],
        [Err(CallError::Refused(refused.1)), Err(CallError::Skipped), Err(CallError::Skipped)]
    );
    // What was skipped was not written, and what came behind it was done.
    assert_eq!(ends[4], ends[0]);
}

pub fn a_missing_drive_is_reported_at_once(subject: &'static dyn Subject) {
    let soon = subject.calls().soon;
    let mut m = Machine::new(subject, 2, |_, _| ());
    m.plug(0, false);
    m.until("the other is online", 2_000, |m| m.feedback(1).link == Link::Online);
    let calls = subject.calls();
    let mut ticket = post(&mut m, 0, calls.read);
    // An absent drive gets a request every 100 cycles only.
    assert_eq!(end(&mut m, &mut ticket, 2 * soon), Err(CallError::NotOnline));
    let mut ticket = post(&mut m, 1, calls.read);
    assert_eq!(end(&mut m, &mut ticket, soon).err(), None);
    // Lost in the middle of it.
    m.plug(1, false);
    let mut tickets: Vec<_> = (0..4).map(|_| post(&mut m, 1, calls.read)).collect();
    // A session takes the silence of its drive for the end of its connection only after some requests.
    let (most, tries) = if m.can.sessions { (30 * soon, 4) } else { (3 * soon, 1) };
    for ticket in &mut tickets {
        // One or two may have been answered by what was still under way.
        let _ = end(&mut m, ticket, most);
    }
    let is_known = (0..tries).any(|_| {
        let mut ticket = post(&mut m, 1, calls.read);
        end(&mut m, &mut ticket, most) == Err(CallError::NotOnline)
    });
    assert!(is_known, "it is not online");
    m.plug(1, true);
    m.until("it is back", if m.can.sessions { 40_000 } else { 2_000 }, |m| {
        m.feedback(1).link == Link::Online
    });
    let mut ticket = post(&mut m, 1, calls.read);
    assert_eq!(end(&mut m, &mut ticket, soon).err(), None);
}

pub fn the_queue_is_bounded_and_nothing_in_it_is_lost(subject: &'static dyn Subject) {
    let soon = subject.calls().soon;
    let mut m = Machine::new(subject, 1, |_, drive| drive.axis.parameter_queue = 5);
    m.online();
    let read = subject.calls().read;
    let acyclic = m.sim.axis(0).acyclic().clone();
    let mut tickets: Vec<_> = (0..5).map(|_| post(&mut m, 0, read)).collect();
    let full = acyclic.post(read, LIMIT).unwrap_err();
    assert!(matches!(&full, PostError::Full { capacity: 5, .. }), "{full}");
    assert!(matches!(acyclic.post_series(&[read; 6], LIMIT), Err(PostError::Full { .. })));
    for ticket in &mut tickets {
        end(&mut m, ticket, soon).unwrap();
    }
    // Room again, for all of them.
    let mut tickets = acyclic.post_series(&[read; 5], LIMIT).unwrap();
    for ticket in &mut tickets {
        end(&mut m, ticket, soon).unwrap();
    }
}

pub fn a_cancelled_call_ends_as_cancelled_and_frees_the_queue(subject: &'static dyn Subject) {
    let soon = subject.calls().soon;
    let mut m = Machine::new(subject, 1, |_, drive| drive.axis.parameter_queue = 4);
    m.online();
    let calls = subject.calls();
    let mut first = post(&mut m, 0, calls.read);
    let before = end(&mut m, &mut first, soon).unwrap();
    let mut cancelled = post(&mut m, 0, calls.write);
    cancelled.cancel();
    let mut behind = post(&mut m, 0, calls.read);
    assert_eq!(end(&mut m, &mut cancelled, soon), Err(CallError::Cancelled));
    assert_eq!(end(&mut m, &mut behind, soon), Ok(before), "it had not gone out");
    // A ticket that is dropped takes its call along, and leaves its room.
    for _ in 0..20 {
        drop(post(&mut m, 0, calls.write));
        let mut behind = post(&mut m, 0, calls.read);
        assert_eq!(end(&mut m, &mut behind, soon), Ok(before));
    }
}

pub fn calls_add_no_request_and_move_no_cycle(subject: &'static dyn Subject) {
    let sent = |busy: bool| {
        let mut m = Machine::new(subject, 2, |_, _| ());
        m.online();
        let begun = m.sim.status().executed;
        let mut tickets: Vec<CallTicket> = Vec::new();
        let mut ended = 0_u64;
        for _ in 0..500 {
            tickets.retain_mut(|ticket| match ticket.poll() {
                Some(result) => {
                    ended += u64::from(result.is_ok());
                    false
                }
                None => true,
            });
            while busy && tickets.len() < 10 {
                tickets.push(post(&mut m, 0, subject.calls().read));
            }
            m.step();
        }
        assert!(!busy || ended > 5_000 / subject.calls().soon, "{ended} calls in 500 cycles");
        assert_eq!(m.sim.status().executed - begun, 500);
        drop(tickets);
        let numbers = m.sim.finish();
        assert_eq!(numbers.status.skipped, 0);
        numbers.drives.iter().map(|drive| (drive.counters.sent, drive.counters.missed)).collect::<Vec<_>>()
    };
    assert_eq!(sent(true), sent(false));
}

pub fn the_end_of_the_master_ends_what_is_under_way(subject: &'static dyn Subject) {
    let mut m = Machine::new(subject, 1, |_, _| ());
    m.online();
    let acyclic = m.sim.axis(0).acyclic().clone();
    let mut ticket = post(&mut m, 0, subject.calls().read);
    drop(m);
    assert_eq!(ticket.poll(), Some(Err(CallError::Gone)));
    assert!(matches!(acyclic.post(subject.calls().read, LIMIT), Err(PostError::Gone { .. })));
}
