//! Things at rest in the light of a projector, as a camera sees them: walls, balls and printed tags.
//!
//! Every pixel of the camera is a set of true rays. Where each ends, which place of the projector's raster lights it and how
//! much of that light comes back is found once; a picture is then a sum over what the raster shows. Things stand in each
//! other's light.

use super::{CameraOptics, PrintedTag};
use crate::motion::{add, multiply, rotate, scale, sub};
use dpm_device::pose::Pose;
use dpm_device::rng::Draws;
use dpm_device::tag36h11::{printed_cell, TagBoard, CELLS, PRINTED};

/// Share of light that white and black of a print reflect.
const PRINT: [f64; 2] = [0.05, 0.95];
/// What a ray must leave behind before it meets something else, metres.
const LEAST_WAY: f64 = 1e-4;

/// A thing at rest.
#[derive(Clone, Debug, PartialEq)]
pub enum LitThing {
    /// A rectangle in the plane z = 0 of its own space, whose front is +z.
    Sheet {
        /// Its place.
        pose: Pose,
        /// Half its width and height, metres.
        half_m: [f64; 2],
        /// Share of light that it reflects.
        albedo: f64,
    },
    /// A ball.
    Ball {
        /// Its middle, metres.
        middle_m: [f64; 3],
        /// Its radius, metres.
        radius_m: f64,
        /// Share of light that it reflects.
        albedo: f64,
    },
    /// A printed tag on a body at rest.
    Tag {
        /// The body's place.
        pose: Pose,
        /// The tag on the body.
        tag: PrintedTag,
    },
}

/// Camera, projector and what they look at.
#[derive(Clone, Debug)]
pub struct LitStage {
    /// The camera's raster and lens.
    pub camera: CameraOptics,
    /// World from camera; it looks along -Z with +Y up.
    pub camera_pose: Pose,
    /// The projector's raster and lens.
    pub projector: CameraOptics,
    /// World from projector; it looks along -Z with +Y up.
    pub projector_pose: Pose,
    /// What is there.
    pub things: Vec<LitThing>,
    /// Grey level of white that faces the room's light.
    pub ambient: f64,
    /// Grey level of white that faces the projector's full light at a metre, without the room's.
    pub light: f64,
    /// Rays along each side of a pixel, 1 to 8.
    pub samples: u32,
    /// Noise of reading, grey levels, and variance for each grey level.
    pub noise: [f64; 2],
    /// Seed of the noise.
    pub seed: u64,
}

/// One ray of a pixel.
#[derive(Clone, Copy, Debug)]
struct Sample {
    /// Index in the projector's raster; `NOWHERE` in the dark.
    from: u32,
    /// Grey levels of the lit raster's light, as a share of the pixel, and of the room's.
    lit: f32,
    room: f32,
}

const NOWHERE: u32 = u32::MAX;

/// What the camera sees, ready for any picture of the projector.
#[derive(Clone, Debug)]
pub struct LitView {
    stage: LitStage,
    samples: Vec<Sample>,
    rays: usize,
}

