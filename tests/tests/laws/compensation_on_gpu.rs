//! Compares the compensation shader with its CPU twin, bit for bit, for radiance and surfaces that no scene produces.

use bytemuck::Zeroable;
use dpm_lab::reference::Sampler;
use dpm_lab::twins::compensation::{interpolated, on_albedo, ray_of, real_cosine, Compensation};
use dpm_render::albedo_map::AlbedoMap;
use dpm_render::drive::Response;
use dpm_render::gpu::{
    shared_bindings, BindingSet, BindingTable, Buffer, CommandList, ComputePipeline, FrameFence, Gpu,
    MemoryKind,
};
use dpm_render::pack::{quantise, QuantiseCounts};
use dpm_render::scene_data::SceneNeeds;
use dpm_render::Surface;
use dpm_shaders::specialization as ids;
use dpm_shaders::structs::{
    is_of_software, Counters, Frame, Instance, Rows, TriangleRef, Vertex, BINDINGS, LENS_BROWN, LENS_NONE,
    NO_ALBEDO_MAP, NO_HIT,
};
use dpm_shaders::Reading;
use dpm_tests::gpu::with_gpu;
use std::mem::size_of;
use std::sync::Arc;

const WIDTH: u32 = 48;
const HEIGHT: u32 = 32;
const PIXELS: usize = (WIDTH * HEIGHT) as usize;

/// Everything that the shader reads.
struct Input {
    frame: Frame,
    instances: Vec<Instance>,
    refs: Vec<TriangleRef>,
    vertices: Vec<Vertex>,
    surfaces: Vec<Surface>,
    radiance: Vec<[f32; 4]>,
    optics: Optics,
}

/// What differs from pixel to pixel, if it does.
#[derive(Default)]
struct Optics {
    response: Option<Response>,
    flat_field: Option<Vec<[f32; 3]>>,
    straight: Option<Vec<[f32; 2]>>,
    /// Of each instance, or none.
    maps: Vec<Option<AlbedoMap>>,
}

impl Optics {
    /// The table that the shader reads, with the places of its parts written into `frame` and `instances`, and the constants that compile them in.
    fn table(&self, frame: &mut Frame, instances: &mut [Instance]) -> (Vec<f32>, [(u32, u32); 4]) {
        let mut table = vec![0.0; 4];
        if let Some(response) = &self.response {
            table = (0..3).flat_map(|c| *response.thresholds(c)).collect();
        }
        frame.flat_field_at = table.len() as u32;
        table.extend(self.flat_field.iter().flatten().flatten());
        frame.rays_at = table.len() as u32;
        table.extend(self.straight.iter().flatten().flatten());
        for (instance, map) in instances.iter_mut().zip(&self.maps) {
            let Some(map) = map else { continue };
            instance.albedo_map = table.len() as u32;
            table.extend([map.width() as f32, map.height() as f32]);
            table.extend(map.texels().iter().flatten());
        }
        let constants = [
            (ids::LENS, if self.straight.is_some() { LENS_BROWN } else { LENS_NONE }),
            (ids::HAS_RESPONSE, u32::from(self.response.is_some())),
            (ids::HAS_FLAT_FIELD, u32::from(self.flat_field.is_some())),
            (ids::HAS_ALBEDO_MAPS, u32::from(!self.maps.is_empty())),
        ];
        (table, constants)
    }
}

/// Runs the shader alone, in both ways in which it reads the scene, and checks that they agree.
fn on_gpu(gpu: &Arc<Gpu>, input: &Input) -> (Vec<u32>, Counters) {
    let [storage, texel] = [false, true].map(|texel| on_gpu_through(gpu, input, texel));
    assert!(storage.0 == texel.0, "codes depend on how the scene is read");
    assert_eq!(storage.1, texel.1);
    storage
}

