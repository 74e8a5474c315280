//! Values as people write them: times with a unit, IPv4 addresses, and words that are nearly right.

use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat_core::axis::is_plain_name;
use fieldbeat_core::time::{MS, S, US};

/// What a short plain name looks like: at most 32 characters, of ASCII only letters, digits, `-`, `_` and `.`.
pub const SHORT_NAME: &str = r"^[^\s!-,/:-@\[-^`{-~]{1,32}$";
/// What an IPv4 address looks like, with or without a port.
pub const ENDPOINT: &str = r"^[0-9]{1,3}(\.[0-9]{1,3}){3}(:[0-9]{1,5})?$";
/// What an IPv4 address looks like.
pub const HOST: &str = r"^[0-9]{1,3}(\.[0-9]{1,3}){3}$";
/// Not nothing.
pub const SOMETHING: &str = ".";
/// What a time looks like.
pub const TIME: &str =
    r"^ *([0-9]+(\.[0-9]+)? *h *[0-9]+(\.[0-9]+)? *m *|[0-9]+(\.[0-9]+)? *(ns|us|ms|s|min|h) *)+$";

/// A time as whole nanoseconds: digits, an optional fraction, a unit; spaces around and between number and unit.
/// `"250us"`, `"0.5s"`, `"1 ms"`. Several of them, the largest unit first, add up: `"1h30min"`; behind hours minutes
/// may be `m`.
pub fn duration(text: &str) -> Option<u64> {
    let (mut rest, mut total, mut above) = (text.trim_matches(' '), 0_u64, u64::MAX);
    while !rest.is_empty() {
        let end = rest.find(|c: char| !c.is_ascii_digit() && c != '.')?;
        let (number, behind) = rest.split_at(end);
        let behind = behind.trim_start_matches(' ');
        let (unit, next) =
            behind.split_at(behind.find(|c: char| !c.is_ascii_lowercase()).unwrap_or(behind.len()));
        let unit = match unit {
            "ns" => 1,
            "us" => US,
            "ms" => MS,
            "s" => S,
            "min" => 60 * S,
            "m" if above == 3600 * S => 60 * S,
            "h" => 3600 * S,
            _ => return None,
        };
        // A second unit that is not below the first one is a slip of the pen.
        total = if unit < above { total.checked_add(part(number, unit)?)? } else { return None };
        (rest, above) = (next.trim_start_matches(' '), unit);
    }
    (above < u64::MAX).then_some(total)
}

/// A number of a unit, ns.
fn part(number: &str, unit: u64) -> Option<u64> {
    let (whole, fraction) = match number.split_once('.') {
        Some((whole, fraction)) if !fraction.is_empty() => (whole, fraction),
        Some(_) => return None,
        None => (number, "0"),
    };
    let whole = whole.parse::<u64>().ok()?.checked_mul(unit)?;
    let parts = fraction.parse::<u64>().ok()?.checked_mul(unit)?;
    let divisor = 10_u64.checked_pow(u32::try_from(fraction.len()).ok()?)?;
    // A fraction of a nanosecond is a mistake, not something to round away.
    (parts % divisor == 0).then_some(whole.checked_add(parts / divisor)?)
}

/// `count` times `10^-decimals`, without loss and without zeros at its end: the shortest decimal number that says it.
pub fn decimal(count: i128, decimals: u32) -> String {
    let one = 10_i128.pow(decimals);
    let (sign, whole, fraction) = (if count < 0 { "-" } else { "" }, count / one, count % one);
    let fraction = format!("{:0width$}", fraction.abs(), width = decimals as usize);
    match fraction.trim_end_matches('0') {
        "" => format!("{sign}{}", whole.abs()),
        fraction => format!("{sign}{}.{fraction}", whole.abs()),
    }
}

/// `192.168.1.10` or `192.168.1.10:49360`.
pub fn endpoint(text: &str, default_port: u16) -> Option<SocketAddrV4> {
    match text.parse::<Ipv4Addr>() {
        Ok(address) => Some(SocketAddrV4::new(address, default_port)),
        Err(_) => text.parse().ok(),
    }
}

/// One that a packet can be sent to or from.
pub fn station(text: &str, default_port: u16) -> Option<SocketAddrV4> {
    endpoint(text, default_port).filter(|e| !e.ip().is_multicast() && !e.ip().is_broadcast() && e.port() != 0)
}

/// `"a", "b" or "c"`.
pub fn alternatives<'a>(words: impl IntoIterator<Item = &'a str>) -> String {
    let quoted: Vec<String> = words.into_iter().map(|word| format!("\"{word}\"")).collect();
    match quoted.split_last() {
        Some((last, rest)) if !rest.is_empty() => format!("{} or {last}", rest.join(", ")),
        _ => quoted.concat(),
    }
}

/// The known word that `word` was probably meant to be.
pub fn closest<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let length = word.chars().count();
    if length > 40 {
        return None;
    }
    let farthest = (length / 3).clamp(1, 3);
    known
        .into_iter()
        .map(|candidate| (distance(word, candidate), candidate))
        .filter(|(distance, _)| *distance <= farthest)
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, candidate)| candidate)
}

