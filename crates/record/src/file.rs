//! Files that are whole or not there.

use std::fs::{self, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

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
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 3);
    }

    #[test]
    fn it_has_the_rights_of_every_other_file() {
        let directory = tempfile::tempdir().unwrap();
        let [ours, other] = ["ours", "other"].map(|name| directory.path().join(name));
        save(&ours, b"").unwrap();
        fs::write(&other, "").unwrap();
        let mode = |path| fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&ours), mode(&other));
    }

    #[test]
    fn nothing_is_left_of_what_cannot_have_its_name() {
        let directory = tempfile::tempdir().unwrap();
        let taken = directory.path().join("taken");
        fs::create_dir(&taken).unwrap();
        assert!(save(&taken, b"new").is_err());
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }
}
