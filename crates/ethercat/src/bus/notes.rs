//! Why slaves are not in operation, for normal threads.

use std::sync::Arc;

use crate::counters::DeviceCounters;
use crate::plan::Expected;
use crate::segment::note::{Note, Notes as SegmentNotes};
use fieldbeat_core::bus::Notes;
use fieldbeat_core::bus::counters::OWN_COUNTERS;
use fieldbeat_core::bus::notes::NoteCells;
use fieldbeat_core::net::frames::Dropped;
use fieldbeat_core::net::local;

/// The fault of the wire.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum WireNote {
    #[default]
    None,
    /// The interface is down.
    Down,
    /// No frame comes back.
    NothingBack,
    /// Frames of another master come.
    OtherMaster,
}

/// A slave of the plan: its index, its position, and who it has to be.
pub(super) type KnownSlave = (usize, u16, Expected);

/// The notes of drives and devices, in the order of the plan.
#[derive(Debug)]
pub(super) struct SlaveNotes {
    pub(super) notes: SegmentNotes,
    pub(super) remarks: [SegmentNotes; 2],
    /// The slave of each drive.
    pub(super) drives: Vec<KnownSlave>,
    /// The same of each device.
    pub(super) devices: Vec<KnownSlave>,
    /// The counters of each device.
    pub(super) counters: Vec<Arc<DeviceCounters>>,
    pub(super) dropped: Option<Arc<dyn Dropped>>,
    pub(super) wire: NoteCells<WireNote>,
    pub(super) interface: String,
}

impl Notes for SlaveNotes {
    fn get(&self, index: usize) -> Option<String> {
        self.note(self.drives.get(index)?)
    }

    fn is_vague(&self, _index: usize) -> bool {
        self.wire.get(0) == WireNote::NothingBack
    }

    fn device(&self, index: usize) -> Option<String> {
        self.note(self.devices.get(index)?)
    }

    fn remark(&self, index: usize) -> Option<String> {
        self.remarked(self.drives.get(index)?)
    }

    fn device_remark(&self, index: usize) -> Option<String> {
        self.remarked(self.devices.get(index)?)
    }

    fn device_counters(&self, index: usize) -> [u64; OWN_COUNTERS] {
        self.counters.get(index).map_or([0; OWN_COUNTERS], |counters| counters.get())
    }

    fn dropped(&self) -> u64 {
        self.dropped.as_ref().map_or(0, |dropped| dropped.count())
    }
}

impl SlaveNotes {
    fn remarked(&self, (slave, place, expected): &KnownSlave) -> Option<String> {
        match self.remarks.each_ref().map(|notes| notes.get(*slave)) {
            [Note::None, only] | [only, Note::None] => only.text(*place, expected),
            [first, further] => {
                Some(format!("{}; {}", first.text(*place, expected)?, further.what(expected)?))
            }
        }
    }

    fn note(&self, (slave, place, expected): &KnownSlave) -> Option<String> {
        let interface = &self.interface;
        let text = self.notes.get(*slave).text(*place, expected);
        match self.wire.get(0) {
            WireNote::Down if local::name(interface).is_some() => {
                Some(format!("nothing serves {interface}: start it: fieldbeat sim CONFIG"))
            }
            WireNote::Down => {
                Some(format!("{interface} is down or has no cable: look at both, ip link shows it"))
            }
            WireNote::NothingBack => Some(format!(
                "no frame comes back on {interface}: look at its cable, and at the power of the slave next \
                 to the master"
            )),
            // While it is there no slave is brought up; those that are in operation stay so.
            WireNote::OtherMaster => text.map(|_| {
                format!("another master has frames on {interface}: end it, or look where its cable leads")
            }),
            WireNote::None => text,
        }
    }
}
