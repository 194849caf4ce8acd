//! One picture of the film: the room, the observer's view, and what is on the mirrors.

use super::raster;
use super::room::{camera, observer_camera, Ball, Bounds, Room};
use super::stages::Stage;
use super::view::{SeenPoint, View};
use super::SLOWED;
use crate::snapshot::glyphs::{for_each_dot, ADVANCE};
use crate::snapshot::paint::Canvas;
use dpm_device::planes::Channel;
use dpm_render::gpu::Gpu;
use dpm_render::RenderError;
use dpm_rig::pictures::{to_srgb, FallenLight};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::live::SeenLight;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DVec2, DVec3, Vec3};
use std::sync::Arc;

/// Columns and rows of the room, of the observer's view, and of the mirrors.
const ROOM: [u32; 2] = [400, 300];
const OBSERVER: [u32; 2] = [240, 168];
const MIRRORS: [u32; 2] = [168, 126];
/// Between two parts, pixels.
const GAP: usize = 2;
/// Instants of the film at which the bodies' reach is measured.
const INSTANTS: i64 = 24;
/// Steps through the air in which light is looked for along a ray.
const STEPS: usize = 96;
/// How bright light in the air is beside light on a surface.
const HAZE: f32 = 0.55;
/// How bright the cone is where no mirror is on.
const CONE: f32 = 0.016;
/// Brightness of the lit surface that one lit pixel in a hundred exceeds.
const WHITE: f32 = 0.85;
/// Reflectance under the room's light that is as bright as that.
const ROOM_LIGHT: f32 = 0.5;
/// Samples of the eye's window of which the light in the air is made.
const AIR_SLOTS: usize = 4;

const INK: [u8; 3] = [236, 236, 236];
const FAINT: [u8; 3] = [150, 150, 150];
const FRAME: [u8; 3] = [56, 58, 64];
const MARKED: [u8; 3] = [250, 190, 60];

/// Draws the pictures of a film.
pub(super) struct Studio {
    rig: Arc<Rig>,
    bounds: Bounds,
    bodies: Ball,
    room: Room,
    views: [View; 3],
    /// Normals of the sides of the projector's cone, inward.
    cone: [DVec3; 4],
    /// From radiance to brightness; known when light has been seen.
    exposure: Option<f32>,
    planes: SlowPlanes,
}

/// The views, in the order of [`Studio::views`].
const OF_ROOM: usize = 0;
const OF_OBSERVER: usize = 1;
const OF_PROJECTOR: usize = 2;

/// The planes of one frame, one after the other, a picture each.
#[derive(Default)]
struct SlowPlanes {
    planes: Vec<u8>,
    next: usize,
}

impl Studio {
    /// Sets up the cameras of `rig`.
    ///
    /// # Errors
    /// The renderer's.
    pub(super) fn new(rig: &Arc<Rig>, gpu: &Arc<Gpu>) -> Result<Self, RenderError> {
        let slots = rig.config.run.frames as i64;
        let step_ns = rig.rate().slot_len_ns(0) * slots / INSTANTS;
        let nothing = Ball { centre: rig.camera.position() - DVec3::Z, radius: 0.1 };
        let bounds = Bounds::around(rig, (0..INSTANTS).map(|i| i * step_ns));
        let bounds = bounds.unwrap_or_else(|| Bounds::of_ball(nothing));
        let bodies = bounds.ball();
        let (eye, _) = eye_and_gaze(rig, 0);
        let projector =
            rig.camera.at_raster(raster(half(rig.camera.raster.width(), rig.camera.raster.height())));
        let room_camera = camera(rig, bounds, eye, raster(ROOM)).unwrap_or(projector);
        let of_observer = observer_camera(bounds, eye, raster(OBSERVER)).unwrap_or(projector);
        let views = [
            View::new(rig, gpu, room_camera)?,
            View::new(rig, gpu, of_observer)?,
            View::new(rig, gpu, projector)?,
        ];
        let room = Room::new(rig, bodies, eye);
        let cone = sides_of_cone(&rig.camera);
        Ok(Self {
            rig: rig.clone(),
            bounds,
            bodies,
            room,
            views,
            cone,
            exposure: None,
            planes: SlowPlanes::default(),
        })
    }

