//! What every `Bus` must do, whatever its protocol: the contract in `core/bus/contract.rs`, clause by clause.
//!
//! | file | what |
//! |---|---|
//! | `subject` | what a protocol brings along; nothing else in here knows one |
//! | `subjects/` | the protocols, a file each; and EtherCAT slaves with one oddity each, the rows |
//! | `line`, `rules` | one bus alone: the clause plays the loop by hand, the referee looks at every call |
//! | `machine` | the whole loop over the same bus |
//! | `wire` | what goes over the wire, written down |
//! | `opening`, `exchanges`, `replies`, `neighbours`, `orders`, `reports` | clauses of a bus alone |
//! | `own_clock`, `half_duplex` | clauses of these two wires alone |
//! | `acyclic` | clauses of acyclic access, under the loop |
//! | `whole` | clauses of a bus under the loop |
//!
//! A new protocol is one file in `subjects/` and one line in `subjects!` below. A failure reads
//! `linudp::replies::a_duplicate_is_counted_and_answers_nothing`: subject, chapter, clause. What means nothing for a
//! subject is said on standard error and never passed over in silence.

mod acyclic;
mod exchanges;
mod half_duplex;
mod line;
mod machine;
mod neighbours;
mod opening;
mod orders;
mod own_clock;
mod replies;
mod reports;
mod rules;
mod subject;
mod subjects;
mod whole;
mod wire;

