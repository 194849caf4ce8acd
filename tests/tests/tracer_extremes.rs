//! Rays, shapes and lights at the edge of what numbers can hold.

use dpm_host::experiments::stability::estimate::pooled;
use dpm_host::experiments::stability::gpu_shot::Shot;
use dpm_host::experiments::stability::shapes::*;
use dpm_host::scene::{Material, PunctualKind, PunctualLight, Scene, TriangleMesh};
use dpm_tests::compare::{compare, Demands};
use dpm_tests::gpu::with_gpu;
use glam::{DAffine3, DMat3, DVec3, Vec3};

/// A floor of `n` x `n` squares of side `side` whose seams lie on round numbers, about the origin.
fn grid(n: i32, side: f32) -> TriangleMesh {
    let at = |i: i32, k: i32| Vec3::new((i - n / 2) as f32 * side, 0.0, (k - n / 2) as f32 * side);
    let positions: Vec<Vec3> = (0..=n).flat_map(|k| (0..=n).map(move |i| at(i, k))).collect();
    let index = |i: i32, k: i32| (k * (n + 1) + i) as u32;
    let triangles = (0..n)
        .flat_map(|k| (0..n).map(move |i| (i, k)))
        .flat_map(|(i, k)| {
            let [a, b, c, d] = [index(i, k), index(i, k + 1), index(i + 1, k + 1), index(i + 1, k)];
            [[a, b, c], [a, c, d]]
        })
        .collect();
    let normals = vec![Vec3::Y; positions.len()];
    mesh(positions, normals, triangles)
}

#[test]
fn rays_along_axes_and_seams_find_the_surface() {
    // The middle column and row of an odd raster run exactly in the planes of the seams; the middle ray hits a vertex. Looked at along
    // each axis from both sides, at distances where rounding differs.
    with_gpu(|gpu| {
        let axes = [DVec3::X, DVec3::Y, DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y, DVec3::NEG_Z];
        let mut scene = scene_of(grid(16, 0.25), Material { double_sided: true, ..diffuse(Vec3::ONE) });
        scene.environment = sky(1.0);
        for (k, &axis) in axes.iter().enumerate() {
            for distance in [0.375, 3.0, 5.9] {
                // The floor's normal turned to the axis by a matrix of zeros and ones.
                let side = axes[(k + 1) % 3].abs();
                let turn = DMat3::from_cols(side, axis, side.cross(axis));
                let camera = camera(33, 33, axis * distance, DVec3::ZERO);
                let poses = vec![DAffine3::from_mat3(turn)];
                let picture = Shot { poses, spp: 4, depth: 2, ..Shot::new(&scene, camera) }.draw(gpu);
                let missed: Vec<_> = (0..33 * 33).filter(|&i| !picture.hit(i)).collect();
                assert!(missed.is_empty(), "axis {axis} from {distance}: rays fell through at {missed:?}");
                let middle = picture.surfaces[16 * 33 + 16].distance;
                assert!((f64::from(middle) / distance - 1.0).abs() < 1e-6, "{middle}");
                assert!(picture.estimates.iter().all(|e| (e.mean[0] - 1.0).abs() < 2e-6));
            }
        }
    });
}

#[test]
fn slivers_points_lines_and_twins_change_nothing() {
    with_gpu(|gpu| {
        let plain = sphere(Vec3::ZERO, 0.5, 2, true);
        let mut odd = plain.clone();
        let corners = plain.triangles[7].map(|i| plain.positions[i as usize]);
        let extra = [
            [corners[0]; 3],
            [corners[0], corners[1], corners[0].lerp(corners[1], 0.5)],
            [corners[0], corners[0], corners[2]],
            corners,
            corners,
            [Vec3::ZERO, Vec3::splat(1e-20), Vec3::new(1e-20, 0.0, 0.0)],
        ];
        for t in extra {
            odd = join([odd, triangle(t)]);
        }
        // Twins carry the sphere's own normals: whichever is hit, it looks the same.
        let n = odd.triangles.len();
        for twin in [n - 3, n - 2] {
            odd.triangles[twin] = plain.triangles[7];
        }
        let camera = camera(48, 36, DVec3::new(0.3, 0.4, 2.0), DVec3::ZERO);
        let draw = |mesh: TriangleMesh| {
            let mut scene = scene_of(mesh, diffuse(Vec3::splat(0.6)));
            scene.environment = sky(1.0);
            Shot { spp: 8, ..Shot::new(&scene, camera) }.draw(gpu)
        };
        let (a, b) = (draw(plain), draw(odd));
        for i in 0..a.surfaces.len() {
            assert_eq!(a.hit(i), b.hit(i), "pixel {i}");
            let (x, y) = (a.estimates[i].mean[0], b.estimates[i].mean[0]);
            assert!(x.is_finite() && (x - y).abs() < 1e-5, "pixel {i}: {x} {y}");
        }
        assert_eq!(b.counters[0].invalid_samples, 0);
    });
}

