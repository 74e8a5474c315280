//! Sessions in a virtual world: the machine of the link thread, over connections that the loop never gets.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Wake, Waker};

use super::World;
use crate::net::link::Peer;
use crate::net::{LinkNotes, SessionPeer, Sessions};
use crate::rt::Regions;

/// The post of one session. It locks nothing: whoever posts something may be called by the world.
#[derive(Debug)]
pub(super) struct Post {
    pending: AtomicBool,
    /// There is one at any session of the world.
    any: Arc<AtomicBool>,
}

impl Post {
    /// Whether something was posted since the last time.
    pub(super) fn take(&self) -> bool {
        self.pending.swap(false, Ordering::AcqRel)
    }
}

impl Wake for Post {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.pending.store(true, Ordering::Release);
        self.any.store(true, Ordering::Release);
    }
}

/// The sessions of one carrier: they end when it is dropped.
struct Hold {
    world: World,
    id: u64,
}

impl Drop for Hold {
    fn drop(&mut self) {
        self.world.lock().close(self.id);
    }
}

impl World {
    pub(super) fn open_sessions(&self, peers: Vec<SessionPeer>) -> Sessions {
        let mut inner = self.lock();
        let notes = LinkNotes::new(peers.len());
        let post = || Post { pending: AtomicBool::new(false), any: Arc::clone(&inner.links.posted) };
        let posts: Vec<_> = peers.iter().map(|_| Arc::new(post())).collect();
        let wakers = posts.iter().map(|post| Waker::from(Arc::clone(post))).collect();
        let peers = peers.into_iter().map(Peer::from).zip(posts.into_iter().map(Some));
        let id = inner.open(peers.collect(), &notes);
        drop(inner);
        let hold = Box::new(Hold { world: self.clone(), id });
        // Virtual time is never real time: nothing to lock.
        Sessions::new(wakers, notes, Arc::default(), Regions::new(), hold)
    }
}
