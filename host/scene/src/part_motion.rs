//! How a part of a scene moves by itself: key frames of a file, played over and over.
//!
//! A part is rigid. What carries it is a tracked body or the world. Its place in the space of its carrier is a product of
//! the nodes between them, of which each stands still or follows its key frames [glTF 2.0, section 3.11 and appendix C].

use std::sync::Arc;

use glam::{DAffine3, DQuat, DVec3};

/// The motion of a part in the space of its carrier, which repeats for ever.
#[derive(Clone, Debug, PartialEq)]
pub struct PartMotion {
    /// From the carrier to the part; parts on parts share them.
    links: Vec<Arc<PartLink>>,
    /// Seconds of the file's time in a round.
    length_s: f64,
    /// Nanoseconds that a round lasts, above 0.
    period_ns: i64,
}

/// One of the places whose product is that of a part.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum PartLink {
    /// It does not move.
    Fixed(DAffine3),
    /// A node with key frames.
    Node(NodeMotion),
}

/// Translation and rotation of a node, parent-from-node.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct NodeMotion {
    /// Metres.
    pub translation: ValueTrack<DVec3>,
    /// Unit quaternions.
    pub rotation: ValueTrack<DQuat>,
}

/// A value over time.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum ValueTrack<T> {
    /// It does not change.
    Constant(T),
    /// It follows key frames.
    Keys(Keys<T>),
}

/// How values follow from one key frame to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Interpolation {
    /// A value holds until the next key frame.
    Step,
    /// Straight, for rotations along the shortest arc.
    Linear,
    /// By Hermite's polynomials. The values of a key are its in-tangent, itself and its out-tangent.
    CubicSpline,
}

impl Interpolation {
    /// Values that a key frame has.
    pub(crate) fn values_of_key(self) -> usize {
        match self {
            Self::CubicSpline => 3,
            Self::Step | Self::Linear => 1,
        }
    }
}

/// Key frames.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Keys<T> {
    /// Seconds, rising, at least one, finite.
    pub times: Vec<f64>,
    /// [`Interpolation::values_of_key`] for each time.
    pub values: Vec<T>,
    /// Between the times.
    pub interpolation: Interpolation,
}

/// What key frames hold.
pub(crate) trait Keyed: Copy {
    /// The value a share `s` of the way from `a` to `b`.
    fn between(a: Self, b: Self, s: f64) -> Self;
    /// The sum of values by weights.
    fn weighted(of: [(Self, f64); 4]) -> Self;
    /// True if both mean the same to within rounding.
    fn is_near(self, other: Self) -> bool;
}

impl Keyed for DVec3 {
    fn between(a: Self, b: Self, s: f64) -> Self {
        a + (b - a) * s
    }

    fn weighted(of: [(Self, f64); 4]) -> Self {
        of.iter().map(|(value, weight)| *value * *weight).sum()
    }

    fn is_near(self, other: Self) -> bool {
        self.distance(other) <= 1e-6 * (1.0 + self.length())
    }
}

impl Keyed for f64 {
    fn between(a: Self, b: Self, s: f64) -> Self {
        a + (b - a) * s
    }

    fn weighted(of: [(Self, f64); 4]) -> Self {
        of.iter().map(|(value, weight)| value * weight).sum()
    }

    fn is_near(self, other: Self) -> bool {
        (self - other).abs() <= 1e-6 * (1.0 + self.abs())
    }
}

impl Keyed for DQuat {
    fn between(a: Self, b: Self, s: f64) -> Self {
        a.slerp(b, s)
    }

    /// A rotation: the specification has the sum normalised. Where it is nothing, the first value holds.
    fn weighted(of: [(Self, f64); 4]) -> Self {
        let sum = of.iter().fold(DQuat::from_array([0.0; 4]), |sum, (value, weight)| sum + *value * *weight);
        let length = sum.length();
        if length > 1e-9 {
            sum * length.recip()
        } else {
            of[0].0
        }
    }

    fn is_near(self, other: Self) -> bool {
        self.dot(other).abs() >= 1.0 - 1e-9
    }
}

impl<T: Keyed> Keys<T> {
    /// The value of key `k`, without tangents.
    pub(crate) fn value(&self, k: usize) -> T {
        match self.interpolation {
            Interpolation::CubicSpline => self.values[3 * k + 1],
            Interpolation::Step | Interpolation::Linear => self.values[k],
        }
    }

    /// The value at `t` seconds; before the first key that of the first, after the last that of the last.
    fn at(&self, t: f64) -> T {
        let next = self.times.partition_point(|time| *time <= t);
        if next == 0 {
            return self.value(0);
        }
        let k = next - 1;
        if next == self.times.len() {
            return self.value(k);
        }
        let length = self.times[next] - self.times[k];
        let s = (t - self.times[k]) / length;
        match self.interpolation {
            Interpolation::Step => self.value(k),
            Interpolation::Linear => T::between(self.value(k), self.value(next), s),
            Interpolation::CubicSpline => {
                let (s2, s3) = (s * s, s * s * s);
                T::weighted([
                    (self.value(k), 2.0 * s3 - 3.0 * s2 + 1.0),
                    (self.values[3 * k + 2], length * (s3 - 2.0 * s2 + s)),
                    (self.value(next), 3.0 * s2 - 2.0 * s3),
                    (self.values[3 * next], length * (s3 - s2)),
                ])
            }
        }
    }

