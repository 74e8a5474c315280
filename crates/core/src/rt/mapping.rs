//! Memory of a mapping of its own: of this process alone, with a name that outlives it, or for a process that gets its
//! descriptor.
//!
//! A name is that of a file in /dev/shm, which is memory, never a disk: the kernel writes none of it back, so that no
//! write to it faults, whatever `sync` does meanwhile. Its process holds a lock on it; what is there without that lock
//! was left behind. The name appears once its owner has written what a reader needs, and goes with an orderly end.

use std::alloc::{Layout, handle_alloc_error};
use std::fs::{File, OpenOptions};
use std::io;
use std::mem;
use std::num::NonZeroUsize;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::ptr::NonNull;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

use nix::errno::Errno;
use nix::fcntl::{AT_FDCWD, AtFlags, FallocateFlags, FcntlArg, Flock, FlockArg, SealFlag, fallocate, fcntl};
use nix::sys::memfd::{MFdFlags, memfd_create};
use nix::sys::mman::{MapFlags, ProtFlags, mmap, mmap_anonymous, munmap};
use nix::sys::stat::fstat;
use nix::sys::statfs::{TMPFS_MAGIC, fstatfs};
use nix::unistd::{ftruncate, linkat};

use super::clock::MonotonicClock;

/// Where named memory is.
const DIRECTORY: &str = "/dev/shm";

/// The prefix of the names of mappings.
const PREFIX: &str = "fieldbeat-";

/// Zeroed memory, page by page.
#[derive(Debug)]
pub struct Mapping {
    begin: NonNull<u8>,
    length: NonZeroUsize,
    /// The lock that says that its process lives; `None`: it has no name.
    file: Option<Flock<File>>,
    /// Of memory for another process.
    handed: Option<OwnedFd>,
    name: OnceLock<PathBuf>,
    /// A process that was forked has no say in it.
    owner: u32,
    /// The name is to stay.
    is_left: AtomicBool,
}

/// This process is about to crash: all names are to stay.
static CRASHES: AtomicBool = AtomicBool::new(false);

/// This process is about to end by an error: the memory of its masters stays for whoever looks at it later. May be
/// called by the handler of a signal.
pub fn crashes() {
    CRASHES.store(true, Ordering::Relaxed);
}

// SAFETY: it owns the memory as a box does.
unsafe impl Send for Mapping {}
// SAFETY: a shared reference gives a pointer only.
unsafe impl Sync for Mapping {}

impl Mapping {
    fn new(begin: NonNull<u8>, length: NonZeroUsize, file: Option<Flock<File>>) -> Mapping {
        let (name, owner, is_left) = (OnceLock::new(), std::process::id(), AtomicBool::new(false));
        Mapping { begin, length, file, handed: None, name, owner, is_left }
    }

    /// Of this process alone. Without memory the process ends, as it does with that of a `Vec`.
    pub fn anonymous(length: NonZeroUsize) -> Mapping {
        let rights = ProtFlags::PROT_READ | ProtFlags::PROT_WRITE;
        // SAFETY: a new mapping at an address that the kernel chooses.
        let begin = unsafe { mmap_anonymous(None, length, rights, MapFlags::MAP_PRIVATE) };
        let layout = Layout::array::<u8>(length.get()).unwrap_or(Layout::new::<u8>());
        Mapping::new(begin.unwrap_or_else(|_| handle_alloc_error(layout)).cast(), length, None)
    }

    /// For a name, and for this user alone. All of it is reserved: a write never fails for want of memory.
    pub fn shared(length: NonZeroUsize) -> io::Result<Mapping> {
        let mut options = OpenOptions::new();
        let file =
            options.read(true).write(true).custom_flags(libc::O_TMPFILE).mode(0o600).open(DIRECTORY)?;
        if fstatfs(&file)?.filesystem_type() != TMPFS_MAGIC {
            return Err(io::Error::other(format!("{DIRECTORY} is not memory (tmpfs)")));
        }
        let file = locked(file)?;
        let size = i64::try_from(length.get()).map_err(|_| io::ErrorKind::FileTooLarge)?;
        // A signal ends it too early.
        while let Err(errno) = fallocate(&*file, FallocateFlags::empty(), 0, size) {
            if errno != Errno::EINTR {
                return Err(errno.into());
            }
        }
        Ok(Mapping::new(mapped(&*file, length)?, length, Some(file)))
    }

    /// For another process, which gets its [descriptor](Mapping::descriptor). Nobody can make it shorter.
    pub fn handed(length: NonZeroUsize) -> io::Result<Mapping> {
        let flags = MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING;
        let memory = memfd_create("fieldbeat", flags)?;
        ftruncate(&memory, i64::try_from(length.get()).map_err(|_| io::ErrorKind::FileTooLarge)?)?;
        fcntl(&memory, FcntlArg::F_ADD_SEALS(SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_SEAL))?;
        Mapping::with(memory, length)
    }

    /// That of the process that handed this descriptor over.
    ///
    /// # Errors
    ///
    /// It is none of [`handed`](Mapping::handed).
    pub fn received(memory: OwnedFd) -> io::Result<Mapping> {
        let seals = SealFlag::from_bits_retain(fcntl(&memory, FcntlArg::F_GET_SEALS)?);
        let length = usize::try_from(fstat(&memory)?.st_size).ok().and_then(NonZeroUsize::new);
        let length = length.filter(|_| seals.contains(SealFlag::F_SEAL_SHRINK));
        Mapping::with(memory, length.ok_or(io::ErrorKind::InvalidData)?)
    }

