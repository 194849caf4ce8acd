//! The laws of tracks (docs/PROTOCOL.md, section 14), judged from the light: what the mirrors showed, plane by plane, against
//! what the TRACKS that reached the projector ask for, and against where the body was.

use crate::follow::{expected, moved, Expected, Memory, Present, Shift};
use crate::machine::Sent;
use crate::plan::{Setup, TrackerSetup};
use dpm_device::link::{DeviceState, Region, TrackCounts, Tracks};
use dpm_device::projector::SlotMoves;
use dpm_device::rng::Draws;
use dpm_device::time::{DeviceTicks, HostTime};
use dpm_rig::rig::Rig;
use glam::{DAffine3, DVec2, DVec3};
use hil_mock::motion::Motion;
use hil_mock::projector::{LightChange, MockProjector};
use std::sync::Arc;

const MS: i64 = 1_000_000;
const S: i64 = 1_000 * MS;
/// No shift of this host is greater, mirrors.
const CLAMP: u8 = 8;
/// First tracks of a frame leave so long before its slot, and a little earlier while the projector's clock is corrected.
const AHEAD_NS: i64 = 300_000 + MS;
/// Samples of this age are in the tracks of the link as well, nanoseconds.
const FRESH_NS: i64 = 20 * MS;
/// By how much farther from the body the light of one plane may be than without tracks, mirrors: half a mirror by rounding, and
/// a filter that follows faster has more noise. The most that was seen in lawful lives is 1.3.
const WORSE: f64 = 2.0;
/// The same where a turn is over before a second sample of it can arrive, so that what is foretold goes on for a while: 2.2
/// was seen.
const WORSE_TURN: f64 = 3.0;
/// Poses of this age tell where the body is even while it turns, seconds.
const FRESH_S: f64 = 0.03;
/// What is foretold from older ones may err by this many metres a second: a body that has turned goes the other way.
const WORSE_M_S: f64 = 0.6;
/// Moved planes from which on their light must be nearer to the body than it would be without tracks. In one life the light of
/// the first 551 was farther, and that of 15,352 in five minutes nearer: a tracker of 60 Hz sees turns that are over before
/// its next sample.
const MANY: u64 = 2_000;
/// How far the host's idea of the projector's clock may be wrong in peace, nanoseconds.
const CLOCK_NS: i64 = MS;

/// What a second of light was made of.
#[derive(Clone, Copy, Debug, Default)]
struct Window {
    /// Slots that were lit to their end, and those of which the last plane followed tracks.
    slots: u64,
    in_the_end: u64,
    /// Planes that followed tracks, and those whose tracks were older than they should be in peace.
    followed: u64,
    old: u64,
}

/// Distances of moved planes from the body, while the tracker tells the truth and poses are less than [`FRESH_S`] old.
#[derive(Clone, Copy, Debug, Default)]
pub struct Placed {
    /// Planes of which light was moved.
    pub moved: u64,
    /// Sum of the squares of the distance of the light from the body, mirrors squared: as it was lit, and as it would have
    /// been without tracks.
    pub with: f64,
    /// See `with`.
    pub without: f64,
}

impl Placed {
    /// Adds those of another life.
    pub fn add(&mut self, other: &Self) {
        self.moved += other.moved;
        self.with += other.with;
        self.without += other.without;
    }
}

/// See the module's documentation.
pub struct TrackLaws {
    rig: Arc<Rig>,
    motion: Motion,
    memory: Memory,
    /// Vertices of the body, in its own space.
    points: Vec<DVec3>,
    /// Random planes, and what tracks make of them.
    pattern: Vec<u8>,
    light: Vec<u8>,
    was_lit: bool,
    /// The counters of planes of this session, as the light tells them; `None` if some light was not seen whole.
    counts: Option<TrackCounts>,
    session_from: u64,
    greatest_age: Option<u32>,
    /// Nothing disturbed the cable since the session began.
    is_clean: bool,
    windows: [Window; 11],
    /// By how much farther from the body a plane may be than without tracks, mirrors.
    worse: f64,
    /// Half a plane, the way of TRACKS, and what a busy host takes, nanoseconds.
    usual_age_ns: i64,
    /// Half a second of slots. Fewer, as where the first part of a second is not judged, do not tell how tracks usually are:
    /// one stall of 4 ms is a tenth of 40 slots at 2,000 frames/s.
    few_slots: u64,
    window: usize,
    now: Window,
    /// What came of moved planes.
    pub placed: Placed,
    /// Planes that were lit with a shift.
    pub planes_moved: u64,
    /// Print every moved plane.
    pub is_loud: bool,
}

