//! GLSL sources, committed SPIR-V, and the one definition of every struct and constant shared with the GPU.
//!
//! `glsl/generated.glsl` is written from [`structs`] by `cargo run -p dpm-shaders --bin build-shaders`, which also runs `glslc`;
//! tests fail when either is stale, so users need no shader compiler.

pub mod generate;
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

macro_rules! shaders {
    ($($(#[$doc:meta])* $konst:ident = $name:literal;)*) => {
        $($(#[$doc])* pub const $konst: Shader = Shader { name: $name, spirv: include_bytes!(concat!("../spv/", $name, ".spv")) };)*
        /// Every shader in the crate.
        pub const ALL: &[Shader] = &[$($konst),*];
    };
}

shaders! {
    /// Primary visibility. `TEXEL`, here and below: the scene through texel buffers (software Vulkan).
    PRIMARY_TEXEL = "primary.texel";
    /// Primary visibility. `STORAGE`, here and below: the scene through storage buffers (GPUs).
    PRIMARY_STORAGE = "primary.storage";
    /// Path tracing.
    TRACE_TEXEL = "trace.texel";
    /// Path tracing.
    TRACE_STORAGE = "trace.storage";
    /// History carried to where its surface point is now.
    REPROJECT_TEXEL = "reproject.texel";
    /// History carried to where its surface point is now.
    REPROJECT_STORAGE = "reproject.storage";
    /// Shading rates per tile.
    RATE_MAP = "rate_map";
    /// Which pixels are traced, with how many samples.
    SCHEDULE = "schedule";
    /// New samples into the history.
    ACCUMULATE = "accumulate";
    /// Spatial filter of the picture.
    SPATIAL = "spatial";
    /// Compensation for distance, angle and albedo, then quantisation to code values.
    COMPENSATE_TEXEL = "compensate.texel";
    /// Compensation for distance, angle and albedo, then quantisation to code values.
    COMPENSATE_STORAGE = "compensate.storage";
    /// Code values into bit planes.
    PACK = "pack";
}
