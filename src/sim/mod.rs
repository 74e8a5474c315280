//! What all simulated drives share.
//!
//! | file | what |
//! |---|---|
//! | `physics` | an axis: setpoint generator, mass, limits, following error |
//! | `fault` | seeded fault injection |
//! | `server` | the threads that serve simulated drives on real sockets |
//! | `world` | virtual time, and an in-memory network with the same drives |

pub mod fault;
pub mod physics;
pub mod server;
pub mod world;

use std::net::SocketAddrV4;

use crate::time::Time;

/// A simulated drive that speaks datagrams: the same object behind a real socket and in virtual time.
pub trait DatagramDrive: Send {
    /// Where it listens.
    fn address(&self) -> SocketAddrV4;

    /// The faults between it and the master.
    fn faults(&self) -> FaultPlan;

    /// Takes one datagram. Writes the answer into `reply` (cleared by the caller) and returns where it goes, or `None`
    /// for no answer.
    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4>;

    /// Power cycle: everything volatile is lost.
    fn restart(&mut self, now: Time);

    /// Its hardware enable (STO) is open until then: power goes off, and does not come on.
    fn inhibit(&mut self, until: Time);
}

/// Seeded faults between a master and a simulated drive. All rates are probabilities a datagram, 0 ... 1, each way
/// unless it says otherwise.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FaultPlan {
    /// Seed of the random numbers; the same seed gives the same faults.
    pub seed: u64,
    /// A datagram is lost.
    pub drop: f64,
    /// A datagram comes twice.
    pub duplicate: f64,
    /// A datagram has one flipped bit.
    pub corrupt: f64,
    /// A datagram comes later, by `delay_ns`.
    pub delay: f64,
    /// How much later.
    pub delay_ns: u64,
    /// A datagram is held until the next one of its direction has passed.
    pub reorder: f64,
    /// A request meets a drive that hears nothing for `stall_ns`, this request included.
    pub stall: f64,
    /// How long.
    pub stall_ns: u64,
    /// A request meets a drive that restarts, and is lost.
    pub restart: f64,
    /// A request meets a drive whose hardware enable (STO) is open from now on for `inhibit_ns`.
    pub inhibit: f64,
    /// How long.
    pub inhibit_ns: u64,
    /// A reply comes from a wrong port.
    pub wrong_id: f64,
    /// Time from a request's arrival to its answer, ns.
    pub answer_ns: u64,
}
