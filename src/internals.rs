//! What the benches, the tests and the program of this repository need beyond the public face. It changes without
//! notice: no program of anyone else builds on it.
//!
//! Each module here is that of the library with the same path.

pub mod axis {
    pub use crate::axis::*;
    pub mod acyclic {
        pub use crate::axis::acyclic::*;
    }
    pub mod cell {
        pub use crate::axis::cell::*;
    }
    pub mod command {
        pub use crate::axis::command::*;
    }
    pub mod doorbell {
        pub use crate::axis::doorbell::*;
    }
    pub mod event {
        pub use crate::axis::event::*;
    }
    pub mod feedback {
        pub use crate::axis::feedback::*;
    }
    pub mod handle {
        pub use crate::axis::handle::*;
    }
    pub mod limits {
        pub use crate::axis::limits::*;
    }
    pub mod newest {
        pub use crate::axis::newest::*;
    }
    pub mod observer {
        pub use crate::axis::observer::*;
    }
    pub mod plan {
        pub use crate::axis::plan::*;
    }
    pub mod units {
        pub use crate::axis::units::*;
    }
}

pub mod bus {
    pub use crate::bus::contract::*;
    pub use crate::bus::counters::*;
    pub use crate::bus::drives::*;
    pub use crate::bus::native::*;
    pub use crate::bus::*;
    pub mod desired {
        pub use crate::bus::desired::*;
    }
    #[cfg(feature = "cli")]
    pub mod outline {
        pub use crate::bus::outline::*;
    }
    #[cfg(feature = "cli")]
    pub mod tools {
        pub use crate::bus::tools::*;
    }
    pub mod variant {
        pub use crate::bus::variant::*;
    }
    pub mod ethercat {
        pub use crate::bus::ethercat::bus::*;
        pub use crate::bus::ethercat::image::*;
        pub use crate::bus::ethercat::*;
        pub mod cia402 {
            pub use crate::bus::ethercat::cia402::*;
        }
        pub mod counters {
            pub use crate::bus::ethercat::counters::*;
        }
        pub mod faults {
            pub use crate::bus::ethercat::faults::*;
        }
        pub mod object {
            pub use crate::bus::ethercat::object::*;
        }
        pub mod scan {
            pub use crate::bus::ethercat::scan::*;
        }
        pub mod service {
            pub use crate::bus::ethercat::service::*;
        }
        pub mod sii {
            pub use crate::bus::ethercat::sii::*;
        }
        pub mod slot {
            pub use crate::bus::ethercat::slot::*;
        }
        pub mod wire {
            pub use crate::bus::ethercat::wire::*;
        }
    }
    pub mod ethernet_ip {
        pub use crate::bus::ethernet_ip::*;
        pub mod exchange {
            pub use crate::bus::ethernet_ip::exchange::*;
        }
        pub mod station {
            pub use crate::bus::ethernet_ip::station::*;
        }
        pub mod wire {
            pub use crate::bus::ethernet_ip::wire::*;
        }
    }
    pub mod linudp {
        pub use crate::bus::linudp::*;
        pub mod bus {
            pub use crate::bus::linudp::bus::*;
        }
        pub mod native {
            pub use crate::bus::linudp::native::*;
        }
        pub mod notation {
            pub use crate::bus::linudp::notation::*;
        }
        pub mod plan {
            pub use crate::bus::linudp::plan::*;
        }
        pub mod rtc {
            pub use crate::bus::linudp::rtc::*;
        }
        pub mod station {
            pub use crate::bus::linudp::station::*;
        }
        pub mod upid {
            pub use crate::bus::linudp::upid::*;
        }
        pub mod wire {
            pub use crate::bus::linudp::wire::*;
        }
    }
    pub mod modbus {
        pub use crate::bus::modbus::bus::*;
        pub use crate::bus::modbus::handshake::*;
        pub use crate::bus::modbus::station::*;
        pub use crate::bus::modbus::*;
        pub mod counters {
            pub use crate::bus::modbus::counters::*;
        }
        pub mod mapping {
            pub use crate::bus::modbus::mapping::*;
        }
        pub mod native {
            pub use crate::bus::modbus::native::*;
        }
        pub mod notation {
            pub use crate::bus::modbus::notation::*;
        }
        pub mod parameter {
            pub use crate::bus::modbus::parameter::*;
        }
        pub mod trips {
            pub use crate::bus::modbus::trips::*;
        }
        pub mod wire {
            pub use crate::bus::modbus::wire::*;
        }
        pub mod words {
            pub use crate::bus::modbus::words::*;
        }
    }
    pub mod profibus {
        pub use crate::bus::profibus::*;
        pub mod counters {
            pub use crate::bus::profibus::counters::*;
        }
        pub mod line {
            pub use crate::bus::profibus::line::*;
        }
        pub mod station {
            pub use crate::bus::profibus::station::*;
        }
        pub mod wire {
            pub use crate::bus::profibus::wire::*;
        }
    }
}

