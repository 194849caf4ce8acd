//! Linear drive into code values, and code values into the bit planes that a DMD shows.
//!
//! Every kernel gives the same bytes, whatever the raster. The GPU's packer is held to the same bytes.

mod frame;
pub mod gpu;
mod halftone;
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
mod lanes;
mod quantise;
mod scalar;
#[cfg(target_arch = "x86_64")]
mod simd;

pub use frame::BitPlaneFrame;
pub use halftone::{halftone, halftone_of_bodies, Halftone};
pub use quantise::{quantise, QuantiseCounts};

use dpm_device::planes::{Channel, PlaneSchedule, PlaneSpec, MAX_PLANES};

/// Pixels that a kernel packs at once.
const BLOCK_PIXELS: usize = 512;
/// Bytes of a block in each plane: a whole cache line.
const BLOCK_BYTES: usize = BLOCK_PIXELS / 8;
/// Bytes of a batch in each plane. Planes of 1024 x 768 lie exactly 24 x 4 KiB apart, so lines at the same place of all
/// planes compete for one set of the first-level cache, which holds eight or twelve of them. So a kernel writes a batch in that
/// cache, and several lines of a plane move on in a row.
const BATCH_BYTES: usize = 8 * BLOCK_BYTES;
/// Bit planes that code values hold: 8 bits of red, green and blue.
const CODE_BITS: usize = 24;

/// A batch's bits: for each bit of the code value a stretch of its plane.
type Planes = [[u8; BATCH_BYTES]; CODE_BITS];

/// The same, on a cache line.
#[repr(align(64))]
struct Batch(Planes);

/// A way to pack, chosen by what the CPU can do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kernel {
    /// Plain Rust, for every processor.
    Scalar,
    /// Every x86-64.
    Sse2,
    /// Every AArch64.
    Neon,
    /// x86-64 with AVX2.
    Avx2,
    /// x86-64 with AVX-512 F, BW, VBMI and GFNI.
    Avx512,
}

impl Kernel {
    /// The kernels that this CPU can run, slowest first.
    pub fn available() -> &'static [Self] {
        #[cfg(target_arch = "x86_64")]
        {
            if simd::has_avx512() && simd::has_avx2() {
                return &[Self::Scalar, Self::Sse2, Self::Avx2, Self::Avx512];
            }
            if simd::has_avx2() {
                return &[Self::Scalar, Self::Sse2, Self::Avx2];
            }
            &[Self::Scalar, Self::Sse2]
        }
        #[cfg(target_arch = "aarch64")]
        {
            &[Self::Scalar, Self::Neon]
        }
        #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
        {
            &[Self::Scalar]
        }
    }

    /// The fastest kernel that this CPU can run.
    pub fn best() -> Self {
        Self::available().last().copied().unwrap_or(Self::Scalar)
    }

    /// Name for reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Scalar => "scalar",
            Self::Sse2 => "SSE2",
            Self::Neon => "NEON",
            Self::Avx2 => "AVX2",
            Self::Avx512 => "AVX-512 with GFNI",
        }
    }
}

/// The bit of a code value `0x00BBGGRR` that a plane shows. A white plane shows the green bit.
pub(crate) const fn source_bit(plane: PlaneSpec) -> u32 {
    let channel = match plane.channel {
        Channel::Red => 0,
        Channel::Green | Channel::White => 8,
        Channel::Blue => 16,
    };
    channel + plane.bit as u32
}

/// For each plane of `schedule` the bit of a pixel's word that it shows. The words are code values; for frames that show them
/// in parts they are what [`halftone()`] makes of code values, in which each plane of a channel has a bit of its own.
pub fn source_bits(schedule: &PlaneSchedule) -> [u8; MAX_PLANES] {
    let mut bits = [0; MAX_PLANES];
    let Some(parts) = schedule.parts() else {
        for (bit, &plane) in bits.iter_mut().zip(schedule.planes()) {
            *bit = source_bit(plane) as u8;
        }
        return bits;
    };
    let lowest = lowest_bit(schedule);
    // The planes of the parts come behind those below them, in the order in which they are shown.
    let mut before = [parts.low; 4];
    for (bit, &plane) in bits.iter_mut().zip(schedule.planes()) {
        let number = match plane.bit - lowest {
            below if below < parts.low => below,
            _ => {
                before[plane.channel as usize] += 1;
                before[plane.channel as usize] - 1
            }
        };
        let first = if plane.channel == Channel::White { 0 } else { 8 * plane.channel as u8 };
        *bit = first + number;
    }
    bits
}

/// The lowest bit that a schedule's planes show.
fn lowest_bit(schedule: &PlaneSchedule) -> u8 {
    schedule.planes().iter().map(|plane| plane.bit).fold(7, u8::min)
}

/// What a schedule's planes show of a pixel's word: the light of a mirror, which is what the projector sends out for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shown {
    /// Bits of the code value that planes of their own colour show.
    coloured: u32,
    /// Bits of the green code value that white planes show.
    white: u32,
    /// The word is a halftone's, of planes of this schedule.
    halftone: Option<(Halftone, PlaneSchedule)>,
}

impl Shown {
    /// That of `schedule`.
    pub fn by(schedule: &PlaneSchedule) -> Self {
        let halftone = Halftone::of(schedule).map(|halftone| (halftone, *schedule));
        let mut shown = Self { coloured: 0, white: 0, halftone };
        for &plane in schedule.planes() {
            match plane.channel {
                Channel::White => shown.white |= 1 << plane.bit,
                _ => shown.coloured |= 1 << source_bit(plane),
            }
        }
        shown
    }

