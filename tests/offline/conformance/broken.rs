//! The clauses can fail: each defect of the toy is caught by the clause that is about it, and so is what only a bus of
//! connections, or one of one frame for all, can get wrong.

use std::panic::{AssertUnwindSafe, catch_unwind};

use crate::conformance::subject::Subject;
use crate::conformance::subjects::ethercat::{Defect as LineDefect, EtherCat, slaves};
use crate::conformance::subjects::modbus::{Defect as StreamDefect, Modbus};
use crate::conformance::subjects::toy::{Defect, Toy, ToyWire};
use crate::conformance::{
    acyclic, exchanges, half_duplex, neighbours, orders, own_clock, replies, reports, whole,
};

type Clause = fn(&'static dyn Subject);

const CAUGHT: [(Defect, Clause); 13] = [
    (Defect::SendsWhatIsNotDue, exchanges::nothing_is_sent_for_a_slot_that_is_not_due),
    (Defect::ForgetsARefusedSend, exchanges::a_refused_send_opens_nothing_and_is_made_up_for),
    (
        Defect::MatchesAnyReply,
        replies::a_late_reply_that_comes_first_in_the_next_window_is_not_taken_for_the_newest,
    ),
    (Defect::CountsLateTwice, replies::a_reply_between_two_windows_is_late_and_its_exchange_a_miss),
    (Defect::ReadsDuplicates, replies::a_reply_of_before_that_comes_again_moves_nothing),
    (Defect::OpensTheWindowForEver, exchanges::a_window_is_open_for_what_it_owes_and_for_nothing_else),
    (Defect::SharesItsMisses, neighbours::the_silence_of_one_troubles_no_other),
    (Defect::WritesBeforeTheFirstOrder, orders::a_drive_found_running_runs_on_until_the_first_order),
    (Defect::IgnoresStops, whole::the_stop_request_is_on_the_wire_within_its_bound),
    (Defect::ForgetsRestarts, reports::a_restart_is_noticed_once_and_what_was_known_is_forgotten),
    (Defect::ScalesWrongly, reports::velocity_is_the_way_made_in_user_units_a_second),
    (Defect::BuildsAnewEachTime, exchanges::a_request_that_is_built_again_is_the_same_to_the_byte),
    (Defect::ForgetsItsCalls, acyclic::a_drive_that_is_not_there_is_told_of_at_once),
];

const CAUGHT_BY_ITS_OWN_CLOCK: [(Defect, Clause); 5] = [
    (
        Defect::ClaimsWhatItDidNotSend,
        orders::an_order_is_not_done_by_what_was_heard_before_the_one_it_replaces,
    ),
    (Defect::IsFreshWithEachExchange, reports::each_answer_is_fresh_once_and_silence_is_not),
    (Defect::IsNeverTooOld, own_clock::exchanges_are_missed_once_the_newest_packet_is_too_old),
    (Defect::TakesOlderPackets, own_clock::only_the_newest_of_several_packets_counts),
    (Defect::IsProbed, own_clock::requests_go_at_the_agreed_rate_whatever_the_link),
];

const CAUGHT_ON_A_HALF_DUPLEX_WIRE: [(Defect, Clause); 5] = [
    (Defect::SendsOutOfTurn, half_duplex::one_request_is_on_the_wire_at_a_time),
    (Defect::GivesUpItsTurn, half_duplex::what_waits_for_its_turn_is_neither_unsent_nor_missed),
    (Defect::KeepsTheOldRequest, half_duplex::a_request_that_waits_is_built_anew_until_it_leaves),
    (Defect::IsNotPolled, half_duplex::a_reply_that_is_overdue_lets_the_next_request_go_in_the_same_window),
    (Defect::WaitsForEver, neighbours::the_silence_of_one_troubles_no_other),
];

const CAUGHT_ON_STREAMS: [(StreamDefect, Clause); 5] = [
    (
        StreamDefect::NeverGivesUp,
        exchanges::what_is_not_answered_in_its_window_is_open_until_the_loop_calls_it_missed,
    ),
    (StreamDefect::AsksTwice, exchanges::each_due_slot_is_one_request_and_one_exchange),
    (StreamDefect::BeginsAgain, exchanges::a_request_that_the_wire_takes_in_pieces_is_heard_once_and_whole),
    (StreamDefect::GivesUpAll, replies::no_bytes_whatever_upset_it),
    (StreamDefect::TrustsCounts, replies::no_bytes_whatever_upset_it),
];

const CAUGHT_ON_LINES: [(LineDefect, Clause); 5] = [
    (LineDefect::GivesAnothersInputs, reports::a_report_is_what_the_drive_said_in_user_units),
    (LineDefect::GivesAnothersOutputs, orders::each_verb_ends_in_what_it_says),
    (LineDefect::CountsTheMissing, exchanges::a_window_is_open_for_what_it_owes_and_for_nothing_else),
    (LineDefect::MissesAllWithOne, neighbours::the_silence_of_one_troubles_no_other),
    (LineDefect::IsAFrameBehind, replies::a_clean_wire_answers_everything),
];

fn is_caught(subject: Box<dyn Subject>, clause: Clause) -> bool {
    let subject: &'static dyn Subject = Box::leak(subject);
    catch_unwind(AssertUnwindSafe(|| clause(subject))).is_err()
}

#[test]
fn each_defect_of_the_toy_is_caught_by_the_clause_that_is_about_it() {
    let wires = [
        (ToyWire::Later, &CAUGHT[..]),
        (ToyWire::OwnClock, &CAUGHT_BY_ITS_OWN_CLOCK),
        (ToyWire::HalfDuplex, &CAUGHT_ON_A_HALF_DUPLEX_WIRE),
    ];
    for (wire, caught) in wires {
        for (defect, clause) in caught {
            assert!(is_caught(Box::new(Toy(wire, Some(*defect))), *clause), "{defect:?} went unnoticed");
        }
    }
}

#[test]
fn what_only_a_bus_of_one_frame_for_all_gets_wrong_is_caught_as_well() {
    for (defect, clause) in CAUGHT_ON_LINES {
        for positions in [false, true] {
            let subject = EtherCat { positions, slaves: slaves::PLAIN, defect: Some(defect) };
            assert!(
                is_caught(Box::new(subject), clause),
                "{defect:?} went unnoticed, positions: {positions}"
            );
        }
    }
}

#[test]
fn what_only_a_bus_of_connections_gets_wrong_is_caught_as_well() {
    for (defect, clause) in CAUGHT_ON_STREAMS {
        for direct in [false, true] {
            let subject = Modbus { direct, defect: Some(defect) };
            assert!(is_caught(Box::new(subject), clause), "{defect:?} went unnoticed, direct: {direct}");
        }
    }
}
