//! The memory of one frame in flight, on the GPU and on the host, and the buffer of each binding of the shaders.

use super::apart::{self, ApartFrame};
use super::body_tree::BodyTree;
use super::deformed::DeformedTables;
use super::fill::fill;
use super::live_textures::{LiveTextures, Piece};
use super::memory::{BytesPerPixel, SharedBuffers, SHOWN_BYTES};
use super::read_back::{Guide, Surface};
use super::scene_data::{BodyData, SceneData};
use super::scene_gpu::{self, table_buffer, Geometry, SceneGpu};
use super::settings::{Output, RendererSettings};
use crate::gpu::{Buffer, FrameTree, Gpu, GpuError, MemoryKind, MemoryPlace};
use crate::pack;
use dpm_shaders::structs::{
    in_blocks, BodyNode, Counters, Filtered, Frame, Instance, Mover, Schedule, TextureInfo, PART_BLOCK,
};
use dpm_shaders::Reading;
use std::sync::Arc;

/// The buffers of one frame in flight.
pub(super) struct FrameBuffers {
    /// What the host writes in every frame, and the copies that the shaders read. Every ray reads the poses, so they have to lie in the GPU's own
    /// memory: the host's lies behind a bus.
    pub frame: LatchBuffer,
    pub instances: LatchBuffer,
    /// The tree over the bodies; of no use where rays ask each body.
    pub body_nodes: LatchBuffer,
    /// Builds it.
    pub body_tree: BodyTree,
    pub arguments: Buffer,
    pub tiles: Buffer,
    pub counters: Buffer,
    pub counters_host: Buffer,
    pub surfaces: Buffer,
    pub radiance: Buffer,
    pub codes: Buffer,
    /// `None`: the host reads only the planes.
    pub codes_host: Option<Buffer>,
    pub planes: Buffer,
    /// `None`: the host reads only the code values.
    pub planes_host: Option<Buffer>,
    /// Bytes of all planes together.
    pub plane_bytes: usize,
    pub guides: Buffer,
    pub schedule: Buffer,
    /// `None`: it belongs to `apart`.
    pub work: Option<Buffer>,
    /// What the frame shares with the threads that walk its rays; `None`: the shaders walk.
    pub apart: Option<Arc<ApartFrame>>,
    /// Bound where no host walks.
    no_queue: Option<Buffer>,
    /// The history's picture. In method dpm the pass `reproject` leaves shifts here, which the pass `accumulate` reads before it writes the picture.
    pub filtered: Buffer,
    /// The picture after the spatial filter. By method dpm only a host that reads everything gets it.
    pub filtered_shown: Buffer,
    /// Copies for debugging, if they were asked for.
    pub debug_host: Option<DebugBuffers>,
    /// Sizes of the buffers that grow with the raster.
    pub each: BytesPerPixel,
    /// What was drawn, from which planes that follow are taken, and how it moves while the planes last.
    pub motion: Buffer,
    /// The bodies that move while the planes last.
    pub movers: LatchBuffer,
    /// The tree over the bodies, in which the device finds what a ray meets; `None`: the shaders walk.
    pub device_tree: Option<FrameTree>,
    /// The tables of a scene in which bodies deform.
    pub deformed: Option<DeformedTables>,
    /// The texture table of a scene with clips or live textures.
    pub textures: Option<LatchBuffer>,
    /// What goes to the GPU of live pictures.
    pub piece: Option<Piece>,
    /// What the panel's pixels have of their own where fewer are traced; `None`: these are all of the panel's.
    pub panel: Option<PanelBuffers>,
}

/// The lists that the passes of a reduced raster make: of pixels, and of cells.
pub(super) const PANEL_LISTS: usize = 2;

/// What the passes have of their own that work on the panel's pixels, where fewer pixels are traced than the panel has.
pub(super) struct PanelBuffers {
    pub frame: LatchBuffer,
    pub arguments: Buffer,
    pub tiles: Buffer,
    pub counters: Buffer,
    pub counters_host: Buffer,
    pub surfaces: Buffer,
    /// The picture before compensation, which only a host that reads everything gets.
    pub shown: Buffer,
    /// Of each traced pixel what enlarging needs.
    lights: Buffer,
    /// The panel's pixels on edges and the cells with even surface, as the shaders list them.
    lists: Buffer,
    /// How many there are: [`PANEL_LISTS`] in a row, that of pixels first.
    pub schedule: Buffer,
    /// Code values of the traced pixels, which nobody reads.
    unread_codes: Buffer,
}

