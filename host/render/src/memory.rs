//! The memory that a raster and a method need: how large each buffer is, whether the device can bind it, and what is kept from frame to
//! frame.

use super::blue_noise;
use super::fill::fill;
use super::method::Method;
use super::optics::OpticsLayout;
use super::read_back::{Guide, History, Surface};
use super::scale::Scale;
use super::scene_gpu::table_buffer;
use super::settings::{RasterTooLarge, RenderError, RendererSettings};
use super::tiles::TILE;
use crate::gpu::{Buffer, Gpu, GpuError, MemoryKind};
use bytemuck::Zeroable;
use dpm_device::planes::Raster;
use dpm_shaders::structs::{in_blocks, Filtered, Moved, PlaneGroup, Schedule, WorkItem, PARTS};
use std::sync::Arc;

/// Bytes of a pixel of the picture that the host can read.
pub(super) const SHOWN_BYTES: usize = size_of::<[f32; 4]>();

/// Bytes a pixel of every buffer that grows with the raster; 0 if the method does not need the buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct BytesPerPixel {
    /// What is known of the pixel's surface point. There are two such buffers, which frames write in turns.
    pub history: usize,
    /// Motion, apparent size, angle and albedo; demands of method dpm.
    pub guides: usize,
    /// What each pixel's ray hit.
    pub surfaces: usize,
    /// The radiance that was traced.
    pub radiance: usize,
    /// The history's picture.
    pub filtered: usize,
    /// The filtered picture; 0 for method dpm, which turns it into code values at once.
    pub shown: usize,
    /// The work list of the tracer.
    pub work: usize,
    /// Code values.
    pub codes: usize,
    /// What was drawn and how it moves, for planes that follow; 0 if they do not.
    pub motion: usize,
}

impl BytesPerPixel {
    /// The bytes of `method`.
    pub(crate) fn of(method: &Method) -> Self {
        let when = |wanted: bool, bytes: usize| if wanted { bytes } else { 0 };
        Self {
            history: when(method.needs_history(), History::BYTES),
            guides: when(method.needs_guides(), Guide::BYTES),
            surfaces: Surface::BYTES,
            radiance: size_of::<[f32; 4]>(),
            filtered: when(method.needs_history(), size_of::<Filtered>()),
            shown: when(method.needs_spatial() && !method.dpm, SHOWN_BYTES),
            work: size_of::<WorkItem>(),
            codes: size_of::<u32>(),
            motion: 0,
        }
    }

    /// Bytes a pixel on the GPU of a run with so many frames in flight.
    fn on_device(&self, slots: usize) -> usize {
        let of_slot =
            self.guides + self.surfaces + self.radiance + self.filtered + self.shown + self.work + self.codes;
        2 * self.history + slots * of_slot
    }

    /// Bytes a pixel of the buffer of a binding, or of one of its parts (`B_HISTORY.light`); 0 if it does not grow with the raster. `None`: the bit
    /// planes, whose number the projector decides.
    pub(super) fn of_buffer(&self, name: &str) -> Option<f64> {
        let (binding, name) = name.split_once('.').unwrap_or((name, ""));
        let part = PARTS.iter().find(|part| part.binding == binding && part.name == name);
        let part = part.map_or(0, |part| part.bytes);
        Some(match binding {
            "B_SURFACES" | "B_COARSE_SURFACES" => part,
            "B_GUIDES" if self.guides > 0 => part,
            "B_HISTORY" | "B_FORMER" if self.history > 0 => part,
            "B_RADIANCE" => self.radiance,
            "B_FILTERED" => self.filtered,
            // The picture that is shown: that of the last pass that the method has.
            "B_SHOWN" if self.shown > 0 => self.shown,
            "B_SHOWN" => self.radiance,
            "B_COARSE_LIGHT" => size_of::<Filtered>(),
            "B_WORK" => self.work,
            "B_CODES" => self.codes,
            "B_MOTION" => self.motion,
            "B_PLANES" => return None,
            _ => 0,
        } as f64)
    }

