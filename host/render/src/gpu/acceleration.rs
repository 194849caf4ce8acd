//! The trees in which a device finds itself what a ray meets (`VK_KHR_acceleration_structure`): one over the triangles of each body, built once, and
//! one over the bodies, which each frame builds anew from its poses.
//!
//! The trees are built from the triangles that the shaders read, in their order. So the number of a triangle in a tree is its number in the body.

use super::buffer::{Buffer, MemoryKind};
use super::commands::{run_now, Recorder};
use super::context::{Gpu, On as _};
use super::error::GpuError;
use ash::vk;
use dpm_shaders::structs::{Instance, INSTANCE_EMPTY, INSTANCE_PROJECTED};
use std::ops::Range;
use std::sync::Arc;

/// Trees begin at multiples of this in their memory, by the standard.
const TREE_ALIGNMENT: u64 = 256;
/// Bytes from one corner of a triangle to the next.
const CORNER_BYTES: u64 = 16;
/// Words of a body in the list from which a frame's tree is built (`VkAccelerationStructureInstanceKHR`).
const RECORD_WORDS: usize = 16;
/// This bit of a body's mask is set in every body that has triangles, so that rays that see all bodies meet it. The others are those of its flags.
const MASK_OF_ALL: u32 = 0x80;

/// The triangles of a body.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct BodyTriangles {
    /// Their place among those of all bodies.
    pub range: Range<u32>,
    /// Surfaces of the body may have holes, so that shaders must look whether a triangle is there.
    pub has_holes: bool,
}

/// What a tree is built from.
type Geometry = vk::AccelerationStructureGeometryKHR<'static>;

/// A tree in memory that its owner keeps alive.
struct Tree {
    handle: vk::AccelerationStructureKHR,
    gpu: Arc<Gpu>,
}

impl Drop for Tree {
    fn drop(&mut self) {
        let tree = self.handle;
        self.gpu.destroy(move |gpu| {
            if let Some(calls) = &gpu.acceleration {
                // SAFETY: owners wait for the GPU before dropping, or the device is lost; the handle is ours alone.
                unsafe { calls.destroy_acceleration_structure(tree, None) }
            }
        });
    }
}

/// The calls for trees.
///
/// # Errors
/// The device does not trace rays.
fn calls(gpu: &Gpu) -> Result<&ash::khr::acceleration_structure::Device, GpuError> {
    gpu.acceleration.as_ref().ok_or_else(|| GpuError::NoRayQuery { device: gpu.device_name().clone() })
}

/// How to build a tree of one geometry.
fn build_of(
    kind: vk::AccelerationStructureTypeKHR,
    geometry: &[Geometry],
) -> vk::AccelerationStructureBuildGeometryInfoKHR<'_> {
    vk::AccelerationStructureBuildGeometryInfoKHR::default()
        .ty(kind)
        .flags(vk::BuildAccelerationStructureFlagsKHR::PREFER_FAST_TRACE)
        .mode(vk::BuildAccelerationStructureModeKHR::BUILD)
        .geometries(geometry)
}

/// Bytes of a tree over `count` triangles or bodies, and of the memory in which it is built.
fn sizes_of(
    gpu: &Gpu,
    kind: vk::AccelerationStructureTypeKHR,
    geometry: &[Geometry],
    count: u32,
) -> Result<[u64; 2], GpuError> {
    let mut sizes = vk::AccelerationStructureBuildSizesInfoKHR::default();
    // SAFETY: valid structures with one count for the one geometry.
    unsafe {
        calls(gpu)?.get_acceleration_structure_build_sizes(
            vk::AccelerationStructureBuildTypeKHR::DEVICE,
            &build_of(kind, geometry),
            &[count],
            &mut sizes,
        );
    }
    Ok([sizes.acceleration_structure_size, sizes.build_scratch_size])
}

/// Memory in which trees are built, one after the other.
fn scratch(gpu: &Arc<Gpu>, bytes: u64) -> Result<Buffer, GpuError> {
    let bytes = bytes + gpu.scratch_alignment;
    Buffer::addressed(gpu, "scratch of ray tracing", bytes, MemoryKind::Device, vk::BufferUsageFlags::empty())
}

/// Where building may begin in it.
fn scratch_address(gpu: &Gpu, scratch: &Buffer) -> vk::DeviceOrHostAddressKHR {
    vk::DeviceOrHostAddressKHR { device_address: scratch.address().next_multiple_of(gpu.scratch_alignment) }
}

