//! The Modbus side of the drive: connections, messages, functions and exceptions.
//!
//! Knows no socket: bytes come split anywhere, and answers go out whole. Facts: SI-Ethernet guide; what it leaves
//! open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | a header that is no Modbus, lengths that contradict each other | the connection ends |
//! | 0 registers, an odd number of them with 32-bit access, function 6 with 32-bit access, bit 15 | exception 02 |
//! | a parameter that does not exist, an unknown unit | exception 02, and nothing is written or read |
//! | a value out of range, a parameter that is read only | function 16 stops there and counts the registers that it has written; 6 and 23 give no error |
//! | function 23 | writes, then reads (a setting: refuses it, ignores it, ends the connection, takes few registers) |
//! | a 16-bit write to a 32-bit parameter | carries the sign, if the parameter has one |

use std::net::SocketAddrV4;

use super::codec::{self, ADU_MAX, Exception, Header, INTERFACE_UNIT, NoModbus, Request, Response, function};
use super::drive::Drive;
use super::settings::{Interface, ReadWrite};
use super::table;

/// One client.
#[derive(Debug)]
struct Connection {
    from: SocketAddrV4,
    /// The bytes of an incomplete message.
    bytes: Vec<u8>,
    /// The last bytes were not Modbus.
    broken: bool,
}

/// The network interface of one drive.
#[derive(Debug)]
pub(super) struct Server {
    connections: Vec<Connection>,
    service: Service,
}

impl Server {
    pub(super) fn new(interface: &Interface) -> Server {
        Server { connections: Vec::new(), service: Service { interface: interface.clone() } }
    }

    /// A client connects; false if there are too many.
    pub(super) fn connect(&mut self, from: SocketAddrV4) -> bool {
        self.disconnect(from);
        let has_room = self.connections.len() < self.service.interface.connections;
        if has_room {
            self.connections.push(Connection { from, bytes: Vec::with_capacity(2 * ADU_MAX), broken: false });
        }
        has_room
    }

    /// A client disconnects.
    pub(super) fn disconnect(&mut self, from: SocketAddrV4) {
        self.connections.retain(|connection| connection.from != from);
    }

    /// All of them disconnect.
    pub(super) fn disconnect_all(&mut self) {
        self.connections.clear();
    }

    /// The number of connections.
    pub(super) fn connections(&self) -> usize {
        self.connections.len()
    }

    /// Whether the drive ends this connection.
    pub(super) fn hangs_up(&self, from: SocketAddrV4) -> bool {
        !self.connections.iter().any(|connection| connection.from == from && !connection.broken)
    }

    /// Takes in bytes of the connection of `from`, and appends the answers.
    pub(super) fn take(&mut self, from: SocketAddrV4, bytes: &[u8], drive: &mut Drive, reply: &mut Vec<u8>) {
        let connection = self.connections.iter_mut().find(|connection| connection.from == from);
        let Some(connection) = connection.filter(|connection| !connection.broken) else { return };
        connection.bytes.extend_from_slice(bytes);
        let (mut taken, mut is_first) = (0, true);
        loop {
            let rest = &connection.bytes[taken..];
            let size = match codec::message(rest) {
                Ok(Some(size)) => size,
                Ok(None) => break,
                Err(NoModbus) => {
                    connection.broken = true;
                    break;
                }
            };
            if is_first || self.service.interface.pipelining {
                connection.broken = self.service.answer(&rest[..size], drive, reply).is_err();
                if connection.broken {
                    break;
                }
            }
            taken += size;
            is_first = false;
        }
        connection.bytes.drain(..taken);
    }
}

/// Answers the messages.
#[derive(Debug)]
struct Service {
    interface: Interface,
}

/// The parameters of a block by their table indices, and whether they are accessed with 32 bits.
struct Block {
    places: Vec<usize>,
    long: bool,
}

impl Service {
    /// Answers one message, or not.
    fn answer(&self, message: &[u8], drive: &mut Drive, reply: &mut Vec<u8>) -> Result<(), NoModbus> {
        let (header, request) = codec::request(message)?;
        match (self.interface.read_write, header.function) {
            (ReadWrite::Closes, function::READ_WRITE) => return Err(NoModbus),
            (ReadWrite::Ignored, function::READ_WRITE) => {}
            _ => self.carry_out(header, request, drive, reply),
        }
        drive.sequencer.received(drive.parameters.get(table::MODBUS_TIMEOUT));
        Ok(())
    }

