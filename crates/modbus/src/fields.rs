//! The registers of a Unidrive, as a recording shows them: of what was read the newest count of each cyclic parameter,
//! of what was written the values in the request.

use std::sync::Arc;

use super::mapping::{Block, Mapping, ROLES, Role};
use super::parameter::{Parameter, Width};
use super::plan::UnidriveDrive;
use super::wire::{ADU_MAX, HEADER, Request};
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::bus::native::{NativeField, NativeLayout};

/// Bytes of the mask in front of the counts that were read: a bit for each role with an index.
pub(super) const MASK: usize = 2;
/// Bytes of a count.
pub(super) const COUNT: usize = 4;

/// The values of `drive`, whose blocks are these.
pub(super) fn layout(drive: &UnidriveDrive, (direct, menu_0): (Mapping, Option<Mapping>)) -> NativeLayout {
    let map = &drive.map;
    let shown = (0..MONITOR_CHANNELS).map(|channel| (Role::Shown(channel as u8), map.show[channel]));
    let of_roles = [
        (Role::Control, Some(map.control)),
        (Role::Reference, Some(map.reference)),
        (Role::Status, Some(map.status)),
        (Role::Speed, Some(map.speed)),
        (Role::Trip, map.trip),
    ];
    let of_roles = of_roles.into_iter().chain(shown).filter_map(|(role, mapped)| {
        let place = role.index()?;
        let name = name(mapped?.parameter);
        Some(NativeField::new(name, move |read| is_read(read, place).then(|| count(read, place))?))
    });
    let also = (ROLES..).zip(&map.also).map(|(place, mapped)| {
        NativeField::new(name(mapped.parameter), move |read: &[u8]| count(read, place))
    });
    let written: Arc<[Block]> =
        std::iter::once(&direct).chain(&menu_0).flat_map(Mapping::writes).cloned().collect();
    let outputs = [(Role::Control, map.control), (Role::Reference, map.reference)].map(|(role, mapped)| {
        let written = Arc::clone(&written);
        NativeField::new(name(mapped.parameter), move |request| value(request, &written, role))
    });
    NativeLayout {
        inputs: of_roles.chain(also).collect(),
        outputs: outputs.into(),
        most: MASK + COUNT * (ROLES + map.also.len()) + ADU_MAX - HEADER,
    }
}

fn name(parameter: Parameter) -> String {
    format!("register_{}_{}", parameter.menu, parameter.number)
}

fn is_read(read: &[u8], place: usize) -> bool {
    read.first_chunk().is_some_and(|mask| u16::from_le_bytes(*mask) >> place & 1 != 0)
}

fn count(read: &[u8], place: usize) -> Option<i64> {
    let count = read.get(MASK + COUNT * place..)?.first_chunk()?;
    Some(i32::from_le_bytes(*count).into())
}

/// The value that a request, without its header, writes to the parameter of `role`.
fn value(request: &[u8], blocks: &[Block], role: Role) -> Option<i64> {
    // Behind the length, the header of a message has its unit.
    let [high, low] = u16::try_from(request.len() + 1).ok()?.to_be_bytes();
    let header: [u8; HEADER] = [0, 0, 0, 0, high, low, 0];
    let message = [&header, request].concat();
    let (address, data) = match Request::parse(&message).ok()?.1 {
        Request::Write { address, data } | Request::ReadWrite { write: address, data, .. } => (address, data),
        Request::Read { .. } | Request::WriteOne { .. } => return None,
    };
    let same = |block: &&Block| (block.address, usize::from(block.registers)) == (address, data.len());
    let block = blocks.iter().find(same)?;
    let place = block.roles.iter().position(|other| *other == role)?;
    match block.width {
        Width::Word => Some((data.word(place)? as i16).into()),
        Width::Long => Some(data.long(place)?.into()),
    }
}

const _: () = assert!(ROLES <= 8 * MASK, "each of them has a bit");
