//! A machine: the checked plan, the open buses, the loop's thread and the application's handles, joined.
//!
//! `assembly` builds the loop and the handles from a plan, for whatever clock and thread; here they get the loop's
//! thread, the telemetry and the application; `guardian` is the process that stops drives in place of this one; `log`
//! begins the log of the loop's inputs, if one is wanted; `process` ends what runs when the process ends; `watch` sees
//! a loop whose cycle does not end.

mod assembly;
#[cfg(feature = "files")]
mod files;
mod guardian;
mod log;
mod process;
#[cfg(feature = "sim")]
pub mod simulation;
mod watch;

use std::ops::Deref;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use thiserror::Error;

pub use self::assembly::{Assembly, Devices, assemble};
use self::guardian::Guardian;
pub use self::guardian::{NoGuardian, guardian_main};
use self::process::Running;
pub use self::process::{ENDING, action_of};
pub(crate) use self::watch::LoopWatch;
use fieldbeat_core::axis::acyclic::{Acyclic, Parameters};
use fieldbeat_core::axis::handle;
use fieldbeat_core::axis::{Axis, Group, GroupError, Link, Pulse, StopCause};
use fieldbeat_core::bus::diagnosis::NOT_YET;
use fieldbeat_core::bus::{Cycle, OpenError};
use fieldbeat_core::cycle::cost::{Costs, Demand};
use fieldbeat_core::cycle::engine::{Control, LoopPanic};
use fieldbeat_core::cycle::ring::Kept;
use fieldbeat_core::cycle::status::{AtEnd, Numbers};
use fieldbeat_core::cycle::task::{Axes, Task};
use fieldbeat_core::cycle::{self, OnCost, Plan, PlanErrors, WatchAfter};
use fieldbeat_core::drive::last::LastStop;
use fieldbeat_core::logged::{LoggedCarriers, LoggedClock};
use fieldbeat_core::net::{Carriers, Os};
use fieldbeat_core::rt::watch::ThreadWatch;
use fieldbeat_core::rt::{
    self, Clock, Held, Memory, MonotonicClock, Realtime, RealtimeError, RealtimePlan, Regions, Usage, Wires,
    Words,
};
use fieldbeat_core::time::{self, Time};
use fieldbeat_telemetry::log::{LogSink, MachineOf};
use fieldbeat_telemetry::tap::Taps;
use fieldbeat_telemetry::{Feed, Keep, Measured, Monitor, Run, Sink, TelemetryThread};

/// A machine that has not started yet.
#[derive(Default)]
pub struct Setup {
    plan: Plan,
    /// Default ones that fit the plan, unless others were set.
    #[cfg(feature = "sim")]
    drives: std::sync::OnceLock<fieldbeat_sim::SimPlan>,
    task: Option<Task>,
    black_box: Option<Box<dyn Keep>>,
    log_sink: Option<LogSink>,
    machine: MachineOf,
    /// With the file that it writes.
    sink: Option<(PathBuf, Box<dyn Sink>)>,
    stop_on_signals: bool,
    confine: bool,
    guardian: Option<PathBuf>,
}

impl std::fmt::Debug for Setup {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Setup").field("plan", &self.plan).field("task", &self.task.is_some()).finish()
    }
}

/// A running machine. Dropping it stops all axes, powers them off and ends the loop. If the loop's cycle does not end,
/// it returns without it, once the [watch](fieldbeat_core::cycle::WatchAfter) has done what can be done.
///
/// So does the end of the process by `exit` or by a return from `main`, if it is not dropped before, as in a `static`:
/// a handler of `exit` (atexit(3)) waits for the loops of all masters. After the longest `stop.timeout` of its axes and
/// a second, at most after 30 s, it shortens their waits, and 3 s later it gives up. The measurements are lost then:
/// [`finish`](Master::finish) returns them. What else ends a process is in [`Setup::stop_on_signals`].
#[derive(Debug)]
pub struct Master {
    axes: Mutex<Vec<Option<Axis>>>,
    devices: Mutex<Devices>,
    acyclics: Vec<Acyclic>,
    monitor: Monitor,
    pulse: Pulse,
    control: Control,
    telemetry: TelemetryThread,
    watch: LoopWatch,
    guardian: Option<Guardian>,
    no_guardian: Option<NoGuardian>,
    thread: Option<JoinHandle<Numbers>>,
}

