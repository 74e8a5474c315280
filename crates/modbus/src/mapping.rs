//! The cyclic parameters as blocks of registers.
//!
//! A request has one block to write and one to read, each of parameters that follow each other and have one width. In
//! 32-bit access the address counts parameters and the quantity counts registers (manual, FC23 example).

use super::parameter::{Parameter, Width};
use super::plan::{Mapped, UnidriveDrive, Via};
use super::wire::{REGISTERS_MAX, Registers};
use fieldbeat_core::axis::PlanFault;
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::rt::Regions;

/// The purpose of a cyclic parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The control word.
    Control,
    /// The speed reference.
    Reference,
    /// The status word.
    Status,
    /// The speed feedback.
    Speed,
    /// The trip number.
    Trip,
    /// A monitored channel.
    Shown(u8),
    /// An additional parameter that is read for the native process data.
    Also(u8),
}

/// How many roles have an index in an [`Image`]: all but the additional ones.
pub const ROLES: usize = Role::FIRST_SHOWN + MONITOR_CHANNELS;

const _: () = assert!(ROLES <= u16::BITS as usize, "each role has a bit in Places");

/// The most additional parameters.
pub const ALSO_MAX: usize = REGISTERS_MAX as usize;

impl Role {
    /// The index of the first monitored channel.
    pub const FIRST_SHOWN: usize = 5;

    /// The index in an [`Image`].
    #[inline]
    pub const fn index(self) -> Option<usize> {
        match self {
            Role::Control => Some(0),
            Role::Reference => Some(1),
            Role::Status => Some(2),
            Role::Speed => Some(3),
            Role::Trip => Some(4),
            Role::Shown(channel) if (channel as usize) < MONITOR_CHANNELS => {
                Some(Role::FIRST_SHOWN + channel as usize)
            }
            Role::Shown(_) | Role::Also(_) => None,
        }
    }

    /// The key in a configuration.
    fn key(self) -> &'static str {
        match self {
            Role::Control => "map.control",
            Role::Reference => "map.reference",
            Role::Status => "map.status",
            Role::Speed => "map.speed",
            Role::Trip => "map.trip",
            Role::Shown(_) => "monitor",
            Role::Also(_) => "also_read",
        }
    }
}

/// A value for each role that has an index, once it was read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Image {
    /// Bit n: the value at index n was read; the others are 0.
    seen: u32,
    /// Two values each, as they are published: values written apart would be slow to read together right after.
    pairs: [u64; Image::PAIRS],
}

impl Image {
    /// Words of its values.
    pub(super) const PAIRS: usize = ROLES.div_ceil(2);

    /// From its parts.
    pub(super) fn new(seen: u32, pairs: [u64; Image::PAIRS]) -> Image {
        Image { seen, pairs }
    }

    /// The bits of the values that were read, and all values.
    #[inline]
    pub(super) fn parts(&self) -> (u32, &[u64; Image::PAIRS]) {
        (self.seen, &self.pairs)
    }

    /// The value at this index; `None`: not read yet.
    #[inline]
    pub fn get(&self, place: usize) -> Option<i32> {
        let pair = self.pairs.get(place / 2)?;
        (self.seen >> place & 1 != 0).then_some((pair >> (place % 2 * 32)) as i32)
    }

    /// Control word, reference and status; 0 if not read yet.
    #[inline]
    pub(super) fn front(&self) -> [i32; 3] {
        let [first, second, ..] = self.pairs;
        [first as i32, (first >> 32) as i32, second as i32]
    }

    /// The value of a role.
    #[inline]
    pub fn of(&self, role: Role) -> Option<i32> {
        role.index().and_then(|place| self.get(place))
    }

    /// Takes over all of a block whose parameters are in the order of this image, from index 0 on.
    #[inline]
    pub(super) fn set_front(&mut self, data: Registers<'_>) {
        let (pairs, rest) = data.bytes().as_chunks();
        for (pair, bytes) in self.pairs.iter_mut().zip(pairs) {
            // On the wire the first one comes before the second, the high byte first.
            *pair = u64::from_be_bytes(*bytes).rotate_left(32);
        }
        let count = data.len() / 2;
        self.seen |= (1 << count) - 1;
        if let Some(last) = rest.first_chunk() {
            self.set(count - 1, i32::from_be_bytes(*last));
        }
    }

    /// Puts a value in.
    #[inline]
    pub(super) fn set(&mut self, place: usize, count: i32) {
        if let Some(pair) = self.pairs.get_mut(place / 2) {
            let shift = place % 2 * 32;
            *pair = *pair & !(u64::from(u32::MAX) << shift) | u64::from(count as u32) << shift;
            self.seen |= 1 << place;
        }
    }
}

