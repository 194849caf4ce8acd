//! Packs the code values of a finished frame into bit planes, without the light that would meet a tracked head.

pub mod eye_mask;
pub mod prepared;
pub mod source;

use crate::frame::job::{hash_codes, FrameJob};
use crate::frame::Stage;
use dpm_common::clock::Stopwatch;
use dpm_render::pack::{self, Kernel, Shown};
use eye_mask::EyeMask;
use source::FrameSource;

/// What turns finished frames into planes. All planes that are sent come from here.
pub(crate) struct Packer {
    /// How to pack planes if the GPU does not.
    pub kernel: Kernel,
    /// `None` if a GPU renders.
    pub pictures: Option<FrameSource>,
    /// `None` if no head is guarded.
    pub eyes: Option<EyeMask>,
}

impl Packer {
    /// Packs the code values of a finished frame into planes. What the eyes of tracked people forbid is dark in them,
    /// whatever the picture is. With `verify` the light of the planes goes into the frame's note.
    pub(crate) fn pack(&mut self, job: &mut FrameJob, verify: bool) {
        let FrameJob { note, memory } = job;
        let watch = Stopwatch::start();
        let bytes = memory.planes.bytes().len() as u64;
        memory.sends_from_gpu = false;
        // What was written, unless something else is said below.
        note.touched_bytes = bytes;
        match (&memory.gpu, &mut self.pictures) {
            (Some(slot), _) => match slot.planes() {
                // What the GPU has packed is changed where eyes are spared, and packed otherwise where rows have odd ends.
                Some(planes) if self.eyes.is_none() && planes.len() == memory.planes.bytes().len() => {
                    (memory.sends_from_gpu, note.touched_bytes) = (true, 0);
                }
                Some(planes) => {
                    pack::gpu::take(planes, &mut memory.planes);
                    note.touched_bytes += bytes;
                }
                None => {
                    pack::pack(self.kernel, slot.codes(), &mut memory.planes);
                    note.touched_bytes += size_of_val(slot.codes()) as u64;
                }
            },
            (None, Some(FrameSource::Marked(prepared))) => {
                note.touched_bytes += prepared.pack(self.kernel, note.plan.id.0, &mut memory.planes);
            }
            (None, Some(FrameSource::Drawn(painter))) => {
                note.touched_bytes = painter.pack(self.kernel, (note.plan.id.0, note.plan.slot), memory);
            }
            (None, None) => return,
        }
        spare(job, &mut self.eyes);
        let FrameJob { note, memory } = job;
        note.timeline.wall_ns[Stage::Pack as usize] = watch.elapsed_ns();
        if !verify {
            return;
        }
        if let Some(slot) = &memory.gpu {
            let shown = Shown::by(memory.planes.schedule());
            let eyes = self.eyes.as_ref().filter(|_| note.cut_mirrors > 0);
            let is_cut = |pixel: usize| eyes.is_some_and(|eyes| eyes.is_cut(pixel));
            let lit = slot.codes().iter().enumerate().map(|(i, &code)| if is_cut(i) { 0 } else { code });
            note.code_hash = hash_codes(lit.map(|code| shown.light(code)));
        } else if let Some(FrameSource::Drawn(painter)) = &mut self.pictures {
            note.code_hash = hash_codes(painter.light_of(&memory.planes).iter().copied());
        }
    }
}

/// Makes the mirrors dark of a packed frame that `eyes` forbids, and counts them in its note.
pub(crate) fn spare(job: &mut FrameJob, eyes: &mut Option<EyeMask>) {
    let FrameJob { note, memory } = job;
    let plan = &note.plan;
    note.cut_mirrors = eyes.as_mut().map_or(0, |eyes| eyes.cut(&plan.eyes, &plan.camera, &mut memory.planes));
    if note.cut_mirrors > 0 {
        // The planes are those of the picture no longer.
        memory.picture = None;
    }
}
