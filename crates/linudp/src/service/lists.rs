//! The parameters that a drive has, and those that differ from their defaults.

use super::log::plain;
use super::{Progress, ServiceError, Services, USUAL, Watcher, describe};
use crate::upid::{Upid, Usage, call};
use crate::wire::{Refusal, RtcCommand};
use fieldbeat_core::axis::acyclic::{Answer, CallError};

/// The most pieces of a text.
const LONGEST_TEXT: u16 = 16;

/// One parameter of a list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ListItem {
    /// The number.
    pub upid: Upid,
    /// How it can be used.
    pub usage: Usage,
}

impl Services<'_> {
    /// All parameters from `first` on.
    pub fn upids(&self, first: Upid, watch: Watcher<'_>) -> Result<Vec<ListItem>, ServiceError> {
        let items = self.list(RtcCommand::START_LIST, RtcCommand::NEXT_ITEM, first, watch)?;
        let item = |answer: &Answer| ListItem {
            upid: Upid(answer.address as u16),
            usage: Usage(answer.value as u16),
        };
        Ok(items.iter().map(item).collect())
    }

    /// Those from `first` on whose value in ROM is not their default, with that value.
    pub fn modified_upids(&self, first: Upid, watch: Watcher<'_>) -> Result<Vec<(Upid, u32)>, ServiceError> {
        let (start, next) = (RtcCommand::START_MODIFIED_LIST, RtcCommand::NEXT_MODIFIED_ITEM);
        let items = self.list(start, next, first, watch)?;
        Ok(items.iter().map(|answer| (Upid(answer.address as u16), answer.value as u32)).collect())
    }

    /// A text, from its first four bytes on: the pieces are at consecutive UPIDs.
    pub fn text(&self, first: Upid) -> Result<String, ServiceError> {
        let mut bytes = Vec::new();
        for piece in 0..LONGEST_TEXT {
            let upid = first.0.saturating_add(piece);
            match self.command(call(RtcCommand::READ_RAM, upid, 0), USUAL) {
                Ok(answer) => bytes.extend((answer.value as u32).to_le_bytes()),
                // It ends where the next UPID is none.
                Err(error) if piece > 0 && error.refusal() == Some(Refusal::NoSuchUpid) => break,
                Err(ServiceError::Call { error: error @ CallError::Refused(_), .. }) => {
                    return Err(self.failed(format!("text at {first}"), error));
                }
                Err(error) => return Err(error),
            }
            if bytes.ends_with(&[0]) {
                break;
            }
        }
        Ok(plain(&bytes))
    }

    /// Progress is measured by the UPID numbers passed: no drive reports how many parameters it has.
    fn list(
        &self,
        start: RtcCommand,
        next: RtcCommand,
        first: Upid,
        watch: Watcher<'_>,
    ) -> Result<Vec<Answer>, ServiceError> {
        self.command(call(start, first.0, 0), USUAL)?;
        let (more, mut items) = (vec![call(next, 0, 0); self.at_once()], Vec::new());
        // There are no more UPIDs than numbers of 16 bits; a longer list is refused.
        while items.len() <= usize::from(u16::MAX) {
            let series = self.carrier.run(&more, USUAL);
            items.extend(series.answers);
            match series.failed {
                None => {
                    let done = items.last().map_or(first.0, |item: &Answer| item.address as u16).into();
                    let progress = Progress { what: "list", done, of: usize::from(u16::MAX) + 1 };
                    self.go_on(watch, progress, || "listing its parameters".to_owned())?;
                }
                Some(CallError::Refused(status)) if Refusal::of(status as u8) == Refusal::EndOfList => {
                    return Ok(items);
                }
                Some(error @ CallError::Refused(_)) => return Err(self.failed(next.to_string(), error)),
                Some(error) => return Err(self.failed(describe(more.first()), error)),
            }
        }
        Err(self.content(next.to_string(), "a list without an end".to_owned()))
    }
}
