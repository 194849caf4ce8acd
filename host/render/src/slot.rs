//! One frame in flight: its memory on the GPU and on the host, what it cost, and what can be read back.

use super::apart::ApartLists;
use super::frame_buffers::FrameBuffers;
use super::passes::{FIRST_PASSES, PASSES};
use super::read_back::{elements, Guide, History, Surface};
use super::resources::Resources;
use super::tiles::{TileList, TILE};
use crate::gpu::{BindingSet, CommandList, FrameFence, GpuError, MemoryPlace};
use crate::walker::Ray;
use dpm_device::planes::Raster;
use dpm_shaders::structs::{part, BodyNode, Counters, HistoryLight, Instance, Moved, Schedule, WorkItem};
use std::sync::Arc;

/// What a frame cost.
#[derive(Clone, Copy, Debug, Default)]
pub struct FrameCost {
    /// What the shaders counted: [`Counters`] as words.
    pub counters: [u32; size_of::<Counters>() / 4],
    /// GPU time of each pass of [`PASSES`], nanoseconds; 0 if the device has no time stamps.
    pub pass_ns: [u64; PASSES.len()],
    /// The next frame could begin before this one had ended.
    pub overlaps: bool,
}

impl FrameCost {
    /// The counters by name.
    pub fn counters(&self) -> Counters {
        bytemuck::cast(self.counters)
    }

    /// For how long the frame kept the GPU from another one, nanoseconds: all its passes, or where frames overlap the longer of its two parts. 0 if
    /// the device has no time stamps.
    pub fn occupied_ns(&self) -> u64 {
        let [first, second] =
            [&self.pass_ns[..FIRST_PASSES], &self.pass_ns[FIRST_PASSES..]].map(|part| part.iter().sum());
        if self.overlaps {
            u64::max(first, second)
        } else {
            first + second
        }
    }
}

/// What the shaders are given: the passes that work on the traced pixels, and those that work on the panel's, if these are others.
pub(super) struct Sets {
    pub traced: BindingSet,
    pub panel: Option<BindingSet>,
}

/// The memory of one frame in flight. It moves between threads: one fills and submits it, another waits for it and reads it. It keeps alive what its
/// submission reads, so it may outlive its renderer. Dropping it waits for the submission as [`FrameFence`] does.
pub struct FrameSlot {
    // Dropped first, because it waits until the GPU no longer uses the rest.
    pub(super) fence: FrameFence,
    /// Two for each of the two history buffers that a frame may write: the passes that the next frame waits for, and the others.
    pub(super) lists: [[CommandList; 2]; 2],
    /// Those that take the place of the first ones where the host walks rays, for each of the two history buffers.
    pub(super) apart: Option<[ApartLists; 2]>,
    /// The frame that ran last did so.
    pub(super) was_apart: bool,
    pub(super) _sets: [Sets; 2],
    pub(super) buffers: FrameBuffers,
    /// Of each raster that a frame may trace, the largest first.
    pub(super) tile_lists: Vec<TileList>,
    /// Of the panel, where fewer pixels are traced than it has.
    pub(super) panel_tiles: Option<TileList>,
    /// The list of them that was traced last.
    pub(super) rung: usize,
    /// Raster of the panel.
    pub(super) raster: Raster,
    /// The raster that was traced last.
    pub(super) traced: Raster,
    /// The list that ran last.
    pub(super) parity: usize,
    pub(super) stamps: [u64; PASSES.len() + 2],
    // Dropped last, because the submission uses these pipelines and buffers.
    pub(super) resources: Arc<Resources>,
}

impl FrameSlot {
    /// Waits at most `timeout_ns` for the frame, and returns what it cost. Allocates nothing.
    ///
    /// # Errors
    /// A timeout, after which the frame is still being drawn: wait again, or give the device up. Or the device is lost or was given up.
    pub fn wait(&mut self, timeout_ns: u64) -> Result<FrameCost, GpuError> {
        self.fence.wait(timeout_ns)?;
        Ok(self.cost())
    }

