//! Errors that were put in come out, with their owner.

use super::*;
use dpm_device::planes::Raster;
use dpm_scene::geometry::lens::Lens;
use glam::DQuat;

fn camera() -> ProjectorCamera {
    let raster = Raster::new(1024, 768).unwrap();
    ProjectorCamera::look_at(raster, DVec3::new(0.3, 0.5, 1.5), DVec3::ZERO, DVec3::Y, 0.6)
        .unwrap()
        .with_lens(Lens::opencv(&[-0.1, 0.02, 0.0, 0.0]).unwrap())
        .unwrap()
}

/// Where a ray through a pixel meets the plane z = 0.
fn on_plane(camera: &ProjectorCamera, pixel: DVec2) -> DVec3 {
    let ray = camera.ray(pixel);
    ray.origin - ray.direction * (ray.origin.z / ray.direction.z)
}

/// Readings on the plane z = 0 with a true projector, and a body that is truly shifted by `shift`.
fn offsets(rig: &ProjectorCamera, truth: &ProjectorCamera, shift: DVec3, touches: bool) -> Vec<Offset> {
    (0..9)
        .map(|i| {
            let point = DVec3::new(0.1 * f64::from(i % 3 - 1), 0.1 * f64::from(i / 3 - 1), 0.0);
            let lit = rig.project(point).unwrap().floor() + 0.5;
            let reading = PointReading {
                point,
                normal: DVec3::Z,
                lit,
                in_light: on_plane(truth, lit),
                touched: touches.then_some(point + shift),
            };
            Offset::of(rig, &reading).unwrap()
        })
        .collect()
}

#[test]
fn a_perfect_rig_has_no_error_although_pixels_are_whole() {
    let c = camera();
    for o in offsets(&c, &c, DVec3::ZERO, true) {
        assert!(o.light.length() < 1e-6 && o.light_m < 1e-9, "{o:?}");
    }
}

#[test]
fn a_shifted_body_gives_the_shift_that_was_put_in() {
    let (c, shift) = (camera(), DVec3::new(1.5e-3, -2e-3, 0.0));
    let all = offsets(&c, &c, shift, true);
    for o in &all {
        assert!(o.projector.length() < 1e-6);
        assert!((o.body_m.unwrap() - shift).length() < 1e-12);
        // Along the surface the light is as far from the point as the body was shifted, up to the curvature of the view.
        assert!((o.light_m - shift.length()).abs() < 0.005 * shift.length(), "{}", o.light_m);
    }
    let checked = CheckSummary::of(&all).unwrap();
    let (fault, part) = checked.fault(1.0).unwrap();
    assert_eq!((fault, part.is_shift()), (Fault::Body, true));
    assert!(checked.fault(checked.light.largest_px).is_none());
    // Touching nothing leaves the body's fault unseen, and says so.
    let unseen = CheckSummary::of(&offsets(&c, &c, shift, false)).unwrap();
    assert!(unseen.body.is_none() && unseen.light.largest_px < 1e-6);
}

#[test]
fn a_shifted_projector_is_told_from_a_shifted_body() {
    let rig = camera();
    let mut truth = rig;
    truth.world_from_projector.translation += DVec3::new(4e-3, 0.0, 0.0);
    let all = offsets(&rig, &truth, DVec3::new(0.0, 5e-4, 0.0), true);
    let (fault, part) = CheckSummary::of(&all).unwrap().fault(2.0).unwrap();
    assert_eq!((fault, part.is_shift()), (Fault::Projector, true));
    for o in &all {
        // The light moves with the projector.
        let expected = DVec2::new(rig.jacobian(DVec3::ZERO).unwrap()[0].x * 4e-3, 0.0);
        assert!((o.projector - expected).length() < 0.1 * expected.length(), "{} {expected}", o.projector);
    }
}

#[test]
fn a_turned_body_scatters_about_no_shift() {
    let c = camera();
    let turn = DQuat::from_rotation_z(0.02);
    let all: Vec<Offset> = offsets(&c, &c, DVec3::ZERO, true)
        .into_iter()
        .enumerate()
        .map(|(i, _)| {
            let i = i as i32;
            let point = DVec3::new(0.1 * f64::from(i % 3 - 1), 0.1 * f64::from(i / 3 - 1), 0.0);
            let lit = c.project(point).unwrap();
            let reading =
                PointReading { point, normal: DVec3::Z, lit, in_light: point, touched: Some(turn * point) };
            Offset::of(&c, &reading).unwrap()
        })
        .collect();
    let (fault, part) = CheckSummary::of(&all).unwrap().fault(1.0).unwrap();
    assert_eq!((fault, part.is_shift()), (Fault::Body, false));
}

