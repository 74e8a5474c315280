//! No page fault in the loop: memory that is touched before it starts and locked while it runs.
//!
//! In the order of use: [`prepare_heap`] before anything of the loop is built, [`ring`] and [`Regions::add`] while it
//! is built, [`prefault_stack`] and [`lock_process`] or [`Regions::lock`] on the loop's thread (`thread::enter` does
//! these). Knows nothing of what the memory holds.
//!
//! A lock does not survive fork(2): afterwards the first write to each page faults, in the parent's loop too
//! (mlock(2), notes). A process with a loop starts children by posix_spawn, which `std::process::Command` does unless
//! `pre_exec` is used.

use std::collections::VecDeque;
use std::ffi::{c_int, c_void};
use std::io;
use std::mem::MaybeUninit;
use std::ptr;

use nix::sys::mman::{MlockAllFlags, mlockall};
use rtrb::{Consumer, Producer, RingBuffer};

use super::rights::{Capability, Denied, holds, memlock_limit};

/// How much of the loop's stack is made present: far more than its call depth needs.
const STACK_BYTES: usize = 256 << 10;

/// The room that the thread must have left beyond [`STACK_BYTES`] before it is touched.
const STACK_SPARE: usize = 32 << 10;

/// The growth of a process after [`lock_process`] under a finite limit, besides doubling its size.
const GROWTH_BYTES: u64 = 64 << 20;

/// Makes the heap of the whole process keep what it has. For `Memory::Process`, once, before the loop's structures
/// are built; a large host program that wants its allocator left alone uses `Memory::Own`, which does without.
///
/// With glibc (mallopt(3)):
/// - `M_TRIM_THRESHOLD = -1`: freed memory is never handed back, so what was prefaulted stays present.
/// - `M_MMAP_MAX = 0`: large blocks come from the same heap instead of a mapping of their own, which would be unmapped
///   with every free. An unmap by any thread interrupts every core that runs this process, the loop's too, to flush its
///   translation cache.
/// - `M_ARENA_MAX = 1`: no further arena, each of which reserves 64 MiB of address space that counts against
///   RLIMIT_MEMLOCK. Normal threads share one lock in return; the loop does not allocate.
///
/// Transparent huge pages are switched off for the process and its children (PR_SET_THP_DISABLE, prctl(2)): collapsing
/// pages into a huge one unmaps them for a moment, and the loop would fault on them, locked or not.
pub fn prepare_heap() {
    #[cfg(target_env = "gnu")]
    // SAFETY: mallopt takes two integers. It is marked MT-Unsafe because a malloc of another thread may read a
    // parameter while it is written: each is one aligned word, written under the arena's lock, and any of both values
    // will do.
    unsafe {
        libc::mallopt(libc::M_TRIM_THRESHOLD, -1);
        libc::mallopt(libc::M_MMAP_MAX, 0);
        libc::mallopt(libc::M_ARENA_MAX, 1);
    }
    // Refused only by a system call filter; then there are huge pages as before.
    let _ = nix::sys::prctl::set_thp_disable(true);
}

/// Makes 256 KiB of the calling thread's stack below this call present. A thread with less left is not touched: a
/// loop's thread should be built with 1 MiB or more (the standard library's default is 2 MiB).
pub fn prefault_stack() {
    #[inline(never)]
    fn touch() {
        prefault(&mut [MaybeUninit::<u8>::uninit(); STACK_BYTES]);
    }
    if stack().is_some_and(|(low, _)| here().saturating_sub(low) > STACK_BYTES + STACK_SPARE) {
        touch();
    }
}

/// Makes every page under `slice` present and this process's own by writing to it; the elements stay uninitialised.
pub fn prefault<T>(slice: &mut [MaybeUninit<T>]) {
    let length = size_of_val(slice);
    let bytes = slice.as_mut_ptr().cast::<u8>();
    let page = page_size();
    let mut at = 0;
    while at < length {
        // SAFETY: `at < length` lies within the slice, which is exclusively borrowed and may hold any bytes. Volatile,
        // because nobody ever reads what is written.
        unsafe { bytes.add(at).write_volatile(0) };
        at += page - (bytes as usize + at) % page;
    }
}

/// A ring of `capacity` elements with every page present, added to `regions`.
pub fn ring<T>(capacity: usize, regions: &mut Regions) -> (Producer<T>, Consumer<T>) {
    let (mut producer, consumer) = RingBuffer::new(capacity);
    regions.add(producer.buffer());
    if let Ok(mut chunk) = producer.write_chunk_uninit(capacity) {
        // The ring is empty and new, so that the first slice is all of it. Never committed: the elements stay the
        // ring's to write.
        let (slots, rest) = chunk.as_mut_slices();
        prefault(slots);
        prefault(rest);
        regions.add(slots);
        regions.add(rest);
    }
    (producer, consumer)
}

