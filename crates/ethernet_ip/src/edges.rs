//! The command word as a machine of edges (Host Command Reference 920-0002 W, EtherNet/IP; sheet, 5.4).
//!
//! A drive acts on the change from idle to a command. Packets can be lost, and nothing echoes a command: each is held
//! for some packets and until its effect is seen, or its time is over; then idle is held for as long. The first packets
//! of a connection are idle, so that no old command is an edge. A stop waits for one idle packet only, and a stronger
//! one for no other stop. It is sent anew as soon as the drive's packets show that it has not taken it: if the idle
//! packet before it was lost, it was no edge.
//!
//! A step is that of one packet: it belongs to the state behind the packet, which has no effect before that has left.

use super::wire::assembly::command::IDLE;
use fieldbeat_core::time::Time;

/// A command that is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Wanted {
    /// The bit.
    pub word: u32,
    /// It replaces what is held and weaker, behind one idle packet.
    pub urgency: Urgency,
    /// How often it was sent without an effect: each time idle is held twice as long before it.
    pub repeats: u8,
}

impl Wanted {
    /// With the most idle packets before it.
    const LONGEST: Wanted = Wanted { word: IDLE, urgency: Urgency::None, repeats: MOST_REPEATS };

    /// The idle packets before it, where usually `hold` of them are.
    fn idle(self, hold: u8) -> u8 {
        match self.urgency.is_stop() {
            true => 1,
            false => u8::try_from(u32::from(hold) << self.repeats.min(8)).unwrap_or(u8::MAX),
        }
    }
}

/// The edge that goes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Urgency {
    /// It waits for its turn.
    None,
    /// A stop along the ramp.
    Stop,
    /// The fastest stop.
    FastStop,
    /// Power off.
    Off,
}

impl Urgency {
    fn is_stop(self) -> bool {
        self > Urgency::None
    }
}

/// A stop whose effect is in none of so many packets of the drive, since it was delivered, was not taken.
const STOP_ANSWERS: u8 = 4;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// In so many packets.
    Idle { packets: u8 },
    /// In so many packets, the first of them at this instant. Since all of these, so many packets of the drive came.
    Held { wanted: Wanted, packets: u8, since: Time, answers: u8 },
}

/// The changes of a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    /// Nothing.
    None,
    /// It is the first one with this command.
    Begun,
    /// It is the first idle one behind a command.
    Ended,
}

/// The command word of one connection.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Edges {
    phase: Phase,
    /// The effect of the held command was seen.
    seen: bool,
    hold: u8,
    within_ns: u64,
}

/// An absolute move and a jog are sent again so often, since that is safe: with two idle packets before the first one,
/// one behind thirty of them. At a loss of 30 % one in 10^15 goes wrong.
pub(super) const MOST_REPEATS: u8 = 3;

impl Edges {
    /// Commands are held for `hold` packets at least, and for `within_ns` at most without an effect.
    pub(super) fn new(hold: u8, within_ns: u64) -> Edges {
        Edges { phase: Phase::Idle { packets: 0 }, seen: false, hold: hold.max(1), within_ns }
    }

    /// A new connection: the drive has seen none of the packets before.
    pub(super) fn reset(&mut self) {
        (self.phase, self.seen) = (Phase::Idle { packets: 0 }, false);
    }

    /// The word of the next packet, to be sent at `now`, and what that changes. Packets are counted as far as their
    /// number counts.
    pub(super) fn step(&mut self, now: Time, wanted: Option<Wanted>) -> (u32, Change) {
        let before = self.phase;
        self.phase = match (before, wanted) {
            (Phase::Idle { packets }, Some(wanted)) if packets >= wanted.idle(self.hold) => {
                self.seen = false;
                Phase::Held { wanted, packets: 1, since: now, answers: 0 }
            }
            (Phase::Idle { packets }, _) => {
                let most = wanted.unwrap_or(Wanted::LONGEST).idle(self.hold).max(packets);
                Phase::Idle { packets: packets.saturating_add(1).min(most) }
            }
            (Phase::Held { wanted: held, .. }, Some(wanted)) if wanted.urgency > held.urgency => {
                Phase::Idle { packets: 1 }
            }
            (Phase::Held { wanted, packets, since, answers }, _)
                if self.is_over(packets, since, now)
                    || wanted.urgency.is_stop() && !self.seen && answers >= STOP_ANSWERS =>
            {
                Phase::Idle { packets: 1 }
            }
            (Phase::Held { wanted, packets, since, answers }, _) => {
                Phase::Held { wanted, packets: packets.saturating_add(1).min(self.hold), since, answers }
            }
        };
        match (before, self.phase) {
            (Phase::Idle { .. }, Phase::Held { wanted, .. }) => (wanted.word, Change::Begun),
            (_, Phase::Held { wanted, .. }) => (wanted.word, Change::None),
            (Phase::Held { .. }, Phase::Idle { .. }) => (IDLE, Change::Ended),
            (Phase::Idle { .. }, Phase::Idle { .. }) => (IDLE, Change::None),
        }
    }

