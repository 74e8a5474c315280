//! Another master of a Unidrive, by values that do not stay as they were written.
//!
//! The drive answers each client by itself: requests of another master are never seen here. What it writes is seen in
//! the control word and the reference. FC23 writes before it reads, so that its answer shows our own values whoever
//! else writes; now and then an exchange only reads instead. A value that the drive has accepted, and that reads as
//! another one before anything was written again, was written by somebody else.
//!
//! A keypad, too, can change a parameter. Its control word nobody edits several times within a moment, so that a few
//! changes of it are proof; of the reference many are needed, in a row, each after our own value stood there again.
//! Status and trips are no evidence: terminals, keypad and the drive itself change them. But they are a reason to look:
//! a drive that leaves operation without a trip is reported only after a read has shown that our control word still
//! stands, or the hardware enable would be blamed for what another master has done.

use super::mapping::Role;
use fieldbeat_core::time::{S, Time};

/// One of so many exchanges that write is followed by one that only reads ...
const CHECK_EVERY: u8 = 16;
/// ... and each of them while there is a suspicion: for so many checks without a finding.
const EAGER_CHECKS: u8 = 8;
/// The number of changes of the control word within this time, ns, that are proof ...
const CONTROL_CHANGES: u8 = 3;
const WITHIN_NS: u64 = 2 * S;
/// ... and so many of the reference, in checks in a row.
const REFERENCE_CHANGES: u8 = 6;
/// ... or so many before anything was written here, when nothing is at stake but the start.
const FOUND_CHANGES: u8 = 3;
/// A drive that has left operation is reported after so many exchanges at the latest.
const DOUBT_EXCHANGES: u8 = 12;

/// The watch for another master's values. What each exchange touches comes first.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub(super) struct OtherMaster {
    /// Exchanges that wrote since the last one that only read.
    writes: u8,
    /// Checks that are still to follow each write.
    eager: u8,
    /// Changes of the control word since `first`; changes of the reference in a row.
    control: u8,
    reference: u8,
    doubt: Doubt,
    /// The next check reads the reference, where that is not read with the control word.
    turn: bool,
    first: Time,
    /// The values of the drive while nothing is written here: control word and reference.
    found: [Option<i32>; 2],
}

/// Whether a drive that was commanded to run has left operation by itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Doubt {
    #[default]
    None,
    /// It has, and its control word was not read since: for so many exchanges.
    Open(u8),
    /// It has, although our control word stands.
    Cleared,
}

impl OtherMaster {
    /// The next exchange shall only read.
    #[inline]
    pub(super) fn is_check_due(&self) -> bool {
        let every = if self.eager > 0 || matches!(self.doubt, Doubt::Open(_)) { 1 } else { CHECK_EVERY };
        self.writes >= every
    }

    /// An exchange went out.
    #[inline]
    pub(super) fn sent(&mut self, writes: bool) {
        self.turn ^= !writes;
        if writes && self.writes == 0 {
            self.found = [None; 2];
        }
        self.writes = if writes { self.writes.saturating_add(1) } else { 0 };
    }

    /// An exchange that only read has shown our values: the control word, the reference, or both.
    pub(super) fn same(&mut self, control: bool, reference: bool) {
        self.eager = self.eager.saturating_sub(1);
        if control && matches!(self.doubt, Doubt::Open(_)) {
            self.doubt = Doubt::Cleared;
        }
        if reference {
            self.reference = 0;
        }
    }

    /// Values that the drive had accepted have changed. True if that proves another master.
    pub(super) fn changed(&mut self, at: Time, control: bool, reference: bool) -> bool {
        self.eager = EAGER_CHECKS;
        if control {
            if self.control == 0 || at.since(self.first) > WITHIN_NS {
                (self.control, self.first) = (0, at);
            }
            self.control += 1;
        }
        self.reference += u8::from(reference);
        let most = if self.found == [None; 2] { REFERENCE_CHANGES } else { FOUND_CHANGES };
        let proved = self.control >= CONTROL_CHANGES || self.reference >= most;
        if proved {
            (self.control, self.reference) = (0, 0);
        }
        proved
    }

    /// The values of a drive that this master only reads: control word and reference, as far as they were read. True
    /// if they prove another master, by the same count.
    pub(super) fn read(&mut self, at: Time, values: [Option<i32>; 2]) -> bool {
        let mut changes = [None; 2];
        for ((change, found), value) in changes.iter_mut().zip(&mut self.found).zip(values) {
            if let Some(value) = value {
                *change = found.replace(value).map(|before| before != value);
            }
        }
        self.same(changes[0] == Some(false), changes[1] == Some(false));
        let [control, reference] = changes.map(|change| change == Some(true));
        (control || reference) && self.changed(at, control, reference)
    }

