//! A pattern over time: which step, or which number, each frame shows.

use super::{Ink, Pattern, PatternError};
use crate::pack::source::{Canvas, PatternSource};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::FrameRate;

/// The longest time for which a step may be held, milliseconds: one day.
const MAX_HOLD_MS: u64 = 86_400_000;

/// A pattern that steps through its pictures, or shows one of them.
#[derive(Clone, Copy, Debug)]
pub struct PatternShow {
    pattern: Pattern,
    ink: Ink,
    raster: Raster,
    /// Frames for which each step is shown.
    hold_frames: u64,
    hold_ms: u64,
    /// The only step to show; `None` for all in turn. For a counter, the number that stands still.
    only: Option<u32>,
}

impl PatternShow {
    /// `pattern` on `raster` in the colours that `schedule` has, each step for `hold_ms` milliseconds (rounded to
    /// frames of `rate`, at least one), or step `only` for ever.
    ///
    /// # Errors
    /// A measure does not fit the raster, or the step or the colour does not exist.
    pub fn new(
        pattern: Pattern,
        ink: Ink,
        (raster, schedule): (Raster, &PlaneSchedule),
        rate: FrameRate,
        hold_ms: u64,
        only: Option<u32>,
    ) -> Result<Self, PatternError> {
        pattern.check(raster)?;
        ink.check(schedule)?;
        let range = |flag, value, rule| Err(PatternError::Range { flag, value, rule });
        if hold_ms == 0 || hold_ms > MAX_HOLD_MS {
            let value = u32::try_from(hold_ms).unwrap_or(u32::MAX);
            return range("--hold-ms", value, format!("1 to {MAX_HOLD_MS}"));
        }
        let steps = pattern.steps(raster);
        if let Some(step) = only.filter(|&step| step >= steps && pattern != Pattern::Counter) {
            return range("--step", step, format!("0 to {}: the pattern has so many steps", steps - 1));
        }
        let hold_frames = ((hold_ms as f64 * 1e-3 * rate.hz()).round() as u64).max(1);
        Ok(Self { pattern, ink, raster, hold_frames, hold_ms, only })
    }

    /// The pattern.
    pub fn pattern(&self) -> Pattern {
        self.pattern
    }

    /// Brightness and colour.
    pub fn ink(&self) -> Ink {
        self.ink
    }

    /// Every pixel is either dark or at code value 255.
    pub fn is_binary(&self) -> bool {
        let is_grey = matches!(self.pattern, Pattern::Phase { .. } | Pattern::Ramp { .. });
        !is_grey && self.ink.level == 255
    }

    /// Columns and rows.
    pub fn raster(&self) -> Raster {
        self.raster
    }

    /// Frames for which each step is shown.
    pub fn hold_frames(&self) -> u64 {
        self.hold_frames
    }

    /// The same in milliseconds, as asked for.
    pub fn hold_ms(&self) -> u64 {
        self.hold_ms
    }

    /// Its pictures in order, by which [`PatternShow::fill`] draws them. A counter has only the first one here.
    pub fn pictures(&self) -> std::ops::Range<u32> {
        match self.only {
            Some(step) => step..step.saturating_add(1),
            None => 0..self.pattern.steps(self.raster),
        }
    }

    /// Writes the code values of a picture.
    ///
    /// # Panics
    /// When `codes` does not hold exactly one value per pixel of the raster.
    pub fn fill(&self, picture: u32, codes: &mut [u32]) {
        self.pattern.fill(self.raster, picture, self.ink, codes);
    }
}

impl PatternSource for PatternShow {
    fn picture(&self, frame: u64) -> u64 {
        if let Some(step) = self.only {
            return u64::from(step);
        }
        match self.pattern {
            // Thirty-two bits are shown, as many as the link carries.
            Pattern::Counter => frame & u64::from(u32::MAX),
            _ => frame / self.hold_frames % u64::from(self.pattern.steps(self.raster).max(1)),
        }
    }

    fn draw(&self, picture: u64, canvas: &mut Canvas<'_>) {
        canvas.codes(|codes| self.fill(picture as u32, codes));
    }
}
