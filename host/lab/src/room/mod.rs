//! The room of a rig, drawn: bodies in the light that fell on them, projector and observer, and the projector's cone in the air.

pub mod export;
pub(crate) mod furniture;
pub(crate) mod view;

use crate::paint::glyphs::ADVANCE;
use crate::paint::Canvas;
use dpm_device::planes::Raster;
use dpm_render::gpu::Gpu;
use dpm_render::RenderError;
use dpm_rig::pictures::{to_srgb, FallenLight};
use dpm_rig::rig::Rig;
use dpm_scene::geometry::projector::ProjectorCamera;
use furniture::{camera, Bounds, Room};
use glam::{DVec2, DVec3, Vec3};
use std::sync::Arc;
use view::{FilmCamera, SeenPoint};

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
/// Slots of the eye's window of which the light in the air is made.
const AIR_SLOTS: usize = 4;
const FAINT: [u8; 3] = [150, 150, 150];

/// How bright what is.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RoomLight {
    /// Light of the room, 1 where it is bright.
    pub room: f32,
    /// Share of the projector's light that is shown.
    pub projector: f32,
    /// From radiance in the projector's light to brightness.
    pub exposure: f32,
}

/// Draws the room of a rig.
pub(crate) struct RoomPicture {
    rig: Arc<Rig>,
    bounds: Bounds,
    furniture: Room,
    view: FilmCamera,
    /// What the projector's rays meet first.
    shadow: FilmCamera,
    /// Normals of the sides of the projector's cone, inward.
    cone: [DVec3; 4],
    eye: DVec3,
}

impl RoomPicture {
    /// For a run whose bodies stay within `bounds`.
    ///
    /// # Errors
    /// The renderer's.
    pub(crate) fn new(
        rig: &Arc<Rig>,
        gpu: &Arc<Gpu>,
        bounds: Bounds,
        raster: Raster,
    ) -> Result<Self, RenderError> {
        let (eye, _) = eye_and_gaze(rig, 0);
        let projector = rig.camera.at_raster(half(rig.camera.raster));
        let of_room = camera(rig, bounds, eye, raster).unwrap_or(rig.camera.at_raster(raster));
        Ok(Self {
            rig: rig.clone(),
            bounds,
            furniture: Room::new(rig, bounds.ball(), eye),
            view: FilmCamera::new(rig, gpu, of_room)?,
            shadow: FilmCamera::new(rig, gpu, projector)?,
            cone: sides_of_cone(&rig.camera),
            eye,
        })
    }

    /// Where the camera stands.
    pub(crate) fn camera(&self) -> &ProjectorCamera {
        &self.view.camera
    }

    /// Where the observer's eye was when the room was drawn last.
    pub(crate) fn eye(&self) -> DVec3 {
        self.eye
    }

    /// The box around the bodies.
    pub(crate) fn bounds(&self) -> Bounds {
        self.bounds
    }

    /// The room at the end of `window`, whose light an eye adds up: brightness, row by row.
    ///
    /// # Errors
    /// The renderer's.
    pub(crate) fn draw(
        &mut self,
        window: &[FallenLight],
        light: RoomLight,
    ) -> Result<Vec<Vec3>, RenderError> {
        let Some(last) = window.last() else {
            return Ok(vec![Vec3::ZERO; self.camera().raster.pixel_count()]);
        };
        let (eye, gaze) = eye_and_gaze(&self.rig, last.centre_ns);
        self.eye = eye;
        self.furniture.see_from(eye);
        let lens = self.rig.camera.position();
        let points = self.view.points(&last.poses, last.centre_ns, lens)?;
        let shadow = self.shadow.points(&last.poses, last.centre_ns, lens)?;
        let mut picture = shown(&self.rig, &points, &lit(&self.rig, &points, window), light);
        self.furnish(&mut picture, &points, &shadow, window, light, gaze);
        Ok(picture)
    }

    /// As [`RoomPicture::draw`], as a picture with names, and as bright as its own light suggests.
    ///
    /// # Errors
    /// The renderer's.
    pub(crate) fn draw_by_itself(
        &mut self,
        window: &[FallenLight],
        room: f32,
    ) -> Result<Canvas, RenderError> {
        let lens = self.rig.camera.position();
        let lit = match window.last() {
            Some(last) => lit(&self.rig, &self.view.points(&last.poses, last.centre_ns, lens)?, window),
            None => Vec::new(),
        };
        let light = RoomLight { room, projector: 1.0, exposure: exposure_of(&lit) };
        let rgb = to_srgb(&self.draw(window, light)?, 1.0);
        let raster = self.camera().raster;
        let mut canvas = Canvas { width: raster.width() as usize, height: raster.height() as usize, rgb };
        self.label(&mut canvas);
        Ok(canvas)
    }

    /// Names projector and observer on a picture whose upper left corner is the room's.
    pub(crate) fn label(&self, canvas: &mut Canvas) {
        let size = [self.camera().raster.width(), self.camera().raster.height()].map(f64::from);
        let mut label = |at: DVec3, below: f64, text: &str| {
            let Some(p) = self.camera().project(at) else { return };
            let columns = (text.len() * ADVANCE * 2) as f64;
            let x = (p.x - 0.5 * columns).clamp(2.0, (size[0] - columns).max(2.0));
            let y = (p.y + below * size[1] / 300.0).clamp(0.0, size[1] - 12.0);
            canvas.write([x as usize, y as usize], 2, text, FAINT);
        };
        label(self.rig.camera.position(), 26.0, "PROJECTOR");
        label(self.eye, -36.0, "OBSERVER");
    }

