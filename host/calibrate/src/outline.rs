//! Points of light that move while the projector runs.

use dpm_rig::pack::source::{Canvas, PatternSource};
use dpm_rig::pattern::Ink;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

/// Most points of a picture.
pub const MOST_POINTS: usize = 4096;
/// Pictures that are kept while frames draw an older one.
const KEPT: u64 = 4;
/// A point is a square that reaches this many pixels beyond its middle.
const REACH: u32 = 1;

/// Shows the points that it was last given. Frames are drawn without a lock: a picture that is being drawn stays as it is
/// until three more have come.
pub struct Outlines {
    newest: AtomicU64,
    kept: Vec<OutlinePoints>,
}

struct OutlinePoints {
    count: AtomicU64,
    /// The row in the upper half, the column in the lower.
    points: Vec<AtomicU32>,
}

impl Default for Outlines {
    fn default() -> Self {
        let points = || (0..MOST_POINTS).map(|_| AtomicU32::new(0)).collect();
        let kept = (0..KEPT).map(|_| OutlinePoints { count: AtomicU64::new(0), points: points() }).collect();
        Self { newest: AtomicU64::new(0), kept }
    }
}

impl Outlines {
    fn picture(&self, number: u64) -> Option<&OutlinePoints> {
        self.kept.get((number % KEPT) as usize)
    }

    /// Shows points, each column and row; those after the first [`MOST_POINTS`] are left out. One thread at a time may
    /// call it.
    pub fn show(&self, points: &[[u32; 2]]) {
        let number = self.newest.load(Ordering::Relaxed) + 1;
        let Some(picture) = self.picture(number) else { return };
        for (to, [x, y]) in picture.points.iter().zip(points) {
            to.store(y << 16 | x & 0xffff, Ordering::Relaxed);
        }
        picture.count.store(points.len().min(MOST_POINTS) as u64, Ordering::Relaxed);
        self.newest.store(number, Ordering::Release);
    }
}

impl PatternSource for Outlines {
    fn picture(&self, _: u64, _: u64) -> u64 {
        self.newest.load(Ordering::Acquire)
    }

    fn draw(&self, picture: u64, canvas: &mut Canvas<'_>) {
        let (width, height) = (canvas.raster().width(), canvas.raster().height());
        canvas.codes(|codes| {
            codes.fill(0);
            let Some(picture) = Self::picture(self, picture) else { return };
            let count = picture.count.load(Ordering::Relaxed) as usize;
            for point in picture.points.iter().take(count) {
                let at = point.load(Ordering::Relaxed);
                let (x, y) = (at & 0xffff, at >> 16);
                for row in y.saturating_sub(REACH)..(y + REACH + 1).min(height) {
                    for column in x.saturating_sub(REACH)..(x + REACH + 1).min(width) {
                        if let Some(code) = codes.get_mut((row * width + column) as usize) {
                            *code = Ink::WHITE.code(255);
                        }
                    }
                }
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::{PlaneSchedule, Raster};
    use dpm_render::pack::{BitPlaneFrame, Kernel};
    use dpm_rig::pack::source::PatternPainter;
    use std::sync::Arc;

    /// Pixels that are lit in the first plane.
    fn lit(outlines: &Arc<Outlines>) -> usize {
        let raster = Raster::new(64, 48).unwrap();
        let mut planes = BitPlaneFrame::new(raster, PlaneSchedule::rgb24());
        let number = PatternSource::picture(&**outlines, 0, 0);
        PatternPainter::new(outlines.clone(), raster).draw(Kernel::Scalar, number, &mut planes);
        planes.plane(0).iter().map(|byte| byte.count_ones() as usize).sum()
    }

    #[test]
    fn the_newest_points_are_shown_and_only_on_the_raster() {
        let outlines = Arc::new(Outlines::default());
        assert_eq!(lit(&outlines), 0);
        outlines.show(&[[10, 10], [20, 40]]);
        assert_eq!(lit(&outlines), 18);
        // At the corners a square is cut, and what lies outside is dark.
        outlines.show(&[[0, 0], [63, 47], [500, 500]]);
        assert_eq!(lit(&outlines), 8);
        for i in 0..3 * KEPT as u32 {
            outlines.show(&[[10 + i, 10]]);
            assert_eq!(lit(&outlines), 9);
        }
        outlines.show(&[]);
        assert_eq!(lit(&outlines), 0);
        outlines.show(&vec![[30, 30]; MOST_POINTS + 9]);
        assert_eq!(lit(&outlines), 9);
    }
}
