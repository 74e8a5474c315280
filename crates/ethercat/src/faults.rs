//! Faults of a Kollmorgen S300 ... S700: the number on its display, and the content of its emergency.
//!
//! Codes: CAN manual of the S300 and S700, "Emergency". Entries that are not in it are marked
//! [`assumed`](Fault::assumed).

use super::wire::mailbox::Emergency;

/// How a fault can be cleared: the first vendor byte of an emergency (CAN manual).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Clearing {
    /// By switching the drive off and on.
    ColdStart = 1,
    /// By bit 7 of the control word.
    Reset = 2,
    /// A mistake in the process data.
    Pdo = 3,
    /// Not at all.
    Never = 4,
    /// A warning: it clears by itself.
    Warning = 5,
}

impl Clearing {
    /// The clearing in an emergency; `None`: an unknown one, or the end of an error.
    pub const fn of(emergency: &Emergency) -> Option<Clearing> {
        match (emergency.code, emergency.vendor[0]) {
            (0, _) => None,
            (_, 1) => Some(Clearing::ColdStart),
            (_, 2) => Some(Clearing::Reset),
            (_, 3) => Some(Clearing::Pdo),
            (_, 4) => Some(Clearing::Never),
            (_, 5) => Some(Clearing::Warning),
            _ => None,
        }
    }
}

/// A fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Fault {
    /// The number: F28 is 28.
    pub number: u8,
    /// The error code of its emergency.
    pub code: u16,
    /// The bits that it sets in the error register, 1001h, besides bit 0 (assumed: CiA 301 by kind).
    pub register: u8,
    /// How it can be cleared: the category of the CAN manual.
    pub clearing: Clearing,
    /// The meaning.
    pub name: &'static str,
    /// The code is not from a document.
    pub assumed: bool,
}

/// Bits of the error register (CiA 301).
mod register {
    pub const GENERIC: u8 = 1 << 0;
    pub const CURRENT: u8 = 1 << 1;
    pub const VOLTAGE: u8 = 1 << 2;
    pub const TEMPERATURE: u8 = 1 << 3;
    pub const COMMUNICATION: u8 = 1 << 4;
    pub const PROFILE: u8 = 1 << 5;
}

impl Fault {
    /// F01: the heat sink is too hot.
    pub const HEAT_SINK: Fault = Fault::new(1, 0x4210, register::TEMPERATURE, "heat sink temperature").cold();
    /// F02: over-voltage of the DC bus.
    pub const OVERVOLTAGE: Fault = Fault::new(2, 0x3110, register::VOLTAGE, "over-voltage");
    /// F03: following error.
    pub const FOLLOWING: Fault = Fault::new(3, 0x8611, register::PROFILE, "following error").assume();
    /// F05: under-voltage of the DC bus.
    pub const UNDERVOLTAGE: Fault = Fault::new(5, 0x3120, register::VOLTAGE, "under-voltage");
    /// F06: the motor is too hot.
    pub const MOTOR_TEMPERATURE: Fault =
        Fault::new(6, 0x4310, register::TEMPERATURE, "motor temperature").cold();
    /// F12: a phase of the motor is missing.
    pub const MOTOR_PHASE: Fault = Fault::new(12, 0x2380, register::CURRENT, "motor phase").cold();
    /// F13: the ambient temperature of the drive is too high.
    pub const AMBIENT: Fault = Fault::new(13, 0x4110, register::TEMPERATURE, "ambient temperature");
    /// F16: the mains are missing.
    pub const MAINS: Fault = Fault::new(16, 0x3100, register::VOLTAGE, "mains");
    /// F19: a phase of the mains is missing.
    pub const MAINS_PHASE: Fault = Fault::new(19, 0x3130, register::VOLTAGE, "mains phase");
    /// F22: short circuit to earth.
    pub const EARTH: Fault = Fault::new(22, 0x2330, register::CURRENT, "earth short circuit");
    /// F28: not, or no longer, synchronous to the cycle of the bus.
    pub const SYNCHRONISATION: Fault =
        Fault::new(28, 0x8700, register::COMMUNICATION, "bus synchronisation").assume();