/// A queue of one thread for `capacity` elements, with every page present, added to `regions`.
pub fn deque<T>(capacity: usize, regions: &mut Regions) -> VecDeque<T> {
    let mut elements = Vec::with_capacity(capacity);
    prefault(elements.spare_capacity_mut());
    regions.add(elements.spare_capacity_mut());
    // Keeps the memory of the vector.
    elements.into()
}

/// Locks all memory of the process, now and in future (`mlockall(MCL_CURRENT | MCL_FUTURE)`, mlock(2)).
///
/// Without CAP_IPC_LOCK only if RLIMIT_MEMLOCK is unlimited or at least twice the present size of the address space
/// and 64 MiB: MCL_FUTURE under a tight limit succeeds first, and then the process cannot start a thread, grow its
/// heap or, with a SIGSEGV, its stack. A program that drops the capability later needs the limit all the same.
///
/// # Errors
///
/// [`Denied::Memlock`] with what it takes; nothing is locked then.
pub fn lock_process() -> Result<(), Denied> {
    check_limit(address_space().map(|bytes| bytes.saturating_mul(2).saturating_add(GROWTH_BYTES)))?;
    mlockall(MlockAllFlags::MCL_CURRENT | MlockAllFlags::MCL_FUTURE)
        .map_err(|errno| Denied::Call { call: "mlockall", error: errno.into() })
}

/// Undoes every lock of the process, those of [`Regions::lock`] too (munlockall(2)); for callers that only test
/// whether locking works.
pub fn unlock_process() {
    // Cannot fail: it requires no right.
    let _ = nix::sys::mman::munlockall();
}

/// The memory that the loop touches, for [`Memory::Own`](super::Memory::Own): collected while the loop is built, locked
/// when it starts. What is freed or moved after it was added makes [`lock`](Self::lock) fail or lock too much, no
/// worse.
#[derive(Debug, Default)]
pub struct Regions {
    /// Address and length in bytes.
    areas: Vec<(usize, usize)>,
}

impl Regions {
    /// None yet.
    pub fn new() -> Regions {
        Regions::default()
    }

    /// Adds the memory of `value` itself, not what it points to: a `Vec` is added as its slice.
    pub fn add<T: ?Sized>(&mut self, value: &T) {
        self.areas.push((ptr::from_ref(value).cast::<u8>() as usize, size_of_val(value)));
    }

    /// Adds all regions of `other`, which were collected earlier.
    pub fn extend(&mut self, other: &Regions) {
        self.areas.extend_from_slice(&other.areas);
    }

    /// Whether `value` lies within the added regions.
    pub fn covers<T>(&self, value: &[T]) -> bool {
        let (begin, size) = (value.as_ptr() as usize, size_of_val(value));
        self.areas.iter().any(|(area, length)| *area <= begin && begin + size <= area + length)
    }

    /// Locks all of it (mlock(2)), and with it what every thread touches: the calling thread's stack around the
    /// present depth, the code and the static data of the program and its libraries. It is permanent: nothing
    /// unlocks it.
    ///
    /// The limit counts for all of them together; a few MiB for a program of its own, much more inside a host with
    /// large libraries.
    ///
    /// # Errors
    ///
    /// [`Denied::Memlock`] if RLIMIT_MEMLOCK is too small; nothing is locked then. [`Denied::Call`] if a region is
    /// no longer mapped, or others of the process have used up the limit.
    pub fn lock(&self) -> Result<(), Denied> {
        let mut areas = self.areas.clone();
        if let Some((low, high)) = stack() {
            let from = low.max(here().saturating_sub(STACK_BYTES));
            areas.push((from, high - from));
        }
        areas.extend(loaded_segments());
        let pages = whole_pages(areas, page_size());
        check_limit(Some(pages.iter().map(|(_, length)| *length as u64).sum()))?;
        for (address, length) in pages {
            // SAFETY: mlock reads and writes nothing through the pointer; it refuses what is not mapped.
            if unsafe { libc::mlock(address as *const c_void, length) } != 0 {
                return Err(Denied::Call { call: "mlock", error: io::Error::last_os_error() });
            }
        }
        Ok(())
    }
}

/// Whether `need` bytes may be locked.
fn check_limit(need: Option<u64>) -> Result<(), Denied> {
    match memlock_limit() {
        // What is not known may be more than any limit.
        Some(limit) if need.is_none_or(|need| need > limit) && !holds(Capability::IpcLock) => {
            Err(Denied::Memlock { need_kib: need.map(|need| need.div_ceil(1 << 10)), limit_kib: limit >> 10 })
        }
        _ => Ok(()),
    }
}

