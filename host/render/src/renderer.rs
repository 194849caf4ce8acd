//! One frame on the GPU: surfaces, radiance, code values. `Renderer::create_slot` records the passes in their order.

use super::last_frame::LastFrame;
use super::memory::{BytesPerPixel, RasterTooLarge, SharedBuffers};
use super::method::Method;
use super::scene_data::{world_bounds, Keep, SceneData, SceneDataError};
use super::scene_gpu::{table_buffer, SceneGpu};
use super::slot::{DebugBuffers, FrameSlot, PASSES};
use super::tiles::TileList;
use crate::gpu::{
    BindingKind, BindingSet, BindingTable, Buffer, CommandList, ComputePipeline, FrameFence, Gpu, GpuError,
    MemoryKind, Recorder,
};
use crate::pack;
use bytemuck::Zeroable;
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::Scene;
use dpm_shaders::structs::{self as gpu_structs, Counters, Frame, Guide, Instance, Rows, Schedule, Surface};
use dpm_shaders::TableShader;
use glam::{DAffine3, DVec3, Vec3};
use std::sync::Arc;

/// What does not change while a renderer lives.
#[derive(Clone, Debug)]
pub struct RendererSettings {
    /// Raster traced.
    pub raster: Raster,
    /// Closest-hit rays of a path, primary included.
    pub depth: u32,
    /// Seed of the run.
    pub seed: u32,
    /// Limit on indirect contributions; `None`: off.
    pub clamp_indirect: Option<f32>,
    /// `pi * exposure / (albedo * max_intensity)`.
    pub drive_gain: f32,
    /// Radiance that the real surfaces show by themselves.
    pub ambient: [f32; 3],
    /// Ordinary camera (tests): radiance goes back along the primary ray and everything is lit.
    pub camera_is_eye: bool,
    /// Compile in what the scene does not need (tests).
    pub leave_nothing_out: bool,
    /// How rays are spent.
    pub method: Method,
    /// What comes back.
    pub output: Output,
}

/// What a frame brings to the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Output {
    /// Code values, to be packed there.
    Codes,
    /// Bit planes, packed by the GPU.
    Planes(PlaneSchedule),
    /// Both: planes to be sent, code values to check the light against.
    Both(PlaneSchedule),
}

impl Output {
    /// The planes that the GPU packs.
    pub(crate) fn schedule(&self) -> Option<&PlaneSchedule> {
        match self {
            Self::Codes => None,
            Self::Planes(schedule) | Self::Both(schedule) => Some(schedule),
        }
    }
}

/// What changes from frame to frame. Small: it is written just before the GPU starts.
#[derive(Clone, Copy, Debug)]
pub struct FrameInputs<'a> {
    /// Number of the frame.
    pub frame: u32,
    /// Samples per traced pixel where neither angle nor budget decides.
    pub spp: u32,
    /// Samples per lit pixel on average (method dpm).
    pub budget_spp: f32,
    /// Projector.
    pub camera: &'a ProjectorCamera,
    /// Eye, world.
    pub eye: DVec3,
    /// Gaze point, world.
    pub gaze: DVec3,
    /// Degrees by which all zones about the gaze grow: 0 while it is known.
    pub widen_deg: f32,
    /// world-from-body of every body of the scene, at the time of light.
    pub poses: &'a [DAffine3],
    /// Per tracked body: lost, no light falls on it. Bodies beyond the end are not lost.
    pub lost: &'a [bool],
}

