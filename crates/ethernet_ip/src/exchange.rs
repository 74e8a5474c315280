//! What passes between the session of a drive on the link thread and its station on the loop: two wait-free queues.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::plan::{Layout, Version};
use fieldbeat_core::axis::doorbell::Bell;
use fieldbeat_core::inputs::entry::{peer, peer_of};
use fieldbeat_core::inputs::{Inlet, InputLog};
use fieldbeat_core::packed::Part;
use fieldbeat_core::rt::{self, Regions};
use fieldbeat_core::sync::{Consumer, Producer};

/// Room of each queue: more than a session can cause between two looks of the loop.
const ROOM: usize = 16;

/// From the session to the loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum News {
    /// A connection is open.
    Opened(Connection),
    /// The connection of this generation is closed, and will not be used again.
    Closed {
        /// Which one.
        generation: u32,
    },
    /// The facts read of the drive outside its process data; again after each opening of a session.
    Read(Facts),
}

/// A class 1 connection that is open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Connection {
    /// Counts the connections of this drive, from 1.
    pub generation: u32,
    /// The id of our packets.
    pub outgoing: u32,
    /// The id of the drive's packets.
    pub incoming: u32,
    /// Where our packets go.
    pub destination: SocketAddrV4,
    /// Where the drive's packets come from.
    pub source: Ipv4Addr,
    /// The drive expects our packets at this interval, ns.
    pub outgoing_api_ns: u64,
    /// The drive's packets come at this interval, ns.
    pub incoming_api_ns: u64,
    /// Without an accepted packet of the drive for so long it has timed out, ns.
    pub timeout_ns: u64,
    /// The contents of our packets.
    pub outputs: Outputs,
    /// The contents of the drive's packets.
    pub version: Version,
    /// The order of 0x65.
    pub layout: Layout,
}

/// The contents of our packets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outputs {
    /// The run/idle header and assembly 0x70.
    Owned,
    /// A heartbeat of this connection size: 2, 6 or 0.
    Heartbeat(u8),
}

/// The facts read of a drive by explicit messages, as far as its enable depends on them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Facts {
    /// Whether the register of the plan says that it has its reference.
    pub homed: Option<bool>,
}

/// From the loop to the session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wish {
    /// The drive's packets of this generation have ended: it is to be opened anew, after a pause.
    TimedOut {
        /// Which one.
        generation: u32,
    },
    /// The orderly end: close it, and open nothing any more.
    Close {
        /// Which one; 0 = none is open.
        generation: u32,
    },
}

/// The kind, and what it holds.
impl Part for News {
    const WORDS: usize = 13;

    fn put(&self, words: &mut [u64]) {
        words.fill(0);
        match *self {
            News::Opened(connection) => {
                let Connection { generation, outgoing, incoming, destination, source, .. } = connection;
                let outputs = match connection.outputs {
                    Outputs::Owned => u64::MAX,
                    Outputs::Heartbeat(size) => size.into(),
                };
                let (v2, page) = (connection.version == Version::V2, connection.layout == Layout::Page);
                [0, generation.into(), outgoing.into(), incoming.into(), peer(destination)].put(words);
                [source.to_bits().into(), connection.outgoing_api_ns, connection.incoming_api_ns]
                    .put(&mut words[5..]);
                [connection.timeout_ns, outputs, v2.into(), page.into()].put(&mut words[8..]);
            }
            News::Closed { generation } => [1, u64::from(generation)].put(words),
            News::Read(Facts { homed }) => {
                words[0] = 2;
                homed.put(&mut words[1..]);
            }
        }
    }

    fn take(words: &[u64]) -> News {
        match words[0] {
            0 => News::Opened(Connection {
                generation: words[1] as u32,
                outgoing: words[2] as u32,
                incoming: words[3] as u32,
                destination: peer_of(words[4]),
                source: (words[5] as u32).into(),
                outgoing_api_ns: words[6],
                incoming_api_ns: words[7],
                timeout_ns: words[8],
                outputs: match words[9] {
                    u64::MAX => Outputs::Owned,
                    size => Outputs::Heartbeat(size as u8),
                },
                version: if words[10] == 0 { Version::V1 } else { Version::V2 },
                layout: if words[11] == 0 { Layout::Manual } else { Layout::Page },
            }),
            1 => News::Closed { generation: words[1] as u32 },
            _ => News::Read(Facts { homed: Part::take(&words[1..]) }),
        }
    }
}

