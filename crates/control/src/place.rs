//! Where the sockets are: one directory a user, which nobody else may enter, and in it one socket a machine.

use std::fs::{self, DirBuilder};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::os::unix::fs::{DirBuilderExt, FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};

use fieldbeat_core::errors::user;

/// Where a service of the sample unit has its sockets (`RuntimeDirectory=fieldbeat`).
const SERVICE: &str = "/run/fieldbeat";

/// Where the directories of logins are, each named by the number of its user (`XDG_RUNTIME_DIR` by systemd-logind).
const LOGINS: &str = "/run/user";

/// The directories that a process of this user may have its sockets in; it takes the first: that of the service, that
/// of the user's login, or one of its own in the directory for temporary files, where anybody may have been first.
fn own() -> Vec<PathBuf> {
    let of = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let named = of("RUNTIME_DIRECTORY").or_else(|| Some(of("XDG_RUNTIME_DIR")?.join("fieldbeat")));
    named.into_iter().chain(unnamed(Path::new(LOGINS), &std::env::temp_dir())).collect()
}

/// Those that no variable has to name: below `logins`, which only root fills, and in the directory for temporary files.
fn unnamed(logins: &Path, temporary: &Path) -> Vec<PathBuf> {
    let user = nix::unistd::geteuid();
    let login = Some(logins.join(user.to_string())).filter(|login| is_own(login));
    let login = login.map(|login| login.join("fieldbeat"));
    login.into_iter().chain([temporary.join(format!("fieldbeat-{user}"))]).collect()
}

/// The name of the socket for a configuration: that of the file, and a mark of its whole path.
fn name(config: &Path) -> String {
    let whole = fs::canonicalize(config).unwrap_or_else(|_| config.to_owned());
    // The same in every process of one build; another version of the program is found by its file name.
    let mut hasher = DefaultHasher::new();
    whole.hash(&mut hasher);
    let stem = config.file_stem().unwrap_or_default().to_string_lossy();
    // A socket's path has 108 bytes (unix(7)).
    let stem: String = stem.chars().filter(char::is_ascii).take(32).collect();
    format!("{stem}-{:08x}.sock", hasher.finish() as u32)
}

/// Makes the directory, if need be, and gives the path for the socket of `config`; `None` is the demo.
///
/// # Errors
///
/// The directory cannot be made, is not this user's, or others may enter it.
pub fn prepare(config: Option<&Path>) -> io::Result<PathBuf> {
    let directory = own().into_iter().next().unwrap_or_default();
    make(&directory)?;
    Ok(directory.join(config.map_or_else(|| "demo.sock".to_owned(), name)))
}

/// Makes a directory for this user alone, or finds that it is one.
fn make(directory: &Path) -> io::Result<()> {
    match DirBuilder::new().mode(0o700).recursive(true).create(directory) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(error),
        _ if is_own(directory) => return Ok(()),
        _ => {}
    }
    let about = fs::symlink_metadata(directory)?;
    let path = directory.display();
    Err(io::Error::other(match about.uid() == nix::unistd::geteuid().as_raw() {
        false => format!(
            "{path} belongs to {}, who may have taken its name: set XDG_RUNTIME_DIR to a directory of this user, or \
             RuntimeDirectory= in the unit of a service",
            user(about.uid())
        ),
        true if about.is_dir() => format!("others may write to {path}: run `chmod 700 {path}`"),
        true => format!("{path} is no directory: remove it"),
    }))
}

/// Whether `directory` is this user's and nobody else may put a socket into it. One of the service manager may be open
/// for reading: the sockets themselves are not.
fn is_own(directory: &Path) -> bool {
    owner(directory) == Some(nix::unistd::geteuid().as_raw())
}

/// The user who alone may put a socket into `directory`.
pub(super) fn owner(directory: &Path) -> Option<u32> {
    let about = fs::symlink_metadata(directory).ok()?;
    (about.is_dir() && about.mode() & 0o022 == 0).then_some(about.uid())
}

/// The directories of all users that [`own`] may have given: those of their logins below `logins`, and those in the
/// directory for temporary files. One that is not of the user whose name it has is nobody's.
fn of_all_users(logins: &Path, temporary: &Path) -> Vec<PathBuf> {
    let entries = |directory: &Path| fs::read_dir(directory).into_iter().flatten().flatten();
    let user = |entry: &fs::DirEntry, before: &str| -> Option<u32> {
        entry.file_name().to_str()?.strip_prefix(before)?.parse().ok()
    };
    let logins =
        entries(logins).filter_map(|entry| Some((user(&entry, "")?, entry.path().join("fieldbeat"))));
    let temporary = entries(temporary).filter_map(|entry| Some((user(&entry, "fieldbeat-")?, entry.path())));
    let all = logins.chain(temporary).filter(|(user, directory)| owner(directory) == Some(*user));
    all.map(|(_, directory)| directory).collect()
}