/// That `word` is an unknown `what`, if it is nearly a known one; else `otherwise`.
pub fn unknown<'a>(
    what: &str,
    word: &str,
    known: impl IntoIterator<Item = &'a str>,
    otherwise: &str,
) -> String {
    match closest(word, known) {
        Some(name) => format!("has an unknown {what}; did you mean \"{name}\"?"),
        None => otherwise.to_owned(),
    }
}

/// How many characters have to be added, left out, changed or swapped with their neighbour to make one of the other.
fn distance(a: &str, b: &str) -> usize {
    let (a, b): (Vec<char>, Vec<char>) = (a.chars().collect(), b.chars().collect());
    let mut cost = vec![vec![0; b.len() + 1]; a.len() + 1];
    for i in 0..=a.len() {
        for j in 0..=b.len() {
            if i == 0 || j == 0 {
                cost[i][j] = i + j;
                continue;
            }
            let change = cost[i - 1][j - 1] + usize::from(a[i - 1] != b[j - 1]);
            cost[i][j] = change.min(cost[i - 1][j] + 1).min(cost[i][j - 1] + 1);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                cost[i][j] = cost[i][j].min(cost[i - 2][j - 2] + 1);
            }
        }
    }
    cost[a.len()][b.len()]
}

/// A name as machines have them.
pub fn plain_name(text: &str) -> Option<String> {
    is_plain_name(text).then(|| text.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_exact() {
        for (text, ns) in [
            ("1ms", MS),
            ("250us", 250 * US),
            ("0.5s", 500 * MS),
            ("0.4ms", 400 * US),
            ("1.000000001s", S + 1),
            ("0us", 0),
            ("7ns", 7),
            ("1.5us", 1_500),
            ("1 ms", MS),
            (" 0.5  s ", 500 * MS),
            ("1h30min", 5_400 * S),
            ("1h30m", 5_400 * S),
            ("1h 30m 20s", 5_420 * S),
            ("1.5h0.5s", 5_400 * S + 500 * MS),
            ("2s500ms", 2_500 * MS),
        ] {
            assert_eq!(duration(text), Some(ns), "{text}");
        }
    }

    #[test]
    fn times_are_strict() {
        for (wrong, texts) in [
            ("a part is missing", &["", "1", "ms", ".5s", "1.s", "1h30"][..]),
            ("no number", &["1..5s", "-1ms", "+1ms", "1e3us", "1,5ms", "1.2.3ms", "1h-1s", "1 000us"]),
            ("no unit", &["1MS", "1m", "30m", "1\u{b5}s", "1 m s"]),
            ("a blank elsewhere", &["1 ", "1 .5ms", "1\tms", "1ms\n", "1\u{a0}ms"]),
            ("finer than 1 ns", &["0.5ns", "1.0000000001s"]),
            ("too long", &["99999999999999999999s", "18446744073.8s", "5124095h1000000min"]),
            ("not in order", &["1s1h", "1h1h", "1min30m"]),
        ] {
            for text in texts {
                assert_eq!(duration(text), None, "{wrong}: {text}");
            }
        }
    }

    #[test]
    fn decimals_are_exact_and_short() {
        for (count, decimals, text) in [
            (0, 4, "0"),
            (5_700, 4, "0.57"),
            (-1, 4, "-0.0001"),
            (-20_000, 4, "-2"),
            (i128::from(i32::MIN), 4, "-214748.3648"),
            (120, 0, "120"),
            (0, 0, "0"),
        ] {
            assert_eq!(decimal(count, decimals), text);
        }
    }

    #[test]
    fn endpoints_take_the_default_port() {
        assert_eq!(endpoint("10.0.0.1", 7).map(|e| e.to_string()), Some("10.0.0.1:7".into()));
        assert_eq!(endpoint("10.0.0.1:9", 7).map(|e| e.to_string()), Some("10.0.0.1:9".into()));
        for text in ["10.0.0", "10.0.0.1:", "10.0.0.1:65536", "::1", "[::1]:7", "drive-1", "10.0.0.256", ""] {
            assert_eq!(endpoint(text, 7), None, "{text}");
        }
    }

    #[test]
    fn a_slip_finds_its_word() {
        let known = ["period", "priority", "core", "divisor"];
        assert_eq!(closest("perod", known), Some("period"));
        assert_eq!(closest("divisro", known), Some("divisor"));
        assert_eq!(closest("cor", known), Some("core"));
        assert_eq!(closest("reference", known), None);
        assert_eq!(closest(&"p".repeat(1_000_000), known), None);
        assert_eq!(distance("kitten", "sitting"), 3);
    }

    #[test]
    fn words_read_as_a_sentence() {
        assert_eq!(alternatives(["a"]), r#""a""#);
        assert_eq!(alternatives(["a", "b", "c"]), r#""a", "b" or "c""#);
    }
}
