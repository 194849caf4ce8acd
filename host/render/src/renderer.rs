//! One frame on the GPU, from surfaces over radiance to code values. `Renderer::create_slot` records the passes in their order.

use super::apart::{ApartLists, Side, WalkCrew};
use super::body_tree::BodyTree;
use super::fill;
use super::frame_buffers::{FrameBuffers, Pixels, PANEL_LISTS};
use super::last_frame::{LastFrame, Turn};
use super::live_textures::{LiveTextures, Piece};
use super::memory::{SharedBuffers, SHOWN_BYTES};
use super::optics::OpticsLayout;
use super::passes::{Grid, FIRST_PASSES, PASSES, TABLE};
use super::plan::RendererPlan;
use super::prepared::PreparedScene;
use super::read_back::{History, Surface};
use super::resources::Resources;
use super::scale::{cells_of_tiles, reach_of_cells};
use super::scene_data::{rows, world_bounds, BodyData, Keep, SceneData};
use super::settings::{FrameInputs, Overlapping, RayWalk, RayWalker, RenderError, RendererSettings};
use super::slot::{FrameSlot, Sets};
use super::tiles::TileList;
use super::warp::Movers;
use crate::gpu::{
    submit_frame, BindingSet, CommandList, FrameFence, FrameOrder, Gpu, GpuError, Orders, Overlap, Recorder,
    Relay,
};
use crate::pack;
use bytemuck::Zeroable;
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::Scene;
use dpm_shaders::structs::{
    self as gpu_structs, in_blocks, BodyNode, Counters, Frame, Instance, Mover, Schedule,
};
use dpm_shaders::Reading;
use glam::{DAffine3, Vec3};
use std::ops::Range;
use std::sync::Arc;

/// Byte offsets in the dispatch arguments: of four workgroups a tile, of one workgroup a tile in frames that decide rates, and of four workgroups a
/// tile in which something moves.
const PER_TILE_QUARTER: u64 = 0;
const PER_TILE_RATES: u64 = 16;
const PER_MOVING_QUARTER: u64 = 32;
/// In the panel's arguments, of as many workgroups as have a lane for each cell of a tile. It decides no rates.
const PER_CELLS: u64 = PER_TILE_RATES;
/// Lanes of a workgroup of the pass `cells`.
const LANES: u32 = 64;
/// Where the pass `trace` stands, which has parts where the host walks rays.
const TRACE: usize = {
    let mut i = 0;
    while !matches!(TABLE[i].grid, Grid::Work) {
        i += 1;
    }
    i
};

/// After this pass the history is what it is before the frame's samples.
const REPROJECT: &str = "reproject";

/// Draws the frames of one scene. It owns all that it needs, so a thread that hangs with the GPU can be abandoned together with it.
pub struct Renderer {
    pub(super) resources: Arc<Resources>,
    data: Arc<SceneData>,
    /// The bodies of `data`, with the bounds that those have which deform.
    bodies: Vec<BodyData>,
    pub(super) settings: RendererSettings,
    keep: Keep,
    /// For each body of the scene the tracked body that carries it.
    tracked: Vec<Option<u16>>,
    /// The pass that decides rates is recorded.
    decides_rates: bool,
    /// The last frame that was submitted and its poses, which is what the history holds.
    last: LastFrame,
    /// The tiles that were active when shading rates were last decided. All others have the full rate.
    rated: Vec<bool>,
    /// The rasters that frames may trace, the largest first.
    rungs: Vec<Rung>,
    /// The tiles of the panel, where fewer pixels are traced than it has. Copied into every slot.
    panel_tiles: Option<TileList>,
    /// The bodies that move while the planes of a frame last.
    movers: Movers,
    /// The textures that show what another program makes.
    live: Option<LiveTextures>,
    /// Rays look for bodies in a tree that the host builds.
    walks_tree: bool,
    /// How shaders read tables.
    reading: Reading,
    /// The order of frames that overlap.
    orders: Orders,
    /// The next question that a frame may ask of the threads that walk.
    next_question: u64,
    /// That of the panel.
    optics: OpticsLayout,
    prepared: PreparedScene,
    pub(super) gpu: Arc<Gpu>,
}

/// A raster that frames may trace.
struct Rung {
    raster: Raster,
    /// Where its part of the table of optics lies, and what is in it.
    optics: (u32, OpticsLayout),
    /// Copied into every slot.
    tile_list: TileList,
}

