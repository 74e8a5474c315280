//! The values of motion commands: one type per quantity, over its wire integer, so that a velocity cannot be passed
//! as an acceleration; and [`Kind`], the same quantities as data, for code that walks the catalogue.
//!
//! Knows no command. One wire count is always a power of ten of the user unit, so that a value in user units has a
//! finite number of decimals and goes to the wire and back without loss. Every conversion rounds to nearest and checks
//! its range (SG5 manual, motion command interface).

use fieldbeat_core::axis::RangeError;

/// The "unit" of a bare number in a message.
const PLAIN: &str = "as a number";

/// The types and [`Kind`], both from one list:
///
/// `Name: wire integer, user unit, decimals of one count in that unit, conversions` - any integer is a value;
/// `Name: wire integer in low..=high, ...` - only some are, and the field is private.
macro_rules! kinds {
    ($($(#[doc = $doc:literal])+
       $name:ident: $int:ident $(in $low:literal..=$high:literal)?, $unit:literal, $decimals:literal
       $(, $from:ident, $to:ident)?;)*) => {
        /// The kind of a field of a command: its wire integer, unit, scale and range.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Kind {
            $($(#[doc = $doc])+ $name,)*
        }

        impl Kind {
            /// All of them.
            pub const ALL: &[Kind] = &[$(Kind::$name),*];

            /// Bytes on the wire: 2 or 4.
            pub const fn size(self) -> usize {
                match self { $(Kind::$name => size_of::<$int>(),)* }
            }

            /// The wire integer has a sign.
            pub const fn is_signed(self) -> bool {
                match self { $(Kind::$name => $int::MIN != 0,)* }
            }

            /// The user unit; empty where it has none.
            pub const fn unit(self) -> &'static str {
                match self { $(Kind::$name => $unit,)* }
            }

            /// One wire count is `10^-decimals` of the user unit.
            pub const fn decimals(self) -> u32 {
                match self { $(Kind::$name => $decimals,)* }
            }

            /// The smallest and the largest valid wire integer.
            pub const fn range(self) -> (i64, i64) {
                match self { $(Kind::$name => kinds!(@range $int $($low $high)?),)* }
            }
        }

        $(kinds!(@type [$($doc)+] $name $int $($low $high)?);

        impl $name {
            /// The same quantity as data.
            pub const KIND: Kind = Kind::$name;

            /// The wire integer.
            pub const fn wire(self) -> $int {
                self.0
            }

            $(#[doc = concat!("From ", $unit, ": rounded to nearest, and refused where the wire cannot carry \
                 it.")]
            pub fn $from(value: f64) -> Result<$name, RangeError> {
                Kind::$name.wire(value).map(|wire| $name(wire as $int))
            }

            #[doc = concat!("In ", $unit, ".")]
            pub fn $to(self) -> f64 {
                Kind::$name.user(i64::from(self.0))
            })?
        })*
    };
    (@range $int:ident) => { ($int::MIN as i64, $int::MAX as i64) };
    (@range $int:ident $low:literal $high:literal) => { ($low, $high) };
    (@type [$($doc:literal)+] $name:ident $int:ident) => {
        $(#[doc = $doc])+
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct $name(pub $int);
    };
    (@type [$($doc:literal)+] $name:ident $int:ident $low:literal $high:literal) => {
        $(#[doc = $doc])+
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct $name($int);

        impl $name {
            #[doc = concat!("From the wire integer, ", $low, " ... ", $high, ".")]
            pub const fn new(wire: $int) -> Result<$name, RangeError> {
                match Kind::$name.check(wire as i64) {
                    Ok(()) => Ok($name(wire)),
                    Err(error) => Err(error),
                }
            }
        }
    };
}

kinds! {
    /// A position or a distance, 0.1 um.
    Position: i32, "mm", 4, from_mm, mm;
    /// A velocity, 1 um/s.
    Velocity: u32, "mm/s", 3, from_mm_per_s, mm_per_s;
    /// A velocity with a direction, 1 um/s: of streams and comparisons.
    SignedVelocity: i32, "mm/s", 3, from_mm_per_s, mm_per_s;
    /// An acceleration or a deceleration, 1e-5 m/s².
    Acceleration: u32, "mm/s²", 2, from_mm_per_s2, mm_per_s2;
    /// An acceleration with a direction, 1e-5 m/s²: of streams.
    SignedAcceleration: i32, "mm/s²", 2, from_mm_per_s2, mm_per_s2;
    /// A jerk, 1e-4 m/s³.
    Jerk: u32, "mm/s³", 1, from_mm_per_s3, mm_per_s3;
    /// A current, 1 mA, in 32 bits.
    Current: i32, "mA", 0, from_ma, ma;
    /// A current, 1 mA, in 16 bits: of the wait commands.
    ShortCurrent: i16, "mA", 0, from_ma, ma;
    /// The largest current of a move that presses, 1 mA.
    CurrentLimit: u16, "mA", 0, from_ma, ma;
    /// A force, 0.1 N.
    Force: i16, "N", 1, from_n, n;
    /// The time that a curve takes, 10 us.
    CurveTime: i32, "ms", 2, from_ms, ms;
    /// A time to wait, 100 us.
    WaitTime: u32, "ms", 1, from_ms, ms;
    /// How much of its own time a curve takes, 0.01 %: 0 ... 200 %.
    TimeScale: u16 in 0..=20_000, "%", 2, from_percent, percent;
    /// How much of its own amplitude a curve has, 0.1 %: -2000 ... 2000 %.
    AmplitudeScale: i16 in -20_000..=20_000, "%", 1, from_percent, percent;
    /// A position in the drive's 16-bit scaling (UPIDs 1455h-1458h).
    ScaledPosition: i16, "", 0;
    /// A velocity in the drive's 16-bit scaling (UPIDs 1455h-1458h).
    ScaledVelocity: u16, "", 0;
    /// An acceleration or a deceleration in the drive's 16-bit scaling (UPIDs 1455h-1458h).
    ScaledAcceleration: u16, "", 0;
    /// The number of a parameter or variable of the drive.
    Upid: u16, "", 0;
    /// An entry of the command table, 1 ... 255.
    EntryId: u16 in 1..=255, "", 0;
    /// A curve, 1 ... 100.
    CurveId: u16 in 1..=100, "", 0;
    /// A position controller set: 0 is A, 1 is B.
    ControllerSet: u16 in 0..=1, "", 0;
    /// A mask, or the value that it is compared with, or a control word.
    Bits: u16, "", 0;
    /// A place inside a curve or an entry of the command table.
    Offset: u16, "", 0;
    /// A number whose meaning the sources do not give.
    Number: u16, "", 0;
    /// Counts of an encoder, or revolutions.
    Counts: i32, "", 0;
    /// A raw value of 16 bits.
    Short: i16, "", 0;
    /// A raw value of 32 bits, such as a variable of the command table.
    Long: i32, "", 0;
    /// A raw value of 32 bits, of which a shorter parameter takes the low ones.
    Raw: u32, "", 0;
}

impl Kind {
    /// Counts in one user unit.
    fn scale(self) -> f64 {
        10_f64.powi(self.decimals() as i32)
    }

    /// The wire integer of a value in user units: rounded to nearest, its range checked.
    pub fn wire(self, value: f64) -> Result<i64, RangeError> {
        let wire = (value * self.scale()).round();
        let (low, high) = self.range();
        if wire >= low as f64 && wire <= high as f64 {
            Ok(wire as i64)
        } else {
            let unit = if self.unit().is_empty() { PLAIN } else { self.unit() };
            Err(RangeError { value, unit, low: self.user(low), high: self.user(high) })
        }
    }

    /// A wire integer in user units.
    pub fn user(self, wire: i64) -> f64 {
        wire as f64 / self.scale()
    }

    /// Whether a wire integer is valid; the error counts in wire integers.
    pub const fn check(self, wire: i64) -> Result<(), RangeError> {
        let (low, high) = self.range();
        if low <= wire && wire <= high {
            Ok(())
        } else {
            Err(RangeError { value: wire as f64, unit: PLAIN, low: low as f64, high: high as f64 })
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn every_quantity_has_the_factor_of_the_manual_and_is_rounded() {
        // SG5 manual: 1e7 a metre, 1e6 a m/s, 1e5 a m/s2, 1e4 a m/s3, 1e3 an ampere, 10 a newton, 1e5 and 1e4 a second.
        assert_eq!(Position::from_mm(1_000.0), Ok(Position(10_000_000)));
        assert_eq!(Velocity::from_mm_per_s(1_000.0), Ok(Velocity(1_000_000)));
        assert_eq!(SignedVelocity::from_mm_per_s(-1_000.0), Ok(SignedVelocity(-1_000_000)));
        assert_eq!(Acceleration::from_mm_per_s2(1_000.0), Ok(Acceleration(100_000)));
        assert_eq!(SignedAcceleration::from_mm_per_s2(-1_000.0), Ok(SignedAcceleration(-100_000)));
        assert_eq!(Jerk::from_mm_per_s3(1_000.0), Ok(Jerk(10_000)));
        assert_eq!(Current::from_ma(-1_000.0), Ok(Current(-1_000)));
        assert_eq!(ShortCurrent::from_ma(1_000.0), Ok(ShortCurrent(1_000)));
        assert_eq!(CurrentLimit::from_ma(1_000.0), Ok(CurrentLimit(1_000)));
        assert_eq!(Force::from_n(-1.0), Ok(Force(-10)));
        assert_eq!(CurveTime::from_ms(1_000.0), Ok(CurveTime(100_000)));
        assert_eq!(WaitTime::from_ms(1_000.0), Ok(WaitTime(10_000)));
        assert_eq!(TimeScale::from_percent(200.0).map(TimeScale::wire), Ok(20_000));
        assert_eq!(AmplitudeScale::from_percent(-2_000.0).map(AmplitudeScale::wire), Ok(-20_000));
        assert_eq!(Position(-57).mm(), -0.0057);
        // Rounded, not truncated as by other masters: 0.57 mm became 5699, 2.01 m/s became 2009999.
        assert_eq!(Position::from_mm(0.57), Ok(Position(5_700)));
        assert_eq!(Position::from_mm(-0.00006), Ok(Position(-1)));
        assert_eq!(Velocity::from_mm_per_s(2_010.0), Ok(Velocity(2_010_000)));
        assert_eq!(Jerk(5).mm_per_s3(), 0.5);
    }

    #[test]
    fn a_value_out_of_range_is_refused_in_user_units() {
        let error = Position::from_mm(214_748.364_8).unwrap_err();
        assert_eq!((error.value, error.unit), (214_748.364_8, "mm"));
        assert_eq!((error.low, error.high), (-214_748.364_8, 214_748.364_7));
        assert!(Position::from_mm(214_748.364_7).is_ok());
        assert!(Velocity::from_mm_per_s(-0.001).is_err() && Velocity::from_mm_per_s(f64::NAN).is_err());
        assert!(Acceleration::from_mm_per_s2(f64::INFINITY).is_err());
        assert!(TimeScale::from_percent(200.01).is_err() && AmplitudeScale::from_percent(2_000.1).is_err());
        assert!(Force::from_n(3_276.8).is_err() && CurrentLimit::from_ma(-1.0).is_err());
        assert!(EntryId::new(0).is_err() && EntryId::new(1).is_ok() && EntryId::new(255).is_ok());
        assert_eq!(
            EntryId::new(256).unwrap_err().to_string(),
            "256 as a number is outside the range of the drive (1 ... 255): give a value inside it"
        );
        assert!(CurveId::new(0).is_err() && CurveId::new(100).is_ok() && CurveId::new(101).is_err());
        assert!(ControllerSet::new(1).is_ok() && ControllerSet::new(2).is_err());
    }

    proptest! {
        #[test]
        fn any_wire_integer_comes_back_from_user_units(index in any::<prop::sample::Index>(), value in any::<i64>()) {
            let kind = *index.get(Kind::ALL);
            let (low, high) = kind.range();
            let wire = low + value.rem_euclid(high - low + 1);
            prop_assert_eq!(kind.wire(kind.user(wire)), Ok(wire));
            prop_assert_eq!(kind.check(wire), Ok(()));
            prop_assert!(kind.check(low - 1).is_err() && kind.check(high + 1).is_err());
        }
    }
}
