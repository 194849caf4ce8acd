//! Laws of both ways, against a drawn truth.

use super::*;
use crate::trajectory::TimedPose;
use dpm_common::so3::{so3_exp, so3_log};
use dpm_device::rng::Draws;
use glam::{DAffine3, DQuat, DVec3};

fn truth(seed: u64) -> DAffine3 {
    let d = Draws::new(seed);
    DAffine3::from_rotation_translation(
        so3_exp(DVec3::from_array(d.normal3(0))),
        DVec3::from_array(d.normal3(1)) * 0.05,
    )
}

fn touches(truth: &DAffine3, n: u64, sigma: f64, seed: u64) -> Vec<Touch> {
    let d = Draws::new(seed).stream(1);
    let corner = |i: u64| {
        DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2 & 1) as f64) * DVec3::new(0.2, 0.15, 0.1)
    };
    // The corners of a box, beginning with four that span it.
    [0, 1, 2, 4, 3, 5, 6, 7][..n as usize]
        .iter()
        .map(|i| (*i, corner(*i)))
        .map(|(i, mesh)| Touch {
            mesh,
            body: truth.transform_point3(mesh) + DVec3::from_array(d.normal3(i)) * sigma,
        })
        .collect()
}

fn solve(touches: &[Touch]) -> Result<TouchFit, TouchError> {
    let mut session = TouchSession::default();
    touches.iter().for_each(|t| session.add(*t));
    session.solve()
}

fn off(a: &DAffine3, b: &DAffine3, at: DVec3) -> f64 {
    a.transform_point3(at).distance(b.transform_point3(at))
}

#[test]
fn touched_points_place_the_mesh() {
    let middle = DVec3::new(0.1, 0.075, 0.05);
    let (mut ratio, runs) = (0.0, 60);
    for seed in 0..runs {
        let truth = truth(seed);
        assert!(
            off(&solve(&touches(&truth, 4, 0.0, seed)).unwrap().mesh_to_body, &truth, DVec3::ONE) < 1e-12
        );
        let got = solve(&touches(&truth, 8, 1e-4, seed)).unwrap();
        assert!(off(&got.mesh_to_body, &truth, middle) < 2e-4);
        let corner = DVec3::new(0.2, 0.15, 0.1);
        ratio += (off(&got.mesh_to_body, &truth, corner) / got.deviation_m(corner)).powi(2) / runs as f64;
    }
    // The stated deviation is neither far too small nor far too large.
    assert!((0.4..1.6).contains(&ratio), "{ratio}");
}

#[test]
fn bad_touches_are_refused_by_name() {
    let truth = truth(3);
    let good = touches(&truth, 8, 1e-4, 3);
    assert_eq!(solve(&good[..3]), Err(TouchError::TooFew(3)));
    let line: Vec<Touch> = (0..6)
        .map(|i| DVec3::new(0.03, 0.02, 0.01) * f64::from(i))
        .map(|mesh| Touch { mesh, body: truth.transform_point3(mesh) })
        .collect();
    assert_eq!(solve(&line), Err(TouchError::Collinear));
    let mut mirrored = good.clone();
    mirrored.iter_mut().for_each(|t| t.mesh.x = -t.mesh.x);
    assert!(matches!(solve(&mirrored), Err(TouchError::Mirrored { .. })), "{:?}", solve(&mirrored));
    let mut inches = good.clone();
    inches.iter_mut().for_each(|t| t.mesh /= 25.4);
    assert!(matches!(solve(&inches), Err(TouchError::WrongScale { scale }) if (scale - 25.4).abs() < 0.1));
    let mut wrong = good.clone();
    wrong[5].body += DVec3::new(0.012, 0.0, 0.01);
    assert!(matches!(solve(&wrong), Err(TouchError::WrongPoint { point: 5, .. })), "{:?}", solve(&wrong));
    let mut shuffled = good.clone();
    shuffled.rotate_left(0);
    let bodies: Vec<DVec3> = good.iter().map(|t| t.body).collect();
    shuffled.iter_mut().enumerate().for_each(|(i, t)| t.body = bodies[(3 * i + 1) % 8]);
    assert!(matches!(solve(&shuffled), Err(TouchError::DoesNotFit { .. } | TouchError::Mirrored { .. })));
    let mut bad = good;
    bad[2].body.z = f64::NAN;
    assert_eq!(solve(&bad), Err(TouchError::NotFinite(2)));
}