/// Runs the shader alone. `texel`: the variant that reads the scene through texel buffers.
fn on_gpu_through(gpu: &Arc<Gpu>, input: &Input, texel: bool) -> (Vec<u32>, Counters) {
    let uploaded = |what: &str, bytes: &[u8]| {
        let mut buffer = Buffer::new(gpu, what, bytes.len(), MemoryKind::Upload).unwrap();
        buffer.bytes_mut()[..bytes.len()].copy_from_slice(bytes);
        buffer
    };
    let rows = |what: &str, bytes: &[u8]| {
        let mut buffer = Buffer::new_texels(gpu, what, bytes.len() / 16, false, MemoryKind::Upload).unwrap();
        buffer.bytes_mut()[..bytes.len()].copy_from_slice(bytes);
        buffer
    };
    let tiles: Vec<u32> = (0..WIDTH.div_ceil(16) * HEIGHT.div_ceil(16)).collect();
    let device = |what, bytes| Buffer::new(gpu, what, bytes, MemoryKind::Device).unwrap();
    let host = |what, bytes| Buffer::new(gpu, what, bytes, MemoryKind::Readback).unwrap();
    let unused = rows("unused", &[0; 16]);
    let (mut frame, mut instances) = (input.frame, input.instances.clone());
    let (optics, optics_constants) = input.optics.table(&mut frame, &mut instances);
    let frame = uploaded("frame", bytemuck::bytes_of(&frame));
    let optics = uploaded("optics", bytemuck::cast_slice(&optics));
    let instances = rows("instances", bytemuck::cast_slice(&instances));
    let refs = rows("refs", bytemuck::cast_slice(&input.refs));
    let vertices = rows("vertices", bytemuck::cast_slice(&input.vertices));
    let surfaces = rows("surfaces", &Surface::bytes_of(&input.surfaces));
    let radiance = uploaded("radiance", bytemuck::cast_slice(&input.radiance));
    let tile_list = uploaded("tiles", bytemuck::cast_slice(&tiles));
    let codes = device("codes", PIXELS * 4);
    let counters = device("counters", size_of::<Counters>());
    let codes_host = host("codes", PIXELS * 4);
    let counters_host = host("counters", size_of::<Counters>());
    let bound = || BINDINGS.iter().filter(|(name, _)| texel || !is_of_software(name));
    let reading = if texel { Reading::Texels } else { Reading::Storage };
    let table = BindingTable::new(gpu, &shared_bindings(reading, false)).unwrap();
    let mut constants = SceneNeeds::default().everything().constants();
    constants.extend(optics_constants);
    let shader = dpm_shaders::COMPENSATE.reading(reading);
    let pipeline = ComputePipeline::new(&table, shader, &constants).unwrap();
    let buffers: Vec<(u32, &Buffer)> = bound()
        .map(|&(name, binding)| {
            let buffer = match name {
                "B_FRAME" => &frame,
                "B_INSTANCES" => &instances,
                "B_TRIANGLE_REFS" => &refs,
                "B_VERTICES" => &vertices,
                "B_TILES" => &tile_list,
                "B_SURFACES" | "B_SURFACE_ROWS" => &surfaces,
                "B_SHOWN" => &radiance,
                "B_CODES" => &codes,
                "B_COUNTERS" => &counters,
                "B_OPTICS" => &optics,
                _ => &unused,
            };
            (binding, buffer)
        })
        .collect();
    let set = BindingSet::new(&table, &buffers).unwrap();
    let list = CommandList::record(gpu, 0, |r| {
        r.clear(&counters);
        r.barrier();
        r.dispatch(&pipeline, &set, [tiles.len() as u32 * 4, 1, 1]);
        r.barrier();
        r.copy(&codes, &codes_host, PIXELS * 4);
        r.copy(&counters, &counters_host, size_of::<Counters>());
        r.barrier_to_host();
    })
    .unwrap();
    let mut fence = FrameFence::new(gpu).unwrap();
    list.submit(&mut fence).unwrap();
    fence.wait(60_000_000_000).unwrap();
    (codes_host.read(PIXELS).to_vec(), counters_host.read::<Counters>(1)[0])
}

