//! The optics of a projector: a point of the world to the pixel that lights it, through a Brown lens. Written for this
//! mock from the published formulas, and from nothing else of this project, so that it can judge the rest.

use dpm_device::pose::Pose;

/// A vector times a unit quaternion's rotation.
pub(super) fn rotate(q: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    let [x, y, z, w] = q;
    // v + 2 u x (u x v + w v), u the vector part.
    let a = cross([x, y, z], v);
    let a = [a[0] + w * v[0], a[1] + w * v[1], a[2] + w * v[2]];
    let b = cross([x, y, z], a);
    [v[0] + 2.0 * b[0], v[1] + 2.0 * b[1], v[2] + 2.0 * b[2]]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(super) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(super) fn length(v: [f64; 3]) -> f64 {
    dot(v, v).sqrt()
}

/// A point of a body's space in the world.
pub(super) fn place(pose: &Pose, point: [f64; 3]) -> [f64; 3] {
    let [x, y, z] = rotate(pose.rotation_xyzw, point);
    let [a, b, c] = pose.position_m;
    [a + x, b + y, c + z]
}

/// A projector's camera. Its space looks along -Z, with +X to the right and +Y up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProjectorOptics {
    /// Its place: world from projector.
    pub pose: Pose,
    /// Focal lengths in pixels.
    pub focal_px: [f64; 2],
    /// Principal point in pixels from the upper left corner of the raster: pixel (i, j) covers i to i + 1.
    pub centre_px: [f64; 2],
    /// Brown's coefficients k1, k2, p1, p2, k3, as OpenCV has them, for normalized coordinates x right and y down.
    pub brown: [f64; 5],
    /// k4, k5, k6 of OpenCV's rational model: the radial factor is divided by `1 + k4 r^2 + k5 r^4 + k6 r^6`.
    pub quotient: [f64; 3],
}

impl ProjectorOptics {
    /// A projector at `position_m` that looks along the world's -Z without roll, with the principal point in the middle of
    /// a raster of `width` by `height`, and no distortion.
    pub fn along_z(position_m: [f64; 3], focal_px: f64, width: u32, height: u32) -> Self {
        Self {
            pose: Pose { position_m, ..Pose::IDENTITY },
            focal_px: [focal_px; 2],
            centre_px: [f64::from(width) / 2.0, f64::from(height) / 2.0],
            brown: [0.0; 5],
            quotient: [0.0; 3],
        }
    }

    /// The factor by which a point at this squared radius moves away from the axis; `None` from the radius on at which the
    /// lens folds the picture back.
    fn radial(&self, r2: f64) -> Option<f64> {
        let [k1, k2, _, _, k3] = self.brown;
        // 1 + a r^2 + b r^4 + c r^6, and r times its slope.
        let polynomial = |[a, b, c]: [f64; 3]| {
            (1.0 + r2 * (a + r2 * (b + r2 * c)), r2 * (2.0 * a + r2 * (4.0 * b + r2 * 6.0 * c)))
        };
        let ((above, above_slope), (below, below_slope)) =
            (polynomial([k1, k2, k3]), polynomial(self.quotient));
        let grows = below > 0.0 && (above + above_slope) * below > above * below_slope;
        grows.then_some(above / below)
    }

    /// The point in the projector's space.
    pub(super) fn inward(&self, world: [f64; 3]) -> [f64; 3] {
        let [x, y, z, w] = self.pose.rotation_xyzw;
        rotate([-x, -y, -z, w], minus(world, self.pose.position_m))
    }

    /// The place on the raster, in pixels from its upper left corner, whose light hits a point of the world; `None` behind
    /// the projector, and beyond the radius at which the lens folds the picture back.
    pub fn pixel_of(&self, world: [f64; 3]) -> Option<[f64; 2]> {
        let [x, y, z] = self.inward(world);
        if z >= -1e-6 {
            return None;
        }
        let (x, y) = (x / -z, -y / -z);
        let [_, _, p1, p2, _] = self.brown;
        let r2 = x * x + y * y;
        let radial = self.radial(r2)?;
        let bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let bent_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        let [[fx, fy], [cx, cy]] = [self.focal_px, self.centre_px];
        Some([fx * bent_x + cx, fy * bent_y + cy])
    }

