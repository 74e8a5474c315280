//! Exact counts of what a bus sent and received, and the state of its clock.

use std::fmt;

/// Exact counts of one drive's exchanges. `sent = answered + missed + owed`; what is queued is not sent. Those of each
/// exchange stand first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct Counters {
    /// Requests handed to the wire.
    pub sent: u64,
    /// Exchanges answered in time.
    pub answered: u64,
    /// Requests that could not be handed to the wire: the operating system refused, or there was no connection.
    pub unsent: u64,
    /// Exchanges not answered in time.
    pub missed: u64,
    /// Replies that came after their window.
    pub late: u64,
    /// Second replies to one request.
    pub duplicate: u64,
    /// Answered exchanges whose reply may be that of an earlier request.
    pub suspect: u64,
    /// Reports that were not taken, for this axis cannot be so: a place that it cannot have reached since the last one,
    /// or the loss of its power, its reference or its hardware enable that the next report did not confirm. Counted by
    /// the loop; of a restart by the bus, which confirms it.
    pub implausible: u64,
    /// Datagrams from the drive that are no reply of this protocol.
    pub malformed: u64,
    /// Well-formed replies to something that was not requested, or from the wrong port.
    pub foreign: u64,
    /// Counts that only this protocol has, as its `BusFacts::own_counters` name them.
    pub own: [u64; OWN_COUNTERS],
}

impl Counters {
    /// The counts since `before`.
    pub fn since(&self, before: &Counters) -> Counters {
        let of = |count: fn(&Counters) -> u64| count(self).saturating_sub(count(before));
        Counters {
            sent: of(|counters| counters.sent),
            unsent: of(|counters| counters.unsent),
            answered: of(|counters| counters.answered),
            missed: of(|counters| counters.missed),
            late: of(|counters| counters.late),
            duplicate: of(|counters| counters.duplicate),
            suspect: of(|counters| counters.suspect),
            implausible: of(|counters| counters.implausible),
            malformed: of(|counters| counters.malformed),
            foreign: of(|counters| counters.foreign),
            own: std::array::from_fn(|index| self.own[index].saturating_sub(before.own[index])),
        }
    }
}

/// The most counters that a protocol has of its own.
pub const OWN_COUNTERS: usize = 14;

/// A counter that only one protocol has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OwnCounter {
    /// The key in JSON and metrics: small letters and underscores.
    pub key: &'static str,
    /// The meaning of the count, for people: one short sentence.
    pub what: &'static str,
}

/// Defines the counters that only one protocol has: their indices in [`Counters::own`], and the list of their keys and
/// meanings in the same order.
#[macro_export]
macro_rules! own_counters {
    ($vis:vis enum $Own:ident, $LIST:ident { $($Counter:ident = $key:literal: $what:literal,)+ }) => {
        /// The indices of the counters in [`Counters::own`]($crate::bus::Counters::own).
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[repr(usize)]
        $vis enum $Own { $(#[doc = concat!("Counts ", $what, ".")] $Counter,)+ }

        /// Their keys and meanings, in order.
        $vis const $LIST: [$crate::bus::OwnCounter; [$($key),+].len()] =
            [$($crate::bus::OwnCounter { key: $key, what: $what }),+];

        impl $Own {
            /// Counts one more.
            #[inline]
            $vis fn count(self, counters: &mut $crate::bus::Counters) {
                counters.own[self as usize] += 1;
            }
        }
    };
}

/// The counts of a drive or device that only one protocol has, exactly.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ProtocolCounters(pub Vec<(OwnCounter, u64)>);

impl ProtocolCounters {
    /// The counts of a drive or device, by what they count.
    #[doc(hidden)]
    pub fn of(own: &[OwnCounter], counts: [u64; OWN_COUNTERS]) -> ProtocolCounters {
        ProtocolCounters(own.iter().copied().zip(counts).collect())
    }

    /// One of them is above 0.
    #[doc(hidden)]
    pub fn are_any(&self) -> bool {
        self.0.iter().any(|(_, count)| *count > 0)
    }
}

/// Those above 0, in words.
impl fmt::Display for ProtocolCounters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counted = self.0.iter().filter(|(_, count)| *count > 0);
        for (place, (OwnCounter { what, .. }, count)) in counted.enumerate() {
            let between = if place == 0 { "" } else { "; " };
            write!(f, "{between}{what}: {count}")?;
        }
        Ok(())
    }
}

/// The relation of the clock of a bus and the grid, whichever of them leads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusClock {
    /// Distance of the newest slot from where that clock wants it, ns: positive is late; `None`: not measured yet,
    /// or not any more.
    pub error_ns: Option<i64>,
    /// The distance has been inside the window for a while.
    pub locked: bool,
    /// The largest distance since the first lock, ns.
    pub error_max_ns: u64,
    /// The distance that its drives tolerate, ns.
    pub window_ns: u64,
}

/// Exact counts of what arrived at a bus and belongs to none of its drives.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Unmatched {
    /// Datagrams from an address that is not a drive's.
    pub datagrams: u64,
    /// Datagrams that the kernel dropped because the socket's buffer was full, whoever sent them.
    pub dropped: u64,
    /// Errors of the receiving socket.
    pub errors: u64,
}

/// The counts of a bus itself, and the state of its clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusNumbers {
    /// The received messages that belong to no drive.
    pub unmatched: Unmatched,
    /// The relation of its clock and the grid, if it has a clock.
    pub clock: Option<BusClock>,
}

/// Those of a bus without a clock.
impl From<Unmatched> for BusNumbers {
    fn from(unmatched: Unmatched) -> BusNumbers {
        BusNumbers { unmatched, clock: None }
    }
}
