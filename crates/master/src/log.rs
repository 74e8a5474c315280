//! The log of a machine's inputs: how it begins, and who gets it.

use super::Setup;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::inputs::recording::{LogReader, log};
use fieldbeat_core::logged::LinkTap;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::S;
use fieldbeat_telemetry::log::{LogBegin, MachineOf};

/// The ring of the log holds the traffic of a second, but no fewer and no more words than this.
const LEAST_WORDS: u64 = 1 << 17;
const MOST_WORDS: u64 = 1 << 23;
/// The words of each drive and cycle: request and reply with their heads, of the longest usual telegrams.
const WORDS_A_DRIVE: u64 = 40;
/// The further words of each cycle.
const WORDS_A_CYCLE: u64 = 64;

/// A log for a machine of `plan`, and its reader.
fn begin(plan: &Plan, regions: &mut Regions) -> (InputLog, LogReader) {
    let a_cycle = WORDS_A_CYCLE + WORDS_A_DRIVE * plan.axes().len() as u64;
    let words = (S / plan.cycle.period_ns.max(1)).saturating_mul(a_cycle).clamp(LEAST_WORDS, MOST_WORDS);
    let (recording, reader) = log(words as usize, regions);
    (InputLog::recording(recording), reader)
}

impl Setup {
    /// All that the loop takes from outside is logged; `sink` gets the log when the machine is built.
    #[doc(hidden)]
    pub fn with_log(mut self, sink: impl FnOnce(LogBegin) + Send + 'static) -> Setup {
        self.log_sink = Some(Box::new(sink));
        self
    }

    /// Where the plan comes from, for a recording with the wire.
    #[doc(hidden)]
    pub fn of_machine(mut self, machine: MachineOf) -> Setup {
        self.machine = machine;
        self
    }

    /// The log of the machine, begun if one is wanted, and what takes up the link thread's part of the wire.
    pub(crate) fn begin_log(&mut self, regions: &mut Regions) -> (InputLog, LinkTap) {
        let link = LinkTap::default();
        let Some(sink) = self.log_sink.take() else { return (InputLog::default(), link) };
        let (log, reader) = begin(&self.plan, regions);
        let machine = std::mem::take(&mut self.machine);
        let plan = self.plan.resolved();
        sink(LogBegin { reader, link: link.clone(), machine, plan, has_task: self.task.is_some() });
        (log, link)
    }
}
