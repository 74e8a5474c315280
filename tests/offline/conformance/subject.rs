//! What a protocol brings to the suite: everything else is the contract's.

use std::io::Write;

use fieldbeat::axis::AxisPlan;
use fieldbeat::bus::BusPlan;
use fieldbeat::sim::{SimSegment, SimSerial, Simulated};
use fieldbeat::{Axis, Time};
use fieldbeat_core::axis::Call;

/// One protocol, in one way of configuring it.
///
/// The clauses look at the wire only through this: bytes mean nothing to them. What befalls the wire of the simulated
/// drives comes from the shared `FaultPlan` and the world.
pub trait Subject: Sync {
    /// Its name in messages.
    fn name(&self) -> &'static str;

    /// What it can do by nature.
    fn can(&self) -> Can;

    /// What names a request is used again some exchanges later: after an outage as long as that a reply is suspect,
    /// although replies name their requests.
    fn names_repeat(&self) -> bool {
        false
    }

    /// An axis as usual in this protocol: units and profile; the clauses change what they are about.
    fn axis(&self, name: &str) -> AxisPlan;

    /// A bus of these drives. The addresses are the protocol's choice, the wire is clean.
    fn plan(&self, drives: &[Drive]) -> Box<dyn BusPlan>;

    /// These drives, simulated: in slot order, or as one segment.
    fn simulated(&self, drives: &[Drive]) -> Simulated;

    /// What a drive's answer says, in the drive's own counts: the truth that reports are held against. `None`: this
    /// one says nothing of the drive. What only other answers tell is as the last one left it, in `before`.
    fn said(&self, before: Option<Said>, request: &[u8], reply: &[u8]) -> Option<Said>;

    /// On a stream, the length of the message in front of `bytes`; `None` while it is not all there.
    fn message(&self, bytes: &[u8]) -> Result<Option<usize>, NoMessage> {
        Ok(Some(bytes.len()))
    }

    /// Acyclic calls that every drive of it takes in every state.
    fn calls(&self) -> Calls;

    /// Writes native outputs to the drive of an axis, each with its number in it. None of them switches its power on.
    fn native(&self, axis: &mut Axis) -> Box<dyn FnMut(u16)>;

    /// On a line, the place of drive `index` of `count`, counted from 0 at the master: the first one stands last, so
    /// that the cable in front of it can be cut.
    fn place(&self, index: usize, count: usize) -> usize {
        count - 1 - index
    }

    /// What a frame that passes drive `index` of `count` at `now` carries of it: its request and its answer, which is
    /// empty if it took no part. `None`: nothing of any drive.
    fn piece(&self, _now: Time, _frame: &[u8], _index: usize, _count: usize) -> Option<(Vec<u8>, Vec<u8>)> {
        None
    }

    /// Of a frame of a line, the same of another master.
    fn of_another(&self, _frame: &[u8]) -> Vec<u8> {
        Vec::new()
    }

    /// Of a frame of a line, the one behind it, as it would come if it had gone round without passing the master.
    /// `None`: nothing goes round.
    fn circulated(&self, _frame: &[u8]) -> Option<Vec<u8>> {
        None
    }

    /// A frame that comes to the master is none of its own.
    fn is_strange(&self, _frame: &[u8]) -> bool {
        false
    }

    /// Brings about the fault of [`fault`](Self::fault) in the drive at this place of a line.
    fn provoke(&self, _line: &mut dyn SimSegment, _place: usize) {}

    /// On a serial wire, the drive that a telegram of the master goes to; `None`: to none, or to all.
    fn requested(&self, _telegram: &[u8]) -> Option<usize> {
        None
    }

    /// That telegram is an exchange, of a drive that is in data exchange or not: what sets it up is none.
    fn is_exchange(&self, _telegram: &[u8], _open: bool) -> bool {
        true
    }

    /// Whether the drive is in data exchange behind that telegram.
    fn opens(&self, _telegram: &[u8], open: bool) -> bool {
        open
    }

    /// From the begin of an exchange on a serial wire to its answer, but for two latencies of the world, ns.
    fn answer_ns(&self) -> u64 {
        0
    }

    /// Brings about the fault of [`fault`](Self::fault) in a drive on a serial wire.
    fn provoke_slave(&self, _drive: &mut dyn SimSerial) {}

    /// Whether this request, behind those `before` it, requests a stop: along a ramp, or by its quick stop.
    fn requests_stop(&self, before: &[Vec<u8>], request: &[u8]) -> bool;

    /// What another master could send to a drive in operation, whose last answer is `reply`, so that it goes into a
    /// fault that can be acknowledged. `None`: nothing that comes over the wire does that.
    fn fault(&self, reply: &[u8]) -> Option<Vec<u8>>;

    /// Telegrams that are no answer of this protocol. On a stream, none that hides where the next one begins.
    fn malformed(&self, reply: &[u8]) -> Vec<Vec<u8>>;

    /// The packet that comes so many after this one, of a drive with its own clock.
    fn later(&self, _packet: &[u8], _by: u8) -> Option<Vec<u8>> {
        None
    }

