//! Drives in turn on one half-duplex wire: from the last good exchange of one of them to the stop of all, and to the
//! next new telegram of each, by which its stop counts.

use fieldbeat::axis::{Command, Link, StopHow};
use fieldbeat::bus::profibus::ProfibusPlan;
use fieldbeat::internals::cycle::bound::stop_bound;
use fieldbeat::sim::profibus::ProfibusSegment;
use fieldbeat::sim::{Simulated, WorldOptions};
use fieldbeat::time::MS;
use fieldbeat::{CyclePlan, Master, Plan, Simulation, Time};

use crate::virtual_time::lenze::tap::TapWire;
use crate::virtual_time::lenze::turns::jog;
use crate::virtual_time::lenze::wire;

/// In a telegram of Data_Exchange with a parameter channel: the function code, the control word and the set point.
const AT_FC: usize = 6;
const AT_CONTROL: usize = 15;
const AT_SET_POINT: usize = 17;
/// Of a function code: its FCB counts.
const COUNTED: u8 = 1 << 4;
/// Control word: voltage, no quick stop, operation.
const RUNS: u16 = 0b1110;

/// Drives of one stop group, which turn.
struct Wire {
    sim: Simulation,
    taps: TapWire,
    plan: Plan,
    begin: Time,
    bus: ProfibusPlan,
}

impl Wire {
    fn new(rate: u32, divisors: &[u32], phase: u32, bucket: u32, how: StopHow) -> Wire {
        let mut bus = wire(rate, divisors.len());
        for (index, (drive, divisor)) in bus.drives.iter_mut().zip(divisors).enumerate() {
            let axis = &mut drive.axis;
            (axis.divisor, axis.phase) = (*divisor, (index as u32 + phase) % divisor);
            (axis.health.bucket, axis.stop.group, axis.stop.how) = (bucket, Some(1), how);
        }
        let cycle = CyclePlan { receive_deadline: 0.8, ..CyclePlan::default() };
        let plan = || Plan {
            source: None,
            cycle: cycle.clone(),
            buses: vec![Box::new(bus.clone())],
            groups: Vec::new(),
        };
        let mut segment = ProfibusSegment::of(&bus);
        segment.drives.iter_mut().for_each(|drive| drive.motor.ramps_s = (0.01, 0.01, 0.01));
        let taps = TapWire::new(segment);
        let simulated = Simulated { wires: vec![taps.wire()], ..Simulated::default() };
        let options = WorldOptions::default();
        // The first slot of the grid.
        let begin = options.start + options.read_ns + 2 * MS;
        let sim = Master::from_plan(plan()).simulate_with(simulated, options).unwrap();
        let mut wire = Wire { sim, taps, plan: plan(), begin, bus };
        wire.until(|sim, index| sim.feedback(index).link == Link::Online);
        wire
    }

    fn count(&self) -> usize {
        self.taps.drives.len()
    }

    fn until(&mut self, done: impl Fn(&Simulation, usize) -> bool) {
        let count = self.count();
        assert!(self.sim.run_until(20_000, |sim| (0..count).all(|index| done(sim, index))));
    }

    /// All turn.
    fn turn(&mut self) {
        for tap in &self.taps.drives {
            let mut tap = tap.lock();
            (tap.unplugged, tap.flaky) = (false, false);
        }
        self.until(|sim, index| sim.feedback(index).link == Link::Online);
        self.sim.run(200);
        for command in [Command::Reset, Command::Enable] {
            for index in 0..self.count() {
                self.sim.execute(index, command, 20_000).unwrap();
            }
        }
        for index in 0..self.count() {
            self.sim.axis(index).post(jog(8.0)).unwrap();
        }
        self.until(|sim, index| (sim.feedback(index).status.velocity - 8.0).abs() < 0.05);
        self.sim.run(50);
    }

