//! What a surface looks like: textures, normal maps, cut-outs, sides, the rig's own visibility, and invariance under motion and scale.

use super::*;
use crate::reference::texture;
use crate::reference::{Reference, RenderSettings};
use dpm_scene::{Texture, TextureRef, Wrap};
use glam::{DQuat, DVec2};

fn image(width: u32, height: u32, texels: Vec<[u8; 4]>) -> Texture {
    Texture::repeated([width, height], texels, false)
}

fn use_of(texture: u32) -> TextureRef {
    TextureRef { texture, offset: Vec2::ZERO, rotation: 0.0, scale: Vec2::ONE }
}

#[test]
fn texels_are_centred_at_halves_and_wrap_as_told() {
    let grey = |v: u8| [v, 0, 0, 255];
    let mut t = image(4, 1, vec![grey(0), grey(51), grey(102), grey(255)]);
    let red = |t: &Texture, u: f64| texture::sample(t, DVec2::new(u, 0.3)).x;
    for (u, want) in
        [(0.125, 0.0), (0.375, 0.2), (0.25, 0.1), (0.0, 0.5), (1.0, 0.5), (-0.125, 1.0), (1.375, 0.2)]
    {
        assert!((red(&t, u) - want).abs() < 1e-12, "repeat {u}");
    }
    t.wrap_u = Wrap::Clamp;
    for (u, want) in [(0.0, 0.0), (-7.0, 0.0), (1.0, 1.0), (1e300, 1.0), (f64::NAN, 0.0)] {
        assert!((red(&t, u) - want).abs() < 1e-12, "clamp {u}");
    }
    t.wrap_u = Wrap::Mirror;
    for (u, want) in [(-0.125, 0.0), (-0.375, 0.2), (1.125, 1.0), (1.375, 0.4), (2.375, 0.2)] {
        assert!((red(&t, u) - want).abs() < 1e-12, "mirror {u}");
    }
    t.nearest = true;
    t.wrap_u = Wrap::Repeat;
    for (u, want) in [(0.0, 0.0), (0.249, 0.0), (0.25, 0.2), (0.999, 1.0), (-0.001, 1.0)] {
        assert!((red(&t, u) - want).abs() < 1e-12, "nearest {u}");
    }
}

#[test]
fn srgb_is_decoded_before_interpolation_and_alpha_never() {
    let mut t = image(2, 1, vec![[0, 0, 0, 0], [255, 188, 10, 255]]);
    t.srgb = true;
    let middle = texture::sample(&t, DVec2::new(0.5, 0.5));
    assert!((middle.x - 0.5).abs() < 1e-12 && (middle.w - 0.5).abs() < 1e-12);
    assert!((middle.y - 0.5 * 0.502886).abs() < 1e-5, "{middle}");
    assert!((middle.z - 0.5 * (10.0 / 255.0 / 12.92)).abs() < 1e-12);
    let mean = texture::mean(&t);
    assert!((mean - middle).abs().max_element() < 1e-12);
}

#[test]
fn texture_transform_follows_the_extension() {
    // The extension's first example: lower left quadrant (v runs down), turned clockwise.
    let r = TextureRef {
        texture: 0,
        offset: Vec2::new(0.0, 1.0),
        rotation: std::f32::consts::FRAC_PI_2,
        scale: Vec2::splat(0.5),
    };
    for (uv, want) in [
        ((0.0, 0.0), (0.0, 1.0)),
        ((1.0, 0.0), (0.0, 0.5)),
        ((0.0, 1.0), (0.5, 1.0)),
        ((1.0, 1.0), (0.5, 0.5)),
    ] {
        let got = texture::transform(&r, DVec2::from(uv));
        assert!((got - DVec2::from(want)).length() < 1e-6, "{uv:?} {got}");
    }
}

#[test]
fn a_texture_lies_on_the_surface_the_right_way() {
    // Floor seen from above with -Z up in the picture: u runs right, v = 0 is the far edge.
    let mut s = scene_of(
        floor(1.0, 0.0),
        Material { emissive: Vec3::ONE, emissive_texture: Some(use_of(0)), ..diffuse(Vec3::ZERO) },
    );
    let mut t = image(2, 2, vec![[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255], [255, 255, 255, 255]]);
    t.nearest = true;
    s.textures.push(t);
    let r = Reference::new(&s, &[]);
    let at = |x: f64, z: f64| r.trace(DVec3::new(x, 1.0, z), -DVec3::Y, 9.0, false).unwrap().look.emission;
    assert_eq!(at(-0.5, -0.5), DVec3::X);
    assert_eq!(at(0.5, -0.5), DVec3::Y);
    assert_eq!(at(-0.5, 0.5), DVec3::Z);
    assert_eq!(at(0.5, 0.5), DVec3::ONE);
}

