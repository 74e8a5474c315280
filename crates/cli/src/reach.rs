//! The way to one drive of a configuration: through the master that runs, or by one of its own that reads and moves
//! nothing. Never next to a master that runs: a drive has one owner.

use std::path::Path;
use std::sync::Arc;
use std::thread::sleep;
use std::time::{Duration, Instant};

use fieldbeat_control::{AskError, Remote};
use fieldbeat_core::axis::Acyclic;
use fieldbeat_core::axis::acyclic::{Access, Call, CallError, Carrier, Notation};
use fieldbeat_core::bus::diagnosis::NOT_YET;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::net::Os;
use fieldbeat_master::{Master, StartError};
use fieldbeat_tools::Drive;

use super::interrupt::{Interrupt, LOOK_EVERY};
use super::masters::{Wanted, others};
use super::{Stop, load};

/// A drive that is there answers sooner, and the bring-up of a bus comes to its next step sooner.
const PATIENCE: Duration = Duration::from_secs(5);

/// All of a bring-up. It takes thousands of cycles on an EtherCAT segment, and more of them where the host disturbs
/// them.
const BRING_UP: Duration = Duration::from_secs(30);

/// A drive that answers without an exchange does so within this time.
const PROBED: Duration = Duration::from_secs(1);

/// The way to a drive.
pub struct Reach {
    drive: String,
    notation: Arc<dyn Notation>,
    way: Way,
}

enum Way {
    /// A master runs.
    Running(Remote),
    /// None does; this one ends when it is dropped.
    Alone { acyclic: Acyclic, _master: Box<Master> },
}

impl Reach {
    /// The way to `drive`. What is wrong with the question itself says `check`: nothing was sent then.
    pub fn open(
        drive: &Drive,
        check: impl FnOnce(&dyn Notation) -> Result<(), Stop>,
        interrupt: &Interrupt,
    ) -> Result<Reach, Stop> {
        let Drive { config, drive, pid } = drive;
        let (plan, notation) = find(config, drive)?;
        check(&*notation)?;
        let way = match running(Wanted { config: Some(config), pid: *pid }, drive)? {
            Some(remote) => Way::Running(remote),
            None => alone(&plan, drive, interrupt)?,
        };
        Ok(Reach { drive: drive.to_owned(), notation, way })
    }

    /// No master ran: what the drive does is not this program's doing.
    pub fn is_alone(&self) -> bool {
        matches!(self.way, Way::Alone { .. })
    }

    /// The name.
    pub fn drive(&self) -> &str {
        &self.drive
    }

    /// How it writes addresses.
    pub fn notation(&self) -> &dyn Notation {
        &*self.notation
    }

    /// The parameters.
    pub fn access(&self) -> Access<'_> {
        Access { drive: &self.drive, notation: &*self.notation, carrier: self.carrier() }
    }

    /// The way itself.
    pub fn carrier(&self) -> &dyn Carrier {
        match &self.way {
            Way::Running(remote) => remote,
            Way::Alone { acyclic, .. } => acyclic,
        }
    }
}

/// The plan of `config`, which has a drive of this name, and how that writes addresses.
pub fn find(config: &Path, drive: &str) -> Result<(Plan, Arc<dyn Notation>), Stop> {
    let plan = load(config)?;
    let Some(bus) = plan.find(drive).map(|(bus, _)| bus).or_else(|| plan.find_device(drive)) else {
        let facts = plan.facts();
        let devices = facts.iter().flat_map(|bus| &bus.devices);
        let known: Vec<&str> =
            plan.axes().into_iter().map(|axis| &axis.name).chain(devices).map(String::as_str).collect();
        let (config, known) = (config.display(), known.join(", "));
        return Err(Stop::usage(format!("{config} has no drive {drive}; it has {known}")));
    };
    let notation = bus.facts(plan.cycle.grid()).notation;
    Ok((plan, notation))
}

