//! Messages of Modbus TCP in words.

use fieldbeat_keys::telegram::{Carrier, Front, Telegrams, Way, Words};

use crate::parameter::{Addressing, Parameter, Width, slot};
use crate::plan::PORT;
use crate::wire::{Header, Registers, Request, Response, frame};

/// Those of this protocol.
pub const TELEGRAMS: &[Telegrams] = &[Telegrams { carrier: Carrier::Streams(PORT), front, words }];

/// No mark shows where the next message begins: bytes that are none end with what has arrived.
fn front(bytes: &[u8]) -> Front {
    match frame(bytes) {
        Ok(Some(size)) => Front::Telegram(size),
        Ok(None) => Front::Incomplete,
        Err(_) => Front::Foreign(bytes.len()),
    }
}

fn words(bytes: &[u8], way: Way) -> Option<Words> {
    match way {
        Way::ToDrive => Request::parse(bytes).ok().map(|(header, request)| requested(header, &request)),
        Way::FromDrive => Response::parse(bytes).ok().map(|(header, response)| answered(header, &response)),
        Way::Unknown => None,
    }
}

/// The first words of a message: what it is, its function and its header.
fn begin(what: &str, function: u8, Header { transaction, unit }: Header) -> Words {
    Words::new(format_args!("{what} of function {function}, transaction {transaction}, unit {unit}"))
}

/// Registers from an address on, and the parameter there by the usual addressing.
fn place(header: Header, address: u16) -> String {
    let parameter = Parameter::from_address(address, Addressing::Standard).zip(slot(header.unit));
    match parameter {
        Some(((parameter, Width::Word), slot)) => format!("{address} (Pr {})", parameter.in_slot(slot)),
        Some(((parameter, Width::Long), slot)) => {
            format!("{address} (Pr {}, 32 bits)", parameter.in_slot(slot))
        }
        None => address.to_string(),
    }
}

fn values(words: &mut Words, data: Registers<'_>) {
    for (index, word) in data.words().enumerate() {
        words.then(if index == 0 { ": " } else { " " }, format_args!("{word:04x}"));
    }
}

fn requested(header: Header, request: &Request<'_>) -> Words {
    let mut words = begin("request", request.function(), header);
    let place = |address| place(header, address);
    match *request {
        Request::Read { address, count } => {
            words.field(format_args!("read {count} registers from {}", place(address)));
        }
        Request::WriteOne { address, value } => {
            words.field(format_args!("write register {}: {value:04x}", place(address)));
        }
        Request::Write { address, data } => {
            words.field(format_args!("write {} registers from {}", data.len(), place(address)));
            values(&mut words, data);
        }
        Request::ReadWrite { read, count, write, data } => {
            words.field(format_args!("read {count} registers from {}", place(read)));
            words.field(format_args!("write {} registers from {}", data.len(), place(write)));
            values(&mut words, data);
        }
    }
    words
}

fn answered(header: Header, response: &Response<'_>) -> Words {
    let function = match response {
        Response::Exception { function, .. } => *function,
        other => other.function(),
    };
    let mut words = begin("response", function, header);
    match *response {
        Response::Read { data } | Response::ReadWritten { data } => {
            words.field(format_args!("{} registers", data.len()));
            values(&mut words, data);
        }
        Response::WriteOne { address, value } => {
            words.field(format_args!("wrote register {}: {value:04x}", place(header, address)));
        }
        Response::Written { address, count } => {
            words.field(format_args!("wrote {count} registers from {}", place(header, address)));
        }
        Response::Exception { code, .. } => words.field(code),
    }
    words
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::ExceptionCode;

    #[test]
    fn messages_say_what_is_read_and_written() {
        let header = Header { transaction: 7, unit: 255 };
        let data = Registers::new(&[0, 1, 0x12, 0x34]).unwrap();
        let mut bytes = [0; 64];
        let request = Request::ReadWrite { read: 0x4000 | 639, count: 2, write: 641, data };
        let size = request.emit(header, &mut bytes);
        assert_eq!(front(&bytes[..size]), Front::Telegram(size));
        assert_eq!(front(&bytes[..size - 1]), Front::Incomplete);
        assert_eq!(
            words(&bytes[..size], Way::ToDrive).unwrap().text,
            "request of function 23, transaction 7, unit 255, read 2 registers from 17023 (Pr 06.040, 32 bits), \
             write 2 registers from 641 (Pr 06.042): 0001 1234"
        );
        let refused = Response::Exception { function: 23, code: ExceptionCode::ADDRESS };
        let size = refused.emit(header, &mut bytes);
        assert_eq!(
            words(&bytes[..size], Way::FromDrive).unwrap().text,
            "response of function 23, transaction 7, unit 255, exception 02h no such parameter, or too many \
             registers at once"
        );
        assert_eq!(words(&bytes[..size], Way::Unknown), None);
        assert_eq!(front(&[0, 1, 0, 9, 0, 6]), Front::Foreign(6));
    }
}
