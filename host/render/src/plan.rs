//! What a renderer is made from, without a device, and the pipelines that this becomes on one.

use super::apart::{self, ApartPipelines};
use super::optics::OpticsLayout;
use super::passes::TABLE;
use super::scene_data::{Keep, SceneData, SceneDataError};
use super::scene_needs::SceneNeeds;
use super::settings::{RayWalk, RayWalker, RendererSettings, Tracing};
use crate::gpu::{shared_bindings, BindingTable, ComputePipeline, DeviceSummary, Executable, Gpu, GpuError};
use dpm_scene::Scene;
use dpm_shaders::specialization as ids;
use dpm_shaders::{Reading, Shader};
use std::sync::Arc;

/// What a renderer is made from, without a device. It is kept so that the renderer can be made again on another device without preparing the
/// scene again. Cheap to clone.
#[derive(Clone)]
pub struct RendererPlan {
    pub(super) data: Arc<SceneData>,
    pub(super) settings: RendererSettings,
    pub(super) keep: Keep,
    /// For each body of the scene the tracked body that carries it.
    pub(super) tracked: Vec<Option<u16>>,
}

/// The program of a pass, as a driver is given it.
#[derive(Clone, Debug)]
pub struct Program {
    /// Name of the pass in reports, as in [`crate::PASSES`].
    pub pass: &'static str,
    /// Whether its rays walk through the scene.
    pub walks: bool,
    /// The shader that the method runs in this pass.
    pub shader: Shader,
    /// Specialization constants, each as id and value.
    pub constants: Vec<(u32, u32)>,
}

/// The pipelines of a plan on a device.
pub(super) struct Pipelines {
    pub table: Arc<BindingTable>,
    /// One for each row of [`TABLE`]; `None`: the method does not need the pass.
    pub each: Vec<Option<ComputePipeline>>,
    /// The parts of passes between which the host walks rays, and where everything lies; `None`: it does not.
    pub apart: Option<(ApartPipelines, apart::QueueLayout)>,
}

/// Workgroups of the pass `trace` for each multiprocessor or compute unit, so that the device is busy to the end: about three times what it holds at
/// once. On an H100, which holds seven a multiprocessor, 23 of 60 samples each took 0.48 ms, 11 of 120 took 0.51 ms and 8 of 180 took 0.55 ms.
const GROUPS_A_PROCESSOR: u32 = 24;
/// The same for a device of unknown size.
const TRACE_GROUPS: u32 = 1024;

/// How many workgroups of the pass `trace` keep a device busy.
pub fn trace_groups(device: &DeviceSummary) -> u32 {
    device.processors.map_or(TRACE_GROUPS, |n| n.saturating_mul(GROUPS_A_PROCESSOR))
}

impl RendererPlan {
    /// A plan to draw `scene` with these settings, and with all of `keep`, whether the rig needs it or not.
    ///
    /// # Errors
    /// The scene is too large for the tables of the shaders.
    pub fn new(scene: &Scene, settings: RendererSettings, keep: Keep) -> Result<Self, SceneDataError> {
        let data = Arc::new(SceneData::build(scene)?);
        let tracked = scene.bodies.iter().map(|b| b.tracked).collect();
        Ok(Self { data, settings, keep, tracked })
    }

    /// The same scene to be drawn with other settings. What was worked out of it is shared.
    pub fn with_settings(&self, settings: RendererSettings) -> Self {
        Self { settings, ..self.clone() }
    }

    /// How the shaders read tables and find what a ray meets on this device. Software Vulkan should read texel buffers.
    ///
    /// # Errors
    /// Ray queries are asked for, and the device has none.
    pub(super) fn reading(&self, device: &DeviceSummary) -> Result<Reading, GpuError> {
        let tracing = self.settings.tracing;
        // The device's own trees are built once, so they do not follow bodies that deform.
        let can_ask = self.data.deforming.is_empty();
        match tracing.asks_device(device) && can_ask {
            true => Ok(Reading::Query),
            false if tracing == Tracing::RayQuery && can_ask => {
                Err(GpuError::NoRayQuery { device: device.name.as_str().into() })
            }
            false if device.software && !self.keep.storage_tables => Ok(Reading::Texels),
            false => Ok(Reading::Storage),
        }
    }

    /// What of the tracer is compiled.
    fn needs(&self) -> SceneNeeds {
        let mut needs = self.data.needs.with(self.keep.needs);
        needs.clamp |= self.settings.clamp_indirect.is_some();
        if self.settings.leave_nothing_out {
            needs = needs.everything();
        }
        needs.body_tree &= !self.keep.body_list;
        needs
    }

    /// Whether rays look for bodies in a tree that the host builds. A device that traces rays itself has its own.
    pub(super) fn walks_body_tree(&self, reading: Reading) -> bool {
        self.needs().body_tree && reading != Reading::Query
    }

    /// Specialization constants of all passes that read the scene, each as id and value. `groups`: see [`trace_groups`].
    fn constants(&self, optics: &OpticsLayout, groups: u32) -> Vec<(u32, u32)> {
        let mut constants = self.needs().constants();
        constants.extend(self.settings.method.constants());
        constants.extend(optics.constants());
        constants.push((ids::TRACE_GROUPS, groups));
        constants.push((ids::LAMPS, self.data.lamps.len() as u32));
        // A level's group waits while the next level is open, so the deepest one never does.
        constants.push((ids::WALK_STACK, self.data.levels.saturating_sub(1).max(1)));
        constants
    }