    /// The point of the world that a place on the raster lights, at the depth of `near`: on the plane through `near` that is
    /// parallel to the projector's raster. `None` where the lens lights nothing there.
    pub fn lit_near(&self, pixel: [f64; 2], near: [f64; 3]) -> Option<[f64; 3]> {
        let across = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]].map(|v| rotate(self.pose.rotation_xyzw, v));
        let depth = -self.inward(near)[2];
        let step = 1e-6 * depth;
        let mut at = near;
        for _ in 0..50 {
            let here = self.pixel_of(at)?;
            let off = [pixel[0] - here[0], pixel[1] - here[1]];
            if off[0].hypot(off[1]) < 1e-6 {
                return Some(at);
            }
            let slope = |k: usize| {
                let beside: [f64; 3] = std::array::from_fn(|i| at[i] + step * across[k][i]);
                self.pixel_of(beside).map(|p| [(p[0] - here[0]) / step, (p[1] - here[1]) / step])
            };
            let (a, b) = (slope(0)?, slope(1)?);
            let determinant = a[0] * b[1] - a[1] * b[0];
            let right = (off[0] * b[1] - off[1] * b[0]) / determinant;
            let up = (a[0] * off[1] - a[1] * off[0]) / determinant;
            at = std::array::from_fn(|i| at[i] + right * across[0][i] + up * across[1][i]);
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_lights_the_point_that_falls_on_it() {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let pose = Pose { position_m: [0.2, 0.1, -0.3], rotation_xyzw: [0.0, half, 0.0, half] };
        let brown = [-0.06, 0.02, 0.0005, -0.0003, 0.0];
        let optics = ProjectorOptics { pose, brown, ..ProjectorOptics::along_z([0.0; 3], 1800.0, 1024, 768) };
        for pixel in [[3.0, 5.0], [512.0, 384.0], [1000.0, 700.5]] {
            let near = [-1.1, 0.05, -0.25];
            let at = optics.lit_near(pixel, near).expect("inside the lens's view");
            let back = optics.pixel_of(at).expect("ahead");
            assert!((back[0] - pixel[0]).hypot(back[1] - pixel[1]) < 1e-5, "{back:?}");
            assert!((optics.inward(at)[2] - optics.inward(near)[2]).abs() < 1e-9);
        }
        assert_eq!(optics.lit_near([1e9, 0.0], [-1.0, 0.0, 0.0]), None);
    }

    #[test]
    fn points_of_a_pinhole_fall_where_the_formula_says() {
        let optics = ProjectorOptics::along_z([0.1, 0.2, 1.0], 1500.0, 1024, 768);
        // 0.3 to the right, 0.1 up, 2 ahead.
        let at = optics.pixel_of([0.4, 0.3, -1.0]).expect("ahead");
        assert!((at[0] - (512.0 + 225.0)).abs() < 1e-9 && (at[1] - (384.0 - 75.0)).abs() < 1e-9, "{at:?}");
        assert_eq!(optics.pixel_of([0.0, 0.0, 1.1]), None);
        // Turned by a right angle about +Y, it looks along -X.
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let pose = Pose { position_m: [0.0; 3], rotation_xyzw: [0.0, half, 0.0, half] };
        let at = ProjectorOptics { pose, ..optics }.pixel_of([-2.0, 0.0, 0.0]).expect("ahead");
        assert!((at[0] - 512.0).abs() < 1e-9 && (at[1] - 384.0).abs() < 1e-9, "{at:?}");
    }

    #[test]
    fn a_brown_lens_bends_as_the_published_formula() {
        let plain = ProjectorOptics::along_z([0.0; 3], 1000.0, 1000, 800);
        let bent = ProjectorOptics { brown: [-0.1, 0.02, 0.001, -0.002, 0.005], ..plain };
        // By hand for x = 0.3, y = 0.2: r2 = 0.13, radial = 1 - 0.013 + 0.000338 + 0.000010985.
        let radial = 1.0 - 0.1 * 0.13 + 0.02 * 0.13 * 0.13 + 0.005 * 0.13f64.powi(3);
        let x = 0.3 * radial + 2.0 * 0.001 * 0.06 + -0.002 * (0.13 + 0.18);
        let y = 0.2 * radial + 0.001 * (0.13 + 0.08) + 2.0 * -0.002 * 0.06;
        let at = bent.pixel_of([0.3, -0.2, -1.0]).expect("ahead");
        assert!((at[0] - (1000.0 * x + 500.0)).abs() < 1e-9 && (at[1] - (1000.0 * y + 400.0)).abs() < 1e-9);
        // The same above 1 + 0.2 r2 + 0.1 r2^2 - 0.05 r2^3.
        let rational = ProjectorOptics { quotient: [0.2, 0.1, -0.05], ..bent };
        let shrunk = radial / (1.0 + 0.2 * 0.13 + 0.1 * 0.13 * 0.13 - 0.05 * 0.13f64.powi(3));
        let at = rational.pixel_of([0.3, -0.2, -1.0]).expect("ahead");
        assert!((at[0] - (1000.0 * (x + 0.3 * (shrunk - radial)) + 500.0)).abs() < 1e-9, "{at:?}");
        // r / (1 + r^2) has its maximum at 1.
        let turned = ProjectorOptics { quotient: [1.0, 0.0, 0.0], ..plain };
        assert!(turned.pixel_of([0.99, 0.0, -1.0]).is_some() && turned.pixel_of([1.01, 0.0, -1.0]).is_none());
        // Where r (1 + k1 r^2) has its maximum, the picture folds.
        let folded = ProjectorOptics { brown: [-1.0, 0.0, 0.0, 0.0, 0.0], ..plain };
        assert!(folded.pixel_of([0.57, 0.0, -1.0]).is_some() && folded.pixel_of([0.58, 0.0, -1.0]).is_none());
    }
}
