//! The enabling device: a button or a pedal at the computer, which has to be held while anything moves. It is read as
//! the kernel reports it (evdev, <https://docs.kernel.org/input/input.html>), not as text of the terminal, so that its
//! going up is seen on every terminal.

use std::fs::File;
use std::io::{self, Read};
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use super::Stop;

/// Of linux/input-event-codes.h.
const EV_SYN: u16 = 0;
const EV_KEY: u16 = 1;
const SYN_DROPPED: u16 = 3;
const KEYS: usize = 0x300;
/// The keys that command something in the panel: they enable nothing, should somebody name the keyboard itself. The
/// arrows and page keys, those of the keypad, `e`, `d`, `h`, `r`, `q`, `+`, `=`, `-`, `*`, `/`, space and tab, where a
/// keyboard as in the USA has them.
const PANEL_KEYS: [usize; 25] = [
    103, 104, 105, 106, 108, 109, 72, 73, 75, 77, 80, 81, 18, 32, 35, 19, 16, 78, 13, 12, 74, 55, 98, 57, 15,
];

/// A bit for each key and button.
type Bits = [u8; KEYS / 8];

/// Which of them the device has (EVIOCGBIT(EV_KEY)), and which are down (EVIOCGKEY), of linux/input.h.
const HAS: libc::Ioctl = libc::_IOR::<Bits>(b'E' as u32, 0x20 + EV_KEY as u32);
const DOWN: libc::Ioctl = libc::_IOR::<Bits>(b'E' as u32, 0x18);

const EVENT: usize = size_of::<libc::input_event>();

/// Reads of 64 events at a look: a device that reports more is a device that moves, and its keys are looked at all the
/// same.
const MOST_READS: usize = 16;

/// How the device is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Enabling {
    /// One of its keys is held.
    Held,
    /// None is, or it was let go since the last look.
    Released,
    /// It cannot be read any more.
    Lost,
}

/// Reads which keys are down.
type KeysDown = Box<dyn Fn(&File) -> io::Result<Bits>>;

/// The device.
pub struct EnablingDevice {
    file: File,
    down: KeysDown,
    /// They have all been up since it was opened: one that is tied down enables nothing.
    was_up: bool,
    is_lost: bool,
}

impl EnablingDevice {
    /// Opens it.
    pub fn open(path: &Path) -> Result<EnablingDevice, Stop> {
        let refused = |why: &str| Stop::usage(format!("--enable-device {}: {why}", path.display()));
        // Without waiting: neither for the other end of a pipe nor for an event.
        let file = File::options().read(true).custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY).open(path);
        let file = file.map_err(|error| match error.kind() {
            io::ErrorKind::PermissionDenied => refused(
                "this user may not read it; add the user to its group, usually `input`, and log in again",
            ),
            _ => refused(&format!("{error}; name one of /dev/input/by-id")),
        })?;
        match bits(&file, HAS) {
            Err(_) => {
                Err(refused("this is no input device of the kernel (evdev); name one of /dev/input/by-id"))
            }
            Ok(has) if !is_any(has) => Err(refused("this device has no keys or buttons; name another one")),
            Ok(_) => Ok(EnablingDevice::of(file, |file| bits(file, DOWN))),
        }
    }

    /// Of events in `file`, whose reads do not wait, and of keys that are down as `down` reports.
    fn of(file: File, down: impl Fn(&File) -> io::Result<Bits> + 'static) -> EnablingDevice {
        EnablingDevice { file, down: Box::new(down), was_up: false, is_lost: false }
    }

    /// How it is now. One that is lost stays so: what is plugged in again may be another one.
    pub fn look(&mut self) -> Enabling {
        if self.is_lost {
            return Enabling::Lost;
        }
        // The events first: the request for the keys empties the queue of them.
        let looked = self.was_released().and_then(|released| Ok((released, (self.down)(&self.file)?)));
        let Ok((was_released, down)) = looked else {
            self.is_lost = true;
            return Enabling::Lost;
        };
        let is_down = is_any(down);
        self.was_up |= !is_down;
        if is_down && self.was_up && !was_released { Enabling::Held } else { Enabling::Released }
    }

    /// Whether a key has gone up since the last look, or may have: events were dropped.
    fn was_released(&mut self) -> io::Result<bool> {
        let mut released = false;
        let mut bytes = [0; 64 * EVENT];
        for _ in 0..MOST_READS {
            let count = match self.file.read(&mut bytes) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(count) if count % EVENT != 0 => return Err(io::ErrorKind::InvalidData.into()),
                Ok(count) => count,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => return Err(error),
            };
            // A time, the type, the code, the value: 1 down, 0 up, 2 repeats.
            released |= bytes[..count].chunks_exact(EVENT).any(|event| {
                let [t0, t1, c0, c1, value @ ..] = &event[EVENT - 8..] else { return true };
                let code = u16::from_ne_bytes([*c0, *c1]);
                match u16::from_ne_bytes([*t0, *t1]) {
                    EV_KEY => value == [0; 4] && !PANEL_KEYS.contains(&code.into()),
                    EV_SYN => code == SYN_DROPPED,
                    _ => false,
                }
            });
        }
        Ok(released)
    }
}