/// A tree that is still empty, at this place in its memory.
fn tree_in(
    gpu: &Arc<Gpu>,
    memory: &Buffer,
    (offset, bytes): (u64, u64),
    kind: vk::AccelerationStructureTypeKHR,
) -> Result<Tree, GpuError> {
    let info = vk::AccelerationStructureCreateInfoKHR::default()
        .buffer(memory.handle)
        .offset(offset)
        .size(bytes)
        .ty(kind);
    gpu.alive("making a tree for ray tracing")?;
    // SAFETY: the buffer was made for trees and has this many bytes behind the offset; destroyed in Drop.
    let handle = unsafe { calls(gpu)?.create_acceleration_structure(&info, None) }
        .on(gpu, "making a tree for ray tracing")?;
    Ok(Tree { handle, gpu: gpu.clone() })
}

/// Memory for trees.
fn memory_of_trees(gpu: &Arc<Gpu>, bytes: u64) -> Result<Buffer, GpuError> {
    let usage = vk::BufferUsageFlags::ACCELERATION_STRUCTURE_STORAGE_KHR;
    Buffer::addressed(gpu, "trees of ray tracing", bytes, MemoryKind::Device, usage)
}

/// Triangles in the layout of the shaders' table, for trees and for shaders.
///
/// # Errors
/// As [`Buffer::from_slice`].
pub(crate) fn triangle_buffer(gpu: &Arc<Gpu>, corners: &[[u32; 4]]) -> Result<Buffer, GpuError> {
    let usage = vk::BufferUsageFlags::ACCELERATION_STRUCTURE_BUILD_INPUT_READ_ONLY_KHR;
    Buffer::filled_addressed(gpu, "triangles", bytemuck::cast_slice(corners), usage)
}

fn geometry_of(triangles: &Buffer, body: &BodyTriangles) -> Geometry {
    let address = triangles.address() + u64::from(body.range.start) * 3 * CORNER_BYTES;
    let data = vk::AccelerationStructureGeometryTrianglesDataKHR::default()
        .vertex_format(vk::Format::R32G32B32_SFLOAT)
        .vertex_data(vk::DeviceOrHostAddressConstKHR { device_address: address })
        .vertex_stride(CORNER_BYTES)
        .max_vertex((body.range.len() as u32 * 3).saturating_sub(1))
        .index_type(vk::IndexType::NONE_KHR);
    let flags = if body.has_holes { vk::GeometryFlagsKHR::empty() } else { vk::GeometryFlagsKHR::OPAQUE };
    Geometry::default()
        .geometry_type(vk::GeometryTypeKHR::TRIANGLES)
        .geometry(vk::AccelerationStructureGeometryDataKHR { triangles: data })
        .flags(flags)
}

/// The trees of all bodies of a scene.
pub(crate) struct BodyTrees {
    /// The address of each body's tree; 0: the body has no triangles.
    addresses: Vec<u64>,
    // Dropped before their memory.
    _trees: Vec<Tree>,
    _memory: Option<Buffer>,
}

impl BodyTrees {
    /// Builds the trees of these bodies, whose triangles lie in `triangles` (see [`triangle_buffer`]). It waits until they are built.
    ///
    /// # Errors
    /// [`GpuError::NoRayQuery`], out of memory, or a call of Vulkan failed.
    pub(crate) fn new(
        gpu: &Arc<Gpu>,
        triangles: &Buffer,
        bodies: &[BodyTriangles],
    ) -> Result<Self, GpuError> {
        let kind = vk::AccelerationStructureTypeKHR::BOTTOM_LEVEL;
        let solid: Vec<_> = bodies.iter().filter(|body| !body.range.is_empty()).collect();
        if solid.is_empty() {
            calls(gpu)?;
            return Ok(Self { addresses: vec![0; bodies.len()], _trees: Vec::new(), _memory: None });
        }
        let geometries: Vec<[Geometry; 1]> =
            solid.iter().map(|body| [geometry_of(triangles, body)]).collect();
        let (mut places, mut end, mut most_scratch) = (Vec::new(), 0, 0);
        for (body, geometry) in solid.iter().zip(&geometries) {
            let [bytes, scratch] = sizes_of(gpu, kind, geometry, body.range.len() as u32)?;
            places.push((end, bytes));
            end = (end + bytes).next_multiple_of(TREE_ALIGNMENT);
            most_scratch = most_scratch.max(scratch);
        }
        let memory = memory_of_trees(gpu, end)?;
        let trees = (places.into_iter().map(|place| tree_in(gpu, &memory, place, kind)))
            .collect::<Result<Vec<_>, _>>()?;
        let scratch = scratch(gpu, most_scratch)?;
        run_now(gpu, |r| {
            for ((body, geometry), tree) in solid.iter().zip(&geometries).zip(&trees) {
                r.build(tree, kind, geometry, body.range.len() as u32, &scratch);
                r.barrier_of_trees();
            }
        })?;
        let mut built = trees.iter();
        let addresses = bodies.iter().map(|body| match body.range.is_empty() {
            true => Ok(0),
            false => built.next().map_or(Ok(0), |tree| address_of(gpu, tree)),
        });
        let addresses = addresses.collect::<Result<_, _>>()?;
        Ok(Self { addresses, _trees: trees, _memory: Some(memory) })
    }
}