    /// The programs of the passes that the plan needs; `None` for the others. `groups`: see [`trace_groups`].
    fn wanted(&self, reading: Reading, groups: u32) -> impl Iterator<Item = Option<Program>> + '_ {
        let settings = &self.settings;
        let of_panel = self.constants(&OpticsLayout::new(settings), groups);
        let of_traced = self.constants(&OpticsLayout::new(&settings.on_traced()), groups);
        TABLE.iter().map(move |pass| {
            let shared = if pass.at_panel { &of_panel } else { &of_traced };
            (pass.when)(settings, self.keep).then(|| Program {
                pass: pass.name,
                walks: pass.walks,
                shader: pass.shader(&settings.method, reading),
                constants: pass.constants(shared, settings),
            })
        })
    }

    /// Compiles the passes that the plan needs. Nothing is sent to the device.
    ///
    /// # Errors
    /// The GPU's own.
    pub(super) fn pipelines(&self, gpu: &Arc<Gpu>, reading: Reading) -> Result<Pipelines, GpuError> {
        let table = BindingTable::new(gpu, &shared_bindings(reading, self.settings.is_reduced()))?;
        let compiled = |p: Program| ComputePipeline::new(&table, p.shader, &p.constants);
        let wanted = self.wanted(reading, trace_groups(gpu.summary()));
        let each = wanted.map(|program| program.map(compiled).transpose());
        let each = each.collect::<Result<_, _>>()?;
        let apart = match self.layout_apart(gpu, reading) {
            Ok(layout) => {
                let optics = OpticsLayout::new(&self.settings.on_traced());
                let constants = self.constants(&optics, trace_groups(gpu.summary()));
                Some((ApartPipelines::new(&table, &constants)?, layout))
            }
            Err(reason) => {
                if self.settings.tracing == Tracing::Host && gpu.summary().software {
                    tracing::warn!("the shaders walk the rays, and not the host: {reason}");
                }
                None
            }
        };
        Ok(Pipelines { table, each, apart })
    }

    /// The walk alone, on this device.
    ///
    /// # Errors
    /// The GPU's own.
    pub(super) fn walk(
        &self,
        gpu: &Arc<Gpu>,
        table: &Arc<BindingTable>,
        reading: Reading,
    ) -> Result<ComputePipeline, GpuError> {
        let constants = self.constants(&OpticsLayout::new(&self.settings), trace_groups(gpu.summary()));
        ComputePipeline::new(table, dpm_shaders::WALK.reading(reading), &constants)
    }

    /// Where everything lies if the host walks the rays; else why it does not.
    pub(super) fn layout_apart(
        &self,
        gpu: &Gpu,
        reading: Reading,
    ) -> Result<apart::QueueLayout, &'static str> {
        let needs = self.needs();
        if let Some(reason) = apart::refusal(gpu, reading, &self.settings, &self.data, &needs) {
            return Err(reason);
        }
        let most = gpu.max_buffer_bytes();
        apart::QueueLayout::new(&self.settings.on_traced(), needs.absorption, needs.emissive, most)
            .ok_or("paths have no rays, or more than there is room for")
    }

    /// Who finds what the rays of this plan meet on this device, and why.
    ///
    /// # Errors
    /// Ray queries are asked for, and the device has none.
    pub fn ray_walk(&self, gpu: &Gpu) -> Result<RayWalk, GpuError> {
        let reading = self.reading(gpu.summary())?;
        Ok(match (reading, self.layout_apart(gpu, reading)) {
            (Reading::Query, _) => RayWalk { by: RayWalker::Device, why: "it has ray queries" },
            (_, Ok(_)) => RayWalk { by: RayWalker::Host, why: "render.tracing is \"host\"" },
            (_, Err(why)) => RayWalk { by: RayWalker::Shaders, why },
        })
    }

    /// The programs that a GPU whose driver does not say how large it is would be given for this plan, in the order in which they run. None of them
    /// has ray queries.
    pub fn programs(&self) -> Vec<Program> {
        self.wanted(Reading::Storage, TRACE_GROUPS).flatten().collect()
    }

    /// Those that it would be given in place of them if it has ray queries.
    pub fn programs_with_queries(&self) -> Vec<Program> {
        self.wanted(Reading::Query, TRACE_GROUPS).flatten().filter(|program| program.walks).collect()
    }

    /// What the device's driver makes of each of [`RendererPlan::programs`], if it was opened with [`crate::gpu::GpuOptions::statistics`]. Nothing is sent
    /// to the device, so its driver may be one that only compiles.
    ///
    /// # Errors
    /// The GPU's own.
    pub fn compile(&self, gpu: &Arc<Gpu>) -> Result<Vec<(Program, Vec<Executable>)>, GpuError> {
        compile(gpu, (Reading::Storage, self.settings.is_reduced()), self.programs())
    }

    /// The same of each of [`RendererPlan::programs_with_queries`].
    ///
    /// # Errors
    /// The device has no ray queries, or the GPU's own.
    pub fn compile_with_queries(&self, gpu: &Arc<Gpu>) -> Result<Vec<(Program, Vec<Executable>)>, GpuError> {
        if !gpu.summary().ray_query {
            return Err(GpuError::NoRayQuery { device: gpu.summary().name.as_str().into() });
        }
        compile(gpu, (Reading::Query, self.settings.is_reduced()), self.programs_with_queries())
    }
}

fn compile(
    gpu: &Arc<Gpu>,
    (reading, enlarges): (Reading, bool),
    programs: Vec<Program>,
) -> Result<Vec<(Program, Vec<Executable>)>, GpuError> {
    let table = BindingTable::new(gpu, &shared_bindings(reading, enlarges))?;
    let made = |p: Program| {
        let made = ComputePipeline::new(&table, p.shader, &p.constants)?.executables()?;
        Ok((p, made))
    };
    programs.into_iter().map(made).collect()
}