/// Whose pixels a pass works on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pixels {
    /// Those that are traced.
    Traced,
    /// Those of the panel.
    Panel,
}

/// A buffer that the host writes, with its copy for the shaders. The frame's first commands make the copy.
pub(super) struct LatchBuffer {
    pub host: Buffer,
    pub device: Buffer,
    pub len_bytes: usize,
}

/// Copies for debugging.
pub(super) struct DebugBuffers {
    pub shown: Buffer,
    pub surfaces: Buffer,
    /// `None` for the methods that do not need it, and so below.
    pub guides: Option<Buffer>,
    pub history: Option<Buffer>,
    pub prior: Option<Buffer>,
    pub traced: Buffer,
    pub rates: Buffer,
    pub schedule: Buffer,
    pub work: Buffer,
    /// `None` unless planes follow.
    pub motion: Option<Buffer>,
}

impl FrameBuffers {
    /// Memory for the scene `data`, whose tables shaders read in this way, for so many tiles of the traced raster and of the panel. `debug` adds the
    /// copies for debugging.
    ///
    /// # Errors
    /// Out of memory.
    pub(super) fn new(
        gpu: &Arc<Gpu>,
        settings: &RendererSettings,
        (data, reading, apart): (&SceneData, Reading, Option<apart::QueueLayout>),
        (tiles, panel_tiles): (usize, usize),
        body_tree: BodyTree,
        live: Option<&LiveTextures>,
        debug: bool,
    ) -> Result<Self, GpuError> {
        use MemoryKind::{Device, Readback, Upload};
        let (bodies, asks_device) = (data.bodies.len(), reading == Reading::Query);
        let pixels = in_blocks(settings.on_traced().raster.pixel_count());
        let panel_pixels = in_blocks(settings.raster.pixel_count());
        let (both, is_reduced) = ((pixels, panel_pixels), settings.is_reduced());
        let size = |what, bytes, kind| Buffer::new(gpu, what, bytes, kind);
        let table = |what, bytes, kind| table_buffer(gpu, what, bytes, kind);
        let latched = |what, len_bytes| -> Result<LatchBuffer, GpuError> {
            let host = size(what, len_bytes, Upload)?;
            Ok(LatchBuffer { host, device: table(what, len_bytes, Device)?, len_bytes })
        };
        let each = BytesPerPixel::of(&settings.method).and_planes_follow(!settings.plane_groups.is_empty());
        // A buffer that the method does not need is bound all the same, but is as small as possible.
        let with = |what, each: usize| table(what, (pixels * each).max(16), Device);
        let shown_bytes = if debug || is_reduced { SHOWN_BYTES } else { each.shown };
        let packed = settings.output.schedule();
        let plane_bytes = packed.map_or(4, |schedule| pack::gpu::len_bytes(settings.raster, schedule));
        let reads_codes = !matches!(settings.output, Output::Planes(_));
        let codes_host = reads_codes.then(|| size("code values", panel_pixels * each.codes, Readback));
        let nodes = body_tree.most_nodes();
        let apart = apart.map(|layout| ApartFrame::new(gpu, layout, bodies, nodes, pixels)).transpose()?;
        let own_work = apart.is_none().then(|| size("work list", pixels * each.work, Device)).transpose()?;
        let no_queue =
            apart.is_none().then(|| Buffer::new_texels(gpu, "no rays", 1, false, Device)).transpose()?;
        Ok(Self {
            frame: latched("frame uniforms", size_of::<Frame>())?,
            instances: latched("instances", size_of::<Instance>() * bodies.max(1))?,
            body_nodes: latched(
                "tree over the bodies",
                size_of::<BodyNode>() * body_tree.most_nodes().max(1),
            )?,
            body_tree,
            arguments: size("dispatch arguments", 48, Upload)?,
            tiles: size("tile list", tiles * 4, Upload)?,
            counters: size("counters", size_of::<Counters>(), Device)?,
            counters_host: size("counters", size_of::<Counters>(), Readback)?,
            surfaces: table("surfaces", pixels * each.surfaces, Device)?,
            radiance: size("radiance", pixels * each.radiance, Device)?,
            codes: size("code values", panel_pixels * each.codes, Device)?,
            codes_host: codes_host.transpose()?,
            planes: size("bit planes", plane_bytes, Device)?,
            planes_host: packed.map(|_| size("bit planes", plane_bytes, Readback)).transpose()?,
            plane_bytes,
            guides: with("guides", each.guides)?,
            schedule: size("schedule", size_of::<Schedule>(), Device)?,
            work: own_work,
            apart: apart.map(Arc::new),
            no_queue,
            filtered: with("filtered radiance", each.filtered)?,
            filtered_shown: with("shown radiance", shown_bytes)?,
            motion: table("motion of surfaces", (panel_pixels * each.motion).max(16), Device)?,
            movers: latched("movers", size_of::<Mover>() * bodies.max(1))?,
            device_tree: asks_device.then(|| FrameTree::new(gpu, bodies)).transpose()?,
            deformed: DeformedTables::new(gpu, data, reading)?,
            textures: texture_table(gpu, reading, data)?,
            piece: live.map(|live| live.piece(gpu)).transpose()?,
            debug_host: debug.then(|| DebugBuffers::new(gpu, both, tiles, each)).transpose()?,
            panel: is_reduced.then(|| PanelBuffers::new(gpu, both, panel_tiles, each, debug)).transpose()?,
            each,
        })
    }

