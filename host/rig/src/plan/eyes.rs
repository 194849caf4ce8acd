//! The eye guard: the newest tracks of heads into spheres that hold every place where a head can be while a frame is lit.
//!
//! A sphere is what a head can reach. While samples come it is about the predicted place, as large as the rig file says
//! and as prediction may err. A head that is not seen, or that jumps farther than it can move, keeps its last sphere,
//! which grows at [`SPEED_M_S`] until a sample lies in it again; where the head was said to be has a sphere too. Labels
//! that the tracker exchanges are such jumps, so both places stay dark. Nor is a head found again where another one is, or
//! where a body was that is not seen there under its own label: that may be the other one under the head's label.

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

/// No two heads are nearer to each other than this, metres. What is nearer to a body's place may be the body.
const APART_M: f64 = 0.2;

/// What is told of a head with exchanged labels is this much older than what it goes on from, at most, seconds.
const EXCHANGED_S: f64 = 0.25;
/// A filter that took a jump for a motion, or lost sight of one, is right again when it has had a head's speed for so long,
/// nanoseconds.
const SETTLES_NS: i64 = 100_000_000;
/// A tracker that has named a head for so long where it cannot be is believed, nanoseconds.
const BELIEVED_NS: i64 = 10_000_000_000;

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

/// Since when a filter says without a gap that something moves as a head does.
#[derive(Clone, Copy, Debug, Default)]
struct Calm(Option<HostTime>);

impl Calm {
    fn see(&mut self, state: &TrackState, has_gap: bool) {
        let since = self.0.filter(|_| !has_gap).unwrap_or(state.captured_at);
        self.0 = (state.position.mean.velocity.length() <= SPEED_M_S).then_some(since);
    }

    /// For at least `ns`.
    fn lasts(self, state: &TrackState, ns: i64) -> bool {
        self.0.is_some_and(|since| state.captured_at.ns_since(since) >= ns)
    }
}

/// What is known of something tracked that is no head.
#[derive(Clone, Copy, Debug, Default)]
struct Bystander {
    /// The newest state that it can have come to, under its own label or under a head's.
    believed: Option<TrackState>,
    /// It is not seen there under its own label.
    is_astray: bool,
    /// See [`Calm`]: what has its label.
    calm: Calm,
}

impl Bystander {
    /// Whether `state`, told of a head, may be this.
    fn may_be(&self, state: &TrackState) -> bool {
        self.is_astray && self.believed.is_some_and(|known| is_near(&known, state))
    }
}

/// What is known of a head.
#[derive(Clone, Copy, Debug, Default)]
struct HeadBelief {
    /// The newest state that it can have come to.
    believed: Option<TrackState>,
    /// That was told of it, and not of a body under whose label it goes on.
    is_own: bool,
    /// Since when what the tracker says of it is not believed.
    doubted_since: Option<HostTime>,
    /// See [`Calm`].
    calm: Calm,
}

impl HeadBelief {
    /// Takes note of the speed that the filter says.
    fn watch(&mut self, state: &TrackState) {
        let has_gap = self.is_own && !self.believed.is_some_and(|known| goes_on(&known, state));
        self.calm.see(state, has_gap);
    }

    /// Whether its filter is over the last jump.
    fn is_settled(&self, state: &TrackState) -> bool {
        self.calm.lasts(state, if self.believed.is_some() { SETTLES_NS } else { 0 })
    }
}

/// What is known of the heads of a rig.
#[derive(Clone, Debug)]
pub(crate) struct HeadWatch {
    /// Those of [`Rig::heads`].
    heads: Vec<HeadBelief>,
    /// All that is tracked besides, each with its index among [`Rig::tracked`].
    bystanders: Vec<(usize, Bystander)>,
}

impl HeadWatch {
    /// No head was seen yet.
    pub(crate) fn new(rig: &Rig) -> Self {
        let is_head = |i: &usize| rig.heads.iter().any(|head| head.tracked == *i);
        let others = (0..rig.tracked_count()).filter(|i| !is_head(i) && !rig.heads.is_empty());
        Self {
            heads: vec![HeadBelief::default(); rig.heads.len()],
            bystanders: others.map(|i| (i, Bystander::default())).collect(),
        }
    }

