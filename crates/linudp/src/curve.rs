//! Time curves and encoder cams: what the drive stores, byte for byte, and its meaning.
//!
//! Knows no file and no channel. A curve is an info block of [`INFO_SIZE`] bytes and its setpoints, 4 bytes each,
//! which are equidistant over the curve's length. Curves of other layouts are refused, not guessed at.
//!
//! Facts: "Drive Configuration over Fieldbus Interfaces" manual, curve info block; confirmed by an independent
//! master on real drives. That the setpoints are equidistant is inferred.

use thiserror::Error;

use super::name;
use super::wire::{Fill, Take};

/// Bytes of the info block.
pub const INFO_SIZE: usize = 70;
/// Bytes of one setpoint.
pub const SETPOINT_SIZE: usize = 4;
/// Bytes of the name; it may fill all of them.
pub const NAME_SIZE: usize = 22;

/// A curve. [`check`](Curve::check) says whether a drive would accept it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Curve {
    /// 1 ... 100.
    pub id: u16,
    /// Over time or over the counts of an encoder.
    pub kind: CurveKind,
    /// As the drive holds it, whatever it contains; see [`name`](Curve::name).
    pub name: [u8; NAME_SIZE],
    /// From the first setpoint to the last, in the unit of `x_dimension`: 10 us of a time curve, counts of a cam.
    pub x_length: u32,
    /// The unit of x.
    pub x_dimension: Dimension,
    /// The unit of the setpoints.
    pub y_dimension: Dimension,
    /// How the vendor's tool made the curve; used by that tool only.
    pub wizard: u16,
    /// Parameters of `wizard`.
    pub wizard_parameters: [u32; 7],
    /// The setpoints, 2 ... 65535 of them; 0.1 um where `y_dimension` is a position.
    pub setpoints: Vec<i32>,
}

/// The quantity that a curve runs over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CurveKind {
    /// 0003h: position over time.
    Time,
    /// 0103h: position over the counts of an encoder.
    Cam,
}

impl CurveKind {
    /// The object type of the info block.
    pub const fn code(self) -> u16 {
        match self {
            CurveKind::Time => 0x0003,
            CurveKind::Cam => 0x0103,
        }
    }
}

/// The unit of an axis of a curve, as the drive numbers it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Dimension(pub u16);

impl Dimension {
    /// 0.1 um.
    pub const POSITION: Dimension = Dimension(5);
    /// 10 us.
    pub const TIME: Dimension = Dimension(26);
    /// Counts.
    pub const ENCODER: Dimension = Dimension(27);
}

/// Why a curve is invalid for a drive.
#[derive(Clone, PartialEq, Eq, Error)]
pub enum CurveError {
    /// The info block.
    #[error("an info block of {0} bytes; it has 70: transfer the curve again")]
    InfoSize(usize),
    /// The data offset.
    #[error("the setpoints begin at byte {0}; only 70 is known: leave this curve to the vendor's tool")]
    DataOffset(u16),
    /// The object type.
    #[error("object type {0:04X}h; only 0003h and 0103h are known: leave this curve to the vendor's tool")]
    Kind(u16),
    /// The bytes of one setpoint.
    #[error("setpoints of {0} bytes; only those of 4 are known: leave this curve to the vendor's tool")]
    SetpointSize(u16),
    /// The data.
    #[error("{found} bytes of setpoints where the info block promises {promised}: transfer the curve again")]
    DataSize {
        /// The bytes that there are.
        found: usize,
        /// The bytes that the info block announces.
        promised: usize,
    },
    /// The number of setpoints.
    #[error("{0} setpoints; a curve has 2 to 65535")]
    Setpoints(usize),
    /// The id.
    #[error("curve id {0}; use 1 to 100")]
    Id(u16),
    /// The name.
    #[error("the name {0:?}; use at most 22 printable ASCII characters")]
    Name(String),
}
fieldbeat_core::debug_as_display!(CurveError);

impl Curve {
    /// The bytes of a name, at most 22 printable ASCII characters.
    pub fn name_bytes(name: &str) -> Result<[u8; NAME_SIZE], CurveError> {
        name::bytes(name, NAME_SIZE).ok_or_else(|| CurveError::Name(name.to_owned()))
    }