/// The areas as whole pages, in order, none twice: what the kernel will count.
fn whole_pages(mut areas: Vec<(usize, usize)>, page: usize) -> Vec<(usize, usize)> {
    areas.retain(|(_, length)| *length > 0);
    areas.sort_unstable();
    let mut pages: Vec<(usize, usize)> = Vec::new();
    for (address, length) in areas {
        let begin = address / page * page;
        let end = (address + length).next_multiple_of(page);
        match pages.last_mut() {
            Some((first, total)) if begin <= *first + *total => *total = (*total).max(end - *first),
            _ => pages.push((begin, end - begin)),
        }
    }
    pages
}

/// The size of the address space, bytes: what mlockall(2) counts (first number of /proc/self/statm, in pages).
fn address_space() -> Option<u64> {
    let statm = std::fs::read_to_string("/proc/self/statm").ok()?;
    let pages: u64 = statm.split_whitespace().next()?.parse().ok()?;
    Some(pages * page_size() as u64)
}

fn page_size() -> usize {
    // SAFETY: takes no pointer and has no precondition.
    let size = unsafe { libc::sysconf(libc::_SC_PAGESIZE) };
    // POSIX gives no way to fail for this name; 4 KiB is the smallest page of any Linux.
    usize::try_from(size).unwrap_or(4096).max(1)
}

/// An address within the caller's stack frame.
#[inline(always)]
fn here() -> usize {
    let mark = 0_u8;
    ptr::from_ref(std::hint::black_box(&mark)) as usize
}

/// Lowest address and end of the calling thread's stack.
fn stack() -> Option<(usize, usize)> {
    let mut attributes = MaybeUninit::<libc::pthread_attr_t>::uninit();
    // SAFETY: pthread_self is the live calling thread, and `attributes` has room for what is written.
    if unsafe { libc::pthread_getattr_np(libc::pthread_self(), attributes.as_mut_ptr()) } != 0 {
        return None;
    }
    let (mut low, mut size) = (ptr::null_mut(), 0);
    // SAFETY: `attributes` was initialised by the call above, is read once and destroyed once; both results have room.
    let status = unsafe {
        let status = libc::pthread_attr_getstack(attributes.as_ptr(), &mut low, &mut size);
        libc::pthread_attr_destroy(attributes.as_mut_ptr());
        status
    };
    (status == 0).then_some((low as usize, low as usize + size))
}