    /// The light of a mirror with the word `code`, `0x00BBGGRR`, as code values of red, green and blue: white planes light all three, and a sum
    /// above full light stays full.
    pub fn light(self, code: u32) -> u32 {
        if let Some((halftone, schedule)) = self.halftone {
            let lowest = lowest_bit(&schedule);
            let [r, g, b] = halftone.sums(code).map(|sum| u32::from(schedule.light_of(sum << lowest)));
            return r | g << 8 | b << 16;
        }
        let own = code & self.coloured;
        let white = code >> 8 & self.white;
        if white == 0 {
            return own;
        }
        let sum = |shift: u32| ((own >> shift & 0xff) + white).min(0xff) << shift;
        sum(0) | sum(8) | sum(16)
    }
}

/// Code values `0x00BBGGRR` (for frames that show them in parts the words that [`halftone()`] makes of them), row after row, into the planes of `frame`; bits 24 to 31 are ignored, padding bits become 0.
/// A `kernel` that this CPU cannot run is replaced by [`Kernel::best`].
///
/// # Panics
/// When `codes` does not hold exactly one value per pixel of the frame's raster.
pub fn pack(kernel: Kernel, codes: &[u32], frame: &mut BitPlaneFrame) {
    let raster = frame.raster();
    assert_eq!(codes.len(), raster.pixel_count(), "code values for a raster of {raster:?}");
    let kernel = if Kernel::available().contains(&kernel) { kernel } else { Kernel::best() };
    match kernel {
        Kernel::Scalar => scalar::pack(codes, frame),
        #[cfg(target_arch = "x86_64")]
        Kernel::Sse2 => lanes::pack(codes, frame),
        #[cfg(target_arch = "aarch64")]
        Kernel::Neon => lanes::pack(codes, frame),
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx2 => simd::pack_avx2(codes, frame),
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx512 => simd::pack_avx512(codes, frame),
        // Not among those of this processor.
        #[allow(unreachable_patterns)]
        _ => scalar::pack(codes, frame),
    }
}

/// Code values of a picture that rests, as its planes show them: as [`pack`], by way of [`halftone()`] where the planes do not weigh
/// as the bits do. It allocates.
///
/// # Panics
/// As [`pack`].
pub fn pack_codes(kernel: Kernel, codes: &[u32], frame: &mut BitPlaneFrame) {
    let Some(how) = Halftone::of(frame.schedule()) else { return pack(kernel, codes, frame) };
    let mut words = vec![0; codes.len()];
    halftone(how, frame.raster(), 0, codes, &mut words);
    pack(kernel, &words, frame);
}

/// The planes of `frame` back into code values. Bits that no plane shows are 0; a white plane gives the green bit.
///
/// # Panics
/// When `codes` does not hold exactly one value per pixel of the frame's raster.
pub fn unpack(frame: &BitPlaneFrame, codes: &mut [u32]) {
    let raster = frame.raster();
    assert_eq!(codes.len(), raster.pixel_count(), "code values for a raster of {raster:?}");
    codes.fill(0);
    for (i, bit) in frame.source_bits().into_iter().enumerate().take(frame.schedule().len()) {
        let rows = frame.plane(i).chunks_exact(raster.row_bytes());
        for (row, pixels) in rows.zip(codes.chunks_exact_mut(raster.width() as usize)) {
            for (byte, eight) in row.iter().zip(pixels.chunks_mut(8)) {
                for (x, code) in eight.iter_mut().enumerate() {
                    *code |= u32::from(byte >> (7 - x) & 1) << bit;
                }
            }
        }
    }
}

/// Moves a batch of a plane to where it belongs, by way of the caches.
fn copy(to: &mut [u8; BATCH_BYTES], from: &[u8; BATCH_BYTES]) {
    *to = *from;
}

/// Packs runs of pixels by `kernel`, which takes blocks and puts their bits at an offset in a batch; `put` moves a whole batch of a
/// plane to where it belongs. Rows that end on a byte are one long run; other rows are a run each.
#[inline(always)]
fn pack_blocks(
    codes: &[u32],
    frame: &mut BitPlaneFrame,
    put: impl Fn(&mut [u8; BATCH_BYTES], &[u8; BATCH_BYTES]),
    mut kernel: impl FnMut(&[[u32; BLOCK_PIXELS]], &mut Planes, usize),
) {
    let raster = frame.raster();
    let width = raster.width() as usize;
    let (run_pixels, run_bytes) = if width.is_multiple_of(8) {
        (codes.len(), raster.plane_bytes())
    } else {
        (width, raster.row_bytes())
    };
    let (bits, plane_bytes) = (frame.source_bits(), raster.plane_bytes());
    let bits = &bits[..frame.schedule().len()];
    let bytes = frame.bytes_mut();
    let mut batch = Batch([[0; BATCH_BYTES]; CODE_BITS]);
    for (run, pixels) in codes.chunks_exact(run_pixels).enumerate() {
        for (i, pixels) in pixels.chunks(8 * BATCH_BYTES).enumerate() {
            let (at, count) = (run * run_bytes + i * BATCH_BYTES, pixels.len().div_ceil(8));
            let (whole, rest) = pixels.as_chunks::<BLOCK_PIXELS>();
            kernel(whole, &mut batch.0, 0);
            if !rest.is_empty() {
                let mut padded = [0; BLOCK_PIXELS];
                padded[..rest.len()].copy_from_slice(rest);
                kernel(&[padded], &mut batch.0, BLOCK_BYTES * whole.len());
            }
            for (plane, &bit) in bytes.chunks_exact_mut(plane_bytes).zip(bits) {
                let (to, from) = (&mut plane[at..at + count], &batch.0[usize::from(bit)]);
                match to.try_into() {
                    Ok(whole) => put(whole, from),
                    Err(_) => plane[at..at + count].copy_from_slice(&from[..count]),
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
