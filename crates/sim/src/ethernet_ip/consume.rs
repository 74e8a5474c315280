//! Class 1 packets that come.
//!
//! Facts: sheet, 3.1 and 3.2. What is not the connection's own is counted and dropped, and feeds no watchdog.

use std::net::Ipv4Addr;

use super::adapter::Adapter;
use super::assembly::Outputs;
use super::cip::Reader;
use super::connections::Use;
use super::drive::Drive;
use super::items::{Items, item};
use fieldbeat_core::time::Time;

/// The bit of the run/idle header.
const RUN: u32 = 1;

/// Takes one packet.
pub(super) fn packet(adapter: &mut Adapter, now: Time, from: Ipv4Addr, bytes: &[u8], drive: &mut Drive) {
    let ignored = &mut adapter.ignored;
    let Some(items) = Items::parse(bytes) else {
        ignored.wrong_items += 1;
        return;
    };
    let (item::SEQUENCED_ADDRESS, item::CONNECTED_DATA, 8) =
        (items.address.0, items.data.0, items.address.1.len())
    else {
        ignored.wrong_items += 1;
        return;
    };
    let mut address = Reader(items.address.1);
    let (Some(id), Some(sequence)) = (address.u32(), address.u32()) else { return };
    let known = adapter
        .connections
        .open
        .iter_mut()
        .find(|connection| connection.purpose != Use::Messages && connection.consumed == id);
    let Some(connection) = known else {
        ignored.unknown_connection += 1;
        return;
    };
    if *connection.peer.ip() != from {
        ignored.wrong_source += 1;
        return;
    }
    let mut data = Reader(items.data.1);
    if !items.whole || data.0.len() != usize::from(connection.sizes.0) {
        ignored.wrong_length += 1;
        return;
    }
    if connection.sequence.is_some_and(|last| sequence.wrapping_sub(last) as i32 <= 0) {
        ignored.old_sequence += 1;
        return;
    }
    connection.sequence = Some(sequence);
    connection.feed(now);
    let Use::Owner(_) = connection.purpose else {
        return drive.heartbeat(now);
    };
    // The lengths were checked.
    let (Some(count), Some(header)) = (data.u16(), data.u32()) else { return };
    let ahead = match adapter.connections.settings.counts_forward {
        true => count.wrapping_sub(connection.count) as i16 > 0,
        false => !connection.begun || count != connection.count,
    };
    drive.fed(now);
    if !ahead {
        ignored.duplicate += 1;
        return;
    }
    (connection.count, connection.begun) = (count, true);
    let (Some(outputs), Ok(image)) = (Outputs::parse(data.0), data.0.try_into()) else { return };
    if header & RUN == 0 {
        ignored.idle += 1;
        return drive.idle(&outputs);
    }
    adapter.outputs = image;
    drive.outputs(&outputs);
}