    /// The name; `None` if its bytes are anything else than printable ASCII followed by zeros.
    pub fn name(&self) -> Option<&str> {
        name::text(&self.name, NAME_SIZE)
    }

    /// Whether a drive would accept it.
    pub fn check(&self) -> Result<(), CurveError> {
        if !(1..=100).contains(&self.id) {
            return Err(CurveError::Id(self.id));
        }
        if !(2..=usize::from(u16::MAX)).contains(&self.setpoints.len()) {
            return Err(CurveError::Setpoints(self.setpoints.len()));
        }
        Ok(())
    }

    /// Info block and setpoints, in the drive's format.
    pub fn encode(&self) -> Result<([u8; INFO_SIZE], Vec<u8>), CurveError> {
        self.check()?;
        let mut info = [0; INFO_SIZE];
        let mut out = Fill(&mut info);
        // The count of the setpoints was checked to fit.
        let head = [INFO_SIZE as u16, self.kind.code(), self.setpoints.len() as u16, SETPOINT_SIZE as u16];
        head.iter().for_each(|word| out.put(word.to_le_bytes()));
        out.put(self.name);
        out.put(self.id.to_le_bytes());
        out.put(self.x_length.to_le_bytes());
        let tail = [self.x_dimension.0, self.y_dimension.0, self.wizard];
        tail.iter().for_each(|word| out.put(word.to_le_bytes()));
        self.wizard_parameters.iter().for_each(|parameter| out.put(parameter.to_le_bytes()));
        Ok((info, self.setpoints.iter().flat_map(|setpoint| setpoint.to_le_bytes()).collect()))
    }

    /// The curve of an info block and its setpoints. Bytes after the 70th are padding of the transfer.
    pub fn decode(info: &[u8], data: &[u8]) -> Result<Curve, CurveError> {
        if info.len() < INFO_SIZE {
            return Err(CurveError::InfoSize(info.len()));
        }
        let mut info = Take(info);
        let [data_offset, kind, setpoints, setpoint_size] = std::array::from_fn(|_| info.word());
        if usize::from(data_offset) != INFO_SIZE {
            return Err(CurveError::DataOffset(data_offset));
        }
        let known = [CurveKind::Time, CurveKind::Cam].into_iter().find(|known| known.code() == kind);
        let kind = known.ok_or(CurveError::Kind(kind))?;
        if usize::from(setpoint_size) != SETPOINT_SIZE {
            return Err(CurveError::SetpointSize(setpoint_size));
        }
        let promised = usize::from(setpoints) * SETPOINT_SIZE;
        if data.len() != promised {
            return Err(CurveError::DataSize { found: data.len(), promised });
        }
        // In the order of the wire.
        let curve = Curve {
            kind,
            name: info.bytes(),
            id: info.word(),
            x_length: info.long(),
            x_dimension: Dimension(info.word()),
            y_dimension: Dimension(info.word()),
            wizard: info.word(),
            wizard_parameters: std::array::from_fn(|_| info.long()),
            setpoints: data.as_chunks().0.iter().map(|bytes| i32::from_le_bytes(*bytes)).collect(),
        };
        curve.check()?;
        Ok(curve)
    }

