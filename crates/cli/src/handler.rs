//! What the program does next to a running master: the live line, what happened to links and black boxes, the service
//! manager, the control socket, and SIGUSR1.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use fieldbeat_control::{
    Answering, Legacies, OperatorSession, Sender, Server, Session, Station, Urgency, Watch, answer_operator,
    operator_urgency, place,
};
use fieldbeat_core::axis::feedback::FaultNames;
use fieldbeat_core::axis::{Axis, Fault, Link, StopCause};
use fieldbeat_core::rt::thread::helper_thread;
use fieldbeat_master::{Master, NoGuardian};
use fieldbeat_record::Summary;
use fieldbeat_record::blackbox::Written;
use fieldbeat_telemetry::{DriveEmergency, Failure, Measured, Monitor};
use serde_json::{Value, json};

use super::complain;
use super::interrupt::{Interrupt, LOOK_EVERY};
use super::live::{Count, Live};
use super::service::Service;

/// The reason why a drive has no connection is reported if it still holds so long after it was first seen: while one is
/// opened, it may be many things.
const STANDS_FOR: Duration = Duration::from_secs(1);

/// The number of reasons that are kept apart: numbers in them may make each another one.
const MOST_REASONS: usize = 64;

/// Looks after a master.
#[derive(Debug)]
pub struct Handler {
    live: Live,
    service: Service,
    interrupt: Interrupt,
    /// Answers `fieldbeat status` while it lives.
    control: Option<Server>,
    /// Those whose events nobody else takes.
    axes: Vec<Axis>,
    /// The axes, if others may operate them.
    station: Option<Station>,
    links: Vec<Link>,
    drives: Vec<DriveReports>,
    devices: Vec<DriveReports>,
    /// The remarks on drives and devices that are in operation.
    remarks: Vec<String>,
    /// All of them were online once.
    complete: bool,
    /// The number of the last file of the black box that was reported, and of the last emergency.
    black_boxes: usize,
    emergencies: u64,
    /// How many failures of the program itself were reported.
    failures: usize,
    /// The display panicked: from then on nothing is shown.
    is_blind: bool,
}

impl Handler {
    /// Begins. Without a control socket the master runs all the same.
    pub fn new(master: &Master, interrupt: &Interrupt) -> Handler {
        Handler::with(master, interrupt, None)
    }

    /// The same, and others may operate the axes of `station` through its control socket.
    pub fn operated(master: &Master, interrupt: &Interrupt, station: Station) -> Handler {
        Handler::with(master, interrupt, Some(station))
    }

    fn with(master: &Master, interrupt: &Interrupt, station: Option<Station>) -> Handler {
        let control = serve(master, station.clone());
        if let Err(why) = &control {
            complain(&format!("no `fieldbeat status`: {why}"));
        }
        Handler {
            live: Live::new(),
            service: Service::ready(),
            interrupt: interrupt.clone(),
            control: control.ok(),
            axes: Vec::new(),
            station,
            links: vec![Link::default(); master.observers().len()],
            drives: master.plan().fault_names().into_iter().map(DriveReports::new).collect(),
            devices: master.devices().iter().map(|_| DriveReports::new(|_| None)).collect(),
            remarks: Vec::new(),
            complete: false,
            black_boxes: 0,
            emergencies: 0,
            failures: 0,
            is_blind: false,
        }
    }

    /// Takes the events of these axes, which nobody else wants.
    pub fn taking(mut self, axes: Vec<Axis>) -> Handler {
        self.axes = axes;
        self
    }

    /// To be called some fifty times a second. `what` is going on.
    pub fn look(&mut self, master: &Master, what: &str) {
        self.look_and_count(master, what, Count::Operational);
    }

    /// The same while drives are waited for.
    pub fn look_while_waiting(&mut self, master: &Master) {
        self.look_and_count(master, "waiting for the drives", Count::Online);
    }

