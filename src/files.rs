//! What needs files: configurations, recordings, reports, and what they are made of.

pub mod config {
    //! A plan from TOML: see [`Master::from_file`](crate::Master::from_file).
    //!
    //! What follows is the reference of docs/.
    #![doc = include_str!("../docs/src/configuration.md")]

    #[doc(inline)]
    pub use fieldbeat_config::{ConfigError, ConfigErrors, Configuration, load, parse};

    pub mod linmot {
        //! What a LinMot stores besides its parameters, as files: time curves, and its command table.

        #[doc(inline)]
        pub use fieldbeat_linudp::config::{curve, table};
    }
}

pub mod doctor {
    //! How fit a host is for real time, and how to fix what is not.

    #[doc(inline)]
    pub use fieldbeat_doctor::{
        Area, Effort, Finding, Glance, Measured, Progress, Report, Subject, Untried, Verdict, examine,
        glance, measure,
    };
}

pub mod replay {
    //! A recorded run, repeated bit by bit.
    //!
    //! The loop logs all that it takes from outside; its inputs say where, each of them. A recording keeps the log
    //! ([`Recorder::with_wire`](crate::telemetry::recording::Recorder::with_wire)), and a machine in virtual time
    //! repeats the run from it ([`Replay`]): the same loop makes the same telegrams, or the first difference is found.
    //! What happened in the field becomes a test of a few lines.

    #[doc(inline)]
    pub use fieldbeat_replay::{Difference, LogEnd, Recorded, Replay, ReplayError, Telegrams, Verdict};
}

pub mod telemetry {
    //! What the telemetry writes.

    #[doc(no_inline)]
    pub use self::summary::Summary;

    pub mod blackbox {
        //! The last cycles, written to a file when something fails.

        #[doc(inline)]
        pub use fieldbeat_record::blackbox::{BlackBox, Written, default_directory};
    }

    pub mod metrics {
        //! The numbers of a running machine for Prometheus.

        #[doc(inline)]
        pub use fieldbeat_record::metrics::{Address, Endpoint, MetricsError, NotAnAddress, Server, address};
    }

    pub mod recording {
        //! Every cycle in a file for Foxglove, PlotJuggler and Rerun.

        #[doc(inline)]
        pub use fieldbeat_record::recording::RecordError;
        /// # Example
        ///
        /// ```
        /// use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
        /// use fieldbeat::sim::WorldOptions;
        /// use fieldbeat::telemetry::recording::Recorder;
        /// use fieldbeat::{Master, Plan};
        ///
        /// # let directory = tempfile::tempdir()?;
        /// # let path = directory.path().join("run.mcap");
        /// let drive = LinUdpDrive::new("x", [192, 168, 1, 10].into());
        /// let bus = LinUdpPlan::new([192, 168, 1, 1].into(), vec![drive]);
        /// let plan = Plan { buses: vec![Box::new(bus)], ..Plan::default() };
        ///
        /// // The same with `start` in place of `simulate`.
        /// let setup = Master::from_plan(plan).with_recorder(Recorder::create(&path)?);
        /// let mut machine = setup.simulate(WorldOptions::default())?;
        /// machine.run(1_000);
        /// let recorded = machine.finish_recording();
        /// assert_eq!((recorded[0].lost, &recorded[0].error), (0, &None));
        /// # Ok::<(), Box<dyn std::error::Error>>(())
        /// ```
        #[doc(inline)]
        pub use fieldbeat_record::recording::Recorder;
    }

    pub mod report {
        //! A directory with a page of plots, the summary and `.hgrm` histograms.

        #[doc(inline)]
        pub use fieldbeat_record::report::{ArchiveError, Report, ReportError};
    }

    pub mod summary {
        //! A run in numbers: the object that `--json` prints, and the same as text.

        #[doc(inline)]
        pub use fieldbeat_record::summary::{
            Bus, Carried, ClockNumbers, CycleNumbers, Drive, Found, Host, Late, LateCycle, ProtocolCounters,
            RealtimeNumbers, ReferenceNumbers, Share, Stages, Summary, Variable,
        };
    }
}

/// The programs of README.md and docs/ compile, or the doctests fail.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
#[doc = include_str!("../docs/src/library.md")]
#[doc = include_str!("../docs/src/recording.md")]
#[doc = include_str!("../docs/src/replay.md")]
struct Programs;