    /// The setpoint at `x`, linear between two of them; the first one before the curve, the last one after it. `x`
    /// is counted from the first setpoint in the unit of `x_length`, and may be fractional.
    pub fn position_at(&self, x: f64) -> f64 {
        let last = self.setpoints.len().saturating_sub(1);
        let setpoint = |index: usize| self.setpoints.get(index).map_or(0.0, |setpoint| f64::from(*setpoint));
        let length = f64::from(self.x_length);
        if x <= 0.0 {
            return setpoint(0);
        }
        if x >= length || x.is_nan() {
            return setpoint(last);
        }
        let place = x / length * last as f64;
        let index = (place as usize).min(last.saturating_sub(1));
        let (from, to) = (setpoint(index), setpoint(index + 1));
        from + (to - from) * (place - index as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lift() -> Curve {
        Curve {
            id: 5,
            kind: CurveKind::Time,
            name: Curve::name_bytes("lift").unwrap(),
            x_length: 100_000,
            x_dimension: Dimension::TIME,
            y_dimension: Dimension::POSITION,
            wizard: 0x0102,
            wizard_parameters: [1, 0, 0, 0, 0, 0, 0x0403_0201],
            setpoints: vec![0, 100_000, -1],
        }
    }

    /// Drive Configuration manual, curve info block.
    #[test]
    fn golden_info_block() {
        let (info, data) = lift().encode().unwrap();
        let mut golden = vec![70, 0, 3, 0, 3, 0, 4, 0];
        golden.extend(*b"lift\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0");
        golden.extend([5, 0, 0xA0, 0x86, 0x01, 0, 26, 0, 5, 0, 0x02, 0x01, 1, 0, 0, 0]);
        golden.extend([0; 20]);
        golden.extend([1, 2, 3, 4]);
        assert_eq!(info.to_vec(), golden);
        assert_eq!(data, [0, 0, 0, 0, 0xA0, 0x86, 0x01, 0, 0xFF, 0xFF, 0xFF, 0xFF]);
        // The transfer pads the info block to whole dwords.
        assert_eq!(Curve::decode(&[&info[..], &[0, 0]].concat(), &data), Ok(lift()));
        let cam = Curve { kind: CurveKind::Cam, ..lift() };
        assert_eq!(cam.encode().unwrap().0[2..4], [0x03, 0x01]);
    }

    #[test]
    fn a_curve_that_no_drive_can_hold_is_refused_with_its_value() {
        for (byte, value, error) in [
            (0, 72, CurveError::DataOffset(72)),
            (2, 4, CurveError::Kind(4)),
            (4, 4, CurveError::DataSize { found: 12, promised: 16 }),
            (6, 2, CurveError::SetpointSize(2)),
            (30, 0, CurveError::Id(0)),
        ] {
            let (mut info, data) = lift().encode().unwrap();
            info[byte] = value;
            assert_eq!(Curve::decode(&info, &data), Err(error));
        }
        assert_eq!(Curve::decode(&[0; 69], &[]), Err(CurveError::InfoSize(69)));
        let (id, of) = (5, |points: usize| vec![0; points]);
        for (id, setpoints, expected) in [
            (101, of(3), Err(CurveError::Id(101))),
            (id, of(1), Err(CurveError::Setpoints(1))),
            (id, of(65_536), Err(CurveError::Setpoints(65_536))),
            (id, of(65_535), Ok(())),
        ] {
            assert_eq!(Curve { id, setpoints, ..lift() }.check(), expected);
        }
        assert_eq!(Curve::name_bytes(&"n".repeat(22)), Ok([b'n'; NAME_SIZE]));
        for name in [&*"n".repeat(23), "H\u{f6}he", "zero\0"] {
            assert_eq!(Curve::name_bytes(name), Err(CurveError::Name(name.into())));
        }
    }

    #[test]
    fn a_name_is_one_only_to_the_last_byte() {
        for (bytes, name) in [
            (&b"lift"[..], Some("lift")),
            (&[b'n'; NAME_SIZE], Some("nnnnnnnnnnnnnnnnnnnnnn")),
            (&[0; NAME_SIZE], Some("")),
            // Stale bytes behind the zero, and what is not ASCII.
            (b"lift\0old", None),
            (b"l\xF6ft", None),
        ] {
            let mut curve = lift();
            curve.name[..bytes.len()].copy_from_slice(bytes);
            assert_eq!(curve.name(), name, "{bytes:x?}");
        }
    }

    #[test]
    fn setpoints_are_equidistant_and_joined_by_straight_lines() {
        let curve = Curve { x_length: 200, setpoints: vec![0, 1_000, -500], ..lift() };
        for (x, position) in [
            (-1.0, 0.0),
            (0.0, 0.0),
            (50.0, 500.0),
            (100.0, 1_000.0),
            (150.0, 250.0),
            (200.0, -500.0),
            (1e9, -500.0),
            (f64::NAN, -500.0),
        ] {
            assert_eq!(curve.position_at(x), position, "{x}");
        }
        assert_eq!(Curve { x_length: 0, ..curve.clone() }.position_at(0.5), -500.0);
        assert_eq!(Curve { setpoints: vec![], ..curve }.position_at(7.0), 0.0);
    }
}
