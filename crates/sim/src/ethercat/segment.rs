//! Slaves in order, and a frame on its way through them.

use std::ops::Range;

use super::chip::Passage;
use super::codec::frame::{DATAGRAMS_MAX, PASSED, SOURCE, datagrams};
use super::esc::Esc;
use super::topology::{Behind, Topology, Visit};
use fieldbeat_core::time::Time;

/// A segment of slaves. The master is at the first one; the last one turns the frames.
#[derive(Debug)]
pub struct Segment {
    slaves: Vec<Esc>,
    topology: Topology,
    /// The way of a frame.
    visits: Vec<Option<Visit>>,
    /// Outputs of slaves that are wired to the inputs of others: from, to.
    wires: Vec<(usize, usize)>,
    /// The offsets of the datagrams of the present frame.
    places: Vec<Range<usize>>,
}

impl Segment {
    /// A segment of these, all cables intact.
    pub fn new(slaves: Vec<Esc>) -> Segment {
        let mut segment = Segment {
            topology: Topology::line(slaves.iter().map(Esc::delay_ns).collect()),
            visits: Vec::new(),
            slaves,
            wires: Vec::new(),
            places: Vec::with_capacity(DATAGRAMS_MAX),
        };
        segment.link();
        segment
    }

    /// Cuts the cable in front of slave `n`, counted from 0, or repairs it. Frames turn at the slave before it; if
    /// there is none, no slave is reached.
    pub fn cut(&mut self, n: Option<usize>) {
        self.topology.cut = n;
        self.link();
    }

    /// Puts slave `n` behind another port than port 1 of the slave before it; false: a frame would come to it in
    /// another position, and nothing changes.
    pub fn put(&mut self, n: usize, behind: Behind) -> bool {
        let fits = n < self.slaves.len() && self.topology.put(n, behind);
        self.link();
        fits
    }

    /// Exchanges two slaves, each with everything that it is and has.
    pub fn exchange(&mut self, one: usize, other: usize) {
        if one.max(other) < self.slaves.len() {
            self.slaves.swap(one, other);
            self.link();
        }
    }

    /// Wires the outputs of slave `from` to the inputs of slave `to`.
    pub(super) fn wire(&mut self, from: usize, to: usize) {
        self.wires.push((from, to));
    }

    /// Copies outputs to the inputs that they are wired to.
    fn sense(&mut self) {
        for &(from, to) in &self.wires {
            if let Ok([output, input]) = self.slaves.get_disjoint_mut([from, to]) {
                input.sense(output.driven());
            }
        }
    }

    /// The slave `n`, counted from 0.
    pub fn slave(&mut self, n: usize) -> Option<&mut Esc> {
        self.slaves.get_mut(n)
    }

    /// The number of slaves.
    pub fn slaves(&self) -> usize {
        self.slaves.len()
    }

    /// The time of a frame through all slaves that it reaches and back to the master, ns.
    pub fn delay_ns(&self) -> u64 {
        self.topology.delay_ns()
    }

    /// A frame reaches a slave, and so comes back.
    pub fn is_reached(&self) -> bool {
        self.topology.reaches(0)
    }

    /// Advances all slaves to `now`, without a frame.
    pub fn advance(&mut self, now: Time) {
        self.slaves.iter_mut().for_each(|slave| slave.advance(now));
    }

    /// Carries a frame that the master sends at `now` through all slaves that it reaches, in place. Frames that are
    /// not EtherCAT stay as they are; datagrams after a broken one are not carried out.
    pub fn pass(&mut self, now: Time, frame: &mut [u8]) {
        self.sense();
        let Some(read) = datagrams(frame) else {
            self.advance(now);
            return;
        };
        self.places.clear();
        self.places.extend(read);
        if let Some(source) = frame.get_mut(SOURCE).filter(|_| self.topology.reaches(0)) {
            *source |= PASSED;
        }
        for (slave, visit) in self.slaves.iter_mut().zip(&self.visits) {
            match visit {
                None => slave.advance(now),
                Some(Visit { at, back }) => {
                    let passage =
                        Passage { at: now + *at, back: back.map(|back| back.map(|back| now + back)) };
                    slave.pass(passage, frame, &self.places);
                }
            }
        }
    }

