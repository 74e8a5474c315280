//! Wires behind ports of this host, with the master's own carrier at the other end.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use super::*;
use crate::serial::tests::wire_at;
use crate::server::{ServerOptions, SimServer};
use crate::testing::Slave;
use crate::{FaultPlan, Simulated};
use fieldbeat_core::net::{Broken, Carriers, Os, Serial};
use fieldbeat_testing::Pty;
use fieldbeat_testing::until;

fn name(what: &str) -> String {
    format!("{}wire-{what}-{}", local::PREFIX, std::process::id())
}

fn wire(port: &str) -> SerialWire {
    wire_at(port, &[7, 9])
}

fn start(port: &str, own_port: Option<String>, faults: FaultPlan) -> io::Result<SimServer> {
    serve(SerialWire { own_port, faults, ..wire(port) })
}

fn serve(wire: SerialWire) -> io::Result<SimServer> {
    SimServer::start(Simulated { wires: vec![wire], ..Simulated::default() }, ServerOptions::default())
}

fn open(port: &str) -> Box<dyn Serial> {
    let mut master = Os::default().serial(port, &Slave::LINE).unwrap();
    until("opened", || master.opened().is_some());
    master
}

/// An answer, or an end.
fn answer(master: &mut dyn Serial) -> Result<Vec<u8>, Broken> {
    let (mut got, mut end) = (Vec::new(), None);
    until("answered", || {
        // What follows is the next answer's.
        let mut room = [0; 3];
        let room = &mut room[..3 - got.len()];
        match master.receive(0, room) {
            Ok(count) => got.extend_from_slice(&room[..count.map_or(0, |(_, count)| count)]),
            Err(why) => end = Some(why),
        }
        got.len() >= 3 || end.is_some()
    });
    end.map_or(Ok(got), Err)
}

fn exchange(master: &mut dyn Serial, number: u8, value: u8) -> Result<Vec<u8>, Broken> {
    assert_eq!(master.send(0, &Slave::request(number, value))?.1, 3);
    answer(master)
}

#[test]
fn a_local_wire_answers_and_counts() {
    let port = name("answers");
    let mut server = start(&port, None, FaultPlan::default()).unwrap();
    let mut master = open(&port);
    for value in 0..50 {
        assert_eq!(exchange(&mut *master, 7, value).unwrap(), [135, value, value + 1]);
    }
    assert_eq!((exchange(&mut *master, 9, 1).unwrap(), master.unsent()), (vec![137, 1, 1], Ok(0)));
    server.end();
    assert_eq!(answer(&mut *master), Err(Broken::Closed));
    assert_eq!(master.send(0, b"x"), Err(Broken::Failed(libc::EPIPE)));
    let [stats] = &server.buses()[..] else { panic!() };
    let counts = (stats.received, stats.answered, stats.unsent);
    assert_eq!((stats.interface.as_str(), counts), (port.as_str(), (51, 51, 0)));
    assert!(server.stats().is_empty());
}

#[test]
fn a_local_wire_comes_and_goes_and_has_one_master() {
    let port = name("comes");
    let mut master = Os::default().serial(&port, &Slave::LINE).unwrap();
    let notes = master.notes();
    until("noted", || notes.get(0).is_some());
    assert_eq!(notes.get(0).unwrap(), format!("nobody simulates the wire {port}: start `fieldbeat sim`"));
    for _ in 0..3 {
        let server = start(&port, None, FaultPlan::default()).unwrap();
        assert!(start(&port, None, FaultPlan::default()).unwrap_err().to_string().contains("is taken"));
        until("opened", || master.opened().is_some());
        assert_eq!(exchange(&mut *master, 7, 3).unwrap(), [135, 3, 1]);
        // A second master is sent away, and the first one goes on.
        let mut second = open(&port);
        let sent_away = answer(&mut *second).or_else(|why| match why {
            Broken::Closed | Broken::Failed(libc::ECONNRESET) => Ok(vec![]),
            other => Err(other),
        });
        assert_eq!(sent_away, Ok(vec![]));
        assert_eq!(exchange(&mut *master, 7, 4).unwrap(), [135, 4, 2]);
        drop(server);
        assert!(answer(&mut *master).is_err());
        master.abandon(0, "it ended");
    }
}

#[test]
fn a_master_that_leaves_makes_room_for_the_next_one() {
    let port = name("leaves");
    let server = start(&port, None, FaultPlan::default()).unwrap();
    for round in 0..300_u32 {
        let mut master = open(&port);
        if round % 2 == 0 {
            // Sent away if the server has not seen the end of the one before.
            let _ = exchange(&mut *master, 7, 1);
        }
        drop(master);
    }
    let mut master = open(&port);
    until("served", || match exchange(&mut *master, 9, 5) {
        Ok(answer) => answer[..2] == [137, 5],
        Err(_) => {
            master.abandon(0, "sent away");
            until("opened", || master.opened().is_some());
            false
        }
    });
    drop(server);
}

#[test]
fn faults_on_a_wire_are_injected_counted_and_accounted_for() {
    let port = name("faults");
    let faults = FaultPlan { seed: 1, wrong_id: 0.3, ..FaultPlan::default() };
    let mut server = start(&port, None, faults).unwrap();
    let mut master = open(&port);
    let mut wrong = 0;
    for value in 0..100 {
        let answer = exchange(&mut *master, 7, value).unwrap();
        wrong += u64::from(answer[0] != 135);
        assert_eq!(answer[1], value);
    }
    server.end();
    assert_eq!(server.buses()[0].injected.wrong_id, wrong);
    assert!((15..50).contains(&wrong), "{wrong}");
}

/// A null modem between two pseudo-terminals.
struct Cable {
    cut: Arc<AtomicBool>,
    pump: Option<JoinHandle<()>>,
}

impl Cable {
    fn new(ends: [Pty; 2]) -> Cable {
        let cut = Arc::new(AtomicBool::new(false));
        let is_cut = Arc::clone(&cut);
        let pump = std::thread::spawn(move || {
            let [mut a, mut b] = ends;
            let mut bytes = [0; 512];
            while !is_cut.load(Ordering::Relaxed) {
                let (there, back) = (a.carry_to(&mut b, &mut bytes), b.carry_to(&mut a, &mut bytes));
                if !there && !back {
                    std::thread::sleep(Duration::from_micros(100));
                }
            }
        });
        Cable { cut, pump: Some(pump) }
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.cut.store(true, Ordering::Relaxed);
        self.pump.take().unwrap().join().unwrap();
    }
}

#[test]
fn a_wire_at_the_other_end_of_a_cable_answers_the_same_way() {
    let ends = [Pty::new(), Pty::new()];
    let [near, far] = [&ends[0], &ends[1]].map(|end| end.path.clone());
    let cable = Cable::new(ends);
    let error = start(&near, None, FaultPlan::default()).unwrap_err();
    assert!(error.to_string().contains("the other end of its cable"), "{error}");
    let error = start(&near, Some("/dev/no-such-port".into()), FaultPlan::default()).unwrap_err();
    assert!(error.to_string().contains("there is no serial port /dev/no-such-port"), "{error}");
    let server = start(&near, Some(far), FaultPlan::default()).unwrap();
    let mut master = open(&near);
    for value in 0..50 {
        assert_eq!(exchange(&mut *master, 9, value).unwrap(), [137, value, value + 1]);
    }
    drop(cable);
    assert!(answer(&mut *master).is_err());
    drop(server);
}
