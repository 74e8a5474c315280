//! Two operators, a panel in a terminal and a page in a browser, each in its own rhythm, have the axes of a machine; or
//! processes of a shell have them, each for one command.
//!
//! | rule | statement |
//! |---|---|
//! | `held` | an axis moves only while its operator holds its jog, or a step or homing of its operator has not ended |
//! | `left` | once its operator has left, an axis comes to rest and, unless its stop holds it, its power goes off; if it has said so, power stays as it is, and nothing moves |
//! | `one` | nobody but the operator commands, and nobody else becomes it |
//! | `turn` | a request out of turn, and one for a jog that has ended, is refused |
//! | `take` | whoever left or fell silent does not keep the axes from the next operator |
//!
//! They hold for the next master, too, when one dies: what moves then comes to rest once its drive can be reached.
//!
//! What is held, who operates and who has left are worked out here from the requests and their answers alone. Bounds
//! are counted in turns in which the drive can be reached.

use std::fmt::Write as _;

use fieldbeat::axis::Link;
use fieldbeat::time::{MS, Time};
use fieldbeat_control::{
    Act, AxisState, Ended, HOLD_LIMIT, OPERATOR_LIMIT, Operated, Operation, OperationState, Order, Reply,
    Request,
};

use super::judge::{GRACE, REACTION};
use super::machine::{AXES, DEADMAN, Machine, STOP_TIMEOUT, Shape};
use super::run::{Effect, Found, Tally};
use super::steps::{Deed, Once, Op, Round, Step};

/// How often the thread of the operation looks, ms.
const LOOK: u64 = 5;
/// An axis that nobody moves any more comes to rest within so many turns, and its power is off after as many again.
const RESTS: u32 = STOP_TIMEOUT.as_millis() as u32 * 3 / 2 + REACTION + 2 * LOOK as u32;
/// Turns after the last step of a round, in which what it began goes on, and in which all ends.
const TAIL: u64 = 300;
const SETTLED: u64 = 6_000;
/// Turns in which a line comes up, and in which its axes are made ready.
const UP: u64 = 12_000;
const READY: u64 = 12_000;
/// How often a process of the shell looks, and holds its jog; and for how long it tries to become the operator.
const SHELL: u64 = 20;
const SHELL_HOLDS: u64 = 60;
const SHELL_TAKES: u64 = 500;

type Judged = Result<(), Found>;

/// One that may be the operator.
struct Client {
    session: u64,
    beat: u64,
    /// Its jog, and the one before.
    jog: Option<u64>,
    former: u64,
    holds: bool,
    silent: u64,
    /// The turn of its next request.
    next: u64,
    shell: Option<Shell>,
}

/// A process of the shell.
#[derive(Clone, Copy)]
struct Shell {
    axis: usize,
    once: Once,
    /// Until then it tries to become the operator; once it is, `None`.
    takes: Option<u64>,
    /// The command whose end it waits for, and that end.
    waits: Option<u64>,
    ended: Option<Ended>,
    /// It jogs until then, and has held it then.
    jogs: Option<(u64, u64)>,
    /// Its own command was given.
    given: bool,
    /// All that is left is to leave.
    over: bool,
}

impl Client {
    fn new(session: u64) -> Client {
        Client { session, beat: 0, jog: None, former: 0, holds: false, silent: 0, next: 0, shell: None }
    }
}

/// What an axis may do, and what it does although it may not.
#[derive(Clone, Copy, Default)]
struct May {
    /// A jog of it is held until then.
    jogs: Option<Time>,
    /// The last one began.
    begun: Time,
    /// A step or a homing that has not ended.
    moves: Option<u64>,
    unheld: u32,
    left: u32,
    /// Who operated last has left it as it is.
    kept: bool,
    /// Its wire is bad until this turn.
    bad: u64,
    unplugged: Option<u64>,
    lossy: Option<u64>,
}

pub struct Run {
    machine: Machine,
    operation: Operation,
    clients: [Client; 2],
    sessions: u64,
    /// Who operates, and when its last request came in its turn.
    operator: Option<(usize, Time)>,
    axes: [May; AXES],
    /// The thread that looks does so again from this turn on; and when it last did.
    deaf: u64,
    looked: Time,
    since: u64,
    turn: u64,
    begun: u64,
    round: usize,
    tally: Tally,
    story: Option<String>,
}

