use super::*;
use fieldbeat_core::time::MS;
use proptest::prelude::*;

/// More than any motion of the ranges below lasts.
const LONG: u64 = 100_000 * S;

fn limits() -> impl Strategy<Value = (f64, f64, f64)> {
    (1.0..2_000.0, 10.0..50_000.0, 10.0..50_000.0)
}

#[test]
fn a_given_demand_stands_until_halt() {
    let mut g = Generator::at(0.0);
    g.set(3.0, 4.0, 5.0);
    g.advance(S);
    assert_eq!((g.position(), g.velocity(), g.acceleration(), g.is_moving()), (3.0, 4.0, 5.0, true));
    g.set(f64::NAN, 0.0, 0.0);
    g.go_to(f64::INFINITY, 1.0, 1.0, 1.0);
    assert_eq!(g.position(), 3.0);
    g.halt();
    assert_eq!((g.position(), g.velocity(), g.acceleration(), g.is_moving()), (3.0, 0.0, 0.0, false));
}

#[test]
fn the_same_target_again_while_braking_changes_nothing() {
    let mut g = Generator::at(0.0);
    g.go_to(100.0, 100.0, 1000.0, 500.0);
    g.advance(1_000 * MS);
    for _ in 0..150 {
        g.go_to(100.0, 100.0, 1000.0, 500.0);
        g.advance(MS);
        assert!((g.acceleration() + 500.0).abs() < 1e-3 || !g.is_moving(), "{g:?}");
        assert!(g.position() <= 100.0);
    }
    assert_eq!((g.position(), g.is_moving()), (100.0, false));
}

proptest! {
    #[test]
    fn stays_continuous_when_replaced_in_motion(
        moves in prop::collection::vec((0..4u8, -100.0..100.0f64, limits(), 1..500u64), 1..30),
    ) {
        let mut g = Generator::at(0.0);
        let (mut fastest, mut hardest) = (0.0f64, 0.0f64);
        for (kind, target, (v, a, d), ms) in moves {
            let before = (g.position(), g.velocity());
            match kind {
                0 => g.run(v.copysign(target), a),
                1 => g.brake(d),
                _ => g.go_to(target, v, a, d),
            }
            prop_assert_eq!((g.position(), g.velocity()), before);
            fastest = fastest.max(v);
            hardest = hardest.max(a).max(d);
            for _ in 0..ms {
                let from = g.clone();
                g.advance(MS);
                let (slack, dt) = (1.0 + 1e-6, 1e-3);
                prop_assert!(g.velocity().abs() <= fastest * slack);
                prop_assert!((g.velocity() - from.velocity()).abs() <= hardest * dt * slack);
                let mean = (g.velocity() + from.velocity()) / 2.0 * dt;
                // At most a triangle of acceleration between the two ends differs from the mean.
                prop_assert!((g.position() - from.position() - mean).abs() <= hardest * dt * dt / 2.0 + 1e-9);
            }
        }
        g.go_to(7.0, 100.0, 1000.0, 1000.0);
        g.advance(LONG);
        prop_assert_eq!((g.position(), g.velocity(), g.is_moving()), (7.0, 0.0, false));
    }

    #[test]
    fn the_mass_follows_and_settles_at_any_step(
        target in -0.9..0.9f64, step_us in 100..10_000u64, mass in 0.1..20.0f64,
    ) {
        let mut g = Generator::at(0.0);
        let mut plant = Plant::new(PlantPlan { mass_kg: mass, peak_force_n: 100.0 * mass, ..PlantPlan::default() });
        g.go_to(target, 1.0, 10.0, 10.0);
        let mut lag = 0.0f64;
        for _ in 0..4_000_000 / step_us {
            g.advance(step_us * 1_000);
            plant.advance(g.position(), g.velocity(), g.acceleration(), step_us * 1_000);
            lag = lag.max((plant.position() - g.position()).abs());
        }
        prop_assert!(lag < 2e-3, "lag {lag}");
        prop_assert!(lag > 1e-6 || target.abs() < 1e-2, "lag {lag}");
        prop_assert!((plant.position() - target).abs() < 1e-9);
        prop_assert!(plant.velocity().abs() < 1e-9 && plant.force().abs() < 1e-6 * mass);
    }

    #[test]
    fn the_mass_stays_finite_and_in_range_whatever_is_requested(
        steps in prop::collection::vec(
            (-1e6..1e6f64, -1e6..1e6f64, -1e6..1e6f64, 0..10_000_000_000u64, any::<bool>()), 1..50),
    ) {
        let mut plant = Plant::new(PlantPlan { range: (0.2, 0.3), ..PlantPlan::default() });
        prop_assert_eq!(plant.position(), 0.2);
        for (x, v, a, dt, powered) in steps {
            match powered {
                true => plant.advance(x, v, a, dt),
                false => plant.advance_with_force(0.0, dt),
            }
            prop_assert!((0.2..=0.3).contains(&plant.position()));
            prop_assert!(plant.velocity().is_finite() && plant.force().abs() <= 200.0);
        }
    }
}

#[test]
fn without_power_it_runs_out() {
    let mut plant = Plant::new(PlantPlan::default());
    for k in 1..=100u32 {
        plant.advance(1e-3 * f64::from(k) * 0.5, 0.5, 0.0, MS);
    }
    assert!((plant.velocity() - 0.5).abs() < 1e-3);
    let from = plant.position();
    for _ in 0..200 {
        plant.advance_with_force(0.0, MS);
    }
    // v^2 / (2 F / m) = 0.25 / 10
    assert!((plant.position() - from - 0.025).abs() < 1e-3, "{}", plant.position() - from);
    assert_eq!((plant.velocity(), plant.force()), (0.0, 0.0));
}

#[test]
fn the_hard_stop_holds_against_the_peak_force() {
    let mut plant = Plant::new(PlantPlan { range: (-0.1, 0.1), ..PlantPlan::default() });
    assert!(!plant.at_stop());
    for _ in 0..1_000 {
        plant.advance(0.5, 0.0, 0.0, MS);
    }
    assert!(plant.at_stop());
    assert_eq!((plant.position(), plant.velocity(), plant.force()), (0.1, 0.0, 200.0));
    for _ in 0..1_000 {
        plant.advance(0.0, 0.0, 0.0, MS);
    }
    assert!(!plant.at_stop() && plant.position().abs() < 1e-9);
}
