//! What the plan of a bus knows before the start: facts, computed once.

use std::net::SocketAddrV4;
use std::sync::Arc;

use super::OwnCounter;
use super::desired::Capabilities;
use super::diagnosis::Row;
use super::load::Load;
use crate::axis::acyclic::{Call, Notation};
use crate::axis::feedback::MONITOR_CHANNELS;
use crate::axis::{FaultNames, MonitorChannel, SilenceFaults};

/// The facts of a bus on its grid before the start. A wire states the differences from [`BusFacts::new`].
#[derive(Clone, Debug)]
pub struct BusFacts {
    /// The protocol's name, as in the configuration.
    pub protocol: &'static str,
    /// The drives, in slot order.
    pub drives: Vec<DriveFacts>,
    /// The names of its devices that are not drives, in the order of [`Ends::devices`](super::Ends::devices).
    pub devices: Vec<String>,
    /// The drives have a common clock that can lead the grid.
    pub has_clock: bool,
    /// One frame serves all of its drives: it is sent before the requests of other buses, since its reply comes while
    /// they are sent; and that is one reply that is waited for, whatever the number of drives.
    pub is_one_frame: bool,
    /// The load of its exchanges on its wire. `None`: nothing that costs a processor time.
    #[doc(hidden)]
    pub load: Option<Load>,
    /// The address that it sends from, with port 0 where that is the choice of the kernel; `None`: it has none, or it
    /// is whichever leads to a drive.
    #[doc(hidden)]
    pub local: Option<SocketAddrV4>,
    /// The meaning of `Counters::own`, in order.
    #[doc(hidden)]
    pub own_counters: &'static [OwnCounter],
    /// Which of `Counters::own` is the time that the telegrams of a drive took on a half-duplex wire, µs.
    #[doc(hidden)]
    pub wire_us: Option<usize>,
    /// The meaning of the counts of a drive that is not online, the most specific symptoms first.
    #[doc(hidden)]
    pub diagnosis: &'static [Row],
    /// The names of the fault codes of its drives.
    #[doc(hidden)]
    pub fault_names: FaultNames,
    /// Which fault codes its drives have because their master was silent: their watchdogs, a lost connection.
    #[doc(hidden)]
    pub silence_faults: SilenceFaults,
    /// How its drives write addresses and values for acyclic access.
    #[doc(hidden)]
    pub notation: Arc<dyn Notation>,
    /// A call that the drive of a plan of [`BusPlan::reaching`](super::BusPlan::reaching) answers whenever it is there,
    /// without an exchange; `None`: it has to be online.
    #[doc(hidden)]
    pub probe: Option<Call>,
}

impl BusFacts {
    /// Those of drives that have nothing in common but their protocol and its notation.
    pub fn new(
        protocol: &'static str,
        notation: impl Notation + 'static,
        drives: Vec<DriveFacts>,
    ) -> BusFacts {
        BusFacts {
            protocol,
            drives,
            devices: Vec::new(),
            has_clock: false,
            is_one_frame: false,
            load: None,
            local: None,
            own_counters: &[],
            wire_us: None,
            diagnosis: &[],
            fault_names: |_| None,
            silence_faults: |_| false,
            notation: Arc::new(notation),
            probe: None,
        }
    }

    /// The IP addresses of its drives, in slot order; empty if they have none.
    pub fn addresses(&self) -> Vec<SocketAddrV4> {
        self.drives.iter().filter_map(|drive| drive.address).collect()
    }
}

/// All drives of these buses, in slot order, each with its bus.
pub fn of_drives(buses: &[BusFacts]) -> impl Iterator<Item = (&BusFacts, &DriveFacts)> {
    buses.iter().flat_map(|bus| bus.drives.iter().map(move |drive| (bus, drive)))
}

/// The facts of a drive on its grid before the start. A wire states the differences from [`DriveFacts::at`] and
/// [`DriveFacts::on_wire`].
#[derive(Clone, Debug)]
pub struct DriveFacts {
    /// The IP address, if it has one.
    pub address: Option<SocketAddrV4>,
    /// Where it is, as the search of its protocol reports it.
    #[doc(hidden)]
    pub place: String,
    /// The place on a wire without IP addresses, counted from 0 at the master's end.
    #[doc(hidden)]
    pub place_on_wire: usize,
    /// How long its replies count.
    pub reply_within: ReplyWithin,
    /// The number of requests that may have to leave before one with a stop can: the command that the stop replaces has
    /// to end first.
    pub before_stop: u32,
    /// It stops by itself within this time if the master dies, ns: its own watchdog. `None`: it does not.
    pub watchdog_ns: Option<u64>,
    /// The watch and the guardian stop it in place of the loop: it has no watchdog of its own.
    pub has_last_resort: bool,
    /// The variables that it reports in addition to its process data, each once.
    pub monitored: [Option<MonitorChannel>; MONITOR_CHANNELS],
    /// The capabilities.
    #[doc(hidden)]
    pub capabilities: Capabilities,
}

impl DriveFacts {
    /// A drive with an IP address.
    pub fn at(address: SocketAddrV4, capabilities: Capabilities) -> DriveFacts {
        DriveFacts { address: Some(address), ..DriveFacts::on_wire(address, 0, capabilities) }
    }

    /// A drive at this place on a wire without IP addresses.
    pub fn on_wire(place: impl ToString, place_on_wire: usize, capabilities: Capabilities) -> DriveFacts {
        DriveFacts {
            address: None,
            place: place.to_string(),
            place_on_wire,
            reply_within: ReplyWithin::Cycles(1),
            before_stop: 0,
            watchdog_ns: None,
            has_last_resort: false,
            monitored: [const { None }; MONITOR_CHANNELS],
            capabilities,
        }
    }
}

/// How long a reply counts, by the kind of wire; [`Bus`](super::Bus) describes them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReplyWithin {
    /// For so many cycles, that of the request included. The next request does not wait for it.
    Cycles(u32),
    /// On a connection, for so long, ns. The next request waits for it.
    Connection(u64),
    /// On a half-duplex wire, where a request waits for its turn: the longest times from the slot in which an exchange
    /// is due, all turns before its own included, ns.
    Turn {
        /// Until its request begins.
        request_ns: u64,
        /// Until its end.
        end_ns: u64,
    },
    /// The drive sends by its own clock: a packet counts for so long, ns. Requests to it are due by divisor and phase
    /// whatever its link, since its watchdog needs them.
    OwnClock(u64),
}
