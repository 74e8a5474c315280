//! Requests and browsers that mean no good, against a master in this process. Whatever they do, the loop loses no
//! record, no event and no drive.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::Duration;

use fieldbeat::Master;
use fieldbeat::sim::server::SimServer;
use fieldbeat::time::MS;
use fieldbeat_control::{About, Ended, Operator, Order, Part, Station, Watch, Watched};
use fieldbeat_core::cycle::record::Record;
use fieldbeat_scope::{Control, Endpoint, Server, Source};
use nix::sys::resource::{Resource, getrlimit, setrlimit};

use crate::socket::{Message, Socket, ask, cycles, get, status, upgrade, upgrade_from_any};
use crate::support::{LONG, Machine, carried, served, simulated, until};

/// The master of this process.
struct Own(Watch);

impl Source for Own {
    fn open(&mut self) -> Result<(About, Watched), String> {
        self.0.clone().local()
    }
}

/// A machine, its drives, its master.
struct Running {
    master: Master,
    watch: Watch,
    _drives: SimServer,
    _machine: Machine,
}

impl Running {
    fn start(test: u8, drives: usize) -> Running {
        Running::with(test, drives, "")
    }

    /// `cycle` are lines of `[cycle]`.
    fn with(test: u8, drives: usize, cycle: &str) -> Running {
        let machine = Machine::new(test);
        let config = machine.config("m.toml", drives, cycle, "simulate = { start = 10 }");
        let drives = served(|| simulated(&config));
        let master = Master::from_file(&config).unwrap().start().unwrap();
        master.wait_online(LONG).unwrap();
        let watch = Watch::new(&master.monitor());
        Running { master, watch, _drives: drives, _machine: machine }
    }

    fn serve(&self) -> (SocketAddr, Server) {
        let endpoint = Endpoint::bind(loopback(), None).unwrap();
        let address = endpoint.address();
        (address, endpoint.serve(Own(self.watch.clone()), None).unwrap())
    }

    /// A page that may command, and its token.
    fn serve_control(&self, control: impl Control) -> (SocketAddr, String, Server) {
        let endpoint = Endpoint::bind(loopback(), Some(Arc::new(control))).unwrap();
        assert!(endpoint.has_control());
        let (address, url) = (endpoint.address(), endpoint.url());
        let server = endpoint.serve(Own(self.watch.clone()), None).unwrap();
        let token = url.strip_prefix(&format!("http://{address}/#token=")).unwrap().to_owned();
        (address, token, server)
    }

    /// Nobody in the master has noticed anything.
    fn end(self) {
        let end = self.master.finish().end;
        let status = end.status;
        assert_eq!((status.lost_records, status.lost_events), (0, 0));
        assert!(end.drives.iter().all(|drive| drive.losses == 0));
    }
}

fn loopback() -> fieldbeat::telemetry::metrics::Address {
    fieldbeat::telemetry::metrics::address("0").unwrap()
}

/// Each of them follows the one before, from the first that is seen.
fn follow(socket: &mut Socket, frames: usize) -> Vec<u64> {
    let cycles: Vec<u64> = (0..frames).flat_map(|_| socket.cycles()).collect();
    assert!(cycles.windows(2).all(|two| two[0] < two[1]), "{cycles:?}");
    cycles
}

