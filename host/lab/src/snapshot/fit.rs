//! Bodies of any size and place into a view that shows all of them: where the projector and the eye stand, and how bright both are.

use crate::sequence::{draw, BodyPlaces};
use dpm_device::planes::Raster;
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::{RenderError, Renderer, RendererSettings, Scale};
use dpm_rig::config::{CalibrationConfig, ObserverConfig, PerChannel};
use dpm_rig::config::{ProjectorConfig, RigConfig};
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_scene::{Body, Scene};
use glam::{DAffine3, DVec3};
use serde::Serialize;
use std::sync::Arc;

/// Where a snapshot is seen from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum SnapshotView {
    /// `fit` for a scene from a file where no key of the rig file places the projector, else `rig`.
    #[default]
    Auto,
    /// From the rig's projector.
    Rig,
    /// From a corner of the room: projector, observer and bodies in the light that falls on them.
    Room,
    /// From a place in front of the bodies that shows all of them, whatever the rig file says of projector and eye.
    Fit,
}

/// A view that shows all bodies on which light is projected, as keys of a rig file. Metres, in the world.
#[derive(Clone, Debug, Serialize)]
pub struct FittedView {
    /// The smallest box around the bodies: its lower and its upper corner.
    pub bounds: [[f64; 3]; 2],
    /// `projector.position`.
    pub position: [f64; 3],
    /// `projector.look_at`.
    pub look_at: [f64; 3],
    /// `projector.max_intensity` that shows radiance 1 on every surface whose normal is within 60 degrees of the light.
    pub max_intensity: [f64; 3],
    /// `render.exposure` with which one lit pixel in a hundred gets more light than the projector has.
    pub exposure: f64,
}

/// Share of the picture's width or height that the bodies fill.
const FILL: f64 = 0.9;

/// The camera is at least this share of the bodies' size before the nearest point.
const CLEARANCE: f64 = 0.1;

/// Views that are tried, the best liked first: degrees around the upward axis, from +Z to +X. glTF's models face +Z.
const AROUND: [f64; 8] = [20.0, -25.0, 65.0, -70.0, 110.0, -115.0, 155.0, 200.0];

/// Each of them at each of these heights above the horizon, degrees; the best liked first.
const ABOVE: [f64; 6] = [15.0, 45.0, 75.0, -20.0, -50.0, -80.0];

/// A view is good enough where it shows this share of the area that the best one shows.
const SHOWS_ENOUGH: f64 = 0.7;

/// Triangles that are asked for the area that a view shows; of larger scenes every n-th.
const ASKED_TRIANGLES: usize = 1_000_000;

/// True where `rig` says where its projector is, so that a view which fits the bodies would be another one.
fn places_projector(rig: &RigConfig) -> bool {
    let (said, default) = (&rig.projector, ProjectorConfig::default());
    let place = |p: &ProjectorConfig| (p.position, p.look_at, p.up, p.horizontal_fov_deg);
    place(said) != place(&default) || said.calibration.is_some() || rig.calibration.file.is_some()
}

impl SnapshotView {
    /// Whether the view of a snapshot of `rig` is fitted to the bodies.
    pub(crate) fn is_fitted(self, rig: &RigConfig) -> bool {
        match self {
            Self::Auto => rig.scene.file.is_some() && !places_projector(rig),
            Self::Rig | Self::Room => false,
            Self::Fit => true,
        }
    }
}

