//! The wire against simulated drives, in virtual time.

mod scan;
mod segment;
mod service;
mod station;

use fieldbeat_core::time::Time;
use fieldbeat_ethercat::wire::frame::{BROADCAST, Builder, Command, FRAME_MAX};

/// A frame of another master with one datagram, as it comes back.
fn foreign(now: Time, command: Command, data: &[u8], pass: impl FnOnce(Time, &mut [u8])) -> Vec<u8> {
    let mut room = [0; FRAME_MAX];
    let mut frame = Builder::new(&mut room, BROADCAST, [0x30; 6]).unwrap();
    frame.push_with(command, 9, data).unwrap();
    let length = frame.finish();
    pass(now, &mut room[..length]);
    room[..length].to_vec()
}

/// The data and the working counter of its datagram.
fn only(frame: &[u8]) -> (Vec<u8>, u16) {
    let datagram = fieldbeat_ethercat::wire::frame::datagrams(frame).unwrap().next().unwrap().unwrap();
    (datagram.data.to_vec(), datagram.working_counter)
}
