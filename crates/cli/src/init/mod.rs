//! `fieldbeat init`: a first configuration by questions.
//!
//! | file | what |
//! |---|---|
//! | `ask` | questions at the terminal, answers from a pipe, defaults |
//! | `draft` | the file as far as it is answered, its comments, and what the reader says of it |
//!
//! The outline of each protocol lists its keys; [`common`] has those of every drive.

mod ask;
mod draft;

use std::fs;
use std::net::SocketAddrV4;
use std::path::{Path, PathBuf};

use clap::Args;
use fieldbeat_config::PROTOCOLS;
use fieldbeat_keys::Protocol;
use fieldbeat_keys::outline::{Found, Known, Line, Outline, Unit, Usual, addresses};
use fieldbeat_record::file::{Place, save, save_new};

use self::ask::Answers;
use self::draft::{Block, Draft};
use super::Stop;

/// The most drives that it configures.
const MOST_DRIVES: usize = 128;
/// The longest period that is tried where the usual one does not do.
const LONGEST_MS: u64 = 512;

/// The keys that every drive has, behind its name and its address.
fn common(unit: Unit) -> [Line; 10] {
    [
        Line::ask(
            "units",
            "Unit of length: mm or rev",
            Usual::From(|known| Some(known.unit.name.to_owned())),
        ),
        Line::ask("scale", unit.counts, Usual::From(scale)),
        Line::ask(
            "limits.velocity",
            "Largest velocity, units/s",
            Usual::From(|known| of_unit(known, "100", "1")),
        ),
        Line::ask(
            "limits.acceleration",
            "Largest acceleration, units/s²",
            Usual::From(|known| times(known, "limits.velocity", 5.0)),
        ),
        Line::ask(
            "profile.velocity",
            "Velocity of a move, units/s",
            Usual::From(|known| times(known, "limits.velocity", 0.5)),
        ),
        Line::ask(
            "profile.acceleration",
            "Acceleration of a move, units/s²",
            Usual::From(|known| times(known, "limits.acceleration", 0.5)),
        ),
        Line::ask(
            "stop.how",
            "How an axis is stopped: ramp, quick (the drive's own) or coast (power off at once)",
            Usual::Is("ramp"),
        ),
        Line::ask(
            "stop.deceleration",
            "Deceleration of that ramp, units/s²",
            Usual::From(|known| (known.answer)("limits.acceleration")),
        ),
        Line::ask("load", "Load: level, or vertical if it drops when nothing holds it", Usual::Is("level")),
        Line::ask("held_by", "What holds it: brake, or drive (never powered off then)", Usual::Needed)
            .only_if("load", "vertical"),
    ]
}

const NAME: &str = "name";

/// The scale of the usual unit. That of another one has to be known.
fn scale(known: &Known<'_>) -> Option<String> {
    let Unit { name, scale, .. } = known.unit;
    ((known.answer)("units").as_deref() == Some(name)).then(|| scale.to_owned())
}

fn of_unit(known: &Known<'_>, mm: &str, rev: &str) -> Option<String> {
    Some(if (known.answer)("units").as_deref() == Some("mm") { mm } else { rev }.to_owned())
}

/// `factor` times an answer that is a number.
fn times(known: &Known<'_>, key: &str, factor: f64) -> Option<String> {
    let answer: f64 = (known.answer)(key)?.parse().ok()?;
    Some((factor * answer).to_string())
}

/// Arguments of `init`.
#[derive(Debug, Args)]
pub struct Init {
    /// The file to write.
    #[arg(default_value = "machine.toml")]
    file: PathBuf,
    /// Take every default; nothing is asked, and nothing is sent to any drive.
    #[arg(long)]
    yes: bool,
    /// The protocol, by its name.
    #[arg(long, value_parser = protocol)]
    protocol: Option<&'static Protocol>,
    /// Replace the file if it is there.
    #[arg(long)]
    force: bool,
}

