//! The command line: one file a command, no logic that a user of the library would want. Signals are handled here.
//!
//! Exit codes: 0 done, 1 the run failed, a drive was lost or left on, or the host is not ready, 2 bad arguments or
//! configuration.

mod axis;
mod blackbox;
mod check;
mod config;
mod decode;
mod demo;
mod doctor;
mod export;
mod handler;
mod init;
mod interrupt;
#[cfg_attr(not(feature = "jog"), path = "without/jog.rs")]
mod jog;
mod live;
mod manual;
mod masters;
mod meter;
mod operating;
mod output;
mod own;
mod param;
mod pin;
mod reach;
mod replay;
mod run;
#[cfg_attr(not(feature = "scope"), path = "without/scope.rs")]
mod scope;
mod service;
mod serving;
mod sim;
mod soak;
mod status;
mod tools;

use std::io::Write;
use std::process::ExitCode;
use std::time::Duration;

use anstyle::AnsiColor;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{CommandFactory, Parser, Subcommand};
use fieldbeat_master::guardian_main;
use fieldbeat_tools::Stop;
use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// With the commit that it was built from, where that is known.
const VERSION: &str = env!("FIELDBEAT_VERSION");

/// The description in the help and in the manual page.
const ABOUT: &str = "Hard-real-time cyclic master for servo drives: one pinned SCHED_FIFO loop, many drives, \
     measured latency";

/// A hard-real-time cyclic master for servo drives.
///
/// Not a safety function: a machine needs its own STO / emergency stop.
#[derive(Debug, Parser)]
#[command(name = "fieldbeat", version = VERSION, about = ABOUT, max_term_width = 100)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Master and simulated drives in one process: homes the axes and moves them in a travelling wave.
    Demo(demo::Demo),
    /// The drives of CONFIG, simulated, in this process.
    Sim(sim::Sim),
    /// The master of CONFIG: brings the drives online and exchanges with them every cycle.
    Run(run::Run),
    /// The master of CONFIG for hours or days: moves the axes, keeps checkpoints, and ends with a verdict.
    Soak(soak::SoakTest),
    /// The plan of CONFIG in words or as JSON; refuses what cannot work, with the reason.
    Check(check::Check),
    /// By what the drives of CONFIG are known, as they report it; writes it into CONFIG on request, and to no drive.
    Pin(pin::Pin),
    /// A first configuration by questions; looks for the drives if that is wanted, and moves nothing.
    Init(init::Init),
    /// The keys of a configuration as a JSON schema.
    Config(config::Config),
    /// The state of a running master, and what it measured so far.
    Status(status::Status),
    /// One command of an axis: enable, disable, home, move, jog, stop, reset; through the running master or by one of
    /// its own.
    Axis(axis::Axis),
    #[command(flatten)]
    Jog(jog::Command),
    /// Parameters of a drive: through its running master, or else by a master of its own that moves nothing.
    Param(param::Param),
    #[command(flatten)]
    Scope(scope::Command),
    #[command(flatten)]
    Added(tools::Added),
    /// What led up to a failure, from the file that the master's black box wrote, or to the end of a recording.
    Blackbox(blackbox::BlackBox),
    /// A recording, or a file of the black box, as tables or as a capture.
    Export(export::Export),
    /// A capture of the wires in words, telegram by telegram, whoever made it.
    Decode(decode::Decode),
    /// A recorded run through the same loop in virtual time, compared bit by bit.
    Replay(replay::Replay),
    /// How well this host suits real time, and how to fix it; changes nothing.
    Doctor(doctor::Doctor),
    /// The script that completes the arguments of this program in a shell.
    Completions(manual::Completions),
    /// The manual page of this program.
    Man(manual::Manual),
}

/// Parses the arguments and runs the command; or is the guardian of a master.
pub fn main() -> ExitCode {
    guardian_main();
    // As many descriptors as this process may have: those of status and metrics never take the last one of a drive.
    if let Ok((_, hard)) = getrlimit(Resource::RLIMIT_NOFILE) {
        // Refused, it is what it was.
        let _ = setrlimit(Resource::RLIMIT_NOFILE, hard, hard);
    }
    let result = arguments().and_then(|arguments| match arguments.command {
        Command::Demo(demo) => demo.run(),
        Command::Sim(sim) => sim.run(),
        Command::Run(run) => run.run(),
        Command::Soak(soak) => soak.run(),
        Command::Check(check) => check.run(),
        Command::Pin(pin) => pin.run(),
        Command::Init(init) => init.run(),
        Command::Config(config) => config.run(),
        Command::Status(status) => status.run(),
        Command::Axis(axis) => axis.run(),
        Command::Jog(jog) => jog.run(),
        Command::Param(param) => param.run(),
        Command::Scope(scope) => scope.run(),
        Command::Added(added) => added.run(),
        Command::Blackbox(blackbox) => blackbox.run(),
        Command::Export(export) => export.run(),
        Command::Decode(decode) => decode.run(),
        Command::Replay(replay) => replay.run(),
        Command::Doctor(doctor) => doctor.run(),
        Command::Completions(completions) => completions.run(),
        Command::Man(manual) => manual.run(),
    });
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(stop) => {
            stop.message.lines().for_each(report);
            ExitCode::from(stop.code)
        }
    }
}