impl FittedView {
    /// The view of `scene`, whose bodies have the poses `poses`, on `raster`; `None` where no body has a surface that light is
    /// projected on.
    pub(crate) fn new(rig: &RigConfig, scene: &Scene, poses: &[DAffine3], raster: Raster) -> Option<Self> {
        let [lower, upper] = bounds(scene, poses)?;
        let centre = (lower + upper) * 0.5;
        let back = direction(scene, poses);
        let right = DVec3::Y.cross(back).normalize();
        let up = back.cross(right);
        // Half of the picture at distance 1, as far as the bodies may fill it.
        let half_width = FILL * (0.5 * rig.projector.horizontal_fov_deg.to_radians()).tan();
        let half_height = half_width * f64::from(raster.height()) / f64::from(raster.width());
        let (mut across, mut along) = (Reach::new(right, half_width), Reach::new(up, half_height));
        let mut nearest = f64::NEG_INFINITY;
        for point in points(scene, poses) {
            let from_centre = point - centre;
            let toward = from_centre.dot(back);
            nearest = nearest.max(toward);
            across.add(from_centre, toward);
            along.add(from_centre, toward);
        }
        // The camera stays out of the bodies, also where they are a needle that points at it.
        let outside = nearest + CLEARANCE * (upper - lower).length();
        let distance = across.distance().max(along.distance()).max(outside);
        let look_at = centre + right * across.middle() + up * along.middle();
        let position = look_at + back * distance;
        let farthest = points(scene, poses).map(|p| p.distance_squared(position)).fold(0.0, f64::max);
        let albedo = rig.scene.surface_albedo.0.into_iter().fold(1.0, f64::min);
        let needed = std::f64::consts::PI * farthest / albedo / 60.0f64.to_radians().cos();
        let of_file = rig.projector.max_intensity.0;
        let is_said = rig.projector.max_intensity != ProjectorConfig::default().max_intensity;
        Some(Self {
            bounds: [lower.to_array(), upper.to_array()],
            position: position.to_array(),
            look_at: look_at.to_array(),
            max_intensity: if is_said { of_file } else { [needed; 3] },
            exposure: rig.render.exposure,
        })
    }

    /// The rig of `config` with this view.
    pub(crate) fn applied_to(&self, config: &RigConfig, asked: SnapshotView) -> RigConfig {
        let mut config = config.clone();
        let default = ProjectorConfig::default();
        let projector = &mut config.projector;
        (projector.position, projector.look_at, projector.up) = (self.position, self.look_at, default.up);
        projector.max_intensity = PerChannel(self.max_intensity);
        // A measured projector stands where it was measured.
        (projector.calibration, projector.calibration_unit) = (None, None);
        (projector.calibration_camera, projector.calibration_region) = (None, None);
        projector.calibration_device = None;
        config.calibration = CalibrationConfig::default();
        if asked == SnapshotView::Fit || config.observer == ObserverConfig::default() {
            config.observer = ObserverConfig {
                position: self.position,
                gaze: dpm_rig::gaze::at_point(self.look_at),
                ..ObserverConfig::default()
            };
        }
        config.render.exposure = self.exposure;
        config
    }
}

/// Samples of each pixel of the frame that the exposure is measured on.
const EXPOSURE_SPP: u32 = 4;

/// Share of the lit pixels that may be brighter than white.
const CLIPPED: f64 = 0.01;

/// `render.exposure` that suits a frame of `rig` with bodies at `poses`: 1 over the radiance that all but a few of the lit pixels
/// stay below, within the key's range; 1 where everything is dark.
///
/// # Errors
/// The renderer's.
pub(crate) fn exposure(rig: &Rig, gpu: &Arc<Gpu>, poses: &BodyPlaces) -> Result<f64, RenderError> {
    let settings = RendererSettings {
        method: Method::full(EXPOSURE_SPP),
        scale: Scale::WHOLE,
        halftone: None,
        plane_groups: Vec::new(),
        ..renderer_settings(rig)
    };
    let mut renderer = Renderer::new(gpu, &rig.scene, settings)?;
    let mut slot = renderer.create_slot(true)?;
    draw(rig, &mut renderer, &mut slot, poses, 0, EXPOSURE_SPP as f32)?;
    let (surfaces, radiance) = (slot.surfaces().unwrap_or_default(), slot.radiance().unwrap_or(&[]));
    let lit = surfaces.iter().zip(radiance).filter(|(surface, _)| surface.is_lit());
    let mut greatest: Vec<f32> = lit.map(|(_, [r, g, b, _])| r.max(*g).max(*b)).collect();
    greatest.sort_unstable_by(f32::total_cmp);
    let brightest = greatest.len().saturating_sub(1) as f64;
    let white = greatest.get((brightest * (1.0 - CLIPPED)) as usize).copied().unwrap_or(0.0);
    Ok(if white > 0.0 && white.is_finite() { (1.0 / f64::from(white)).clamp(1e-6, 1e6) } else { 1.0 })
}

