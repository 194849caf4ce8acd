//! Every specialization constant, declared once: the host sets them when it compiles a shader, and what they switch off is compiled away.
//!
//! `glsl/generated.glsl` declares them all to the shaders. The compiler removes from a shader the constants that it does not use. Rust sets a
//! constant by the `u32` of its name, which is its id.

/// A specialization constant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Specialization {
    /// Name in GLSL and in Rust.
    pub name: &'static str,
    /// What Rust and the SPIR-V call it: its place in the list.
    pub id: u32,
    /// Type in GLSL: `bool` or `uint`.
    pub glsl_type: &'static str,
    /// Value of a shader that is compiled without it; booleans are 0 and 1.
    pub default: u32,
    /// What it says.
    pub meaning: &'static str,
}

impl Specialization {
    /// The declaration in GLSL.
    pub fn glsl(&self) -> String {
        let Self { name, id, glsl_type, default, meaning } = self;
        let value = match *glsl_type {
            "bool" => (*default != 0).to_string(),
            _ => format!("{default}u"),
        };
        format!("//{meaning}\nlayout(constant_id = {id}) const {glsl_type} {name} = {value};\n")
    }
}

macro_rules! specialization_constants {
    ($($(#[doc = $doc:literal])* $name:ident: $glsl_type:ident = $default:literal;)*) => {
        #[allow(non_camel_case_types, clippy::upper_case_acronyms)]
        #[repr(u32)]
        enum Id { $($name),* }

        $($(#[doc = $doc])* pub const $name: u32 = Id::$name as u32;)*

        /// All of them, in the order of their ids.
        pub const ALL: &[Specialization] = &[$(Specialization {
            name: stringify!($name),
            id: $name,
            glsl_type: stringify!($glsl_type),
            default: $default as u32,
            meaning: concat!($($doc),*),
        }),*];
    };
}

specialization_constants! {
    /// A material of the scene has a texture.
    HAS_TEXTURES: bool = true;
    /// A material of the scene has a normal map.
    HAS_NORMAL_MAPS: bool = true;
    /// A material of the scene has holes where its alpha is low.
    HAS_ALPHA_MASK: bool = true;
    /// A material of the scene lets light through.
    HAS_TRANSMISSION: bool = true;
    /// A material of the scene has a specular lobe: it is metallic, or its index of refraction is not 1.
    HAS_SPECULAR: bool = true;
    /// A triangle of the scene emits light.
    HAS_EMISSIVE: bool = true;
    /// The scene has a point, spot or directional light.
    HAS_PUNCTUAL: bool = true;
    /// Light from the surroundings, as `ENVIRONMENT_*`.
    ENVIRONMENT_KIND: uint = 2;
    /// The luminance of indirect contributions is limited.
    HAS_CLAMP: bool = true;
    /// A material of the scene has a diffuse lobe: it is not metallic everywhere.
    HAS_DIFFUSE: bool = true;
    /// The scene has so many bodies that rays look for them in a tree. Of few they ask each.
    HAS_BODY_TREE: bool = true;
    /// Where random numbers come from, as `SAMPLER_*`.
    SAMPLER: uint = 0;
    /// Guides are written, because a pass between tracing and compensation reads them.
    HAS_GUIDES: bool = true;
    /// Radiance is divided by the albedo of the surface before it is filtered.
    HAS_DEMODULATION: bool = true;
    /// The picture is filtered in space.
    HAS_FILTER: bool = true;
    /// How the projector's lens bends rays, as `LENS_*`.
    LENS: uint = 0;
    /// The projector's light is not proportional to the code value.
    HAS_RESPONSE: bool = false;
    /// The projector's pixels are not equally bright.
    HAS_FLAT_FIELD: bool = false;
    /// The albedo of some body's real surface is a picture over its texture coordinates.
    HAS_ALBEDO_MAPS: bool = false;
    /// Parts of a frame in which each channel shows its code value.
    HALFTONE_PARTS: uint = 8;
    /// Bits of a part.
    HALFTONE_DEPTH: uint = 1;
    /// The planes are white, and show the green code value.
    HALFTONE_WHITE: bool = false;
    /// Planes that follow are taken from whole words, which are halftones and hold no code values.
    WARP_WHOLE_WORDS: bool = false;
    /// Width of the bit planes, pixels.
    PLANE_WIDTH: uint = 1;
    /// Height of the bit planes, pixels.
    PLANE_HEIGHT: uint = 1;
    /// Which planes show bits 0 to 3 of a code value, a byte each from the lowest on; 255: none does.
    PLANE_OF_BITS_0: uint = 0xffff_ffff;
    /// The same for bits 4 to 7.
    PLANE_OF_BITS_4: uint = 0xffff_ffff;
    /// The same for bits 8 to 11.
    PLANE_OF_BITS_8: uint = 0xffff_ffff;
    /// The same for bits 12 to 15.
    PLANE_OF_BITS_12: uint = 0xffff_ffff;
    /// The same for bits 16 to 19.
    PLANE_OF_BITS_16: uint = 0xffff_ffff;
    /// The same for bits 20 to 23.
    PLANE_OF_BITS_20: uint = 0xffff_ffff;
    /// On GPUs: groups of nodes that may wait while a ray walks through a body, at most one for each level of the deepest tree.
    WALK_STACK: uint = 24;
    /// On GPUs: a pixel may have more than `TRACE_PIXEL_SAMPLES` samples, so that those of a workgroup may take several rounds. The loop over the
    /// rounds costs registers even where there is one.
    MANY_SAMPLES: bool = true;
    /// On GPUs: workgroups of the pass `trace` that keep the whole device busy to the end. A list that has too few samples for so many is cut into
    /// shorter ranges, because a lane that takes three samples one after the other while others idle makes the pass longer.
    TRACE_GROUPS: uint = 1024;
    /// A material of the scene has a clear coat.
    HAS_CLEARCOAT: bool = true;
    /// A dielectric of the scene reflects in a colour of its own, or less than its index says.
    HAS_SPECULAR_COLOR: bool = true;
    /// A material of the scene is rougher along one direction.
    HAS_ANISOTROPY: bool = true;
    /// A material of the scene has fibres.
    HAS_SHEEN: bool = true;
    /// A solid of the scene absorbs light.
    HAS_ABSORPTION: bool = true;
    /// A material of the scene is partly there.
    HAS_ALPHA_BLEND: bool = true;
    /// A material of the scene has a thin film.
    HAS_IRIDESCENCE: bool = true;
    /// Light shines through a material of the scene in every direction.
    HAS_DIFFUSE_TRANSMISSION: bool = true;
    /// A solid of the scene refracts colours differently.
    HAS_DISPERSION: bool = true;
    /// Bits below the parts of a halftone, which are shown once. Above 0, the pass `warp` cuts code values into levels.
    HALFTONE_LOW: uint = 0;
    /// Lamps by which histories are relit. A loop over one of them is no loop.
    LAMPS: uint = 2;
}
