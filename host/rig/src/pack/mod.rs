//! Packs the code values of a finished frame into bit planes.

pub mod prepared;
pub mod source;

use crate::frame::job::{hash_codes, FrameJob};
use crate::frame::Stage;
use dpm_common::clock::Stopwatch;
use dpm_render::pack::{self, Kernel, Shown};
use source::Pictures;

/// Packs the code values of a finished frame into planes. A job without GPU takes its picture from `pictures`.
pub(crate) fn pack(job: &mut FrameJob, kernel: Kernel, verify: bool, pictures: &mut Option<Pictures>) {
    let FrameJob { note, memory } = job;
    let watch = Stopwatch::start();
    if let Some(slot) = &memory.gpu {
        let codes = slot.codes();
        match slot.planes() {
            Some(planes) => pack::gpu::take(planes, &mut memory.planes),
            None => pack::pack(kernel, codes, &mut memory.planes),
        }
        note.timeline.wall_ns[Stage::Pack as usize] = watch.elapsed_ns();
        if verify {
            let shown = Shown::by(memory.planes.schedule());
            note.code_hash = hash_codes(codes.iter().map(|&c| shown.light(c)));
        }
        return;
    }
    match pictures {
        Some(Pictures::Marked(prepared)) => prepared.pack(kernel, note.plan.id.0, &mut memory.planes),
        Some(Pictures::Drawn(painter)) => painter.pack(kernel, note.plan.id.0, memory),
        None => return,
    }
    note.timeline.wall_ns[Stage::Pack as usize] = watch.elapsed_ns();
    if let (true, Some(Pictures::Drawn(painter))) = (verify, pictures) {
        note.code_hash = hash_codes(painter.light_of(&memory.planes).iter().copied());
    }
}