impl Run {
    fn new(shape: Shape) -> Run {
        let mut machine = Machine::new(shape, None);
        let online = (0..30_000).any(|_| {
            machine.step();
            machine.online()
        });
        assert!(online, "a machine that nothing has happened to comes up");
        let axes = (0..AXES).map(|axis| Operated::new(machine.sim.take_axis(axis), Vec::new()));
        Run {
            operation: Operation::new(axes.collect()),
            looked: machine.sim.world().now(),
            machine,
            clients: [Client::new(1), Client::new(2)],
            sessions: 2,
            operator: None,
            axes: [May::default(); AXES],
            deaf: 0,
            since: 0,
            turn: 0,
            begun: 0,
            round: 0,
            tally: Tally { machines: 1, ..Tally::default() },
            story: None,
        }
    }

    /// All rounds, each from axes that are ready and in the hands of the first client.
    pub fn rounds(shape: Shape, rounds: &[Round], story: bool) -> (Judged, Tally, Option<String>) {
        let mut tally = Tally::default();
        let mut run = Run::new(shape);
        run.story = story.then(String::new);
        for (index, round) in rounds.iter().enumerate() {
            run.round = index;
            let judged = run.round(round);
            run.tally.sequences += AXES as u64;
            match judged {
                Ok(true) => {}
                Ok(false) => {
                    tally += run.tally;
                    let before = run.story.take();
                    run = Run { story: before, ..Run::new(shape) };
                }
                Err(found) => {
                    tally += run.tally;
                    return (Err(found), tally, run.story);
                }
            }
        }
        tally += run.tally;
        (Ok(()), tally, run.story)
    }

    fn round(&mut self, round: &[Step]) -> Result<bool, Found> {
        self.begun = self.turn;
        if !self.ready()? {
            return Ok(false);
        }
        self.begun = self.turn;
        let last = round.last().map_or(0, |step| u64::from(step.at));
        let mut steps = round.iter().peekable();
        let silent = |run: &Run| run.clients.iter().any(|client| client.silent > run.turn);
        while self.turn - self.begun <= last + TAIL || silent(self) {
            while let Some(step) = steps.next_if(|step| u64::from(step.at) <= self.turn - self.begun) {
                self.take(step)?;
            }
            self.step()?;
        }
        self.settle()
    }

    fn now(&self) -> Time {
        self.machine.sim.world().now()
    }

    fn found(&self, axis: usize, rule: &'static str, text: String) -> Found {
        Found { rule, round: self.round, turn: self.turn - self.begun, axis, text }
    }

    fn tell(&mut self, what: impl FnOnce() -> String) {
        let turn = self.turn - self.begun;
        if let Some(story) = &mut self.story {
            let _ = writeln!(story, "{turn:5} {}", what());
        }
    }

    fn state(&mut self) -> OperationState {
        match self.operation.request(self.now(), u64::MAX, 0, &Request::State { since: self.since }).1 {
            Ok(Reply::State(state)) => *state,
            other => panic!("everybody may look: {other:?}"),
        }
    }

    /// Nobody moves anything any more.
    fn stopped(&mut self) {
        self.jogs_end();
        self.axes.iter_mut().for_each(|axis| axis.moves = None);
    }

    fn jogs_end(&mut self) {
        let now = self.now();
        self.axes.iter_mut().for_each(|axis| axis.jogs = axis.jogs.map(|until| until.min(now)));
    }

    /// The operator, unless it is silent for too long.
    fn operator(&self) -> Option<usize> {
        let (client, received) = self.operator?;
        (self.now().since(received) <= OPERATOR_LIMIT).then_some(client)
    }

