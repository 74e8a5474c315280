//! A bus or a simulated drive around another one, for tests that get between it and its wire: everything else goes
//! through.

/// Methods that do the same of what is reached from `this`, each by its signature.
#[macro_export]
macro_rules! forward {
    ($this:ident => $to:expr;) => {};
    ($this:ident => $to:expr;
        fn $name:ident(&mut $me:ident $(, $given:ident: $kind:ty)*) $(-> $back:ty)?; $($rest:tt)*) => {
        fn $name(&mut $me $(, $given: $kind)*) $(-> $back)? {
            let $this = $me;
            $to.$name($($given),*)
        }
        $crate::forward! { $this => $to; $($rest)* }
    };
    ($this:ident => $to:expr;
        fn $name:ident(&$me:ident $(, $given:ident: $kind:ty)*) $(-> $back:ty)?; $($rest:tt)*) => {
        fn $name(&$me $(, $given: $kind)*) $(-> $back)? {
            let $this = $me;
            $to.$name($($given),*)
        }
        $crate::forward! { $this => $to; $($rest)* }
    };
}

/// All of `BusPlan` but `open`, by the plan in this field; and but `turn_faults`: tests let more be due than a wire can
/// carry.
#[macro_export]
macro_rules! forward_bus_plan {
    ($field:tt) => {
        $crate::forward! { this => this.$field;
            fn name(&self) -> &str;
            fn axes(&self) -> Vec<&fieldbeat::axis::AxisPlan>;
            fn faults(&self, period_ns: u64) -> Vec<(usize, fieldbeat::axis::PlanFault)>;
            fn facts(&self, grid: fieldbeat_core::bus::Grid) -> fieldbeat_core::bus::BusFacts;
            fn describe(&self, grid: fieldbeat_core::bus::Grid) -> Vec<String>;
            fn native_layout(&self, index: usize) -> fieldbeat_core::bus::native::NativeLayout;
            fn reaching(&self, index: usize) -> Option<Box<dyn fieldbeat::bus::BusPlan>>;
        }
    };
}

/// All of `SimDrive` but `receive` and `restart`, by the drive in this field, or what is reached like one.
#[macro_export]
macro_rules! forward_sim_drive {
    ($($drive:tt)+) => {
        $crate::forward! { this => this.$($drive)+;
            fn address(&self) -> std::net::SocketAddrV4;
            fn faults(&self) -> fieldbeat::sim::FaultPlan;
            fn carrier(&self) -> fieldbeat::sim::Carrier;
            fn connect(&mut self, now: fieldbeat::Time, from: std::net::SocketAddrV4) -> bool;
            fn hangs_up(&mut self, from: std::net::SocketAddrV4) -> bool;
            fn disconnected(&mut self, now: fieldbeat::Time, from: std::net::SocketAddrV4);
            fn mislabel(&self, reply: &mut [u8]);
            fn open_sto(&mut self, until: fieldbeat::Time);
        }
    };
}

/// All of `SimSegment` but its names, `slaves`, `pass`, `advance` and `restart`, by the segment reached from `this`.
#[macro_export]
macro_rules! forward_sim_line {
    ($this:ident => $line:expr) => {
        $crate::forward! { $this => $line;
            fn ethertype(&self) -> u16;
            fn faults(&self) -> fieldbeat::sim::FaultPlan;
            fn delay_ns(&self) -> u64;
            fn mislabel(&self, frame: &mut [u8]);
            fn cut(&mut self, place: Option<usize>);
            fn deafen(&mut self, place: usize, deaf: bool);
            fn open_sto(&mut self, place: usize, until: fieldbeat::Time);
        }
    };
}