    /// The first drive is flaky after so many cycles: the cycles from its last good exchange until each drive was sent
    /// its stop, and the next new telegram behind it.
    fn loses(&mut self, after: u64, flaky: bool) -> Vec<(u64, Option<u64>)> {
        self.turn();
        self.sim.run(after);
        for tap in &self.taps.drives {
            let mut tap = tap.lock();
            (tap.requests, tap.flaky) = (Some(Vec::new()), flaky);
        }
        self.taps.drives[0].lock().unplugged = true;
        let bound = self.bound();
        let mut last = 0;
        for turn in 0..bound + 40 {
            self.sim.run(1);
            let feedback = self.sim.feedback(0);
            if feedback.age == 0 || turn == 0 {
                last = feedback.cycle - u64::from(feedback.age);
            }
        }
        let line = self.bus.line();
        let reached = |index: usize| {
            let requests = self.taps.drives[index].lock().requests.take().unwrap_or_default();
            let exchanges: Vec<_> = requests.iter().filter(|(_, bytes)| bytes[4] & 0x80 == 0).collect();
            let first = exchanges.iter().position(|(_, bytes)| {
                let word = |at: usize| u16::from_be_bytes([bytes[at], bytes[at + 1]]);
                word(AT_CONTROL) & RUNS != RUNS || word(AT_SET_POINT) < self.cruise()
            });
            let first = first.unwrap_or_else(|| panic!("drive {index} was sent no stop"));
            let slot = |place: usize| {
                let (at, bytes) = exchanges[place];
                (*at - line.span_ns(bytes.len())).since(self.begin) / MS
            };
            let fc = |place: usize| exchanges[place].1[AT_FC];
            // One without a count of requests is new again, once it has failed.
            let tries = 1 + usize::from(self.bus.retries);
            let next = match fc(first) & COUNTED {
                0 => Some(first + tries).filter(|place| *place < exchanges.len()),
                _ => (first + 1..exchanges.len()).find(|place| fc(*place) != fc(first)),
            };
            (slot(first) - last, next.map(|place| slot(place) - last))
        };
        (0..self.count()).map(reached).collect()
    }

    /// The set point of a jog.
    fn cruise(&self) -> u16 {
        (8.0 * self.bus.drives[0].counts_per_velocity()).round() as u16
    }

    fn bound(&self) -> u64 {
        stop_bound(&self.plan, 0)
    }
}

/// What is sent and counts last, and what is stated, over all phases.
fn longest(rate: u32, divisors: &[u32], bucket: u32, how: StopHow, flaky: bool) -> (u64, u64) {
    let most = *divisors.iter().max().unwrap_or(&1);
    let (mut longest, mut bound) = (0, 0);
    for phase in 0..most {
        let mut wire = Wire::new(rate, divisors, phase, bucket, how);
        bound = wire.bound();
        for after in 0..u64::from(most) {
            for (index, (sent, counts)) in wire.loses(after, flaky).into_iter().enumerate() {
                // What the lost drive is sent is new to it.
                let cycles = if index == 0 { sent } else { counts.expect("it is sent more") };
                assert!(
                    sent <= cycles && cycles <= bound,
                    "{rate}, {divisors:?}, phase {phase}, {after} cycles later: the stop of drive {index} counts after \
                     {cycles} cycles, not {bound}"
                );
                longest = longest.max(cycles);
            }
        }
    }
    (longest, bound)
}

#[test]
fn a_stop_is_sent_and_counts_within_its_bound_in_every_phase_of_a_wire() {
    for (divisors, bucket, how) in [
        (&[1][..], 4, StopHow::Coast),
        (&[1, 1, 1], 1, StopHow::Quick),
        (&[1, 2, 4], 3, StopHow::Ramp),
        (&[3, 1], 2, StopHow::Quick),
    ] {
        let (longest, bound) = longest(12_000_000, divisors, bucket, how, bucket == 3);
        // A stop one cycle later would break it.
        assert_eq!(longest, bound, "{divisors:?}, bucket {bucket}: no stop came as late as its bound");
    }
}

/// Each bound has room for what happens at once only seldom: all repetitions of all drives, and Global_Control.
#[test]
fn turns_that_take_longer_than_a_cycle_hold_up_no_stop_beyond_its_bound() {
    for (divisors, bucket, how) in [(&[2, 2][..], 2, StopHow::Ramp), (&[3, 2], 1, StopHow::Quick)] {
        let (longest, bound) = longest(1_500_000, divisors, bucket, how, true);
        assert!(longest > u64::from(bucket * divisors[0]), "{divisors:?}: {longest}, {bound}");
    }
}
