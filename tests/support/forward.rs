//! A bus around another one, for tests that get between it and its carriers or its drives: everything else goes through.

/// All of `BusPlan` but `open` and `simulate`, by the plan in this field.
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
    };
}
