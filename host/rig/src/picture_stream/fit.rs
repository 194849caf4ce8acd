//! A picture at the size of a texture: the mean of what a texel covers where it becomes smaller, and between two
//! neighbours where it becomes larger. That of the crate `image` takes several times as long.

/// The sum of all weights of a texel.
const WHOLE: u32 = 1 << 16;

/// The pixels that make a texel along one side: the first, and the weight of each, [`WHOLE`] together.
struct Taps {
    first: usize,
    weights: Vec<u32>,
}

/// For `to` texels from `from` pixels along one side.
fn taps(from: usize, to: usize) -> Vec<Taps> {
    let step = from as f64 / to as f64;
    (0..to)
        .map(|k| {
            // The stretch of pixels that the texel covers, or where it is smaller than a pixel, one pixel's length about its middle,
            // which two neighbours share.
            let (middle, half) = ((k as f64 + 0.5) * step, 0.5 * step.max(1.0));
            let (begin, end) = ((middle - half).max(0.0), (middle + half).min(from as f64));
            let first = (begin as usize).min(from - 1);
            let last = (end.ceil() as usize).clamp(first + 1, from);
            let covered = |i: usize| (end.min(i as f64 + 1.0) - begin.max(i as f64)).max(0.0);
            let mut weights: Vec<u32> = (first..last)
                .map(|i| (covered(i) / (end - begin) * f64::from(WHOLE)).round() as u32)
                .collect();
            // What rounding leaves goes to the pixel in the middle, so that an even picture stays even.
            let (sum, centre) = (weights.iter().sum::<u32>(), weights.len() / 2);
            weights[centre] = (weights[centre] + WHOLE).saturating_sub(sum);
            Taps { first, weights }
        })
        .collect()
}

/// `picture` of `from` columns and rows at `to` columns and rows.
pub(super) fn fitted(picture: &[[u8; 4]], from: [u32; 2], to: [u32; 2]) -> Vec<[u8; 4]> {
    let [[width, height], [columns, rows]] = [from, to].map(|size| size.map(|side| side as usize));
    let (across, down) = (taps(width, columns), taps(height, rows));
    let mut out = Vec::with_capacity(columns * rows);
    // A row of the result, not yet fitted across: 24 bits a channel.
    let mut row = vec![[0u32; 3]; width];
    for of in down {
        row.fill([0; 3]);
        for (weight, pixels) in of.weights.iter().zip(picture[of.first * width..].chunks_exact(width)) {
            for (sum, [r, g, b, _]) in row.iter_mut().zip(pixels) {
                for (sum, value) in sum.iter_mut().zip([*r, *g, *b]) {
                    *sum += weight * u32::from(value);
                }
            }
        }
        for of in &across {
            let mut sum = [u64::from(WHOLE) * u64::from(WHOLE) / 2; 3];
            for (weight, pixel) in of.weights.iter().zip(&row[of.first..]) {
                for (sum, value) in sum.iter_mut().zip(pixel) {
                    *sum += u64::from(*weight) * u64::from(*value);
                }
            }
            let [r, g, b] = sum.map(|sum| (sum / (u64::from(WHOLE) * u64::from(WHOLE))) as u8);
            out.push([r, g, b, 255]);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_whole_and_stay_in_the_picture() {
        for (from, to) in
            [(1, 1), (1, 7), (7, 1), (5, 5), (640, 512), (512, 640), (1920, 512), (3, 4096), (8192, 3)]
        {
            let all = taps(from, to);
            assert_eq!(all.len(), to);
            for of in all {
                assert_eq!(of.weights.iter().sum::<u32>(), WHOLE, "{from} to {to}");
                assert!(of.first + of.weights.len() <= from);
            }
        }
    }

    #[test]
    fn the_same_size_changes_nothing_and_half_the_size_takes_means() {
        let picture: Vec<[u8; 4]> = (0..24u8).map(|i| [i, 200 - i, 3 * i, 255]).collect();
        assert_eq!(fitted(&picture, [6, 4], [6, 4]), picture);
        let half = fitted(&picture, [6, 4], [3, 2]);
        for (i, texel) in half.iter().enumerate() {
            let (x, y) = (2 * (i % 3), 2 * (i / 3));
            let of =
                |c: usize| [0, 1, 6, 7].iter().map(|k| u32::from(picture[6 * y + x + k][c])).sum::<u32>();
            assert_eq!(*texel, [0, 1, 2, 3].map(|c| ((of(c) + 2) / 4) as u8), "texel {i}");
        }
        // A ramp that becomes larger stays a ramp.
        let ramp: Vec<[u8; 4]> = (0..10u8).map(|i| [10 * i, 0, 0, 255]).collect();
        let large = fitted(&ramp, [10, 1], [100, 1]);
        for (i, texel) in large.iter().enumerate().skip(5).take(90) {
            let exact = ((i as f64 + 0.5) / 10.0 - 0.5) * 10.0;
            assert!((f64::from(texel[0]) - exact).abs() <= 0.6, "texel {i}: {} of {exact}", texel[0]);
        }
    }
}
