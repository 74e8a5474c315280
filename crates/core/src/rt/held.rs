//! Values that threads share, and that another process can share as well.

use std::fmt::Debug;
use std::io;
use std::num::NonZeroUsize;
use std::os::fd::{BorrowedFd, OwnedFd};
use std::ptr::NonNull;
use std::sync::Arc;

use super::mapping::Mapping;

/// A value that two processes may share.
///
/// # Safety
///
/// It has no pointer, no reference and nothing to be dropped, any bytes are a value of it, its layout is that of C, and
/// what changes once it is shared is atomic.
pub unsafe trait Plain: Sized {}

/// One or more values in memory that lives as long as the last of its clones, which are the same.
#[derive(Debug)]
pub struct Held<T>(Arc<Memory<T>>);

#[derive(Debug)]
struct Memory<T> {
    begin: NonNull<T>,
    count: NonZeroUsize,
    mapping: Option<Mapping>,
}

// SAFETY: it owns the values as a boxed slice does.
unsafe impl<T: Send> Send for Memory<T> {}
// SAFETY: as above; a shared reference gives shared references only.
unsafe impl<T: Sync> Sync for Memory<T> {}

impl<T> Held<T> {
    /// Of this process.
    pub fn own(value: T) -> Held<T> {
        Held::all_own(vec![value].into())
    }

    fn all_own(values: Box<[T]>) -> Held<T> {
        let count = NonZeroUsize::new(values.len()).expect("at least one");
        let begin = NonNull::from(Box::leak(values)).cast();
        Held(Arc::new(Memory { begin, count, mapping: None }))
    }

    /// The first one.
    #[inline]
    pub fn first(&self) -> &T {
        // SAFETY: there is at least one, and it lives as long as `self`.
        unsafe { self.0.begin.as_ref() }
    }

    /// All of them.
    pub fn all(&self) -> &[T] {
        // SAFETY: so many were written at the beginning, or any bytes are some; they live as long as `self`.
        unsafe { std::slice::from_raw_parts(self.0.begin.as_ptr(), self.0.count.get()) }
    }
}

impl<T: Plain> Held<T> {
    /// In memory that another process can get; where the kernel gives none, of this process alone.
    ///
    /// # Panics
    ///
    /// There are no values.
    pub fn handed(values: Vec<T>) -> Held<T> {
        let Some((count, mapping)) = Held::mapping_of(&values) else { return Held::all_own(values.into()) };
        let begin = mapping.begin().cast::<T>();
        for (at, value) in values.into_iter().enumerate() {
            // SAFETY: a page is aligned enough for any value, and there is room for all of them; nobody else has it.
            unsafe { begin.add(at).write(value) };
        }
        Held(Arc::new(Memory { begin, count, mapping: Some(mapping) }))
    }

    fn mapping_of(values: &[T]) -> Option<(NonZeroUsize, Mapping)> {
        let bytes = NonZeroUsize::new(size_of_val(values))?;
        Some((NonZeroUsize::new(values.len())?, Mapping::handed(bytes).ok()?))
    }

    /// Those that another process has handed over.
    ///
    /// # Errors
    ///
    /// It is no such memory.
    pub fn received(memory: OwnedFd) -> io::Result<Held<T>> {
        let mapping = Mapping::received(memory)?;
        let count = NonZeroUsize::new(mapping.length() / size_of::<T>()).ok_or(io::ErrorKind::InvalidData)?;
        let begin = mapping.begin().cast();
        Ok(Held(Arc::new(Memory { begin, count, mapping: Some(mapping) })))
    }

    /// The descriptor by which another process gets them; `None`: they are of this one.
    pub fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.0.mapping.as_ref().and_then(Mapping::descriptor)
    }
}

impl<T> Clone for Held<T> {
    fn clone(&self) -> Held<T> {
        Held(Arc::clone(&self.0))
    }
}

impl<T: Default> Default for Held<T> {
    fn default() -> Held<T> {
        Held::own(T::default())
    }
}

impl<T> Drop for Memory<T> {
    fn drop(&mut self) {
        if self.mapping.is_none() {
            let all = NonNull::slice_from_raw_parts(self.begin, self.count.get());
            // SAFETY: a leaked box of so many values, which nobody else drops.
            drop(unsafe { Box::from_raw(all.as_ptr()) });
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    #[derive(Debug, Default)]
    #[repr(C)]
    struct Count(AtomicU64);

    // SAFETY: an atomic number.
    unsafe impl Plain for Count {}

    #[test]
    fn two_owners_of_a_descriptor_share_what_is_in_its_memory() {
        let first = Held::handed(vec![Count::default(), Count(7.into())]);
        let other = first.descriptor().unwrap().try_clone_to_owned().unwrap();
        let second = Held::<Count>::received(other).unwrap();
        first.first().0.store(5, Ordering::Relaxed);
        let shared =
            |held: &Held<Count>| held.all()[..2].iter().map(|c| c.0.load(Ordering::Relaxed)).sum::<u64>();
        assert_eq!((shared(&first), shared(&second)), (12, 12));
        // A file that somebody may shorten is refused.
        let file = tempfile::tempfile().unwrap();
        file.set_len(4096).unwrap();
        assert!(Held::<Count>::received(file.into()).is_err());
        assert!(Held::own(Count::default()).descriptor().is_none());
    }
}
