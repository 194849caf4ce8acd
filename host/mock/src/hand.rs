//! A hand that holds a tracked wand and does what it is told: from orders and their instants to the wand's true pose at
//! any time.
//!
//! A motion of a rig file is fixed for a whole run. Whoever touches points, holds the tip into a dot or lays the wand down
//! decides while the run goes on; this is for them.

use crate::motion::{add, from_rotation_vector, multiply, normalize4, rotate, scale, Motion};
use dpm_device::pose::Pose;
use std::collections::VecDeque;
use std::sync::{PoisonError, RwLock};

/// Time in which the hand gets to where it was told to go.
pub const REACH_NS: i64 = 600_000_000;
/// Orders that are remembered: whoever asks for a pose asks for one of the last seconds.
const REMEMBERED: usize = 64;
/// Tilt of the wand at a point that is touched, radians. Its direction differs from order to order, as a hand's does.
const TILT_RAD: f64 = 0.3;
/// The same while the wand is turned about its tip.
const PIVOT_RAD: f64 = 0.5;
/// Turns about two axes while the wand is turned about its tip, hertz.
const PIVOT_HZ: [f64; 2] = [0.31, 0.47];

/// On the way from one place to the next while places are visited, nanoseconds.
const GO_NS: i64 = 1_000_000_000;
/// The box in which the places lie, metres: its middle and its sides.
const VISITED_M: [[f64; 3]; 2] = [[0.0, 0.0, 0.12], [0.4, 0.3, 0.3]];

/// What a hand may be told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum HandOrder {
    /// Move as before the first order.
    Wander,
    /// Hold the tip at a point of the world, metres.
    Tip([f64; 3]),
    /// Hold the tip still at one place after another, near and far, and go slowly between them.
    Visit {
        /// At each place, nanoseconds.
        rest_ns: i64,
    },
    /// Turn the wand about its tip, which stays at a point of the world, metres.
    Pivot([f64; 3]),
}

/// A hand that holds a wand. Its pose at an instant changes only by orders that came before that instant.
#[derive(Debug)]
pub struct Hand {
    tip: [f64; 3],
    wander: Motion,
    stretches: RwLock<VecDeque<Stretch>>,
}

/// What the hand does from an instant on.
#[derive(Clone, Copy, Debug)]
struct Stretch {
    since_ns: i64,
    /// Where it was then; it leaves from there.
    from: Pose,
    order: HandOrder,
    /// Counts the orders.
    number: u32,
}

impl Hand {
    /// A hand that moves the wand by `wander` until it is told otherwise. `tip` is the wand's tip in its body, metres.
    pub fn new(wander: Motion, tip: [f64; 3]) -> Self {
        Self { tip, wander, stretches: RwLock::new(VecDeque::with_capacity(REMEMBERED)) }
    }

    /// Takes an order at `now_ns`, which no pose that was asked for may lie behind.
    pub fn tell(&self, now_ns: i64, order: HandOrder) {
        let from = self.pose_at(now_ns);
        let mut stretches = self.stretches.write().unwrap_or_else(PoisonError::into_inner);
        let number = stretches.back().map_or(0, |s| s.number.wrapping_add(1));
        if stretches.len() == REMEMBERED {
            stretches.pop_front();
        }
        stretches.push_back(Stretch { since_ns: now_ns, from, order, number });
    }

    /// World from body at an instant.
    pub fn pose_at(&self, t_ns: i64) -> Pose {
        let stretches = self.stretches.read().unwrap_or_else(PoisonError::into_inner);
        match stretches.iter().rev().find(|s| s.since_ns <= t_ns) {
            None => self.wander.pose_at(t_ns),
            Some(stretch) => {
                let share = (t_ns - stretch.since_ns) as f64 / REACH_NS as f64;
                let there = self.doing(stretch, t_ns);
                if share >= 1.0 {
                    return there;
                }
                between(&stretch.from, &there, share * share * (3.0 - 2.0 * share))
            }
        }
    }

