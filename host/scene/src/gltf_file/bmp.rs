//! BMP as the decoder of `image` takes them: with a header of Windows in the place of one of OS/2, and without runs, whose damage
//! ends a decoder that others go on with.

/// A BMP that is the same picture, where it has to be another file, with what should be said of it. `allowed` is the greatest piece
/// of memory in bytes.
pub(super) fn plain(bytes: &[u8], allowed: u64) -> Option<(Vec<u8>, Option<String>)> {
    let of_windows = without_os2(bytes);
    let bytes = of_windows.as_deref().unwrap_or(bytes);
    without_runs(bytes, allowed).or(of_windows.map(|file| (file, None)))
}

fn number(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..)?.first_chunk().map(|b| u32::from_le_bytes(*b))
}

/// The second version of OS/2 has a header that is longer or shorter than that of Windows, with the same numbers in front. `None`
/// where it is none, or packed as only OS/2 did.
fn without_os2(bytes: &[u8]) -> Option<Vec<u8>> {
    let header = number(bytes, 14)? as usize;
    if !(16..=64).contains(&header) || matches!(header, 40 | 52 | 56) {
        return None;
    }
    let own = bytes.get(14..14 + header)?;
    if header >= 20 && number(own, 16)? > 2 {
        return None;
    }
    let mut windows = own[..header.min(40)].to_vec();
    windows.resize(40, 0);
    windows[..4].copy_from_slice(&40u32.to_le_bytes());
    let place = number(bytes, 10)?.wrapping_add(40).wrapping_sub(header as u32);
    Some([&bytes[..10], &place.to_le_bytes(), &windows, &bytes[14 + header..]].concat())
}

/// Places in a list of colours, packed as runs of 8 or 4 bits, as bytes. What is missing or damaged is the first colour.
fn without_runs(bytes: &[u8], allowed: u64) -> Option<(Vec<u8>, Option<String>)> {
    let [header, place, width, height, packing] = [14, 10, 18, 22, 30].map(|at| number(bytes, at));
    let (header, place, width, height) = (header? as usize, place? as usize, width?, height?);
    let bits = number(bytes, 28)? & 0xffff;
    if header < 40 || !matches!((packing?, bits), (1, 8) | (2, 4)) || width == 0 || height > i32::MAX as u32 {
        return None;
    }
    let stride = u64::from(width).next_multiple_of(4);
    let texels = stride.checked_mul(u64::from(height)).filter(|texels| *texels <= allowed / 2)? as usize;
    let colours = place.checked_sub(14 + header)? / 4;
    let listed = number(bytes, 46)? as usize;
    let colours = colours.min(if listed == 0 { 1 << bits } else { listed });
    let mut out = bytes.get(..place)?.to_vec();
    out.reserve_exact(texels);
    out[28..30].copy_from_slice(&8u16.to_le_bytes());
    out[30..38].fill(0);
    out[46..50].copy_from_slice(&(colours as u32).to_le_bytes());
    out.resize(place + texels, 0);
    let (beyond, is_ended) =
        unpack(&bytes[place..], bits, [width as usize, height as usize], &mut out[place..]);
    let end = if is_ended { "" } else { ", and its end is missing" };
    let told = format!("{beyond} texels of its runs lie outside of the picture{end}: the BMP is damaged");
    Some((out, (beyond > 0 || !is_ended).then_some(told)))
}

/// Returns how many texels lay outside, and whether the end was there.
fn unpack(packed: &[u8], bits: u32, [width, height]: [usize; 2], out: &mut [u8]) -> (usize, bool) {
    let stride = width.next_multiple_of(4);
    let (mut x, mut y, mut rest, mut beyond) = (0, 0, packed, 0);
    let mut put = |x: usize, y: usize, code: u8| {
        if x < width && y < height {
            out[y * stride + x] = code;
        } else {
            beyond += 1;
        }
    };
    // Place `i` of a run or of codes that are stored one by one.
    let code = |byte: u8, i: usize| match (bits, i % 2) {
        (8, _) => byte,
        (_, 0) => byte >> 4,
        _ => byte & 15,
    };
    while let [first, second, after @ ..] = rest {
        rest = after;
        match (*first, *second) {
            (0, 0) => (x, y) = (0, y + 1),
            (0, 1) => return (beyond, true),
            (0, 2) => {
                let [right, up, after @ ..] = rest else { break };
                (x, y, rest) = (x + usize::from(*right), y + usize::from(*up), after);
                if y >= height {
                    break;
                }
            }
            (0, count) => {
                let count = usize::from(count);
                let stored = if bits == 8 { count } else { count.div_ceil(2) };
                let codes = &rest[..stored.min(rest.len())];
                for (i, byte) in
                    (0..count).filter_map(|i| Some((i, codes.get(if bits == 8 { i } else { i / 2 })?)))
                {
                    put(x + i, y, code(*byte, i));
                }
                x += count;
                rest = rest.get(stored.next_multiple_of(2)..).unwrap_or_default();
            }
            (count, byte) => {
                (0..usize::from(count)).for_each(|i| put(x + i, y, code(byte, i)));
                x += usize::from(count);
            }
        }
        // Some programs leave the end out.
        if y >= height {
            return (beyond, true);
        }
    }
    (beyond, y + 1 == height && x >= width)
}
