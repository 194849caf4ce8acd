//! The rays of a frame in flight, and what a thread of the host does with them at each step.

use super::layout::{QueueLayout, COUNTED_WORD, ENTRY_BYTES};
use crate::gpu::{Buffer, Gpu, GpuError, MemoryKind};
use crate::walker::{Ray, WalkKernel, WalkScene, WideTree};
use bytemuck::Zeroable;
use dpm_shaders::structs::{BodyNode, Instance, WorkItem, NO_HIT, RAY_NONE, TRACE_LANES};
use std::sync::atomic::Ordering::{AcqRel, Acquire, Relaxed, Release};
use std::sync::atomic::{AtomicU32, AtomicU64};
use std::sync::Arc;

/// Paths that a thread takes at once.
const CHUNK: u32 = 256;

/// What device and host share of a frame.
pub(crate) struct ApartFrame {
    pub(crate) layout: QueueLayout,
    /// Rays, hits, lists and paths: see `queue.glsl`.
    pub(crate) queue: Buffer,
    /// The schedule, and the entries of the steps and batches.
    pub(crate) control: Buffer,
    /// The work list.
    pub(crate) work: Buffer,
    /// The bodies of the frame, as words, and the tree over them.
    bodies: Box<[AtomicU32]>,
    nodes: Box<[AtomicU32]>,
    /// Words of the tree that are of use.
    node_words: AtomicU32,
    /// The lower half of the number of the question that is being answered in the upper 32 bits, and the next chunk that nobody has taken.
    cursor: AtomicU64,
    /// Chunks that are done.
    done: AtomicU32,
    /// Rays that were walked.
    walked: AtomicU32,
    /// Paths in the list of the step, from its front and from its back.
    listed: [AtomicU32; 2],
}

/// What a thread keeps from step to step. After it was made it allocates nothing.
pub(crate) struct WalkMemory {
    bodies: Vec<Instance>,
    nodes: Vec<BodyNode>,
    rays: Vec<Ray>,
    hits: Vec<u32>,
    slots: Vec<u32>,
}

impl WalkMemory {
    pub(crate) fn new(bodies: usize, nodes: usize) -> Self {
        let chunk = CHUNK as usize;
        Self {
            bodies: vec![Instance::zeroed(); bodies],
            nodes: vec![BodyNode::zeroed(); nodes],
            rays: vec![Ray::zeroed(); 2 * chunk],
            hits: vec![NO_HIT; 2 * chunk],
            slots: vec![0; chunk],
        }
    }
}

fn words_of(count: usize) -> Box<[AtomicU32]> {
    std::iter::repeat_with(|| AtomicU32::new(0)).take(count).collect()
}

fn store(to: &[AtomicU32], from: &[u32]) {
    to.iter().zip(from).for_each(|(to, from)| to.store(*from, Relaxed));
}

fn load(from: &[AtomicU32], to: &mut [u32]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to = from.load(Relaxed));
}

/// What a step is about.
#[derive(Clone, Copy)]
struct StepWork {
    /// Slots of paths, or entries of the list before.
    count: u32,
    kind: StepKind,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum StepKind {
    /// All paths of a batch, and the slots before the first of them.
    Begun { before: u32 },
    /// The paths that the step before has listed.
    Listed,
}

impl ApartFrame {
    /// Memory for frames of so many bodies and nodes over them, on a raster of so many pixels.
    ///
    /// # Errors
    /// Out of memory.
    pub(crate) fn new(
        gpu: &Arc<Gpu>,
        layout: QueueLayout,
        bodies: usize,
        nodes: usize,
        pixels: usize,
    ) -> Result<Self, GpuError> {
        let queue = Buffer::new_texels(
            gpu,
            "rays that the host walks",
            layout.rows as usize,
            false,
            MemoryKind::Shared,
        )?;
        store(queue.words(), layout.header().as_flattened());
        let control = Buffer::new(gpu, "steps of the host", layout.control_bytes(), MemoryKind::Upload)?;
        let work = Buffer::new(gpu, "work list", pixels * size_of::<WorkItem>(), MemoryKind::Shared)?;
        Ok(Self {
            layout,
            queue,
            control,
            work,
            bodies: words_of(bodies * size_of::<Instance>() / 4),
            nodes: words_of(nodes * size_of::<BodyNode>() / 4),
            node_words: AtomicU32::new(0),
            cursor: AtomicU64::new(0),
            done: AtomicU32::new(0),
            walked: AtomicU32::new(0),
            listed: [AtomicU32::new(0), AtomicU32::new(0)],
        })
    }

