//! Converts light events of the mock projector into notes for the telemetry, and keeps the last frames of light for
//! pictures.
//!
//! It runs where the mock runs: in the link thread at virtual pace, in the mock's own thread at real pace.

use crate::frame::job::hash_codes;
use crate::light::measures::is_followed;
use crate::mock::{EmulatedProjector, MockProjector, Served};
use crate::pack::prepared::is_whole;
use crate::telemetry::live::SeenLight;
use crate::telemetry::monitor::RunMonitor;
use dpm_common::clock::Stopwatch;
use dpm_device::light::{LightEvent, LightKind};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::projector::{light_of_planes, SlotMoves};
use dpm_device::time::HostTime;
use dpm_handoff::channel::{channel, Receiver, Sender};
use dpm_handoff::wake::WaitPolicy;
use std::collections::VecDeque;
use std::sync::mpsc::SyncSender;
use std::sync::Arc;

/// Capacity for light events between the projector and the collector: eight seconds at 947 Hz.
const LIGHTS: usize = 8192;
/// The same for moves of slots that are followed: two seconds.
const MOVES: usize = 128;

/// What the projector did in one slot.
#[derive(Clone, Debug)]
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

/// Notes on light for the collector, and what tracks made of the slots that are followed plane by plane. Those are large
/// and few, so that they have a channel of their own: no note has to carry them, and no memory is taken for one.
pub(crate) struct LightSender {
    /// What the projector did in each slot.
    pub notes: Sender<LightNote>,
    moves: Sender<SlotMoves>,
}

/// The other end of a [`LightSender`].
pub(crate) struct LightReceiver {
    /// What the projector did in each slot.
    pub notes: Receiver<LightNote>,
    moves: Receiver<SlotMoves>,
    held: Option<SlotMoves>,
}

/// The way of light from the projector to the collector. Notes and moves for which there is no room are lost.
pub(crate) fn light_channel() -> (LightSender, LightReceiver) {
    let (notes_in, notes) = channel(LIGHTS, WaitPolicy::Park);
    let (moves_in, moves) = channel(MOVES, WaitPolicy::Park);
    (LightSender { notes: notes_in, moves: moves_in }, LightReceiver { notes, moves, held: None })
}

impl LightReceiver {
    /// The next moves of a slot before `slot`. They are there as soon as a note of `slot` is.
    pub(crate) fn moves_before(&mut self, slot: u64) -> Option<SlotMoves> {
        let next = self.held.take().or_else(|| self.moves.try_pop())?;
        if next.slot < slot {
            return Some(next);
        }
        self.held = Some(next);
        None
    }
}

/// One frame of light as it was emitted, moved by tracks where they moved it. Of the last frame of a run the moves may be
/// unknown; it is as it was sent.
#[derive(Clone, Debug)]
pub struct LightFrame {
    /// Low 32 bits of the frame's number.
    pub frame: u32,
    /// True time of its first photon.
    pub first_photon_at: HostTime,
    /// Red, green, blue code values, rows top to bottom.
    pub codes: Vec<[u8; 3]>,
    /// Tracks moved a part of it.
    pub is_moved: bool,
}

/// The planes on the mirrors as they were sent, kept until it is known what tracks made of them.
#[derive(Default)]
struct SentPlanes {
    /// The count of lit frames that they belong to.
    generation: Option<u64>,
    frame: Option<u32>,
    planes: Vec<u8>,
    /// The same as tracks moved them, and their light.
    moved: Vec<u8>,
    light: Vec<[u8; 3]>,
}

/// Records the light of a mock projector.
pub(crate) struct LightRecorder {
    /// `None` after [`LightRecorder::close`].
    lights: Option<LightSender>,
    /// Notes for which there was no room.
    pub notes_lost: u64,
    keep: usize,
    hash: bool,
    schedule: PlaneSchedule,
    /// Lit planes carry marks.
    is_marked: bool,
    sent: SentPlanes,
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
    /// Who is to see the light of every slot; `None` if nobody is.
    follower: Option<SyncSender<SeenLight>>,
}

impl LightRecorder {
    /// Sends notes to `lights` and keeps the last frames of light and the shifts of the last slots, as many of each as
    /// `keep` says. `hash`: hashes every frame of light.
    /// `is_marked`: the planes, in the order of `schedule`, come from [`crate::pack::prepared`] and are checked for parts of
    /// other frames.
    pub(crate) fn new(
        lights: LightSender,
        [keep, keep_moves]: [usize; 2],
        hash: bool,
        schedule: PlaneSchedule,
        is_marked: bool,
    ) -> Self {
        Self {
            lights: Some(lights),
            notes_lost: 0,
            keep,
            hash,
            schedule,
            is_marked,
            sent: SentPlanes::default(),
            frames: VecDeque::with_capacity(keep + 1),
            moves: VecDeque::with_capacity(keep_moves),
            keep_moves,
            light_hash: 0,
            lit_at: HostTime(0),
            observer: None,
            follower: None,
        }
    }

