//! A bus or a simulated drive around another one, for tests that get between it and its wire: everything else goes
//! through.

/// All of `BusPlan` but `open`, by the plan in this field; and but `turn_faults`: tests let more be due than a wire can
/// carry.
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

        fn turn_within_ns(&self, index: usize, grid: fieldbeat::bus::Grid) -> Option<u64> {
            self.$field.turn_within_ns(index, grid)
        }

        fn request_within_ns(&self, index: usize, grid: fieldbeat::bus::Grid) -> Option<u64> {
            self.$field.request_within_ns(index, grid)
        }

        fn before_stop(&self, index: usize) -> u32 {
            self.$field.before_stop(index)
        }

        fn fresh_within_ns(&self, index: usize, period_ns: u64) -> Option<u64> {
            self.$field.fresh_within_ns(index, period_ns)
        }

        fn drive_watchdog_ns(&self, index: usize) -> Option<u64> {
            self.$field.drive_watchdog_ns(index)
        }

        fn addresses(&self) -> Vec<std::net::SocketAddrV4> {
            self.$field.addresses()
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

        fn notation(&self) -> std::sync::Arc<dyn fieldbeat_core::axis::acyclic::Notation> {
            self.$field.notation()
        }

        fn native_layout(&self, index: usize) -> fieldbeat_core::bus::native::NativeLayout {
            self.$field.native_layout(index)
        }

        fn wire_us(&self) -> Option<usize> {
            self.$field.wire_us()
        }

        fn describe_turns(&self, grid: fieldbeat::bus::Grid) -> Option<String> {
            self.$field.describe_turns(grid)
        }

        fn own_counters(&self) -> &'static [fieldbeat_core::bus::OwnCounter] {
            self.$field.own_counters()
        }

        fn capabilities(&self, index: usize, period_ns: u64) -> fieldbeat_core::bus::desired::Capabilities {
            self.$field.capabilities(index, period_ns)
        }

        fn fault_names(&self) -> fieldbeat_core::axis::feedback::FaultNames {
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

/// All of `SimDrive` but `receive` and `restart`, by the drive in this field, or what is reached like one.
#[macro_export]
macro_rules! forward_sim_drive {
    ($($drive:tt)+) => {
        fn address(&self) -> std::net::SocketAddrV4 {
            self.$($drive)+.address()
        }

        fn faults(&self) -> fieldbeat::sim::FaultPlan {
            self.$($drive)+.faults()
        }

        fn carrier(&self) -> fieldbeat::sim::Carrier {
            self.$($drive)+.carrier()
        }

        fn connect(&mut self, now: fieldbeat::Time, from: std::net::SocketAddrV4) -> bool {
            self.$($drive)+.connect(now, from)
        }

        fn hangs_up(&mut self, from: std::net::SocketAddrV4) -> bool {
            self.$($drive)+.hangs_up(from)
        }

        fn disconnected(&mut self, now: fieldbeat::Time, from: std::net::SocketAddrV4) {
            self.$($drive)+.disconnected(now, from);
        }

        fn mislabel(&self, reply: &mut [u8]) {
            self.$($drive)+.mislabel(reply);
        }

        fn inhibit(&mut self, until: fieldbeat::Time) {
            self.$($drive)+.inhibit(until);
        }
    };
}

/// All of `SimSegment` but its names, `slaves`, `pass`, `advance` and `restart`, by the segment reached from `this`.
#[macro_export]
macro_rules! forward_sim_line {
    ($this:ident => $line:expr) => {
        fn ethertype(&self) -> u16 {
            let $this = self;
            fieldbeat::sim::SimSegment::ethertype(&$line)
        }

        fn faults(&self) -> fieldbeat::sim::FaultPlan {
            let $this = self;
            fieldbeat::sim::SimSegment::faults(&$line)
        }

        fn delay_ns(&self) -> u64 {
            let $this = self;
            fieldbeat::sim::SimSegment::delay_ns(&$line)
        }

        fn mislabel(&self, frame: &mut [u8]) {
            let $this = self;
            fieldbeat::sim::SimSegment::mislabel(&$line, frame);
        }

        fn cut(&mut self, place: Option<usize>) {
            let $this = self;
            fieldbeat::sim::SimSegment::cut(&mut $line, place);
        }

        fn deafen(&mut self, place: usize, deaf: bool) {
            let $this = self;
            fieldbeat::sim::SimSegment::deafen(&mut $line, place, deaf);
        }

        fn inhibit(&mut self, place: usize, until: fieldbeat::Time) {
            let $this = self;
            fieldbeat::sim::SimSegment::inhibit(&mut $line, place, until);
        }
    };
}
