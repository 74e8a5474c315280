//! Which request a reply answers.
//!
//! LinUDP has no sequence number. A reply counts by its sender, by the echo of both definitions, and by the open
//! exchange. By default the response definition changes from request to request ([`ReplyTag`]), so that a reply that is
//! one to seven exchanges late echoes another one. A reply that could be that of a missed exchange all the same is
//! *suspect*: taken as feedback one cycle older, without a round-trip sample. The request after it requests one block
//! more or less, so that its echo is its own. With `reply_tag = "count"` a real-time-config no-operation carries a new
//! count in every request and its echo names the request.
//!
//! Requests do not wait for replies. An exchange that is owed when the next request leaves stays open for
//! `reply_within` cycles, and a reply that echoes it answers it: of so few exchanges no two have the same echo. A
//! request that has no echo of its own is answered in its own window only.
//!
//! What comes between two windows and answers no open exchange answers nothing: the bus takes it in before the next
//! request leaves. What is left is an answered exchange whose reply comes once more, eight exchanges late, between a
//! request and the reply to it: it passes for the newest. So no single reply proves that a command is done, or that the
//! drive has lost its power ([`profile`](super::super::profile)).

use std::mem::offset_of;

use crate::plan::ReplyTag;
use crate::profile::Carried;
use crate::wire::{Request, RequestDef, ResponseDef, ResponseView};
use fieldbeat_core::bus::MOST_EARLIER;
use fieldbeat_core::time::Time;

/// The blocks that come in turn, so that consecutive response definitions differ: the ones that a cycle can do without.
/// The error code comes with every second reply: that there is an error stands in the status word of each.
const IN_TURN: [ResponseDef; 3] = [ResponseDef::ERROR, ResponseDef::WARN, ResponseDef::MONITOR];

/// For each turn the blocks that its response definition has or lacks, unlike that of the first one.
static TURNED: [u16; 1 << IN_TURN.len()] = {
    let (mut turned, mut turn) = ([0; 1 << IN_TURN.len()], 1_usize);
    while turn < turned.len() {
        let without_lowest = turn & (turn - 1);
        turned[turn] = turned[without_lowest] | IN_TURN[turn.trailing_zeros() as usize].0 as u16;
        turn += 1;
    }
    turned
};

/// The most requests whose replies may still be under way: older ones count as lost ...
const MOST_UNDER_WAY: u8 = 32;
/// ... and are written off after so many exchanges without a miss: no reply takes that long.
const FORGOTTEN_AFTER: u8 = 16;

/// The identity of the reply to the last request. The part that each exchange touches comes first: it shares a
/// line of the cache with what stands before it in the station.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub(super) struct Identity {
    /// The echo of the prepared request.
    pub(super) prepared: Echo,
    /// The echo of the last request sent.
    pub(super) requested: Echo,
    /// The response definition of the first turn, and the blocks by which the requests of one kind differ.
    usual: u16,
    varies: u16,
    /// The number of response definitions that take turns, and the place of the next one.
    turns: u8,
    turn: u8,
    last: Last,
    /// Replies to earlier requests that may still come: such a one is late and no duplicate.
    under_way: u8,
    /// Those among them that were sent since the last clean reply. If there are as many as definitions, one of them
    /// looks like the reply to the next request: that reply is suspect.
    mistakable: u8,
    /// Exchanges without a miss since the last one.
    without_miss: u8,
    /// A reply was suspect: the next request that is built differs from those before it. Its reply cannot be mistaken
    /// for theirs, which may still come.
    odd_due: bool,
    /// The number of cycles after that of its request in which a reply counts, if its echo is that of no other request.
    beyond: u8,
    /// Of the requests whose replies may still come those that have none yet, by their definitions that take turns, or
    /// by their counts: a bit each. What comes to any other one is a duplicate.
    unanswered: u16,
    /// Older ones among them: no request of the round of definitions behind them has a reply either.
    older: u8,
    /// The block that a request behind a suspect reply has or lacks.
    odd: u16,
    /// The kinds of the requests before the last one, newest first, without repetitions in a row: as far back as late
    /// replies come from while the link is still online.
    requested_before: [Echo; 3],
}

