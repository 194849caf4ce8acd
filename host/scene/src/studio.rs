//! Generates a photographer's studio: soft boxes in a dim room, for scenes without light of their own.
//!
//! Even light does not show shape, and a mirror in it is invisible; a few large, soft boxes show both, and are easy to
//! sample.

use super::Environment;
use glam::Vec3;

const WIDTH: u32 = 128;
const HEIGHT: u32 = 64;

/// A rectangular light seen from the middle of the room.
struct SoftBox {
    /// Direction of its middle; need not be of unit length.
    toward: Vec3,
    /// Tangents of half its angular width and height.
    half: [f32; 2],
    /// Linear.
    radiance: Vec3,
}

/// The room: floor, horizon and ceiling, linear radiance.
const FLOOR: Vec3 = Vec3::new(0.07, 0.06, 0.055);
const HORIZON: Vec3 = Vec3::new(0.16, 0.17, 0.18);
const CEILING: Vec3 = Vec3::new(0.10, 0.12, 0.15);

/// Key from the upper right in front, fill from the left, rim from behind above.
const BOXES: [SoftBox; 3] = [
    SoftBox { toward: Vec3::new(0.7, 0.8, 0.9), half: [0.38, 0.28], radiance: Vec3::new(2.5, 2.35, 2.15) },
    SoftBox {
        toward: Vec3::new(-1.0, 0.25, 0.55),
        half: [0.25, 0.55],
        radiance: Vec3::new(0.56, 0.68, 0.82),
    },
    SoftBox { toward: Vec3::new(-0.4, 0.9, -1.0), half: [0.45, 0.2], radiance: Vec3::new(1.5, 1.55, 1.7) },
];

fn smooth_step(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// The radiance from direction `d`, of unit length.
fn radiance(d: Vec3) -> Vec3 {
    let room = if d.y < 0.0 {
        HORIZON.lerp(FLOOR, smooth_step(0.0, 0.35, -d.y))
    } else {
        HORIZON.lerp(CEILING, smooth_step(0.0, 0.8, d.y))
    };
    BOXES.iter().fold(room, |sum, b| {
        let forward = b.toward.normalize();
        let right = forward.cross(Vec3::Y).normalize();
        let up = right.cross(forward);
        let depth = d.dot(forward);
        if depth <= 0.0 {
            return sum;
        }
        // Inside where both are below 1; the edge is soft over a tenth.
        let [x, y] = [d.dot(right).abs() / depth / b.half[0], d.dot(up).abs() / depth / b.half[1]];
        sum + b.radiance * (1.0 - smooth_step(0.9, 1.1, x)) * (1.0 - smooth_step(0.9, 1.1, y))
    })
}

/// The studio. Its mean radiance over the sphere is 0.25, equal to the even light of scenes with lamps of their own.
pub fn studio() -> Environment {
    let texels = (0..HEIGHT).flat_map(|row| {
        let polar = (row as f32 + 0.5) / HEIGHT as f32 * std::f32::consts::PI;
        (0..WIDTH).map(move |column| {
            // The middle column looks along -Z.
            let turn = ((column as f32 + 0.5) / WIDTH as f32 - 0.5) * std::f32::consts::TAU;
            radiance(Vec3::new(polar.sin() * turn.sin(), polar.cos(), -polar.sin() * turn.cos()))
        })
    });
    Environment::Equirect { width: WIDTH, height: HEIGHT, texels: texels.collect(), rotation_rad: 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_studio_is_as_bright_as_even_light() {
        let Environment::Equirect { width, height, texels, .. } = studio() else { panic!("an image") };
        assert_eq!(texels.len(), (width * height) as usize);
        let (mut sum, mut weight) = (Vec3::ZERO, 0.0);
        for (row, pixels) in texels.chunks(width as usize).enumerate() {
            let solid = ((row as f32 + 0.5) / height as f32 * std::f32::consts::PI).sin();
            sum += pixels.iter().sum::<Vec3>() * solid;
            weight += solid * width as f32;
        }
        let mean = (sum / weight).dot(Vec3::new(0.2126, 0.7152, 0.0722));
        assert!((mean - 0.25).abs() < 0.01, "mean luminance {mean}");
        assert!(texels.iter().all(|t| t.is_finite() && t.min_element() > 0.0));
    }

    #[test]
    fn the_key_light_is_on_the_right_in_front_and_the_floor_is_darkest() {
        let key = radiance(Vec3::new(0.7, 0.8, 0.9).normalize());
        assert!(key.min_element() > 2.0 && radiance(-Vec3::Y).max_element() < 0.1);
        assert!(radiance(Vec3::new(-0.7, 0.8, 0.9).normalize()).max_element() < 0.5);
    }
}
