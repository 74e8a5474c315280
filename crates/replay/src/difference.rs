//! The first difference of a repeated run to the recorded one, in words.

use std::fmt;

use fieldbeat_core::bus::BusPlan;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::inputs::entry::Kind;
use fieldbeat_core::inputs::replaying::{self, Mismatch};

/// The first difference of a repeated run to the recorded one. Its text names the cycle and, where one is known, the
/// drive.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Difference {
    /// The cycle of the difference.
    pub cycle: u64,
    /// The drive whose telegram differs.
    pub drive: Option<String>,
    /// The telegrams, if these have other bytes.
    pub telegrams: Option<Telegrams>,
    text: String,
}

/// A telegram of both runs.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Telegrams {
    /// As it was sent in the recorded run.
    pub recorded: Vec<u8>,
    /// As it would have been sent in the repeated one.
    pub repeated: Vec<u8>,
}

impl Telegrams {
    /// The place of the first byte that differs.
    pub fn first(&self) -> usize {
        let pairs = self.recorded.iter().zip(&self.repeated);
        pairs.take_while(|(recorded, repeated)| recorded == repeated).count()
    }
}

impl fmt::Display for Telegrams {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let at = self.first();
        let (recorded, repeated) = (self.recorded.get(at), self.repeated.get(at));
        match (recorded, repeated) {
            (Some(recorded), Some(repeated)) => {
                write!(
                    f,
                    "byte {at} of {} is {repeated:02x}, recorded was {recorded:02x}",
                    self.recorded.len()
                )
            }
            _ => write!(f, "it has {} bytes, recorded were {}", self.repeated.len(), self.recorded.len()),
        }
    }
}

impl Difference {
    pub(super) fn new(found: replaying::Difference, plan: &Plan) -> Difference {
        let replaying::Difference { cycle, what } = found;
        let bus = |place: usize| plan.buses.get(place).map(|bus| &**bus);
        let drive_of = |place, index, bytes: &[u8], at| {
            let bus = bus(place)?;
            let is_addressed = !bus.facts(plan.cycle.grid()).addresses().is_empty();
            let drive = if is_addressed { Some(index) } else { bus.drive_in(bytes, at) };
            bus.axes().get(drive?).map(|axis| axis.name.clone())
        };
        let of = |place, drive: &Option<String>| match drive {
            Some(drive) => format!("drive {drive}"),
            None => format!("bus {}", bus(place).map_or("?", BusPlan::name)),
        };
        let (drive, telegrams, text) = match what {
            Mismatch::Sent { bus, index, recorded, repeated } => {
                let telegrams = Telegrams { recorded, repeated };
                let drive = drive_of(bus, index, &telegrams.recorded, telegrams.first());
                let text = format!("{}: another telegram: {telegrams}", of(bus, &drive));
                (drive, Some(telegrams), text)
            }
            Mismatch::More { bus, index } => {
                let drive = drive_of(bus, index, &[], 0);
                let text = format!("{}: a telegram is sent that is not recorded", of(bus, &drive));
                (drive, None, text)
            }
            Mismatch::Fewer { bus, index } => {
                let drive = drive_of(bus, index, &[], 0);
                let text = format!("{}: a telegram is recorded that is not sent", of(bus, &drive));
                (drive, None, text)
            }
            Mismatch::Look { recorded, repeated } => {
                let name = |kind: Option<Kind>| kind.map_or("nothing more", Kind::name);
                let (repeated, recorded) = (name(repeated), name(recorded));
                (None, None, format!("the loop looks for {repeated}, recorded is {recorded}"))
            }
            Mismatch::Task => (None, None, "the in-loop task requests something else".into()),
            Mismatch::Broken => (None, None, "the log is broken there: record it again".into()),
        };
        Difference { cycle, drive, telegrams, text }
    }
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "cycle {}: {}", self.cycle, self.text)
    }
}
