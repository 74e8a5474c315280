//! The keys of a configuration, below the protocols: a table read key by key, and what all drives and all machines have
//! in common. A protocol reads its own keys in its `config`; `fieldbeat-config` reads a whole file.
//!
//! | file | what |
//! |---|---|
//! | `file` | a file as text |
//! | `page` | its lines, and the mistakes found so far |
//! | `table` | a table, read key by key; unknown keys, ranges, words, places of mistakes |
//! | `form` | what a key takes, and a record of all keys: what the schema is made from |
//! | `key` | the declaration of a key: its name, its default, what it is for |
//! | `value` | times with units, addresses, did-you-mean |
//! | `error` | the mistakes |
//! | `machine` | what must be unique in a machine |
//! | `bus` | the drives of a bus over its defaults, and their addresses |
//! | `drive` | the keys that every `[[bus.drive]]` has |
//! | `telegram` | telegrams of a protocol in a capture, and in words |
//! | `outline` | what a first configuration of a protocol has, and what is asked for it |

pub mod bus;
pub mod drive;
pub mod error;
pub mod file;
pub mod form;
pub mod key;
pub mod machine;
pub mod outline;
pub mod page;
pub mod table;
pub mod telegram;
pub mod value;

use fieldbeat_core::bus::BusPlan;

use crate::machine::Machine;
use crate::table::Table;

/// A protocol, as the readers of configurations find it: what it is called, and what it reads.
#[derive(Debug)]
pub struct Protocol {
    /// Its name in configurations.
    pub name: &'static str,
    /// The drives that have it, for people.
    pub drives: &'static str,
    /// Reads the keys of a `[[bus]]`. What is wrong is noted on the table.
    pub read: fn(&mut Table<'_>, &mut Machine) -> Box<dyn BusPlan>,
    /// What a first configuration of it has.
    pub outline: outline::Outline,
    /// What passes its wire, for captures.
    pub telegrams: &'static [telegram::Telegrams],
}
