//! Simulated drives: their protocols, physics and faults, in virtual time and behind real sockets.

#[doc(inline)]
pub use fieldbeat_sim::{
    Carrier, FaultPlan, SerialWire, SimBus, SimDrive, SimPlan, SimSegment, SimSerial, Simulated, Truth,
    World, WorldOptions,
};

pub mod server {
    //! Simulated drives behind real sockets.

    #[doc(inline)]
    pub use fieldbeat_sim::server::{BusStats, ConnectionStats, DriveStats, ServerOptions, SimServer};
}

/// The machine in virtual time, at the root.
pub(crate) mod machine {
    /// # Example
    ///
    /// ```
    /// use fieldbeat::axis::{Link, Outcome, Command};
    /// use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
    /// use fieldbeat::{CyclePlan, Plan};
    /// use fieldbeat::sim::WorldOptions;
    /// use fieldbeat::Master;
    ///
    /// // A plan built in code: one drive on one bus, 1 kHz.
    /// let drive = LinUdpDrive::new("x", [192, 168, 1, 10].into());
    /// let bus = LinUdpPlan::new([192, 168, 1, 1].into(), vec![drive]);
    /// let plan = Plan { source: None, cycle: CyclePlan::default(), buses: vec![Box::new(bus)], groups: Vec::new() };
    ///
    /// let mut machine = Master::from_plan(plan).simulate(WorldOptions::default())?;
    /// assert!(machine.run_until(100, |machine| machine.feedback(0).link == Link::Online));
    /// assert_eq!(machine.execute(0, Command::Enable, 1_000)?, Some(Outcome::Done));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// A program that waits runs on a thread of its own:
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use fieldbeat::bus::linudp::{LinUdpDrive, LinUdpPlan};
    /// use fieldbeat::{CyclePlan, Plan};
    /// use fieldbeat::sim::WorldOptions;
    /// use fieldbeat::Master;
    ///
    /// // It may get the master of `start`, too.
    /// fn program(master: &Master) -> Result<f64, Box<dyn std::error::Error>> {
    ///     master.wait_online(Duration::from_secs(20))?;
    ///     let mut x = master.axis("x")?;
    ///     x.enable()?;
    ///     x.home()?;
    ///     x.move_to(20.0, x.profile())?;
    ///     Ok(x.feedback().status.position)
    /// }
    ///
    /// let drive = LinUdpDrive::new("x", [192, 168, 1, 10].into());
    /// let bus = LinUdpPlan::new([192, 168, 1, 1].into(), vec![drive]);
    /// let plan = Plan { source: None, cycle: CyclePlan::default(), buses: vec![Box::new(bus)], groups: Vec::new() };
    ///
    /// let master = Master::from_plan(plan).simulate(WorldOptions::default())?.into_master(20.0)?;
    /// assert!((program(&master)? - 20.0).abs() < 0.1);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[doc(inline)]
    pub use fieldbeat_master::simulation::Simulation;
    #[doc(inline)]
    pub use fieldbeat_master::simulation::{DriveEvent, SimulateError};
}
