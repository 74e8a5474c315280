//! What is wrong with a configuration: one line a mistake, all mistakes at once.

use std::error::Error;
use std::fmt;

use serde::Serialize;

/// One mistake. Its `Display` is the whole line, remedy included:
/// `machine.toml:12: bus.drive.divisor = 0: must be at least 1; 1 exchanges every cycle`.
#[derive(Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct ConfigError {
    /// The file, as it was named.
    pub file: String,
    /// The line, counted from 1; `None` = the file as a whole, and the message names it.
    pub line: Option<usize>,
    /// The key with its tables, `bus.drive.divisor`; `None` for a mistake of syntax.
    pub key: Option<String>,
    /// The value as written, shortened; `None` where there is none.
    pub value: Option<String>,
    /// What is wrong and what would be right.
    pub message: String,
}

impl ConfigError {
    /// One about the file as a whole.
    pub fn of_file(file: String, message: String) -> ConfigError {
        ConfigError { file, line: None, key: None, value: None, message }
    }
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(line) = self.line {
            write!(f, "{}:{line}: ", self.file)?;
        }
        match (&self.key, &self.value) {
            (Some(key), Some(value)) => write!(f, "{key} = {value}: ")?,
            (Some(key), None) => write!(f, "{key}: ")?,
            (None, _) => {}
        }
        f.write_str(&self.message)
    }
}

impl Error for ConfigError {}

/// All mistakes of a configuration in the order of the file, at least one. Its `Display` is one line each.
#[derive(Clone, PartialEq, Eq)]
pub struct ConfigErrors(Vec<ConfigError>);

impl ConfigErrors {
    /// Sorted by line, each line of text once: a mistake in `[bus.defaults]` is found with every drive.
    pub(super) fn new(mut mistakes: Vec<ConfigError>) -> ConfigErrors {
        mistakes.sort_by_key(|mistake| mistake.line);
        let mut errors: Vec<ConfigError> = Vec::with_capacity(mistakes.len());
        for mistake in mistakes {
            let mut same_line = errors.iter().rev().take_while(|known| known.line == mistake.line);
            if !same_line.any(|known| *known == mistake) {
                errors.push(mistake);
            }
        }
        ConfigErrors(errors)
    }

    /// The mistakes.
    pub fn iter(&self) -> std::slice::Iter<'_, ConfigError> {
        self.0.iter()
    }
}

impl From<ConfigError> for ConfigErrors {
    fn from(error: ConfigError) -> ConfigErrors {
        ConfigErrors(vec![error])
    }
}

impl fmt::Display for ConfigErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, error) in self.0.iter().enumerate() {
            if index > 0 {
                f.write_str("\n")?;
            }
            write!(f, "{error}")?;
        }
        Ok(())
    }
}

impl Error for ConfigErrors {}

fieldbeat_core::debug_as_display!(ConfigError, ConfigErrors);
