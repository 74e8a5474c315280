//! The log of a machine's inputs: how it begins, for whatever takes it out.

use fieldbeat_core::inputs::recording::LogReader;
use fieldbeat_core::logged::LinkTap;

/// Where the plan of a machine comes from.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum MachineOf {
    /// Code of the application: whoever repeats its runs gives the plan again.
    #[default]
    Code,
    /// A configuration.
    Configuration {
        /// As messages call it.
        file: String,
        /// The text.
        text: String,
    },
    /// The demo.
    Demo {
        /// How many drives its first bus has.
        drives: usize,
        /// The period, ns.
        period_ns: u64,
        /// Which of the demos of the computer it is.
        place: usize,
    },
}

/// The log of a machine, for what takes it out.
#[derive(Debug)]
pub struct LogBegin {
    /// The end of the log.
    pub reader: LogReader,
    /// The bytes on connections while the loop does not have them.
    pub link: LinkTap,
    /// Where the plan comes from.
    pub machine: MachineOf,
    /// The plan, resolved.
    pub plan: String,
    /// There is an in-loop task.
    pub has_task: bool,
}

/// Gets the log of a machine when it is built.
pub type LogSink = Box<dyn FnOnce(LogBegin) + Send>;
