//! What every command that runs a master offers meanwhile: metrics, the scope, and the black box.

use std::io;
use std::path::{Path, PathBuf};

use clap::Args;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::errors::no_descriptor;
use fieldbeat_master::{Master, Setup};
use fieldbeat_record::blackbox::default_directory;
use fieldbeat_record::file::Place;
use fieldbeat_record::metrics;
use fieldbeat_record::metrics::{Endpoint, MetricsError, Server};

use super::scope;
use super::{Stop, complain};

/// Arguments of every command that runs a master: what it offers meanwhile.
#[derive(Debug, Args)]
pub struct Serving {
    /// Meanwhile answer at http://ADDR/metrics for Prometheus; a port alone is for this computer only, NAME:PORT
    /// for clients that use another name of this computer.
    #[arg(long, value_name = "ADDR", value_parser = metrics::address)]
    metrics: Option<metrics::Address>,
    #[command(flatten)]
    scope: scope::Page,
    /// Where the black box writes its files; without it the state directory of the service, or of the user.
    #[arg(long, value_name = "DIR")]
    black_box: Option<PathBuf>,
    /// The black box also has what passed the wires: `export --pcapng` makes a capture for Wireshark of its files.
    #[arg(long)]
    black_box_wire: bool,
    #[command(flatten)]
    guarding: Guarding,
}

/// Arguments of every command that moves drives by a master of its own.
#[derive(Clone, Copy, Debug, Args)]
pub struct Guarding {
    /// Without a guardian, the process that stops the LinMots if this one is killed or hangs: they then move on to
    /// their targets and stay powered. Other drives stop by their own watchdogs.
    #[arg(long, global = true)]
    no_guardian: bool,
}

impl Guarding {
    /// As an option says.
    pub fn new(no_guardian: bool) -> Guarding {
        Guarding { no_guardian }
    }

    /// The machine, with or without it.
    pub fn setup(self, setup: Setup) -> Setup {
        if self.no_guardian { setup.without_guardian() } else { setup }
    }
}

/// All of it can be had.
#[derive(Debug)]
pub struct Served {
    endpoint: Option<Endpoint>,
    scope: scope::Served,
    black_box: Option<Place>,
    black_box_wire: bool,
    guarding: Guarding,
}

/// Answer for as long as they are held.
#[derive(Debug)]
pub struct Servers {
    _metrics: Option<Server>,
    _scope: scope::Held,
    /// The directory stays if there is a file in it.
    _black_box: Option<Place>,
}

impl Serving {
    /// Finds out whether it can be had, before anything is sent.
    pub fn prepare(self) -> Result<Served, Stop> {
        let bind = |metrics::Address { socket, name }| {
            let endpoint = Endpoint::bind(socket)?;
            Ok(name.into_iter().fold(endpoint, Endpoint::named))
        };
        let endpoint =
            self.metrics.map(bind).transpose().map_err(|error: MetricsError| Stop::usage(error))?;
        Ok(Served {
            endpoint,
            scope: self.scope.prepare()?,
            black_box: self.black_box.map(black_box).transpose()?,
            black_box_wire: self.black_box_wire,
            guarding: self.guarding,
        })
    }
}

impl Served {
    /// The machine of `plan`, with its black box.
    pub fn setup(&self, plan: Plan) -> Setup {
        let directory = match &self.black_box {
            Some(place) => place.directory().to_owned(),
            None => usual_directory(&plan),
        };
        let setup = self.guarding.setup(Master::from_plan(plan));
        match self.black_box_wire {
            true => setup.with_black_box_and_wire(directory),
            false => setup.with_black_box(directory),
        }
    }

    /// Answers with the numbers of `master` for as long as what it returns is held.
    pub fn serve(self, master: &Master) -> Result<Servers, Stop> {
        let serve = |endpoint: Endpoint| {
            let address = endpoint.address();
            complain(&format!("metrics at http://{address}/metrics"));
            if !address.ip().is_loopback() {
                complain(
                    "anyone on that network can read the metrics; --metrics with a port alone keeps them \
                     here",
                );
            }
            endpoint.serve(master.monitor()).map_err(Stop::failed)
        };
        Ok(Servers {
            _metrics: self.endpoint.map(serve).transpose()?,
            _scope: self.scope.serve(&master.monitor())?,
            _black_box: self.black_box,
        })
    }
}

/// A directory that was named for it.
fn black_box(directory: PathBuf) -> Result<Place, Stop> {
    Place::prepare(&directory).map_err(|why| {
        let remedy = no_descriptor(&why).unwrap_or("name a directory that this user may write to");
        Stop::usage(format!("{}; {remedy}", cannot_write(&directory, &why)))
    })
}

/// The machine of `plan`, with a black box in the usual directory.
pub fn with_usual_black_box(plan: Plan) -> Setup {
    let directory = usual_directory(&plan);
    Master::from_plan(plan).with_black_box(directory)
}

/// The usual directory of the black box of `plan`. Nobody named that: it is no reason not to start, but it is known at
/// once.
fn usual_directory(plan: &Plan) -> PathBuf {
    let directory = default_directory();
    if plan.black_box_records() > 0
        && let Err(why) = Place::prepare(&directory)
    {
        let why = cannot_write(&directory, &why);
        complain(&format!("{why}; what leads to a failure is lost without it"));
    }
    directory
}

fn cannot_write(directory: &Path, why: &io::Error) -> String {
    format!("black box {}: cannot write there: {why}", directory.display())
}
