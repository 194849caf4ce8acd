//! One frame on the GPU: surfaces, radiance, code values. Reads top to bottom in `Renderer::record`.

use super::scene_data::{world_bounds, SceneData, SceneDataError, SceneNeeds};
use super::scene_gpu::SceneGpu;
use super::tiles::TileList;
use crate::geometry::projector::ProjectorCamera;
use crate::gpu::{
    BindingKind, BindingSet, BindingTable, Buffer, CommandList, ComputePipeline, FrameFence, Gpu, GpuError,
    MemoryKind,
};
use crate::scene::Scene;
use bytemuck::Zeroable;
use dpm_device::planes::Raster;
use dpm_shaders::structs::{self as gpu_structs, Counters, Frame, Instance, Rows, Surface};
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
}

/// What changes from frame to frame. Small: it is written just before the GPU starts.
#[derive(Clone, Copy, Debug)]
pub struct FrameInputs<'a> {
    /// Number of the frame.
    pub frame: u32,
    /// Samples per pixel.
    pub spp: u32,
    /// Projector.
    pub camera: &'a ProjectorCamera,
    /// Eye, world.
    pub eye: DVec3,
    /// Gaze point, world.
    pub gaze: DVec3,
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
}

/// Names of the passes whose ends are stamped, in order.
pub const PASSES: &[&str] = &["primary", "trace", "compensate", "readback"];

/// What a frame cost.
#[derive(Clone, Copy, Debug, Default)]
pub struct FrameCost {
    /// Rays, samples and mishaps.
    pub counters: [u32; 8],
    /// GPU time of each pass of [`PASSES`], nanoseconds; 0 where the device has no time stamps.
    pub pass_ns: [u64; PASSES.len()],
}

impl FrameCost {
    /// The counters by name.
    pub fn counters(&self) -> Counters {
        bytemuck::cast(self.counters)
    }
}

/// The memory of one frame in flight. Moves between threads: the render thread fills and submits it, the pack thread waits and reads.
pub struct FrameSlot {
    // Dropped first: it waits until the GPU no longer uses the rest.
    fence: FrameFence,
    list: CommandList,
    _set: BindingSet,
    frame: Buffer,
    instances: Buffer,
    arguments: Buffer,
    tiles: Buffer,
    counters_host: Buffer,
    codes_host: Buffer,
    _device_only: [Buffer; 4],
    debug_host: Option<[Buffer; 2]>,
    tile_list: TileList,
    raster: Raster,
    stamps: [u64; PASSES.len() + 1],
}

impl FrameSlot {
    /// Waits at most `timeout_ns` for the frame, then tells what it cost. Allocates nothing.
    ///
    /// # Errors
    /// Timeout (still running) or device lost.
    pub fn wait(&mut self, timeout_ns: u64) -> Result<FrameCost, GpuError> {
        self.fence.wait(timeout_ns)?;
        let mut cost = FrameCost {
            counters: bytemuck::cast(self.counters_host.read::<Counters>(1)[0]),
            ..FrameCost::default()
        };
        let n = self.list.stamps_ns(&mut self.stamps);
        if n == self.stamps.len() {
            for (i, pass) in cost.pass_ns.iter_mut().enumerate() {
                *pass = self.stamps[i + 1].saturating_sub(self.stamps[i]);
            }
        }
        Ok(cost)
    }

    /// Code values 0x00BBGGRR, row by row. Valid after [`FrameSlot::wait`].
    pub fn codes(&self) -> &[u32] {
        self.codes_host.read(self.raster.pixel_count())
    }

    /// Mean radiance and sample count of every pixel; only with `debug` at creation.
    pub fn radiance(&self) -> Option<&[[f32; 4]]> {
        self.debug_host.as_ref().map(|d| d[0].read(self.raster.pixel_count()))
    }

    /// What each pixel's ray met; only with `debug` at creation.
    pub fn surfaces(&self) -> Option<&[Surface]> {
        self.debug_host.as_ref().map(|d| d[1].read(self.raster.pixel_count()))
    }
}