    /// The picture at `share` of the film, of the light of `window`, the last of whose slots is that of `seen`.
    ///
    /// # Errors
    /// The renderer's.
    pub(super) fn picture(
        &mut self,
        share: f64,
        window: &[FallenLight],
        seen: &SeenLight,
    ) -> Result<Canvas, RenderError> {
        let stage = Stage::at(share);
        let Some(last) = window.last() else { return Ok(Canvas::new(1, 1)) };
        let (eye, gaze) = eye_and_gaze(&self.rig, last.centre_ns);
        self.room.see_from(eye);
        if let Some(camera) = observer_camera(self.bounds, eye, raster(OBSERVER)) {
            self.views[OF_OBSERVER].camera = camera;
        }
        let place = self.rig.camera.position();
        let look = |view: &mut View| view.points(&last.poses, last.centre_ns, place);
        let [room, observer, projector] = &mut self.views;
        let (room, observer, shadow) = (look(room)?, look(observer)?, look(projector)?);
        let lit = self.lit(&observer, window);
        let exposure = *self.exposure.get_or_insert_with(|| exposure_of(&lit));
        let shown = |points: &[Option<SeenPoint>], lit: &[Vec3]| self.shown(points, lit, stage, exposure);
        let observer_picture = shown(&observer, &lit);
        let mut room_picture = shown(&room, &self.lit(&room, window));
        self.furnish(&mut room_picture, &room, &shadow, window, stage, gaze);
        let mut canvas = blank();
        let right = ROOM[0] as usize + GAP;
        put(&mut canvas, [0, 0], ROOM, &to_srgb(&room_picture, 1.0));
        put(&mut canvas, [right, 0], OBSERVER, &to_srgb(&observer_picture, 1.0));
        self.label_room(&mut canvas, stage, eye);
        write(&mut canvas, [right + 6, 6], 2, "WHAT THE OBSERVER SEES", INK);
        self.mirrors(&mut canvas, window, seen, stage);
        Ok(canvas)
    }

    /// Radiance of each point in the projector's light.
    fn lit(&self, points: &[Option<SeenPoint>], window: &[FallenLight]) -> Vec<Vec3> {
        let rig = &*self.rig;
        let intensity = Vec3::from_array(rig.config.projector.max_intensity.0.map(|v| v as f32));
        let lit = |point: &Option<SeenPoint>| {
            let Some(point) = point.as_ref().filter(|p| !p.is_hidden) else { return Vec3::ZERO };
            let sum: Vec3 = window.iter().map(|slot| slot.on(rig, point.body, point.in_mesh)).sum();
            let to_projector = rig.camera.position() - point.position;
            let d2 = to_projector.length_squared();
            // Radiance of a Lambertian surface.
            let cos = point.normal.dot(to_projector).abs() / d2.sqrt();
            let albedo = rig.albedo_at(point.body, point.uv);
            sum / window.len() as f32 * albedo * intensity * (cos / (std::f64::consts::PI * d2)) as f32
        };
        points.iter().map(lit).collect()
    }

    /// Brightness of each pixel: the projector's light and the room's.
    fn shown(&self, points: &[Option<SeenPoint>], lit: &[Vec3], stage: Stage, exposure: f32) -> Vec<Vec3> {
        let shown = |(point, lit): (&Option<SeenPoint>, &Vec3)| {
            let Some(point) = point else { return Vec3::ZERO };
            let albedo = self.rig.albedo_at(point.body, point.uv);
            *lit * (exposure * stage.projector) + albedo * (room_light(point.normal) * stage.room)
        };
        points.iter().zip(lit).map(shown).collect()
    }

    /// Floor, projector and observer where no body is before them, and light in the air.
    fn furnish(
        &self,
        picture: &mut [Vec3],
        points: &[Option<SeenPoint>],
        shadow: &[Option<SeenPoint>],
        window: &[FallenLight],
        stage: Stage,
        gaze: DVec3,
    ) {
        let camera = &self.views[OF_ROOM].camera;
        let air: Vec<&FallenLight> = window.iter().step_by(window.len().div_ceil(AIR_SLOTS).max(1)).collect();
        for (i, (pixel, point)) in picture.iter_mut().zip(points).enumerate() {
            let at = DVec2::new(f64::from(i as u32 % ROOM[0]) + 0.5, f64::from(i as u32 / ROOM[0]) + 0.5);
            let ray = camera.ray(at);
            let mut end = point.map_or(f64::INFINITY, |p| p.distance);
            if let Some(thing) = self.room.meet(ray.origin, ray.direction, gaze).filter(|t| t.distance < end)
            {
                end = thing.distance;
                // Furniture is dim, so that nobody takes it for what the film is about.
                *pixel = thing.albedo * (room_light(thing.normal) * (0.25 + 0.75 * stage.room));
            }
            if stage.projector > 0.0 {
                *pixel += self.air(ray.origin, ray.direction, end, shadow, &air) * stage.projector;
            }
        }
    }