    fn is_over(&self, packets: u8, since: Time, now: Time) -> bool {
        packets >= self.hold && (self.seen || now.since(since) >= self.within_ns)
    }

    /// A packet of the drive has come.
    pub(super) fn answered(&mut self) {
        if let Phase::Held { packets, answers, .. } = &mut self.phase
            && *packets >= self.hold
        {
            *answers = answers.saturating_add(1).min(STOP_ANSWERS);
        }
    }

    /// The effect of the held command is in the newest packet of the drive.
    pub(super) fn see(&mut self) {
        self.seen |= self.is_held();
    }

    /// A command is held.
    pub(super) fn is_held(&self) -> bool {
        matches!(self.phase, Phase::Held { .. })
    }

    /// The drive has the held command, as far as that can be known without an effect: it was sent as often as it is to
    /// be, and a packet of the drive came after that.
    pub(super) fn is_delivered(&self) -> bool {
        matches!(self.phase, Phase::Held { answers: 1.., .. })
    }

    /// The effect was seen.
    pub(super) fn is_seen(&self) -> bool {
        self.seen
    }

    /// Idle, for so long that the next command may follow: another packet like the last one changes nothing.
    pub(super) fn is_settled(&self) -> bool {
        matches!(self.phase, Phase::Idle { packets } if packets >= self.hold)
    }
}

#[cfg(test)]
mod tests {

    use super::*;
    use fieldbeat_core::time::MS;

    const ENABLE: Wanted = Wanted { word: 2, urgency: Urgency::None, repeats: 0 };
    const STOP: Wanted = Wanted { word: 0x8000, urgency: Urgency::Stop, repeats: 0 };

    /// Words of the next packets, one a ms, each sent.
    fn words(edges: &mut Edges, from_ms: u64, wanted: &[Option<Wanted>]) -> Vec<u32> {
        let word = |(ms, wanted): (u64, &Option<Wanted>)| edges.step(Time((from_ms + ms) * MS), *wanted).0;
        (0..).zip(wanted).map(word).collect()
    }

    #[test]
    fn a_command_waits_for_idle_is_held_for_its_packets_and_idle_follows() {
        let mut edges = Edges::new(2, 100 * MS);
        assert_eq!(words(&mut edges, 0, &[Some(ENABLE); 3]), [0, 0, 2]);
        edges.see();
        assert_eq!(words(&mut edges, 3, &[Some(ENABLE); 4]), [2, 0, 0, 2]);
        assert!(!edges.is_seen(), "the next one has no effect yet");
        // Without an effect it is held until its time is over.
        let word = words(&mut Edges::new(2, 5 * MS), 0, &[Some(ENABLE); 9]);
        assert_eq!(word, [0, 0, 2, 2, 2, 2, 2, 0, 0]);
        // Sent again, it is behind twice as many idle packets: one of them gets through.
        let mut edges = Edges::new(2, 100 * MS);
        assert_eq!(words(&mut edges, 0, &[Some(Wanted { repeats: 1, ..ENABLE }); 5]), [0, 0, 0, 0, 2]);
    }

    #[test]
    fn a_stop_that_the_packets_of_the_drive_do_not_show_is_sent_anew_before_its_time_is_over() {
        for (wanted, words_then) in [(STOP, [0x8000, 0, 0x8000]), (ENABLE, [2, 2, 2])] {
            let mut edges = Edges::new(2, 1_000 * MS);
            words(&mut edges, 0, &[None, None]);
            words(&mut edges, 2, &[Some(wanted); 2]);
            (1..STOP_ANSWERS).for_each(|_| edges.answered());
            let first = words(&mut edges, 4, &[Some(wanted)]);
            edges.answered();
            assert_eq!([first, words(&mut edges, 5, &[Some(wanted); 2])].concat(), words_then);
        }
    }
}
