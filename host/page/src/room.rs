//! The room of a run, in three dimensions: the shapes, which stay, and where everything is, which changes.

use crate::pictures::mesh::CoarseMesh;
use crate::shared::RunView;
use dpm_rig::rig::{affine, Rig};
use glam::{DAffine3, DVec2, DVec3};
use serde_json::{json, Value};

/// Cells along the longest side of a body's mesh where there are few bodies, and at least.
const CELLS: f32 = 20.0;
const LEAST_CELLS: f32 = 4.0;
/// So many bodies have all cells; more bodies share them, so that the answer does not grow.
const FEW: f32 = 4.0;

/// The shapes: each body's mesh with few triangles in its own space, metres, and the edges of the projector's cone as
/// directions in the projector's space.
pub(crate) fn shapes(rig: &Rig) -> Value {
    let count = rig.scene.bodies.len() as f32;
    let cells = (CELLS * (FEW / count.max(FEW)).sqrt()).max(LEAST_CELLS);
    let bodies: Vec<Value> = rig
        .scene
        .bodies
        .iter()
        .map(|body| {
            let mesh = CoarseMesh::of(&body.mesh, cells);
            json!({
                "name": body.name,
                "tracked": body.tracked.and_then(|i| rig.bodies.get(usize::from(i))).map(|b| b.name.as_str()),
                "projected": body.projected,
                "positions": mesh.positions.iter().flat_map(|p| rounded(p.as_dvec3())).collect::<Vec<_>>(),
                "triangles": mesh.triangles.iter().flatten().collect::<Vec<_>>(),
            })
        })
        .collect();
    let camera = &rig.camera;
    let (width, height) = (f64::from(camera.raster.width()), f64::from(camera.raster.height()));
    let to_projector = camera.world_from_projector.matrix3.transpose();
    let corner = |x: f64, y: f64| rounded(to_projector * camera.ray(DVec2::new(x, y)).direction);
    let cone = [corner(0.0, 0.0), corner(width, 0.0), corner(width, height), corner(0.0, height)];
    json!({ "bodies": bodies, "cone": cone })
}

/// Where everything is now: world-from-mesh of every body and world-from-projector as four columns each, and the
/// observer's eye and gaze point, metres. `None` before the run begins.
pub(crate) fn places(shared: &RunView) -> Option<Value> {
    let live = shared.monitor.live();
    let rig = live.rig()?;
    // Before the first frame the bodies stand where the rig file puts them.
    let drawn = live.drawn(None).filter(|drawn| drawn.poses.len() == rig.tracked_count());
    let (tracked, seen) = drawn.map(|drawn| (drawn.poses, drawn.gaze)).unzip();
    let tracked = tracked.unwrap_or_else(|| rig.bodies.iter().map(|body| affine(&body.rest)).collect());
    let t_ns = live.snapshot().map_or(0, |figures| figures.frame.due_at.0);
    let mut poses = Vec::new();
    rig.scene_poses(&tracked, t_ns, &mut poses);
    let (eye, gaze) = rig.observer.eye_and_gaze(&tracked);
    let projector = shared.monitor.parameters().projector().unwrap_or(rig.camera.world_from_projector);
    Some(json!({
        "bodies": poses.iter().map(columns).collect::<Vec<_>>(),
        "projector": columns(&projector),
        "eye": rounded(eye),
        "gaze": rounded(seen.unwrap_or(gaze)),
    }))
}

fn columns(pose: &DAffine3) -> Vec<f64> {
    let m = pose.matrix3;
    [m.x_axis, m.y_axis, m.z_axis, pose.translation].into_iter().flat_map(rounded).collect()
}

/// To tenths of a millimetre: more would only make the answer longer.
fn rounded(v: DVec3) -> [f64; 3] {
    v.to_array().map(|x| (x * 1e4).round() / 1e4)
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::Raster;
    use dpm_rig::config::{Overrides, RigConfig};
    use glam::Vec3;

    #[test]
    fn shapes_have_every_body_within_its_own_bounds_and_the_cone_of_the_raster() {
        let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
        let rig = Rig::build(&config, Raster::new(64, 48)).unwrap();
        let told = shapes(&rig);
        let bodies = told["bodies"].as_array().unwrap();
        assert_eq!(bodies.len(), rig.scene.bodies.len());
        for (body, of) in bodies.iter().zip(&rig.scene.bodies) {
            let numbers = |key: &str| -> Vec<f64> {
                body[key].as_array().unwrap().iter().map(|n| n.as_f64().unwrap()).collect()
            };
            let points: Vec<Vec3> = numbers("positions")
                .chunks_exact(3)
                .map(|p| Vec3::new(p[0] as f32, p[1] as f32, p[2] as f32))
                .collect();
            assert!(!points.is_empty() && numbers("triangles").iter().all(|i| (*i as usize) < points.len()));
            let bounds = |points: &[Vec3]| {
                points.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(l, u), p| (l.min(*p), u.max(*p)))
            };
            let ((low, high), (least, most)) = (bounds(&points), bounds(&of.mesh.positions));
            assert!(
                (low - least).min_element() > -1e-3 && (most - high).min_element() > -1e-3,
                "{}",
                of.name
            );
            // A merged vertex lies within its cell, so the shape keeps nearly all of its size.
            assert!((high - low).max_element() > 0.85 * (most - least).max_element(), "{}", of.name);
        }
        let cone = told["cone"].as_array().unwrap();
        let sides: Vec<f64> = cone.iter().map(|c| c[0].as_f64().unwrap()).collect();
        assert!(sides[0] < 0.0 && sides[1] > 0.0 && sides[2] > 0.0 && sides[3] < 0.0, "{sides:?}");
        assert!(cone.iter().all(|c| c[2].as_f64().unwrap() < 0.0), "the projector looks along -z");
    }
}