    /// Light that the air scatters along a ray up to `end` metres.
    fn air(
        &self,
        origin: DVec3,
        direction: DVec3,
        end: f64,
        shadow: &[Option<SeenPoint>],
        window: &[&FallenLight],
    ) -> Vec3 {
        let rig = &*self.rig;
        let (lens, reach) = (rig.camera.position(), (rig.camera.position() - self.bodies.centre).length());
        let behind = reach + 1.4 * self.bodies.radius;
        let (mut from, mut to) = (0.0f64, end);
        for side in &self.cone {
            // Inside of the side is where the normal points.
            let (height, slope) = ((origin - lens).dot(*side), direction.dot(*side));
            match slope {
                s if s > 0.0 => from = from.max(-height / s),
                s if s < 0.0 => to = to.min(-height / s),
                _ if height < 0.0 => return Vec3::ZERO,
                _ => {}
            }
        }
        // And no farther from the lens than to a little behind the bodies.
        let (half, apart) = ((lens - origin).dot(direction), (lens - origin).length_squared());
        let under = half * half - apart + behind * behind;
        (from, to) = (from.max(half - under.max(0.0).sqrt()), to.min(half + under.max(0.0).sqrt()));
        if to <= from || under <= 0.0 {
            return Vec3::ZERO;
        }
        let step = (to - from) / STEPS as f64;
        let projector = &self.views[OF_PROJECTOR].camera;
        let [columns, rows] = [projector.raster.width(), projector.raster.height()];
        let mut sum = Vec3::ZERO;
        for k in 0..STEPS {
            let at = origin + direction * (from + (k as f64 + 0.5) * step);
            let away = (at - lens).length();
            let Some(p) = projector.project(at) else { continue };
            if p.x < 0.0 || p.y < 0.0 || p.x >= f64::from(columns) || p.y >= f64::from(rows) {
                continue;
            }
            let pixel = p.y as usize * columns as usize + p.x as usize;
            if shadow[pixel].is_some_and(|met| met.distance < away) {
                continue;
            }
            let light: Vec3 = window.iter().map(|slot| slot.at(rig, at)).sum::<Vec3>() / window.len() as f32;
            // Light thins out with the square of the distance, but for the place next to the lens.
            let thin = (reach / away.max(0.15 * reach)).powi(2).min(6.0) as f32;
            // The cone ends softly.
            let fade = ((behind - away) / (0.4 * self.bodies.radius)).clamp(0.0, 1.0) as f32;
            sum += (light * HAZE + Vec3::splat(CONE)) * thin * fade;
        }
        sum * (step / (2.0 * self.bodies.radius)) as f32
    }

    fn label_room(&self, canvas: &mut Canvas, stage: Stage, eye: DVec3) {
        let camera = &self.views[OF_ROOM].camera;
        let mut label = |at: DVec3, below: f64, text: &str| {
            let Some(p) = camera.project(at) else { return };
            let columns = text.len() * ADVANCE * 2;
            let x = (p.x - 0.5 * columns as f64).clamp(2.0, f64::from(ROOM[0]) - columns as f64);
            let y = (p.y + below).clamp(0.0, f64::from(ROOM[1]) - 12.0);
            write(canvas, [x as usize, y as usize], 2, text, FAINT);
        };
        label(self.rig.camera.position(), 26.0, "PROJECTOR");
        label(eye, -36.0, "OBSERVER");
        write(canvas, [8, 10], 3, stage.caption, INK);
        let slower = format!("{SLOWED} TIMES SLOWER");
        write(canvas, [8, ROOM[1] as usize - 18], 2, &slower, FAINT);
    }

