//! Whether the named cause of a late cycle is the true one: causes are brought about on purpose, and what was found is
//! held against what was done. Prints the confusion matrix, rows done, columns found.
//!
//! A host disturbs the loop, too. How often it does is measured in the same run, in as many times of the same length
//! in which nothing was done; what was found there, and the spread of such a count, is not held against the search.
//!
//! The late end of a sleep by a hypervisor alone cannot be brought about from inside; only the steal time separates it
//! from a late timer, which the unit tests of `telemetry::causes` hold.
//!
//!     cargo test --release --test causes -- --ignored --nocapture --test-threads 1

mod support;

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::sleep;
use std::time::Duration;

use crossbeam_channel::{Receiver, unbounded};
use fieldbeat::telemetry::{Cause, Causes, Judged, Stage};
use fieldbeat::time::{MS, Time, US};
use fieldbeat::{CyclePlan, Guard, Master, Memory, Realtime};
use fieldbeat_core::rt::thread::{enter, stand_aside};
use fieldbeat_core::rt::{Clock, MonotonicClock, RealtimePlan, Regions};
use libc::{SIGCONT, SIGSTOP};
use support::hold::{Hold, thread};
use support::{LONG, Machine, PROGRAM, Program, again, plan, role};

/// How long each disturbance lasts: twice the threshold, and no longer than the spin of a loop that is held.
const DISTURBANCE_NS: u64 = 1_000 * US;
const PERIOD_NS: u64 = 2 * MS;
const LATE_NS: u64 = 500 * US;
/// How many of each; twice as many of the one of which few make a cycle late.
const ROUNDS: usize = 160;
/// Of the newest causes, so many are looked at at a time.
const MOST: usize = 1_024;
/// Wide apart, so that each has its own samples around it.
const APART: Duration = Duration::from_millis(25);

/// Longer than a late cycle is followed by closer samples.
const QUIET: Duration = Duration::from_millis(300);

/// The classes, in the order of the matrix.
const CLASSES: [&str; 7] = ["preempted", "page fault", "work", "host", "timer", "drive", "other"];

/// Of causes that are none of the others, and of those that name the wrong stage or drive.
const OTHER: usize = 6;

/// A host that disturbs more than every fourth of the times in which nothing was done shows nothing about a search for
/// what was done: both meet in too many cycles. Such a row is taken again, up to so many times, and is not judged then.
const TRIES: usize = 3;

/// The row whose thread of samples is held up.
const UNWATCHED: &str = "unwatched";
/// The rows whose work is so short that the run time of quiet cycles varies as much on many a host.
const SHORT: [&str; 2] = ["short work", "after quiet"];

fn class(cause: Cause) -> usize {
    match cause {
        Cause::Preempted => 0,
        Cause::PageFault => 1,
        // The stage of the in-loop task, and the one drive that is stopped.
        Cause::Work(Stage::Commands) => 2,
        Cause::Host => 3,
        Cause::Timer => 4,
        Cause::Drive(1) => 5,
        Cause::Work(_) | Cause::Drive(_) | Cause::Drives | Cause::Unknown => OTHER,
    }
}

fn spin(ns: u64) {
    let end = MonotonicClock::read() + ns;
    while MonotonicClock::read() < end {
        std::hint::spin_loop();
    }
}

/// A machine of two drives in another process, and a master over them that does in its task what a test wants.
struct Bench {
    _machine: Machine,
    _first: Program,
    second: Program,
    master: Master,
    tasks: Arc<Tasks>,
}

/// What the in-loop task is to do in its next cycle, once.
#[derive(Default)]
struct Tasks {
    work: AtomicBool,
    work_ns: AtomicU64,
    touch: AtomicBool,
    slack: AtomicBool,
    memory: AtomicU64,
}

/// For so many cycles.
const SLACK_CYCLES: u64 = 5;

/// Pages that are taken away before they are touched.
const PAGES: usize = 3_000;
const PAGE: usize = 4096;

impl Bench {
    fn start(number: u8, realtime: Realtime, guard: Guard) -> Bench {
        Bench::with(number, realtime, guard, |_| {})
    }

