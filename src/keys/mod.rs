//! The keys of a configuration, below the protocols: a table read key by key, and what all drives and all machines have
//! in common. A protocol reads its own keys in its `config`; [`config`](crate::config) reads a whole file.
//!
//! | file | what |
//! |---|---|
//! | `file` | a file as text |
//! | `page` | its lines, and the mistakes found so far |
//! | `table` | a table, read key by key; unknown keys, ranges, words, places of mistakes |
//! | `form` | what a key takes, and a record of all keys: what the schema is made from |
//! | `value` | times with units, addresses, did-you-mean |
//! | `error` | the mistakes |
//! | `machine` | what must be unique in a machine |
//! | `bus` | the drives of a bus over its defaults, and their addresses |
//! | `drive` | the keys that every `[[bus.drive]]` has |

pub mod bus;
pub mod drive;
pub mod error;
pub mod file;
pub mod form;
pub mod machine;
pub mod page;
pub mod table;
pub mod value;
