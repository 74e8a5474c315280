//! The contents of PDOs: objects back to back, without gaps (EtherCAT manual).
//!
//! | PDO | S300 ... S700 | AKD |
//! |---|---|---|
//! | 1701h out | 60C1h:1, 6040h (assumed) | 60C1h:1, 6040h |
//! | 1702h out | 606Bh, 6040h | 60FFh, 6040h |
//! | 1703h out | 6074h, 6040h | - |
//! | 1704h out | 607Ah, 6040h (assumed) | - |
//! | 1B01h in | 6063h, 6041h (assumed) | 6063h, 6041h |
//! | 1B03h in | 6064h, 6077h, 6041h | - |
//!
//! The order differs from drive to drive. The PDOs of a drive are therefore a setting, and these are only the known
//! ones: 1702h, 1703h and 1B03h from the device description of a real S600, the AKD's from its own and its manual.

use super::{Family, Object, Type};

/// One object in a PDO.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Entry {
    /// The object.
    pub object: Object,
    /// The type, which gives its size.
    pub kind: Type,
}

/// A PDO: its number, and its objects in order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    /// The index, as 1C12h and 1C13h have it.
    pub pdo: u16,
    /// The objects.
    pub entries: Vec<Entry>,
}

impl Layout {
    /// A PDO of known objects; `None`: one of them is not known.
    pub fn of_known(pdo: u16, objects: &[Object]) -> Option<Layout> {
        let entry = |object: &Object| Some(Entry { object: *object, kind: object.known()?.kind });
        Some(Layout { pdo, entries: objects.iter().map(entry).collect::<Option<_>>()? })
    }

    /// Bytes.
    pub fn size(&self) -> usize {
        self.entries.iter().map(|entry| entry.kind.bytes()).sum()
    }

    /// The objects with the byte that each begins at.
    pub fn places(&self) -> impl Iterator<Item = (usize, Entry)> {
        self.entries.iter().scan(0, |next, entry| {
            let at = *next;
            *next += entry.kind.bytes();
            Some((at, *entry))
        })
    }

    /// The offset of an object in it.
    pub fn place(&self, object: Object) -> Option<usize> {
        self.places().find(|(_, entry)| entry.object == object).map(|(at, _)| at)
    }

    /// Whether the master writes it: 16xxh and 17xxh; 1Axxh and 1Bxxh are read.
    pub const fn is_output(&self) -> bool {
        self.pdo < 0x1800
    }
}

/// Numbers and objects of the fixed PDOs.
type Fixed = &'static [(u16, &'static [(u16, u8)])];

const S700: Fixed = &[
    (0x1701, &[(0x60C1, 1), (0x6040, 0)]),
    (0x1702, &[(0x606B, 0), (0x6040, 0)]),
    (0x1703, &[(0x6074, 0), (0x6040, 0)]),
    (0x1704, &[(0x607A, 0), (0x6040, 0)]),
    (0x1B01, &[(0x6063, 0), (0x6041, 0)]),
    (0x1B03, &[(0x6064, 0), (0x6077, 0), (0x6041, 0)]),
];

const AKD: Fixed = &[
    (0x1701, &[(0x60C1, 1), (0x6040, 0)]),
    (0x1702, &[(0x60FF, 0), (0x6040, 0)]),
    (0x1720, &[(0x6040, 0), (0x60C1, 1), (0x20A4, 0), (0x60B2, 0), (0x60FE, 1)]),
    (0x1721, &[(0x60C1, 1), (0x6040, 0), (0x60B2, 0)]),
    (0x1724, &[(0x607A, 0), (0x6040, 0), (0x60B2, 0)]),
    (0x1725, &[(0x6040, 0), (0x607A, 0), (0x60FE, 1), (0x60B2, 0), (0x3470, 3), (0x6072, 0)]),
    (0x1B01, &[(0x6063, 0), (0x6041, 0)]),
    (
        0x1B20,
        &[
            (0x6063, 0),
            (0x2050, 0),
            (0x606C, 0),
            (0x60FD, 0),
            (0x60F4, 0),
            (0x20A0, 0),
            (0x6041, 0),
            (0x6077, 0),
            (0x20A5, 0),
            (0x3470, 4),
        ],
    ),
    (0x1B24, &[(0x6064, 0), (0x6041, 0)]),
    (0x1B26, &[(0x6041, 0), (0x6064, 0), (0x6077, 0), (0x60FD, 0), (0x3470, 4), (0x60F4, 0)]),
];

/// The known fixed PDOs of these drives.
pub fn fixed(family: Family) -> Vec<Layout> {
    let known = match family {
        Family::S700 => S700,
        Family::Akd => AKD,
    };
    let layout = |(pdo, objects): &(u16, &[(u16, u8)])| {
        let objects: Vec<Object> = objects.iter().map(|(index, sub)| Object::new(*index, *sub)).collect();
        Layout::of_known(*pdo, &objects)
    };
    known.iter().filter_map(layout).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn size(family: Family, pdo: u16) -> Option<usize> {
        fixed(family).iter().find(|layout| layout.pdo == pdo).map(Layout::size)
    }

    #[test]
    fn sizes_are_those_of_the_sheet() {
        let s700 = [0x1701, 0x1702, 0x1703, 0x1704, 0x1B01, 0x1B03].map(|pdo| size(Family::S700, pdo));
        assert_eq!(s700, [6, 6, 4, 6, 6, 8].map(Some));
        let akd = [0x1701, 0x1702, 0x1721, 0x1724, 0x1B01, 0x1B20].map(|pdo| size(Family::Akd, pdo));
        assert_eq!(akd, [6, 6, 8, 8, 6, 32].map(Some));
        assert_eq!(size(Family::Akd, 0x1703), None);
        let known = [Family::S700, Family::Akd].map(|family| fixed(family).len());
        assert_eq!(known, [S700.len(), AKD.len()], "all of their objects are known");
    }
}