    /// The one value that it has at all times; `None` if it has several.
    pub(crate) fn constant(&self) -> Option<T> {
        let first = self.value(0);
        // A spline through equal values may leave them between two keys.
        let middles = self.times.windows(2).map(|pair| self.at(0.5 * (pair[0] + pair[1])));
        let quarters = self.times.windows(2).map(|pair| self.at(0.75 * pair[0] + 0.25 * pair[1]));
        let keys = (0..self.times.len()).map(|k| self.value(k));
        keys.chain(middles).chain(quarters).all(|value| value.is_near(first)).then_some(first)
    }
}

impl<T: Keyed> ValueTrack<T> {
    /// The value at `t` seconds.
    pub(crate) fn at(&self, t: f64) -> T {
        match self {
            Self::Constant(value) => *value,
            Self::Keys(keys) => keys.at(t),
        }
    }

    fn times(&self) -> &[f64] {
        match self {
            Self::Constant(_) => &[],
            Self::Keys(keys) => &keys.times,
        }
    }
}

/// Most instants that [`PartMotion::instants`] names.
const MOST_INSTANTS: usize = 4096;
/// Instants from one key frame to the next.
const BETWEEN_KEYS: usize = 8;

impl PartMotion {
    /// The product of `links`, of whose key frames a round has `length_s` seconds and lasts `period_ns`.
    pub(crate) fn new(links: Vec<Arc<PartLink>>, length_s: f64, period_ns: i64) -> Self {
        Self { links, length_s, period_ns: period_ns.max(1) }
    }

    /// Carrier-from-part, a rigid map, at `t_ns` nanoseconds. It repeats after every round.
    pub fn at(&self, t_ns: i64) -> DAffine3 {
        let round = t_ns.rem_euclid(self.period_ns) as f64 / self.period_ns as f64;
        let t = round * self.length_s;
        self.links.iter().fold(DAffine3::IDENTITY, |place, link| {
            place
                * match &**link {
                    PartLink::Fixed(map) => *map,
                    PartLink::Node(node) => {
                        DAffine3::from_rotation_translation(node.rotation.at(t), node.translation.at(t))
                    }
                }
        })
    }

