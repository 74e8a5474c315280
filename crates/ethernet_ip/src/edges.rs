//! The command word as a machine of edges (Host Command Reference 920-0002 W, EtherNet/IP; sheet, 5.4).
//!
//! A drive acts on the change from idle to a command. Packets can be lost, and nothing echoes a command: each is held
//! for some packets and until its effect is seen, or its time is over; then idle is held for as long. The first packets
//! of a connection are idle, so that no old command is an edge. A stop waits for one idle packet only, and a stronger
//! one for no other stop. It is sent anew as soon as the drive's packets show that it has not taken it: if the idle
//! packet before it was lost, it was no edge.
//!
//! What a packet carries becomes the state once that packet has gone out: one that is built again, or that the system
//! does not send, has no effect.

use super::wire::assembly::command::IDLE;
use fieldbeat_core::time::Time;

/// A command that is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Wanted {
    /// Its bit.
    pub word: u32,
    /// It replaces what is held and weaker, behind one idle packet.
    pub urgency: Urgency,
    /// How often it was sent without an effect: each time idle is held twice as long before it.
    pub repeats: u8,
}

impl Wanted {
    /// The idle packets before it, where usually `hold` of them are.
    fn idle(self, hold: u8) -> u8 {
        match self.urgency.is_stop() {
            true => 1,
            false => u8::try_from(u32::from(hold) << self.repeats.min(8)).unwrap_or(u8::MAX),
        }
    }
}

/// What goes first.
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

/// What has become of the packet that was built last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    /// Nothing new.
    None,
    /// The first packet with this command has left.
    Begun,
    /// The first idle packet behind a command has left.
    Ended,
}

/// The command word of one connection.
#[derive(Clone, Copy, Debug)]
pub(super) struct Edges {
    phase: Phase,
    /// As it is once the packet has left.
    prepared: Phase,
    /// The effect of the held command was seen.
    seen: bool,
    hold: u8,
    within_ns: u64,
}

impl Edges {
    /// Commands are held for `hold` packets at least, and for `within_ns` at most without an effect.
    pub(super) fn new(hold: u8, within_ns: u64) -> Edges {
        let phase = Phase::Idle { packets: 0 };
        Edges { phase, prepared: phase, seen: false, hold: hold.max(1), within_ns }
    }

    /// A new connection: the drive has seen none of the packets before.
    pub(super) fn reset(&mut self) {
        (self.phase, self.prepared, self.seen) =
            (Phase::Idle { packets: 0 }, Phase::Idle { packets: 0 }, false);
    }

    /// The word of the next packet, to be sent at `now`.
    pub(super) fn prepare(&mut self, now: Time, wanted: Option<Wanted>) -> u32 {
        self.prepared = match (self.phase, wanted) {
            (Phase::Idle { packets }, Some(wanted)) if packets >= wanted.idle(self.hold) => {
                Phase::Held { wanted, packets: 1, since: now, answers: 0 }
            }
            (Phase::Idle { packets }, _) => Phase::Idle { packets: packets.saturating_add(1) },
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
                Phase::Held { wanted, packets: packets.saturating_add(1), since, answers }
            }
        };
        match self.prepared {
            Phase::Idle { .. } => IDLE,
            Phase::Held { wanted, .. } => wanted.word,
        }
    }

    fn is_over(&self, packets: u8, since: Time, now: Time) -> bool {
        packets >= self.hold && (self.seen || now.since(since) >= self.within_ns)
    }

    /// The packet has gone out.
    pub(super) fn sent(&mut self) -> Change {
        let before = std::mem::replace(&mut self.phase, self.prepared);
        match (before, self.phase) {
            (Phase::Idle { .. }, Phase::Held { .. }) => {
                self.seen = false;
                Change::Begun
            }
            (Phase::Held { .. }, Phase::Idle { .. }) => Change::Ended,
            _ => Change::None,
        }
    }

    /// The prepared packet is the first one with its command.
    pub(super) fn begins(&self) -> bool {
        matches!((self.phase, self.prepared), (Phase::Idle { .. }, Phase::Held { .. }))
    }

    /// A packet of the drive has come.
    pub(super) fn answered(&mut self) {
        if let Phase::Held { packets, answers, .. } = &mut self.phase
            && *packets >= self.hold
        {
            *answers = answers.saturating_add(1);
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

    /// Its effect was seen.
    pub(super) fn is_seen(&self) -> bool {
        self.seen
    }

    /// Idle, for so long that the next command may follow: another packet like the last one changes nothing.
    pub(super) fn is_settled(&self) -> bool {
        matches!(self.phase, Phase::Idle { packets } if packets >= self.hold)
            && matches!(self.prepared, Phase::Idle { .. })
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
        let word = |(ms, wanted): (u64, &Option<Wanted>)| {
            let word = edges.prepare(Time((from_ms + ms) * MS), *wanted);
            edges.sent();
            word
        };
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

    #[test]
    fn a_packet_that_did_not_leave_changes_nothing() {
        let mut edges = Edges::new(1, 100 * MS);
        words(&mut edges, 0, &[None]);
        for _ in 0..3 {
            assert_eq!(edges.prepare(Time(MS), Some(ENABLE)), 2);
            assert!(edges.begins() && !edges.is_held());
        }
        assert_eq!(edges.sent(), Change::Begun);
        assert_eq!(edges.prepare(Time(2 * MS), Some(STOP)), 0);
        assert_eq!(edges.prepare(Time(2 * MS), None), 2, "the stop is not wanted any more");
    }
}