/// The same on the CPU.
fn twin(input: &Input) -> (Vec<u32>, QuantiseCounts, u32) {
    let mut lit = 0;
    let drive: Vec<[f32; 4]> = (0..PIXELS)
        .map(|i| {
            let s = &input.surfaces[i];
            if s.id == NO_HIT || s.distance.is_nan() || s.distance <= 0.0 {
                return [0.0; 4];
            }
            lit += 1;
            let body = (s.id >> 24) as usize;
            let instance = &input.instances[body];
            let corners = input.refs[(instance.triangle_offset + (s.id & 0xff_ffff)) as usize].vertices;
            let normals = corners.map(|v| input.vertices[v as usize].normal);
            let straight = input.optics.straight.as_ref().map(|rays| rays[i]);
            let ray = ray_of(&input.frame, [i as u32 % WIDTH, i as u32 / WIDTH], straight);
            let cos = real_cosine(&instance.world_from_object, normals, s.barycentric, &input.frame, ray);
            let [r, g, b, _] = input.radiance[i];
            let k = Compensation { gain: instance.drive_gain, ambient: input.frame.ambient };
            let mut drive = k.unlimited_drive([r, g, b], s.distance, cos);
            if let Some(Some(map)) = input.optics.maps.get(body) {
                let uvs = corners.map(|v| input.vertices[v as usize].uv);
                drive = on_albedo(drive, map.at(interpolated(uvs, s.barycentric)));
            }
            if let Some(flat_field) = &input.optics.flat_field {
                (0..3).for_each(|c| drive[c] *= flat_field[i][c]);
            }
            [drive[0], drive[1], drive[2], 0.0]
        })
        .collect();
    let mut codes = vec![0; PIXELS];
    let counts = quantise(&drive, None, &mut codes);
    if let Some(response) = &input.optics.response {
        for (code, drive) in codes.iter_mut().zip(&drive) {
            let [r, g, b] = [0, 1, 2].map(|c| u32::from(response.code_of(c, drive[c])));
            *code = r | g << 8 | b << 16;
        }
    }
    (codes, counts, lit)
}

/// The rows of a rotation about an axis, with a translation that must have no effect.
fn rows(random: &mut Sampler) -> Rows {
    let mut u = || random.uniform() as f32 * 2.0 - 1.0;
    let q = glam::Quat::from_xyzw(u(), u(), u(), u()).normalize();
    let m = glam::Mat3::from_quat(q).transpose().to_cols_array_2d();
    std::array::from_fn(|i| [m[i][0], m[i][1], m[i][2], u()])
}

fn random_input(seed: u64) -> Input {
    let mut random = Sampler::new(seed, 0);
    let world_from_projector = rows(&mut random);
    let instances: Vec<Instance> = (0..4)
        .map(|i| Instance {
            world_from_object: rows(&mut random),
            triangle_offset: i * 8,
            drive_gain: [0.3, 0.3 + 0.01 * i as f32, 0.3],
            albedo_map: NO_ALBEDO_MAP,
            ..Zeroable::zeroed()
        })
        .collect();
    let mut u = || random.uniform() as f32;
    let vertices: Vec<Vertex> = (0..96)
        .map(|_| {
            let n = glam::Vec3::new(u() - 0.5, u() - 0.5, u() - 0.5).normalize();
            Vertex { normal: n.into(), uv: [3.0 * u() - 1.0, 3.0 * u() - 1.0], ..Zeroable::zeroed() }
        })
        .collect();
    let refs = (0..32u32)
        .map(|t| TriangleRef { vertices: [3 * t, 3 * t + 1, 3 * t + 2], ..Zeroable::zeroed() })
        .collect();
    let surfaces = (0..PIXELS)
        .map(|_| {
            let id = if u() < 0.1 { NO_HIT } else { ((u() * 4.0) as u32) << 24 | (u() * 8.0) as u32 };
            let (a, b) = (u(), u());
            let sign = if u() < 0.1 { -1.0 } else { 1.0 };
            Surface { id, barycentric: [a * (1.0 - b), b], distance: sign * (0.1 + 3.0 * u()) }
        })
        .collect();
    let radiance = (0..PIXELS).map(|_| [u(), u(), u() * 0.1, 1.0]).collect();
    let frame = Frame {
        world_from_projector,
        intrinsics: [61.3, 60.7, 23.1, 17.9],
        width: WIDTH,
        height: HEIGHT,
        tiles_x: WIDTH.div_ceil(16),
        ambient: [0.05, 0.0, 0.01],
        ..Zeroable::zeroed()
    };
    Input { frame, instances, refs, vertices, surfaces, radiance, optics: Optics::default() }
}