/// Draws frames of one scene.
pub struct Renderer {
    // Dropped before the buffers they use.
    primary: ComputePipeline,
    trace: ComputePipeline,
    compensate: ComputePipeline,
    table: Arc<BindingTable>,
    scene: SceneGpu,
    data: SceneData,
    settings: RendererSettings,
    needs: SceneNeeds,
    /// Per body of the scene: which tracked body carries it.
    tracked: Vec<Option<u16>>,
    gpu: Arc<Gpu>,
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
        let data = SceneData::build(scene)?;
        let texel = gpu.summary().software;
        let scene_gpu = SceneGpu::new(gpu, &data, texel)?;
        let mut needs = data.needs;
        needs.clamp = settings.clamp_indirect.is_some();
        if settings.leave_nothing_out {
            needs = needs.everything();
        }
        use BindingKind::{Storage, Texel, Uniform};
        let bvh = if texel { Texel } else { Storage };
        let kinds: Vec<_> = gpu_structs::BINDINGS
            .iter()
            .map(|&(name, binding)| {
                let kind = match name {
                    "B_FRAME" => Uniform,
                    "B_NODES" | "B_TRIANGLES" => bvh,
                    _ => Storage,
                };
                (binding, kind)
            })
            .collect();
        let table = BindingTable::new(gpu, &kinds)?;
        let constants = needs.constants();
        let pick = |t, s| if texel { t } else { s };
        let primary = ComputePipeline::new(
            &table,
            pick(dpm_shaders::PRIMARY_TEXEL, dpm_shaders::PRIMARY_STORAGE),
            &constants,
        )?;
        let trace = ComputePipeline::new(
            &table,
            pick(dpm_shaders::TRACE_TEXEL, dpm_shaders::TRACE_STORAGE),
            &constants,
        )?;
        let compensate = ComputePipeline::new(&table, dpm_shaders::COMPENSATE, &constants)?;
        let tracked = scene.bodies.iter().map(|b| b.tracked).collect();
        Ok(Self {
            primary,
            trace,
            compensate,
            table,
            scene: scene_gpu,
            data,
            settings,
            needs,
            tracked,
            gpu: gpu.clone(),
        })
    }

    fn is_lost(&self, body: usize, lost: &[bool]) -> bool {
        self.tracked[body].is_some_and(|t| lost.get(usize::from(t)).copied().unwrap_or(false))
    }

    /// What the scene needs of the tracer.
    pub fn needs(&self) -> SceneNeeds {
        self.needs
    }

    /// Bodies of the scene, in order.
    pub fn body_count(&self) -> usize {
        self.data.bodies.len()
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
        let instances = size("instances", size_of::<Instance>() * self.data.bodies.len().max(1), Upload)?;
        let arguments = size("dispatch arguments", 16, Upload)?;
        let tiles = size("tile list", tile_list.len() * 4, Upload)?;
        let counters = size("counters", size_of::<Counters>(), Device)?;
        let counters_host = size("counters", size_of::<Counters>(), Readback)?;
        let surfaces = size("surfaces", pixels * size_of::<Surface>(), Device)?;
        let radiance = size("radiance", pixels * 16, Device)?;
        let codes = size("code values", pixels * 4, Device)?;
        let codes_host = size("code values", pixels * 4, Readback)?;
        let debug_host = if debug {
            Some([
                size("radiance", pixels * 16, Readback)?,
                size("surfaces", pixels * size_of::<Surface>(), Readback)?,
            ])
        } else {
            None
        };
        let s = &self.scene;
        let buffer_of = |name: &str| match name {
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
            "B_SURFACES" => &surfaces,
            "B_RADIANCE" => &radiance,
            "B_CODES" => &codes,
            "B_COUNTERS" => &counters,
            other => unreachable!("binding {other} has no buffer"),
        };
        let bindings: Vec<_> = gpu_structs::BINDINGS.iter().map(|&(n, b)| (b, buffer_of(n))).collect();
        let set = BindingSet::new(&self.table, &bindings)?;
        // Tiles that are never traced must read as nothing hit and black from the start.
        let nothing = Surface { id: gpu_structs::NO_HIT, ..Surface::zeroed() };
        super::fill::fill(gpu, &surfaces, &nothing, pixels)?;
        super::fill::fill(gpu, &codes, &0u32, pixels)?;
        super::fill::fill(gpu, &radiance, &[0f32; 4], pixels)?;
        let list = CommandList::record(gpu, PASSES.len() as u32 + 1, |r| {
            r.clear(&counters);
            r.barrier();
            r.stamp();
            r.dispatch_indirect(&self.primary, &set, &arguments, 0);
            r.barrier();
            r.stamp();
            r.dispatch_indirect(&self.trace, &set, &arguments, 0);
            r.barrier();
            r.stamp();
            r.dispatch_indirect(&self.compensate, &set, &arguments, 0);
            r.barrier();
            r.stamp();
            r.copy(&codes, &codes_host, pixels * 4);
            r.copy(&counters, &counters_host, size_of::<Counters>());
            if let Some([radiance_host, surfaces_host]) = &debug_host {
                r.copy(&radiance, radiance_host, pixels * 16);
                r.copy(&surfaces, surfaces_host, pixels * size_of::<Surface>());
            }
            r.barrier_to_host();
            r.stamp();
        })?;
        Ok(FrameSlot {
            fence: FrameFence::new(gpu)?,
            list,
            _set: set,
            frame,
            instances,
            arguments,
            tiles,
            counters_host,
            codes_host,
            _device_only: [counters, surfaces, radiance, codes],
            debug_host,
            tile_list,
            raster,
            stamps: [0; PASSES.len() + 1],
        })
    }

    /// Writes the inputs and starts the GPU. The slot must not be in flight. Allocates nothing.
    ///
    /// # Errors
    /// Device lost.
    ///
    /// # Panics
    /// When there are fewer poses than bodies: a programmer's mistake.
    pub fn submit(&self, slot: &mut FrameSlot, inputs: &FrameInputs<'_>) -> Result<(), GpuError> {
        assert_eq!(inputs.poses.len(), self.data.bodies.len(), "one pose per body");
        if self.settings.camera_is_eye {
            slot.tile_list.fill();
        } else {
            slot.tile_list.update(
                inputs.camera,
                &self.data.bodies,
                inputs.poses,
                gpu_structs::INSTANCE_PROJECTED,
            );
        }
        let tile_count = slot.tile_list.write(bytemuck::cast_slice_mut(slot.tiles.bytes_mut()));
        // Four 8 x 8 workgroups a tile.
        slot.arguments.write(&[[tile_count * 4, 1u32, 1]]);
        // The projector is the origin: f32 is finest where the rays start.
        let origin = inputs.camera.position();
        let shift = DAffine3::from_translation(-origin);
        for (i, (body, pose)) in self.data.bodies.iter().zip(inputs.poses).enumerate() {
            let world_from_object = shift * *pose;
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
                previous_world_from_object: rows(&world_from_object),
                // What is lost still casts virtual shadows where it was last, but gets no light.
                flags: if self.is_lost(i, inputs.lost) {
                    body.flags & !gpu_structs::INSTANCE_PROJECTED
                } else {
                    body.flags
                },
                body: i as u32,
                extent: body.extent,
            };
            let at = i * size_of::<Instance>();
            slot.instances.bytes_mut()[at..at + size_of::<Instance>()]
                .copy_from_slice(bytemuck::bytes_of(&instance));
        }
        let raster = self.settings.raster;
        let c = inputs.camera;
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
            flags: if self.settings.camera_is_eye { gpu_structs::FRAME_CAMERA_IS_EYE } else { 0 },
            environment: self.data.environment_constant.into(),
            environment_width: self.data.environment_size[0],
            environment_height: self.data.environment_size[1],
            environment_rotation: self.data.environment_rotation,
            environment_select: self.data.environment_select,
            world_origin: origin.as_vec3().into(),
        };
        slot.frame.write(&[frame]);
        slot.list.submit(&mut slot.fence)
    }
}