fn address_of(gpu: &Gpu, tree: &Tree) -> Result<u64, GpuError> {
    let info = vk::AccelerationStructureDeviceAddressInfoKHR::default().acceleration_structure(tree.handle);
    // SAFETY: the tree is alive.
    Ok(unsafe { calls(gpu)?.get_acceleration_structure_device_address(&info) })
}

/// The tree over the bodies of one frame in flight, with all that it takes to build it anew. Two frames in flight share none of it.
pub(crate) struct FrameTree {
    // Dropped before its memory.
    tree: Tree,
    _memory: Buffer,
    scratch: Buffer,
    /// What it is built from: a record for each body, which the host writes.
    records: Buffer,
    bodies: u32,
}

impl FrameTree {
    /// Memory for a tree over so many bodies.
    ///
    /// # Errors
    /// [`GpuError::NoRayQuery`], out of memory, or a call of Vulkan failed.
    pub(crate) fn new(gpu: &Arc<Gpu>, bodies: usize) -> Result<Self, GpuError> {
        let kind = vk::AccelerationStructureTypeKHR::TOP_LEVEL;
        let usage = vk::BufferUsageFlags::ACCELERATION_STRUCTURE_BUILD_INPUT_READ_ONLY_KHR;
        let bytes = bodies.max(1) * RECORD_WORDS * 4;
        let records =
            Buffer::addressed(gpu, "bodies of ray tracing", bytes as u64, MemoryKind::Upload, usage)?;
        let [bytes, scratch_bytes] = sizes_of(gpu, kind, &[geometry_of_bodies(&records)], bodies as u32)?;
        let memory = memory_of_trees(gpu, bytes)?;
        let tree = tree_in(gpu, &memory, (0, bytes), kind)?;
        let scratch = scratch(gpu, scratch_bytes)?;
        Ok(Self { tree, _memory: memory, scratch, records, bodies: bodies as u32 })
    }

    /// Writes body number `i` of `bodies` as the shaders are given it. Allocates nothing. The frame in flight must not be on the GPU.
    pub(crate) fn place(&mut self, i: usize, instance: &Instance, bodies: &BodyTrees) {
        let record = record_of(i, instance, bodies.addresses[i]);
        let at = i * RECORD_WORDS * 4;
        self.records.bytes_mut()[at..at + RECORD_WORDS * 4].copy_from_slice(bytemuck::bytes_of(&record));
    }

    /// What shaders are given.
    pub(super) fn handle(&self) -> vk::AccelerationStructureKHR {
        self.tree.handle
    }
}

fn geometry_of_bodies(records: &Buffer) -> Geometry {
    let data = vk::AccelerationStructureGeometryInstancesDataKHR::default()
        .data(vk::DeviceOrHostAddressConstKHR { device_address: records.address() });
    Geometry::default()
        .geometry_type(vk::GeometryTypeKHR::INSTANCES)
        .geometry(vk::AccelerationStructureGeometryDataKHR { instances: data })
}