impl Rung {
    /// All of a renderer with these settings.
    fn all(settings: &RendererSettings) -> Vec<Self> {
        let mut first = 0;
        let rung = |raster| {
            let of = settings.on(raster);
            let optics = (first, OpticsLayout::new(&of));
            first += optics.1.len();
            Self { raster, optics, tile_list: TileList::new(raster, of.lens.as_ref()) }
        };
        settings.scale.rasters(settings.raster).map(rung).collect()
    }
}

/// `tracked`: for each body of the scene the tracked body that carries it.
fn is_lost(tracked: &[Option<u16>], body: usize, lost: &[bool]) -> bool {
    tracked[body].is_some_and(|t| lost.get(usize::from(t)).copied().unwrap_or(false))
}

/// Lists the tiles on which light can fall, or every tile.
fn list_tiles(tiles: &mut TileList, every: bool, inputs: &FrameInputs<'_>, bodies: &[BodyData]) {
    if every {
        tiles.fill();
    } else {
        tiles.update(inputs.camera, bodies, inputs.poses, gpu_structs::INSTANCE_PROJECTED);
    }
}

impl Renderer {
    /// Uploads the scene and compiles the passes that it needs.
    ///
    /// # Errors
    /// The scene is too large, or the GPU's own.
    pub fn new(gpu: &Arc<Gpu>, scene: &Scene, settings: RendererSettings) -> Result<Self, RenderError> {
        Self::keeping(gpu, scene, settings, Keep::default())
    }

    /// The same, but with all of `keep`, whether the rig needs it or not. This measures what leaving it out saves.
    ///
    /// # Errors
    /// As [`Renderer::new`].
    pub fn keeping(
        gpu: &Arc<Gpu>,
        scene: &Scene,
        settings: RendererSettings,
        keep: Keep,
    ) -> Result<Self, RenderError> {
        Self::from_plan(gpu, &RendererPlan::new(scene, settings, keep)?)
    }

    /// What this renderer was made from.
    pub fn plan(&self) -> RendererPlan {
        self.prepared.plan().clone()
    }

    /// The same renderer on this device, as it was before its first frame.
    ///
    /// # Errors
    /// The raster or the scene is too large for this device, or the GPU's own.
    pub fn from_plan(gpu: &Arc<Gpu>, plan: &RendererPlan) -> Result<Self, RenderError> {
        // Refused before the work of uploading and compiling.
        let shared = SharedBuffers::new(gpu, &plan.settings)?;
        Self::on(PreparedScene::new(gpu, plan)?, shared)
    }

    /// Another renderer of a scene that was prepared for one before, as that one was before its first frame. It is made at once: nothing is compiled,
    /// and only a scene with the pictures of other programs is uploaded again.
    ///
    /// # Errors
    /// The GPU's own.
    pub fn from_prepared(prepared: &PreparedScene) -> Result<Self, RenderError> {
        let shared = SharedBuffers::new(&prepared.gpu, &prepared.plan.settings)?;
        Self::on(prepared.for_another()?, shared)
    }

    fn on(prepared: PreparedScene, shared: SharedBuffers) -> Result<Self, RenderError> {
        let (gpu, plan, reading) = (&prepared.gpu, &prepared.plan, prepared.reading);
        let RendererPlan { data, settings, keep, tracked } = plan.clone();
        let optics = OpticsLayout::new(&settings);
        let decides_rates = TABLE
            .iter()
            .zip(&prepared.pipelines.each)
            .any(|(pass, p)| pass.grid == Grid::Rates && p.is_some());
        let overlaps = match settings.overlap {
            Overlapping::Never => false,
            Overlapping::WhereItCan => gpu.has_two_queues(),
            Overlapping::Always => true,
        };
        let overlap = overlaps.then(|| Overlap::new(gpu)).transpose()?;
        let last = LastFrame::none(tracked.len());
        let rungs = Rung::all(&settings);
        let reach = reach_of_cells(&settings.scale, settings.raster);
        let panel_tiles =
            settings.is_reduced().then(|| TileList::of_panel(settings.raster, settings.lens.as_ref(), reach));
        let rated = vec![false; rungs[0].tile_list.len()];
        let movers = Movers::new(data.bodies.len(), &settings.plane_groups, !settings.shows_halftones());
        let live = LiveTextures::new(&data.live, settings.most_live_texels);
        let walks_tree = plan.walks_body_tree(reading);
        let nodes = BodyTree::new(if walks_tree { data.bodies.len() } else { 0 }).most_nodes();
        let walks = prepared.pipelines.apart.is_some() && overlap.is_none();
        let crew = walks.then(|| WalkCrew::new(gpu, &data, nodes)).transpose()?;
        Ok(Self {
            resources: Arc::new(Resources {
                crew: crew.filter(|crew| !crew.is_empty()),
                pipelines: prepared.pipelines.clone(),
                shared,
                scene: prepared.scene().clone(),
                overlap,
            }),
            bodies: data.bodies.clone(),
            reading,
            data,
            settings,
            keep,
            tracked,
            decides_rates,
            last,
            rated,
            rungs,
            panel_tiles,
            movers,
            live,
            walks_tree,
            orders: Orders::default(),
            next_question: 1,
            optics,
            gpu: gpu.clone(),
            prepared,
        })
    }

