//! The passes of a frame, one row each: what runs, when, over what, and the buffers that it reads and writes.

use super::memory::BytesPerPixel;
use super::method::Method;
use super::scene_data::Keep;
use super::settings::RendererSettings;
use crate::pack;
use dpm_shaders as shaders;
use dpm_shaders::{specialization as ids, Reading, Shader};

/// One pass of a frame.
pub(super) struct Pass {
    /// Name in reports.
    pub name: &'static str,
    /// The shader that runs.
    pub code: Code,
    /// Whether the pass is recorded: a pass that the method does not need is not.
    pub when: fn(&RendererSettings, Keep) -> bool,
    /// How many workgroups run.
    pub grid: Grid,
    /// Its rays walk through the scene.
    pub walks: bool,
    /// The next frame may begin meanwhile: it needs nothing that this pass writes, and writes nothing that it reads.
    pub overlaps: bool,
}

/// The shader of a pass.
pub(super) enum Code {
    /// Every method runs this one.
    OfAll(Kernel),
    /// Method `dpm` has its own.
    ByMethod {
        /// The shader of method `dpm`.
        dpm: Kernel,
        /// The shader of the methods of others.
        others: Kernel,
    },
}

/// A shader with the buffers that it uses.
pub(super) struct Kernel {
    /// The shader that reads in this way.
    pub shader: fn(Reading) -> Shader,
    /// Buffers, or their parts, that an earlier pass of this frame, or the frame before, has written and that this shader reads. Inputs that no pass writes
    /// are not listed: the frame's constants, the tiles, the scene, the noise and the table of rates.
    pub reads: &'static [&'static str],
    /// Buffers that this shader writes.
    pub writes: &'static [&'static str],
    /// What it touches only by other methods, or if the host reads everything. It is not counted.
    #[cfg_attr(not(test), expect(dead_code, reason = "documentation that a test checks"))]
    pub seldom: &'static [&'static str],
}

/// How many workgroups of a pass run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Grid {
    /// Four for each listed tile.
    Tiles,
    /// One for each listed tile, in frames that decide rates.
    Rates,
    /// Four for each listed tile on which the light of a moving body can fall.
    Moving,
    /// As many as the pass `schedule` asked for.
    Work,
    /// All of the bit planes.
    Planes,
}

