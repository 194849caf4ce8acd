//! The eye guard: the newest tracks of heads into spheres that hold every place where a head can be while a frame is lit.
//!
//! A sphere is what a head can reach. While samples come it is about the predicted place, as large as the rig file says
//! and as prediction may err. A head that is not seen, or that jumps farther than it can move, keeps its last sphere,
//! which grows at [`SPEED_M_S`] until a sample lies in it again; where the head was said to be has a sphere too. Labels
//! that the tracker exchanges are such jumps, so both places stay dark. Nor is a head found again where another one is:
//! that may be the other one under its label.

use crate::rig::{GuardedHead, Rig};
use crate::tracks::TrackSnapshot;
use dpm_device::time::HostTime;
use dpm_tracking::TrackState;
use glam::DVec3;

/// How fast a head moves that nobody sees, metres per second.
const SPEED_M_S: f64 = 2.0;
/// How far ahead of its newest sample a head's motion is extrapolated, seconds. After that it goes anywhere.
const EXTRAPOLATED_S: f64 = 0.05;
/// Standard deviations of the predicted place that are guarded.
const SIGMAS: f64 = 3.0;
/// Acceleration that the filters may not know of, metres per second squared: a head that turns round.
const ACCELERATION_M_S2: f64 = 20.0;
/// A sample this far from where a head can be is still its own, metres.
const SURPRISE_M: f64 = 0.1;

/// No two heads are nearer to each other than this, metres.
const APART_M: f64 = 0.2;

/// A sphere in which no light may be, in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EyeGuard {
    /// Its centre, metres.
    pub centre: DVec3,
    /// Its radius, metres.
    pub radius_m: f64,
}

/// What must stay dark of a frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GuardedEyes {
    /// The spheres of all heads.
    pub spheres: Vec<EyeGuard>,
    /// The first head that has been lost for longer than it may be, among [`Rig::heads`]: the whole frame is dark.
    pub lost: Option<usize>,
}

impl GuardedEyes {
    /// Nothing, with room for the heads of `rig`.
    pub(crate) fn empty(rig: &Rig) -> Self {
        Self { spheres: Vec::with_capacity(2 * rig.heads.len()), lost: None }
    }
}

/// What is known of the heads of a rig.
#[derive(Clone, Debug)]
pub(crate) struct HeadWatch {
    /// For each of [`Rig::heads`]: the newest state that the head can have come to.
    believed: Vec<Option<TrackState>>,
}

impl HeadWatch {
    /// No head was seen yet.
    pub(crate) fn new(rig: &Rig) -> Self {
        Self { believed: vec![None; rig.heads.len()] }
    }

    /// Whether the sample of `state`, told of head `i`, lies where another head can be.
    fn is_another(
        &self,
        heads: &[GuardedHead],
        snapshot: &TrackSnapshot,
        i: usize,
        state: &TrackState,
    ) -> bool {
        heads.iter().zip(&self.believed).enumerate().any(|(j, (other, believed))| {
            let known = newest_of(snapshot, other).or(*believed);
            j != i && known.is_some_and(|known| is_within(reach(&known, state.captured_at), state, APART_M))
        })
    }

    /// Writes to `eyes` what must stay dark of a frame that may be lit at any time of `light`, its first instant and its
    /// last, by the tracks that were read at `now`.
    pub(crate) fn guard(
        &mut self,
        heads: &[GuardedHead],
        snapshot: &TrackSnapshot,
        now: HostTime,
        light: [HostTime; 2],
        eyes: &mut GuardedEyes,
    ) {
        eyes.spheres.clear();
        eyes.lost = None;
        for (i, head) in heads.iter().enumerate() {
            let newest = newest_of(snapshot, head);
            if let Some(state) = newest {
                let known = self.believed[i];
                let is_found = |known: &TrackState| {
                    goes_on(known, &state)
                        || is_within(reach(known, state.captured_at), &state, SURPRISE_M)
                            && !self.is_another(heads, snapshot, i, &state)
                };
                let is_first = known.is_none() && !self.is_another(heads, snapshot, i, &state);
                if is_first || known.as_ref().is_some_and(is_found) {
                    self.believed[i] = newest;
                } else {
                    eyes.spheres.push(swept(&state, light, head.radius_m));
                }
            }
            let believed = self.believed[i];
            eyes.spheres.extend(believed.map(|state| swept(&state, light, head.radius_m)));
            let unseen_ns = believed.map_or(i64::MAX, |state| now.ns_since(state.captured_at));
            if unseen_ns > head.lost_ns && eyes.lost.is_none() {
                eyes.lost = Some(i);
            }
        }
    }
}

/// The newest state of what is tracked of `head`.
fn newest_of(snapshot: &TrackSnapshot, head: &GuardedHead) -> Option<TrackState> {
    snapshot.tracks.get(head.tracked).copied().flatten().map(|(state, _)| state)
}

/// Where a head with the track `state` can be at `at`: the centre, and by how much it may be elsewhere, metres.
fn reach(state: &TrackState, at: HostTime) -> (DVec3, f64) {
    let horizon_s = at.ns_since(state.captured_at) as f64 * 1e-9;
    let ahead_s = horizon_s.clamp(-EXTRAPOLATED_S, EXTRAPOLATED_S);
    let predicted = state.predict(state.captured_at.plus_ns((ahead_s * 1e9) as i64));
    let unknown_m = SIGMAS * predicted.position_sigma_m + 0.5 * ACCELERATION_M_S2 * ahead_s * ahead_s;
    let beyond_s = (horizon_s.abs() - EXTRAPOLATED_S).max(0.0);
    (DVec3::from_array(predicted.pose.position_m), unknown_m + SPEED_M_S * beyond_s)
}

/// Whether the newest sample of `state` lies within `more_m` of a place that is known as well as [`reach`] says.
fn is_within((centre, unknown_m): (DVec3, f64), state: &TrackState, more_m: f64) -> bool {
    let at = DVec3::from_array(state.predict(state.captured_at).pose.position_m);
    // False for places that are no numbers.
    (at - centre).length() <= unknown_m + more_m
}

/// Whether `state` continues the motion of `known` without a gap.
fn goes_on(known: &TrackState, state: &TrackState) -> bool {
    let gap_s = state.captured_at.ns_since(known.captured_at) as f64 * 1e-9;
    gap_s <= EXTRAPOLATED_S && is_within(reach(known, state.captured_at), state, SURPRISE_M)
}

/// The sphere that holds a head of `radius_m` from the first instant of `light` to the last.
fn swept(state: &TrackState, light: [HostTime; 2], radius_m: f64) -> EyeGuard {
    let [first, last] = light;
    let middle = first.plus_ns(last.ns_since(first) / 2);
    let [(begin, early_m), (on_way, _), (end, late_m)] = [first, middle, last].map(|at| reach(state, at));
    let centre = 0.5 * (begin + end);
    // A way of constant acceleration is nowhere farther from its chord than in the middle of its time.
    let way_m = 0.5 * (end - begin).length() + (on_way - centre).length();
    EyeGuard { centre, radius_m: radius_m + way_m + early_m.max(late_m) }
}