    /// A request of a client. Its answer is what these rules say.
    fn request(&mut self, client: usize, request: Request, in_turn: bool) -> Result<Option<Reply>, Found> {
        let (now, operator) = (self.now(), self.operator());
        let operates = operator == Some(client);
        let own = &mut self.clients[client];
        let beat = if in_turn { own.beat } else { own.beat.wrapping_sub(1) };
        let (next, answer) = self.operation.request(now, own.session, beat, &request);
        own.beat = next;
        self.tell(|| format!("client {client}: {request:?}: {answer:?}"));
        let is_act = matches!(request, Request::Act(_));
        let wrong = match (&request, &answer) {
            (Request::Act(_), Ok(_)) if !operates => Some("one"),
            (Request::Take { .. }, Ok(_)) if operator.is_some() && !operates => Some("one"),
            (_, Ok(_)) if operates && !in_turn => Some("turn"),
            (_, Err(_)) if operates && in_turn && !is_act && request != Request::Leave => Some("turn"),
            _ => None,
        };
        if let Some(rule) = wrong {
            return Err(self.found(0, rule, format!("client {client}: {request:?}: {answer:?}")));
        }
        if operates && in_turn {
            self.operator = Some((client, now));
        }
        if operates && answer.is_err() || request == Request::Stop {
            self.stopped();
        }
        match (&request, &answer) {
            (Request::Leave, Ok(_)) => {
                self.operator = None;
                self.tally.effects.count(Effect::HandedBack);
                // Whatever moves from here on is moved by nobody.
                self.stopped();
                self.axes.iter_mut().for_each(|axis| axis.kept = true);
            }
            (Request::StopAxis(axis), Ok(_)) => {
                let may = &mut self.axes[*axis];
                (may.moves, may.jogs) = (None, may.jogs.map(|until| until.min(now)));
            }
            (Request::Take { .. }, Ok(_)) if !operates => {
                self.operator = Some((client, now));
                self.axes.iter_mut().for_each(|axis| axis.kept = false);
                if client > 0 {
                    self.tally.effects.count(Effect::OtherTook);
                }
            }
            (_, Err(_)) if operator.is_some() && !operates => {
                self.tally.effects.count(Effect::RefusedToOther);
            }
            (_, Err(_)) if operates && !in_turn => self.tally.effects.count(Effect::OutOfTurn),
            _ => {}
        }
        Ok(answer.ok())
    }

    fn act(&mut self, client: usize, act: Act) -> Result<Option<Reply>, Found> {
        self.request(client, Request::Act(act), true)
    }

    /// Gives an axis a command; its id, if it is taken.
    fn order(&mut self, client: usize, axis: usize, command: Order) -> Result<Option<u64>, Found> {
        let Some(Reply::Commanded(id)) = self.act(client, Act::Command { axis, command })? else {
            return Ok(None);
        };
        self.tally.accepted += 1;
        match command {
            Order::Move { .. } => self.tally.effects.count(Effect::Stepped),
            Order::Home => self.tally.effects.count(Effect::Homed),
            _ => return Ok(Some(id)),
        }
        self.axes[axis].moves = Some(id);
        Ok(Some(id))
    }

    /// Begins a jog; whether it is taken.
    fn begin_jog(&mut self, client: usize, axis: usize, velocity: f64) -> Result<bool, Found> {
        let Some(Reply::Jogs(number)) = self.act(client, Act::Jog { axis, velocity })? else {
            return Ok(false);
        };
        self.tally.effects.count(Effect::Jogged);
        self.axes.iter_mut().for_each(|axis| axis.jogs = None);
        let now = self.now();
        (self.axes[axis].jogs, self.axes[axis].begun) = (Some(now + HOLD_LIMIT), now);
        let own = &mut self.clients[client];
        if let Some(before) = own.jog.replace(number) {
            own.former = before;
        }
        Ok(true)
    }

    /// What a client does by itself: it holds its jog, or shows that it is there.
    fn rhythm(&mut self, client: usize) -> Judged {
        let own = &mut self.clients[client];
        if self.turn < own.silent.max(own.next) {
            return Ok(());
        }
        if let Some(shell) = own.shell {
            own.next = self.turn + SHELL;
            return self.shell(client, shell);
        }
        // A panel is as regular as its timer, a page is not.
        own.next = self.turn + if client == 0 { 60 } else { 40 + self.turn * 7 % 45 };
        if self.operator.is_none_or(|(operator, _)| operator != client) {
            return Ok(());
        }
        let Some(jog) = own.jog.filter(|_| own.holds) else {
            return self.request(client, Request::State { since: u64::MAX }, true).map(drop);
        };
        let axis = self.jogs();
        match self.act(client, Act::Hold { jog })? {
            Some(_) => {
                self.tally.effects.count(Effect::Held);
                let until = self.now() + HOLD_LIMIT;
                if let Some(axis) = axis {
                    self.axes[axis].jogs = Some(until);
                }
            }
            None => self.clients[client].jog = None,
        }
        Ok(())
    }

