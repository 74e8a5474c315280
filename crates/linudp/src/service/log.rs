//! The error log and the texts of errors.

use super::{ServiceError, Services, USUAL};
use crate::upid::call;
use crate::wire::RtcCommand;
use fieldbeat_core::axis::acyclic::Call;

/// Entries that a drive keeps (LinUDP V2 manual: 0 ... 20).
const ENTRIES: u16 = 21;
/// A text is 8 pieces of 4 characters.
const PIECES: u32 = 8;

/// The drive's error log.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ErrorLog {
    /// Entries that it keeps.
    pub logged: u16,
    /// Errors that have ever occurred.
    pub occurred: u16,
    /// The entries, in the order in which the drive numbers them.
    pub entries: Vec<LoggedError>,
}

/// One entry of the error log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoggedError {
    /// The error code.
    pub code: u16,
    /// The text, from the drive.
    pub text: String,
    /// Operating hours when it occurred ...
    pub hours: u32,
    /// ... and ms beyond them.
    pub ms: u32,
}

impl Services<'_> {
    /// The error log.
    pub fn error_log(&self) -> Result<ErrorLog, ServiceError> {
        let counters = self.command(call(RtcCommand::ERROR_COUNTERS, 0, 0), USUAL)?.value as u32;
        let (logged, occurred) = (counters as u16, (counters >> 16) as u16);
        let mut entries = Vec::new();
        for entry in 0..logged.min(ENTRIES) {
            let of = |command| call(command, entry, 0);
            let commands = [RtcCommand::ERROR_CODE, RtcCommand::ERROR_TIME_LOW, RtcCommand::ERROR_TIME_HIGH];
            let answers = self.series(&commands.map(of), USUAL)?;
            let [code, low, high] =
                [0, 1, 2].map(|at| answers.get(at).map_or(0, |answer| answer.value as u32));
            // Low word first; the halves are milliseconds and hours, not one number.
            let code = code as u16;
            entries.push(LoggedError { code, text: self.error_text(code)?, hours: high, ms: low });
        }
        Ok(ErrorLog { logged, occurred, entries })
    }

    /// The drive's text of an error.
    pub fn error_text(&self, code: u16) -> Result<String, ServiceError> {
        let pieces: Vec<Call> = (0..PIECES).map(|piece| call(RtcCommand::ERROR_TEXT, code, piece)).collect();
        let answers = self.series(&pieces, USUAL)?;
        let bytes: Vec<u8> = answers.iter().flat_map(|answer| (answer.value as u32).to_le_bytes()).collect();
        Ok(plain(&bytes))
    }
}

/// ASCII up to the first zero; control characters for a terminal are removed.
pub(super) fn plain(bytes: &[u8]) -> String {
    let text = bytes.split(|byte| *byte == 0).next().unwrap_or_default();
    text.iter().map(|byte| char::from(*byte)).filter(|c| c.is_ascii_graphic() || *c == ' ').collect()
}