    /// `change` has the last word on the cycle.
    fn with(number: u8, realtime: Realtime, guard: Guard, change: fn(&mut CyclePlan)) -> Bench {
        let machine = Machine::new(number);
        let config = machine.plain(2);
        // A simulation for each drive.
        let text = std::fs::read_to_string(&config).unwrap();
        let [head, first, second] = &text.split("[[bus.drive]]").collect::<Vec<_>>()[..] else { panic!() };
        let [first, second] = [first, second].map(|drive| format!("{head}[[bus.drive]]{drive}"));
        let (first, second) = (machine.write("first.toml", first), machine.write("second.toml", second));
        let mut plan = plan(&config);
        let cycle = &mut plan.cycle;
        (cycle.period_ns, cycle.late_ns, cycle.realtime) = (PERIOD_NS, Some(LATE_NS), realtime);
        // A slot may begin late by half of the window: those that are passed over run no task.
        (cycle.receive_deadline, cycle.guard) = (0.9, guard);
        // By number: this thread, which starts one loop after the other, is kept off the core of the first.
        let cores = fieldbeat_core::rt::host::online_cores().unwrap();
        let (near, far) = (cores[0].to_string(), *cores.last().unwrap());
        cycle.core = Some(far);
        change(cycle);
        let [_first, second] = [first, second].map(|config| {
            let mut sim =
                Program::spawn(Command::new(PROGRAM).arg("sim").arg(&config).args(["--core", &near]));
            sim.await_text("listening");
            sim
        });
        let tasks = Arc::new(Tasks::default());
        tasks.work_ns.store(DISTURBANCE_NS, Ordering::Relaxed);
        let given = Arc::clone(&tasks);
        let mut slack = 0;
        let master = Master::from_plan(plan)
            .with_task(move |_, _| {
                if given.work.swap(false, Ordering::Relaxed) {
                    spin(given.work_ns.load(Ordering::Relaxed));
                }
                if given.touch.swap(false, Ordering::Relaxed) {
                    let memory = given.memory.load(Ordering::Relaxed) as *mut u8;
                    for page in 0..PAGES {
                        // SAFETY: the mapping has so many pages and outlives the master.
                        unsafe { memory.add(page * PAGE).write_volatile(1) };
                    }
                }
                // The next sleeps may end later, but not so late that their cycles are passed over; one of them will,
                // if no other interrupt comes first.
                if given.slack.swap(false, Ordering::Relaxed) {
                    slack = SLACK_CYCLES;
                    timer_slack(DISTURBANCE_NS / 5 * 4);
                } else if slack > 0 {
                    slack -= 1;
                    if slack == 0 {
                        timer_slack(1);
                    }
                }
            })
            .start()
            .unwrap();
        stand_aside(master.granted().core);
        master.wait_online(LONG).unwrap();
        Bench { _machine: machine, _first, second, master, tasks }
    }

    /// Brings `what` about again and again; it returns the time in which it did.
    fn disturb(self, rounds: usize, mut what: impl FnMut(&Bench) -> (Time, Time)) -> Found {
        let (mut done, mut random) = (Vec::new(), fastrand::Rng::with_seed(4));
        let mut judged = BTreeMap::new();
        let mut collect = |causes: &Causes| {
            let before = judged.last_key_value().map(|((index, _), _)| *index);
            let newest: Vec<Judged> = causes.newest(MOST).copied().collect();
            let joins = |at| newest.len() < MOST || newest.iter().any(|late| late.index <= at);
            assert!(before.is_none_or(joins), "some were dropped");
            judged.extend(newest.into_iter().map(|late| ((late.index, late.from), late)));
        };
        self.master.measured(|measured| collect(&measured.causes));
        for round in 0..rounds {
            // Anywhere in a period.
            sleep(APART + Duration::from_nanos(random.u64(..PERIOD_NS)));
            done.push(what(&self));
            if round % 2 == 1 {
                self.master.measured(|measured| collect(&measured.causes));
            }
        }
        sleep(2 * APART);
        let run = self.master.finish();
        collect(&run.measured.causes);
        // The longest delay that meets each time; one without is not counted.
        let count = |times: &mut dyn Iterator<Item = (Time, Time)>| {
            let mut row = vec![0; CLASSES.len()];
            for (from, to) in times {
                let meets = judged.values().filter(|late| late.from <= to && late.to >= from);
                if let Some(late) = meets.max_by_key(|late| late.lateness.ns()) {
                    row[class(late.cause)] += 1;
                }
            }
            row
        };
        // As long, and so much sooner that no cycle is part of both.
        let before = |(from, to): &(Time, Time)| {
            let earlier = |time: &Time| Time(time.0 - to.since(*from) - 2 * PERIOD_NS);
            (earlier(from), earlier(to))
        };
        Found { row: count(&mut done.iter().copied()), host: count(&mut done.iter().map(before)) }
    }

