//! The commands of a frame whose rays the host walks: a list for each question, and one after the last answer.

use super::frame::ApartFrame;
use super::layout::{QueueLayout, COUNTED_WORD, NOW_ROW};
use crate::gpu::{BindingSet, BindingTable, Buffer, CommandList, ComputePipeline, Gpu, GpuError, Recorder};
use dpm_shaders as shaders;
use dpm_shaders::structs::{Counters, Schedule};
use std::mem::offset_of;
use std::sync::Arc;

/// Byte of the sizes of the first dispatch in an entry, and of the second.
const FRONT: usize = 16;
const BACK: usize = 32;

/// The parts of the pass `trace`.
pub(crate) struct ApartPipelines {
    begin: ComputePipeline,
    hits: ComputePipeline,
    ends: ComputePipeline,
    misses: ComputePipeline,
    sums: ComputePipeline,
}

impl ApartPipelines {
    /// Compiles them with the constants of the pass that they are parts of.
    ///
    /// # Errors
    /// The GPU's own.
    pub(crate) fn new(table: &Arc<BindingTable>, constants: &[(u32, u32)]) -> Result<Self, GpuError> {
        let of = |shader| ComputePipeline::new(table, shader, constants);
        Ok(Self {
            begin: of(shaders::TRACE_BEGIN)?,
            hits: of(shaders::TRACE_HITS)?,
            ends: of(shaders::TRACE_ENDS)?,
            misses: of(shaders::TRACE_MISSES)?,
            sums: of(shaders::TRACE_SUMS)?,
        })
    }
}

/// What is recorded around the parts: see [`ApartLists::record`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Side {
    /// What comes before the pass, with its time stamps.
    Before,
    /// The passes from `trace` to the end of the list, with a time stamp for each.
    After,
}

/// The first lists of a frame, in their order.
pub(crate) struct ApartLists(pub(crate) Vec<CommandList>);

impl ApartLists {
    /// Records them. `stamps`: time stamps of [`Side::Before`] and [`Side::After`]. `schedule` has the size of the pass `trace`.
    ///
    /// # Errors
    /// A call of Vulkan failed.
    pub(crate) fn record(
        gpu: &Arc<Gpu>,
        (frame, pipelines, set): (&ApartFrame, &ApartPipelines, &BindingSet),
        (schedule, counters): (&Buffer, &Buffer),
        stamps: [u32; 2],
        around: &dyn Fn(&mut Recorder<'_>, Side),
    ) -> Result<Self, GpuError> {
        let layout = &frame.layout;
        let mut lists = vec![CommandList::record(gpu, stamps[0], |r| {
            around(r, Side::Before);
            r.copy_part((schedule, 0), (&frame.control, 0), size_of::<Schedule>());
            r.copy_part((counters, offset_of!(Counters, rays)), (&frame.control, 4 * COUNTED_WORD), 4);
            about(r, frame, layout.entry_of_batch(0));
            r.dispatch_indirect(&pipelines.begin, set, schedule, 0);
            r.barrier_to_host();
        })?];
        for step in 0..layout.steps() {
            let ends = step + 1 == layout.steps();
            lists.push(CommandList::record(gpu, if ends { 1 + stamps[1] } else { 0 }, |r| {
                record_step(r, (frame, pipelines, set), schedule, step);
                if ends {
                    r.barrier();
                    r.stamp();
                    around(r, Side::After);
                } else {
                    r.barrier_to_host();
                }
            })?);
        }
        Ok(Self(lists))
    }
}

/// Says what the next dispatch is about.
fn about(r: &mut Recorder<'_>, frame: &ApartFrame, entry: usize) {
    r.copy_part((&frame.control, entry), (&frame.queue, 16 * NOW_ROW), 16);
    r.barrier();
}

/// What follows after the walk of `step`: paths that have met something, paths that have not, and after the last of a batch its sums and the next one.
fn record_step(
    r: &mut Recorder<'_>,
    (frame, pipelines, set): (&ApartFrame, &ApartPipelines, &BindingSet),
    schedule: &Buffer,
    step: u32,
) {
    let layout = &frame.layout;
    let (batch, vertex) = layout.batch_and_vertex(step);
    let entry = QueueLayout::entry_of_step(step);
    let is_last = vertex + 1 == layout.vertices;
    r.barrier_from_host();
    about(r, frame, entry);
    if !(is_last && layout.last_is_any) {
        let hits = if is_last { &pipelines.ends } else { &pipelines.hits };
        r.dispatch_indirect(hits, set, &frame.control, (entry + FRONT) as u64);
    }
    r.dispatch_indirect(&pipelines.misses, set, &frame.control, (entry + BACK) as u64);
    if !is_last {
        return;
    }
    // The first batch is about all items, as many as the schedule has, and leaves the others out.
    let items = |r: &mut Recorder<'_>, pipeline: &ComputePipeline, batch: u32| {
        let entry = layout.entry_of_batch(batch);
        r.barrier();
        about(r, frame, entry);
        match batch {
            0 => r.dispatch_indirect(pipeline, set, schedule, 0),
            _ => r.dispatch_indirect(pipeline, set, &frame.control, (entry + FRONT) as u64),
        }
    };
    items(r, &pipelines.sums, batch);
    if batch + 1 < layout.batches {
        items(r, &pipelines.begin, batch + 1);
    }
}
