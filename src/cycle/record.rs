//! What the loop tells the telemetry thread: fixed-size records through a ring. A full ring loses records, never truth:
//! the counts and maxima that the loop keeps itself are exact, and the loss is counted.

/// One record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Record {
    /// One executed cycle.
    Cycle {
        /// Its slot.
        index: u64,
        /// Begin of the cycle after its grid point, ns.
        wake_ns: u32,
        /// How long the send stage took, ns.
        send_ns: u32,
        /// How long the receive stage took, ns.
        receive_ns: u32,
        /// Everything after it, ns.
        work_ns: u32,
    },
    /// Slots passed over.
    Skipped {
        /// The first of them.
        first: u64,
        /// How many.
        count: u64,
        /// How late the first of them was when it was given up, ns; each further one is a period less.
        late_ns: u64,
    },
    /// One exchange with a round-trip time.
    RoundTrip {
        /// The slot.
        index: u64,
        /// The axis.
        axis: u32,
        /// From the send stamp to the taking in, ns.
        rtt_ns: u32,
    },
}