    /// Requests something of the task, and waits until it is done.
    fn give(&self, what: fn(&Tasks) -> &AtomicBool) -> (Time, Time) {
        let from = MonotonicClock::read();
        what(&self.tasks).store(true, Ordering::Relaxed);
        while what(&self.tasks).load(Ordering::Relaxed) {
            sleep(Duration::from_micros(50));
        }
        (from, MonotonicClock::read() + DISTURBANCE_NS)
    }
}

/// What was found, by class.
struct Found {
    /// While something was done.
    row: Vec<usize>,
    /// While nothing was done: the host's own.
    host: Vec<usize>,
}

impl Found {
    /// Whether the host did little enough else than `done`.
    fn is_quiet(&self, done: usize, rounds: usize) -> bool {
        self.host.iter().sum::<usize>() - self.host[done] <= rounds / 4
    }

    /// What was found of other classes than `done` and `excused`, beyond what the host does by itself: its count, and
    /// three standard deviations of a Poisson one. Where the host does so in the midst of what was done, the delay is
    /// both; that is one in ten of its own at most, since what was done takes a tenth of the time.
    fn wrong(&self, done: usize, expected_silence: Option<usize>) -> usize {
        let others = (0..CLASSES.len()).filter(|class| *class != done && Some(*class) != expected_silence);
        let beyond = others.map(|class| {
            let host = self.host[class];
            self.row[class].saturating_sub(host + (3.0 * (host as f64).sqrt()).ceil() as usize)
        });
        let both = self.host.iter().sum::<usize>() / 10;
        beyond.sum::<usize>().saturating_sub(both)
    }
}

/// Of the calling thread, which is a normal one then, and is to be the first of its kind.
fn timer_slack(ns: u64) {
    // SAFETY: both take numbers only.
    unsafe {
        libc::prctl(libc::PR_SET_TIMERSLACK, ns as libc::c_ulong);
        libc::setpriority(libc::PRIO_PROCESS, 0, -20);
    }
}

fn preempted() -> Found {
    let bench = Bench::start(1, Realtime::Require, Guard::Off);
    let core = bench.master.granted().core.unwrap();
    let (go, wait) = unbounded::<()>();
    let (report, reported): (_, Receiver<(Time, Time)>) = unbounded();
    let thread = std::thread::spawn(move || {
        let plan = RealtimePlan {
            realtime: Realtime::Require,
            memory: Memory::Process,
            priority: 90,
            core: Some(core),
        };
        enter(&plan, &Regions::new()).unwrap();
        while wait.recv().is_ok() {
            let from = MonotonicClock::read();
            // Longer, since it comes at any time: only what lies across a grid point makes a cycle late.
            spin(DISTURBANCE_NS / 5 * 8);
            report.send((from, MonotonicClock::read())).unwrap();
        }
    });
    let row = bench.disturb(ROUNDS, move |_| {
        go.send(()).unwrap();
        reported.recv().unwrap()
    });
    thread.join().unwrap();
    row
}

fn page_fault() -> Found {
    let bench = Bench::start(2, Realtime::Require, Guard::Off);
    // SAFETY: a fresh private mapping; never unmapped.
    let memory = unsafe {
        libc::mmap(
            std::ptr::null_mut(),
            PAGES * PAGE,
            libc::PROT_READ | libc::PROT_WRITE,
            libc::MAP_PRIVATE | libc::MAP_ANONYMOUS,
            -1,
            0,
        )
    };
    assert_ne!(memory, libc::MAP_FAILED);
    bench.tasks.memory.store(memory as u64, Ordering::Relaxed);
    bench.disturb(ROUNDS, |bench| {
        // SAFETY: unlocks and drops pages of the mapping above, which nobody else uses.
        let refused = unsafe {
            libc::munlock(memory, PAGES * PAGE) != 0
                || libc::madvise(memory, PAGES * PAGE, libc::MADV_DONTNEED) != 0
        };
        assert!(!refused, "{}", std::io::Error::last_os_error());
        bench.give(|tasks| &tasks.touch)
    })
}

