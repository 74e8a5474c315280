//! Colours of what people read. Texts have them in their alternate form (`{:#}`) only, which the program prints through
//! `anstream`: it takes them out where standard output is no terminal, where NO_COLOR is set and where TERM is `dumb`.

use anstyle::{AnsiColor, Style};

/// The style of failures.
pub const BAD: Style = AnsiColor::Red.on_default().bold();

/// The text, in this style if it is wanted.
pub fn paint(text: &str, style: Style, wanted: bool) -> String {
    if wanted && !text.is_empty() { format!("{style}{text}{style:#}") } else { text.to_owned() }
}
