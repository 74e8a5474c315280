//! The panel without a terminal.

use std::time::Duration;

use fieldbeat_control::{AxisFacts, AxisLacks, AxisState, Notice, OperationState, Order};
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::crossterm::event::{Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use ratatui::style::Color;

use super::enabling::Enabling;
use super::panel::{Panel, Want};
use super::view;

const NO: Duration = Duration::ZERO;

fn facts(name: &str) -> AxisFacts {
    AxisFacts {
        name: name.to_owned(),
        protocol: "linudp-v2".to_owned(),
        unit: "mm".to_owned(),
        position_limits: Some((0.0, 400.0)),
        velocity_limit: Some(2_000.0),
        velocity: 500.0,
        holds: false,
        lacks: AxisLacks::default(),
        monitors: vec![("temperature".to_owned(), "°C".to_owned())],
    }
}

fn operational() -> AxisState {
    AxisState {
        link: "online".to_owned(),
        state: "OperationEnabled".to_owned(),
        powered: true,
        operational: true,
        homed: true,
        position: Some(100.0),
        demand: Some(100.125),
        velocity: Some(-12.5),
        current: Some(0.25),
        monitors: vec![Some(41.5)],
        ..AxisState::default()
    }
}

/// Of these axes, all in operation.
fn panel(names: &[&str], has_releases: bool) -> Panel {
    let mut panel =
        Panel::new("m.toml".to_owned(), names.iter().map(|name| facts(name)).collect(), 0, has_releases);
    let axes = vec![operational(); names.len()];
    panel.take(OperationState { axes, ..OperationState::default() });
    if has_releases {
        // A terminal is believed once it has reported that a key goes up.
        assert!(panel.event(NO, NO, &released(KeyCode::Char('e'))).is_empty());
        assert!(panel.has_releases());
    }
    panel
}

fn released(code: KeyCode) -> Event {
    Event::Key(KeyEvent { kind: KeyEventKind::Release, ..KeyEvent::new(code, KeyModifiers::NONE) })
}

fn key(code: KeyCode) -> Event {
    Event::Key(KeyEvent::new(code, KeyModifiers::NONE))
}

fn press(panel: &mut Panel, now: Duration, code: KeyCode) -> Vec<Want> {
    panel.event(now, now, &key(code))
}

fn character(panel: &mut Panel, which: char) -> Vec<Want> {
    press(panel, Duration::from_secs(10), KeyCode::Char(which))
}

/// The drawn cells, a line each.
fn drawn(panel: &Panel, width: u16, height: u16) -> Vec<String> {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal.draw(|frame| view::draw(frame, panel)).unwrap();
    let buffer = terminal.backend().buffer();
    let line = |y| (0..width).map(|x| buffer[(x, y)].symbol()).collect::<String>().trim_end().to_owned();
    (0..height).map(line).collect()
}

#[test]
fn the_panel_shows_what_is_known_in_80_by_24() {
    let mut panel = panel(&["x", "y"], false);
    let mut axes = panel.state.axes.clone();
    axes[1] = AxisState {
        link: "lost".to_owned(),
        not_connected: Some("connection refused".to_owned()),
        state: "Fault".to_owned(),
        stopped: Some("link lost".to_owned()),
        fault: Some("0x001e (30, watchdog)".to_owned()),
        warning: 0x80,
        sto_open: true,
        commands: vec!["reset fault".to_owned(), "reset".to_owned()],
        ..AxisState::default()
    };
    let notice = |number, axis, text: &str| Notice { number, axis, text: text.to_owned(), end: None };
    let notices = vec![notice(1, None, "one operates"), notice(2, Some(1), "fault 0x001e (30, watchdog)")];
    panel.take(OperationState { axes, notices, ..OperationState::default() });
    assert_eq!(panel.noticed(), 2);
    let lines = drawn(&panel, 80, 24);
    let wanted = [
        "fieldbeat jog: m.toml",
        "> x            OperationEnabled     online         100.000 mm    -12.500 mm/s",
        "  y            Fault                lost                    -               -",
        " x (linudp-v2) ",
        " state     OperationEnabled   command none",
        " position  100.000 mm   demand 100.125 mm",
        " limits    0 [----------|-----------------------------] 400 mm",
        " velocity  -12.500 mm/s   limit 2000 mm/s   current 0.250 A",
        " inputs    STO not reported missing   homed   not in target   not moving",
        " fault     none   warnings none   stopped: no",
        " monitor   temperature 41.5 °C",
        "one operates",
        "y: fault 0x001e (30, watchdog)",
        " <- -> hold to run 50 mm/s   - + step 1 mm",
        "any other stops",
    ];
    let mut rest = &lines[..];
    for line in wanted {
        let place = rest.iter().position(|drawn| drawn.contains(line));
        let place = place.unwrap_or_else(|| panic!("{line}: {lines:#?}"));
        rest = &rest[place + 1..];
    }
    panel.selected = 1;
    let lines = drawn(&panel, 80, 24).join("\n");
    for line in [
        " link      lost (connection refused)",
        " inputs    STO missing   not homed",
        " fault     0x001e (30, watchdog)   warnings 0x0080   stopped: link lost",
        " position  -   demand -",
        "command reset fault, reset",
    ] {
        assert!(lines.contains(line), "{line}: {lines}");
    }
}

#[test]
fn many_axes_are_listed_around_the_selected_one_and_a_small_terminal_says_what_it_needs() {
    let names: Vec<String> = (0..64).map(|number| format!("axis-{number}")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut panel = panel(&names, false);
    for selected in [0, 5, 40, 63] {
        panel.selected = selected;
        for (width, height) in [(80, 24), (120, 50)] {
            let lines = drawn(&panel, width, height);
            assert_eq!(lines.iter().filter(|line| line.starts_with("> ")).count(), 1, "{lines:#?}");
            assert!(lines.iter().any(|line| line.starts_with(&format!("> axis-{selected} "))), "{lines:#?}");
            assert!(lines.last().unwrap().ends_with("any other stops"), "{lines:#?}");
        }
    }
    let lines = drawn(&panel, 60, 20).join(" ");
    assert!(lines.contains("60x20 cells, the panel needs 80x24"), "{lines}");
    // What cannot be seen does not run.
    panel.fits = false;
    for code in [KeyCode::Char('e'), KeyCode::Char('+'), KeyCode::Char('h')] {
        assert_eq!(press(&mut panel, NO, code), [Want::Stop]);
    }
    assert!(!runs(&mut panel, KeyCode::Right, true));
}

#[test]
fn without_colours_there_are_none() {
    let mut panel = panel(&["x"], false);
    let colours = |panel: &Panel| {
        let mut terminal = Terminal::new(TestBackend::new(80, 24)).unwrap();
        terminal.draw(|frame| view::draw(frame, panel)).unwrap();
        terminal.backend().buffer().content().iter().filter(|cell| cell.fg != Color::Reset).count()
    };
    assert!(colours(&panel) > 0);
    panel.colours = false;
    assert_eq!(colours(&panel), 0);
}

#[test]
fn each_key_does_what_the_help_line_says() {
    let mut panel = panel(&["x", "y"], false);
    for (which, order) in [
        ('e', Order::Enable),
        ('d', Order::Disable),
        ('h', Order::Home),
        ('+', Order::step(1.0, 50.0)),
        ('-', Order::step(-1.0, 50.0)),
    ] {
        assert_eq!(character(&mut panel, which), [Want::Command(0, order)]);
    }
    press(&mut panel, NO, KeyCode::Down);
    press(&mut panel, NO, KeyCode::PageUp);
    character(&mut panel, '*');
    let step = Order::step(10.0, 100.0);
    assert_eq!(character(&mut panel, '+'), [Want::Command(1, step)]);
    for _ in 0..20 {
        press(&mut panel, NO, KeyCode::PageUp);
    }
    assert_eq!(panel.velocities, [50.0, 2_000.0], "up to the limit of the axis");
    press(&mut panel, NO, KeyCode::Up);
    assert_eq!(panel.selected, 0);
    // All others stop, with any modifier too.
    for which in ('a'..='z').filter(|which| !"edhrq".contains(*which)).chain([' ', 'E', 'D', '0', '~']) {
        assert_eq!(character(&mut panel, which), [Want::Stop], "{which}");
    }
    for code in [KeyCode::Esc, KeyCode::Enter, KeyCode::F(1), KeyCode::Delete] {
        assert_eq!(press(&mut panel, NO, code), [Want::Stop]);
    }
    let alt = Event::Key(KeyEvent::new(KeyCode::Char('e'), KeyModifiers::ALT));
    assert_eq!(panel.event(NO, NO, &alt), [Want::Stop]);
    assert_eq!(panel.event(NO, NO, &Event::FocusLost), [Want::Stop]);
    assert_eq!(panel.event(NO, NO, &Event::Resize(80, 24)), []);
    assert_eq!(panel.event(NO, NO, &Event::Resize(79, 24)), [Want::Stop]);
    assert_eq!(panel.event(NO, NO, &Event::Paste("eh+".to_owned())), [Want::Stop]);
    // One that was pressed long ago as well, and while it is not known what the panel did meanwhile.
    assert_eq!(panel.event(NO, Duration::from_millis(301), &key(KeyCode::Char('e'))), [Want::Stop]);
    panel.ignore_keys(Duration::from_secs(10));
    assert_eq!(character(&mut panel, 'e'), [Want::Stop]);
    for quit in
        [key(KeyCode::Char('q')), Event::Key(KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL))]
    {
        assert_eq!(panel.event(NO, NO, &quit), [Want::Quit]);
    }
    // A key that goes up does nothing.
    let up =
        KeyEvent { kind: KeyEventKind::Release, ..KeyEvent::new(KeyCode::Char('e'), KeyModifiers::NONE) };
    assert_eq!(panel.event(NO, NO, &Event::Key(up)), []);
}

#[test]
fn while_something_runs_every_key_stops_it() {
    for busy in ["enable", "home", "move", "jog", "stop"] {
        let mut panel = panel(&["x", "y"], false);
        // On whichever axis.
        panel.state.axes[1].commands.push(busy.to_owned());
        for code in [KeyCode::Char('e'), KeyCode::Char('+'), KeyCode::Char('d'), KeyCode::Left, KeyCode::Down]
        {
            assert_eq!(press(&mut panel, NO, code), [Want::Stop], "{busy} {code:?}");
        }
        assert_eq!(press(&mut panel, NO, KeyCode::Char('q')), [Want::Quit]);
    }
}

#[test]
fn impossible_commands_are_refused_by_the_panel_itself() {
    let mut panel = panel(&["x"], false);
    let message = |panel: &mut Panel, which| {
        assert_eq!(character(panel, which), [], "{which}");
        panel.message.clone().unwrap_or_default()
    };
    assert_eq!(message(&mut panel, 'r'), "nothing to reset");
    panel.state.axes[0].operational = false;
    for which in ['h', '+', '-'] {
        assert_eq!(message(&mut panel, which), "x is not enabled: press e");
    }
    assert!(!runs(&mut panel, KeyCode::Right, true));
    assert_eq!(panel.message.as_deref(), Some("x is not enabled: press e"));
    panel.state.axes[0].sto_open = true;
    assert_eq!(message(&mut panel, 'e'), "the hardware enable (STO) is missing: close it, then e");
    panel.state.axes[0].fault = Some("0x001e (30, watchdog)".to_owned());
    assert_eq!(message(&mut panel, 'e'), "fault 0x001e (30, watchdog): press r, then e");
    assert_eq!(character(&mut panel, 'r'), [Want::Command(0, Order::ResetFault)]);
    panel.state.axes[0].stopped = Some("drive fault".to_owned());
    assert_eq!(message(&mut panel, 'e'), "stopped (drive fault): press r, then e");
    assert_eq!(message(&mut panel, 'h'), "x is stopped (drive fault): press r, then e");
    let both = [Want::Command(0, Order::ResetFault), Want::Command(0, Order::Reset)];
    assert_eq!(character(&mut panel, 'r'), both);
    let why = Some("it has none".to_owned());
    panel.facts[0].lacks = AxisLacks { enable: why.clone(), home: why.clone(), step: why.clone(), jog: why };
    for which in ['e', 'h', '+'] {
        assert_eq!(message(&mut panel, which), "x cannot: it has none");
    }
    assert!(!runs(&mut panel, KeyCode::Left, true));
    assert_eq!(panel.message.as_deref(), Some("x does not jog: it has none"));
}

/// Whether a key that is held, with or without reports of its release, runs.
fn runs(panel: &mut Panel, code: KeyCode, by_presses: bool) -> bool {
    let mut ran = false;
    for at in [20_000, 20_500, 20_533, 20_566] {
        let now = Duration::from_millis(at);
        let first = at == 20_000 || by_presses;
        let kind = if first { KeyEventKind::Press } else { KeyEventKind::Repeat };
        let event = Event::Key(KeyEvent { kind, ..KeyEvent::new(code, KeyModifiers::NONE) });
        panel.event(now, now, &event);
        ran |= panel.jogs(now).is_some();
    }
    ran
}

#[test]
fn a_run_key_runs_while_it_is_held_and_any_other_key_ends_that() {
    let ms = Duration::from_millis;
    for has_releases in [false, true] {
        for (code, velocity) in [(KeyCode::Right, 50.0), (KeyCode::Left, -50.0)] {
            let mut panel = panel(&["x"], has_releases);
            assert!(runs(&mut panel, code, !has_releases));
            assert_eq!(panel.jogs(ms(20_600)), Some(velocity));
            assert_eq!(panel.jogs(ms(20_767)), None, "it was let go");
        }
        for other in [KeyCode::Char(' '), KeyCode::Char('e'), KeyCode::Left, KeyCode::Down] {
            let mut panel = panel(&["x"], has_releases);
            assert!(runs(&mut panel, KeyCode::Right, !has_releases));
            assert_eq!(press(&mut panel, ms(20_580), other), [Want::Stop], "{other:?}");
            assert_eq!(panel.jogs(ms(20_580)), None);
        }
        let mut panel = panel(&["x"], has_releases);
        assert!(runs(&mut panel, KeyCode::Right, !has_releases));
        assert_eq!(panel.event(ms(20_580), ms(20_580), &Event::FocusLost), [Want::Stop]);
        assert_eq!(panel.jogs(ms(20_580)), None);
    }
}

#[test]
fn nothing_moves_unless_the_enabling_device_is_held() {
    let ms = Duration::from_millis;
    for has_releases in [false, true] {
        for (enabling, why) in
            [(Enabling::Released, "hold the enabling device first"), (Enabling::Lost, "device is lost")]
        {
            let mut panel = panel(&["x"], has_releases);
            panel.enabling = Some(enabling);
            for which in ['+', '-', 'h'] {
                assert!(character(&mut panel, which).is_empty(), "{which}");
                assert!(panel.message.as_deref().unwrap().contains(why), "{:?}", panel.message);
            }
            assert!(!runs(&mut panel, KeyCode::Right, !has_releases));
            // What was held down before the device has to be let go.
            assert!(panel.enable(ms(20_570), Enabling::Held).is_empty());
            let repeat = if has_releases { KeyEventKind::Repeat } else { KeyEventKind::Press };
            for at in (20_580..22_000).step_by(30) {
                let key = KeyEvent { kind: repeat, ..KeyEvent::new(KeyCode::Right, KeyModifiers::NONE) };
                panel.event(ms(at), ms(at), &Event::Key(key));
                assert_eq!(panel.jogs(ms(at)), None);
            }
            // Power needs none.
            let mut panel = self::panel(&["x"], has_releases);
            panel.enabling = Some(enabling);
            assert_eq!(character(&mut panel, 'e'), [Want::Command(0, Order::Enable)]);
            assert_eq!(character(&mut panel, 'd'), [Want::Command(0, Order::Disable)]);
        }
        for end in [Enabling::Released, Enabling::Lost] {
            let mut panel = panel(&["x"], has_releases);
            assert!(panel.enable(NO, Enabling::Released).is_empty());
            assert!(panel.enable(NO, Enabling::Held).is_empty());
            let step = Order::step(1.0, 50.0);
            assert_eq!(character(&mut panel, '+'), [Want::Command(0, step)]);
            assert!(runs(&mut panel, KeyCode::Right, !has_releases));
            assert!(panel.enable(ms(20_570), Enabling::Held).is_empty());
            // Whatever moves: a step or a homing has no key that is held. Once.
            assert_eq!(panel.enable(ms(20_580), end), [Want::Stop]);
            assert_eq!(panel.jogs(ms(20_580)), None);
            assert!(panel.enable(ms(20_590), end).is_empty());
            let shown = drawn(&panel, 80, 24).concat();
            let word = if end == Enabling::Lost { "device lost" } else { "device not held" };
            assert!(shown.contains(word), "{shown}");
        }
    }
}

#[test]
fn a_run_key_that_goes_up_or_repeats_with_another_key_down_runs_no_further() {
    let now = Duration::from_millis(20_580);
    for modifiers in [KeyModifiers::SHIFT, KeyModifiers::CONTROL, KeyModifiers::ALT, KeyModifiers::SUPER] {
        for (kind, wants) in [
            (KeyEventKind::Release, vec![]),
            (KeyEventKind::Repeat, vec![Want::Stop]),
            (KeyEventKind::Press, vec![Want::Stop]),
        ] {
            let mut panel = panel(&["x"], true);
            assert!(runs(&mut panel, KeyCode::Right, false));
            let event = Event::Key(KeyEvent { kind, ..KeyEvent::new(KeyCode::Right, modifiers) });
            assert_eq!(panel.event(now, now, &event), wants, "{modifiers:?} {kind:?}");
            assert_eq!(panel.jogs(now), None, "{modifiers:?} {kind:?}");
        }
    }
}

/// Keys at random: nothing runs for longer after the last report of a run key than the gap between two of them allows,
/// and nothing at all where no run key comes.
#[test]
fn nothing_runs_longer_than_a_run_key_is_held() {
    let others = "edhr+-*/ xq0".chars().map(KeyCode::Char);
    let others: Vec<KeyCode> =
        others.chain([KeyCode::Up, KeyCode::Down, KeyCode::PageUp, KeyCode::Esc]).collect();
    let mut ran = 0;
    for seed in 0..400 {
        let mut rng = fastrand::Rng::with_seed(seed);
        let (has_releases, has_run_keys) = (rng.bool(), seed % 2 == 0);
        let mut panel = panel(&["x", "y"], has_releases);
        let (mut now, mut last) = (Duration::from_secs(1), NO);
        for _ in 0..400 {
            let (code, kind) = if has_run_keys && rng.u32(0..20) > 0 {
                let way = if rng.u32(0..30) == 0 { KeyCode::Left } else { KeyCode::Right };
                let kinds =
                    [KeyEventKind::Press, KeyEventKind::Repeat, KeyEventKind::Repeat, KeyEventKind::Release];
                (way, if has_releases { kinds[rng.usize(0..4)] } else { KeyEventKind::Press })
            } else {
                (others[rng.usize(..others.len())], KeyEventKind::Press)
            };
            let event = Event::Key(KeyEvent { kind, ..KeyEvent::new(code, KeyModifiers::NONE) });
            panel.event(now, now, &event);
            if [KeyCode::Right, KeyCode::Left].contains(&code) && kind != KeyEventKind::Release {
                last = now;
            }
            // Long enough for a first repeat, or as fast as a keyboard repeats.
            let most = if rng.u32(0..4) == 0 { 1_500 } else { 60 };
            for _ in 0..=rng.u64(0..most) / 10 {
                if panel.jogs(now).is_some() {
                    ran += 1;
                    let gap = Duration::from_millis(if has_releases { 1_200 } else { 200 });
                    assert!(
                        has_run_keys && now - last <= gap,
                        "seed {seed}: {:?} after the last key",
                        now - last
                    );
                }
                now += Duration::from_millis(10);
            }
        }
    }
    assert!(ran > 1_000, "{ran}");
}

#[test]
fn a_long_answer_has_two_lines() {
    let mut panel = panel(&["x"], false);
    let why = "a LinUDP drive has no watchdog; allow jogs and velocities with no_drive_watchdog = \"accept\" \
         and a leash";
    panel.facts[0].lacks.jog = Some(why.to_owned());
    assert!(!runs(&mut panel, KeyCode::Right, true));
    let words = |text: &str| text.split_whitespace().collect::<String>();
    let lines = drawn(&panel, 80, 24).concat();
    assert!(words(&lines).contains(&words(why)), "{lines}");
}