    /// Instants of a round that show where the part goes: its key frames and some between them, at most 4,097.
    pub fn instants(&self) -> Vec<i64> {
        let nodes = self.links.iter().filter_map(|link| match &**link {
            PartLink::Fixed(_) => None,
            PartLink::Node(node) => Some(node),
        });
        let mut keys: Vec<f64> = nodes
            .flat_map(|node| node.translation.times().iter().chain(node.rotation.times()))
            .copied()
            .collect();
        keys.sort_by(f64::total_cmp);
        keys.dedup();
        let every = keys.len().div_ceil(MOST_INSTANTS / BETWEEN_KEYS).max(1);
        let mut some: Vec<f64> = keys.iter().copied().step_by(every).collect();
        some.extend(keys.last());
        some.dedup();
        let part = |k: usize| k as f64 / BETWEEN_KEYS as f64;
        let between = some
            .windows(2)
            .flat_map(|pair| (0..BETWEEN_KEYS).map(move |k| pair[0] + (pair[1] - pair[0]) * part(k)));
        let end = keys.last().copied();
        // At the very end of a round the next one begins.
        let ns = |t: f64| ((t / self.length_s * self.period_ns as f64) as i64).clamp(0, self.period_ns - 1);
        between.chain(end).map(ns).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keys<T>(times: &[f64], values: Vec<T>, interpolation: Interpolation) -> Keys<T> {
        Keys { times: times.to_vec(), values, interpolation }
    }

    #[test]
    fn values_hold_before_the_first_key_and_after_the_last() {
        let x = |x: f64| DVec3::new(x, 0.0, 0.0);
        for interpolation in [Interpolation::Step, Interpolation::Linear] {
            let k = keys(&[1.0, 2.0, 4.0], vec![x(1.0), x(3.0), x(5.0)], interpolation);
            assert_eq!((k.at(-1.0), k.at(1.0), k.at(2.0)), (x(1.0), x(1.0), x(3.0)));
            assert_eq!((k.at(4.0), k.at(9.0)), (x(5.0), x(5.0)));
            let middle = if interpolation == Interpolation::Step { x(3.0) } else { x(4.0) };
            assert_eq!(k.at(3.0), middle);
        }
    }

    /// A cubic is its own spline: the Hermite polynomials of its values and slopes give it back.
    #[test]
    fn a_spline_gives_back_a_cubic() {
        let cubic = |t: f64| DVec3::new(t * t * t - 2.0 * t, 1.0 - t * t, 3.0 * t);
        let slope = |t: f64| DVec3::new(3.0 * t * t - 2.0, -2.0 * t, 3.0);
        let times = [-1.0, 0.25, 2.0];
        let values = times.iter().flat_map(|&t| [slope(t), cubic(t), slope(t)]).collect();
        let k = keys(&times, values, Interpolation::CubicSpline);
        for i in 0..=30 {
            let t = -1.0 + 0.1 * f64::from(i);
            assert!(k.at(t).distance(cubic(t)) < 1e-12, "{t}: {} {}", k.at(t), cubic(t));
        }
    }

    #[test]
    fn rotations_take_the_shortest_arc_and_stay_rotations() {
        let (a, b) = (DQuat::from_rotation_y(0.2), DQuat::from_rotation_y(1.0));
        // -b is the same rotation as b.
        let k = keys(&[0.0, 1.0], vec![a, -b], Interpolation::Linear);
        assert!(k.at(0.5).angle_between(DQuat::from_rotation_y(0.6)) < 1e-7);
        let zero = DQuat::from_array([0.0; 4]);
        let spline = keys(&[0.0, 1.0], vec![zero, a, zero, zero, b, zero], Interpolation::CubicSpline);
        for i in 0..=10 {
            assert!((spline.at(0.1 * f64::from(i)).length() - 1.0).abs() < 1e-12);
        }
        // Opposite keys without tangents meet in nothing half way, which is no rotation.
        let bad = keys(&[0.0, 1.0], vec![zero, a, zero, zero, -a, zero], Interpolation::CubicSpline);
        assert!((bad.at(0.5).length() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn what_never_changes_is_found() {
        let one = DVec3::ONE;
        let step = |values: Vec<DVec3>| keys(&[0.0, 1.0], values, Interpolation::Linear).constant();
        assert_eq!(step(vec![one, one]), Some(one));
        assert_eq!(step(vec![one, one * 1.1]), None);
        let zero = DVec3::ZERO;
        let spline = |out: DVec3| {
            keys(&[0.0, 1.0], vec![zero, one, out, zero, one, zero], Interpolation::CubicSpline).constant()
        };
        assert_eq!((spline(zero), spline(one)), (Some(one), None), "it swings out between equal keys");
        let turned = keys(&[0.0, 1.0], vec![DQuat::IDENTITY, -DQuat::IDENTITY], Interpolation::Linear);
        assert!(turned.constant().is_some());
    }

    /// A wheel at the end of an arm that turns: the place is the product of both, and it repeats.
    #[test]
    fn links_multiply_and_rounds_repeat() {
        use std::f64::consts::PI;
        let turn = |times: &[f64], angles: &[f64]| {
            let values = angles.iter().map(|a| DQuat::from_rotation_z(*a)).collect();
            ValueTrack::Keys(keys(times, values, Interpolation::Linear))
        };
        let arm = NodeMotion {
            translation: ValueTrack::Constant(DVec3::ZERO),
            rotation: turn(&[0.0, 1.0, 2.0], &[0.0, 0.5 * PI, PI]),
        };
        let wheel = NodeMotion {
            translation: ValueTrack::Constant(DVec3::X),
            rotation: turn(&[0.0, 2.0], &[0.0, -0.5 * PI]),
        };
        let above = DAffine3::from_translation(DVec3::new(0.0, 0.0, 5.0));
        let links =
            [PartLink::Fixed(above), PartLink::Node(arm), PartLink::Node(wheel)].map(Arc::new).to_vec();
        // Played at twice the file's speed.
        let motion = PartMotion::new(links, 2.0, 1_000_000_000);
        let place = motion.at(500_000_000);
        assert!(place.translation.distance(DVec3::new(0.0, 1.0, 5.0)) < 1e-12, "{place}");
        let along = place.transform_vector3(DVec3::X);
        let angle = 0.5 * PI - 0.25 * PI;
        assert!(along.distance(DVec3::new(angle.cos(), angle.sin(), 0.0)) < 1e-12, "{along}");
        for t in [0, 123_456_789, 999_999_999] {
            assert_eq!(motion.at(t), motion.at(t + 7_000_000_000));
            assert_eq!(motion.at(t), motion.at(t - 3_000_000_000));
        }
        let instants = motion.instants();
        assert_eq!((instants[0], instants.len()), (0, 17));
        assert!(instants.is_sorted() && instants.iter().all(|t| (0..1_000_000_000).contains(t)));
    }

    #[test]
    fn instants_are_bounded() {
        let times: Vec<f64> = (0..100_000).map(f64::from).collect();
        let values = times.iter().map(|t| DVec3::new(*t, 0.0, 0.0)).collect();
        let node = NodeMotion {
            translation: ValueTrack::Keys(keys(&times, values, Interpolation::Linear)),
            rotation: ValueTrack::Constant(DQuat::IDENTITY),
        };
        let motion = PartMotion::new(vec![Arc::new(PartLink::Node(node))], 99_999.0, 99_999_000_000_000);
        let n = motion.instants().len();
        assert!((2_000..=MOST_INSTANTS + BETWEEN_KEYS + 1).contains(&n), "{n}");
    }
}