    fn look_and_count(&mut self, master: &Master, what: &str, count: Count) {
        // Here this program is the application.
        master.alive();
        if self.interrupt.wants_black_box() {
            master.write_black_box();
        }
        self.service.look(master);
        for axis in &mut self.axes {
            while axis.event().is_some() {}
        }
        if self.control.as_ref().is_some_and(Server::has_failed) {
            let what = "internal error: the control socket panicked; `fieldbeat status` may get no answer; \
                 please report it";
            master.monitor().failed(what, false);
        }
        if self.station.as_ref().is_some_and(Station::has_failed) {
            // Nothing ends what its operator does not hold any more.
            let what =
                "internal error: the operation of the axes panicked: the master ends; please report it";
            master.monitor().failed(what, true);
            master.stop();
        }
        if let Some(why @ NoGuardian::Ended) = master.no_guardian() {
            master.monitor().failed(&why.to_string(), false);
        }
        if self.is_blind {
            return;
        }
        let show = AssertUnwindSafe(|| {
            self.look_at_failures(master);
            self.look_at_links(master);
            self.look_at_drives(master);
            self.look_at_devices(master);
            self.look_at_remarks(master);
            self.look_at_emergencies(master);
            self.look_at_black_boxes(master);
            self.live.show(master, what, count);
        });
        if catch_unwind(show).is_err() {
            self.is_blind = true;
            let what = "internal error: the live line panicked; the run goes on without it; please report it";
            master.monitor().failed(what, false);
        }
    }

    /// Says what failed of the program itself.
    fn look_at_failures(&mut self, master: &Master) {
        let shown = self.failures;
        let new = |measured: &Measured| -> Vec<Failure> { measured.failures[shown..].to_vec() };
        let new = measured(master, new);
        self.failures += new.len();
        new.iter().for_each(|failure| self.live.say(&failure.what));
    }

    /// Requests the orderly end, and watches the master until it has come to it.
    pub fn end(mut self, master: &Master) {
        self.service.stopping();
        master.stop();
        while master.is_running() {
            self.look(master, "stop");
            std::thread::sleep(LOOK_EVERY);
        }
        // What no look has found the telemetry at rest for.
        self.look(master, "stop");
        self.live.end();
    }

    /// Says which drives came and went.
    fn look_at_links(&mut self, master: &Master) {
        for ((name, observer), known) in master.observers().iter().zip(&mut self.links) {
            let link = observer.feedback().link;
            if link == *known {
                continue;
            }
            match link {
                Link::Online if *known != Link::Unseen => {
                    self.live.say(&format!("drive {name}: back online"))
                }
                Link::Lost => self.live.say(&format!("drive {name}: lost")),
                Link::Online | Link::Unseen | Link::Qualifying => {}
            }
            if link != Link::Qualifying {
                *known = link;
            }
        }
        if !self.complete && !self.links.is_empty() && self.links.iter().all(|link| *link == Link::Online) {
            self.complete = true;
            self.live.say(&format!("all drives online: {}", self.links.len()));
        }
    }

    /// Says which drives cannot be connected to, and why; and which have a fault, and which one.
    fn look_at_drives(&mut self, master: &Master) {
        let now = Instant::now();
        let drives = master.observers().iter().zip(&mut self.drives);
        for (index, ((name, observer), known)) in drives.enumerate() {
            let feedback = observer.feedback();
            // Also while it is online: what is counted from then on says why it goes offline.
            let why = master.not_connected(index);
            let why = known.stands(feedback.link, now, || why);
            let apart = why.map(|why| format!("not connected: {why}"));
            let other = known.other_master(feedback.stopped);
            for news in apart.into_iter().chain(known.fault(feedback.status.fault)).chain(other) {
                self.live.say(&format!("drive {name}: {news}"));
            }
        }
    }

    /// Says what takes part without being a drive, and does not, and why.
    fn look_at_devices(&mut self, master: &Master) {
        let now = Instant::now();
        for (device, known) in master.devices().into_iter().zip(&mut self.devices) {
            let link = if device.not_operational.is_some() { Link::Unseen } else { Link::Online };
            let was_reported = known.apart.iter().any(|apart| apart.reported);
            let why = known.stands(link, now, || device.not_operational);
            let news = why.map(|why| format!("not in operation: {why}"));
            let back = (was_reported && link == Link::Online).then(|| "in operation".to_owned());
            for news in news.into_iter().chain(back) {
                self.live.say(&format!("device {}: {news}", device.name));
            }
        }
    }

    /// Says what is to be known of those that are in operation, once.
    fn look_at_remarks(&mut self, master: &Master) {
        for remark in master.remarks() {
            if !self.remarks.contains(&remark) {
                self.live.say(&remark);
                self.remarks.push(remark);
            }
        }
    }

