//! Laws of the solver, against a drawn truth.

use super::*;
use crate::model::ProjectorModel;
use dpm_common::so3::so3_exp;
use dpm_device::rng::Draws;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::DMat3;

fn raster() -> Raster {
    Raster::new(1024, 768).unwrap()
}

fn volume() -> Volume {
    Volume { low: DVec3::new(-0.28, -0.2, -0.17), high: DVec3::new(0.28, 0.2, 0.17) }
}

/// A projector at 1.1 to 1.4 m, upright, with a lens.
fn truth(seed: u64) -> ProjectorModel {
    let d = Draws::new(seed).stream(77);
    let u = |i: u64, low: f64, high: f64| low + (high - low) * d.unit(i);
    let from = DVec3::new(u(0, -0.4, 0.4), u(1, 0.0, 0.6), u(2, 1.1, 1.4));
    let camera = ProjectorCamera::look_at(raster(), from, DVec3::ZERO, DVec3::Y, u(3, 0.6, 0.7)).unwrap();
    let lens = [u(4, -0.15, 0.1), u(5, -0.1, 0.1), u(6, -1e-3, 1e-3), u(7, -1e-3, 1e-3), u(8, -0.02, 0.02)];
    let mut model = ProjectorModel::from_camera(&camera, lens, DVec3::ZERO);
    model.centre += DVec2::new(u(9, -10.0, 10.0), u(10, -20.0, 60.0));
    model
}

/// Points of the raster at changing depth, aimed at with an error.
fn aimed(model: &ProjectorModel, n: u64, aim_px: f64, seed: u64) -> Vec<Sight> {
    let d = Draws::new(seed).stream(5);
    let camera = ProjectorModel { lens: [0.0; crate::model::LENS], ..*model }.pinhole(raster()).unwrap();
    (0..n)
        .map(|i| {
            // Eight directions around the picture and its middle, at three depths in turn.
            let share = if i < 8 {
                DVec2::from_array(FIRST[i as usize])
            } else {
                DVec2::new(d.unit(3 * i), d.unit(3 * i + 1))
            };
            let ray = camera.ray(share * DVec2::new(1024.0, 768.0));
            let depth = [-0.17, 0.17, 0.0][i as usize % 3] + model.local(DVec3::ZERO).z;
            let axis = -camera.world_from_projector.matrix3.z_axis;
            let world = ray.origin + ray.direction * (depth / ray.direction.dot(axis));
            let e = DVec2::new(d.normal(1000 + 2 * i), d.normal(1001 + 2 * i)) * aim_px;
            Sight::at_rest(world, model.project(world).unwrap() + e)
        })
        .filter(|s| s.pixel.cmpge(DVec2::ZERO).all() && s.pixel.cmple(DVec2::new(1024.0, 768.0)).all())
        .collect()
}

/// 99th percentile of the error over convex combinations of the points.
fn p99_in_hull(got: &ProjectorModel, truth: &ProjectorModel, sights: &[Sight]) -> f64 {
    let d = Draws::new(3);
    let errors = (0..2000u64).map(|i| {
        let weights: Vec<f64> = (0..sights.len() as u64)
            .map(|k| -(1.0 - d.unit(i * 64 + k)).ln())
            .map(|w: f64| w.powi(3))
            .collect();
        let sum: f64 = weights.iter().sum();
        let point = sights.iter().zip(&weights).map(|(s, w)| s.world * *w).sum::<DVec3>() / sum;
        (got.project(point).unwrap() - truth.project(point).unwrap()).length()
    });
    uncertainty::percentile(errors.collect(), 0.99)
}

fn solved(sights: &[Sight]) -> Result<ProjectorFit, PointsRefusal> {
    solve(raster(), sights, &Options::by_hand(raster()), &volume())
}

#[test]
fn exact_points_give_the_exact_projector() {
    for seed in 0..5 {
        let truth = truth(seed);
        let sights = aimed(&truth, 60, 0.0, seed);
        let options =
            Options { priors: Priors::many_points(raster()), aim_px: 1e-3, ..Options::by_hand(raster()) };
        let got = solve(raster(), &sights, &options, &volume()).unwrap();
        assert!(p99_in_hull(&got.model, &truth, &sights) < 1e-3, "{seed}");
    }
}

