//! `fieldbeat demo`: master and simulated drives in one process, and a show of what the axes can do.

mod light;
mod show;

use std::io::ErrorKind;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::time::{Duration, Instant};

use clap::Args;
use fieldbeat_config::Configuration;
use fieldbeat_config::demo::{DEMO_PLACES, DEMO_STREAMS_UP_TO_NS, demo_plan};
use fieldbeat_core::bus::facts::of_drives;
use fieldbeat_core::cycle::{CyclePlan, Plan};
use fieldbeat_core::time::{MS, Ns, nanos};
use fieldbeat_doctor::{Glance, glance};
use fieldbeat_record::compare::percent;
use fieldbeat_record::summary::Carried;
use fieldbeat_sim::server::SimServer;
use fieldbeat_telemetry::log::MachineOf;

use self::light::Light;
use self::show::{Error, SWING_S, Show, was_stopped};
use crate::handler::Handler;
use crate::interrupt::Interrupt;
use crate::output::{Output, both};
use crate::run::{not_whole, start};
use crate::sim::serving;
use crate::{Stop, complain, print, span};

/// Without `--for`: the drives are waited for so long, on a very busy computer, and the show takes so long.
const PATIENCE: Duration = Duration::from_secs(60);
const SHOW: Duration = Duration::from_secs(10);

/// Periods to choose from. In the last one LinMots take no streams.
const PERIODS_NS: [u64; 5] = [MS, 2 * MS, 4 * MS, 8 * MS, 16 * MS];

/// The largest share of disturbed cycles with which a period is chosen. The end judges by smaller ones: at a longer
/// period the drives of a busy host come online too late for a show.
const MOST_DISTURBED: f64 = 0.2;

/// Arguments of `demo`.
#[derive(Debug, Args)]
pub struct Demo {
    /// Length of the whole demo, the wait for the drives included; without it, 10 s from then on.
    #[arg(long = "for", value_name = "TIME", value_parser = span)]
    duration: Option<Duration>,
    /// How many LinMot drives, next to two Unidrives, Kollmorgens, MOONS' and Lenzes each, and a coupler with
    /// terminals.
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=128))]
    drives: u16,
    /// The period of the cycle; without it, the shortest of 1, 2, 4, 8 and 16 ms that this host carries now.
    #[arg(long, value_name = "TIME", value_parser = span)]
    period: Option<Duration>,
    #[command(flatten)]
    output: Output,
}

impl Demo {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let begun = Instant::now();
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        let mut output = self.output.prepare()?;
        let period_ns = period_ns(self.period)?;
        let Served { plan, machine, server, claim: _claim } = serve(usize::from(self.drives), period_ns)?;
        // The bus whose clock leads takes few periods.
        if plan.cycle.reference.is_none() {
            let period = Ns(period_ns);
            complain(&format!(
                "without the Kollmorgens and the terminals: they take a --period of whole multiples of 250us \
                 below 3ms, of 1ms above, not {period}"
            ));
        }
        let master = start(output.setup(plan, machine), &interrupt)?;
        let output = output.serve(&master)?;

        let [streamers, movers, turners] = names(master.plan());
        let axes = streamers.iter().chain(&movers).chain(&turners).map(|name| master.axis(name));
        let axes = axes.collect::<Result<_, _>>().map_err(Stop::failed)?;
        let light = Light::of(&master, Duration::from_secs_f64(SWING_S)).map_err(Stop::failed)?;
        let handler = Handler::new(&master, &interrupt);
        let end = begun + self.duration.unwrap_or(PATIENCE);
        let (streamers, movers) = (streamers.len(), streamers.len() + movers.len());
        let mut show = Show { master, axes, streamers, movers, end, handler, light };
        let result = show.wait_online().and_then(|()| {
            if self.duration.is_none() {
                show.end = Instant::now() + SHOW;
            }
            show.play()
        });
        show.light.iter_mut().for_each(Light::end);
        show.handler.end(&show.master);
        let is_json = output.is_json();
        let (summary, printed) = output.finish(show.master);
        let lit = show.light.map_or(Ok(()), |light| finish(&light, is_json));
        server.stop();
        let judged = judge(&summary.carried, is_json);
        let verdict = match result {
            _ if summary.has_failed() => Err(not_whole(&summary)),
            Ok(()) | Err(Error::Over) if interrupt.is_set() || summary.is_whole() => Ok(()),
            Ok(()) | Err(Error::Over) => Err(not_whole(&summary)),
            Err(error) if interrupt.is_set() && was_stopped(&error) => Ok(()),
            Err(error) => Err(Stop::failed(error)),
        };
        both(both(both(printed, lit), judged), verdict)
    }
}

/// Prints what became of the light, below the summary; behind JSON on standard error.
fn finish(light: &Light, is_json: bool) -> Result<(), Stop> {
    if light.has_failed() {
        return Err(Stop::failed(light));
    }
    if is_json {
        complain(&light.to_string());
        return Ok(());
    }
    print(light)
}

