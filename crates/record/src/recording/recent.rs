//! What passed the wires in the last seconds of a run, for the file of a black box: the end of the log of the loop. It
//! does not begin with the run, so that it cannot be repeated; a capture can be made of it.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use crossbeam_channel::Receiver;

use crate::log::layout::Begin;
use fieldbeat_core::inputs::entry::{Head, Kind};
use fieldbeat_core::inputs::recording::LogReader;
use fieldbeat_core::logged::{LinkPassed, LinkTap};
use fieldbeat_core::time::Time;
use fieldbeat_telemetry::log::LogBegin;

/// The newest entries of a log.
#[derive(Debug)]
pub struct RecentWire {
    from: Receiver<LogBegin>,
    /// Once the machine is built.
    log: Option<(LogReader, LinkTap, Begin)>,
    pieces: VecDeque<Piece>,
    /// The bytes that the link thread had on connections meanwhile, and how much of it was lost.
    link: VecDeque<LinkPassed>,
    lost: u64,
    /// The time of the newest entry.
    newest: Time,
    /// The length of time that is kept.
    span_ns: u64,
}

/// Some whole cycles of it.
#[derive(Debug)]
struct Piece {
    /// The time from which the first entry counts.
    from: Time,
    words: Arc<[u64]>,
}

/// As much of it as is kept, for a file.
#[derive(Debug)]
pub struct WireEnd {
    /// The metadata before it.
    pub begin: BTreeMap<String, String>,
    /// A time in its first cycles, by the clock of the loop.
    pub at: Time,
    /// The words, some whole cycles each.
    pub words: Vec<Arc<[u64]>>,
    /// The bytes that the link thread had on connections meanwhile.
    pub link: Vec<LinkPassed>,
    /// The part of that which was lost in the run.
    pub lost: u64,
    /// The first cycle that it has not, since there was no room for it between the loop and this.
    pub cut_at: Option<u64>,
}

impl RecentWire {
    /// The newest `span_ns` of the log that comes from there.
    pub fn new(from: Receiver<LogBegin>, span_ns: u64) -> RecentWire {
        let (pieces, link) = (VecDeque::new(), VecDeque::new());
        RecentWire { from, log: None, pieces, link, lost: 0, newest: Time(0), span_ns }
    }

    /// Takes what the loop has logged since then.
    pub fn take(&mut self) {
        if self.log.is_none() {
            self.log = self.from.try_recv().ok().map(|LogBegin { reader, link, machine, plan, has_task }| {
                let begin = Begin::new(env!("CARGO_PKG_VERSION"), machine, plan, has_task);
                (reader, link, Begin { is_whole: false, ..begin })
            });
        }
        let Some((reader, link, _)) = &mut self.log else { return };
        let (passed, lost) = link.take();
        let mut words = Vec::new();
        reader.take(&mut words);
        if words.is_empty() && reader.ended_at().is_some() {
            // It never goes on. What is there becomes older than what is kept.
            self.pieces.clear();
            return self.link.clear();
        }
        self.link.extend(passed);
        self.lost = lost;
        if words.is_empty() {
            return;
        }
        let from = self.newest;
        self.newest = end_of(from, &words);
        self.pieces.push_back(Piece { from, words: words.into() });
        // The oldest one goes once the others are enough.
        while self.pieces.get(1).is_some_and(|next| self.newest.since(next.from) >= self.span_ns) {
            self.pieces.pop_front();
        }
        let from = self.pieces.front().map_or(Time(0), |piece| piece.from);
        while self.link.front().is_some_and(|passed| passed.at < from) {
            self.link.pop_front();
        }
    }

    /// As much of it as is kept; `None`: there is no log.
    pub fn end(&self) -> Option<WireEnd> {
        let (reader, _, begin) = self.log.as_ref()?;
        // Differences of times count from the entry before, which is no longer there.
        let base = Head { kind: Kind::Base, looks: 0, bytes: size_of::<u64>(), after_ns: 0 };
        let first = self.pieces.front();
        let base = first.map(|first| Arc::from([base.word(), first.from.0]));
        Some(WireEnd {
            begin: begin.to_map(),
            at: first.map_or(self.newest, |first| end_of(first.from, &first.words)),
            words: base.into_iter().chain(self.pieces.iter().map(|piece| Arc::clone(&piece.words))).collect(),
            link: self.link.iter().cloned().collect(),
            lost: self.lost,
            cut_at: reader.ended_at(),
        })
    }
}

