//! Which request a reply answers: transaction ids.

/// How many earlier requests are remembered; the reply to an older one is foreign.
const REMEMBERED: u32 = 64;

/// The request that a reply belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Whose {
    /// The open request.
    Open,
    /// An earlier request without a reply.
    Late,
    /// A request that has its reply already.
    Duplicate,
    /// No request of this connection.
    Foreign,
}

/// The requests of one connection. One is open at a time.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Identity {
    /// Bit n: the n-th request before the last one has its reply.
    answered: u64,
    /// The last sent request, 16 bits of its count. A whole word, like all of these: small neighbours are read
    /// together, and values just written in parts are slow to read as a whole.
    last: u32,
    /// The number of requests that went out on this connection, at most [`REMEMBERED`].
    sent: u32,
    /// Not 0: the last one has no reply yet.
    open: u32,
}

impl Identity {
    /// The id of the next request.
    #[inline]
    pub(super) fn next(&self) -> u16 {
        (self.last as u16).wrapping_add(1)
    }

    /// That request went out.
    #[inline]
    pub(super) fn sent(&mut self) {
        self.last = self.next().into();
        self.answered <<= 1;
        self.sent = (self.sent + 1).min(REMEMBERED);
        self.open = 1;
    }

    /// A request has no reply yet.
    #[inline]
    pub(super) fn is_open(&self) -> bool {
        self.open != 0
    }

    /// The id of the request that has no reply yet.
    #[inline]
    pub(super) fn open(&self) -> Option<u16> {
        self.is_open().then_some(self.last as u16)
    }

    /// The last request is not waited for any more: its reply would be late.
    pub(super) fn give_up(&mut self) {
        self.open = 0;
    }

    /// A new connection: no reply of the earlier one arrives on it, and no id is used again.
    pub(super) fn reconnected(&mut self) {
        (self.answered, self.sent, self.open) = (0, 0, 0);
    }

    /// The request that this id belongs to.
    #[inline]
    pub(super) fn whose(&self, id: u16) -> Whose {
        let before = self.before(id);
        match before {
            _ if before >= self.sent => Whose::Foreign,
            0 if self.is_open() => Whose::Open,
            _ if self.answered >> before & 1 == 0 => Whose::Late,
            _ => Whose::Duplicate,
        }
    }

    /// This request has its reply.
    #[inline]
    pub(super) fn answer(&mut self, id: u16) {
        let before = self.before(id);
        if before < self.sent {
            self.answered |= 1 << before;
        }
        if before == 0 {
            self.open = 0;
        }
    }

    /// The last request has its reply.
    #[inline]
    pub(super) fn answer_open(&mut self) {
        self.answered |= 1;
        self.open = 0;
    }

    /// The number of requests sent after the one with this id.
    #[inline]
    fn before(&self, id: u16) -> u32 {
        (self.last as u16).wrapping_sub(id).into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reply_is_that_of_its_request_once() {
        let mut identity = Identity::default();
        assert_eq!(identity.whose(0), Whose::Foreign);
        for round in 0..70_000_u32 {
            let id = identity.next();
            identity.sent();
            assert_eq!(identity.whose(id), Whose::Open);
            identity.answer(id);
            assert!(!identity.is_open());
            assert_eq!(identity.whose(id), Whose::Duplicate);
            assert_eq!(identity.whose(id.wrapping_add(1)), Whose::Foreign);
            let before = id.wrapping_sub(63);
            assert_eq!(identity.whose(before), if round < 63 { Whose::Foreign } else { Whose::Duplicate });
            assert_eq!(identity.whose(id.wrapping_sub(64)), Whose::Foreign);
        }
    }

    #[test]
    fn a_late_reply_is_none_of_the_open_request() {
        let mut identity = Identity::default();
        let first = identity.next();
        identity.sent();
        let second = identity.next();
        identity.sent();
        assert_eq!((identity.whose(first), identity.whose(second)), (Whose::Late, Whose::Open));
        identity.answer(first);
        assert_eq!((identity.whose(first), identity.whose(second)), (Whose::Duplicate, Whose::Open));
        assert!(identity.is_open());
        identity.reconnected();
        assert_eq!((identity.whose(first), identity.whose(second)), (Whose::Foreign, Whose::Foreign));
        assert_eq!(identity.next(), second.wrapping_add(1), "ids go on");
    }
}
