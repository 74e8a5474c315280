//! The whole machine in virtual time: the same loop, buses and stations as on the real clock, with simulated drives
//! on a network in memory. Hours pass in seconds, and the same seed gives the same bytes.
//!
//! An application tests its own motion logic here: post commands, let cycles pass, look at events. Time passes only
//! when it is stepped, so that the blocking calls of [`Axis`] would wait for ever; for a program that has them,
//! [`Simulation::into_master`] steps it on a thread.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::watch::LoopWatch;
use crate::{Assembly, Devices, Master, MasterError, Setup, StartError, assemble, kept_for, utc_ns};
use fieldbeat_core::axis::acyclic::Acyclic;
use fieldbeat_core::axis::{Axis, Command, Event, EventKind, Feedback, Observer, Outcome, Pulse};
use fieldbeat_core::axis::{AxisError, CommandId};
use fieldbeat_core::bus::OpenError;
use fieldbeat_core::bus::load::Way;
use fieldbeat_core::cycle::engine::{Control, Engine, Flow};
use fieldbeat_core::cycle::ring::RecordReader;
use fieldbeat_core::cycle::status::{Gauges, Numbers, Status};
use fieldbeat_core::cycle::{Plan, PlanErrors};
use fieldbeat_core::logged::{LoggedCarriers, LoggedClock};
use fieldbeat_core::net::Carriers;
use fieldbeat_core::rt::confine::{self, give_up_rights};
use fieldbeat_core::rt::{Clock, Granted, Regions, Wires};
use fieldbeat_core::time::nanos;
use fieldbeat_sim::world::{World, WorldClock, WorldOptions};
use fieldbeat_sim::{SimPlan, Simulated};
use fieldbeat_telemetry::tap::{Tap, Taps};
use fieldbeat_telemetry::{Feed, Keep, Measured, Monitor, Recorded, Sink, TelemetryThread};

/// By so much may virtual time be ahead of its pace before the thread that steps it sleeps.
const AHEAD: Duration = Duration::from_millis(1);

/// A machine in virtual time.
#[derive(Debug)]
pub struct Simulation {
    world: World,
    engine: Engine<LoggedClock<WorldClock>>,
    axes: Vec<Option<Axis>>,
    observers: Vec<Observer>,
    devices: Devices,
    acyclics: Vec<Acyclic>,
    pulse: Pulse,
    control: Control,
    wires: Wires,
    records: RecordReader,
    measured: Measured,
    taps: Taps,
    telemetry_by: fn(&mut dyn FnMut()),
    plan: Plan,
    gauges: Gauges,
    black_box: Option<Box<dyn Keep>>,
    sink: Option<(PathBuf, Box<dyn Sink>)>,
    /// How many causes of late cycles it was given.
    judged: u64,
    /// Events seen by [`execute`](Simulation::execute) while it waited for another one.
    pub events: Vec<(usize, Event)>,
}

/// The events of a simulated drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum DriveEvent {
    /// The cable is pulled out: on an EtherCAT segment in front of it, so that all behind it are gone, too; on a
    /// serial wire that of the master. The drive goes on by itself.
    Unplug,
    /// The cable is back.
    Plug,
    /// It is switched off and on again.
    Restart,
    /// The hardware enable (STO) is open for so long.
    OpenSto(Duration),
}

/// The grants of virtual time.
pub(crate) fn granted() -> Granted {
    let missing = vec!["time is virtual: nothing here says what this host is worth".to_owned()];
    Granted { policy: "virtual", priority: 0, core: None, memory_locked: false, missing }
}

