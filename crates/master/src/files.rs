//! Machines from files, and what files they leave behind.

use std::path::{Path, PathBuf};

use crossbeam_channel::Receiver;

use fieldbeat_config::{ConfigErrors, Configuration, Loaded, load_machine};
use fieldbeat_record::Summary;
use fieldbeat_record::blackbox::BlackBox;
use fieldbeat_record::recording::Recorder;
use fieldbeat_telemetry::log::{LogBegin, MachineOf};
use fieldbeat_telemetry::thread::Keep;

use crate::simulation::{Simulation, granted};
use crate::{Master, Setup};

impl Master {
    /// Reads and checks a configuration.
    pub fn from_file(path: impl AsRef<Path>) -> Result<Setup, ConfigErrors> {
        load_machine(path).map(Setup::from)
    }
}

impl From<Loaded> for Setup {
    /// The machine of a configuration that was read.
    fn from(Loaded { configuration, file, text }: Loaded) -> Setup {
        let Configuration { plan, simulation, .. } = configuration;
        let machine = MachineOf::Configuration { file, text };
        Master::from_plan(plan).with_simulation(simulation).of_machine(machine)
    }
}

impl Setup {
    /// Where the black box writes its files. Without it there is none.
    pub fn with_black_box(mut self, directory: impl Into<PathBuf>) -> Setup {
        let black_box = BlackBox::new(&self.plan, &directory.into());
        self.black_box = black_box.map(|black_box| Box::new(black_box) as Box<dyn Keep>);
        self
    }

    /// The same, and its files have what has passed the wires meanwhile: `fieldbeat export --pcapng` makes a capture of
    /// one. The loop logs all that it takes from outside and sends for it. A [recorder](Self::with_recorder) with the
    /// wire has the log in its place.
    pub fn with_black_box_and_wire(mut self, directory: impl Into<PathBuf>) -> Setup {
        let directory = directory.into();
        if self.log_sink.is_some() {
            return self.with_black_box(directory);
        }
        let Some(black_box) = BlackBox::new(&self.plan, &directory) else { return self };
        let (setup, log) = self.logged();
        self = setup;
        self.black_box = Some(Box::new(black_box.with_wire(log)));
        self
    }

    /// It has a log, which comes from the other end once it is built.
    fn logged(self) -> (Setup, Receiver<LogBegin>) {
        let (sender, log) = crossbeam_channel::bounded(1);
        let setup = self.with_log(move |begin| {
            let _ = sender.send(begin);
        });
        (setup, log)
    }

    /// Records the machine, from its first cycle on.
    pub fn with_recorder(mut self, recorder: Recorder) -> Setup {
        let path = recorder.path().to_owned();
        self.plan.cycle.record_native = recorder.native().to_vec();
        let mut log = None;
        if recorder.has_wire() {
            // The machine is built, and has its log, before the recording begins.
            let (setup, of_machine) = self.logged();
            (self, log) = (setup, Some(of_machine));
        }
        self.sink = Some((path, recorder.sink(&self.plan, log)));
        self
    }
}

impl From<&Simulation> for Summary {
    /// That of a simulated machine so far.
    fn from(machine: &Simulation) -> Summary {
        Summary::of(machine.plan(), &machine.numbers(), machine.measured(), &granted(), None)
    }
}
