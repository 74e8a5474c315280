//! What the panel knows, and what each key does: without a terminal and without a master.

use std::collections::VecDeque;
use std::time::Duration;

use fieldbeat_control::{AxisFacts, AxisState, OperationState, Order};
use ratatui::crossterm::event::{Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use ratatui::layout::Rect;

use super::super::operating::short;
use super::enabling::Enabling;
use super::hold::{Hold, Stroke, Way};
use super::view;

/// A key that was read so long after it was pressed commands nothing any more, but a stop.
const STALE: Duration = Duration::from_millis(300);

const DEVICE_LOST: &str = "stopped: the enabling device is lost; q quits, plug it in and start again";

/// Lines of events that are kept.
const MOST_LINES: usize = 200;

/// The panel.
#[derive(Debug)]
pub struct Panel {
    /// The operated machine, for the first line.
    pub title: String,
    /// The facts of the axes.
    pub facts: Vec<AxisFacts>,
    /// How they are.
    pub state: OperationState,
    /// The axis that the keys are for.
    pub selected: usize,
    /// The velocity of jogs and steps of each axis, and the distance of its steps, in user units.
    pub velocities: Vec<f64>,
    pub steps: Vec<f64>,
    /// The notices, oldest first.
    pub lines: VecDeque<String>,
    /// The answer to the last key.
    pub message: Option<String>,
    /// Colours may be used.
    pub colours: bool,
    /// The terminal is large enough to see what moves.
    pub fits: bool,
    /// How the enabling device is, if there is one.
    pub enabling: Option<Enabling>,
    hold: Hold,
    /// Up to then keys only stop.
    ignores_until: Duration,
    /// The number of the last notice.
    noticed: u64,
}

/// The actions of the panel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Want {
    /// A command to an axis.
    Command(usize, Order),
    /// Stop all axes.
    Stop,
    /// Stop and end.
    Quit,
}

impl Panel {
    /// A panel of these axes, which shows this one.
    pub fn new(title: String, facts: Vec<AxisFacts>, selected: usize, has_releases: bool) -> Panel {
        // A tenth of the profile, and a step that the eye sees.
        let velocities = facts.iter().map(|axis| axis.velocity / 10.0).collect();
        let steps = facts.iter().map(|axis| if axis.unit == "mm" { 1.0 } else { 0.1 }).collect();
        Panel {
            title,
            state: OperationState {
                axes: vec![AxisState::default(); facts.len()],
                ..OperationState::default()
            },
            facts,
            selected,
            velocities,
            steps,
            lines: VecDeque::new(),
            message: None,
            colours: true,
            fits: true,
            enabling: None,
            hold: Hold::new(has_releases),
            ignores_until: Duration::ZERO,
            noticed: 0,
        }
    }

    /// The number of the last notice that is known.
    pub fn noticed(&self) -> u64 {
        self.noticed
    }

    /// Whether the terminal reports that a key goes up.
    pub fn has_releases(&self) -> bool {
        self.hold.has_releases()
    }

    /// The axis that the keys are for.
    pub fn axis(&self) -> (&AxisFacts, &AxisState) {
        (&self.facts[self.selected], &self.state.axes[self.selected])
    }

    /// Takes how the axes are.
    pub fn take(&mut self, state: OperationState) {
        for notice in &state.notices {
            self.noticed = self.noticed.max(notice.number);
            let line = match notice.axis.and_then(|axis| self.facts.get(axis)) {
                Some(axis) => format!("{}: {}", axis.name, notice.text),
                None => notice.text.clone(),
            };
            self.lines.push_back(line);
        }
        while self.lines.len() > MOST_LINES {
            self.lines.pop_front();
        }
        if state.axes.len() == self.facts.len() {
            self.state = state;
        }
    }

    /// Ends the hold for the reason that ended or refused a motion: the run key has to be released.
    pub fn end_hold(&mut self, now: Duration, why: Option<String>) {
        self.hold.end(now);
        if why.is_some() {
            self.message = why;
        }
    }

    /// The panel has hung: what comes in at first was typed while nobody saw what it does.
    pub fn ignore_keys(&mut self, now: Duration) {
        self.hold.end(now);
        self.ignores_until = now + STALE;
    }

    /// Whether a key of this time commands nothing but a stop.
    fn is_stale(&self, at: Duration, now: Duration) -> bool {
        now.saturating_sub(at) > STALE || now < self.ignores_until
    }