/// A protocol by its name, or by its place in the list.
fn protocol(text: &str) -> Result<&'static Protocol, String> {
    let by_place = text.parse().ok().and_then(|place: usize| PROTOCOLS.get(place.checked_sub(1)?));
    let found = PROTOCOLS.iter().find(|protocol| protocol.name == text).or(by_place);
    found.ok_or_else(|| {
        let names: Vec<&str> = PROTOCOLS.iter().map(|protocol| protocol.name).collect();
        format!("must be one of {}", names.join(", "))
    })
}

impl Init {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        let file = self.file.display();
        if !self.force && fs::symlink_metadata(&self.file).is_ok() {
            return Err(Stop::usage(format!(
                "{file} is there already; name another file, or replace it by --force"
            )));
        }
        // Known before the first question.
        let _place = Place::of_file(&self.file).map_err(|why| {
            Stop::usage(format!("{file} cannot be written: {why}; name a file where this user may write"))
        })?;
        let answers = Answers::new(self.yes)?;
        let protocol = match self.protocol {
            Some(protocol) => protocol,
            None => ask_protocol(&answers)?,
        };
        let text = Interview::new(&answers, protocol).run(&file.to_string())?;
        if let Err(why) = write(&self.file, &text, self.force) {
            // The answers are not to be given again.
            answers.say(&text)?;
            return Err(why);
        }
        answers.say(&format!(
            "{file} is written. Before the first motion: is the emergency stop of the machine in place?\n\
             fieldbeat check {file}    the plan in words\n\
             fieldbeat sim {file}      its drives, simulated (give them 127.x.y.z addresses for a trial)\n\
             fieldbeat run {file}      the master"
        ))
    }
}

/// Whole or not at all, and never in the place of another file unless that is wanted.
fn write(path: &Path, text: &str, force: bool) -> Result<(), Stop> {
    let written = if force { save(path, text.as_bytes()) } else { save_new(path, text.as_bytes()) };
    written.map_err(|error| {
        Stop::failed(format!("{} cannot be written: {error}; its text is above", path.display()))
    })
}

fn ask_protocol(answers: &Answers) -> Result<&'static Protocol, Stop> {
    for (place, protocol) in (1..).zip(&PROTOCOLS) {
        answers.say(&format!("{place}  {:<12} {}", protocol.name, protocol.drives))?;
    }
    loop {
        match protocol(&answers.ask("Protocol", PROTOCOLS[0].name)?) {
            Ok(protocol) => return Ok(protocol),
            Err(why) => answers.say(&format!("  {why}"))?,
        }
    }
}

/// The questions of one protocol, in their order.
struct Interview<'a> {
    answers: &'a Answers,
    outline: &'static Outline,
    draft: Draft,
}