    /// Changes the shapes and pictures of this frame to those of `t_ns`, and the bounds of bodies that deform. Allocates
    /// nothing.
    pub(super) fn show(
        &mut self,
        data: &SceneData,
        live: Option<&LiveTextures>,
        t_ns: i64,
        bounds: &mut [BodyData],
    ) {
        if let Some(deformed) = &mut self.deformed {
            deformed.write(data, t_ns, bounds);
        }
        if let Some(textures) = &mut self.textures {
            let clips = data.clips.iter().map(|clip| (clip.texture, clip.offset_at(t_ns)));
            for (texture, offset) in clips.chain(live.into_iter().flat_map(LiveTextures::shown)) {
                let info = TextureInfo { offset, ..data.textures[texture] };
                let size = size_of::<TextureInfo>();
                textures.host.bytes_mut()[texture * size..][..size]
                    .copy_from_slice(bytemuck::bytes_of(&info));
            }
        }
    }

    /// Fills the buffers so that tiles that are never traced have no hit and are black.
    ///
    /// # Errors
    /// The GPU's own.
    pub(super) fn clear(&self, gpu: &Arc<Gpu>, settings: &RendererSettings) -> Result<(), GpuError> {
        let pixels = in_blocks(settings.on_traced().raster.pixel_count());
        let panel_pixels = in_blocks(settings.raster.pixel_count());
        fill(gpu, &self.surfaces, &Surface::block_of_none(), pixels / PART_BLOCK)?;
        fill(gpu, &self.codes, &0u32, panel_pixels)?;
        if let Some(panel) = &self.panel {
            fill(gpu, &panel.surfaces, &Surface::block_of_none(), panel_pixels / PART_BLOCK)?;
            if self.debug_host.is_some() {
                fill(gpu, &panel.shown, &[0u8; SHOWN_BYTES], panel_pixels)?;
            }
        }
        fill(gpu, &self.radiance, &[0f32; 4], pixels)?;
        if self.each.guides > 0 {
            fill(gpu, &self.guides, &0u32, pixels * Guide::BYTES / 4)?;
        }
        if self.each.filtered > 0 {
            fill(gpu, &self.filtered, &[0u8; size_of::<Filtered>()], pixels)?;
        }
        let is_shown = !settings.method.dpm || self.debug_host.is_some() || self.panel.is_some();
        if is_shown {
            fill(gpu, self.shown(settings), &[0u8; SHOWN_BYTES], pixels)
        } else {
            Ok(())
        }
    }

    /// The picture that is shown: that of the method's last pass before the pass `compensate`.
    pub(super) fn shown(&self, settings: &RendererSettings) -> &Buffer {
        if settings.method.needs_spatial() {
            &self.filtered_shown
        } else if settings.method.needs_history() {
            &self.filtered
        } else {
            &self.radiance
        }
    }

    /// The picture that the host may read, and the surfaces to which it belongs: those of the panel's pixels.
    pub(super) fn seen(&self, settings: &RendererSettings) -> [&Buffer; 2] {
        match &self.panel {
            Some(panel) => [&panel.shown, &panel.surfaces],
            None => [self.shown(settings), &self.surfaces],
        }
    }