/// Where a ray meets a thing.
struct Hit {
    along: f64,
    normal: [f64; 3],
    albedo: f64,
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn inverse(q: [f64; 4]) -> [f64; 4] {
    [-q[0], -q[1], -q[2], q[3]]
}

/// Where a ray meets the plane z = 0 of a pose from its front: how far, the place in the plane, and the normal.
fn on_plane(pose: &Pose, from: [f64; 3], ray: [f64; 3]) -> Option<(f64, [f64; 2], [f64; 3])> {
    let back = inverse(pose.rotation_xyzw);
    let (o, d) = (rotate(back, sub(from, pose.position_m)), rotate(back, ray));
    if d[2] >= 0.0 || o[2] <= 0.0 {
        return None;
    }
    let along = -o[2] / d[2];
    let normal = rotate(pose.rotation_xyzw, [0.0, 0.0, 1.0]);
    Some((along, [o[0] + along * d[0], o[1] + along * d[1]], normal))
}

impl LitThing {
    fn meets(&self, from: [f64; 3], ray: [f64; 3]) -> Option<Hit> {
        match self {
            Self::Sheet { pose, half_m, albedo } => {
                let (along, [x, y], normal) = on_plane(pose, from, ray)?;
                let inside = x.abs() < half_m[0] && y.abs() < half_m[1];
                inside.then_some(Hit { along, normal, albedo: *albedo })
            }
            Self::Tag { pose, tag } => {
                let place = Pose {
                    position_m: add(pose.position_m, rotate(pose.rotation_xyzw, tag.place.position_m)),
                    rotation_xyzw: multiply(pose.rotation_xyzw, tag.place.rotation_xyzw),
                };
                let (along, [x, y], normal) = on_plane(&place, from, ray)?;
                let cell = tag.side_m / CELLS as f64;
                let (i, j) = (x / cell + 0.5 * PRINTED as f64, 0.5 * PRINTED as f64 - y / cell);
                if i < 0.0 || j < 0.0 {
                    return None;
                }
                let white = printed_cell(tag.id, i as usize, j as usize)?;
                Some(Hit { along, normal, albedo: PRINT[usize::from(white)] })
            }
            Self::Ball { middle_m, radius_m, albedo } => {
                let o = sub(from, *middle_m);
                let (a, b, c) = (dot(ray, ray), dot(ray, o), dot(o, o) - radius_m * radius_m);
                let root = b * b - a * c;
                if root <= 0.0 || c <= 0.0 {
                    return None;
                }
                let along = (-b - root.sqrt()) / a;
                let normal = scale(add(o, scale(ray, along)), 1.0 / radius_m);
                (along > 0.0).then_some(Hit { along, normal, albedo: *albedo })
            }
        }
    }
}

impl LitStage {
    /// The nearest thing on a ray.
    fn nearest(&self, from: [f64; 3], ray: [f64; 3]) -> Option<Hit> {
        let hits = self.things.iter().filter_map(|t| t.meets(from, ray)).filter(|h| h.along > LEAST_WAY);
        hits.min_by(|a, b| a.along.total_cmp(&b.along))
    }

    /// Where the projector's pixel lights: the nearest thing on its ray.
    pub fn lit_place(&self, pixel: [f64; 2]) -> Option<[f64; 3]> {
        let [x, y] = self.projector.straight(pixel);
        let ray = rotate(self.projector_pose.rotation_xyzw, [x, -y, -1.0]);
        let hit = self.nearest(self.projector_pose.position_m, ray)?;
        Some(add(self.projector_pose.position_m, scale(ray, hit.along)))
    }

    /// The projector's pixel that lights a place, wherever its raster ends; `None` behind it.
    pub fn pixel_of(&self, place: [f64; 3]) -> Option<[f64; 2]> {
        let back = inverse(self.projector_pose.rotation_xyzw);
        self.projector.pixel(rotate(back, sub(place, self.projector_pose.position_m)))
    }

    fn sample(&self, [x, y]: [f64; 2]) -> Sample {
        let dark = Sample { from: NOWHERE, lit: 0.0, room: 0.0 };
        let eye = self.camera_pose.position_m;
        let ray = rotate(self.camera_pose.rotation_xyzw, [x, -y, -1.0]);
        let Some(hit) = self.nearest(eye, ray) else { return dark };
        let place = add(eye, scale(ray, hit.along));
        let towards_eye = scale(ray, -1.0 / dot(ray, ray).sqrt());
        let room = self.ambient * hit.albedo * (0.4 + 0.6 * dot(hit.normal, towards_eye).max(0.0));
        let dark = Sample { room: room as f32, ..dark };
        let way = sub(place, self.projector_pose.position_m);
        let distance = dot(way, way).sqrt();
        let facing = -dot(hit.normal, way) / distance;
        let Some([u, v]) = self.pixel_of(place).filter(|_| facing > 0.0) else { return dark };
        let [w, h] = self.projector.size.map(f64::from);
        if !(u >= 0.0 && v >= 0.0 && u < w && v < h) {
            return dark;
        }
        // Something else stands in the light.
        let stops =
            |t: &LitThing| t.meets(self.projector_pose.position_m, way).is_some_and(|h| h.along < 1.0 - 1e-3);
        if self.things.iter().any(stops) {
            return dark;
        }
        let from = v as u32 * self.projector.size[0] + u as u32;
        Sample { from, lit: (self.light * hit.albedo * facing / (distance * distance)) as f32, ..dark }
    }

