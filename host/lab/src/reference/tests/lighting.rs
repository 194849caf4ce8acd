//! Light sources against closed forms, and the estimators against each other.

use super::*;
use crate::reference::light::SkyImage;
use crate::reference::{Reference, ReferenceImage, RenderSettings, Sampler};
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::{PunctualKind, PunctualLight};
use std::f64::consts::PI;

fn down(w: u32) -> ProjectorCamera {
    let mut c = camera(w, w, DVec3::new(0.0, 4.0, 0.0), DVec3::ZERO);
    // A pencil of rays around the origin.
    c.fx = 1e6;
    c.fy = 1e6;
    c
}

/// Mean and standard error over all pixels of one channel.
fn overall(image: &ReferenceImage, channel: usize) -> (f64, f64) {
    let n = image.mean.len() as f64;
    let mean = image.mean.iter().map(|p| p[channel]).sum::<f64>() / n;
    (mean, image.variance.iter().map(|v| v[channel]).sum::<f64>().sqrt() / n)
}

fn light(kind: PunctualKind, position: Vec3, direction: Vec3, intensity: f32, range: f32) -> PunctualLight {
    PunctualLight {
        kind,
        intensity: Vec3::splat(intensity),
        body: None,
        position,
        direction: direction.normalize(),
        range,
    }
}

#[test]
fn punctual_lights_give_their_closed_form() {
    let albedo = 0.6f64;
    let position = Vec3::new(0.8, 1.5, -0.4);
    let (d2, cos) = (f64::from(position.length_squared()), f64::from(position.y / position.length()));
    let spot = |a: f64| ((a.cos() - 0.7f64.cos()) / (0.3f64.cos() - 0.7f64.cos())).clamp(0.0, 1.0).powi(2);
    let off_axis = Vec3::new(-0.8, -1.5, 0.9);
    let angle = f64::from((-position).angle_between(off_axis));
    assert!(angle > 0.3 && angle < 0.7 || angle < 0.3);
    let window = 1.0 - (d2.sqrt() / 2.5).powi(4);
    let cases = [
        (light(PunctualKind::Point, position, Vec3::Y, 5.0, f32::INFINITY), 5.0 * cos / d2),
        (light(PunctualKind::Point, position, Vec3::Y, 5.0, 2.5), 5.0 * cos / d2 * window),
        (light(PunctualKind::Point, position, Vec3::Y, 5.0, 1.0), 0.0),
        (
            light(PunctualKind::Spot { inner: 0.3, outer: 0.7 }, position, -position, 5.0, f32::INFINITY),
            5.0 * cos / d2,
        ),
        (
            light(PunctualKind::Spot { inner: 0.3, outer: 0.7 }, position, off_axis, 5.0, f32::INFINITY),
            5.0 * cos / d2 * spot(angle),
        ),
        (light(PunctualKind::Spot { inner: 0.3, outer: 0.7 }, position, Vec3::Y, 5.0, f32::INFINITY), 0.0),
        (light(PunctualKind::Directional, position, -position, 3.0, f32::INFINITY), 3.0 * cos),
        (light(PunctualKind::Directional, position, position, 3.0, f32::INFINITY), 0.0),
        (light(PunctualKind::Point, Vec3::ZERO, Vec3::Y, 5.0, f32::INFINITY), 0.0),
    ];
    for (l, irradiance) in cases {
        let mut s = scene_of(floor(2.0, 0.0), diffuse(Vec3::splat(albedo as f32)));
        s.lights = vec![l];
        let image = Reference::new(&s, &[])
            .render_camera(&down(3), &RenderSettings { spp: 2, depth: 2, ..Default::default() });
        let got = image.mean[4][0];
        assert!(
            (got - albedo / PI * irradiance).abs() < 1e-6,
            "{:?}: {got} {}",
            s.lights[0],
            albedo / PI * irradiance
        );
    }
}