    fn link(&mut self) {
        self.visits = self.topology.visits();
        for (n, slave) in self.slaves.iter_mut().enumerate() {
            slave.link(self.topology.links(n));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Settings;
    use super::super::codec::frame::Command::Lrw;
    use super::super::codec::registers::AlState;
    use super::super::tests::{Bench, logical};
    use crate::testing::hex;
    use fieldbeat_core::time::MS;

    fn pass(bench: &mut Bench, sent: &str) -> Vec<u8> {
        let mut frame = hex(sent);
        bench.segment.pass(bench.now, &mut frame);
        frame
    }

    #[test]
    fn a_cycle_of_two_drives_passes_byte_by_byte() {
        let mut bench = Bench::drives(|settings| {
            (settings.features, settings.clock_ns) = (0x018C, 5_123_456_789);
        });
        bench.scripts[0].script().inputs = hex("40E20100 06FF 3706");
        bench.scripts[1].script().inputs = hex("FFFFFFFF 0000 3306");
        bench.all_to(&[AlState::SafeOp, AlState::Op]);
        bench.send(logical(Lrw, 0x1_0000), &[0; 28]);
        let back = pass(
            &mut bench,
            "FFFFFFFFFFFF 101010101010 88A4 4A10 | 0E 42 0110 1009 0880 0000 0000000000000000 0000 | 0C 43 \
             00000100 1C80 0000 A0860100 0F00 6079FEFF 0700 00000000 0000 0000 00000000 0000 0000 0000 | 07 \
             44 0000 3001 0200 0000 0000 0000",
        );
        let answer = "FFFFFFFFFFFF 121010101010 88A4 4A10 | 0E 42 0110 1009 0880 0000 15BF613101000000 0200 \
             0C 43 00000100 1C80 0000 A0860100 0F00 6079FEFF 0700 40E20100 06FF 3706 FFFFFFFF 0000 3306 0600 \
             07 44 0200 3001 0200 0000 0800 0200";
        assert_eq!(back, hex(answer));
        let outputs = |n: usize| bench.scripts[n].script().cycles.last().unwrap().1.clone();
        assert_eq!([0, 1].map(outputs), [hex("A0860100 0F00"), hex("6079FEFF 0700")]);
    }

    #[test]
    fn a_sound_frame_is_answered_as_in_a_capture_and_another_stays_as_far_as_it_is_not() {
        let mut bench = Bench::new(vec![Settings::default()]);
        for (sent, back) in [
            (
                "FFFFFFFFFFFF 010101010101 88A4 0E10 07 04 0000 0000 0200 0000 0000 0000",
                "FFFFFFFFFFFF 030101010101 88A4 0E10 07 04 0100 0000 0200 0000 0402 0100",
            ),
            // One datagram is sound, and the one that it says follows it is not.
            (
                "FFFFFFFFFFFF 010101010101 88A4 1410 07 04 0000 0000 0280 0000 0000 0000 070500000000",
                "FFFFFFFFFFFF 030101010101 88A4 1410 07 04 0100 0000 0280 0000 0402 0100 070500000000",
            ),
        ] {
            assert_eq!(pass(&mut bench, sent), hex(back));
        }
        for other in [
            "FFFFFFFFFFFF 010101010101 0800 0E10 07 04 0000 0000 0200 0000 0000 0000",
            "FFFFFFFFFFFF 010101010101 88A4 0E40 07 04 0000 0000 0200 0000 0000 0000",
            "FFFFFFFFFFFF 010101010101 88A4 FF17 07 04 0000 0000 0200 0000 0000 0000",
            "FFFFFFFFFFFF",
            "",
        ] {
            assert_eq!(pass(&mut bench, other), hex(other));
        }
    }

    #[test]
    fn behind_a_cut_cable_the_watchdog_goes_on() {
        let mut bench = Bench::drives(|_| {});
        for n in 0..2 {
            bench.manage(n, 2, &[0x00, 0x11, 6, 0, 0x64, 0, 1, 0]);
        }
        bench.all_to(&[AlState::SafeOp, AlState::Op]);
        bench.segment.cut(Some(1));
        for _ in 0..200 {
            bench.wait(MS);
            assert_eq!(bench.send(logical(Lrw, 0x1_0000), &[7; 28]).1, 3);
        }
        let states = [0, 1].map(|n| bench.segment.slave(n).unwrap().state());
        assert_eq!(states, [AlState::Op, AlState::SafeOp]);
        assert_eq!(bench.scripts[1].script().requested.last(), Some(&AlState::SafeOp));
        assert!(bench.segment.slave(2).is_none());
    }
}