    /// One look of a process of the shell, and what it does then.
    fn shell(&mut self, client: usize, mut shell: Shell) -> Judged {
        let turn = self.turn;
        let is_operator = |run: &Run| run.operator.is_some_and(|(operator, _)| operator == client);
        if shell.once == Once::Stop {
            self.request(client, Request::StopAxis(shell.axis), true)?;
            return self.exits(client);
        }
        if let Some(until) = shell.takes {
            let name = "shell".to_owned();
            if self.request(client, Request::Take { name }, true)?.is_none() {
                let state = self.state();
                return if state.operator.is_some() || turn > until { self.exits(client) } else { Ok(()) };
            }
            shell.takes = None;
        } else if self.request(client, Request::State { since: u64::MAX }, true)?.is_none() {
            return self.exits(client);
        }
        if !is_operator(self) {
            // It was held for too long, or its request was refused for that.
            return self.exits(client);
        }
        if shell.over {
            let rests = self.state().axes.iter().all(|axis| axis.commands.is_empty());
            if rests {
                self.request(client, Request::Leave, true)?;
                return self.exits(client);
            }
            return Ok(());
        }
        match (shell.waits, shell.ended) {
            (Some(_), None) if shell.jogs.is_none() => {}
            (Some(_), Some(how)) => {
                (shell.waits, shell.ended) = (None, None);
                shell.over = shell.given || how != Ended::Done;
                if shell.given && how == Ended::Done {
                    self.tally.effects.count(Effect::Once);
                }
            }
            _ => {}
        }
        if let Some((until, held)) = shell.jogs {
            self.shell_jogs(client, &mut shell, until, held)?;
        } else if shell.waits.is_none() && !shell.over {
            self.shell_orders(client, &mut shell)?;
        }
        if let Some(own) = &mut self.clients[client].shell {
            // The end of the command that it has just given comes later.
            *own = shell;
        }
        Ok(())
    }

    /// It holds its jog, or lets it go.
    fn shell_jogs(&mut self, client: usize, shell: &mut Shell, until: u64, held: u64) -> Judged {
        let Some(jog) = self.clients[client].jog else {
            shell.over = true;
            return Ok(());
        };
        if self.turn >= until {
            self.clients[client].jog = None;
            let runs = self.state().jog.is_some();
            self.act(client, Act::Release { jog })?;
            if runs {
                self.stopped()
            } else {
                self.jogs_end()
            }
            (shell.jogs, shell.over) = (None, true);
        } else if self.turn >= held + SHELL_HOLDS {
            let axis = shell.axis;
            shell.jogs = Some((until, self.turn));
            if self.act(client, Act::Hold { jog })?.is_some() {
                self.tally.effects.count(Effect::Held);
                self.axes[axis].jogs = Some(self.now() + HOLD_LIMIT);
            } else {
                self.clients[client].jog = None;
                (shell.jogs, shell.over) = (None, true);
            }
        }
        Ok(())
    }

    /// What its axis needs next, or its own command.
    fn shell_orders(&mut self, client: usize, shell: &mut Shell) -> Judged {
        let axis = shell.axis;
        let needed = self.way_back(axis);
        let resets = matches!(needed, Some(Order::Reset | Order::ResetFault));
        let own = match (shell.once, needed) {
            (Once::Reset, Some(reset)) if resets => Some(reset),
            (Once::Reset, _) => None,
            (Once::Disable, _) => Some(Order::Disable),
            // It is refused before anything is commanded.
            (_, Some(_)) if resets => None,
            (Once::Enable, _) => Some(Order::Enable),
            (Once::Home, Some(Order::Enable)) => return self.shell_order(client, shell, Order::Enable),
            (Once::Home, _) => Some(Order::Home),
            (_, Some(needed)) => return self.shell_order(client, shell, needed),
            (Once::Step { percent, speed }, None) => {
                let most = self.machine.scales[axis].velocity;
                Some(Order::step(f64::from(percent) / 1_000.0 * most, f64::from(speed) / 100.0 * most))
            }
            (Once::Jog { percent, ms }, None) => {
                let velocity = f64::from(percent) / 100.0 * self.machine.scales[axis].velocity;
                let begun = self.begin_jog(client, axis, velocity)?;
                (shell.given, shell.over) = (true, !begun);
                shell.jogs = begun.then_some((self.turn + u64::from(ms), self.turn));
                return Ok(());
            }
            (Once::Stop, _) => unreachable!("it takes nobody's place"),
        };
        // A fault and a latch are reset one after the other.
        shell.given = !(shell.once == Once::Reset && own == Some(Order::ResetFault));
        match own {
            Some(order) => self.shell_order(client, shell, order),
            None => {
                shell.over = true;
                Ok(())
            }
        }
    }

