//! Poses and their covariance from drawn corners and markers: what the solver says of its error is true.

use crate::stage::{any_rotation, camera, facing, optics, quantile, two_tags, within};
use dpm_camera::{
    BodyPose, Covariance, Expectation, Markings, Sightings, SpotSighting, TagPlace, TagSighting, Velocity,
};
use dpm_common::so3::so3_between;
use dpm_device::rng::Draws;
use dpm_mock::camera::CameraOptics;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DQuat, DVec2, DVec3};

/// What a camera with corners of `sigma` pixels sees of a body's tags that face it.
fn tags_seen(
    camera: &ProjectorCamera,
    markings: &Markings,
    pose: &DAffine3,
    sigma: f64,
    draws: Draws,
) -> Vec<TagSighting> {
    let seen = markings.tags.iter().enumerate().filter_map(|(n, tag)| {
        let face = *pose * tag.body_from_tag;
        let towards = camera.position() - face.translation;
        if face.matrix3.z_axis.dot(towards) < 0.2 * towards.length() {
            return None;
        }
        let mut corners = [DVec2::ZERO; 4];
        for (i, corner) in tag.corners().iter().enumerate() {
            let n = (4 * n + i) as u64;
            let noise = DVec2::new(draws.normal(2 * n), draws.normal(2 * n + 1)) * sigma;
            corners[i] = camera.project(pose.transform_point3(*corner))? + noise;
        }
        Some(TagSighting { id: tag.id, corners, sigma_px: [sigma; 4], wrong_cells: 0 })
    });
    seen.collect()
}

fn spots_seen(
    camera: &ProjectorCamera,
    markings: &Markings,
    pose: &DAffine3,
    sigma: f64,
    draws: Draws,
) -> Vec<SpotSighting> {
    let seen = markings.markers.iter().enumerate().map(|(n, m)| {
        let noise = DVec2::new(draws.normal(2 * n as u64), draws.normal(2 * n as u64 + 1)) * sigma;
        let centre = camera.project(pose.transform_point3(*m)).unwrap() + noise;
        SpotSighting { centre, sigma_px: sigma, weight: 1e4 }
    });
    seen.collect()
}

fn locate(
    camera: &ProjectorCamera,
    markings: &Markings,
    tags: &[TagSighting],
    spots: &[SpotSighting],
    expected: Option<&Expectation>,
) -> Option<BodyPose> {
    markings.locate(&[*camera], &[Sightings { tags, spots, row_s: 0.0, row: 400.0 }], expected)
}

/// The error of a pose: of the place, m, and of the turn, rad.
fn error(found: &BodyPose, truth: &DAffine3) -> [f64; 6] {
    let d = found.fit.position - truth.translation;
    let w = so3_between(DQuat::from_mat3(&truth.matrix3), found.fit.rotation);
    [d.x, d.y, d.z, w.x, w.y, w.z]
}

fn place(e: &[f64; 6]) -> f64 {
    DVec3::from_slice(&e[..3]).length()
}

fn turn(e: &[f64; 6]) -> f64 {
    DVec3::from_slice(&e[3..]).length()
}

/// The squared distance of an error in standard deviations, by elimination.
fn squared_distance(covariance: &Covariance, e: &[f64; 6]) -> f64 {
    let (mut m, mut v) = (*covariance, *e);
    let mut sum = 0.0;
    for i in 0..6 {
        sum += v[i] * v[i] / m[i][i];
        for j in i + 1..6 {
            let f = m[j][i] / m[i][i];
            (i..6).for_each(|k| m[j][k] -= f * m[i][k]);
            v[j] -= f * v[i];
        }
    }
    sum
}

/// 95 % of a chi-square with 6 degrees of freedom.
const CHI2_6: f64 = 12.592;

/// Two tags of 80 mm at one metre with corners of 0.1 px: 2 mm and 0.3 degrees in 99 of 100, and the covariance is true.
#[test]
fn two_tags_at_a_metre() {
    let (cam, markings) = (camera(&optics()), two_tags());
    let (mut places, mut turns, mut covered) = (vec![], vec![], 0);
    for seed in 0..1000 {
        let draws = Draws::new(seed);
        let truth = facing(draws, 1.0, 0.5);
        let seen = tags_seen(&cam, &markings, &truth, 0.1, draws.stream(7));
        let found = locate(&cam, &markings, &seen, &[], None).expect("a pose");
        assert!(found.is_certain(), "seed {seed}: {found:?}");
        let e = error(&found, &truth);
        places.push(1e3 * place(&e));
        turns.push(turn(&e).to_degrees());
        covered += usize::from(squared_distance(&found.fit.covariance, &e) < CHI2_6);
    }
    let (p, t) = (quantile(&mut places, 0.99), quantile(&mut turns, 0.99));
    println!("p99 {p:.3} mm, {t:.4} deg; {covered} of 1000 covered");
    assert!(p < 2.0 && t < 0.3, "{p} mm, {t} degrees");
    assert!((930..=980).contains(&covered), "{covered} of 1000 lie within the ellipsoid of 95 %");
}