    /// Says what drives reported by themselves.
    fn look_at_emergencies(&mut self, master: &Master) {
        let before = self.emergencies;
        let new = |measured: &Measured| -> Vec<DriveEmergency> {
            measured.emergencies.iter().filter(|one| one.number > before).copied().collect()
        };
        for newest in measured(master, new) {
            let missed = newest.number - self.emergencies - 1;
            self.emergencies = newest.number;
            if missed > 0 {
                self.live.say(&format!("{missed} emergencies before the next one came too fast to be shown"));
            }
            let ((name, _), known) = (&master.observers()[newest.axis], &self.drives[newest.axis]);
            let fault = Fault::new(newest.emergency.code.into(), known.fault_names);
            self.live.say(&format!(
                "drive {name}: {} (cycle {})",
                newest.emergency.described(fault),
                newest.cycle
            ));
        }
    }

    fn look_at_black_boxes(&mut self, master: &Master) {
        let shown = self.black_boxes;
        let new = |measured: &Measured| -> Vec<Written> {
            measured.black_boxes.iter().filter(|written| written.number > shown).cloned().collect()
        };
        for written in measured(master, new) {
            self.black_boxes = written.number;
            self.live.say(&written.to_string());
        }
    }
}

/// Looks at what the telemetry measured. While the master runs, this thread gives it signs of life, and waits for no
/// other: what is not seen now is seen with a later look.
fn measured<R: Default>(master: &Master, look: impl FnOnce(&Measured) -> R) -> R {
    match master.is_running() {
        true => master.try_measured(look).unwrap_or_default(),
        false => master.measured(look),
    }
}

/// The reports on a drive.
#[derive(Debug)]
struct DriveReports {
    fault_names: FaultNames,
    fault: u32,
    /// The axis is stopped for another master.
    other_master: bool,
    /// Why it had no connection since it was online.
    apart: Vec<Apart>,
}

/// Why a drive has no connection.
#[derive(Debug)]
struct Apart {
    why: String,
    first_seen: Instant,
    reported: bool,
}

impl DriveReports {
    fn new(fault_names: FaultNames) -> DriveReports {
        DriveReports { fault_names, fault: 0, other_master: false, apart: Vec::new() }
    }

    /// A reason that stands: each once, however often it is tried.
    fn stands(&mut self, link: Link, now: Instant, why: impl FnOnce() -> Option<String>) -> Option<String> {
        if link == Link::Online {
            self.apart.clear();
            return None;
        }
        let why = why()?;
        let Some(known) = self.apart.iter_mut().find(|known| known.why == why) else {
            if self.apart.len() < MOST_REASONS {
                self.apart.push(Apart { why, first_seen: now, reported: false });
            }
            return None;
        };
        if known.reported || now.duration_since(known.first_seen) < STANDS_FOR {
            return None;
        }
        known.reported = true;
        Some(why)
    }

    /// A line once another master commands the drive.
    fn other_master(&mut self, stopped: Option<StopCause>) -> Option<String> {
        let other = stopped == Some(StopCause::OtherMaster);
        let before = std::mem::replace(&mut self.other_master, other);
        (other && !before)
            .then(|| "another master commands it: its axis is stopped; end that master".to_owned())
    }

    /// The fault, if it is another one.
    fn fault(&mut self, code: u32) -> Option<String> {
        let before = std::mem::replace(&mut self.fault, code);
        match code {
            _ if code == before => None,
            0 => Some("fault gone".to_owned()),
            code => Some(format!("fault {}", Fault::new(code, self.fault_names))),
        }
    }
}

/// Answers questions about `master`, and lets others operate the axes of `station`.
pub fn serve(master: &Master, station: Option<Station>) -> Result<Server, String> {
    let config = master.plan().source.clone();
    let path = place::prepare(config.as_deref()).map_err(|error| error.to_string())?;
    let monitor = master.monitor();
    let core = master.granted().core;
    let acyclics = master.acyclics().to_vec();
    let watch = Watch::new(&monitor);
    let legacies = Legacies::default();
    let open = move || Conversation {
        monitor: monitor.clone(),
        config: config.clone(),
        session: Session::new(acyclics.clone(), &legacies),
        watch: watch.clone(),
        operator: station.as_ref().map(Station::session),
    };
    Server::start(&path, move || helper_thread(core), open).map_err(|error| error.to_string())
}

/// The questions of other processes to this master.
struct Conversation {
    monitor: Monitor,
    config: Option<PathBuf>,
    session: Session,
    watch: Watch,
    operator: Option<OperatorSession>,
}