    /// Shows the light to those who ask for it through `monitor`.
    pub(crate) fn seen_by(self, monitor: &Arc<RunMonitor>) -> Self {
        Self { observer: Some(monitor.clone()), follower: monitor.live().take_follower(), ..self }
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
            let projector = mock.projector();
            // Where the projector follows tracks, light is shown when its slot is over.
            if !projector.follows_tracks() || projector.lit_generation().is_none() {
                monitor.live().show_light(|light| show(projector, self.lit_at, light));
            }
        }
    }

    fn drain(&mut self, mock: &mut MockProjector, watch: Stopwatch) {
        self.take_moves(mock);
        while let Some(event) = mock.next_light() {
            let mut hash = 0;
            if event.kind == LightKind::Lit && (self.hash || self.keep > 0) {
                if let Some(light) = mock.light_of_frame() {
                    if self.hash {
                        hash = hash_of(light);
                        self.light_hash = mixed(self.light_hash, hash);
                    }
                    keep(&mut self.frames, self.keep, &event, light);
                }
            }
            if event.kind == LightKind::Lit {
                self.lit_at = event.first_photon_at;
            }
            if self.follower.is_some() && event.kind == LightKind::Lit && !mock.follows_tracks() {
                let mut light = SeenLight::default();
                show(mock, event.first_photon_at, &mut light);
                self.send(light);
            }
            let torn = event.kind == LightKind::Lit && self.is_torn(mock, event.frame);
            let note = LightNote { event, hash, torn, wall_ns: watch.elapsed_ns(), unseen: 0 };
            if self.lights.as_mut().is_none_or(|lights| lights.notes.push(note).is_err()) {
                self.notes_lost += 1;
            }
        }
        self.remember(mock);
    }

    /// Sends the light of a slot to whoever follows.
    fn send(&mut self, light: SeenLight) {
        if self.follower.as_ref().is_some_and(|follower| follower.send(light).is_err()) {
            self.follower = None;
        }
    }

    /// Keeps the planes on the mirrors if somebody will want to know what tracks made of them.
    fn remember(&mut self, mock: &MockProjector) {
        let is_wanted = self.hash
            || self.keep > 0
            || self.follower.is_some()
            || self.observer.as_ref().is_some_and(|monitor| monitor.live().is_light_wanted());
        let generation = mock.lit_generation();
        if !is_wanted || !mock.follows_tracks() || generation == self.sent.generation {
            return;
        }
        self.sent.generation = generation;
        self.sent.frame = mock.lit_frame();
        self.sent.planes.clear();
        self.sent.planes.extend_from_slice(mock.lit_planes().unwrap_or(&[]));
    }

    /// Takes what tracks made of the slots that are over, and makes it a part of their light. Sends those that are followed
    /// plane by plane.
    fn take_moves(&mut self, mock: &mut MockProjector) {
        while let Some(moves) = mock.next_moves() {
            if is_followed(u64::from(moves.frame)) {
                if let Some(lights) = &mut self.lights {
                    // Without them the frame is not followed, and the report says of how many frames its figures are.
                    let _ = lights.moves.push(moves);
                }
            }
            self.apply(mock.raster(), &moves);
            if self.keep_moves == 0 {
                continue;
            }
            if self.moves.len() >= self.keep_moves {
                self.moves.pop_front();
            }
            self.moves.push_back(moves);
        }
    }

    /// Makes the moves of a slot a part of its light.
    fn apply(&mut self, raster: Raster, moves: &SlotMoves) {
        let sent = &mut self.sent;
        let live = self.observer.as_ref().map(|monitor| monitor.live()).filter(|live| live.is_light_wanted());
        let is_known = sent.frame == Some(moves.frame) && !sent.planes.is_empty();
        if !is_known || !(moves.is_any() || live.is_some() || self.follower.is_some()) {
            return;
        }
        sent.moved.resize(sent.planes.len(), 0);
        moves.move_planes(raster, &sent.planes, &mut sent.moved);
        if let Some(follower) = &self.follower {
            let light = SeenLight {
                frame: Some(moves.frame),
                first_photon_at: moves.first_photon_at,
                is_moved: moves.is_any(),
                planes: sent.moved.clone(),
            };
            // Whoever no longer follows has seen enough.
            let _ = follower.send(light);
        }
        if let Some(live) = live {
            live.show_light(|light| {
                (light.frame, light.first_photon_at) = (Some(moves.frame), moves.first_photon_at);
                light.is_moved = moves.is_any();
                light.planes.clone_from(&sent.moved);
            });
        }
        let of_slot = |light: &&mut LightFrame| {
            light.frame == moves.frame && light.first_photon_at == moves.first_photon_at
        };
        let kept = self.frames.iter_mut().rev().find(of_slot);
        if !moves.is_any() || (kept.is_none() && !self.hash) {
            return;
        }
        sent.light.resize(raster.pixel_count(), [0; 3]);
        light_of_planes(raster, &self.schedule, &sent.moved, &mut sent.light);
        if self.hash {
            self.light_hash = mixed(self.light_hash, hash_of(&sent.light));
        }
        if let Some(kept) = kept {
            kept.is_moved = true;
            kept.codes.copy_from_slice(&sent.light);
        }
    }

    /// The hash of all light in order, in hexadecimal digits; `None` if not requested.
    pub(crate) fn hash(&self) -> Option<String> {
        self.hash.then(|| format!("{:016x}", self.light_hash))
    }

    /// Ends the notes: their receiver comes to the end.
    pub(crate) fn close(&mut self) {
        self.lights = None;
    }

    fn is_torn(&self, mock: &MockProjector, frame: Option<u32>) -> bool {
        let (true, Some(planes), Some(id)) = (self.is_marked, mock.lit_planes(), frame) else { return false };
        !is_whole(mock.raster(), &self.schedule, planes, id)
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
    light.is_moved = false;
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
        is_moved: false,
    });
}

/// Hash of the light of a frame.
fn hash_of(light: &[[u8; 3]]) -> u64 {
    hash_codes(light.iter().map(|c| u32::from_le_bytes([c[0], c[1], c[2], 0])))
}

/// A hash over several frames, and one more.
fn mixed(all: u64, one: u64) -> u64 {
    (all ^ one).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(23)
}
