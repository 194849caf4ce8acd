//! Converts light events of the mock projector into notes for the telemetry, and keeps the last frames of light for
//! pictures.
//!
//! It runs where the mock runs: in the link thread at virtual pace, in the mock's own thread at real pace.

use crate::frame::job::hash_codes;
use crate::mock::{EmulatedProjector, MockProjector, Served};
use crate::pack::prepared::is_whole;
use crate::telemetry::live::SeenLight;
use crate::telemetry::monitor::RunMonitor;
use dpm_common::clock::Stopwatch;
use dpm_device::light::{LightEvent, LightKind};
use dpm_device::planes::PlaneSchedule;
use dpm_device::projector::SlotMoves;
use dpm_device::time::HostTime;
use dpm_handoff::channel::Sender;
use std::collections::VecDeque;
use std::sync::Arc;

/// What the projector did in one slot.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LightNote {
    /// The light event.
    pub event: LightEvent,
    /// Hash of the light as code values; 0 if not requested.
    pub hash: u64,
    /// Parts of it belong to another frame (prepared frames only).
    pub torn: bool,
    /// Wall time that the mock needed for it, nanoseconds; 0 for a projector outside this process.
    pub wall_ns: u64,
    /// Frames lit since the previous note of which only the number is known.
    pub unseen: u32,
}

/// One frame of light as it was emitted.
#[derive(Clone, Debug)]
pub struct LightFrame {
    /// Low 32 bits of the frame's number.
    pub frame: u32,
    /// True time of its first photon.
    pub first_photon_at: HostTime,
    /// Red, green, blue code values, rows top to bottom.
    pub codes: Vec<[u8; 3]>,
}

/// Records the light of a mock projector.
pub(crate) struct LightRecorder {
    /// `None` after [`LightRecorder::close`].
    notes: Option<Sender<LightNote>>,
    /// Notes for which there was no room.
    pub notes_lost: u64,
    keep: usize,
    hash: bool,
    /// Lit planes carry marks, in this schedule.
    marks: Option<PlaneSchedule>,
    frames: VecDeque<LightFrame>,
    /// What tracks made of the last lit slots, and how many are kept.
    moves: VecDeque<SlotMoves>,
    keep_moves: usize,
    /// Hash over all light in order.
    light_hash: u64,
    /// When the first photon of the frame on the mirrors left.
    lit_at: HostTime,
    /// Those who look at the light while the run goes on.
    observer: Option<Arc<RunMonitor>>,
}

impl LightRecorder {
    /// Sends notes to `notes` and keeps the last frames of light and the shifts of the last slots, as many of each as
    /// `keep` says. `hash`: hashes every frame of light.
    /// `marks`: the planes, in this order, come from [`crate::pack::prepared`] and are checked for parts of other
    /// frames.
    pub(crate) fn new(
        notes: Sender<LightNote>,
        [keep, keep_moves]: [usize; 2],
        hash: bool,
        marks: Option<PlaneSchedule>,
    ) -> Self {
        Self {
            notes: Some(notes),
            notes_lost: 0,
            keep,
            hash,
            marks,
            frames: VecDeque::with_capacity(keep + 1),
            moves: VecDeque::with_capacity(keep_moves),
            keep_moves,
            light_hash: 0,
            lit_at: HostTime(0),
            observer: None,
        }
    }

    /// Shows the light to those who ask for it through `monitor`.
    pub(crate) fn seen_by(self, monitor: &Arc<RunMonitor>) -> Self {
        Self { observer: Some(monitor.clone()), ..self }
    }

    /// Advances the mock to `now`, one slot at a time, and records all light.
    pub(crate) fn advance(&mut self, mock: &mut EmulatedProjector, now: HostTime) {
        use dpm_device::transport::LinkDevice;
        while let Some(due) = mock.next_due().filter(|&due| due <= now) {
            let watch = Stopwatch::start();
            mock.advance_to(due);
            self.drain(mock.projector(), watch);
        }
        let watch = Stopwatch::start();
        mock.advance_to(now);
        self.drain(mock.projector(), watch);
        if let Some(monitor) = &self.observer {
            monitor.live().show_light(|light| show(mock.projector(), self.lit_at, light));
        }
    }

    fn drain(&mut self, mock: &mut MockProjector, watch: Stopwatch) {
        self.take_moves(mock);
        while let Some(event) = mock.next_light() {
            let mut hash = 0;
            if event.kind == LightKind::Lit && (self.hash || self.keep > 0) {
                if let Some(light) = mock.light_of_frame() {
                    if self.hash {
                        hash = hash_codes(light.iter().map(|c| u32::from_le_bytes([c[0], c[1], c[2], 0])));
                        self.light_hash =
                            (self.light_hash ^ hash).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(23);
                    }
                    keep(&mut self.frames, self.keep, &event, light);
                }
            }
            if event.kind == LightKind::Lit {
                self.lit_at = event.first_photon_at;
            }
            let torn = event.kind == LightKind::Lit && self.is_torn(mock, event.frame);
            let note = LightNote { event, hash, torn, wall_ns: watch.elapsed_ns(), unseen: 0 };
            if self.notes.as_mut().is_none_or(|notes| notes.push(note).is_err()) {
                self.notes_lost += 1;
            }
        }
    }

    /// Keeps what tracks made of the slots that are over.
    fn take_moves(&mut self, mock: &mut MockProjector) {
        while let Some(moves) = mock.next_moves() {
            if self.keep_moves == 0 {
                continue;
            }
            if self.moves.len() >= self.keep_moves {
                self.moves.pop_front();
            }
            self.moves.push_back(moves);
        }
    }

    /// The hash of all light in order, in hexadecimal digits; `None` if not requested.
    pub(crate) fn hash(&self) -> Option<String> {
        self.hash.then(|| format!("{:016x}", self.light_hash))
    }

    /// Ends the notes: their receiver comes to the end.
    pub(crate) fn close(&mut self) {
        self.notes = None;
    }

    fn is_torn(&self, mock: &MockProjector, frame: Option<u32>) -> bool {
        match (&self.marks, mock.lit_planes(), frame) {
            (Some(schedule), Some(planes), Some(id)) => !is_whole(mock.raster(), schedule, planes, id),
            _ => false,
        }
    }

    /// The last frames of light and what tracks made of the last lit slots, oldest first.
    pub(crate) fn into_frames(self) -> (Vec<LightFrame>, Vec<SlotMoves>) {
        (self.frames.into(), self.moves.into())
    }
}

/// Copies what is on the mirrors now.
fn show(mock: &MockProjector, lit_at: HostTime, light: &mut SeenLight) {
    let lit = mock.lit_generation().and(mock.lit_planes());
    light.frame = lit.and(mock.lit_frame());
    light.first_photon_at = lit_at;
    light.planes.clear();
    light.planes.extend_from_slice(lit.unwrap_or(&[]));
}

/// Keeps a copy of `light`. When `limit` frames are kept, the oldest frame's memory is reused.
fn keep(frames: &mut VecDeque<LightFrame>, limit: usize, event: &LightEvent, light: &[[u8; 3]]) {
    if limit == 0 {
        return;
    }
    let mut codes =
        if frames.len() >= limit { frames.pop_front().map_or(Vec::new(), |f| f.codes) } else { Vec::new() };
    codes.clear();
    codes.extend_from_slice(light);
    frames.push_back(LightFrame {
        frame: event.frame.unwrap_or(0),
        first_photon_at: event.first_photon_at,
        codes,
    });
}
