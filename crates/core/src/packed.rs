//! Structures as words, field by field, for the cells that carry them from the loop to its readers.

/// A value as a fixed number of words.
#[doc(hidden)]
pub trait Part: Copy {
    /// Their number.
    const WORDS: usize;
    /// Writes them to the begin of `words`.
    fn put(&self, words: &mut [u64]);
    /// The value of words that [`put`](Self::put) wrote.
    fn take(words: &[u64]) -> Self;
}

/// Values of one word.
#[macro_export]
macro_rules! word {
    ($($type:ty: $put:expr, $take:expr;)+) => {
        $(impl $crate::packed::Part for $type {
            const WORDS: usize = 1;

            #[inline]
            fn put(&self, words: &mut [u64]) {
                words[0] = $put(*self);
            }

            #[inline]
            fn take(words: &[u64]) -> $type {
                $take(words[0])
            }
        })+
    };
}

word! {
    u64: u64::from, u64::from;
    u32: u64::from, |word| word as u32;
    u16: u64::from, |word| word as u16;
    u8: u64::from, |word| word as u8;
    i32: |number: i32| u64::from(number.cast_unsigned()), |word| (word as u32).cast_signed();
    bool: u64::from, |word| word != 0;
    i64: i64::cast_unsigned, u64::cast_signed;
    f64: f64::to_bits, f64::from_bits;
}

impl<T: Part, const N: usize> Part for [T; N] {
    const WORDS: usize = N * T::WORDS;

    #[inline]
    fn put(&self, words: &mut [u64]) {
        self.iter().zip(words.chunks_exact_mut(T::WORDS)).for_each(|(item, words)| item.put(words));
    }

    #[inline]
    fn take(words: &[u64]) -> [T; N] {
        std::array::from_fn(|at| T::take(&words[at * T::WORDS..]))
    }
}

/// `None` is a word that is zero; those behind it do not count.
impl<T: Part> Part for Option<T> {
    const WORDS: usize = 1 + T::WORDS;

    #[inline]
    fn put(&self, words: &mut [u64]) {
        words[0] = self.is_some().into();
        self.iter().for_each(|value| value.put(&mut words[1..]));
    }

    #[inline]
    fn take(words: &[u64]) -> Option<T> {
        (words[0] != 0).then(|| T::take(&words[1..]))
    }
}

/// Bytes, eight in each word, the lowest first.
#[doc(hidden)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bytes<const N: usize>(pub [u8; N]);

impl<const N: usize> Part for Bytes<N> {
    const WORDS: usize = N.div_ceil(size_of::<u64>());

    fn put(&self, words: &mut [u64]) {
        for (word, bytes) in words.iter_mut().zip(self.0.chunks(size_of::<u64>())) {
            *word = bytes.iter().rev().fold(0, |word, byte| word << 8 | u64::from(*byte));
        }
    }

    fn take(words: &[u64]) -> Bytes<N> {
        let mut bytes = [0; N];
        for (bytes, word) in bytes.chunks_mut(size_of::<u64>()).zip(words) {
            bytes.copy_from_slice(&word.to_le_bytes()[..bytes.len()]);
        }
        Bytes(bytes)
    }
}

/// The words of the field that this reads.
pub const fn words_of<S, T: Part>(_: fn(&S) -> T) -> usize {
    T::WORDS
}

/// Structures as their fields, one behind the other.
#[macro_export]
macro_rules! parts {
    ($($Name:ident { $($field:ident),+ })+) => {
        $(impl $crate::packed::Part for $Name {
            const WORDS: usize = 0 $(+ $crate::packed::words_of(|part: &$Name| part.$field))+;

            #[inline]
            fn put(&self, words: &mut [u64]) {
                $(let (part, words) = words.split_at_mut($crate::packed::words_of(|part: &$Name| part.$field));
                self.$field.put(part);)+
                let _ = words;
            }

            #[inline]
            fn take(words: &[u64]) -> $Name {
                $(let (part, words) = words.split_at($crate::packed::words_of(|part: &$Name| part.$field));
                let $field = $crate::packed::Part::take(part);)+
                let _ = words;
                $Name { $($field),+ }
            }
        })+
    };
}
