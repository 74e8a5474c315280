//! What parameters, registers and commands of these drives are called and measured in (Host Command Reference
//! 920-0002 W).
//!
//! Scaled are those whose unit the manual gives for EtherNet/IP: accelerations in 10 rpm/s, velocities in 0.25 rpm,
//! currents of GC and IC in 0.01 A, EG in half the steps of a revolution. Registers of the same quantities count as in
//! the process data (assumed).

use fieldbeat_core::axis::acyclic::{Counts, Quantity, Scale};

use crate::plan::{ACCELERATION_PER_REV, MOST_PER_REV, VELOCITY_PER_REV};

const VELOCITY: Quantity = counted(VELOCITY_PER_REV, "rev/s");
const ACCELERATION: Quantity = counted(ACCELERATION_PER_REV, "rev/s²");
const CURRENT: Quantity = counted(100.0, "A");
const VOLTAGE: Quantity = counted(10.0, "V");
const TEMPERATURE: Quantity = counted(10.0, "°C");
const STEPS: Quantity = counted(0.5, "steps/rev");

const fn counted(per_unit: f64, unit: &'static str) -> Quantity {
    Quantity { scale: Scale::Linear { per_unit, zero: 0.0 }, unit }
}

/// Parameters that have a sign.
pub(super) const SIGNED: [&str; 6] = ["GC", "IC", "IQ", "IT", "IV actual", "IV target"];

/// The range of accelerations and velocities: as many counts as the drive takes.
const MOST: i64 = MOST_PER_REV as i64;

/// The values of a parameter or command with this name.
pub(super) fn scaled(name: &str, counts: Counts) -> Counts {
    let (quantity, range) = match name {
        "AC" | "AM" | "DE" | "JA" | "JL" => (ACCELERATION, (1, MOST)),
        "VE" | "VC" => (VELOCITY, (1, MOST)),
        "JS" => (VELOCITY, (0, MOST)),
        "GC" => (CURRENT, (-2_000, 2_000)),
        "IC" => (CURRENT, counts.range),
        "EG" => (STEPS, counts.range),
        _ => return counts,
    };
    Counts { range, quantity: Some(quantity), ..counts }
}

/// The values of a register.
pub(super) fn scaled_register(register: u8, counts: Counts) -> Counts {
    let quantity = match register {
        b'A' | b'B' => ACCELERATION,
        b'V' | b'M' | b'J' | b'v' | b'w' => VELOCITY,
        b't' => TEMPERATURE,
        b'u' => VOLTAGE,
        _ => return counts,
    };
    Counts { quantity: Some(quantity), ..counts }
}

/// A name of the manual as it is written in an address.
pub(super) fn hyphened(name: &str) -> String {
    name.replace(' ', "-")
}

/// The name of a parameter or command.
#[rustfmt::skip]
pub(super) fn meaning(name: &str) -> Option<&'static str> {
    Some(match name {
        "AC" => "acceleration", "AD" => "deadband of the analog input", "AF" => "filter of the analog input",
        "AG" => "velocity gain of the analog input", "AI" => "use of the alarm reset input", "AL" => "alarms",
        "AM" => "largest acceleration: that of fast stops", "AN" => "torque gain of the analog input",
        "AO" => "use of the alarm output", "AP" => "position gain of the analog input",
        "AS" => "scaling of the analog input", "AT" => "threshold of the analog input",
        "AV" => "offset of the analog input", "AX" => "alarm reset", "AZ" => "zero of the analog input",
        "BD" => "delay until a move, for the brake", "BE" => "delay after a move, for the brake",
        "BO" => "use of the brake output", "BS" => "free places of the buffer", "CA" => "current while accelerating",
        "CC" => "current", "CD" => "delay of the idle current", "CI" => "idle current", "CJ" => "begin a jog",
        "CM" => "command mode", "CP" => "peak current", "DC" => "distance until the speed changes",
        "DE" => "deceleration", "DI" => "distance or position", "DL" => "use of the limit inputs",
        "EF" => "encoder function", "EG" => "steps of a revolution, half of them", "EI" => "filter of all inputs",
        "EN" => "electronic gear, numerator", "EP" => "encoder position", "EP high" => "encoder position, upper half",
        "EP low" => "encoder position, lower half", "ER" => "encoder resolution",
        "EU" => "electronic gear, denominator", "FC" => "move, with a change of speed",
        "FD" => "move to two sensors", "FE" => "follow the encoder", "FI" => "filter of an input",
        "FL" => "relative move", "FM" => "move to a sensor that is masked for a distance",
        "FO" => "move that sets an output", "FP" => "absolute move", "FS" => "move to a sensor",
        "FX" => "which inputs are filtered", "FY" => "move to a sensor, with a safety distance",
        "GC" => "current command", "GG" => "global gain", "HG" => "4th harmonic filter, gain",
        "HP" => "4th harmonic filter, phase", "HW" => "hand wheel", "IA" => "analog input",
        "IC" => "commanded current", "IO" => "outputs", "IQ" => "actual current",
        "IS" => "inputs of the extension board", "ISX" => "inputs of the main board", "IT" => "temperature",
        "IU" => "supply voltage", "IV actual" => "actual velocity", "IV target" => "target velocity",
        "IX" => "position error", "JA" => "acceleration of jogs", "JD" => "disable jogs", "JE" => "enable jogs",
        "JL" => "deceleration of jogs", "JM" => "jog mode", "JS" => "jog speed", "LM" => "software limit, CCW",
        "LP" => "software limit, CW", "MD" => "motor off", "ME" => "motor on", "MO" => "use of the motion output",
        "MV" => "model and revision", "PD" => "in position: counts", "PE" => "in position: time",
        "PF" => "position error that is a fault", "PK" => "lock of parameters", "PM" => "mode at power-up",
        "PR" => "protocol", "PT" => "pulse type", "QX" => "load and execute a segment", "RE" => "restart the drive",
        "RX" => "load a register", "SC" => "status", "SF" => "step filter", "SH" => "seek home",
        "SI" => "use of the enable input", "SM" => "stop the move: 68 with DE, 77 with AM", "SO" => "set an output",
        "SP" => "set the position", "TI" => "test an input", "TO" => "tach output", "TR" => "test a register",
        "TV" => "torque ripple", "VC" => "velocity after a change of speed", "VE" => "velocity",
        "VR" => "velocity ripple", "WD" => "wait for the time in a register",
        "firmware letter" => "letter of the firmware", "sub-model" => "sub-model", "is servo" => "it is a servo",
        "options" => "options",
        _ => return None,
    })
}