    /// What is on the mirrors: the sum of the planes, or one plane after the other.
    fn mirrors(&mut self, canvas: &mut Canvas, window: &[FallenLight], seen: &SeenLight, stage: Stage) {
        let rig = self.rig.clone();
        let raster = rig.camera.raster;
        let plane_bytes = raster.plane_bytes();
        let planes = rig.schedule.planes();
        if !stage.shows_planes || self.planes.next >= planes.len() {
            self.planes.next = 0;
        }
        if self.planes.next == 0 {
            self.planes.planes.clone_from(&seen.planes);
        }
        let k = self.planes.next;
        let (width, height) = (raster.width() as usize, raster.height() as usize);
        let last = window.last();
        let is_on = |x: usize, y: usize| {
            let byte = self.planes.planes.get(k * plane_bytes + y * width.div_ceil(8) + x / 8);
            byte.is_some_and(|byte| byte >> (7 - x % 8) & 1 == 1)
        };
        let colour = match planes[k].channel {
            Channel::Red => Vec3::new(1.0, 0.15, 0.1),
            Channel::Green => Vec3::new(0.2, 1.0, 0.2),
            Channel::Blue => Vec3::new(0.2, 0.4, 1.0),
            Channel::White => Vec3::ONE,
        };
        let shown = |x: usize, y: usize| {
            if stage.shows_planes {
                colour * f32::from(u8::from(is_on(x, y)))
            } else {
                let code = last.map_or([0; 3], |slot| slot.light.codes[y * width + x]);
                Vec3::from_array(code.map(f32::from)) / 255.0 * stage.projector
            }
        };
        // Every pixel of the inset is the mean of the mirrors that lie in it.
        let [columns, rows] = fitted(MIRRORS, width, height);
        let mut small = Vec::new();
        for j in 0..rows {
            for i in 0..columns {
                let (x, y) = (span(i, columns, width), span(j, rows, height));
                let count = (x.len() * y.len()) as f32;
                small.push(
                    y.flat_map(|y| x.clone().map(move |x| (x, y))).map(|(x, y)| shown(x, y)).sum::<Vec3>()
                        / count,
                );
            }
        }
        let x0 = ROOM[0] as usize + GAP + (OBSERVER[0] as usize - columns) / 2;
        let y0 = OBSERVER[1] as usize + GAP + (ROOM[1] as usize - OBSERVER[1] as usize - GAP - rows) / 2;
        put(canvas, [x0, y0], [columns as u32, rows as u32], &to_srgb(&small, 1.0));
        border(canvas, [x0, y0], [columns, rows], if stage.shows_planes { MARKED } else { FRAME });
        let label = if stage.shows_planes {
            self.planes.next += 1;
            format!("PLANE {} OF {}", k + 1, planes.len())
        } else {
            "ON THE MIRRORS".to_owned()
        };
        write(canvas, [x0 + 6, y0 + 6], 2, &label, if stage.shows_planes { MARKED } else { INK });
    }
}

/// Normals of the sides of a projector's cone, inward: each through two corners of the raster and the lens.
fn sides_of_cone(projector: &ProjectorCamera) -> [DVec3; 4] {
    let (width, height) = (f64::from(projector.raster.width()), f64::from(projector.raster.height()));
    let corner = |x: f64, y: f64| projector.ray(DVec2::new(x, y)).direction;
    let corners = [corner(0.0, 0.0), corner(width, 0.0), corner(width, height), corner(0.0, height)];
    let axis = corner(0.5 * width, 0.5 * height);
    std::array::from_fn(|i| {
        let normal = corners[i].cross(corners[(i + 1) % 4]).normalize_or_zero();
        if normal.dot(axis) < 0.0 {
            -normal
        } else {
            normal
        }
    })
}

/// Light of a bright ceiling on a surface, 0 to [`ROOM_LIGHT`].
fn room_light(normal: DVec3) -> f32 {
    ROOM_LIGHT * (0.55 + 0.45 * normal.y as f32)
}

/// The factor with which one lit pixel in a hundred is brighter than [`WHITE`].
fn exposure_of(lit: &[Vec3]) -> f32 {
    let mut peaks: Vec<f32> = lit.iter().map(|v| v.max_element()).filter(|v| *v > 0.0).collect();
    peaks.sort_unstable_by(f32::total_cmp);
    let high = peaks.len().saturating_sub(1) * 99 / 100;
    peaks.get(high).map_or(1.0, |peak| WHITE / peak)
}

/// The observer's eye and gaze at `t_ns`.
fn eye_and_gaze(rig: &Rig, t_ns: i64) -> (DVec3, DVec3) {
    rig.observer.eye_and_gaze(&rig.true_poses(t_ns).unwrap_or_default())
}

/// A raster of half the size, for shadows.
fn half(width: u32, height: u32) -> [u32; 2] {
    [width.div_ceil(2), height.div_ceil(2)]
}

/// Columns and rows of a raster of `width` x `height` within `most`, each at least 1.
fn fitted(most: [u32; 2], width: usize, height: usize) -> [usize; 2] {
    let [columns, rows] = most.map(|side| side as usize);
    let share = (columns as f64 / width as f64).min(rows as f64 / height as f64);
    [width, height].map(|side| ((side as f64 * share) as usize).max(1))
}

