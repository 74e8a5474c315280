//! Objects of a drive that are used by their number; the [`catalogue`](super::catalogue) has their types.
#![expect(missing_docs, reason = "the names are those of the manuals")]

use super::Object;

/// The assignment of the SyncManagers of outputs and of inputs.
pub const OUTPUT_PDO: u16 = 0x1C12;
pub const INPUT_PDO: u16 = 0x1C13;

pub const DEVICE_TYPE: Object = Object::new(0x1000, 0);
pub const ERROR_REGISTER: Object = Object::new(0x1001, 0);
pub const MANUFACTURER_STATUS: Object = Object::new(0x1002, 0);
pub const ERROR_COUNT: Object = Object::new(0x1003, 0);
pub const LAST_ERROR: Object = Object::new(0x1003, 1);
pub const DEVICE_NAME: Object = Object::new(0x1008, 0);
pub const OUTPUT_CYCLE: Object = Object::new(0x1C32, 2);
pub const INPUT_CYCLE: Object = Object::new(0x1C33, 2);
pub const POSITION_2: Object = Object::new(0x2050, 0);
pub const INCREMENTAL_SPEED: Object = Object::new(0x2070, 2);
pub const CYCLE_TIME: Object = Object::new(0x35D5, 1);
pub const ERROR_CODE: Object = Object::new(0x603F, 0);
pub const CONTROL_WORD: Object = Object::new(0x6040, 0);
pub const STATUS_WORD: Object = Object::new(0x6041, 0);
pub const MODE: Object = Object::new(0x6060, 0);
pub const MODE_DISPLAY: Object = Object::new(0x6061, 0);
pub const INCREMENTS: Object = Object::new(0x6063, 0);
pub const POSITION: Object = Object::new(0x6064, 0);
pub const FOLLOWING_WINDOW: Object = Object::new(0x6065, 0);
pub const VELOCITY_SETPOINT: Object = Object::new(0x606B, 0);
pub const VELOCITY: Object = Object::new(0x606C, 0);
pub const TARGET_TORQUE: Object = Object::new(0x6071, 0);
pub const MAXIMUM_TORQUE: Object = Object::new(0x6072, 0);
pub const CURRENT_SETPOINT: Object = Object::new(0x6074, 0);
pub const TORQUE: Object = Object::new(0x6077, 0);
pub const TARGET_POSITION: Object = Object::new(0x607A, 0);
pub const HOME_OFFSET: Object = Object::new(0x607C, 0);
pub const MAXIMUM_VELOCITY: Object = Object::new(0x607F, 0);
pub const MAXIMUM_SPEED: Object = Object::new(0x6080, 0);
pub const PROFILE_VELOCITY: Object = Object::new(0x6081, 0);
pub const ACCELERATION: Object = Object::new(0x6083, 0);
pub const DECELERATION: Object = Object::new(0x6084, 0);
pub const RESOLUTION: Object = Object::new(0x608F, 1);
pub const RESOLUTION_TURNS: Object = Object::new(0x608F, 2);
pub const FEED: Object = Object::new(0x6092, 1);
pub const FEED_TURNS: Object = Object::new(0x6092, 2);
pub const FACTOR: Object = Object::new(0x6093, 1);
pub const DIVISOR: Object = Object::new(0x6093, 2);
pub const HOMING_METHOD: Object = Object::new(0x6098, 0);
pub const HOMING_SPEED: Object = Object::new(0x6099, 1);
pub const HOMING_ACCELERATION: Object = Object::new(0x609A, 0);
pub const INTERPOLATION: Object = Object::new(0x60C1, 1);
pub const CYCLE_UNITS: Object = Object::new(0x60C2, 1);
pub const CYCLE_POWER: Object = Object::new(0x60C2, 2);
pub const POSITIVE_TORQUE: Object = Object::new(0x60E0, 0);
pub const NEGATIVE_TORQUE: Object = Object::new(0x60E1, 0);
pub const FOLLOWING_ERROR: Object = Object::new(0x60F4, 0);
pub const TARGET_VELOCITY: Object = Object::new(0x60FF, 0);
