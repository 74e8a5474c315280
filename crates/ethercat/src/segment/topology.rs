//! How much later than the first slave each one receives a frame.
//! A broadcast latches at each port of all slaves when that frame came there. Frames go through the open ports in the
//! order 0, 3, 1, 2, to all slaves behind one port before the next, and positions count in this order: so the links
//! show which slave is behind which port of which other one (ETG.1000.4). The time from a port to the next one less
//! the time that the slave there needed by itself is cable, half of it each way; forwarding through a slave counts
//! as cable, and so does a slave without receive times.

use crate::slot::{Answers, Ask};
use crate::wire::frame::{Command, position};
use crate::wire::registers::{Links, address};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::MS;

/// The order of the ports.
const ORDER: [u8; 4] = [0, 3, 1, 2];
/// The receive times of the ports, bytes.
const TIMES: usize = 16;
/// No frame is under way for so long, ns: the slave was switched off meanwhile.
const LONGEST_NS: u32 = 10 * MS as u32;

/// How far the reading is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum State {
    #[default]
    Idle,
    Latch,
    Read(usize),
}

/// Where a slave is: behind a port of a slave with receive times, counted from its entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Behind {
    node: usize,
    port: usize,
}

/// The slaves behind one port: how many of them have no other one with receive times before them, and the time that a
/// frame spends in and behind all of these, ns.
#[derive(Clone, Copy, Debug, Default)]
struct Branch {
    slaves: u32,
    inside_ns: u32,
}

/// One position of the segment.
#[derive(Clone, Copy, Debug, Default)]
struct Node {
    /// It has receive times.
    timed: bool,
    /// The open ports but the entry, and when the frame was back at each of them, since it came in, ns; first of all
    /// the entry itself.
    exits: usize,
    back_ns: [u32; 4],
    parent: Option<usize>,
    /// The number of exits that have their slaves.
    used: usize,
    behind: Option<Behind>,
    /// The slaves behind each exit; and the same, as far as it was passed on.
    branches: [Branch; 3],
    passed: [Branch; 3],
    delay_ns: u32,
}

impl Node {
    /// With these receive times and links.
    fn new(times: Option<[u32; 4]>, links: Links) -> Node {
        let is_open = |port: &u8| links.link(*port) && links.open(*port);
        let since = |port: u8, entry: u8| {
            let time = |port: u8| times.map_or(0, |times| times[usize::from(port)]);
            Some(time(port).wrapping_sub(time(entry))).filter(|ns| *ns < LONGEST_NS)
        };
        // Frames come in where they are first.
        let is_first =
            |entry: &u8| ORDER.into_iter().filter(is_open).all(|port| since(port, *entry).is_some());
        let entry = ORDER.into_iter().filter(is_open).find(is_first).unwrap_or(0);
        let begin = ORDER.iter().position(|port| *port == entry).unwrap_or(0);
        let mut node = Node { timed: times.is_some(), ..Node::default() };
        for port in ORDER.into_iter().cycle().skip(begin + 1).take(ORDER.len() - 1).filter(is_open) {
            node.exits += 1;
            node.back_ns[node.exits] = since(port, entry).unwrap_or(0);
        }
        node
    }

    /// The time that a frame spends in it and behind it, ns.
    fn inside_ns(&self) -> u32 {
        self.back_ns[self.exits]
    }
}

/// The slaves of a segment, up to the last one of interest.
#[derive(Debug, Default)]
pub struct Topology {
    nodes: Box<[Node]>,
    state: State,
}

impl Topology {
    /// Of so many positions.
    pub fn new(count: usize) -> Topology {
        Topology { nodes: vec![Node::default(); count].into(), state: State::Idle }
    }

