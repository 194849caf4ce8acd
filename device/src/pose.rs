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

/// Covariance of a pose: of the position, m, and of a rotation vector on the left, rad, in the axes of the position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseCovariance {
    /// The lower triangle by rows: 1 entry, then 2, up to 6. Position first.
    pub lower: [f32; 21],
}

impl PoseCovariance {
    /// Of a symmetric matrix, whose lower triangle is read.
    pub fn of(matrix: &[[f64; 6]; 6]) -> Self {
        let mut lower = [0.0; 21];
        let mut at = 0;
        for (i, row) in matrix.iter().enumerate() {
            for value in &row[..=i] {
                lower[at] = *value as f32;
                at += 1;
            }
        }
        Self { lower }
    }

    /// The whole matrix.
    pub fn matrix(&self) -> [[f64; 6]; 6] {
        // Row i begins after i (i + 1) / 2 entries.
        let entry = |i: usize, j: usize| f64::from(self.lower[i * (i + 1) / 2 + j]);
        core::array::from_fn(|i| core::array::from_fn(|j| entry(i.max(j), i.min(j))))
    }

    /// The variances of the position along each axis, m^2, and of the rotation about each, rad^2; `None` if one of them is
    /// not finite or not above 0, which no measurement has.
    pub fn variances(&self) -> Option<[[f64; 3]; 2]> {
        let diagonal = [0, 2, 5, 9, 14, 20].map(|i| f64::from(self.lower[i]));
        let possible = diagonal.iter().all(|v| v.is_finite() && *v > 0.0);
        possible.then(|| [[diagonal[0], diagonal[1], diagonal[2]], [diagonal[3], diagonal[4], diagonal[5]]])
    }
}
