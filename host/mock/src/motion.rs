//! Computes the true pose at any time: closed forms of the motions that the mock tracker reports and the mock projector
//! lights.
//!
//! Every motion of a rig file is periodic with a period of whole nanoseconds, and time is reduced to the period as an
//! integer before any floating-point operation: a pose is as exact after 400 days as in the first second.

use dpm_device::pose::Pose;
use std::sync::Arc;

pub use crate::motion_spec::{MotionKind, MotionSpec};

/// Why a [`MotionSpec`] is invalid.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MotionError {
    /// A number outside its range.
    #[error("motion: `{field}` is {value}; it must be {rule}")]
    OutOfRange {
        /// Name of the field in the rig file.
        field: &'static str,
        /// The value given.
        value: f64,
        /// The range.
        rule: &'static str,
    },
    /// A vector without direction.
    #[error("motion: `{field}` is {value:?}; it must be finite and not zero")]
    NoDirection {
        /// Name of the field in the rig file.
        field: &'static str,
        /// The value given.
        value: [f64; 3],
    },
    /// The turn takes more room than there is.
    #[error(
        "motion: turning round at {speed_m_s} m/s with {acceleration_m_s2} m/s^2 takes {needed_m} m, more than \
         `amplitude_m` = {amplitude_m}; raise `amplitude_m` or `acceleration_m_s2`"
    )]
    NoRoomToTurn {
        /// Speed, m/s.
        speed_m_s: f64,
        /// Acceleration, m/s^2.
        acceleration_m_s2: f64,
        /// Given amplitude, m.
        amplitude_m: f64,
        /// Least amplitude, m.
        needed_m: f64,
    },
    /// One cycle is shorter than a microsecond or longer than a year.
    #[error("motion: one cycle takes {seconds} s; it must be between 1e-6 s and 3.2e7 s")]
    Period {
        /// Length of the cycle, s.
        seconds: f64,
    },
    /// `together` with 0, too many or nested parts.
    #[error("motion: `parts` must hold 1 to 8 motions, none of them `together`")]
    Parts,
    /// The rest pose has a non-finite number or a quaternion that is not of unit length.
    #[error("motion: the rest pose {0:?} is not a rigid pose")]
    RestPose(Pose),
}

/// Velocity of a body in world axes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Twist {
    /// Velocity of the body's origin, metres per second.
    pub linear_m_s: [f64; 3],
    /// Angular velocity, radians per second, right-handed.
    pub angular_rad_s: [f64; 3],
}

/// A checked motion of one body about its rest pose: computes the true pose at any time.
#[derive(Clone, Debug, PartialEq)]
pub struct Motion {
    rest: Pose,
    parts: Vec<ElementaryMotion>,
}

/// One elementary motion with its period in whole nanoseconds.
#[derive(Clone, Debug, PartialEq)]
enum ElementaryMotion {
    /// Through poses relative to the rest pose, so many nanoseconds apart; at rest before the first and after the last.
    Path { poses: Arc<[Pose]>, step_ns: i64 },
    /// Two straight stretches of twice `half_stretch_ns`, joined by turns of `turn_ns`, with a rest of `rest_ns` in the
    /// middle of each turn.
    Line { direction: [f64; 3], speed: f64, half_stretch_ns: i64, turn_ns: i64, rest_ns: i64 },
    /// `amplitude * sin(2 pi t / period)`.
    Wave { direction: [f64; 3], amplitude: f64, period_ns: i64 },
    /// `2 pi t / period` about an axis through `pivot`; `sense` is 1 or -1.
    Turn { axis: [f64; 3], sense: f64, pivot: [f64; 3], period_ns: i64 },
    /// `amplitude * sin(2 pi t / period)` about an axis through `pivot`.
    Sway { axis: [f64; 3], amplitude: f64, pivot: [f64; 3], period_ns: i64 },
}

impl Motion {
    /// Checks `spec` and applies it relative to `rest`.
    pub fn new(spec: &MotionSpec, rest: Pose) -> Result<Self, MotionError> {
        if !rest.is_valid(1e-6) {
            return Err(MotionError::RestPose(rest));
        }
        let rest = Pose { rotation_xyzw: normalize4(rest.rotation_xyzw), ..rest };
        let mut parts = Vec::new();
        match spec {
            MotionSpec::Together { parts: specs } => {
                let nested = specs.iter().any(|s| matches!(s, MotionSpec::Together { .. }));
                if specs.is_empty() || specs.len() > MotionSpec::MAX_PARTS || nested {
                    return Err(MotionError::Parts);
                }
                for spec in specs {
                    add_part(spec, &rest, &mut parts)?;
                }
            }
            spec => add_part(spec, &rest, &mut parts)?,
        }
        Ok(Self { rest, parts })
    }

