//! One vector for each command, with offsets and types as the SG5 manual gives them: its constructor, and the block
//! up to the last parameter, with count 5. No two bytes of a value are the same, so that a swapped byte is found.

use super::*;
use fieldbeat_core::axis::RangeError;

type M = MotionCommand;

const P: Position = Position(i32::from_le_bytes([0x01, 0x02, 0x03, 0x04]));
const V: Velocity = Velocity(u32::from_le_bytes([0x11, 0x12, 0x13, 0x14]));
const SV: SignedVelocity = SignedVelocity(i32::from_le_bytes([0x11, 0x12, 0x13, 0x14]));
const A: Acceleration = Acceleration(u32::from_le_bytes([0x21, 0x22, 0x23, 0x24]));
const SA: SignedAcceleration = SignedAcceleration(i32::from_le_bytes([0x21, 0x22, 0x23, 0x24]));
const D: Acceleration = Acceleration(u32::from_le_bytes([0x31, 0x32, 0x33, 0x34]));
const J: Jerk = Jerk(u32::from_le_bytes([0x41, 0x42, 0x43, 0x44]));
const P16: ScaledPosition = ScaledPosition(i16::from_le_bytes([0x01, 0x02]));
const V16: ScaledVelocity = ScaledVelocity(u16::from_le_bytes([0x11, 0x12]));
const A16: ScaledAcceleration = ScaledAcceleration(u16::from_le_bytes([0x21, 0x22]));
const D16: ScaledAcceleration = ScaledAcceleration(u16::from_le_bytes([0x31, 0x32]));
const TIME: CurveTime = CurveTime(i32::from_le_bytes([0x51, 0x52, 0x53, 0x54]));
const TARGET: Position = Position(i32::from_le_bytes([0x61, 0x62, 0x63, 0x64]));
const COUNTS: Counts = Counts(i32::from_le_bytes([0x71, 0x72, 0x73, 0x74]));
const LENGTH: Counts = Counts(i32::from_le_bytes([0x81, 0x82, 0x83, 0x84]));
const MASK: Bits = Bits(u16::from_le_bytes([0xA1, 0xA2]));
const BITS: Bits = Bits(u16::from_le_bytes([0xB1, 0xB2]));
const UPID: Upid = Upid(u16::from_le_bytes([0xC1, 0xC2]));
const OFFSET: Offset = Offset(u16::from_le_bytes([0xD1, 0xD2]));
const SHORT: Short = Short(i16::from_le_bytes([0xE1, 0xE2]));
const LONG: Long = Long(i32::from_le_bytes([0xF1, 0xF2, 0xF3, 0xF4]));
const LONG2: Long = Long(i32::from_le_bytes([0xE1, 0xE2, 0xE3, 0xE4]));
const LONG3: Long = Long(i32::from_le_bytes([0xD1, 0xD2, 0xD3, 0xD4]));
const WAIT: WaitTime = WaitTime(u32::from_le_bytes([0x51, 0x52, 0x53, 0x54]));
const CURRENT: Current = Current(i32::from_le_bytes([0x91, 0x92, 0x93, 0x94]));
const I16: ShortCurrent = ShortCurrent(i16::from_le_bytes([0x91, 0x92]));
const LIMIT: CurrentLimit = CurrentLimit(u16::from_le_bytes([0x91, 0x92]));
const FORCE: Force = Force(i16::from_le_bytes([0x51, 0x52]));
const FORCE2: Force = Force(i16::from_le_bytes([0x61, 0x62]));
const RAW: Raw = Raw(u32::from_le_bytes([0xF1, 0xF2, 0xF3, 0xF4]));
const NUMBER: Number = Number(u16::from_le_bytes([0xD1, 0xD2]));

