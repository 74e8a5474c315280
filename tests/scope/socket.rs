//! A websocket client (RFC 6455) that reads and writes when its test wants it, and requests in plain text.

use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};

use serde_json::Value;

use crate::support::{LONG, until};

/// Everything that is answered to `request`.
pub fn ask(address: SocketAddr, request: &str) -> String {
    let mut stream = connect(address);
    stream.write_all(request.as_bytes()).unwrap();
    let mut text = Vec::new();
    // A reset after the answer is no concern.
    let _ = stream.read_to_end(&mut text);
    String::from_utf8_lossy(&text).into_owned()
}

fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(LONG)).unwrap();
    stream.set_write_timeout(Some(LONG)).unwrap();
    stream
}

/// The number of the status in an answer.
pub fn status(answer: &str) -> u16 {
    let status = answer.split(' ').nth(1).and_then(|status| status.parse().ok());
    status.unwrap_or_else(|| panic!("no answer: {answer}"))
}

/// The status of the answer to a GET with these further header lines.
pub fn get(address: SocketAddr, path: &str, headers: &str) -> u16 {
    status(&ask(address, &format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n{headers}\r\n")))
}

const UPGRADE: &str = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
                       Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n";

/// The status of a request for the websocket with these further header lines, from a page of this server.
pub fn upgrade(address: SocketAddr, headers: &str) -> u16 {
    Socket::open(address, headers).map_or_else(|answer| status(&answer), |_| 101)
}

/// The same, from whichever page the header lines name.
pub fn upgrade_from_any(address: SocketAddr, headers: &str) -> u16 {
    Socket::open_from_any(address, headers).map_or_else(|answer| status(&answer), |_| 101)
}

/// One message of the server.
#[derive(Debug)]
pub enum Message {
    Text(Value),
    Samples(Vec<u8>),
    Close(u16),
}

/// The cycles of samples.
pub fn cycles(bytes: &[u8]) -> Vec<u64> {
    let signals = usize::from(u16::from_le_bytes([bytes[2], bytes[3]]));
    let count = u32::from_le_bytes(*bytes[4..].first_chunk().unwrap()) as usize;
    let cycles = bytes[8 + (4 * signals).next_multiple_of(8) + 8 * count..].chunks_exact(8).take(count);
    cycles.map(|cycle| f64::from_le_bytes(cycle.try_into().unwrap()) as u64).collect()
}

/// An open websocket.
pub struct Socket(TcpStream);

impl Socket {
    /// Opens it as a page of this server does, or gives the answer that it got instead.
    pub fn open(address: SocketAddr, headers: &str) -> Result<Socket, String> {
        Socket::open_from_any(address, &format!("Origin: http://{address}\r\n{headers}"))
    }

    /// The same, from whichever page the header lines name.
    pub fn open_from_any(address: SocketAddr, headers: &str) -> Result<Socket, String> {
        let mut stream = connect(address);
        let request = format!("GET /ws HTTP/1.1\r\nHost: {address}\r\n{UPGRADE}{headers}\r\n");
        // One that is turned away may find the connection closed already; its answer is there all the same.
        let _ = stream.write_all(request.as_bytes());
        let mut head = Vec::new();
        let mut byte = [0];
        while !head.ends_with(b"\r\n\r\n") && stream.read(&mut byte).is_ok_and(|count| count == 1) {
            head.push(byte[0]);
        }
        let head = String::from_utf8_lossy(&head).into_owned();
        if status(&head) == 101 { Ok(Socket(stream)) } else { Err(head) }
    }

    /// Sends a message of the page.
    pub fn say(&mut self, text: &str) -> io::Result<()> {
        let mut frame = vec![0x81];
        match text.len() {
            length @ ..126 => frame.push(0x80 | length as u8),
            length @ ..0x1_0000 => {
                frame.push(0x80 | 126);
                frame.extend((length as u16).to_be_bytes());
            }
            length => {
                frame.push(0x80 | 127);
                frame.extend((length as u64).to_be_bytes());
            }
        }
        // Masked by zeros, which changes nothing.
        frame.extend([0; 4]);
        frame.extend(text.as_bytes());
        self.0.write_all(&frame)
    }

    /// The next message.
    pub fn next(&mut self) -> io::Result<Message> {
        let mut head = [0; 2];
        self.0.read_exact(&mut head)?;
        let length = match head[1] {
            126 => u64::from(u16::from_be_bytes(self.bytes()?)),
            127 => u64::from_be_bytes(self.bytes()?),
            length => length.into(),
        };
        let mut payload = vec![0; length as usize];
        self.0.read_exact(&mut payload)?;
        Ok(match head[0] {
            0x81 => Message::Text(serde_json::from_slice(&payload).unwrap()),
            0x82 => Message::Samples(payload),
            0x88 => Message::Close(u16::from_be_bytes(*payload.first_chunk().unwrap())),
            kind => panic!("a frame of kind {kind:#x}"),
        })
    }

    fn bytes<const N: usize>(&mut self) -> io::Result<[u8; N]> {
        let mut bytes = [0; N];
        self.0.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    /// The next text that has this key.
    pub fn text(&mut self, key: &str) -> Value {
        let mut found = None;
        let is_found = until(LONG, || {
            if let Message::Text(text) = self.next().unwrap() {
                found = text.get(key).cloned();
            }
            found.is_some()
        });
        assert!(is_found, "no {key}");
        found.unwrap()
    }

    /// The cycles of the next samples.
    pub fn cycles(&mut self) -> Vec<u64> {
        loop {
            if let Message::Samples(bytes) = self.next().unwrap() {
                return cycles(&bytes);
            }
        }
    }

    /// Reads up to the close of the server; its code.
    pub fn close(&mut self) -> Option<u16> {
        loop {
            match self.next() {
                Ok(Message::Close(code)) => return Some(code),
                Ok(_) => {}
                Err(_) => return None,
            }
        }
    }

    /// Says that it writes no more.
    pub fn hang_up(&self) {
        self.0.shutdown(Shutdown::Both).unwrap();
    }

    /// Takes less at a time than any browser.
    pub fn narrow(&self) {
        nix::sys::socket::setsockopt(&self.0, nix::sys::socket::sockopt::RcvBuf, &4096).unwrap();
    }
}