    /// A body at rest. Never panics: an invalid pose is returned as the error.
    pub fn still(rest: Pose) -> Result<Self, MotionError> {
        Self::new(&MotionSpec::Still {}, rest)
    }

    /// A body that goes through `poses`, relative to `rest` and `step_ns` > 0 apart, once: a recording. It moves on cubic
    /// polynomials through four of them, and is at rest before the first and after the last, where its velocity is taken
    /// for 0. Fewer than four poses are a body at rest.
    ///
    /// # Errors
    /// A pose is not rigid.
    pub fn through(rest: Pose, poses: &[Pose], step_ns: i64) -> Result<Self, MotionError> {
        if let Some(pose) = [rest].iter().chain(poses).find(|pose| !pose.is_valid(1e-6)) {
            return Err(MotionError::RestPose(*pose));
        }
        let is_path = poses.len() >= 4 && step_ns > 0;
        let path = ElementaryMotion::Path { poses: poses.into(), step_ns };
        Ok(Self { rest, parts: if is_path { vec![path] } else { Vec::new() } })
    }

    /// The pose that the motion is relative to.
    pub fn rest(&self) -> Pose {
        self.rest
    }

    /// World-from-body at `t_ns` nanoseconds after the motion's start (any value, also negative). The quaternion has
    /// unit length within 4e-16.
    pub fn pose_at(&self, t_ns: i64) -> Pose {
        self.state_at(t_ns).0
    }

    /// Velocity at `t_ns`: the exact derivative of [`Motion::pose_at`].
    pub fn twist_at(&self, t_ns: i64) -> Twist {
        self.state_at(t_ns).1
    }

    /// Pose and velocity at `t_ns`.
    pub fn state_at(&self, t_ns: i64) -> (Pose, Twist) {
        let mut pose = self.rest;
        let mut twist = Twist::default();
        for part in &self.parts {
            part.apply(t_ns, &mut pose, &mut twist);
        }
        pose.rotation_xyzw = normalize4(pose.rotation_xyzw);
        (pose, twist)
    }
}

fn add_part(spec: &MotionSpec, rest: &Pose, parts: &mut Vec<ElementaryMotion>) -> Result<(), MotionError> {
    match *spec {
        MotionSpec::Still {} => {}
        MotionSpec::Translate { direction, speed_m_s, amplitude_m, acceleration_m_s2, rest_s } => {
            parts.push(line(direction, speed_m_s, amplitude_m, acceleration_m_s2, rest_s, "direction")?);
        }
        MotionSpec::Sinusoid { direction, peak_speed_m_s, peak_acceleration_m_s2 } => {
            let direction = unit3("direction", direction)?;
            let speed = positive("peak_speed_m_s", peak_speed_m_s)?;
            let acceleration = positive("peak_acceleration_m_s2", peak_acceleration_m_s2)?;
            let period_ns = whole_period(core::f64::consts::TAU * speed / acceleration)?;
            parts.push(ElementaryMotion::Wave {
                direction,
                amplitude: speed * speed / acceleration,
                period_ns,
            });
        }
        MotionSpec::Rotate { axis, rate_rad_s, pivot_offset_m } => {
            if pivot_offset_m.iter().any(|c| !c.is_finite()) {
                return Err(MotionError::NoDirection { field: "pivot_offset_m", value: pivot_offset_m });
            }
            turn(axis, rate_rad_s, add(rest.position_m, pivot_offset_m), parts)?;
        }
        MotionSpec::Sway { axis, peak_rate_rad_s, peak_acceleration_rad_s2 } => {
            let axis = unit3("axis", axis)?;
            let rate = positive("peak_rate_rad_s", peak_rate_rad_s)?;
            let acceleration = positive("peak_acceleration_rad_s2", peak_acceleration_rad_s2)?;
            let period_ns = whole_period(core::f64::consts::TAU * rate / acceleration)?;
            let amplitude = rate * rate / acceleration;
            parts.push(ElementaryMotion::Sway { axis, amplitude, pivot: rest.position_m, period_ns });
        }
        MotionSpec::Screw { axis, rate_rad_s, speed_m_s, amplitude_m, acceleration_m_s2 } => {
            turn(axis, rate_rad_s, rest.position_m, parts)?;
            parts.push(line(axis, speed_m_s, amplitude_m, acceleration_m_s2, 0.0, "axis")?);
        }
        MotionSpec::Together { .. } => return Err(MotionError::Parts),
    }
    Ok(())
}