#[rustfmt::skip]
fn vectors() -> Vec<(MotionCommand, &'static str)> {
    const CURVE: CurveId = limited(CurveId::new(7));
    const ENTRY: EntryId = limited(EntryId::new(9));
    const YES: EntryId = limited(EntryId::new(10));
    const NO: EntryId = limited(EntryId::new(255));
    const SET: ControllerSet = limited(ControllerSet::new(1));
    const SCALE: TimeScale = limited(TimeScale::new(0x4E1F));
    // -19999.
    const AMP: AmplitudeScale = limited(AmplitudeScale::new(-0x4E1F));
    vec![
        (M::no_operation(), "05 00"),
        (M::control_word(BITS), "15 00 B1B2"),
        (M::live_parameter(UPID, RAW), "25 00 C1C2 F1F2F3F4"),
        (M::x4_outputs(MASK, BITS), "35 00 A1A2 B1B2"),
        (M::x6_outputs(MASK, BITS), "45 00 A1A2 B1B2"),
        (M::controller_set(SET), "55 00 0100"),
        (M::clear_events(), "85 00"),
        (M::master_homing(P), "95 00 01020304"),
        (M::reset_firmware(), "F5 00"),
        (M::vai_go_to(P, V, A, D), "05 01 01020304 11121314 21222324 31323334"),
        (M::vai_increment_demand(P, V, A, D), "15 01 01020304 11121314 21222324 31323334"),
        (M::vai_increment_target(P, V, A, D), "25 01 01020304 11121314 21222324 31323334"),
        (M::vai_go_to_from_actual(P, V, A, D), "35 01 01020304 11121314 21222324 31323334"),
        (M::vai_go_to_from_standstill(P, V, A, D), "45 01 01020304 11121314 21222324 31323334"),
        (M::vai_increment_actual(P, V, A, D), "55 01 01020304 11121314 21222324 31323334"),
        (M::vai_increment_actual_from_standstill(P, V, A, D), "65 01 01020304 11121314 21222324 31323334"),
        (M::vai_stop(D), "75 01 31323334"),
        (M::vai_go_to_after_actual_command(P, V, A, D), "85 01 01020304 11121314 21222324 31323334"),
        (M::vai_go_to_analog(V, A, D), "95 01 11121314 21222324 31323334"),
        (M::vai_go_to_on_rising_trigger(P, V, A, D), "A5 01 01020304 11121314 21222324 31323334"),
        (M::vai_increment_target_on_rising_trigger(P, V, A, D), "B5 01 01020304 11121314 21222324 31323334"),
        (M::vai_go_to_on_falling_trigger(P, V, A, D), "C5 01 01020304 11121314 21222324 31323334"),
        (M::vai_increment_target_on_falling_trigger(P, V, A, D), "D5 01 01020304 11121314 21222324 31323334"),
        (M::vai_change_on_positive_transition(P, V, A, D), "E5 01 01020304 11121314 21222324 31323334"),
        (M::vai_change_on_negative_transition(P, V, A, D), "F5 01 01020304 11121314 21222324 31323334"),
        (M::vai_predefined_go_to(P), "05 02 01020304"),
        (M::vai_predefined_increment_demand(P), "15 02 01020304"),
        (M::vai_predefined_increment_target(P), "25 02 01020304"),
        (M::vai_predefined_go_to_from_actual(P), "35 02 01020304"),
        (M::vai_predefined_go_to_from_standstill(P), "45 02 01020304"),
        (M::vai_predefined_stop(), "75 02"),
        (M::vai_predefined_go_to_after_actual_command(P), "85 02 01020304"),
        (M::vai_predefined_go_to_on_rising_trigger(P), "A5 02 01020304"),
        (M::vai_predefined_increment_target_on_rising_trigger(P), "B5 02 01020304"),
        (M::vai_predefined_go_to_on_falling_trigger(P), "C5 02 01020304"),
        (M::vai_predefined_increment_target_on_falling_trigger(P), "D5 02 01020304"),
        (M::vai_predefined_run_positive(), "E5 02"),
        (M::vai_predefined_run_negative(), "F5 02"),
        (M::stream_p(P), "05 03 01020304"),
        (M::stream_pv(P, SV), "15 03 01020304 11121314"),
        (M::stream_p_configured(P), "25 03 01020304"),
        (M::stream_pv_configured(P, SV), "35 03 01020304 11121314"),
        (M::stream_pva(P, SV, SA), "45 03 01020304 11121314 21222324"),
        (M::stream_pva_configured(P, SV, SA), "55 03 01020304 11121314 21222324"),
        (M::stream_pva_stamped(P, SV, SA), "A5 03 01020304 11121314 21222324"),
        (M::stream_end(), "F5 03"),
        (M::curve_start(CURVE), "05 04 0700"),
        (M::curve_start_from_actual(CURVE), "15 04 0700"),
        (M::curve_start_to_target(CURVE, TARGET), "25 04 0700 61626364"),
        (M::curve_start_to_target_in_time(CURVE, TARGET, TIME), "35 04 0700 61626364 51525354"),
        (M::curve_start_scaled(CURVE, P, SCALE, AMP), "45 04 0700 01020304 1F4E E1B1"),
        (M::curve_start_in_time(CURVE, P, TIME, AMP), "55 04 0700 01020304 51525354 E1B1"),
        (M::curve_start_in_time_on_rising_trigger(CURVE, P, TIME, AMP), "65 04 0700 01020304 51525354 E1B1"),
        (M::curve_start_in_time_on_falling_trigger(CURVE, P, TIME, AMP), "75 04 0700 01020304 51525354 E1B1"),
        (M::curve_start_to_target_on_rising_trigger(CURVE, TARGET), "A5 04 0700 61626364"),
        (M::curve_start_to_target_on_falling_trigger(CURVE, TARGET), "C5 04 0700 61626364"),
        (M::curve_start_to_target_in_time_on_rising_trigger(CURVE, TARGET, TIME), "E5 04 0700 61626364 51525354"),
        (M::curve_start_to_target_in_time_on_falling_trigger(CURVE, TARGET, TIME), "F5 04 0700 61626364 51525354"),
        (M::curve_modify_start_address(CURVE, OFFSET), "05 05 0700 D1D2"),
        (M::curve_modify_info_short(CURVE, OFFSET, SHORT), "15 05 0700 D1D2 E1E2"),
        (M::curve_modify_info_long(CURVE, OFFSET, LONG), "25 05 0700 D1D2 F1F2F3F4"),
        (M::curve_modify_one(CURVE, OFFSET, LONG), "45 05 0700 D1D2 F1F2F3F4"),
        (M::curve_modify_two(CURVE, OFFSET, LONG, LONG2), "55 05 0700 D1D2 F1F2F3F4 E1E2E3E4"),
        (M::curve_modify_three(CURVE, OFFSET, LONG, LONG2, LONG3), "65 05 0700 D1D2 F1F2F3F4 E1E2E3E4 D1D2D3D4"),
        (M::cam_from_actual_counts(CURVE, COUNTS), "45 06 0700 71727374"),
        (M::cam_on_rising_trigger(CURVE, COUNTS), "95 06 0700 71727374"),
        (M::cam_to_position_on_rising_trigger(CURVE, COUNTS, P, LENGTH), "A5 06 0700 71727374 01020304 81828384"),
        (M::cam_on_falling_trigger(CURVE, COUNTS), "B5 06 0700 71727374"),
        (M::cam_to_position_on_falling_trigger(CURVE, COUNTS, P, LENGTH), "C5 06 0700 71727374 01020304 81828384"),
        (M::cam_scaled_on_rising_trigger(CURVE, COUNTS, AMP, LENGTH), "D5 06 0700 71727374 E1B1 81828384"),
        (M::cam_scaled_on_falling_trigger(CURVE, COUNTS, AMP, LENGTH), "E5 06 0700 71727374 E1B1 81828384"),
        (M::indexing_070(P, V, A, D), "05 07 01020304 11121314 21222324 31323334"),
        (M::indexing_071(P), "15 07 01020304"),
        (M::indexing_07e(P, V, A, D), "E5 07 01020304 11121314 21222324 31323334"),
        (M::indexing_07f(P), "F5 07 01020304"),
        (M::vai_16bit_go_to(P16, V16, A16, D16), "05 09 0102 1112 2122 3132"),
        (M::vai_16bit_increment_demand(P16, V16, A16, D16), "15 09 0102 1112 2122 3132"),
        (M::vai_16bit_increment_target(P16, V16, A16, D16), "25 09 0102 1112 2122 3132"),
        (M::vai_16bit_go_to_from_actual(P16, V16, A16, D16), "35 09 0102 1112 2122 3132"),
        (M::vai_16bit_go_to_from_standstill(P16, V16, A16, D16), "45 09 0102 1112 2122 3132"),
        (M::vai_16bit_increment_actual(P16, V16, A16, D16), "55 09 0102 1112 2122 3132"),
        (M::vai_16bit_increment_actual_from_standstill(P16, V16, A16, D16), "65 09 0102 1112 2122 3132"),
        (M::vai_16bit_stop(D16), "75 09 3132"),
        (M::vai_16bit_go_to_after_actual_command(P16, V16, A16, D16), "85 09 0102 1112 2122 3132"),
        (M::vai_16bit_go_to_on_rising_trigger(P16, V16, A16, D16), "A5 09 0102 1112 2122 3132"),
        (M::vai_16bit_increment_target_on_rising_trigger(P16, V16, A16, D16), "B5 09 0102 1112 2122 3132"),
        (M::vai_16bit_go_to_on_falling_trigger(P16, V16, A16, D16), "C5 09 0102 1112 2122 3132"),
        (M::vai_16bit_increment_target_on_falling_trigger(P16, V16, A16, D16), "D5 09 0102 1112 2122 3132"),
        (M::vai_16bit_change_on_positive_transition(P16, V16, A16, D16), "E5 09 0102 1112 2122 3132"),
        (M::vai_16bit_change_on_negative_transition(P16, V16, A16, D16), "F5 09 0102 1112 2122 3132"),
        (M::vai_predefined_16bit_go_to(P16), "05 0A 0102"),
        (M::vai_predefined_16bit_increment_demand(P16), "15 0A 0102"),
        (M::vai_predefined_16bit_increment_target(P16), "25 0A 0102"),
        (M::vai_predefined_16bit_go_to_from_actual(P16), "35 0A 0102"),
        (M::vai_predefined_16bit_go_to_from_standstill(P16), "45 0A 0102"),
        (M::vai_predefined_16bit_stop(), "75 0A"),
        (M::vai_predefined_16bit_go_to_after_actual_command(P16), "85 0A 0102"),
        (M::vai_predefined_16bit_go_to_on_rising_trigger(P16), "A5 0A 0102"),
        (M::vai_predefined_16bit_increment_target_on_rising_trigger(P16), "B5 0A 0102"),
        (M::vai_predefined_16bit_go_to_on_falling_trigger(P16), "C5 0A 0102"),
        (M::vai_predefined_16bit_increment_target_on_falling_trigger(P16), "D5 0A 0102"),
        (M::vai_predefined_acc_go_to(P, V), "05 0B 01020304 11121314"),
        (M::vai_predefined_acc_increment_demand(P, V), "15 0B 01020304 11121314"),
        (M::vai_predefined_acc_increment_target(P, V), "25 0B 01020304 11121314"),
        (M::vai_predefined_acc_go_to_from_actual(P, V), "35 0B 01020304 11121314"),
        (M::vai_predefined_acc_go_to_from_standstill(P, V), "45 0B 01020304 11121314"),
        (M::vai_predefined_acc_go_to_after_actual_command(P, V), "85 0B 01020304 11121314"),
        (M::vai_predefined_acc_go_to_on_rising_trigger(P, V), "A5 0B 01020304 11121314"),
        (M::vai_predefined_acc_increment_target_on_rising_trigger(P, V), "B5 0B 01020304 11121314"),
        (M::vai_predefined_acc_go_to_on_falling_trigger(P, V), "C5 0B 01020304 11121314"),
        (M::vai_predefined_acc_increment_target_on_falling_trigger(P, V), "D5 0B 01020304 11121314"),
        (M::vai_dec_acc_go_to(P, V, A), "05 0C 01020304 11121314 21222324"),
        (M::vai_dec_acc_increment_demand(P, V, A), "15 0C 01020304 11121314 21222324"),
        (M::vai_dec_acc_increment_target(P, V, A), "25 0C 01020304 11121314 21222324"),
        (M::vai_dec_acc_go_to_from_actual(P, V, A), "35 0C 01020304 11121314 21222324"),
        (M::vai_dec_acc_go_to_from_standstill(P, V, A), "45 0C 01020304 11121314 21222324"),
        (M::vai_dec_acc_press(P, V, A, LIMIT), "55 0C 01020304 11121314 21222324 9192"),
        (M::vai_dec_acc_press_from_actual(P, V, A, LIMIT), "65 0C 01020304 11121314 21222324 9192"),
        (M::vai_dec_acc_press_from_standstill(P, V, A, LIMIT), "75 0C 01020304 11121314 21222324 9192"),
        (M::vai_dec_acc_go_to_after_actual_command(P, V, A), "85 0C 01020304 11121314 21222324"),
        (M::vai_dec_acc_go_to_on_rising_trigger(P, V, A), "A5 0C 01020304 11121314 21222324"),
        (M::vai_dec_acc_increment_target_on_rising_trigger(P, V, A), "B5 0C 01020304 11121314 21222324"),
        (M::vai_dec_acc_go_to_on_falling_trigger(P, V, A), "C5 0C 01020304 11121314 21222324"),
        (M::vai_dec_acc_increment_target_on_falling_trigger(P, V, A), "D5 0C 01020304 11121314 21222324"),
        (M::vai_dec_acc_run_positive(V, A), "E5 0C 11121314 21222324"),
        (M::vai_dec_acc_run_negative(V, A), "F5 0C 11121314 21222324"),
        (M::vai_increment_captured(P, V, A, D), "05 0D 01020304 11121314 21222324 31323334"),
        (M::vai_16bit_dec_acc_increment_captured(P16, V16, A16), "15 0D 0102 1112 2122"),
        (M::vai_go_to_variable_1(V, A, D), "45 0D 11121314 21222324 31323334"),
        (M::vai_go_to_variable_2(V, A, D), "55 0D 11121314 21222324 31323334"),
        (M::vai_go_to_variable_1_from_actual(V, A, D), "65 0D 11121314 21222324 31323334"),
        (M::vai_go_to_variable_2_from_actual(V, A, D), "75 0D 11121314 21222324 31323334"),
        (M::vai_increment_actual_reset_integrator(P, V, A, D), "95 0D 01020304 11121314 21222324 31323334"),
        (M::vai_start_trigger_rise(), "E5 0D"),
        (M::vai_start_trigger_fall(), "F5 0D"),
        (M::sine_va_go_to(P, V, A), "05 0E 01020304 11121314 21222324"),
        (M::sine_va_increment_demand(P, V, A), "15 0E 01020304 11121314 21222324"),
        (M::sine_va_go_to_from_actual(P, V, A), "45 0E 01020304 11121314 21222324"),
        (M::sine_va_increment_actual(P, V, A), "65 0E 01020304 11121314 21222324"),
        (M::sine_va_go_to_after_actual_command(P, V, A), "85 0E 01020304 11121314 21222324"),
        (M::sine_va_go_to_analog(V, A), "95 0E 11121314 21222324"),
        (M::sine_va_go_to_on_rising_trigger(P, V, A), "A5 0E 01020304 11121314 21222324"),
        (M::sine_va_increment_demand_on_rising_trigger(P, V, A), "B5 0E 01020304 11121314 21222324"),
        (M::sine_va_go_to_on_falling_trigger(P, V, A), "C5 0E 01020304 11121314 21222324"),
        (M::sine_va_increment_demand_on_falling_trigger(P, V, A), "D5 0E 01020304 11121314 21222324"),
        (M::bestehorn_vaj_go_to(P, V, A, J), "05 0F 01020304 11121314 21222324 41424344"),
        (M::bestehorn_vaj_increment_demand(P, V, A, J), "15 0F 01020304 11121314 21222324 41424344"),
        (M::bestehorn_vaj_go_to_from_actual(P, V, A, J), "45 0F 01020304 11121314 21222324 41424344"),
        (M::bestehorn_vaj_increment_actual(P, V, A, J), "65 0F 01020304 11121314 21222324 41424344"),
        (M::bestehorn_vaj_go_to_after_actual_command(P, V, A, J), "85 0F 01020304 11121314 21222324 41424344"),
        (M::bestehorn_vaj_go_to_analog(V, A, J), "95 0F 11121314 21222324 41424344"),
        (M::bestehorn_vaj_go_to_on_rising_trigger(P, V, A, J), "A5 0F 01020304 11121314 21222324 41424344"),
        (M::bestehorn_vaj_increment_demand_on_rising_trigger(P, V, A, J), "B5 0F 01020304 11121314 21222324 41424344"),
        (M::bestehorn_vaj_go_to_on_falling_trigger(P, V, A, J), "C5 0F 01020304 11121314 21222324 41424344"),
        (M::bestehorn_vaj_increment_demand_on_falling_trigger(P, V, A, J), "D5 0F 01020304 11121314 21222324 41424344"),
        (M::encoder_cam_enable(), "05 10"),
        (M::encoder_cam_disable(), "15 10"),
        (M::encoder_cam_go_to_sync(), "25 10"),
        (M::encoder_cam_set_counts(COUNTS), "45 10 71727374"),
        (M::encoder_cam_1_start(CURVE, COUNTS), "05 11 0700 71727374"),
        (M::encoder_cam_1_start_from_actual(CURVE, COUNTS), "15 11 0700 71727374"),
        (M::encoder_cam_1_start_to_position(CURVE, COUNTS, P), "25 11 0700 71727374 01020304"),
        (M::encoder_cam_1_start_between(CURVE, COUNTS, P, TARGET, LENGTH),
            "35 11 0700 71727374 01020304 61626364 81828384"),
        (M::encoder_cam_1_start_to_position_over(CURVE, COUNTS, P, LENGTH), "45 11 0700 71727374 01020304 81828384"),
        (M::encoder_cam_1_start_scaled(CURVE, COUNTS, AMP, LENGTH), "55 11 0700 71727374 E1B1 81828384"),
        (M::encoder_cam_1_enable(), "65 11"),
        (M::encoder_cam_1_disable(), "75 11"),
        (M::encoder_cam_1_scale(AMP, LENGTH), "85 11 E1B1 81828384"),
        (M::encoder_cam_2_start(CURVE, COUNTS), "05 12 0700 71727374"),
        (M::encoder_cam_2_start_from_actual(CURVE, COUNTS), "15 12 0700 71727374"),
        (M::encoder_cam_2_start_to_position(CURVE, COUNTS, P), "25 12 0700 71727374 01020304"),
        (M::encoder_cam_2_start_between(CURVE, COUNTS, P, TARGET, LENGTH),
            "35 12 0700 71727374 01020304 61626364 81828384"),
        (M::encoder_cam_2_start_to_position_over(CURVE, COUNTS, P, LENGTH), "45 12 0700 71727374 01020304 81828384"),
        (M::encoder_cam_2_start_scaled(CURVE, COUNTS, AMP, LENGTH), "55 12 0700 71727374 E1B1 81828384"),
        (M::encoder_cam_2_enable(), "65 12"),
        (M::encoder_cam_2_disable(), "75 12"),
        (M::encoder_cam_2_scale(AMP, LENGTH), "85 12 E1B1 81828384"),
        (M::table_start(ENTRY), "05 20 0900"),
        (M::table_start_on_rising_trigger(ENTRY), "15 20 0900"),
        (M::table_start_on_falling_trigger(ENTRY), "25 20 0900"),
        (M::table_modify_short(ENTRY, OFFSET, SHORT), "85 20 0900 D1D2 E1E2"),
        (M::table_modify_long(ENTRY, OFFSET, LONG), "95 20 0900 D1D2 F1F2F3F4"),
        (M::wait_time(WAIT), "05 21 51525354"),
        (M::wait_until_motion_finished(), "15 21"),
        (M::wait_until_in_target(), "25 21"),
        (M::wait_for_rising_trigger(), "35 21"),
        (M::wait_for_falling_trigger(), "45 21"),
        (M::wait_time_in_variable_1(), "85 21"),
        (M::wait_time_in_variable_2(), "95 21"),
        (M::wait_until_demand_position_greater(P), "05 22 01020304"),
        (M::wait_until_demand_position_less(P), "15 22 01020304"),
        (M::wait_until_actual_position_greater(P), "25 22 01020304"),
        (M::wait_until_actual_position_less(P), "35 22 01020304"),
        (M::wait_until_difference_greater(P), "45 22 01020304"),
        (M::wait_until_difference_less(P), "55 22 01020304"),
        (M::wait_until_unsigned_difference_greater(P), "65 22 01020304"),
        (M::wait_until_unsigned_difference_less(P), "75 22 01020304"),
        (M::wait_until_demand_velocity_greater(SV), "85 22 11121314"),
        (M::wait_until_demand_velocity_less(SV), "95 22 11121314"),
        (M::wait_until_actual_velocity_greater(SV), "A5 22 11121314"),
        (M::wait_until_actual_velocity_less(SV), "B5 22 11121314"),
        (M::wait_until_current_greater(I16), "E5 22 9192"),
        (M::wait_until_current_less(I16), "F5 22 9192"),
        (M::variable_1_set(LONG), "05 24 F1F2F3F4"),
        (M::variable_1_add(LONG), "15 24 F1F2F3F4"),
        (M::variable_2_set(LONG), "25 24 F1F2F3F4"),
        (M::variable_2_add(LONG), "35 24 F1F2F3F4"),
        (M::variable_1_to_upid(UPID), "85 24 C1C2"),
        (M::variable_2_to_upid(UPID), "95 24 C1C2"),
        (M::upid_to_variable_1(UPID), "C5 24 C1C2"),
        (M::upid_to_variable_2(UPID), "D5 24 C1C2"),
        (M::upid_ram_to_rom(UPID), "E5 24 C1C2"),
        (M::if_variable_1_less(LONG, YES, NO), "05 25 F1F2F3F4 0A00 FF00"),
        (M::if_variable_1_greater(LONG, YES, NO), "15 25 F1F2F3F4 0A00 FF00"),
        (M::if_variable_2_less(LONG, YES, NO), "25 25 F1F2F3F4 0A00 FF00"),
        (M::if_variable_2_greater(LONG, YES, NO), "35 25 F1F2F3F4 0A00 FF00"),
        (M::if_demand_position_less(P, YES, NO), "85 25 01020304 0A00 FF00"),
        (M::if_demand_position_greater(P, YES, NO), "95 25 01020304 0A00 FF00"),
        (M::if_actual_position_less(P, YES, NO), "A5 25 01020304 0A00 FF00"),
        (M::if_actual_position_greater(P, YES, NO), "B5 25 01020304 0A00 FF00"),
        (M::if_difference_less(P, YES, NO), "C5 25 01020304 0A00 FF00"),
        (M::if_difference_greater(P, YES, NO), "D5 25 01020304 0A00 FF00"),
        (M::if_current_less(CURRENT, YES, NO), "E5 25 91929394 0A00 FF00"),
        (M::if_current_greater(CURRENT, YES, NO), "F5 25 91929394 0A00 FF00"),
        (M::if_analog_input_less(LONG, YES, NO), "05 26 F1F2F3F4 0A00 FF00"),
        (M::if_x4_inputs_equal(MASK, BITS, YES, NO), "25 26 A1A2 B1B2 0A00 FF00"),
        (M::if_x6_inputs_equal(MASK, BITS, YES, NO), "35 26 A1A2 B1B2 0A00 FF00"),
        (M::if_status_word_equal(MASK, BITS, YES, NO), "45 26 A1A2 B1B2 0A00 FF00"),
        (M::if_warn_word_equal(MASK, BITS, YES, NO), "55 26 A1A2 B1B2 0A00 FF00"),
        (M::if_266(LONG, YES, NO), "65 26 F1F2F3F4 0A00 FF00"),
        (M::winding_304(), "45 30"),
        (M::winding_305(), "55 30"),
        (M::winding_310(NUMBER), "05 31 D1D2"),
        (M::winding_311(NUMBER, COUNTS), "15 31 D1D2 71727374"),
        (M::force_380(P, V, A, FORCE), "05 38 01020304 11121314 21222324 5152"),
        (M::force_381(P, V, A, D), "15 38 01020304 11121314 21222324 31323334"),
        (M::force_change_target(FORCE), "25 38 5152"),
        (M::force_383(P, V, A, FORCE, FORCE2), "35 38 01020304 11121314 21222324 5152 6162"),
        (M::force_384(P, V, A, FORCE), "45 38 01020304 11121314 21222324 5152"),
        (M::force_385(P, V, A, FORCE, FORCE2), "55 38 01020304 11121314 21222324 5152 6162"),
        (M::force_386(P, V, A, D), "65 38 01020304 11121314 21222324 31323334"),
        (M::force_387(P, V, A, D), "75 38 01020304 11121314 21222324 31323334"),
        (M::force_increment_actual_higher_limit(P, V, A, FORCE, FORCE2), "85 38 01020304 11121314 21222324 5152 6162"),
        (M::force_increment_actual_lower_limit(P, V, A, FORCE, FORCE2), "95 38 01020304 11121314 21222324 5152 6162"),
        (M::current_mode(CURRENT), "05 39 91929394"),
        (M::position_mode(), "F5 39"),
        (M::vaji_go_to(P, V, A, D, J), "05 3A 01020304 11121314 21222324 31323334 41424344"),
        (M::vaji_increment_demand(P, V, A, D, J), "15 3A 01020304 11121314 21222324 31323334 41424344"),
    ]
}