impl Answering for Conversation {
    fn urgency(question: &Value) -> Urgency {
        operator_urgency(question).unwrap_or(if Session::is_slow(question) {
            Urgency::Slow
        } else {
            Urgency::Usual
        })
    }

    fn answer(&mut self, question: &Value, go_on: &dyn Fn() -> bool) -> Result<Value, String> {
        if question["ask"] == "status" {
            return Ok(status(&self.monitor, self.config.as_deref()));
        }
        let answer =
            answer_operator(self.operator.as_ref(), question).or_else(|| self.watch.answer(question));
        answer.or_else(|| self.session.answer(question, go_on)).unwrap_or_else(|| {
            Err("this master does not know that question; is it another version?".to_owned())
        })
    }

    fn stream(&mut self, question: &Value, send: &mut Sender<'_>) -> Option<std::io::Result<()>> {
        self.watch.stream(question, send)
    }

    fn end(&mut self, go_on: &dyn Fn() -> bool) {
        // First of all: what the conversation bequeathed may take minutes.
        self.operator = None;
        self.session.end(go_on);
    }
}

fn status(monitor: &Monitor, config: Option<&std::path::Path>) -> Value {
    let summary = Summary::from(monitor);
    json!({
        "pid": std::process::id(),
        "version": env!("CARGO_PKG_VERSION"),
        "config": config,
        "text": summary.to_string(),
        "summary": summary,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_comes_first_and_the_calls_of_drives_last() {
        let operate = |request: Value| json!({ "ask": "operate", "beat": 0, "request": request });
        for (question, urgency) in [
            (operate(json!("stop")), Urgency::Stop),
            (operate(json!({ "stop_axis": 1 })), Urgency::Stop),
            (operate(json!({ "take": { "name": "stop" } })), Urgency::Operate),
            (json!({ "ask": "status", "request": "stop" }), Urgency::Usual),
            (json!({ "ask": "claim", "drive": "x" }), Urgency::Usual),
            (json!({ "ask": "calls", "drive": "x", "calls": [] }), Urgency::Slow),
            (json!(["operate"]), Urgency::Usual),
        ] {
            assert_eq!(<Conversation as Answering>::urgency(&question), urgency, "{question}");
        }
    }

    #[test]
    fn a_reason_that_stands_is_reported_once_until_the_drive_was_online() {
        let mut known = DriveReports::new(|_| None);
        let mut now = Instant::now();
        let mut reported = |link, why: Option<&str>, wait: Duration| {
            now += wait;
            known.stands(link, now, || why.map(str::to_owned))
        };
        let short = STANDS_FOR / 4;
        // On the way up it is many things.
        for why in [None, Some("begins"), Some("waits"), Some("begins"), None] {
            assert_eq!(reported(Link::Unseen, why, short), None);
        }
        let not = |why: &str| Some(why.to_owned());
        assert_eq!(reported(Link::Unseen, Some("begins"), short), not("begins"));
        assert_eq!(reported(Link::Unseen, Some("refused"), short), None);
        assert_eq!(reported(Link::Qualifying, Some("refused"), STANDS_FOR), not("refused"));
        assert_eq!(reported(Link::Unseen, Some("silent"), short), None);
        // It is tried again and again, and is many things each time.
        assert_eq!(reported(Link::Unseen, Some("begins"), STANDS_FOR), None, "known");
        assert_eq!(reported(Link::Unseen, Some("silent"), short), not("silent"));
        for why in [Some("refused"), None, Some("refused"), Some("silent"), Some("silent")] {
            assert_eq!(reported(Link::Unseen, why, STANDS_FOR), None, "known");
        }
        assert_eq!(reported(Link::Online, Some("refused"), short), None);
        assert_eq!(reported(Link::Lost, Some("refused"), STANDS_FOR), None);
        assert_eq!(reported(Link::Lost, Some("refused"), STANDS_FOR), not("refused"));
    }

    #[test]
    fn a_fault_is_reported_by_its_name_when_it_comes_changes_and_goes() {
        let mut known = DriveReports::new(|code| (code == 30).then_some("watchdog"));
        let reported: Vec<_> = [0, 30, 30, 7, 0, 0].into_iter().map(|code| known.fault(code)).collect();
        let text: Vec<_> = reported.iter().map(Option::as_deref).collect();
        let expected = [
            None,
            Some("fault 0x001e (30, watchdog)"),
            None,
            Some("fault 0x0007 (7)"),
            Some("fault gone"),
            None,
        ];
        assert_eq!(text, expected);
    }
}