    fn shell_order(&mut self, client: usize, shell: &mut Shell, order: Order) -> Judged {
        match self.order(client, shell.axis, order)? {
            Some(id) => shell.waits = Some(id),
            None => shell.over = true,
        }
        Ok(())
    }

    /// A client's process has ended, and its connection with it.
    fn exits(&mut self, client: usize) -> Judged {
        self.clients[client].shell = None;
        self.deed(client, Deed::Leave)
    }

    /// The axis whose jog was begun last.
    fn jogs(&self) -> Option<usize> {
        (0..AXES).filter(|axis| self.axes[*axis].jogs.is_some()).max_by_key(|axis| self.axes[*axis].jogs)
    }

    fn step(&mut self) -> Judged {
        for client in 0..2 {
            self.rhythm(client)?;
        }
        for axis in 0..AXES {
            let (may, turn) = (&mut self.axes[axis], self.turn);
            if may.unplugged.take_if(|until| turn >= *until).is_some() {
                self.machine.plug(axis, true);
            }
            if self.axes[axis].lossy.take_if(|until| turn >= *until).is_some() {
                self.machine.lose(axis, 0, 0);
            }
        }
        self.machine.step();
        self.turn += 1;
        self.tally.turns += 1;
        if self.turn >= self.deaf && self.turn.is_multiple_of(LOOK) {
            let now = self.now();
            self.operation.tick(now);
            self.looked = now;
        }
        let state = self.state();
        self.since = state.notices.last().map_or(self.since, |notice| notice.number);
        for notice in &state.notices {
            self.tell(|| format!("axis {:?}: {}", notice.axis, notice.text));
            let (Some(axis), Some(end)) = (notice.axis, &notice.end) else { continue };
            match end.how {
                Ended::Done => self.tally.done += 1,
                Ended::Failed => self.tally.failed += 1,
                Ended::Aborted => self.tally.aborted += 1,
            }
            self.axes[axis].moves.take_if(|id| *id == end.command);
            for shell in self.clients.iter_mut().filter_map(|client| client.shell.as_mut()) {
                if (shell.axis, shell.waits) == (axis, Some(end.command)) {
                    shell.ended = Some(end.how);
                }
            }
        }
        if self.operator.is_some() && self.operator().is_none() {
            self.operator = None;
            self.tally.effects.count(Effect::FellSilent);
            self.stopped();
        }
        for axis in 0..AXES {
            self.judge(axis, &state.axes[axis])?;
        }
        Ok(())
    }

    fn judge(&mut self, axis: usize, state: &AxisState) -> Judged {
        let truth = self.machine.truth(axis);
        let (now, deaf, operates) = (self.now(), self.turn <= self.deaf + LOOK, self.operator.is_some());
        let moves = truth.powered && truth.velocity.abs() > self.machine.scales[axis].still;
        let hold = self.machine.shape.hold;
        // The dead-man time ends a jog that is held, and not renewed because nobody looks; its begin counts, too.
        let renewed = self.axes[axis].begun.max(self.looked) + DEADMAN.as_nanos() as u64 + LOOK * MS;
        let link = self.machine.sim.feedback(axis).link;
        let may = &mut self.axes[axis];
        if link != Link::Online {
            may.bad = may.bad.max(self.turn + 20);
        }
        let reached = self.turn > may.bad;
        let jogs = may.jogs.is_some_and(|until| now <= until.min(renewed));
        // While nobody looks, steps and homings end as they would.
        let commanded =
            jogs || may.moves.is_some() || deaf && !state.commands.is_empty() && may.jogs.is_none();
        let counts = |counter: &mut u32, holds: bool| {
            *counter = if holds { *counter + u32::from(reached) } else { 0 };
            *counter > RESTS
        };
        let unheld = counts(&mut may.unheld, moves && !commanded);
        let on = truth.powered && !hold && !deaf && !may.kept;
        may.left = if operates || !on && !moves { 0 } else { may.left + u32::from(reached) };
        let left = may.left > 2 * RESTS;
        let rule = match (unheld, left) {
            (true, _) => "held",
            (_, true) => "left",
            _ => return Ok(()),
        };
        let feedback = self.machine.sim.feedback(axis);
        Err(self.found(axis, rule, format!("{truth:?}; {state:?}; {feedback:?}")))
    }