    /// Where each buffer lies: those of the shaders' bindings, and those that the host reads.
    pub(super) fn places(&self) -> Vec<(&'static str, MemoryPlace)> {
        let of_shaders = [
            ("frame uniforms", &self.frame.device),
            ("instances", &self.instances.device),
            ("tree over the bodies", &self.body_nodes.device),
            ("movers", &self.movers.device),
            ("counters", &self.counters),
            ("surfaces", &self.surfaces),
            ("radiance", &self.radiance),
            ("guides", &self.guides),
            ("schedule", &self.schedule),
            ("work list", self.work()),
            ("filtered radiance", &self.filtered),
            ("shown radiance", &self.filtered_shown),
            ("code values", &self.codes),
            ("bit planes", &self.planes),
        ];
        let of_host = [
            ("counters of the host", Some(&self.counters_host)),
            ("code values of the host", self.codes_host.as_ref()),
            ("bit planes of the host", self.planes_host.as_ref()),
        ];
        let of_host = of_host.into_iter().filter_map(|(name, buffer)| Some((name, buffer?)));
        of_shaders.into_iter().chain(of_host).map(|(name, buffer)| (name, buffer.place())).collect()
    }

    /// The work list.
    pub(super) fn work(&self) -> &Buffer {
        let of_apart = || self.apart.as_ref().map(|apart| &apart.work);
        self.work.as_ref().or_else(of_apart).expect("one of the two")
    }

    /// The scene's geometry, or that of this frame.
    fn geometry<'a>(&'a self, scene: &'a SceneGpu) -> &'a Geometry {
        self.deformed.as_ref().map_or(&scene.geometry, |deformed| &deformed.geometry)
    }

    /// The buffer of the binding `name` for the passes of one side, in frames that write the history buffer `parity`.
    pub(super) fn of<'a>(
        &'a self,
        name: &str,
        (parity, side): (usize, Pixels),
        settings: &RendererSettings,
        (shared, scene): (&'a SharedBuffers, &'a SceneGpu),
    ) -> &'a Buffer {
        let of_side = self.panel.as_ref().and_then(|panel| match (side, name) {
            (Pixels::Traced, "B_CODES") => Some(&panel.unread_codes),
            (_, "B_COARSE_LIGHT" | "B_COARSE_LIGHT_ROWS") => Some(&panel.lights),
            (Pixels::Traced, _) => None,
            (Pixels::Panel, "B_SCHEDULE") => Some(&panel.schedule),
            (Pixels::Panel, "B_WORK") => Some(&panel.lists),
            (Pixels::Panel, "B_FRAME") => Some(&panel.frame.device),
            (Pixels::Panel, "B_TILES") => Some(&panel.tiles),
            (Pixels::Panel, "B_COUNTERS") => Some(&panel.counters),
            (Pixels::Panel, "B_SURFACES" | "B_SURFACE_ROWS") => Some(&panel.surfaces),
            (Pixels::Panel, "B_SHOWN") => Some(&panel.shown),
            (Pixels::Panel, "B_OPTICS") => shared.panel_optics.as_ref(),
            (Pixels::Panel, _) => None,
        });
        of_side.unwrap_or_else(|| self.of_traced(name, parity, settings, (shared, scene)))
    }

    /// The same, but for what the panel's pixels have of their own.
    fn of_traced<'a>(
        &'a self,
        name: &str,
        parity: usize,
        settings: &RendererSettings,
        (shared, scene): (&'a SharedBuffers, &'a SceneGpu),
    ) -> &'a Buffer {
        match name {
            "B_COARSE_FRAME" => &self.frame.device,
            "B_COARSE_SURFACES" => &self.surfaces,
            // Bound and never used where the panel has nothing of its own.
            "B_COARSE_LIGHT" | "B_COARSE_LIGHT_ROWS" => &self.surfaces,
            "B_FRAME" => &self.frame.device,
            "B_INSTANCES" => &self.instances.device,
            "B_BODY_NODES" => &self.body_nodes.device,
            "B_NODES" => &self.geometry(scene).nodes,
            "B_TRIANGLES" => &self.geometry(scene).triangles,
            "B_TRIANGLE_REFS" => &scene.refs,
            "B_VERTICES" => &self.geometry(scene).vertices,
            "B_MATERIALS" => &scene.materials,
            "B_TEXTURES" => self.textures.as_ref().map_or(&scene.textures, |textures| &textures.device),
            "B_TEXELS" => &scene.texels,
            "B_LIGHTS" => &scene.lights,
            "B_ENVIRONMENT" => &scene.environment,
            "B_ALBEDO" => &scene.albedo,
            "B_TILES" => &self.tiles,
            "B_SURFACES" | "B_SURFACE_ROWS" => &self.surfaces,
            "B_RADIANCE" => &self.radiance,
            "B_CODES" => &self.codes,
            "B_COUNTERS" => &self.counters,
            "B_GUIDES" | "B_GUIDE_ROWS" => &self.guides,
            "B_HISTORY" | "B_HISTORY_ROWS" => &shared.history[parity],
            "B_FORMER" => &shared.history[1 - parity],
            "B_RATES" => &shared.rates,
            "B_SCHEDULE" => &self.schedule,
            "B_WORK" => self.work(),
            "B_QUEUE" | "B_QUEUE_ROWS" => self.apart.as_ref().map_or_else(
                || self.no_queue.as_ref().expect("made where no host walks"),
                |apart| &apart.queue,
            ),
            "B_NOISE" => &shared.noise,
            "B_OPTICS" => &shared.optics,
            "B_FILTERED" | "B_FILTERED_ROWS" => &self.filtered,
            "B_SHOWN" => self.shown(settings),
            "B_PLANES" => &self.planes,
            "B_MOTION" => &self.motion,
            "B_MOVERS" => &self.movers.device,
            "B_PLANE_GROUPS" => &shared.plane_groups,
            other => unreachable!("binding {other} has no buffer"),
        }
    }
}

