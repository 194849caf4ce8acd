//! GLSL sources, committed SPIR-V, and the one definition of every struct and constant shared with the GPU.
//!
//! `glsl/generated.glsl` and `glsl/tables.glsl` are written from [`structs`] and [`specialization`] by
//! `cargo run -p dpm-shaders --bin build-shaders`, which also runs `glslc`. Tests fail when either is stale, so users need no shader compiler.
//!
//! # Example
//!
//! ```
//! use dpm_shaders::{generate::generated_glsl, structs::Frame, Reading, ALL, COMPENSATE, TRACE};
//!
//! // Software Vulkan reads tables through texel buffers, GPUs through storage buffers.
//! assert_eq!(TRACE.reading(Reading::Texels).name, "trace.texel");
//! assert_eq!(TRACE.reading(Reading::Storage).name, "trace.storage");
//!
//! // On devices that trace rays themselves the shaders that walk through the scene leave that to them; the others are as on any GPU.
//! assert_eq!(TRACE.reading(Reading::Query).name, "trace.query");
//! assert_eq!(COMPENSATE.reading(Reading::Query).name, "compensate.storage");
//!
//! // Every shader is SPIR-V, ready for `vkCreateShaderModule`.
//! for shader in ALL {
//!     assert_eq!(shader.spirv[..4], 0x0723_0203_u32.to_le_bytes(), "{}", shader.name);
//! }
//!
//! // What Rust writes is what GLSL reads: one struct, declared once.
//! let frame: Frame = bytemuck::Zeroable::zeroed();
//! assert_eq!(bytemuck::bytes_of(&frame).len(), size_of::<Frame>());
//! assert!(generated_glsl().contains("struct Frame {"));
//! ```

pub mod generate;
pub mod specialization;
#[cfg(test)]
mod spirv_layout_tests;
pub mod structs;

/// A compute shader as SPIR-V, with the name of its source for messages.
#[derive(Clone, Copy, Debug)]
pub struct Shader {
    /// Stem of the source file, e.g. `primary`.
    pub name: &'static str,
    /// Little-endian SPIR-V words as bytes.
    pub spirv: &'static [u8],
}

/// How shaders read tables and find what a ray meets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reading {
    /// Tables through texel buffers, and their own walk through the scene: software Vulkan.
    Texels,
    /// Tables through storage buffers, and their own walk: GPUs.
    Storage,
    /// Tables through storage buffers; the device finds what a ray meets (ray query).
    Query,
}

/// A shader that reads tables, built for every way of reading them.
#[derive(Clone, Copy, Debug)]
pub struct TableShader {
    /// Through texel buffers: software Vulkan.
    pub texel: Shader,
    /// Through storage buffers: GPUs.
    pub storage: Shader,
    /// The same with ray queries; `None`: it traces no rays.
    pub query: Option<Shader>,
}

impl TableShader {
    /// The one that reads in this way.
    pub fn reading(&self, reading: Reading) -> Shader {
        match reading {
            Reading::Texels => self.texel,
            Reading::Storage => self.storage,
            Reading::Query => self.query.unwrap_or(self.storage),
        }
    }
}

macro_rules! spirv {
    ($name:expr) => {
        Shader { name: $name, spirv: include_bytes!(concat!("../spv/", $name, ".spv")) }
    };
}

macro_rules! table_shaders {
    ($($(#[$doc:meta])* $konst:ident = $name:literal $(with $query:literal)?;)*) => {
        $($(#[$doc])* pub const $konst: TableShader = TableShader {
            texel: spirv!(concat!($name, ".texel")),
            storage: spirv!(concat!($name, ".storage")),
            query: [$(Some(spirv!($query)),)? None][0],
        };)*
        /// Every shader in the crate.
        pub const ALL: &[Shader] = &[
            $($konst.texel, $konst.storage, $(spirv!($query),)?)*
            TRACE_BEGIN, TRACE_HITS, TRACE_ENDS, TRACE_MISSES, TRACE_SUMS, PACK,
        ];
    };
}

table_shaders! {
    /// Primary visibility.
    PRIMARY = "primary" with "primary.query";
    /// Path tracing.
    TRACE = "trace" with "trace.query";
    /// Histories moved to the pixels in which their surface points are now (method dpm).
    REPROJECT_POINT = "reproject_point";
    /// Histories fetched bilinearly where each surface point was (methods paper and miyamoto).
    REPROJECT_BILINEAR = "reproject_bilinear";
    /// Shading rates per tile.
    RATE_MAP = "rate_map";
    /// Samples of each pixel from a budget (method dpm).
    SCHEDULE_BUDGET = "schedule_budget";
    /// Samples of one pixel in each coarse pixel (the methods of others).
    SCHEDULE_BLOCKS = "schedule_blocks";
    /// New samples into the history, each counted once (method dpm).
    ACCUMULATE_SAMPLES = "accumulate_samples";
    /// A new frame into the history, with a weight (methods paper and miyamoto).
    ACCUMULATE_FRAMES = "accumulate_frames";
    /// Spatial filter of the picture by local linear regression (method dpm).
    SPATIAL_REGRESSION = "spatial_regression";
    /// Spatial filter of the picture by a Poisson disk (methods paper and miyamoto).
    SPATIAL_DISK = "spatial_disk";
    /// Compensation for distance, angle and albedo, then quantisation to code values.
    COMPENSATE = "compensate";
    /// What enlarging needs of each traced pixel, in one row.
    PREPARE = "prepare";
    /// The panel's pixels by what the traced pixels around them show, into lists.
    CELLS = "cells";
    /// The light of a reduced raster at the panel's pixels on even surface, and its code values.
    ENLARGE = "enlarge";
    /// The same at edges.
    EDGES = "edges" with "edges.query";
    /// Code values into halftones, for planes of equal light.
    HALFTONE = "halftone";
    /// How far the surface of each pixel moves while the planes last.
    MOTION = "motion";
    /// Planes taken from the pixels whose surfaces are at their mirrors at their instants.
    WARP = "warp";
    /// The walk alone, for measurements.
    WALK = "walk";
}

/// Code values into bit planes.
pub const PACK: Shader = spirv!("pack");

/// Work items into paths and the rays from their first vertices.
pub const TRACE_BEGIN: Shader = spirv!("trace_begin.texel");
/// Paths that have met a surface to their next vertices.
pub const TRACE_HITS: Shader = spirv!("trace_hits.texel");
/// The same where that is their last vertex.
pub const TRACE_ENDS: Shader = spirv!("trace_ends.texel");
/// Paths that have met none to their ends.
pub const TRACE_MISSES: Shader = spirv!("trace_misses.texel");
/// The light of the paths of each work item into radiance.
pub const TRACE_SUMS: Shader = spirv!("trace_sums.texel");

/// The parts of the pass `trace` where the host walks its rays (software Vulkan).
pub const TRACE_APART: [Shader; 5] = [TRACE_BEGIN, TRACE_HITS, TRACE_ENDS, TRACE_MISSES, TRACE_SUMS];