/// Every pass, in the order in which they run. Between two of them lies a barrier.
pub(super) const TABLE: [Pass; 12] = [
    Pass {
        name: "primary",
        code: Code::ByMethod {
            dpm: Kernel {
                shader: |reading| shaders::PRIMARY.reading(reading),
                reads: &["B_COUNTERS", "B_FORMER.tag"],
                writes: &["B_SURFACES", "B_COUNTERS", "B_GUIDES.tint"],
                seldom: &["B_GUIDES.sight"],
            },
            others: Kernel {
                shader: |reading| shaders::PRIMARY.reading(reading),
                reads: &["B_COUNTERS"],
                writes: &["B_SURFACES", "B_COUNTERS", "B_GUIDES.sight"],
                seldom: &["B_GUIDES.tint", "B_FORMER.tag"],
            },
        },
        when: |_, _| true,
        grid: Grid::Tiles,
        walks: true,
        overlaps: false,
    },
    Pass {
        name: "reproject",
        code: Code::ByMethod {
            dpm: Kernel {
                shader: |reading| shaders::REPROJECT_POINT.reading(reading),
                reads: &[
                    "B_SURFACES",
                    "B_GUIDES.tint",
                    "B_SCHEDULE",
                    "B_FORMER.light",
                    "B_FORMER.place",
                    "B_FORMER.noise",
                    "B_FORMER.tag",
                ],
                writes: &[
                    "B_HISTORY.light",
                    "B_HISTORY.place",
                    "B_HISTORY.noise",
                    "B_HISTORY.tag",
                    "B_SCHEDULE",
                    "B_FILTERED",
                    "B_GUIDES.demand",
                ],
                seldom: &[],
            },
            others: Kernel {
                shader: |reading| shaders::REPROJECT_BILINEAR.reading(reading),
                reads: &["B_SURFACES", "B_FORMER.light", "B_FORMER.place", "B_FORMER.tag"],
                writes: &["B_HISTORY.light", "B_HISTORY.place", "B_HISTORY.tag"],
                seldom: &[],
            },
        },
        when: |s, _| s.method.needs_history(),
        grid: Grid::Tiles,
        walks: false,
        overlaps: false,
    },
    Pass {
        name: "rate map",
        code: Code::OfAll(Kernel {
            shader: |reading| shaders::RATE_MAP.reading(reading),
            reads: &["B_SURFACES", "B_GUIDES.sight", "B_HISTORY.light"],
            writes: &["B_RATES"],
            seldom: &[],
        }),
        when: |s, keep| s.method.needs_rates() || keep.rate_map && s.method.needs_history(),
        grid: Grid::Rates,
        walks: false,
        overlaps: false,
    },
    Pass {
        name: "schedule",
        code: Code::ByMethod {
            dpm: Kernel {
                shader: |reading| shaders::SCHEDULE_BUDGET.reading(reading),
                reads: &["B_GUIDES.demand", "B_SCHEDULE"],
                writes: &["B_GUIDES.demand", "B_SCHEDULE", "B_WORK"],
                seldom: &["B_SURFACES", "B_RADIANCE"],
            },
            others: Kernel {
                shader: |reading| shaders::SCHEDULE_BLOCKS.reading(reading),
                reads: &["B_SURFACES", "B_GUIDES.sight", "B_RATES", "B_SCHEDULE"],
                writes: &["B_RADIANCE", "B_SCHEDULE", "B_WORK"],
                seldom: &[],
            },
        },
        when: |_, _| true,
        grid: Grid::Tiles,
        walks: false,
        overlaps: false,
    },
    Pass {
        name: "trace",
        code: Code::ByMethod {
            dpm: Kernel {
                shader: |reading| shaders::TRACE.reading(reading),
                reads: &["B_SURFACES", "B_COUNTERS", "B_HISTORY.tag", "B_SCHEDULE", "B_WORK"],
                writes: &["B_RADIANCE", "B_COUNTERS", "B_GUIDES.demand"],
                seldom: &[],
            },
            others: Kernel {
                shader: |reading| shaders::TRACE.reading(reading),
                reads: &["B_SURFACES", "B_COUNTERS", "B_SCHEDULE", "B_WORK"],
                writes: &["B_RADIANCE", "B_COUNTERS"],
                seldom: &["B_HISTORY.tag", "B_GUIDES.demand"],
            },
        },
        when: |_, _| true,
        grid: Grid::Work,
        walks: true,
        overlaps: false,
    },
    Pass {
        name: "accumulate",
        code: Code::ByMethod {
            dpm: Kernel {
                shader: |reading| shaders::ACCUMULATE_SAMPLES.reading(reading),
                reads: &[
                    "B_RADIANCE",
                    "B_GUIDES.tint",
                    "B_GUIDES.demand",
                    "B_HISTORY.light",
                    "B_HISTORY.noise",
                    "B_FILTERED",
                ],
                writes: &["B_HISTORY.light", "B_HISTORY.noise", "B_FILTERED"],
                seldom: &[],
            },
            others: Kernel {
                shader: |reading| shaders::ACCUMULATE_FRAMES.reading(reading),
                reads: &["B_SURFACES", "B_RADIANCE", "B_GUIDES.sight", "B_HISTORY.light", "B_RATES"],
                writes: &["B_HISTORY.light", "B_FILTERED"],
                seldom: &[],
            },
        },
        when: |s, _| s.method.needs_history(),
        grid: Grid::Tiles,
        walks: false,
        overlaps: false,
    },
    Pass {
        // By method dpm with the pass `compensate` at its end.
        name: "spatial",
        code: Code::ByMethod {
            dpm: Kernel {
                shader: |reading| shaders::SPATIAL_REGRESSION.reading(reading),
                reads: &[
                    "B_SURFACES",
                    "B_COUNTERS",
                    "B_GUIDES.tint",
                    "B_HISTORY.place",
                    "B_HISTORY.noise",
                    "B_FILTERED",
                ],
                writes: &["B_CODES", "B_COUNTERS"],
                seldom: &["B_SHOWN"],
            },
            others: Kernel {
                shader: |reading| shaders::SPATIAL_DISK.reading(reading),
                reads: &["B_SURFACES", "B_GUIDES.sight", "B_HISTORY.place", "B_FILTERED"],
                writes: &["B_SHOWN"],
                seldom: &[],
            },
        },
        when: |s, _| s.method.needs_spatial(),
        grid: Grid::Tiles,
        walks: false,
        overlaps: true,
    },
    Pass {
        name: "compensate",
        code: Code::OfAll(Kernel {
            shader: |reading| shaders::COMPENSATE.reading(reading),
            reads: &["B_SURFACES", "B_COUNTERS", "B_SHOWN"],
            writes: &["B_CODES", "B_COUNTERS"],
            seldom: &[],
        }),
        when: |s, _| !s.method.dpm,
        grid: Grid::Tiles,
        walks: false,
        overlaps: true,
    },
    Pass {
        name: "halftone",
        code: Code::OfAll(Kernel {
            shader: |reading| shaders::HALFTONE.reading(reading),
            reads: &["B_SURFACES", "B_CODES"],
            writes: &["B_CODES"],
            seldom: &[],
        }),
        when: |s, _| s.halftone.is_some(),
        grid: Grid::Tiles,
        walks: false,
        overlaps: true,
    },
    Pass {
        name: "motion",
        code: Code::OfAll(Kernel {
            shader: |reading| shaders::MOTION.reading(reading),
            reads: &["B_SURFACES", "B_CODES"],
            writes: &["B_MOTION"],
            seldom: &[],
        }),
        when: |s, _| !s.plane_groups.is_empty(),
        grid: Grid::Moving,
        walks: false,
        overlaps: true,
    },
    Pass {
        name: "warp",
        code: Code::OfAll(Kernel {
            shader: |reading| shaders::WARP.reading(reading),
            reads: &["B_MOTION"],
            writes: &["B_CODES"],
            seldom: &[],
        }),
        when: |s, _| !s.plane_groups.is_empty(),
        grid: Grid::Moving,
        walks: false,
        overlaps: true,
    },
    Pass {
        name: "pack",
        code: Code::OfAll(Kernel {
            shader: |_| shaders::PACK,
            reads: &["B_CODES"],
            writes: &["B_PLANES"],
            seldom: &[],
        }),
        when: |s, _| s.output.schedule().is_some(),
        grid: Grid::Planes,
        walks: false,
        overlaps: true,
    },
];

