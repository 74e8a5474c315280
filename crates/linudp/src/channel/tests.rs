//! Counts and their echoes, without a telegram.

use super::*;
use crate::motion::Acceleration;

const STOP: MotionCommand = MotionCommand::vai_stop(Acceleration(1));

/// A channel whose first clean reply had this count.
fn agreed(count: u8) -> MotionChannel {
    let mut channel = MotionChannel::default();
    channel.take(count, true, false).unwrap();
    channel
}

/// The same, and a stop has gone out under the next count.
fn commanded(count: u8) -> MotionChannel {
    let mut channel = agreed(count);
    channel.send(STOP);
    channel.sent();
    channel
}

fn count(channel: &MotionChannel) -> Option<u16> {
    channel.block().map(|block| block.header & 0xF)
}

/// Whether the command is accepted after replies with these counts.
fn after(channel: &mut MotionChannel, echoes: &[u8]) -> bool {
    for echo in echoes {
        channel.take(*echo, true, false).unwrap();
    }
    channel.is_accepted()
}

#[test]
fn an_older_count_is_no_news() {
    let mut channel = agreed(3);
    for expected in [4, 5] {
        channel.send(STOP);
        channel.sent();
        assert!(after(&mut channel, &[expected, expected]));
        channel.clear();
        // A reply of before the command, in all respects like a clean one: the count after its own is the one that the
        // drive has stored.
        channel.take(expected - 1, true, false).unwrap();
    }
    channel.send(STOP);
    assert_eq!(count(&channel), Some(6));
}

#[test]
fn no_command_gets_the_count_that_the_drive_has() {
    // An old request was delivered again, and the drive has stored its count: sixteen commands ago it was 4.
    let mut channel = agreed(3);
    channel.take(4, true, false).unwrap();
    channel.send(STOP);
    assert_eq!(count(&channel), Some(5));
    // The same, but seen only after the count was chosen, and before the command left.
    channel.take(5, false, false).unwrap();
    assert_eq!(count(&channel), Some(6));
    assert!(!channel.is_accepted());
}

#[test]
fn only_a_clean_reply_to_a_request_with_the_command_is_its_echo() {
    let mut channel = commanded(3);
    channel.take(4, false, false).unwrap();
    assert!(!channel.is_accepted());
    channel.take(4, true, false).unwrap();
    assert!(channel.is_accepted() && channel.is_settled());
    assert_eq!(count(&channel), None);
}

#[test]
fn a_command_that_another_one_has_replaced_is_repeated_with_its_count() {
    let mut channel = commanded(3);
    assert!(!after(&mut channel, &[4, 2]), "an old request, or an old reply, was delivered once more");
    assert_eq!((channel.is_accepted(), channel.is_settled(), count(&channel)), (false, false, Some(4)));
    assert!(after(&mut channel, &[4]));
    assert_eq!(count(&channel), None);
    // What has replaced it stays.
    assert!(!after(&mut channel, &[2; 5]));
    assert_eq!(count(&channel), Some(4));
    assert!(!after(&mut channel, &[2]));
    assert_eq!(count(&channel), Some(5));
}

#[test]
fn old_replies_take_no_command_away_however_many_they_are() {
    let mut channel = commanded(3);
    for _ in 0..100 {
        assert!(after(&mut channel, &[4, 2, 4, 2, 2, 4, 4]));
    }
    assert_eq!(channel.count, Some(4));
}

#[test]
fn two_masters_that_take_turns_end_the_command() {
    let mut channel = commanded(3);
    let fight = (0..8).map(|_| channel.take(4, true, false).and_then(|()| channel.take(12, true, false)));
    assert_eq!(fight.collect::<Result<Vec<()>, _>>(), Err(Failure::NotTaken));
    assert_eq!(count(&channel), None);
}

#[test]
fn a_motion_of_another_master_is_answered_by_a_stop_alone() {
    let foreign = |command: MotionCommand| {
        let mut channel = agreed(3);
        channel.send(command);
        channel.sent();
        channel.take(4, true, false).unwrap();
        channel.take(12, true, true).unwrap();
        assert!(!channel.is_accepted());
        count(&channel)
    };
    assert_eq!(foreign(STOP), Some(4));
    assert_eq!(foreign(MotionCommand::stream_end()), None);
}