    fn carry_out(&self, header: Header, request: Request<'_>, drive: &mut Drive, reply: &mut Vec<u8>) {
        let mut data = Vec::new();
        let result = self.execute(header.unit, request, drive, &mut data);
        codec::respond(header, result.unwrap_or_else(Response::Exception), reply);
    }

    fn execute<'a>(
        &self,
        unit: u8,
        request: Request<'_>,
        drive: &mut Drive,
        read: &'a mut Vec<u8>,
    ) -> Result<Response<'a>, Exception> {
        let is_own = match unit {
            unit if self.interface.drive_units.contains(&unit) => false,
            unit if unit == INTERFACE_UNIT || unit == self.interface.slot => true,
            _ => return Err(Exception::Address),
        };
        match request {
            Request::Read { address, count } => {
                let block = self.look_up(is_own, address, count.into(), drive)?;
                block.read(drive, read);
                Ok(Response::Data(read))
            }
            Request::WriteOne { address, value } => {
                self.look_up(is_own, address, 1, drive)?.write(drive, &value);
                Ok(Response::Written { address, what: u16::from_be_bytes(value) })
            }
            Request::Write { address, data } => {
                let block = self.look_up(is_own, address, data.len() / 2, drive)?;
                Ok(Response::Written { address, what: block.write(drive, data) })
            }
            Request::ReadWrite { read: address, count, write, data } => {
                let registers = data.len() / 2;
                match self.interface.read_write {
                    ReadWrite::Refused => return Err(Exception::Function),
                    ReadWrite::UpTo(most) if registers + usize::from(count) > most.into() => {
                        return Err(Exception::Address);
                    }
                    _ => {}
                }
                let written = self.look_up(is_own, write, registers, drive)?;
                let block = self.look_up(is_own, address, count.into(), drive)?;
                written.write(drive, data);
                block.read(drive, read);
                Ok(Response::Data(read))
            }
            Request::Unsupported => Err(Exception::Function),
        }
    }

    /// Looks up the parameters of a block, of the interface or of the drive.
    fn look_up(
        &self,
        is_own: bool,
        address: u16,
        registers: usize,
        drive: &Drive,
    ) -> Result<Block, Exception> {
        let modified = drive.parameters.is_modified();
        let first = codec::place(address, modified).ok_or(Exception::Address)?;
        let each = if first.long { 2 } else { 1 };
        if !(1..=usize::from(codec::REGISTERS_MAX)).contains(&registers) || !registers.is_multiple_of(each) {
            return Err(Exception::Address);
        }
        let mut places = Vec::new();
        for index in 0..(registers / each) as u16 {
            let place = codec::place(address.wrapping_add(index), modified);
            let place = place.filter(|place| place.long == first.long).ok_or(Exception::Address)?;
            places.push(drive.parameters.find(place.menu, place.number, is_own).ok_or(Exception::Address)?);
        }
        Ok(Block { places, long: first.long })
    }
}

impl Block {
    /// Writes up to the first value that is refused; returns how many registers were written.
    fn write(&self, drive: &mut Drive, data: &[u8]) -> u16 {
        let width = if self.long { 4 } else { 2 };
        let values = data.chunks_exact(width);
        let mut written = 0;
        for (place, value) in self.places.iter().zip(values) {
            let value = match *value {
                [a, b, c, d] => i32::from_be_bytes([a, b, c, d]),
                [a, b] => drive.parameters.row(*place).word([a, b]),
                _ => break,
            };
            if !drive.write(*place, value) {
                break;
            }
            written += width as u16 / 2;
        }
        written
    }

    /// Reads them; of a 32-bit parameter that is accessed with 16 bits, the low ones.
    fn read(&self, drive: &Drive, data: &mut Vec<u8>) {
        for place in &self.places {
            let bytes = drive.read(*place).to_be_bytes();
            data.extend(if self.long { &bytes[..] } else { &bytes[2..] });
        }
    }
}