#[test]
fn twelve_points_by_hand_give_light_within_a_pixel() {
    let (mut errors, mut covered) = (Vec::new(), 0);
    for seed in 0..20 {
        let truth = truth(seed);
        let sights = aimed(&truth, 12, 0.3, seed);
        let got = solved(&sights).unwrap();
        let error = p99_in_hull(&got.model, &truth, &sights);
        let in_hull: Vec<DVec3> = sights.iter().map(|s| s.world).collect();
        covered += u32::from(predict(&got.model, &got.covariance, &in_hull).p99_px > error);
        errors.push(error);
    }
    let median = uncertainty::percentile(errors.clone(), 0.5);
    assert!(median < 1.0, "{errors:?}");
    assert!(covered >= 19, "{covered}");
}

#[test]
fn wrong_points_are_named_and_left_out() {
    let truth = truth(4);
    let mut sights = aimed(&truth, 30, 0.3, 4);
    sights[11].pixel += DVec2::new(25.0, -3.0);
    sights[17].pixel += DVec2::new(-2.0, 160.0);
    let got = solved(&sights).unwrap();
    let out: Vec<usize> = (0..sights.len()).filter(|i| !got.inliers[*i]).collect();
    assert_eq!(out, [11, 17]);
    assert!(got.notes.iter().any(|n| n.contains("point 11, 17")), "{:?}", got.notes);
    assert!(p99_in_hull(&got.model, &truth, &sights) < 1.0);
}

#[test]
fn five_points_find_a_bumped_projector_again() {
    for seed in 0..10 {
        let before = truth(seed);
        let mut after = before;
        after.rotation *= DMat3::from_quat(so3_exp(DVec3::new(0.02, -0.03, 0.01)));
        after.translation += DVec3::new(0.02, -0.01, 0.015);
        let sights = aimed(&after, 5, 0.3, seed);
        let options = Options::by_hand(raster());
        let got = relocate(raster(), &before, &sights, &options, &volume()).unwrap();
        let error = p99_in_hull(&got.model, &after, &sights);
        assert!(error < 1.2, "{seed}: {error}");
        assert_eq!(got.model.lens, before.lens);
        let four = relocate(raster(), &before, &sights[..4], &options, &volume());
        assert_eq!(four.unwrap_err(), PointsRefusal::TooFew { have: 4, need: 5 });
    }
}

#[test]
fn planar_points_and_points_at_one_depth_are_refused_by_name() {
    let truth = truth(6);
    let d = Draws::new(9);
    let place = |f: &dyn Fn(u64) -> DVec3| -> Vec<Sight> {
        (0..30).map(|i| Sight::at_rest(f(i), truth.project(f(i)).unwrap())).collect()
    };
    let planar = place(&|i| {
        DVec3::new(0.4 * d.unit(3 * i) - 0.2, 0.3 * d.unit(3 * i + 1) - 0.15, 2e-3 * d.unit(3 * i + 2))
    });
    assert!(matches!(solved(&planar), Err(PointsRefusal::Planar { off_plane_mm }) if off_plane_mm < 1.0));
    let back = truth.world_from_projector();
    // In the projector's own space: 40 mm of depth at more than a metre.
    let local = |i: u64| {
        DVec3::new(0.5 * d.unit(3 * i) - 0.25, 0.4 * d.unit(3 * i + 1) - 0.2, -1.2 - 0.04 * d.unit(3 * i + 2))
    };
    let flat = place(&|i| back.transform_point3(local(i)));
    let flat: Vec<Sight> = flat
        .into_iter()
        .filter(|s| s.pixel.min_element() > 0.0 && s.pixel.x < 1024.0 && s.pixel.y < 768.0)
        .collect();
    let got = solved(&flat);
    assert!(
        matches!(got, Err(PointsRefusal::OneDepth { share }) if share < 5.0)
            || matches!(got, Err(PointsRefusal::Planar { .. })),
        "{got:?}"
    );
    let same = vec![planar[0]; 12];
    assert!(matches!(solved(&same), Err(PointsRefusal::Planar { .. })));
}

