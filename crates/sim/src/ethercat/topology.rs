//! The cables of a segment: which port a slave is behind, and when a frame is at each port.
//!
//! A frame enters a slave at port 0, is processed, goes out at port 3, then 1, then 2, and back at port 0; positions
//! count in that order (ETG.1000.4, 4.8). A slave is behind port 1 of the one before it unless it says otherwise.

/// The ports in the order in which a frame leaves by them.
const ORDER: [usize; 3] = [3, 1, 2];

/// The slave in front of another one, and the port there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Behind {
    /// The position.
    pub place: u16,
    /// The port, 1 ... 3.
    pub port: u8,
}

/// When a frame is at a slave, ns after it left the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Visit {
    /// At port 0, on its way out.
    pub(super) at: u64,
    /// Back at each port; `None`: nothing is there. That of port 0 is never one.
    pub(super) back: [Option<u64>; 4],
}

/// The cables of so many slaves.
#[derive(Debug)]
pub(super) struct Topology {
    /// The slave in front of each slave, and the port there; `None`: the master.
    front: Vec<Option<(usize, usize)>>,
    /// The delay of the cable in front of each slave, each way.
    delays: Vec<u64>,
    pub(super) cut: Option<usize>,
}

impl Topology {
    /// A line of slaves with these delays.
    pub(super) fn line(delays: Vec<u64>) -> Topology {
        let front = (0..delays.len()).map(|n: usize| n.checked_sub(1).map(|before| (before, 1))).collect();
        Topology { front, delays, cut: None }
    }

    /// Puts slave `n` behind another port. False: no frame would come to it in its position, and nothing changes.
    pub(super) fn put(&mut self, n: usize, behind: Behind) -> bool {
        let (place, port) = (usize::from(behind.place), usize::from(behind.port));
        let turn = |port: usize| ORDER.iter().position(|other| *other == port);
        // A frame that was at the slave before goes on at the ones it came from, each at a port behind its last one.
        let mut last = n.checked_sub(1).map(|before| (before, None));
        while let Some((at, used)) = last {
            if at == place {
                let fits = turn(port) > used && turn(port).is_some();
                if fits {
                    self.front[n] = Some((place, port));
                }
                return fits;
            }
            last = self.front[at].map(|(front, port)| (front, turn(port)));
        }
        false
    }

    /// Whether a frame comes to slave `n`.
    pub(super) fn reaches(&self, n: usize) -> bool {
        let mut at = Some(n);
        while let Some(here) = at {
            if self.cut == Some(here) || here >= self.front.len() {
                return false;
            }
            at = self.front[here].map(|(front, _)| front);
        }
        true
    }

    /// The slave that is at a port of slave `n`.
    fn at_port(&self, n: usize, port: usize) -> Option<usize> {
        self.front.iter().position(|front| *front == Some((n, port)))
    }

    /// Which ports of slave `n` have a link.
    pub(super) fn links(&self, n: usize) -> [bool; 4] {
        let is_whole = |slave: usize| self.cut != Some(slave);
        std::array::from_fn(|port| match port {
            0 => is_whole(n),
            port => self.at_port(n, port).is_some_and(is_whole),
        })
    }

    /// The way of a frame: when it is at each slave; `None`: it does not reach that.
    pub(super) fn visits(&self) -> Vec<Option<Visit>> {
        let mut visits = vec![None; self.front.len()];
        if self.reaches(0) {
            self.visit(0, 0, &mut visits);
        }
        visits
    }

    /// A frame leaves for slave `n` at `now`; returns when it is back.
    fn visit(&self, n: usize, now: u64, visits: &mut [Option<Visit>]) -> u64 {
        let mut now = now + self.delays[n];
        let mut visit = Visit { at: now, back: [None; 4] };
        for port in ORDER {
            if let Some(next) = self.at_port(n, port).filter(|next| self.cut != Some(*next)) {
                now = self.visit(next, now, visits);
                visit.back[port] = Some(now);
            }
        }
        visits[n] = Some(visit);
        now + self.delays[n]
    }

    /// The time of a frame through all slaves that it reaches, and back to the master, ns.
    pub(super) fn delay_ns(&self) -> u64 {
        let reached = (0..self.delays.len()).filter(|n| self.reaches(*n));
        reached.map(|n| 2 * self.delays[n]).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_position_that_the_order_of_ports_does_not_give_is_refused() {
        let mut line = Topology::line(vec![0; 4]);
        for (n, place, port) in [(0, 0, 1), (1, 0, 0), (1, 0, 4), (1, 2, 1), (2, 2, 2), (2, 0, 1), (2, 0, 3)]
        {
            assert!(!line.put(n, Behind { place, port }), "{n} {place} {port}");
        }
        assert!(line.put(2, Behind { place: 0, port: 2 }));
        assert!(!line.put(3, Behind { place: 1, port: 2 }), "that branch is done");
        assert!(line.put(3, Behind { place: 2, port: 2 }));
    }
}
