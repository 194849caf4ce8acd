//! Compute pipelines and the one table of bindings that all shaders share.

use super::acceleration::FrameTree;
use super::buffer::Buffer;
use super::context::{Gpu, On as _};
use super::error::GpuError;
use super::kept::{Layouts, PipelineKey};
use ash::vk;
use dpm_shaders::{structs, Reading, Shader};
use std::sync::Arc;

/// What a binding holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BindingKind {
    /// Uniform block.
    Uniform,
    /// Storage buffer.
    Storage,
    /// Storage texel buffer, which the driver reads by image instructions.
    Texel,
    /// The tree over the bodies of a frame, in which the device finds what a ray meets.
    BodyTree,
}

impl BindingKind {
    fn vulkan(self) -> vk::DescriptorType {
        match self {
            Self::Uniform => vk::DescriptorType::UNIFORM_BUFFER,
            Self::Storage => vk::DescriptorType::STORAGE_BUFFER,
            Self::Texel => vk::DescriptorType::STORAGE_TEXEL_BUFFER,
            Self::BodyTree => vk::DescriptorType::ACCELERATION_STRUCTURE_KHR,
        }
    }
}

/// The bindings that all shaders share, with their kinds. The second bindings of a buffer, as texels, and the rays that the host walks are bound only
/// for shaders that read tables so, and what `enlarges` a reduced raster only where there is one, because devices bind a limited
/// number; and the tree over the bodies only for those that ask the device for hits.
pub fn shared_bindings(reading: Reading, enlarges: bool) -> Vec<(u32, BindingKind)> {
    let texel = reading == Reading::Texels;
    let tree = (reading == Reading::Query).then_some((structs::TREE_BINDING.1, BindingKind::BodyTree));
    (structs::BINDINGS.iter())
        .filter(|(name, _)| texel || !structs::is_of_software(name))
        .filter(|(name, _)| enlarges || !structs::is_of_enlarging(name))
        .map(|&(name, binding)| {
            let rows = texel && structs::TEXEL_BINDINGS.contains(&name);
            (binding, if rows { BindingKind::Texel } else { BindingKind::Storage })
        })
        .chain(tree)
        .collect()
}

/// The layout of set 0: the kind of each binding. The device keeps one layout of each list of bindings.
pub struct BindingTable {
    pub(super) layouts: Layouts,
    bindings: Vec<(u32, BindingKind)>,
    pub(super) gpu: Arc<Gpu>,
}

impl BindingTable {
    /// # Errors
    /// A call of Vulkan failed.
    pub fn new(gpu: &Arc<Gpu>, bindings: &[(u32, BindingKind)]) -> Result<Arc<Self>, GpuError> {
        let layouts = match gpu.kept.layouts(bindings) {
            Some(layouts) => layouts,
            None => Self::make(gpu, bindings)?,
        };
        Ok(Arc::new(Self { layouts, bindings: bindings.to_vec(), gpu: gpu.clone() }))
    }

    fn make(gpu: &Gpu, bindings: &[(u32, BindingKind)]) -> Result<Layouts, GpuError> {
        let entries: Vec<_> = bindings
            .iter()
            .map(|&(binding, kind)| {
                vk::DescriptorSetLayoutBinding::default()
                    .binding(binding)
                    .descriptor_type(kind.vulkan())
                    .descriptor_count(1)
                    .stage_flags(vk::ShaderStageFlags::COMPUTE)
            })
            .collect();
        let info = vk::DescriptorSetLayoutCreateInfo::default().bindings(&entries);
        gpu.alive("making a descriptor layout")?;
        // SAFETY: valid create infos. The device destroys what it keeps when it goes, and nobody has the others.
        unsafe {
            let set = gpu
                .device
                .create_descriptor_set_layout(&info, None)
                .on(gpu, "creating a descriptor layout")?;
            let layouts = [set];
            let info = vk::PipelineLayoutCreateInfo::default().set_layouts(&layouts);
            let made = gpu.device.create_pipeline_layout(&info, None).on(gpu, "creating a pipeline layout");
            let made = made.inspect_err(|_| gpu.device.destroy_descriptor_set_layout(set, None));
            let made = Layouts { set, pipeline: made? };
            let (layouts, spare) = gpu.kept.keep_layouts(bindings, made);
            if let Some(spare) = spare {
                spare.destroy(&gpu.device);
            }
            Ok(layouts)
        }
    }
}