    /// The same with what planes need that follow the bodies, if they do.
    pub(crate) fn and_planes_follow(self, follow: bool) -> Self {
        Self { motion: if follow { size_of::<Moved>() } else { 0 }, ..self }
    }

    /// Name and bytes a pixel of the largest buffer.
    fn largest(&self) -> (&'static str, usize) {
        [
            ("history", self.history),
            ("guide", self.guides),
            ("surface", self.surfaces),
            ("radiance", self.radiance),
            ("filtered radiance", self.filtered),
            ("shown radiance", self.shown),
            ("work", self.work),
            ("code", self.codes),
        ]
        .into_iter()
        // Of equal ones the first.
        .rev()
        .max_by_key(|b| b.1)
        .unwrap_or(("code", 0))
    }
}

/// Memory on the GPU that a run with so many frames in flight takes at least, bytes: the buffers that grow with the raster of the panel and with
/// what is traced of it, without the scene.
pub fn least_memory_bytes(raster: Raster, scale: Scale, method: &Method, slots: usize) -> u64 {
    let each = BytesPerPixel::of(method);
    let traced = scale.rasters(raster).next().unwrap_or(raster).pixel_count() * each.on_device(slots);
    let of_panel = match scale == Scale::WHOLE {
        true => 0,
        false => raster.pixel_count() * slots * (each.surfaces + each.codes + each.work),
    };
    (traced + of_panel) as u64
}

/// Refuses a raster that `method` cannot trace on a device that binds buffers of at most `limit` bytes.
///
/// # Errors
/// The buffer that is too large, and what to do.
pub(super) fn check_raster(
    raster: Raster,
    method: &Method,
    limit: u64,
    device: &str,
) -> Result<(), RasterTooLarge> {
    let pixels = in_blocks(raster.pixel_count()) as u64;
    let (what, bytes) = BytesPerPixel::of(method).largest();
    let needed = pixels * bytes as u64;
    if needed <= limit {
        return Ok(());
    }
    let frugal = BytesPerPixel::of(&Method::full(1)).largest().1;
    Err(RasterTooLarge {
        raster,
        device: device.to_owned(),
        what,
        needed,
        limit,
        most_pixels: limit / bytes as u64,
        frugal_fits: pixels * frugal as u64 <= limit,
    })
}

/// Memory that is kept from frame to frame.
pub(super) struct SharedBuffers {
    /// Two buffers with one entry a pixel. Frames write them in turns, and read the other.
    pub history: [Buffer; 2],
    pub rates: Buffer,
    pub noise: Buffer,
    /// Response, flat field and rays of the projector's pixels, albedo maps, and the blur of a moving eye. Where fewer pixels are traced, of each
    /// traced raster one after the other.
    pub optics: Buffer,
    /// The same of the panel, where fewer pixels are traced than it has.
    pub panel_optics: Option<Buffer>,
    /// Groups of planes that follow the bodies.
    pub plane_groups: Buffer,
    /// The schedule at the start of a frame.
    pub schedule_start: Buffer,
}

