//! PROFIBUS DP-V0 and DP-V1 to Lenze drives (EMF2133IB): one half-duplex wire, this master keeps the token.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |

pub(crate) mod wire;
