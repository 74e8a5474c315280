//! What all error types have in common: whoever prints one with `{:?}` reads the sentence, too. So `fn main() ->
//! Result<(), MasterError>`, `unwrap` and `expect` show what is wrong and the remedy, not the fields of a struct.

/// `Debug` of error types prints what their `Display` prints.
macro_rules! debug_as_display {
    ($($error:ty),+) => {
        $(impl std::fmt::Debug for $error {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                std::fmt::Display::fmt(self, f)
            }
        })+
    };
}
pub(crate) use debug_as_display;

/// The remedy where no descriptor is left, whatever was to be opened.
pub(crate) fn no_descriptor(error: &std::io::Error) -> Option<&'static str> {
    match error.raw_os_error()? {
        libc::EMFILE => Some(
            "this process has too many files and sockets open: raise its limit (ulimit -n, or LimitNOFILE= of the \
             service)",
        ),
        libc::ENFILE => Some("this computer has too many files and sockets open: raise fs.file-max (sysctl)"),
        _ => None,
    }
}

#[cfg(all(test, feature = "cli"))]
mod tests {
    use std::path::{Path, PathBuf};

    use crate::axis::{AxisError, GroupError};
    use crate::bus::OpenError;
    use crate::config;
    use crate::control::AskError;
    use crate::master::{MasterError, StartError};

    #[test]
    fn debug_of_an_error_is_its_sentence() {
        let configuration = config::parse("[cycle]\nperod = 1\ncore = -1\n", "m.toml").unwrap_err();
        let bind = OpenError::Bind {
            bus: "b".into(),
            address: "127.0.0.1:1".parse().unwrap(),
            source: std::io::Error::from_raw_os_error(13),
            remedy: "end the other master",
        };
        let samples: Vec<Box<dyn std::error::Error>> = vec![
            configuration.iter().next().unwrap().clone().into(),
            configuration.into(),
            bind.into(),
            AxisError::Full { axis: "x".into(), command: "stop", capacity: 64 }.into(),
            GroupError::TooFew(1).into(),
            AskError::Nobody("/run/m.sock".into()).into(),
            MasterError::Unknown { what: "axis", name: "x".into(), known: "y, z".into() }.into(),
            StartError::Starving("a spin of 60 %".into()).into(),
        ];
        for error in samples {
            assert_eq!(format!("{error:?}"), error.to_string());
            assert!(error.to_string().contains(' '), "{error}");
        }
    }

    fn sources(directory: &Path, found: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(directory).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => sources(&path, found),
                false => found.extend(path.extension().is_some_and(|ext| ext == "rs").then_some(path)),
            }
        }
    }

    /// A new error type that derives `Debug` would print its fields again.
    #[test]
    fn no_error_type_of_the_library_derives_debug() {
        let mut files = Vec::new();
        sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut files);
        let mut seen = 0;
        // What the program's own files have for themselves never leaves it.
        for file in files.iter().filter(|file| !file.components().any(|part| part.as_os_str() == "cli")) {
            let text = std::fs::read_to_string(file).unwrap();
            for derive in text.lines().filter(|line| line.trim_start().starts_with("#[derive(")) {
                let names: Vec<&str> = derive.split(['(', ')', ',']).map(str::trim).collect();
                if names.iter().any(|name| *name == "Error" || *name == "thiserror::Error") {
                    seen += 1;
                    assert!(!names.contains(&"Debug"), "{}: {derive}", file.display());
                }
            }
        }
        assert!(seen > 30, "{seen}");
    }
}
