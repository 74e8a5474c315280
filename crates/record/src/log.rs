//! The log of the loop's inputs in a recording: where it is, what describes its machine, and its records.
//!
//! | file | what |
//! |---|---|
//! | `layout` | where the log is in a recording, and what describes its machine |
//! | `records` | the records of a recording, as far as they are sound |

pub mod layout;
pub mod records;
