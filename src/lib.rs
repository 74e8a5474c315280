//! Fieldbeat: a hard-real-time cyclic master for servo drives.
//!
//! One thread, SCHED_FIFO and pinned to a core, wakes on an absolute time grid. In every cycle it sends one
//! preallocated request to every drive that is due, takes in the replies until a deadline, evaluates them, and
//! publishes feedback. Application threads talk to it through wait-free queues and never make it wait.
//!
//! **It is not a safety function.** A machine needs its own STO / emergency stop.
//!
//! # A tour
//!
//! - [`Master`] brings a machine up from a file or from a [`Plan`] built in code, and hands out its [`Axis`] handles.
//! - [`Axis`] is the application's end of one drive: commands ([`Command`]) that each end in Done, Failed or Aborted,
//!   streamed rows ([`Row`]), the newest [`Feedback`], events ([`Event`]).
//! - [`Axis::parameter`] reads and writes the drive's parameters outside the cycle ([`axis::Parameters`]); the
//!   other services of a LinMot drive, such as curves and command tables, are in [`bus::linudp::service`].
//! - [`Group`] takes several axes: commands and rows of all of them take effect in the same cycle's send, all or
//!   none.
//! - An in-loop task ([`Setup::with_task`]) runs inside the cycle: it sees the feedback of cycle k, and its
//!   commands leave in cycle k + 1.
//! - [`Monitor`] reads a running machine from any thread: its numbers, histograms, and why cycles were late
//!   ([`telemetry`]); [`telemetry::metrics`] serves them to Prometheus, and [`telemetry::report`] writes the results
//!   of a run.
//! - [`Setup::simulate`] builds the same machine in virtual time, with simulated drives and seeded faults: hours pass
//!   in seconds, and the same seed gives the same bytes.
//! - [`replay`] repeats a recorded run bit by bit: a failure in the field becomes a test.
//! - [`doctor`] reports how fit a host is for real time, and how to fix what is not.
//! - [`bus`] has a folder for each protocol: the plan of its buses, its native process data, its services.
//!
//! # A complete program
//!
//! It starts the simulated drives of the sample configuration, so that it runs anywhere. Without that line it moves
//! real drives.
//!
//! ```no_run
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # #[cfg(feature = "files")] {
//! use std::time::Duration;
//!
//! use fieldbeat::sim::server::{ServerOptions, SimServer};
//! use fieldbeat::{Master, Profile};
//!
//! // First: this program is the guardian of its master, too.
//! fieldbeat::guardian_main();
//! let setup = Master::from_file("rt-config/demo.toml")?;
//! let _drives = SimServer::start(setup.simulation().build(), ServerOptions::default())?;
//!
//! let master = setup.start()?;
//! master.wait_online(Duration::from_secs(5))?;
//!
//! let mut x = master.axis("a1")?;
//! x.enable()?;
//! x.home()?;
//! x.move_to(120.0, Profile { velocity: 200.0, ..x.profile() })?;
//! let feedback = x.feedback();
//! println!("{:.3} mm, {} cycles old", feedback.status.position, feedback.age);
//! x.disable()?;
//!
//! let run = master.finish();
//! let status = run.end.status;
//! println!("{} cycles executed, {} skipped", status.executed, status.skipped);
//! # }
//! # Ok(())
//! # }
//! ```
//!
//! # Features
//!
//! The default is the whole program. With `default-features = false` there is the runtime for a program of your own:
//! [`Master`], [`axis`], [`bus`] and the histograms of [`telemetry`], for a [`Plan`] that is built in code. Each wire
//! is a feature, and with one of them at most 26 packages are compiled: no simulator, no reader of files, no other
//! wire.
//!
//! | feature | what it adds |
//! |---|---|
//! | `linudp`, `modbus`, `ethercat`, `ethernet-ip`, `profibus` | that module of [`bus`] |
//! | `wires` | all five |
//! | `sim` | [`sim`] and [`Simulation`]: simulated drives, the machine in virtual time; brings `wires` |
//! | `files` | [`config`]: a plan from TOML, [`Master::from_file`]; recordings, reports, black boxes and metrics in [`telemetry`]; [`replay`]; [`doctor`]; brings `sim` |
//! | `cli` | the program; the default; brings `files` |
//! | `jog` | the program's panel in the terminal; brings `cli` |
//! | `scope` | the program's page of a running machine in the browser, with a web server; brings `cli` |
//!
//! # Architecture
//!
//! This package re-exports. The packages below it point down only: the program -> `master` -> `config`, `record`,
//! `telemetry`, `sim` -> the wires -> the core, in which the loop stands on the drive machine, on the contract of a
//! bus, and on axes and sockets. What is listed here is kept; the packages below change freely.

pub mod bus;
#[cfg(feature = "files")]
mod files;
#[cfg(feature = "sim")]
pub mod sim;

pub mod axis {
    //! What an application holds: the handles of its axes, their commands, feedback and events, units.