#[test]
fn a_summary_is_its_numbers() {
    let offsets = [DVec2::new(3.0, 4.0), DVec2::new(-1.0, 0.0), DVec2::ZERO];
    let s = Summary::of(&offsets).unwrap();
    assert_eq!((s.p50_px, s.largest_px, s.count), (1.0, 5.0, 3));
    assert!((s.rms() - (26.0f64 / 3.0).sqrt()).abs() < 1e-12);
    assert_eq!(Summary::of(&offsets[..2]).unwrap().p50_px, 3.0);
    assert!(Summary::of(&[]).is_none());
}

/// A box with its corners at +-0.1, as triangles seen counter-clockwise from outside.
fn cube() -> Vec<[DVec3; 3]> {
    let mut triangles = Vec::new();
    for axis in 0..3 {
        for side in [-1.0, 1.0] {
            let mut n = DVec3::ZERO;
            n[axis] = side;
            let (u, v) = n.any_orthonormal_pair();
            let (u, v) = if u.cross(v).dot(n) > 0.0 { (u, v) } else { (v, u) };
            let corner = |a: f64, b: f64| 0.1 * (n + u * a + v * b);
            let [a, b, c, d] = [corner(-1., -1.), corner(1., -1.), corner(1., 1.), corner(-1., 1.)];
            triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    triangles
}

fn points_of(triangles: &[[DVec3; 3]]) -> Vec<MeshPoint> {
    let normal = |t: &[DVec3; 3]| (t[1] - t[0]).cross(t[2] - t[0]).normalize();
    triangles.iter().flat_map(|t| t.map(|position| MeshPoint { position, normal: normal(t) })).collect()
}

#[test]
fn points_are_seen_and_far_apart() {
    let (c, place) = (camera(), DAffine3::from_rotation_y(0.2));
    let triangles = cube();
    let surface = TriangleTree::new(triangles.clone());
    let chosen = spread(&points_of(&triangles), &surface, &c, &place, 4);
    // The face towards the projector has four corners, and they are all that faces it.
    assert_eq!(chosen.len(), 4);
    for p in &chosen {
        assert!(p.normal.z > 0.9 && (p.position.z - 0.1).abs() < 1e-12, "{p:?}");
        for q in chosen.iter().filter(|q| *q != p) {
            assert!(p.position.distance(q.position) > 0.19);
        }
    }
    assert_eq!(spread(&points_of(&triangles), &surface, &c, &place, 50).len(), 4);
    // A wall before the box hides it; a body behind the projector has no point.
    let wall = [DVec3::new(-1., -1., 0.5), DVec3::new(1., -1., 0.5), DVec3::new(0., 2., 0.5)];
    let hidden = TriangleTree::new(triangles.iter().copied().chain([wall]));
    assert!(spread(&points_of(&triangles), &hidden, &c, &place, 4).is_empty());
    let behind = DAffine3::from_translation(DVec3::new(0.0, 0.0, 9.0));
    assert!(spread(&points_of(&triangles), &surface, &c, &behind, 4).is_empty());
}

#[test]
fn hiding_agrees_with_each_triangle_on_its_own() {
    let draws = dpm_device::rng::Draws::new(7);
    let at = |i: u64| DVec3::from_array(draws.normal3(i));
    let triangles: Vec<[DVec3; 3]> =
        (0..60).map(|i| [at(i), at(i) + 0.3 * at(i + 100), at(i) + 0.3 * at(i + 200)]).collect();
    let surface = TriangleTree::new(triangles.clone());
    let mut hidden = 0;
    for i in 0..400 {
        let (from, to) = (3.0 * at(1000 + i), at(2000 + i));
        // Oracle: the signed volumes of the way with each edge have one sign, and both ends lie on two sides.
        let volume = |a: DVec3, b: DVec3, c: DVec3, d: DVec3| (b - a).cross(c - a).dot(d - a);
        let expected = triangles.iter().any(|[a, b, c]| {
            let sides = [(a, b), (b, c), (c, a)].map(|(p, q)| volume(from, to, *p, *q) > 0.0);
            let apart = volume(*a, *b, *c, from) > 0.0;
            sides[0] == sides[1] && sides[1] == sides[2] && apart != (volume(*a, *b, *c, to) > 0.0)
        });
        assert_eq!(surface.hides(from, to, 0.0), expected, "{i}");
        hidden += u32::from(expected);
    }
    assert!((20..380).contains(&hidden), "{hidden}");
}
