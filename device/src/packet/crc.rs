//! CRC-32C (Castagnoli), the checksum of every header and payload on the link.
//!
//! Reflected polynomial 0x82F63B78, initial value and final XOR 0xFFFFFFFF \[RFC3720\] B.4. With the feature `std` the
//! processor's own instruction is used through the crate `crc32c`; firmware gets a 1 KiB table. Both give the same value.

/// Bytes that are checksummed and passed on in one step: few enough that whoever takes them finds them in the
/// first-level cache.
pub(super) const BLOCK_BYTES: usize = 16 * 1024;

const TABLE: [u32; 256] = {
    let mut table = [0u32; 256];
    let mut i = 0;
    while i < 256 {
        let mut c = i as u32;
        let mut k = 0;
        while k < 8 {
            c = if c & 1 != 0 { (c >> 1) ^ 0x82f6_3b78 } else { c >> 1 };
            k += 1;
        }
        table[i] = c;
        i += 1;
    }
    table
};

/// CRC-32C of `bytes`.
pub fn crc32c(bytes: &[u8]) -> u32 {
    crc32c_append(0, bytes)
}

/// CRC-32C of the bytes whose checksum is `crc` followed by `bytes`; 0 stands for no bytes.
pub fn crc32c_append(crc: u32, bytes: &[u8]) -> u32 {
    #[cfg(feature = "std")]
    {
        crc32c::crc32c_append(crc, bytes)
    }
    #[cfg(not(feature = "std"))]
    {
        crc32c_append_table(crc, bytes)
    }
}

/// The table form that firmware uses, one byte a step.
pub fn crc32c_append_table(crc: u32, bytes: &[u8]) -> u32 {
    let mut c = !crc;
    for &b in bytes {
        c = (c >> 8) ^ TABLE[((c ^ u32::from(b)) & 0xff) as usize];
    }
    !c
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_check_values() {
        // [RFC3720] B.4: 32 zero bytes, 32 bytes of ones, ascending and descending bytes; and the usual "123456789".
        let ascending: [u8; 32] = core::array::from_fn(|i| i as u8);
        let descending: [u8; 32] = core::array::from_fn(|i| 31 - i as u8);
        for (bytes, expected) in [
            (&[0u8; 32][..], 0x8a91_36aa),
            (&[0xffu8; 32][..], 0x62a8_ab43),
            (&ascending[..], 0x46dd_794e),
            (&descending[..], 0x113f_db5c),
            (b"123456789", 0xe306_9283),
            (b"", 0),
        ] {
            assert_eq!(crc32c(bytes), expected);
            assert_eq!(crc32c_append_table(0, bytes), expected);
        }
    }

    #[test]
    fn table_and_instruction_agree_at_every_split() {
        let bytes: [u8; 257] = core::array::from_fn(|i| (i * 167 + 13) as u8);
        for split in 0..bytes.len() {
            let (a, b) = bytes.split_at(split);
            let whole = crc32c(&bytes);
            assert_eq!(crc32c_append(crc32c(a), b), whole);
            assert_eq!(crc32c_append_table(crc32c_append_table(0, a), b), whole);
        }
    }
}
