//! The link layer: silence, damage, frame count bits.