/// Why a renderer cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The GPU's word.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// The scene's.
    #[error(transparent)]
    Scene(#[from] SceneDataError),
    /// The raster's.
    #[error(transparent)]
    Raster(#[from] RasterTooLarge),
}

/// Byte offsets in the dispatch arguments: four workgroups a tile, and one a tile in frames that decide rates.
const PER_TILE_QUARTER: u64 = 0;
const PER_TILE_RATES: u64 = 16;

/// Draws frames of one scene. Owns what it needs: a thread may keep it, and may be left alone with it when the GPU hangs.
pub struct Renderer {
    pub(super) resources: Arc<Resources>,
    data: Arc<SceneData>,
    pub(super) settings: RendererSettings,
    keep: Keep,
    /// Per body of the scene: which tracked body carries it.
    tracked: Vec<Option<u16>>,
    /// What the history holds: the last frame submitted and its poses.
    last: LastFrame,
    /// The tiles that were active when shading rates were decided last. All others have the full rate.
    rated: Vec<bool>,
    pub(super) gpu: Arc<Gpu>,
}

/// What a renderer is made from, without a device: to be kept beside one, so that it can be made anew on another device without the scene
/// being looked at again. Cheap to clone.
#[derive(Clone)]
pub struct RendererPlan {
    data: Arc<SceneData>,
    settings: RendererSettings,
    keep: Keep,
    tracked: Vec<Option<u16>>,
}

/// What submissions read, held by the renderer and by every slot: it goes when the last submission is over, in whatever order they are
/// dropped.
pub(super) struct Resources {
    // Dropped before the buffers they use.
    pipelines: Pipelines,
    table: Arc<BindingTable>,
    pub(super) shared: SharedBuffers,
    scene: SceneGpu,
}

/// One pipeline a pass; `None`: the method does not need it and it is not recorded.
struct Pipelines {
    primary: ComputePipeline,
    reproject: Option<ComputePipeline>,
    rate_map: Option<ComputePipeline>,
    schedule: ComputePipeline,
    trace: ComputePipeline,
    accumulate: Option<ComputePipeline>,
    spatial: Option<ComputePipeline>,
    compensate: ComputePipeline,
    pack: Option<ComputePipeline>,
}

/// `tracked`: per body of the scene, which tracked body carries it.
fn is_lost(tracked: &[Option<u16>], body: usize, lost: &[bool]) -> bool {
    tracked[body].is_some_and(|t| lost.get(usize::from(t)).copied().unwrap_or(false))
}

fn rows(m: &DAffine3) -> Rows {
    let r = m.matrix3.transpose();
    let t = m.translation;
    [
        [r.x_axis.x as f32, r.x_axis.y as f32, r.x_axis.z as f32, t.x as f32],
        [r.y_axis.x as f32, r.y_axis.y as f32, r.y_axis.z as f32, t.y as f32],
        [r.z_axis.x as f32, r.z_axis.y as f32, r.z_axis.z as f32, t.z as f32],
    ]
}

impl Renderer {
    /// Uploads the scene and compiles the passes it needs.
    ///
    /// # Errors
    /// The scene is too large, or the GPU's own.
    pub fn new(gpu: &Arc<Gpu>, scene: &Scene, settings: RendererSettings) -> Result<Self, RenderError> {
        Self::keeping(gpu, scene, settings, Keep::default())
    }

    /// The same with `keep` in whether the rig needs it or not: for measuring what leaving it out saves.
    ///
    /// # Errors
    /// As [`Renderer::new`].
    pub fn keeping(
        gpu: &Arc<Gpu>,
        scene: &Scene,
        settings: RendererSettings,
        keep: Keep,
    ) -> Result<Self, RenderError> {
        let data = Arc::new(SceneData::build(scene)?);
        let tracked = scene.bodies.iter().map(|b| b.tracked).collect();
        Self::from_plan(gpu, &RendererPlan { data, settings, keep, tracked })
    }

    /// What this renderer was made from.
    pub fn plan(&self) -> RendererPlan {
        RendererPlan {
            data: self.data.clone(),
            settings: self.settings.clone(),
            keep: self.keep,
            tracked: self.tracked.clone(),
        }
    }

    /// The same renderer on this device, as it was before its first frame.
    ///
    /// # Errors
    /// The raster or the scene is too large for this device, or the GPU's own.
    pub fn from_plan(gpu: &Arc<Gpu>, plan: &RendererPlan) -> Result<Self, RenderError> {
        let RendererPlan { data, settings, keep, tracked } = plan.clone();
        let shared = SharedBuffers::new(gpu, &settings)?;
        let texel = gpu.summary().software && !keep.storage_tables;
        let scene_gpu = SceneGpu::new(gpu, &data, texel)?;
        let mut needs = data.needs.with(keep.needs);
        needs.clamp |= settings.clamp_indirect.is_some();
        if settings.leave_nothing_out {
            needs = needs.everything();
        }
        use BindingKind::{Storage, Texel};
        // Second bindings of one buffer, as texels, are for shaders that read tables so: devices bind a limited number.
        let kinds: Vec<_> = gpu_structs::BINDINGS
            .iter()
            .filter(|(name, _)| texel || !name.ends_with("_ROWS"))
            .map(|&(name, binding)| {
                let rows = texel && gpu_structs::TEXEL_BINDINGS.contains(&name);
                (binding, if rows { Texel } else { Storage })
            })
            .collect();
        let table = BindingTable::new(gpu, &kinds)?;
        let method = &settings.method;
        let mut constants = needs.constants().to_vec();
        constants.extend([
            (10, method.sampler as u32),
            (11, u32::from(method.needs_guides())),
            (12, u32::from(method.dpm)),
            (13, u32::from(method.spatial)),
        ]);
        let pipeline = |shader: TableShader| ComputePipeline::new(&table, shader.reading(texel), &constants);
        let only = |wanted: bool, shader| wanted.then(|| pipeline(shader)).transpose();
        let pipelines = Pipelines {
            primary: pipeline(dpm_shaders::PRIMARY)?,
            reproject: only(method.needs_history(), dpm_shaders::REPROJECT)?,
            rate_map: only(
                method.needs_rates() || keep.rate_map && method.needs_history(),
                dpm_shaders::RATE_MAP,
            )?,
            schedule: pipeline(dpm_shaders::SCHEDULE)?,
            trace: pipeline(dpm_shaders::TRACE)?,
            accumulate: only(method.needs_history(), dpm_shaders::ACCUMULATE)?,
            spatial: only(method.needs_spatial(), dpm_shaders::SPATIAL)?,
            compensate: pipeline(dpm_shaders::COMPENSATE)?,
            pack: (settings.output.schedule())
                .map(|schedule| {
                    let constants = pack::gpu::constants(settings.raster, schedule);
                    ComputePipeline::new(&table, dpm_shaders::PACK, &constants)
                })
                .transpose()?,
        };
        let last = LastFrame::none(tracked.len());
        let rated = vec![false; TileList::new(settings.raster.width(), settings.raster.height()).len()];
        Ok(Self {
            resources: Arc::new(Resources { pipelines, table, shared, scene: scene_gpu }),
            data,
            settings,
            keep,
            tracked,
            last,
            rated,
            gpu: gpu.clone(),
        })
    }

    /// Interpolated normal of a surface in its body's space, without the normal map.
    pub fn shading_normal(&self, surface: &Surface) -> Vec3 {
        let body = &self.data.bodies[(surface.id >> 24) as usize];
        let reference = &self.data.refs[(body.triangle_offset + (surface.id & 0x00ff_ffff)) as usize];
        let [u, v] = surface.barycentric;
        let n = reference.vertices.map(|i| Vec3::from_array(self.data.vertices[i as usize].normal));
        (n[0] * (1.0 - u - v) + n[1] * u + n[2] * v).normalize_or_zero()
    }

    /// Memory and commands for one frame in flight. `debug` also brings radiance and surfaces to the host.
    ///
    /// # Errors
    /// Out of memory.
    pub fn create_slot(&self, debug: bool) -> Result<FrameSlot, GpuError> {
        let gpu = &self.gpu;
        let raster = self.settings.raster;
        let pixels = raster.pixel_count();
        let size = |what, bytes, kind| Buffer::new(gpu, what, bytes, kind);
        use MemoryKind::{Device, Readback, Upload};
        let tile_list = TileList::new(raster.width(), raster.height());
        let frame = size("frame uniforms", size_of::<Frame>(), Upload)?;
        let table = |what, bytes, kind| table_buffer(gpu, what, bytes, kind);
        let instances = table("instances", size_of::<Instance>() * self.data.bodies.len().max(1), Upload)?;
        let arguments = size("dispatch arguments", 32, Upload)?;
        let tiles = size("tile list", tile_list.len() * 4, Upload)?;
        let counters = size("counters", size_of::<Counters>(), Device)?;
        let counters_host = size("counters", size_of::<Counters>(), Readback)?;
        let each = BytesPerPixel::of(&self.settings.method);
        let surfaces = table("surfaces", pixels * each.surfaces, Device)?;
        let radiance = size("radiance", pixels * each.radiance, Device)?;
        let codes = size("code values", pixels * each.codes, Device)?;
        let schedule_packed = self.settings.output.schedule();
        let codes_host = match self.settings.output {
            Output::Planes(_) => None,
            Output::Codes | Output::Both(_) => Some(size("code values", pixels * each.codes, Readback)?),
        };
        let plane_bytes = schedule_packed.map_or(4, |schedule| pack::gpu::len_bytes(raster, schedule));
        let planes = size("bit planes", plane_bytes, Device)?;
        let planes_host = schedule_packed.map(|_| size("bit planes", plane_bytes, Readback)).transpose()?;
        let method = &self.settings.method;
        // What the method does without is bound all the same, but as small as can be.
        let with = |what, each: usize| table(what, (pixels * each).max(16), Device);
        let guides = with("guides", each.guides)?;
        let schedule = size("schedule", size_of::<Schedule>(), Device)?;
        let work = size("work list", pixels * each.work, Device)?;
        let filtered = with("filtered radiance", each.filtered)?;
        let filtered_shown = with("shown radiance", each.shown)?;
        let kept = |what, each: usize| (each > 0).then(|| size(what, pixels * each, Readback)).transpose();
        let debug_host = if debug {
            Some(DebugBuffers {
                shown: size("shown radiance", pixels * 16, Readback)?,
                surfaces: size("surfaces", pixels * each.surfaces, Readback)?,
                guides: kept("guides", each.guides)?,
                history: kept("history", each.history)?,
                prior: kept("prior history", each.history)?,
                traced: size("radiance", pixels * each.radiance, Readback)?,
                rates: size("shading rates", tile_list.len() * 4, Readback)?,
            })
        } else {
            None
        };
        // The last pass that ran before compensation is what is shown.
        let shown = if method.needs_spatial() {
            &filtered_shown
        } else if method.needs_history() {
            &filtered
        } else {
            &radiance
        };
        let resources = &self.resources;
        let s = &resources.scene;
        let buffer_of = |name: &str, parity: usize| match name {
            "B_FRAME" => &frame,
            "B_INSTANCES" => &instances,
            "B_NODES" => &s.nodes,
            "B_TRIANGLES" => &s.triangles,
            "B_TRIANGLE_REFS" => &s.refs,
            "B_VERTICES" => &s.vertices,
            "B_MATERIALS" => &s.materials,
            "B_TEXTURES" => &s.textures,
            "B_TEXELS" => &s.texels,
            "B_LIGHTS" => &s.lights,
            "B_ENVIRONMENT" => &s.environment,
            "B_ALBEDO" => &s.albedo,
            "B_TILES" => &tiles,
            "B_SURFACES" | "B_SURFACE_ROWS" => &surfaces,
            "B_RADIANCE" => &radiance,
            "B_CODES" => &codes,
            "B_COUNTERS" => &counters,
            "B_GUIDES" | "B_GUIDE_ROWS" => &guides,
            "B_HISTORY" | "B_HISTORY_ROWS" => &resources.shared.history[parity],
            "B_FORMER" => &resources.shared.history[1 - parity],
            "B_RATES" => &resources.shared.rates,
            "B_RATE_TABLE" => &resources.shared.rate_table,
            "B_SCHEDULE" => &schedule,
            "B_WORK" => &work,
            "B_NOISE" => &resources.shared.noise,
            "B_FILTERED" | "B_FILTERED_ROWS" => &filtered,
            "B_SHOWN" => shown,
            "B_PLANES" => &planes,
            other => unreachable!("binding {other} has no buffer"),
        };
        let set_of = |parity| {
            let bindings: Vec<_> =
                gpu_structs::BINDINGS.iter().map(|&(n, b)| (b, buffer_of(n, parity))).collect();
            BindingSet::new(&resources.table, &bindings)
        };
        let sets = [set_of(0)?, set_of(1)?];
        // Tiles that are never traced must read as nothing hit and black from the start.
        let nothing = Surface { id: gpu_structs::NO_HIT, ..Surface::zeroed() };
        super::fill::fill(gpu, &surfaces, &nothing, pixels)?;
        super::fill::fill(gpu, &codes, &0u32, pixels)?;
        super::fill::fill(gpu, &radiance, &[0f32; 4], pixels)?;
        if each.guides > 0 {
            super::fill::fill(gpu, &guides, &Guide::zeroed(), pixels)?;
        }
        super::fill::fill(gpu, shown, &[0f32; 4], pixels)?;
        let p = &resources.pipelines;
        let record = |parity: usize, r: &mut Recorder<'_>| {
            let (set, history) = (&sets[parity], &resources.shared.history[parity]);
            // The frame, in order. A pass that the method does not need is not recorded; its stamp is.
            let tiled = |r: &mut Recorder<'_>, pass: Option<&ComputePipeline>, offset: u64| {
                if let Some(pass) = pass {
                    r.dispatch_indirect(pass, set, &arguments, offset);
                    r.barrier();
                }
                r.stamp();
            };
            r.clear(&counters);
            r.copy(&resources.shared.schedule_start, &schedule, size_of::<Schedule>());
            r.barrier();
            r.stamp();
            tiled(r, Some(&p.primary), PER_TILE_QUARTER);
            tiled(r, p.reproject.as_ref(), PER_TILE_QUARTER);
            if let Some(prior) = debug_host.as_ref().and_then(|d| d.prior.as_ref()) {
                r.copy(history, prior, pixels * each.history);
                r.barrier();
            }
            tiled(r, p.rate_map.as_ref(), PER_TILE_RATES);
            tiled(r, Some(&p.schedule), PER_TILE_QUARTER);
            r.dispatch_indirect(&p.trace, set, &schedule, 0);
            r.barrier();
            r.stamp();
            tiled(r, p.accumulate.as_ref(), PER_TILE_QUARTER);
            tiled(r, p.spatial.as_ref(), PER_TILE_QUARTER);
            tiled(r, Some(&p.compensate), PER_TILE_QUARTER);
            if let Some(pass) = &p.pack {
                r.dispatch(pass, set, pack::gpu::workgroups(raster));
                r.barrier();
            }
            r.stamp();
            if let Some(planes_host) = &planes_host {
                r.copy(&planes, planes_host, plane_bytes);
            }
            if let Some(codes_host) = &codes_host {
                r.copy(&codes, codes_host, pixels * each.codes);
            }
            r.copy(&counters, &counters_host, size_of::<Counters>());
            if let Some(d) = &debug_host {
                r.copy(shown, &d.shown, pixels * 16);
                r.copy(&surfaces, &d.surfaces, pixels * each.surfaces);
                if let Some(to) = &d.guides {
                    r.copy(&guides, to, pixels * each.guides);
                }
                if let Some(to) = &d.history {
                    r.copy(history, to, pixels * each.history);
                }
                r.copy(&radiance, &d.traced, pixels * each.radiance);
                r.copy(&resources.shared.rates, &d.rates, tile_list.len() * 4);
            }
            r.barrier_to_host();
            r.stamp();
        };
        let list = |parity| CommandList::record(gpu, PASSES.len() as u32 + 1, |r| record(parity, r));
        let lists = [list(0)?, list(1)?];
        Ok(FrameSlot {
            fence: FrameFence::new(gpu)?,
            lists,
            _sets: sets,
            frame,
            instances,
            arguments,
            tiles,
            counters_host,
            codes_host,
            planes_host,
            plane_bytes,
            _device_only: vec![
                counters,
                surfaces,
                radiance,
                codes,
                planes,
                guides,
                schedule,
                work,
                filtered,
                filtered_shown,
            ],
            debug_host,
            tile_list,
            raster,
            parity: 0,
            stamps: [0; PASSES.len() + 1],
            _resources: resources.clone(),
        })
    }

    /// Writes the inputs and starts the GPU. Allocates nothing.
    ///
    /// # Errors
    /// Device lost or given up, [`GpuError::InFlight`] when the slot's last frame was not waited for to its end. The next frame begins as if
    /// this one had not been.
    ///
    /// # Panics
    /// When there are fewer poses than bodies: a programmer's mistake.
    pub fn submit(&mut self, slot: &mut FrameSlot, inputs: &FrameInputs<'_>) -> Result<(), GpuError> {
        assert_eq!(inputs.poses.len(), self.data.bodies.len(), "one pose per body");
        slot.fence.check_free()?;
        if self.settings.camera_is_eye || self.keep.every_tile {
            slot.tile_list.fill();
        } else {
            slot.tile_list.update(
                inputs.camera,
                &self.data.bodies,
                inputs.poses,
                gpu_structs::INSTANCE_PROJECTED,
            );
        }
        let turn = self.last.turn_of(inputs.frame);
        // Four 8 x 8 workgroups a tile; rates are decided in every second frame drawn, one workgroup a tile. The checkerboard goes by the
        // same count, so that both of its halves are traced at one rate.
        let decides_rates = self.resources.pipelines.rate_map.is_some() && turn.drawn.is_multiple_of(2);
        // A tile that is left loses its rate, whichever slot's turn it is: a body that comes back to it would else find a rate of long ago in one
        // slot and none in another, and a run would not repeat.
        let left = if decides_rates { &self.rated[..] } else { &[] };
        let tile_count = slot.tile_list.write(left, bytemuck::cast_slice_mut(slot.tiles.bytes_mut()));
        let rate_tiles = if decides_rates { tile_count } else { 0 };
        slot.arguments.write(&[[tile_count * 4, 1u32, 1, 0], [rate_tiles, 1, 1, 0]]);
        // The projector is the origin: f32 is finest where the rays start.
        let origin = inputs.camera.position();
        let shift = DAffine3::from_translation(-origin);
        for (i, (body, pose)) in self.data.bodies.iter().zip(inputs.poses).enumerate() {
            let world_from_object = shift * *pose;
            let before = self.last.poses.get(i).copied().unwrap_or(*pose);
            let previous = DAffine3::from_translation(-self.last.origin) * before;
            let (lower, upper) = world_bounds(&world_from_object, body.bounds_min, body.bounds_max);
            // Bounds grow by the rounding of the transforms.
            let slack = (lower.abs().max(upper.abs()).max_element() + f64::from(body.extent)) * 1e-6;
            let instance = Instance {
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
                // What is lost still casts virtual shadows where it was last, but gets no light.
                flags: if is_lost(&self.tracked, i, inputs.lost) {
                    body.flags & !gpu_structs::INSTANCE_PROJECTED
                } else {
                    body.flags
                },
                body: i as u32,
                extent: body.extent,
                reserved: 0,
            };
            let at = i * size_of::<Instance>();
            slot.instances.bytes_mut()[at..at + size_of::<Instance>()]
                .copy_from_slice(bytemuck::bytes_of(&instance));
        }
        let raster = self.settings.raster;
        let method = &self.settings.method;
        let c = inputs.camera;
        let steady = !self.keep.every_pixel
            && self.last.is_steady(&self.data.bodies, inputs, |i| is_lost(&self.tracked, i, inputs.lost));
        let frame = Frame {
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
            spp: inputs.spp,
            depth: self.settings.depth,
            tile_count,
            tiles_x: slot.tile_list.tiles_x(),
            clamp_indirect: self.settings.clamp_indirect.unwrap_or(f32::MAX),
            drive_gain: self.settings.drive_gain,
            ambient: self.settings.ambient,
            light_count: self.data.lights.len() as u32,
            flags: method.flags()
                | if self.settings.camera_is_eye { gpu_structs::FRAME_CAMERA_IS_EYE } else { 0 }
                | if steady { gpu_structs::FRAME_STEADY } else { 0 },
            environment: self.data.environment_constant.into(),
            environment_width: self.data.environment_size[0],
            environment_height: self.data.environment_size[1],
            environment_rotation: self.data.environment_rotation,
            // An even sky is found as well by the directions that the surface's own reflection chooses: a ray to it tells nothing new.
            environment_select: if method.dpm && self.data.environment_size == [0, 0] {
                0.0
            } else {
                self.data.environment_select
            },
            world_origin: origin.as_vec3().into(),
            history_frame: self.last.frame,
            budget_spp: inputs.budget_spp,
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
        };
        slot.frame.write(&[frame]);
        slot.parity = 1 - self.last.parity;
        slot.lists[slot.parity].submit(&mut slot.fence)?;
        if decides_rates {
            self.rated.copy_from_slice(slot.tile_list.active());
        }
        let lost = (0..inputs.poses.len()).map(|i| is_lost(&self.tracked, i, inputs.lost));
        self.last.becomes(inputs, slot.parity, lost);
        Ok(())
    }
}
