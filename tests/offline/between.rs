//! A simulated drive with something between it and the world, for tests that look at what passes, or change it.

use std::net::SocketAddrV4;
use std::sync::{Arc, Mutex, MutexGuard};

use fieldbeat::Time;
use fieldbeat::sim::{Carrier, FaultPlan, SimDrive};

/// A message to a drive.
#[derive(Clone, Copy)]
pub struct Message<'a> {
    /// The socket of the drive that it has come to.
    pub socket: usize,
    pub now: Time,
    pub from: SocketAddrV4,
    pub bytes: &'a [u8],
}

impl Message<'_> {
    /// It reaches the drive.
    pub fn reaches(self, drive: &mut dyn SimDrive, reply: &mut Vec<u8>) -> Option<SocketAddrV4> {
        drive.receive_at(self.socket, self.now, self.from, self.bytes, reply)
    }
}

/// Takes what a drive sends by its own clock: the socket, the destination, the bytes.
pub type Sender<'a> = dyn FnMut(usize, SocketAddrV4, &[u8]) + 'a;

/// What stands between a drive and the world: everything goes through, but for what it does itself.
pub trait Between: Send {
    fn drive(&mut self) -> &mut dyn SimDrive;

    fn receive(&mut self, message: Message<'_>, reply: &mut Vec<u8>) -> Option<SocketAddrV4> {
        message.reaches(self.drive(), reply)
    }

    fn run(&mut self, now: Time, send: &mut Sender<'_>) {
        self.drive().run(now, send);
    }

    fn connect(&mut self, now: Time, from: SocketAddrV4) -> bool {
        self.drive().connect(now, from)
    }

    fn disconnected(&mut self, now: Time, from: SocketAddrV4) {
        self.drive().disconnected(now, from);
    }
}

/// A drive and what stands before it, of the world and of the test.
pub struct Shared<B>(Arc<Mutex<B>>);

impl<B> Shared<B> {
    pub fn new(between: B) -> Shared<B> {
        Shared(Arc::new(Mutex::new(between)))
    }

    pub fn lock(&self) -> MutexGuard<'_, B> {
        self.0.lock().unwrap()
    }
}

impl<B> Clone for Shared<B> {
    fn clone(&self) -> Shared<B> {
        Shared(Arc::clone(&self.0))
    }
}

impl<B: Between> SimDrive for Shared<B> {
    crate::forward! { this => this.lock().drive();
        fn address(&self) -> SocketAddrV4;
        fn faults(&self) -> FaultPlan;
        fn carrier(&self) -> Carrier;
        fn more_sockets(&self) -> Vec<(Carrier, SocketAddrV4)>;
        fn next_due(&self) -> Option<Time>;
        fn hangs_up(&mut self, from: SocketAddrV4) -> bool;
        fn mislabel(&self, reply: &mut [u8]);
        fn restart(&mut self, now: Time);
        fn open_sto(&mut self, until: Time);
    }

    crate::forward! { this => this.lock();
        fn run(&mut self, now: Time, send: &mut dyn FnMut(usize, SocketAddrV4, &[u8]));
        fn connect(&mut self, now: Time, from: SocketAddrV4) -> bool;
        fn disconnected(&mut self, now: Time, from: SocketAddrV4);
    }

    fn receive_at(
        &mut self,
        socket: usize,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        self.lock().receive(Message { socket, now, from, bytes }, reply)
    }

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        self.receive_at(0, now, from, bytes, reply)
    }
}