/// A body as Vulkan is given it: its transform, its number with its mask, no flags, and the address of its tree.
fn record_of(number: usize, instance: &Instance, tree: u64) -> [u32; RECORD_WORDS] {
    let mut words = [0; RECORD_WORDS];
    let rows = instance.world_from_object;
    for (to, value) in words.iter_mut().zip(rows.iter().flatten()) {
        *to = value.to_bits();
    }
    // A body whose place is no place is met by no ray, as in the walk.
    let is_somewhere = rows.iter().flatten().all(|value| value.is_finite());
    let mask = if is_somewhere { mask_of(instance.flags) } else { 0 };
    words[12] = number as u32 | mask << 24;
    words[14] = tree as u32;
    words[15] = (tree >> 32) as u32;
    words
}

/// Which rays meet a body: those that ask for all bodies or for one of its flags. Shaders ask by the same bits.
fn mask_of(flags: u32) -> u32 {
    const { assert!(INSTANCE_PROJECTED < MASK_OF_ALL) };
    if flags & INSTANCE_EMPTY != 0 {
        0
    } else {
        MASK_OF_ALL | flags & INSTANCE_PROJECTED
    }
}

impl Recorder<'_> {
    /// Builds the tree over the bodies of a frame from what [`FrameTree::place`] has written, for the shaders that follow.
    pub(crate) fn build_frame_tree(&mut self, tree: &FrameTree) {
        let kind = vk::AccelerationStructureTypeKHR::TOP_LEVEL;
        self.build(&tree.tree, kind, &[geometry_of_bodies(&tree.records)], tree.bodies, &tree.scratch);
        self.barrier_of_trees();
    }

    fn build(
        &mut self,
        tree: &Tree,
        kind: vk::AccelerationStructureTypeKHR,
        geometry: &[Geometry],
        count: u32,
        scratch: &Buffer,
    ) {
        let gpu = &tree.gpu;
        let Some(calls) = &gpu.acceleration else { return };
        let mut build = build_of(kind, geometry).dst_acceleration_structure(tree.handle);
        build.scratch_data = scratch_address(gpu, scratch);
        let range = [vk::AccelerationStructureBuildRangeInfoKHR::default().primitive_count(count)];
        // SAFETY: recording; the tree and its scratch memory were made for this many, and their owner keeps all of it alive.
        unsafe { calls.cmd_build_acceleration_structures(self.list.buffer, &[build], &[&range]) }
    }

    /// Makes trees that were built visible to shaders and to what is built next, which may use the same scratch memory.
    fn barrier_of_trees(&mut self) {
        use vk::{AccessFlags as A, PipelineStageFlags as S};
        let barrier = vk::MemoryBarrier::default()
            .src_access_mask(A::ACCELERATION_STRUCTURE_WRITE_KHR)
            .dst_access_mask(A::ACCELERATION_STRUCTURE_READ_KHR | A::ACCELERATION_STRUCTURE_WRITE_KHR);
        let built = S::ACCELERATION_STRUCTURE_BUILD_KHR;
        self.pipeline_barrier(built, built | S::COMPUTE_SHADER, barrier);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;

    #[test]
    fn a_body_is_met_by_the_rays_that_meet_it_in_the_walk() {
        // As `next_body` of the shaders, and as their ray query.
        let walk = |flags: u32, mask: u32| flags & INSTANCE_EMPTY == 0 && (mask == 0 || flags & mask != 0);
        let query =
            |flags: u32, mask: u32| mask_of(flags) & (if mask == 0 { 0xff } else { mask & 0xff }) != 0;
        for flags in 0..4 {
            for mask in [0, INSTANCE_PROJECTED] {
                assert_eq!(query(flags, mask), walk(flags, mask), "flags {flags}, mask {mask}");
            }
        }
    }

    #[test]
    fn a_body_is_written_as_the_standard_wants_it() {
        let rows = [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0], [9.0, 10.0, 11.0, 12.0]];
        let body = Instance { world_from_object: rows, flags: INSTANCE_PROJECTED, ..Instance::zeroed() };
        let words = record_of(200, &body, 0x1234_5678_9abc_def0);
        assert_eq!(words[..12], std::array::from_fn::<_, 12, _>(|i| (i as f32 + 1.0).to_bits()));
        assert_eq!(words[12..], [0x8100_00c8, 0, 0x9abc_def0, 0x1234_5678]);
        let mut nowhere = body;
        nowhere.world_from_object[1][3] = f32::NAN;
        assert_eq!(record_of(3, &nowhere, 1)[12], 3);
        assert_eq!(record_of(3, &Instance { flags: INSTANCE_EMPTY, ..body }, 0)[12..], [3, 0, 0, 0]);
    }
}
