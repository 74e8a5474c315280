//! Drives in turn on one half-duplex wire: from the last good exchange of one of them to the stop of all, and to the
//! next new telegram of each, by which its stop counts.

use std::collections::BTreeSet;

use fieldbeat::axis::{Command, StopHow};
use fieldbeat::bus::profibus::{ParameterPath, ProfibusPlan};
use fieldbeat::sim::WorldOptions;
use fieldbeat::time::{MS, Time};
use fieldbeat_core::cycle::bound::stop_bound;
use fieldbeat_sim::profibus::ProfibusSegment;

use crate::virtual_time::lenze::tap::TapWire;
use crate::virtual_time::lenze::turns::jog;
use crate::virtual_time::lenze::{Lenze, cycle, wire};

/// In a telegram of Data_Exchange: the function code, and the data; control word and set point are the first of their
/// process data.
const AT_FC: usize = 6;
const AT_DATA: usize = 7;
/// Of a function code: its FCB counts.
const COUNTED: u8 = 1 << 4;
/// Control word: voltage, no quick stop, operation.
const RUNS: u16 = 0b1110;

/// What happens to the lost drive, and to the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Loss {
    /// It is silent.
    Unplugged,
    /// It is silent, and of each two answers of the others one is lost.
    Flaky,
    /// All answer as late as they may; its answers are all broken, and those of the others but for the last try.
    Slow,
}

/// A wire, and what it loses.
#[derive(Clone, Copy, Debug)]
struct Shape {
    rate: u32,
    /// Three words of process data and no parameter channel, so that an answer comes in the window of its request.
    short: bool,
    /// Divisor and phase of each drive.
    slots: &'static [(u32, u32)],
    bucket: u32,
    how: StopHow,
    /// They are one stop group.
    together: bool,
    lost: usize,
    loss: Loss,
}

/// Drives which turn.
struct Wire {
    m: Lenze,
    taps: TapWire,
    begin: Time,
    bus: ProfibusPlan,
    shape: Shape,
}

impl Wire {
    fn new(shape: Shape) -> Wire {
        let mut bus = wire(shape.rate, shape.slots.len());
        bus.gap = None;
        for (drive, slots) in bus.drives.iter_mut().zip(shape.slots) {
            let axis = &mut drive.axis;
            (axis.divisor, axis.phase) = *slots;
            (axis.health.bucket, axis.stop.how) = (shape.bucket, shape.how);
            axis.stop.group = shape.together.then_some(1);
            if shape.short {
                (drive.channel, drive.parameters, drive.configuration) =
                    (false, ParameterPath::None, vec![0xF2]);
                drive.extended_diagnosis = 0;
            }
        }
        let mut segment = ProfibusSegment::of(&bus);
        segment.drives.iter_mut().for_each(|drive| drive.motor.ramps_s = (0.01, 0.01, 0.01));
        let taps = TapWire::new(segment);
        let options = WorldOptions::default();
        // The first slot of the grid.
        let begin = options.start + options.read_ns + 2 * MS;
        let mut m = Lenze::on(bus.clone(), cycle(), taps.wire());
        m.online();
        Wire { m, taps, begin, bus, shape }
    }

    fn count(&self) -> usize {
        self.taps.drives.len()
    }

    /// All turn.
    fn turn(&mut self) {
        for tap in &self.taps.drives {
            let mut tap = tap.lock();
            (tap.unplugged, tap.flaky, tap.slow) = (false, false, None);
        }
        self.m.online();
        self.m.sim.run(200);
        for command in [Command::Reset, Command::Enable] {
            for index in 0..self.count() {
                self.m.sim.execute(index, command, 20_000).unwrap();
            }
        }
        let count = self.count();
        (0..count).for_each(|index| self.m.post(index, jog(8.0)));
        self.m.until("their velocity", 20_000, |sim| {
            (0..count).all(|index| (sim.feedback(index).status.velocity - 8.0).abs() < 0.05)
        });
        self.m.sim.run(50);
    }