    /// Where an order alone would have the wand.
    fn doing(&self, stretch: &Stretch, t_ns: i64) -> Pose {
        let (place, turn) = match stretch.order {
            HandOrder::Wander => return self.wander.pose_at(t_ns),
            HandOrder::Visit { rest_ns } => return self.visiting(t_ns - stretch.since_ns, rest_ns),
            HandOrder::Tip(place) => (place, tilt(TILT_RAD, stretch.number)),
            HandOrder::Pivot(place) => {
                let seconds = 1e-9 * (t_ns - stretch.since_ns) as f64;
                let [a, b] = PIVOT_HZ.map(|hz| libm::sin(std::f64::consts::TAU * hz * seconds));
                (place, from_rotation_vector([PIVOT_RAD * a, PIVOT_RAD * b, 0.4 * PIVOT_RAD * a * b]))
            }
        };
        self.holding(place, turn)
    }

    /// The wand with its tip at a place.
    fn holding(&self, place: [f64; 3], turn: [f64; 4]) -> Pose {
        let arm = scale(rotate(turn, self.tip), -1.0);
        Pose { position_m: add(place, arm), rotation_xyzw: turn }
    }

    /// Where it is some time after it was told to visit places.
    fn visiting(&self, since_ns: i64, rest_ns: i64) -> Pose {
        let at = |number: i64| {
            let [middle, sides] = VISITED_M;
            let shares = [2, 3, 5].map(|base| van_der_corput(number.max(0) as u64 + 1, base) - 0.5);
            let place = std::array::from_fn(|i| middle[i] + sides[i] * shares[i]);
            // Upright to twice as far tilted as for a touch: how the tip lies in the wand shows in the difference.
            let far = 2.0 * TILT_RAD * van_der_corput(number.max(0) as u64 + 1, 7);
            self.holding(place, tilt(far, number.max(0) as u32))
        };
        let visit_ns = GO_NS + rest_ns.max(0);
        let (number, within_ns) = (since_ns.div_euclid(visit_ns), since_ns.rem_euclid(visit_ns));
        let share = (within_ns as f64 / GO_NS as f64).min(1.0);
        match number {
            // The way to the first place is that from where it was.
            ..=0 => at(0),
            _ => between(&at(number - 1), &at(number), share * share * (3.0 - 2.0 * share)),
        }
    }
}

/// A tilt that differs from number to number, by the golden angle: no two directions are near each other.
fn tilt(far_rad: f64, number: u32) -> [f64; 4] {
    let (sin, cos) = libm::sincos(2.399_963 * f64::from(number));
    from_rotation_vector([far_rad * cos, far_rad * sin, 0.0])
}

/// The digits of a number in a base, mirrored at the point: 0 to 1, evenly spread over any stretch of numbers.
fn van_der_corput(mut number: u64, base: u64) -> f64 {
    let (mut value, mut digit) = (0.0, 1.0);
    while number > 0 {
        digit /= base as f64;
        value += digit * (number % base) as f64;
        number /= base;
    }
    value
}

