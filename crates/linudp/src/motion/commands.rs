//! Every motion command of the manual: id, name, marks, fields in their order on the wire.
//!
//! The constructors of [`MotionCommand`] and the [`CATALOGUE`] are made from one list, and with that the names, layouts
//! and ranges of the command-table files. The names are those of the files and stay as they are. Where the sources give
//! a layout without a meaning, a command is called by its number.
//!
//! Sources: SG5 manual 4.3.4; the marks say where it does not reach. Where the header that it prints differs from the
//! number of the section (027x, 02Dx, 07Fx, 09Fx, 25Ex, 266x), the section is right.

use super::catalogue::{CommandInfo, Mark, kebab, lay_out};
use super::command::MotionCommand;
use super::values::*;
use super::values::{ScaledAcceleration as A16, ScaledPosition as P16, ScaledVelocity as V16};

impl CommandInfo {
    /// The command of this id, 12 bits: the catalogue is in their order.
    pub fn of(id: u16) -> Option<&'static CommandInfo> {
        let index = CATALOGUE.binary_search_by_key(&id, |info| info.id).ok()?;
        CATALOGUE.get(index)
    }

    /// The command of this name.
    pub fn named(name: &str) -> Option<&'static CommandInfo> {
        CATALOGUE.iter().find(|info| info.name == name)
    }
}

/// The usual quantity of a field of this name.
mod usual {
    pub(super) use crate::motion::values::{
        Acceleration as acceleration, Acceleration as deceleration, AmplitudeScale as amplitude,
        Bits as mask, Bits as value, Counts as delay, Counts as length, Counts as start, CurveId as curve,
        CurveTime as time, EntryId as entry, EntryId as if_false, EntryId as if_true, Jerk as jerk,
        Long as first, Long as second, Long as third, Offset as offset, Position as distance,
        Position as limit, Position as position, Position as target, Upid as upid, Velocity as velocity,
    };
}

/// The quantity of a field: the one that the list names, or the usual one.
macro_rules! kind {
    ($field:ident $kind:ident) => {
        $kind
    };
    ($field:ident) => {
        usual::$field
    };
}