/// Bodies with one to six tags anywhere, other lenses, distances and noise: whatever the pose is worth, the covariance says it.
#[test]
fn the_covariance_covers_in_drawn_set_ups() {
    let (mut covered, mut count, mut doubtful, mut wrong) = (0, 0, 0, 0usize);
    for seed in 0..1500 {
        let draws = Draws::new(1000 + seed);
        let view = 35.0 + 50.0 * draws.unit(20);
        let optics = CameraOptics {
            lens: [-0.1 * draws.unit(21), 0.03 * draws.unit(22), 0.0, 0.0, 0.0],
            ..CameraOptics::pinhole([1280, 800], view)
        };
        let cam = camera(&optics);
        let side = 0.03 + 0.09 * draws.unit(23);
        let tags = (0..1 + draws.bits(24) % 6).map(|i| {
            let own = draws.stream(100 + i);
            let place = DAffine3::from_rotation_translation(any_rotation(own), within(own.stream(1), 0.12));
            TagPlace { id: i as u16, side, body_from_tag: place }
        });
        let markings = Markings { tags: tags.collect(), markers: vec![] };
        let distance = 0.4 + 2.0 * draws.unit(25);
        let sigma = 0.03 + 0.3 * draws.unit(26);
        let mut truth = facing(draws.stream(2), distance, 0.1);
        truth.matrix3 = glam::DMat3::from_quat(any_rotation(draws.stream(3)));
        let seen = tags_seen(&cam, &markings, &truth, sigma, draws.stream(7));
        let Some(found) = locate(&cam, &markings, &seen, &[], None) else { continue };
        if !found.is_certain() {
            doubtful += 1;
            continue;
        }
        let e = error(&found, &truth);
        count += 1;
        covered += usize::from(squared_distance(&found.fit.covariance, &e) < CHI2_6);
        wrong += usize::from(turn(&e) > 0.5);
    }
    let share = covered as f64 / count as f64;
    println!("{count} poses, {doubtful} doubtful, {wrong} far off, {share:.4} covered");
    assert!(count > 1000, "{count}");
    assert!(doubtful * 4 < count, "{doubtful} of {count} were refused");
    assert!((0.93..=0.99).contains(&share), "{share}");
    assert!(wrong * 100 <= count, "{wrong} of {count}");
}

/// A single flat tag far away has two poses; where the body was decides.
#[test]
fn the_last_pose_decides_between_two() {
    let cam = camera(&optics());
    let markings = Markings {
        tags: vec![TagPlace { id: 3, side: 0.05, body_from_tag: DAffine3::IDENTITY }],
        markers: vec![],
    };
    let (mut doubtful, mut right, mut count) = (0, 0, 0);
    for seed in 0..300 {
        let draws = Draws::new(seed);
        let truth = facing(draws, 2.0, 0.6);
        let seen = tags_seen(&cam, &markings, &truth, 0.15, draws.stream(7));
        let alone =
            locate(&cam, &markings, &seen, &[], None).unwrap_or_else(|| panic!("{seed} {truth} {seen:?}"));
        doubtful += usize::from(!alone.is_certain());
        let turned = DQuat::from_axis_angle(DVec3::Y, 0.05);
        let pose = DAffine3::from_rotation_translation(
            DQuat::from_mat3(&truth.matrix3) * turned,
            truth.translation + DVec3::splat(0.005),
        );
        let expected = Expectation { pose, velocity: Velocity::default(), turn: 0.1, shift: 0.05 };
        let found = locate(&cam, &markings, &seen, &[], Some(&expected)).expect("a pose");
        if found.is_certain() {
            count += 1;
            right += usize::from(turn(&error(&found, &truth)) < 0.35);
        }
    }
    println!("{doubtful} doubtful alone; {right} of {count} right");
    assert!(doubtful > 50, "{doubtful}: the test tests nothing");
    assert!(count > 280 && right * 100 >= count * 99, "{right} of {count}");
}

fn constellation() -> Markings {
    let markers =
        [[0.0, 0.0, 0.0], [0.1, 0.0, 0.02], [0.0, 0.08, 0.0], [-0.07, -0.05, 0.03], [0.05, -0.06, -0.03]];
    Markings { tags: vec![], markers: markers.map(DVec3::from_array).to_vec() }
}

