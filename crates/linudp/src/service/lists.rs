//! The parameters that a drive has, and those that differ from their defaults.

use super::log::plain;
use super::{Progress, ServiceError, Services, Watcher};
use crate::upid::{Upid, Usage, call};
use crate::wire::{Refusal, RtcCommand};
use fieldbeat_core::axis::acyclic::Answer;

/// The most pieces of a text.
const LONGEST_TEXT: u16 = 16;

/// One parameter of a list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ListItem {
    /// Its number.
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
            let (answers, refused) = self.until_refused(&[call(RtcCommand::READ_RAM, upid, 0)])?;
            match (answers.first(), refused) {
                (Some(answer), _) => bytes.extend((answer.value as u32).to_le_bytes()),
                // It ends where the next UPID is none.
                (None, Some(Refusal::NoSuchUpid)) if piece > 0 => break,
                (None, refused) => {
                    let status = refused.map_or(0, |refusal| refusal.code().into());
                    let what = format!("text at {first}");
                    return Err(self.failed(what, fieldbeat_core::axis::acyclic::CallError::Refused(status)));
                }
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
        self.command(start, first.0, 0, super::USUAL)?;
        let (more, mut items) = (vec![call(next, 0, 0); self.at_once()], Vec::new());
        // There are no more UPIDs than numbers of 16 bits; a longer list is refused.
        while items.len() <= usize::from(u16::MAX) {
            match self.until_refused(&more)? {
                (answers, None) => {
                    items.extend(answers);
                    let done = items.last().map_or(first.0, |item| item.address as u16).into();
                    let of = usize::from(u16::MAX) + 1;
                    if watch(Progress { what: "list", done, of }).is_break() {
                        let what = "listing its parameters".to_owned();
                        return Err(ServiceError::BrokenOff { drive: self.drive.clone(), what });
                    }
                }
                (answers, Some(Refusal::EndOfList)) => {
                    items.extend(answers);
                    return Ok(items);
                }
                (_, Some(refusal)) => {
                    let error = fieldbeat_core::axis::acyclic::CallError::Refused(refusal.code().into());
                    return Err(self.failed(next.to_string(), error));
                }
            }
        }
        Err(self.content(next.to_string(), "a list without an end".to_owned()))
    }
}