#[test]
fn a_tip_is_averaged_over_a_moving_body_and_one_that_slides_is_refused() {
    let tip = DVec3::new(0.0, 0.1, 0.05);
    let on_body = DVec3::new(0.03, -0.02, 0.07);
    let d = Draws::new(4);
    let poses = |slide: f64| -> Vec<(TimedPose, TimedPose)> {
        (0..120)
            .map(|i| {
                let s = i as f64 / 240.0;
                let body = TimedPose {
                    stamp_ns: i,
                    position: DVec3::new(0.1 * s, s.sin(), 0.0),
                    rotation: so3_exp(DVec3::Y * s),
                };
                let rotation = so3_exp(DVec3::new(s, 0.3, -s));
                let position = body.place(on_body + DVec3::X * slide * s) - rotation * tip
                    + DVec3::from_array(d.normal3(i as u64)) * 1e-4;
                (TimedPose { stamp_ns: i, position, rotation }, body)
            })
            .collect()
    };
    let got = tip_in_body(tip, &poses(0.0)).unwrap();
    assert!(
        (got.body - on_body).length() < 5e-5 && got.sigma_m < 2e-5 && got.sigma_m > 5e-6,
        "{}",
        got.sigma_m
    );
    assert!(matches!(tip_in_body(tip, &poses(0.01)), Err(TouchError::NotHeld { .. })));
    assert!(matches!(tip_in_body(tip, &poses(0.0)[..5]), Err(TouchError::NotHeld { poses: 5, .. })));
}

#[test]
fn the_next_point_is_far_from_all_that_were_touched() {
    let corners: Vec<DVec3> = touches(&DAffine3::IDENTITY, 8, 0.0, 0).iter().map(|t| t.mesh).collect();
    let mut session = TouchSession::new(corners.clone());
    for _ in 0..4 {
        let mesh = session.next_point().unwrap();
        session.add(Touch { mesh, body: mesh });
    }
    session.solve().unwrap();
    assert_eq!(TouchSession::default().next_point(), None);
}

/// Triangles of a grid over two parameters from 0 to 1.
fn grid(n: u32, f: impl Fn(f64, f64) -> DVec3) -> Vec<[DVec3; 3]> {
    let at = |i: u32, j: u32| f(f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
    (0..n * n)
        .flat_map(|k| {
            let (i, j) = (k / n, k % n);
            let (a, b, c, d) = (at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1));
            [[a, b, c], [a, c, d]]
        })
        .collect()
}

fn bumpy(u: f64, v: f64) -> DVec3 {
    let (lat, long) = (std::f64::consts::PI * u, std::f64::consts::TAU * v);
    let r = 0.1 * (1.0 + 0.2 * (3.0 * long).sin() * lat.sin() + 0.15 * (2.0 * lat).cos());
    DVec3::new(lat.sin() * long.cos(), lat.cos(), lat.sin() * long.sin()) * r * DVec3::new(1.0, 1.3, 0.8)
}

fn wandered(triangles: &[[DVec3; 3]], noise: f64, seed: u64) -> (Vec<DVec3>, DAffine3) {
    let (d, truth) = (Draws::new(seed).stream(8), truth(seed));
    let points = (0..3000u64).map(|i| {
        let t = triangles[(d.unit(10 * i) * triangles.len() as f64) as usize];
        let (a, b) = (d.unit(10 * i + 1), d.unit(10 * i + 2));
        let (a, b) = if a + b > 1.0 { (1.0 - a, 1.0 - b) } else { (a, b) };
        let mut p =
            t[0] + (t[1] - t[0]) * a + (t[2] - t[0]) * b + DVec3::from_array(d.normal3(10_000 + i)) * noise;
        if i % 20 == 0 {
            // The tip leaves the surface now and then.
            p += p.normalize_or(DVec3::X) * 0.02;
        }
        truth.transform_point3(p)
    });
    (points.collect(), truth)
}