impl SharedBuffers {
    /// Allocates and fills.
    ///
    /// # Errors
    /// The raster is too large for the device, or the GPU's own.
    pub(crate) fn new(gpu: &Arc<Gpu>, settings: &RendererSettings) -> Result<Self, RenderError> {
        let raster = settings.on_traced().raster;
        check_raster(raster, &settings.method, gpu.max_buffer_bytes(), &gpu.summary().name)?;
        let optics = |settings: &RendererSettings| {
            OpticsLayout::new(settings).table(&settings.drive, settings.lens.as_ref())
        };
        let tables: Vec<f32> =
            settings.scale.rasters(settings.raster).flat_map(|raster| optics(&settings.on(raster))).collect();
        let panel_optics = || Buffer::from_slice(gpu, "optics of the panel", &optics(settings));
        let pixels = if settings.method.needs_history() { raster.pixel_count() } else { 1 };
        let none = History::block_of_none();
        let history = || -> Result<Buffer, GpuError> {
            let bytes = History::buffer_bytes(pixels);
            let buffer = table_buffer(gpu, "history", bytes, MemoryKind::Device)?;
            fill(gpu, &buffer, &none, bytes / none.len())?;
            Ok(buffer)
        };
        let tiles = raster.width().div_ceil(TILE) * raster.height().div_ceil(TILE);
        let start = Schedule { groups: [0, 1, 1], ..Schedule::zeroed() };
        Ok(Self {
            history: [history()?, history()?],
            rates: Buffer::from_slice(gpu, "shading rates", &vec![0u32; tiles as usize])?,
            optics: Buffer::from_slice(gpu, "optics", &tables)?,
            panel_optics: settings.is_reduced().then(panel_optics).transpose()?,
            noise: Buffer::from_slice(gpu, "blue noise", blue_noise::MASK)?,
            plane_groups: match &settings.plane_groups[..] {
                [] => Buffer::from_slice(gpu, "plane groups", &[PlaneGroup::zeroed()])?,
                groups => Buffer::from_slice(gpu, "plane groups", groups)?,
            },
            schedule_start: Buffer::from_slice(gpu, "schedule", &[start])?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::method::SamplerKind;

    const LIMIT: u64 = 128 << 20;

    /// Method `dpm`, the paper's and that of its predecessor, as a rig file's defaults give them.
    fn with_history() -> [Method; 3] {
        let paper = Method {
            rate_map: true,
            checkerboard: true,
            sampler: SamplerKind::BlueNoise,
            temporal: true,
            spatial: true,
            spp_by_angle: true,
            ..Method::full(2)
        };
        let miyamoto = Method { rate_map: false, checkerboard: false, ..paper.clone() };
        let dpm = Method {
            dpm: true,
            checkerboard: false,
            spp_by_angle: false,
            sampler: SamplerKind::Continued,
            history_cap: crate::method::HISTORY_CAP,
            ..paper.clone()
        };
        [dpm, paper, miyamoto]
    }

    fn refusal(width: u32, height: u32, method: &Method) -> Option<RasterTooLarge> {
        check_raster(Raster::new(width, height).unwrap(), method, LIMIT, "a device").err()
    }

    #[test]
    fn a_method_without_a_history_is_refused_for_no_buffer_of_those_with_one() {
        let full = Method::full(2);
        assert!(!full.needs_history() && !full.needs_guides() && !full.needs_spatial());
        // Sixteen bytes a pixel is what it needs: 128 MiB of them are 8388608 pixels, to the pixel.
        for (w, h) in [(2560, 1440), (3840, 2160), (4096, 2048)] {
            assert_eq!(refusal(w, h, &full), None, "{w} x {h}");
        }
        let error = refusal(4097, 2048, &full).unwrap();
        assert_eq!((error.what, error.needed, error.most_pixels), ("surface", 4097 * 2048 * 16, 1 << 23));
        assert!(!error.frugal_fits && !error.to_string().contains("render.method"), "{error}");
    }

    #[test]
    fn a_history_fits_up_to_two_megapixels_and_the_refusal_says_what_to_do() {
        for method in with_history() {
            for (w, h) in [(1280, 1024), (1920, 1080), (2048, 1024)] {
                assert_eq!(refusal(w, h, &method), None, "{w} x {h}");
            }
            let error = refusal(2560, 1440, &method).unwrap();
            assert_eq!((error.what, error.needed, error.most_pixels), ("history", 2560 * 1440 * 64, 1 << 21));
            let text = error.to_string();
            for word in [
                "2560 x 1440",
                "a device",
                "history",
                "225.0 MiB",
                "128.0 MiB",
                "--raster",
                "render.method=full",
            ] {
                assert!(text.contains(word), "{word} in {text}");
            }
        }
    }
}