/// The texture table of a frame in flight; `None` if the pictures of the scene stay.
fn texture_table(
    gpu: &Arc<Gpu>,
    reading: Reading,
    data: &SceneData,
) -> Result<Option<LatchBuffer>, GpuError> {
    if data.clips.is_empty() && data.live.is_empty() {
        return Ok(None);
    }
    let len_bytes = size_of_val(&data.textures[..]);
    let mut host = Buffer::new(gpu, "texture table", len_bytes, MemoryKind::Upload)?;
    host.write(&data.textures);
    let device = scene_gpu::texture_table(gpu, reading, data)?;
    Ok(Some(LatchBuffer { host, device, len_bytes }))
}

impl PanelBuffers {
    /// For so many pixels that are traced and of the panel. `debug`: the host reads the picture before compensation.
    fn new(
        gpu: &Arc<Gpu>,
        (pixels, panel_pixels): (usize, usize),
        tiles: usize,
        each: BytesPerPixel,
        debug: bool,
    ) -> Result<Self, GpuError> {
        use MemoryKind::{Device, Readback, Upload};
        let size = |what, bytes, kind| Buffer::new(gpu, what, bytes, kind);
        let len_bytes = size_of::<Frame>();
        let frame = size("frame uniforms of the panel", len_bytes, Upload)?;
        Ok(Self {
            frame: LatchBuffer {
                host: frame,
                device: table_buffer(gpu, "frame uniforms of the panel", len_bytes, Device)?,
                len_bytes,
            },
            arguments: size("dispatch arguments of the panel", 48, Upload)?,
            tiles: size("tile list of the panel", tiles * 4, Upload)?,
            counters: size("counters of the panel", size_of::<Counters>(), Device)?,
            counters_host: size("counters of the panel", size_of::<Counters>(), Readback)?,
            surfaces: table_buffer(gpu, "surfaces of the panel", panel_pixels * each.surfaces, Device)?,
            shown: size("shown radiance", if debug { panel_pixels * SHOWN_BYTES } else { 16 }, Device)?,
            lights: table_buffer(gpu, "light of traced pixels", pixels * size_of::<Filtered>(), Device)?,
            lists: size("pixels on edges", panel_pixels * each.work, Device)?,
            schedule: size("schedule of the panel", PANEL_LISTS * size_of::<Schedule>(), Device)?,
            unread_codes: size("code values of traced pixels", pixels * each.codes, Device)?,
        })
    }
}

impl DebugBuffers {
    /// For so many pixels that are traced and of the panel.
    fn new(
        gpu: &Arc<Gpu>,
        (pixels, panel_pixels): (usize, usize),
        tiles: usize,
        each: BytesPerPixel,
    ) -> Result<Self, GpuError> {
        let size = |what, bytes| Buffer::new(gpu, what, bytes, MemoryKind::Readback);
        let kept = |what, each: usize| (each > 0).then(|| size(what, pixels * each)).transpose();
        Ok(Self {
            shown: size("shown radiance", panel_pixels * SHOWN_BYTES)?,
            surfaces: size("surfaces", panel_pixels * each.surfaces)?,
            guides: kept("guides", each.guides)?,
            history: kept("history", each.history)?,
            prior: kept("prior history", each.history)?,
            traced: size("radiance", pixels * each.radiance)?,
            rates: size("shading rates", tiles * 4)?,
            schedule: size("schedule", size_of::<Schedule>())?,
            work: size("work list", pixels * each.work)?,
            motion: (each.motion > 0)
                .then(|| size("motion of surfaces", panel_pixels * each.motion))
                .transpose()?,
        })
    }
}