    /// Adds what it touches besides itself, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.nodes);
    }

    /// Reads all anew, unless it does so.
    pub fn begin(&mut self) {
        if self.state == State::Idle {
            self.state = State::Latch;
        }
    }

    /// Requests what is next; nothing, if nothing is to be read.
    pub fn request(&self, ask: &mut Ask) {
        match self.state {
            State::Idle => {}
            State::Latch => {
                ask.write(Command::Bwr(address::DC_PORTS), &[0; 4]);
            }
            State::Read(at) => {
                let position = position(at as u16);
                ask.read(Command::Aprd(position, address::DC_PORTS), TIMES);
                ask.read(Command::Aprd(position, address::LINKS), 2);
            }
        }
    }

    /// Takes the answers; true: all delays are known. A lost frame is repeated.
    pub fn receive(&mut self, answers: &Answers<'_>) -> bool {
        self.state = match (self.state, answers) {
            (State::Latch, [Some(_), _]) => State::Read(0),
            (State::Read(at), [Some(times), Some(links)]) => {
                let bytes = links.data.first_chunk().filter(|_| links.working_counter > 0);
                let links = bytes.map(|bytes| Links(u16::from_le_bytes(*bytes)));
                let words = times.data.as_chunks::<4>().0.iter().map(|bytes| u32::from_le_bytes(*bytes));
                let mut ports = [0; 4];
                ports.iter_mut().zip(words).for_each(|(port, word)| *port = word);
                let times = (times.working_counter > 0).then_some(ports);
                // Behind the last slave there is none.
                if let (Some(links), Some(node)) = (links, self.nodes.get_mut(at)) {
                    *node = Node::new(times, links);
                    if at + 1 < self.nodes.len() { State::Read(at + 1) } else { self.find(at + 1) }
                } else {
                    self.find(at)
                }
            }
            (state, _) => state,
        };
        self.state == State::Idle
    }

    /// How much later than the first slave with receive times the one at `place` receives, ns.
    pub fn delay_ns(&self, place: u16) -> u32 {
        self.nodes.get(usize::from(place)).map_or(0, |node| node.delay_ns)
    }

    /// Finds the delays of the first `count` slaves; the others are not there.
    fn find(&mut self, count: usize) -> State {
        let (nodes, absent) = self.nodes.split_at_mut(count);
        absent.fill(Node::default());
        for at in 0..nodes.len() {
            Topology::place(nodes, at);
        }
        for at in 0..nodes.len() {
            nodes[at].delay_ns = Topology::delay(nodes, at);
        }
        State::Idle
    }

    /// Finds the port that the slave `at` is behind: the next one of the nearest slave before it that has one left.
    fn place(nodes: &mut [Node], at: usize) {
        let mut before = at.checked_sub(1);
        while let Some(parent) = before.filter(|parent| nodes[*parent].used == nodes[*parent].exits) {
            before = nodes[parent].parent;
        }
        let Some(parent) = before else { return };
        let port = nodes[parent].used;
        nodes[parent].used += 1;
        let behind =
            if nodes[parent].timed { Some(Behind { node: parent, port }) } else { nodes[parent].behind };
        (nodes[at].parent, nodes[at].behind) = (before, behind);
        if let Some(Behind { node, port }) = behind.filter(|_| nodes[at].timed) {
            let inside_ns = nodes[at].inside_ns();
            nodes[node].branches[port].add(inside_ns);
        }
    }

    /// The delay of the slave `at`: those before it have theirs.
    fn delay(nodes: &mut [Node], at: usize) -> u32 {
        let inside_ns = nodes[at].inside_ns();
        let Some(Behind { node, port }) = nodes[at].behind.filter(|_| nodes[at].timed) else { return 0 };
        let before = &mut nodes[node];
        let (forth_ns, back_ns) = (before.back_ns[port], before.back_ns[port + 1]);
        let (all, passed) = (before.branches[port], before.passed[port]);
        before.passed[port].add(inside_ns);
        let cable_ns = back_ns.saturating_sub(forth_ns).saturating_sub(all.inside_ns);
        // As many cables as slaves, and the one back.
        let cables_ns = u64::from(cable_ns) * u64::from(passed.slaves + 1) / u64::from(all.slaves + 1);
        before
            .delay_ns
            .saturating_add(forth_ns)
            .saturating_add(passed.inside_ns)
            .saturating_add(cables_ns as u32)
    }
}