impl Layouts {
    /// Destroys them.
    ///
    /// # Safety
    /// Nothing that was made with them is used any more.
    pub(super) unsafe fn destroy(self, device: &ash::Device) {
        // SAFETY: the caller's.
        unsafe {
            device.destroy_pipeline_layout(self.pipeline, None);
            device.destroy_descriptor_set_layout(self.set, None);
        }
    }
}

/// Buffers bound to a table. It does not hold the buffers. Their owner keeps them alive as long as the GPU may use them.
pub struct BindingSet {
    pub(super) set: vk::DescriptorSet,
    pool: vk::DescriptorPool,
    table: Arc<BindingTable>,
}

impl BindingSet {
    /// Binds every entry of a table that has no tree.
    ///
    /// # Errors
    /// A call of Vulkan failed.
    ///
    /// # Panics
    /// If an entry of the table is missing from `buffers`, which is a mistake of the caller.
    pub fn new(table: &Arc<BindingTable>, buffers: &[(u32, &Buffer)]) -> Result<Self, GpuError> {
        Self::with_tree(table, buffers, None)
    }

    /// Binds every entry of the table. `tree`: that of the frame in flight.
    ///
    /// # Errors
    /// As [`BindingSet::new`].
    ///
    /// # Panics
    /// If an entry of the table is missing, which is a mistake of the caller.
    pub(crate) fn with_tree(
        table: &Arc<BindingTable>,
        buffers: &[(u32, &Buffer)],
        tree: Option<&FrameTree>,
    ) -> Result<Self, GpuError> {
        let gpu = &table.gpu;
        let count = |kind| table.bindings.iter().filter(|b| b.1 == kind).count() as u32;
        let kinds = [BindingKind::Uniform, BindingKind::Storage, BindingKind::Texel, BindingKind::BodyTree];
        let sizes: Vec<_> = kinds
            .iter()
            .map(|&k| vk::DescriptorPoolSize { ty: k.vulkan(), descriptor_count: count(k) })
            .filter(|s| s.descriptor_count > 0)
            .collect();
        let info = vk::DescriptorPoolCreateInfo::default().max_sets(1).pool_sizes(&sizes);
        gpu.alive("making a descriptor set")?;
        // SAFETY: valid create infos; the pool is destroyed in Drop and frees the set.
        unsafe {
            let pool =
                gpu.device.create_descriptor_pool(&info, None).on(gpu, "creating a descriptor pool")?;
            let mut bound = Self { set: vk::DescriptorSet::null(), pool, table: table.clone() };
            let layouts = [table.layouts.set];
            let info = vk::DescriptorSetAllocateInfo::default().descriptor_pool(pool).set_layouts(&layouts);
            bound.set = gpu.device.allocate_descriptor_sets(&info).on(gpu, "allocating a descriptor set")?[0];
            for &(binding, kind) in &table.bindings {
                if kind == BindingKind::BodyTree {
                    bound.bind_tree(binding, tree.unwrap_or_else(|| panic!("binding {binding} has no tree")));
                    continue;
                }
                let buffer = buffers
                    .iter()
                    .find(|b| b.0 == binding)
                    .unwrap_or_else(|| panic!("binding {binding} has no buffer"))
                    .1;
                bound.bind(binding, kind, buffer);
            }
            Ok(bound)
        }
    }

    /// Binds a buffer.
    fn bind(&self, binding: u32, kind: BindingKind, buffer: &Buffer) {
        let infos = [vk::DescriptorBufferInfo { buffer: buffer.handle, offset: 0, range: vk::WHOLE_SIZE }];
        let views = [buffer.view.unwrap_or_default()];
        let write = self.write_of(binding, kind);
        let write = match kind {
            BindingKind::Texel => write.texel_buffer_view(&views),
            _ => write.buffer_info(&infos),
        };
        // SAFETY: the set is not in use yet, and the buffer is alive.
        unsafe { self.table.gpu.device.update_descriptor_sets(&[write], &[]) }
    }

    /// Binds the tree of a frame.
    fn bind_tree(&self, binding: u32, tree: &FrameTree) {
        let trees = [tree.handle()];
        let mut bound =
            vk::WriteDescriptorSetAccelerationStructureKHR::default().acceleration_structures(&trees);
        let write = self.write_of(binding, BindingKind::BodyTree).push_next(&mut bound);
        // SAFETY: the set is not in use yet, and the tree is alive.
        unsafe { self.table.gpu.device.update_descriptor_sets(&[write], &[]) }
    }