/// The mirrors, of `mirrors`, that lie in pixel `i` of `pixels`.
fn span(i: usize, pixels: usize, mirrors: usize) -> std::ops::Range<usize> {
    let begin = i * mirrors / pixels;
    begin..((i + 1) * mirrors / pixels).max(begin + 1)
}

fn blank() -> Canvas {
    let (width, height) = (ROOM[0] as usize + GAP + OBSERVER[0] as usize, ROOM[1] as usize);
    Canvas { width, height, rgb: [14, 15, 18].repeat(width * height) }
}

fn put(canvas: &mut Canvas, [x, y]: [usize; 2], [columns, rows]: [u32; 2], rgb: &[u8]) {
    let (columns, rows) = (columns as usize, rows as usize);
    for j in 0..rows {
        let at = ((y + j) * canvas.width + x) * 3;
        canvas.rgb[at..at + columns * 3].copy_from_slice(&rgb[j * columns * 3..(j + 1) * columns * 3]);
    }
}

fn border(canvas: &mut Canvas, [x, y]: [usize; 2], [columns, rows]: [usize; 2], colour: [u8; 3]) {
    let (x, y) = (x - 1, y - 1);
    canvas.block(x, y, columns + 2, 1, colour);
    canvas.block(x, y + rows + 1, columns + 2, 1, colour);
    canvas.block(x, y, 1, rows + 2, colour);
    canvas.block(x + columns + 1, y, 1, rows + 2, colour);
}

/// Writes text of `dot` pixels a dot, on a dark edge.
fn write(canvas: &mut Canvas, [x, y]: [usize; 2], dot: usize, text: &str, colour: [u8; 3]) {
    for_each_dot(text, |i, j| {
        canvas.block(
            (x + i * dot).saturating_sub(1),
            (y + j * dot).saturating_sub(1),
            dot + 2,
            dot + 2,
            [0; 3],
        )
    });
    for_each_dot(text, |i, j| canvas.block(x + i * dot, y + j * dot, dot, dot, colour));
}

/// The pictures at `shares` of the film, two beside each other.
pub(super) fn strip(pictures: &[Canvas], shares: &[f64; 4]) -> Canvas {
    let (width, height) = (pictures[0].width, pictures[0].height);
    let mut strip = Canvas::new(2 * width + GAP, 2 * height + GAP);
    strip.block(0, 0, 2 * width + GAP, 2 * height + GAP, FRAME);
    for (i, share) in shares.iter().enumerate() {
        let picture = &pictures[((share * pictures.len() as f64) as usize).min(pictures.len() - 1)];
        strip.paste(i % 2 * (width + GAP), i / 2 * (height + GAP), 1, picture);
    }
    strip
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cone_holds_what_the_raster_shows_and_nothing_beside_it() {
        let raster = raster([64, 48]);
        let (lens, target) = (DVec3::new(0.3, 1.0, 2.0), DVec3::new(0.0, 0.2, 0.0));
        let projector = ProjectorCamera::look_at(raster, lens, target, DVec3::Y, 0.6).unwrap();
        let cone = sides_of_cone(&projector);
        for (x, y, is_inside) in
            [(1.0, 1.0, true), (63.0, 24.0, true), (-1.0, 24.0, false), (32.0, 49.0, false)]
        {
            let at = projector.ray(DVec2::new(x, y)).direction * 3.0;
            assert_eq!(cone.iter().all(|side| at.dot(*side) >= 0.0), is_inside, "{x} {y}");
        }
    }

    #[test]
    fn every_mirror_lies_in_one_pixel_of_the_inset_or_more() {
        for (pixels, mirrors) in [(4, 4), (3, 10), (168, 1024), (10, 3)] {
            let covered: std::collections::BTreeSet<usize> =
                (0..pixels).flat_map(|i| span(i, pixels, mirrors)).collect();
            assert_eq!(covered, (0..mirrors).collect(), "{pixels} {mirrors}");
        }
    }

    #[test]
    fn the_inset_keeps_the_rasters_shape() {
        assert_eq!(fitted(MIRRORS, 1024, 768), [168, 126]);
        assert_eq!(fitted(MIRRORS, 1920, 1080), [168, 94]);
        assert_eq!(fitted(MIRRORS, 1, 10_000), [1, 126]);
    }

    #[test]
    fn exposure_makes_the_brightest_white_and_ignores_a_few_sparks() {
        let mut lit = vec![Vec3::splat(2.0); 1000];
        lit[7] = Vec3::splat(1e9);
        assert!((exposure_of(&lit) * 2.0 - WHITE).abs() < 1e-6);
        assert_eq!(exposure_of(&[Vec3::ZERO; 4]), 1.0);
    }
}