#[test]
fn light_sampling_and_scattering_agree_on_a_glossy_floor() {
    // The image combines both estimators; by hand, scattering alone must find the same light.
    let (lamp, floor_material) = (
        quad(Vec3::new(-0.5, 1.0, -0.5), Vec3::X, Vec3::Z),
        Material { roughness: 0.35, metallic: 1.0, base_color: Vec3::splat(0.9), ..Material::default() },
    );
    let mut s = scene_of(floor(3.0, 0.0), floor_material.clone());
    add(&mut s, lamp, emitter(Vec3::ONE));
    let r = Reference::new(&s, &[]);
    let mut c = camera(8, 8, DVec3::new(1.0, 1.2, 0.0), DVec3::ZERO);
    (c.fx, c.fy) = (1e6, 1e6);
    let image = r.render_camera(&c, &RenderSettings { spp: 400, depth: 2, ..Default::default() });
    let (mis, sigma_mis) = overall(&image, 0);
    let point = r.trace(c.position(), -c.position().normalize(), 9.0, false).unwrap();
    let bsdf = crate::reference::bsdf::Bsdf::new(&point, r.table(0), c.position().normalize()).unwrap();
    let mut sampler = Sampler::new(1, 2);
    let n = 60_000;
    let (mut sum, mut sum2) = (0.0, 0.0);
    for _ in 0..n {
        let Some(next) = bsdf.sample(sampler.uniform(), sampler.uniform2(), sampler.uniform()) else {
            continue;
        };
        let origin = crate::reference::offset(point.position, point.geometric, next.l, point.scale);
        let seen = r
            .trace(origin, next.l, 99.0, false)
            .is_some_and(|h| h.body == 1 && h.geometric.dot(next.l) < 0.0);
        let w = if seen { next.weight.x } else { 0.0 };
        sum += w;
        sum2 += w * w;
    }
    let mean = sum / f64::from(n);
    let sigma = ((sum2 / f64::from(n) - mean * mean) / f64::from(n)).sqrt();
    assert!(sigma < 0.02 * mean && sigma_mis < sigma);
    assert!((mean - mis).abs() < 4.0 * sigma.hypot(sigma_mis), "{mean} +- {sigma}, {mis} +- {sigma_mis}");
}

fn gradient_sky(rotation_rad: f32) -> Environment {
    let (width, height) = (16u32, 8u32);
    let texels = (0..width * height)
        .map(|i| {
            let (x, y) = (i % width, i / width);
            Vec3::new(
                0.1 + x as f32,
                if (x, y) == (3, 1) { 200.0 } else { 0.0 },
                if y < 2 { 0.0 } else { 1.0 },
            )
        })
        .collect();
    Environment::Equirect { width, height, texels, rotation_rad }
}

#[test]
fn sky_importance_sampling_is_unbiased() {
    let mut s = scene_of(floor(2.0, 0.0), diffuse(Vec3::ONE));
    s.environment = gradient_sky(0.4);
    let r = Reference::new(&s, &[]);
    let image = r.render_camera(&down(8), &RenderSettings { spp: 300, depth: 2, ..Default::default() });
    let Environment::Equirect { width, height, texels, rotation_rad } = &s.environment else {
        unreachable!()
    };
    let sky = SkyImage::new(*width as usize, *height as usize, texels.clone(), f64::from(*rotation_rad));
    // Even quadrature over the upper hemisphere.
    let n = 600;
    let mut want = DVec3::ZERO;
    for i in 0..n {
        for j in 0..n {
            let y = (f64::from(i) + 0.5) / f64::from(n);
            let phi = 2.0 * PI * (f64::from(j) + 0.5) / f64::from(n);
            let rr = (1.0 - y * y).sqrt();
            want += sky.radiance(DVec3::new(rr * phi.cos(), y, rr * phi.sin())) * y * 2.0 / f64::from(n * n);
        }
    }
    for c in 0..3 {
        let (mean, sigma) = overall(&image, c);
        assert!(
            (mean - want[c]).abs() < 4.0 * sigma + 2e-3 * want[c],
            "channel {c}: {mean} +- {sigma}, {want}"
        );
        assert!(sigma < 0.02 * want[c]);
    }
}

#[test]
fn the_sky_is_the_right_way_round() {
    let texels: Vec<Vec3> = (0..32).map(|i| Vec3::new((i % 8) as f32, (i / 8) as f32, 0.0)).collect();
    let still = SkyImage::new(8, 4, texels.clone(), 0.0);
    // Columns 3 | 4 meet at -Z; right of it, toward +X, is column 5 | 6. Row 0 is up.
    let at = |s: &SkyImage, x: f64, y: f64, z: f64| s.radiance(DVec3::new(x, y, z).normalize());
    assert_eq!(at(&still, -0.01, 0.01, -1.0), DVec3::new(3.0, 1.0, 0.0));
    assert_eq!(at(&still, 0.01, 0.01, -1.0), DVec3::new(4.0, 1.0, 0.0));
    assert_eq!(at(&still, 1.0, -0.01, 0.01), DVec3::new(6.0, 2.0, 0.0));
    assert_eq!(at(&still, 0.01, 1.0, -0.02).y, 0.0);
    assert_eq!(at(&still, 0.01, -1.0, -0.02).y, 3.0);
    // A quarter turn counter-clockwise about +Y moves the middle from -Z to -X.
    let turned = SkyImage::new(8, 4, texels, PI / 2.0);
    assert_eq!(at(&turned, -1.0, 0.01, 0.01).x, 3.0);
    assert_eq!(at(&turned, -1.0, 0.01, -0.01).x, 4.0);
}
