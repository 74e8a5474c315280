use super::*;

#[test]
fn a_watchdog_shorter_than_the_silence_between_two_requests_is_a_fault() {
    let mut drive = UnidriveDrive::new("u", [192, 168, 1, 21].into());
    let keys = |drive: &UnidriveDrive, period_ns| {
        drive.faults(period_ns).into_iter().map(|fault| fault.key).collect::<Vec<_>>()
    };
    drive.watchdog.timeout_ns = Some(100 * MS);
    drive.reply_within_ns = 80 * MS;
    assert_eq!(keys(&drive, 20 * MS), [""; 0], "what a reply may take, and a period");
    assert_eq!(keys(&drive, 21 * MS), ["watchdog.timeout"]);
    drive.reply_within_ns = 10 * MS;
    assert_eq!(keys(&drive, 50 * MS), [""; 0], "twice a period");
    assert_eq!(keys(&drive, 51 * MS), ["watchdog.timeout"]);
    assert_eq!(keys(&drive, MS), [""; 0]);
    drive.watchdog.keypad = true;
    assert_eq!(keys(&drive, 20 * MS), ["watchdog.keypad"]);
    // In menu 0 control word and reference are one block, which is written with every request.
    drive.via = Via::Menu0 { first: 1 };
    assert_eq!(keys(&drive, 20 * MS), [""; 0]);
}

/// A reply counts for longer than TCP needs to repeat a lost frame, unless the watchdog must be shorter.
#[test]
fn the_usual_time_of_a_reply_follows_the_watchdog() {
    let usual = |timeout_ms: Option<u64>, period_ms: u64| {
        let timeout_ns = timeout_ms.map(|ms| ms * MS);
        let mut drive = UnidriveDrive::new("u", [192, 168, 1, 21].into());
        drive.watchdog.timeout_ns = timeout_ns;
        drive.reply_within_ns = UnidriveDrive::usual_reply_within(&drive.watchdog, period_ms * MS);
        assert_eq!(drive.faults(period_ms * MS), [], "{timeout_ms:?}, {period_ms}");
        (drive.reply_within_ns / MS, drive.describe_loss(period_ms * MS))
    };
    for (timeout_ms, period_ms, within_ms) in
        [(None, 8, 250), (Some(500), 8, 250), (Some(266), 8, 250), (Some(265), 8, 249), (Some(226), 8, 210)]
    {
        let (ms, line) = usual(timeout_ms, period_ms);
        assert_eq!(ms, within_ms, "{timeout_ms:?}");
        assert!(line.contains("the link stays up") && line.contains("leaves 218 ms later"), "{line}");
    }
    for (timeout_ms, period_ms, within_ms, costs) in [
        (
            225,
            8,
            209,
            "reply_within from 210 ms on would wait for it, with a watchdog.timeout from 226 ms on",
        ),
        (225, 8, 209, "one lost frame costs 1 exchange"),
        (170, 8, 154, "one lost frame costs the link"),
        (100, 50, 50, "one lost frame costs the link"),
        (40, 1, 38, "one lost frame costs the link"),
    ] {
        let (ms, line) = usual(Some(timeout_ms), period_ms);
        assert_eq!(ms, within_ms, "{timeout_ms}");
        assert!(line.contains(costs), "{line}");
    }
}
