//! A rigid pose as every tracker reports it.

/// Where a body is: `p_world = rotation * p_body + position`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Position of the body's origin in world space, metres.
    pub position_m: [f64; 3],
    /// Unit quaternion world-from-body, components x y z w. `q` and `-q` are the same rotation.
    pub rotation_xyzw: [f64; 4],
}

impl Pose {
    /// The body frame equals the world frame.
    pub const IDENTITY: Self = Self { position_m: [0.0; 3], rotation_xyzw: [0.0, 0.0, 0.0, 1.0] };

    /// True when every component is finite and the quaternion's norm is within `tolerance` of 1.
    pub fn is_valid(&self, tolerance: f64) -> bool {
        let norm2: f64 = self.rotation_xyzw.iter().map(|c| c * c).sum();
        self.position_m.iter().all(|c| c.is_finite())
            && norm2.is_finite()
            && (norm2 - 1.0).abs() <= 2.0 * tolerance + tolerance * tolerance
    }
}