fn line(
    direction: [f64; 3],
    speed: f64,
    amplitude: f64,
    acceleration: f64,
    rest_s: f64,
    field: &'static str,
) -> Result<ElementaryMotion, MotionError> {
    let direction = unit3(field, direction)?;
    let speed = positive("speed_m_s", speed)?;
    let amplitude = positive("amplitude_m", amplitude)?;
    let acceleration = positive("acceleration_m_s2", acceleration)?;
    if !(rest_s >= 0.0 && rest_s.is_finite()) {
        return Err(MotionError::OutOfRange { field: "rest_s", value: rest_s, rule: "0 or more" });
    }
    // Half of a turn slows from full speed to zero: distance speed^2 / (2 acceleration) beyond the stretch's end.
    let turn_depth = speed * speed / (2.0 * acceleration);
    if turn_depth > amplitude {
        return Err(MotionError::NoRoomToTurn {
            speed_m_s: speed,
            acceleration_m_s2: acceleration,
            amplitude_m: amplitude,
            needed_m: turn_depth,
        });
    }
    let stretch_s = 2.0 * (amplitude - turn_depth) / speed;
    let turn_s = 2.0 * speed / acceleration;
    whole_period(2.0 * (stretch_s + turn_s + rest_s))?;
    // Whole nanoseconds for each piece keep position and speed continuous without drift; the amplitude changes by less
    // than 1 nm per m/s.
    let turn_ns = ((turn_s * 1e9).round() as i64).max(2);
    let half_stretch_ns = (stretch_s * 0.5e9).round() as i64;
    Ok(ElementaryMotion::Line {
        direction,
        speed,
        half_stretch_ns,
        turn_ns,
        rest_ns: (rest_s * 1e9).round() as i64,
    })
}

fn turn(
    axis: [f64; 3],
    rate: f64,
    pivot: [f64; 3],
    parts: &mut Vec<ElementaryMotion>,
) -> Result<(), MotionError> {
    let axis = unit3("axis", axis)?;
    if !rate.is_finite() || rate.abs() > 1e5 {
        return Err(MotionError::OutOfRange { field: "rate_rad_s", value: rate, rule: "within +-1e5" });
    }
    if rate != 0.0 {
        let period_ns = whole_period(core::f64::consts::TAU / rate.abs())?;
        parts.push(ElementaryMotion::Turn { axis, sense: rate.signum(), pivot, period_ns });
    }
    Ok(())
}

impl ElementaryMotion {
    /// Applies this part to `pose` and `twist`, the state after the previous parts.
    fn apply(&self, t_ns: i64, pose: &mut Pose, twist: &mut Twist) {
        match *self {
            ElementaryMotion::Path { ref poses, step_ns } => along(poses, step_ns, t_ns, pose, twist),
            ElementaryMotion::Line { direction, speed, half_stretch_ns, turn_ns, rest_ns } => {
                let (s, v) = line_at(t_ns, speed, half_stretch_ns, turn_ns, rest_ns);
                pose.position_m = add(pose.position_m, scale(direction, s));
                twist.linear_m_s = add(twist.linear_m_s, scale(direction, v));
            }
            ElementaryMotion::Wave { direction, amplitude, period_ns } => {
                let (sin, cos, omega) = phase(t_ns, period_ns);
                pose.position_m = add(pose.position_m, scale(direction, amplitude * sin));
                twist.linear_m_s = add(twist.linear_m_s, scale(direction, amplitude * omega * cos));
            }
            ElementaryMotion::Turn { axis, sense, pivot, period_ns } => {
                let fraction = t_ns.rem_euclid(period_ns) as f64 / period_ns as f64;
                let omega = core::f64::consts::TAU / (period_ns as f64 * 1e-9);
                rotate_about(
                    axis,
                    sense * core::f64::consts::TAU * fraction,
                    sense * omega,
                    pivot,
                    pose,
                    twist,
                );
            }
            ElementaryMotion::Sway { axis, amplitude, pivot, period_ns } => {
                let (sin, cos, omega) = phase(t_ns, period_ns);
                rotate_about(axis, amplitude * sin, amplitude * omega * cos, pivot, pose, twist);
            }
        }
    }
}