fn assert_same(gpu: &Arc<Gpu>, input: &Input) -> Counters {
    let (codes, counters) = on_gpu(gpu, input);
    let (expected, counts, lit) = twin(input);
    let different: Vec<_> =
        (0..PIXELS).filter(|&i| codes[i] != expected[i]).map(|i| (i, codes[i], expected[i])).collect();
    if gpu.summary().software {
        assert!(
            different.is_empty(),
            "{} codes differ: {:x?}",
            different.len(),
            &different[..different.len().min(5)]
        );
        assert_eq!(u64::from(counters.clipped_values), counts.clipped);
    } else {
        // Real GPUs may round 1/x and the square root by an ulp or two. Then, in rare cases, a code may differ by
        // one.
        let near = |a: u32, b: u32| (0..3).all(|c| (a >> (8 * c) & 255).abs_diff(b >> (8 * c) & 255) <= 1);
        assert!(different.iter().all(|&(_, a, b)| near(a, b)) && different.len() < PIXELS / 100);
    }
    assert_eq!(counters.lit_pixels, lit);
    counters
}

/// Albedo maps of all bodies but the second: of one texel, and with sides that are no powers of two.
fn maps(u: &mut impl FnMut() -> f32) -> Vec<Option<AlbedoMap>> {
    let mut map = |width: u32, height: u32| {
        let texels = (0..width * height).map(|_| [0.02 + 0.9 * u(), 0.02 + 0.9 * u(), 0.3 + 0.7 * u()]);
        AlbedoMap::new(width, height, texels.collect())
    };
    vec![map(7, 5), None, map(1, 1), map(13, 2)]
}

/// Texture coordinates far beyond the picture, where a texel is all of f32's precision, must still be the twin's.
#[test]
fn texture_coordinates_far_outside_equal_the_twin() {
    with_gpu(|gpu| {
        let mut input = random_input(13);
        let mut random = Sampler::new(13, 9);
        input.optics.maps = maps(&mut || random.uniform() as f32);
        for (i, vertex) in input.vertices.iter_mut().enumerate() {
            let far = [1e3, -1e3, 1e7, -1e30, 0.0, -0.0][i % 6];
            vertex.uv = vertex.uv.map(|t| t * far);
        }
        assert_same(gpu, &input);
    });
}

#[test]
fn codes_equal_the_twin_bit_for_bit() {
    with_gpu(|gpu| {
        for seed in 0..8 {
            let input = random_input(seed);
            let (codes, _, lit) = twin(&input);
            // The comparison is meaningful: most lit pixels are neither black nor full.
            let between = codes.iter().filter(|&&c| c & 255 > 0 && c & 255 < 255).count();
            assert!(lit > 1000 && between > 500, "{lit} {between}");
            assert_same(gpu, &input);
        }
    });
}

#[test]
fn lens_response_flat_field_and_albedo_maps_equal_the_twin_bit_for_bit() {
    with_gpu(|gpu| {
        let plain = twin(&random_input(11)).0;
        for parts in 1..16u32 {
            let mut input = random_input(11);
            let mut random = Sampler::new(u64::from(parts), 9);
            let mut u = || random.uniform() as f32;
            input.optics = Optics {
                response: (parts & 1 > 0)
                    .then(|| Response::gamma([2.2, 1.0, 0.7], [0.01, 0.0, 0.002]).unwrap()),
                flat_field: (parts & 2 > 0)
                    .then(|| (0..PIXELS).map(|_| [1.0 + u(), 1.0 + u(), 1.0 + u()]).collect()),
                straight: (parts & 4 > 0).then(|| (0..PIXELS).map(|_| [u() - 0.5, u() - 0.5]).collect()),
                maps: if parts & 8 > 0 { maps(&mut u) } else { Vec::new() },
            };
            // What is no number must stay black behind each part as well.
            (0..PIXELS).step_by(17).for_each(|i| input.radiance[i][i % 3] = f32::NAN);
            let counters = assert_same(gpu, &input);
            assert!(counters.nan_values > 10, "{parts}");
            let different = twin(&input).0.iter().zip(&plain).filter(|(a, b)| a != b).count();
            assert!(different > PIXELS / 3, "part {parts} changes {different} codes");
        }
    });
}