/// Why a machine did not start. No drive was commanded. The message ends with the remedy.
#[derive(Error)]
#[non_exhaustive]
pub enum StartError {
    /// The plan contradicts itself.
    #[error(transparent)]
    Plan(#[from] PlanErrors),
    /// A bus could not be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// Real-time scheduling is required and not available.
    #[error(transparent)]
    Realtime(#[from] RealtimeError),
    /// The cycle would occupy its core until the kernel takes the core away.
    #[error("{0}")]
    Starving(String),
    /// A cycle takes longer than its period on this host, or its wire does.
    #[error("{0}")]
    Cost(String),
    /// A thread could not be started.
    #[error("cannot start a thread: {0}; look at the limits of processes and memory (ulimit -u, ulimit -v)")]
    Thread(std::io::Error),
    /// The loop's thread ended before its first cycle.
    #[error("the loop's thread ended at its start; its own message is above")]
    Ended,
}
fieldbeat_core::debug_as_display!(StartError);

/// Why the application did not get an axis, or not in time.
#[derive(Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum MasterError {
    /// No such axis, device or group.
    #[error("there is no {what} {name}; there are: {known}")]
    Unknown {
        /// An axis, a device or a group.
        what: &'static str,
        /// The requested name.
        name: String,
        /// The names that exist.
        known: String,
    },
    /// The axis was taken already.
    #[error("axis {0} is already taken: an axis has one owner; read it through an observer")]
    Taken(String),
    /// The device was taken already.
    #[error("device {0} is already taken: its process data has one owner")]
    DeviceTaken(String),
    /// The device is of another type.
    #[error("device {0} has process data of another type; request the type that its protocol names")]
    DeviceType(String),
    /// The axes of the group cannot act together.
    #[error(transparent)]
    NotAGroup(GroupError),
    /// Not all axes came online.
    #[error("not online after {waited:?}: {missing}")]
    NotOnline {
        /// How long the call waited.
        waited: Duration,
        /// The axes that are missing, each with the reason and what to do.
        missing: String,
    },
    /// Another master commands a drive, or has frames on its segment.
    #[error("another master commands {0}: end that one, then start this one again")]
    OtherMaster(String),
    /// The end was requested meanwhile.
    #[error("the master has ended: start it again")]
    Ended,
    /// The loop's cycle does not end. Its watch has stopped what it can stop, and the run has failed.
    #[error("{}; {}", handle::STUCK, handle::STUCK_REMEDY)]
    Stuck,
}
fieldbeat_core::debug_as_display!(MasterError);

impl MasterError {
    fn unknown<'a>(what: &'static str, name: &str, known: impl Iterator<Item = &'a String>) -> MasterError {
        let known = known.map(String::as_str).collect::<Vec<_>>().join(", ");
        MasterError::Unknown { what, name: name.to_owned(), known }
    }
}

/// Ends the machine from another thread, or from a signal's handler thread.
#[derive(Clone, Debug)]
pub struct StopHandle(Control);

impl StopHandle {
    /// Requests the orderly end: all axes ramp down and are powered off. A second request shortens the waits.
    pub fn stop(&self) {
        self.0.stop();
    }
}

/// Stack size of the loop's thread; the part that it uses is touched before the first cycle.
const STACK_BYTES: usize = 1024 * 1024;

/// All that a [`Monitor`] can read.
impl Deref for Master {
    type Target = Monitor;

    fn deref(&self) -> &Monitor {
        &self.monitor
    }
}

impl Master {
    /// A machine from a plan built in code.
    pub fn from_plan(plan: Plan) -> Setup {
        Setup { plan, ..Setup::default() }
    }

    /// A reader of this machine for another thread.
    pub fn monitor(&self) -> Monitor {
        self.monitor.clone()
    }

    /// Takes an axis; only once, because an axis has one producer of commands.
    pub fn axis(&self, name: &str) -> Result<Axis, MasterError> {
        let mut axes = self.axes.lock().unwrap_or_else(PoisonError::into_inner);
        let observers = self.observers();
        let Some(index) = observers.iter().position(|(known, _)| known == name) else {
            return Err(self.no_axis(name));
        };
        axes[index].take().ok_or_else(|| MasterError::Taken(name.to_owned()))
    }

