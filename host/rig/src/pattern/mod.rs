//! Patterns for aiming, focusing and calibrating: from a kind and its measures to code values, pixel by pixel.
//!
//! Pixel (i, j) is the one in column i and row j, counted from the upper left corner, which has (0, 0). In dpm's
//! coordinates it covers i to i + 1, and its centre is at i + 0.5.

mod flash;
mod run;
mod show;
#[cfg(test)]
mod tests;

pub use flash::{flashes, shortest_hold_ms};
pub use run::{run_pattern, run_pattern_stamped};
pub use show::PatternShow;

use dpm_device::planes::{Channel, PlaneSchedule, Raster};

/// The direction along which a pattern varies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Axis {
    /// It tells columns apart.
    Columns,
    /// It tells rows apart.
    Rows,
}

impl Axis {
    /// The coordinate of a pixel along the axis, and the number of pixels along it.
    fn of(self, raster: Raster, x: u32, y: u32) -> (u32, u32) {
        match self {
            Self::Columns => (x, raster.width()),
            Self::Rows => (y, raster.height()),
        }
    }
}

/// What is shown. Lengths are in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pattern {
    /// A column and a row of pixels that cross at pixel `at`; each arm has `arm` pixels, or reaches the edge.
    Cross {
        /// Column and row of the crossing.
        at: [u32; 2],
        /// Pixels of each arm without the crossing itself; `None` for arms up to the edges.
        arm: Option<u32>,
    },
    /// The pixels whose centres lie within half of `diameter` of the centre of pixel `at`.
    Dot {
        /// Column and row of the centre.
        at: [u32; 2],
        /// Diameter; 1 is the one pixel.
        diameter: u32,
    },
    /// Lines of one pixel every `pitch` pixels, and along the edges.
    Grid {
        /// From line to line.
        pitch: u32,
    },
    /// Squares; the one in the upper left corner is lit.
    Chessboard {
        /// Side of a square.
        square: u32,
    },
    /// Binary reflected Gray code of the column or row, most significant bit first; each bit is followed by its
    /// inverse.
    Gray {
        /// What is coded.
        axis: Axis,
    },
    /// Stripes, half of each period lit, which move by one pixel from step to step. With the Gray code, which says
    /// which period it is, they locate an edge to a fraction of a pixel.
    Shifted {
        /// Across the stripes.
        axis: Axis,
        /// Even number of pixels from stripe to stripe, and the number of steps.
        period: u32,
    },
    /// Sinusoidal fringes, which move by one `shifts`-th of a period from step to step.
    Phase {
        /// Across the fringes.
        axis: Axis,
        /// From fringe to fringe.
        period: u32,
        /// Number of steps.
        shifts: u32,
    },
    /// Every pixel is lit.
    Full,
    /// From dark to the full level over the raster.
    Ramp {
        /// Along the ramp.
        axis: Axis,
    },
    /// The frame's number as blocks, 32 bits in eight rows of four bits, most significant first. Each bit has two
    /// blocks side by side: the left one is lit for 1, the right one for 0.
    Counter,
    /// A Siemens star around the centre of the raster.
    FocusStar {
        /// Number of lit spokes.
        spokes: u32,
    },
}

/// Why a pattern cannot be shown.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PatternError {
    /// The pixel lies outside the raster.
    #[error("--at {x},{y} lies outside the raster of {width} x {height} pixels: columns go from 0 to {}, rows from 0 to {}", width - 1, height - 1)]
    Outside {
        /// Column.
        x: u32,
        /// Row.
        y: u32,
        /// Columns of the raster.
        width: u32,
        /// Rows of the raster.
        height: u32,
    },
    /// A measure is out of its range.
    #[error("{flag} {value}: must be {rule}")]
    Range {
        /// The flag.
        flag: &'static str,
        /// Its value.
        value: u32,
        /// Its rule.
        rule: String,
    },
    /// The raster has no room for the pattern.
    #[error("a raster of {width} x {height} pixels has no room for a counter, which needs 8 x 8")]
    TooSmall {
        /// Columns of the raster.
        width: u32,
        /// Rows of the raster.
        height: u32,
    },
    /// No plane of the projector shows this colour.
    #[error("--channel {channel}: no plane of the projector shows this colour; leave the flag out, or set projector.planes = 24")]
    NoChannel {
        /// The colour.
        channel: &'static str,
    },
    /// The pattern would flash.
    #[error("--hold-ms {hold_ms}: the steps would count as more flashes than safety.flashes_per_second allows, and the light would go off; hold each step for at least {least_ms} ms")]
    Flashes {
        /// The time asked for.
        hold_ms: u64,
        /// A time that is allowed.
        least_ms: u64,
    },
}