/// Passes before those that overlap with the next frame. They end a frame: none of the others comes after them.
pub(super) const FIRST_PASSES: usize = {
    let mut i = 0;
    while !TABLE[i].overlaps {
        i += 1;
    }
    i
};

/// Names of the passes whose ends have time stamps, in order. The last one copies what the host reads.
pub const PASSES: &[&str] = &{
    let mut names = ["readback"; TABLE.len() + 1];
    let mut i = 0;
    while i < TABLE.len() {
        names[i] = TABLE[i].name;
        i += 1;
    }
    names
};

impl Code {
    /// What method `dpm` runs, or the methods of others.
    fn kernel(&self, is_dpm: bool) -> &Kernel {
        match self {
            Self::OfAll(kernel) => kernel,
            Self::ByMethod { dpm, others } => {
                if is_dpm {
                    dpm
                } else {
                    others
                }
            }
        }
    }
}

impl Pass {
    /// The shader of a method that reads in this way.
    pub(super) fn shader(&self, method: &Method, reading: Reading) -> Shader {
        (self.code.kernel(method.dpm).shader)(reading)
    }

    /// Specialization constants. Passes that read the scene have the `shared` ones and those of halftones; packing has its own.
    pub(super) fn constants(&self, shared: &[(u32, u32)], settings: &RendererSettings) -> Vec<(u32, u32)> {
        match (self.grid, settings.output.schedule()) {
            (Grid::Planes, Some(schedule)) => pack::gpu::constants(settings.raster, schedule).to_vec(),
            _ => {
                let halftone = settings.halftone.into_iter().flat_map(pack::Halftone::constants);
                let whole_words = (ids::WARP_WHOLE_WORDS, u32::from(settings.shows_halftones()));
                shared.iter().copied().chain(halftone).chain([whole_words]).collect()
            }
        }
    }
}