/// The instants of one judgement.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    /// True time.
    pub t: i64,
    /// True time minus the host's clock.
    pub lag: i64,
    /// Nothing has been wrong for two seconds, with the tracker neither.
    pub is_peaceful: bool,
    /// The tracker has told the truth for a while.
    pub is_true: bool,
    /// No clock has jumped lately.
    pub is_steady: bool,
}

impl TrackLaws {
    /// The laws for `rig`.
    ///
    /// # Errors
    /// The motion is none, which is a mistake in this program.
    pub fn new(rig: &Arc<Rig>, setup: &Setup) -> Result<Self, String> {
        let raster = rig.camera.raster;
        let draws = Draws::new(setup.seed).stream(0x7ac);
        let bytes = raster.plane_bytes() * rig.schedule.len();
        let bodies = rig.scene.bodies.iter().filter(|body| body.tracked == Some(0));
        let plane_ns = S / i64::from(setup.rate_hz) / rig.schedule.len() as i64;
        // From 0.3 m/s to 0.3 m/s the other way.
        let turn_s = 0.6 / setup.motion.acceleration();
        // A sample comes once a period, an adapter may hold it back, and one alone may be noise.
        let held_ns = match &setup.tracker {
            TrackerSetup::Serial(line) => line.timer_ns,
            _ => 0,
        };
        let unheard_s = 2.0 / f64::from(setup.tracker_hz) + held_ns as f64 * 1e-9;
        Ok(Self {
            rig: rig.clone(),
            motion: setup.motion.of(1.0)?,
            memory: Memory::default(),
            points: bodies.flat_map(|body| body.mesh.positions.iter().map(|p| p.as_dvec3())).collect(),
            pattern: (0..bytes as u64).map(|i| draws.bits(i) as u8).collect(),
            light: vec![0; bytes],
            was_lit: false,
            counts: None,
            session_from: 0,
            greatest_age: None,
            is_clean: false,
            windows: [Window::default(); 11],
            worse: if turn_s < unheard_s { WORSE_TURN } else { WORSE },
            usual_age_ns: plane_ns / 2 + setup.travel_ns + 3 * MS / 2,
            few_slots: u64::from(setup.rate_hz) / 2,
            window: 0,
            now: Window::default(),
            placed: Placed::default(),
            planes_moved: 0,
            is_loud: false,
        })
    }

    /// Another projector is in this place, or it has lost its memory.
    pub fn new_device(&mut self) {
        self.memory.new_device();
        (self.counts, self.is_clean) = (None, false);
    }

    /// The cable was pulled.
    pub fn no_session(&mut self, projector: &MockProjector) {
        self.memory.no_session(projector.clock().ticks_at(projector.now()));
        (self.counts, self.is_clean) = (None, false);
    }

    /// A clock moved: light of this session was not seen whole.
    pub fn clock_moved(&mut self) {
        self.counts = None;
    }

    /// The cable loses, doubles, damages or delays what it carries.
    pub fn cable_disturbed(&mut self) {
        self.is_clean = false;
    }

    /// Light went on or off, or the projector's state changed.
    pub fn change(&mut self, change: &LightChange, projector: &MockProjector) {
        let is_lit = change.frame.is_some();
        let is_over = match change.state {
            DeviceState::Idle | DeviceState::Greeted | DeviceState::Configured | DeviceState::Faulted => true,
            // `dark from`; a BLACK forgets nothing.
            DeviceState::Armed | DeviceState::Frozen => self.was_lit && !is_lit,
            DeviceState::Black => false,
        };
        self.was_lit = is_lit;
        if is_over {
            self.memory.forget(projector.clock().ticks_at(change.at));
        }
    }