    /// Gets the frame, whose first question is `first`, ready to be submitted. Allocates nothing.
    pub(crate) fn begin(&self, first: u64, bodies: &[u32], nodes: &[u32]) {
        store(&self.bodies, bodies);
        store(&self.nodes, nodes);
        self.node_words.store(nodes.len() as u32, Relaxed);
        self.done.store(0, Relaxed);
        self.walked.store(0, Relaxed);
        self.listed.iter().for_each(|count| count.store(0, Relaxed));
        // Of batches that the frame may not need nothing is dispatched.
        let control = self.control.words();
        let entries = &control[QueueLayout::entry_of_step(0) / 4..];
        entries.iter().for_each(|word| word.store(0, Relaxed));
        self.cursor.store(first << 32, Release);
    }

    /// Copies where the bodies are.
    pub(crate) fn look(&self, bench: &mut WalkMemory) {
        load(&self.bodies, bytemuck::cast_slice_mut(&mut bench.bodies));
        load(&self.nodes, bytemuck::cast_slice_mut(&mut bench.nodes));
    }

    /// The rays that the paths of the frame, if it has one batch, have asked for last, in the order of its samples, with where its bodies are and the tree
    /// over them. Valid once the frame is done.
    pub(crate) fn last_rays(&self) -> (Vec<Ray>, Vec<Instance>, Vec<BodyNode>) {
        let mut bench = WalkMemory::new(self.bodies.len() * 4 / size_of::<Instance>(), 0);
        load(&self.bodies, bytemuck::cast_slice_mut(&mut bench.bodies));
        let words = self.node_words.load(Relaxed) as usize;
        let mut nodes = vec![BodyNode::zeroed(); words * 4 / size_of::<BodyNode>()];
        load(&self.nodes, bytemuck::cast_slice_mut(&mut nodes));
        let mut rays = vec![Ray::zeroed(); 2 * self.listed_samples().1.min(self.layout.paths) as usize];
        let first = 4 * self.layout.rays_row as usize;
        load(&self.queue.words()[first..], bytemuck::cast_slice_mut(&mut rays));
        rays.retain(|ray| ray.kind & 255 != RAY_NONE);
        (rays, bench.bodies, nodes)
    }

    /// Rays that paths have asked for, those included that surely meet nothing, if `all` is what the whole frame has counted; and rays that were walked.
    /// Valid once the frame is done.
    pub(crate) fn ray_counts(&self, all: u32) -> (u32, u32) {
        let before = self.control.words()[COUNTED_WORD].load(Relaxed);
        (all - before, self.walked.load(Relaxed))
    }

    /// Samples of the frame, and its items. Valid once the device has asked for the rays of paths.
    fn listed_samples(&self) -> (u32, u32) {
        let control = self.control.words();
        (control[4].load(Relaxed), control[5].load(Relaxed))
    }

    /// The first sample of an item, or the number of all.
    fn first_of(&self, item: u32) -> u32 {
        let (items, samples) = self.listed_samples();
        if item < items {
            self.work.words()[2 * item as usize + 1].load(Relaxed)
        } else {
            samples
        }
    }

    /// The first item of a batch.
    fn item_of(&self, batch: u32) -> u32 {
        let (mut low, mut high) = (0, self.listed_samples().0);
        let from = batch * self.layout.batch;
        if batch == 0 {
            return 0;
        }
        while low < high {
            let middle = low + (high - low) / 2;
            if self.first_of(middle) < from {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        low
    }

    fn work_of(&self, step: u32) -> StepWork {
        let (batch, vertex) = self.layout.batch_and_vertex(step);
        if vertex == 0 {
            let [begin, end] = [batch, batch + 1].map(|b| self.first_of(self.item_of(b)));
            let before = begin.saturating_sub(batch * self.layout.batch);
            return StepWork { count: end.saturating_sub(begin), kind: StepKind::Begun { before } };
        }
        let entry = QueueLayout::entry_of_step(step - 1) / 4;
        StepWork { count: self.control.words()[entry].load(Relaxed), kind: StepKind::Listed }
    }

    /// Walks what nobody has taken of a step, which the device asks for by the number `question`. Returns how many questions are answered by that: none
    /// if other threads are still about it, and more than one if no later one has rays.
    pub(crate) fn walk(
        &self,
        (step, question): (u32, u64),
        trees: &[WideTree],
        kernel: WalkKernel,
        bench: &mut WalkMemory,
    ) -> u32 {
        let work = self.work_of(step);
        let chunks = work.count.div_ceil(CHUNK).max(1);
        loop {
            let taken = self.cursor.fetch_update(AcqRel, Acquire, |cursor| {
                ((cursor >> 32) as u32 == question as u32 && (cursor as u32) < chunks).then_some(cursor + 1)
            });
            let Ok(cursor) = taken else { return 0 };
            let from = cursor as u32 * CHUNK;
            let count = work.count.saturating_sub(from).min(CHUNK);
            match work.kind {
                StepKind::Begun { before } => {
                    let slots = bench.slots.iter_mut().zip(before + from..);
                    slots.for_each(|(to, slot)| *to = slot);
                    self.walk_paths(step, count, trees, kernel, bench);
                }
                StepKind::Listed => {
                    let list = self.list_of(step - 1) as usize + from as usize;
                    load(&self.queue.words()[list..][..count as usize], &mut bench.slots);
                    self.walk_paths(step, count, trees, kernel, bench);
                }
            }
            if self.done.fetch_add(1, AcqRel) + 1 == chunks {
                let answered = self.finish(step);
                self.done.store(0, Relaxed);
                self.cursor.store((question + u64::from(answered)) << 32, Release);
                return answered;
            }
        }
    }

    /// First word of the list that a step writes.
    fn list_of(&self, step: u32) -> u32 {
        self.layout.lists_word[step as usize & 1]
    }

    fn scene<'a>(
        &self,
        trees: &'a [WideTree],
        bodies: &'a [Instance],
        nodes: &'a [BodyNode],
    ) -> WalkScene<'a> {
        let nodes = &nodes[..self.node_words.load(Relaxed) as usize * 4 / size_of::<BodyNode>()];
        WalkScene { bodies, trees, body_nodes: nodes }
    }

