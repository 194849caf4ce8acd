//! The walk alone on a device: for measurements.

use super::frame_buffers::Pixels;
use super::renderer::Renderer;
use super::walker::{Ray, WalkKernel, WalkScene};
use crate::gpu::{BindingSet, Buffer, CommandList, FrameFence, GpuError, MemoryKind};
use bytemuck::{cast_slice, Zeroable};
use dpm_shaders::structs::{self as gpu_structs, BodyNode, Frame, Instance, TRACE_LANES};

/// How long a device may take, nanoseconds.
const WAIT_NS: u64 = 60_000_000_000;

impl Renderer {
    /// Walks rays, at least one, by the device's own kernel in their order, through bodies of this renderer's scene that stand as `bodies` says, with the
    /// tree over them. Holes are surfaces. Returns what each meets, and how long the device took, nanoseconds; 0 if it has no time stamps.
    ///
    /// # Errors
    /// The GPU's own.
    pub fn walk_on_device(
        &self,
        rays: &[Ray],
        (bodies, nodes): (&[Instance], &[BodyNode]),
    ) -> Result<(Vec<u32>, u64), GpuError> {
        let (gpu, resources) = (&self.gpu, &self.resources);
        let mut slot = self.create_slot(false)?;
        let b = &mut slot.buffers;
        let body_nodes = (nodes.len() / 8) as u32;
        let frame = Frame { instance_count: bodies.len() as u32, body_nodes, ..Frame::zeroed() };
        b.frame.host.write(&[frame]);
        b.instances.host.write(bodies);
        b.body_nodes.host.write(nodes);
        let mut queue = Buffer::new(gpu, "rays", size_of_val(rays), MemoryKind::Upload)?;
        queue.write(rays);
        let hits = Buffer::new(gpu, "hits", 4 * rays.len(), MemoryKind::Readback)?;
        let b = &slot.buffers;
        let all = (&resources.shared, &*resources.scene);
        let bindings: Vec<_> = (gpu_structs::BINDINGS.iter())
            .filter(|(name, _)| self.is_software() || !gpu_structs::is_of_software(name))
            .map(|&(name, binding)| {
                let buffer = match name {
                    "B_SHOWN" => &queue,
                    "B_CODES" => &hits,
                    name => b.of(name, (0, Pixels::Traced), &self.settings, all),
                };
                (binding, buffer)
            })
            .collect();
        let table = &resources.pipelines.table;
        let set = BindingSet::with_tree(table, &bindings, b.device_tree.as_ref())?;
        let pipeline = self.prepared().plan().walk(gpu, table, self.reading())?;
        let list = CommandList::record(gpu, 2, |r| {
            for latched in [&b.frame, &b.instances, &b.body_nodes] {
                r.copy(&latched.host, &latched.device, latched.len_bytes);
            }
            r.barrier();
            r.stamp();
            r.dispatch(&pipeline, &set, [(rays.len() as u32).div_ceil(TRACE_LANES), 1, 1]);
            r.barrier_to_host();
            r.stamp();
        })?;
        let mut fence = FrameFence::new(gpu)?;
        let (mut best, mut stamps) = (u64::MAX, [0; 2]);
        // The first run compiles the kernel on some devices.
        for _ in 0..3 {
            list.submit(&mut fence)?;
            fence.wait(WAIT_NS)?;
            let took = if list.stamps_ns(&mut stamps) == 2 { stamps[1] } else { 0 };
            best = best.min(took);
        }
        Ok((cast_slice(hits.read::<u32>(rays.len())).to_vec(), best))
    }

    /// The same by a kernel of the processor, on the calling thread.
    pub fn walk_on_host(
        &self,
        kernel: WalkKernel,
        rays: &[Ray],
        (bodies, nodes): (&[Instance], &[BodyNode]),
        hits: &mut [u32],
    ) {
        let scene = WalkScene { bodies, trees: self.scene_data().wide_trees(), body_nodes: nodes };
        kernel.walk(&scene, rays, hits);
    }
}