    /// A transfer on the control lane is about to reach the projector. `sent` finds a frame that the program sent.
    ///
    /// # Errors
    /// A broken law of the host.
    pub fn hear<'a>(
        &mut self,
        bytes: &[u8],
        cut: bool,
        projector: &MockProjector,
        moment: &Moment,
        sent: &dyn Fn(u32) -> Option<&'a Sent>,
    ) -> Result<(), String> {
        let clock = projector.clock();
        let present = Present {
            ticks: clock.ticks_at(HostTime(moment.t)),
            tick_hz: clock.tick_hz,
            raster: projector.raster(),
            lit: projector.lit_frame(),
            most: hil_mock::projector::GREATEST_SHIFT,
        };
        let Self { memory, is_clean, rig, points, .. } = self;
        let host = Heard { rig, points, moment, present: &present, sent };
        let mut told = Ok(());
        let is_new = memory.hear(bytes, cut, &present, &mut |tracks, before| {
            if told.is_ok() {
                let since = clock.instant_of(present.ticks).ns_since(clock.instant_of(tracks.begin));
                told = host.judge(tracks, before, since, *is_clean);
            }
        });
        if is_new {
            (self.is_clean, self.session_from) = (true, present.ticks.0);
            (self.counts, self.greatest_age) = (Some(TrackCounts::default()), Some(0));
        }
        told
    }

    /// The planes of a slot are over.
    ///
    /// # Errors
    /// A broken law of the projector, or of the place of light.
    pub fn slot(
        &mut self,
        moves: &SlotMoves,
        projector: &MockProjector,
        sent: Option<&Sent>,
        moment: &Moment,
    ) -> Result<(), String> {
        let clock = projector.clock();
        let epoch = self.memory.epoch_at(clock.ticks_at(moves.first_photon_at)).copied();
        let (Some(epoch), Some(sent), true) = (epoch, sent, moment.is_steady) else {
            self.counts = None;
            return Ok(());
        };
        let (start, end) = (epoch.slots.start(moves.slot).0, epoch.slots.start(moves.slot + 1).0);
        let target = epoch.slots.start(epoch.slots.slot_at(sent.target_at).unwrap_or(0)).0;
        let late = i128::from(start.saturating_sub(target));
        let n = epoch.config.schedule.len() as u128;
        let share = |halves: u128| start + (u128::from(end - start) * halves / (2 * n)) as u64;
        let mut greatest = 0;
        let mut any: Option<(usize, Expected)> = None;
        let mut totals = [0u32; 3];
        for (k, lit) in moves.planes().iter().enumerate() {
            let (begin, middle) = (share(2 * k as u128), share(2 * k as u128 + 1));
            let Some(tracks) = self.memory.tracks_of(moves.frame, begin) else {
                self.counts = None;
                return Ok(());
            };
            let w = late * 1_000_000 / i128::from(clock.tick_hz);
            let wanted = expected(tracks, middle, w, clock.tick_hz, hil_mock::projector::GREATEST_SHIFT);
            let shown: Vec<Shift> =
                lit.all().iter().map(|one| Shift { area: one.area, by: one.shift }).collect();
            let age = moves.ages()[k].map(u64::from);
            if shown != wanted.shifts || age != wanted.age {
                let frame = moves.frame;
                return Err(format!(
                    "plane {k} of frame {frame} is lit with the shifts {shown:?} by tracks of the age {age:?}; by the TRACKS \
                     that arrived it should be {wanted:?}; slot {} begins {late} ticks after that of the frame"
                    , moves.slot
                ));
            }
            totals[0] += u32::from(wanted.is_moved());
            totals[1] += u32::from(wanted.was_clamped);
            totals[2] += u32::from(wanted.is_stale);
            greatest = greatest.max(wanted.age.unwrap_or(0));
            let at = clock.instant_of(DeviceTicks(middle)).0;
            let late_ns = (late * 1_000_000_000 / i128::from(clock.tick_hz)) as i64;
            // The first tracks of a frame may come after the first planes of a short slot.
            let is_last = k as u128 + 1 == n;
            self.now.slots += u64::from(is_last);
            self.now.in_the_end += u64::from(is_last && wanted.age.is_some());
            self.now.followed += u64::from(wanted.age.is_some());
            self.now.old += u64::from(wanted.age.is_some_and(|age| age as i64 > self.usual_age_ns));
            self.place(sent, k, at, late_ns, &wanted, moment)?;
            if wanted.is_moved() && any.is_none() {
                any = Some((k, wanted));
            }
        }
        if let Some((k, wanted)) = any {
            self.planes_moved += u64::from(totals[0]);
            self.mirrors(moves, k, &wanted)?;
        }
        self.count(moves, start, totals, greatest as u32, n as usize, projector)
    }

    /// The mirrors of plane `k`, and no others, show what the shifts say.
    fn mirrors(&mut self, moves: &SlotMoves, k: usize, wanted: &Expected) -> Result<(), String> {
        let raster = self.rig.camera.raster;
        moves.move_planes(raster, &self.pattern, &mut self.light);
        let plane = k * raster.plane_bytes()..(k + 1) * raster.plane_bytes();
        if moved(raster, &self.pattern[plane.clone()], &self.light[plane], &wanted.shifts) {
            return Ok(());
        }
        let frame = moves.frame;
        Err(format!(
            "plane {k} of frame {frame}: mirrors do not show what the shifts {:?} say",
            wanted.shifts
        ))
    }

    /// The counters of STATUS are those of the light.
    fn count(
        &mut self,
        moves: &SlotMoves,
        start: u64,
        [moved, clamped, stale]: [u32; 3],
        greatest: u32,
        planes: usize,
        projector: &MockProjector,
    ) -> Result<(), String> {
        if start < self.session_from {
            return Ok(());
        }
        let Some(mine) = &mut self.counts else { return Ok(()) };
        mine.planes_moved += moved;
        mine.planes_clamped += clamped;
        mine.planes_stale += stale;
        if moves.planes().len() == planes {
            mine.greatest_age = greatest;
        }
        let (mine, Some(told)) = (*mine, projector.status().tracks) else { return Ok(()) };
        // Planes of the slot that is being lit are counted already.
        let fits = |told: u32, mine: u32| told >= mine && told <= mine + planes as u32;
        let is_whole = fits(told.planes_moved, mine.planes_moved)
            && fits(told.planes_clamped, mine.planes_clamped)
            && fits(told.planes_stale, mine.planes_stale)
            && told.greatest_age == mine.greatest_age;
        if is_whole {
            return Ok(());
        }
        Err(format!("STATUS tells {told:?}, and the light of this session was {mine:?}"))
    }

    /// How far the light of a plane is from the body.
    fn place(
        &mut self,
        sent: &Sent,
        k: usize,
        at: i64,
        late_ns: i64,
        wanted: &Expected,
        moment: &Moment,
    ) -> Result<(), String> {
        let Some(captured_at) = sent.captured_at.filter(|_| wanted.is_moved() && moment.is_true) else {
            return Ok(());
        };
        let truth = DVec3::from_array(self.motion.pose_at(at).position_m);
        let truth = DAffine3::from_translation(truth);
        let drawn = sent.pose_at(HostTime(at - moment.lag - late_ns));
        let (Some(truth), Some(made)) = (self.mean(&truth), self.mean(&drawn)) else { return Ok(()) };
        let by = wanted.shifts.first().map_or([0; 2], |shift| shift.by).map(f64::from);
        let off = truth - made;
        let (without, with) = (off.length(), (off - DVec2::new(by[0], by[1])).length());
        if self.is_loud {
            println!(
                "{:>12.6} s      frame {} plane {k} moved by {by:?}: {with:.2} instead of {without:.2} mirrors off, tracks {:.2} ms old{}",
                at as f64 * 1e-9,
                sent.frame,
                wanted.age.unwrap_or(0) as f64 * 1e-6,
                if moment.is_peaceful { ", in peace" } else { "" }
            );
        }
        let age_s = (at - moment.lag - captured_at) as f64 * 1e-9;
        // A frame that stays while the stages start again is moved by what was known before, and errs for long in one way.
        if age_s < FRESH_S {
            self.placed.moved += 1;
            self.placed.with += with * with;
            self.placed.without += without * without;
        }
        let per_m = self.rig.camera.fx / -self.rig.camera.to_projector_space(drawn.translation).z;
        if with > without + self.worse + WORSE_M_S * (age_s - FRESH_S).max(0.0) * per_m {
            let frame = sent.frame;
            return Err(format!(
                "plane {k} of frame {frame}: tracks move the light by {by:?} mirrors, and it is {with:.2} off the body instead \
                 of {without:.2}"
            ));
        }
        Ok(())
    }

    /// Where the body is on the raster, on average over its points.
    fn mean(&self, pose: &DAffine3) -> Option<DVec2> {
        mean(&self.rig, &self.points, pose)
    }

    /// What no event triggers. `is_in_peace`: nothing has been wrong for some seconds.
    ///
    /// # Errors
    /// A broken law.
    pub fn tick(&mut self, projector: &MockProjector, is_in_peace: bool) -> Result<(), String> {
        let told = projector.status().tracks;
        let mine = self.memory.follows().then_some((self.memory.taken, self.memory.refused));
        if told.map(|told| (told.taken, told.refused)) != mine {
            return Err(format!("STATUS tells {told:?} of TRACKS; taken and refused were {mine:?}"));
        }
        let Placed { moved, with, without } = self.placed;
        if moved > MANY && with > without {
            return Err(format!(
                "the light of {moved} moved planes is farther from the body than without tracks: {with:.0} instead of \
                 {without:.0} mirrors squared in all"
            ));
        }
        self.window = (self.window + 1) % self.windows.len();
        let before = std::mem::replace(&mut self.windows[self.window], self.now);
        if !is_in_peace || mine.is_none() {
            return Ok(());
        }
        let slots = self.now.slots - before.slots;
        let in_the_end = self.now.in_the_end - before.in_the_end;
        let (followed, old) = (self.now.followed - before.followed, self.now.old - before.old);
        if slots < self.few_slots {
            return Ok(());
        }
        if in_the_end * 10 < slots * 8 {
            return Err(format!(
                "{in_the_end} of {slots} slots follow tracks in the end in a second of peace"
            ));
        }
        if old * 10 > followed {
            return Err(format!(
                "tracks of {old} of {followed} planes are older than {:.2} ms in a second of peace",
                self.usual_age_ns as f64 * 1e-6
            ));
        }
        Ok(())
    }
}