/// `name = id [marks] (field, field: Kind, ...);`: a constructor and an entry of the catalogue each.
macro_rules! commands {
    ($($(#[doc = $doc:literal])+
       $name:ident = $id:literal [$($mark:ident),*] ($($field:ident $(: $kind:ident)?),*);)*) => {
        /// Every motion command that is known, by rising ids.
        pub static CATALOGUE: &[CommandInfo] = &[$(CommandInfo {
            id: $id,
            name: {
                const NAME: &str = stringify!($name);
                const KEBAB: [u8; NAME.len()] = kebab(NAME);
                match std::str::from_utf8(&KEBAB) {
                    Ok(name) => name,
                    Err(_) => NAME,
                }
            },
            marks: &[$(Mark::$mark),*],
            fields: &const { lay_out([$((stringify!($field), <kind!($field $($kind)?)>::KIND)),*]) },
        }),*];

        impl MotionCommand {
            $($(#[doc = $doc])+
            #[doc = concat!("\n\nId `", stringify!($id), "`" $(, ", [`Mark::", stringify!($mark), "`]")*, ".")]
            #[inline]
            pub const fn $name($($field: kind!($field $($kind)?)),*) -> MotionCommand {
                let (command, _at) = (MotionCommand::new($id), 0);
                $(let (command, _at) = (
                    command.with(_at, $field.wire() as u32, size_of_val(&$field)),
                    _at + size_of_val(&$field),
                );)*
                command
            })*
        }
    };
}

commands! {
    // 00: control.

    /// Nothing, in any state. A new count with it is stored all the same.
    no_operation = 0x000 [] ();
    /// Writes the interface's control word.
    control_word = 0x001 [] (word: Bits);
    /// Writes a live parameter in RAM.
    live_parameter = 0x002 [] (upid, value: Raw);
    /// Writes the outputs X4 / X14 of `mask`: bit 0 is X4.3, bit 1 is X4.4 ...
    x4_outputs = 0x003 [] (mask, value);
    /// Writes the outputs X6 of `mask`. Known from one master in the field only.
    x6_outputs = 0x004 [Newer, Assumed] (mask, value);
    /// Selects a position controller set.
    controller_set = 0x005 [] (set: ControllerSet);
    /// Disarms trigger and after-actual commands.
    clear_events = 0x008 [] ();
    /// The present position of the motor becomes `position`, and it is homed.
    master_homing = 0x009 [] (position);
    /// Restarts the whole firmware. Send it with count 0 only, or the drive reboots in a loop.
    reset_firmware = 0x00F [] ();

    // 01: VAI, a trapezoid from velocity, acceleration, deceleration.

    /// VAI: goes to `position` from demand position and demand velocity.
    vai_go_to = 0x010 [] (position, velocity, acceleration, deceleration);
    /// VAI: goes by `distance` from the demand position.
    vai_increment_demand = 0x011 [] (distance, velocity, acceleration, deceleration);
    /// VAI: moves the last target by `distance`.
    vai_increment_target = 0x012 [] (distance, velocity, acceleration, deceleration);
    /// VAI: goes to `position` from actual position and actual velocity.
    vai_go_to_from_actual = 0x013 [] (position, velocity, acceleration, deceleration);
    /// VAI: goes to `position` from actual position with velocity 0.
    vai_go_to_from_standstill = 0x014 [] (position, velocity, acceleration, deceleration);
    /// VAI: goes by `distance` from actual position and actual velocity.
    vai_increment_actual = 0x015 [] (distance, velocity, acceleration, deceleration);
    /// VAI: goes by `distance` from actual position with velocity 0.
    vai_increment_actual_from_standstill = 0x016 [] (distance, velocity, acceleration, deceleration);
    /// VAI: ramps down to standstill and stays controlled.
    vai_stop = 0x017 [] (deceleration);
    /// VAI: goes to `position` after the running command.
    vai_go_to_after_actual_command = 0x018 [] (position, velocity, acceleration, deceleration);
    /// VAI: goes to the position of the analog input.
    vai_go_to_analog = 0x019 [] (velocity, acceleration, deceleration);
    /// VAI: goes to `position` on the rising edge of the trigger.
    vai_go_to_on_rising_trigger = 0x01A [] (position, velocity, acceleration, deceleration);
    /// VAI: moves the last target by `distance` on the rising edge of the trigger.
    vai_increment_target_on_rising_trigger = 0x01B [] (distance, velocity, acceleration, deceleration);
    /// VAI: goes to `position` on the falling edge of the trigger.
    vai_go_to_on_falling_trigger = 0x01C [] (position, velocity, acceleration, deceleration);
    /// VAI: moves the last target by `distance` on the falling edge of the trigger.
    vai_increment_target_on_falling_trigger = 0x01D [] (distance, velocity, acceleration, deceleration);
    /// VAI: takes another profile when the demand passes `position` in positive direction; the target stays.
    vai_change_on_positive_transition = 0x01E [] (position, velocity, acceleration, deceleration);
    /// VAI: takes another profile when the demand passes `position` in negative direction; the target stays.
    vai_change_on_negative_transition = 0x01F [] (position, velocity, acceleration, deceleration);

    // 02: VAI with the drive's own profile (UPIDs 14BEh-14C0h).

    /// Predefined VAI: goes to `position` from demand position and demand velocity.
    vai_predefined_go_to = 0x020 [] (position);
    /// Predefined VAI: goes by `distance` from the demand position.
    vai_predefined_increment_demand = 0x021 [] (distance);
    /// Predefined VAI: moves the last target by `distance`.
    vai_predefined_increment_target = 0x022 [] (distance);
    /// Predefined VAI: goes to `position` from actual position and actual velocity.
    vai_predefined_go_to_from_actual = 0x023 [] (position);
    /// Predefined VAI: goes to `position` from actual position with velocity 0.
    vai_predefined_go_to_from_standstill = 0x024 [] (position);
    /// Predefined VAI: stops with the drive's quick-stop deceleration.
    vai_predefined_stop = 0x027 [] ();
    /// Predefined VAI: goes to `position` after the running command.
    vai_predefined_go_to_after_actual_command = 0x028 [] (position);
    /// Predefined VAI: goes to `position` on the rising edge of the trigger.
    vai_predefined_go_to_on_rising_trigger = 0x02A [] (position);
    /// Predefined VAI: moves the last target by `distance` on the rising edge of the trigger.
    vai_predefined_increment_target_on_rising_trigger = 0x02B [] (distance);
    /// Predefined VAI: goes to `position` on the falling edge of the trigger.
    vai_predefined_go_to_on_falling_trigger = 0x02C [] (position);
    /// Predefined VAI: moves the last target by `distance` on the falling edge of the trigger.
    vai_predefined_increment_target_on_falling_trigger = 0x02D [] (distance);
    /// Predefined VAI: runs without end in positive direction.
    vai_predefined_run_positive = 0x02E [] ();
    /// Predefined VAI: runs without end in negative direction.
    vai_predefined_run_negative = 0x02F [] ();

    // 03: streams. Velocity and acceleration are signed; each setpoint needs a new count.

    /// A streamed position; the drive's receive time is the time base.
    stream_p = 0x030 [] (position);
    /// A streamed position and velocity; receive time.
    stream_pv = 0x031 [] (position, velocity: SignedVelocity);
    /// A streamed position; the period configured in the drive (UPID 14E6h).
    stream_p_configured = 0x032 [] (position);
    /// A streamed position and velocity; configured period.
    stream_pv_configured = 0x033 [] (position, velocity: SignedVelocity);
    /// A streamed position, velocity and acceleration; receive time.
    stream_pva = 0x034 [] (position, velocity: SignedVelocity, acceleration: SignedAcceleration);
    /// A streamed position, velocity and acceleration; configured period.
    stream_pva_configured = 0x035 [] (position, velocity: SignedVelocity, acceleration: SignedAcceleration);
    /// A streamed position, velocity and acceleration with the controller's time stamp, of which no more is
    /// known.
    stream_pva_stamped = 0x03A [Newer, Assumed] (position, velocity: SignedVelocity, acceleration: SignedAcceleration);
    /// Leaves streaming.
    stream_end = 0x03F [] ();

    // 04: time curves.

    /// Starts a curve as it is.
    curve_start = 0x040 [] (curve);
    /// Starts a curve as it is, at the actual position.
    curve_start_from_actual = 0x041 [] (curve);
    /// Starts a curve that is stretched so that it ends at `target`.
    curve_start_to_target = 0x042 [] (curve, target);
    /// Starts a curve that ends at `target` after `time`.
    curve_start_to_target_in_time = 0x043 [] (curve, target, time);
    /// Starts a curve with an offset, in other time and amplitude.
    curve_start_scaled = 0x044 [] (curve, offset: Position, time_scale: TimeScale, amplitude);
    /// Starts a curve with an offset and another amplitude that takes `time`.
    curve_start_in_time = 0x045 [] (curve, offset: Position, time, amplitude);
    /// Like 045x, on the rising edge of the trigger.
    curve_start_in_time_on_rising_trigger = 0x046 [] (curve, offset: Position, time, amplitude);
    /// Like 045x, on the falling edge of the trigger.
    curve_start_in_time_on_falling_trigger = 0x047 [] (curve, offset: Position, time, amplitude);
    /// Like 042x, on the rising edge of the trigger.
    curve_start_to_target_on_rising_trigger = 0x04A [] (curve, target);
    /// Like 042x, on the falling edge of the trigger.
    curve_start_to_target_on_falling_trigger = 0x04C [] (curve, target);
    /// Like 043x, on the rising edge of the trigger.
    curve_start_to_target_in_time_on_rising_trigger = 0x04E [] (curve, target, time);
    /// Like 043x, on the falling edge of the trigger.
    curve_start_to_target_in_time_on_falling_trigger = 0x04F [] (curve, target, time);

    // 05: changes a curve in RAM. The layouts are known; that 051x and 052x write the info block, and the others the
    // setpoints, is assumed.

    /// Sets the address that a curve starts at.
    curve_modify_start_address = 0x050 [] (curve, address: Offset);
    /// Writes 16 bits of a curve's info block.
    curve_modify_info_short = 0x051 [Assumed] (curve, offset, value: Short);
    /// Writes 32 bits of a curve's info block.
    curve_modify_info_long = 0x052 [Assumed] (curve, offset, value: Long);
    /// Writes one value of 32 bits into a curve's setpoints.
    curve_modify_one = 0x054 [Assumed] (curve, offset, first);
    /// Writes two values of 32 bits into a curve's setpoints.
    curve_modify_two = 0x055 [Assumed] (curve, offset, first, second);
    /// Writes three values of 32 bits into a curve's setpoints.
    curve_modify_three = 0x056 [Assumed] (curve, offset, first, second, third);

    // 06: encoder cams that a trigger starts.

    /// Starts a cam `delay` counts behind the actual ones.
    cam_from_actual_counts = 0x064 [Assumed] (curve, delay);
    /// Starts a cam `delay` counts after the rising edge of the trigger.
    cam_on_rising_trigger = 0x069 [] (curve, delay);
    /// Like 069x; the cam ends at `position` after `length` counts.
    cam_to_position_on_rising_trigger = 0x06A [] (curve, delay, position, length);
    /// Starts a cam `delay` counts after the falling edge of the trigger.
    cam_on_falling_trigger = 0x06B [] (curve, delay);
    /// Like 06Bx; the cam ends at `position` after `length` counts.
    cam_to_position_on_falling_trigger = 0x06C [] (curve, delay, position, length);
    /// Like 069x, with another amplitude, over `length` counts.
    cam_scaled_on_rising_trigger = 0x06D [] (curve, delay, amplitude, length);
    /// Like 06Bx, with another amplitude, over `length` counts.
    cam_scaled_on_falling_trigger = 0x06E [] (curve, delay, amplitude, length);

    // 07: indexing. The layouts are known, how they differ is not, so they are called by their numbers.

    /// Indexing with a profile.
    indexing_070 = 0x070 [] (position, velocity, acceleration, deceleration);
    /// Indexing with the drive's own profile.
    indexing_071 = 0x071 [] (position);
    /// Indexing with a profile.
    indexing_07e = 0x07E [] (position, velocity, acceleration, deceleration);
    /// Indexing with the drive's own profile.
    indexing_07f = 0x07F [] (position);

    // 09: VAI in 16 bits, scaled by UPIDs 1455h-1458h.

    /// 16-bit VAI: goes to `position` from demand position and demand velocity.
    vai_16bit_go_to = 0x090 [] (position: P16, velocity: V16, acceleration: A16, deceleration: A16);
    /// 16-bit VAI: goes by `distance` from the demand position.
    vai_16bit_increment_demand = 0x091 [] (distance: P16, velocity: V16, acceleration: A16, deceleration: A16);
    /// 16-bit VAI: moves the last target by `distance`.
    vai_16bit_increment_target = 0x092 [] (distance: P16, velocity: V16, acceleration: A16, deceleration: A16);
    /// 16-bit VAI: goes to `position` from actual position and actual velocity.
    vai_16bit_go_to_from_actual = 0x093 [] (position: P16, velocity: V16, acceleration: A16, deceleration: A16);
    /// 16-bit VAI: goes to `position` from actual position with velocity 0.
    vai_16bit_go_to_from_standstill = 0x094 [] (position: P16, velocity: V16, acceleration: A16, deceleration: A16);
    /// 16-bit VAI: goes by `distance` from actual position and actual velocity.
    vai_16bit_increment_actual = 0x095 [] (distance: P16, velocity: V16, acceleration: A16, deceleration: A16);
    /// 16-bit VAI: goes by `distance` from actual position with velocity 0.
    vai_16bit_increment_actual_from_standstill = 0x096 [] (
        distance: P16, velocity: V16, acceleration: A16, deceleration: A16
    );
    /// 16-bit VAI: ramps down to standstill and stays controlled.
    vai_16bit_stop = 0x097 [] (deceleration: A16);
    /// 16-bit VAI: goes to `position` after the running command.
    vai_16bit_go_to_after_actual_command = 0x098 [] (
        position: P16, velocity: V16, acceleration: A16, deceleration: A16
    );
    /// 16-bit VAI: goes to `position` on the rising edge of the trigger.
    vai_16bit_go_to_on_rising_trigger = 0x09A [] (position: P16, velocity: V16, acceleration: A16, deceleration: A16);
    /// 16-bit VAI: moves the last target by `distance` on the rising edge of the trigger.
    vai_16bit_increment_target_on_rising_trigger = 0x09B [] (
        distance: P16, velocity: V16, acceleration: A16, deceleration: A16
    );
    /// 16-bit VAI: goes to `position` on the falling edge of the trigger.
    vai_16bit_go_to_on_falling_trigger = 0x09C [] (position: P16, velocity: V16, acceleration: A16, deceleration: A16);
    /// 16-bit VAI: moves the last target by `distance` on the falling edge of the trigger.
    vai_16bit_increment_target_on_falling_trigger = 0x09D [] (
        distance: P16, velocity: V16, acceleration: A16, deceleration: A16
    );
    /// 16-bit VAI: takes another profile when the demand passes `position` in positive direction; the target
    /// stays.
    vai_16bit_change_on_positive_transition = 0x09E [] (
        position: P16, velocity: V16, acceleration: A16, deceleration: A16
    );
    /// 16-bit VAI: takes another profile when the demand passes `position` in negative direction; the target
    /// stays.
    vai_16bit_change_on_negative_transition = 0x09F [] (
        position: P16, velocity: V16, acceleration: A16, deceleration: A16
    );

    // 0A: VAI in 16 bits with the drive's own profile.

    /// Predefined 16-bit VAI: goes to `position` from demand position and demand velocity.
    vai_predefined_16bit_go_to = 0x0A0 [] (position: P16);
    /// Predefined 16-bit VAI: goes by `distance` from the demand position.
    vai_predefined_16bit_increment_demand = 0x0A1 [] (distance: P16);
    /// Predefined 16-bit VAI: moves the last target by `distance`.
    vai_predefined_16bit_increment_target = 0x0A2 [] (distance: P16);
    /// Predefined 16-bit VAI: goes to `position` from actual position and actual velocity.
    vai_predefined_16bit_go_to_from_actual = 0x0A3 [] (position: P16);
    /// Predefined 16-bit VAI: goes to `position` from actual position with velocity 0.
    vai_predefined_16bit_go_to_from_standstill = 0x0A4 [] (position: P16);
    /// Predefined 16-bit VAI: stops with the drive's quick-stop deceleration.
    vai_predefined_16bit_stop = 0x0A7 [] ();
    /// Predefined 16-bit VAI: goes to `position` after the running command.
    vai_predefined_16bit_go_to_after_actual_command = 0x0A8 [] (position: P16);
    /// Predefined 16-bit VAI: goes to `position` on the rising edge of the trigger.
    vai_predefined_16bit_go_to_on_rising_trigger = 0x0AA [] (position: P16);
    /// Predefined 16-bit VAI: moves the last target by `distance` on the rising edge of the trigger.
    vai_predefined_16bit_increment_target_on_rising_trigger = 0x0AB [] (distance: P16);
    /// Predefined 16-bit VAI: goes to `position` on the falling edge of the trigger. Printed with 32 bits,
    /// most likely a misprint.
    vai_predefined_16bit_go_to_on_falling_trigger = 0x0AC [Assumed] (position: P16);
    /// Predefined 16-bit VAI: moves the last target by `distance` on the falling edge of the trigger.
    vai_predefined_16bit_increment_target_on_falling_trigger = 0x0AD [] (distance: P16);

    // 0B: VAI with the drive's own acceleration and deceleration.

    /// VAI, predefined acceleration: goes to `position` from demand position and demand velocity.
    vai_predefined_acc_go_to = 0x0B0 [] (position, velocity);
    /// VAI, predefined acceleration: goes by `distance` from the demand position.
    vai_predefined_acc_increment_demand = 0x0B1 [] (distance, velocity);
    /// VAI, predefined acceleration: moves the last target by `distance`.
    vai_predefined_acc_increment_target = 0x0B2 [] (distance, velocity);
    /// VAI, predefined acceleration: goes to `position` from actual position and actual velocity.
    vai_predefined_acc_go_to_from_actual = 0x0B3 [] (position, velocity);
    /// VAI, predefined acceleration: goes to `position` from actual position with velocity 0.
    vai_predefined_acc_go_to_from_standstill = 0x0B4 [] (position, velocity);
    /// VAI, predefined acceleration: goes to `position` after the running command.
    vai_predefined_acc_go_to_after_actual_command = 0x0B8 [] (position, velocity);
    /// VAI, predefined acceleration: goes to `position` on the rising edge of the trigger.
    vai_predefined_acc_go_to_on_rising_trigger = 0x0BA [] (position, velocity);
    /// VAI, predefined acceleration: moves the last target by `distance` on the rising edge of the trigger.
    vai_predefined_acc_increment_target_on_rising_trigger = 0x0BB [] (distance, velocity);
    /// VAI, predefined acceleration: goes to `position` on the falling edge of the trigger.
    vai_predefined_acc_go_to_on_falling_trigger = 0x0BC [] (position, velocity);
    /// VAI, predefined acceleration: moves the last target by `distance` on the falling edge of the trigger.
    vai_predefined_acc_increment_target_on_falling_trigger = 0x0BD [] (distance, velocity);

    // 0C: VAI, deceleration = acceleration.

    /// VAI, dec = acc: goes to `position` from demand position and demand velocity.
    vai_dec_acc_go_to = 0x0C0 [] (position, velocity, acceleration);
    /// VAI, dec = acc: goes by `distance` from the demand position.
    vai_dec_acc_increment_demand = 0x0C1 [] (distance, velocity, acceleration);
    /// VAI, dec = acc: moves the last target by `distance`.
    vai_dec_acc_increment_target = 0x0C2 [] (distance, velocity, acceleration);
    /// VAI, dec = acc: goes to `position` from actual position and actual velocity.
    vai_dec_acc_go_to_from_actual = 0x0C3 [] (position, velocity, acceleration);
    /// VAI, dec = acc: goes to `position` from actual position with velocity 0.
    vai_dec_acc_go_to_from_standstill = 0x0C4 [] (position, velocity, acceleration);
    /// VAI, dec = acc: presses with at most `current`; goes to `position` from demand position and demand
    /// velocity.
    vai_dec_acc_press = 0x0C5 [] (position, velocity, acceleration, current: CurrentLimit);
    /// VAI, dec = acc: presses with at most `current`; goes to `position` from actual position and actual
    /// velocity.
    vai_dec_acc_press_from_actual = 0x0C6 [] (position, velocity, acceleration, current: CurrentLimit);
    /// VAI, dec = acc: presses with at most `current`; goes to `position` from actual position with velocity
    /// 0.
    vai_dec_acc_press_from_standstill = 0x0C7 [] (position, velocity, acceleration, current: CurrentLimit);
    /// VAI, dec = acc: goes to `position` after the running command.
    vai_dec_acc_go_to_after_actual_command = 0x0C8 [] (position, velocity, acceleration);
    /// VAI, dec = acc: goes to `position` on the rising edge of the trigger.
    vai_dec_acc_go_to_on_rising_trigger = 0x0CA [] (position, velocity, acceleration);
    /// VAI, dec = acc: moves the last target by `distance` on the rising edge of the trigger.
    vai_dec_acc_increment_target_on_rising_trigger = 0x0CB [] (distance, velocity, acceleration);
    /// VAI, dec = acc: goes to `position` on the falling edge of the trigger.
    vai_dec_acc_go_to_on_falling_trigger = 0x0CC [] (position, velocity, acceleration);
    /// VAI, dec = acc: moves the last target by `distance` on the falling edge of the trigger.
    vai_dec_acc_increment_target_on_falling_trigger = 0x0CD [] (distance, velocity, acceleration);
    /// VAI, dec = acc: runs without end in positive direction. The layout is known from one master in the
    /// field only.
    vai_dec_acc_run_positive = 0x0CE [Assumed] (velocity, acceleration);
    /// VAI, dec = acc: runs without end in negative direction. The layout is known from one master in the
    /// field only.
    vai_dec_acc_run_negative = 0x0CF [Assumed] (velocity, acceleration);

    // 0D: VAI from what the drive has captured, computed or armed.

    /// VAI: goes to the captured position and `distance`.
    vai_increment_captured = 0x0D0 [] (distance, velocity, acceleration, deceleration);
    /// 16-bit VAI, dec = acc: goes to the captured position and `distance`.
    vai_16bit_dec_acc_increment_captured = 0x0D1 [] (distance: P16, velocity: V16, acceleration: A16);
    /// VAI: goes to the position in command table variable 1.
    vai_go_to_variable_1 = 0x0D4 [] (velocity, acceleration, deceleration);
    /// VAI: goes to the position in command table variable 2.
    vai_go_to_variable_2 = 0x0D5 [] (velocity, acceleration, deceleration);
    /// VAI: goes to the position in command table variable 1 from the actual position.
    vai_go_to_variable_1_from_actual = 0x0D6 [] (velocity, acceleration, deceleration);
    /// VAI: goes to the position in command table variable 2 from the actual position.
    vai_go_to_variable_2_from_actual = 0x0D7 [] (velocity, acceleration, deceleration);
    /// VAI: resets the integrator and goes by `distance` from the actual position.
    vai_increment_actual_reset_integrator = 0x0D9 [Newer] (distance, velocity, acceleration, deceleration);
    /// Starts the VAI of the rising trigger.
    vai_start_trigger_rise = 0x0DE [] ();
    /// Starts the VAI of the falling trigger.
    vai_start_trigger_fall = 0x0DF [] ();

    // 0E: sine, which starts only when the motion before has finished.

    /// Sine VA: goes to `position` from the demand position.
    sine_va_go_to = 0x0E0 [] (position, velocity, acceleration);
    /// Sine VA: goes by `distance` from the demand position.
    sine_va_increment_demand = 0x0E1 [] (distance, velocity, acceleration);
    /// Sine VA: goes to `position` from the actual position.
    sine_va_go_to_from_actual = 0x0E4 [] (position, velocity, acceleration);
    /// Sine VA: goes by `distance` from the actual position.
    sine_va_increment_actual = 0x0E6 [] (distance, velocity, acceleration);
    /// Sine VA: goes to `position` after the running command.
    sine_va_go_to_after_actual_command = 0x0E8 [] (position, velocity, acceleration);
    /// Sine VA: goes to the position of the analog input.
    sine_va_go_to_analog = 0x0E9 [] (velocity, acceleration);
    /// Sine VA: goes to `position` on the rising edge of the trigger.
    sine_va_go_to_on_rising_trigger = 0x0EA [] (position, velocity, acceleration);
    /// Sine VA: goes by `distance` from the demand position on the rising edge of the trigger.
    sine_va_increment_demand_on_rising_trigger = 0x0EB [] (distance, velocity, acceleration);
    /// Sine VA: goes to `position` on the falling edge of the trigger.
    sine_va_go_to_on_falling_trigger = 0x0EC [] (position, velocity, acceleration);
    /// Sine VA: goes by `distance` from the demand position on the falling edge of the trigger.
    sine_va_increment_demand_on_falling_trigger = 0x0ED [] (distance, velocity, acceleration);

    // 0F: Bestehorn, which starts only when the motion before has finished.

    /// Bestehorn VAJ: goes to `position` from the demand position.
    bestehorn_vaj_go_to = 0x0F0 [] (position, velocity, acceleration, jerk);
    /// Bestehorn VAJ: goes by `distance` from the demand position.
    bestehorn_vaj_increment_demand = 0x0F1 [] (distance, velocity, acceleration, jerk);
    /// Bestehorn VAJ: goes to `position` from the actual position.
    bestehorn_vaj_go_to_from_actual = 0x0F4 [] (position, velocity, acceleration, jerk);
    /// Bestehorn VAJ: goes by `distance` from the actual position.
    bestehorn_vaj_increment_actual = 0x0F6 [] (distance, velocity, acceleration, jerk);
    /// Bestehorn VAJ: goes to `position` after the running command.
    bestehorn_vaj_go_to_after_actual_command = 0x0F8 [] (position, velocity, acceleration, jerk);
    /// Bestehorn VAJ: goes to the position of the analog input.
    bestehorn_vaj_go_to_analog = 0x0F9 [] (velocity, acceleration, jerk);
    /// Bestehorn VAJ: goes to `position` on the rising edge of the trigger.
    bestehorn_vaj_go_to_on_rising_trigger = 0x0FA [] (position, velocity, acceleration, jerk);
    /// Bestehorn VAJ: goes by `distance` from the demand position on the rising edge of the trigger.
    bestehorn_vaj_increment_demand_on_rising_trigger = 0x0FB [] (distance, velocity, acceleration, jerk);
    /// Bestehorn VAJ: goes to `position` on the falling edge of the trigger.
    bestehorn_vaj_go_to_on_falling_trigger = 0x0FC [] (position, velocity, acceleration, jerk);
    /// Bestehorn VAJ: goes by `distance` from the demand position on the falling edge of the trigger.
    bestehorn_vaj_increment_demand_on_falling_trigger = 0x0FD [] (distance, velocity, acceleration, jerk);

    // 10: encoder cams on and off.

    /// Enables the encoder cams.
    encoder_cam_enable = 0x100 [] ();
    /// Disables the encoder cams.
    encoder_cam_disable = 0x101 [] ();
    /// Goes to the position that the cam has at the encoder's counts.
    encoder_cam_go_to_sync = 0x102 [] ();
    /// Sets the counts of the encoder.
    encoder_cam_set_counts = 0x104 [] (counts: Counts);

    // 11: encoder cam 1.

    /// Cam 1: a curve from `start` on.
    encoder_cam_1_start = 0x110 [] (curve, start);
    /// Cam 1: a curve from `start` on, at the actual position (by analogy with 041x).
    encoder_cam_1_start_from_actual = 0x111 [Assumed] (curve, start);
    /// Cam 1: a curve from `start` on that ends at `position`.
    encoder_cam_1_start_to_position = 0x112 [] (curve, start, position);
    /// Cam 1: a curve from `start_position` to `target`, `length` counts long.
    encoder_cam_1_start_between = 0x113 [] (curve, start, start_position: Position, target, length);
    /// Cam 1: a curve that ends at `position`, `length` counts long.
    encoder_cam_1_start_to_position_over = 0x114 [] (curve, start, position, length);
    /// Cam 1: a curve with another amplitude, `length` counts long.
    encoder_cam_1_start_scaled = 0x115 [] (curve, start, amplitude, length);
    /// Enables cam 1.
    encoder_cam_1_enable = 0x116 [] ();
    /// Disables cam 1.
    encoder_cam_1_disable = 0x117 [] ();
    /// Cam 1: another amplitude and length.
    encoder_cam_1_scale = 0x118 [] (amplitude, length);

    // 12: encoder cam 2.

    /// Cam 2: a curve from `start` on.
    encoder_cam_2_start = 0x120 [] (curve, start);
    /// Cam 2: a curve from `start` on, at the actual position (by analogy with 041x).
    encoder_cam_2_start_from_actual = 0x121 [Assumed] (curve, start);
    /// Cam 2: a curve from `start` on that ends at `position`.
    encoder_cam_2_start_to_position = 0x122 [] (curve, start, position);
    /// Cam 2: a curve from `start_position` to `target`, `length` counts long.
    encoder_cam_2_start_between = 0x123 [] (curve, start, start_position: Position, target, length);
    /// Cam 2: a curve that ends at `position`, `length` counts long.
    encoder_cam_2_start_to_position_over = 0x124 [] (curve, start, position, length);
    /// Cam 2: a curve with another amplitude, `length` counts long.
    encoder_cam_2_start_scaled = 0x125 [] (curve, start, amplitude, length);
    /// Enables cam 2.
    encoder_cam_2_enable = 0x126 [] ();
    /// Disables cam 2.
    encoder_cam_2_disable = 0x127 [] ();
    /// Cam 2: another amplitude and length.
    encoder_cam_2_scale = 0x128 [] (amplitude, length);

    // 20: the command table.

    /// Starts the command table at an entry.
    table_start = 0x200 [] (entry);
    /// Starts the command table at an entry on the rising edge of the trigger.
    table_start_on_rising_trigger = 0x201 [] (entry);
    /// Starts the command table at an entry on the falling edge of the trigger.
    table_start_on_falling_trigger = 0x202 [] (entry);
    /// Writes 16 bits of an entry in RAM: offset 2 is its link, 4 its header, 6 its first parameter.
    table_modify_short = 0x208 [] (entry, offset, value: Short);
    /// Writes 32 bits of an entry in RAM.
    table_modify_long = 0x209 [] (entry, offset, value: Long);

    // 21, 22: waiting, inside the command table.

    /// Waits for a time.
    wait_time = 0x210 [TableOnly] (time: WaitTime);
    /// Waits until the motion has finished.
    wait_until_motion_finished = 0x211 [TableOnly] ();
    /// Waits until the motor is in its target position.
    wait_until_in_target = 0x212 [TableOnly] ();
    /// Waits for the rising edge of the trigger.
    wait_for_rising_trigger = 0x213 [TableOnly] ();
    /// Waits for the falling edge of the trigger.
    wait_for_falling_trigger = 0x214 [TableOnly] ();
    /// Waits for the time in variable 1.
    wait_time_in_variable_1 = 0x218 [TableOnly] ();
    /// Waits for the time in variable 2.
    wait_time_in_variable_2 = 0x219 [TableOnly] ();
    /// Waits until the demand position is greater than `limit`.
    wait_until_demand_position_greater = 0x220 [TableOnly] (limit);
    /// Waits until the demand position is less than `limit`.
    wait_until_demand_position_less = 0x221 [TableOnly] (limit);
    /// Waits until the actual position is greater than `limit`.
    wait_until_actual_position_greater = 0x222 [TableOnly] (limit);
    /// Waits until the actual position is less than `limit`.
    wait_until_actual_position_less = 0x223 [TableOnly] (limit);
    /// Waits until the difference of demand and actual position is greater than `limit`.
    wait_until_difference_greater = 0x224 [TableOnly] (limit);
    /// Waits until the difference of demand and actual position is less than `limit`.
    wait_until_difference_less = 0x225 [TableOnly] (limit);
    /// Waits until the difference of demand and actual position, without its sign, is greater than `limit`.
    wait_until_unsigned_difference_greater = 0x226 [TableOnly] (limit);
    /// Waits until the difference of demand and actual position, without its sign, is less than `limit`.
    wait_until_unsigned_difference_less = 0x227 [TableOnly] (limit);
    /// Waits until the demand velocity is greater than `limit`.
    wait_until_demand_velocity_greater = 0x228 [TableOnly] (limit: SignedVelocity);
    /// Waits until the demand velocity is less than `limit`.
    wait_until_demand_velocity_less = 0x229 [TableOnly] (limit: SignedVelocity);
    /// Waits until the actual velocity is greater than `limit`.
    wait_until_actual_velocity_greater = 0x22A [TableOnly] (limit: SignedVelocity);
    /// Waits until the actual velocity is less than `limit`.
    wait_until_actual_velocity_less = 0x22B [TableOnly] (limit: SignedVelocity);
    /// Waits until the current is greater than `limit`.
    wait_until_current_greater = 0x22E [TableOnly] (limit: ShortCurrent);
    /// Waits until the current is less than `limit`.
    wait_until_current_less = 0x22F [TableOnly] (limit: ShortCurrent);

    // 24: variables of the command table.

    /// Sets variable 1.
    variable_1_set = 0x240 [TableOnly] (value: Long);
    /// Adds to variable 1.
    variable_1_add = 0x241 [TableOnly] (value: Long);
    /// Sets variable 2.
    variable_2_set = 0x242 [TableOnly] (value: Long);
    /// Adds to variable 2.
    variable_2_add = 0x243 [TableOnly] (value: Long);
    /// Writes variable 1 to a parameter in RAM.
    variable_1_to_upid = 0x248 [TableOnly] (upid);
    /// Writes variable 2 to a parameter in RAM.
    variable_2_to_upid = 0x249 [TableOnly] (upid);
    /// Reads a parameter or variable of the drive in RAM into variable 1.
    upid_to_variable_1 = 0x24C [TableOnly] (upid);
    /// Reads a parameter or variable of the drive in RAM into variable 2.
    upid_to_variable_2 = 0x24D [TableOnly] (upid);
    /// Copies a parameter from RAM to ROM. Listed, but not described.
    upid_ram_to_rom = 0x24E [TableOnly, Assumed] (upid);

    // 25, 26: branches of the command table. The layouts are known; which comparison has which id is assumed, but for
    // 262x ... 265x. 256x and 257x, which compare a variable with a parameter, are listed without a layout.

    /// Goes on with `if_true` if variable 1 is less than `limit`, else with `if_false`.
    if_variable_1_less = 0x250 [TableOnly, Assumed] (limit: Long, if_true, if_false);
    /// Goes on with `if_true` if variable 1 is greater than `limit`, else with `if_false`.
    if_variable_1_greater = 0x251 [TableOnly, Assumed] (limit: Long, if_true, if_false);
    /// Goes on with `if_true` if variable 2 is less than `limit`, else with `if_false`.
    if_variable_2_less = 0x252 [TableOnly, Assumed] (limit: Long, if_true, if_false);
    /// Goes on with `if_true` if variable 2 is greater than `limit`, else with `if_false`.
    if_variable_2_greater = 0x253 [TableOnly, Assumed] (limit: Long, if_true, if_false);
    /// Goes on with `if_true` if the demand position is less than `limit`, else with `if_false`.
    if_demand_position_less = 0x258 [TableOnly, Assumed] (limit, if_true, if_false);
    /// Goes on with `if_true` if the demand position is greater than `limit`, else with `if_false`.
    if_demand_position_greater = 0x259 [TableOnly, Assumed] (limit, if_true, if_false);
    /// Goes on with `if_true` if the actual position is less than `limit`, else with `if_false`.
    if_actual_position_less = 0x25A [TableOnly, Assumed] (limit, if_true, if_false);
    /// Goes on with `if_true` if the actual position is greater than `limit`, else with `if_false`.
    if_actual_position_greater = 0x25B [TableOnly, Assumed] (limit, if_true, if_false);
    /// Goes on with `if_true` if the difference of demand and actual position is less than `limit`, else with
    /// `if_false`.
    if_difference_less = 0x25C [TableOnly, Assumed] (limit, if_true, if_false);
    /// Goes on with `if_true` if the difference of demand and actual position is greater than `limit`, else
    /// with `if_false`.
    if_difference_greater = 0x25D [TableOnly, Assumed] (limit, if_true, if_false);
    /// Goes on with `if_true` if the current is less than `limit`, else with `if_false`.
    if_current_less = 0x25E [TableOnly, Assumed] (limit: Current, if_true, if_false);
    /// Goes on with `if_true` if the current is greater than `limit`, else with `if_false`.
    if_current_greater = 0x25F [TableOnly, Assumed] (limit: Current, if_true, if_false);
    /// Goes on with `if_true` if the analog input is less than `limit`, else with `if_false`.
    if_analog_input_less = 0x260 [TableOnly, Assumed] (limit: Long, if_true, if_false);
    /// Goes on with `if_true` if the inputs X4 equal `value` in the bits of `mask`, else with `if_false`.
    if_x4_inputs_equal = 0x262 [TableOnly] (mask, value, if_true, if_false);
    /// Goes on with `if_true` if the inputs X6 equal `value` in the bits of `mask`, else with `if_false`.
    if_x6_inputs_equal = 0x263 [TableOnly] (mask, value, if_true, if_false);
    /// Goes on with `if_true` if the status word equal `value` in the bits of `mask`, else with `if_false`.
    if_status_word_equal = 0x264 [TableOnly] (mask, value, if_true, if_false);
    /// Goes on with `if_true` if the warn word equal `value` in the bits of `mask`, else with `if_false`.
    if_warn_word_equal = 0x265 [TableOnly] (mask, value, if_true, if_false);
    /// A branch whose condition is not known.
    if_266 = 0x266 [TableOnly, Assumed] (limit: Long, if_true, if_false);

    // 30, 31: winding. The layouts are known, what the commands do is not, so they are called by their numbers.

    /// Winding.
    winding_304 = 0x304 [] ();
    /// Winding.
    winding_305 = 0x305 [] ();
    /// Winding.
    winding_310 = 0x310 [] (number: Number);
    /// Winding with a number of revolutions.
    winding_311 = 0x311 [] (number: Number, revolutions: Counts);

    // 38: force control. How commands of one layout differ is not known, so these are called by their numbers.

    /// Force control with a limit.
    force_380 = 0x380 [SoftwareKey] (position, velocity, acceleration, limit: Force);
    /// Force control: a move with a whole profile.
    force_381 = 0x381 [SoftwareKey] (position, velocity, acceleration, deceleration);
    /// Force control: another target.
    force_change_target = 0x382 [SoftwareKey] (target: Force);
    /// Force control with a limit and a target.
    force_383 = 0x383 [SoftwareKey] (position, velocity, acceleration, limit: Force, target: Force);
    /// Force control with a limit.
    force_384 = 0x384 [SoftwareKey] (position, velocity, acceleration, limit: Force);
    /// Force control with a limit and a target.
    force_385 = 0x385 [SoftwareKey] (position, velocity, acceleration, limit: Force, target: Force);
    /// Force control: a move with a whole profile.
    force_386 = 0x386 [SoftwareKey] (position, velocity, acceleration, deceleration);
    /// Force control: a move with a whole profile.
    force_387 = 0x387 [SoftwareKey] (position, velocity, acceleration, deceleration);
    /// Force control: goes by `distance` from the actual position; higher limit and target.
    force_increment_actual_higher_limit = 0x388 [SoftwareKey, Newer, Assumed] (
        distance, velocity, acceleration, limit: Force, target: Force
    );
    /// Force control: goes by `distance` from the actual position; lower limit and target.
    force_increment_actual_lower_limit = 0x389 [SoftwareKey, Newer, Assumed] (
        distance, velocity, acceleration, limit: Force, target: Force
    );

    // 39: current control.

    /// Controls the current instead of the position.
    current_mode = 0x390 [] (current: Current);
    /// Back to position control.
    position_mode = 0x39F [] ();

    // 3A: VAJI, limited in jerk.

    /// VAJI: goes to `position` from demand position and demand velocity.
    vaji_go_to = 0x3A0 [Newer] (position, velocity, acceleration, deceleration, jerk);
    /// VAJI: goes by `distance` from the demand position.
    vaji_increment_demand = 0x3A1 [Newer] (distance, velocity, acceleration, deceleration, jerk);

}
