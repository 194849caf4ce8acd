//! The numbers of a row of a TIFF, of any width, and what predictors made of them.

/// A float of three bytes: a sign, 7 bits of exponent and 16 of mantissa.
pub(super) fn float_of_24(bits: u32) -> f32 {
    let (sign, exponent, mantissa) = (bits >> 23, bits >> 16 & 0x7f, bits & 0xffff);
    let size = match exponent {
        0 => mantissa as f32 * 2.0f32.powi(-62 - 16),
        0x7f if mantissa == 0 => f32::INFINITY,
        0x7f => f32::NAN,
        _ => (1.0 + mantissa as f32 / 65_536.0) * 2.0f32.powi(exponent as i32 - 63),
    };
    if sign == 1 {
        -size
    } else {
        size
    }
}

/// The numbers of a row. Those of whole bytes are in this machine's order.
pub(super) struct Bits<'a> {
    pub row: &'a [u8],
    /// In bits.
    pub at: usize,
}

impl Bits<'_> {
    /// The next number, of `bits` bits.
    pub(super) fn take(&mut self, bits: u32) -> u64 {
        let at = self.at;
        self.at += bits as usize;
        if matches!(bits, 16 | 24 | 32 | 64) && at.is_multiple_of(8) {
            let bytes = &self.row[at / 8..][..bits as usize / 8];
            let add = |sum: u64, byte: &u8| sum << 8 | u64::from(*byte);
            return if cfg!(target_endian = "little") {
                bytes.iter().rev().fold(0, add)
            } else {
                bytes.iter().fold(0, add)
            };
        }
        if bits == 8 && at.is_multiple_of(8) {
            return self.row[at / 8].into();
        }
        (at..at + bits as usize)
            .fold(0, |sum, bit| sum << 1 | u64::from(self.row[bit / 8] >> (7 - bit % 8) & 1))
    }
}

/// Undoes differences of neighbours in a row, of numbers of `size` bytes in this machine's order, `step` of them for a texel.
pub(super) fn add_up(row: &mut [u8], size: usize, step: usize) {
    let number = |bytes: &[u8]| {
        let add = |sum: u64, byte: &u8| sum << 8 | u64::from(*byte);
        if cfg!(target_endian = "little") {
            bytes.iter().rev().fold(0, add)
        } else {
            bytes.iter().fold(0, add)
        }
    };
    for at in (size * step..row.len() - row.len() % size).step_by(size) {
        let sum = number(&row[at - size * step..][..size]).wrapping_add(number(&row[at..][..size]));
        match cfg!(target_endian = "little") {
            true => row[at..at + size].copy_from_slice(&sum.to_le_bytes()[..size]),
            false => row[at..at + size].copy_from_slice(&sum.to_be_bytes()[8 - size..]),
        }
    }
}

/// Undoes the differences of the bytes of floats, which a row has sorted by their place in a float, the highest first.
pub(super) fn gather(row: &mut [u8], size: usize, step: usize) {
    for at in step..row.len() {
        row[at] = row[at].wrapping_add(row[at - step]);
    }
    let sorted = row.to_vec();
    let count = sorted.len() / size;
    for (i, float) in row.chunks_exact_mut(size).enumerate() {
        for (byte, to) in float.iter_mut().enumerate() {
            let from_high = if cfg!(target_endian = "little") { size - 1 - byte } else { byte };
            *to = sorted[from_high * count + i];
        }
    }
}
