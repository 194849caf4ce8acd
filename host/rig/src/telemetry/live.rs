//! What an observer sees of a run while it goes on: the collector's figures, the poses of the newest frames, and the
//! light of single frames.
//!
//! All of it is made only while somebody looks, by the collector and by the mock projector's thread. The frame path
//! has no part in it.

use super::histogram_steps::Steps;
use super::miss_log::MissRun;
use super::report::Report;
use crate::plan::dark::DarkCause;
use crate::plan::light_centre::{light_centre_at, true_poses_at_centre};
use crate::rig::Rig;
use dpm_common::unix::monotonic_ns;
use dpm_device::time::HostTime;
use dpm_handoff::path::Lock;
use glam::{DAffine3, DVec3};
use std::collections::VecDeque;
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, MutexGuard, OnceLock, PoisonError};

/// How long a look lasts, nanoseconds: an observer looks again before that.
const LOOK_NS: u64 = 2_000_000_000;
/// The shortest time between two snapshots, nanoseconds. One costs the collector about two milliseconds.
const EVERY_NS: u64 = 500_000_000;
/// Frames whose poses are remembered until their light is seen.
const DRAWN: usize = 32;

/// A tracked body, as the newest frame shows it.
#[derive(Clone, Debug, PartialEq)]
pub struct LiveBody {
    /// Its name in the rig file.
    pub name: String,
    /// The tracker has reported it since the run began.
    pub seen: bool,
    /// Why no light falls on it; `None` while light does.
    pub dark: Option<DarkCause>,
    /// Where its origin is, world coordinates, metres.
    pub at_m: [f64; 3],
}

/// The distribution of an interval up to now, and where its figures come from.
#[derive(Clone, Debug)]
pub struct LiveInterval {
    /// Its name in reports.
    pub name: &'static str,
    /// The figures are constants of the rig file.
    pub modelled: bool,
    /// How many frames took how long.
    pub steps: Steps,
}

/// The newest frame of which the link has disposed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LiveFrame {
    /// Its number.
    pub id: u64,
    /// Age of the oldest sample among its lit bodies when the frame was due, nanoseconds; `None` if none is lit.
    pub sample_age_ns: Option<i64>,
    /// Average samples per pixel.
    pub budget_spp: f64,
    /// Which version of the operator's parameters it uses.
    pub parameters: u64,
    /// The longest time for which prediction may extend a body's track, nanoseconds.
    pub predict_ns: i64,
    /// When its slot begins.
    pub due_at: HostTime,
}

/// The collector's figures at one moment.
#[derive(Clone, Debug)]
pub struct LiveSnapshot {
    /// The report as it would be if the run ended now. The fields that are known only at the end are empty.
    pub report: Report,
    /// The run is over, and the figures are final.
    pub is_final: bool,
    /// Every tracked body.
    pub bodies: Vec<LiveBody>,
    /// Every interval, in the order of [`super::interval::Interval::ALL`].
    pub intervals: Vec<LiveInterval>,
    /// The newest frame.
    pub frame: LiveFrame,
    /// Frames planned.
    pub planned: u64,
    /// Rays, with those that were proven to meet nothing.
    pub rays: u64,
    /// Those of them that were walked through the scene.
    pub walked_rays: u64,
    /// Samples taken.
    pub samples: u64,
    /// The last missed slots, newest first.
    pub misses: Vec<MissRun>,
    /// Flights that the flight recorder has written; `None` if it is off.
    pub flights: Option<u64>,
}

/// What a frame was drawn for.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameSubject {
    /// Low 32 bits of its number.
    pub frame: u32,
    /// Per tracked body: world-from-mesh at the centre of its light.
    pub poses: Vec<DAffine3>,
    /// Per tracked body: no light falls on it.
    pub dark: Vec<bool>,
    /// What the observer looks at, in world coordinates, metres.
    pub gaze: DVec3,
}

