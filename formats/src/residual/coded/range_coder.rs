//! A binary range coder: one yes/no decision at a time, each with its own probability.
//!
//! The interval `[low, low + range)` of 32 bits is split at `range * p / 2^16`; a yes keeps the lower part. When the
//! range falls below 2^24 the top byte of `low` goes out and both shift up by 8 bits; a carry out of the 32 bits walks
//! back into the bytes already written. The end is the four bytes of `low`, so a decoder reads exactly the bytes that
//! the encoder wrote. One multiplication a decision.
//!
//! Source: Martin 1979, "Range encoding"; binary form with 16-bit probabilities as in LZMA.

/// Probabilities are fractions of this.
pub(super) const ONE: u32 = 1 << 16;
const BOTTOM: u32 = 1 << 24;

/// Either side of the channel, so that one model drives both and cannot disagree with itself.
pub(super) trait BitChannel {
    /// Codes a decision whose probability of yes is `p / 2^16`, `0 < p < 2^16`. The encoder writes `bit` and returns
    /// it; the decoder ignores `bit` and returns what it read.
    fn bit(&mut self, bit: bool, p: u32) -> bool;

    /// True once a decoder had to read past its bytes: all that follows is meaningless.
    fn exhausted(&self) -> bool;
}

/// Writes decisions.
pub(super) struct Encoder {
    low: u32,
    range: u32,
    out: Vec<u8>,
}

impl Encoder {
    /// An encoder that appends to `out`.
    pub(super) fn new(out: Vec<u8>) -> Self {
        Self { low: 0, range: u32::MAX, out }
    }

    /// Ends the stream and gives the bytes back.
    pub(super) fn finish(mut self) -> Vec<u8> {
        self.out.extend_from_slice(&self.low.to_be_bytes());
        self.out
    }
}

impl BitChannel for Encoder {
    #[inline(always)]
    fn bit(&mut self, bit: bool, p: u32) -> bool {
        let yes = ((u64::from(self.range) * u64::from(p)) >> 16) as u32;
        if bit {
            self.range = yes;
        } else {
            let (low, carry) = self.low.overflowing_add(yes);
            self.low = low;
            self.range -= yes;
            if carry {
                for byte in self.out.iter_mut().rev() {
                    *byte = byte.wrapping_add(1);
                    if *byte != 0 {
                        break;
                    }
                }
            }
        }
        while self.range < BOTTOM {
            self.out.push((self.low >> 24) as u8);
            self.low <<= 8;
            self.range <<= 8;
        }
        bit
    }

    fn exhausted(&self) -> bool {
        false
    }
}

/// Reads decisions.
pub(super) struct Decoder<'a> {
    value: u32,
    range: u32,
    bytes: &'a [u8],
    position: usize,
}

impl<'a> Decoder<'a> {
    /// A decoder at the start of `bytes`.
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        let mut this = Self { value: 0, range: u32::MAX, bytes, position: 0 };
        for _ in 0..4 {
            this.shift();
        }
        this
    }

    #[inline(always)]
    fn shift(&mut self) {
        let byte = self.bytes.get(self.position).copied().unwrap_or(0);
        self.value = self.value << 8 | u32::from(byte);
        self.position += 1;
    }

    /// Bytes consumed; past the end where the stream was cut.
    pub(super) fn position(&self) -> usize {
        self.position
    }
}

impl BitChannel for Decoder<'_> {
    #[inline(always)]
    fn bit(&mut self, _bit: bool, p: u32) -> bool {
        let yes = ((u64::from(self.range) * u64::from(p)) >> 16) as u32;
        let bit = self.value < yes;
        if bit {
            self.range = yes;
        } else {
            self.value -= yes;
            self.range -= yes;
        }
        while self.range < BOTTOM {
            self.shift();
            self.range <<= 8;
        }
        bit
    }

    fn exhausted(&self) -> bool {
        self.position > self.bytes.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Decisions and probabilities from a linear congruential generator; a decision is as likely as its probability
    /// says, except that every 97th is the unlikely one.
    fn decisions(count: usize) -> Vec<(bool, u32)> {
        let mut state = 7u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as u32
        };
        (0..count)
            .map(|i| {
                let p = [1, 16, 300, 32768, 65000, 65520, 65535][next() as usize % 7];
                (if i % 97 == 0 { p < 32768 } else { next() % ONE < p }, p)
            })
            .collect()
    }

    #[test]
    fn decisions_return_and_every_byte_is_read() {
        for count in [0, 1, 2, 100, 50_000] {
            let decisions = decisions(count);
            let mut encoder = Encoder::new(Vec::new());
            decisions.iter().for_each(|&(bit, p)| assert_eq!(encoder.bit(bit, p), bit));
            let bytes = encoder.finish();
            let mut decoder = Decoder::new(&bytes);
            for (i, &(bit, p)) in decisions.iter().enumerate() {
                assert_eq!(decoder.bit(!bit, p), bit, "decision {i}");
            }
            assert!(!decoder.exhausted());
            assert_eq!(decoder.position(), bytes.len());
        }
    }

    #[test]
    fn carries_walk_back_through_full_bytes() {
        // Hundreds of unlikely "no" put `low` near the top of its interval; the last decisions carry over.
        let mut encoder = Encoder::new(vec![0]);
        (0..4000).for_each(|i| _ = encoder.bit(i % 3 == 2, 65535));
        let bytes = encoder.finish();
        let mut decoder = Decoder::new(&bytes[1..]);
        assert!((0..4000).all(|i| decoder.bit(false, 65535) == (i % 3 == 2)));
    }

    #[test]
    fn the_cost_is_the_information() {
        let decisions = decisions(100_000);
        let bits: f64 =
            decisions.iter().map(|&(bit, p)| -(f64::from(if bit { p } else { ONE - p }) / f64::from(ONE)).log2()).sum();
        let mut encoder = Encoder::new(Vec::new());
        decisions.iter().for_each(|&(bit, p)| _ = encoder.bit(bit, p));
        // Rounding of the split is at most 2^-24 * 2^16 of a probability of 2^-16: less than one bit in 256 decisions.
        let written = encoder.finish().len() as f64 * 8.0;
        assert!(written < bits + 40.0 + 100_000.0 / 256.0, "{written} bits for {bits}");
        assert!(written > bits, "{written} bits for {bits}: less than the information");
    }

    #[test]
    fn a_decoder_without_bytes_says_so() {
        assert!(Decoder::new(&[1, 2, 3]).exhausted());
        let mut decoder = Decoder::new(&[1, 2, 3, 4]);
        assert!(!decoder.exhausted());
        (0..20).for_each(|_| _ = decoder.bit(false, 32768));
        assert!(decoder.exhausted());
    }
}