/// The clauses by chapter, each as a test of the subject at hand.
macro_rules! clauses {
    () => {
        clauses! {
            opening::{
                a_plan_lists_its_drives_in_slot_order,
                open_sends_nothing,
                a_bus_that_cannot_be_opened_is_an_error_with_its_name_and_a_remedy,
                the_native_end_of_each_drive_is_given_once,
                the_memory_that_it_names_stays_where_it_is,
            },
            exchanges::{
                a_slot_that_is_not_due_sends_no_request,
                each_due_slot_is_one_request_and_one_exchange,
                a_request_that_is_built_again_is_the_same_to_the_byte,
                only_the_command_of_the_last_build_is_carried_out,
                receive_never_waits,
                a_window_is_open_for_what_it_owes_and_for_nothing_else,
                an_exchange_still_owed_is_not_sent_again,
                an_exchange_without_reply_in_its_window_is_open_until_the_loop_marks_it_missed,
                a_flood_is_received_in_bounded_parts,
                a_cycle_that_begins_late_ends_when_it_always_does,
                a_refused_send_opens_nothing_and_is_made_up_for,
                a_request_sent_in_pieces_is_received_once_and_whole,
                the_end_comes_and_leaves_nothing_owed,
            },
            replies::{
                a_clean_wire_answers_everything,
                the_reply_after_a_miss_is_suspect_unless_it_names_its_request,
                a_reply_between_two_windows_is_late_and_its_exchange_a_miss,
                a_late_reply_that_comes_first_in_the_next_window_is_not_taken_for_the_newest,
                a_late_reply_next_to_the_requested_one_keeps_the_newer_values,
                replies_that_are_always_one_exchange_behind_are_never_taken_for_fresh_ones,
                a_duplicate_is_counted_and_answers_nothing,
                a_reply_of_before_that_comes_again_moves_nothing,
                a_reply_that_was_overtaken_is_late,
                a_reply_of_no_known_form_is_malformed,
                an_answer_without_request_is_foreign,
                a_frame_that_circulated_is_no_answer,
                a_true_answer_from_a_wrong_port_is_foreign,
                a_telegram_of_an_unknown_sender_is_foreign,
                no_bytes_cause_a_panic,
                the_counters_add_up_under_random_faults,
            },
            neighbours::{
                the_silence_of_one_troubles_no_other,
                the_absence_of_one_troubles_no_other,
                the_garbage_of_one_troubles_no_other,
                replies_of_one_that_come_twice_or_late_trouble_no_other,
                refused_sends_to_one_trouble_no_other,
                restarts_of_one_trouble_no_other,
                orders_to_one_trouble_no_other,
            },
            orders::{
                a_drive_that_got_no_order_stays_as_it_was_found,
                a_drive_found_running_runs_on_until_the_first_order,
                an_order_without_a_verb_keeps_the_state_of_the_drive,
                a_drive_found_running_is_taken_over_and_stopped_with_its_power_on,
                each_verb_ends_in_what_it_says,
                a_command_is_carried_out_once_and_its_end_stays_reported,
                a_move_keeps_to_its_profile_in_user_units,
                a_new_order_replaces_the_one_before_it,
                unsupported_commands_are_refused_by_name_at_once,
                native_mode_is_refused_by_name_or_moves_nothing_by_itself,
                a_stop_from_every_motion_brings_standstill_with_power_on,
                a_stop_ends_at_standstill_however_fast_the_motion_was,
                a_stop_ramps_down_with_the_given_deceleration,
                a_stop_at_standstill_or_without_power_changes_nothing,
                an_enable_that_is_stopped_half_way_does_not_go_on_by_itself,
                a_command_is_not_done_by_reports_from_before_the_one_it_replaces,
                a_stop_behind_a_disable_that_never_arrived_ends_at_standstill,
                disable_powers_off_from_every_motion,
                rows_are_followed_in_order_to_the_last,
                a_jog_goes_on_until_it_is_replaced,
                a_velocity_is_followed_wherever_it_goes,
                commands_not_checked_on_submission_keep_to_the_position_limits,
                orders_survive_exchanges_that_are_missed,
                a_stop_reaches_a_drive_whose_replies_are_lost,
                the_request_after_an_order_carries_it,
                orders_with_a_time_limit_end_even_if_nobody_answers,
                an_enable_that_timed_out_does_not_come_up_later,
                a_motion_whose_drive_restarts_fails_and_is_not_taken_up_again,
                a_fault_of_the_drive_ends_its_orders_and_is_reset_to_power_off,
                slots_that_are_passed_over_lose_no_order_and_no_row,
                every_command_in_every_state_ends_or_goes_on,
            },
            reports::{
                a_report_is_what_the_drive_said_in_user_units,
                velocity_is_the_way_made_in_user_units_a_second,
                each_answer_is_fresh_once_and_silence_is_not,
                a_restart_is_noticed_once_and_what_was_known_is_forgotten,
                homed_is_what_the_drive_says_after_a_restart_too,
            },
            own_clock::{
                exchanges_are_missed_once_the_newest_packet_is_too_old,
                only_the_newest_of_several_packets_counts,
                a_packet_between_two_exchanges_is_reported_at_once,
                requests_go_at_the_agreed_rate_whatever_the_link,
            },
            half_duplex::{
                one_request_is_on_the_wire_at_a_time,
                a_queued_exchange_is_neither_unsent_nor_missed,
                a_request_that_waits_is_built_anew_until_it_leaves,
                a_reply_that_is_overdue_lets_the_next_request_go_in_the_same_window,
                a_request_has_its_own_stamp_whenever_it_leaves,
            },
            acyclic::{
                a_value_that_was_written_is_read_back,
                a_call_refused_by_the_drive_ends_with_its_status,
                the_first_that_fails_ends_its_series,
                a_missing_drive_is_reported_at_once,
                the_queue_is_bounded_and_nothing_in_it_is_lost,
                a_cancelled_call_ends_as_cancelled_and_frees_the_queue,
                calls_add_no_request_and_move_no_cycle,
                the_end_of_the_master_ends_what_is_under_way,
            },
            whole::{
                good_exchanges_in_a_row_bring_the_link_up,
                unseen_and_lost_drives_are_probed_once_per_interval,
                the_stop_request_is_on_the_wire_within_its_bound,
                divisor_and_phase_choose_the_slots,
                one_lost_drive_leaves_the_others_untouched,
                a_lost_drive_comes_back_by_the_application_only_and_homed_is_read_again,
                a_restart_in_mid_motion_ends_latched_and_nothing_moves_by_itself,
                a_restart_that_nothing_else_shows_brings_no_power_back,
                found_running_is_stopped_or_left_alone_as_its_plan_says,
                a_fault_of_the_drive_latches_its_axis,
                the_same_seed_is_the_same_run_to_the_byte,
                a_prepared_request_that_does_not_leave_has_no_effect,
                the_end_of_the_master_leaves_every_drive_at_standstill_and_off,
                a_grid_with_skipped_slots_owes_nothing_for_them,
            },
        }
    };
    ($($chapter:ident::{$($clause:ident),* $(,)?}),* $(,)?) => {
        $(mod $chapter {
            $(#[test]
            fn $clause() {
                crate::conformance::$chapter::$clause(super::SUBJECT);
            })*
        })*
    };
}

