//! Whether anything moved between two pictures: the shift of each block that has edges, by the slopes of its light.

use super::ViewRefusal;

/// Pixels along the side of a block.
const BLOCK: usize = 32;
/// Blocks whose shift is known to so many pixels count.
const KNOWN_PX: f64 = 0.04;
/// Shift of the middle block beyond which the camera moved, and of any block beyond which something moved, pixels.
const CAMERA_PX: f64 = 0.12;
const SCENE_PX: f64 = 0.5;
/// Share of the blocks that may be wrong by chance.
const BY_CHANCE: f64 = 0.05;
/// Change of a block beyond which it shows something else, in standard deviations of its noise.
const CHANGED: f64 = 5.0;

/// How one block changed.
struct Change {
    shift_px: [f64; 2],
    /// Its change in standard deviations of the noise.
    change: f64,
}

/// Refuses pictures between which the camera moved, or much of what it sees.
///
/// # Errors
/// [`ViewRefusal::CameraMoved`] and [`ViewRefusal::SceneMoved`].
pub fn check_rest(before: &[u8], after: &[u8], width: usize) -> Result<(), ViewRefusal> {
    let noise = noise_of(before, after);
    let height = before.len().min(after.len()) / width.max(1);
    let mut changes = Vec::new();
    for top in (1..height.saturating_sub(BLOCK + 1)).step_by(BLOCK) {
        for left in (1..width.saturating_sub(BLOCK + 1)).step_by(BLOCK) {
            changes.extend(change_of(before, after, width, (left, top), noise));
        }
    }
    if changes.is_empty() {
        return Ok(());
    }
    let median = |of: &dyn Fn(&Change) -> f64| {
        let mut all: Vec<f64> = changes.iter().map(of).collect();
        all.sort_by(f64::total_cmp);
        all[all.len() / 2]
    };
    let together = median(&|c| c.shift_px[0]).hypot(median(&|c| c.shift_px[1]));
    let size = |c: &Change| c.shift_px[0].hypot(c.shift_px[1]);
    if together > CAMERA_PX || median(&|c| c.change) > CHANGED {
        return Err(ViewRefusal::CameraMoved { moved_px: together.max(median(&size)) });
    }
    let moved = changes.iter().filter(|c| size(c) > SCENE_PX || c.change > 3.0 * CHANGED);
    let moved: Vec<f64> = moved.map(size).collect();
    if moved.len() as f64 > BY_CHANCE * changes.len() as f64 {
        return Err(ViewRefusal::SceneMoved { moved_px: moved.into_iter().fold(0.0, f64::max) });
    }
    Ok(())
}

/// Standard deviation of a pixel's noise, grey levels: half of all pixels change by less than 0.67 times that of a difference.
fn noise_of(before: &[u8], after: &[u8]) -> f64 {
    let mut counts = [0usize; 256];
    before.iter().zip(after).for_each(|(a, b)| counts[usize::from(a.abs_diff(*b))] += 1);
    let half = before.len().min(after.len()) / 2;
    let mut sum = 0;
    let median = counts.iter().position(|c| {
        sum += c;
        sum > half
    });
    ((median.unwrap_or(0) as f64 + 0.5) / 0.67 / std::f64::consts::SQRT_2).max(0.5)
}

fn change_of(
    before: &[u8],
    after: &[u8],
    width: usize,
    (left, top): (usize, usize),
    noise: f64,
) -> Option<Change> {
    let level = |picture: &[u8], at: usize| f64::from(picture[at]);
    let (mut xx, mut xy, mut yy, mut x_by, mut y_by, mut squares) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    for y in top..top + BLOCK {
        for x in left..left + BLOCK {
            let at = y * width + x;
            let mean = |i: usize| 0.5 * (level(before, i) + level(after, i));
            let (gx, gy) = (0.5 * (mean(at + 1) - mean(at - 1)), 0.5 * (mean(at + width) - mean(at - width)));
            let d = level(after, at) - level(before, at);
            (xx, xy, yy) = (xx + gx * gx, xy + gx * gy, yy + gy * gy);
            (x_by, y_by, squares) = (x_by - gx * d, y_by - gy * d, squares + d * d);
        }
    }
    // Noise has slopes, too.
    let own = 0.25 * noise * noise * (BLOCK * BLOCK) as f64;
    let (xx, yy) = (xx - own, yy - own);
    let determinant = xx * yy - xy * xy;
    let variance = 2.0 * noise * noise;
    let worst = variance * xx.max(yy) / determinant;
    if !(xx > 0.0 && yy > 0.0 && determinant > 0.0 && worst < KNOWN_PX * KNOWN_PX) {
        return None;
    }
    let shift_px = [(yy * x_by - xy * y_by) / determinant, (xx * y_by - xy * x_by) / determinant];
    Some(Change { shift_px, change: (squares / (BLOCK * BLOCK) as f64 / variance).sqrt() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::rng::Draws;

    const W: usize = 256;
    const H: usize = 192;

    /// Blurred discs on an even ground, moved by `by` pixels; those of the upper left quarter by `part` more.
    fn picture(by: f64, part: f64, seed: u64) -> Vec<u8> {
        let draws = Draws::new(7);
        let discs: Vec<[f64; 4]> = (0..60u64)
            .map(|k| [0, 1, 2, 3].map(|i| draws.unit(10 * k + i)))
            .map(|[x, y, r, l]| [x * W as f64, y * H as f64, 4.0 + 12.0 * r, 60.0 + 120.0 * l])
            .collect();
        let noise = Draws::new(seed);
        (0..W * H)
            .map(|i| {
                let (x, y) = ((i % W) as f64, (i / W) as f64);
                let mut level = 90.0;
                for [dx, dy, r, l] in &discs {
                    let more = if *dx < 0.5 * W as f64 && *dy < 0.5 * H as f64 { part } else { 0.0 };
                    let d = (x - dx - by - more).hypot(y - dy - 0.5 * by);
                    level += (l - level) * (r - d + 0.5).clamp(0.0, 1.0);
                }
                (level + 1.5 * noise.normal(2 * i as u64)).round() as u8
            })
            .collect()
    }

    #[test]
    fn what_rests_is_at_rest_and_a_camera_that_moved_is_seen() {
        let before = picture(0.0, 0.0, 1);
        check_rest(&before, &picture(0.0, 0.0, 2), W).unwrap();
        for by in [0.2, 0.5, 1.0, 3.0, 12.0] {
            let told = check_rest(&before, &picture(by, 0.0, 3), W);
            assert!(matches!(told, Err(ViewRefusal::CameraMoved { .. })), "{by}: {told:?}");
        }
        let part = check_rest(&before, &picture(0.0, 3.0, 3), W);
        assert!(matches!(part, Err(ViewRefusal::SceneMoved { .. })), "{part:?}");
    }
}
