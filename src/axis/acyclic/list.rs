//! Lists of the parameters of a drive, as far as its protocol can make them.

use std::ops::ControlFlow;

use thiserror::Error;

use super::parameter::{Access, ParameterError};

/// Which parameters shall be listed.
#[derive(Clone, Copy, Debug, Default)]
pub struct Wanted<'a> {
    /// The drive's name, for messages.
    pub drive: &'a str,
    /// Those of one part, as a menu.
    pub part: Option<&'a str>,
    /// Only those whose value in flash is not the default.
    pub modified: bool,
    /// With their values.
    pub values: bool,
    /// Those from this address on.
    pub from: Option<&'a str>,
}

/// One parameter of a list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// Its address.
    pub address: String,
    /// Its name, if it is known.
    pub name: Option<&'static str>,
    /// Size or type, and access.
    pub usage: Option<String>,
    /// Its value, if that was wanted or comes with the list.
    pub raw: Option<u64>,
}

/// The progress of a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// The present activity.
    pub what: &'static str,
    /// Steps done ...
    pub done: usize,
    /// ... of so many.
    pub of: usize,
}

/// Receives the progress of a transfer; its return value can cancel it.
pub type Watcher<'a> = &'a mut dyn FnMut(Progress) -> ControlFlow<()>;

/// Makes a list by reading the drive.
pub type ReadList = dyn FnOnce(Access<'_>, Watcher<'_>) -> Result<Vec<Listed>, ListError>;

/// What a list needs.
pub enum Listing {
    /// Nothing: the list is known.
    Known(Vec<Listed>),
    /// The drive.
    Read(Box<ReadList>),
}

impl std::fmt::Debug for Listing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Listing::Known(rows) => f.debug_tuple("Known").field(rows).finish(),
            Listing::Read(_) => f.write_str("Read"),
        }
    }
}

/// Why there is no list.
#[derive(Clone, PartialEq, Eq, Error)]
pub enum ListError {
    /// Drives of this protocol do not list this; nothing was sent.
    #[error("{0}")]
    Wanted(String),
    /// A parameter was not read.
    #[error(transparent)]
    Parameter(#[from] ParameterError),
    /// The drive did not give its list.
    #[error("{0}")]
    Failed(String),
    /// It was cancelled.
    #[error("drive {drive}: reading its parameters was interrupted")]
    BrokenOff {
        /// The drive.
        drive: String,
    },
}
crate::errors::debug_as_display!(ListError);

/// Reports that `done` of `of` parameters are read; an error if that cancels the list.
pub(crate) fn go_on(access: Access<'_>, watch: Watcher<'_>, done: usize, of: usize) -> Result<(), ListError> {
    match watch(Progress { what: "read", done, of }) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(ListError::BrokenOff { drive: access.drive.to_owned() }),
    }
}