    /// The word that the next check reads, if it cannot read both.
    pub(super) fn check(&self) -> Role {
        let reference = self.reference > 0 || self.turn && self.control == 0;
        if reference && !self.is_in_doubt() { Role::Reference } else { Role::Control }
    }

    /// Whether the report of a drive has to wait until its control word was read: `may` it be in doubt, since it is
    /// commanded to run and is off without a trip; `begins`: that is new.
    pub(super) fn doubts(&mut self, may: bool, begins: bool) -> bool {
        self.doubt = match self.doubt {
            _ if !may => Doubt::None,
            Doubt::None if begins => Doubt::Open(0),
            Doubt::Open(exchanges) if exchanges >= DOUBT_EXCHANGES => Doubt::Cleared,
            Doubt::Open(exchanges) => Doubt::Open(exchanges + 1),
            same => same,
        };
        self.is_in_doubt()
    }

    /// The report waits.
    #[inline]
    pub(super) fn is_in_doubt(&self) -> bool {
        matches!(self.doubt, Doubt::Open(_))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::time::MS;

    /// The check, at 100 Hz, that proves another master: whether control word and reference have changed.
    fn proof(checks: impl IntoIterator<Item = (bool, bool)>) -> Option<usize> {
        let mut other = OtherMaster::default();
        checks.into_iter().enumerate().position(|(n, (control, reference))| {
            other.same(!control, !reference);
            (control || reference) && other.changed(Time(S + n as u64 * 10 * MS), control, reference)
        })
    }

    #[test]
    fn three_changes_of_the_control_word_within_two_seconds_are_proof() {
        assert_eq!(proof([(true, false); 9]), Some(2));
        assert_eq!(proof((0..900).map(|n| (n % 90 == 0, false))), Some(180));
        assert_eq!(proof((0..900).map(|n| (n % 101 == 0, false))), None, "now and then somebody edits it");
    }

    #[test]
    fn only_many_reference_changes_in_a_row_prove_another_master() {
        assert_eq!(proof([(false, true); 9]), Some(5));
        assert_eq!(proof((0..900).map(|n| (false, n % 6 != 0))), None, "a key that is held");
    }

    #[test]
    fn an_exchange_that_only_reads_comes_now_and_then_and_often_on_a_suspicion() {
        let mut other = OtherMaster::default();
        let checks = |other: &mut OtherMaster, exchanges: usize| {
            (0..exchanges)
                .filter(|_| {
                    let check = other.is_check_due();
                    other.sent(!check);
                    if check {
                        other.same(true, true);
                    }
                    check
                })
                .count()
        };
        assert_eq!(checks(&mut other, 170), 10);
        assert!(!other.changed(Time(S), true, false));
        assert_eq!(checks(&mut other, 16), 8);
        assert_eq!(checks(&mut other, 17), 1);
    }

    #[test]
    fn a_drive_that_leaves_operation_is_reported_once_its_control_word_was_read_or_after_a_while() {
        let mut other = OtherMaster::default();
        assert!(!other.doubts(true, false));
        assert!(other.doubts(true, true) && other.doubts(true, false));
        other.sent(true);
        assert!(other.is_check_due());
        other.same(false, true);
        assert!(other.doubts(true, true), "its control word was not read");
        other.same(true, false);
        assert!(!other.doubts(true, true));
        assert!(!other.doubts(false, false), "it runs again");
        assert_eq!((0..50).take_while(|_| other.doubts(true, true)).count(), 13);
    }

    #[test]
    fn a_drive_commanded_by_another_master_is_detected_before_anything_is_written() {
        let proof = |values: fn(i32) -> (i32, i32)| {
            let mut other = OtherMaster::default();
            let read = |n: i32| [values(n).0, values(n).1].map(Some);
            (0..50).position(|n| other.read(Time(S + n as u64 * 10 * MS), read(n)))
        };
        assert_eq!(proof(|n| (0x181, n)), Some(3));
        assert_eq!(proof(|n| (0x180 + n % 2, 500)), Some(3));
        assert_eq!(proof(|_| (0x183, 500)), None, "a dead one has left it so");
        assert_eq!(proof(|n| (0x183, 500 + n / 10)), None, "somebody turns it up by its keypad");
    }
}
