//! The table of passes against the shaders' own SPIR-V, and the bytes that it says a pixel moves.

use super::*;
use bytemuck::Zeroable;
use dpm_shaders::structs::{members_of, BINDINGS, PARTS, TREE_BINDING};
use std::collections::{BTreeSet, HashMap};

const READINGS: [Reading; 3] = [Reading::Texels, Reading::Storage, Reading::Query];

/// Buffers that no pass writes. The host fills them, at the start or before a frame.
const INPUTS: [&str; 19] = [
    "B_FRAME",
    "B_COARSE_FRAME",
    "B_INSTANCES",
    "B_BODY_NODES",
    "B_NODES",
    "B_TRIANGLES",
    "B_TRIANGLE_REFS",
    "B_VERTICES",
    "B_MATERIALS",
    "B_TEXTURES",
    "B_TEXELS",
    "B_LIGHTS",
    "B_ENVIRONMENT",
    "B_ALBEDO",
    "B_TILES",
    "B_NOISE",
    "B_OPTICS",
    "B_MOVERS",
    "B_PLANE_GROUPS",
];

/// Names of the buffers, or of their parts, that a shader loads from and stores to, as its SPIR-V says: every pointer is followed back to the
/// variable that it was made from, and a part is told by the types of an element's members. Inputs are left out; a second binding of a buffer
/// as texels counts as the buffer.
fn loads_and_stores(shader: &Shader) -> [BTreeSet<String>; 2] {
    let words: Vec<u32> =
        shader.spirv.chunks_exact(4).map(|w| u32::from_le_bytes(w.try_into().unwrap())).collect();
    let (mut binding, mut origin, mut type_of) = (HashMap::new(), HashMap::new(), HashMap::new());
    // What types consist of: "f" and "u" for numbers, what they point at or hold for the others.
    let mut types: HashMap<u32, String> = HashMap::new();
    let mut touched = [BTreeSet::new(), BTreeSet::new()];
    let mut at = 5;
    while at < words.len() {
        let (length, op) = ((words[at] >> 16) as usize, words[at] & 0xffff);
        let a = &words[at + 1..at + length];
        let mut touch = |pointer: u32, load: bool, store: bool| {
            if let Some(&variable) = origin.get(&pointer) {
                if load {
                    touched[0].insert(variable);
                }
                if store {
                    touched[1].insert(variable);
                }
            }
        };
        match op {
            // OpDecorate Binding, OpVariable, then OpLoad, OpStore and atomics.
            71 if a[1] == 33 => drop(binding.insert(a[0], a[2])),
            61 => touch(a[2], true, false),
            62 => touch(a[0], false, true),
            228 => touch(a[0], false, true),
            227 => touch(a[2], true, false),
            229..=242 => touch(a[2], true, true),
            57 => {
                assert!(!a[3..].iter().any(|p| origin.contains_key(p)), "a pointer is passed to a function")
            }
            _ => {}
        }
        let of = |t: &u32| types.get(t).cloned().unwrap_or_default();
        match op {
            59 => {
                origin.insert(a[1], a[1]);
                type_of.insert(a[1], a[0]);
            }
            // Access chains and copies.
            65 | 66 | 83 => {
                if let Some(&variable) = origin.get(&a[2]) {
                    origin.insert(a[1], variable);
                }
            }
            // OpTypeInt, OpTypeFloat, OpTypeVector, OpTypeArray, OpTypeRuntimeArray, OpTypeStruct, OpTypePointer.
            21 => drop(types.insert(a[0], if a[2] == 1 { "i" } else { "u" }.to_owned())),
            22 => drop(types.insert(a[0], "f".to_owned())),
            23 => drop(types.insert(a[0], of(&a[1]).repeat(a[2] as usize))),
            28 | 29 => drop(types.insert(a[0], of(&a[1]))),
            30 => drop(types.insert(a[0], a[1..].iter().map(of).collect::<Vec<_>>().join(","))),
            32 => drop(types.insert(a[0], of(&a[2]))),
            _ => {}
        }
        at += length;
    }
    touched.map(|variables| {
        variables
            .into_iter()
            .filter_map(|v| binding.get(&v).map(|b| (v, *b)))
            // The tree over the bodies is no buffer.
            .filter(|(_, b)| *b != TREE_BINDING.1)
            .map(|(v, b)| {
                let name = BINDINGS.iter().find(|(_, known)| *known == b).expect("a known binding").0;
                let name = match name {
                    "B_SURFACE_ROWS" => "B_SURFACES",
                    "B_GUIDE_ROWS" => "B_GUIDES",
                    "B_HISTORY_ROWS" => "B_HISTORY",
                    "B_FILTERED_ROWS" => "B_FILTERED",
                    "B_COARSE_LIGHT_ROWS" => "B_COARSE_LIGHT",
                    name => name,
                };
                let members = &types[&type_of[&v]];
                let part = PARTS.iter().find(|p| p.binding == name && members_of(p.element) == *members);
                part.map_or(name.to_owned(), |part| format!("{name}.{}", part.name))
            })
            .filter(|name| !INPUTS.contains(&name.as_str()))
            .collect()
    })
}

