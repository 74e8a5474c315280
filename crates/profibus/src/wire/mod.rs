//! PROFIBUS DP-V0 and DP-V1 to Lenze drives, the master's side: bytes <-> values.
//!
//! Knows no state, clock or port, allocates nothing, and panics on no bytes. What a telegram means to whoever sent the
//! request is not decided here.
//!
//! | file | what |
//! |---|---|
//! | `telegram` | SD1, SD2, SD3, SD4 and SC: the next one in what has arrived, and those that are sent |
//! | `fc` | the function code of a telegram |
//! | `sap` | service access points, and which service is at which |
//! | `dp` | Slave_Diag, Set_Prm, Chk_Cfg, Get_Cfg, Global_Control |
//! | `msac1` | acyclic reading and writing of records by DP-V1 |
//! | `job` | a job in the parameter channel, and what values are |
//! | `pkw` | parameters in the process data, as the vendor's page draws them (path A) |
//! | `drivecom` | parameters in the process data, by DRIVECOM (path B) |
//! | `base_mode` | parameters in the record 47 (path C) |
//! | `errors` | the error numbers of paths A and C by name |
//! | `words` | control and status words of DRIVECOM and PROFIdrive |
//!
//! All values are big-endian. "Sheet" is the project's fact sheet of the EMF2133IB; a fact that it marks `?` is marked
//! *assumed*.

pub mod base_mode;
pub mod dp;
pub mod drivecom;
pub mod errors;
pub mod fc;
pub mod job;
pub mod msac1;
pub mod pkw;
pub mod sap;
pub mod telegram;
pub mod words;

use fieldbeat_core::bus::reader::Reader;

/// Writes values into the data unit of a telegram, in place. What does not fit makes the whole telegram none.
#[derive(Debug)]
pub struct Writer<'a> {
    out: &'a mut [u8],
    /// Bytes written, or that would have been.
    at: usize,
}

impl<'a> Writer<'a> {
    /// Writes from the start of `out`.
    pub fn new(out: &'a mut [u8]) -> Writer<'a> {
        Writer { out, at: 0 }
    }

    /// Appends bytes.
    #[inline]
    pub fn bytes(&mut self, bytes: &[u8]) {
        let end = self.at.saturating_add(bytes.len());
        if let Some(room) = self.out.get_mut(self.at..end) {
            room.copy_from_slice(bytes);
        }
        self.at = end;
    }

    /// Appends 16 bits.
    #[inline]
    pub fn word(&mut self, word: u16) {
        self.bytes(&word.to_be_bytes());
    }

    /// Appends a byte that counts what `fill` writes, and that; fails over 255.
    fn counted(&mut self, fill: impl FnOnce(&mut Writer<'_>)) {
        let length = self.at;
        self.bytes(&[0]);
        let start = self.at;
        fill(self);
        match (u8::try_from(self.at - start), self.out.get_mut(length)) {
            (Ok(count), Some(at)) => *at = count,
            _ => self.fail(),
        }
    }

    /// Marks the written telegram as none, whatever follows.
    fn fail(&mut self) {
        self.at = usize::MAX;
    }

    /// How many bytes were written; `None` if they did not fit.
    #[inline]
    pub fn finish(self) -> Option<usize> {
        (self.at <= self.out.len()).then_some(self.at)
    }
}

#[cfg(test)]
mod tests;