    /// A drive is lost after so many cycles: the cycles from its last good exchange until each drive that stops with it
    /// was sent its stop, and until that counts: with the next new telegram, but for the lost drive, to which it is
    /// new in any case.
    fn loses(&mut self, after: u64) -> Vec<(u64, u64)> {
        self.turn();
        self.m.sim.run(after);
        let Shape { lost, loss, together, .. } = self.shape;
        for (index, tap) in self.taps.drives.iter().enumerate() {
            let mut tap = tap.lock();
            tap.requests = Some(Vec::new());
            match loss {
                Loss::Slow => tap.slow = Some(if index == lost { u8::MAX } else { self.bus.retries }),
                _ => (tap.unplugged, tap.flaky) = (index == lost, loss == Loss::Flaky),
            }
        }
        let mut last = 0;
        for turn in 0..self.bound() + 40 {
            self.m.sim.run(1);
            let feedback = self.m.feedback(lost);
            if feedback.age == 0 || turn == 0 {
                last = feedback.cycle - u64::from(feedback.age);
            }
        }
        let line = self.bus.line();
        let reached = |index: usize| {
            let requests = self.taps.drives[index].lock().requests.take().unwrap_or_default();
            let exchanges: Vec<_> = requests.iter().filter(|(_, bytes)| bytes[4] & 0x80 == 0).collect();
            let first = exchanges.iter().position(|(_, bytes)| {
                let at = AT_DATA + self.bus.drives[index].process_at();
                let word = |at: usize| u16::from_be_bytes([bytes[at], bytes[at + 1]]);
                word(at) & RUNS != RUNS || word(at + 2) < self.cruise()
            });
            let first = first.unwrap_or_else(|| panic!("drive {index} was sent no stop"));
            let slot = |place: usize| {
                let (at, bytes) = exchanges[place];
                (*at - line.span_ns(bytes.len())).since(self.begin) / MS
            };
            let sent = slot(first) - last;
            if index == lost {
                return (sent, sent);
            }
            let fc = |place: usize| exchanges[place].1[AT_FC];
            // One without a count of requests is new again, once it has failed.
            let tries = 1 + usize::from(self.bus.retries);
            let next = match fc(first) & COUNTED {
                0 => Some(first + tries).filter(|place| *place < exchanges.len()),
                _ => (first + 1..exchanges.len()).find(|place| fc(*place) != fc(first)),
            };
            (sent, slot(next.expect("it is sent more")) - last)
        };
        (0..self.count()).filter(|index| *index == lost || together).map(reached).collect()
    }

    /// The set point of a jog.
    fn cruise(&self) -> u16 {
        (8.0 * self.bus.drives[0].counts_per_velocity()).round() as u16
    }

    fn bound(&self) -> u64 {
        stop_bound(self.m.sim.plan(), self.shape.lost)
    }
}

/// What is sent and counts last, and what is stated, in every phase of the wire.
fn longest(shape: Shape) -> (u64, u64) {
    let mut wire = Wire::new(shape);
    let bound = wire.bound();
    // The phases come around within the product of their divisors.
    let around: u32 =
        shape.slots.iter().map(|(divisor, _)| *divisor).collect::<BTreeSet<_>>().iter().product();
    let mut longest = 0;
    for after in 0..u64::from(around) {
        for (sent, counts) in wire.loses(after) {
            assert!(
                sent <= counts && counts <= bound,
                "{shape:?}, {after} cycles later: a stop counts after {counts} cycles, not {bound}"
            );
            longest = longest.max(counts);
        }
    }
    (longest, bound)
}

/// Drives of one stop group, the first of which is lost.
fn group(rate: u32, slots: &'static [(u32, u32)], bucket: u32, how: StopHow, loss: Loss) -> Shape {
    Shape { rate, short: false, slots, bucket, how, together: true, lost: 0, loss }
}