    /// # Example
    ///
    /// ```
    /// # use fieldbeat::{Master, Plan, Profile};
    /// # use std::time::Duration;
    /// # use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
    /// # use fieldbeat::sim::WorldOptions;
    /// # let named = |(name, host)| LinUdpDrive::new(name, [10, 0, 0, host].into());
    /// # let drives = ["x", "y"].into_iter().zip(10..).map(named);
    /// # let bus = LinUdpPlan::new([10, 0, 0, 1].into(), drives.collect());
    /// # let setup = Master::from_plan(Plan { buses: vec![Box::new(bus)], ..Plan::default() });
    /// # let master = setup.simulate(WorldOptions::default())?.into_master(20.0)?;
    /// # master.wait_online(Duration::from_secs(30))?;
    /// let mut x = master.axis("x")?;
    /// x.enable()?;
    /// x.home()?;
    /// x.move_to(120.0, Profile { velocity: 200.0, ..x.profile() })?;
    ///
    /// let feedback = x.feedback();
    /// assert!((feedback.status.position - 120.0).abs() < 0.1);
    /// // What cannot work is refused before anything is sent.
    /// assert!(x.move_to(f64::NAN, x.profile()).is_err());
    /// x.disable()?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[doc(inline)]
    pub use fieldbeat_core::axis::Axis;
    /// # Example
    ///
    /// ```
    /// # use fieldbeat::{Group, Master, Plan};
    /// # use std::time::Duration;
    /// # use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
    /// # use fieldbeat::sim::WorldOptions;
    /// # let drives = ["x", "y"].into_iter().zip(10..).map(|(name, host)| {
    /// #     let mut drive = LinUdpDrive::new(name, [10, 0, 0, host].into());
    /// #     drive.axis.stop.group = Some(1);
    /// #     drive
    /// # });
    /// # let bus = LinUdpPlan::new([10, 0, 0, 1].into(), drives.collect());
    /// # let setup = Master::from_plan(Plan { buses: vec![Box::new(bus)], ..Plan::default() });
    /// # let master = setup.simulate(WorldOptions::default())?.into_master(20.0)?;
    /// # master.wait_online(Duration::from_secs(30))?;
    /// let mut gantry = Group::new([master.axis("x")?, master.axis("y")?])?;
    /// gantry.enable()?;
    /// gantry.home()?;
    /// gantry.move_to(&[100.0, 50.0])?;
    /// let [x, y] = [0, 1].map(|index| gantry.feedback()[index].status.position);
    /// assert!((x - 100.0).abs() < 0.1 && (y - 50.0).abs() < 0.1);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[doc(inline)]
    pub use fieldbeat_core::axis::Group;
    /// # Example
    ///
    /// ```
    /// # use fieldbeat::{Master, Plan};
    /// # use std::time::Duration;
    /// # use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
    /// # use fieldbeat::sim::WorldOptions;
    /// # let named = |(name, host)| LinUdpDrive::new(name, [10, 0, 0, host].into());
    /// # let drives = ["x", "y"].into_iter().zip(10..).map(named);
    /// # let bus = LinUdpPlan::new([10, 0, 0, 1].into(), drives.collect());
    /// # let setup = Master::from_plan(Plan { buses: vec![Box::new(bus)], ..Plan::default() });
    /// # let master = setup.simulate(WorldOptions::default())?.into_master(20.0)?;
    /// # master.wait_online(Duration::from_secs(30))?;
    /// let parameters = master.parameter("x")?;
    /// // The home position, in RAM; 0.1 um.
    /// let home: i32 = parameters.read("0x13C7")?;
    /// parameters.write("0x13C7", home + 10_000)?;
    /// assert_eq!(parameters.read::<i32>("0x13C7")?, home + 10_000);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[doc(inline)]
    pub use fieldbeat_core::axis::Parameters;
    #[doc(inline)]
    pub use fieldbeat_core::axis::{
        Abort, Acyclic, AxisError, AxisPlan, BegunBy, CallError, Command, CommandId, DriveStatus, Emergency,
        Event, EventKind, Failure, Fault, Feedback, FollowingError, FoundRunning, GroupCommand, GroupError,
        GroupRefused, Health, HeldBy, InPosition, Jog, Limits, Link, Load, Move, NativeOwner, Observer,
        Outcome, OwnerLost, ParameterError, ParameterTicket, PlanFault, Profile, RangeError, Row, Samples,
        Scalar, Shown, State, StopCause, StopHow, StopPlan, StopThen, StopTimeout, Target, Underrun, Unit,
        Units,
    };
}

pub mod time {
    //! Instants of CLOCK_MONOTONIC in ns, and lengths of time.

    #[doc(inline)]
    pub use fieldbeat_core::time::{MS, Ns, S, Time, US};
}

pub mod telemetry {
    //! What the loop reports: histograms, causes of late cycles, how the axes moved.

