//! What holds in every interleaving: of two writes and readers of a cell; of sets of setpoints that replace each other
//! while the loop takes them; of a loop that sends while its wires are taken; of applications that ring while the loop
//! takes their bells; of an application that posts, cancels and polls calls while the loop takes and ends them; and of
//! a log that is taken out while the loop fills it.

use std::time::Duration;

use fieldbeat_loom::axis::acyclic::{Acyclic, Answer, Call, CallError, CallTicket, Port};
use fieldbeat_loom::axis::cell::{Packed, Reader, cell};
use fieldbeat_loom::axis::command::{CommandId, Setpoint};
use fieldbeat_loom::axis::doorbell::Bells;
use fieldbeat_loom::axis::newest::{NewestOut, newest};
use fieldbeat_loom::calls;
use fieldbeat_loom::inputs::entry::Kind;
use fieldbeat_loom::inputs::recording::log;
use fieldbeat_loom::rt::{Regions, Taker, Wires};
use loom::sync::Arc;
use loom::sync::atomic::{AtomicU64, Ordering};
use loom::thread;

/// As many words as it takes to be torn.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Pair([u64; 2]);

impl Packed for Pair {
    type Words = [u64; 2];
    fn pack(&self) -> [u64; 2] {
        self.0
    }
    fn unpack(words: &[u64; 2]) -> Pair {
        Pair(*words)
    }
}

fn whole(reader: &Reader<Pair>) -> u64 {
    let Pair([first, second]) = reader.read();
    assert_eq!(first, second, "torn");
    first
}

/// All interleavings with at most so many switches away from a thread that could go on.
fn bounded(switches: usize, model: impl Fn() + Sync + Send + 'static) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(switches);
    builder.check(model);
}

#[test]
fn a_reader_of_two_writes_sees_a_whole_value() {
    loom::model(|| {
        let (mut writer, reader) = cell(Pair([0; 2]));
        let other = thread::spawn(move || whole(&reader));
        for value in 1..=2 {
            writer.write(&Pair([value; 2]));
        }
        assert!(other.join().unwrap() <= 2);
    });
}

#[test]
fn a_reader_never_sees_an_older_value_than_before() {
    bounded(3, || {
        let (mut writer, reader) = cell(Pair([0; 2]));
        let other = thread::spawn(move || {
            let first = whole(&reader);
            assert!(whole(&reader) >= first, "went back");
        });
        for value in 1..=2 {
            writer.write(&Pair([value; 2]));
        }
        other.join().unwrap();
    });
}

/// Set `number` of a group of two.
fn set(number: u64) -> [Setpoint; 2] {
    [0, 1].map(|member| Setpoint { member, parts: 2, number, of: CommandId(number), value: number as f64 })
}

#[test]
fn the_setpoints_of_a_group_are_taken_whole_in_their_order_and_the_last_ones_once() {
    bounded(3, || {
        let (mut input, mut output) = newest(2);
        let application = thread::spawn(move || (1..=3).for_each(|number| input.write(&set(number))));
        let mut before = 0;
        let mut look = |output: &mut NewestOut| {
            if output.take() {
                let parts = [0, 1].map(|place| output.part(place).unwrap());
                let number = parts[0].number;
                assert!(number > before && parts == set(number), "{parts:?} after {before}");
                before = number;
            }
        };
        look(&mut output);
        look(&mut output);
        application.join().unwrap();
        look(&mut output);
        assert_eq!(before, 3, "the newest is never lost");
        assert!(!output.take());
    });
}

/// What the drive is sent: the newest request of all.
const REQUEST: u64 = 1;
const STOP: u64 = 2;

