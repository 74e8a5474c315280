//! `fieldbeat sim`: the drives of a configuration, simulated, behind real sockets.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use fieldbeat_config::Configuration;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::rt::confine::{Keep, give_up_rights};
use fieldbeat_core::rt::thread::{default_core, spare_core};
use fieldbeat_core::rt::{Realtime, host};
use fieldbeat_record::summary::plural;
use fieldbeat_sim::server::{ServerOptions, SimServer};

use super::interrupt::{Interrupt, LOOK_EVERY};
use super::{Stop, configuration, print, span};

/// Arguments of `sim`.
#[derive(Debug, Args)]
pub struct Sim {
    /// The configuration.
    config: PathBuf,
    /// End after this time; without it, at Ctrl-C.
    #[arg(long = "for", value_name = "TIME", value_parser = span)]
    duration: Option<Duration>,
    /// The core for the simulation; without it, the kernel chooses.
    #[arg(long)]
    core: Option<usize>,
}

impl Sim {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let Configuration { plan, simulation, .. } = configuration(&self.config)?;
        let cores = host::online_cores().unwrap_or_default();
        if let Some(core) = self.core.filter(|core| !cores.is_empty() && !cores.contains(core)) {
            return Err(Stop::usage(format!("--core {core}: there is no such core; there are {cores:?}")));
        }
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        let drives: usize = plan.buses.iter().map(|bus| bus.axes().len()).sum();
        let devices: usize = plan.facts().iter().map(|bus| bus.devices.len()).sum();
        let listening = match drives {
            0 => plural(devices as u64, "simulated device"),
            drives => plural(drives as u64, "simulated drive"),
        };
        let mut server = SimServer::start(simulation.build(), serving(&plan, self.core))
            .map_err(|error| Stop::usage(format!("cannot simulate the drives: {error}")))?;
        give_up_rights(Keep::Nothing);
        print(format_args!("{listening} listening; Ctrl-C ends the simulation"))?;
        let begun = Instant::now();
        while !interrupt.is_set() && self.duration.is_none_or(|duration| begun.elapsed() < duration) {
            std::thread::sleep(LOOK_EVERY);
        }
        server.end();
        // A frame of an EtherCAT segment is one request to all of its slaves.
        let drives = server.stats().into_iter().map(|drive| (drive.received, drive.answered));
        let buses = server.buses().into_iter().map(|bus| (bus.received, bus.answered));
        let (received, answered) = drives
            .chain(buses)
            .fold((0, 0), |(received, answered), one| (received + one.0, answered + one.1));
        print(format_args!("{} received, {answered} answered", plural(received, "request")))
    }
}

/// How the simulated drives of `plan` are served: below the loop, but above whatever else this computer does, and off
/// the loop's core: a real drive shares no processor with a compiler. Without the right it is an ordinary thread.
pub fn serving(plan: &Plan, core: Option<usize>) -> ServerOptions {
    let below = plan.cycle.priority.saturating_sub(10).max(1);
    ServerOptions {
        core: core.or_else(|| spare_core(plan.cycle.core.or_else(default_core))),
        priority: (plan.cycle.realtime != Realtime::Off).then_some(below),
    }
}
