//! What the panel looks like.

use fieldbeat_control::{AxisFacts, AxisState};
use fieldbeat_telemetry::signals::{COMMAND, CURRENT, DEMAND, POSITION, STATE, VELOCITY};
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Borders, Paragraph, Wrap};

use super::super::operating::short;
use super::enabling::Enabling;
use super::panel::Panel;

/// The smallest terminal that shows what moves.
pub const WIDTH: u16 = 80;
pub const HEIGHT: u16 = 24;

/// Axes that are listed at once, at most.
const MOST_AXES: u16 = 12;

/// All lines but those of the axes and those of events beyond the second.
const OTHERS: u16 = 18;

/// Cells of the bar that shows a position within its limits.
const BAR: usize = 40;

/// Lines of the values of an axis, with their head.
const VALUES: u16 = 9;

/// Draws `panel`.
pub fn draw(frame: &mut Frame<'_>, panel: &Panel) {
    let area = frame.area();
    if !fits(area) {
        let needs = format!(
            "This terminal has {}x{} cells, the panel needs {WIDTH}x{HEIGHT}: make it larger. Any key stops, \
             q quits.",
            area.width, area.height
        );
        frame.render_widget(Paragraph::new(needs).wrap(Wrap { trim: true }), area);
        return;
    }
    let listed = (panel.facts.len().min(usize::from(MOST_AXES)) as u16).min(area.height - OTHERS);
    let rows = [1, listed + 1, VALUES].map(Constraint::Length);
    let [head, axes, values, events, message, keys] = Layout::vertical(rows.into_iter().chain([
        Constraint::Min(3),
        Constraint::Length(2),
        Constraint::Length(2),
    ]))
    .areas(area);
    frame.render_widget(title(panel), head);
    frame.render_widget(
        Paragraph::new(list(panel, usize::from(listed))).block(block("axes".to_owned())),
        axes,
    );
    let (facts, state) = panel.axis();
    let block_of_axis = block(format!("{} ({})", facts.name, facts.protocol));
    frame.render_widget(Paragraph::new(details(panel, facts, state)).block(block_of_axis), values);
    let room = usize::from(events.height.saturating_sub(1));
    let newest = panel.lines.iter().skip(panel.lines.len().saturating_sub(room));
    let lines: Vec<Line<'_>> = newest.map(|line| Line::raw(line.as_str())).collect();
    frame.render_widget(Paragraph::new(lines).block(block("events".to_owned())), events);
    let text = panel.message.as_deref().unwrap_or_default();
    let text = Line::styled(format!(" {text}"), marked(panel, Color::Yellow));
    frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: false }), message);
    frame.render_widget(help(panel), keys);
}

/// Whether the panel fits into `area`.
pub fn fits(area: Rect) -> bool {
    area.width >= WIDTH && area.height >= HEIGHT
}

fn block(title: String) -> Block<'static> {
    Block::new().borders(Borders::TOP).title(format!(" {title} "))
}

/// In this colour, or bold where there are none.
fn marked(panel: &Panel, colour: Color) -> Style {
    let style = Style::new().add_modifier(Modifier::BOLD);
    if panel.colours { style.fg(colour) } else { style }
}

fn title(panel: &Panel) -> Paragraph<'_> {
    let text = format!(" fieldbeat jog: {}", panel.title);
    Paragraph::new(Line::styled(text, Style::new().add_modifier(Modifier::REVERSED)))
        .style(Style::new().add_modifier(Modifier::REVERSED))
}

/// A line for each of so many axes, the selected one among them.
fn list(panel: &Panel, listed: usize) -> Vec<Line<'_>> {
    let first = (panel.selected + 1).saturating_sub(listed);
    let axes = panel.facts.iter().zip(&panel.state.axes).enumerate().skip(first).take(listed);
    let line = |(index, (facts, state)): (usize, (&AxisFacts, &AxisState))| {
        let mark = if index == panel.selected { ">" } else { " " };
        let text = format!(
            "{mark} {:<12.12} {:<20} {:<11} {:>13} {:>15}",
            facts.name,
            state.state,
            state.link,
            value(state.position, &facts.unit),
            value(state.velocity, &VELOCITY.unit(&facts.unit)),
        );
        let style = match condition(state) {
            Condition::Bad => marked(panel, Color::Red),
            Condition::On => marked(panel, Color::Green),
            Condition::Off => Style::new(),
        };
        Line::styled(text, style)
    };
    axes.map(line).collect()
}

/// How an axis is to be shown.
enum Condition {
    Bad,
    On,
    Off,
}