    /// All of them, by number.
    pub const ALL: [Fault; 11] = [
        Fault::HEAT_SINK,
        Fault::OVERVOLTAGE,
        Fault::FOLLOWING,
        Fault::UNDERVOLTAGE,
        Fault::MOTOR_TEMPERATURE,
        Fault::MOTOR_PHASE,
        Fault::AMBIENT,
        Fault::MAINS,
        Fault::MAINS_PHASE,
        Fault::EARTH,
        Fault::SYNCHRONISATION,
    ];

    const fn new(number: u8, code: u16, register: u8, name: &'static str) -> Fault {
        Fault { number, code, register, clearing: Clearing::Reset, name, assumed: false }
    }

    const fn cold(self) -> Fault {
        Fault { clearing: Clearing::ColdStart, ..self }
    }

    const fn assume(self) -> Fault {
        Fault { assumed: true, ..self }
    }

    /// The fault with this error code in its emergency.
    pub fn of_code(code: u16) -> Option<&'static Fault> {
        Self::ALL.iter().find(|fault| fault.code == code)
    }

    /// The error register, 1001h, while it is present.
    pub const fn error_register(&self) -> u8 {
        self.register | register::GENERIC
    }

    /// The emergency that the drive sends with it. The register is the one of the sheet's example: without bit 0.
    pub const fn emergency(&self) -> Emergency {
        Emergency { code: self.code, register: self.register, vendor: [self.clearing as u8, 0, 0, 0, 0] }
    }
}

/// The name of an error code, whether it is a fault's or another one of the CAN manual.
pub fn name(code: u16) -> Option<&'static str> {
    match code {
        0x0000 => Some("no error"),
        0x1000 => Some("general error"),
        0x1080 => Some("not ready for operation"),
        _ => Fault::of_code(code).map(|fault| fault.name),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_those_of_the_can_manual() {
        let documented = Fault::ALL.iter().filter(|fault| !fault.assumed);
        let codes: Vec<_> =
            documented.map(|fault| format!("F{:02} {:04X}", fault.number, fault.code)).collect();
        let manual =
            "F01 4210, F02 3110, F05 3120, F06 4310, F12 2380, F13 4110, F16 3100, F19 3130, F22 2330";
        assert_eq!(codes.join(", "), manual);
    }

    #[test]
    fn each_has_a_code_and_a_number_of_its_own() {
        for fault in Fault::ALL {
            assert_eq!(Fault::of_code(fault.code), Some(&fault));
            assert_eq!(Fault::ALL.iter().filter(|other| other.number == fault.number).count(), 1);
            assert_eq!(name(fault.code), Some(fault.name));
        }
        assert_eq!((name(0x1080), name(0x7777)), (Some("not ready for operation"), None));
    }

    #[test]
    fn an_emergency_says_how_its_fault_is_cleared() {
        for fault in Fault::ALL {
            assert_eq!(Clearing::of(&fault.emergency()), Some(fault.clearing));
        }
        let warning = Emergency { code: 0x1080, register: 0, vendor: [5, 0, 0, 0, 0] };
        assert_eq!(Clearing::of(&warning), Some(Clearing::Warning));
        assert_eq!(Clearing::of(&Emergency { vendor: [6, 0, 0, 0, 0], ..warning }), None);
        assert_eq!(Clearing::of(&Emergency::default()), None);
        let hot = Emergency { code: 0x4310, register: 8, vendor: [1, 0, 0, 0, 0] };
        assert_eq!(Fault::MOTOR_TEMPERATURE.emergency(), hot);
        assert_eq!(Fault::MOTOR_TEMPERATURE.error_register(), 9);
    }
}
