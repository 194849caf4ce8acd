//! What the link's thread has seen of the light, for those who ask for its state ([`LightState`]).

use super::light_state::{Evidence, LightState};
use super::monitor::ProjectorHealth;
use crate::order::Order;
use crate::plan::dark::DarkCause;
use dpm_device::link::faults;
use dpm_device::time::HostTime;
use dpm_render::scene_data::MAX_BODIES;
use std::sync::atomic::{AtomicI64, AtomicU64, AtomicU8, Ordering};

/// For so long after it was last seen, light counts as present, nanoseconds. With the time that a report takes, and a
/// look at the state, the word is never wrong for a second.
pub(crate) const HELD_NS: i64 = 900_000_000;
/// An instant before every other.
pub(crate) const NEVER: HostTime = HostTime(i64::MIN / 2);

/// Bits of the first word of [`LightGauge`].
mod bit {
    pub(super) const WAS_ARMED: u64 = 1;
    pub(super) const IS_OVER: u64 = 1 << 1;
    /// Above them: the order that stands, 0 for none.
    pub(super) const STANDING_SHIFT: u32 = 8;
}

/// What the link's thread sees of the light at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LightReport {
    /// When mirrors were last seen lit; [`NEVER`] if darkness was reported since.
    pub mirrors_lit_at: HostTime,
    /// When a frame was last lit for the first time.
    pub frame_lit_at: HostTime,
    /// When a frame was last sent.
    pub sent_at: HostTime,
    /// When a frame was last lit that is dark for a lost head.
    pub head_lost_at: HostTime,
    /// The projector was armed in this run.
    pub was_armed: bool,
    /// The run has ended its light.
    pub is_over: bool,
    /// The order that stands.
    pub standing: Option<Order>,
}

/// Written by the link's thread and by the supervisor, read by anybody. Accesses are relaxed: a reader that sees a
/// figure a moment late shows it a moment late.
#[derive(Debug)]
pub(crate) struct LightGauge {
    seen: AtomicU64,
    /// The four instants of [`LightReport`]. They pass also where the link's thread says nothing any more.
    at_ns: [AtomicI64; 4],
    /// The host's clock, when the link's thread or the supervisor last looked.
    now_ns: AtomicI64,
    /// Per tracked body: why it has had no light for a second, as its place in `DarkCause::ALL` and 1; 0 if it has.
    bodies: [AtomicU8; MAX_BODIES],
    /// Set by the supervisor.
    restarts: AtomicU8,
    link_silent: AtomicU8,
    /// Set at the start of a run.
    awaits_first_arm: AtomicU8,
    /// Number of times that the link's thread has told what it sees.
    tellings: AtomicU64,
    /// Time in each state, nanoseconds, in the order of [`LightState::WORDS`].
    times_ns: [AtomicU64; LightState::WORDS.len()],
}

impl Default for LightGauge {
    fn default() -> Self {
        Self {
            seen: AtomicU64::new(0),
            at_ns: [const { AtomicI64::new(NEVER.0) }; 4],
            now_ns: AtomicI64::new(0),
            bodies: [const { AtomicU8::new(0) }; MAX_BODIES],
            restarts: AtomicU8::new(0),
            link_silent: AtomicU8::new(0),
            awaits_first_arm: AtomicU8::new(0),
            tellings: AtomicU64::new(0),
            times_ns: Default::default(),
        }
    }
}

impl LightGauge {
    /// The link's thread tells at `now` what it sees.
    pub(crate) fn tell(&self, seen: &LightReport, now: HostTime) {
        let instants = [seen.mirrors_lit_at, seen.frame_lit_at, seen.sent_at, seen.head_lost_at];
        self.at_ns.iter().zip(instants).for_each(|(to, at)| to.store(at.0, Ordering::Relaxed));
        self.pass(now);
        let set = |is: bool, bit: u64| if is { bit } else { 0 };
        let bits = set(seen.was_armed, bit::WAS_ARMED)
            | set(seen.is_over, bit::IS_OVER)
            | seen.standing.map_or(0, |order| order as u64) << bit::STANDING_SHIFT;
        self.seen.store(bits, Ordering::Relaxed);
        self.tellings.fetch_add(1, Ordering::Relaxed);
    }

    /// It is `now`, whoever looks: what was seen of the light grows old.
    pub(crate) fn pass(&self, now: HostTime) {
        self.now_ns.store(now.0, Ordering::Relaxed);
    }

    /// What a projector without frames of this program shows.
    pub(crate) fn tell_shown(&self, health: ProjectorHealth, is_lit: bool) {
        let was_armed = is_lit || self.seen.load(Ordering::Relaxed) & bit::WAS_ARMED != 0;
        // It needs no frames to stay lit.
        let at = if is_lit { HostTime(i64::MAX) } else { NEVER };
        let seen = LightReport {
            mirrors_lit_at: at,
            frame_lit_at: at,
            sent_at: at,
            head_lost_at: NEVER,
            was_armed,
            is_over: health == ProjectorHealth::Stopped,
            standing: match health {
                ProjectorHealth::Black => Some(Order::Black),
                ProjectorHealth::Frozen => Some(Order::Freeze),
                ProjectorHealth::Faulted(faults::HOST_SAFE) => Some(Order::Safe),
                _ => None,
            },
        };
        self.tell(&seen, HostTime(0));
    }

    /// Why body `body` has had no light for a second; `None` if it has.
    pub(crate) fn tell_body(&self, body: usize, dark: Option<DarkCause>) {
        if let Some(place) = self.bodies.get(body) {
            place.store(dark.map_or(0, |cause| cause as u8 + 1), Ordering::Relaxed);
        }
    }