    /// Waits at most `wait_ns` for the frame. Returns what it cost, or `None` while it is still being drawn. Call it again until the frame is done; a
    /// thread that has to show that it is alive does so in between. Allocates nothing.
    ///
    /// # Errors
    /// The device is lost or was given up, so the frame will never be finished.
    pub fn poll_done(&mut self, wait_ns: u64) -> Result<Option<FrameCost>, GpuError> {
        Ok(if self.fence.poll(wait_ns)? { Some(self.cost()) } else { None })
    }

    /// What the finished frame cost.
    fn cost(&mut self) -> FrameCost {
        let mut cost = FrameCost {
            counters: bytemuck::cast(self.buffers.counters_host.read::<Counters>(1)[0]),
            ..FrameCost::default()
        };
        if let Some(panel) = &self.buffers.panel {
            let panel = panel.counters_host.read::<Counters>(1)[0];
            let traced = cost.counters();
            cost.counters = bytemuck::cast(Counters {
                rays: traced.rays + panel.rays,
                camera_rays: traced.camera_rays + panel.camera_rays,
                lit_pixels: panel.lit_pixels,
                clipped_values: panel.clipped_values,
                nan_values: panel.nan_values,
                ..traced
            });
        }
        cost.overlaps = self.resources.overlap.is_some();
        let [first, second] = &self.lists[self.parity];
        let (of_first, of_second) = self.stamps.split_at_mut(FIRST_PASSES + 1);
        let has_first = match self.apart.as_ref().filter(|_| self.was_apart) {
            None => first.stamps_ns(of_first),
            Some(lists) => {
                (lists[self.parity].0.iter()).fold(0, |n, list| n + list.own_stamps_ns(&mut of_first[n..]))
            }
        };
        if has_first == of_first.len() && second.stamps_ns(of_second) == of_second.len() {
            let ends = of_first.windows(2).chain(of_second.windows(2));
            for (pass, ends) in cost.pass_ns.iter_mut().zip(ends) {
                *pass = ends[1].saturating_sub(ends[0]);
            }
        }
        cost
    }

    /// Where its buffers lie: by name those that the shaders use, then those "of the host", which it reads.
    pub fn places(&self) -> Vec<(&'static str, MemoryPlace)> {
        self.buffers.places()
    }

    /// Code values 0x00BBGGRR, row by row. Empty if the renderer's output is planes only. Valid after [`FrameSlot::wait`].
    pub fn codes(&self) -> &[u32] {
        self.buffers.codes_host.as_ref().map_or(&[], |codes| codes.read(self.raster.pixel_count()))
    }

    /// Bit planes in the layout of [`crate::pack::gpu`]; `None` unless the renderer packs. Valid after [`FrameSlot::wait`].
    pub fn planes(&self) -> Option<&[u8]> {
        self.buffers.planes_host.as_ref().map(|planes| planes.read(self.buffers.plane_bytes))
    }

    /// The picture before compensation, as radiance. Only with `debug` at creation.
    pub fn radiance(&self) -> Option<&[[f32; 4]]> {
        self.buffers.debug_host.as_ref().map(|d| d.shown.read(self.raster.pixel_count()))
    }

    /// What each pixel's ray hit. Only with `debug` at creation.
    pub fn surfaces(&self) -> Option<Vec<Surface>> {
        let pixels = self.raster.pixel_count();
        let debug = self.buffers.debug_host.as_ref()?;
        Some(Surface::all(debug.surfaces.read(Surface::buffer_bytes(pixels)), pixels))
    }

    /// Motion, apparent size, angle and albedo of each lit pixel. Only with `debug` at creation, and for methods that use them.
    pub fn guides(&self) -> Option<Vec<Guide>> {
        let guides = self.buffers.debug_host.as_ref()?.guides.as_ref()?;
        let pixels = self.traced.pixel_count();
        Some(Guide::all(guides.read(Guide::buffer_bytes(pixels)), pixels))
    }

