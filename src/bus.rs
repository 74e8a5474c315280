//! The buses of a plan: a module for each protocol, with the plan of its buses, its native process data, its services.

#[doc(inline)]
pub use fieldbeat_core::bus::{BusFacts, BusPlan, DriveFacts, OpenError, ReplyWithin};

#[cfg(feature = "linudp")]
pub mod linudp {
    //! LinMot drives by LinUDP V2: UDP, one reply to each request.
    //!
    //! What follows is the reference of docs/ for its configuration.
    #![doc = include_str!("../docs/src/configuration-linudp.md")]

    pub mod curve {
        //! Time curves and encoder cams: what a drive stores of them, and its meaning.

        #[doc(inline)]
        pub use fieldbeat_linudp::curve::{Curve, CurveError, CurveKind, Dimension};
    }

    pub mod motion {
        //! Motion commands by name and in units, for native process data and command tables.
        //!
        //! # Example
        //!
        //! ```
        //! use fieldbeat::bus::linudp::motion::{Acceleration, MotionCommand, Position, Velocity};
        //!
        //! let ramp = Acceleration::from_mm_per_s2(1_000.0)?;
        //! let velocity = Velocity::from_mm_per_s(200.0)?;
        //! let command = MotionCommand::vai_go_to(Position::from_mm(120.5)?, velocity, ramp, ramp);
        //! assert_eq!(command.header(1), 0x0101);
        //! assert_eq!(command.parameters[..4], 1_205_000_i32.to_le_bytes());
        //! # Ok::<(), fieldbeat::axis::RangeError>(())
        //! ```

        #[doc(inline)]
        pub use fieldbeat_linudp::motion::{
            Acceleration, AmplitudeScale, Bits, ControllerSet, Counts, Current, CurrentLimit, CurveId,
            CurveTime, EntryId, Force, Jerk, Long, MotionCommand, Number, Offset, Position, Raw,
            ScaledAcceleration, ScaledPosition, ScaledVelocity, Short, ShortCurrent, SignedAcceleration,
            SignedVelocity, TimeScale, Upid, Velocity, WaitTime,
        };
    }

    #[doc(inline)]
    pub use fieldbeat_linudp::service;

    pub mod table {
        //! The command table of a drive: motion commands that it runs by itself, one after the other.

        #[doc(inline)]
        pub use fieldbeat_linudp::table::{DeadEnd, Entry, EntryError, Table, dead_ends};
    }

    #[doc(inline)]
    pub use fieldbeat_linudp::{
        COUNTS_PER_MM, ControlWord, ErrorCode, LinUdpDrive, LinUdpPlan, MainState, MonitorPlan, MotionBlock,
        Native, NativeInputs, NativeOutput, ReplyTag, Serial, StateVar, StatusWord, StreamCommand, WarnWord,
    };
}

#[cfg(feature = "modbus")]
pub mod modbus {
    //! Nidec Unidrives by Modbus TCP: one request outstanding on a connection.
    //!
    //! What follows is the reference of docs/ for its configuration.
    #![doc = include_str!("../docs/src/configuration-modbus.md")]

    #[doc(inline)]
    pub use fieldbeat_modbus::{
        Addressing, Block, ControlWord, Functions, Map, Mapped, Mapping, ModbusPlan, Native, NativeInputs,
        NativeOutput, Parameter, ParseError, Role, StatusWord, Trip, UnidriveDrive, Via, Watchdog, Width,
    };
}

#[cfg(feature = "ethercat")]
pub mod ethercat {
    //! Kollmorgen drives by EtherCAT CoE: one frame for all.
    //!
    //! What follows is the reference of docs/ for its configuration.
    #![doc = include_str!("../docs/src/configuration-ethercat.md")]

    #[doc(inline)]
    pub use fieldbeat_ethercat::{
        Area, Device, Entry, EthercatPlan, Expected, Family, Identity, KollmorgenDrive, Layout, Mapping,
        Native, NativeInputs, NativeOutput, Object, Owner, Scaling, Setpoint, SlavePlan, Start,
        TerminalError, TerminalInputs, Terminals, Type, Watchdog,
    };
}

#[cfg(feature = "ethernet-ip")]
pub mod ethernet_ip {
    //! MOONS' drives by EtherNet/IP: packets of their own clock.
    //!
    //! What follows is the reference of docs/ for its configuration.
    #![doc = include_str!("../docs/src/configuration-ethernet-ip.md")]

    #[doc(inline)]
    pub use fieldbeat_ethernet_ip::command;
    #[doc(inline)]
    pub use fieldbeat_ethernet_ip::status;
    #[doc(inline)]
    pub use fieldbeat_ethernet_ip::{
        Access, Condition, Delivery, EnableInput, EthernetIpPlan, Expected, Explicit, Homing, HomingMethod,
        Inputs, IoCode, Layout, Letters, MoonsDrive, Native, NativeInputs, NativeOutput, NativeProfile,
        NoIoCode, Originator, Outputs, Version, Watchdog,
    };
}

#[cfg(feature = "profibus")]
pub mod profibus {
    //! Lenze drives by PROFIBUS DP: half duplex, one drive after the other.
    //!
    //! What follows is the reference of docs/ for its configuration.
    #![doc = include_str!("../docs/src/configuration-profibus.md")]

    #[doc(inline)]
    pub use fieldbeat_profibus::{
        Bits, DriveProfile, LenzeDrive, Native, NativeInputs, NativeOutput, Numbers, ParameterPath,
        ProfibusPlan, RATES, Rs485, Scale, ShownWord, StatusBit, Watchdog,
    };
}