#[test]
fn a_wandering_tip_places_a_surface_within_fifty_micrometres() {
    for seed in 0..4 {
        let triangles = grid(40, bumpy);
        let (points, truth) = wandered(&triangles, 1.5e-4, seed);
        let roughly = truth
            * DAffine3::from_rotation_translation(so3_exp(DVec3::new(0.03, -0.02, 0.03)), DVec3::splat(2e-3));
        let got = wander(&TriangleTree::new(triangles), &points, 0.0, &roughly).unwrap();
        for at in [DVec3::ZERO, DVec3::X * 0.1, DVec3::Y * 0.1] {
            assert!(
                off(&got.mesh_to_body, &truth, at) < 5e-5,
                "{seed}: {:e}",
                off(&got.mesh_to_body, &truth, at)
            );
        }
        let turn = so3_log(DQuat::from_mat3(&(got.mesh_to_body.matrix3 * truth.matrix3.transpose())));
        assert!(turn.length() < 5e-4 && got.residual_m < 3e-4);
    }
}

#[test]
fn surfaces_that_slide_along_themselves_are_refused_by_name() {
    let tau = std::f64::consts::TAU;
    let sphere = grid(40, |u, v| {
        let (lat, long) = (0.5 * tau * u, tau * v);
        DVec3::new(lat.sin() * long.cos(), lat.cos(), lat.sin() * long.sin()) * 0.1
    });
    let plane = grid(10, |u, v| DVec3::new(0.3 * u, 0.0, 0.2 * v));
    let cylinder = grid(40, |u, v| DVec3::new(0.08 * (tau * u).cos(), 0.2 * v, 0.08 * (tau * u).sin()));
    for (triangles, name) in [(sphere, "a sphere"), (plane, "a plane"), (cylinder, "a cylinder")] {
        let (points, truth) = wandered(&triangles, 1e-4, 1);
        let got = wander(&TriangleTree::new(triangles), &points, 0.0, &truth);
        assert!(
            matches!(got, Err(WanderError::Undetermined { shape, .. }) if shape == name),
            "{name}: {got:?}"
        );
    }
}

#[test]
fn nonsense_is_refused_by_name() {
    let triangles = grid(40, bumpy);
    let (points, truth) = wandered(&triangles, 1e-4, 1);
    let surface = TriangleTree::new(triangles);
    assert_eq!(wander(&surface, &points[..10], 0.0, &truth), Err(WanderError::TooFew(10)));
    assert_eq!(wander(&TriangleTree::new([]), &points, 0.0, &truth), Err(WanderError::NoSurface));
    assert_eq!(
        wander(&TriangleTree::new([[DVec3::NAN; 3]]), &points, 0.0, &truth),
        Err(WanderError::NoSurface)
    );
    let far = truth * DAffine3::from_translation(DVec3::splat(0.3));
    let other: Vec<DVec3> = points.iter().map(|p| *p * 1.5).collect();
    let got = wander(&surface, &other, 0.0, &far);
    assert!(matches!(got, Err(WanderError::DoesNotFit { .. } | WanderError::Undetermined { .. })), "{got:?}");
    let mut bad = points;
    bad[3].x = f64::NAN;
    assert_eq!(wander(&surface, &bad, 0.0, &truth), Err(WanderError::NotFinite(3)));
}

/// Oracle: all triangles, cut into many small pieces.
#[test]
fn the_tree_finds_the_nearest_point() {
    let triangles = grid(12, bumpy);
    let surface = TriangleTree::new(triangles.clone());
    let d = Draws::new(2);
    for i in 0..50 {
        let p = DVec3::from_array(d.normal3(i)) * 0.1;
        let got = surface.nearest(p).unwrap();
        let dense = triangles.iter().flat_map(|t| {
            (0..=20u32).flat_map(move |a| {
                (0..=20 - a).map(move |b| {
                    t[0] + (t[1] - t[0]) * (f64::from(a) / 20.0) + (t[2] - t[0]) * (f64::from(b) / 20.0)
                })
            })
        });
        let oracle = dense.map(|q| q.distance(p)).fold(f64::INFINITY, f64::min);
        assert!(got.distance <= oracle + 1e-12 && oracle - got.distance < 3e-3, "{} {oracle}", got.distance);
    }
}