#[test]
fn what_is_no_number_is_black_and_counted() {
    with_gpu(|gpu| {
        let mut input = random_input(3);
        for (i, r) in input.radiance.iter_mut().enumerate() {
            match i % 11 {
                0 => r[0] = f32::NAN,
                1 => r[1] = f32::INFINITY,
                2 => r[2] = f32::NEG_INFINITY,
                3 => r[0] = -1.0,
                4 => *r = [f32::from_bits(0xffc0_1234); 4],
                5 => *r = [1e38; 4],
                6 => *r = [1e-42; 4],
                _ => {}
            }
        }
        let counters = assert_same(gpu, &input);
        let lit = |i: &usize| input.surfaces[*i].is_lit();
        let count = |m: usize| (0..PIXELS).filter(|i| i % 11 == m).filter(lit).count() as u32;
        assert_eq!(counters.nan_values, count(0) + 3 * count(4));
        assert!(counters.nan_values > 300 && counters.clipped_values >= count(1) + 3 * count(5));
        let (codes, _) = on_gpu(gpu, &input);
        for i in (0..PIXELS).filter(lit) {
            match i % 11 {
                0 | 3 => assert_eq!(codes[i] & 0xff, 0),
                1 => assert_eq!(codes[i] >> 8 & 0xff, 255),
                2 => assert_eq!(codes[i] >> 16 & 0xff, 0),
                4 => assert_eq!(codes[i], 0),
                5 => assert_eq!(codes[i], 0xff_ffff),
                _ => {}
            }
        }
    });
}

#[test]
fn extreme_geometry_stays_defined() {
    with_gpu(|gpu| {
        let mut input = random_input(5);
        // Normals that cancel, grazing light, huge and tiny distances.
        for v in 0..6 {
            input.vertices[v].normal = if v % 2 == 0 { [0.0, 0.0, 1.0] } else { [0.0, 0.0, -1.0] };
        }
        input.vertices[9].normal = [0.0; 3];
        input.vertices[10].normal = [0.0; 3];
        input.vertices[11].normal = [0.0; 3];
        for (i, s) in input.surfaces.iter_mut().enumerate() {
            match i % 5 {
                0 => *s = Surface { id: i as u32 % 4, barycentric: [0.5, 0.0], distance: 1.0 },
                1 => s.distance *= 1e12,
                2 => s.distance *= 1e-12,
                _ => {}
            }
        }
        let counters = assert_same(gpu, &input);
        assert_eq!(counters.nan_values, 0);
    });
}

#[test]
fn ambient_is_taken_off_in_f32_and_never_below_zero() {
    with_gpu(|gpu| {
        let mut input = random_input(7);
        input.frame.ambient = [0.3, 0.5, 0.7];
        for (i, r) in input.radiance.iter_mut().enumerate() {
            // Equal to the ambient light, an ulp above and below.
            let ulp = |x: f32, k: i32| f32::from_bits((x.to_bits() as i32 + k) as u32);
            let k = i as i32 % 3 - 1;
            *r = [ulp(0.3, k), ulp(0.5, k), ulp(0.7, 1000 * k), 1.0];
        }
        assert_same(gpu, &input);
        let (codes, _) = on_gpu(gpu, &input);
        assert!((0..PIXELS).filter(|i| i % 3 < 2).all(|i| codes[i] == 0));
    });
}
