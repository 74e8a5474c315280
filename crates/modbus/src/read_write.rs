//! Whether a drive has FC23, as its answers show.
//!
//! No request is made only to find out: the first one that writes and reads shows it. A drive that refuses it, ignores
//! it or closes the connection on it, and answers FC03, is written by FC16 and read by FC03 from then on, on later
//! connections, too. Nothing is written twice or out of turn by that: of a refused request nothing was carried out, and
//! after a silence the next request writes the values of its own time, behind the silent one on the same connection.

use super::plan::Functions;
use super::wire::ExceptionCode;

/// The knowledge of one drive.
#[derive(Clone, Copy, Debug)]
pub(super) struct ReadWrite {
    used: bool,
    /// The configuration says which functions are used.
    fixed: bool,
    /// The registers of the largest request by FC23 that was answered, both directions together; 0: none was.
    answered: u16,
    /// One was ignored, and nothing was answered on that connection since: the drive may have been out of reach.
    suspected: bool,
    /// Connections that ended with such a suspicion.
    silences: u8,
    /// How often it was given up.
    given_up: u16,
}

/// After so many FC23 is given up: a server may answer nothing any more after a request that it does not know.
const MOST_SILENCES: u8 = 2;

impl ReadWrite {
    pub(super) fn new(functions: Functions) -> ReadWrite {
        let (used, fixed) = (functions != Functions::Apart, functions != Functions::Auto);
        ReadWrite { used, fixed, answered: 0, suspected: false, silences: 0, given_up: 0 }
    }

    /// FC23 is used.
    #[inline]
    pub(super) fn is_used(&self) -> bool {
        self.used
    }

    /// How often it was given up so far.
    #[inline]
    pub(super) fn given_up(&self) -> u16 {
        self.given_up
    }

    /// The configuration allows nothing else.
    pub(super) fn is_only(&self) -> bool {
        self.used && self.fixed
    }

    /// A request by FC23 for so many registers was answered.
    #[inline]
    pub(super) fn answered(&mut self, registers: u16) {
        self.answered = self.answered.max(registers);
    }

    /// It was answered, although it had been given up as ignored.
    pub(super) fn answered_late(&mut self) {
        self.used |= !self.fixed;
        self.answered(1);
    }

    /// An exception to a request by FC23 for so many registers; true: it is given up.
    pub(super) fn refused(&mut self, code: ExceptionCode, registers: u16) -> bool {
        match code {
            ExceptionCode::FUNCTION => self.give_up(),
            // The handshake has read these addresses: there are too many registers, for this function.
            ExceptionCode::ADDRESS if registers > self.answered => self.give_up(),
            _ => false,
        }
    }

    /// A request by FC23 was ignored; true: it is given up, until the connection shows whether anything is answered.
    pub(super) fn ignored(&mut self) -> bool {
        self.suspected = self.answered == 0 && self.give_up();
        self.suspected
    }

    /// The drive closed the connection on a request by FC23; true: it is given up.
    pub(super) fn closed(&mut self) -> bool {
        self.answered == 0 && self.give_up()
    }

    /// A request by another function was answered.
    pub(super) fn other_answered(&mut self) {
        self.suspected = false;
    }

    /// There is a new connection, on which FC03 is answered.
    pub(super) fn reconnected(&mut self) {
        if std::mem::take(&mut self.suspected) {
            self.silences += 1;
            self.used = self.silences < MOST_SILENCES;
        }
    }

    fn give_up(&mut self) -> bool {
        let gives_up = self.used && !self.fixed;
        self.used &= !gives_up;
        self.given_up = self.given_up.saturating_add(gives_up.into());
        gives_up
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drive_out_of_reach_is_tried_once_more() {
        let mut auto = ReadWrite::new(Functions::Auto);
        assert!(auto.ignored());
        auto.reconnected();
        assert!(auto.is_used() && auto.ignored());
        auto.reconnected();
        assert!(!auto.is_used());
    }

    #[test]
    fn a_drive_that_has_answered_is_only_believed_when_it_names_the_function_or_the_request_is_larger() {
        let mut auto = ReadWrite::new(Functions::Auto);
        auto.answered(14);
        assert!(!auto.ignored() && !auto.closed() && !auto.refused(ExceptionCode::ADDRESS, 14));
        assert!(auto.clone().refused(ExceptionCode::ADDRESS, 15));
        assert!(auto.refused(ExceptionCode::FUNCTION, 14) && !auto.is_used());
    }

    #[test]
    fn a_late_answer_brings_it_back_unless_the_configuration_says_otherwise() {
        let mut auto = ReadWrite::new(Functions::Auto);
        assert!(auto.ignored());
        auto.answered_late();
        assert!(auto.is_used() && !auto.ignored(), "it was slow");
        for (functions, used) in [(Functions::ReadWrite, true), (Functions::Apart, false)] {
            let mut fixed = ReadWrite::new(functions);
            assert!(!fixed.ignored() && !fixed.closed() && !fixed.refused(ExceptionCode::FUNCTION, 14));
            fixed.answered_late();
            assert_eq!(fixed.is_used(), used);
        }
    }
}