#[test]
fn a_stop_follows_every_send_of_a_loop_whose_wires_were_taken() {
    loom::model(|| {
        let wires = Wires::default();
        // Nothing but the word orders what both hand to the kernel.
        let wire = Arc::new(AtomicU64::new(0));
        let watch = {
            let (wires, wire) = (wires.clone(), Arc::clone(&wire));
            thread::spawn(move || {
                if !wires.take(Taker::Watch) {
                    return false;
                }
                while !wires.gave_way() {
                    thread::yield_now();
                }
                wire.store(STOP, Ordering::Relaxed);
                true
            })
        };
        let mut taken = false;
        for _ in 0..2 {
            taken = wires.are_taken();
            if taken {
                break;
            }
            wire.store(REQUEST, Ordering::Relaxed);
        }
        if taken || !wires.end() {
            wires.give_way();
        }
        let stopped = watch.join().unwrap();
        let newest = wire.load(Ordering::Relaxed);
        assert_eq!(newest, if stopped { STOP } else { REQUEST });
        assert_eq!((wires.is_stuck(), wires.have_ended()), (stopped, !stopped));
    });
}

#[test]
fn the_wires_have_one_taker_in_the_end_who_knows_that_the_loop_gave_way() {
    loom::model(|| {
        let wires = Wires::default();
        let takers = [Taker::Watch, Taker::Guardian].map(|taker| {
            let wires = wires.clone();
            thread::spawn(move || wires.take(taker))
        });
        if wires.are_taken() || !wires.end() {
            wires.give_way();
        }
        let [watch, guardian] = takers.map(|taker| taker.join().unwrap());
        match wires.taker() {
            // The guardian takes them from the watch, never the other way round.
            Some(taker) => {
                assert_eq!(taker, if guardian { Taker::Guardian } else { Taker::Watch });
                assert!(wires.gave_way() && (watch || guardian) && !wires.have_ended());
                assert!(guardian != wires.set_ended(Taker::Watch));
                assert!(!guardian || wires.set_ended(Taker::Guardian));
            }
            None => assert!(!watch && !guardian),
        }
        assert!(wires.have_ended());
    });
}

/// What two applications put into the queues of their axes, once or twice, before they ring: nothing else orders it.
fn given(axes: usize) -> Arc<Vec<AtomicU64>> {
    Arc::new((0..axes).map(|_| AtomicU64::new(0)).collect())
}

#[test]
fn values_set_before_a_bell_are_seen_after_it_and_no_bell_is_lost() {
    bounded(3, || {
        let mut bells = Bells::new(2);
        let queues = given(2);
        let ring = |axis: usize, times: u64| {
            let (bell, queues) = (bells.bell(axis), Arc::clone(&queues));
            thread::spawn(move || {
                for value in 1..=times {
                    queues[axis].store(value, Ordering::Relaxed);
                    bell.ring();
                }
            })
        };
        let applications = [ring(0, 2), ring(1, 1)];
        let mut seen = [0; 2];
        let look = |bells: &mut Bells, seen: &mut [u64; 2]| {
            if bells.take() {
                for axis in bells.rung() {
                    let value = queues[axis].load(Ordering::Relaxed);
                    assert!(value > 0 && value >= seen[axis], "axis {axis} rang for {value}");
                    seen[axis] = value;
                }
                // Their queues are empty now.
                bells.silence(|_| false);
            }
        };
        look(&mut bells, &mut seen);
        for application in applications {
            application.join().unwrap();
        }
        look(&mut bells, &mut seen);
        assert_eq!(seen, [2, 1], "all of it was seen, and looked for only where it rang");
    });
}

fn post(acyclic: &Acyclic, value: u64) -> CallTicket {
    acyclic.post(Call { value, ..Call::default() }, Duration::ZERO).expect("there is room")
}

fn end(ticket: &mut CallTicket) -> Result<u64, CallError> {
    loop {
        match ticket.poll() {
            Some(end) => return end.map(|answer| answer.value),
            None => thread::yield_now(),
        }
    }
}

/// The loop, for so many calls: what it took is answered by its own value.
fn serve(port: &mut Port, calls: usize) {
    let mut ended = 0;
    while ended < calls {
        match port.take() {
            Some(posted) => {
                port.end(&posted, Ok(Answer { value: posted.call.value, ..Answer::default() }));
                ended += 1;
            }
            None => thread::yield_now(),
        }
    }
}