    fn write_of(&self, binding: u32, kind: BindingKind) -> vk::WriteDescriptorSet<'static> {
        vk::WriteDescriptorSet::default()
            .dst_set(self.set)
            .dst_binding(binding)
            .descriptor_count(1)
            .descriptor_type(kind.vulkan())
    }
}

impl Drop for BindingSet {
    fn drop(&mut self) {
        let pool = self.pool;
        // SAFETY: owners wait for the GPU before dropping.
        self.table.gpu.destroy(move |gpu| unsafe { gpu.device.destroy_descriptor_pool(pool, None) });
    }
}

/// A compiled shader with its specialization constants.
pub struct ComputePipeline {
    pub(super) pipeline: vk::Pipeline,
    pub(super) table: Arc<BindingTable>,
    /// What it was compiled from.
    pub(super) key: PipelineKey,
}

impl ComputePipeline {
    /// Compiles `shader` with specialization constants `(id, value as 32 bits)`, or takes the pipeline that the device has kept of
    /// them. Booleans are 0 and 1.
    ///
    /// # Errors
    /// A call of Vulkan failed.
    pub fn new(
        table: &Arc<BindingTable>,
        shader: Shader,
        constants: &[(u32, u32)],
    ) -> Result<Self, GpuError> {
        let gpu = &table.gpu;
        let key = PipelineKey {
            layout: table.layouts.pipeline,
            spirv: shader.spirv,
            constants: constants.to_vec(),
        };
        gpu.alive("compiling a compute pipeline")?;
        if let Some(pipeline) = gpu.kept.take(&key) {
            return Ok(Self { pipeline, table: table.clone(), key });
        }
        let words: Vec<u32> =
            shader.spirv.chunks_exact(4).map(|c| u32::from_le_bytes([c[0], c[1], c[2], c[3]])).collect();
        let module_info = vk::ShaderModuleCreateInfo::default().code(&words);
        let entries: Vec<_> = constants
            .iter()
            .enumerate()
            .map(|(i, &(constant_id, _))| vk::SpecializationMapEntry {
                constant_id,
                offset: i as u32 * 4,
                size: 4,
            })
            .collect();
        let values: Vec<u32> = constants.iter().map(|c| c.1).collect();
        let data = bytemuck::cast_slice(&values);
        let specialization = vk::SpecializationInfo::default().map_entries(&entries).data(data);
        // SAFETY: the SPIR-V is ours, checked by tests; module and pipeline are destroyed here and in Drop.
        unsafe {
            let module =
                gpu.device.create_shader_module(&module_info, None).on(gpu, "creating a shader module")?;
            let name = Gpu::name("main");
            let stage = vk::PipelineShaderStageCreateInfo::default()
                .stage(vk::ShaderStageFlags::COMPUTE)
                .module(module)
                .name(&name)
                .specialization_info(&specialization);
            let flags = match gpu.statistics {
                Some(_) => vk::PipelineCreateFlags::CAPTURE_STATISTICS_KHR,
                None => vk::PipelineCreateFlags::empty(),
            };
            let info = [vk::ComputePipelineCreateInfo::default()
                .flags(flags)
                .stage(stage)
                .layout(table.layouts.pipeline)];
            let result = gpu.device.create_compute_pipelines(vk::PipelineCache::null(), &info, None);
            gpu.device.destroy_shader_module(module, None);
            let pipeline = result.map_err(|(_, e)| e).on(gpu, "compiling a compute pipeline")?[0];
            Ok(Self { pipeline, table: table.clone(), key })
        }
    }
}

impl Drop for ComputePipeline {
    fn drop(&mut self) {
        let gpu = &self.table.gpu;
        // Owners wait for the GPU before dropping, so the next owner may have it at once. A device that was given up makes none any more.
        if let Some(oldest) = gpu.kept.give_back(self.key.clone(), self.pipeline) {
            // SAFETY: it was given back by its owner, as above, and nobody has taken it since.
            gpu.destroy(move |gpu| unsafe { gpu.device.destroy_pipeline(oldest, None) });
        }
    }
}
