//! `[soak]`: how axes move of which nothing is said, and moves that their limits refuse.

use fieldbeat_config::soak::{Criteria, Pattern, SoakPlan};

use super::{mistakes, read_all};

/// A LinMot within limits, one without, a Unidrive within and one without; `soak` begins in line 29.
pub fn machine(soak: &str) -> String {
    format!("{}{soak}\n", include_str!("limits.toml"))
}

fn soak(text: &str) -> SoakPlan {
    read_all(&machine(text)).soak
}

#[test]
fn what_is_not_said_stays_inside_the_limits_or_still() {
    let plan = soak("");
    let pattern = |name: &str| plan.axes.iter().find(|axis| axis.name == name).unwrap().pattern.clone();
    let Pattern::Moves { targets, profile, pause_ns } = pattern("x") else { panic!("{plan:?}") };
    assert_eq!((targets, profile.velocity, pause_ns), (vec![180.0, 220.0], 100.0, 500_000_000));
    assert_eq!(pattern("y"), Pattern::Still("it has no limits.position; give it targets".into()));
    assert_eq!(pattern("u"), Pattern::Velocities { velocities: vec![2.0, -2.0], hold_ns: 2_000_000_000 });
    assert_eq!(pattern("v"), Pattern::Still("it has no limits.velocity; give it velocities".into()));
    assert_eq!(plan.criteria, Criteria::default());
}

#[test]
fn what_is_said_counts_and_the_rest_keeps_its_default() {
    let plan = soak(
        r#"[[soak.axis]]
drive = "x"
velocity = 250
pause = "0s"
following_error = 2
[[soak.axis]]
drive = "u"
hold = "5s"
[[soak.axis]]
drive = "v"
velocities = [1, 0, -1]
[[soak.axis]]
drive = "y"
move = false
[soak.criteria]
late_share = 0.5
warm_up = "1h"
"#,
    );
    let Pattern::Moves { targets, profile, pause_ns } = &plan.axes[0].pattern else { panic!("{plan:?}") };
    assert_eq!((&targets[..], profile.velocity, *pause_ns), (&[180.0, 220.0][..], 250.0, 0));
    assert_eq!(plan.axes[0].following_error, Some(2.0));
    assert_eq!(plan.axes[1].pattern, Pattern::Still("move = false".into()));
    assert_eq!(
        plan.axes[2].pattern,
        Pattern::Velocities { velocities: vec![2.0, -2.0], hold_ns: 5_000_000_000 }
    );
    let turning = Pattern::Velocities { velocities: vec![1.0, 0.0, -1.0], hold_ns: 2_000_000_000 };
    assert_eq!(plan.axes[3].pattern, turning);
    let expected = Criteria { late_share: 0.5, warm_up_ns: 3_600_000_000_000, ..Criteria::default() };
    assert_eq!(plan.criteria, expected);
}

#[test]
fn velocities_need_a_dead_man_time_that_outlasts_their_renewals() {
    let machine = |dead_man: &str, soak: &str| {
        let key = format!("address = \"127.0.0.20\"\njog_deadman = \"{dead_man}\"");
        machine(soak).replacen("address = \"127.0.0.20\"", &key, 1)
    };
    let why = "its jog_deadman of 299 ms is too short, since a velocity is renewed each 100 ms: make it 300 \
         ms or more";
    let usual = read_all(&machine("299ms", "")).soak;
    assert_eq!(usual.axes[2].pattern, Pattern::Still(why.into()));
    let given = "[[soak.axis]]\ndrive = \"u\"\nvelocities = [1]";
    let refused = mistakes(&machine("299ms", given));
    assert_eq!(refused, [format!("m.toml:32: soak.axis.velocities = [1]: {why}")]);
    for long in ["300ms", "off"] {
        let pattern = read_all(&machine(long, given)).soak.axes[2].pattern.clone();
        assert!(matches!(pattern, Pattern::Velocities { .. }), "{long}: {pattern:?}");
    }
}