/// The shaders that each of the methods may run, in their order.
fn kernels(is_dpm: bool) -> impl Iterator<Item = (&'static str, &'static PassKernel)> {
    static PASSES: [Pass; TABLE.len()] = TABLE;
    PASSES.iter().map(move |pass| (pass.name, pass.code.kernel(is_dpm)))
}

#[test]
fn every_row_says_what_its_shader_reads_and_writes() {
    for (_, kernel) in kernels(true).chain(kernels(false)) {
        for reading in READINGS {
            let shader = (kernel.shader)(reading);
            // Of an image nobody sees which part of a buffer it reads.
            let name = |name: &str| match reading {
                Reading::Texels => name.split('.').next().unwrap_or(name).to_owned(),
                _ => name.to_owned(),
            };
            let names = |names: &[&str]| -> BTreeSet<String> { names.iter().map(|n| name(n)).collect() };
            let touched = loads_and_stores(&shader).map(|all| all.iter().map(|n| name(n)).collect());
            let [loads, stores]: [BTreeSet<String>; 2] = touched;
            let seldom = names(kernel.seldom);
            for (listed, found) in [(names(kernel.reads), &loads), (names(kernel.writes), &stores)] {
                let not_told: Vec<_> = found.difference(&(&listed | &seldom)).cloned().collect();
                let not_done: Vec<_> = listed.difference(found).collect();
                assert!(
                    not_told.is_empty() && not_done.is_empty(),
                    "{}: {not_told:?}, {not_done:?}",
                    shader.name
                );
            }
            let never: Vec<_> = seldom.difference(&(&loads | &stores)).cloned().collect();
            assert!(never.is_empty(), "{}: {never:?}", shader.name);
        }
    }
}

/// What a pass reads was written by a pass before it in this frame, is cleared or filled before the first, or is kept from the frame before.
#[test]
fn nothing_is_read_before_it_is_written() {
    let kept = ["B_COUNTERS", "B_SCHEDULE", "B_RATES"];
    for is_dpm in [true, false] {
        let mut written: BTreeSet<&str> = kept.into();
        // Method dpm decides shading rates only to measure what leaving them out saves, and its filter compensates itself.
        let is_run = |pass: &str| !is_dpm || !["rate map", "compensate"].contains(&pass);
        for (pass, kernel) in kernels(is_dpm).filter(|(pass, _)| is_run(pass)) {
            // Under this name the pass `enlarge` reads what others have written of the traced pixels. Where it runs, the filter of method dpm keeps its
            // light, which it seldom does.
            let written_as = |name: &'static str| match name {
                "B_COARSE_SURFACES.hit" => "B_SURFACES.hit",
                "B_SHOWN" if is_dpm => "B_CODES",
                name => name,
            };
            for name in kernel.reads.iter().map(|name| written_as(name)) {
                // The history's pass is left out together with all that read what it writes.
                assert!(written.contains(&name) || name.starts_with("B_FORMER"), "{pass} reads {name}");
            }
            written.extend(kernel.writes);
        }
    }
}