/// Exchanges that were owed when the next request left, oldest first: they may be over since.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct EarlierRequests {
    requests: [EarlierRequest; MOST_EARLIER],
    count: u8,
}

/// The last exchange.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Last {
    /// No reply has closed it.
    Open,
    /// A reply has.
    #[default]
    Closed,
    /// A suspect one has.
    Suspect,
}

impl Last {
    fn answered(suspect: bool) -> Last {
        if suspect { Last::Suspect } else { Last::Closed }
    }
}

/// A request whose reply may come after newer ones have left.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct EarlierRequest {
    pub(super) echo: Echo,
    /// When it was sent.
    pub(super) sent_at: Time,
    /// The contents of it and of those before it.
    pub(super) carried: Carried,
}

/// The echo of a request in its reply: the definitions, as far as this master has blocks for their bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Echo {
    response: u16,
    request: u8,
    /// The count of the real-time-config block, if it was chosen to distinguish the reply from others, or [`NO_TAG`].
    tag: u8,
}

/// No count comes to this.
const NO_TAG: u8 = u8::MAX;

impl Default for Echo {
    fn default() -> Echo {
        Echo { response: 0, request: 0, tag: NO_TAG }
    }
}

impl Echo {
    /// That of a request of this master.
    #[inline]
    pub(super) fn new(request: &Request, tag: Option<u8>) -> Echo {
        let (request, response) = (request.definition().0 as u8, request.response_def.0 as u16);
        Echo { response, request, tag: tag.unwrap_or(NO_TAG) }
    }

    /// The definitions of a reply; `None`: no request of this master has such ones.
    fn of(view: &ResponseView<'_>) -> Option<Echo> {
        let (request, response) =
            (view.request_def().0.try_into().ok()?, view.response_def().0.try_into().ok()?);
        Some(Echo { response, request, tag: NO_TAG })
    }

    fn tag(self) -> Option<u8> {
        Some(self.tag).filter(|tag| *tag != NO_TAG)
    }

    /// The request carries a motion command.
    #[inline]
    pub(super) fn has_motion(self) -> bool {
        RequestDef(self.request.into()).contains(RequestDef::MOTION)
    }

    #[inline]
    fn is_that_of(self, view: &ResponseView<'_>) -> bool {
        let definitions = (RequestDef(self.request.into()), ResponseDef(self.response.into()));
        (view.request_def(), view.response_def()) == definitions
            && (self.tag == NO_TAG || view.config().map(|config| config.count()) == self.tag())
    }
}

impl EarlierRequests {
    /// This one is owed as the next one leaves.
    pub(super) fn owe(&mut self, request: EarlierRequest) {
        if usize::from(self.count) == MOST_EARLIER {
            self.forget(0);
        }
        if let Some(room) = self.requests.get_mut(usize::from(self.count)) {
            *room = request;
            self.count += 1;
        }
    }

    fn owed(&self) -> &[EarlierRequest] {
        &self.requests[..usize::from(self.count)]
    }

    /// The place of the request of an earlier cycle that this reply echoes, the newest one first.
    pub(super) fn find(&self, view: &ResponseView<'_>) -> Option<(usize, EarlierRequest)> {
        let mut found =
            self.owed().iter().enumerate().rev().filter(|(_, earlier)| earlier.echo.is_that_of(view));
        found.next().map(|(place, earlier)| (place, *earlier))
    }

    /// The exchange at this place is over.
    pub(super) fn forget(&mut self, place: usize) {
        self.requests.copy_within(place + 1..usize::from(self.count), place);
        self.count -= 1;
    }
}

/// The kind of a reply that closes no exchange in its window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unrequested {
    /// The requested reply, behind a late one that was taken for it in the same window.
    Second {
        /// There may be more of them.
        suspect: bool,
    },
    /// The reply to an earlier request.
    Late,
    /// A second reply to one request.
    Duplicate,
    /// To something that was not requested.
    Foreign,
}

impl Identity {
    /// The bytes that each exchange touches.
    pub(super) const TOUCHED: usize = offset_of!(Identity, unanswered);