/// The sockets that a question may be meant for, living or dead: that of `config`, or all there are. Those of this user
/// and of the service; root finds those of all users.
pub fn find(config: Option<&Path>) -> Vec<PathBuf> {
    // In a directory of somebody else, somebody else would answer. That of the service is made by root.
    let mut directories: Vec<PathBuf> = own().into_iter().filter(|directory| is_own(directory)).collect();
    directories.push(SERVICE.into());
    if nix::unistd::geteuid().is_root() {
        directories.extend(of_all_users(Path::new(LOGINS), &std::env::temp_dir()));
    }
    directories.sort();
    directories.dedup();
    let name = config.map(name);
    let entries = directories.iter().filter_map(|directory| fs::read_dir(directory).ok()).flatten().flatten();
    let mut found: Vec<PathBuf> = entries
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_socket()))
        .filter(|entry| name.as_ref().is_none_or(|name| *name == *entry.file_name().to_string_lossy()))
        .map(|entry| entry.path())
        .collect();
    found.sort();
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_machines_have_two_sockets_with_short_names() {
        let long = format!("/a/{}.toml", "machine".repeat(40));
        let names = ["/a/m.toml", "/b/m.toml", &long].map(|path| name(Path::new(path)));
        assert!(names[0].starts_with("m-") && names[1].starts_with("m-") && names[0] != names[1]);
        assert!(names.iter().all(|name| name.len() < 50 && name.ends_with(".sock")), "{names:?}");
    }

    #[test]
    fn the_directory_of_the_login_comes_first_and_one_that_is_taken_is_named_with_its_owner_and_the_remedy() {
        let place = tempfile::tempdir().unwrap();
        let number = nix::unistd::geteuid();
        let [logins, temporary] = ["user", "tmp"].map(|name| place.path().join(name));
        fs::create_dir(&temporary).unwrap();
        let own = temporary.join(format!("fieldbeat-{number}"));
        assert_eq!(unnamed(&logins, &temporary), std::slice::from_ref(&own));
        let login = logins.join(number.to_string());
        fs::create_dir_all(&login).unwrap();
        assert_eq!(unnamed(&logins, &temporary), [login.join("fieldbeat"), own.clone()]);

        make(&own).unwrap();
        make(&own).unwrap();
        let refused = |directory: &Path| make(directory).unwrap_err().to_string();
        fs::set_permissions(&own, std::os::unix::fs::PermissionsExt::from_mode(0o722)).unwrap();
        assert!(refused(&own).ends_with(&format!("run `chmod 700 {}`", own.display())), "{}", refused(&own));
        // A link of somebody else leads where he likes.
        let link = temporary.join("link");
        std::os::unix::fs::symlink(&login, &link).unwrap();
        assert!(refused(&link).ends_with("is no directory: remove it"), "{}", refused(&link));
        // Root is another user than this one, or this one makes it another's.
        let others = if number.is_root() { own.clone() } else { PathBuf::from("/proc/sys") };
        if number.is_root() {
            std::os::unix::fs::chown(&own, Some(65534), None).unwrap();
        }
        let said = refused(&others);
        let owner = if number.is_root() { "belongs to user " } else { "belongs to user root" };
        assert!(said.contains(owner) && said.contains(": set XDG_RUNTIME_DIR to a directory of"), "{said}");
    }

    #[test]
    fn a_directory_counts_for_the_user_whose_name_it_has() {
        let place = tempfile::tempdir().unwrap();
        let user = nix::unistd::geteuid().as_raw();
        let [logins, temporary] = ["user", "tmp"].map(|name| place.path().join(name));
        let login = logins.join(format!("{user}/fieldbeat"));
        let own = temporary.join(format!("fieldbeat-{user}"));
        let others = ["fieldbeat-4000000000", "fieldbeat-x", "fieldbeat-", "fieldbeat-1-2"];
        for directory in others.iter().map(|name| temporary.join(name)).chain([login.clone(), own.clone()]) {
            DirBuilder::new().mode(0o700).recursive(true).create(directory).unwrap();
        }
        assert_eq!(of_all_users(&logins, &temporary), [login, own.clone()]);
        fs::set_permissions(&own, std::os::unix::fs::PermissionsExt::from_mode(0o777)).unwrap();
        assert_eq!(of_all_users(Path::new("/none"), &temporary), [] as [PathBuf; 0]);
    }
}
