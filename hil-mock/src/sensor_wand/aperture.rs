//! How much of a round aperture the lit mirrors of a bit plane cover.

use dpm_device::planes::Raster;

/// Lines by which the part of the disc in each row of pixels is cut.
const LINES: usize = 8;

/// Largest radius, pixels: an aperture that is as large as the picture measures nothing.
pub(super) const MAX_RADIUS: f64 = 1024.0;

/// The mirrors that a round aperture sees, each with its share of the aperture. What lies outside the raster is dark. The
/// disc is cut exactly at the borders of rows, and each line's chord at those of pixels; a disc of less than a tenth of a
/// pixel is a point.
#[derive(Clone, Debug, Default)]
pub(super) struct Aperture {
    /// Byte of a plane, bit of it, and share.
    mirrors: Vec<(usize, u8, f64)>,
}

impl Aperture {
    /// Looks through a disc of `radius` pixels around `centre` (in pixels from the upper left corner).
    pub(super) fn look(&mut self, raster: Raster, centre: [f64; 2], radius: f64) {
        self.mirrors.clear();
        let [u, v] = centre;
        let outside = |at: f64, count: u32| !(-radius..=f64::from(count) + radius).contains(&at);
        if !(0.0..=MAX_RADIUS).contains(&radius) || outside(u, raster.width()) || outside(v, raster.height())
        {
            return;
        }
        if radius < 0.1 {
            self.add(raster, u.floor() as i64, v.floor() as i64, 1.0);
            return;
        }
        let mut area = 0.0;
        for y in (v - radius).floor() as i64..=(v + radius).floor() as i64 {
            // The lines lie evenly in the part of the row that the disc reaches. Were they fixed to the row, a disc smaller than
            // a pixel would cross its border in steps.
            let (top, bottom) = ((y as f64).max(v - radius), ((y + 1) as f64).min(v + radius));
            let height = (bottom - top) / LINES as f64;
            // Half chords of the lines.
            let mut half = [0.0; LINES];
            for (line, half) in half.iter_mut().enumerate() {
                let at = top + (line as f64 + 0.5) * height - v;
                *half = (radius * radius - at * at).max(0.0).sqrt();
                area += 2.0 * *half * height;
            }
            let widest = half.iter().copied().fold(0.0, f64::max);
            for x in (u - widest).floor() as i64..=(u + widest).floor() as i64 {
                let (low, high) = (x as f64, (x + 1) as f64);
                let part = |h: &f64| (high.min(u + h) - low.max(u - h)).max(0.0);
                let lit: f64 = half.iter().map(part).sum::<f64>() * height;
                if lit > 0.0 {
                    self.add(raster, x, y, lit);
                }
            }
        }
        if area > 0.0 {
            self.mirrors.iter_mut().for_each(|(_, _, share)| *share /= area);
        } else {
            self.add(raster, u.floor() as i64, v.floor() as i64, 1.0);
        }
    }

    fn add(&mut self, raster: Raster, x: i64, y: i64, share: f64) {
        if (0..i64::from(raster.width())).contains(&x) && (0..i64::from(raster.height())).contains(&y) {
            let byte = y as usize * raster.row_bytes() + x as usize / 8;
            self.mirrors.push((byte, 0x80 >> (x % 8), share));
        }
    }

    /// The share, 0 to 1, of the aperture on which `plane` is lit.
    pub(super) fn lit(&self, plane: &[u8]) -> f64 {
        self.mirrors.iter().filter(|(byte, bit, _)| plane[*byte] & bit != 0).map(|(_, _, share)| share).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn covered(raster: Raster, plane: &[u8], centre: [f64; 2], radius: f64) -> f64 {
        let mut seen = Aperture::default();
        // What was seen before plays no part.
        seen.look(raster, [3.0, 2.0], 2.0);
        seen.look(raster, centre, radius);
        seen.lit(plane)
    }

    fn plane(raster: Raster, lit: impl Fn(u32, u32) -> bool) -> Vec<u8> {
        let mut plane = vec![0; raster.plane_bytes()];
        for y in 0..raster.height() {
            for x in (0..raster.width()).filter(|&x| lit(x, y)) {
                plane[y as usize * raster.row_bytes() + x as usize / 8] |= 0x80 >> (x % 8);
            }
        }
        plane
    }

    /// The share of a disc on one side of a line has a closed form.
    #[test]
    fn a_disc_across_an_edge_has_the_share_of_its_segment() {
        let raster = Raster::new(60, 40).unwrap();
        let left = plane(raster, |x, _| x < 30);
        let upper = plane(raster, |_, y| y < 20);
        for radius in [0.3, 1.0, 2.25, 7.5] {
            for k in -12..=12 {
                let d = radius * f64::from(k) / 10.0;
                let h = (d / radius).clamp(-1.0, 1.0);
                let segment = (h.acos() - h * (1.0 - h * h).sqrt()) / std::f64::consts::PI;
                let across = covered(raster, &left, [30.0 + d, 20.2], radius);
                assert!((across - segment).abs() < 0.01, "{radius} {d}: {across} {segment}");
                let down = covered(raster, &upper, [30.3, 20.0 + d], radius);
                assert!((down - segment).abs() < 0.01, "{radius} {d}: {down} {segment}");
            }
        }
    }

    #[test]
    fn outside_the_raster_it_is_dark_and_a_point_sees_one_pixel() {
        let raster = Raster::new(16, 8).unwrap();
        let full = plane(raster, |_, _| true);
        assert!((covered(raster, &full, [8.0, 4.0], 2.0) - 1.0).abs() < 1e-12);
        assert!((covered(raster, &full, [0.0, 4.0], 2.0) - 0.5).abs() < 0.01);
        for far in [[-50.0, 4.0], [8.0, 1e12], [f64::MAX, f64::MIN]] {
            assert_eq!(covered(raster, &full, far, 2.0), 0.0);
        }
        let one = plane(raster, |x, y| (x, y) == (3, 2));
        assert_eq!(covered(raster, &one, [3.9, 2.1], 0.0), 1.0);
        assert_eq!(covered(raster, &one, [4.1, 2.1], 0.0), 0.0);
    }
}