    /// Of a drive whose requests usually request these blocks, and whose replies count so many cycles `beyond` their
    /// own; `shown`: its monitoring channels come in each reply.
    pub(super) fn new(usual: ResponseDef, reply_tag: ReplyTag, shown: bool, beyond: u8) -> Identity {
        let turning = reply_tag == ReplyTag::Definition;
        // The last block in turn stays if it is shown.
        let blocks = &IN_TURN[..if turning { IN_TURN.len() - usize::from(shown) } else { 0 }];
        let odd = if turning { ResponseDef::CURRENT } else { ResponseDef::MONITOR };
        let varies =
            if turning { blocks.iter().fold(odd, |all, block| all.with(*block)) } else { ResponseDef::NONE };
        let [usual, varies, odd] = [usual, varies, odd].map(|definition| definition.0 as u16);
        Identity { turns: 1 << blocks.len(), usual, varies, odd, beyond, ..Identity::default() }
    }

    /// The response definition of this turn.
    #[inline]
    fn in_turn(&self, turn: u8) -> u16 {
        self.usual ^ TURNED[usize::from(turn) % TURNED.len()]
    }

    /// The blocks that the next request requests.
    #[inline]
    pub(super) fn response_def(&self) -> ResponseDef {
        let usual = self.in_turn(self.turn);
        // After a suspect reply the definition differs from the earlier ones, so that the echo distinguishes its reply
        // from all late ones: if they were always one cycle behind, each would pass for the newest for ever.
        ResponseDef(u32::from(if self.odd_due { usual ^ self.odd } else { usual }))
    }

    /// The prepared request has gone out.
    #[inline]
    pub(super) fn sent(&mut self) {
        if self.last != Last::Closed || self.under_way > 0 || self.without_miss < FORGOTTEN_AFTER {
            self.count();
        }
        self.last = Last::Open;
        // The prepared one may have been built before that was known.
        if self.odd_due && self.is_odd(self.prepared) {
            self.odd_due = false;
        }
        // A power of two.
        self.turn = (self.turn + 1) & (self.turns - 1);
        if !self.is_same_kind(self.requested, self.prepared) {
            self.requested_before.rotate_right(1);
            self.requested_before[0] = self.kind(self.requested);
        }
        self.requested = self.prepared;
    }

    /// The replies that may still be under way as the next request goes out.
    #[inline(never)]
    fn count(&mut self) {
        if self.is_open() {
            self.unanswered |= self.bit(self.turn.wrapping_sub(1) & (self.turns - 1), self.requested.tag());
            self.under_way = (self.under_way + 1).min(MOST_UNDER_WAY);
            self.mistakable = (self.mistakable + 1).min(MOST_UNDER_WAY);
            self.without_miss = 0;
        } else if self.without_miss < FORGOTTEN_AFTER {
            self.without_miss += 1;
        } else {
            (self.under_way, self.unanswered, self.older) = (0, 0, 0);
        }
        if self.turns > 1 && self.unanswered == (1 << self.turns) - 1 {
            self.older = (self.older + 1).min(MOST_UNDER_WAY);
        }
        // The next reply with its echo is its own.
        self.unanswered &= !self.bit(self.turn, self.prepared.tag());
    }

    /// The bit of a request in this turn, or with this count; 0: all have the same echo.
    fn bit(&self, turn: u8, tag: Option<u8>) -> u16 {
        match tag {
            Some(count) => 1 << (count & 0xF),
            None if self.turns > 1 => 1 << turn,
            None => 0,
        }
    }

    /// That of the request which a reply echoes.
    fn bit_of(&self, response: u16, tag: Option<u8>) -> u16 {
        let blocks = self.varies & !self.odd;
        let turn = (0..self.turns).find(|turn| (self.in_turn(*turn) ^ response) & blocks == 0);
        self.bit(turn.unwrap_or(0), tag)
    }

    /// The last exchange has no reply yet.
    pub(super) fn is_open(&self) -> bool {
        self.last == Last::Open
    }

    /// The reply can be that to the last request.
    #[inline]
    pub(super) fn is_answered_by(&self, view: &ResponseView<'_>) -> bool {
        self.requested.is_that_of(view)
    }

    /// The last request is answered; true: the reply may be that of an earlier one.
    #[inline]
    pub(super) fn answered(&mut self) -> bool {
        let named = self.requested.tag != NO_TAG;
        let suspect = !named && self.mistakable >= self.turns && !self.is_odd(self.requested);
        self.last = Last::answered(suspect);
        if suspect {
            self.odd_due = true;
        } else if !named {
            // Replies come in the order of their requests: after this one the earlier ones count as lost.
            self.mistakable = 0;
        }
        suspect
    }

