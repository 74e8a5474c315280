//! `fieldbeat completions` and `fieldbeat man`: generated from the arguments themselves.

use std::path::PathBuf;

use clap::{Args, Command, CommandFactory};
use clap_complete::Shell;
use clap_mangen::Man;

use super::{Arguments, Stop, print};

/// Arguments of `completions`.
#[derive(Debug, Args)]
pub struct Completions {
    /// The shell.
    shell: Shell,
}

impl Completions {
    /// Prints the script.
    pub fn run(self) -> Result<(), Stop> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut Arguments::command(), "fieldbeat", &mut script);
        print(String::from_utf8_lossy(&script).trim_end())
    }
}

/// Arguments of `man`.
#[derive(Debug, Args)]
pub struct Manual {
    /// Write a page for each command into this directory; without it, all of them go to standard output as one.
    #[arg(long, value_name = "DIR")]
    dir: Option<PathBuf>,
}

impl Manual {
    /// Prints or writes it.
    pub fn run(self) -> Result<(), Stop> {
        let mut program = Arguments::command();
        if let Some(dir) = &self.dir {
            let failed = |error| {
                Stop::failed(format!("cannot write to {}: {error}; name another directory", dir.display()))
            };
            std::fs::create_dir_all(dir).map_err(failed)?;
            return clap_mangen::generate_to(program, dir).map_err(failed);
        }
        program.build();
        let mut page = Vec::new();
        Man::new(program.clone()).render(&mut page).map_err(Stop::failed)?;
        sections(&program, &mut page).map_err(Stop::failed)?;
        print(String::from_utf8_lossy(&page).trim_end())
    }
}

/// A section for each command below `parent`, with those below it.
fn sections(parent: &Command, page: &mut Vec<u8>) -> std::io::Result<()> {
    for command in parent.get_subcommands().filter(|command| command.get_name() != "help") {
        let name = command.get_bin_name().unwrap_or(command.get_name());
        page.extend_from_slice(format!(".SH {}\n", name.to_uppercase()).as_bytes());
        let man = Man::new(command.clone());
        let mut parts = Vec::new();
        man.render_description_section(&mut parts)?;
        man.render_synopsis_section(&mut parts)?;
        man.render_options_section(&mut parts)?;
        page.extend_from_slice(String::from_utf8_lossy(&parts).replace(".SH ", ".SS ").as_bytes());
        sections(command, page)?;
    }
    Ok(())
}