/// What the next frame reads or writes meanwhile, no pass that overlaps with it writes. These are the buffers of which a renderer has one for all
/// frames, but for the history that such passes read: a frame that would write it waits.
#[test]
fn passes_that_overlap_with_the_next_frame_end_a_frame_and_keep_away_from_what_it_uses() {
    assert!(TABLE[FIRST_PASSES..].iter().all(|pass| pass.overlaps));
    for (pass, kernel) in kernels(true).chain(kernels(false)) {
        let overlaps = TABLE.iter().any(|row| row.name == pass && row.overlaps);
        for name in ["B_HISTORY", "B_FORMER", "B_RATES"] {
            let is_in = |names: &[&str]| names.iter().any(|n| n.split('.').next() == Some(name));
            assert!(!overlaps || !is_in(kernel.writes) && !is_in(kernel.seldom), "{pass} writes {name}");
            assert!(!overlaps || name == "B_HISTORY" || !is_in(kernel.reads), "{pass} reads {name}");
        }
    }
}

/// A shader that no method runs would be dead, and one that a row names twice is likely a slip.
#[test]
fn every_shader_belongs_to_one_pass() {
    let mut named = Vec::new();
    for pass in &TABLE {
        named.push(pass.code.kernel(true));
        if let Code::ByMethod { others, .. } = &pass.code {
            named.push(others);
        }
    }
    let names = |reading| named.iter().map(move |kernel| (kernel.shader)(reading).name);
    let mut found: Vec<_> = READINGS.into_iter().flat_map(names).collect();
    found.extend(shaders::TRACE_APART.map(|shader| shader.name));
    found.extend(READINGS.map(|reading| shaders::WALK.reading(reading).name));
    found.sort_unstable();
    found.dedup();
    let mut all: Vec<_> = shaders::ALL.iter().map(|shader| shader.name).collect();
    all.sort_unstable();
    assert_eq!(found, all);
}

/// The demo's settings by a method, with 24 planes made on the GPU.
fn settings_of(method: Method) -> RendererSettings {
    let raster = dpm_device::planes::Raster::new(64, 48).expect("a small raster");
    RendererSettings {
        raster,
        scale: crate::Scale::WHOLE,
        depth: 3,
        seed: 1,
        clamp_indirect: None,
        drive: crate::drive::Drive::even(1.0),
        lens: None,
        camera_is_eye: false,
        leave_nothing_out: false,
        method,
        halftone: None,
        plane_groups: Vec::new(),
        output: crate::Output::Planes(dpm_device::planes::PlaneSchedule::rgb24()),
        overlap: crate::Overlapping::Never,
        most_live_texels: usize::MAX,
        tracing: crate::Tracing::Auto,
    }
}

/// A table of the bandwidth that a frame takes. It may only fall: whoever makes an element larger sees here what that costs in every pass.
#[test]
fn a_pixel_moves_no_more_bytes_than_it_did() {
    let dpm = Method {
        dpm: true,
        temporal: true,
        spatial: true,
        rate_map: true,
        sampler: crate::method::SamplerKind::Continued,
        ..Method::full(2)
    };
    let moved_by = |settings: &RendererSettings| -> Vec<(&str, f64)> {
        traffic(settings, Keep::default()).iter().map(|t| (t.pass, t.read + t.written)).collect()
    };
    let moved = |method| moved_by(&settings_of(method));
    let expected = [
        ("primary", 32.0),
        ("reproject", 160.0),
        ("schedule", 16.0),
        ("trace", 52.0),
        ("accumulate", 116.0),
        ("spatial", 76.0),
        ("pack", 7.0),
    ];
    assert_eq!(moved(dpm.clone()), expected);
    let planes_follow = RendererSettings { plane_groups: vec![Zeroable::zeroed()], ..settings_of(dpm) };
    let all: Vec<_> = moved_by(&planes_follow).into_iter().filter(|pass| !expected.contains(pass)).collect();
    assert_eq!(all, [("motion", 24.0), ("warp", 16.0)]);
    let sum = |passes: &[(&str, f64)]| passes.iter().map(|(_, bytes)| bytes).sum::<f64>();
    assert!(sum(&expected) + sum(&all) < 500.0);
    // Without a history nothing but the surface, the work list, the radiance and the code values moves.
    let expected =
        [("primary", 16.0), ("schedule", 32.0), ("trace", 40.0), ("compensate", 36.0), ("pack", 7.0)];
    assert_eq!(moved(Method::full(2)), expected);
}
