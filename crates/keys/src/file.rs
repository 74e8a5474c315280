//! The files that hold a configuration, a curve or a table.

use std::fs::{self, File, Metadata};
use std::io::{self, Read};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::Path;

use super::error::{ConfigError, ConfigErrors};

/// The most that a configuration, a curve or a table may have, bytes: a hundred times what 256 drives need.
const LONGEST: u64 = 16 << 20;

/// The one pipe that is read: its writer is there, and somebody asked for it by this name.
const STANDARD_INPUT: &str = "/dev/stdin";

/// What stands for standard input on the command line, and what messages call it.
const DASH: &str = "-";
const STDIN: &str = "<stdin>";

/// A file's name and text; `kind` says what kind of file it should be, with an example. `-` is standard input.
pub fn read(path: &Path, kind: &str) -> Result<(String, String), ConfigErrors> {
    let file = if path == Path::new(DASH) { STDIN.to_owned() } else { path.display().to_string() };
    let bytes =
        regular(path, kind).map_err(|why| whole_file(&file, None, format!("cannot read {file}: {why}")))?;
    // NUL is UTF-8, but in no text: UTF-16 has it in every other place, a binary file sooner or later.
    let text_to = bytes.iter().position(|byte| *byte == 0);
    let valid_to = std::str::from_utf8(&bytes).err().map(|error| error.valid_up_to());
    match [text_to, valid_to].into_iter().flatten().min() {
        Some(end) => {
            let line = bytes[..end].iter().filter(|byte| **byte == b'\n').count() + 1;
            Err(whole_file(&file, Some(line), "not UTF-8 text; save the file as UTF-8 text".into()))
        }
        None => Ok((file, String::from_utf8_lossy(&bytes).into_owned())),
    }
}

/// The bytes of a regular file that is not too long, or of standard input by its name. Anything else is refused without
/// being opened: opening a pipe waits for its writer, and some devices act on being opened. Else why not, and the
/// remedy.
pub fn regular(path: &Path, kind: &str) -> Result<Vec<u8>, String> {
    if path == Path::new(DASH) {
        return bounded(io::stdin().lock(), kind);
    }
    let failed = |error: io::Error| unreadable(&error, kind);
    let about = fs::metadata(path).map_err(failed)?;
    if about.file_type().is_fifo() && path == Path::new(STANDARD_INPUT) {
        return bounded(io::stdin().lock(), kind);
    }
    fit(&about, kind)?;
    // It may have been replaced meanwhile: it is opened without waiting, and looked at again.
    let file = File::options().read(true).custom_flags(libc::O_NONBLOCK).open(path).map_err(failed)?;
    fit(&file.metadata().map_err(failed)?, kind)?;
    bounded(file, kind)
}

/// Files of /proc say that they have 0 bytes, and a pipe does not say: more than `LONGEST` is noticed while it is read.
fn bounded(from: impl Read, kind: &str) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    from.take(LONGEST + 1).read_to_end(&mut bytes).map_err(|error| unreadable(&error, kind))?;
    match bytes.len() as u64 > LONGEST {
        true => Err(too_long(kind)),
        false => Ok(bytes),
    }
}

fn fit(about: &Metadata, kind: &str) -> Result<(), String> {
    let is = about.file_type();
    match () {
        () if is.is_dir() => Err(format!("Is a directory; name {kind}")),
        () if is.is_fifo() => {
            Err(format!("it is a pipe; write its content to a file, or pipe it into {STANDARD_INPUT}"))
        }
        () if !is.is_file() => Err(format!("it is a device or a socket; name {kind}")),
        () if about.len() > LONGEST => Err(too_long(kind)),
        () => Ok(()),
    }
}

fn too_long(kind: &str) -> String {
    format!("it has more than {} MiB; name {kind}", LONGEST >> 20)
}

fn unreadable(error: &io::Error, kind: &str) -> String {
    let reason = match error.raw_os_error() {
        Some(number) => nix::errno::Errno::from_raw(number).desc().to_owned(),
        None => error.to_string(),
    };
    match error.kind() {
        io::ErrorKind::PermissionDenied => format!("{reason}; let this user read it"),
        _ => format!("{reason}; name {kind}"),
    }
}

/// The mistake of a file as a whole, or of one of its lines.
pub fn whole_file(file: &str, line: Option<usize>, message: String) -> ConfigErrors {
    ConfigError { file: file.to_owned(), line, key: None, value: None, message }.into()
}
