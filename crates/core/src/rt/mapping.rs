//! Memory of a mapping of its own: of this process alone, or of a name that outlives it.
//!
//! A named one is a file of /dev/shm, which is memory, never a disk: the kernel writes none of it back, so that no
//! write to it faults, whatever `sync` does meanwhile. Its process holds a lock on it; what is there without that lock
//! was left behind. The name goes with an orderly end.

use std::alloc::{Layout, handle_alloc_error};
use std::fs::{File, OpenOptions};
use std::io;
use std::num::NonZeroUsize;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::ptr::NonNull;

use nix::fcntl::{FallocateFlags, Flock, FlockArg, fallocate};
use nix::sys::mman::{MapFlags, ProtFlags, mmap, mmap_anonymous, munmap};
use nix::sys::statfs::{TMPFS_MAGIC, fstatfs};

use super::clock::MonotonicClock;

/// Where named memory is.
const DIRECTORY: &str = "/dev/shm";

/// What its names begin with.
const PREFIX: &str = "fieldbeat-";

/// Zeroed memory, page by page.
#[derive(Debug)]
pub struct Mapping {
    begin: NonNull<u8>,
    length: NonZeroUsize,
    /// Its name, and the lock that says that its process lives.
    name: Option<(PathBuf, Flock<File>)>,
}

// SAFETY: it owns the memory as a box does.
unsafe impl Send for Mapping {}
// SAFETY: a shared reference gives a pointer only.
unsafe impl Sync for Mapping {}

impl Mapping {
    /// Of this process alone. Without memory the process ends, as it does with that of a `Vec`.
    pub fn anonymous(length: NonZeroUsize) -> Mapping {
        let rights = ProtFlags::PROT_READ | ProtFlags::PROT_WRITE;
        // SAFETY: a new mapping at an address that the kernel chooses.
        let begin = unsafe { mmap_anonymous(None, length, rights, MapFlags::MAP_PRIVATE) };
        let begin = begin.unwrap_or_else(|_| handle_alloc_error(Layout::new::<u8>()));
        Mapping { begin: begin.cast(), length, name: None }
    }

    /// With a name, for this user alone. All of it is reserved: a write never fails for want of memory.
    pub fn named(length: NonZeroUsize) -> io::Result<Mapping> {
        let name = format!("{PREFIX}{}-{:x}", std::process::id(), MonotonicClock::read().0);
        let path = Path::new(DIRECTORY).join(name);
        let file = OpenOptions::new().read(true).write(true).create_new(true).mode(0o600).open(&path)?;
        // Nobody else knows of it.
        let (begin, file) = reserved(file, length).inspect_err(|_| drop(std::fs::remove_file(&path)))?;
        Ok(Mapping { begin, length, name: Some((path, file)) })
    }

    /// Its first byte. It is aligned to a page.
    pub fn begin(&self) -> NonNull<u8> {
        self.begin
    }

    /// Its bytes.
    pub fn length(&self) -> usize {
        self.length.get()
    }

    /// Where it is after this process has ended.
    pub fn path(&self) -> Option<&Path> {
        self.name.as_ref().map(|(path, _)| &**path)
    }
}

/// Locks a new file, makes it so long, and maps it.
fn reserved(file: File, length: NonZeroUsize) -> io::Result<(NonNull<u8>, Flock<File>)> {
    if fstatfs(&file)?.filesystem_type() != TMPFS_MAGIC {
        return Err(io::Error::other(format!("{DIRECTORY} is not memory (tmpfs)")));
    }
    let file = locked(file)?;
    let size = i64::try_from(length.get()).map_err(|_| io::ErrorKind::FileTooLarge)?;
    fallocate(&*file, FallocateFlags::empty(), 0, size)?;
    let rights = ProtFlags::PROT_READ | ProtFlags::PROT_WRITE;
    // SAFETY: a new mapping at an address that the kernel chooses. Only this user may shorten the file.
    let begin = unsafe { mmap(None, length, rights, MapFlags::MAP_SHARED, &*file, 0)? };
    Ok((begin.cast(), file))
}

/// Locks a file, unless another process has it.
fn locked(file: File) -> io::Result<Flock<File>> {
    Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|(_, errno)| errno.into())
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: mapped by this, and the last that knows it. Neither call fails for a mapping of ours.
        let _ = unsafe { munmap(self.begin.cast(), self.length.get()) };
        if let Some((path, _)) = &self.name {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// The memory of a process that has ended without an orderly end. It is its holder's: nobody else finds it.
#[derive(Debug)]
pub struct Left {
    /// Its name.
    pub path: PathBuf,
    /// Its bytes.
    pub file: Flock<File>,
}

impl Left {
    /// All of this user.
    pub fn all() -> impl Iterator<Item = Left> {
        let entries = std::fs::read_dir(DIRECTORY).into_iter().flatten().flatten();
        let ours =
            entries.filter(|entry| entry.file_name().as_encoded_bytes().starts_with(PREFIX.as_bytes()));
        ours.filter_map(|entry| Left::of(entry.path()))
    }

    fn of(path: PathBuf) -> Option<Left> {
        let flags = libc::O_NOFOLLOW | libc::O_NONBLOCK;
        let file = OpenOptions::new().read(true).write(true).custom_flags(flags).open(&path).ok()?;
        let facts = file.metadata().ok()?;
        let is_ours = facts.is_file() && facts.uid() == nix::unistd::geteuid().as_raw();
        // Otherwise its process lives, or somebody else looks at it.
        is_ours.then(|| locked(file).ok()).flatten().map(|file| Left { path, file })
    }

    /// Gives the memory back.
    pub fn remove(self) -> io::Result<()> {
        std::fs::remove_file(self.path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_left_by_those_alone_who_end_without_an_orderly_end() {
        let Ok(mapping) = Mapping::named(NonZeroUsize::MIN) else { return println!("no {DIRECTORY} here") };
        let path = mapping.path().unwrap().to_owned();
        assert!(path.exists() && Left::of(path.clone()).is_none(), "its process lives");
        drop(mapping);
        assert!(!path.exists());
        // As a process leaves it that is killed.
        std::fs::write(&path, [0]).unwrap();
        let left = Left::of(path.clone()).unwrap();
        assert!(Left::of(path.clone()).is_none(), "one looks at it at a time");
        left.remove().unwrap();
        assert!(!path.exists());
    }
}