#[test]
fn a_normal_map_tilts_along_the_tangent_and_turns_with_the_body() {
    let mut s = scene_of(floor(1.0, 0.0), Material { normal_texture: Some(use_of(0)), ..diffuse(Vec3::ONE) });
    // x = 0.6, y = 0, z = 0.8 of the map: (0.6 + 1) / 2 * 255 = 204, 127.5, 229.5
    s.textures.push(image(1, 1, vec![[204, 128, 230, 255]]));
    let normal = |pose: DAffine3, strength: f32| {
        let mut s = s.clone();
        s.materials[0].normal_scale = strength;
        let r = Reference::new(&s, &[pose]);
        let up = pose.transform_vector3(DVec3::Y);
        r.trace(pose.translation + up, -up, 9.0, false).unwrap().shading
    };
    let n = normal(DAffine3::IDENTITY, 1.0);
    assert!((n - DVec3::new(0.6, 0.8, 0.0)).length() < 6e-3, "{n}");
    let flat = normal(DAffine3::IDENTITY, 0.0);
    assert!((flat - DVec3::Y).length() < 1e-9);
    // y of the map runs along cross(N, T) * w = Y x X = -Z.
    let q = DQuat::from_euler(glam::EulerRot::XYZ, 0.4, 1.1, -0.6);
    let turned = normal(DAffine3::from_rotation_translation(q, DVec3::new(1.0, 2.0, 3.0)), 1.0);
    assert!((turned - q * n).length() < 1e-9);
}

#[test]
fn cut_out_texels_are_not_there_for_any_ray() {
    let leaf =
        Material { alpha_cutoff: Some(0.5), base_color_texture: Some(use_of(0)), ..diffuse(Vec3::ONE) };
    let mut s = scene_of(quad(Vec3::new(-1.0, 1.0, 1.0), Vec3::X * 2.0, Vec3::NEG_Z * 2.0), leaf);
    add(&mut s, floor(1.0, 0.0), diffuse(Vec3::ONE));
    let mut t = image(2, 1, vec![[255, 255, 255, 0], [255, 255, 255, 255]]);
    t.nearest = true;
    s.textures.push(t);
    let r = Reference::new(&s, &[]);
    let body = |x: f64| r.trace(DVec3::new(x, 2.0, 0.0), -DVec3::Y, 9.0, false).unwrap().body;
    assert_eq!((body(-0.5), body(0.5)), (1, 0));
    assert!(r.visible(DVec3::new(-0.5, 0.5, 0.0), DVec3::new(-0.5, 2.0, 0.0), true));
    assert!(!r.visible(DVec3::new(0.5, 0.5, 0.0), DVec3::new(0.5, 2.0, 0.0), true));
}

#[test]
fn backs_of_single_sided_surfaces_are_black_and_block() {
    let mut s = scene_of(floor(1.0, 0.0), diffuse(Vec3::ONE));
    s.environment = sky(1.0);
    let from_below = camera(2, 2, DVec3::new(0.0, -2.0, 0.0), DVec3::ZERO);
    let settings = RenderSettings { spp: 1, depth: 3, ..Default::default() };
    let mean = |s: &Scene| Reference::new(s, &[]).render_camera(&from_below, &settings).mean[0][0];
    assert_eq!(mean(&s), 0.0);
    s.materials[0].double_sided = true;
    assert!((mean(&s) - 1.0).abs() < 1e-12);
    s.materials[0].emissive = Vec3::splat(2.0);
    assert!((mean(&s) - 3.0).abs() < 1e-12);
    s.materials[0].double_sided = false;
    assert_eq!(mean(&s), 0.0);
}