/// Judges the period by the run, in the last line; behind JSON on standard error.
fn judge(carried: &Carried, is_json: bool) -> Result<(), Stop> {
    let period = Ns(carried.period_ns);
    let line = match (carried.carried, carried.would_be_ns) {
        (true, _) => format!("cycle of {period}: this host carried it"),
        (false, None) => format!("cycle of {period}: this host did not carry it"),
        (false, Some(longer)) => {
            format!("cycle of {period}: this host did not carry it; {} would have been", Ns(longer))
        }
    };
    let line = if carried.realtime { line } else { line + "; not real-time" };
    if is_json {
        complain(&line);
        return Ok(());
    }
    print(line)
}

/// The requested period, or the shortest that this host carries; one line says why.
fn period_ns(requested: Option<Duration>) -> Result<u64, Stop> {
    if let Some(period) = requested {
        // A period that cannot be is refused before anything is measured.
        demo_plan(1, nanos(period), 0).map_err(Stop::usage)?;
    }
    let seen = glance(&CyclePlan::default()).map_err(Stop::usage)?;
    let carried = seen.shortest(&PERIODS_NS, MOST_DISTURBED);
    let Some(period) = requested else {
        complain(&chosen(&seen, carried));
        return Ok(carried);
    };
    let period_ns = nanos(period);
    if period_ns < carried {
        complain(&format!(
            "--period {}: expect about {} of the cycles to be late, with drives that miss them; this host \
             {}, and carries {}",
            Ns(period_ns),
            percent(seen.disturbed(period_ns)),
            holds_up(&seen),
            Ns(carried),
        ));
    }
    Ok(period_ns)
}

/// The simulated drives, at the first addresses that no other demo has.
fn serve(drives: usize, period_ns: u64) -> Result<Served, Stop> {
    let mut in_use = None;
    for place in 0..DEMO_PLACES {
        let Configuration { plan, simulation, .. } =
            demo_plan(drives, period_ns, place).map_err(Stop::usage)?;
        let name = format!("fieldbeat-demo/{place}");
        let claim = SocketAddr::from_abstract_name(name).and_then(|name| UnixListener::bind_addr(&name));
        let served = claim.and_then(|claim| {
            let server = SimServer::start(simulation.build(), serving(&plan, None))?;
            Ok((claim, server))
        });
        match served {
            Ok((claim, server)) => {
                let machine = MachineOf::Demo { drives, period_ns, place };
                return Ok(Served { plan, machine, server, claim });
            }
            Err(error) if error.kind() == ErrorKind::AddrInUse => in_use = Some(error),
            Err(error) => return Err(Stop::usage(format!("cannot simulate the drives: {error}"))),
        }
    }
    let why = in_use.map_or(String::new(), |error| format!(": {error}"));
    Err(Stop::usage(format!("{DEMO_PLACES} demos run already, or others have their addresses{why}; end one")))
}

/// The drives of a demo, with addresses that are its own for as long as this lives.
struct Served {
    plan: Plan,
    machine: MachineOf,
    server: SimServer,
    /// An abstract address of the network namespace: it needs no rights, and the kernel takes it back on death.
    claim: UnixListener,
}

/// Why this period, and not a shorter one.
fn chosen(seen: &Glance, period_ns: u64) -> String {
    let Some(shorter) = PERIODS_NS.iter().rev().find(|shorter| **shorter < period_ns) else {
        return format!("cycle of {}: this host carries it, as far as half a second shows", Ns(period_ns));
    };
    let streams = if period_ns > DEMO_STREAMS_UP_TO_NS { "; LinMots take no streams so slowly" } else { "" };
    format!(
        "cycle of {}: at {} this host, which {}, would disturb {} of the cycles{streams}; `fieldbeat doctor` \
         says more",
        Ns(period_ns),
        Ns(*shorter),
        holds_up(seen),
        percent(seen.disturbed(*shorter)),
    )
}

fn holds_up(seen: &Glance) -> String {
    format!("holds threads up for as long as {:.1} ms", seen.longest_ns() as f64 / MS as f64)
}

/// The names of the axes that follow streams, of those that only make moves, and of those that take velocities only.
fn names(plan: &Plan) -> [Vec<String>; 3] {
    let mut names = [const { Vec::new() }; 3];
    for (axis, (_, drive)) in plan.axes().into_iter().zip(of_drives(&plan.facts())) {
        let lacks = drive.capabilities.lacks;
        let group = match (lacks.moves, lacks.rows) {
            (Some(_), _) => 2,
            // In a long period LinMots take none either.
            (None, Some(_)) if plan.cycle.period_ns <= DEMO_STREAMS_UP_TO_NS => 1,
            (None, _) => 0,
        };
        names[group].push(axis.name.clone());
    }
    names
}
