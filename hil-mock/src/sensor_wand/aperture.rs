//! How much of a round aperture the lit mirrors of a bit plane cover.

use dpm_device::planes::Raster;

/// Lines by which the disc is cut in each row of pixels.
const LINES: usize = 8;

/// Largest radius, pixels: an aperture that is as large as the picture measures nothing.
pub(super) const MAX_RADIUS: f64 = 1024.0;

/// The share, 0 to 1, of a disc of `radius` pixels around `centre` (in pixels from the upper left corner) on which `plane` is lit.
/// What lies outside the raster is dark. Each line's chord is cut exactly at the borders of pixels; a disc of less than
/// a tenth of a pixel is a point.
pub(super) fn covered(raster: Raster, plane: &[u8], centre: [f64; 2], radius: f64) -> f64 {
    let [u, v] = centre;
    let is_lit = |x: i64, y: i64| {
        let inside =
            (0..i64::from(raster.width())).contains(&x) && (0..i64::from(raster.height())).contains(&y);
        inside && plane[y as usize * raster.row_bytes() + x as usize / 8] << (x % 8) & 0x80 != 0
    };
    let outside = |at: f64, count: u32| !(-radius..=f64::from(count) + radius).contains(&at);
    if !(0.0..=MAX_RADIUS).contains(&radius) || outside(u, raster.width()) || outside(v, raster.height()) {
        return 0.0;
    }
    if radius < 0.1 {
        return f64::from(u8::from(is_lit(u.floor() as i64, v.floor() as i64)));
    }
    let (mut area, mut lit) = (0.0, 0.0);
    for y in (v - radius).floor() as i64..=(v + radius).floor() as i64 {
        for line in 0..LINES {
            let at = y as f64 + (line as f64 + 0.5) / LINES as f64 - v;
            let half = (radius * radius - at * at).max(0.0).sqrt();
            let (from, to) = (u - half, u + half);
            area += to - from;
            let mut x = from;
            while x < to {
                let next = (x.floor() + 1.0).min(to);
                if is_lit(x.floor() as i64, y) {
                    lit += next - x;
                }
                x = next;
            }
        }
    }
    if area > 0.0 {
        lit / area
    } else {
        f64::from(u8::from(is_lit(u.floor() as i64, v.floor() as i64)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
                // A line every eighth of a pixel: exact along rows, and to a part of its width across them.
                assert!(
                    (across - segment).abs() < 0.04 / radius.min(1.0) / radius,
                    "{radius} {d}: {across} {segment}"
                );
                let down = covered(raster, &upper, [30.3, 20.0 + d], radius);
                assert!((down - segment).abs() < 0.13 / radius, "{radius} {d}: {down} {segment}");
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