    /// The number of cycles after its own in which the reply to the prepared request counts: none, if another one of
    /// the last requests has the same echo.
    #[inline]
    pub(super) fn beyond(&self) -> u8 {
        if self.turns > 1 || self.prepared.tag != NO_TAG { self.beyond } else { 0 }
    }

    /// The exchange at this place of `earlier` is answered; true: the reply may be that of an older one.
    pub(super) fn answer_earlier(&mut self, earlier: &mut EarlierRequests, place: usize) -> bool {
        let echo = earlier.requests[place].echo;
        let suspect = echo.tag == NO_TAG && !self.is_odd(echo) && self.mistakable >= self.turns;
        earlier.forget(place);
        if suspect {
            // One at a time: of two their replies could be mistaken.
            let is_odd_owed = earlier.owed().iter().any(|earlier| self.is_odd(earlier.echo));
            self.odd_due |= !(is_odd_owed || self.is_open() && self.is_odd(self.requested));
        }
        if self.is_open() && echo == self.requested {
            // No request has left since.
            self.last = Last::answered(suspect);
            if !suspect {
                self.mistakable = 0;
            }
            return suspect;
        }
        self.take_late(self.bit_of(echo.response, echo.tag()));
        if !suspect {
            // Those before it count as lost; those behind it are under way. The open one is counted as the next leaves.
            let behind = earlier.owed().len().saturating_sub(place);
            self.mistakable = self.mistakable.min(behind as u8);
        }
        suspect
    }

    /// The request that has this echo differs from the usual ones.
    fn is_odd(&self, echo: Echo) -> bool {
        (echo.response ^ self.usual) & self.odd != 0
    }

    /// A reply that closes no exchange in its window.
    pub(super) fn unrequested(&mut self, view: &ResponseView<'_>, in_window: bool) -> Unrequested {
        let answers = self.is_answered_by(view);
        if answers && in_window && self.last == Last::Suspect {
            // Two replies in one window: the first was a late one. This one is the requested reply, unless there may be
            // more of them.
            self.take_late(0);
            let suspect = self.mistakable >= self.turns;
            self.last = Last::answered(suspect);
            self.odd_due |= suspect;
            return Unrequested::Second { suspect };
        }
        let named = self.requested.tag != NO_TAG || (self.turns > 1 && self.last != Last::Suspect);
        let Some(echo) = Echo::of(view).filter(|echo| self.knows(*echo)) else { return Unrequested::Foreign };
        if answers && self.is_open() {
            // The reply to the last request, after its window. It may arrive in the window of a cycle in which none
            // was due. The exchange was missed all the same.
            self.last = Last::Closed;
            self.without_miss = 0;
            return Unrequested::Late;
        }
        let tag = self.requested.tag().and_then(|_| Some(view.config()?.count()));
        let bit = self.bit_of(echo.response, tag);
        let is_owed = bit == 0 || self.unanswered & bit != 0 || self.older > 0;
        if self.under_way > 0 && is_owed && !(answers && named) {
            self.take_late(bit);
            return Unrequested::Late;
        }
        Unrequested::Duplicate
    }

    /// A reply to an earlier request has come.
    fn take_late(&mut self, bit: u16) {
        if bit != 0 && self.unanswered & bit == 0 {
            self.older = self.older.saturating_sub(1);
        }
        self.unanswered &= !bit;
        self.under_way = self.under_way.saturating_sub(1);
        self.mistakable = self.mistakable.saturating_sub(1);
    }

    /// The part that the echoes of all requests of this kind have in common.
    fn kind(&self, echo: Echo) -> Echo {
        Echo { response: echo.response & !self.varies, tag: NO_TAG, ..echo }
    }

    #[inline]
    fn is_same_kind(&self, one: Echo, other: Echo) -> bool {
        one.request == other.request && (one.response ^ other.response) & !self.varies == 0
    }

    /// The echo is that of a request of the last kinds that were sent.
    fn knows(&self, echo: Echo) -> bool {
        self.is_same_kind(echo, self.requested) || self.requested_before.contains(&self.kind(echo))
    }
}