/// Two misses of one of these drives, with all repetitions of all of them.
fn slow(rate: u32, slots: &'static [(u32, u32)], lost: usize) -> Shape {
    Shape { together: false, lost, ..group(rate, slots, 2, StopHow::Quick, Loss::Slow) }
}

#[test]
fn a_stop_is_sent_and_counts_within_its_bound_in_every_phase_of_a_wire() {
    for shape in [
        group(12_000_000, &[(1, 0)], 4, StopHow::Coast, Loss::Unplugged),
        group(12_000_000, &[(1, 0), (1, 0), (1, 0)], 1, StopHow::Quick, Loss::Unplugged),
        group(12_000_000, &[(1, 0), (2, 1), (4, 2)], 3, StopHow::Ramp, Loss::Flaky),
        group(12_000_000, &[(3, 0), (1, 0)], 2, StopHow::Quick, Loss::Unplugged),
    ] {
        let (longest, bound) = longest(shape);
        // A stop one cycle later would break it.
        assert_eq!(longest, bound, "{shape:?}: no stop came as late as its bound");
    }
}

#[test]
fn turns_of_all_repetitions_of_all_drives_reach_the_bound() {
    const TWO: &[(u32, u32)] = &[(2, 0), (2, 0)];
    const FOUR: &[(u32, u32)] = &[(2, 0), (2, 0), (2, 0), (2, 0)];
    const EACH: &[(u32, u32)] = &[(1, 0), (1, 0), (1, 0), (1, 0)];
    for shape in [
        Shape { short: true, ..slow(500_000, &[(3, 0)], 0) },
        slow(1_500_000, &[(1, 0)], 0),
        slow(1_500_000, &[(3, 0), (3, 0)], 1),
        Shape { short: true, ..slow(1_500_000, TWO, 1) },
        Shape { short: true, together: true, ..slow(1_500_000, TWO, 0) },
        slow(12_000_000, &[(1, 0)], 0),
        slow(12_000_000, FOUR, 3),
        Shape { together: true, ..slow(12_000_000, FOUR, 0) },
        Shape { bucket: 1, ..slow(12_000_000, EACH, 3) },
    ] {
        let (longest, bound) = longest(shape);
        assert_eq!(longest, bound, "{shape:?}: no stop came as late as its bound");
    }
}

/// A bound has room for what does not come together on these wires:
///
/// - At 500 kbit/s the last good exchange behind another drive ends a cycle later itself.
/// - The turn of the lost drive, which has its stop, is ahead of those of its group only in part.
/// - Where the repetitions of all drives take longer than from slot to slot, a drive that was last has its next turn
///   first. So the turns of a group, or of a drive after a second miss, are not all of them the longest ones.
/// - Without broken answers turns are shorter.
#[test]
fn no_stop_is_later_than_its_bound_where_that_is_not_reached() {
    const TWO: &[(u32, u32)] = &[(5, 0), (5, 0)];
    const FOUR: &[(u32, u32)] = &[(1, 0), (1, 0), (1, 0), (1, 0)];
    for (shape, room) in [
        (Shape { short: true, ..slow(500_000, TWO, 1) }, 1),
        (Shape { short: true, together: true, ..slow(500_000, TWO, 0) }, 2),
        (Shape { together: true, ..slow(1_500_000, &[(3, 0), (3, 0)], 0) }, 1),
        (slow(12_000_000, FOUR, 3), 1),
        (Shape { together: true, ..slow(12_000_000, FOUR, 3) }, 2),
        (group(1_500_000, &[(2, 0), (2, 1)], 2, StopHow::Ramp, Loss::Flaky), 9),
        (group(1_500_000, &[(3, 0), (2, 1)], 1, StopHow::Quick, Loss::Flaky), 7),
    ] {
        let (longest, bound) = longest(shape);
        assert_eq!(longest + room, bound, "{shape:?}");
    }
}