const fn limited<T: Copy>(value: Result<T, RangeError>) -> T {
    match value {
        Ok(value) => value,
        Err(_) => panic!("the value is in its range"),
    }
}

/// LinUDP V2 manual: VAI go to 10 mm with 1 m/s and 10 m/s2, count 0.
#[test]
fn golden_example_of_the_manual() {
    let ramp = Acceleration::from_mm_per_s2(10_000.0).unwrap();
    let velocity = Velocity::from_mm_per_s(1_000.0).unwrap();
    let command = M::vai_go_to(Position::from_mm(10.0).unwrap(), velocity, ramp, ramp);
    check(&command, 0, "00 01 A0 86 01 00 40 42 0F 00 40 42 0F 00 40 42 0F 00");
}

#[test]
fn every_command_of_the_catalogue_has_its_bytes() {
    let vectors = vectors();
    for (command, golden) in &vectors {
        check(command, 5, golden);
        // The catalogue reads the same values from the same places, and writes them there.
        let info = CommandInfo::of(command.id).unwrap();
        assert_eq!(2 * (info.size() + 2), digits(golden).len(), "{}", info.name);
        assert_eq!(info.command(&info.values(&command.parameters)), Ok(*command), "{}", info.name);
    }
    let covered: Vec<u16> = vectors.iter().map(|(command, _)| command.id).collect();
    let known: Vec<u16> = CATALOGUE.iter().map(|info| info.id).collect();
    assert_eq!(covered, known);
}

fn digits(golden: &str) -> String {
    golden.replace(' ', "")
}

fn check(command: &MotionCommand, count: u8, golden: &str) {
    let block = command.block(count);
    let bytes = [&block.header.to_le_bytes()[..], &block.parameters].concat();
    let written: String = bytes.iter().map(|byte| format!("{byte:02X}")).collect();
    assert_eq!(written, format!("{:0<64}", digits(golden)), "{:03X}", command.id);
}