    /// Its scene and passes, for a renderer that takes over on the same device.
    pub fn prepared(&self) -> &PreparedScene {
        &self.prepared
    }

    /// Who finds what its rays meet, and why.
    pub fn ray_walk(&self) -> Option<RayWalk> {
        let planned = self.prepared.plan().ray_walk(&self.gpu).ok()?;
        // Threads that could not be started walk nothing.
        match planned.by == RayWalker::Host && self.resources.crew.is_none() {
            true => Some(RayWalk { by: RayWalker::Shaders, why: "no thread of the host could be started" }),
            false => Some(planned),
        }
    }

    /// Whether the device finds itself what a ray meets (ray query), or the shaders do.
    pub fn asks_device(&self) -> bool {
        self.resources.scene.geometry.trees.is_some()
    }

    /// What the scene has become.
    pub(super) fn scene_data(&self) -> &SceneData {
        &self.data
    }

    /// How shaders read tables and find what a ray meets.
    pub(super) fn reading(&self) -> Reading {
        self.reading
    }

    /// Whether shaders read tables through texel buffers.
    pub(super) fn is_software(&self) -> bool {
        self.reading == Reading::Texels
    }

    /// Interpolated normal of a surface, in its body's space and without the normal map.
    pub fn shading_normal(&self, surface: &Surface) -> Vec3 {
        let [u, v] = surface.barycentric;
        let n = self.corners(surface).map(|i| Vec3::from_array(self.data.vertices[i as usize].normal));
        (n[0] * (1.0 - u - v) + n[1] * u + n[2] * v).normalize_or_zero()
    }

    /// Texture coordinates of what a projector pixel sees.
    pub fn texture_coordinates(&self, surface: &Surface) -> [f32; 2] {
        let [u, v] = surface.barycentric;
        let [a, b, c] = self.corners(surface).map(|i| self.data.vertices[i as usize].uv);
        std::array::from_fn(|k| (a[k] * ((1.0 - u) - v) + b[k] * u) + c[k] * v)
    }

    /// Indices of the corners of a surface's triangle, among the vertices of all bodies in their order.
    pub fn corners(&self, surface: &Surface) -> [u32; 3] {
        let body = &self.data.bodies[(surface.id >> 24) as usize];
        self.data.refs[(body.triangle_offset + (surface.id & 0x00ff_ffff)) as usize].vertices
    }

    /// The bodies that moved while the planes of the last frame were lit.
    pub fn movers(&self) -> &[Mover] {
        self.movers.movers()
    }

    /// Memory and commands for one frame in flight. With `debug` the host can also read radiance and surfaces.
    ///
    /// # Errors
    /// Out of memory.
    pub fn create_slot(&self, debug: bool) -> Result<FrameSlot, GpuError> {
        let (gpu, resources, settings) = (&self.gpu, &self.resources, &self.settings);
        let tile_lists: Vec<_> = self.rungs.iter().map(|rung| rung.tile_list.clone()).collect();
        let tiles = tile_lists[0].len();
        let panel_tiles = self.panel_tiles.as_ref().map_or(tiles, TileList::len);
        let body_tree = BodyTree::new(if self.walks_tree { self.data.bodies.len() } else { 0 });
        let apart = resources.crew.as_ref().and(resources.pipelines.apart.as_ref());
        let scene = (&*self.data, self.reading, apart.map(|(_, layout)| *layout));
        let live = self.live.as_ref();
        let buffers = FrameBuffers::new(gpu, settings, scene, (tiles, panel_tiles), body_tree, live, debug)?;
        buffers.clear(gpu, settings)?;
        let set_of = |parity, side| {
            let all = (&resources.shared, &*resources.scene);
            let bindings: Vec<_> = gpu_structs::BINDINGS
                .iter()
                .map(|&(name, binding)| (binding, buffers.of(name, (parity, side), settings, all)))
                .collect();
            BindingSet::with_tree(&resources.pipelines.table, &bindings, buffers.device_tree.as_ref())
        };
        let sets_of = |parity| -> Result<Sets, GpuError> {
            let panel = buffers.panel.as_ref().map(|_| set_of(parity, Pixels::Panel)).transpose()?;
            Ok(Sets { traced: set_of(parity, Pixels::Traced)?, panel })
        };
        let sets = [sets_of(0)?, sets_of(1)?];
        let lists = |parity: usize| -> Result<[CommandList; 2], GpuError> {
            let (set, stamps) = (&sets[parity], [FIRST_PASSES, PASSES.len() - FIRST_PASSES]);
            let [first, second] = stamps.map(|passes| passes as u32 + 1);
            Ok([
                CommandList::record(gpu, first, |r| {
                    self.record_latch(r, &buffers);
                    self.record_passes(r, 0..FIRST_PASSES, set, &buffers, parity);
                })?,
                CommandList::record(gpu, second, |r| {
                    r.stamp();
                    self.record_passes(r, FIRST_PASSES..TABLE.len(), set, &buffers, parity);
                    self.record_readback(r, &buffers, parity, tiles);
                })?,
            ])
        };
        let lists = [lists(0)?, lists(1)?];
        let apart =
            apart.map(|_| Ok([0, 1].map(|parity| self.record_apart(&sets[parity], &buffers, parity))));
        let apart = apart.transpose()?.map(|[a, b]| Ok([a?, b?])).transpose()?;
        Ok(FrameSlot {
            fence: FrameFence::new(gpu)?,
            lists,
            apart,
            was_apart: false,
            _sets: sets,
            buffers,
            tile_lists,
            panel_tiles: self.panel_tiles.clone(),
            rung: 0,
            raster: settings.raster,
            traced: self.rungs[0].raster,
            parity: 0,
            stamps: [0; PASSES.len() + 2],
            resources: resources.clone(),
        })
    }