    #[cfg(feature = "files")]
    #[doc(no_inline)]
    pub use crate::files::telemetry::Summary;
    #[cfg(feature = "files")]
    pub use crate::files::telemetry::{blackbox, metrics, recording, report, summary};
    #[doc(inline)]
    pub use fieldbeat_core::rt::Granted;
    #[doc(inline)]
    pub use fieldbeat_telemetry::{
        AtEnd, AxisMotion, Band, BusClock, Cause, Causes, Condition, Counters, DeviceEnd, DriveEmergency,
        DriveEnd, DriveHistograms, Extent, Failure, Happened, Histograms, Judged, Largest, LoopPanic, Mark,
        Marks, Measured, Monitor, Motion, Moved, Numbers, Peak, Peaks, Quantiles, Quantity, Recorded,
        ReferenceStatus, Run, Stage, Status, StopRequest, Stretch, Tally, Timeline, Unmatched, WireSummary,
        Written,
    };
}

#[cfg(feature = "files")]
pub use self::files::{config, doctor, replay};

#[doc(no_inline)]
pub use self::axis::{Axis, Command, Event, EventKind, Feedback, Group, Profile, Row};
#[doc(no_inline)]
pub use self::bus::OpenError;
#[cfg(feature = "sim")]
pub use self::sim::machine::{DriveEvent, SimulateError, Simulation};
#[doc(no_inline)]
pub use self::telemetry::{Monitor, Run};
#[doc(no_inline)]
pub use self::time::Time;
#[doc(inline)]
pub use fieldbeat_core::bus::Cycle;
/// # Example
///
/// ```
/// use fieldbeat::Plan;
/// use fieldbeat::bus::modbus::{ModbusPlan, UnidriveDrive};
/// use fieldbeat::CyclePlan;
///
/// let mut drive = UnidriveDrive::new("winder", [192, 168, 1, 20].into());
/// drive.axis.limits.velocity = Some(25.0);
/// // 2 ms, and the drive in every fourth cycle.
/// drive.axis.divisor = 4;
/// let cycle = CyclePlan { period_ns: 2_000_000, ..CyclePlan::default() };
/// let plan = Plan { cycle, buses: vec![Box::new(ModbusPlan::new(vec![drive]))], ..Plan::default() };
/// plan.check()?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[doc(inline)]
pub use fieldbeat_core::cycle::Plan;
#[doc(inline)]
pub use fieldbeat_core::cycle::engine::Flow;
#[doc(inline)]
pub use fieldbeat_core::cycle::task::Axes;
#[doc(inline)]
pub use fieldbeat_core::cycle::{
    CyclePlan, GroupPlan, Guard, OnCost, Overrun, PlanErrors, Shares, Wait, WatchAfter,
};
#[doc(inline)]
pub use fieldbeat_core::rt::{Memory, Realtime, RealtimeError};
/// # Example
///
/// ```
/// # use fieldbeat::{Master, Plan};
/// # use std::time::Duration;
/// # use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
/// # use fieldbeat::sim::WorldOptions;
/// # let drives = ["x", "y"].into_iter().zip(10..).map(|(name, host)| LinUdpDrive::new(name, [10, 0, 0, host].into()));
/// # let bus = LinUdpPlan::new([10, 0, 0, 1].into(), drives.collect());
/// # let setup = Master::from_plan(Plan { buses: vec![Box::new(bus)], ..Plan::default() });
/// # let master = setup.simulate(WorldOptions::default())?.into_master(20.0)?;
/// # master.wait_online(Duration::from_secs(30))?;
/// // From another thread, at any time.
/// let monitor = master.monitor();
/// assert_eq!(monitor.status().online, 2);
///
/// let run = master.finish();
/// assert_eq!(run.end.status.planned, run.end.status.executed + run.end.status.skipped);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[doc(inline)]
pub use fieldbeat_master::Master;
/// # Example
///
/// ```
/// use fieldbeat::{Master, Plan};
/// # use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
/// # use fieldbeat::sim::WorldOptions;
/// # let drive = LinUdpDrive::new("x", [10, 0, 0, 10].into());
/// # let bus = LinUdpPlan::new([10, 0, 0, 1].into(), vec![drive]);
/// # let plan = Plan { buses: vec![Box::new(bus)], ..Plan::default() };
///
/// // `start` in place of `simulate` runs it on its drives, in real time.
/// let setup = Master::from_plan(plan).with_task(|cycle, axes| {
///     // On the real-time thread: it sees the feedback of this cycle, and its commands leave in the next one.
///     let _position = axes.feedback(0).map(|feedback| feedback.status.position);
///     let _now = cycle.grid;
/// });
/// let mut machine = setup.simulate(WorldOptions::default())?;
/// machine.run(1_000);
/// assert_eq!(machine.status().executed, 1_000);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[doc(inline)]
pub use fieldbeat_master::Setup;
#[doc(inline)]
pub use fieldbeat_master::{MasterError, NoGuardian, StartError, StopHandle, guardian_main};
