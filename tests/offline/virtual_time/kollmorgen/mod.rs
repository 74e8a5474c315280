//! A line of Kollmorgen drives under the whole loop in virtual time: what the conformance suite does not ask of a
//! protocol.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the machine: a line and its master |
//! | `drives` | free PDOs, emergencies, lost links and masters |
//! | `devices` | slaves that are no drives; which of them are refused, and the report |
//! | `left` | segments that another master left behind |
//! | `long` | lines of many drives |
//! | `outputs` | who writes what is in the outputs of a drive |
//! | `returns` | drives that were deaf, and segments that a tool has run over |
//! | `shifted` | drives that change their places while the master runs |
//! | `clocks` | clocks under a busy host, and of several kinds |
//! | `terminals` | terminals: where their process data are |

mod clocks;
mod devices;
pub mod drives;
pub mod left;
mod long;
mod outputs;
mod returns;
mod shifted;
mod terminals;

use std::time::Duration;

use fieldbeat::axis::{Command, Feedback, Jog, Link, Outcome, State};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethercat::{EthercatPlan, Family, KollmorgenDrive, Watchdog};
use fieldbeat::config::{Configuration, parse};
use fieldbeat::sim::{SimPlan, SimSegment, Simulated, WorldOptions};
use fieldbeat::telemetry::Counters;
use fieldbeat::time::{MS, Time};
use fieldbeat::{CyclePlan, Flow, Master, Plan, Simulation};
use fieldbeat_ethercat::object::pdo;
use fieldbeat_ethercat::wire::frame::{BROADCAST, Builder, Command as Datagram, FRAME_MAX};
use fieldbeat_sim::ethercat::Drive;
use fieldbeat_sim::ethercat::{EthercatSegment, EthercatSim, Misuse};

/// The interface of the line.
pub const LINE: &str = "local:line";
pub const STOP: Command = Command::Stop { deceleration: None };
/// Cycles in which a line comes up, with clocks that have to settle.
const UP: u64 = 8_000;

/// A drive as most tests want it, in revolutions: 10 rev/s, and jogs without a button to hold.
pub fn drive(place: u16, family: Family) -> KollmorgenDrive {
    let mut drive = KollmorgenDrive::new(format!("d{place}"), place, family);
    drive.slave.watchdog = Watchdog::After(100 * MS);
    let axis = &mut drive.axis;
    axis.profile.velocity = 10.0;
    axis.profile.acceleration = 100.0;
    axis.profile.deceleration = 100.0;
    axis.stop.deceleration = 200.0;
    axis.enable_timeout = Duration::from_secs(3);
    axis.jog_deadman = None;
    drive
}

/// The same with two of its fixed PDOs.
pub fn with(place: u16, family: Family, outputs: u16, inputs: u16) -> KollmorgenDrive {
    let mut drive = drive(place, family);
    let fixed =
        |pdo| pdo::fixed(family).into_iter().find(|layout| layout.pdo == pdo).expect("it has this PDO");
    (drive.outputs, drive.inputs) = (fixed(outputs), fixed(inputs));
    drive.fit();
    drive
}

/// Drives of the S700 that take velocities.
pub fn plan(count: u16) -> EthercatPlan {
    EthercatPlan::new(LINE, (0..count).map(|place| drive(place, Family::S700)).collect())
}

pub fn jog(velocity: f64) -> Command {
    Command::Jog(Jog { velocity, acceleration: 100.0 })
}

/// The machine of a bus with these tables in it, as a user writes them.
fn machine_of(tables: &str) -> Machine {
    let text = format!("[[bus]]\nprotocol = \"ethercat\"\ninterface = \"{LINE}\"\n{tables}");
    let Configuration { mut plan, simulation, .. } = parse(&text, "line.toml").unwrap_or_else(|errors| {
        panic!("{text}: {:?}", errors.iter().map(ToString::to_string).collect::<Vec<_>>())
    });
    Machine::on(plan.buses.remove(0), simulation.build(), plan.cycle, WorldOptions::default())
}

/// A datagram of somebody else passes the slaves, and does not come to their master: what it brings back.
pub fn pass(line: &mut EthercatSim, now: Time, command: Datagram, data: &[u8]) -> Vec<u8> {
    let mut room = [0; FRAME_MAX];
    let mut frame = Builder::new(&mut room, BROADCAST, [0x30; 6]).unwrap();
    let place = frame.push_with(command, 7, data).unwrap();
    let length = frame.finish();
    line.pass(now, &mut room[..length]);
    room[place.data()].to_vec()
}

/// A line and its master.
pub struct Machine {
    pub sim: Simulation,
    pub count: usize,
}

impl Machine {
    pub fn new(segment: impl Into<EthercatSegment>) -> Machine {
        Machine::with(segment, false, WorldOptions::default())
    }

