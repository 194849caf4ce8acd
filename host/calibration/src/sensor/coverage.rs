//! How much of the raster a sweep has seen so far, and where the hand should go next.

use super::code::{Code, PLANES};
use super::decode::{frames_seen, DecodeError};
use super::lock::SampleBlock;
use super::start::pixel_of;
use glam::DVec2;

const CELLS: [usize; 2] = [8, 6];
/// Frames in a cell that count as seen.
const ENOUGH: usize = 5;
/// Share of the cells beyond which the raster counts as seen.
const MOST: f64 = 0.85;

/// Frames by cell of a grid of 8 x 6 over the raster.
#[derive(Clone, Debug)]
pub struct Coverage {
    code: Code,
    counts: [usize; CELLS[0] * CELLS[1]],
}

impl Coverage {
    /// Nothing seen yet.
    pub fn new(code: Code) -> Self {
        Self { code, counts: [0; CELLS[0] * CELLS[1]] }
    }

    /// Adds the frames of some seconds of samples; `frame_ns` is the length of a frame. Gives their number.
    ///
    /// # Errors
    /// Why no frames are seen in the samples.
    pub fn add(&mut self, frame_ns: f64, blocks: &[SampleBlock]) -> Result<usize, DecodeError> {
        let frames = frames_seen(frame_ns / PLANES as f64, blocks)?;
        let cell = self.cell();
        for frame in &frames {
            let at = pixel_of(&self.code, frame) / cell;
            let index = (at.y as usize).min(CELLS[1] - 1) * CELLS[0] + (at.x as usize).min(CELLS[0] - 1);
            self.counts[index] += 1;
        }
        Ok(frames.len())
    }

    fn cell(&self) -> DVec2 {
        let raster = self.code.raster();
        DVec2::new(f64::from(raster.width()), f64::from(raster.height()))
            / DVec2::new(CELLS[0] as f64, CELLS[1] as f64)
    }

    /// Share of the cells that were seen.
    pub fn share(&self) -> f64 {
        self.counts.iter().filter(|c| **c >= ENOUGH).count() as f64 / self.counts.len() as f64
    }

    /// Middle of the cell that was seen least, pixels.
    pub fn emptiest(&self) -> DVec2 {
        let least = self.counts.iter().enumerate().min_by_key(|(_, c)| **c).map_or(0, |(i, _)| i);
        DVec2::new((least % CELLS[0]) as f64 + 0.5, (least / CELLS[0]) as f64 + 0.5) * self.cell()
    }

    /// What the hand should do next, one sentence.
    pub fn advice(&self) -> String {
        let share = self.share();
        let seen = format!("{:.0} % of the picture is seen", 100.0 * share);
        if share >= MOST {
            return format!("{seen}; move through its whole depth");
        }
        let (DVec2 { x, y }, size) = (self.emptiest(), self.code.raster());
        let third = |at: f64, side: u32, words: [&'static str; 3]| {
            words[((3.0 * at / f64::from(side.max(1))) as usize).min(2)]
        };
        let across = third(x, size.width(), ["left", "middle", "right"]);
        let down = third(y, size.height(), ["top", "middle", "bottom"]);
        format!("{seen}; move to its {down} {across}, near and far")
    }
}