/// The segments of the program and its shared libraries as loaded (dl_iterate_phdr(3)): code, constants, static data
/// and its zeroed part. Not /proc/self/maps, which cannot tell a library from a data file that the host has mapped.
fn loaded_segments() -> Vec<(usize, usize)> {
    unsafe extern "C" fn collect(
        info: *mut libc::dl_phdr_info,
        _size: libc::size_t,
        areas: *mut c_void,
    ) -> c_int {
        // SAFETY: `areas` is the Vec below, borrowed by nobody else during the walk.
        let areas = unsafe { &mut *areas.cast::<Vec<(usize, usize)>>() };
        // SAFETY: the loader hands over a valid record for the time of this call.
        let info = unsafe { &*info };
        if !info.dlpi_phdr.is_null() {
            // SAFETY: the loader gives `dlpi_phnum` headers behind this pointer.
            let headers = unsafe { std::slice::from_raw_parts(info.dlpi_phdr, usize::from(info.dlpi_phnum)) };
            let loaded = headers.iter().filter(|header| header.p_type == libc::PT_LOAD);
            areas.extend(
                loaded.map(|header| ((info.dlpi_addr + header.p_vaddr) as usize, header.p_memsz as usize)),
            );
        }
        0
    }
    let mut areas: Vec<(usize, usize)> = Vec::new();
    // SAFETY: `collect` has the required type and `areas` outlives the walk.
    unsafe { libc::dl_iterate_phdr(Some(collect), ptr::from_mut(&mut areas).cast()) };
    areas
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rt::Usage;
    use crate::rt::testing::{become_ordinary, in_own_process, limit_memlock, locked_kib};

    #[test]
    fn pages_are_merged_and_counted_once() {
        let areas = vec![(9000, 10), (100, 0), (4096, 1), (4100, 4096), (40_960, 8192)];
        assert_eq!(whole_pages(areas, 4096), [(4096, 8192), (40_960, 8192)]);
    }

    #[test]
    fn knows_its_own_code_data_and_stack() {
        static DATA: [u8; 3] = [1, 2, 3];
        let segments = loaded_segments();
        let within =
            |address: usize| segments.iter().any(|(begin, size)| (*begin..begin + size).contains(&address));
        assert!(within(knows_its_own_code_data_and_stack as *const () as usize));
        assert!(within(std::hint::black_box(&DATA).as_ptr() as usize));
        assert!(within(libc::clock_gettime as *const () as usize), "no libraries");
        let (low, high) = stack().unwrap_or_default();
        assert!((low..high).contains(&here()));
    }

    #[test]
    fn a_prefaulted_ring_does_not_fault_and_the_memory_of_a_queue_is_kept() {
        let mut regions = Regions::new();
        let (mut producer, mut consumer) = ring::<[u64; 8]>(1 << 16, &mut regions);
        assert!(regions.areas.iter().map(|(_, length)| length).sum::<usize>() >= 64 << 16);
        let before = Usage::of_thread();
        while producer.push([7; 8]).is_ok() {}
        assert_eq!(consumer.slots(), 1 << 16);
        assert_eq!(consumer.pop(), Ok([7; 8]));
        // 1024 pages: none faults, but the kernel may move one at any time, as nothing is locked here.
        let faults = Usage::of_thread().since(before).page_faults();
        assert!(faults < 32, "{faults}");
        let mut queue = deque::<u64>(100, &mut regions);
        (0..100).for_each(|n| queue.push_back(n));
        assert!(regions.covers(queue.as_slices().0) && queue.as_slices().0.len() == 100);
    }

    #[test]
    fn a_prefaulted_stack_does_not_fault() {
        #[inline(never)]
        fn deep() -> u8 {
            // A copy is made of it in a debug build.
            let memory = std::hint::black_box([1_u8; 100 << 10]);
            memory.iter().step_by(512).fold(0, |sum, byte| sum ^ byte)
        }
        // A thread of its own, whose stack nobody has touched.
        let faults = std::thread::spawn(|| {
            prefault_stack();
            let before = Usage::of_thread();
            std::hint::black_box(deep());
            Usage::of_thread().since(before).page_faults()
        });
        let faults = faults.join().unwrap();
        assert!(faults < 10, "{faults} of 25 pages or more");
        // A short stack is left alone.
        std::thread::Builder::new().stack_size(128 << 10).spawn(prefault_stack).unwrap().join().unwrap();
    }

    #[test]
    fn empty_and_odd_slices_are_prefaulted() {
        prefault::<u64>(&mut []);
        prefault(&mut [MaybeUninit::<()>::uninit(); 3]);
        prefault(&mut [MaybeUninit::<u8>::uninit(); 5000][1..]);
        let (mut producer, _consumer) = ring::<u8>(0, &mut Regions::new());
        assert!(producer.push(1).is_err());
    }

    #[test]
    fn a_prepared_heap_keeps_what_was_touched() {
        in_own_process("rt::memory::tests::a_prepared_heap_keeps_what_was_touched", || {
            fn touch(bytes: usize) {
                prefault(Vec::<u8>::with_capacity(bytes).spare_capacity_mut());
            }
            prepare_heap();
            touch(16 << 20);
            let before = Usage::of_thread();
            touch(8 << 20);
            let faults = Usage::of_thread().since(before).page_faults();
            if cfg!(target_env = "gnu") {
                assert!(faults < 64, "{faults} of 2048 pages");
            }
        });
    }

    /// The trap: MCL_FUTURE alone would be granted, and the process would die of its next thread.
    #[test]
    fn a_tight_limit_locks_nothing_and_names_what_it_takes() {
        in_own_process("rt::memory::tests::a_tight_limit_locks_nothing_and_names_what_it_takes", || {
            assert!(limit_memlock(64 << 10));
            become_ordinary();
            let mut regions = Regions::new();
            let _ring = ring::<u64>(1 << 12, &mut regions);
            assert!(matches!(regions.lock(), Err(Denied::Memlock { limit_kib: 64, .. })));
            assert_eq!(locked_kib(), 0);
            match lock_process() {
                Err(Denied::Memlock { need_kib: Some(need_kib), limit_kib: 64 }) => {
                    assert!(need_kib > 64 << 10)
                }
                other => panic!("{other:?}"),
            }
            assert_eq!(locked_kib(), 0);
            std::thread::spawn(|| vec![1_u8; 16 << 20].len()).join().unwrap();
        });
    }

    #[test]
    #[ignore = "needs root: raises RLIMIT_MEMLOCK before it becomes an ordinary user"]
    fn an_ample_limit_is_enough_without_privilege() {
        in_own_process("rt::memory::tests::an_ample_limit_is_enough_without_privilege", || {
            if !limit_memlock(4 << 30) {
                return println!("skipped: no CAP_SYS_RESOURCE to raise a limit with");
            }
            become_ordinary();
            let mut regions = Regions::new();
            let ring = ring::<u64>(1 << 16, &mut regions);
            regions.lock().unwrap();
            let own = locked_kib();
            assert!(own >= 512, "{own} KiB");
            // Locked once, where it is: adding it again adds nothing.
            regions.lock().unwrap();
            assert_eq!(locked_kib(), own);
            lock_process().unwrap();
            assert!(locked_kib() > own);
            std::thread::spawn(|| vec![1_u8; 16 << 20].len()).join().unwrap();
            drop(ring);
        });
    }
}
