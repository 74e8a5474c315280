//! Enumerations whose values, numbers and names stand in one list.

/// Defines an enumeration with its numbers, a list of all values, and their names.
#[macro_export]
macro_rules! named {
    (
        $(#[$meta:meta])*
        pub enum $Name:ident { $($(#[$about:meta])* $Value:ident = $number:literal: $text:literal,)+ }
    ) => {
        $(#[$meta])*
        pub enum $Name { $($(#[$about])* $Value = $number,)+ }

        impl $Name {
            /// All of them, in the order of their numbers.
            pub const ALL: [$Name; [$($number),+].len()] = [$($Name::$Value),+];

            /// The name in messages and reports.
            pub const fn name(self) -> &'static str {
                match self { $($Name::$Value => $text,)+ }
            }
        }

        impl std::fmt::Display for $Name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(self.name())
            }
        }
    };
}