    /// Walks both rays of so many paths, and lists the paths.
    fn walk_paths(
        &self,
        step: u32,
        count: u32,
        trees: &[WideTree],
        kernel: WalkKernel,
        bench: &mut WalkMemory,
    ) {
        let (words, layout) = (self.queue.words(), &self.layout);
        let WalkMemory { bodies, nodes, rays, hits, slots } = bench;
        let slots = &mut slots[..count as usize];
        for (slot, rays) in slots.iter().zip(rays.chunks_exact_mut(2)) {
            let first = 4 * layout.rays_row as usize + 16 * *slot as usize;
            load(&words[first..][..16], bytemuck::cast_slice_mut(rays));
        }
        let scene = self.scene(trees, bodies, nodes);
        kernel.walk(&scene, &rays[..2 * slots.len()], hits);
        let is_last = layout.batch_and_vertex(step).1 + 1 == layout.vertices && layout.last_is_any;
        let (mut front, mut back) = (0, 0);
        let mut listed = [0u32; CHUNK as usize];
        for (i, &slot) in slots.iter().enumerate() {
            let [light, onward] = [rays[2 * i].kind, rays[2 * i + 1].kind].map(|kind| kind & 255 != RAY_NONE);
            let hit = layout.hits_word as usize + 2 * slot as usize;
            store(&words[hit..][..2], &hits[2 * i..][..2]);
            if onward && hits[2 * i + 1] != NO_HIT && !is_last {
                listed[front] = slot;
                front += 1;
            } else if light || onward {
                // From the end of the array on.
                back += 1;
                listed[CHUNK as usize - back] = slot;
            }
        }
        let walked = rays[..2 * slots.len()].iter().filter(|ray| ray.kind & 255 != RAY_NONE).count();
        self.walked.fetch_add(walked as u32, Relaxed);
        let list = self.list_of(step) as usize;
        let at = self.listed[0].fetch_add(front as u32, Relaxed) as usize;
        store(&words[list + at..][..front], &listed[..front]);
        let at = self.listed[1].fetch_add(back as u32, Relaxed) as usize;
        let end = list + layout.paths as usize - at;
        store(&words[end - back..end], &listed[CHUNK as usize - back..]);
    }

    fn write_entry(&self, at: usize, now: [u32; 4], groups: [u32; 2]) {
        let [front, back] = groups;
        let entry = [now, [front, 1, 1, 0], [back, 1, 1, 0], [0; 4]];
        store(&self.control.words()[at / 4..][..ENTRY_BYTES / 4], entry.as_flattened());
    }

    /// Writes what the device does after a step, once all of its rays are walked. Returns how many questions are answered by that.
    fn finish(&self, step: u32) -> u32 {
        let layout = &self.layout;
        let (batch, vertex) = layout.batch_and_vertex(step);
        let [front, back] = [0, 1].map(|i| self.listed[i].swap(0, Relaxed));
        let now = [front, back, self.list_of(step), batch * layout.batch];
        self.write_entry(
            QueueLayout::entry_of_step(step),
            now,
            [front, back].map(|n| n.div_ceil(TRACE_LANES)),
        );
        if vertex + 1 < layout.vertices || batch + 1 == layout.batches {
            return 1;
        }
        let [first, end] = [batch + 1, batch + 2].map(|b| self.item_of(b));
        if first >= end {
            // No further batch has samples, and nothing is dispatched for it.
            return layout.steps() - step;
        }
        let group = first / TRACE_LANES;
        let now = [group, 0, 0, (batch + 1) * layout.batch];
        self.write_entry(layout.entry_of_batch(batch + 1), now, [end.div_ceil(TRACE_LANES) - group, 0]);
        1
    }
}