    fn take(&mut self, step: &Step) -> Judged {
        let axis = usize::from(step.axis);
        self.tell(|| format!("axis {axis}: {:?}", step.op));
        let turn = self.turn;
        let bad = |run: &mut Run, turns: u64| {
            let may = &mut run.axes[axis];
            may.bad = may.bad.max(turn + turns + GRACE);
        };
        match &step.op {
            Op::Operate { client, deed } => self.deed(usize::from(*client), *deed)?,
            Op::Unplug(turns) => {
                self.machine.plug(axis, false);
                self.axes[axis].unplugged = Some(turn + u64::from(*turns));
                bad(self, (*turns).into());
            }
            Op::Lose { requests, replies } => {
                self.machine.lose(axis, (*requests).into(), (*replies).into());
                let turns = u64::from(requests + replies);
                self.axes[axis].lossy = Some(turn + turns);
                bad(self, turns);
            }
            Op::OpenSto(ms) => self.machine.open_sto(axis, u64::from(*ms) * MS),
            Op::Fault => self.machine.provoke(axis),
            Op::Late(slots) => self.machine.skip((*slots).into()),
            Op::Deaf(turns) => self.deaf = self.deaf.max(turn + u64::from(*turns)),
            Op::Die(ms) => self.die((*ms).into()),
            other => unreachable!("{other:?} is nothing that happens to operators"),
        }
        Ok(())
    }

    /// The master's process dies, and with it all that its operators had; another one starts.
    fn die(&mut self, ms: u64) {
        if self.operator.take().is_some() {
            self.tally.effects.count(Effect::OperatedDied);
        }
        // Its axes are dropped before the loop that they belong to.
        self.operation = Operation::new(Vec::new());
        self.machine.replace_master(ms);
        let axes = (0..AXES).map(|axis| Operated::new(self.machine.sim.take_axis(axis), Vec::new()));
        self.operation = Operation::new(axes.collect());
        (self.since, self.deaf, self.looked) = (0, 0, self.now());
        self.stopped();
        for client in &mut self.clients {
            self.sessions += 1;
            *client = Client::new(self.sessions);
        }
        for axis in &mut self.axes {
            axis.bad = axis.bad.max(self.turn + ms + GRACE);
            axis.kept = false;
        }
    }

