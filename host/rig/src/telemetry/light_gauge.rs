//! What the link's thread has seen of the light, for those who ask for its state ([`LightState`]).

use super::light_state::{Evidence, LightState};
use super::monitor::ProjectorHealth;
use crate::order::Order;
use crate::plan::dark::DarkCause;
use dpm_device::link::faults;
use dpm_render::scene_data::MAX_BODIES;
use std::sync::atomic::{AtomicU64, AtomicU8, Ordering};

/// Bits of the first word of [`LightGauge`].
mod bit {
    pub(super) const MIRRORS_LIT: u64 = 1;
    pub(super) const FRAMES_LIT: u64 = 1 << 1;
    pub(super) const FRAMES_SENT: u64 = 1 << 2;
    pub(super) const WAS_ARMED: u64 = 1 << 3;
    pub(super) const IS_OVER: u64 = 1 << 4;
    pub(super) const HEAD_LOST: u64 = 1 << 5;
    /// Above them: the order that stands, 0 for none.
    pub(super) const STANDING_SHIFT: u32 = 8;
}

/// What the link's thread sees of the light at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct LightReport {
    /// Mirrors were lit within the last second, and no darkness was reported since.
    pub mirrors_lit: bool,
    /// A frame was lit for the first time within the last second.
    pub frames_lit: bool,
    /// A frame was sent within the last second.
    pub frames_sent: bool,
    /// A frame that is dark for a lost head was lit within the last second.
    pub head_lost: bool,
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
    /// The link's thread tells what it sees.
    pub(crate) fn tell(&self, seen: &LightReport) {
        let set = |is: bool, bit: u64| if is { bit } else { 0 };
        let bits = set(seen.mirrors_lit, bit::MIRRORS_LIT)
            | set(seen.frames_lit, bit::FRAMES_LIT)
            | set(seen.frames_sent, bit::FRAMES_SENT)
            | set(seen.head_lost, bit::HEAD_LOST)
            | set(seen.was_armed, bit::WAS_ARMED)
            | set(seen.is_over, bit::IS_OVER)
            | seen.standing.map_or(0, |order| order as u64) << bit::STANDING_SHIFT;
        self.seen.store(bits, Ordering::Relaxed);
        self.tellings.fetch_add(1, Ordering::Relaxed);
    }

    /// What a projector without frames of this program shows.
    pub(crate) fn tell_shown(&self, health: ProjectorHealth, is_lit: bool) {
        let was_armed = is_lit || self.seen.load(Ordering::Relaxed) & bit::WAS_ARMED != 0;
        self.tell(&LightReport {
            mirrors_lit: is_lit,
            frames_lit: is_lit,
            frames_sent: is_lit,
            head_lost: false,
            was_armed,
            is_over: health == ProjectorHealth::Stopped,
            standing: match health {
                ProjectorHealth::Black => Some(Order::Black),
                ProjectorHealth::Frozen => Some(Order::Freeze),
                ProjectorHealth::Faulted(faults::HOST_SAFE) => Some(Order::Safe),
                _ => None,
            },
        });
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
        let flag = |flag: &AtomicU8| flag.load(Ordering::Relaxed) != 0;
        Evidence {
            projector,
            standing: Order::from_code((bits >> bit::STANDING_SHIFT) as u8),
            awaits_first_arm: flag(&self.awaits_first_arm),
            was_armed: is(bit::WAS_ARMED),
            mirrors_lit: is(bit::MIRRORS_LIT),
            frames_lit: is(bit::FRAMES_LIT),
            frames_sent: is(bit::FRAMES_SENT),
            head_lost: is(bit::HEAD_LOST),
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
        for k in 0..6 {
            let is = |n: u32| n == k;
            let seen = LightReport {
                mirrors_lit: is(0),
                frames_lit: is(1),
                frames_sent: is(2),
                was_armed: is(3),
                is_over: is(4),
                head_lost: is(5),
                standing: [None, Some(Order::Black), Some(Order::Freeze), Some(Order::Safe), None, None]
                    [k as usize],
            };
            gauge.tell(&seen);
            let e = gauge.evidence(ProjectorHealth::Up);
            let told = [e.mirrors_lit, e.frames_lit, e.frames_sent, e.was_armed, e.is_over, e.head_lost];
            assert_eq!(told, [0, 1, 2, 3, 4, 5].map(is));
            assert_eq!(e.standing, seen.standing);
        }
        assert_eq!(gauge.tellings(), 6);
        for (body, cause) in DarkCause::ALL.into_iter().enumerate() {
            assert!(!gauge.evidence(ProjectorHealth::Up).some_body_dark);
            gauge.tell_body(body, Some(cause));
            assert_eq!(gauge.body(body), Some(cause));
            assert!(gauge.evidence(ProjectorHealth::Up).some_body_dark);
            gauge.tell_body(body, None);
        }
        gauge.spent(LightState::PartlyLit { is_held: false }, 1_500_000_000);
        assert_eq!(gauge.times_s(), [0.0, 1.5, 0.0, 0.0, 0.0, 0.0]);
    }
}