    /// Records what comes before the passes: counters are cleared, what the host has written is copied, and where the device finds what a ray meets,
    /// it builds the tree over the bodies at the same poses.
    fn record_latch(&self, r: &mut Recorder<'_>, b: &FrameBuffers) {
        r.clear(&b.counters);
        if let Some(panel) = &b.panel {
            r.clear(&panel.counters);
            for list in 0..PANEL_LISTS {
                let to = (&panel.schedule, list * size_of::<Schedule>());
                r.copy_part((&self.resources.shared.schedule_start, 0), to, size_of::<Schedule>());
            }
            r.copy(&panel.frame.host, &panel.frame.device, panel.frame.len_bytes);
        }
        r.copy(&self.resources.shared.schedule_start, &b.schedule, size_of::<Schedule>());
        for latched in [&b.frame, &b.instances, &b.body_nodes, &b.movers] {
            r.copy(&latched.host, &latched.device, latched.len_bytes);
        }
        if let Some(deformed) = &b.deformed {
            deformed.record(r);
        }
        if let Some(textures) = &b.textures {
            r.copy(&textures.host, &textures.device, textures.len_bytes);
        }
        if let Some(tree) = &b.device_tree {
            r.build_frame_tree(tree);
        }
        r.barrier();
        r.stamp();
    }