/// A module for each kind of slaves that has one oddity: the clauses of bring-up, operation, stop, acyclic access and
/// the end, and whether the oddity was met at all.
macro_rules! rows {
    ($($name:ident: $row:ident,)*) => {
        mod ethercat_rows {
            use crate::conformance::subjects::ethercat::{EtherCat, rows, slaves::Slaves};

            $(mod $name {
                use super::{EtherCat, Slaves, rows};

                const SLAVES: Slaves = Slaves { name: stringify!($name), ..rows::$row.slaves };
                const SUBJECT: &dyn crate::conformance::subject::Subject =
                    &EtherCat { positions: true, slaves: SLAVES };

                clauses! {
                    exchanges::{the_end_comes_and_leaves_nothing_owed},
                    orders::{each_verb_ends_in_what_it_says},
                    acyclic::{a_value_that_was_written_is_read_back},
                    whole::{
                        good_exchanges_in_a_row_bring_the_link_up,
                        the_stop_request_is_on_the_wire_within_its_bound,
                    },
                }

                #[test]
                fn it_was_met() {
                    rows::$row.is_met(SUBJECT);
                }
            })*
        }
    };
}

/// A module of tests for each subject.
macro_rules! subjects {
    ($($name:ident: $subject:expr,)*) => {
        $(mod $name {
            const SUBJECT: &dyn crate::conformance::subject::Subject = &$subject;
            clauses!();
        })*
    };
}

subjects! {
    linudp: crate::conformance::subjects::linudp::LinUdp { reply_tag: fieldbeat::bus::linudp::ReplyTag::Definition },
    linudp_counted: crate::conformance::subjects::linudp::LinUdp { reply_tag: fieldbeat::bus::linudp::ReplyTag::Count },
    linudp_untagged: crate::conformance::subjects::linudp::LinUdp { reply_tag: fieldbeat::bus::linudp::ReplyTag::Off },
    modbus_menu_0: crate::conformance::subjects::modbus::Modbus { direct: false },
    modbus_direct: crate::conformance::subjects::modbus::Modbus { direct: true },
    ethercat_velocity: crate::conformance::subjects::ethercat::EtherCat {
        positions: false, slaves: crate::conformance::subjects::ethercat::slaves::PLAIN
    },
    ethercat_position: crate::conformance::subjects::ethercat::EtherCat {
        positions: true, slaves: crate::conformance::subjects::ethercat::slaves::PLAIN
    },
    ethercat_strict: crate::conformance::subjects::ethercat::EtherCat {
        positions: true, slaves: crate::conformance::subjects::ethercat::slaves::STRICT
    },
    ethercat_terminals: crate::conformance::subjects::ethercat::EtherCat {
        positions: false, slaves: crate::conformance::subjects::ethercat::slaves::TERMINALS
    },
    ethernet_ip: crate::conformance::subjects::ethernet_ip::EthernetIp { multicast: false },
    ethernet_ip_multicast: crate::conformance::subjects::ethernet_ip::EthernetIp { multicast: true },
    profibus_drivecom: crate::conformance::subjects::profibus::Profibus { profidrive: false },
    profibus_profidrive: crate::conformance::subjects::profibus::Profibus { profidrive: true },
}

rows! {
    device_emulation: DEVICE_EMULATION,
    exact_sync_managers: EXACT_SYNC_MANAGERS,
    two_sync_managers_a_direction: TWO_SYNC_MANAGERS,
    sii_of_its_processor: SII_OF_ITS_PROCESSOR,
    sii_of_four_bytes_a_read: SII_OF_FOUR_BYTES,
    sii_of_eight_bytes_a_read: SII_OF_EIGHT_BYTES,
    sii_with_a_wrong_checksum: SII_WITH_A_WRONG_CHECKSUM,
    sii_of_noise: SII_OF_NOISE,
    sii_that_returns_another_address: SII_OF_ANOTHER_ADDRESS,
    sii_with_failing_reads: SII_WITH_FAILING_READS,
    sii_that_is_not_loaded: SII_THAT_IS_NOT_LOADED,
    slow_sii: SLOW_SII,
    digital_terminals_of_2_bits: DIGITAL_2,
    digital_terminals_of_4_bits: DIGITAL_4,
    digital_terminals_of_8_bits: DIGITAL_8,
    digital_terminals_of_16_bits: DIGITAL_16,
    no_fmmu_to_spare: NO_FMMU_TO_SPARE,
    too_few_fmmus: TOO_FEW_FMMUS,
    clocks_of_32_bits: CLOCKS_OF_32_BITS,
    no_clocks: NO_CLOCKS,
    branch: BRANCH,
    slow_mailbox: SLOW_MAILBOX,
    lost_answers: LOST_ANSWERS,
    repeat_that_is_acknowledged_only: REPEAT_ACKNOWLEDGED_ONLY,
    cycle_time_that_is_read_only: CYCLE_TIME_READ_ONLY,
    no_optional_objects: WITHOUT_OPTIONAL_OBJECTS,
}