/// Five markers at one metre, found without and with an expectation, among spots that are none of them.
#[test]
fn markers_at_a_metre() {
    let (cam, markings) = (camera(&optics()), constellation());
    let (mut aside, mut places, mut turns, mut covered, mut count) = (vec![], vec![], vec![], 0, 0);
    for seed in 0..120 {
        let draws = Draws::new(seed);
        let truth = facing(draws, 1.0, 0.8);
        let mut spots = spots_seen(&cam, &markings, &truth, 0.1, draws.stream(7));
        for k in 0..draws.bits(8) % 4 {
            let centre = DVec2::new(1280.0 * draws.unit(30 + k), 800.0 * draws.unit(40 + k));
            spots.insert(
                (draws.bits(50 + k) % 5) as usize,
                SpotSighting { centre, sigma_px: 0.1, weight: 1e4 },
            );
        }
        let expected = Expectation {
            pose: truth * DAffine3::from_rotation_x(0.02),
            velocity: Velocity::default(),
            turn: 0.1,
            shift: 0.05,
        };
        for expected in [None, Some(&expected)] {
            let Some(found) = locate(&cam, &markings, &[], &spots, expected) else { continue };
            let e = error(&found, &truth);
            assert!(place(&e) < 0.02, "seed {seed}: a wrong correspondence, {e:?}");
            count += 1;
            aside.push(1e3 * e[0].hypot(e[1]));
            places.push(1e3 * place(&e));
            turns.push(turn(&e).to_degrees());
            covered += usize::from(squared_distance(&found.fit.covariance, &e) < CHI2_6);
        }
    }
    let (a, p, t) = (quantile(&mut aside, 0.99), quantile(&mut places, 0.99), quantile(&mut turns, 0.99));
    println!("{count} of 240; p99 {a:.3} mm aside, {p:.3} mm, {t:.3} deg; {covered} covered");
    assert!(count >= 228, "{count} of 240 found");
    assert!(covered * 100 >= count * 91, "{covered} of {count}");
}

/// A row later is a moment later: with the body's velocity a rolling shutter takes nothing away.
#[test]
fn a_rolling_shutter_is_undone_by_the_velocity() {
    let (cam, markings) = (camera(&optics()), two_tags());
    let truth = facing(Draws::new(5), 1.0, 0.4);
    let (row_s, row) = (20e-6, 400.0);
    let velocity = Velocity { linear: DVec3::new(0.8, 0.3, -0.2), angular: DVec3::new(0.5, -1.0, 2.0) };
    let moved = |late: f64| {
        let turned = dpm_common::so3::so3_exp(velocity.angular * late) * DQuat::from_mat3(&truth.matrix3);
        DAffine3::from_rotation_translation(turned, truth.translation + velocity.linear * late)
    };
    let mut seen = tags_seen(&cam, &markings, &truth, 0.1, Draws::new(1));
    for sighting in &mut seen {
        let tag = markings.tags.iter().find(|t| t.id == sighting.id).unwrap();
        for (pixel, corner) in sighting.corners.iter_mut().zip(tag.corners()) {
            // The row in which it is seen depends on when it is seen.
            let mut late = 0.0;
            for _ in 0..20 {
                *pixel = cam.project(moved(late).transform_point3(corner)).unwrap();
                late = (pixel.y - row) * row_s;
            }
        }
    }
    let sightings = [Sightings { tags: &seen, spots: &[], row_s, row }];
    let without = markings.locate(&[cam], &sightings, None).unwrap();
    let expected = Expectation { pose: truth, velocity, turn: 0.1, shift: 0.05 };
    let with = markings.locate(&[cam], &sightings, Some(&expected)).unwrap();
    let (without, with) = (place(&error(&without, &truth)), place(&error(&with, &truth)));
    assert!(without > 5e-4, "{without}: the test tests nothing");
    assert!(with < 2e-5, "{with} m");
}

/// Two cameras across the room see the depth that one does not.
#[test]
fn two_cameras_are_better_than_one() {
    let markings = two_tags();
    let left = camera(&optics());
    let right = ProjectorCamera {
        world_from_projector: DAffine3::from_translation(DVec3::new(0.9, 0.0, -0.3))
            * DAffine3::from_rotation_y(0.9),
        ..left
    };
    let (mut one, mut two) = (vec![], vec![]);
    for seed in 0..100 {
        let draws = Draws::new(seed);
        let truth = DAffine3::from_rotation_translation(
            DQuat::from_rotation_y(0.4),
            DVec3::new(0.0, 0.0, -1.0) + within(draws, 0.05),
        );
        let seen = [&left, &right].map(|c| tags_seen(c, &markings, &truth, 0.1, draws.stream(7)));
        assert!(seen.iter().all(|s| !s.is_empty()));
        let sightings = seen.each_ref().map(|tags| Sightings { tags, spots: &[], row_s: 0.0, row: 400.0 });
        let first = markings.locate(&[left], &sightings[..1], None).unwrap();
        let both = markings.locate(&[left, right], &sightings, None).unwrap();
        one.push(place(&error(&first, &truth)));
        two.push(place(&error(&both, &truth)));
    }
    let (one, two) = (quantile(&mut one, 0.5), quantile(&mut two, 0.5));
    assert!(two < 0.6 * one, "{two} m with two, {one} m with one");
}