/// Parameters side by side, of one width.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block {
    /// The address on the wire.
    pub address: u16,
    /// The number of registers.
    pub registers: u16,
    /// The width of each parameter.
    pub width: Width,
    /// The role of each parameter, in order.
    pub roles: Box<[Role]>,
    /// The roles that have an index in an [`Image`].
    pub(super) places: Places,
    /// They are 32 bits wide, and their indices in an [`Image`] are 0, 1, 2 ...
    pub(super) in_order: bool,
    /// The first parameter, for messages.
    pub first: Parameter,
}

impl Block {
    /// Whether it has this role.
    #[inline]
    pub fn has(&self, role: Role) -> bool {
        self.places.has(role)
    }
}

/// Some of the roles that have an index in an [`Image`]: a bit each, by that index.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Places(pub(super) u16);

impl Places {
    /// Control word, reference, status and speed.
    pub(super) const FRONT: Places = Places(0b1111);
    /// Status and speed, which make a report.
    pub(super) const REPORT: Places = Places(0b1100);

    #[inline]
    pub(super) fn has(self, role: Role) -> bool {
        role.index().is_some_and(|place| self.0 >> place & 1 != 0)
    }

    /// All of `others` are among them.
    #[inline]
    pub(super) fn have(self, others: Places) -> bool {
        self.0 & others.0 == others.0
    }

    /// Those of `others` that are in one of both.
    #[inline]
    pub(super) fn with(self, more: Places, others: Places) -> Places {
        Places((self.0 | more.0) & others.0)
    }
}

/// All blocks of a drive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mapping {
    writes: Box<[Block]>,
    reads: Box<[Block]>,
    /// How many of `reads`, the first ones, have status or speed.
    hot: usize,
    /// For menu 0: the parameters that it is to show, from the first on.
    shown_in_menu_0: Box<[Parameter]>,
}

impl Mapping {
    /// The blocks of `drive`.
    ///
    /// # Errors
    ///
    /// A parameter that has no address, or that has two roles.
    pub fn new(drive: &UnidriveDrive) -> Result<Mapping, PlanFault> {
        let map = &drive.map;
        let outputs = [(Role::Control, map.control), (Role::Reference, map.reference)];
        let inputs =
            [(Role::Status, Some(map.status)), (Role::Speed, Some(map.speed)), (Role::Trip, map.trip)];
        let shown = (0..MONITOR_CHANNELS).map(|channel| (Role::Shown(channel as u8), map.show[channel]));
        let also = map
            .also
            .iter()
            .take(ALSO_MAX)
            .enumerate()
            .map(|(index, mapped)| (Role::Also(index as u8), Some(*mapped)));
        let inputs: Vec<(Role, Mapped)> = inputs
            .into_iter()
            .chain(shown)
            .chain(also)
            .filter_map(|(role, mapped)| Some((role, mapped?)))
            .collect();
        if map.also.len() > ALSO_MAX {
            let why = format!(
                "names {} parameters, and a request has {REGISTERS_MAX} registers; name fewer",
                map.also.len()
            );
            return Err(PlanFault::new("also_read", why));
        }
        let all: Vec<(Role, Mapped)> = outputs.into_iter().chain(inputs.iter().copied()).collect();
        for (place, (role, Mapped { parameter, width, .. })) in all.iter().enumerate() {
            let wrong = |why: String| Err(PlanFault::new(role.key(), why));
            if let Some((other, _)) = all[..place].iter().find(|(_, other)| other.parameter == *parameter) {
                return wrong(format!("{parameter} is already {}; name each parameter once", other.key()));
            }
            if parameter.slot != 0 {
                return wrong(format!(
                    "{parameter} is in an option slot; cyclic parameters are the drive's own"
                ));
            }
            drive.address_of(*role, *parameter, *width)?;
            if drive.via != Via::Direct && parameter.to_setup().is_none() {
                return wrong(format!(
                    "{parameter} cannot be shown in menu 0 (menus up to 59); use via = \"direct\""
                ));
            }
        }
        let (writes, reads, hot, shown_in_menu_0) = match drive.via {
            Via::Direct => {
                let writes = blocks(drive, &outputs)?;
                let mut reads = blocks(drive, &inputs)?;
                let is_hot =
                    |block: &Block| block.roles.iter().any(|role| matches!(role, Role::Status | Role::Speed));
                // The status first: without it there is no report.
                reads.sort_by_key(|block| (!block.has(Role::Status), !is_hot(block)));
                let hot = reads.iter().filter(|block| is_hot(block)).count();
                // Written values are read back now and then: a drive refuses a value by FC23 without an error code.
                reads.extend(writes.iter().cloned());
                (writes, reads, hot, Box::default())
            }
            Via::Menu0 { first } => {
                // Adjacent, the written ones first: one block reads the written values back, too.
                let place = |(index, (role, mapped)): (usize, &(Role, Mapped))| {
                    let number = u16::from(first) + index as u16;
                    match u8::try_from(number).ok().filter(|number| (1..=80).contains(number)) {
                        Some(number) => Ok((
                            *role,
                            Mapped { parameter: Parameter::new(0, number), width: Width::Long, ..*mapped },
                        )),
                        None => Err(PlanFault::new("via", "menu 0 has places 1 ... 80; use a lower number")),
                    }
                };
                let placed = all.iter().enumerate().map(place).collect::<Result<Vec<_>, _>>()?;
                let shown = all.iter().map(|(_, mapped)| mapped.parameter).collect();
                (blocks(drive, &placed[..outputs.len()])?, blocks(drive, &placed)?, 1, shown)
            }
        };
        if let Some(block) = writes.iter().chain(&reads).find(|block| block.registers > REGISTERS_MAX) {
            let why = format!(
                "{} registers from {} on exceed the {REGISTERS_MAX} of one request; map fewer",
                block.registers, block.first
            );
            return Err(PlanFault::new("map", why));
        }
        Ok(Mapping { writes: writes.into(), reads: reads.into(), hot, shown_in_menu_0 })
    }