    /// The parameters of the drive of axis `name`, or of a device that is not a drive: independent of the owner of
    /// the axis, for any thread.
    pub fn parameter(&self, name: &str) -> Result<Parameters, MasterError> {
        match self.acyclics.iter().find(|acyclic| acyclic.axis() == name) {
            Some(acyclic) => Ok(acyclic.parameters()),
            None => Err(self.no_axis(name)),
        }
    }

    /// Acyclic access to all drives, in the order of the plan, followed by the devices that have it.
    pub fn acyclics(&self) -> &[Acyclic] {
        &self.acyclics
    }

    /// Takes the process data of a device that is not a drive, such as a digital input; only once, because it has
    /// one owner. `T` is the type that its protocol names.
    pub fn device<T: 'static>(&self, name: &str) -> Result<T, MasterError> {
        self.devices.lock().unwrap_or_else(PoisonError::into_inner).take(name)
    }

    fn no_axis(&self, name: &str) -> MasterError {
        MasterError::unknown("axis", name, self.observers().iter().map(|(name, _)| name))
    }

    /// Takes the axes of a `[[group]]` of the plan, together.
    pub fn group(&self, name: &str) -> Result<Group, MasterError> {
        let groups = &self.plan().groups;
        let Some(group) = groups.iter().find(|group| group.name == name) else {
            return Err(MasterError::unknown("group", name, groups.iter().map(|group| &group.name)));
        };
        let mut axes = self.axes.lock().unwrap_or_else(PoisonError::into_inner);
        let index = |name: &String| self.observers().iter().position(|(known, _)| known == name);
        let places: Vec<usize> = group.axes.iter().filter_map(index).collect();
        // All or none of them.
        if let Some(place) = places.iter().find(|place| axes[**place].is_none()) {
            return Err(MasterError::Taken(self.observers()[*place].0.clone()));
        }
        let members: Vec<Axis> = places.iter().filter_map(|place| axes[*place].take()).collect();
        drop(axes);
        Group::new(members).map_err(|refused| MasterError::NotAGroup(*refused.reason))
    }

    /// Waits until every axis is online. An axis that another master commands ends the wait.
    pub fn wait_online(&self, limit: Duration) -> Result<(), MasterError> {
        let begun = Instant::now();
        loop {
            let (mut missing, mut others) = (Vec::new(), Vec::new());
            for (index, (name, observer)) in self.observers().iter().enumerate() {
                let feedback = observer.feedback();
                missing.extend((feedback.link != Link::Online).then_some(index));
                others.extend((feedback.stopped == Some(StopCause::OtherMaster)).then_some(name.as_str()));
            }
            if self.watch.is_stuck() {
                return Err(MasterError::Stuck);
            }
            if !others.is_empty() {
                return Err(MasterError::OtherMaster(others.join(", ")));
            }
            if missing.is_empty() {
                return Ok(());
            }
            if !self.is_running() {
                return Err(MasterError::Ended);
            }
            if begun.elapsed() > limit {
                let missing: Vec<String> = missing.into_iter().map(|index| self.absent(index)).collect();
                return Err(MasterError::NotOnline { waited: limit, missing: missing.join(", ") });
            }
            self.alive();
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// A drive that is not online, with the reason.
    fn absent(&self, index: usize) -> String {
        let why = self.not_connected(index);
        format!("{} ({})", self.observers()[index].0, why.as_deref().unwrap_or(NOT_YET))
    }

    /// A sign of life for the heartbeat of the plan, if it has one. Accepted commands, rows and setpoints count as
    /// signs of life too, and so do the blocking calls while they wait.
    pub fn alive(&self) {
        self.pulse.beat();
    }

    /// Why nothing stops the drives that have no watchdog of their own, the LinMots, if this process is killed; `None`:
    /// a [guardian](guardian_main) does, or there are no such drives.
    pub fn no_guardian(&self) -> Option<NoGuardian> {
        let lack = || self.guardian.as_ref().filter(|_| self.is_running())?.lack();
        self.no_guardian.clone().or_else(lack)
    }

    /// Requests the orderly end, unless it was requested already: a second request would shorten the waits.
    /// [`finish`](Master::finish) waits for the end.
    pub fn stop(&self) {
        if !self.control.is_stopping() {
            self.control.stop();
        }
    }

    /// A handle that ends the machine from elsewhere.
    pub fn stop_handle(&self) -> StopHandle {
        StopHandle(self.control.clone())
    }

    /// Whether the loop still runs, and is not stuck.
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|thread| !thread.is_finished()) && !self.watch.is_stuck()
    }

    /// Waits for the end of the loop, or for all that its watch can do in its place. `None`: its thread is left behind.
    fn join(&mut self) -> Option<std::thread::Result<Numbers>> {
        let thread = self.thread.take()?;
        while !thread.is_finished() {
            if self.watch.is_over() {
                return None;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        let end = thread.join();
        // Nobody has stopped the drives of a bus that was left out.
        let died = end.as_ref().map_or(true, |end| end.panic.as_ref().is_some_and(LoopPanic::leaves_drives));
        self.watch.end(died);
        self.guardian = None;
        Some(end)
    }

    /// Stops all axes, powers them off, ends the loop and returns the measurements. If the loop panicked, they say so:
    /// [`Numbers::panic`], [`Measured::failures`].
    ///
    /// If its cycle does not end, this returns once the [watch](fieldbeat_core::cycle::WatchAfter) has done what can be
    /// done without it, and the measurements say that the run has failed.
    pub fn finish(mut self) -> Run {
        self.stop();
        let (end, failed) = match self.join() {
            Some(Ok(end)) => {
                let panic = end.panic.as_ref().map(ToString::to_string);
                let stuck = self.watch.stuck(panic.is_some());
                let failed: Vec<String> = panic.into_iter().chain(stuck).collect();
                (end, (!failed.is_empty()).then(|| failed.join("; ")))
            }
            Some(Err(_)) => {
                let failed =
                    "internal error: the loop's thread panicked outside of its cycle; please report it";
                (self.abandoned(), Some(failed.to_owned()))
            }
            None => (self.abandoned(), self.watch.stuck(false)),
        };
        let measured = self.telemetry.finish(&end.status, failed);
        self.monitor.ended(end, measured)
    }

    /// The newest numbers of a loop that has not come to its end: nobody knows how its drives were left.
    fn abandoned(&self) -> Numbers {
        let mut numbers = self.numbers();
        for drive in &mut numbers.drives {
            drive.at_end = AtEnd::abandoned(&drive.feedback);
        }
        numbers
    }
}

impl Drop for Master {
    fn drop(&mut self) {
        self.stop();
        self.join();
    }
}

/// How much later UTC is than the clock that shows `now`, ns.
pub(crate) fn utc_ns(now: Time) -> i64 {
    let utc = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, time::nanos);
    (utc as i64).wrapping_sub(now.0 as i64)
}