/// Bytes that a pass moves between memory and shaders for each pixel that it works on: every buffer that it touches, once, by the whole element.
/// A driver may read less of an element, and a cache may serve what was touched before.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Traffic {
    /// Name of the pass.
    pub pass: &'static str,
    /// Bytes read.
    pub read: f64,
    /// Bytes written.
    pub written: f64,
}

/// What each recorded pass moves for each pixel, in the order in which they run. What the whole frame has one of (constants, poses, scene, tables) is not
/// counted.
pub fn traffic(settings: &RendererSettings, keep: Keep) -> Vec<Traffic> {
    let each = BytesPerPixel::of(&settings.method).and_planes_follow(!settings.plane_groups.is_empty());
    let planes = settings.output.schedule().map_or(0.0, |schedule| schedule.planes().len() as f64 / 8.0);
    let bytes = |names: &[&str]| names.iter().map(|name| each.of_buffer(name).unwrap_or(planes)).sum();
    let recorded = TABLE.iter().filter(|pass| (pass.when)(settings, keep));
    recorded
        .map(|pass| {
            let kernel = pass.code.kernel(settings.method.dpm);
            Traffic { pass: pass.name, read: bytes(kernel.reads), written: bytes(kernel.writes) }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_shaders::structs::{members_of, BINDINGS, PARTS, TREE_BINDING};
    use std::collections::{BTreeSet, HashMap};

    const READINGS: [Reading; 3] = [Reading::Texels, Reading::Storage, Reading::Query];

    /// Buffers that no pass writes. The host fills them, at the start or before a frame.
    const INPUTS: [&str; 18] = [
        "B_FRAME",
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
                57 => assert!(
                    !a[3..].iter().any(|p| origin.contains_key(p)),
                    "a pointer is passed to a function"
                ),
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
                21 => drop(types.insert(a[0], "u".to_owned())),
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
                        "B_GUIDE_ROWS" | "B_GUIDE_WORDS_ROWS" => "B_GUIDES",
                        "B_HISTORY_ROWS" => "B_HISTORY",
                        "B_FILTERED_ROWS" => "B_FILTERED",
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
    fn kernels(is_dpm: bool) -> impl Iterator<Item = (&'static str, &'static Kernel)> {
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
            for (pass, kernel) in kernels(is_dpm) {
                for name in kernel.reads {
                    // The history's pass is left out together with all that read what it writes.
                    assert!(written.contains(name) || name.starts_with("B_FORMER"), "{pass} reads {name}");
                }
                written.extend(kernel.writes);
                // What the pass of shading rates reads, which method dpm runs only to measure what leaving it out saves.
                written.extend(kernel.seldom);
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
        let moved = |method| -> Vec<(&str, f64)> {
            let all = traffic(&settings_of(method), Keep::default());
            all.iter().map(|t| (t.pass, t.read + t.written)).collect()
        };
        let expected = [
            ("primary", 40.0),
            ("reproject", 172.0),
            ("schedule", 16.0),
            ("trace", 60.0),
            ("accumulate", 124.0),
            ("spatial", 76.0),
            ("pack", 7.0),
        ];
        assert_eq!(moved(dpm), expected);
        // Without a history nothing but the surface, the work list, the radiance and the code values moves.
        let expected =
            [("primary", 16.0), ("schedule", 40.0), ("trace", 40.0), ("compensate", 36.0), ("pack", 7.0)];
        assert_eq!(moved(Method::full(2)), expected);
    }
}
