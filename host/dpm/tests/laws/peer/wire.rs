//! Bytes: checksums, stuffing, packets, codecs. Written from docs/PROTOCOL.md, without this project's own code.

/// CRC-32C, bit by bit.
pub(super) fn crc(bytes: &[u8]) -> u32 {
    let mut c = u32::MAX;
    for &b in bytes {
        c ^= u32::from(b);
        for _ in 0..8 {
            c = if c & 1 == 1 { c >> 1 ^ 0x82f6_3b78 } else { c >> 1 };
        }
    }
    !c
}

pub(super) fn u16_at(b: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([b[at], b[at + 1]])
}

pub(super) fn u32_at(b: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(b[at..at + 4].try_into().unwrap())
}

pub(super) fn u64_at(b: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(b[at..at + 8].try_into().unwrap())
}

/// A packet of the device as a frame of the line.
pub(super) fn packet(kind: u8, session: u32, payload: &[u8], spoil: bool) -> Vec<u8> {
    let mut p = b"DPML\x02".to_vec();
    p.extend([kind, 0, 0]);
    p.extend(session.to_le_bytes());
    p.extend([0; 12]);
    p.extend(&(payload.len() as u32).to_le_bytes()[..3]);
    p.push(0);
    p.extend(crc(&p).to_le_bytes());
    if !payload.is_empty() {
        p.extend(payload);
        p.extend(vec![0; (4 - payload.len() % 4) % 4]);
        p.extend((crc(payload) ^ u32::from(spoil)).to_le_bytes());
    }
    stuffed(&p)
}

/// Consistent overhead byte stuffing, with the zero at the end.
fn stuffed(bytes: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut block = Vec::new();
    for &b in bytes {
        if b == 0 {
            out.push(block.len() as u8 + 1);
            out.append(&mut block);
        } else {
            block.push(b);
            if block.len() == 254 {
                out.push(255);
                out.append(&mut block);
            }
        }
    }
    out.push(block.len() as u8 + 1);
    out.append(&mut block);
    out.push(0);
    out
}

/// The bytes between two zeros of the line, without their stuffing.
pub(super) fn unstuffed(mut frame: &[u8]) -> Option<Vec<u8>> {
    let mut out = Vec::new();
    while let Some((&code, rest)) = frame.split_first() {
        let n = usize::from(code) - 1;
        if rest.len() < n {
            return None;
        }
        out.extend(&rest[..n]);
        frame = &rest[n..];
        if code != 255 && !frame.is_empty() {
            out.push(0);
        }
    }
    Some(out)
}

/// RLE of section 8. `long`: what 127 adds to its count (128, unless the device is to be wrong).
pub(super) fn rle(mut b: &[u8], long: usize) -> Option<Vec<u8>> {
    let mut out = Vec::new();
    while let Some((&t, rest)) = b.split_first() {
        let (literal, n, head) = match t {
            0..=126 => (true, usize::from(t) + 1, 0),
            127 => (true, usize::from(u16_at(rest.get(..2)?, 0)) + long, 2),
            128..=254 => (false, usize::from(t) - 127, 0),
            255 => (false, usize::from(u16_at(rest.get(..2)?, 0)) + 128, 2),
        };
        let rest = &rest[head..];
        if literal {
            out.extend(rest.get(..n)?);
            b = &rest[n..];
        } else {
            out.extend(vec![*rest.first()?; n]);
            b = &rest[1..];
        }
    }
    Some(out)
}

/// One LZ4 block.
pub(super) fn lz4(b: &[u8]) -> Option<Vec<u8>> {
    let mut out: Vec<u8> = Vec::new();
    let mut at = 0;
    let count = |at: &mut usize, first: usize| -> Option<usize> {
        let mut n = first;
        if first == 15 {
            loop {
                let more = *b.get(*at)?;
                *at += 1;
                n += usize::from(more);
                if more != 255 {
                    break;
                }
            }
        }
        Some(n)
    };
    loop {
        let token = *b.get(at)?;
        at += 1;
        let literals = count(&mut at, usize::from(token >> 4))?;
        out.extend(b.get(at..at + literals)?);
        at += literals;
        if at == b.len() {
            return Some(out);
        }
        let back = usize::from(u16_at(b.get(at..at + 2)?, 0));
        at += 2;
        let n = count(&mut at, usize::from(token & 15))? + 4;
        if back == 0 || back > out.len() {
            return None;
        }
        for _ in 0..n {
            out.push(out[out.len() - back]);
        }
    }
}