/// A quarter of a period at the default threshold.
fn short_work() -> Found {
    let usual = |cycle: &mut CyclePlan| (cycle.period_ns, cycle.late_ns) = (MS, None);
    let bench = Bench::with(7, Realtime::Require, Guard::Off, usual);
    bench.tasks.work_ns.store(250 * US, Ordering::Relaxed);
    bench.disturb(ROUNDS, |bench| bench.give(|tasks| &tasks.work))
}

/// After so much quiet that the thread which takes the samples takes few.
fn work_after_quiet() -> Found {
    let usual = |cycle: &mut CyclePlan| (cycle.period_ns, cycle.late_ns) = (MS, None);
    let bench = Bench::with(9, Realtime::Require, Guard::Off, usual);
    bench.tasks.work_ns.store(250 * US, Ordering::Relaxed);
    bench.disturb(ROUNDS / 2, |bench| {
        sleep(QUIET);
        bench.give(|tasks| &tasks.work)
    })
}

/// While the thread that takes the samples is held up for 150 ms at a time.
fn unwatched_work() -> Found {
    let bench = Bench::start(8, Realtime::Require, Guard::Off);
    let end = Arc::new(AtomicBool::new(false));
    let ending = Arc::clone(&end);
    let monitor = bench.master.monitor();
    let thread = std::thread::spawn(move || {
        while !ending.load(Ordering::Relaxed) {
            // It waits for whoever looks at its numbers.
            monitor.measured(|_| sleep(Duration::from_millis(150)));
            sleep(Duration::from_millis(20));
        }
    });
    let row = bench.disturb(ROUNDS / 2, |bench| bench.give(|tasks| &tasks.work));
    end.store(true, Ordering::Relaxed);
    thread.join().unwrap();
    row
}

fn work() -> Found {
    Bench::start(3, Realtime::Require, Guard::Off).disturb(ROUNDS, |bench| bench.give(|tasks| &tasks.work))
}