impl Branch {
    fn add(&mut self, inside_ns: u32) {
        (self.slaves, self.inside_ns) = (self.slaves + 1, self.inside_ns.saturating_add(inside_ns));
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::slot::Answer;

    /// A slave of a true segment: the cable to it, ns; whether it has receive times, what its clock shows when a
    /// frame is sent, and the slaves behind its ports 3, 1 and 2.
    #[derive(Clone, Debug, Default)]
    struct Slave {
        cable_ns: u32,
        untimed: bool,
        shows: u32,
        behind: [Option<Box<Slave>>; 3],
    }

    /// The registers of each slave in order, and its true delay.
    type Seen = Vec<(Option<[u32; 4]>, u16, u32)>;

    impl Slave {
        fn at(cable_ns: u32, behind: [Option<Slave>; 3]) -> Slave {
            let behind = behind.map(|slave| slave.map(Box::new));
            Slave { cable_ns, shows: cable_ns.wrapping_mul(0x9E37_79B9), behind, ..Slave::default() }
        }

        /// A line of such cables.
        fn line(cables: &[u32]) -> Option<Slave> {
            let (first, rest) = cables.split_first()?;
            Some(Slave::at(*first, [None, Slave::line(rest), None]))
        }

        /// A frame leaves for it at `sent`; when it is back there.
        fn pass(&self, sent: u32, seen: &mut Seen) -> u32 {
            let mut at = sent + self.cable_ns;
            let mut times = [0; 4];
            let mut links = 1 << 4 | 1 << 9;
            times[0] = self.shows.wrapping_add(at);
            let own = seen.len();
            seen.push((None, 0, at));
            for (port, behind) in [3, 1, 2].into_iter().zip(&self.behind) {
                links |= if behind.is_some() { 1 << (4 + port) } else { 1 << (8 + 2 * port) };
                if let Some(slave) = behind {
                    at = slave.pass(at, seen);
                    times[port] = self.shows.wrapping_add(at);
                }
            }
            (seen[own].0, seen[own].1) = ((!self.untimed).then_some(times), links);
            at + self.cable_ns
        }

        fn seen(&self) -> Seen {
            let mut seen = Seen::new();
            self.pass(0, &mut seen);
            seen
        }
    }

    /// Reads a segment; the delays found.
    fn found(seen: &Seen, positions: usize) -> Vec<u32> {
        let mut topology = Topology::new(positions);
        topology.begin();
        fn answer(working_counter: u16, data: &[u8]) -> Option<Answer<'_>> {
            Some(Answer { working_counter, data })
        }
        assert!(!topology.receive(&[None, None]), "a lost frame");
        assert!(!topology.receive(&[answer(3, &[0; 4]), None]));
        for at in 0.. {
            let mut ask = Ask::default();
            topology.request(&mut ask);
            assert_eq!(ask.datagrams().next().unwrap().0, Command::Aprd(position(at), address::DC_PORTS));
            let Some((times, links, _)) = seen.get(usize::from(at)) else {
                assert!(topology.receive(&[answer(0, &[0; 16]), answer(0, &[0; 2])]));
                break;
            };
            let bytes: Vec<u8> = times.unwrap_or_default().into_iter().flat_map(u32::to_le_bytes).collect();
            let links = links.to_le_bytes();
            if topology.receive(&[answer(times.is_some().into(), &bytes), answer(1, &links)]) {
                break;
            }
        }
        (0..positions as u16).map(|place| topology.delay_ns(place)).collect()
    }

    #[test]
    fn a_slave_without_receive_times_counts_as_cable_and_shares_it() {
        let mut line = Slave::line(&[0, 500, 700, 300]).unwrap();
        line.behind[1].as_mut().unwrap().untimed = true;
        assert_eq!(found(&line.seen(), 4), [0, 0, 1_200, 1_500]);
        // Two branches of it: three cables, and what is between them.
        let mut star = Slave::at(400, [Slave::line(&[400, 100]), Slave::line(&[400]), None]);
        star.untimed = true;
        let segment = Slave::at(0, [None, Some(star), None]);
        assert_eq!(found(&segment.seen(), 5), [0, 0, 800, 900, 1_800]);
    }

    #[test]
    fn a_slave_that_is_switched_off_meanwhile_is_no_long_delay() {
        let mut seen = Slave::line(&[0, 500, 700]).unwrap().seen();
        seen[0].0 = Some([0xFFFF_0000, 5, 0, 0]);
        seen[1].0 = Some([0; 4]);
        assert!(found(&seen, 3).iter().all(|delay| *delay < 2 * LONGEST_NS));
        seen.iter_mut().for_each(|slave| slave.1 = 0);
        assert_eq!(found(&seen, 3), [0; 3], "no link at all");
    }

    fn tree() -> impl Strategy<Value = Slave> {
        let leaf = (1_u32..3_000).prop_map(|cable| Slave::at(cable, [None, None, None]));
        leaf.prop_recursive(6, 60, 3, |inner| {
            let port = || proptest::option::of(inner.clone());
            (1_u32..3_000, [port(), port(), port()]).prop_map(|(cable, behind)| Slave::at(cable, behind))
        })
    }

    proptest! {
        #[test]
        fn the_delays_of_any_tree_are_found(tree in tree()) {
            let seen = tree.seen();
            let wanted: Vec<u32> = seen.iter().map(|(_, _, delay)| delay - tree.cable_ns).collect();
            prop_assert_eq!(found(&seen, seen.len()), wanted);
        }

        #[test]
        fn no_registers_panic(seen: Vec<(Option<[u32; 4]>, u16, u32)>, positions in 0_usize..20) {
            prop_assume!(positions > 0);
            found(&seen, positions);
        }
    }
}