/// The light of a mock projector at one moment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SeenLight {
    /// Low 32 bits of the number of the frame on the mirrors; `None` while the projector is dark.
    pub frame: Option<u32>,
    /// When the first photon of that frame left.
    pub first_photon_at: HostTime,
    /// Its bit planes, one after the other in the order of the rig's schedule, as tracks moved them; empty while it is dark.
    pub planes: Vec<u8>,
    /// Tracks moved a part of it to where the bodies were by then.
    pub is_moved: bool,
}

/// Shared between a run and its observers.
#[derive(Default)]
pub struct Live {
    rig: OnceLock<Arc<Rig>>,
    looked_until_ns: AtomicU64,
    told_at_ns: AtomicU64,
    snapshot: Lock<Option<Arc<LiveSnapshot>>>,
    drawn: Lock<VecDeque<FrameSubject>>,
    light_wanted: AtomicBool,
    light: Lock<SeenLight>,
    follower: Lock<Option<SyncSender<SeenLight>>>,
}

impl fmt::Debug for Live {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Live").field("is_looked_at", &self.is_looked_at()).finish_non_exhaustive()
    }
}

fn held<T>(lock: &Lock<T>) -> MutexGuard<'_, T> {
    // Nothing panics while it holds one of these locks.
    lock.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Live {
    /// Says that somebody looks, for the next two seconds.
    pub fn look(&self) {
        self.looked_until_ns.store(monotonic_ns() + LOOK_NS, Ordering::Relaxed);
    }

    /// True while somebody looks.
    pub fn is_looked_at(&self) -> bool {
        monotonic_ns() < self.looked_until_ns.load(Ordering::Relaxed)
    }

    /// The rig that runs; `None` before it is built.
    pub fn rig(&self) -> Option<&Arc<Rig>> {
        self.rig.get()
    }

    /// The rig of the run; the first call counts.
    pub(crate) fn set_rig(&self, rig: &Arc<Rig>) {
        let _ = self.rig.set(rig.clone());
    }

    /// The newest snapshot; `None` before the first one. It is at most half a second old while somebody looks.
    pub fn snapshot(&self) -> Option<Arc<LiveSnapshot>> {
        held(&self.snapshot).clone()
    }

    /// True when the collector is to make a snapshot.
    pub(crate) fn wants_snapshot(&self) -> bool {
        let now = monotonic_ns();
        now < self.looked_until_ns.load(Ordering::Relaxed)
            && now.saturating_sub(self.told_at_ns.load(Ordering::Relaxed)) >= EVERY_NS
    }

    /// Publishes a snapshot.
    pub(crate) fn tell(&self, snapshot: LiveSnapshot) {
        self.told_at_ns.store(monotonic_ns(), Ordering::Relaxed);
        *held(&self.snapshot) = Some(Arc::new(snapshot));
    }

    /// Remembers what frame `frame` was drawn for. Called for every frame while somebody looks.
    pub(crate) fn drew(&self, frame: u32, poses: &[DAffine3], dark: &[Option<DarkCause>], gaze: DVec3) {
        let mut drawn = held(&self.drawn);
        let mut one = if drawn.len() >= DRAWN { drawn.pop_front() } else { None }.unwrap_or_default();
        (one.frame, one.gaze) = (frame, gaze);
        one.poses.clear();
        one.poses.extend_from_slice(poses);
        one.dark.clear();
        one.dark.extend(dark.iter().map(Option::is_some));
        drawn.push_back(one);
    }

    /// What frame `frame` was drawn for; the newest frame if that one is not known.
    pub fn drawn(&self, frame: Option<u32>) -> Option<FrameSubject> {
        let drawn = held(&self.drawn);
        drawn.iter().rev().find(|d| Some(d.frame) == frame).or_else(|| drawn.back()).cloned()
    }

    /// Per tracked body: world-from-mesh where `light` fell, and when that was, nanoseconds on the host's clock. It is what its
    /// frame was drawn for; light that tracks moved fell where the bodies were by then, which is `None` unless the tracker is the
    /// mock.
    pub fn poses_of(&self, light: &SeenLight) -> Option<(Vec<DAffine3>, i64)> {
        let rig = self.rig()?;
        let poses = if light.is_moved {
            true_poses_at_centre(rig, light.first_photon_at)?
        } else {
            self.drawn(light.frame)?.poses
        };
        Some((poses, light_centre_at(rig, light.first_photon_at).0))
    }

    /// Asks the mock projector for its light; [`Live::take_light`] has it a moment later.
    pub fn want_light(&self) {
        self.light_wanted.store(true, Ordering::Release);
    }

    /// True while light that was asked for has not come.
    pub(crate) fn is_light_wanted(&self) -> bool {
        self.light_wanted.load(Ordering::Acquire)
    }

    /// The light that was asked for, in exchange for the memory of an earlier one. False while it has not come, which
    /// it never does for a projector outside this process.
    pub fn take_light(&self, into: &mut SeenLight) -> bool {
        if self.is_light_wanted() {
            return false;
        }
        std::mem::swap(&mut *held(&self.light), into);
        true
    }

    /// Sends the light of every slot of the run that begins next to `to`, whose receiver holds the run up as long as it has no
    /// room: for runs at virtual pace. The channel closes when the mock projector of the run is gone.
    pub fn follow(&self, to: SyncSender<SeenLight>) {
        *held(&self.follower) = Some(to);
    }

    /// Where the light of every slot is to go, from now on for the caller alone to send; `None` if nobody follows it.
    pub fn take_follower(&self) -> Option<SyncSender<SeenLight>> {
        held(&self.follower).take()
    }

    /// Calls `see` with the place for the light, if it is asked for.
    pub(crate) fn show_light(&self, see: impl FnOnce(&mut SeenLight)) {
        if self.is_light_wanted() {
            see(&mut held(&self.light));
            self.light_wanted.store(false, Ordering::Release);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_wanted_while_nobody_looks() {
        let live = Live::default();
        assert!(!live.is_looked_at() && !live.wants_snapshot());
        live.look();
        assert!(live.is_looked_at() && live.wants_snapshot());
        live.show_light(|_| panic!("nobody asked for light"));
    }

    #[test]
    fn light_is_made_once_for_each_request_and_memory_goes_round() {
        let live = Live::default();
        let mut mine = SeenLight { planes: Vec::with_capacity(64), ..SeenLight::default() };
        live.want_light();
        assert!(!live.take_light(&mut mine), "it has not come yet");
        live.show_light(|light| {
            light.frame = Some(7);
            light.planes.extend_from_slice(&[1, 2, 3]);
        });
        live.show_light(|_| panic!("asked once"));
        assert!(live.take_light(&mut mine));
        assert_eq!((mine.frame, mine.planes.as_slice()), (Some(7), [1, 2, 3].as_slice()));
        live.want_light();
        live.show_light(|light| assert_eq!(light.planes.capacity(), 64));
    }

    #[test]
    fn poses_belong_to_their_frame_and_few_are_kept() {
        let live = Live::default();
        assert_eq!(live.drawn(Some(1)), None);
        let pose = |k: u32| DAffine3::from_translation(glam::DVec3::splat(f64::from(k)));
        for k in 0..100 {
            live.drew(k, &[pose(k)], &[(k % 2 == 0).then_some(DarkCause::Silent)], DVec3::ZERO);
        }
        let of = |frame| live.drawn(frame).map(|d| (d.frame, d.poses[0], d.dark[0]));
        assert_eq!(of(Some(98)), Some((98, pose(98), true)));
        assert_eq!(of(Some(3)), Some((99, pose(99), false)), "forgotten: the newest stands in");
        assert_eq!(held(&live.drawn).len(), DRAWN);
    }
}