/// How far points reach out along an axis of the picture, either way.
struct Reach {
    axis: DVec3,
    /// How far out the picture shows a point at distance 1.
    half_side: f64,
    /// The greatest sum of how far out a point is and how far out the picture shows it less than at the centre.
    out: [f64; 2],
}

impl Reach {
    fn new(axis: DVec3, half_side: f64) -> Self {
        Self { axis, half_side, out: [f64::NEG_INFINITY; 2] }
    }

    /// Takes in a point, `toward` metres nearer to the camera than the centre.
    fn add(&mut self, from_centre: DVec3, toward: f64) {
        let out = from_centre.dot(self.axis);
        let narrower = self.half_side * toward;
        self.out = [self.out[0].max(out + narrower), self.out[1].max(narrower - out)];
    }

    /// The smallest distance from the centre at which a camera shows all points, metres.
    fn distance(&self) -> f64 {
        (self.out[0] + self.out[1]) / (2.0 * self.half_side)
    }

    /// Where the camera is then, along the axis, metres from the centre.
    fn middle(&self) -> f64 {
        (self.out[0] - self.out[1]) * 0.5
    }
}

/// Bodies that light is projected on, with their poses.
fn projected<'a>(
    scene: &'a Scene,
    poses: &'a [DAffine3],
) -> impl Iterator<Item = (&'a Body, &'a DAffine3)> + 'a {
    scene.bodies.iter().zip(poses).filter(|(body, _)| body.projected)
}

fn points<'a>(scene: &'a Scene, poses: &'a [DAffine3]) -> impl Iterator<Item = DVec3> + 'a {
    projected(scene, poses)
        .flat_map(|(body, pose)| body.mesh.positions.iter().map(|p| pose.transform_point3(p.as_dvec3())))
}

fn bounds(scene: &Scene, poses: &[DAffine3]) -> Option<[DVec3; 2]> {
    points(scene, poses).fold(None, |box_, p| {
        let [lower, upper] = box_.unwrap_or([p, p]);
        Some([lower.min(p), upper.max(p)])
    })
}

