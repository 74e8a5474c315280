//! The requests to one drive: from its latch until it is enabled again only a stop.

use fieldbeat::axis::StopCause;
use fieldbeat::bus::linudp::{ControlWord, StreamCommand};
use fieldbeat_linudp::wire::Request;

/// What a request asks of a drive.
pub struct Says {
    /// /Abort, the stop command, operation off or power off.
    pub stop: bool,
    /// Power off, or on.
    pub off: bool,
    pub on: bool,
    /// A motion, or anything else that is no stop.
    pub go: bool,
}

const STOP_COMMAND: u16 = 0x017;

pub fn says(request: &Request) -> Says {
    // Command 000x does nothing.
    let command = request.motion.map_or(0, |motion| motion.header >> 4);
    let (on, off, stop, go) = match request.control {
        None => (false, false, false, false),
        Some(word) if !word.has(ControlWord::SWITCH_ON) => (false, true, true, false),
        Some(ControlWord::ON) => (true, false, false, false),
        Some(word) => {
            let stop = ControlWord::ON.0 & !word.0 & (ControlWord::NO_ABORT | ControlWord::ENABLE_OPERATION);
            (true, false, stop != 0, word.0 | stop != ControlWord::ON.0)
        }
    };
    Says { stop: stop || command == STOP_COMMAND, off, on, go: go || ![0, STOP_COMMAND].contains(&command) }
}

/// The requests to one drive, and its reports.
#[derive(Default)]
pub struct Watch {
    /// Something was written to it at all.
    pub ours: bool,
    /// From its latch until it is enabled again.
    pub stopped: Option<Stopped>,
    pub enabled: bool,
    /// A command has not ended.
    pub pending: bool,
    pub stream: Option<Stream>,
    /// The cycle of the last good exchange.
    pub good_at: u64,
    pub online_at: u64,
}

#[derive(Clone, Copy, Debug)]
pub struct Stopped {
    pub cause: StopCause,
    /// The cycle of the last good exchange before.
    pub good_at: u64,
    /// The cycle whose send carried the first stop request.
    pub requested_at: Option<u64>,
    /// It has received the power off.
    pub off: bool,
}

/// Rows on their way to one drive.
#[derive(Default)]
pub struct Stream {
    pub next: f64,
    pub step: f64,
    pub velocity: f64,
    pub pushed: u32,
    /// No more of them.
    pub starving: bool,
    /// Those that went out, the cycle of the last one, and its header: each row has another count.
    pub reported: u32,
    pub requested_at: u64,
    pub header: u16,
}

impl Watch {
    /// The master has sent `request` in `cycle`.
    pub fn reported(&mut self, cycle: u64, request: &Request) -> Result<(), String> {
        let Says { stop, on, go, .. } = says(request);
        self.ours |= request.control.is_some();
        if let (Some(stream), Some(motion)) = (&mut self.stream, request.motion)
            && StreamCommand::from_id(motion.header >> 4).is_some()
            && motion.header != std::mem::replace(&mut stream.header, motion.header)
        {
            (stream.reported, stream.requested_at) = (stream.reported + 1, cycle);
        }
        let Some(stopped) = &mut self.stopped else { return Ok(()) };
        let first = stopped.requested_at.is_none();
        let wrong = match () {
            _ if go => "a motion",
            _ if on && stopped.off => "power on after power off",
            _ if self.ours && first && !stop => "something else before any stop",
            _ => "",
        };
        if !wrong.is_empty() {
            return Err(format!("got {wrong} in cycle {cycle}, {stopped:?}: {request:x?}"));
        }
        if stop && first {
            stopped.requested_at = Some(cycle);
        }
        Ok(())
    }
}