    /// The velocity that is to be jogged with now, with its sign.
    pub fn jogs(&mut self, now: Duration) -> Option<f64> {
        let velocity = self.velocities[self.selected];
        let may_move = self.fits && self.forbids().is_none();
        self.hold.held(now).filter(|_| may_move).map(|way| match way {
            Way::Forward => velocity,
            Way::Back => -velocity,
        })
    }

    /// The enabling device is like this now.
    pub fn enable(&mut self, now: Duration, enabling: Enabling) -> Vec<Want> {
        match (self.enabling.replace(enabling), enabling) {
            (Some(before), enabling) if before == enabling => Vec::new(),
            (_, Enabling::Lost) => self.stop(now, DEVICE_LOST),
            (Some(Enabling::Held), Enabling::Released) => {
                self.stop(now, "stopped: the enabling device was let go")
            }
            _ => Vec::new(),
        }
    }

    /// Why nothing may move now.
    fn forbids(&self) -> Option<&'static str> {
        match self.enabling? {
            Enabling::Held => None,
            Enabling::Released => Some("hold the enabling device first"),
            Enabling::Lost => Some(DEVICE_LOST),
        }
    }

    /// Something is under way that any key ends.
    fn is_busy(&mut self, now: Duration) -> bool {
        self.hold.held(now).is_some()
            || self.state.jog.is_some()
            || self.state.axes.iter().any(|axis| !axis.commands.is_empty())
    }

    /// An event of the terminal, which came at `at`, is looked at.
    pub fn event(&mut self, at: Duration, now: Duration, event: &Event) -> Vec<Want> {
        match event {
            Event::Key(key) => self.key(at, now, *key),
            Event::Resize(width, height) if !view::fits(Rect::new(0, 0, *width, *height)) => {
                self.stop(now, "stopped: the terminal is too small")
            }
            Event::FocusGained | Event::Resize(..) => Vec::new(),
            // Nobody looks; or what comes in was not typed.
            Event::FocusLost => self.stop(now, "stopped: the terminal has lost the focus"),
            Event::Paste(_) => self.stop(now, "stopped: pasted text is no command"),
            Event::Mouse(_) => Vec::new(),
        }
    }

    fn key(&mut self, at: Duration, now: Duration, key: KeyEvent) -> Vec<Want> {
        if key.kind == KeyEventKind::Release {
            self.hold.release();
        }
        let way = match key.code {
            KeyCode::Right => Some(Way::Forward),
            KeyCode::Left => Some(Way::Back),
            _ => None,
        };
        let stroke = match key.kind {
            KeyEventKind::Press => Stroke::Down,
            KeyEventKind::Repeat => Stroke::Repeat,
            KeyEventKind::Release => Stroke::Up,
        };
        // One that goes up ends its run, whatever other key is down by then.
        if let Some(way) = way.filter(|_| key.modifiers.is_empty() || stroke == Stroke::Up) {
            return self.run_key(at, now, way, stroke);
        }
        if stroke == Stroke::Up || stroke == Stroke::Repeat && way.is_none() {
            // Of a key that has acted when it went down.
            return Vec::new();
        }
        let control = key.modifiers.contains(KeyModifiers::CONTROL);
        if key.code == KeyCode::Char('q') || control && matches!(key.code, KeyCode::Char('c' | 'd')) {
            return vec![Want::Quit];
        }
        if self.is_busy(now) {
            return self.stop(now, "stopped");
        }
        let modified = key.modifiers.difference(KeyModifiers::SHIFT);
        if self.is_stale(at, now) || !modified.is_empty() || !self.fits {
            return self.stop(now, "");
        }
        self.message = None;
        self.command(key.code).unwrap_or_else(|| self.stop(now, ""))
    }

    fn run_key(&mut self, at: Duration, now: Duration, way: Way, stroke: Stroke) -> Vec<Want> {
        if self.is_stale(at, now) {
            return self.stop(now, "");
        }
        let was_held = self.hold.held(at).is_some();
        if !was_held && stroke != Stroke::Up {
            let (facts, state) = self.axis();
            let refused = match &facts.lacks.jog {
                _ if self.state.axes.iter().any(|axis| !axis.commands.is_empty()) => {
                    return self.stop(now, "stopped");
                }
                _ if !self.fits => Some(String::new()),
                Some(why) => Some(format!("{} does not jog: {why}", facts.name)),
                None if !state.operational => Some(not_enabled(facts, state)),
                None => self.forbids().map(str::to_owned),
            };
            if refused.is_some() {
                self.end_hold(now, refused);
                return Vec::new();
            }
        }
        self.hold.stroke(at, way, stroke);
        match (was_held, self.hold.held(at).is_some()) {
            (true, false) if stroke != Stroke::Up => self.stop(now, "stopped"),
            (_, true) => {
                self.message = None;
                Vec::new()
            }
            _ => {
                if !self.has_releases() && self.message.is_none() {
                    self.message = Some("keep the key down to run".to_owned());
                }
                Vec::new()
            }
        }
    }

    fn stop(&mut self, now: Duration, why: &str) -> Vec<Want> {
        self.end_hold(now, Some(why.to_owned()).filter(|why| !why.is_empty()));
        vec![Want::Stop]
    }

    /// The commands of a key while nothing is under way; `None`: nothing.
    fn command(&mut self, code: KeyCode) -> Option<Vec<Want>> {
        let index = self.selected;
        let (facts, state) = self.axis();
        let (unit, lacks, forbids) = (facts.unit.clone(), &facts.lacks, self.forbids());
        let give = |order| vec![Want::Command(index, order)];
        let ready = |lack: &Option<String>, order: Order| match lack {
            Some(why) => Err(format!("{} cannot: {why}", facts.name)),
            None if !state.operational => Err(not_enabled(facts, state)),
            None => forbids.map_or_else(|| Ok(give(order)), |why| Err(why.to_owned())),
        };
        let velocity = self.velocities[index];
        let step = |distance: f64| ready(&lacks.step, Order::step(distance, velocity));
        let wants = match code {
            KeyCode::Char('e') => match (&lacks.enable, &state.stopped, &state.fault) {
                (Some(why), ..) => Err(format!("{} cannot: {why}", facts.name)),
                (_, Some(cause), _) => Err(format!("stopped ({cause}): press r, then e")),
                (.., Some(fault)) => Err(format!("fault {fault}: press r, then e")),
                _ if state.sto_open => {
                    Err("the hardware enable (STO) is missing: close it, then e".to_owned())
                }
                _ => Ok(give(Order::Enable)),
            },
            KeyCode::Char('d') => Ok(give(Order::Disable)),
            KeyCode::Char('h') => ready(&lacks.home, Order::Home),
            KeyCode::Char('+' | '=') => step(self.steps[index]),
            KeyCode::Char('-') => step(-self.steps[index]),
            KeyCode::Char('r') => {
                let fault = state.fault.is_some().then_some(Want::Command(index, Order::ResetFault));
                let latch = state.stopped.is_some().then_some(Want::Command(index, Order::Reset));
                match (fault, latch) {
                    (None, None) => Err("nothing to reset".to_owned()),
                    (fault, latch) => Ok(fault.into_iter().chain(latch).collect()),
                }
            }
            KeyCode::Up | KeyCode::BackTab => {
                self.selected = (index + self.facts.len() - 1) % self.facts.len();
                Ok(Vec::new())
            }
            KeyCode::Down | KeyCode::Tab => {
                self.selected = (index + 1) % self.facts.len();
                Ok(Vec::new())
            }
            KeyCode::PageUp | KeyCode::PageDown => {
                let most = facts.velocity_limit.unwrap_or(facts.velocity.max(velocity));
                let factor = if code == KeyCode::PageUp { 2.0 } else { 0.5 };
                self.velocities[index] = (velocity * factor).min(most);
                Err(format!("velocity {} {unit}/s", short(self.velocities[index])))
            }
            KeyCode::Char('*' | '/') => {
                self.steps[index] *= if code == KeyCode::Char('*') { 10.0 } else { 0.1 };
                Err(format!("step {} {unit}", short(self.steps[index])))
            }
            _ => return None,
        };
        Some(wants.unwrap_or_else(|message| {
            self.message = Some(message);
            Vec::new()
        }))
    }
}

fn not_enabled(facts: &AxisFacts, state: &AxisState) -> String {
    match &state.stopped {
        Some(cause) => format!("{} is stopped ({cause}): press r, then e", facts.name),
        None => format!("{} is not enabled: press e", facts.name),
    }
}