/// From the bodies to the camera, of unit length and never upright: the best liked view that shows about as much of the surfaces
/// as the best does. A sheet is so never seen from its edge, or from behind where it has only a front.
fn direction(scene: &Scene, poses: &[DAffine3]) -> DVec3 {
    let direction = |around: f64, above: f64| {
        DVec3::new(around.sin() * above.cos(), above.sin(), around.cos() * above.cos())
    };
    let directions: [DVec3; ABOVE.len() * AROUND.len()] = std::array::from_fn(|i| {
        direction(AROUND[i % AROUND.len()].to_radians(), ABOVE[i / AROUND.len()].to_radians())
    });
    let triangles: usize = projected(scene, poses).map(|(body, _)| body.mesh.triangles.len()).sum();
    let step = triangles.div_ceil(ASKED_TRIANGLES).max(1);
    let mut shown = [0.0f64; ABOVE.len() * AROUND.len()];
    for (body, pose) in projected(scene, poses) {
        let mesh = &body.mesh;
        for (corners, material) in mesh.triangles.iter().zip(&mesh.materials).step_by(step) {
            let [a, b, c] = corners.map(|i| mesh.positions[i as usize].as_dvec3());
            let area = pose.transform_vector3((b - a).cross(c - a));
            let has_back = scene.materials.get(*material as usize).is_some_and(|m| m.double_sided);
            for (shown, direction) in shown.iter_mut().zip(&directions) {
                let faces = area.dot(*direction);
                *shown += if has_back { faces.abs() } else { faces.max(0.0) };
            }
        }
    }
    let best = shown.iter().copied().fold(0.0, f64::max);
    let liked = shown.iter().position(|area| *area >= SHOWS_ENOUGH * best).unwrap_or(0);
    directions[liked]
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::config::Overrides;
    use dpm_scene::geometry::projector::ProjectorCamera;
    use dpm_scene::shapes::{add, diffuse, quad, sphere};
    use dpm_scene::{Material, TriangleMesh};
    use glam::{DQuat, DVec2, Vec3};
    use proptest::prelude::*;

    fn scene(parts: impl IntoIterator<Item = (TriangleMesh, Material)>) -> Scene {
        let mut scene = Scene::default();
        for (mesh, material) in parts {
            add(&mut scene, mesh, material);
        }
        scene
    }

    fn config(settings: &[&str]) -> RigConfig {
        let flags = settings.iter().map(|s| (*s).to_owned()).collect();
        RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap()
    }

    /// The camera of the view, the share of the picture's sides that the points of the scene fill from the middle on, and
    /// whether the camera is as near to them as it may be.
    fn filled(scene: &Scene, poses: &[DAffine3], raster: Raster) -> (ProjectorCamera, [DVec2; 2], bool) {
        let rig = config(&[]);
        let view = FittedView::new(&rig, scene, poses, raster).unwrap();
        let p = view.applied_to(&rig, SnapshotView::Fit).projector;
        let [position, look_at, up] = [p.position, p.look_at, p.up].map(DVec3::from_array);
        let fov = p.horizontal_fov_deg.to_radians();
        let camera = ProjectorCamera::look_at(raster, position, look_at, up, fov).unwrap();
        let sides = DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
        let at = |p| camera.project(p).expect("before the camera") / sides * 2.0 - 1.0;
        let ends = points(scene, poses)
            .map(at)
            .fold([DVec2::INFINITY, DVec2::NEG_INFINITY], |[l, u], p| [l.min(p), u.max(p)]);
        let forward = (look_at - position).normalize();
        let nearest = points(scene, poses).map(|p| (p - position).dot(forward)).fold(f64::INFINITY, f64::min);
        let size = bounds(scene, poses).map_or(0.0, |[lower, upper]| (upper - lower).length());
        (camera, ends, nearest <= CLEARANCE * size * (1.0 + 1e-6))
    }

    /// The law of a fitted view: all of the bodies is inside the picture, and fills more than half of one of its sides unless
    /// the camera is as near as it may be: a needle that points at it fills less.
    fn holds(scene: &Scene, poses: &[DAffine3], raster: Raster) -> Result<ProjectorCamera, String> {
        let (camera, [lower, upper], is_near) = filled(scene, poses, raster);
        let inside = lower.min_element() > -0.95 && upper.max_element() < 0.95;
        let fills = (upper - lower).max_element() > 1.0;
        if inside && (fills || is_near) {
            Ok(camera)
        } else {
            Err(format!("from {lower} to {upper} of a picture from -1 to 1, with {camera:?}"))
        }
    }

    proptest! {
        /// Bodies from 10 micrometres to 1000 km, anywhere, upright or not, on rasters of any shape.
        #[test]
        fn any_bodies_fill_the_picture(
            size in -5.0..6.0f64, offset in prop::array::uniform3(-1e6..1e6f64), near in any::<bool>(),
            thickness in prop::array::uniform3(0.0..1.0f32), turn in prop::array::uniform3(-3.2..3.2f64),
            second in prop::array::uniform3(-4.0..4.0f32), raster in (1u32..2000, 1u32..2000),
        ) {
            let ball = |centre| {
                let mut mesh = sphere(Vec3::ZERO, 1.0, 1, true);
                mesh.positions.iter_mut().for_each(|p| *p = *p * Vec3::from(thickness) + centre);
                (mesh, diffuse(Vec3::ONE))
            };
            let scene = scene([ball(Vec3::ZERO), ball(Vec3::from(second))]);
            let turn = DQuat::from_euler(glam::EulerRot::XYZ, turn[0], turn[1], turn[2]);
            let size = 10f64.powf(size);
            let at = DVec3::from(offset) * if near { size / 1e6 } else { 1.0 };
            let pose = DAffine3::from_scale_rotation_translation(DVec3::splat(size), turn, at);
            // Rounding of positions that are far out is not ours.
            prop_assume!(size > 1e-9 * at.length());
            let raster = Raster::new(raster.0, raster.1).unwrap();
            let poses = vec![pose; scene.bodies.len()];
            prop_assert!(holds(&scene, &poses, raster).is_ok(), "{:?}", holds(&scene, &poses, raster));
        }

        /// A sheet is seen from its front, and not from its edge.
        #[test]
        fn sheets_face_the_camera(
            turn in prop::array::uniform3(-3.2..3.2f64), double_sided in any::<bool>(), size in 0.01..10.0f32,
        ) {
            let sheet = quad(Vec3::ZERO, Vec3::X * size, Vec3::Y * size);
            let scene = scene([(sheet, Material { double_sided, ..diffuse(Vec3::ONE) })]);
            let pose = DAffine3::from_quat(DQuat::from_euler(glam::EulerRot::XYZ, turn[0], turn[1], turn[2]));
            let poses = vec![pose; scene.bodies.len()];
            let camera = holds(&scene, &poses, Raster::new(320, 240).unwrap()).unwrap();
            let toward = (camera.position() - pose.transform_point3(DVec3::splat(f64::from(size) * 0.5))).normalize();
            let cosine = pose.transform_vector3(DVec3::Z).dot(toward);
            let seen = if double_sided { cosine.abs() } else { cosine };
            prop_assert!(seen > 0.4, "{seen}");
        }
    }

    #[test]
    fn what_the_rig_file_says_of_the_projector_is_kept() {
        let asked = |settings: &[&str]| {
            // The file must exist; what it holds does not matter here.
            let scene = concat!("scene.file=", env!("CARGO_MANIFEST_DIR"), "/Cargo.toml");
            SnapshotView::Auto.is_fitted(&config(&[&[scene], settings].concat()))
        };
        assert!(asked(&[]) && asked(&["projector.width=640"]));
        for key in ["position=[0, 1, 2]", "look_at=[0, 1, 2]", "up=[0, 0, 1]", "horizontal_fov_deg=20"] {
            assert!(!asked(&[&format!("projector.{key}")]), "{key}");
        }
        let built_in = config(&[]);
        assert!(!SnapshotView::Auto.is_fitted(&built_in), "the demo has the view that was made for it");
        assert!(SnapshotView::Fit.is_fitted(&built_in));

        let view = FittedView {
            bounds: [[0.0; 3]; 2],
            position: [1.0, 2.0, 3.0],
            look_at: [0.0; 3],
            max_intensity: [5.0; 3],
            exposure: 2.0,
        };
        let watched = config(&["observer.position=[7, 7, 7]"]);
        assert_eq!(view.applied_to(&watched, SnapshotView::Auto).observer.position, [7.0; 3]);
        assert_eq!(view.applied_to(&watched, SnapshotView::Fit).observer.position, view.position);
        assert_eq!(view.applied_to(&built_in, SnapshotView::Auto).observer.position, view.position);
    }

    #[test]
    fn lamps_are_neither_shown_nor_in_the_way() {
        let mut scene = scene([
            (sphere(Vec3::ZERO, 0.1, 1, true), diffuse(Vec3::ONE)),
            (sphere(Vec3::Y * 50.0, 1.0, 1, true), diffuse(Vec3::ONE)),
        ]);
        scene.bodies[1].projected = false;
        let poses = [DAffine3::IDENTITY; 2];
        let raster = Raster::new(64, 48).unwrap();
        let view = FittedView::new(&config(&[]), &scene, &poses, raster).unwrap();
        assert!(view.bounds[1][1] < 0.11, "{view:?}");
        scene.bodies[0].projected = false;
        assert!(FittedView::new(&config(&[]), &scene, &poses, raster).is_none());
    }
}
