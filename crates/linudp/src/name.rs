//! Names as a drive holds them: printable ASCII, and zeros behind it.

fn is_printable(name: &[u8]) -> bool {
    name.iter().all(|byte| matches!(byte, b' '..=b'~'))
}

/// The bytes of a name; `None` if it has more than `most` of them, or others than printable ASCII.
pub(super) fn bytes<const N: usize>(name: &str, most: usize) -> Option<[u8; N]> {
    let byte = |at| name.as_bytes().get(at).copied().unwrap_or(0);
    (name.len() <= most && is_printable(name.as_bytes())).then(|| std::array::from_fn(byte))
}

/// The name that these bytes are, of at most `most` of them; `None` if they are anything else.
pub(super) fn text(bytes: &[u8], most: usize) -> Option<&str> {
    let length = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    let (name, behind) = bytes.split_at(length);
    let is_one = length <= most && is_printable(name) && behind.iter().all(|byte| *byte == 0);
    std::str::from_utf8(name).ok().filter(|_| is_one)
}
