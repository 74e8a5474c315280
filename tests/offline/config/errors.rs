//! What the errors of the library print.

use std::path::{Path, PathBuf};

use fieldbeat::axis::{AxisError, GroupError};
use fieldbeat::{MasterError, OpenError, StartError, config};
use fieldbeat_control::AskError;

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
    sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../crates"), &mut files);
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
