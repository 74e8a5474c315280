//! Looks at a machine from any thread, while it runs and after: for a display, a control socket, metrics. Reading never
//! makes the loop wait.

use std::sync::Arc;

use super::tap::Tap;
use super::{Gathered, Measured, Run};
use fieldbeat_core::axis::Observer;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::cycle::status::{DeviceEnd, Gauges, Numbers, Status};
use fieldbeat_core::rt::{self, Granted};

/// A reader of a machine; see `Master::monitor`. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Monitor(Arc<Watched>);

#[derive(Debug)]
struct Watched {
    plan: Arc<Plan>,
    granted: Granted,
    observers: Vec<(String, Observer)>,
    gauges: Gauges,
    gathered: Arc<Gathered>,
    steal_before_ms: Option<u64>,
}

impl Monitor {
    /// A reader of a machine that has started.
    #[doc(hidden)]
    pub fn new(
        plan: Plan,
        granted: Granted,
        gauges: Gauges,
        gathered: Arc<Gathered>,
        steal_before_ms: Option<u64>,
    ) -> Monitor {
        let plan = Arc::new(plan);
        let observers =
            gauges.axes.iter().map(|axis| (axis.info.name.clone(), axis.observer.clone())).collect();
        Monitor(Arc::new(Watched { plan, granted, observers, gauges, gathered, steal_before_ms }))
    }

    /// The plan it runs.
    pub fn plan(&self) -> &Plan {
        &self.0.plan
    }

    /// The run that has come to this end.
    #[doc(hidden)]
    pub fn ended(&self, end: Numbers, measured: Measured) -> Run {
        let (plan, granted) = (Arc::clone(&self.0.plan), self.granted().clone());
        Run::new(plan, granted, end, measured, self.steal_ms())
    }

    /// The grants of the operating system.
    pub fn granted(&self) -> &Granted {
        &self.0.granted
    }

    /// Readers of all axes' newest feedback, in the order of the plan.
    pub fn observers(&self) -> &[(String, Observer)] {
        &self.0.observers
    }

    /// The numbers of the loop, newest.
    pub fn status(&self) -> Status {
        self.0.gauges.status.read()
    }

    /// The loop and all drives in numbers. Those of a drive are at most 64 cycles or 100 ms old.
    pub fn numbers(&self) -> Numbers {
        self.0.gauges.numbers()
    }

    /// The devices that are no drives, in the order of the plan, and why each is not in operation.
    pub fn devices(&self) -> Vec<DeviceEnd> {
        self.0.gauges.devices()
    }

    /// Why drive `index` is not online, and what to do; `None`: it is, or nothing is known yet.
    pub fn not_connected(&self, index: usize) -> Option<String> {
        self.0.gauges.not_connected(index)
    }

    /// The remarks on drives and devices although they are in operation, since the configuration does not say
    /// it: a line each, with its name.
    pub fn remarks(&self) -> Vec<String> {
        self.0.gauges.remarks()
    }

    /// Whether drive `index` is reached by a connection.
    pub fn has_connection(&self, index: usize) -> bool {
        self.0.gauges.axes.get(index).is_some_and(|axis| axis.info.connection.is_some())
    }

    /// Looks at what the telemetry measured so far. The telemetry waits meanwhile, the loop does not. It waits for the
    /// telemetry, which may not be scheduled for seconds on a busy host: a thread that gives signs of life takes
    /// [`try_measured`](Self::try_measured).
    pub fn measured<R>(&self, look: impl FnOnce(&Measured) -> R) -> R {
        look(&self.0.gathered.read())
    }

    /// The same without a wait; `None`: the telemetry is at work on it, look again later.
    pub fn try_measured<R>(&self, look: impl FnOnce(&Measured) -> R) -> Option<R> {
        self.0.gathered.try_read().map(|measured| look(&measured))
    }

    /// One more reader of the loop's records, from now on, with room for so many batches.
    #[doc(hidden)]
    pub fn tap(&self, room: usize) -> Tap {
        self.0.gathered.taps().add(room)
    }

    /// Time that the hypervisor took from all cores since the start, ms.
    pub fn steal_ms(&self) -> Option<u64> {
        Some(rt::host::steal_ms(None)?.saturating_sub(self.0.steal_before_ms?))
    }

    /// Notes that a part of the program failed that it starts by itself, such as a server of its own; `fails_run`: data
    /// was lost. It stands in the summary from then on.
    pub fn failed(&self, what: &str, fails_run: bool) {
        self.0.gathered.failed(what, fails_run);
    }

    /// Writes the black box to a file, if there is one; see `Setup::with_black_box`. So does a recording of what is
    /// newest.
    pub fn write_black_box(&self) {
        self.0.gathered.write_black_box();
    }
}
