//! A frame, a mailbox message and the words of an EEPROM, for every parser of what comes from a line: no bytes make it
//! panic, nothing reaches beyond what it was given, and what was understood is built again as the same bytes.

use fieldbeat_ethercat::image::{Read, returned};
use fieldbeat_ethercat::wire::frame::{
    Builder, DATAGRAM_HEADER, Datagram, FRAME_MAX, HEADER, WORKING_COUNTER, datagrams, set_command, set_index,
};
use fieldbeat_ethercat::wire::mailbox::Message;
use fieldbeat_ethercat::wire::sdo::Response;
use fieldbeat_ethercat::wire::sii::Category;
use fieldbeat_ethercat::wire::{mailbox, sii};

pub fn ethercat_wire(data: &[u8]) {
    frame(data);
    let (sent, received) = data.split_at(data.len() / 2);
    held_against(sent, received);
    message(data);
    eeprom(data);
}

fn frame(bytes: &[u8]) {
    let mut end = HEADER;
    let Ok(all) = datagrams(bytes) else { return };
    let mut sound = Vec::new();
    for read in all {
        let Ok(datagram) = read else { continue };
        let place = datagram.place;
        assert_eq!(place.at, end, "one behind the other");
        end = place.end();
        assert!(end <= bytes.len() && datagram.data.len() == place.length);
        assert_eq!(end, place.at + DATAGRAM_HEADER + place.length + WORKING_COUNTER);
        sound.push(datagram);
    }
    again(bytes, &sound);
}

/// The datagrams that were read are built again, and are the same.
fn again(bytes: &[u8], read: &[Datagram<'_>]) {
    let mut out = [0xEE; FRAME_MAX + 1];
    let (destination, source) =
        (std::array::from_fn(|at| bytes[at]), std::array::from_fn(|at| bytes[6 + at]));
    let mut builder = Builder::new(&mut out[..FRAME_MAX], destination, source).expect("there is room");
    let stem = builder.stem();
    let mut placed = Vec::new();
    for datagram in read {
        let Some(command) = datagram.command() else { return };
        let fits = builder.room().is_some_and(|room| datagram.data.len() <= room);
        let place = builder.push_with(command, datagram.index, datagram.data);
        assert_eq!(place.is_some(), fits);
        placed.extend(place);
    }
    let length = builder.finish();
    assert!(length <= FRAME_MAX && out[FRAME_MAX] == 0xEE);
    let built: Vec<_> =
        datagrams(&out[..length]).expect("it is one").map(|one| one.expect("it is one")).collect();
    assert_eq!(built.len(), placed.len());
    for (built, datagram) in built.iter().zip(read) {
        let same =
            (built.command(), built.index, built.data) == (datagram.command(), datagram.index, datagram.data);
        assert!(same && built.working_counter == 0 && !built.circulated);
        let back = returned(&out, &out, built.place, true);
        assert_eq!(back, Read::Good(0), "a frame is its own reply");
    }
    if let Some(mut builder) = Builder::resume(&mut out[..FRAME_MAX], stem) {
        assert!(builder.push(fieldbeat_ethercat::wire::frame::Command::Nop, 0, 2).is_some());
        let length = builder.finish();
        assert_eq!(datagrams(&out[..length]).expect("it is one").count(), 1, "what stood behind is gone");
    }
}

/// Any frame held against any other one.
fn held_against(sent: &[u8], received: &[u8]) {
    let Ok(all) = datagrams(sent) else { return };
    for datagram in all.map_while(Result::ok) {
        for stays in [true, false] {
            if let Read::Good(counter) = returned(sent, received, datagram.place, stays) {
                let end = datagram.place.data().end;
                assert_eq!(received[end..end + 2], counter.to_le_bytes());
                assert_eq!(received[datagram.place.at + 1], datagram.index);
                assert!(received.len() >= datagram.place.end());
            }
        }
        let mut short = received.to_vec();
        set_index(&mut short, datagram.place, 7);
        set_command(&mut short, datagram.place, fieldbeat_ethercat::wire::frame::Command::Brd(0));
        assert_eq!(short.len(), received.len());
    }
}

fn message(bytes: &[u8]) {
    for size in [16, 128, 1_024] {
        let extent = mailbox::extent(bytes, size);
        assert!((mailbox::HEADER..=size.max(mailbox::HEADER)).contains(&extent));
        let whole = &bytes[..bytes.len().min(size)];
        match mailbox::parse(whole) {
            Some(Message::Sdo { counter, response }) => {
                assert!(counter < 8);
                within(whole, &response);
            }
            Some(Message::Emergency(emergency)) => drop(format!("{emergency:?}")),
            Some(Message::Refused(error)) => drop(error.to_string()),
            Some(Message::Other) | None => {}
        }
    }
    if let Some(response) = Response::parse(bytes) {
        within(bytes, &response);
    }
}

/// What an answer brings stands in its message.
fn within(message: &[u8], response: &Response<'_>) {
    let data = match response {
        Response::Value { data, .. } => {
            assert!((1..=4).contains(&data.len()));
            data
        }
        Response::Begun { data, .. } | Response::Segment { data, .. } => data,
        Response::Abort { code, .. } => return assert!(code.name().is_none_or(|name| !name.is_empty())),
        Response::Downloaded { .. } | Response::SegmentTaken { .. } => return,
    };
    assert!(
        message.as_ptr_range().start <= data.as_ptr()
            && data.as_ptr_range().end <= message.as_ptr_range().end
    );
}

fn eeprom(bytes: &[u8]) {
    for words in bytes.as_chunks::<4>().0 {
        let category = Category::new(*words);
        assert_eq!(category.is_none(), words[..2] == [0xFF, 0xFF]);
    }
    for entry in bytes.as_chunks::<8>().0 {
        let (manager, _) = sii::sync_manager(*entry);
        assert_eq!(manager.to_bytes()[..4], entry[..4]);
    }
    if let Some(config) = bytes.first_chunk::<14>() {
        let mut other = *config;
        other[3] ^= 0x10;
        assert_ne!(sii::crc(config), sii::crc(&other), "every single bit counts");
    }
}