#[test]
fn one_depth_that_is_no_plane_is_refused_by_name() {
    let truth = truth(7);
    let d = Draws::new(19);
    let back = truth.world_from_projector();
    // 7 % of the distance: too thick for a plane.
    let local = |i: u64| {
        DVec3::new(
            0.4 * d.unit(3 * i) - 0.2,
            0.3 * d.unit(3 * i + 1) - 0.15,
            -1.2 - 0.084 * d.unit(3 * i + 2),
        )
    };
    let sights: Vec<Sight> = (0..30)
        .map(|i| back.transform_point3(local(i)))
        .map(|p| Sight::at_rest(p, truth.project(p).unwrap()))
        .collect();
    let got = solved(&sights);
    assert!(matches!(got, Err(PointsRefusal::OneDepth { .. })), "{got:?}");
}

#[test]
fn a_mirror_image_is_refused_by_name() {
    let sights = aimed(&truth(8), 20, 0.1, 8);
    for axis in 0..3 {
        let mut mirrored = sights.clone();
        mirrored.iter_mut().for_each(|s| s.world[axis] = -s.world[axis]);
        assert_eq!(solved(&mirrored).unwrap_err(), PointsRefusal::Mirrored, "axis {axis}");
    }
    let mut picture = sights;
    picture.iter_mut().for_each(|s| s.pixel.x = 1024.0 - s.pixel.x);
    assert_eq!(solved(&picture).unwrap_err(), PointsRefusal::Mirrored);
}

#[test]
fn a_wrong_unit_is_refused_by_name() {
    let truth = truth(9);
    let sights = aimed(&truth, 24, 0.2, 9);
    let known = PlaceHint { distance_m: Some(1.1 * truth.local(DVec3::ZERO).z), up: None };
    let options = Options { known, ..Options::by_hand(raster()) };
    solve(raster(), &sights, &options, &volume()).unwrap();
    for factor in [1000.0, 25.4, 0.01, 0.001, 100.0, 39.37] {
        let mut scaled = sights.clone();
        scaled.iter_mut().for_each(|s| s.world *= factor);
        let of = Volume { low: volume().low * factor, high: volume().high * factor };
        let got = solve(raster(), &scaled, &options, &of).unwrap_err();
        assert!(matches!(got, PointsRefusal::WrongUnit { factor: f, .. } if f == factor), "{factor}: {got}");
    }
    // Without a tape measure the coarse ones are seen.
    for factor in [1000.0, 0.01] {
        let mut scaled = sights.clone();
        scaled.iter_mut().for_each(|s| s.world *= factor);
        assert!(matches!(solved(&scaled), Err(PointsRefusal::WrongUnit { .. })), "{factor}");
    }
}

#[test]
fn a_world_with_another_axis_up_is_refused_by_name() {
    let sights = aimed(&truth(10), 24, 0.2, 10);
    let known = PlaceHint { distance_m: None, up: Some(DVec3::Y) };
    let options = Options { known, ..Options::by_hand(raster()) };
    solve(raster(), &sights, &options, &volume()).unwrap();
    let mut z_up = sights.clone();
    z_up.iter_mut().for_each(|s| s.world = DVec3::new(s.world.x, -s.world.z, s.world.y));
    let got = solve(raster(), &z_up, &options, &volume()).unwrap_err();
    assert_eq!(got, PointsRefusal::AxesExchanged { found: "Z", expected: "Y" });
    // A projector that hangs upside down is none of that.
    let mut hanging = sights;
    hanging.iter_mut().for_each(|s| s.world = DVec3::new(-s.world.x, -s.world.y, s.world.z));
    solve(raster(), &hanging, &options, &volume()).unwrap();
}

#[test]
fn a_shift_in_time_is_corrected_or_refused() {
    let truth = truth(11);
    let d = Draws::new(11);
    let shifted = |offset_s: f64| -> Vec<Sight> {
        let mut sights = aimed(&truth, 60, 0.2, 11);
        for (i, s) in sights.iter_mut().enumerate() {
            s.velocity = DVec3::from_array(d.normal3(i as u64)) * 0.25;
            s.world -= s.velocity * offset_s;
        }
        sights
    };
    let got = solved(&shifted(6e-3)).unwrap();
    let [offset, deviation] = got.offset_s.unwrap();
    assert!((offset - 6e-3).abs() < 5.0 * deviation && deviation < 5e-4, "{offset} {deviation}");
    assert!(got.notes.iter().any(|n| n.contains("time-shifted")), "{:?}", got.notes);
    assert!(matches!(solved(&shifted(0.04)), Err(PointsRefusal::TimeShifted { .. })));
}