/// The flags that both sides look at in each step.
#[derive(Debug, Default)]
struct Flags {
    /// The power of the drive is on, or may come on: calls that command it are refused.
    guarded: AtomicBool,
    /// A call that commands the drive is under way.
    commanded: AtomicBool,
}

/// The loop's end.
#[derive(Debug)]
pub struct LoopEnd {
    news: Inlet<News>,
    wishes: Producer<Wish>,
    flags: Arc<Flags>,
    regions: Regions,
    log: InputLog,
}

/// The session's end.
#[derive(Debug)]
pub struct SessionEnd {
    news: Producer<News>,
    /// Rings for the loop, which looks for news only then.
    bell: Bell,
    wishes: Consumer<Wish>,
    flags: Arc<Flags>,
}

/// Both ends, with the bell of the drive.
pub fn both(bell: Bell) -> (LoopEnd, SessionEnd) {
    let mut regions = Regions::new();
    let (news_in, news) = rt::ring(ROOM, &mut regions);
    let (wishes, wishes_out) = rt::ring(ROOM, &mut regions);
    let flags = Arc::new(Flags::default());
    let session = SessionEnd { news: news_in, bell, wishes: wishes_out, flags: Arc::clone(&flags) };
    (LoopEnd { news: Inlet::new(news), wishes, flags, regions, log: InputLog::default() }, session)
}

impl LoopEnd {
    /// The same with this log.
    pub fn logged(mut self, log: &InputLog) -> LoopEnd {
        (self.news, self.log) = (self.news.logged(log), log.source());
        self
    }

    /// The next news.
    pub fn news(&mut self) -> Option<News> {
        self.news.pop()
    }

    /// Sends it to the session; false if there is no room: again in a later cycle.
    pub fn wish(&mut self, wish: Wish) -> bool {
        self.log.flag(true, self.wishes.push(wish).is_ok())
    }

    /// From now on calls that command the drive are refused, or not. Returns whether one is under way: its telegram
    /// may have left before the session could see this.
    #[inline]
    pub fn guard(&self, on: bool) -> bool {
        // Each side writes its own flag and then reads the other one: one of them sees both (SeqCst).
        if self.flags.guarded.load(Ordering::Relaxed) != on {
            self.flags.guarded.store(on, Ordering::SeqCst);
        }
        self.log.flag(false, self.flags.commanded.load(Ordering::SeqCst))
    }

    /// Adds what it touches, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.extend(&self.regions);
        regions.add(&*self.flags);
    }
}

impl SessionEnd {
    /// Sends it to the loop; false if there is no room: again later.
    pub fn tell(&mut self, news: News) -> bool {
        let is_told = self.news.push(news).is_ok();
        if is_told {
            self.bell.ring();
        }
        is_told
    }

    /// The next wish.
    pub fn wish(&mut self) -> Option<Wish> {
        self.wishes.pop().ok()
    }

    /// The loop is gone.
    pub fn is_abandoned(&self) -> bool {
        self.wishes.is_abandoned()
    }

    /// Calls that command the drive are refused at present.
    pub fn is_guarded(&self) -> bool {
        self.flags.guarded.load(Ordering::SeqCst)
    }

    /// Before a call that commands the drive is sent: false if it must not be.
    pub fn begin_commanding(&self) -> bool {
        self.flags.commanded.store(true, Ordering::SeqCst);
        let may = !self.flags.guarded.load(Ordering::SeqCst);
        if !may {
            self.end_commanding();
        }
        may
    }

    /// The end is known.
    pub fn end_commanding(&self) {
        self.flags.commanded.store(false, Ordering::SeqCst);
    }
}
