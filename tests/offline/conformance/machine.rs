//! The whole loop over the subject's bus, in virtual time.

use std::collections::BTreeMap;
use std::sync::MutexGuard;

use fieldbeat::axis::{
    Command, CommandId, EventKind, Failure, Feedback, Jog, Link, Outcome, Profile, StopCause,
};
use fieldbeat::sim::{FaultPlan, SimSegment, World, WorldOptions};
use fieldbeat::time::{Time, US};
use fieldbeat::{CyclePlan, Flow, Master, Plan, Simulation};

use crate::conformance::line::{self, PERIOD};
use crate::conformance::subject::{Can, Drive, Subject};
use crate::conformance::wire::{Tape, Wire};

pub struct Machine {
    pub can: Can,
    pub drives: Vec<Drive>,
    pub sim: Simulation,
    wire: Wire,
    origin: Time,
    /// How each command ended, by axis and id.
    ends: BTreeMap<(usize, CommandId), Outcome>,
    pub restarts: u32,
}

impl Machine {
    /// A machine of so many drives, each changed.
    pub fn new(subject: &'static dyn Subject, count: usize, change: impl Fn(usize, &mut Drive)) -> Machine {
        Machine::proposing(subject, count, change, WorldOptions::default(), None)
    }

    /// One that builds requests, too, which do not leave, of this seed.
    pub fn proposing(
        subject: &'static dyn Subject,
        count: usize,
        change: impl Fn(usize, &mut Drive),
        options: WorldOptions,
        proposals: Option<u64>,
    ) -> Machine {
        assert_eq!(CyclePlan::default().period_ns, PERIOD);
        let drives = line::drives(subject, count, change);
        let (wire, simulated) = Wire::new(subject, &drives);
        wire.log().proposals = proposals;
        // The grid begins two periods after the first look at the clock.
        let origin = options.start + options.read_ns + 2 * PERIOD;
        let plan = Plan { buses: vec![Box::new(wire.clone())], ..Plan::default() };
        let setup = Master::from_plan(plan);
        let sim = setup.simulate_with(simulated, options).expect("the machine can be built");
        Machine { can: subject.can(), drives, sim, wire, origin, ends: BTreeMap::new(), restarts: 0 }
    }

    pub fn step(&mut self) -> Flow {
        let flow = self.sim.step();
        for index in 0..self.drives.len() {
            while let Some(event) = self.sim.axis(index).event() {
                match event.kind {
                    EventKind::Ended { id, outcome, .. } => {
                        assert_eq!(
                            self.ends.insert((index, id), outcome),
                            None,
                            "command {} ended twice",
                            id.0
                        );
                    }
                    EventKind::Restarted => self.restarts += 1,
                    _ => {}
                }
            }
        }
        flow
    }

    pub fn run(&mut self, cycles: u64) {
        for _ in 0..cycles {
            self.step();
        }
    }

    pub fn until(&mut self, what: &str, most: u64, mut done: impl FnMut(&Machine) -> bool) -> u64 {
        for cycle in 0..most {
            if done(self) {
                return cycle;
            }
            self.step();
        }
        let all: Vec<_> = (0..self.drives.len()).map(|index| self.feedback(index)).collect();
        panic!("not within {most} cycles: {what}; {all:#?}");
    }

    pub fn feedback(&self, index: usize) -> Feedback {
        self.sim.feedback(index)
    }

    pub fn online(&mut self) {
        let count = self.drives.len();
        let most = match self.can {
            Can { sessions: true, .. } => 40_000,
            Can { shared: true, .. } => 8_000,
            _ => 2_000,
        };
        self.until("all online", most, |m| (0..count).all(|index| m.feedback(index).link == Link::Online));
    }

    /// All online, enabled and homed.
    pub fn ready(&mut self) {
        self.online();
        for index in 0..self.drives.len() {
            self.done(index, Command::Enable);
            if self.can.home {
                self.done(index, Command::Home);
            }
        }
    }

    /// Every axis on a move of many seconds.
    pub fn moving(&mut self) -> Vec<CommandId> {
        self.ready();
        let ids = (0..self.drives.len()).map(|index| self.post(index, self.go(index))).collect();
        self.run(200);
        assert!((0..self.drives.len()).all(|index| self.feedback(index).status.moving));
        ids
    }

    /// A move by the way of so many seconds.
    pub fn by(&self, index: usize, seconds: f64) -> Command {
        line::by(&self.drives[index], seconds)
    }

    /// A motion of many seconds.
    pub fn go(&self, index: usize) -> Command {
        line::go(&self.can, &self.drives[index])
    }

    /// A motion of many seconds in which no two requests are the same.
    pub fn changing(&self, index: usize) -> Command {
        let Profile { velocity, .. } = self.drives[index].axis.profile;
        match self.can.positions {
            true => self.by(index, 20.0),
            false => Command::Jog(Jog { velocity: velocity * 5.0, acceleration: velocity * 1.5 }),
        }
    }

