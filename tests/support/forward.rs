//! A bus or a simulated drive around another one, for tests that get between it and its wire: everything else goes
//! through.

/// All of `BusPlan` but `open`, `simulate` and `simulate_line`, by the plan in this field.
#[macro_export]
macro_rules! forward_bus_plan {
    ($field:tt) => {
        fn name(&self) -> &str {
            self.$field.name()
        }

        fn protocol(&self) -> &'static str {
            self.$field.protocol()
        }

        fn axes(&self) -> Vec<&fieldbeat::axis::AxisPlan> {
            self.$field.axes()
        }

        fn faults(&self, period_ns: u64) -> Vec<(usize, fieldbeat::axis::PlanFault)> {
            self.$field.faults(period_ns)
        }

        fn reply_within_ns(&self, index: usize) -> Option<u64> {
            self.$field.reply_within_ns(index)
        }

        fn turn_within_ns(&self, index: usize) -> Option<u64> {
            self.$field.turn_within_ns(index)
        }

        fn fresh_within_ns(&self, index: usize) -> Option<u64> {
            self.$field.fresh_within_ns(index)
        }

        fn drive_watchdog_ns(&self, index: usize) -> Option<u64> {
            self.$field.drive_watchdog_ns(index)
        }

        fn describe(&self, period_ns: u64) -> Vec<String> {
            self.$field.describe(period_ns)
        }

        fn monitored(&self, index: usize) -> [Option<fieldbeat::axis::MonitorChannel>; 4] {
            self.$field.monitored(index)
        }

        fn reaching(&self, index: usize) -> Option<Box<dyn fieldbeat::bus::BusPlan>> {
            self.$field.reaching(index)
        }

        fn notation(&self) -> std::sync::Arc<dyn fieldbeat::axis::acyclic::Notation> {
            self.$field.notation()
        }

        fn own_counters(&self) -> &'static [fieldbeat::bus::OwnCounter] {
            self.$field.own_counters()
        }

        fn capabilities(&self, index: usize) -> fieldbeat::bus::desired::Capabilities {
            self.$field.capabilities(index)
        }

        fn fault_names(&self) -> fieldbeat::axis::FaultNames {
            self.$field.fault_names()
        }

        fn has_clock(&self) -> bool {
            self.$field.has_clock()
        }

        fn devices(&self) -> Vec<&str> {
            self.$field.devices()
        }
    };
}

/// All of `SimDrive` but `receive` and `restart`, by the drive in this field.
#[macro_export]
macro_rules! forward_sim_drive {
    ($field:tt) => {
        fn address(&self) -> std::net::SocketAddrV4 {
            self.$field.address()
        }

        fn faults(&self) -> fieldbeat::sim::FaultPlan {
            self.$field.faults()
        }

        fn carrier(&self) -> fieldbeat::sim::Carrier {
            self.$field.carrier()
        }

        fn connect(&mut self, now: fieldbeat::Time, from: std::net::SocketAddrV4) -> bool {
            self.$field.connect(now, from)
        }

        fn hangs_up(&mut self, from: std::net::SocketAddrV4) -> bool {
            self.$field.hangs_up(from)
        }

        fn disconnected(&mut self, now: fieldbeat::Time, from: std::net::SocketAddrV4) {
            self.$field.disconnected(now, from);
        }

        fn mislabel(&self, reply: &mut [u8]) {
            self.$field.mislabel(reply);
        }

        fn inhibit(&mut self, until: fieldbeat::Time) {
            self.$field.inhibit(until);
        }
    };
}
