//! The loop's side of connections in a world.

use std::collections::VecDeque;
use std::io;
use std::os::fd::RawFd;
use std::sync::Arc;
use std::task::Waker;

use super::{Hold, Inner, Place, Posted, World};
use fieldbeat_core::net::{Broken, LinkNotes, StreamPeer, Streams};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

impl World {
    pub(in super::super) fn open_streams(&self, peers: Vec<StreamPeer>) -> StreamCarrier {
        let notes = LinkNotes::new(peers.len());
        let ready = VecDeque::with_capacity(peers.len());
        let mut inner = self.lock();
        let posted = Arc::clone(&inner.links.posted);
        StreamCarrier { id: inner.open(peers, &notes), world: self.clone(), notes, posted, ready }
    }
}

/// A carrier of connections in a world.
#[derive(Debug)]
pub(in super::super) struct StreamCarrier {
    world: World,
    id: u64,
    notes: LinkNotes,
    posted: Arc<Posted>,
    /// The connections that the last look found.
    ready: VecDeque<usize>,
}

impl StreamCarrier {
    fn place(&self, inner: &Inner, index: usize) -> Option<Place> {
        let set = inner.links.sets.iter().position(|set| set.id == self.id)?;
        let link = inner.links.sets[set].links.get(index)?;
        (link.hold == Hold::Loop).then_some(Place(set, index))
    }
}

impl Streams for StreamCarrier {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn opened(&mut self) -> Option<usize> {
        let mut inner = self.world.lock();
        let set = inner.links.by_id(self.id)?;
        let index = set.opened.pop_front()?;
        set.links[index].hold = Hold::Loop;
        Some(index)
    }

    fn look(&mut self) {
        let mut inner = self.world.lock();
        inner.read();
        self.ready.clear();
        if let Some(set) = inner.links.by_id(self.id) {
            let readable = set.links.iter().enumerate().filter(|(_, link)| link.readable());
            self.ready.extend(readable.map(|(index, _)| index));
        }
    }

    fn ready(&mut self) -> Option<usize> {
        self.ready.pop_front()
    }

    fn receive(&mut self, index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        let mut inner = self.world.lock();
        let at = inner.read();
        let place = self.place(&inner, index).ok_or(Broken::Absent)?;
        let link = inner.links.at(place);
        match (link.inbox.is_empty(), link.broken) {
            (true, Some(why)) => Err(why),
            (true, None) => Ok(None),
            (false, _) => {
                // Reading from this queue of bytes cannot fail, nor wait.
                let count = io::Read::read(&mut link.inbox, room).unwrap_or(0);
                Ok(Some((at, count)))
            }
        }
    }

    fn send(&mut self, index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        let mut inner = self.world.lock();
        let at = inner.read();
        let place = self.place(&inner, index).ok_or(Broken::Absent)?;
        let link = inner.links.at(place);
        if let Some(why) = link.broken {
            return Err(why);
        }
        if link.is_full() {
            return Ok((at, 0));
        }
        let (Some(from), Some(station)) = (link.local, link.station) else { return Err(Broken::Absent) };
        inner.depart_to(station, from, bytes);
        Ok((at, bytes.len()))
    }

    fn abandon(&mut self, index: usize, why: &'static str) {
        let mut inner = self.world.lock();
        if let Some(place) = self.place(&inner, index) {
            inner.work(place, |machine, now| machine.given_back(now, why));
        }
    }

    fn notes(&self) -> LinkNotes {
        self.notes.clone()
    }

    fn waker(&self) -> Option<Waker> {
        Some(Arc::clone(&self.posted).into())
    }

    /// Virtual time is never real time: nothing to lock.
    fn memory(&self, _regions: &mut Regions) {}
}

/// Its connections are closed, as when their sockets are.
impl Drop for StreamCarrier {
    fn drop(&mut self) {
        self.world.lock().close(self.id);
    }
}