/// The drive of the master that is meant, if that runs.
pub fn running(wanted: Wanted<'_>, drive: &str) -> Result<Option<Remote>, Stop> {
    let Some(master) = wanted.find()? else {
        // Who names a process means that one, and no master of its own.
        return if wanted.pid.is_none() { Ok(None) } else { Err(Stop::failed(wanted.missing())) };
    };
    match Remote::open(&master.path, drive) {
        Ok(remote) => Ok(Some(remote)),
        Err(AskError::Nobody(_) | AskError::Dead(_)) => Ok(None),
        Err(error) => Err(Stop::failed(error)),
    }
}

/// The drive is online, or answers `probe`, whatever it answers.
fn is_there(acyclic: &Acyclic, probe: Option<Call>) -> Result<bool, Stop> {
    let Some(call) = probe else { return Ok(acyclic.condition().map_err(Stop::failed)?.online) };
    match acyclic.run(&[call], PROBED).failed {
        None | Some(CallError::Refused(_)) => Ok(true),
        Some(CallError::NotOnline | CallError::TimedOut) => Ok(false),
        Some(error) => Err(Stop::failed(error)),
    }
}

fn alone(plan: &Plan, drive: &str, interrupt: &Interrupt) -> Result<Way, Stop> {
    if plan.find_device(drive).is_some() {
        // Its outputs would fall with a master of its own.
        return Err(Stop::failed(format!(
            "{drive} is not a drive: only a running master can access it; start one with `fieldbeat run`"
        )));
    }
    let Some(plan) = plan.reaching(drive) else {
        return Err(Stop::failed(format!(
            "drive {drive} cannot be reached alone; start its master with `fieldbeat run`"
        )));
    };
    let refused = |error: StartError| {
        // It may be what stands in the way.
        let others = others();
        Stop::usage(if others.is_empty() { error.to_string() } else { format!("{error}; {others}") })
    };
    for bus in &plan.buses {
        bus.require_idle(&Os::default()).map_err(|error| refused(error.into()))?;
    }
    let probe = plan.facts().first().and_then(|bus| bus.probe);
    // It commands nothing that a guardian could stop.
    let master = Master::from_plan(plan).without_guardian().confine().start().map_err(refused)?;
    let Some(acyclic) = master.acyclics().iter().find(|acyclic| acyclic.axis() == drive).cloned() else {
        return Err(Stop::failed(format!("drive {drive} has no acyclic access")));
    };
    let mut waiting = BringUp::begun();
    while !is_there(&acyclic, probe)? {
        if interrupt.is_set() {
            return Err(Stop::failed("interrupted; nothing was written"));
        }
        if let Some(why) = waiting.fails(master.not_connected(0)) {
            return Err(Stop::failed(format!("drive {drive} cannot be reached: {why}")));
        }
        sleep(LOOK_EVERY);
    }
    Ok(Way::Alone { acyclic, _master: Box::new(master) })
}

/// A drive that is waited for.
pub struct BringUp {
    begun: Instant,
    /// When a step was seen for the first time, last.
    since: Instant,
    steps: Vec<Option<String>>,
}

impl BringUp {
    /// From now on.
    pub fn begun() -> BringUp {
        let begun = Instant::now();
        BringUp { begun, since: begun, steps: Vec::new() }
    }

    /// The drive is not there yet, for this reason. Returns the reason once it is waited for no longer.
    pub fn fails(&mut self, why: Option<String>) -> Option<String> {
        // A step that was seen before is one of a bring-up that fails again and again.
        if self.begun.elapsed() < BRING_UP && !self.steps.contains(&why) {
            self.steps.push(why.clone());
            self.since = Instant::now();
        }
        // Without a reason so far, its first bring-up may take longer.
        let is_over = self.since.elapsed() > PATIENCE && (why.is_some() || self.begun.elapsed() > BRING_UP);
        is_over.then(|| why.unwrap_or_else(|| NOT_YET.to_owned()))
    }
}