/// The arguments; a mistake in them is one line, like every other. Help is printed and ends the program.
fn arguments() -> Result<Arguments, Stop> {
    Arguments::try_parse().map_err(|error| {
        if !matches!(
            error.kind(),
            ErrorKind::DisplayHelp
                | ErrorKind::DisplayVersion
                | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
        ) {
            let known = negative_time(&error).or_else(|| left_out(&error));
            return Stop::usage(known.unwrap_or_else(|| one_line(&error.render().to_string())));
        }
        error.exit()
    })
}

/// The mistake is a time below 0, which is taken for an option: its first character, or all of it.
fn negative_time(error: &clap::Error) -> Option<String> {
    let ContextValue::String(taken) = error.get(ContextKind::InvalidArg)? else { return None };
    let words = std::env::args_os().filter_map(|word| word.into_string().ok());
    let mut times = words.filter_map(|word| {
        let time = word.strip_prefix('-').filter(|time| span(time).is_ok())?;
        word.starts_with(taken.as_str()).then(|| time.to_owned())
    });
    let time = times.next()?;
    Some(format!("-{time} is no time: a time is not below 0; write {time}"))
}

/// The mistake is to want what this program was built without.
fn left_out(error: &clap::Error) -> Option<String> {
    const OUTSIDE: [&str; 2] = ["jog", "scope"];
    let wanted = [ContextKind::InvalidSubcommand, ContextKind::InvalidArg].into_iter();
    let ContextValue::String(wanted) = wanted.filter_map(|kind| error.get(kind)).next()? else { return None };
    let feature = OUTSIDE.into_iter().find(|feature| wanted.trim_start_matches("--") == *feature)?;
    Some(format!(
        "this program was built without `{wanted}`: `cargo build --release --features {feature}` builds one \
         that has it"
    ))
}

/// clap's message up to its usage, and the command whose help says more.
fn one_line(message: &str) -> String {
    let what = message.split("Usage:").next().unwrap_or_default();
    let what = what.split("For more information").next().unwrap_or_default();
    let mut line = String::new();
    for part in what.lines().map(str::trim).filter(|part| !part.is_empty()) {
        let between = match line.as_bytes().last() {
            None => "",
            Some(b':') => " ",
            Some(_) => "; ",
        };
        line = line + between + part.trim_start_matches("error: ").trim_start_matches("tip: ");
    }
    let (all, mut named) = (Arguments::command(), "fieldbeat".to_owned());
    let mut command = &all;
    for word in std::env::args_os().skip(1) {
        let Some(next) = command.find_subcommand(word) else { break };
        named = named + " " + next.get_name();
        command = next;
    }
    format!("{line}; see `{named} --help`")
}

/// Prints to standard output. A reader that has gone away (`| head`) is no error; a full disk is, since the
/// requested output is lost.
fn print(text: impl std::fmt::Display) -> Result<(), Stop> {
    print_to(&mut std::io::stdout().lock(), format_args!("{text}"))
}

/// The same in the colours of the text's alternate form, where a terminal shows them.
fn show(text: impl std::fmt::Display) -> Result<(), Stop> {
    print_to(&mut anstream::stdout().lock(), format_args!("{text:#}"))
}

fn print_to(out: &mut impl Write, text: std::fmt::Arguments<'_>) -> Result<(), Stop> {
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(Stop::failed(format!("cannot write to standard output: {error}; look at where it leads")))
        }
        _ => Ok(()),
    }
}

/// A line of its own on standard error. `eprintln!` would panic where nobody reads it.
fn complain(line: &str) {
    let _ = writeln!(std::io::stderr().lock(), "fieldbeat: {line}");
}

/// The same for an error, which a terminal shows in colour.
fn report(line: &str) {
    let style = AnsiColor::Red.on_default().bold();
    let _ = writeln!(anstream::stderr().lock(), "{style}fieldbeat:{style:#} {line}");
}

/// A configuration file, or the reasons why it is none.
fn configuration(path: &std::path::Path) -> Result<fieldbeat_config::Configuration, Stop> {
    fieldbeat_config::load(path).map_err(Stop::usage)
}

/// The machine of a configuration file.
fn load(path: &std::path::Path) -> Result<fieldbeat_core::cycle::Plan, Stop> {
    configuration(path).map(|read| read.plan)
}

/// A span on the command line: a number and its unit, as in the configuration.
fn span(text: &str) -> Result<Duration, String> {
    fieldbeat_config::duration(text).map_err(|why| why.to_string())
}