fn condition(state: &AxisState) -> Condition {
    if state.fault.is_some() || state.stopped.is_some() || state.link == "lost" {
        Condition::Bad
    } else if state.powered {
        Condition::On
    } else {
        Condition::Off
    }
}

/// All that is known of the selected axis.
fn details<'a>(panel: &Panel, facts: &'a AxisFacts, state: &'a AxisState) -> Vec<Line<'a>> {
    let unit = &facts.unit;
    let speed = VELOCITY.unit(unit);
    let alarm = |text: String, bad: bool| {
        Span::styled(text, if bad { marked(panel, Color::Red) } else { Style::new() })
    };
    let link = match &state.not_connected {
        Some(why) => format!("{} ({why})", state.link),
        None => format!("{}, {} cycles old", state.link, state.age),
    };
    let fault = state.fault.clone().unwrap_or_else(|| "none".to_owned());
    let warning = if state.warning == 0 { "none".to_owned() } else { format!("{:#06x}", state.warning) };
    let limit = facts
        .velocity_limit
        .map_or_else(|| "of the drive".to_owned(), |most| format!("{} {speed}", short(most)));
    let monitors = facts.monitors.iter().zip(&state.monitors).map(|((name, unit), value)| {
        let value = value.map_or_else(|| "-".to_owned(), short);
        format!("{name} {value} {unit}").trim_end().to_owned()
    });
    let commands = if state.commands.is_empty() { "none".to_owned() } else { state.commands.join(", ") };
    vec![
        Line::from(vec![
            Span::raw(label(STATE.name)),
            Span::styled(state.state.as_str(), marked(panel, Color::Cyan)),
            Span::raw(match panel.enabling {
                None => "",
                Some(Enabling::Held) => "   enabling device held",
                Some(Enabling::Released) => "   enabling device not held",
                Some(Enabling::Lost) => "   enabling device lost",
            }),
            Span::raw(format!("   {} {commands}", COMMAND.name)),
        ]),
        Line::from(vec![Span::raw(label("link")), alarm(link, state.link != "online")]),
        Line::raw(format!(
            "{}{}   {} {}",
            label(POSITION.name),
            value(state.position, unit),
            DEMAND.name,
            value(state.demand, unit)
        )),
        Line::raw(format!("{}{}", label("limits"), bar(facts, state))),
        Line::raw(format!(
            "{}{}   limit {limit}   {} {}",
            label(VELOCITY.name),
            value(state.velocity, &speed),
            CURRENT.name,
            value(state.current, &CURRENT.unit(unit))
        )),
        Line::from(vec![
            Span::raw(label("inputs")),
            alarm(
                if state.sto_open { "STO missing".to_owned() } else { "STO not reported missing".to_owned() },
                state.sto_open,
            ),
            Span::raw(format!(
                "   {}   {}   {}",
                if state.homed { "homed" } else { "not homed" },
                if state.in_target { "in target" } else { "not in target" },
                if state.moving { "moving" } else { "not moving" },
            )),
        ]),
        Line::from(vec![
            Span::raw(label("fault")),
            alarm(fault, state.fault.is_some()),
            Span::raw(format!("   warnings {warning}   stopped: ")),
            alarm(state.stopped.clone().unwrap_or_else(|| "no".to_owned()), state.stopped.is_some()),
        ]),
        Line::raw(match monitors.collect::<Vec<_>>().join("   ") {
            none if none.is_empty() => String::new(),
            monitors => format!("{}{monitors}", label("monitor")),
        }),
    ]
}

fn label(name: &str) -> String {
    format!(" {name:<9} ")
}

fn value(value: Option<f64>, unit: &str) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.3} {unit}"))
}

/// The position within its limits.
fn bar(facts: &AxisFacts, state: &AxisState) -> String {
    let Some((low, high)) = facts.position_limits else { return "of the drive".to_owned() };
    let mut cells = ['-'; BAR];
    if let Some(position) = state.position {
        let share = ((position - low) / (high - low)).clamp(0.0, 1.0);
        cells[(share * (BAR - 1) as f64).round() as usize] = '|';
    }
    format!("{} [{}] {} {}", short(low), cells.iter().collect::<String>(), short(high), facts.unit)
}

fn help(panel: &Panel) -> Paragraph<'_> {
    let (facts, _) = panel.axis();
    let (velocity, step) = (panel.velocities[panel.selected], panel.steps[panel.selected]);
    let unit = &facts.unit;
    let run = format!(
        " <- -> hold to run {} {unit}/s   - + step {} {unit}   PgUp PgDn velocity   * / step",
        short(velocity),
        short(step)
    );
    let rest = " e enable  d disable  h home  r reset  up down axis  q quit  any other stops";
    Paragraph::new(vec![Line::raw(run), Line::raw(rest)])
}