    /// `ns` were spent in `state`.
    pub(crate) fn spent(&self, state: LightState, ns: u64) {
        self.times_ns[state.index()].fetch_add(ns, Ordering::Relaxed);
    }

    /// The run has ended its light, and nobody tells anything more.
    pub(crate) fn end(&self) {
        self.seen.fetch_or(bit::IS_OVER, Ordering::Relaxed);
    }

    /// The stages are being restarted, or run.
    pub(crate) fn set_restarts(&self, is: bool) {
        self.restarts.store(is.into(), Ordering::Relaxed);
    }

    /// The link's thread is silent, or not.
    pub(crate) fn set_link_silent(&self, is: bool) {
        self.link_silent.store(is.into(), Ordering::Relaxed);
    }

    /// The run waits for its first ARM.
    pub(crate) fn await_first_arm(&self) {
        self.awaits_first_arm.store(1, Ordering::Relaxed);
    }

    /// Grows while the link's thread tells what it sees.
    pub(crate) fn tellings(&self) -> u64 {
        self.tellings.load(Ordering::Relaxed)
    }

    /// Why body `body` is dark; `None` if it has light as far as the projector has any.
    pub(crate) fn body(&self, body: usize) -> Option<DarkCause> {
        let code = self.bodies.get(body)?.load(Ordering::Relaxed);
        usize::from(code).checked_sub(1).and_then(|k| DarkCause::ALL.get(k)).copied()
    }

    /// Everything that is known, with the projector's state.
    pub(crate) fn evidence(&self, projector: ProjectorHealth) -> Evidence {
        let bits = self.seen.load(Ordering::Relaxed);
        let is = |bit: u64| bits & bit != 0;
        let now = self.now_ns.load(Ordering::Relaxed);
        let [mirrors_lit, frames_lit, frames_sent, head_lost] =
            self.at_ns.each_ref().map(|at| now.saturating_sub(at.load(Ordering::Relaxed)) < HELD_NS);
        let flag = |flag: &AtomicU8| flag.load(Ordering::Relaxed) != 0;
        Evidence {
            projector,
            standing: Order::from_code((bits >> bit::STANDING_SHIFT) as u8),
            awaits_first_arm: flag(&self.awaits_first_arm),
            was_armed: is(bit::WAS_ARMED),
            mirrors_lit,
            frames_lit,
            frames_sent,
            head_lost,
            some_body_dark: self.bodies.iter().any(flag),
            restarts: flag(&self.restarts),
            link_silent: flag(&self.link_silent),
            is_over: is(bit::IS_OVER),
        }
    }

    /// Seconds spent in each state, in the order of [`LightState::WORDS`].
    pub(crate) fn times_s(&self) -> [f64; LightState::WORDS.len()] {
        self.times_ns.each_ref().map(|ns| ns.load(Ordering::Relaxed) as f64 * 1e-9)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_told_comes_out_as_evidence() {
        let gauge = LightGauge::default();
        assert_eq!(gauge.evidence(ProjectorHealth::Connecting), Evidence::default());
        let now = HostTime(5_000_000_000);
        for k in 0..6 {
            let is = |n: u32| n == k;
            // What is not so was so until just now.
            let at = |n: u32| if is(n) { now } else { HostTime(now.0 - HELD_NS) };
            let seen = LightReport {
                mirrors_lit_at: at(0),
                frame_lit_at: at(1),
                sent_at: at(2),
                was_armed: is(3),
                is_over: is(4),
                head_lost_at: at(5),
                standing: [None, Some(Order::Black), Some(Order::Freeze), Some(Order::Safe), None, None]
                    [k as usize],
            };
            gauge.tell(&seen, now);
            let told = || {
                let e = gauge.evidence(ProjectorHealth::Up);
                assert_eq!(e.standing, seen.standing);
                [e.mirrors_lit, e.frames_lit, e.frames_sent, e.was_armed, e.is_over, e.head_lost]
            };
            assert_eq!(told(), [0, 1, 2, 3, 4, 5].map(is));
            // Nobody says anything any more, and light passes all the same.
            gauge.pass(HostTime(now.0 + HELD_NS - 1));
            assert_eq!(told(), [0, 1, 2, 3, 4, 5].map(is));
            gauge.pass(HostTime(now.0 + HELD_NS));
            assert_eq!(told(), [6, 6, 6, 3, 4, 6].map(is));
        }
        assert_eq!(gauge.tellings(), 6);
        for (body, cause) in DarkCause::ALL.into_iter().enumerate() {
            assert!(!gauge.evidence(ProjectorHealth::Up).some_body_dark);
            gauge.tell_body(body, Some(cause));
            assert_eq!(gauge.body(body), Some(cause));
            assert!(gauge.evidence(ProjectorHealth::Up).some_body_dark);
            gauge.tell_body(body, None);
        }
        gauge.tell_shown(ProjectorHealth::Frozen, true);
        assert!(gauge.evidence(ProjectorHealth::Frozen).mirrors_lit, "what needs no frames stays");
        gauge.tell_shown(ProjectorHealth::Black, false);
        assert!(!gauge.evidence(ProjectorHealth::Black).mirrors_lit);
        gauge.spent(LightState::PartlyLit { is_held: false }, 1_500_000_000);
        assert_eq!(gauge.times_s(), [0.0, 1.5, 0.0, 0.0, 0.0, 0.0]);
    }
}