    /// Floor, projector and observer where no body is before them, and light in the air.
    fn furnish(
        &self,
        picture: &mut [Vec3],
        points: &[Option<SeenPoint>],
        shadow: &[Option<SeenPoint>],
        window: &[FallenLight],
        light: RoomLight,
        gaze: DVec3,
    ) {
        let camera = self.camera();
        let columns = camera.raster.width();
        let beams = self.beams(window);
        for (i, (pixel, point)) in picture.iter_mut().zip(points).enumerate() {
            let at = DVec2::new(f64::from(i as u32 % columns) + 0.5, f64::from(i as u32 / columns) + 0.5);
            let ray = camera.ray(at);
            let mut end = point.map_or(f64::INFINITY, |p| p.distance);
            if let Some(thing) =
                self.furniture.meet(ray.origin, ray.direction, gaze).filter(|t| t.distance < end)
            {
                end = thing.distance;
                // Furniture is dim, so that nobody takes it for what the film is about.
                *pixel = thing.albedo * (room_light(thing.normal) * (0.25 + 0.75 * light.room));
            }
            if light.projector > 0.0 {
                *pixel += self.air(ray.origin, ray.direction, end, shadow, &beams) * light.projector;
            }
        }
    }

    /// Mean light in the projector's rays through each pixel of the shadow's raster.
    fn beams(&self, window: &[FallenLight]) -> Vec<Vec3> {
        let slots: Vec<&FallenLight> =
            window.iter().step_by(window.len().div_ceil(AIR_SLOTS).max(1)).collect();
        let (whole, half) = (self.rig.camera.raster, self.shadow.camera.raster);
        let scale = DVec2::new(whole.width().into(), whole.height().into())
            / DVec2::new(half.width().into(), half.height().into());
        let beam = |i: usize| {
            let (x, y) = (i as u32 % half.width(), i as u32 / half.width());
            let pixel = (DVec2::new(x.into(), y.into()) + 0.5) * scale;
            slots.iter().map(|slot| slot.through(&self.rig, pixel)).sum::<Vec3>() / slots.len().max(1) as f32
        };
        (0..half.pixel_count()).map(beam).collect()
    }

    /// Light that the air scatters along a ray up to `end` metres.
    fn air(
        &self,
        origin: DVec3,
        direction: DVec3,
        end: f64,
        shadow: &[Option<SeenPoint>],
        beams: &[Vec3],
    ) -> Vec3 {
        let rig = &*self.rig;
        let bodies = self.bounds.ball();
        let (lens, reach) = (rig.camera.position(), (rig.camera.position() - bodies.centre).length());
        let behind = reach + 1.4 * bodies.radius;
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
        let projector = &self.shadow.camera;
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
            // Light thins out with the square of the distance, but for the place next to the lens.
            let thin = (reach / away.max(0.15 * reach)).powi(2).min(6.0) as f32;
            // The cone ends softly.
            let fade = ((behind - away) / (0.4 * bodies.radius)).clamp(0.0, 1.0) as f32;
            sum += (beams[pixel] * HAZE + Vec3::splat(CONE)) * thin * fade;
        }
        sum * (step / (2.0 * bodies.radius)) as f32
    }
}

/// Radiance of each point in the projector's light.
pub(crate) fn lit(rig: &Rig, points: &[Option<SeenPoint>], window: &[FallenLight]) -> Vec<Vec3> {
    let intensity = Vec3::from_array(rig.config.projector.intensity_at_255().map(|v| v as f32));
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
pub(crate) fn shown(rig: &Rig, points: &[Option<SeenPoint>], lit: &[Vec3], light: RoomLight) -> Vec<Vec3> {
    let shown = |(point, lit): (&Option<SeenPoint>, &Vec3)| {
        let Some(point) = point else { return Vec3::ZERO };
        let albedo = rig.albedo_at(point.body, point.uv);
        *lit * (light.exposure * light.projector) + albedo * (room_light(point.normal) * light.room)
    };
    points.iter().zip(lit).map(shown).collect()
}

/// Light of a bright ceiling on a surface, 0 to [`ROOM_LIGHT`].
fn room_light(normal: DVec3) -> f32 {
    ROOM_LIGHT * (0.55 + 0.45 * normal.y as f32)
}

/// The factor with which one lit pixel in a hundred is brighter than [`WHITE`].
pub(crate) fn exposure_of(lit: &[Vec3]) -> f32 {
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
fn half(of: Raster) -> Raster {
    raster([of.width().div_ceil(2), of.height().div_ceil(2)])
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

/// A raster of a picture; the sides are constants above 0, or those of another raster.
pub(crate) fn raster([width, height]: [u32; 2]) -> Raster {
    Raster::new(width, height).unwrap_or_else(|| unreachable!("the sides of a picture"))
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
    fn exposure_makes_the_brightest_white_and_ignores_a_few_sparks() {
        let mut lit = vec![Vec3::splat(2.0); 1000];
        lit[7] = Vec3::splat(1e9);
        assert!((exposure_of(&lit) * 2.0 - WHITE).abs() < 1e-6);
        assert_eq!(exposure_of(&[Vec3::ZERO; 4]), 1.0);
    }
}