#[test]
fn requests_from_elsewhere_and_for_elsewhere_are_refused_by_their_status_and_commands_by_a_word() {
    let running = Running::start(1, 1);
    let (address, server) = running.serve();
    let page = ask(address, &format!("GET / HTTP/1.1\r\nHost: {address}\r\n\r\n"));
    assert_eq!(status(&page), 200);
    for part in ["content-security-policy: default-src 'none'", "x-content-type-options: nosniff", "<title>"]
    {
        assert!(page.contains(part), "no {part}: {page}");
    }
    for file in ["/style.css", "/main.js", "/uplot.min.js", "/uplot.LICENSE", "/icon.svg"] {
        assert_eq!(get(address, file, ""), 200, "{file}");
    }
    for file in ["/none.js", "/../Cargo.toml", "/assets/main.js"] {
        assert_eq!(get(address, file, ""), 404, "{file}");
    }
    let elsewhere = format!("GET http://evil.example/ HTTP/1.1\r\nHost: {address}\r\n\r\n");
    assert_eq!(status(&ask(address, &elsewhere)), 421);
    assert_eq!(status(&ask(address, &format!("POST / HTTP/1.1\r\nHost: {address}\r\n\r\n"))), 405);
    assert_eq!(upgrade(address, ""), 101);
    assert_eq!(upgrade_from_any(address, "Origin: http://evil.example\r\n"), 403);
    let many: String = (0..100).map(|line| format!("x-{line}: y\r\n")).collect();
    assert_eq!(get(address, "/", &many), 431);
    assert_eq!(get(address, "/", &format!("x: {}\r\n", "y".repeat(40_000))), 431);
    assert_eq!(get(address, "/ws", ""), 400);
    // A page that only looks commands nothing.
    let mut socket = Socket::open(address, "").unwrap();
    assert_eq!(socket.text("control"), false);
    socket.say(r#"{"operate":"stop"}"#).unwrap();
    let answer = socket.text("operated");
    assert!(answer["error"].as_str().unwrap().contains("--control"), "{answer}");
    drop(server);
    running.end();
}

#[test]
fn a_page_that_may_command_needs_the_token_of_its_address() {
    /// Of a master that lets nobody.
    struct Nobody;

    impl Control for Nobody {
        fn operator(&self) -> Result<Operator, String> {
            Err("it lets nobody".to_owned())
        }
    }

    let running = Running::start(2, 1);
    let (address, token, _server) = running.serve_control(Nobody);
    // The files of the page are the same everywhere. Nothing that is sent to other ports is kept in the browser.
    let page = ask(address, &format!("GET / HTTP/1.1\r\nHost: {address}\r\n\r\n"));
    assert!(status(&page) == 200 && !page.to_lowercase().contains("set-cookie"), "{page}");
    let protocol = |token: &str| format!("Sec-WebSocket-Protocol: fieldbeat, {token}\r\n");
    let wrong = "0".repeat(token.len());
    let cookies = format!("Cookie: fieldbeat-{}={token}; token={token}\r\n", address.port());
    for headers in [&protocol(&wrong), &cookies] {
        assert_eq!(upgrade(address, headers), 401, "{headers}");
    }
    assert_eq!(upgrade_from_any(address, &protocol(&token)), 403, "no page has opened it");
    // Why it is refused is said to the page.
    for (named, status) in [("", 401), (wrong.as_str(), 401), (token.as_str(), 204)] {
        assert_eq!(get(address, "/access", &format!("Authorization: Bearer {named}\r\n")), status, "{named}");
    }
    assert_eq!(get(address, &format!("/access?token={token}"), &cookies), 401);
    let mut socket = Socket::open(address, &protocol(&token)).unwrap();
    assert_eq!(socket.text("control"), true);
    socket.say(r#"{"operate":{"take":{"name":"test"}}}"#).unwrap();
    assert_eq!(socket.text("operated"), serde_json::json!({ "error": "it lets nobody" }));
    running.end();
}

#[test]
fn four_hundred_browsers_connect_and_thirty_two_are_served_and_the_others_refused() {
    let running = Running::start(4, 2);
    let (address, _server) = running.serve();
    let mut sockets: Vec<Socket> = Vec::new();
    let mut refused = 0;
    for _ in 0..400 {
        match Socket::open(address, "") {
            Ok(socket) => sockets.push(socket),
            Err(answer) => {
                assert_eq!(status(&answer), 503);
                refused += 1;
            }
        }
    }
    assert_eq!((sockets.len(), refused), (32, 400 - 32));
    for socket in &mut sockets {
        socket.say(r#"{"show":[0]}"#).unwrap();
    }
    sockets.iter_mut().for_each(|socket| drop(follow(socket, 2)));
    // Whoever goes makes room.
    sockets.truncate(31);
    assert!(until(LONG, || upgrade(address, "") == 101));
    running.end();
}

#[test]
fn silent_connections_make_room_for_requesting_ones() {
    // Both ends of each connection are this process'.
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
    setrlimit(Resource::RLIMIT_NOFILE, most, most).unwrap();
    let running = Running::start(10, 1);
    let (address, _server) = running.serve();
    let silent = || {
        let mut stream = TcpStream::connect(address).unwrap();
        // Half a request; those whose place was taken may have been hung up on.
        let _ = stream.write_all(b"GET / HT");
        stream
    };
    // More than there is room for, again and again: not one of those that ask is turned away.
    let mut all: VecDeque<TcpStream> = (0..600).map(|_| silent()).collect();
    for _ in 0..40 {
        for _ in 0..20 {
            all.pop_front();
            all.push_back(silent());
        }
        assert_eq!((get(address, "/", ""), upgrade(address, "")), (200, 101));
    }
    // The oldest made room.
    all[0].set_read_timeout(Some(LONG)).unwrap();
    let end = all[0].read(&mut [0]);
    assert!(
        end.as_ref().is_ok_and(|count| *count == 0)
            || end.is_err_and(|error| error.kind() != ErrorKind::WouldBlock)
    );
    drop(all);
    running.end();
}

#[test]
fn late_cycles_arrive_with_their_causes() {
    // Each cycle is late, with such a bound.
    let running = Running::with(11, 1, "late = \"1us\"");
    let (address, _server) = running.serve();
    let mut socket = Socket::open(address, "").unwrap();
    let mut seen = Vec::new();
    let is_seen = until(LONG, || {
        let Message::Text(text) = socket.next().unwrap() else { return false };
        let late = text["late"].as_array().into_iter().flatten();
        seen.extend(
            late.map(|late| (late["cycle"].as_u64().unwrap(), late["text"].as_str().unwrap().to_owned())),
        );
        assert!(seen.len() as u64 <= text["late_count"].as_u64().unwrap_or(u64::MAX), "{text}");
        seen.len() >= 100
    });
    assert!(is_seen, "{seen:?}");
    assert!(seen.iter().all(|(_, cause)| !cause.is_empty()), "{seen:?}");
    // Each once.
    let count = seen.len();
    seen.sort_unstable();
    seen.dedup_by_key(|(cycle, _)| *cycle);
    assert_eq!(seen.len(), count);
    running.end();
}

#[test]
fn a_flooding_client_is_disconnected_alone() {
    let running = Running::start(5, 1);
    let (address, _server) = running.serve();
    let mut other = Socket::open(address, "").unwrap();
    other.say(r#"{"show":[0]}"#).unwrap();
    let before = *follow(&mut other, 2).last().unwrap();
    let floods: [&dyn Fn(&mut Socket); 4] = [
        // More than any page sends. The server may hang up in the midst of it.
        &|socket| drop((0..10_000).try_for_each(|_| socket.say(r#"{"show":[0]}"#))),
        &|socket| socket.say("no JSON").unwrap(),
        &|socket| socket.say(r#"{"show":[-1]}"#).unwrap(),
        // Unknown keys, too.
        &|socket| socket.say(r#"{"show":[0],"x":1}"#).unwrap(),
    ];
    for flood in floods {
        let mut socket = Socket::open(address, "").unwrap();
        flood(&mut socket);
        // The close may be lost, where much is on its way; the end is not.
        assert!(matches!(socket.close(), Some(1008) | None));
    }
    let mut socket = Socket::open(address, "").unwrap();
    // Longer than any message of the page: the server may have hung up before all of it was sent.
    let _ = socket.say(&format!(r#"{{"show":[{}0]}}"#, "0,".repeat(100_000)));
    assert!(matches!(socket.close(), Some(1008 | 1009) | None));
    let after = follow(&mut other, 2);
    assert!(after[0] > before);
    running.end();
}

/// Reads `quick`, which loses nothing, until the queue of a browser that never reads is full: 128 updates, and what the
/// kernel keeps.
fn fill_the_other(quick: &mut Socket) -> Vec<u64> {
    let mut seen = Vec::new();
    while seen.len() < (8 * 1000 / (carried() / MS)) as usize {
        match quick.next().unwrap() {
            Message::Samples(bytes) => seen.extend(cycles(&bytes)),
            Message::Text(text) => assert!(text["frames_lost"].is_null(), "{text}"),
            Message::Close(code) => panic!("closed: {code}"),
        }
    }
    seen
}

#[test]
fn a_browser_that_never_reads_loses_frames_alone_and_its_stop_is_taken_at_once() {
    struct Axes(Station);

    impl Control for Axes {
        fn operator(&self) -> Result<Operator, String> {
            Ok(Operator::local(&self.0))
        }
    }

    let running = Running::start(9, 4);
    let all_records = running.master.monitor().tap(1 << 16);
    let names: Vec<String> = running.master.observers().iter().map(|(name, _)| name.to_string()).collect();
    let axes = names.iter().map(|name| running.master.axis(name).unwrap()).collect();
    let station = Station::start(axes, running.master.monitor()).unwrap();
    let (address, token, _server) = running.serve_control(Axes(station.clone()));
    let protocol = format!("Sec-WebSocket-Protocol: fieldbeat, {token}\r\n");
    let [mut slow, mut quick] = std::array::from_fn(|_| Socket::open(address, &protocol).unwrap());
    slow.narrow();
    let signals = slow.text("machine")["signals"].as_array().unwrap().len();
    slow.say(&format!(r#"{{"show":{:?}}}"#, (0..signals).collect::<Vec<usize>>())).unwrap();
    quick.say(r#"{"show":[0,11]}"#).unwrap();
    let seen = fill_the_other(&mut quick);
    // The quick one saw each executed cycle, and what is between them the loop has skipped.
    let range = seen[0]..=*seen.last().unwrap();
    let (mut executed, mut slots) = (Vec::new(), Vec::new());
    while let Ok(batch) = all_records.next(Duration::ZERO) {
        for record in batch.iter() {
            match record {
                Record::Cycle(cycle) => executed.push(cycle.index),
                Record::Skipped(skipped) => slots.extend(skipped.first..skipped.first + skipped.count),
                _ => {}
            }
        }
    }
    executed.retain(|cycle| range.contains(cycle));
    assert_eq!(seen, executed);
    slots.retain(|cycle| range.contains(cycle));
    slots.extend(executed);
    slots.sort_unstable();
    assert!(slots.into_iter().eq(range));
    let mut operator = Operator::local(&station);
    operator.take("test").unwrap();
    let end_of = |operator: &mut Operator, id: u64| {
        let mut how = None;
        let has_ended = until(LONG, || {
            // An operator that is silent leaves, and that would be a stop, too.
            let state = operator.state(0).unwrap();
            assert_eq!(state.operator.as_deref(), Some("test"));
            let ends = state.notices.iter().filter_map(|notice| notice.end.as_ref());
            how = ends.filter(|end| end.command == id).map(|end| end.how).next();
            how.is_some()
        });
        assert!(has_ended);
        how.unwrap()
    };
    for order in [Order::Enable, Order::Home] {
        let id = operator.command(0, order).unwrap();
        assert_eq!(end_of(&mut operator, id), Ended::Done, "{order:?}");
    }
    // It takes longer than any test.
    let long = operator.command(0, Order::step(100.0, 0.5)).unwrap();
    let moves = |operator: &mut Operator| operator.state(u64::MAX).unwrap().axes[0].moving;
    assert!(until(LONG, || moves(&mut operator)));
    slow.say(r#"{"operate":"stop"}"#).unwrap();
    assert_eq!(end_of(&mut operator, long), Ended::Aborted);
    // The answer is before all that had no room; its queue was full all the time.
    assert_eq!(slow.text("operated"), serde_json::json!({ "ok": "done" }));
    assert!(slow.text("frames_lost").as_u64().unwrap() > 0);
    // And it is served again.
    follow(&mut slow, 3);
    drop(operator);
    running.end();
}

#[test]
fn a_scope_that_reads_too_slowly_loses_records_and_reports_it() {
    let running = Running::start(8, 4);
    let (_, mut watched) = running.watch.clone().local().unwrap();
    // Its queue holds a little more than a second, and the kernel as much.
    let executed = || running.master.monitor().status().executed;
    let enough = executed() + 4 * 1000 / (carried() / MS);
    assert!(until(LONG, || executed() > enough));
    let mut lost = 0;
    let is_told = until(LONG, || {
        if let Some(Part::News(news)) = watched.part().unwrap() {
            lost = news.lost;
        }
        lost > 0
    });
    assert!(is_told);
    // From then on it gets them all.
    let mut last = None;
    for _ in 0..200 {
        let Some(Part::Records(records)) = watched.part().unwrap() else { continue };
        for record in records.iter().filter(|record| matches!(record, Record::Cycle(_))) {
            last = Some(record.index());
        }
    }
    assert!(last.is_some_and(|last| last > enough));
    running.end();
}

#[test]
fn four_scopes_watch_one_master_and_a_fifth_is_refused_with_the_reason() {
    let running = Running::start(7, 1);
    let served: Vec<(SocketAddr, Server)> = (0..4).map(|_| running.serve()).collect();
    for (address, _) in &served {
        let mut socket = Socket::open(*address, "").unwrap();
        socket.say(r#"{"show":[0]}"#).unwrap();
        follow(&mut socket, 1);
    }
    let (address, _fifth) = running.serve();
    let mut socket = Socket::open(address, "").unwrap();
    let is_reported = until(LONG, || {
        let Message::Text(text) = socket.next().unwrap() else { return false };
        text["waiting"].as_str().is_some_and(|why| why.contains("4 others watch"))
    });
    assert!(is_reported);
    // One of them ends, and its place is taken.
    drop(served.into_iter().next());
    socket.text("machine");
    socket.hang_up();
    running.end();
}
