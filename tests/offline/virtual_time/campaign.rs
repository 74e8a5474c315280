//! Seeds, one after the other: what the random tests share. A test of `cargo test` takes the same seeds each time; its
//! long form, marked ignored, takes new ones until its time is up.
//!
//! | variable | what |
//! |---|---|
//! | `CAMPAIGN_SEED` | only this seed, and what happened in it where the test can tell |
//! | `CAMPAIGN_FROM` | the first seed of a long form; by default one that nobody took before |
//! | `CAMPAIGN_SECONDS` | how long a long form takes; by default ten minutes |
//! | `CAMPAIGN_FAILURES` | after so many failures it ends; by default after the first one |

use std::any::Any;
use std::env;
use std::fmt::Debug;
use std::ops::AddAssign;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Mutex;
use std::time::{Duration, Instant, SystemTime};

/// What came of one seed: what is counted, and why it failed.
pub type Judged<T> = (T, Result<(), String>);

/// These seeds, on one thread: the tests beside it have the others. Panics with what failed.
pub fn fixed<T: Tally>(name: &str, seeds: u64, judge: impl Fn(u64) -> Judged<T> + Sync) -> T {
    let (first, last) = only().map_or((0, seeds), |seed| (seed, seed + 1));
    campaign(name, first, 1, |seed| seed < last, judge)
}

/// New seeds on all cores, until the time is up.
pub fn long<T: Tally>(name: &str, judge: impl Fn(u64) -> Judged<T> + Sync) -> T {
    let seconds = variable("CAMPAIGN_SECONDS").unwrap_or(600);
    let end = Instant::now() + Duration::from_secs(seconds);
    let unused =
        || SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |now| now.as_secs() << 20);
    let first = only().or_else(|| variable("CAMPAIGN_FROM")).unwrap_or_else(unused);
    let threads = thread_count();
    match only() {
        Some(only) => campaign(name, only, 1, |seed| seed == only, judge),
        None => campaign(name, first, threads, |_| Instant::now() < end, judge),
    }
}

/// The only seed that is wanted.
pub fn only() -> Option<u64> {
    variable("CAMPAIGN_SEED")
}

pub fn variable<T: std::str::FromStr>(name: &str) -> Option<T> {
    let text = env::var(name).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{name}={text}: cannot be read")))
}

/// What is counted over all seeds.
pub trait Tally: Default + Debug + AddAssign + Send {}

impl<T: Default + Debug + AddAssign + Send> Tally for T {}

fn thread_count() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// From the first seed on, while `goes_on`. A panic is a failure of its seed.
fn campaign<T: Tally>(
    name: &str,
    first: u64,
    threads: usize,
    goes_on: impl Fn(u64) -> bool + Sync,
    judge: impl Fn(u64) -> Judged<T> + Sync,
) -> T {
    let most = variable("CAMPAIGN_FAILURES").unwrap_or(1);
    let begun = Instant::now();
    let shared = Mutex::new((first, T::default(), Vec::<String>::new()));
    let next = || {
        let mut shared = shared.lock().unwrap();
        let seed = shared.0;
        let goes = goes_on(seed) && shared.2.len() < most;
        shared.0 += u64::from(goes);
        goes.then_some(seed)
    };
    let work = || {
        while let Some(seed) = next() {
            let judged = catch_unwind(AssertUnwindSafe(|| judge(seed)));
            let (tally, result) = judged.unwrap_or_else(|panic| (T::default(), Err(text_of(&*panic))));
            let mut shared = shared.lock().unwrap();
            shared.1 += tally;
            if let Err(text) = result {
                let text = format!("{name}: CAMPAIGN_SEED={seed}: {text}");
                eprintln!("{text}\n");
                shared.2.push(text);
            }
        }
    };
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        workers.into_iter().for_each(|worker| worker.join().expect("what panics is caught"));
    });
    let (end, tally, failed) = shared.into_inner().unwrap();
    println!("{name}: seeds {first} ... {}, {:.1?}: {tally:?}", end.saturating_sub(1), begun.elapsed());
    if let Some(text) = failed.first() {
        panic!("{text}");
    }
    tally
}

fn text_of(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("a panic without a message").to_owned()
}

#[test]
fn a_campaign_reports_the_seed_of_a_failure_and_of_a_panic() {
    if only().is_some() {
        return;
    }
    let report = |judge: fn(u64) -> Judged<u64>| {
        let panic = catch_unwind(|| fixed("example", 9, judge)).unwrap_err();
        text_of(&*panic)
    };
    assert_eq!(
        report(|seed| (1, if seed == 5 { Err("why".to_owned()) } else { Ok(()) })),
        "example: CAMPAIGN_SEED=5: why"
    );
    assert_eq!(report(|seed| panic!("so {seed}")), "example: CAMPAIGN_SEED=0: so 0");
    assert_eq!(fixed("example", 9, |seed| (seed, Ok(()))), 36);
}