/// The brightness and colour of what is lit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ink {
    /// Code value of full light, 0 to 255.
    pub level: u8,
    /// One colour; `None` is white.
    pub channel: Option<Channel>,
}

impl Ink {
    /// White at the full level.
    pub const WHITE: Self = Self { level: 255, channel: None };

    /// The code value `0x00BBGGRR` of a pixel whose light is `value` of 255 of the ink's.
    pub fn code(self, value: u8) -> u32 {
        let level = (u32::from(self.level) * u32::from(value) + 127) / 255;
        match self.channel {
            Some(Channel::Red) => level,
            Some(Channel::Green) => level << 8,
            Some(Channel::Blue) => level << 16,
            Some(Channel::White) | None => level * 0x01_0101,
        }
    }

    /// Refuses a colour that no plane of `schedule` shows.
    ///
    /// # Errors
    /// It is such a colour.
    pub fn check(self, schedule: &PlaneSchedule) -> Result<(), PatternError> {
        let named = match self.channel {
            None | Some(Channel::White) => return Ok(()),
            Some(Channel::Red) => "r",
            Some(Channel::Green) => "g",
            Some(Channel::Blue) => "b",
        };
        if schedule.planes().iter().any(|p| Some(p.channel) == self.channel) {
            return Ok(());
        }
        Err(PatternError::NoChannel { channel: named })
    }
}

/// Rows and columns of blocks of a counter.
const BLOCKS: u32 = 8;

impl Pattern {
    /// Refuses what does not fit on `raster`.
    ///
    /// # Errors
    /// The measure that is wrong, with its rule.
    pub fn check(&self, raster: Raster) -> Result<(), PatternError> {
        let (width, height) = (raster.width(), raster.height());
        let side = width.max(height);
        let range = |flag, value, from: u32, to: u32| {
            let rule = format!("{from} to {to}");
            if (from..=to).contains(&value) {
                Ok(())
            } else {
                Err(PatternError::Range { flag, value, rule })
            }
        };
        match *self {
            Self::Cross { at: [x, y], .. } | Self::Dot { at: [x, y], .. } if x >= width || y >= height => {
                Err(PatternError::Outside { x, y, width, height })
            }
            Self::Cross { arm, .. } => range("--size", arm.unwrap_or(0), 0, side),
            Self::Dot { diameter, .. } => range("--size", diameter, 1, side),
            Self::Grid { pitch } => range("--size", pitch, 2, side.max(2)),
            Self::Chessboard { square } => range("--size", square, 1, side),
            Self::Shifted { period, .. } if period % 2 == 1 || !(2..=64).contains(&period) => {
                let rule = "an even number from 2 to 64".into();
                Err(PatternError::Range { flag: "--period", value: period, rule })
            }
            Self::Phase { period, shifts, .. } => {
                range("--period", period, 4, Raster::MAX_SIDE)?;
                range("--shifts", shifts, 3, 64)
            }
            Self::Counter if width < BLOCKS || height < BLOCKS => {
                Err(PatternError::TooSmall { width, height })
            }
            Self::FocusStar { spokes } => range("--size", spokes, 2, 360),
            _ => Ok(()),
        }
    }

    /// Number of pictures that the pattern steps through; 1 for a still one. A counter has a picture for every frame.
    pub fn steps(&self, raster: Raster) -> u32 {
        match *self {
            Self::Gray { axis } => 2 * bits(axis.of(raster, 0, 0).1),
            Self::Shifted { period, .. } => period,
            Self::Phase { shifts, .. } => shifts,
            _ => 1,
        }
    }