/// Applies the pose at `t_ns` of a path of four poses or more.
fn along(poses: &[Pose], step_ns: i64, t_ns: i64, pose: &mut Pose, twist: &mut Twist) {
    let end_ns = (poses.len() as i64 - 1) * step_ns;
    let t_ns = t_ns.clamp(0, end_ns);
    let first = (t_ns / step_ns - 1).clamp(0, poses.len() as i64 - 4);
    let u = (t_ns - first * step_ns) as f64 / step_ns as f64;
    let around: [&Pose; 4] = std::array::from_fn(|k| &poses[first as usize + k]);
    // Lagrange's polynomials through 0, 1, 2 and 3, and their derivatives.
    let weights = [
        -(u - 1.0) * (u - 2.0) * (u - 3.0) / 6.0,
        u * (u - 2.0) * (u - 3.0) / 2.0,
        -u * (u - 1.0) * (u - 3.0) / 2.0,
        u * (u - 1.0) * (u - 2.0) / 6.0,
    ];
    let slopes = [
        -(3.0 * u * u - 12.0 * u + 11.0) / 6.0,
        (3.0 * u * u - 10.0 * u + 6.0) / 2.0,
        -(3.0 * u * u - 8.0 * u + 3.0) / 2.0,
        (3.0 * u * u - 6.0 * u + 2.0) / 6.0,
    ];
    let (mut position, mut velocity, mut turn, mut rate) = ([0.0; 3], [0.0; 3], [0.0; 4], [0.0; 4]);
    for ((at, weight), slope) in around.iter().zip(weights).zip(slopes) {
        position = add(position, scale(at.position_m, weight));
        velocity = add(velocity, scale(at.position_m, slope));
        // The same hemisphere, so that quaternions can be added.
        let dot = at.rotation_xyzw.iter().zip(around[0].rotation_xyzw).map(|(a, b)| a * b).sum::<f64>();
        for (i, q) in at.rotation_xyzw.iter().enumerate() {
            turn[i] += dot.signum() * weight * q;
            rate[i] += dot.signum() * slope * q;
        }
    }
    let per_s = if t_ns == 0 || t_ns == end_ns { 0.0 } else { 1e9 / step_ns as f64 };
    let norm = turn.iter().map(|c| c * c).sum::<f64>().sqrt();
    let turn = turn.map(|c| c / norm);
    let [x, y, z, w] = turn;
    // The angular velocity is twice the vector part of the quaternion's rate and its conjugate.
    let [wx, wy, wz, _] = multiply(rate.map(|c| 2.0 * per_s * c / norm), [-x, -y, -z, w]);
    pose.position_m = add(pose.position_m, position);
    pose.rotation_xyzw = multiply(turn, pose.rotation_xyzw);
    twist.linear_m_s = add(twist.linear_m_s, scale(velocity, per_s));
    twist.angular_rad_s = add(twist.angular_rad_s, [wx, wy, wz]);
}

/// Sine and cosine of `2 pi t / period`, and the angular frequency in rad/s.
fn phase(t_ns: i64, period_ns: i64) -> (f64, f64, f64) {
    let angle = core::f64::consts::TAU * (t_ns.rem_euclid(period_ns) as f64 / period_ns as f64);
    (libm::sin(angle), libm::cos(angle), core::f64::consts::TAU / (period_ns as f64 * 1e-9))
}

