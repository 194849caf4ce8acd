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
    /// It works on the panel's own pixels, and not on those of the traced raster.
    pub at_panel: bool,
    /// The next frame may begin meanwhile: it needs nothing that this pass writes, and writes nothing that it reads.
    pub overlaps: bool,
}

/// The shader of a pass.
pub(super) enum Code {
    /// Every method runs this one.
    OfAll(PassKernel),
    /// Method `dpm` has its own.
    ByMethod {
        /// The shader of method `dpm`.
        dpm: PassKernel,
        /// The shader of the methods of others.
        others: PassKernel,
    },
}

/// A shader with the buffers that it uses.
pub(super) struct PassKernel {
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
    /// As many as an earlier pass asked for: `schedule` for the traced pixels, `cells` and `enlarge` for pixels of the panel.
    Work,
    /// For each tile of the panel as many lanes as it has cells.
    Cells,
    /// As many as the pass `cells` asked for.
    EvenCells,
    /// All of the bit planes.
    Planes,
}

/// Every pass, in the order in which they run. Between two of them lies a barrier.
pub(super) const TABLE: [Pass; 17] = [
    Pass {
        name: "primary",
        code: Code::ByMethod {
            dpm: PassKernel {
                shader: |reading| shaders::PRIMARY.reading(reading),
                reads: &["B_COUNTERS", "B_FORMER.tag"],
                writes: &["B_SURFACES.hit", "B_SURFACES.inside", "B_COUNTERS", "B_GUIDES.tint"],
                seldom: &["B_GUIDES.sight"],
            },
            others: PassKernel {
                shader: |reading| shaders::PRIMARY.reading(reading),
                reads: &["B_COUNTERS"],
                writes: &["B_SURFACES.hit", "B_SURFACES.inside", "B_COUNTERS", "B_GUIDES.sight"],
                seldom: &["B_GUIDES.tint", "B_FORMER.tag"],
            },
        },
        when: |_, _| true,
        grid: Grid::Tiles,
        walks: true,
        at_panel: false,
        overlaps: false,
    },
    Pass {
        name: "reproject",
        code: Code::ByMethod {
            dpm: PassKernel {
                shader: |reading| shaders::REPROJECT_POINT.reading(reading),
                reads: &[
                    "B_SURFACES.hit",
                    "B_SURFACES.inside",
                    "B_GUIDES.tint",
                    "B_SCHEDULE",
                    "B_FORMER.light",
                    "B_FORMER.place",
                    "B_FORMER.noise",
                    "B_FORMER.tag",
                    "B_FORMER.seed",
                ],
                writes: &[
                    "B_HISTORY.light",
                    "B_HISTORY.place",
                    "B_HISTORY.noise",
                    "B_HISTORY.tag",
                    "B_HISTORY.seed",
                    "B_HISTORY.used",
                    "B_SCHEDULE",
                    "B_GUIDES.shift",
                    "B_GUIDES.demand",
                ],
                seldom: &[],
            },
            others: PassKernel {
                shader: |reading| shaders::REPROJECT_BILINEAR.reading(reading),
                reads: &[
                    "B_SURFACES.hit",
                    "B_SURFACES.inside",
                    "B_FORMER.light",
                    "B_FORMER.place",
                    "B_FORMER.tag",
                    "B_FORMER.seed",
                ],
                writes: &[
                    "B_HISTORY.light",
                    "B_HISTORY.place",
                    "B_HISTORY.tag",
                    "B_HISTORY.seed",
                    "B_HISTORY.used",
                ],
                seldom: &[],
            },
        },
        when: |s, _| s.method.needs_history(),
        grid: Grid::Tiles,
        walks: false,
        at_panel: false,
        overlaps: false,
    },
    Pass {
        name: "rate map",
        code: Code::OfAll(PassKernel {
            shader: |reading| shaders::RATE_MAP.reading(reading),
            reads: &["B_SURFACES.hit", "B_GUIDES.sight", "B_HISTORY.light"],
            writes: &["B_RATES"],
            seldom: &[],
        }),
        when: |s, keep| s.method.needs_rates() || keep.rate_map && s.method.needs_history(),
        grid: Grid::Rates,
        walks: false,
        at_panel: false,
        overlaps: false,
    },
    Pass {
        name: "schedule",
        code: Code::ByMethod {
            dpm: PassKernel {
                shader: |reading| shaders::SCHEDULE_BUDGET.reading(reading),
                reads: &["B_GUIDES.demand", "B_SCHEDULE"],
                writes: &["B_GUIDES.demand", "B_SCHEDULE", "B_WORK"],
                seldom: &["B_SURFACES.hit", "B_RADIANCE"],
            },
            others: PassKernel {
                shader: |reading| shaders::SCHEDULE_BLOCKS.reading(reading),
                reads: &["B_SURFACES.hit", "B_GUIDES.sight", "B_RATES", "B_SCHEDULE"],
                writes: &["B_RADIANCE", "B_SCHEDULE", "B_WORK"],
                seldom: &[],
            },
        },
        when: |_, _| true,
        grid: Grid::Tiles,
        walks: false,
        at_panel: false,
        overlaps: false,
    },
    Pass {
        name: "trace",
        code: Code::ByMethod {
            dpm: PassKernel {
                shader: |reading| shaders::TRACE.reading(reading),
                reads: &[
                    "B_SURFACES.hit",
                    "B_SURFACES.inside",
                    "B_COUNTERS",
                    "B_HISTORY.seed",
                    "B_HISTORY.used",
                    "B_SCHEDULE",
                    "B_WORK",
                ],
                writes: &["B_RADIANCE", "B_COUNTERS", "B_GUIDES.demand"],
                seldom: &[],
            },
            others: PassKernel {
                shader: |reading| shaders::TRACE.reading(reading),
                reads: &["B_SURFACES.hit", "B_SURFACES.inside", "B_COUNTERS", "B_SCHEDULE", "B_WORK"],
                writes: &["B_RADIANCE", "B_COUNTERS"],
                seldom: &["B_HISTORY.seed", "B_HISTORY.used", "B_GUIDES.demand"],
            },
        },
        when: |_, _| true,
        grid: Grid::Work,
        walks: true,
        at_panel: false,
        overlaps: false,
    },
    Pass {
        name: "accumulate",
        code: Code::ByMethod {
            dpm: PassKernel {
                shader: |reading| shaders::ACCUMULATE_SAMPLES.reading(reading),
                reads: &[
                    "B_RADIANCE",
                    "B_GUIDES.tint",
                    "B_GUIDES.demand",
                    "B_HISTORY.light",
                    "B_HISTORY.noise",
                    "B_GUIDES.shift",
                ],
                writes: &["B_HISTORY.light", "B_HISTORY.noise", "B_FILTERED"],
                seldom: &[],
            },
            others: PassKernel {
                shader: |reading| shaders::ACCUMULATE_FRAMES.reading(reading),
                reads: &["B_SURFACES.hit", "B_RADIANCE", "B_GUIDES.sight", "B_HISTORY.light", "B_RATES"],
                writes: &["B_HISTORY.light", "B_FILTERED"],
                seldom: &[],
            },
        },
        when: |s, _| s.method.needs_history(),
        grid: Grid::Tiles,
        walks: false,
        at_panel: false,
        overlaps: false,
    },
    Pass {
        // By method dpm with the pass `compensate` at its end.
        name: "spatial",
        code: Code::ByMethod {
            dpm: PassKernel {
                shader: |reading| shaders::SPATIAL_REGRESSION.reading(reading),
                reads: &[
                    "B_SURFACES.hit",
                    "B_SURFACES.inside",
                    "B_COUNTERS",
                    "B_GUIDES.tint",
                    "B_HISTORY.place",
                    "B_HISTORY.noise",
                    "B_FILTERED",
                ],
                writes: &["B_CODES", "B_COUNTERS"],
                seldom: &["B_SHOWN"],
            },
            others: PassKernel {
                shader: |reading| shaders::SPATIAL_DISK.reading(reading),
                reads: &["B_SURFACES.hit", "B_GUIDES.sight", "B_HISTORY.place", "B_FILTERED"],
                writes: &["B_SHOWN"],
                seldom: &[],
            },
        },
        when: |s, _| s.method.needs_spatial(),
        grid: Grid::Tiles,
        walks: false,
        at_panel: false,
        overlaps: true,
    },
    Pass {
        name: "compensate",
        code: Code::OfAll(PassKernel {
            shader: |reading| shaders::COMPENSATE.reading(reading),
            reads: &["B_SURFACES.hit", "B_SURFACES.inside", "B_COUNTERS", "B_SHOWN"],
            writes: &["B_CODES", "B_COUNTERS"],
            seldom: &[],
        }),
        when: |s, _| !s.method.dpm && !s.is_reduced(),
        grid: Grid::Tiles,
        walks: false,
        at_panel: false,
        overlaps: true,
    },
    Pass {
        // This pass and the next three take the place of the pass `compensate`, and of what the pass `spatial` does of it, where fewer pixels are traced
        // than the panel has.
        name: "prepare",
        code: Code::ByMethod {
            dpm: PassKernel {
                shader: |reading| shaders::PREPARE.reading(reading),
                reads: &["B_SURFACES.hit", "B_SURFACES.inside", "B_GUIDES.tint", "B_SHOWN"],
                writes: &["B_COARSE_LIGHT"],
                seldom: &[],
            },
            others: PassKernel {
                shader: |reading| shaders::PREPARE.reading(reading),
                reads: &["B_SURFACES.hit", "B_SURFACES.inside", "B_SHOWN"],
                writes: &["B_COARSE_LIGHT"],
                seldom: &["B_GUIDES.tint"],
            },
        },
        when: |s, _| s.is_reduced(),
        grid: Grid::Tiles,
        walks: false,
        at_panel: false,
        overlaps: true,
    },
    Pass {
        name: "cells",
        code: Code::OfAll(PassKernel {
            shader: |reading| shaders::CELLS.reading(reading),
            reads: &["B_COARSE_SURFACES.hit", "B_SCHEDULE"],
            writes: &["B_SURFACES.hit", "B_CODES", "B_SCHEDULE", "B_WORK"],
            seldom: &["B_SURFACES.inside", "B_SHOWN"],
        }),
        when: |s, _| s.is_reduced(),
        grid: Grid::Cells,
        walks: false,
        at_panel: true,
        overlaps: true,
    },
    Pass {
        name: "enlarge",
        code: Code::OfAll(PassKernel {
            shader: |reading| shaders::ENLARGE.reading(reading),
            reads: &["B_COARSE_SURFACES.hit", "B_COARSE_LIGHT", "B_COUNTERS", "B_SCHEDULE", "B_WORK"],
            writes: &["B_SURFACES.hit", "B_CODES", "B_COUNTERS", "B_SCHEDULE", "B_WORK"],
            seldom: &["B_SURFACES.inside", "B_SHOWN"],
        }),
        when: |s, _| s.is_reduced(),
        grid: Grid::EvenCells,
        walks: false,
        at_panel: true,
        overlaps: true,
    },
    Pass {
        name: "edges",
        code: Code::OfAll(PassKernel {
            shader: |reading| shaders::EDGES.reading(reading),
            reads: &["B_COARSE_SURFACES.hit", "B_COARSE_LIGHT", "B_COUNTERS", "B_SCHEDULE", "B_WORK"],
            writes: &["B_SURFACES.hit", "B_CODES", "B_COUNTERS"],
            seldom: &["B_SURFACES.inside", "B_SHOWN"],
        }),
        when: |s, _| s.is_reduced(),
        grid: Grid::Work,
        walks: true,
        at_panel: true,
        overlaps: true,
    },
    Pass {
        name: "halftone",
        code: Code::OfAll(PassKernel {
            shader: |reading| shaders::HALFTONE.reading(reading),
            reads: &["B_SURFACES.hit", "B_CODES"],
            writes: &["B_CODES"],
            seldom: &[],
        }),
        when: |s, _| s.halftone.is_some_and(|halftone| !halftone.is_cut()),
        grid: Grid::Tiles,
        walks: false,
        at_panel: true,
        overlaps: true,
    },
    Pass {
        name: "motion",
        code: Code::OfAll(PassKernel {
            shader: |reading| shaders::MOTION.reading(reading),
            reads: &["B_SURFACES.hit", "B_CODES"],
            writes: &["B_MOTION"],
            seldom: &[],
        }),
        when: |s, _| !s.plane_groups.is_empty(),
        grid: Grid::Moving,
        walks: false,
        at_panel: true,
        overlaps: true,
    },
    Pass {
        // The pass `halftone` for planes whose highest bit is split, of which the pass `motion` keeps the code values.
        name: "cut",
        code: Code::OfAll(PassKernel {
            shader: |reading| shaders::HALFTONE.reading(reading),
            reads: &["B_SURFACES.hit", "B_CODES"],
            writes: &["B_CODES"],
            seldom: &[],
        }),
        when: |s, _| s.halftone.is_some_and(pack::Halftone::is_cut),
        grid: Grid::Tiles,
        walks: false,
        at_panel: true,
        overlaps: true,
    },
    Pass {
        name: "warp",
        code: Code::OfAll(PassKernel {
            shader: |reading| shaders::WARP.reading(reading),
            reads: &["B_MOTION"],
            writes: &["B_CODES"],
            seldom: &[],
        }),
        when: |s, _| !s.plane_groups.is_empty(),
        grid: Grid::Moving,
        walks: false,
        at_panel: true,
        overlaps: true,
    },
    Pass {
        name: "pack",
        code: Code::OfAll(PassKernel {
            shader: |_| shaders::PACK,
            reads: &["B_CODES"],
            writes: &["B_PLANES"],
            seldom: &[],
        }),
        when: |s, _| s.output.schedule().is_some(),
        grid: Grid::Planes,
        walks: false,
        at_panel: true,
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
    fn kernel(&self, is_dpm: bool) -> &PassKernel {
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
mod tests;