/// Whether any key is in `bits` that may enable.
fn is_any(mut bits: Bits) -> bool {
    for key in PANEL_KEYS {
        bits[key / 8] &= !(1 << (key % 8));
    }
    bits != [0; KEYS / 8]
}

fn bits(file: &File, request: libc::Ioctl) -> io::Result<Bits> {
    let mut bits = [0; KEYS / 8];
    // SAFETY: the kernel writes at most as many bytes as the request says, which is the length of `bits`.
    match unsafe { libc::ioctl(file.as_raw_fd(), request, bits.as_mut_ptr()) } {
        ..0 => Err(io::Error::last_os_error()),
        _ => Ok(bits),
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;
    use std::io::Write;
    use std::os::fd::OwnedFd;
    use std::os::unix::net::UnixStream;
    use std::rc::Rc;

    use super::*;

    /// A button of a joystick, and a pedal.
    const BUTTON: u16 = 0x120;
    const PEDAL: u16 = 0x101;

    /// A device in the hands of a test: what it reports goes through a socket, as the kernel writes it.
    struct Hand {
        end: Option<UnixStream>,
        down: Rc<RefCell<io::Result<Bits>>>,
    }

    impl Hand {
        fn device(down: &[u16]) -> (Hand, EnablingDevice) {
            let (end, other) = UnixStream::pair().unwrap();
            other.set_nonblocking(true).unwrap();
            let hand = Hand { end: Some(end), down: Rc::new(RefCell::new(Ok([0; KEYS / 8]))) };
            down.iter().for_each(|key| hand.set(*key, true));
            let state = Rc::clone(&hand.down);
            let device = EnablingDevice::of(OwnedFd::from(other).into(), move |_| match &*state.borrow() {
                Ok(bits) => Ok(*bits),
                Err(error) => Err(error.kind().into()),
            });
            (hand, device)
        }

        fn set(&self, key: u16, is_down: bool) {
            let mut down = self.down.borrow_mut();
            let byte = &mut down.as_mut().unwrap()[usize::from(key / 8)];
            *byte = *byte & !(1 << (key % 8)) | u8::from(is_down) << (key % 8);
        }

        fn report(&self, kind: u16, code: u16, value: i32) {
            self.report_many(1, kind, code, value);
        }

        /// At once: a socket has room for few small pieces.
        fn report_many(&self, count: usize, kind: u16, code: u16, value: i32) {
            let mut event = vec![0; EVENT - 8];
            event.extend(kind.to_ne_bytes().into_iter().chain(code.to_ne_bytes()).chain(value.to_ne_bytes()));
            self.end.as_ref().unwrap().write_all(&event.repeat(count)).unwrap();
        }

        /// A key goes down or up, and the event is complete.
        fn key(&self, key: u16, is_down: bool) {
            self.set(key, is_down);
            self.report(EV_KEY, key, is_down.into());
            self.report(EV_SYN, 0, 0);
        }
    }

    #[test]
    fn enabling_key_is_held_from_its_press_to_its_release() {
        let (hand, mut device) = Hand::device(&[]);
        assert_eq!(device.look(), Enabling::Released);
        hand.key(BUTTON, true);
        for _ in 0..3 {
            assert_eq!(device.look(), Enabling::Held);
            hand.report(EV_KEY, BUTTON, 2);
            // An axis of the same device moves.
            hand.report(3, 0, 512);
        }
        hand.key(BUTTON, false);
        assert_eq!(device.look(), Enabling::Released);
        // Let go and pressed again between two looks: what ran has ended all the same.
        hand.key(BUTTON, true);
        assert_eq!(device.look(), Enabling::Held);
        hand.key(BUTTON, false);
        hand.key(BUTTON, true);
        assert_eq!([device.look(), device.look()], [Enabling::Released, Enabling::Held]);
        // Of two buttons each that is let go counts.
        hand.key(PEDAL, true);
        assert_eq!(device.look(), Enabling::Held);
        hand.key(BUTTON, false);
        assert_eq!([device.look(), device.look()], [Enabling::Released, Enabling::Held]);
    }

    #[test]
    fn an_unreported_key_release_counts_too() {
        // Another program took the device for itself; or its queue was full.
        let (hand, mut device) = Hand::device(&[]);
        assert_eq!(device.look(), Enabling::Released);
        hand.key(BUTTON, true);
        assert_eq!(device.look(), Enabling::Held);
        hand.set(BUTTON, false);
        assert_eq!(device.look(), Enabling::Released);
        hand.key(BUTTON, true);
        assert_eq!(device.look(), Enabling::Held);
        hand.report(EV_SYN, SYN_DROPPED, 0);
        assert_eq!([device.look(), device.look()], [Enabling::Released, Enabling::Held]);
        // A flood of events hides nothing.
        hand.report_many(64 * MOST_READS, 3, 0, 1);
        hand.key(BUTTON, false);
        assert_eq!(device.look(), Enabling::Released);
    }

    #[test]
    fn a_stuck_key_or_a_run_key_is_no_enabling_key() {
        let (hand, mut device) = Hand::device(&[PEDAL]);
        for _ in 0..3 {
            assert_eq!(device.look(), Enabling::Released);
            hand.report(EV_KEY, PEDAL, 2);
        }
        hand.key(BUTTON, true);
        assert_eq!(device.look(), Enabling::Released, "the pedal was never up");
        hand.key(BUTTON, false);
        hand.key(PEDAL, false);
        assert_eq!(device.look(), Enabling::Released);
        for key in PANEL_KEYS {
            hand.key(key as u16, true);
            assert_eq!(device.look(), Enabling::Released);
        }
        hand.key(PEDAL, true);
        assert_eq!(device.look(), Enabling::Held);
        hand.key(PANEL_KEYS[0] as u16, false);
        assert_eq!(device.look(), Enabling::Held);
    }

    #[test]
    fn one_that_cannot_be_read_is_lost_for_good() {
        let unplug: [fn(&mut Hand); 3] = [
            |hand| hand.end = None,
            |hand| *hand.down.borrow_mut() = Err(io::ErrorKind::NotFound.into()),
            // Half an event.
            |hand| hand.end.as_ref().unwrap().write_all(&[1; EVENT / 2]).unwrap(),
        ];
        for unplug in unplug {
            let (mut hand, mut device) = Hand::device(&[]);
            device.look();
            hand.key(BUTTON, true);
            assert_eq!(device.look(), Enabling::Held);
            unplug(&mut hand);
            assert_eq!(device.look(), Enabling::Lost);
            *hand.down.borrow_mut() = Ok([0xff; KEYS / 8]);
            assert_eq!(device.look(), Enabling::Lost);
        }
    }
}