    fn with(memory: OwnedFd, length: NonZeroUsize) -> io::Result<Mapping> {
        let mut mapping = Mapping::new(mapped(&memory, length)?, length, None);
        mapping.handed = Some(memory);
        Ok(mapping)
    }

    /// The descriptor, if another process can share it. Whoever has that of named memory has its lock.
    pub fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.handed.as_ref().map(AsFd::as_fd).or(self.file.as_ref().map(|file| file.as_fd()))
    }

    /// The first byte. It is aligned to a page.
    pub fn begin(&self) -> NonNull<u8> {
        self.begin
    }

    /// The bytes.
    pub fn length(&self) -> usize {
        self.length.get()
    }

    /// Gives shared memory its name: from here on it outlives the process.
    pub fn appear(&self) -> io::Result<()> {
        let Some(file) = &self.file else { return Ok(()) };
        let name = format!("{PREFIX}{}-{:x}", std::process::id(), MonotonicClock::read().0);
        let path = Path::new(DIRECTORY).join(name);
        let unnamed = format!("/proc/self/fd/{}", file.as_raw_fd());
        linkat(AT_FDCWD, unnamed.as_str(), AT_FDCWD, &path, AtFlags::AT_SYMLINK_FOLLOW)?;
        let _ = self.name.set(path);
        Ok(())
    }

    /// Where it is after this process has ended.
    pub fn path(&self) -> Option<&Path> {
        self.name.get().map(PathBuf::as_path)
    }

    /// The name is to stay: somebody else is to find it.
    pub fn leave(&self) {
        self.is_left.store(true, Ordering::Relaxed);
    }

    /// Takes its name away, unless it is to stay.
    pub fn disappear(&self) {
        let stays = self.is_left.load(Ordering::Relaxed) || CRASHES.load(Ordering::Relaxed);
        if let Some(path) = self.name.get().filter(|_| !stays && self.owner == std::process::id()) {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// Maps so many bytes, which nobody else may make fewer.
fn mapped(file: impl AsFd, length: NonZeroUsize) -> io::Result<NonNull<u8>> {
    let rights = ProtFlags::PROT_READ | ProtFlags::PROT_WRITE;
    // SAFETY: a new mapping at an address that the kernel chooses.
    let begin = unsafe { mmap(None, length, rights, MapFlags::MAP_SHARED, file, 0)? };
    Ok(begin.cast())
}

/// Locks a file, unless another process has it.
fn locked(file: File) -> io::Result<Flock<File>> {
    Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|(_, errno)| errno.into())
}

impl Drop for Mapping {
    fn drop(&mut self) {
        self.disappear();
        if self.owner != std::process::id() {
            // A forked process has the same lock: it must not be given up here.
            mem::forget(self.file.take());
        }
        // SAFETY: mapped by this, and the last that knows it. It does not fail for a mapping of ours.
        let _ = unsafe { munmap(self.begin.cast(), self.length.get()) };
    }
}

/// Named memory of this user, of a process that lives or has ended.
#[derive(Debug)]
pub struct Found {
    /// The name.
    pub path: PathBuf,
    /// The bytes.
    pub file: File,
}

/// That of a process that has ended. It is its holder's: nobody else gets it.
#[derive(Debug)]
pub struct Left {
    path: PathBuf,
    file: Flock<File>,
}

impl Found {
    /// All of this user.
    pub fn all() -> impl Iterator<Item = Found> {
        let entries = std::fs::read_dir(DIRECTORY).into_iter().flatten().flatten();
        let ours =
            entries.filter(|entry| entry.file_name().as_encoded_bytes().starts_with(PREFIX.as_bytes()));
        ours.filter_map(|entry| Found::at(entry.path()))
    }

    fn at(path: PathBuf) -> Option<Found> {
        let flags = libc::O_NOFOLLOW | libc::O_NONBLOCK;
        let file = OpenOptions::new().read(true).write(true).custom_flags(flags).open(&path).ok()?;
        let facts = file.metadata().ok()?;
        let is_ours = facts.is_file() && facts.uid() == nix::unistd::geteuid().as_raw();
        is_ours.then_some(Found { path, file })
    }

    /// Takes it over; `None`: its process lives, or somebody else has it or had it.
    pub fn claim(self) -> Option<Left> {
        let Found { path, file } = self;
        let file = locked(file).ok()?;
        (file.metadata().ok()?.nlink() > 0).then_some(Left { path, file })
    }
}

impl Left {
    /// The bytes.
    pub fn file(&self) -> &File {
        &self.file
    }

    /// Gives the memory back.
    pub fn remove(self) -> io::Result<()> {
        match std::fs::remove_file(self.path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_left_by_those_alone_who_end_without_an_orderly_end() {
        let Ok(mapping) = Mapping::shared(NonZeroUsize::MIN) else { return println!("no {DIRECTORY} here") };
        assert!(mapping.path().is_none());
        mapping.appear().unwrap();
        let path = mapping.path().unwrap().to_owned();
        let claim = || Found::at(path.clone()).and_then(Found::claim);
        assert!(path.exists() && claim().is_none(), "its process lives");
        mapping.disappear();
        assert!(!path.exists());
        drop(mapping);

        let mapping = Mapping::shared(NonZeroUsize::MIN).unwrap();
        mapping.appear().unwrap();
        mapping.leave();
        let path = mapping.path().unwrap().to_owned();
        drop(mapping);
        let claim = || Found::at(path.clone()).and_then(Found::claim);
        let late = Found::at(path.clone()).unwrap();
        let left = claim().unwrap();
        assert!(claim().is_none(), "one has it");
        left.remove().unwrap();
        assert!(!path.exists() && late.claim().is_none(), "one had it");
    }
}