    /// `leads`: the clock of the line steers the grid.
    pub fn with(segment: impl Into<EthercatSegment>, leads: bool, options: WorldOptions) -> Machine {
        let segment = segment.into();
        let reference = leads.then(|| segment.plan.name.clone());
        let drives = SimPlan::from(segment.clone()).build();
        let cycle = CyclePlan { reference, ..CyclePlan::default() };
        Machine::on(Box::new(segment.plan), drives, cycle, options)
    }

    pub fn on(bus: Box<dyn BusPlan>, drives: Simulated, cycle: CyclePlan, options: WorldOptions) -> Machine {
        let count = bus.axes().len();
        let plan = Plan { cycle, buses: vec![bus], ..Plan::default() };
        let sim =
            Master::from_plan(plan).simulate_with(drives, options).unwrap_or_else(|error| panic!("{error}"));
        Machine { sim, count }
    }

    /// All drives in operation.
    pub fn enabled(segment: impl Into<EthercatSegment>) -> Machine {
        let mut machine = Machine::new(segment);
        machine.online();
        machine.each(Command::Enable);
        machine
    }

    pub fn look<R>(&self, look: impl FnOnce(&mut EthercatSim) -> R) -> R {
        self.sim.world().look(LINE, |line: &mut EthercatSim, _| look(line)).expect("there is a line")
    }

    pub fn pass(&self, command: Datagram, data: &[u8]) -> Vec<u8> {
        let now = self.sim.world().now();
        self.look(|line| pass(line, now, command, data))
    }

    /// Looks at the drive at a place of the line.
    pub fn drive<R>(&self, place: usize, look: impl FnOnce(&mut Drive) -> R) -> R {
        self.look(|line| look(line.drive(place).expect("there is a drive")))
    }

    pub fn feedback(&self, index: usize) -> Feedback {
        self.sim.feedback(index)
    }

    pub fn until(&mut self, what: &str, most: u64, done: impl Fn(&Machine) -> bool) -> u64 {
        for turn in 0..most {
            if done(self) {
                return turn;
            }
            self.sim.step();
        }
        let all: Vec<_> = (0..self.count).map(|index| self.feedback(index)).collect();
        let slaves = self.look(|line| {
            let states = (0..).map_while(|place| line.slave(place).map(|slave| slave.state()));
            states.collect::<Vec<_>>()
        });
        panic!("not within {most} turns: {what}; {slaves:?} {all:#?}");
    }

    pub fn online(&mut self) {
        let count = self.count;
        self.until("online", UP, |machine| {
            (0..count).all(|index| machine.feedback(index).link == Link::Online)
        });
    }

    pub fn run(&mut self, turns: u64) {
        self.sim.run(turns);
    }

    /// How a command ends.
    pub fn ended(&mut self, index: usize, command: Command) -> Outcome {
        let outcome = self.sim.execute(index, command, 20_000).unwrap_or_else(|error| panic!("{error}"));
        outcome.unwrap_or_else(|| panic!("{command:?} has no end: {:?}", self.feedback(index)))
    }

    pub fn done(&mut self, index: usize, command: Command) {
        assert_eq!(self.ended(index, command), Outcome::Done, "{command:?}: {:?}", self.feedback(index));
    }

    /// All axes, one after the other.
    pub fn each(&mut self, command: Command) {
        (0..self.count).for_each(|index| self.done(index, command));
    }

    pub fn post(&mut self, index: usize, command: Command) {
        self.sim.axis(index).post(command).unwrap_or_else(|error| panic!("{error}"));
    }

    /// After a stop by the master.
    pub fn recover(&mut self, index: usize) {
        self.done(index, Command::Reset);
        self.done(index, Command::Enable);
    }

    /// It turns, in operation, by fresh inputs.
    pub fn assert_turns(&self, index: usize, velocity: f64) {
        let feedback = self.feedback(index);
        assert!((feedback.status.velocity - velocity).abs() < 0.3, "not {velocity}: {feedback:?}");
        assert_eq!((feedback.status.state, feedback.age), (State::OperationEnabled, 0));
        let rpm = self.drive(index, |drive| drive.rpm());
        assert!((rpm - 60.0 * velocity).abs() < 20.0, "{rpm} rpm");
    }

    /// Nothing was done that real hardware does not tolerate.
    pub fn assert_no_misuse(&self) {
        self.look(|line| {
            let misuses = (0..).map_while(|place| line.slave(place).map(|slave| slave.misuse()));
            for (place, misuse) in misuses.enumerate() {
                assert_eq!(misuse, Misuse::default(), "at place {place}");
            }
        });
    }

    /// Goes to its orderly end; neither that nor what was before is a misuse of any slave.
    pub fn end_well(mut self) {
        self.assert_no_misuse();
        self.stop();
        self.assert_no_misuse();
    }

    /// Goes to its orderly end, and gives what was counted of each drive.
    pub fn end(mut self) -> Vec<Counters> {
        self.stop();
        self.sim.finish().drives.into_iter().map(|drive| drive.counters).collect()
    }

    fn stop(&mut self) {
        self.sim.stop();
        for _ in 0..10_000 {
            if self.sim.step() == Flow::End {
                return;
            }
        }
        panic!("no end");
    }
}
