//! Enums that know their list of variants.

/// Defines an enum of unit variants with `ALL`, the list of its variants in their order. Not part of the interface: this
/// crate and the program share it.
#[doc(hidden)]
#[macro_export]
macro_rules! listed {
    ($(#[$of_enum:meta])* $visible:vis enum $name:ident { $($(#[$of_variant:meta])* $variant:ident,)+ }) => {
        $(#[$of_enum])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        $visible enum $name { $($(#[$of_variant])* $variant,)+ }

        impl $name {
            /// All variants, in the order of their definition.
            $visible const ALL: [Self; [$(stringify!($variant)),+].len()] = [$(Self::$variant),+];
        }
    };
}