impl Setup {
    /// The plan.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Sets the application's code inside the cycle.
    pub fn with_task(mut self, task: impl FnMut(&Cycle, &mut Axes<'_>) + Send + 'static) -> Setup {
        self.task = Some(Box::new(task));
        self
    }

    /// Signals that would end the process end its running masters first: SIGINT, SIGTERM, SIGHUP, SIGQUIT, SIGALRM,
    /// SIGVTALRM, SIGPROF, SIGPIPE, SIGUSR2, SIGIO, SIGPWR, SIGSTKFLT, SIGXCPU and SIGABRT. All axes ramp down and are
    /// powered off, then the process ends by the same signal. A second one shortens the waits. The wait is bounded as
    /// that of `exit` is ([`Master`]).
    ///
    /// It holds from [`start`](Setup::start) on for as long as the process lives, for all masters in it. A signal that
    /// the program handles or ignores when it calls `start` is left to the program, and a handler that it sets later
    /// takes the place of this one. `abort` on the loop's own thread, by the in-loop task, is as SIGKILL.
    pub fn stop_on_signals(mut self) -> Setup {
        self.stop_on_signals = true;
        self
    }

    /// Takes the rights of the thread that calls [`start`](Setup::start) from it, once the loop runs: that thread, and
    /// the threads and programs that it starts from then on, have no capabilities (capabilities(7)) and gain none by a
    /// file that they execute (no_new_privs, prctl(2)). Nothing gives them back. For a `main` that opens what needs a
    /// right before the start.
    ///
    /// Two capabilities stay with whoever has them: CAP_DAC_OVERRIDE, with which root writes into directories of
    /// others, and CAP_IPC_LOCK while a limit of locked memory is set (RLIMIT_MEMLOCK), without which memory that is
    /// locked as a whole could not grow. The user, the groups, the limits and what is open stay as well: a limit of
    /// priorities (RLIMIT_RTPRIO) still lets a second master run in real time, a capability does not.
    ///
    /// Threads that the program has started before are never touched. The threads of the master give up theirs in any
    /// case, the loop and with it the in-loop task too.
    pub fn confine(mut self) -> Setup {
        self.confine = true;
        self
    }

    /// The program of the guardian, if this one does not call [`guardian_main`]: the program `fieldbeat` of the same
    /// version.
    pub fn with_guardian(mut self, program: impl Into<PathBuf>) -> Setup {
        self.guardian = Some(program.into());
        self
    }

    /// There is no guardian (`guardian_after = "off"`): if this process is killed, a LinMot moves on to its target and
    /// stays powered.
    pub fn without_guardian(mut self) -> Setup {
        self.plan.cycle.guardian_after = WatchAfter::Off;
        self
    }

    /// Opens the buses and starts the loop. When it returns, nothing but the first probes has been sent.
    pub fn start(mut self) -> Result<Master, StartError> {
        self.plan.check()?;
        let cycle = &self.plan.cycle;
        let realtime = RealtimePlan {
            realtime: cycle.realtime,
            memory: cycle.memory,
            priority: cycle.priority,
            core: cycle.core,
        };
        let throttling = rt::host::rt_throttling();
        if let Some(why) = throttling.and_then(|throttling| cycle::starvation(cycle, &throttling)) {
            return Err(StartError::Starving(why));
        }
        if cycle.cost == OnCost::Refuse
            && let Some(why) = Demand::of(&self.plan).cost(&Costs::of_this_host()).refusal()
        {
            return Err(StartError::Cost(format!("cycle: {why}")));
        }
        if cycle.realtime != Realtime::Off && cycle.memory == Memory::Process {
            rt::memory::prepare_heap();
        }
        let (core, mut regions) = (realtime.core_to_be(), Regions::default());
        let (log, link) = self.begin_log(&mut regions);
        let os = Os::off_core(core);
        // Without a log nothing is between the loop and the system.
        match log.is_on() {
            false => self.start_on(MonotonicClock, &os, realtime, regions),
            true => {
                let clock = LoggedClock::new(MonotonicClock, &log);
                self.start_on(clock, &LoggedCarriers::new(&os, &log, link), realtime, regions)
            }
        }
    }

    /// Opens the buses and starts the loop, on this clock and these carriers.
    fn start_on<C: Clock + 'static>(
        self,
        clock: C,
        carriers: &dyn Carriers,
        realtime: RealtimePlan,
        mut regions: Regions,
    ) -> Result<Master, StartError> {
        let Setup { plan, task, black_box, sink, stop_on_signals, confine, guardian, .. } = self;
        let has_task = task.is_some();
        if stop_on_signals {
            process::catch_signals(realtime.core_to_be()).map_err(StartError::Thread)?;
        }
        let timeouts = plan.axes().into_iter().map(|axis| axis.stop.timeout);
        let running = Running::begin(timeouts).map_err(StartError::Thread)?;
        let control = running.control();
        let steal_before_ms = rt::host::steal_ms(None);
        let kept = kept_for(&plan, black_box.as_deref(), true);
        let words = Held::handed(vec![Words::default()]);
        let assembly = assemble(&plan, clock, carriers, task, control.clone(), Wires::of(words), kept)?;
        let Assembly {
            mut engine,
            axes,
            devices,
            acyclics,
            gauges,
            records,
            unnamed,
            pulse,
            wires,
            last_resorts,
            regions: own,
        } = assembly;
        regions.extend(&own);
        // Before anything is locked, and before the loop begins.
        let guarded = (!last_resorts.is_empty()).then(|| {
            let after_ns = plan.cycle.guardian_after_ns().ok_or(NoGuardian::Off)?;
            Guardian::start(guardian, &wires, &last_resorts, records.descriptor(), after_ns, &realtime)
        });
        let (guardian, no_guardian) = match guarded.transpose() {
            Ok(guardian) => (guardian, None),
            Err(why) => (None, Some(why)),
        };
        let last_stops: Vec<LastStop> = last_resorts.into_iter().map(LastStop::new).collect();

        let (report, reported) = crossbeam_channel::bounded(1);
        let thread = std::thread::Builder::new()
            .name("fb-loop".into())
            .stack_size(STACK_BYTES)
            .spawn(move || {
                // Until the engine is gone.
                let running = running;
                running.is_on_this_thread();
                let entered = rt::thread::enter(&realtime, &regions);
                let go = entered.is_ok();
                let _ = report.send((entered, nix::unistd::gettid().as_raw()));
                if !go {
                    return engine.finish();
                }
                engine.begin();
                let before = Usage::of_thread();
                while engine.step() == fieldbeat_core::cycle::engine::Flow::Continue {}
                let used = Usage::of_thread().since(before);
                let mut end = engine.finish();
                end.page_faults = Some(used.page_faults());
                end.involuntary_switches = Some(used.involuntary_switches);
                end
            })
            .map_err(StartError::Thread)?;
        let (granted, tid) = match reported.recv() {
            Ok((Ok(granted), tid)) => (granted, tid),
            Ok((Err(error), _)) => {
                let _ = thread.join();
                return Err(error.into());
            }
            Err(_) => return Err(StartError::Ended),
        };
        let core = granted.core;
        let (after_ns, period_ns) = (plan.cycle.watch_after_ns(), plan.cycle.period_ns);
        let watching = match after_ns {
            Some(after_ns) => LoopWatch::start(wires, after_ns, period_ns, granted.clone(), last_stops),
            None => Ok(LoopWatch::none(wires, last_stops.iter().map(LastStop::shared).collect())),
        };
        // A kernel that does not report it leaves more cycles without a known cause.
        let watch = ThreadWatch::open(tid, core).ok();
        let measured = Measured::new(&plan.units(), &plan.cycle, has_task);
        let aside = move || rt::thread::file_thread(core);
        let taps = Taps::default();
        let feed = sink.map(|(path, mut sink)| {
            sink.begin(utc_ns(MonotonicClock::read()));
            Feed::new(path, sink, &taps)
        });
        let started = TelemetryThread::start(records, measured, taps, watch, black_box, aside)
            .and_then(|telemetry| telemetry.feed(feed, gauges.status.clone(), aside));
        let (telemetry, watching) = match started.and_then(|telemetry| Ok((telemetry, watching?))) {
            Ok(started) => started,
            Err(error) => {
                control.stop();
                let _ = thread.join();
                return Err(StartError::Thread(error));
            }
        };
        if let Some(error) = unnamed {
            let what = format!(
                "a kill of this program would lose its black box, whose records cannot be in /dev/shm: {error}; make \
                 that a directory in memory (tmpfs) with room for them"
            );
            telemetry.gathered().failed(&what, false);
        }
        let monitor = Monitor::new(plan, granted, gauges, Arc::clone(telemetry.gathered()), steal_before_ms);
        if confine {
            rt::confine::give_up_rights(rt::confine::Keep::Files);
        }
        Ok(Master {
            axes: Mutex::new(axes.into_iter().map(Some).collect()),
            devices: Mutex::new(devices),
            acyclics,
            monitor,
            pulse,
            control,
            telemetry,
            watch: watching,
            guardian,
            no_guardian,
            thread: Some(thread),
        })
    }
}

/// The records kept for a black box; `outlives`: also once this process has ended.
fn kept_for(plan: &Plan, black_box: Option<&dyn Keep>, outlives: bool) -> Kept {
    black_box.map_or(Kept::default(), |black_box| Kept {
        records: plan.black_box_records(),
        about: outlives.then(|| black_box.about()),
    })
}