    /// The blocks to write: control word and reference, or both in one.
    pub fn writes(&self) -> &[Block] {
        &self.writes
    }

    /// The blocks to read, those with status and speed first.
    pub fn reads(&self) -> &[Block] {
        &self.reads
    }

    /// How many of the first blocks to read have status or speed.
    pub fn hot(&self) -> usize {
        self.hot
    }

    /// Adds what it touches, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.writes);
        regions.add(&*self.reads);
        self.writes.iter().chain(&*self.reads).for_each(|block| regions.add(&*block.roles));
    }

    /// The parameters that menu 0 is to show, from its first place on; empty unless it is used.
    pub fn shown_in_menu_0(&self) -> &[Parameter] {
        &self.shown_in_menu_0
    }

    /// The block that is read in turn `turn`, out of [`turns`](Self::turns): those with status or speed one after the
    /// other, then one of the rest.
    pub fn read_in(&self, turn: usize) -> usize {
        let (hot, all) = (self.hot.max(1), self.reads.len());
        if all <= hot {
            return turn;
        }
        // With one such block, it is read in two of three exchanges.
        let round = hot.max(2) + 1;
        let (place, number) = (turn % round, turn / round);
        if place < round - 1 { place % hot } else { hot + number }
    }

    /// The number of turns until everything was read.
    pub fn turns(&self) -> usize {
        let (hot, all) = (self.hot.max(1), self.reads.len());
        if all <= hot { all } else { (hot.max(2) + 1) * (all - hot) }
    }
}

impl UnidriveDrive {
    /// The address of a parameter on the wire.
    fn address_of(&self, role: Role, parameter: Parameter, width: Width) -> Result<u16, PlanFault> {
        parameter.address(self.addressing, width).ok_or_else(|| {
            let range =
                "menus 0 ... 162 and numbers 0 ... 99 by standard addressing, menus 0 ... 63 by modified";
            PlanFault::new(role.key(), format!("{parameter} has no Modbus address: {range}"))
        })
    }
}

/// Puts those that follow each other into one block.
fn blocks(drive: &UnidriveDrive, items: &[(Role, Mapped)]) -> Result<Vec<Block>, PlanFault> {
    let mut items = items.to_vec();
    items.sort_by_key(|(_, mapped)| (mapped.parameter.menu, mapped.parameter.number));
    let follows = |(_, last): &(Role, Mapped), (_, next): &(Role, Mapped)| {
        last.width == next.width && last.parameter.offset(1) == Some(next.parameter)
    };
    let block = |items: &[(Role, Mapped)]| {
        let (role, Mapped { parameter: first, width, .. }) = items[0];
        let roles: Box<[Role]> = items.iter().map(|(role, _)| *role).collect();
        let mut indices = roles.iter().map(|role| role.index()).enumerate();
        Ok(Block {
            address: drive.address_of(role, first, width)?,
            registers: width.registers() * roles.len() as u16,
            width,
            places: Places(indices.clone().filter_map(|(_, index)| Some(1 << index?)).sum()),
            in_order: width == Width::Long && indices.all(|(place, index)| index == Some(place)),
            first,
            roles: roles.clone(),
        })
    };
    items.chunk_by(follows).map(block).collect()
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    fn drive(change: impl FnOnce(&mut UnidriveDrive)) -> UnidriveDrive {
        let mut drive = UnidriveDrive::new("u", Ipv4Addr::LOCALHOST);
        change(&mut drive);
        drive
    }

    fn addresses(blocks: &[Block]) -> Vec<(u16, u16)> {
        blocks.iter().map(|block| (block.address, block.registers)).collect()
    }

    #[test]
    fn the_usual_parameters_have_the_addresses_of_the_guides() {
        let mapping = Mapping::new(&drive(|_| ())).unwrap();
        assert_eq!(addresses(mapping.writes()), [(0x4078, 2), (0x0281, 1)]);
        let reads = addresses(mapping.reads());
        assert_eq!(reads, [(0x040F, 1), (0x412D, 2), (0x01A3, 1), (0x03FB, 1), (0x4078, 2), (0x0281, 1)]);
        assert_eq!(mapping.hot(), 2);
    }
}
