//! A cross or dot that moves from pixel to pixel while the projector runs.

use dpm_rig::pack::source::{Canvas, PatternSource};
use dpm_rig::pattern::{Ink, Pattern};
use std::sync::atomic::{AtomicU64, Ordering};

/// Pixels of each arm of the cross.
const ARM: u32 = 40;

/// Shows nothing, or a mark at a pixel: a cross by default. The picture's number holds the pixel, so frames that are drawn
/// already stay.
#[derive(Debug, Default)]
pub struct Aim {
    /// 0: nothing. Otherwise the row in the upper half, the column in the lower, and 1.
    at: AtomicU64,
    /// Pixels across a dot that is shown in place of the cross.
    dot: Option<u32>,
}

impl Aim {
    /// With a dot of `diameter` pixels.
    pub fn dot(diameter: u32) -> Self {
        Self { dot: Some(diameter), ..Self::default() }
    }

    /// Moves the mark to a pixel: column and row.
    pub fn show(&self, [x, y]: [u32; 2]) {
        self.at.store((u64::from(y) << 32 | u64::from(x)) + 1, Ordering::Relaxed);
    }

    /// Shows nothing.
    pub fn hide(&self) {
        self.at.store(0, Ordering::Relaxed);
    }
}

impl PatternSource for Aim {
    fn picture(&self, _: u64, _: u64) -> u64 {
        self.at.load(Ordering::Relaxed)
    }

    fn draw(&self, picture: u64, canvas: &mut Canvas<'_>) {
        let raster = canvas.raster();
        canvas.codes(|codes| match picture.checked_sub(1) {
            None => codes.fill(0),
            Some(at) => {
                let at = [at as u32, (at >> 32) as u32];
                let mark = match self.dot {
                    Some(diameter) => Pattern::Dot { at, diameter },
                    None => Pattern::Cross { at, arm: Some(ARM) },
                };
                mark.fill(raster, 0, Ink::WHITE, codes);
            }
        });
    }
}