    /// The history after this frame. Only with `debug` at creation, and for methods that keep one.
    pub fn history(&self) -> Option<Vec<History>> {
        let history = self.buffers.debug_host.as_ref()?.history.as_ref()?;
        let pixels = self.traced.pixel_count();
        Some(History::all(history.read(History::buffer_bytes(pixels)), pixels))
    }

    /// Luminance of each pixel's history before this frame's samples, -1 where there is none. Only with `debug` at creation, and for methods that
    /// keep a history.
    pub fn prior_luminance(&self) -> Option<Vec<f32>> {
        self.buffers.debug_host.as_ref()?.prior.as_ref().map(|prior| {
            let known = |h: &HistoryLight| {
                let [r, g, b] = h.mean;
                if h.weight > 0.0 {
                    r * 0.2126 + g * 0.7152 + b * 0.0722
                } else {
                    -1.0
                }
            };
            let pixels = self.traced.pixel_count();
            let bytes = prior.read(History::buffer_bytes(pixels));
            elements(bytes, part("B_HISTORY", "light"), pixels).iter().map(known).collect()
        })
    }

    /// Mean of the samples of each pixel in this frame, and their number as the fourth value. Only with `debug` at creation.
    pub fn traced(&self) -> Option<&[[f32; 4]]> {
        self.buffers.debug_host.as_ref().map(|d| d.traced.read(self.traced.pixel_count()))
    }

    /// The work items of the pass `trace`, in the order of their samples, and how many samples they have together. Only with `debug` at creation.
    pub fn work(&self) -> Option<(&[WorkItem], u32)> {
        let debug = self.buffers.debug_host.as_ref()?;
        let listed = debug.schedule.read::<Schedule>(1)[0].listed;
        let items = (listed as u32) as usize;
        Some((debug.work.read(items.min(self.traced.pixel_count())), (listed >> 32) as u32))
    }

    /// The rays that each path of the frame has asked for last, in the order of the samples, with the bodies and the tree over them; `None` unless the
    /// host has walked them. Valid after [`FrameSlot::wait`].
    pub fn last_rays(&self) -> Option<(Vec<Ray>, Vec<Instance>, Vec<BodyNode>)> {
        self.buffers.apart.as_ref().filter(|_| self.was_apart).map(|apart| apart.last_rays())
    }

    /// Rays of the frame's paths, those included that surely meet nothing, and those that were walked; `cost` is the frame's. `None` unless the host has
    /// walked them.
    pub fn path_rays(&self, cost: &FrameCost) -> Option<(u32, u32)> {
        let apart = self.buffers.apart.as_ref().filter(|_| self.was_apart)?;
        Some(apart.ray_counts(cost.counters().rays))
    }

    /// Workgroups of the pass `trace` that the pass `schedule` asked for. Only with `debug` at creation.
    pub fn asked_groups(&self) -> Option<u32> {
        let [x, y, _] = self.buffers.debug_host.as_ref()?.schedule.read::<Schedule>(1)[0].groups;
        Some(x * y)
    }

    /// Pixels of the tiles that the frame worked on.
    pub fn listed_pixels(&self) -> u64 {
        let tiles = self.tile_lists[self.rung].active().iter().filter(|is_active| **is_active).count();
        tiles as u64 * u64::from(TILE * TILE)
    }

    /// How the surface of each pixel moves while the planes last, as [`crate::warp::gather`] reads it; of use only in tiles on which the light of
    /// a moving body can fall. Only with `debug` at creation, and if planes follow.
    pub fn motions(&self) -> Option<&[Moved]> {
        let motion = self.buffers.debug_host.as_ref()?.motion.as_ref()?;
        Some(motion.read(self.raster.pixel_count()))
    }

    /// Shading rate of every tile: log2 of the coarse pixel's sides in bits 0..1 and 2..3. Only with `debug` at creation.
    pub fn rates(&self) -> Option<&[u32]> {
        self.buffers.debug_host.as_ref().map(|d| d.rates.read(self.tile_lists[self.rung].len()))
    }
}
