//! Frames of EtherCAT in words.

use fieldbeat_keys::telegram::{Carrier, Front, Telegrams, Way, Words};

use crate::wire::frame::{Command, Datagram, ETHERTYPE, datagrams};
use crate::wire::mailbox::{self, COE_HEADER, Message};
use crate::wire::registers::{AlStatus, address};
use crate::wire::sdo::{AbortCode, Object, Response};

/// Those of this protocol.
pub const TELEGRAMS: &[Telegrams] =
    &[Telegrams { carrier: Carrier::Frames(ETHERTYPE), front: Front::whole, words }];

/// The memory of a slave behind its registers: process data and mailboxes.
const MEMORY: u16 = 0x1000;

fn words(frame: &[u8], _: Way) -> Option<Words> {
    let mut words = Words::default();
    for (place, datagram) in datagrams(frame).ok()?.enumerate() {
        words.then(if place == 0 { "" } else { "; " }, "");
        put(&datagram.ok()?, &mut words);
    }
    Some(words)
}

/// Command, address, length and working counter; what a state or a mailbox says.
fn put(datagram: &Datagram<'_>, words: &mut Words) {
    let Some(command) = datagram.command() else {
        return words.then("", format_args!("unknown command {}", datagram.number));
    };
    let name = format!("{command:?}").to_uppercase();
    words.then("", name.split('(').next().unwrap_or_default());
    let register = (datagram.address >> 16) as u16;
    let first = datagram.address as u16;
    match command {
        Command::Nop => {}
        Command::Lrd(at) | Command::Lwr(at) | Command::Lrw(at) => words.then(" ", format_args!("{at:#010x}")),
        Command::Brd(_) | Command::Bwr(_) | Command::Brw(_) => {
            words.then(" ", format_args!("all:{register:#06x}"));
        }
        Command::Aprd(..) | Command::Apwr(..) | Command::Aprw(..) | Command::Armw(..) => {
            words.then(" ", format_args!("position {}:{register:#06x}", (first as i16).wrapping_neg()));
        }
        Command::Fprd(..) | Command::Fpwr(..) | Command::Fprw(..) | Command::Frmw(..) => {
            words.then(" ", format_args!("station {first:#06x}:{register:#06x}"));
        }
    }
    words.then(
        " ",
        format_args!("{} bytes, working counter {}", datagram.data.len(), datagram.working_counter),
    );
    let is_logical = matches!(command, Command::Lrd(_) | Command::Lwr(_) | Command::Lrw(_) | Command::Nop);
    if is_logical {
        return;
    }
    if let (address::AL_STATUS | address::AL_CONTROL, &[low, high, ..]) = (register, datagram.data) {
        let status = AlStatus(u16::from_le_bytes([low, high]));
        if let Some(state) = status.state() {
            words.field(format_args!("state {state}{}", if status.error() { " with an error" } else { "" }));
        }
    } else if register >= MEMORY {
        match command {
            Command::Fpwr(..) | Command::Apwr(..) => sdo_request(datagram.data, words),
            _ => message(datagram.data, words),
        }
    }
}

/// The object of an SDO request, in a mailbox that was written.
fn sdo_request(mailbox: &[u8], words: &mut Words) {
    if let (true, Some(&[command, low, high, sub])) =
        (mailbox::is_answer(mailbox), mailbox.get(COE_HEADER..).and_then(<[u8]>::first_chunk))
    {
        let object = Object::new(u16::from_le_bytes([low, high]), sub);
        match command >> 5 {
            0 | 3 => words.field("SDO segment"),
            1 => words.field(format_args!("SDO write of {object}")),
            2 => words.field(format_args!("SDO read of {object}")),
            _ => words.field(format_args!("SDO abort of {object}")),
        }
    }
}

/// What a mailbox has that was read, if it has a message.
fn message(mailbox: &[u8], words: &mut Words) {
    match mailbox::parse(mailbox) {
        Some(Message::Sdo { response, .. }) => answered(&response, words),
        Some(Message::Emergency(emergency)) => {
            words.field(format_args!("emergency {:04x}h", emergency.code));
        }
        _ => {}
    }
}

fn answered(response: &Response<'_>, words: &mut Words) {
    match *response {
        Response::Value { object, data } => {
            words.field(format_args!("SDO value of {object}"));
            words.bytes(data);
        }
        Response::Begun { object, .. } => words.field(format_args!("SDO segmented transfer of {object}")),
        Response::Downloaded { object } => words.field(format_args!("SDO written {object}")),
        Response::Abort { object, code: code @ AbortCode(_) } => {
            words.field(format_args!("SDO abort of {object}: {code}"));
        }
        Response::Segment { .. } | Response::SegmentTaken { .. } => words.field("SDO segment"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::frame::{BROADCAST, Builder, FRAME_MAX};
    use crate::wire::mailbox::Counter;
    use crate::wire::sdo::Request;

    #[test]
    fn a_frame_says_what_each_datagram_does() {
        let mut out = [0; FRAME_MAX];
        let mut frame = Builder::new(&mut out, BROADCAST, [2; 6]).unwrap();
        let mut request = [0; 16];
        let read = Request::Upload { object: Object::new(0x6041, 0), complete: false };
        mailbox::emit(&read, Counter::default().next(), &mut request);
        frame.push_with(Command::Fprd(0x1001, address::AL_STATUS), 1, &[8, 0]).unwrap();
        frame.push(Command::Lrw(0x1_0000), 2, 28).unwrap();
        frame.push_with(Command::Fpwr(0x1001, 0x1800), 3, &request).unwrap();
        frame.push_with(Command::Aprd(0xFFFF, 0x1C00), 4, &[6, 0, 0, 0, 0, 3, 0, 0x10, 1, 0]).unwrap();
        let size = frame.finish();
        assert_eq!(
            words(&out[..size], Way::Unknown).unwrap().text,
            "FPRD station 0x1001:0x0130 2 bytes, working counter 0, state OP; LRW 0x00010000 28 bytes, working \
             counter 0; FPWR station 0x1001:0x1800 16 bytes, working counter 0, SDO read of 0x6041:0; APRD position \
             1:0x1c00 10 bytes, working counter 0"
        );
        assert_eq!(words(&out[..20], Way::Unknown), None);
    }
}