/// Why a simulation could not be built.
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum SimulateError {
    /// The plan contradicts itself.
    #[error(transparent)]
    Plan(#[from] PlanErrors),
    /// A bus could not be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The drives do not fit into one network.
    #[error("cannot simulate the drives: {0}")]
    World(#[from] std::io::Error),
}
fieldbeat_core::debug_as_display!(SimulateError);

impl Setup {
    /// The simulated drives of the machine: default ones that fit its plan, or those of its configuration.
    pub fn simulation(&self) -> &SimPlan {
        self.drives.get_or_init(|| SimPlan::of(&self.plan.buses))
    }

    /// Sets the simulated drives of the machine.
    pub fn with_simulation(mut self, simulation: impl Into<SimPlan>) -> Setup {
        self.drives = simulation.into().into();
        self
    }

    /// Builds the machine in virtual time, with its simulated drives.
    pub fn simulate(self, options: WorldOptions) -> Result<Simulation, SimulateError> {
        let drives = self.simulation().build();
        self.simulate_with(drives, options)
    }

    /// Builds the machine in virtual time, with these drives in place of its own simulated ones.
    pub fn simulate_with(
        self,
        drives: impl Into<Simulated>,
        options: WorldOptions,
    ) -> Result<Simulation, SimulateError> {
        self.plan().check()?;
        let world = World::new(drives, options)?;
        let mut setup = self;
        let mut regions = Regions::default();
        let (log, link) = setup.begin_log(&mut regions);
        let Setup { plan, task, black_box, mut sink, .. } = setup;
        let has_task = task.is_some();
        let control = Control::default();
        let clock = LoggedClock::new(world.clock(), &log);
        let logged = LoggedCarriers::new(&world, &log, link);
        let carriers: &dyn Carriers = if log.is_on() { &logged } else { &world };
        let Assembly { mut engine, axes, devices, acyclics, gauges, records, pulse, wires, .. } = assemble(
            &plan,
            clock,
            carriers,
            task,
            control.clone(),
            Wires::default(),
            kept_for(&plan, black_box.as_deref(), false),
        )?;
        engine.begin();
        if let Some((_, sink)) = &mut sink {
            sink.begin(utc_ns(engine.clock().inner().now()));
        }
        Ok(Simulation {
            world,
            engine,
            observers: axes.iter().map(Axis::observer).collect(),
            wires,
            measured: Measured::new(&plan.units(), &plan.cycle, has_task),
            taps: Taps::default(),
            telemetry_by: |work| work(),
            axes: axes.into_iter().map(Some).collect(),
            devices,
            acyclics,
            gauges,
            plan,
            black_box,
            sink,
            judged: 0,
            pulse,
            control,
            records,
            events: Vec::new(),
        })
    }
}

impl Simulation {
    /// A master whose thread steps this machine from now on, virtual time passing `speed` times as fast as real time,
    /// or as fast as this computer can: a program that was written for real drives runs on it unchanged. Its waits have
    /// their limits in real time. What has to keep time with the cycle, as the rows of a stream, needs a speed that the
    /// program can follow; 1 is that of a real machine.
    ///
    /// # Panics
    ///
    /// If the speed is not above 0.
    pub fn into_master(self, speed: f64) -> Result<Master, StartError> {
        assert!(speed > 0.0, "a speed of {speed}");
        let Simulation {
            mut engine,
            axes,
            devices,
            acyclics,
            pulse,
            control,
            records,
            measured,
            taps,
            sink,
            ..
        } = self;
        let thread = std::thread::Builder::new()
            .name("fb-loop".into())
            .spawn(move || {
                give_up_rights(confine::Keep::Nothing);
                let (begun, virtual_begun) = (Instant::now(), engine.clock().inner().now());
                while engine.step() == Flow::Continue {
                    let passed = engine.clock().inner().now().since(virtual_begun) as f64 / speed;
                    let ahead = Duration::from_nanos(passed as u64).saturating_sub(begun.elapsed());
                    if ahead > AHEAD {
                        std::thread::sleep(ahead);
                    }
                }
                engine.finish()
            })
            .map_err(StartError::Thread)?;
        let feed = sink.map(|(path, sink)| Feed::new(path, sink, &taps));
        let aside = || give_up_rights(confine::Keep::Files);
        let started = TelemetryThread::start(records, measured, taps, None, self.black_box, aside)
            .and_then(|telemetry| telemetry.feed(feed, self.gauges.status.clone(), aside));
        let telemetry = match started {
            Ok(telemetry) => telemetry,
            Err(error) => {
                control.stop();
                let _ = thread.join();
                return Err(StartError::Thread(error));
            }
        };
        let monitor = Monitor::new(self.plan, granted(), self.gauges, Arc::clone(telemetry.gathered()), None);
        Ok(Master {
            axes: Mutex::new(axes),
            devices: Mutex::new(devices),
            acyclics,
            monitor,
            pulse,
            control,
            telemetry,
            watch: LoopWatch::none(self.wires, Vec::new()),
            guardian: None,
            no_guardian: None,
            thread: Some(thread),
        })
    }

    /// The simulated network and drives, for disconnecting drives and injecting faults.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Something happens to the simulated drive of axis `name`. What else there is of faults, [`world`](Self::world)
    /// has by address.
    ///
    /// # Errors
    ///
    /// There is no such axis, or the machine has other drives than those of its plan.
    pub fn happen(&self, name: &str, event: DriveEvent) -> Result<(), MasterError> {
        let happened = self.plan.find(name).and_then(|(bus, index)| {
            let facts = bus.facts(self.plan.cycle.grid());
            let (world, drive) = (&self.world, facts.drives.get(index)?);
            let place = drive.place_on_wire;
            Some(match (event, drive.address, facts.load?.way) {
                (DriveEvent::Unplug, Some(at), _) => world.unplug(at),
                (DriveEvent::Plug, Some(at), _) => world.plug(at),
                (DriveEvent::Restart, Some(at), _) => world.restart(at),
                (DriveEvent::OpenSto(time), Some(at), _) => world.open_sto(at, nanos(time)),
                (DriveEvent::Unplug, _, Way::Interface(line)) => world.cut(&line, Some(place)),
                (DriveEvent::Plug, _, Way::Interface(line)) => world.cut(&line, None),
                (DriveEvent::Restart, _, Way::Interface(line)) => world.restart_slave(&line, place),
                (DriveEvent::OpenSto(time), _, Way::Interface(line)) => {
                    world.open_sto_of_slave(&line, place, nanos(time))
                }
                (DriveEvent::Unplug, _, Way::Port(port)) => world.unplug_port(&port),
                (DriveEvent::Plug, _, Way::Port(port)) => world.plug_port(&port),
                (DriveEvent::Restart, _, Way::Port(port)) => world.restart_on(&port, place),
                (DriveEvent::OpenSto(time), _, Way::Port(port)) => {
                    world.open_sto_on(&port, place, nanos(time))
                }
                (_, None, Way::Address(_)) => false,
            })
        });
        match happened {
            Some(true) => Ok(()),
            _ => {
                let axes = self.plan.axes();
                Err(MasterError::unknown("simulated drive", name, axes.iter().map(|axis| &axis.name)))
            }
        }
    }

    /// Axis `index`, in the order of the plan.
    ///
    /// # Panics
    ///
    /// If there is no such axis, or if it was taken.
    pub fn axis(&mut self, index: usize) -> &mut Axis {
        self.axes[index].as_mut().expect("the axis was taken")
    }

    /// Takes axis `index` out, for a [`Group`](fieldbeat_core::axis::Group).
    ///
    /// # Panics
    ///
    /// If there is no such axis, or if it was taken.
    pub fn take_axis(&mut self, index: usize) -> Axis {
        self.axes[index].take().expect("the axis was taken")
    }

    /// Takes the process data of a device that is not a drive, as [`Master::device`](crate::Master::device).
    pub fn device<T: 'static>(&mut self, name: &str) -> Result<T, MasterError> {
        self.devices.take(name)
    }

    /// Acyclic access, as [`Master::acyclics`](crate::Master::acyclics).
    pub fn acyclics(&self) -> &[Acyclic] {
        &self.acyclics
    }

    /// A sign of life of the application, as [`Master::alive`](crate::Master::alive).
    pub fn alive(&self) {
        self.pulse.beat();
    }

    /// The newest feedback of axis `index`.
    pub fn feedback(&self, index: usize) -> Feedback {
        self.observers[index].feedback()
    }

    /// The numbers of the loop so far.
    pub fn status(&self) -> &Status {
        self.engine.status()
    }

    /// The measurements of the telemetry so far. Without a kernel to query, causes other than the drives are unknown.
    pub fn measured(&self) -> &Measured {
        &self.measured
    }

    /// Who may use its wires: nobody watches the loop here.
    #[doc(hidden)]
    pub fn wires(&self) -> &Wires {
        &self.wires
    }

    /// One more reader of the loop's records, from now on, with room for so many turns.
    #[doc(hidden)]
    pub fn tap(&self, room: usize) -> Tap {
        self.taps.add(room)
    }

    /// The plan.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// The loop and all drives in numbers so far. Those of a drive are at most 64 cycles or 100 ms old.
    pub fn numbers(&self) -> Numbers {
        self.gauges.numbers()
    }

    /// The remarks on drives and devices although they are in operation; see
    /// [`Monitor::remarks`](fieldbeat_telemetry::Monitor::remarks).
    pub fn remarks(&self) -> Vec<String> {
        self.gauges.remarks()
    }

    /// One turn of the loop: one executed cycle, or slots passed over.
    pub fn step(&mut self) -> Flow {
        let flow = self.engine.step();
        let by = self.telemetry_by;
        by(&mut || self.gather());
        flow
    }

    /// Runs the work of the telemetry by this, which on the real clock has a thread of its own: what counts the loop's
    /// allocations leaves it out.
    #[doc(hidden)]
    pub fn run_telemetry_by(&mut self, by: fn(&mut dyn FnMut())) {
        self.telemetry_by = by;
    }

    /// Empties the ring of the loop.
    fn gather(&mut self) {
        let mut batch = (!self.taps.is_empty()).then(Vec::new);
        while let Some(record) = self.records.pop() {
            self.measured.enter(&record);
            if let Some((_, sink)) = &mut self.sink {
                sink.enter(&record);
            }
            if let Some(batch) = &mut batch {
                batch.push(record);
            }
        }
        self.taps.hand(batch.unwrap_or_default());
        self.look_at_recording();
    }

    /// Gives a recording the causes of late cycles that are new, and has it take the log.
    fn look_at_recording(&mut self) {
        if let Some((_, sink)) = &mut self.sink {
            self.measured.causes.judged_after(&mut self.judged).for_each(|judged| sink.late(judged));
            // Nothing is lost on the way here. What fails is in what its end returns.
            sink.look(self.engine.status().lost_records);
        }
    }

    /// Ends the recording of [`Setup::with_recorder`](crate::Setup::with_recorder), if there is one. Returns the files
    /// that were written.
    pub fn finish_recording(&mut self) -> Vec<Recorded> {
        self.look_at_recording();
        self.sink.take().map_or(Vec::new(), |(_, mut sink)| sink.finish())
    }

    /// Runs so many turns.
    pub fn run(&mut self, turns: u64) {
        for _ in 0..turns {
            self.step();
        }
    }

    /// Runs turns until `done` holds, at most `most`. Returns whether it held.
    pub fn run_until(&mut self, most: u64, mut done: impl FnMut(&Simulation) -> bool) -> bool {
        for _ in 0..most {
            if done(self) {
                return true;
            }
            self.step();
        }
        done(self)
    }

    /// Posts `command` to axis `index` and lets the loop turn until it has ended, at most `most` turns. `None`: it has
    /// not ended. Other events are appended to [`events`](Simulation::events).
    pub fn execute(
        &mut self,
        index: usize,
        command: Command,
        most: u64,
    ) -> Result<Option<Outcome>, AxisError> {
        let id = self.axis(index).post(command)?;
        Ok(self.run_command(index, id, most))
    }

    /// Lets the loop turn until command `id` of axis `index` has ended, at most `most` turns.
    pub fn run_command(&mut self, index: usize, id: CommandId, most: u64) -> Option<Outcome> {
        for _ in 0..most {
            self.step();
            while let Some(event) = self.axis(index).event() {
                if let EventKind::Ended { id: ended, outcome, .. } = event.kind
                    && ended == id
                {
                    return Some(outcome);
                }
                self.events.push((index, event));
            }
        }
        None
    }

    /// Requests the orderly end.
    pub fn stop(&self) {
        self.control.stop();
    }

    /// The exact numbers of the run. A recording ends with it; [`finish_recording`](Simulation::finish_recording)
    /// before says what became of it.
    pub fn finish(mut self) -> Numbers {
        self.finish_recording();
        self.engine.finish()
    }
}