/// The pose at a share of the way from one to another.
fn between(a: &Pose, b: &Pose, share: f64) -> Pose {
    let [x, y, z, w] = a.rotation_xyzw;
    let mut turn = multiply(b.rotation_xyzw, [-x, -y, -z, w]);
    if turn[3] < 0.0 {
        turn = turn.map(|c| -c);
    }
    let sin = (turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2]).sqrt();
    let angle = 2.0 * libm::atan2(sin, turn[3]);
    let by = if sin > 1e-12 { share * angle / sin } else { 0.0 };
    let part = from_rotation_vector([turn[0] * by, turn[1] * by, turn[2] * by]);
    let apart = add(b.position_m, scale(a.position_m, -1.0));
    Pose {
        position_m: add(a.position_m, scale(apart, share)),
        rotation_xyzw: normalize4(multiply(part, a.rotation_xyzw)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::MotionSpec;

    const TIP: [f64; 3] = [0.01, -0.005, 0.12];

    fn tip_of(pose: &Pose) -> [f64; 3] {
        add(pose.position_m, rotate(pose.rotation_xyzw, TIP))
    }

    fn apart(a: [f64; 3], b: [f64; 3]) -> f64 {
        let d = add(a, scale(b, -1.0));
        (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt()
    }

    #[test]
    fn the_tip_gets_to_where_it_is_told_and_the_wand_never_jumps() {
        let spin =
            MotionSpec::Rotate { axis: [0.3, 1.0, 0.0], rate_rad_s: 2.0, pivot_offset_m: [0.1, 0.0, 0.0] };
        let wander = Motion::new(&spin, Pose::IDENTITY).unwrap();
        let hand = Hand::new(wander.clone(), TIP);
        let ms = 1_000_000;
        assert_eq!(hand.pose_at(123 * ms), wander.pose_at(123 * ms));
        let (point, pivot) = ([0.2, -0.1, 0.3], [-0.1, 0.2, 0.0]);
        hand.tell(1_000 * ms, HandOrder::Tip(point));
        hand.tell(3_000 * ms, HandOrder::Pivot(pivot));
        hand.tell(9_000 * ms, HandOrder::Tip(pivot));
        hand.tell(11_000 * ms, HandOrder::Wander);
        // What was before an order stays as it was.
        assert_eq!(hand.pose_at(900 * ms), wander.pose_at(900 * ms));
        for t in [1_600, 2_300, 2_999] {
            assert!(apart(tip_of(&hand.pose_at(t * ms)), point) < 1e-12, "{t}");
        }
        let mut turned = 0.0f64;
        for t in 3_600..9_000 {
            let pose = hand.pose_at(t * ms);
            assert!(apart(tip_of(&pose), pivot) < 1e-12, "{t}");
            turned = turned.max(apart(pose.position_m, hand.pose_at(3_600 * ms).position_m));
        }
        assert!(turned > 0.05, "the wand turned about its tip: {turned} m");
        for t in 500..13_000 {
            let (a, b) = (hand.pose_at(t * ms), hand.pose_at((t + 1) * ms));
            assert!(apart(a.position_m, b.position_m) < 3e-3, "{t}: 3 m/s are no hand");
            let norm: f64 = b.rotation_xyzw.iter().map(|c| c * c).sum();
            assert!((norm - 1.0).abs() < 1e-12);
        }
        assert_eq!(hand.pose_at(12_000 * ms), wander.pose_at(12_000 * ms));
    }

    #[test]
    fn places_are_visited_near_and_far_and_rested_at() {
        let hand = Hand::new(Motion::still(Pose::IDENTITY).unwrap(), TIP);
        hand.tell(0, HandOrder::Visit { rest_ns: 2_000_000_000 });
        let tip = |ms: i64| tip_of(&hand.pose_at(ms * 1_000_000));
        let mut places: Vec<[f64; 3]> = Vec::new();
        for number in 0..20 {
            let at = tip(3000 * number + 1000);
            for ms in (1000..3000).step_by(100) {
                assert!(apart(tip(3000 * number + ms), at) < 1e-9);
            }
            assert!(places.iter().all(|p| apart(*p, at) > 0.02), "{number}");
            places.push(at);
        }
        for axis in 0..3 {
            let reach = |f: fn(f64, f64) -> f64| places.iter().map(|p| p[axis]).fold(f64::NAN, f);
            assert!(reach(f64::max) - reach(f64::min) > 0.8 * VISITED_M[1][axis]);
        }
        assert!((0..60_000).step_by(5).all(|ms| apart(tip(ms), tip(ms + 5)) < 5e-3), "1 m/s at most");
    }

    #[test]
    fn two_touches_of_a_point_are_at_different_angles() {
        let hand = Hand::new(Motion::still(Pose::IDENTITY).unwrap(), TIP);
        hand.tell(0, HandOrder::Tip([0.0; 3]));
        hand.tell(2 * REACH_NS, HandOrder::Tip([0.0; 3]));
        let (a, b) = (hand.pose_at(REACH_NS), hand.pose_at(4 * REACH_NS));
        assert!(apart(tip_of(&a), tip_of(&b)) < 1e-12 && apart(a.position_m, b.position_m) > 0.01);
    }
}
