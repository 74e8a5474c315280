//! `fieldbeat config`: what concerns configurations and no machine.

use clap::{Args, Subcommand};

use super::{Stop, print};

/// Arguments of `config`.
#[derive(Debug, Args)]
pub struct Config {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Prints the JSON schema of a configuration, by which editors complete keys and flag mistakes.
    Schema,
    /// Prints the reference of all keys: name, default and meaning, in Markdown.
    Keys {
        /// Only this section: `cycle`, `bus.drive`, `linudp-v2 bus.drive` ...
        section: Option<String>,
    },
}

impl Config {
    /// Runs it.
    pub fn run(self) -> Result<(), Stop> {
        match self.what {
            What::Schema => print(format_args!("{:#}", fieldbeat_config::schema::schema())),
            What::Keys { section } => keys(section.as_deref()),
        }
    }
}

/// Prints the reference of one section, or of all.
fn keys(section: Option<&str>) -> Result<(), Stop> {
    let all = fieldbeat_config::reference();
    let wanted = |name: &str| section.is_none_or(|section| section == name);
    let text: String = all
        .iter()
        .filter(|(name, _)| wanted(name))
        .map(
            |(name, table)| if section.is_some() { table.clone() } else { format!("## {name}\n\n{table}\n") },
        )
        .collect();
    if text.is_empty() {
        let names: Vec<&str> = all.iter().map(|(name, _)| name.as_str()).collect();
        return Err(Stop::usage(format!("no such section; there are: {}", names.join(", "))));
    }
    print(text.trim_end())
}
