//! The optics of the mock camera: pixels into rays. They share no code with what they judge.

use dpm_device::rng::Draws;

/// A pinhole with the lens of Brown.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraOptics {
    /// Columns and rows, 16 to 8192.
    pub size: [u32; 2],
    /// Focal lengths across and down, pixels.
    pub focal: [f64; 2],
    /// Where the axis leaves, pixels from the upper left corner of the picture.
    pub centre: [f64; 2],
    /// k1, k2, p1, p2, k3 by OpenCV's definition.
    pub lens: [f64; 5],
}

impl CameraOptics {
    /// A pinhole with square pixels, the axis in the middle, and this horizontal angle of view, degrees.
    pub fn pinhole(size: [u32; 2], view_deg: f64) -> Self {
        let half = [0.5 * f64::from(size[0]), 0.5 * f64::from(size[1])];
        let focal = half[0] / libm::tan(0.5 * view_deg.to_radians());
        Self { size, focal: [focal; 2], centre: half, lens: [0.0; 5] }
    }

    /// A camera as they come: a drawn angle of view of 45 to 75 degrees, pixels that are nearly square, an axis near the middle,
    /// and a lens that bends the corners by up to some tens of pixels.
    pub fn drawn(size: [u32; 2], seed: u64) -> Self {
        let draws = Draws::new(seed).stream(0x6f70_7469);
        let pinhole = Self::pinhole(size, 45.0 + 30.0 * draws.unit(0));
        let aside = |i: u64| 2.0 * draws.unit(i) - 1.0;
        let off = 0.02 * f64::from(size[0]);
        Self {
            focal: [pinhole.focal[0], pinhole.focal[1] * (1.0 + 0.005 * aside(1))],
            centre: [pinhole.centre[0] + off * aside(2), pinhole.centre[1] + off * aside(3)],
            lens: [0.15 * aside(4), 0.05 * aside(5), 1e-3 * aside(6), 1e-3 * aside(7), 0.0],
            ..pinhole
        }
    }

    /// The bent ray of a straight one, both `[x / z, y / z]` with y down.
    fn bend(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [k1, k2, p1, p2, k3] = self.lens;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    /// The pixel of a point in camera space, which looks along -Z with y up; `None` beside and behind the camera.
    pub fn pixel(&self, [x, y, z]: [f64; 3]) -> Option<[f64; 2]> {
        if z >= -1e-6 {
            return None;
        }
        let [x, y] = self.bend([x / -z, y / z]);
        Some([self.centre[0] + self.focal[0] * x, self.centre[1] + self.focal[1] * y])
    }

    /// The straight ray of a pixel, by iteration from the bent one; the lens must not fold inside the picture.
    pub(super) fn straight(&self, pixel: [f64; 2]) -> [f64; 2] {
        let bent: [f64; 2] = std::array::from_fn(|i| (pixel[i] - self.centre[i]) / self.focal[i]);
        let mut ray = bent;
        if self.lens != [0.0; 5] {
            for _ in 0..60 {
                let there = self.bend(ray);
                let off = [bent[0] - there[0], bent[1] - there[1]];
                (ray[0], ray[1]) = (ray[0] + off[0], ray[1] + off[1]);
                if off[0].abs().max(off[1].abs()) < 1e-12 {
                    break;
                }
            }
        }
        ray
    }

    /// The straight ray at each corner of each pixel: `(columns + 1) * (rows + 1)` of them.
    pub(crate) fn grid(&self) -> Vec<[f32; 2]> {
        let [w, h] = self.size;
        let rows = 0..=h;
        let corners = rows.flat_map(|y| (0..=w).map(move |x| [f64::from(x), f64::from(y)]));
        corners.map(|p| self.straight(p).map(|v| v as f32)).collect()
    }
}
