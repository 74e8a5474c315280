//! The last resort of LinMot drives: their stop by control words alone, when the loop cannot send one any more.
//!
//! A LinUDP drive has no watchdog: after a loop that hangs, or a master that has died, it runs to its target and stays
//! powered. What is sent here holds without the newest state of the conversation. It carries no motion command, so no
//! count that could start one, and no parameter channel. /Abort = 0 brakes by the drive's quick stop and keeps the axis
//! controlled, so that no load drops (sheet, 3.1); /Freeze would run on when it is released, and OFF3 ends in power
//! off. Of a drive whose parameters force the bit, the stop ends by its time-out. The telegrams leave from the socket
//! of the loop, since a drive may obey its first master only (single-master filter), and by its port alone.
//!
//! The response definition lacks a block that each reply to the loop has: the echo shows which reply belongs to it.

use super::plan::LinUdpDrive;
use super::wire::{ControlWord, MainState, REQUEST_MAX, Request, ResponseDef, StatusWord};
use fieldbeat_core::bus::last::{LastDrive, Reply, Telegram, Telegrams};

/// The definition of the reply.
const REPORTED: ResponseDef =
    ResponseDef(ResponseDef::STATUS.0 | ResponseDef::STATE.0 | ResponseDef::ACTUAL.0);

/// The main states without power; that of a drive that is booting is 0, too.
const UNPOWERED: [MainState; 4] =
    [MainState::NOT_READY, MainState::SWITCH_ON_DISABLED, MainState::READY_TO_SWITCH_ON, MainState::ERROR];

/// That of a drive in a cycle of `period_ns`.
pub(super) fn last_resort(drive: &LinUdpDrive, period_ns: u64) -> LastDrive {
    let telegram = |control| {
        let request = Request { response_def: REPORTED, control, ..Request::default() };
        let mut bytes = [0; REQUEST_MAX];
        let length = request.emit(&mut bytes);
        Telegram::new(&bytes[..length])
    };
    let telegrams = Telegrams {
        look: telegram(None),
        halt: telegram(Some(ControlWord::ABORT)),
        off: telegram(Some(ControlWord::BASE)),
    };
    let at = |block| REPORTED.at(block) as u8;
    let reply = Reply {
        unpowered: UNPOWERED.into_iter().fold(0, |states, state| states | 1 << state.0),
        unit: drive.axis.units.distance(1.0),
        moving: StatusWord::MOTION_ACTIVE | StatusWord::SPECIAL_MOTION,
        status_at: at(ResponseDef::STATUS),
        // The main state is the high byte.
        state_at: at(ResponseDef::STATE) + 1,
        position_at: at(ResponseDef::ACTUAL),
    };
    LastDrive::new(&drive.axis, period_ns, drive.address, telegrams, reply)
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::bus::BusPlan;
    use fieldbeat_core::bus::last::Sighted;
    use fieldbeat_core::net::Os;
    use fieldbeat_core::time::MS;

    /// Sheet, 2.3 and 3.1: a control word alone; the status word, the state and the actual position in reply.
    #[test]
    fn a_control_word_alone_is_sent_and_the_reply_to_it_is_no_reply_to_the_loop() {
        let mut drive = LinUdpDrive::new("x", [127, 0, 0, 1].into());
        drive.axis.units.counts_per_unit = 10_000.0;
        let last = last_resort(&drive, MS);
        let Telegrams { look, halt, off } = last.telegrams();
        assert_eq!(look.bytes(), [0, 0, 0, 0, 0x07, 0, 0, 0]);
        assert_eq!(halt.bytes(), [0x01, 0, 0, 0, 0x07, 0, 0, 0, 0x2F, 0]);
        assert_eq!(off.bytes(), [0x01, 0, 0, 0, 0x07, 0, 0, 0, 0x3E, 0]);
        // Aborting, and the setpoint generator still runs; 1 mm.
        let moving = [0x01, 0, 0, 0, 0x07, 0, 0, 0, 0x37, 0x20, 0, 12, 0x10, 0x27, 0, 0];
        let reply = last.reply();
        assert_eq!(
            reply.read(&halt, &moving),
            Some(Sighted { powered: true, moving: true, position: 10_000 })
        );
        assert_eq!(reply.unit, 1e-4);
        let mut standing = moving;
        (standing[9], standing[11]) = (0, 2);
        assert_eq!(
            reply.read(&halt, &standing),
            Some(Sighted { powered: false, moving: false, position: 10_000 })
        );
        let mut of_the_loop = moving;
        of_the_loop[4] = ResponseDef::FRONT.0 as u8;
        assert_eq!(reply.read(&halt, &of_the_loop), None);
        assert_eq!(reply.read(&look, &moving), None);
    }

    #[test]
    fn a_bus_without_drives_opens_and_has_no_last_resort() {
        let mut plan = crate::plan::LinUdpPlan::new([127, 0, 0, 1].into(), Vec::new());
        plan.bind.set_port(0);
        let opened = plan.open(MS, &Os::default()).unwrap();
        assert!(opened.last_resort.is_none());
    }
}