#[cfg(feature = "config")]
pub mod config {
    pub use crate::config::demo::*;
    pub use crate::config::describe::*;
    pub use crate::config::json::*;
    pub use crate::config::load_machine;
    pub use crate::config::schema::*;
    pub mod soak {
        pub use crate::config::soak::*;
    }
}

#[cfg(feature = "control")]
pub mod control {
    pub use crate::control::*;
    pub mod place {
        pub use crate::control::place::*;
    }
}

pub mod cycle {
    pub use crate::cycle::*;
}

#[cfg(feature = "doctor")]
pub mod doctor {
    pub use crate::doctor::*;
    pub mod port {
        pub use crate::doctor::port::*;
    }
    pub mod stats {
        pub use crate::doctor::stats::*;
    }
}

pub mod drive {
    pub use crate::drive::*;
}

pub mod logged {
    pub use crate::logged::*;
}

pub mod master {
    pub use crate::master::*;
}

pub mod inputs {
    pub use crate::inputs::*;
}

pub mod net {
    pub use crate::net::*;
}

pub mod replay {
    pub use crate::replay::machine::*;
}

pub mod rt {
    pub use crate::rt::*;
}

#[cfg(feature = "scope")]
pub mod scope {
    pub use crate::scope::*;
}

pub mod sim {
    pub use crate::sim::*;
    pub mod ethercat {
        pub use crate::sim::ethercat::drive::*;
        pub use crate::sim::ethercat::hardware::*;
        pub use crate::sim::ethercat::*;
        pub mod coupler {
            pub use crate::sim::ethercat::coupler::*;
        }
        pub mod esc {
            pub use crate::sim::ethercat::esc::*;
        }
        pub mod segment {
            pub use crate::sim::ethercat::segment::*;
        }
        pub mod sii {
            pub use crate::sim::ethercat::sii::*;
        }
    }
    pub mod fault {
        pub use crate::sim::fault::*;
    }
    pub mod physics {
        pub use crate::sim::physics::*;
    }
    pub mod serial {
        pub use crate::sim::serial::*;
    }
    pub mod world {
        pub use crate::sim::world::*;
    }
}

#[cfg(feature = "config")]
pub mod soak {
    pub use crate::soak::*;
}

pub mod telemetry {
    pub use crate::telemetry::thread::*;
    pub use crate::telemetry::*;
    #[cfg(feature = "report")]
    pub mod archive {
        pub use crate::telemetry::archive::*;
    }
    #[cfg(feature = "report")]
    pub mod compare {
        pub use crate::telemetry::compare::*;
    }
    #[cfg(feature = "black-box")]
    pub mod blackbox {
        pub use crate::telemetry::blackbox::*;
        pub mod events {
            pub use crate::telemetry::blackbox::events::*;
        }
        pub mod file {
            pub use crate::telemetry::blackbox::file::*;
        }
        pub mod list {
            pub use crate::telemetry::blackbox::list::*;
        }
    }
    pub mod causes {
        pub use crate::telemetry::causes::*;
    }
    #[cfg(any(feature = "black-box", feature = "record", feature = "report"))]
    pub mod file {
        pub use crate::telemetry::file::*;
    }
    #[cfg(feature = "report")]
    pub mod hgrm {
        pub use crate::telemetry::hgrm::*;
    }
    pub mod histograms {
        pub use crate::telemetry::histograms::*;
    }
    #[cfg(feature = "report")]
    pub mod plots {
        pub use crate::telemetry::plots::*;
    }
    #[cfg(feature = "record")]
    pub mod recording {
        pub use crate::telemetry::recording::*;
        #[cfg(feature = "black-box")]
        pub mod blackbox {
            pub use crate::telemetry::recording::blackbox::*;
        }
        pub mod csv {
            pub use crate::telemetry::recording::csv::*;
        }
        pub mod perfetto {
            pub use crate::telemetry::recording::perfetto::*;
        }
        pub mod reading {
            pub use crate::telemetry::recording::reading::*;
        }
    }
    #[cfg(feature = "summary")]
    pub mod summary {
        pub use crate::telemetry::summary::numbers::*;
    }
    pub mod tap {
        pub use crate::telemetry::tap::*;
    }
    pub mod timeline {
        pub use crate::telemetry::timeline::*;
    }
}