#[test]
fn the_rig_lights_only_what_projector_and_eye_see() {
    // A floor, a real post, and a virtual wall between projector and floor that real light does not meet.
    let mut s = scene_of(floor(2.0, 0.0), diffuse(Vec3::ONE));
    add(&mut s, sphere(Vec3::new(0.0, 0.5, 0.0), 0.3, 2, true), diffuse(Vec3::ONE));
    add(&mut s, quad(Vec3::new(-5.0, 1.5, 5.0), Vec3::X * 10.0, Vec3::NEG_Z * 10.0), diffuse(Vec3::ONE));
    s.bodies[2].projected = false;
    s.environment = sky(1.0);
    let r = Reference::new(&s, &[]);
    let c = camera(32, 32, DVec3::new(0.0, 4.0, 0.0), DVec3::ZERO);
    let eye = DVec3::new(3.0, 2.5, 0.0);
    let image = r.render(&c, eye, &RenderSettings { spp: 1, depth: 2, ..Default::default() });
    let at = |x: f64, y: f64, z: f64| {
        let p = c.project(DVec3::new(x, y, z)).unwrap();
        p.y as usize * 32 + p.x as usize
    };
    // The sphere's top is lit, the floor on the eye's side too; the floor in the post's shadow from the eye is not.
    assert!(image.lit[at(0.05, 0.78, 0.05)] && image.lit[at(0.8, 0.0, 0.0)]);
    assert!(!image.lit[at(-0.6, 0.0, 0.0)]);
    // Seen from below the floor nothing is lit: the eye is on the other side.
    let image =
        r.render(&c, DVec3::new(0.0, -3.0, 0.0), &RenderSettings { spp: 1, depth: 2, ..Default::default() });
    assert!(image.lit.iter().all(|l| !l) && image.mean.iter().all(|p| *p == [0.0; 3]));
    // The virtual wall is there for all other light: under its black back the floor gets almost nothing.
    let open = {
        let mut s = s.clone();
        s.bodies.pop();
        Reference::new(&s, &[])
            .render(&c, eye, &RenderSettings { spp: 64, depth: 2, ..Default::default() })
            .mean_lit()[0]
    };
    let walled = r.render(&c, eye, &RenderSettings { spp: 64, depth: 2, ..Default::default() }).mean_lit()[0];
    assert!(open > 0.9 && walled < 0.3 * open, "{open} {walled}");
    let nan = r.render(&c, DVec3::NAN, &RenderSettings { spp: 1, depth: 2, ..Default::default() });
    assert!(nan.lit.iter().all(|l| !l));
}

fn small_scene(scale: f32, offset: Vec3) -> Scene {
    let at = |mut m: TriangleMesh| {
        m.positions.iter_mut().for_each(|p| *p = *p * scale + offset);
        m
    };
    let mut s = scene_of(at(floor(2.0, 0.0)), diffuse(Vec3::new(0.8, 0.5, 0.3)));
    let glossy = Material { roughness: 0.4, base_color: Vec3::new(0.9, 0.8, 0.4), ..Material::default() };
    add(&mut s, at(sphere(Vec3::new(0.0, 0.5, 0.0), 0.5, 2, true)), glossy);
    add(&mut s, at(quad(Vec3::new(-0.5, 2.0, -0.5), Vec3::X, Vec3::Z)), emitter(Vec3::splat(4.0)));
    s
}

/// Vertices that lie far off in the file, where a pose would carry them there without rounding: `tracer-far-from-origin`.
#[test]
fn the_place_of_a_mesh_in_its_file_does_not_matter() {
    let render = |scale: f64, offset: f64| {
        let offset = DVec3::new(offset, 0.0, -offset);
        let s = small_scene(scale as f32, offset.as_vec3());
        let at = |p: DVec3| p * scale + offset;
        let c = camera(16, 16, at(DVec3::new(0.5, 3.0, 1.5)), at(DVec3::new(0.0, 0.3, 0.0)));
        let settings = RenderSettings { spp: 32, depth: 3, ..Default::default() };
        Reference::new(&s, &[]).render(&c, at(DVec3::new(2.0, 2.3, 1.0)), &settings)
    };
    let base = render(1.0, 0.0);
    assert!(base.mean_lit()[0] > 0.1 && base.dropped_samples == 0);
    for (scale, offset) in [(1.0, 1000.0), (0.0078125, 1024.0)] {
        let other = render(scale, offset);
        // The same random numbers: but for rounding of the f32 vertices (1 km: 0.06 mm) the images are the same sample by sample.
        let squares = base.mean.iter().zip(&other.mean).map(|(a, b)| (a[0] - b[0]).powi(2));
        let rmse = (squares.sum::<f64>() / base.mean.len() as f64).sqrt();
        let mean = (base.mean_lit()[0] / other.mean_lit()[0] - 1.0).abs();
        assert!(rmse < 0.3 && mean < 3e-2, "scale {scale} offset {offset}: rmse {rmse} mean {mean}");
    }
}

#[test]
fn poses_move_bodies_and_their_lights() {
    let s = small_scene(1.0, Vec3::ZERO);
    let q = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.8, 1.2);
    let motion = DAffine3::from_rotation_translation(q, DVec3::new(0.4, -2.0, 1.0));
    let c = camera(12, 12, DVec3::new(0.5, 3.0, 1.5), DVec3::new(0.0, 0.3, 0.0));
    let mut moved = c;
    moved.world_from_projector = motion * c.world_from_projector;
    let eye = DVec3::new(2.0, 2.3, 1.0);
    let settings = RenderSettings { spp: 16, depth: 3, ..Default::default() };
    let still = Reference::new(&s, &[]).render(&c, eye, &settings);
    let turned = Reference::new(&s, &[motion; 3]).render(&moved, motion.transform_point3(eye), &settings);
    assert_eq!(still.lit, turned.lit);
    let difference = (still.mean_lit()[0] / turned.mean_lit()[0] - 1.0).abs();
    assert!(difference < 0.03, "{difference}");
}