    /// Records the first lists of frames whose rays the host walks.
    fn record_apart(&self, set: &Sets, b: &FrameBuffers, parity: usize) -> Result<ApartLists, GpuError> {
        let frame = b.apart.as_ref().expect("made with the frame");
        let (pipelines, _) = self.resources.pipelines.apart.as_ref().expect("compiled for it");
        let around = |r: &mut Recorder<'_>, what: Side| match what {
            Side::Before => {
                self.record_latch(r, b);
                self.record_passes(r, 0..TRACE, set, b, parity);
            }
            Side::After => self.record_passes(r, TRACE + 1..FIRST_PASSES, set, b, parity),
        };
        let stamps = [1 + TRACE, FIRST_PASSES - TRACE - 1].map(|n| n as u32);
        ApartLists::record(
            &self.gpu,
            (frame, pipelines, &set.traced),
            (&b.schedule, &b.counters),
            stamps,
            &around,
        )
    }

    /// Records `rows` of [`TABLE`] in their order, with a barrier after each. Of a pass that the method does not need only the time stamp is recorded.
    fn record_passes(
        &self,
        r: &mut Recorder<'_>,
        rows: Range<usize>,
        sets: &Sets,
        b: &FrameBuffers,
        parity: usize,
    ) {
        let (resources, raster) = (&self.resources, self.settings.raster);
        for (pass, pipeline) in TABLE[rows.clone()].iter().zip(&resources.pipelines.each[rows]) {
            if let Some(pipeline) = pipeline {
                let (set, arguments, schedule) = match (&sets.panel, &b.panel) {
                    (Some(set), Some(panel)) if pass.at_panel => (set, &panel.arguments, &panel.schedule),
                    _ => (&sets.traced, &b.arguments, &b.schedule),
                };
                match pass.grid {
                    Grid::Tiles => r.dispatch_indirect(pipeline, set, arguments, PER_TILE_QUARTER),
                    Grid::Rates => r.dispatch_indirect(pipeline, set, arguments, PER_TILE_RATES),
                    Grid::Work => r.dispatch_indirect(pipeline, set, schedule, 0),
                    Grid::Cells => r.dispatch_indirect(pipeline, set, arguments, PER_CELLS),
                    Grid::EvenCells => {
                        r.dispatch_indirect(pipeline, set, schedule, size_of::<Schedule>() as u64);
                    }
                    Grid::Moving => r.dispatch_indirect(pipeline, set, arguments, PER_MOVING_QUARTER),
                    Grid::Planes => r.dispatch(pipeline, set, pack::gpu::workgroups(raster)),
                }
                r.barrier();
            }
            r.stamp();
            // The history before this frame's samples.
            let prior = b.debug_host.as_ref().and_then(|d| d.prior.as_ref());
            if let (REPROJECT, Some(prior)) = (pass.name, prior) {
                r.copy(
                    &resources.shared.history[parity],
                    prior,
                    in_blocks(self.rungs[0].raster.pixel_count()) * b.each.history,
                );
                r.barrier();
            }
        }
    }

    /// Records the copies that the host reads, those for debugging included.
    fn record_readback(&self, r: &mut Recorder<'_>, b: &FrameBuffers, parity: usize, tiles: usize) {
        let (shared, pixels) = (&self.resources.shared, in_blocks(self.rungs[0].raster.pixel_count()));
        let panel_pixels = in_blocks(self.settings.raster.pixel_count());
        if let Some(planes_host) = &b.planes_host {
            r.copy(&b.planes, planes_host, b.plane_bytes);
        }
        if let Some(codes_host) = &b.codes_host {
            r.copy(&b.codes, codes_host, panel_pixels * b.each.codes);
        }
        r.copy(&b.counters, &b.counters_host, size_of::<Counters>());
        if let Some(panel) = &b.panel {
            r.copy(&panel.counters, &panel.counters_host, size_of::<Counters>());
        }
        if let Some(d) = &b.debug_host {
            let [shown, surfaces] = b.seen(&self.settings);
            r.copy(shown, &d.shown, panel_pixels * SHOWN_BYTES);
            r.copy(surfaces, &d.surfaces, panel_pixels * b.each.surfaces);
            if let Some(to) = &d.guides {
                r.copy(&b.guides, to, pixels * b.each.guides);
            }
            if let Some(to) = &d.history {
                r.copy(&shared.history[parity], to, pixels * b.each.history);
            }
            r.copy(&b.radiance, &d.traced, pixels * b.each.radiance);
            r.copy(&shared.rates, &d.rates, tiles * 4);
            r.copy(&b.schedule, &d.schedule, size_of::<Schedule>());
            r.copy(b.work(), &d.work, pixels * b.each.work);
            if let Some(to) = &d.motion {
                r.copy(&b.motion, to, panel_pixels * b.each.motion);
            }
        }
        r.barrier_to_host();
        r.stamp();
    }

    /// Writes the inputs and starts the GPU. Allocates nothing.
    ///
    /// # Errors
    /// The device is lost or was given up, or [`GpuError::InFlight`] if the slot's last frame was not waited for to its end. The next frame is
    /// drawn as if this one had not been submitted.
    ///
    /// # Panics
    /// If there are fewer poses than bodies, which is a mistake of the caller.
    pub fn submit(&mut self, slot: &mut FrameSlot, inputs: &FrameInputs<'_>) -> Result<(), GpuError> {
        assert_eq!(inputs.poses.len(), self.data.bodies.len(), "one pose per body");
        slot.fence.check_free()?;
        let has_piece = match (&mut self.live, &mut slot.buffers.piece) {
            (Some(live), Some(piece)) => live.advance(piece, &self.resources.scene.texels)?,
            _ => false,
        };
        slot.buffers.show(&self.data, self.live.as_ref(), inputs.animated_at_ns, &mut self.bodies);
        let rung = inputs.rung.min(self.rungs.len() - 1);
        let traced = self.rungs[rung].raster;
        // Where another raster was traced last, what lies in the slot's buffers is not that of these tiles.
        let is_new = std::mem::replace(&mut slot.rung, rung) != rung;
        slot.traced = traced;
        let every_tile = self.settings.camera_is_eye || self.keep.every_tile;
        let turn = self.last.turn_of(inputs.frame);
        self.find_movers(slot, inputs, every_tile, turn.drawn);
        // From here on the bodies are where this frame draws them.
        let inputs = &FrameInputs { poses: self.movers.poses(), ..*inputs };
        let panel_camera = inputs.camera;
        let traced_camera = inputs.camera.at_raster(traced);
        let on_traced = FrameInputs { camera: &traced_camera, ..*inputs };
        let inputs = if slot.panel_tiles.is_some() {
            list_tiles(&mut slot.tile_lists[rung], every_tile || is_new, &on_traced, &self.bodies);
            &on_traced
        } else {
            inputs
        };
        // A tile has four workgroups of 8 x 8 pixels, and one workgroup in the pass that decides rates, which runs in every second frame that is
        // drawn. The checkerboard uses the same count of frames, so that both of its halves are traced at one rate.
        let decides_rates = self.decides_rates && turn.drawn.is_multiple_of(2);
        // A tile that is left loses its rate, whichever slot is used. Otherwise a body that comes back to the tile would find an old rate in one
        // slot and none in another, and a run could not be repeated.
        let left = if decides_rates { &self.rated[..] } else { &[] };
        let out = bytemuck::cast_slice_mut(slot.buffers.tiles.bytes_mut());
        let tile_list = &slot.tile_lists[rung];
        let (tile_count, moving_tiles) = tile_list.write(left, out);
        let tiles_x = tile_list.tiles_x();
        let rate_tiles = if decides_rates { tile_count } else { 0 };
        let groups = [tile_count * 4, rate_tiles, moving_tiles * 4];
        slot.buffers.arguments.write(&groups.map(|groups| [groups, 1u32, 1, 0]));
        let body_nodes = self.write_bodies(&mut slot.buffers, inputs);
        let constants = self.frame_constants(inputs, &turn, &self.rungs[rung], (tile_count, tiles_x));
        self.write_constants(slot, Frame { body_nodes, ..constants }, panel_camera);
        slot.parity = 1 - self.last.parity;
        let order = self.orders.next(slot.parity);
        let samples = (inputs.budget_spp, inputs.spp, u64::from(tile_count) * 256);
        let submitted = self.submit_lists(slot, (has_piece, order), samples, body_nodes);
        // Numbers of questions are not used again, also if this has failed.
        self.next_question += Relay::QUESTIONS as u64;
        if submitted.is_err() {
            self.live.iter_mut().for_each(LiveTextures::take_back);
        }
        submitted?;
        self.orders.submitted(slot.parity, order);
        if decides_rates {
            self.rated.fill(false);
            self.rated[..slot.tile_lists[rung].len()].copy_from_slice(slot.tile_lists[rung].active());
        }
        let lost = (0..inputs.poses.len()).map(|i| is_lost(&self.tracked, i, inputs.lost));
        self.last.becomes(inputs, slot.parity, lost);
        Ok(())
    }

    /// Lists the panel's tiles, and finds the bodies that move on them, after so many frames.
    fn find_movers(&mut self, slot: &mut FrameSlot, inputs: &FrameInputs<'_>, every_tile: bool, drawn: u32) {
        let tiles = slot.panel_tiles.as_mut().unwrap_or(&mut slot.tile_lists[0]);
        list_tiles(tiles, every_tile, inputs, &self.bodies);
        self.movers.find(inputs.camera, &self.bodies, inputs.poses, inputs.sweep, drawn, tiles);
        slot.buffers.movers.host.write(self.movers.movers());
    }

    /// Writes the constants of a frame, and what the panel's pixels have of their own where fewer are traced: their tiles, and the same constants with
    /// their raster, of which no history is known.
    fn write_constants(&self, slot: &mut FrameSlot, constants: Frame, c: &ProjectorCamera) {
        let shows_all = if slot.buffers.debug_host.is_some() { gpu_structs::FRAME_SHOWS_ALL } else { 0 };
        // The pass `prepare` reads the light that is shown.
        let shows_light = if slot.buffers.panel.is_some() { gpu_structs::FRAME_SHOWS_ALL } else { shows_all };
        slot.buffers.frame.host.write(&[Frame { flags: constants.flags | shows_light, ..constants }]);
        let (Some(tiles), Some(panel)) = (&slot.panel_tiles, &mut slot.buffers.panel) else { return };
        let (tile_count, moving) = tiles.write(&[], bytemuck::cast_slice_mut(panel.tiles.bytes_mut()));
        let cells = cells_of_tiles(tile_count, slot.traced, c.raster).div_ceil(LANES);
        panel.arguments.write(&[tile_count * 4, cells, moving * 4].map(|groups| [groups, 1u32, 1, 0]));
        let mut frame = Frame {
            intrinsics: [c.fx as f32, c.fy as f32, c.cx as f32, c.cy as f32],
            width: c.raster.width(),
            height: c.raster.height(),
            tile_count,
            tiles_x: tiles.tiles_x(),
            pixel_size: (1.0 / c.fx) as f32,
            history_frame: gpu_structs::NO_FRAME,
            flags: (constants.flags | shows_all) & !gpu_structs::FRAME_STEADY,
            ..constants
        };
        self.optics.describe(c, 0, &mut frame);
        panel.frame.host.write(&[frame]);
    }

    /// Starts the lists of a slot that has all of its inputs: those between which the host walks rays if it can and all samples surely have room.
    /// `samples`: the budget, the samples of a pixel, and the pixels that are listed. `body_nodes`: as [`Self::write_bodies`] returns.
    fn submit_lists(
        &self,
        slot: &mut FrameSlot,
        (has_piece, order): (bool, FrameOrder),
        (budget_spp, spp, pixels): (f32, u32, u64),
        body_nodes: u32,
    ) -> Result<(), GpuError> {
        let [first, second] = &slot.lists[slot.parity];
        let piece = slot.buffers.piece.as_ref().filter(|_| has_piece).map(Piece::list);
        let overlap = self.resources.overlap.as_ref().map(|overlap| (overlap, order));
        let apart = (slot.buffers.apart.as_ref(), slot.apart.as_ref(), self.resources.crew.as_ref());
        slot.was_apart = false;
        let (Some(frame), Some(lists), Some(crew)) = apart else {
            return submit_frame(piece, [first, second], overlap, &mut slot.fence);
        };
        if !frame.layout.serves(&self.settings.method, budget_spp, spp, pixels) {
            return submit_frame(piece, [first, second], overlap, &mut slot.fence);
        }
        slot.was_apart = true;
        let question = self.next_question;
        let bodies = slot.buffers.instances.host.read(self.data.bodies.len() * size_of::<Instance>() / 4);
        let nodes = body_nodes as usize * 8 * size_of::<BodyNode>() / 4;
        frame.begin(question, bodies, slot.buffers.body_nodes.host.read(nodes));
        crew.hand(question, frame);
        crew.relay().submit(piece, &lists[slot.parity].0, second, question, &mut slot.fence)
    }

    /// Writes where the bodies are: for the shaders, and for whatever tree rays find them in. Returns how many nodes of the tree over bodies an octant
    /// of directions has.
    fn write_bodies(&self, buffers: &mut FrameBuffers, inputs: &FrameInputs<'_>) -> u32 {
        buffers.body_tree.clear();
        let instances = buffers.instances.host.bytes_mut().chunks_exact_mut(size_of::<Instance>());
        for (i, to) in instances.take(inputs.poses.len()).enumerate() {
            let instance = self.instance(i, inputs);
            to.copy_from_slice(bytemuck::bytes_of(&instance));
            buffers.body_tree.add(&instance);
            if let (Some(tree), Some(trees)) =
                (&mut buffers.device_tree, &self.resources.scene.geometry.trees)
            {
                tree.place(i, &instance, trees);
            }
        }
        buffers.body_tree.write(bytemuck::cast_slice_mut(buffers.body_nodes.host.bytes_mut()))
    }

    /// Changes what is kept of past frames at a range of pixels, in both buffers: for checks that something broken is forgotten. No frame
    /// may be in flight.
    ///
    /// # Errors
    /// Out of memory, device lost.
    ///
    /// # Panics
    /// When the range lies beyond the raster, but not for a method without any: then nothing happens.
    pub fn edit_history(
        &self,
        range: Range<usize>,
        mut change: impl FnMut(&mut History),
    ) -> Result<(), GpuError> {
        if !self.settings.method.needs_history() {
            return Ok(());
        }
        (self.resources.shared.history.iter()).try_for_each(|buffer| {
            let pixels = self.rungs[0].raster.pixel_count();
            fill::edit(&self.gpu, buffer, History::buffer_bytes(pixels), |bytes| {
                let mut all = History::all(bytes, pixels);
                all[range.clone()].iter_mut().for_each(&mut change);
                History::bytes_of(&all)
            })
        })
    }

    /// Body `i` of the scene for the shaders. The projector is the origin, because f32 is finest where the rays start.
    fn instance(&self, i: usize, inputs: &FrameInputs<'_>) -> Instance {
        let (body, pose) = (&self.bodies[i], &inputs.poses[i]);
        let shift = DAffine3::from_translation(-inputs.camera.position());
        let world_from_object = shift * *pose;
        let before = self.last.poses.get(i).copied().unwrap_or(*pose);
        let previous = DAffine3::from_translation(-self.last.origin) * before;
        let (lower, upper) = world_bounds(&world_from_object, body.bounds_min, body.bounds_max);
        // The bounds grow by the rounding of the transforms.
        let slack = (lower.abs().max(upper.abs()).max_element() + f64::from(body.extent)) * 1e-6;
        Instance {
            world_from_object: rows(&world_from_object),
            object_from_world: rows(&world_from_object.inverse()),
            bounds_min: (lower - slack).as_vec3().into(),
            node_offset: body.node_offset,
            bounds_max: (upper + slack).as_vec3().into(),
            triangle_offset: body.triangle_offset,
            previous_world_from_object: rows(if self.last.frame == gpu_structs::NO_FRAME {
                &world_from_object
            } else {
                &previous
            }),
            // A lost body still casts virtual shadows at its last place, but no light falls on it.
            flags: if is_lost(&self.tracked, i, inputs.lost) {
                body.flags & !gpu_structs::INSTANCE_PROJECTED
            } else {
                body.flags
            },
            body: i as u32,
            extent: body.extent,
            mover: self.movers.number_of(i),
            drive_gain: self.settings.drive.gain_of(i).map(|gain| gain * inputs.brighter),
            albedo_map: self.optics.albedo_map_at(i),
        }
    }

    /// The constants of a frame that lists `tile_count` tiles, in rows of `tiles_x`.
    fn frame_constants(
        &self,
        inputs: &FrameInputs<'_>,
        turn: &Turn,
        Rung { raster, optics: (first_optics, optics), .. }: &Rung,
        (tile_count, tiles_x): (u32, u32),
    ) -> Frame {
        let origin = inputs.camera.position();
        let method = &self.settings.method;
        let c = inputs.camera;
        // What deforms moves by more than its pose tells.
        let steady = !self.keep.every_pixel
            && self.data.deforming.is_empty()
            && self.last.is_steady(&self.data.bodies, inputs, |i| is_lost(&self.tracked, i, inputs.lost));
        let mut frame = Frame {
            projector_position: [0.0; 3],
            seed: self.settings.seed,
            world_from_projector: rows(&DAffine3::from_mat3(c.world_from_projector.matrix3)),
            intrinsics: [c.fx as f32, c.fy as f32, c.cx as f32, c.cy as f32],
            eye_position: (inputs.eye - origin).as_vec3().into(),
            frame: inputs.frame,
            gaze_point: (inputs.gaze - origin).as_vec3().into(),
            instance_count: self.data.bodies.len() as u32,
            width: raster.width(),
            height: raster.height(),
            spp: inputs.spp.min(method.most_spp()),
            depth: self.settings.depth,
            tile_count,
            tiles_x,
            clamp_indirect: self.settings.clamp_indirect.unwrap_or(f32::MAX),
            ambient: self.settings.drive.ambient,
            light_count: self.data.lights.len() as u32,
            mean_light: self.data.mean_light,
            flags: method.flags()
                | if self.settings.camera_is_eye { gpu_structs::FRAME_CAMERA_IS_EYE } else { 0 }
                | if steady { gpu_structs::FRAME_STEADY } else { 0 },
            environment: self.data.environment_constant.into(),
            environment_width: self.data.environment_size[0],
            environment_height: self.data.environment_size[1],
            environment_rotation: self.data.environment_rotation,
            // The directions of BSDF sampling find a uniform sky equally well, so it needs no light samples.
            environment_select: if method.dpm && self.data.environment_size == [0, 0] {
                0.0
            } else {
                self.data.environment_select
            },
            world_origin: origin.as_vec3().into(),
            history_frame: self.last.frame_on(c.raster),
            budget_spp: inputs.budget_spp.min(method.most_spp() as f32),
            history_cap: method.history_cap,
            zone_spp: method.paper.zone_spp,
            zone_alpha: method.paper.temporal_alpha.map(|a| a as f32),
            zone_degrees: [method.paper.phi_h_deg, method.paper.phi_q_deg]
                .map(|angle| angle as f32 + inputs.widen_deg),
            filter_degrees: [method.paper.filter_from_deg, method.paper.filter_to_deg]
                .map(|angle| angle as f32 + inputs.widen_deg),
            rate_t: method.paper.t as f32,
            rate_l: method.paper.l as f32,
            pixel_size: (1.0 / c.fx) as f32,
            drawn: turn.drawn,
            first_sample: turn.first_sample,
            mover_count: self.movers.movers().len() as u32,
            group_count: self.settings.plane_groups.len() as u32,
            ..Frame::zeroed()
        };
        optics.describe(c, *first_optics, &mut frame);
        frame
    }
}