    /// A short motion, to its end.
    pub fn move_about(&mut self, index: usize) {
        if self.can.positions {
            return self.done(index, self.by(index, 0.05));
        }
        self.post(index, self.go(index));
        self.until("a motion", 1_000, |m| m.feedback(index).status.moving);
        self.done(index, Command::Stop { deceleration: None });
        assert!(!self.feedback(index).status.moving);
    }

    pub fn post(&mut self, index: usize, command: Command) -> CommandId {
        self.sim.axis(index).post(command).unwrap_or_else(|error| panic!("{error}"))
    }

    pub fn outcome(&self, index: usize, id: CommandId) -> Option<Outcome> {
        self.ends.get(&(index, id)).copied()
    }

    pub fn ended(&mut self, index: usize, id: CommandId) -> Outcome {
        self.until("the end of a command", 40_000, |m| m.outcome(index, id).is_some());
        self.ends[&(index, id)]
    }

    pub fn done(&mut self, index: usize, command: Command) {
        let id = self.post(index, command);
        assert_eq!(self.ended(index, id), Outcome::Done, "{command:?} of axis {index}");
    }

    pub fn failed(&mut self, index: usize, command: Command) -> Failure {
        let id = self.post(index, command);
        match self.ended(index, id) {
            Outcome::Failed(failure) => failure,
            other => panic!("{command:?} of axis {index}: {other}"),
        }
    }

    /// Turns until the axis is latched.
    pub fn stopped(&mut self, index: usize, most: u64) -> StopCause {
        self.until("a stop", most, |m| m.feedback(index).stopped.is_some());
        self.feedback(index).stopped.expect("it is stopped")
    }

    /// Out of the latch and enabled again.
    pub fn recover(&mut self, index: usize) {
        for command in [Command::ResetFault, Command::Reset, Command::Enable] {
            self.done(index, command);
        }
        if self.can.home {
            self.done(index, Command::Home);
        }
    }

    pub fn world(&self) -> &World {
        self.sim.world()
    }

    pub fn tape<R>(&self, index: usize, look: impl FnOnce(&mut Tape) -> R) -> R {
        let mut log: MutexGuard<'_, _> = self.wire.log();
        look(&mut log.drives[index])
    }

    pub fn mute(&self, index: usize, mute: bool) {
        self.tape(index, |tape| tape.mute = mute);
    }

    pub fn plug(&self, index: usize, plugged: bool) {
        self.wire.plug(self.world(), index, plugged);
    }

    pub fn restart(&self, index: usize) {
        self.wire.restart(self.world(), index);
    }

    /// Another master sends this to the drive.
    pub fn meddle(&self, index: usize, bytes: Vec<u8>) {
        self.tape(index, |tape| tape.meddled = Some(bytes));
    }

    /// From here on each answer of the drive comes too late to count. Where one is sent at a time, it comes before the
    /// next one is due; elsewhere it is lost.
    pub fn late(&self, index: usize) {
        if !self.can.stream {
            return self.mute(index, true);
        }
        let ns = u64::from(self.can.answers_after) * PERIOD + line::WINDOW + 100 * US;
        self.faults(index, FaultPlan { answer_ns: ns, ..FaultPlan::default() });
    }

    pub fn faults(&self, index: usize, plan: FaultPlan) {
        let usual = self.tape(index, |tape| tape.usual.answer_ns);
        let plan = FaultPlan { answer_ns: usual + plan.answer_ns, ..plan };
        self.wire.faults(self.world(), index, plan);
    }

    /// Looks at its line.
    pub fn line<R>(&self, look: impl FnOnce(&mut dyn SimSegment, Time) -> R) -> R {
        self.wire.look(self.world(), look).expect("there is a line")
    }

    /// The slots of the grid in which the drive was sent something, from `first` on.
    pub fn asked_in(&self, index: usize, first: usize) -> Vec<u64> {
        let slot = |at: Time| at.since(self.origin) / PERIOD;
        self.tape(index, |tape| tape.received[first..].iter().map(|received| slot(received.at)).collect())
    }

    pub fn received(&self, index: usize) -> usize {
        self.tape(index, |tape| tape.received.len())
    }

    /// The stop bound that `check` states for an axis.
    pub fn stop_bound(&self, index: usize) -> u64 {
        fieldbeat_core::cycle::bound::stop_bound(self.sim.plan(), index)
    }

    /// Turns until the loop has ended.
    pub fn until_end(&mut self, most: u64) {
        assert!((0..most).any(|_| self.step() == Flow::End), "no end within {most} cycles");
    }

    /// `planned = executed + skipped`, each counted on its own.
    pub fn assert_grid(&self) {
        let status = self.sim.status();
        assert_eq!(status.planned, status.executed + status.skipped, "{status:?}");
    }
}