/// A table with a ball, a lamp and a light, all lengths times `scale`, at `offset`.
fn still_life(scale: f32) -> Scene {
    let mut scene = scene_of(floor(scale, 0.0), diffuse(Vec3::new(0.7, 0.5, 0.4)));
    let mut ball = sphere(Vec3::ZERO, 0.4 * scale, 2, true);
    ball.positions.iter_mut().for_each(|p| p.y += 0.45 * scale);
    add(&mut scene, ball, Material { roughness: 0.4, ..diffuse(Vec3::new(0.3, 0.5, 0.8)) });
    let lamp = quad(Vec3::new(-0.2, 1.5, -0.2) * scale, Vec3::X * 0.4 * scale, Vec3::Z * 0.4 * scale);
    add(&mut scene, lamp, emitter(Vec3::splat(4.0)));
    scene.lights.push(PunctualLight {
        kind: PunctualKind::Point,
        intensity: Vec3::splat(0.6 * scale * scale),
        body: Some(0),
        position: Vec3::new(0.8, 1.0, 0.4) * scale,
        direction: Vec3::NEG_Y,
        range: 10.0 * scale,
    });
    scene
}

#[test]
fn size_and_place_do_not_change_the_picture() {
    with_gpu(|gpu| {
        let draw = |scale: f64, offset: DVec3| {
            let scene = still_life(scale as f32);
            let mut camera = camera(40, 30, DVec3::new(0.3, 1.6, 2.4) * scale, DVec3::ZERO);
            camera.world_from_projector.translation += offset;
            let eye = DVec3::new(-0.7, 1.4, 2.1) * scale + offset;
            let poses = vec![DAffine3::from_translation(offset); 3];
            Shot { eye: Some(eye), poses, spp: 16, frames: 8, ..Shot::new(&scene, camera) }.draw(gpu)
        };
        let plain = draw(1.0, DVec3::ZERO);
        let lit = plain.lit_estimates().count();
        assert!(lit > 400, "{lit}");
        // Powers of two scale without rounding; 1024 m of offset at millimetre detail (scale 2^-10).
        let far = DVec3::new(1024.0, -512.0, 2048.0);
        let down = 2f64.powi(-13);
        let up = 2f64.powi(13);
        for (scale, offset) in [(down, DVec3::ZERO), (up, DVec3::ZERO), (1.0, far), (2f64.powi(-10), far)] {
            let other = draw(scale, offset);
            let what = format!("scale {scale} offset {offset}");
            let changed = (0..plain.surfaces.len()).filter(|&i| plain.lit(i) != other.lit(i)).count();
            assert!(changed <= lit / 200, "{what}: {changed} pixels changed their lighting");
            for channel in 0..3 {
                let (a, sigma) = pooled(plain.lit_estimates().collect::<Vec<_>>(), channel);
                let (b, _) = pooled(other.lit_estimates().collect::<Vec<_>>(), channel);
                // The same random numbers: nearly every path is the same one.
                assert!((a - b).abs() < (0.5 * sigma).max(2e-3 * a), "{what}: {a} {b} +- {sigma}");
            }
            assert_eq!(other.counters.iter().map(|c| c.invalid_samples).sum::<u32>(), 0, "{what}");
        }
    });
}

#[test]
fn without_light_all_is_black() {
    with_gpu(|gpu| {
        let mut scene = still_life(1.0);
        scene.lights.clear();
        scene.materials[2].emissive = Vec3::ZERO;
        let camera = camera(32, 24, DVec3::new(0.3, 1.6, 2.4), DVec3::ZERO);
        let picture = Shot::new(&scene, camera).draw(gpu);
        assert!(picture.estimates.iter().all(|e| e.mean == [0.0; 3]));
        assert_eq!(picture.counters[0].invalid_samples, 0);
    });
}