    /// Follows all rays.
    pub fn view(self) -> LitView {
        let n = self.samples.clamp(1, 8) as usize;
        let [w, h] = self.camera.size.map(|s| s as usize);
        let mut samples = Vec::with_capacity(w * h * n * n);
        for y in 0..h {
            for x in 0..w {
                for k in 0..n * n {
                    let (i, j) = ((k % n) as f64 + 0.5, (k / n) as f64 + 0.5);
                    let pixel = [x as f64 + i / n as f64, y as f64 + j / n as f64];
                    samples.push(self.sample(self.camera.straight(pixel)));
                }
            }
        }
        LitView { stage: self, samples, rays: n * n }
    }
}

impl LitView {
    /// What it was made of.
    pub fn stage(&self) -> &LitStage {
        &self.stage
    }

    /// A picture, rows from above, while the raster shows `lit`: shares of full light, row after row. `number` draws the noise.
    pub fn picture(&self, lit: &[f32], number: u64) -> Vec<u8> {
        let draws = Draws::new(self.stage.seed).stream(number);
        let [read, photon] = self.stage.noise;
        let share = 1.0 / self.rays as f32;
        let pixel = |(i, rays): (usize, &[Sample])| {
            let of = |s: &Sample| s.room + s.lit * lit.get(s.from as usize).copied().unwrap_or(0.0);
            let level = f64::from(rays.iter().map(of).sum::<f32>() * share);
            let noise = (read * read + photon * level.max(0.0)).sqrt() * draws.normal(2 * i as u64);
            (level + noise + 0.5).clamp(0.0, 255.0) as u8
        };
        self.samples.chunks_exact(self.rays).enumerate().map(pixel).collect()
    }
}

/// The turn by which something that looks along -Z with +Y up looks along `d`.
fn towards(d: [f64; 3]) -> [f64; 4] {
    let (yaw, pitch) = (libm::atan2(-d[0], -d[2]), libm::atan2(d[1], libm::hypot(d[0], d[2])));
    multiply(about([0.0, 1.0, 0.0], yaw), about([1.0, 0.0, 0.0], pitch))
}

fn about(axis: [f64; 3], angle: f64) -> [f64; 4] {
    let (s, c) = (libm::sin(0.5 * angle), libm::cos(0.5 * angle));
    [axis[0] * s, axis[1] * s, axis[2] * s, c]
}

impl LitStage {
    /// What a calibration of a projector by a camera looks at, drawn by `seed`: a wall, balls before it and a printed board at a
    /// slant, a projector some 2 m away, half of which throw their picture upwards, and a camera half a metre beside it.
    pub fn drawn(camera: [u32; 2], projector: [u32; 2], board: &TagBoard, seed: u64) -> Self {
        let draws = Draws::new(seed).stream(0x7669_6577);
        let aside = |i: u64| 2.0 * draws.unit(i) - 1.0;
        let mut optics = CameraOptics::pinhole(projector, 26.0 + 14.0 * draws.unit(0));
        optics.lens = [0.06 * aside(1), 0.03 * aside(2), 0.0, 0.0, 0.0];
        let shift = if draws.happens(3, 0.5) { 0.0 } else { 0.4 * draws.unit(4) };
        optics.centre[1] += shift * f64::from(projector[1]);
        let place = [0.3 * aside(5), 0.2 * aside(6), 1.9 + 0.2 * aside(7)];
        let beside = if draws.happens(8, 0.5) { 0.5 } else { -0.5 };
        let eye = add(place, [beside, 0.15 * aside(9), 0.1 * aside(10)]);
        let middle = [0.05 * aside(11), 0.05 * aside(12), -0.1];
        let looking = |from: [f64; 3]| Pose { position_m: from, rotation_xyzw: towards(sub(middle, from)) };
        Self {
            camera: CameraOptics {
                lens: [-0.08, 0.02, 0.0005, -0.0003, 0.0],
                ..CameraOptics::pinhole(camera, 50.0)
            },
            camera_pose: looking(eye),
            projector: optics,
            projector_pose: looking(place),
            things: drawn_things(board, draws.stream(1)),
            ambient: 25.0,
            light: 620.0,
            samples: 2,
            noise: [1.5, 0.01],
            seed,
        }
    }
}

fn drawn_things(board: &TagBoard, draws: Draws) -> Vec<LitThing> {
    let aside = |i: u64| 2.0 * draws.unit(i) - 1.0;
    let wall = Pose { position_m: [0.0, 0.0, -0.4], ..Pose::IDENTITY };
    let mut things = vec![LitThing::Sheet { pose: wall, half_m: [3.0, 3.0], albedo: 0.8 }];
    for k in 0..3u64 {
        let d = draws.stream(k);
        let middle_m = [0.8 * d.unit(0) - 0.4, 0.5 * d.unit(1) - 0.25, 0.1 * d.unit(2) - 0.15];
        things.push(LitThing::Ball { middle_m, radius_m: 0.07 + 0.06 * d.unit(3), albedo: 0.7 });
    }
    let turn = 0.25 + 0.25 * draws.unit(11);
    let turn = if draws.happens(10, 0.5) { turn } else { -turn };
    let rotation_xyzw = multiply(about([0.0, 1.0, 0.0], turn), about([1.0, 0.0, 0.0], 0.3 * aside(12)));
    let pose = Pose { position_m: [0.15 * aside(13), 0.1 * aside(14), 0.15], rotation_xyzw };
    let tag = |(id, [x, y]): (u16, [f64; 2])| {
        let place = Pose { position_m: [x, y, 0.0], ..Pose::IDENTITY };
        LitThing::Tag { pose, tag: PrintedTag { id, side_m: board.side_m, place } }
    };
    things.extend(board.tags().map(tag));
    things
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stage() -> LitStage {
        LitStage {
            camera: CameraOptics::pinhole([160, 120], 50.0),
            camera_pose: Pose { position_m: [0.4, 0.0, 1.8], ..Pose::IDENTITY },
            projector: CameraOptics::pinhole([64, 48], 35.0),
            projector_pose: Pose { position_m: [0.0, 0.1, 2.0], ..Pose::IDENTITY },
            things: drawn_things(&TagBoard::SMALL, Draws::new(3)),
            ambient: 20.0,
            light: 400.0,
            samples: 2,
            noise: [0.0, 0.0],
            seed: 1,
        }
    }

    /// Where a pixel of the projector lights, the camera sees light: the two ways round agree.
    #[test]
    fn the_light_of_a_pixel_falls_where_the_projector_says() {
        let view = stage().view();
        let (w, h) = (64u32, 48u32);
        let dark = view.picture(&vec![0.0; (w * h) as usize], 1);
        let mut seen = 0;
        for (x, y) in [(10, 10), (32, 24), (50, 40), (20, 35)] {
            let mut lit = vec![0.0; (w * h) as usize];
            lit[(y * w + x) as usize] = 1.0;
            let picture = view.picture(&lit, 1);
            let middle = view.stage().lit_place([f64::from(x) + 0.5, f64::from(y) + 0.5]).unwrap();
            let eye = view.stage().camera_pose.position_m;
            let [u, v] = view.stage().camera.pixel(sub(middle, eye)).unwrap();
            if !(2.0..158.0).contains(&u) || !(2.0..118.0).contains(&v) {
                continue;
            }
            let gained = |i: usize| f64::from(picture[i]) - f64::from(dark[i]);
            let (mut sum, mut at) = (0.0, [0.0; 2]);
            for i in 0..160 * 120 {
                sum += gained(i);
                at = [
                    at[0] + gained(i) * ((i % 160) as f64 + 0.5),
                    at[1] + gained(i) * ((i / 160) as f64 + 0.5),
                ];
            }
            if sum > 50.0 {
                seen += 1;
                let off = (at[0] / sum - u).hypot(at[1] / sum - v);
                assert!(off < 1.0, "pixel {x} {y}: {off}");
            }
        }
        assert!(seen >= 2, "{seen}");
    }

    #[test]
    fn what_stands_in_the_light_throws_a_shadow() {
        let mut stage = stage();
        stage.things.truncate(1);
        let open = stage.clone().view().picture(&[1.0; 64 * 48], 1);
        stage.things.push(LitThing::Ball { middle_m: [0.0, 0.05, 0.8], radius_m: 0.1, albedo: 0.0 });
        let shadowed = stage.view().picture(&[1.0; 64 * 48], 1);
        let darker = open.iter().zip(&shadowed).filter(|(a, b)| **a > **b + 20).count();
        // The ball itself and its shadow on the wall.
        assert!(darker > 100, "{darker}");
    }
}