#[test]
fn each_ticket_of_two_threads_gets_its_own_end() {
    bounded(3, || {
        let (acyclic, mut port) = calls(2);
        let other = {
            let acyclic = acyclic.clone();
            thread::spawn(move || post(&acyclic, 1))
        };
        let executor = thread::spawn(move || {
            let mut ended = 0;
            while ended < 2
                && let Some(posted) = port.take()
            {
                port.end(&posted, Ok(Answer { value: posted.call.value, ..Answer::default() }));
                ended += 1;
            }
            (port, ended)
        });
        let mut own = post(&acyclic, 2);
        let early = own.poll();
        let mut others = other.join().unwrap();
        let (mut port, ended) = executor.join().unwrap();
        serve(&mut port, 2 - ended);
        let own = early.or_else(|| own.poll()).expect("it has ended").map(|answer| answer.value);
        assert_eq!((own, end(&mut others)), (Ok(2), Ok(1)));
        // The room of both is free again.
        drop([post(&acyclic, 3), post(&acyclic, 4)]);
    });
}

#[test]
fn a_ticket_that_is_dropped_at_any_moment_leaves_its_room() {
    loom::model(|| {
        let (acyclic, mut port) = calls(1);
        let ticket = post(&acyclic, 1);
        let executor = thread::spawn(move || {
            if let Some(posted) = port.take() {
                port.end(&posted, Ok(Answer::default()));
            }
            port
        });
        drop(ticket);
        let mut port = executor.join().unwrap();
        // Taken, or ended as cancelled.
        assert_eq!(port.take(), None);
        let mut next = post(&acyclic, 2);
        serve(&mut port, 1);
        assert_eq!(end(&mut next), Ok(2), "the earlier cancel is not of this one");
    });
}

#[test]
fn a_call_that_is_cancelled_while_it_is_taken_ends_once() {
    loom::model(|| {
        let (acyclic, mut port) = calls(1);
        let mut ticket = post(&acyclic, 1);
        let executor = thread::spawn(move || {
            if let Some(posted) = port.take() {
                let result = if port.is_cancelled(&posted) {
                    Err(CallError::Cancelled)
                } else {
                    Ok(Answer::default())
                };
                port.end(&posted, result);
            }
            port
        });
        ticket.cancel();
        let result = end(&mut ticket);
        assert!(matches!(result, Ok(0) | Err(CallError::Cancelled)), "{result:?}");
        assert_eq!(ticket.poll(), None);
        drop(executor.join().unwrap());
    });
}

#[test]
fn a_command_that_ended_before_the_master_keeps_its_outcome() {
    loom::model(|| {
        let (acyclic, mut port) = calls(1);
        let mut ticket = post(&acyclic, 7);
        let executor = thread::spawn(move || serve(&mut port, 1));
        // The port is gone behind its last end.
        assert_eq!(end(&mut ticket), Ok(7));
        executor.join().unwrap();
        assert!(acyclic.post(Call::default(), Duration::ZERO).is_err());
    });
}

/// With room for two cycles, so that the third one goes to the place of the first one, or ends the log.
#[test]
fn a_log_is_taken_out_in_whole_cycles_and_says_with_which_one_it_ends() {
    bounded(3, || {
        let (recording, mut reader) = log(4, &mut Regions::new());
        let other = thread::spawn(move || {
            let mut words = Vec::new();
            let goes_on = reader.take(&mut words) && reader.take(&mut words);
            (reader, words, goes_on)
        });
        for cycle in 1..=3 {
            recording.cycle(cycle);
            if cycle == 1 {
                let mark = recording.mark();
                recording.entry(Kind::Clock, &[], &[]);
                recording.go_back(mark);
            }
            recording.publish();
        }
        recording.end();
        let (mut reader, mut words, goes_on) = other.join().unwrap();
        let before = words.len();
        assert!(!reader.take(&mut words), "it is over");
        assert!(goes_on || words.len() == before, "more came after its end");
        let cycles = words.chunks_exact(2).map(|entry| entry[1]);
        assert_eq!(
            (words.len() % 2, cycles.collect::<Vec<_>>()),
            (0, (1..reader.ended_at().unwrap_or(4)).collect())
        );
    });
}