#[test]
fn lights_that_touch_the_surface_stay_finite_and_right() {
    with_gpu(|gpu| {
        let mut scene = scene_of(floor(1.0, 0.0), diffuse(Vec3::splat(0.6)));
        // A lamp one millimetre above the floor, facing it, and one that lies in it.
        let lamp = quad(Vec3::new(-0.3, 1e-3, -0.3), Vec3::X * 0.6, Vec3::Z * 0.6);
        add(&mut scene, lamp, Material { double_sided: true, ..emitter(Vec3::splat(1.0)) });
        add(&mut scene, floor(0.15, 0.0), emitter(Vec3::splat(1.0)));
        for height in [0.0, 1e-5] {
            scene.lights.push(PunctualLight {
                kind: PunctualKind::Point,
                intensity: Vec3::splat(0.05),
                body: None,
                position: Vec3::new(0.7, height, 0.5),
                direction: Vec3::NEG_Y,
                range: f32::INFINITY,
            });
        }
        scene.environment = sky(0.3);
        let camera = camera(32, 24, DVec3::new(0.9, 1.2, 1.9), DVec3::ZERO);
        let shot = Shot { spp: 32, frames: 32, ..Shot::new(&scene, camera) };
        let c = compare(gpu, &shot, 512);
        c.assert_same_surfaces("touching lights", 1e-2);
        c.assert_pixels_explained("touching lights");
        assert!(c.picture.estimates.iter().all(|e| e.mean.iter().all(|m| m.is_finite())));
    });
}

#[test]
fn a_lost_body_gets_no_light_but_its_reflection_stays() {
    with_gpu(|gpu| {
        let mut scene = scene_of(
            floor(1.0, 0.0),
            Material { roughness: 0.0, base_color: Vec3::splat(0.9), ..Material::default() },
        );
        let mut ball = sphere(Vec3::ZERO, 0.3, 2, true);
        ball.positions.iter_mut().for_each(|p| p.y += 0.5);
        let body =
            add(&mut scene, ball, Material { double_sided: true, ..emitter(Vec3::new(1.0, 0.0, 0.0)) });
        scene.bodies[body].tracked = Some(0);
        let camera = camera(48, 36, DVec3::new(0.0, 1.6, 2.2), DVec3::ZERO);
        let eye = DVec3::new(0.05, 1.6, 2.2);
        let shot = Shot { eye: Some(eye), spp: 4, ..Shot::new(&scene, camera) };
        let there = shot.draw(gpu);
        let lost = Shot { lost: vec![true], ..shot }.draw(gpu);
        let on_ball = |p: &dpm_host::experiments::stability::gpu_shot::Picture| {
            (0..p.surfaces.len()).filter(|&i| p.hit(i) && p.surfaces[i].id >> 24 == body as u32).count()
        };
        assert!(on_ball(&there) > 50);
        assert_eq!(on_ball(&lost), 0, "no ray of the projector ends on a lost body");
        // Mirrored in the floor it is red as before, wherever the floor was lit before.
        let mut mirrored = 0;
        for i in 0..there.surfaces.len() {
            if there.lit(i) && there.surfaces[i].id >> 24 == 0 {
                let (a, b) = (there.estimates[i].mean[0], lost.estimates[i].mean[0]);
                assert!((a - b).abs() < 1e-5, "pixel {i}: {a} {b}");
                mirrored += usize::from(a > 0.5);
            }
        }
        assert!(mirrored > 20, "{mirrored}");
    });
}

#[test]
fn the_firefly_limit_removes_counts_and_never_adds() {
    with_gpu(|gpu| {
        let scene = still_life(1.0);
        let camera = camera(32, 24, DVec3::new(0.3, 1.6, 2.4), DVec3::ZERO);
        let shot = Shot { spp: 32, depth: 5, ..Shot::new(&scene, camera) };
        let draw = |limit| Shot { clamp_indirect: limit, ..shot.clone() }.draw(gpu);
        let (free, tight, loose) = (draw(None), draw(Some(0.02)), draw(Some(1e30)));
        assert_eq!(free.radiance, loose.radiance, "a limit that nothing reaches changes nothing");
        assert_eq!((free.counters[0].clamped_samples, loose.counters[0].clamped_samples), (0, 0));
        assert!(tight.counters[0].clamped_samples > 100, "{}", tight.counters[0].clamped_samples);
        let sum = |p: &dpm_host::experiments::stability::gpu_shot::Picture| {
            p.estimates.iter().map(|e| e.mean[1]).sum::<f64>()
        };
        assert!(sum(&tight) < 0.99 * sum(&free));
        for (i, (a, b)) in tight.estimates.iter().zip(&free.estimates).enumerate() {
            assert!(a.mean[1] <= b.mean[1] + 1e-6, "pixel {i}: {} above {}", a.mean[1], b.mean[1]);
        }
        // Direct light is never limited.
        let direct = |limit| Shot { clamp_indirect: limit, depth: 2, ..shot.clone() }.draw(gpu);
        assert_eq!(direct(Some(1e-6)).radiance, direct(None).radiance);
    });
}