#[test]
fn numbers_that_are_none_and_pixels_outside_are_refused() {
    let sights = aimed(&truth(13), 12, 0.3, 13);
    assert_eq!(solved(&sights[..5]).unwrap_err(), PointsRefusal::TooFew { have: 5, need: 6 });
    let mut bad = sights.clone();
    bad[3].world.x = f64::INFINITY;
    assert_eq!(solved(&bad).unwrap_err(), PointsRefusal::NotFinite(3));
    let mut bad = sights;
    bad[2].pixel.x = 5000.0;
    assert_eq!(solved(&bad).unwrap_err(), PointsRefusal::OutsideRaster(2));
}

#[test]
fn the_next_point_makes_it_better() {
    let truth = truth(14);
    let mut session = Session::new(raster(), Options::by_hand(raster()), volume());
    assert!(session.next_point().world.is_none());
    aimed(&truth, 12, 0.3, 14).into_iter().for_each(|s| session.add(s));
    let before = session.solve().unwrap().predicted;
    for _ in 0..6 {
        let next = session.next_point();
        let world = next.world.unwrap();
        session.add(Sight::at_rest(world, truth.project(world).unwrap()));
    }
    let after = session.solve().unwrap().predicted;
    assert!(after.worst_px < 0.7 * before.worst_px, "{} {}", before.worst_px, after.worst_px);
    assert!(session.advice().contains("aim there next"));
}

/// A wide angle: the corners lie at 1.1 times the focal length.
fn wide() -> ProjectorModel {
    let from = DVec3::new(0.1, 0.05, 0.8);
    let mut camera = ProjectorCamera::look_at(raster(), from, DVec3::ZERO, DVec3::Y, 0.6).unwrap();
    (camera.fx, camera.fy) = (560.0, 561.0);
    let lens = [0.12, 0.05, 5e-4, -3e-4, 0.01, 0.16, 0.06, 0.01, 2e-3, -1e-3, -1.5e-3, 5e-4];
    ProjectorModel::from_camera(&camera, lens, DVec3::ZERO)
}

fn with_lens(terms: LensTerms, sights: &[Sight]) -> Result<ProjectorFit, PointsRefusal> {
    let priors = Priors::many_points(raster()).with_lens(terms);
    let options = Options { priors, aim_px: 0.1, ..Options::by_hand(raster()) };
    solve(raster(), sights, &options, &Volume { low: DVec3::splat(-0.2), high: DVec3::splat(0.2) })
}

#[test]
fn a_tilted_lens_needs_terms_that_a_narrow_one_does_not_tell() {
    let truth = wide();
    let sights = aimed(&truth, 1500, 0.05, 1);
    let p99 = |solved: &ProjectorFit| p99_in_hull(&solved.model, &truth, &sights);
    let prism = with_lens(LensTerms::ThinPrism, &sights).unwrap();
    let brown = with_lens(LensTerms::Brown, &sights).unwrap();
    println!("{} px with all terms, {} px with five", p99(&prism), p99(&brown));
    assert!(p99(&prism) < 0.03 && p99(&brown) > 0.1);
    assert_eq!((prism.model.lens_numbers().len(), brown.model.lens_numbers().len()), (12, 5));
    // A narrow picture does not tell a quotient from a polynomial.
    let narrow = super::tests::truth(1);
    for terms in [LensTerms::Rational, LensTerms::ThinPrism] {
        let told = with_lens(terms, &aimed(&narrow, 400, 0.05, 1)).unwrap_err();
        assert!(matches!(told, PointsRefusal::LensUndetermined { .. }), "{told}");
        assert!(told.to_string().contains("--lens"), "{told}");
    }
}

/// Whole sweeps.
mod breadth {
    use super::*;

    #[test]
    fn data_from_before_and_after_a_motion_are_refused_by_name() {
        for (shift, first) in [(0.004, 15), (0.03, 10), (0.1, 15), (0.02, 20)] {
            let mut sights = aimed(&truth(12), 30, 0.3, 12);
            sights[first..].iter_mut().for_each(|s| s.world.x += shift);
            let got = solved(&sights);
            let Err(PointsRefusal::Moved { last_before, moved_mm, .. }) = got else {
                panic!("{shift}: {got:?}")
            };
            assert!(last_before.abs_diff(first - 1) <= 3, "{last_before} {first}");
            assert!(moved_mm > 500.0 * shift && moved_mm < 4000.0 * shift + 10.0, "{shift}: {moved_mm}");
        }
    }
}
