//! The Modbus side of the drive: connections, messages, functions and exceptions.
//!
//! Knows no socket: bytes come split anywhere, and answers go out whole. Facts: SI-Ethernet guide; what it leaves
//! open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | a header that is no Modbus, lengths that contradict each other | the connection ends |
//! | 0 registers, an odd number of them with 32-bit access, function 6 with 32-bit access, bit 15 | exception 02 |
//! | a parameter that does not exist | exception 02, and nothing is written or read (a setting for reading) |
//! | a value out of range, a parameter that is read only | function 16 stops there and counts the registers that it has written; 6 and 23 give no error |
//! | function 23 | writes, then reads (a setting: refuses it, ignores it, ends the connection, takes few registers) |
//! | a 16-bit write to a 32-bit parameter | carries the sign, if the parameter has one |

use std::net::SocketAddrV4;

use super::drive::Drive;
use super::settings::{Holes, Interface, ReadWrite};
use super::table;
use fieldbeat_modbus::parameter::{DRIVE_UNIT, INTERFACE_UNIT, Parameter, Width};
use fieldbeat_modbus::wire::{
    self, ADU_MAX, ExceptionCode, Header, REGISTERS_MAX, Registers, RegistersBuffer, Request, RequestError,
    RequestFault, Response, function,
};

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
        Server {
            connections: Vec::with_capacity(interface.connections),
            service: Service {
                interface: interface.clone(),
                places: Vec::with_capacity(2 * usize::from(REGISTERS_MAX)),
                registers: RegistersBuffer::new(),
            },
        }
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
            let size = match wire::frame(rest) {
                Ok(Some(size)) => size,
                Ok(None) => break,
                Err(_) => {
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

/// A message that is not Modbus: the connection has to end.
#[derive(Debug)]
struct NoModbus;

/// The owner of the parameters of a unit id.
#[derive(Clone, Copy, Debug)]
enum Unit {
    Drive,
    Interface,
}

/// Answers the messages.
#[derive(Debug)]
struct Service {
    interface: Interface,
    /// The table indices of the parameters of a message; `None` = a hole. The written ones come first.
    places: Vec<Option<usize>>,
    registers: RegistersBuffer,
}

impl Service {
    /// Answers one message, or not.
    fn answer(&mut self, adu: &[u8], drive: &mut Drive, reply: &mut Vec<u8>) -> Result<(), NoModbus> {
        let (header, function, request) = match Request::parse(adu) {
            Ok((header, request)) => (header, request.function(), Some(request)),
            Err(RequestError { header, function, fault: RequestFault::Unsupported }) => {
                (header, function, None)
            }
            Err(RequestError { fault: RequestFault::Malformed, .. }) => return Err(NoModbus),
        };
        let unit = self.unit(header.unit);
        if unit.is_none() && !self.interface.refuses_units {
            return Ok(());
        }
        match (self.interface.read_write, function) {
            (ReadWrite::Closes, function::READ_WRITE) => return Err(NoModbus),
            (ReadWrite::Ignored, function::READ_WRITE) => {
                drive.sequencer.received(drive.parameters.get(table::MODBUS_TIMEOUT));
                return Ok(());
            }
            _ => {}
        }
        let answering =
            if header.unit == 0 && self.interface.answers_as_255 { DRIVE_UNIT } else { header.unit };
        let response = match (unit, request) {
            (None, _) => Err(ExceptionCode::ADDRESS),
            (_, None) => Err(ExceptionCode::FUNCTION),
            (Some(unit), Some(request)) => self.carry_out(unit, request, drive),
        };
        let response = response.unwrap_or_else(|code| Response::Exception { function, code });
        drive.sequencer.received(drive.parameters.get(table::MODBUS_TIMEOUT));
        append(response, Header { unit: answering, ..header }, reply);
        Ok(())
    }

    fn unit(&self, unit: u8) -> Option<Unit> {
        match unit {
            unit if self.interface.drive_units.contains(&unit) => Some(Unit::Drive),
            unit if unit == INTERFACE_UNIT || unit == self.interface.slot => Some(Unit::Interface),
            _ => None,
        }
    }

    fn carry_out(
        &mut self,
        unit: Unit,
        request: Request<'_>,
        drive: &mut Drive,
    ) -> Result<Response<'_>, ExceptionCode> {
        self.places.clear();
        match request {
            Request::Read { address, count } => {
                let width = self.look_up(unit, address, count.into(), drive)?;
                Ok(Response::Read { data: self.read(0, width, drive) })
            }
            Request::WriteOne { address, value } => {
                let data = value.to_be_bytes();
                let width = self.look_up(unit, address, 1, drive)?;
                self.refuse_holes()?;
                self.write(width, Registers::new(&data).unwrap_or_default(), drive);
                Ok(Response::WriteOne { address, value })
            }
            Request::Write { address, data } => {
                let width = self.look_up(unit, address, data.len(), drive)?;
                self.refuse_holes()?;
                Ok(Response::Written { address, count: self.write(width, data, drive) })
            }
            Request::ReadWrite { read, count, write, data } => {
                match self.interface.read_write {
                    ReadWrite::Refused => return Err(ExceptionCode::FUNCTION),
                    ReadWrite::UpTo(most) if data.len() + usize::from(count) > most.into() => {
                        return Err(ExceptionCode::ADDRESS);
                    }
                    _ => {}
                }
                let written = self.look_up(unit, write, data.len(), drive)?;
                self.refuse_holes()?;
                let first = self.places.len();
                let width = self.look_up(unit, read, count.into(), drive)?;
                self.write(written, data, drive);
                Ok(Response::ReadWritten { data: self.read(first, width, drive) })
            }
        }
    }

    /// Looks up the parameters of a block, and returns how they are accessed.
    fn look_up(
        &mut self,
        unit: Unit,
        address: u16,
        registers: usize,
        drive: &Drive,
    ) -> Result<Width, ExceptionCode> {
        let addressing = drive.parameters.addressing();
        let (_, width) = Parameter::from_address(address, addressing).ok_or(ExceptionCode::ADDRESS)?;
        let each = usize::from(width.registers());
        if !(1..=usize::from(self.interface.registers)).contains(&registers)
            || !registers.is_multiple_of(each)
        {
            return Err(ExceptionCode::ADDRESS);
        }
        for index in 0..(registers / each) as u16 {
            let parameter = Parameter::from_address(address.wrapping_add(index), addressing);
            let (parameter, _) =
                parameter.filter(|(_, like)| *like == width).ok_or(ExceptionCode::ADDRESS)?;
            let place = match unit {
                Unit::Drive => drive.parameters.find(parameter),
                Unit::Interface => drive.parameters.find_own(parameter),
            };
            if place.is_none() && self.interface.holes == Holes::Refused {
                return Err(ExceptionCode::ADDRESS);
            }
            self.places.push(place);
        }
        Ok(width)
    }

    /// A written block may have no holes, unlike a read one.
    fn refuse_holes(&self) -> Result<(), ExceptionCode> {
        if self.places.contains(&None) { Err(ExceptionCode::ADDRESS) } else { Ok(()) }
    }

    /// Writes the parameters at the front, up to the first one that is refused; returns how many registers were
    /// written.
    fn write(&self, width: Width, data: Registers<'_>, drive: &mut Drive) -> u16 {
        let mut written = 0;
        for (index, place) in self.places.iter().flatten().enumerate() {
            let value = match width {
                Width::Word => data.word(index).map(|word| drive.parameters.row(*place).word(word)),
                Width::Long => data.long(index),
            };
            if !value.is_some_and(|value| drive.write(*place, value)) {
                break;
            }
            written += width.registers();
        }
        written
    }

    /// Reads the parameters from this one on.
    fn read(&mut self, first: usize, width: Width, drive: &Drive) -> Registers<'_> {
        self.registers.clear();
        for place in &self.places[first..] {
            let value = place.map_or(0, |place| drive.read(place));
            self.registers.push_raw(width, value.cast_unsigned());
        }
        self.registers.registers()
    }
}

fn append(response: Response<'_>, header: Header, reply: &mut Vec<u8>) {
    let start = reply.len();
    reply.resize(start + response.size(), 0);
    let size = response.emit(header, &mut reply[start..]);
    reply.truncate(start + size);
}