/// The time of the last of these entries, which count from `time`.
fn end_of(mut time: Time, mut words: &[u64]) -> Time {
    while let Some((head, rest)) = words.split_first()
        && let Some(head) = Head::of(*head)
    {
        time = match (head.kind, rest.first()) {
            (Kind::Base, Some(base)) => Time(*base),
            _ => Time(time.0.wrapping_add_signed(head.after_ns.into())),
        };
        words = rest.get(head.words()..).unwrap_or_default();
    }
    time
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::inputs::recording::log;
    use fieldbeat_core::inputs::replaying::Entries;
    use fieldbeat_core::rt::Regions;
    use fieldbeat_core::time::{MS, S};
    use fieldbeat_telemetry::log::MachineOf;

    #[test]
    fn the_kept_seconds_have_their_original_times() {
        let (recording, reader) = log(1 << 16, &mut Regions::new());
        let (sender, from) = crossbeam_channel::bounded(1);
        let mut recent = RecentWire::new(from, S);
        recent.take();
        assert!(recent.end().is_none());
        let (link, plan) = (LinkTap::default(), String::new());
        let begin = LogBegin { reader, link, machine: MachineOf::Code, plan, has_task: false };
        sender.send(begin).unwrap();
        for cycle in 0..5_000 {
            // Far from the zero of the clock, with a gap that no difference bridges.
            let at = Time(1_000_000 * S + cycle * MS + if cycle > 4_500 { 10 * S } else { 0 });
            recording.cycle(cycle);
            recording.entry_at(Kind::DatagramIn, at, &[cycle], &[1, 2, 3]);
            recording.publish();
            if cycle % 20 == 7 || cycle == 4_999 {
                recent.take();
            }
        }
        let end = recent.end().unwrap();
        assert_eq!((end.begin["window"].as_str(), end.cut_at), ("true", None));
        let mut words = end.words.into_iter();
        let entries = Entries::new(Box::new(move || words.next().map(|words| words.to_vec())));
        let entries: Vec<_> = entries.map(|entry| entry.unwrap().1).collect();
        let datagrams: Vec<_> = entries.iter().filter(|entry| entry.kind == Kind::DatagramIn).collect();
        assert_eq!(entries[0].kind, Kind::Cycle);
        for datagram in &datagrams {
            let cycle = datagram.word(0);
            let gap = if cycle > 4_500 { 10 * S } else { 0 };
            assert_eq!(datagram.at, Time(1_000_000 * S + cycle * MS + gap));
        }
        let count = datagrams.len();
        assert!((480..560).contains(&count) && datagrams[count - 1].word(0) == 4_999, "{count}");
        assert!(end.at >= datagrams[0].at && end.at <= datagrams[count - 1].at);
    }

    #[test]
    fn a_log_that_had_no_room_leaves_nothing_that_is_older_than_it_says() {
        let (recording, reader) = log(64, &mut Regions::new());
        let (sender, from) = crossbeam_channel::bounded(1);
        let mut recent = RecentWire::new(from, S);
        let (link, plan) = (LinkTap::default(), String::new());
        sender.send(LogBegin { reader, link, machine: MachineOf::Code, plan, has_task: false }).unwrap();
        let cycles = |cycles: std::ops::Range<u64>| {
            for cycle in cycles {
                recording.cycle(cycle);
                recording.entry_at(Kind::DatagramIn, Time(S + cycle * MS), &[cycle], &[1, 2, 3]);
                recording.publish();
            }
        };
        cycles(0..4);
        recent.take();
        // The first message of a run has a time of the run.
        let first = recent.end().unwrap();
        assert_eq!((first.at, first.cut_at), (Time(S + 3 * MS), None));
        cycles(4..100);
        recent.take();
        recent.take();
        let end = recent.end().unwrap();
        assert!(end.words.is_empty() && end.cut_at.is_some_and(|cycle| (5..30).contains(&cycle)), "{end:?}");
    }
}
