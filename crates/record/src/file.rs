//! Files that are whole or not there, and places for them that are tried before there is anything to write.

use std::fs::{self, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

/// Writes a file whole or not at all, and makes its directory if that is missing. A file or a link of that name is
/// replaced.
///
/// Until it is whole it has a name that nobody can guess: a link laid out there by another user of the directory would
/// lead what is written, perhaps by root, to a file of their choice.
pub fn save(path: &Path, bytes: &[u8]) -> io::Result<()> {
    whole(path, bytes)?.persist(path)?;
    Ok(())
}

/// The same, but nothing is replaced: a file or a link of that name is an error.
pub fn save_new(path: &Path, bytes: &[u8]) -> io::Result<()> {
    whole(path, bytes)?.persist_noclobber(path)?;
    Ok(())
}

/// A directory for files that come later: whether it can be written to is known before there is anything to lose.
/// Dropped without a file in it, it removes the directories that it made.
#[derive(Debug)]
pub struct Place {
    directory: PathBuf,
    /// The directories that were missing, the innermost first.
    made: Vec<PathBuf>,
}

impl Place {
    /// Makes the directory, and writes a file to it that has no name of ours and is removed again: others may try the
    /// same place meanwhile.
    pub fn prepare(directory: impl Into<PathBuf>) -> io::Result<Place> {
        let directory = directory.into();
        // `try_exists` and not `exists`: what cannot be looked at is not missing.
        let missing = |path: &&Path| matches!(path.try_exists(), Ok(false)) && !path.as_os_str().is_empty();
        let made = directory.ancestors().take_while(missing).map(Path::to_owned).collect();
        // From here on, whatever fails takes what was made along.
        let place = Place { directory, made };
        whole(&place.directory.join("probe"), b"a file comes here\n")?;
        Ok(place)
    }

    /// The same for the directory of a file.
    pub fn of_file(path: &Path) -> io::Result<Place> {
        Place::prepare(path.parent().unwrap_or(Path::new("")))
    }

    /// Where it is.
    pub fn directory(&self) -> &Path {
        &self.directory
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        for directory in &self.made {
            // Refused if there is a file in it.
            let _ = fs::remove_dir(directory);
        }
    }
}

/// The bytes in a file next to `path`.
fn whole(path: &Path, bytes: &[u8]) -> io::Result<NamedTempFile> {
    let directory = path.parent().unwrap_or(Path::new(""));
    fs::create_dir_all(directory)?;
    // Dropped before it has its name, it is removed: what is not whole is of no use, and may have taken the last of the
    // disk.
    let mut file = tempfile::Builder::new()
        .prefix(".fieldbeat-")
        // As every other file; the umask takes from it.
        .permissions(Permissions::from_mode(0o666))
        .tempfile_in(directory)?;
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn no_link_is_followed() {
        let directory = tempfile::tempdir().unwrap();
        let [precious, target, part] =
            ["precious", "a.json", "a.part"].map(|name| directory.path().join(name));
        fs::write(&precious, "mine").unwrap();
        symlink(&precious, &target).unwrap();
        symlink(&precious, &part).unwrap();
        save(&target, b"new").unwrap();
        assert_eq!(fs::read_to_string(&precious).unwrap(), "mine");
        assert!(fs::symlink_metadata(&target).unwrap().is_file());
        assert_eq!(fs::read_to_string(&target).unwrap(), "new");
        assert_eq!(files(directory.path()), 3);
    }

    #[test]
    fn a_place_that_was_not_used_leaves_nothing_and_takes_nothing_away() {
        let top = tempfile::tempdir().unwrap();
        let deep = top.path().join("a/b/c");
        let place = Place::prepare(&deep).unwrap();
        assert!(deep.is_dir() && fs::read_dir(&deep).unwrap().next().is_none());
        drop(place);
        assert!(!top.path().join("a").exists() && top.path().exists());

        let used = Place::prepare(&deep).unwrap();
        save(&deep.join("notes"), b"mine").unwrap();
        drop(used);
        drop(Place::prepare(&deep).unwrap());
        assert_eq!(fs::read_to_string(deep.join("notes")).unwrap(), "mine");
    }

    #[test]
    fn a_place_below_a_file_is_refused_and_leaves_nothing() {
        let top = tempfile::tempdir().unwrap();
        let file = top.path().join("file");
        fs::write(&file, "mine").unwrap();
        assert!(Place::prepare(file.join("boxes")).is_err() && Place::of_file(&file.join("box")).is_err());
        assert_eq!((fs::read_to_string(&file).unwrap().as_str(), files(top.path())), ("mine", 1));
    }

    fn files(directory: &Path) -> usize {
        fs::read_dir(directory).unwrap().count()
    }

    #[test]
    fn a_saved_file_has_usual_permissions() {
        let directory = tempfile::tempdir().unwrap();
        let [ours, other] = ["ours", "other"].map(|name| directory.path().join(name));
        save(&ours, b"").unwrap();
        fs::write(&other, "").unwrap();
        let mode = |path| fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&ours), mode(&other));
    }

    #[test]
    fn a_file_that_cannot_be_named_leaves_no_rest() {
        let directory = tempfile::tempdir().unwrap();
        let taken = directory.path().join("taken");
        fs::create_dir(&taken).unwrap();
        assert!(save(&taken, b"new").is_err());
        assert_eq!(files(directory.path()), 1);
    }
}