    /// Well-formed answers to a request that was not made, made from a true one.
    fn foreign(&self, reply: &[u8]) -> Vec<Vec<u8>>;
}

/// What a protocol can do by nature. What it cannot do, the clauses want refused by name.
#[derive(Clone, Copy, Debug, Default)]
pub struct Can {
    /// It takes positions, and reports them. Without, it takes jogs, and reports its velocity.
    pub positions: bool,
    /// `Command::Home`; without it the drive knows where it is from the start.
    pub home: bool,
    /// `Command::Jog`.
    pub jog: bool,
    /// `Command::Follow`.
    pub follow: bool,
    /// `Command::Torque`.
    pub torque: bool,
    /// Jogs and rows are taken by drives that are configured so, and by no others.
    pub picks: bool,
    /// Each reply names the request that it answers. Without that, the reply after a miss is suspect.
    pub identified: bool,
    /// A clean exchange makes a round-trip sample. Without that, every answered exchange is marked suspect.
    pub round_trip: bool,
    /// So many cycles after that of its request a reply may come, and counts. No drive is due sooner again.
    pub answers_after: u32,
    /// Each answer says all that is reported.
    pub whole: bool,
    /// The window of a request stays open for its reply, although that may come later.
    pub awaits: bool,
    /// Each drive has a connection. One request is open on it: before its reply nothing else is requested, and one that
    /// never comes costs the connection, which is opened anew after a pause.
    pub stream: bool,
    /// Each drive sends by its own clock, and is sent requests at the agreed rate: a packet answers nothing. One may be
    /// the newest for several exchanges, and several may come between two.
    pub own_clock: bool,
    /// The packets of each drive go on a connection that a session outside the loop has opened: it ends with the
    /// packets, and is opened again after a pause. Nothing in a packet shows that its drive was switched off meanwhile:
    /// what was known of it ends with the connection.
    pub sessions: bool,
    /// A stop has the ramp of the motion that it ends, if that is steeper than its own, or the steepest one.
    pub steep_stops: bool,
    /// One request is on the wire at a time: the others wait for their turns.
    pub half_duplex: bool,
    /// That wire is one of bytes that all drives share: what is late or broken may be lost with what it meets, and is
    /// counted by whoever had the turn.
    pub bytes: bool,
    /// One frame goes through all drives in every cycle, whoever is due in it, and comes back in its window: each drive
    /// has a piece of it. What befalls it befalls all of them. Before a drive is in operation on its line it gets
    /// no request.
    pub shared: bool,
    /// To bring it up takes its power: it is never found running.
    pub comes_up_off: bool,
    /// What is found running without the watchdog of its plan is set up anew before it gets power again.
    pub rearmed: bool,
}

/// What is no message, nor the begin of one.
#[derive(Debug)]
pub struct NoMessage;

/// Usual for [`Calls::soon`].
pub const SOON: u64 = 100;

/// Acyclic calls to a drive.
#[derive(Clone, Copy, Debug)]
pub struct Calls {
    /// Reads what `write` writes.
    pub read: Call,
    /// Writes another value than the drive has at power-on.
    pub write: Call,
    /// One that it refuses, and its status.
    pub refused: (Call, u32),
    /// Cycles in which a call to a drive that is there has ended. Many calls take a tenth of it each.
    pub soon: u64,
}

/// A drive that a clause wants.
#[derive(Clone, Debug)]
pub struct Drive {
    /// What every protocol's axis has.
    pub axis: AxisPlan,
    /// Where it stands at power-on, in user units from the drive's own zero.
    pub start: f64,
    /// Comes up in operation with a motion running, as if another master had died.
    pub running: bool,
    /// Configured so that it takes jogs, if the protocol does.
    pub jog: bool,
    /// Configured so that it follows rows, if the protocol does.
    pub follow: bool,
}

/// What a drive says of itself.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Said {
    /// The power stage may be on.
    pub powered: bool,
    /// Its setpoint generator is running.
    pub moving: bool,
    /// Its position is referenced; `None`: its answers say nothing of that.
    pub homed: Option<bool>,
    /// Actual position, counts, of a drive that reports positions.
    pub position: Option<i64>,
    /// Demand position, counts, of the same.
    pub demand: Option<i64>,
    /// Position setpoint in the request, counts, where the master makes the demand: it counts while the drive follows
    /// it, and else the drive is where it is.
    pub setpoint: Option<i64>,
    /// When, if that is a part of the answer.
    pub at: Option<Time>,
    /// Velocity, counts/s, of a drive that reports it.
    pub velocity: Option<f64>,
}

/// Says that a clause, or a part of it, means nothing for this subject. Written past the test harness, which would keep
/// it to itself.
pub fn not_applicable(subject: &dyn Subject, clause: &str, why: &str) {
    // In one piece: the harness writes its own lines meanwhile.
    let line = format!("not applicable to {}: {clause}: {why}\n", subject.name());
    let _ = std::io::stderr().write_all(line.as_bytes());
}