/// The loop's thread is held by a debugger, unseen by the scheduler, while it is awake: it spins for the half of each
/// period, and is back before the next one if it was held while it slept.
fn host() -> Found {
    let bench = Bench::start(4, Realtime::Require, Guard::Fixed(PERIOD_NS / 2));
    let tid = thread(std::process::id(), "fb-loop");
    let mut child = again("found_causes_are_the_injected_ones", &format!("hold {tid}"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let (mut ask, answer) = (child.stdin.take().unwrap(), child.stdout.take().unwrap());
    let mut answers = BufReader::new(answer).lines().map(Result::unwrap).filter_map(|line| {
        let (from, to) = line.strip_prefix("held ")?.split_once(' ')?;
        Some((Time(from.parse().ok()?), Time(to.parse().ok()?)))
    });
    let row = bench.disturb(2 * ROUNDS, |_| {
        std::io::Write::write_all(&mut ask, b"go\n").unwrap();
        answers.next().unwrap()
    });
    drop(ask);
    assert!(child.wait().unwrap().success());
    row
}

/// The debugger.
fn hold(tid: libc::pid_t) {
    let mut clock = MonotonicClock;
    // SAFETY: takes no pointer and has no precondition.
    let task = format!("/proc/{}/task/{tid}", unsafe { libc::getppid() });
    let read = |file: &str| std::fs::read_to_string(format!("{task}/{file}")).unwrap();
    let thread = Hold::seize(tid);
    for line in std::io::stdin().lines() {
        assert_eq!(line.unwrap(), "go");
        let from = loop {
            // `R` behind its name, which has no blank: it runs.
            while !read("stat").contains(") R ") {}
            let from = MonotonicClock::read();
            thread.stop();
            // In no system call, so that it spins (proc_pid_syscall(5)): a sleep that is held ends late, as by a timer.
            if read("syscall").starts_with("-1 ") {
                break from;
            }
            thread.go();
        };
        clock.sleep_until(from + DISTURBANCE_NS);
        thread.go();
        println!("held {} {}", from.0, MonotonicClock::read().0);
    }
    // Its end lets the thread go.
}

/// A normal thread, whose sleeps the kernel may stretch on request.
fn timer() -> Found {
    Bench::start(5, Realtime::Off, Guard::Off).disturb(ROUNDS, |bench| {
        let (from, to) = bench.give(|tasks| &tasks.slack);
        (from, to + SLACK_CYCLES * PERIOD_NS)
    })
}

fn drive() -> Found {
    Bench::start(6, Realtime::Require, Guard::Off).disturb(ROUNDS, |bench| {
        let from = MonotonicClock::read();
        bench.second.signal(SIGSTOP);
        // A reply counts for two periods.
        sleep(Duration::from_nanos(4 * PERIOD_NS));
        bench.second.signal(SIGCONT);
        (from, MonotonicClock::read())
    })
}

#[test]
#[ignore = "needs root: SCHED_FIFO, and a debugger's rights over its parent"]
fn found_causes_are_the_injected_ones() {
    let name = "found_causes_are_the_injected_ones";
    match role() {
        // In a process of its own: its memory is locked.
        None => {
            let ended = Program::spawn(&mut again(name, "all")).end_within(4 * LONG);
            print!("{}", ended.out);
            ended.expect(0);
            return;
        }
        Some(role) => {
            if let Some(tid) = role.strip_prefix("hold ") {
                return hold(tid.parse().unwrap());
            }
        }
    }
    type Row = (&'static str, usize, usize, fn() -> Found);
    let rows: [Row; 9] = [
        ("preempted", 0, ROUNDS, preempted),
        ("page fault", 1, ROUNDS, page_fault),
        ("work", 2, ROUNDS, work),
        (SHORT[0], 2, ROUNDS, short_work),
        (SHORT[1], 2, ROUNDS / 2, work_after_quiet),
        (UNWATCHED, 2, ROUNDS / 2, unwatched_work),
        ("host", 3, 2 * ROUNDS, host),
        ("timer", 4, ROUNDS, timer),
        ("drive", 5, ROUNDS, drive),
    ];
    let rows = rows.map(|(name, class, rounds, row)| {
        let mut found = row();
        for _ in 1..TRIES {
            if found.is_quiet(class, rounds) {
                break;
            }
            found = row();
        }
        (name, class, found.is_quiet(class, rounds), found)
    });
    println!("{:>12} {}", "", CLASSES.map(|class| format!("{class:>11}")).concat());
    let line = |counts: &[usize]| counts.iter().map(|count| format!("{count:>11}")).collect::<String>();
    let (mut right, mut wrong) = (0, 0);
    for (name, class, quiet, found) in &rows {
        println!("{name:>12} {}", line(&found.row));
        println!("{:>12} {}", "(host)", line(&found.host));
        if !quiet {
            println!("{:>12} not judged: the host did too much by itself", "");
        } else if *name != UNWATCHED {
            right += found.row[*class];
            wrong += found.wrong(*class, SHORT.contains(name).then_some(OTHER));
        }
    }
    println!("{right} on the diagonal, {wrong} wrong, {UNWATCHED} left out");
    for (name, class, _, found) in rows.iter().filter(|(_, _, quiet, _)| *quiet) {
        // Without samples close to it, or with nothing that stands out, it may say that it does not know, but nothing
        // wrong.
        let expected_silence = (*name == UNWATCHED || SHORT.contains(name)).then_some(OTHER);
        let (right, wrong) = (found.row[*class], found.wrong(*class, expected_silence));
        let right = right + expected_silence.map_or(0, |class| found.row[class]);
        assert!(right >= ROUNDS / 4, "{name}: only {right} were found");
        assert!(right * 100 >= (right + wrong) * 85, "{name}: {:?}, by the host {:?}", found.row, found.host);
    }
    assert!(right * 100 >= (right + wrong) * 95);
}