    /// Takes the newest states of all that is no head. What jumps to where a head may be is not believed: the tracker may have
    /// exchanged their labels.
    fn follow_bystanders(&mut self, snapshot: &TrackSnapshot, now: HostTime) {
        let Self { heads, bystanders } = self;
        for (i, one) in bystanders {
            let newest = snapshot.tracks.get(*i).copied().flatten().map(|(state, _)| state);
            if let Some(state) = newest {
                one.calm.see(&state, false);
            }
            let own = newest.filter(|state| {
                one.believed.is_none_or(|known| is_near(&known, state))
                    || !heads
                        .iter()
                        .filter_map(|head| head.believed)
                        .any(|head| is_within(reach(&head, state.captured_at), state, APART_M))
            });
            one.believed = own.or(one.believed);
            let age_s = own.map_or(f64::INFINITY, |state| now.ns_since(state.captured_at) as f64 * 1e-9);
            one.is_astray = age_s > EXTRAPOLATED_S;
        }
    }

    /// Whether `state`, told of head `i`, is that head's.
    fn is_own(&self, heads: &[GuardedHead], snapshot: &TrackSnapshot, i: usize, state: &TrackState) -> bool {
        let HeadBelief { believed, is_own, doubted_since, .. } = self.heads[i];
        if is_own && believed.is_some_and(|known| goes_on(&known, state)) {
            return true;
        }
        let can_be =
            believed.is_none_or(|known| is_within(reach(&known, state.captured_at), state, SURPRISE_M));
        let is_clear = can_be
            && !self.is_another(heads, snapshot, i, state)
            && !self.bystanders.iter().any(|(_, one)| one.may_be(state));
        let is_believed = doubted_since.is_some_and(|since| state.captured_at.ns_since(since) > BELIEVED_NS);
        // A filter takes a jump for a motion at first, and what it says of place and speed is the jump's.
        (is_clear || is_believed) && self.heads[i].is_settled(state)
    }

    /// The tracker says `state` of head `i`, and that is not where it can be. If it is where a body was that is now where the
    /// head was, both go on under each other's labels.
    fn doubt(&mut self, i: usize, state: &TrackState, snapshot: &TrackSnapshot) {
        let head = &mut self.heads[i];
        head.is_own = false;
        head.doubted_since.get_or_insert(state.captured_at);
        let Some((tracked, one)) = self.bystanders.iter_mut().find(|(_, one)| one.may_be(state)) else {
            return;
        };
        one.believed = Some(*state);
        let other = snapshot.tracks.get(*tracked).copied().flatten().map(|(state, _)| state);
        let goes_on =
            |other: &TrackState| one.calm.lasts(other, SETTLES_NS) && goes_on_exchanged(head.believed, other);
        head.believed = other.filter(goes_on).or(head.believed);
    }

    /// Whether the sample of `state`, told of head `i`, lies where another head can be.
    fn is_another(
        &self,
        heads: &[GuardedHead],
        snapshot: &TrackSnapshot,
        i: usize,
        state: &TrackState,
    ) -> bool {
        heads.iter().zip(&self.heads).enumerate().any(|(j, (other, head))| {
            let known = newest_of(snapshot, other).or(head.believed);
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
        self.follow_bystanders(snapshot, now);
        for (i, head) in heads.iter().enumerate() {
            let newest = newest_of(snapshot, head);
            if let Some(state) = newest {
                self.heads[i].watch(&state);
                if self.is_own(heads, snapshot, i, &state) {
                    let known = self.heads[i];
                    self.heads[i] =
                        HeadBelief { believed: newest, is_own: true, doubted_since: None, ..known };
                } else {
                    self.doubt(i, &state, snapshot);
                    eyes.spheres.push(swept(&state, light, head.radius_m));
                }
            }
            let believed = self.heads[i].believed;
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

/// Whether `state` continues the motion of `known` without a gap, and without the speed of a jump.
fn goes_on(known: &TrackState, state: &TrackState) -> bool {
    let gap_s = state.captured_at.ns_since(known.captured_at) as f64 * 1e-9;
    let [before, after] = [known, state].map(|of| of.position.mean.velocity.length());
    gap_s <= EXTRAPOLATED_S
        && after <= before + SPEED_M_S
        && is_within(reach(known, state.captured_at), state, SURPRISE_M)
}

/// Whether the newest samples of both tracks lie close to each other. What is known of a velocity after a jump is the jump.
fn is_near(known: &TrackState, state: &TrackState) -> bool {
    let [here, there] = [known, state].map(|of| of.predict(of.captured_at).pose.position_m);
    (DVec3::from_array(here) - DVec3::from_array(there)).length() <= APART_M
}

/// Whether a head with the track `known` goes on as `state`, which the tracker says of a body.
fn goes_on_exchanged(known: Option<TrackState>, state: &TrackState) -> bool {
    known.is_some_and(|known| {
        let gap_s = state.captured_at.ns_since(known.captured_at) as f64 * 1e-9;
        (0.0..EXCHANGED_S).contains(&gap_s) && is_within(reach(&known, state.captured_at), state, SURPRISE_M)
    })
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