impl<'a> Interview<'a> {
    fn new(answers: &'a Answers, protocol: &'static Protocol) -> Interview<'a> {
        let head = format!(
            "A first configuration of {}, by `fieldbeat init`. units/s are those of the drive's own `units` \
             per second. All other keys are in the reference of Fieldbeat. Fieldbeat is not a safety \
             function: the machine needs its own STO / emergency stop.",
            protocol.drives
        );
        let mut draft = Draft::new(protocol.name, head);
        draft.blocks.push(Block::new("cycle"));
        let mut bus = Block::new("bus");
        bus.lines.push(("protocol".into(), format!("\"{}\"", protocol.name)));
        draft.blocks.push(bus);
        Interview { answers, outline: &protocol.outline, draft }
    }

    /// The text of the file.
    fn run(mut self, file: &str) -> Result<String, Stop> {
        let outline = self.outline;
        self.draft.blocks[0].lines.push(("period".into(), format!("\"{}\"", outline.period)));
        self.draft.blocks[0].lines.push(("realtime".into(), "\"prefer\"".into()));
        for line in outline.bus {
            self.line(line, 0)?;
        }
        let found = self.search()?;
        self.drives(found)?;
        self.fit(file)?;
        Ok(self.draft.render().0)
    }

    /// The answer to a key: of the newest table, else of the bus.
    fn known(&self, key: &str) -> Option<String> {
        let newest = self.draft.blocks.last().and_then(|block| block.answer(key));
        newest.or_else(|| self.draft.blocks[1].answer(key))
    }

    /// Prompts for a key of the newest table until the reader takes the answer.
    fn line(&mut self, line: &Line, index: usize) -> Result<(), Stop> {
        if line.only_if.is_some_and(|(key, value)| self.known(key).as_deref() != Some(value)) {
            return Ok(());
        }
        let usual = match line.usual {
            Usual::Is(value) => Some(value.to_owned()),
            Usual::From(usual) => {
                usual(&Known { index, unit: self.outline.unit, answer: &|key| self.known(key) })
            }
            Usual::Optional => Some("none".to_owned()),
            Usual::Needed => None,
        };
        loop {
            let shown = usual.as_deref().unwrap_or_default();
            let answer = self.answers.ask(line.question, shown)?;
            if matches!(line.usual, Usual::Optional) && answer == "none" {
                return Ok(());
            }
            match self.take(line.key, &answer) {
                None => return Ok(()),
                Some(why) if self.answers.are_defaults() => {
                    return Err(Stop::usage(format!("{} = {answer}: {why}; nothing is written", line.key)));
                }
                Some(why) => self.answers.say(&format!("  {why}"))?,
            }
        }
    }

    /// Adds an answer to the newest table. What is wrong with it leaves the table as it was.
    fn take(&mut self, key: &str, answer: &str) -> Option<String> {
        if answer.is_empty() {
            return Some("must be given".into());
        }
        let path = self.draft.blocks.last()?.path;
        let value = self.draft.value(path, key, answer);
        self.draft.blocks.last_mut()?.lines.push((key.to_owned(), value));
        let mistake = self.draft.newest_mistake();
        if mistake.is_some() {
            self.draft.blocks.last_mut()?.lines.pop();
        }
        mistake
    }

    /// The drives that answer, if they are to be looked for. Without an answer there is the way by hand.
    fn search(&self) -> Result<Vec<Found>, Stop> {
        let search = self.outline.search;
        if self.answers.are_defaults() || !self.answers.agrees(search.question, search.usual)? {
            return Ok(Vec::new());
        }
        let probed = if search.probes { self.ask_addresses(search.port)? } else { Vec::new() };
        let known = Known { index: 0, unit: self.outline.unit, answer: &|key| self.known(key) };
        match (search.run)(&known, &probed, &|| self.answers.go_on()) {
            _ if !self.answers.go_on() => Err(Stop::failed("interrupted; nothing is written")),
            Err(why) => {
                self.answers.say(&format!("  {why}\n  Type in what you know."))?;
                Ok(Vec::new())
            }
            Ok(found) => {
                if found.is_empty() {
                    self.answers.say("  Nothing answers; check power and cable. Type in what you know.")?;
                }
                for one in &found {
                    self.answers.say(&format!("  {}", one.what))?;
                }
                Ok(found.into_iter().filter(|one| !one.lines.is_empty()).collect())
            }
        }
    }

    fn ask_addresses(&self, port: u16) -> Result<Vec<SocketAddrV4>, Stop> {
        loop {
            match addresses(&self.answers.ask("Addresses, like 192.168.1.10-14 192.168.1.20", "")?, port) {
                Ok(all) => return Ok(all),
                Err(why) => self.answers.say(&format!("  {why}"))?,
            }
        }
    }

    fn drives(&mut self, found: Vec<Found>) -> Result<(), Stop> {
        let count = match found.len() {
            0 => self.ask_count()?,
            found => found,
        };
        for index in 0..count {
            let given = found.get(index);
            match given {
                Some(found) => {
                    self.answers.say(&format!("Drive {} of {count}: {}", index + 1, found.what))?
                }
                None => self.answers.say(&format!("Drive {} of {count}", index + 1))?,
            }
            self.draft.blocks.push(Block::new("bus.drive"));
            self.name(index)?;
            let given = given.map_or(&[][..], |found| found.lines.as_slice());
            for line in self.outline.drive {
                self.given_or_prompted(line, given, index)?;
            }
            self.found(given)?;
            self.shared(given, index)?;
        }
        Ok(())
    }

    fn ask_count(&self) -> Result<usize, Stop> {
        loop {
            match self.answers.ask("Number of drives", "1")?.parse() {
                Ok(count @ 1..=MOST_DRIVES) => return Ok(count),
                _ => self.answers.say(&format!("  must be a whole number, 1 to {MOST_DRIVES}"))?,
            }
        }
    }

    fn name(&mut self, index: usize) -> Result<(), Stop> {
        const NAMES: Line = Line::ask(
            NAME,
            "Name of the drive",
            Usual::From(|known| Some(format!("axis{}", known.index + 1))),
        );
        self.line(&NAMES, index)
    }

    /// A found value is taken as it is; the user is prompted only where the reader refuses it.
    fn given_or_prompted(
        &mut self,
        line: &Line,
        given: &[(&'static str, String)],
        index: usize,
    ) -> Result<(), Stop> {
        if let Some((key, value)) = given.iter().find(|(key, _)| *key == line.key) {
            match self.take(key, value) {
                None => return Ok(()),
                Some(why) => self.answers.say(&format!("  {key} = {value}: {why}"))?,
            }
        }
        self.line(line, index)
    }

    /// The other found values: by them the drive is known from others.
    fn found(&mut self, given: &[(&'static str, String)]) -> Result<(), Stop> {
        let lines = self.outline.drive.iter().chain(self.outline.behind);
        let prompted: Vec<&str> = lines.map(|line| line.key).collect();
        for (key, value) in given.iter().filter(|(key, _)| !prompted.contains(key)) {
            if let Some(why) = self.take(key, value) {
                self.answers.say(&format!("  {key} = {value}: {why}"))?;
            }
        }
        Ok(())
    }

    /// The common settings of drives: that of the drive before, if it is wanted again.
    fn shared(&mut self, given: &[(&'static str, String)], index: usize) -> Result<(), Stop> {
        let shared: Vec<Line> =
            common(self.outline.unit).iter().chain(self.outline.behind).copied().collect();
        let is_shared = |key: &str| shared.iter().any(|line| line.key == key);
        let same = index > 0 && {
            let before = &self.draft.blocks[self.draft.blocks.len() - 2];
            let question = format!("All else as {}?", before.answer(NAME).unwrap_or_default());
            self.answers.agrees(&question, true)?
        };
        if same {
            let before = self.draft.blocks[self.draft.blocks.len() - 2].lines.clone();
            let own = |key: &str| given.iter().find(|(given, _)| *given == key);
            for (key, value) in before.into_iter().filter(|(key, _)| is_shared(key)) {
                let value = own(&key).map_or(value, |(_, own)| self.draft.value("bus.drive", &key, own));
                if let Some(block) = self.draft.blocks.last_mut() {
                    block.lines.push((key, value));
                }
            }
            return Ok(());
        }
        for line in &shared {
            self.given_or_prompted(line, given, index)?;
        }
        Ok(())
    }

    /// Lengthens the period until all drives fit into it. What is wrong otherwise ends it.
    fn fit(&mut self, file: &str) -> Result<(), Stop> {
        let Some(mistakes) = self.draft.mistakes(file) else { return Ok(()) };
        let answered = self.draft.render().0;
        let mut ms = 1;
        while ms <= LONGEST_MS {
            self.draft.blocks[0].lines[0].1 = format!("\"{ms}ms\"");
            if self.draft.mistakes(file).is_none() {
                let usual = self.outline.period;
                let why = format!("A period of {usual} does not suit these drives: it is {ms}ms in the file");
                return self.answers.say(&why);
            }
            ms *= 2;
        }
        // The answers are not to be given again.
        self.answers.say(&answered)?;
        Err(Stop::usage(format!("{mistakes}\nnothing is written; the text is above")))
    }
}