    fn deed(&mut self, client: usize, deed: Deed) -> Judged {
        if self.turn < self.clients[client].silent && !matches!(deed, Deed::Leave) {
            return Ok(());
        }
        let velocity = |run: &Run, axis: u8, percent: i8| {
            f64::from(percent) / 100.0 * run.machine.scales[usize::from(axis)].velocity
        };
        match deed {
            Deed::Take => {
                let name = ["panel", "page"][client].to_owned();
                self.request(client, Request::Take { name }, true)?;
            }
            Deed::Leave => {
                let own = &mut self.clients[client];
                self.operation.leave(own.session);
                self.sessions += 1;
                if own.shell.is_some_and(|shell| !shell.over) {
                    self.tally.effects.count(Effect::OnceKilled);
                }
                *own = Client { former: own.former, ..Client::new(self.sessions) };
                if self.operator.take_if(|(operator, _)| *operator == client).is_some() {
                    self.tally.effects.count(Effect::Left);
                    self.stopped();
                }
            }
            Deed::Silent(ms) => self.clients[client].silent = self.turn + u64::from(ms),
            Deed::LetGo => self.clients[client].holds = false,
            Deed::Release => {
                if let Some(jog) = self.clients[client].jog.take() {
                    let runs = self.state().jog.is_some();
                    self.act(client, Act::Release { jog })?;
                    if self.operator.is_some_and(|(operator, _)| operator == client) {
                        // One that has ended by itself stops nothing else any more.
                        if runs { self.stopped() } else { self.jogs_end() }
                    }
                }
            }
            Deed::Stop => drop(self.request(client, Request::Stop, true)?),
            Deed::Jog { axis, percent } => {
                let velocity = velocity(self, axis, percent);
                if self.begin_jog(client, axis.into(), velocity)? {
                    let own = &mut self.clients[client];
                    (own.holds, own.next) = (true, self.turn + 50);
                }
            }
            Deed::Step { axis, percent } => {
                let distance = velocity(self, axis, percent) / 10.0;
                let fast = velocity(self, axis, 90);
                self.order(client, axis.into(), Order::step(distance, fast))?;
            }
            Deed::Home(axis) => {
                self.order(client, axis.into(), Order::Home)?;
            }
            Deed::Disable(axis) => {
                self.order(client, axis.into(), Order::Disable)?;
            }
            Deed::Ready(axis) => {
                if let Some(order) = self.way_back(axis.into()) {
                    self.order(client, axis.into(), order)?;
                }
            }
            Deed::Former => {
                let own = &self.clients[client];
                let jog = own.former;
                if own.jog != Some(jog) && self.act(client, Act::Hold { jog })?.is_some() {
                    return Err(self.found(
                        0,
                        "turn",
                        format!("client {client} holds jog {jog}, which has ended"),
                    ));
                }
            }
            Deed::OutOfTurn => drop(self.request(client, Request::State { since: u64::MAX }, false)?),
            Deed::HandBack => drop(self.request(client, Request::Leave, true)?),
            // One process at a time.
            Deed::Once { axis, once } => {
                let own = &mut self.clients[client];
                if own.shell.is_none() {
                    let takes = Some(self.turn + SHELL_TAKES);
                    let (waits, ended, jogs, given, over) = (None, None, None, false, false);
                    own.shell =
                        Some(Shell { axis: axis.into(), once, takes, waits, ended, jogs, given, over });
                    own.next = self.turn;
                }
            }
        }
        Ok(())
    }

    /// What an axis needs next to be ready.
    fn way_back(&self, axis: usize) -> Option<Order> {
        let feedback = self.machine.sim.feedback(axis);
        let homes = self.machine.plans[axis].limits.position.is_some();
        match feedback.stopped {
            _ if feedback.status.fault != 0 => Some(Order::ResetFault),
            Some(_) => Some(Order::Reset),
            None if !feedback.is_operational() => Some(Order::Enable),
            None if homes && !feedback.status.homed => Some(Order::Home),
            None => None,
        }
    }

    /// The first client becomes the operator and makes all axes ready; false if one of them cannot be brought there.
    fn ready(&mut self) -> Result<bool, Found> {
        for _ in 0..UP {
            if self.machine.online() {
                break;
            }
            self.step()?;
        }
        for turn in 0..READY {
            if self.operator() != Some(0) {
                self.deed(0, Deed::Take)?;
            }
            let state = self.state();
            let rests = |axis: &AxisState| axis.commands.is_empty() && !axis.stopping;
            if self.operator() == Some(0) && state.axes.iter().all(rests) && turn % 20 == 0 {
                let next = (0..AXES).find_map(|axis| Some((axis, self.way_back(axis)?)));
                let Some((axis, order)) = next else { return Ok(true) };
                self.order(0, axis, order)?;
            }
            self.step()?;
        }
        Ok(false)
    }

    /// Both leave: all axes come to rest, and somebody else may take them.
    fn settle(&mut self) -> Result<bool, Found> {
        self.deaf = self.deaf.min(self.turn);
        for axis in &mut self.axes {
            axis.unplugged = axis.unplugged.map(|_| 0);
            axis.lossy = axis.lossy.map(|_| 0);
        }
        for client in 0..2 {
            self.deed(client, Deed::Leave)?;
        }
        for _ in 0..SETTLED {
            self.step()?;
            if self.machine.online() && !self.operation.is_active() {
                return Ok(true);
            }
        }
        match self.operation.is_active() {
            true => {
                let state = self.state();
                Err(self.found(0, "take", format!("nobody can take them: {state:?}")))
            }
            false => Ok(false),
        }
    }
}