/// Position and speed on the line. One cycle from its middle: half a stretch, a turn, a stretch back, a turn, half a stretch.
fn line_at(t_ns: i64, speed: f64, half_stretch_ns: i64, turn_ns: i64, rest_ns: i64) -> (f64, f64) {
    let half_cycle = 2 * half_stretch_ns + turn_ns + rest_ns;
    let t = (t_ns.rem_euclid(2 * half_cycle) + half_stretch_ns) % (2 * half_cycle);
    // The second half of the cycle mirrors the first: s(t + half_cycle) = -s(t).
    let (t, sign) = if t < half_cycle { (t, 1.0) } else { (t - half_cycle, -1.0) };
    let u = t - half_stretch_ns;
    if u <= half_stretch_ns {
        (sign * speed * u as f64 * 1e-9, sign * speed)
    } else {
        // The rest is not part of the turn: the first half comes before it, the second after it.
        let turned_ns = u - half_stretch_ns;
        let turned_ns = turned_ns.min((turn_ns / 2).max(turned_ns - rest_ns));
        if rest_ns > 0 && turned_ns == turn_ns / 2 {
            let s = speed * (half_stretch_ns as f64 + 0.25 * turn_ns as f64) * 1e-9;
            return (sign * s, 0.0);
        }
        let x = turned_ns as f64 * 1e-9;
        let turn_s = turn_ns as f64 * 1e-9;
        let s = speed * half_stretch_ns as f64 * 1e-9 + speed * x * (1.0 - x / turn_s);
        (sign * s, sign * speed * (1.0 - 2.0 * x / turn_s))
    }
}

fn rotate_about(axis: [f64; 3], angle: f64, rate: f64, pivot: [f64; 3], pose: &mut Pose, twist: &mut Twist) {
    let (sin, cos) = libm::sincos(0.5 * angle);
    let q = [axis[0] * sin, axis[1] * sin, axis[2] * sin, cos];
    let arm = rotate(q, sub(pose.position_m, pivot));
    let omega = scale(axis, rate);
    pose.position_m = add(pivot, arm);
    pose.rotation_xyzw = multiply(q, pose.rotation_xyzw);
    twist.linear_m_s = add(rotate(q, twist.linear_m_s), cross(omega, arm));
    twist.angular_rad_s = add(rotate(q, twist.angular_rad_s), omega);
}

fn positive(field: &'static str, value: f64) -> Result<f64, MotionError> {
    if value.is_finite() && value > 0.0 && value <= 1e6 {
        Ok(value)
    } else {
        Err(MotionError::OutOfRange { field, value, rule: "above 0 and at most 1e6" })
    }
}

fn whole_period(seconds: f64) -> Result<i64, MotionError> {
    if (1e-6..=3.2e7).contains(&seconds) {
        Ok((seconds * 1e9).round() as i64)
    } else {
        Err(MotionError::Period { seconds })
    }
}

fn unit3(field: &'static str, value: [f64; 3]) -> Result<[f64; 3], MotionError> {
    // Scaling by the largest component first prevents underflow and overflow of 1e-200 and 1e200.
    let largest = value.iter().fold(0.0f64, |m, c| m.max(c.abs()));
    if value.iter().any(|c| !c.is_finite()) || largest == 0.0 {
        return Err(MotionError::NoDirection { field, value });
    }
    let v = [value[0] / largest, value[1] / largest, value[2] / largest];
    let norm = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    Ok([v[0] / norm, v[1] / norm, v[2] / norm])
}

pub(crate) fn add(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}
pub(crate) fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}
pub(crate) fn scale(a: [f64; 3], s: f64) -> [f64; 3] {
    [a[0] * s, a[1] * s, a[2] * s]
}
pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(crate) fn normalize4(q: [f64; 4]) -> [f64; 4] {
    let norm = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    q.map(|c| c / norm)
}

/// Hamilton product: the rotation `b` followed by `a`.
pub(crate) fn multiply(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    let ([ax, ay, az, aw], [bx, by, bz, bw]) = (a, b);
    [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]
}

/// `v` rotated by the unit quaternion `q`.
pub(crate) fn rotate(q: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    let u = [q[0], q[1], q[2]];
    let t = scale(cross(u, v), 2.0);
    add(v, add(scale(t, q[3]), cross(u, t)))
}

/// The quaternion of the rotation by the vector `r` (axis times angle, radians), exact at 0 too.
pub(crate) fn from_rotation_vector(r: [f64; 3]) -> [f64; 4] {
    let angle = (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]).sqrt();
    let k = if angle > 1e-9 { libm::sin(0.5 * angle) / angle } else { 0.5 };
    [r[0] * k, r[1] * k, r[2] * k, libm::cos(0.5 * angle)]
}

#[cfg(test)]
#[path = "motion_tests.rs"]
mod tests;