/// Where the body is on the raster at `pose`, on average over its `points`.
fn mean(rig: &Rig, points: &[DVec3], pose: &DAffine3) -> Option<DVec2> {
    let sum = points
        .iter()
        .try_fold(DVec2::ZERO, |sum, point| Some(sum + rig.camera.project(pose.transform_point3(*point))?))?;
    Some(sum / points.len().max(1) as f64)
}

/// What the host's TRACKS are judged by.
struct Heard<'a, 'b> {
    rig: &'a Rig,
    points: &'a [DVec3],
    moment: &'a Moment,
    present: &'a Present,
    sent: &'a dyn Fn(u32) -> Option<&'b Sent>,
}

impl Heard<'_, '_> {
    /// The host's promises about TRACKS that are taken. `before`: number of those before them; `since`: time from their begin
    /// to their arrival.
    fn judge(&self, tracks: &Tracks, before: Option<u32>, since: i64, is_clean: bool) -> Result<(), String> {
        let number = tracks.number;
        let wanted = before.map_or(1, |before| before.wrapping_add(1));
        if is_clean && number != wanted {
            return Err(format!("TRACKS {number} arrive after {before:?} although the cable lost none"));
        }
        if self.moment.is_peaceful && self.moment.is_steady && since < -CLOCK_NS {
            return Err(format!("TRACKS {number} begin {} us after they arrive", -since / 1000));
        }
        let Some(sent) = (self.sent)(tracks.frame) else {
            return Err(format!("TRACKS {number} name frame {}, which was not sent lately", tracks.frame));
        };
        if tracks.begin > sent.dark_from {
            return Err(format!("TRACKS {number} name frame {}, whose light is over by then", tracks.frame));
        }
        let host = self.moment.t - self.moment.lag;
        let early = sent.due_at - host;
        if early > AHEAD_NS && self.moment.is_steady {
            return Err(format!("TRACKS {number} are {:.2} ms ahead of their frame", early as f64 * 1e-6));
        }
        // What the tracker has said lately, the tracks know, too.
        let is_fresh = sent.captured_at.is_some_and(|at| host - at < FRESH_NS.min(sent.predict_ns / 2));
        let is_sure = self.moment.is_true && self.moment.is_steady && is_fresh;
        if is_sure && tracks.regions().is_empty() {
            return Err(format!("TRACKS {number} tell nothing of a body that is lit"));
        }
        tracks.regions().iter().try_for_each(|region| self.region(tracks, region, sent))
    }

    /// A region is the body's, with room for its shift.
    fn region(&self, tracks: &Tracks, region: &Region, sent: &Sent) -> Result<(), String> {
        let (number, area) = (tracks.number, region.area);
        if region.clamp > CLAMP.min(self.present.most) {
            return Err(format!("TRACKS {number} allow shifts of {} mirrors", region.clamp));
        }
        let ends = sent.ends.map(|end| sent.pose_at(end));
        let raster = self.present.raster;
        let corners = ends.iter().flat_map(|pose| self.points.iter().map(|p| pose.transform_point3(*p)));
        for at in corners.filter_map(|corner| self.rig.camera.project(corner)) {
            let limits = [
                (at.x, area.left, area.width, raster.width()),
                (at.y, area.top, area.height, raster.height()),
            ];
            for (at, first, count, side) in limits {
                let at = at.clamp(0.0, f64::from(side));
                let (low, high) = (f64::from(first), f64::from(first) + f64::from(count));
                if at < low || at > high {
                    return Err(format!("TRACKS {number}: a body at {at:.1} is outside the region {area:?}"));
                }
            }
        }
        Ok(())
    }
}