    /// The light of pixel (`x`, `y`) in step `step` (a counter's frame), 0 to 255 of full.
    pub fn value(&self, raster: Raster, step: u32, x: u32, y: u32) -> u8 {
        let lit = match *self {
            Self::Cross { at: [u, v], arm } => {
                let arm = arm.unwrap_or(u32::MAX);
                (x == u && y.abs_diff(v) <= arm) || (y == v && x.abs_diff(u) <= arm)
            }
            Self::Dot { at: [u, v], diameter } => {
                let (dx, dy) = (u64::from(x.abs_diff(u)), u64::from(y.abs_diff(v)));
                4 * (dx * dx + dy * dy) <= u64::from(diameter) * u64::from(diameter)
            }
            Self::Grid { pitch } => {
                let on = |i: u32, count: u32| i.is_multiple_of(pitch.max(1)) || i + 1 == count;
                on(x, raster.width()) || on(y, raster.height())
            }
            Self::Chessboard { square } => (x / square.max(1) + y / square.max(1)).is_multiple_of(2),
            Self::Gray { axis } => {
                let (i, count) = axis.of(raster, x, y);
                let bit = bits(count).saturating_sub(1 + step / 2);
                (gray(i) >> bit & 1) ^ (step & 1) == 1
            }
            Self::Shifted { axis, period } => {
                let (i, period) = (axis.of(raster, x, y).0, period.max(1));
                (i + period - step % period) % period < period / 2
            }
            Self::Phase { axis, period, shifts } => {
                let (i, _) = axis.of(raster, x, y);
                let turns = (f64::from(i) + 0.5) / f64::from(period.max(1));
                let turns = turns - f64::from(step) / f64::from(shifts.max(1));
                return (127.5 * (1.0 + (std::f64::consts::TAU * turns).cos())).round() as u8;
            }
            Self::Full => true,
            Self::Ramp { axis } => {
                let (i, count) = axis.of(raster, x, y);
                let last = count.saturating_sub(1).max(1);
                return ((i * 255 + last / 2) / last) as u8;
            }
            Self::Counter => {
                block(raster, x, y).is_some_and(|(bit, is_left)| (step >> bit & 1 == 1) == is_left)
            }
            Self::FocusStar { spokes } => {
                let from = |i: u32, count: u32| f64::from(i) + 0.5 - f64::from(count) / 2.0;
                let angle = from(y, raster.height()).atan2(from(x, raster.width()));
                (f64::from(spokes) * angle).sin() >= 0.0
            }
        };
        if lit {
            255
        } else {
            0
        }
    }

    /// The one axis along which the pattern varies, if there is only one.
    fn only_axis(&self) -> Option<Axis> {
        match *self {
            Self::Gray { axis }
            | Self::Shifted { axis, .. }
            | Self::Phase { axis, .. }
            | Self::Ramp { axis } => Some(axis),
            _ => None,
        }
    }

    /// Writes the code values of step `step` in `ink`, row after row. Allocates nothing.
    ///
    /// # Panics
    /// When `codes` does not hold exactly one value per pixel of `raster`.
    pub fn fill(&self, raster: Raster, step: u32, ink: Ink, codes: &mut [u32]) {
        assert_eq!(codes.len(), raster.pixel_count(), "code values for a raster of {raster:?}");
        let table: [u32; 256] = std::array::from_fn(|value| ink.code(value as u8));
        let code = |x: u32, y: u32| table[usize::from(self.value(raster, step, x, y))];
        let width = raster.width() as usize;
        let axis = self.only_axis();
        for (y, row) in (0u32..).zip(codes.chunks_exact_mut(width)) {
            match axis {
                Some(Axis::Rows) => row.fill(code(0, y)),
                Some(Axis::Columns) if y > 0 => break,
                _ => row.iter_mut().zip(0u32..).for_each(|(to, x)| *to = code(x, y)),
            }
        }
        if axis == Some(Axis::Columns) {
            (1..raster.height() as usize).for_each(|y| codes.copy_within(0..width, y * width));
        }
    }
}

/// Bits that tell `count` columns or rows apart, at least 1.
fn bits(count: u32) -> u32 {
    (u32::BITS - count.saturating_sub(1).leading_zeros()).max(1)
}

/// The binary reflected Gray code of a number: neighbours differ in one bit.
pub fn gray(number: u32) -> u32 {
    number ^ number >> 1
}

/// The bit whose block of a counter the pixel lies in, and whether it is the left one of the pair. `None` in the gaps
/// between blocks, which are an eighth of a block wide, and at the edges.
fn block(raster: Raster, x: u32, y: u32) -> Option<(u32, bool)> {
    let part = |i: u32, count: u32| {
        let size = count / BLOCKS;
        let i = i.checked_sub(count % BLOCKS / 2)?;
        let (block, inside, gap) = (i / size.max(1), i % size.max(1), size / 8);
        (block < BLOCKS && inside >= gap && inside + gap < size).then_some(block)
    };
    let (column, row) = (part(x, raster.width())?, part(y, raster.height())?);
    Some((31 - (row * BLOCKS / 2 + column / 2), column.is_multiple_of(2)))
}
