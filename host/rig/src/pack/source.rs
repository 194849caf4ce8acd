//! Pictures that are a function of the frame's number, and take the place of a renderer's.

use crate::frame::job::FrameMemory;
use dpm_device::planes::{Channel, PlaneSchedule, Raster};
use dpm_render::pack::{self, BitPlaneFrame, Halftone, Kernel};
use std::sync::Arc;

/// Gives the picture of every frame of a run that renders nothing. What it gives depends on the frame's number and slot
/// and on nothing else, so a crew of threads that takes over goes on with the same pictures.
///
/// It is called on the way of a frame: it must not allocate, lock or wait.
pub trait PatternSource: Send + Sync {
    /// The number of the picture that frame `frame` shows in slot `slot` of the projector. Frames with equal numbers
    /// show equal planes, so their planes are drawn once and kept. By default every frame has a picture of its own.
    /// What must be known to the microsecond goes by slots: a frame that misses its own leaves no gap in the numbers.
    fn picture(&self, frame: u64, _slot: u64) -> u64 {
        frame
    }

    /// The planes that it draws for; `None` for the rig's own. Codes that need planes of equal light have
    /// [`PlaneSchedule::equal24`].
    fn schedule(&self) -> Option<PlaneSchedule> {
        None
    }

    /// Draws picture `picture` completely: as code values by [`Canvas::codes`], or plane by plane by
    /// [`Canvas::planes`].
    fn draw(&self, picture: u64, canvas: &mut Canvas<'_>);
}

/// Where a [`PatternSource`] draws one frame.
pub struct Canvas<'a> {
    raster: Raster,
    kernel: Kernel,
    codes: &'a mut [u32],
    /// For halftones.
    words: &'a mut [u32],
    picture: u64,
    /// The code values are those of this picture already.
    is_filled: bool,
    planes: &'a mut BitPlaneFrame,
}

impl Canvas<'_> {
    /// Columns and rows.
    pub fn raster(&self) -> Raster {
        self.raster
    }

    /// Draws by code values `0x00BBGGRR`, row after row. `fill` must write every one of them; it is not called if
    /// the last picture drawn was this one. The values are then cut into planes, as a renderer's are.
    pub fn codes(&mut self, fill: impl FnOnce(&mut [u32])) {
        if !self.is_filled {
            fill(self.codes);
        }
        match Halftone::of(self.planes.schedule()) {
            None => pack::pack(self.kernel, self.codes, self.planes),
            Some(halftone) => {
                pack::halftone(halftone, self.raster, self.picture as u32, self.codes, self.words);
                pack::pack(self.kernel, self.words, self.planes);
            }
        }
    }

    /// Draws by the planes themselves, which hold some former picture. All planes may differ; padding bits must
    /// be 0.
    pub fn planes(&mut self) -> &mut BitPlaneFrame {
        self.planes
    }
}

/// Draws the frames of one crew.
pub struct PatternPainter {
    source: Arc<dyn PatternSource>,
    raster: Raster,
    codes: Vec<u32>,
    words: Vec<u32>,
    /// The picture that `codes` was last drawn for.
    drawn: Option<u64>,
}

impl PatternPainter {
    /// For frames of `raster`.
    pub fn new(source: Arc<dyn PatternSource>, raster: Raster) -> Self {
        Self {
            source,
            raster,
            codes: vec![0; raster.pixel_count()],
            words: vec![0; raster.pixel_count()],
            drawn: None,
        }
    }

    /// Draws picture `picture` into `planes`.
    pub fn draw(&mut self, kernel: Kernel, picture: u64, planes: &mut BitPlaneFrame) {
        let is_filled = self.drawn.replace(picture) == Some(picture);
        let (raster, codes, words) = (self.raster, &mut self.codes[..], &mut self.words[..]);
        self.source.draw(picture, &mut Canvas { raster, kernel, codes, words, picture, is_filled, planes });
    }

    /// The planes of frame `frame` into its memory, which may hold them from a former frame. Returns the bytes that were read
    /// and written for it.
    pub(crate) fn pack(
        &mut self,
        kernel: Kernel,
        (frame, slot): (u64, u64),
        memory: &mut FrameMemory,
    ) -> u64 {
        let picture = self.source.picture(frame, slot);
        if memory.picture == Some(picture) {
            return 0;
        }
        self.draw(kernel, picture, &mut memory.planes);
        memory.picture = Some(picture);
        (memory.planes.bytes().len() + size_of_val(&self.codes[..])) as u64
    }

    /// The light of `planes` as code values, for a comparison with the light that was made. The next picture is drawn
    /// anew.
    pub(crate) fn light_of(&mut self, planes: &BitPlaneFrame) -> &[u32] {
        self.drawn = None;
        let (width, row_bytes) = (self.raster.width() as usize, self.raster.row_bytes());
        let schedule = *planes.schedule();
        for (y, row) in self.codes.chunks_exact_mut(width).enumerate() {
            for (x, code) in row.iter_mut().enumerate() {
                let mut sums = [0u32; 3];
                for (k, spec) in schedule.planes().iter().enumerate() {
                    let lit = planes.plane(k)[y * row_bytes + x / 8] >> (7 - x % 8) & 1;
                    let light = u32::from(lit) << spec.bit;
                    match spec.channel {
                        Channel::White => sums.iter_mut().for_each(|sum| *sum += light),
                        channel => sums[channel as usize] += light,
                    }
                }
                let [red, green, blue] = sums.map(|sum| u32::from(schedule.light_of(sum)));
                *code = red | green << 8 | blue << 16;
            }
        }
        &self.codes
    }
}

/// Where the frames of a run without a GPU come from.
pub(crate) enum FrameSource {
    /// Marked frames, by which torn light is found.
    Marked(super::prepared::PreparedFrames),
    /// Patterns.
    Drawn(PatternPainter),
}
