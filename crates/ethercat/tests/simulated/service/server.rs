//! A slave with objects of any length: expedited, normal and segmented transfers, from the other end of the wire.

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard};

use fieldbeat_core::time::Time;
use fieldbeat_ethercat::wire::sdo::Object;
use fieldbeat_sim::ethercat::{AlState, Application};

/// The change of an answer before it is sent: any number of messages in its place.
pub(super) type Twist = Box<dyn FnMut(Vec<u8>) -> Vec<Vec<u8>> + Send>;

/// The objects that it has, and the requests that it got.
#[derive(Default)]
pub(super) struct Shared {
    pub objects: Vec<(Object, Vec<u8>)>,
    pub requests: Vec<Vec<u8>>,
    pub twist: Option<Twist>,
    pub messages: VecDeque<Vec<u8>>,
    /// The count of the last request.
    pub last: u8,
    room: usize,
    /// The rest to read, or the part written so far, and where to.
    under_way: Option<(Object, Vec<u8>, usize)>,
    toggle: bool,
}

/// The same on both sides.
#[derive(Clone)]
pub(super) struct Server(Arc<Mutex<Shared>>);

impl fmt::Debug for Server {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Server")
    }
}

impl Server {
    pub(super) fn new(room: usize) -> Server {
        Server(Arc::new(Mutex::new(Shared { room, ..Shared::default() })))
    }

    pub(super) fn shared(&self) -> MutexGuard<'_, Shared> {
        self.0.lock().unwrap()
    }
}

/// A message with this count, type and body.
pub(super) fn message(counter: u8, kind: u8, body: &[u8]) -> Vec<u8> {
    let [low, high] = (body.len() as u16).to_le_bytes();
    [&[low, high, 0, 0, 0, counter << 4 | kind][..], body].concat()
}

/// The same, of CoE.
pub(super) fn coe(counter: u8, service: u8, sdo: &[u8]) -> Vec<u8> {
    message(counter, 3, &[&[0, service << 4][..], sdo].concat())
}

impl Shared {
    fn find(&mut self, object: Object) -> Option<&mut Vec<u8>> {
        self.objects.iter_mut().find(|(own, _)| *own == object).map(|(_, data)| data)
    }

    fn sdo(&mut self, sdo: &[u8]) -> Option<Vec<u8>> {
        let command = sdo[0];
        let object = Object::new(u16::from_le_bytes([sdo[1], sdo[2]]), sdo[3]);
        let first = |command: u8, value: [u8; 4]| {
            let [low, high] = object.index.to_le_bytes();
            [&[command, low, high, object.sub][..], &value].concat()
        };
        let abort = |code: u32| Some(first(0x80, code.to_le_bytes()));
        match command & 0xE0 {
            0x40 => {
                let Some(data) = self.find(object).cloned() else { return abort(0x0602_0000) };
                if (1..=4).contains(&data.len()) {
                    // Garbage behind it.
                    let mut value = [0xEE; 4];
                    value[..data.len()].copy_from_slice(&data);
                    return Some(first(0x43 | ((4 - data.len()) << 2) as u8, value));
                }
                let (now, later) = data.split_at(data.len().min(self.room - 16));
                (self.under_way, self.toggle) = (Some((object, later.to_vec(), 0)), false);
                let begun = first(0x41 | command & 0x10, (data.len() as u32).to_le_bytes());
                Some([&begun[..], now].concat())
            }
            0x60 => {
                let Some((_, data, _)) = &mut self.under_way else { return abort(0x0504_0001) };
                if (command & 0x10 != 0) != self.toggle {
                    return abort(0x0503_0000);
                }
                let part: Vec<u8> = data.drain(..data.len().min(self.room - 9)).collect();
                let last = u8::from(data.is_empty());
                self.toggle = !self.toggle;
                let unused = 7_usize.saturating_sub(part.len());
                let padding = vec![0xEE; unused];
                Some([&[command & 0x10 | (unused << 1) as u8 | last][..], &part, &padding].concat())
            }
            0x20 if command & 2 != 0 => {
                let bytes = 4 - usize::from(command >> 2 & 3);
                let Some(data) = self.find(object) else { return abort(0x0602_0000) };
                *data = sdo[4..4 + bytes].to_vec();
                Some(first(0x60, [0; 4]))
            }
            0x20 => {
                let size = u32::from_le_bytes([sdo[4], sdo[5], sdo[6], sdo[7]]) as usize;
                self.toggle = false;
                self.write(object, sdo[8..].to_vec(), size);
                Some(first(0x60, [0; 4]))
            }
            0x00 => {
                let Some((object, mut data, size)) = self.under_way.take() else { return abort(0x0504_0001) };
                let used = if sdo.len() == 8 { 7 - usize::from(command >> 1 & 7) } else { sdo.len() - 1 };
                data.extend(&sdo[1..1 + used]);
                assert_eq!(command & 1 != 0, data.len() == size, "the last one says so");
                self.write(object, data, size);
                Some(vec![0x20 | command & 0x10, 0, 0, 0, 0, 0, 0, 0])
            }
            _ => None,
        }
    }

    fn write(&mut self, object: Object, data: Vec<u8>, size: usize) {
        match data.len() == size {
            true => *self.find(object).unwrap() = data,
            false => self.under_way = Some((object, data, size)),
        }
    }
}

impl Application for Server {
    fn mailbox(&mut self, request: &[u8], reply: &mut Vec<u8>) -> bool {
        let mut shared = self.shared();
        let end = 6 + usize::from(u16::from_le_bytes([request[0], request[1]]));
        let request = request[..end].to_vec();
        shared.requests.push(request.clone());
        let counter = request[5] >> 4;
        if std::mem::replace(&mut shared.last, counter) == counter {
            return false;
        }
        let answer = shared.sdo(&request[8..]).map(|sdo| coe(counter, 3, &sdo));
        let twisted = match (answer, &mut shared.twist) {
            (Some(answer), Some(twist)) => twist(answer),
            (Some(answer), None) => vec![answer],
            (None, _) => Vec::new(),
        };
        shared.messages.extend(twisted);
        let next = shared.messages.pop_front();
        next.map(|next| reply.extend(next)).is_some()
    }

    fn message(&mut self, message: &mut Vec<u8>) -> bool {
        let next = self.shared().messages.pop_front();
        next.map(|next| message.extend(next)).is_some()
    }

    fn may_enter(&mut self, _now: Time, _state: AlState) -> Result<(), u16> {
        Ok(())
    }

    fn process(&mut self, _now: Time, _outputs: &[u8], _inputs: &mut [u8]) {}
}
