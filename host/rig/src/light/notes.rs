//! The way of a frame's note from the link to the collector, beside the frame path.
//!
//! The link exchanges the note of a frame for a spare one and never waits. A collector that gets no time returns no
//! spare notes. The link then keeps the note, the frame is not recorded, and its loss is counted; nothing about the
//! light changes. (Before this the notes came back through the collector to planning, and a starved collector cost a
//! fifth of the slots.)

use crate::frame::job::FrameNote;
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use dpm_handoff::channel::{channel, Receiver, Sender};
use dpm_handoff::wake::WaitPolicy;
use std::sync::Arc;

/// Frames whose notes the collector may be behind by: a quarter of a second at 947 Hz.
const SPARE_NOTES: usize = 256;

/// The link's end.
pub(crate) struct NoteSender {
    notes: Sender<Box<FrameNote>>,
    spare: Receiver<Box<FrameNote>>,
    /// The last frame's note was kept back.
    kept_back: bool,
    monitor: Arc<RunMonitor>,
}

/// The collector's end.
pub(crate) struct NoteReceiver {
    notes: Receiver<Box<FrameNote>>,
    spare: Sender<Box<FrameNote>>,
}

/// A way for the notes of `rig`; `monitor` counts the frames that are not recorded. All its memory is allocated here.
pub(crate) fn note_channel(rig: &Rig, monitor: &Arc<RunMonitor>) -> (NoteSender, NoteReceiver) {
    let (notes_in, notes) = channel(SPARE_NOTES, WaitPolicy::Park);
    let (mut spare_in, spare) = channel(SPARE_NOTES, WaitPolicy::Park);
    for _ in 0..SPARE_NOTES {
        let _ = spare_in.push(Box::new(FrameNote::new(rig)));
    }
    let sender = NoteSender { notes: notes_in, spare, kept_back: false, monitor: monitor.clone() };
    (sender, NoteReceiver { notes, spare: spare_in })
}

impl NoteSender {
    /// Passes on the note of a frame that the link has finished with. Returns a note for another frame: a spare one,
    /// or the same if there is none.
    pub(crate) fn exchange(&mut self, mut note: Box<FrameNote>) -> Box<FrameNote> {
        let Some(spare) = self.spare.try_pop() else {
            self.kept_back = true;
            self.monitor.count_unrecorded();
            return note;
        };
        note.is_after_gap = std::mem::take(&mut self.kept_back);
        match self.notes.push(note) {
            Ok(()) => spare,
            // The collector has ended.
            Err(note) => note,
        }
    }
}

impl NoteReceiver {
    /// The next note. Give it back with [`NoteReceiver::give_back`].
    pub(crate) fn try_pop(&mut self) -> Option<Box<FrameNote>> {
        self.notes.try_pop()
    }

    /// Returns a note that was read.
    pub(crate) fn give_back(&mut self, note: Box<FrameNote>) {
        // There is a place for every note. A link that has ended needs none.
        let _ = self.spare.push(note);
    }

    /// True if no note waits.
    pub(crate) fn is_empty(&self) -> bool {
        self.notes.is_empty()
    }

    /// True if no note waits and none will come.
    pub(crate) fn is_finished(&self) -> bool {
        self.notes.is_finished()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};
    use crate::plan::frame::FrameId;
    use dpm_device::planes::Raster;

    /// A collector that reads nothing costs the link no note, and every frame that it misses is counted.
    #[test]
    fn a_link_whose_collector_reads_nothing_always_gets_a_note() {
        let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
        let rig = Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}"));
        let monitor = Arc::new(RunMonitor::default());
        let (mut link, mut collector) = note_channel(&rig, &monitor);
        let mut note = Box::new(FrameNote::new(&rig));
        let missed = 1000;
        for frame in 0..SPARE_NOTES as u64 + missed {
            note.plan.id = FrameId(frame);
            note = link.exchange(note);
        }
        let mut read = Vec::new();
        while let Some(note) = collector.try_pop() {
            read.push((note.plan.id.0, note.is_after_gap));
            collector.give_back(note);
        }
        assert_eq!(read, (0..SPARE_NOTES as u64).map(|frame| (frame, false)).collect::<Vec<_>>());
        note.plan.id = FrameId(5000);
        let note = link.exchange(note);
        let late = collector.try_pop().expect("there are spare notes again");
        assert_eq!((late.plan.id.0, late.is_after_gap), (5000, true));
        assert_eq!(monitor.counts().frames_unrecorded, missed);
        drop((link, note));
        assert!(collector.is_finished());
    }
}
