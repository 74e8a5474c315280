//! Bytes as choices.

/// What is left of the bytes. Behind their end all choices are zero, so that every input is a whole program.
#[derive(Clone, Debug)]
pub struct Input<'a>(pub &'a [u8]);

impl<'a> Input<'a> {
    pub fn is_over(&self) -> bool {
        self.0.is_empty()
    }

    /// At most `count` bytes.
    pub fn bytes(&mut self, count: usize) -> &'a [u8] {
        let (taken, left) = self.0.split_at(count.min(self.0.len()));
        self.0 = left;
        taken
    }

    fn padded<const N: usize>(&mut self) -> [u8; N] {
        let mut bytes = [0; N];
        let taken = self.bytes(N);
        bytes[..taken.len()].copy_from_slice(taken);
        bytes
    }

    pub fn byte(&mut self) -> u8 {
        u8::from_le_bytes(self.padded())
    }

    pub fn word(&mut self) -> u16 {
        u16::from_le_bytes(self.padded())
    }

    pub fn long(&mut self) -> u32 {
        u32::from_le_bytes(self.padded())
    }

    pub fn flag(&mut self) -> bool {
        self.byte() & 1 == 1
    }

    /// `0 .. count`.
    pub fn below(&mut self, count: usize) -> usize {
        usize::from(self.byte()) % count
    }

    pub fn of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.below(choices.len())]
    }

    /// A number that somebody could mean, or one that nobody should: every fourth is from the edges of what an `f64`
    /// and the wire can hold.
    pub fn number(&mut self) -> f64 {
        const EDGES: [f64; 16] = [
            0.0,
            -0.0,
            f64::NAN,
            f64::INFINITY,
            f64::NEG_INFINITY,
            f64::MAX,
            f64::MIN,
            f64::MIN_POSITIVE,
            1e-300,
            1e-5,
            -1e-5,
            214_748.364_7,
            -214_748.364_8,
            214_748.4,
            429_496.729_5,
            1e18,
        ];
        match self.byte() {
            edge @ 0..64 => EDGES[usize::from(edge) % EDGES.len()],
            _ => f64::from(self.word() as i16) * 0.01,
        }
    }
}
