//! Every struct that host and GPU share, scalar block layout. Defined here once; the GLSL is generated.
//!
//! Affine transforms are three rows: `p' = (dot(row0, (p, 1)), dot(row1, (p, 1)), dot(row2, (p, 1)))`.

use crate::generate::GlslType;
use bytemuck::{Pod, Zeroable};

/// Three rows of an affine transform.
pub type Rows = [[f32; 4]; 3];

macro_rules! gpu_structs {
    ($($(#[$doc:meta])* struct $name:ident { $($(#[$fdoc:meta])* $field:ident : $ty:ty,)* })*) => {
        $(
            $(#[$doc])*
            #[repr(C)]
            #[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
            pub struct $name { $($(#[$fdoc])* pub $field: $ty,)* }
        )*
        $(
            impl $name {
                /// The GLSL that makes one of the words of the rows r0, r1, ... that begin with `word`.
                pub fn read_members(word: &mut usize) -> String {
                    let members = [$(<$ty as GlslType>::read(word)),*];
                    format!("{}({})", stringify!($name), members.join(",\n        "))
                }

                /// The GLSL that makes a row of words of the struct `of`.
                pub fn words_of(of: &str) -> String {
                    let words = [$(<$ty as GlslType>::words(&format!("{of}.{}", stringify!($field)))),*];
                    words.join(", ")
                }

                /// The GLSL that makes one of the members of `element`, so that what is not used of it is not loaded.
                pub fn copy_members(element: &str) -> String {
                    let members = [$(format!("{element}.{}", stringify!($field))),*];
                    format!("{}({})", stringify!($name), members.join(",\n        "))
                }
            }
        )*
        /// The numbers of each member of a struct, `f` for a float, `i` and `u` for integers, with commas between members: by these the parts of
        /// a buffer are told from one another in SPIR-V. A number is no struct, and has no name.
        pub fn members_of(name: &str) -> String {
            match name {
                $(stringify!($name) => [$(<$ty as GlslType>::numbers()),*].join(","),)*
                _ => "u".to_owned(),
            }
        }
        /// The GLSL of every struct, in order.
        pub fn glsl() -> String {
            let mut out = String::new();
            $(
                out.push_str(concat!("struct ", stringify!($name), " {\n"));
                $( out.push_str(&<$ty as GlslType>::member(stringify!($field))); )*
                out.push_str("};\n\n");
            )*
            out
        }
        /// Name and byte offset of every member of every struct: what the SPIR-V must agree with.
        pub fn layout() -> Vec<(&'static str, &'static str, usize)> {
            vec![$($((stringify!($name), stringify!($field), core::mem::offset_of!($name, $field)),)*)*]
        }
    };
}

gpu_structs! {
    /// One frame's uniforms. Written by the host as late as possible.
    struct Frame {
        /// Projector centre, world.
        projector_position: [f32; 3],
        /// Seed of the run.
        seed: u32,
        /// world direction = (x' , y', z') of these rows applied to ((px - cx) / fx, -(py - cy) / fy, -1).
        world_from_projector: Rows,
        /// fx, fy, cx, cy in pixels of this raster.
        intrinsics: [f32; 4],
        /// Eye, world.
        eye_position: [f32; 3],
        /// Frame number, wraps.
        frame: u32,
        /// Gaze point, world.
        gaze_point: [f32; 3],
        /// Bodies in the instance table.
        instance_count: u32,
        /// Raster width, pixels.
        width: u32,
        /// Raster height, pixels.
        height: u32,
        /// Samples per traced pixel.
        spp: u32,
        /// At most this many closest-hit rays a path.
        depth: u32,
        /// Tiles in the tile list.
        tile_count: u32,
        /// 16-pixel tiles in a row.
        tiles_x: u32,
        /// Limit on the luminance of indirect contributions; infinite: off.
        clamp_indirect: f32,
        /// Ambient radiance that the surface already shows, subtracted before compensation.
        ambient: [f32; 3],
        /// Lights in the alias table.
        light_count: u32,
        /// Bits: see `FRAME_*`.
        flags: u32,
        /// Constant environment radiance, or scale of the map.
        environment: [f32; 3],
        /// Map width in texels.
        environment_width: u32,
        /// Map height in texels.
        environment_height: u32,
        /// Rotation about +Y, radians.
        environment_rotation: f32,
        /// Probability that a light sample goes to the environment.
        environment_select: f32,
        /// World position that all coordinates here are relative to.
        world_origin: [f32; 3],
        /// Stamp of the last frame that the former history holds, `NO_FRAME` before the first.
        history_frame: u32,
        /// Samples per lit pixel that the frame may spend on average (method dpm).
        budget_spp: f32,
        /// Most frames' worth of samples that the history may weigh (method dpm).
        history_cap: f32,
        /// Samples per traced pixel inside the inner angle, between, and outside (\[paper\] table 1).
        zone_spp: [u32; 3],
        /// Weight of the new frame in the same zones.
        zone_alpha: [f32; 3],
        /// Inner and outer angle at the eye, degrees (\[paper\] eq. 4).
        zone_degrees: [f32; 2],
        /// The spatial filter blends in between these angles, degrees.
        filter_degrees: [f32; 2],
        /// t of \[paper\] eq. 2.
        rate_t: f32,
        /// l of \[paper\] eq. 2.
        rate_l: f32,
        /// Pixels per unit of tangent times 1: the size of a pixel at distance 1, metres.
        pixel_size: f32,
        /// How many frames the renderer drew before this one, wraps. Whatever is done in turns from frame to frame goes by this count, and
        /// not by the frame's number, which leaves out the frames that were dropped.
        drawn: u32,
        /// How many samples a pixel those frames took together, wraps: where a sequence that belongs to a pixel goes on.
        first_sample: u32,
        /// Lens of kind `LENS_BROWN`: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4. Of kind `LENS_FISHEYE`: k1 k2 k3 k4.
        lens: [[f32; 4]; 3],
        /// Rows of the matrix by which a bent ray meets a tilted panel, and 0.
        lens_tilt: Rows,
        /// Straight rays farther than this from the axis (`r / z`) have no pixel.
        lens_limit: f32,
        /// First element of the straight rays, two numbers a pixel, in the table of optics.
        rays_at: u32,
        /// First element of the flat field, three numbers a pixel, in the table of optics.
        flat_field_at: u32,
        /// First element of the blur of a moving eye, two numbers a speed, in the table of optics.
        rate_table_at: u32,
        /// Bodies in the table of movers.
        mover_count: u32,
        /// Groups of planes that follow the bodies.
        group_count: u32,
        /// Nodes of the tree over the bodies, for each octant of directions.
        body_nodes: u32,
        /// About the mean radiance of what shines on a surface, as luminance: what the light of histories is divided by is relative to it.
        mean_light: f32,
    }

    /// A body that moves while the planes of a frame last. Motions are those of the whole exposure.
    struct Mover {
        /// How far a point of the body moves, world space, from its place in object space.
        motion_from_object: Rows,
        /// First column and row of the pixels on which its light can fall.
        lower: [i32; 2],
        /// The column and the row after the last.
        upper: [i32; 2],
        /// The pixel to which `start` belongs.
        centre: [i32; 2],
        /// About how far the body moves there, 1/64 pixel to the right and down.
        start: [i32; 2],
        /// By how much more it moves at the next pixel, in 2^-12 of that: to the right with x and with y, then down with x and with y.
        slope: [i32; 4],
        /// Time from the frame's instant to the one for which the body is drawn, in 2^-16 of the exposure.
        instant: i32,
        /// Along columns and rows: 1 if frames take the pixels around a place in turn where codes are rough, 0 if they take the nearest.
        in_turn: [u32; 2],
    }

    /// What was drawn at a pixel, and how it moves while the planes of the frame last.
    struct Moved {
        /// The word whose bits the planes show. Code values of a mover have `WORD_ROUGH` beside them where they are rough.
        word: u32,
        /// Motion on the raster during the whole exposure, 1/64 pixel: to the right in the low half, down in the high half.
        motion: u32,
        /// The owner in the high 8 bits: `OWNER_NONE`, `OWNER_STILL`, or `OWNER_STILL` plus the number of a mover, from 1 on. Distance from the
        /// projector in the low 24, in steps that grow with it.
        owner_and_depth: u32,
    }

    /// Planes that are shown with the bodies at one instant.
    struct PlaneGroup {
        /// The bits of a pixel's word that they show.
        mask: u32,
        /// Time from the frame's instant to theirs, in 2^-16 of the exposure.
        instant: i32,
    }

    /// Where a pixel's surface point moves, and how the eye sees it: what decides shading rates.
    struct Sight {
        /// Pixels per frame that the surface point moved on the raster.
        motion: [f32; 2],
        /// Apparent pixel size, \[paper\] eq. 3.
        size: f32,
        /// Angle at the eye between the gaze point and this point, degrees.
        angle: f32,
    }

    /// What the light of a pixel is filtered by (method dpm).
    struct Tint {
        /// What radiance is divided by before it is kept and filtered (`relight.glsl`): red and green as halves.
        albedo_rg: u32,
        /// Blue, and the angle at the eye between the gaze point and this point in degrees, as halves.
        albedo_b_and_angle: u32,
    }

    /// What is added to the mean of a pixel's history, whose surface point lies beside that of the pixel (method dpm).
    struct Shift {
        /// Red and green, and blue, as halves.
        halves: [u32; 2],
    }

    /// The light that former frames found at the surface point that a pixel shows now.
    struct HistoryLight {
        /// Mean radiance, divided by the albedo where the method does so.
        mean: [f32; 3],
        /// Frames (paper) or samples (dpm) that the mean stands on; 0: none.
        weight: f32,
    }

    /// Where that point is.
    struct HistoryPlace {
        /// The surface point, body space. Method dpm: the point that the history belongs to, at most about half a pixel from the pixel's own.
        position: [f32; 3],
        /// Its normal, body space, octahedral.
        normal: u32,
    }

    /// How far the mean can be trusted (method dpm).
    struct HistoryNoise {
        /// What the last few frames say beyond the mean, as luminance without albedo: how far the mean lags behind.
        drift: f32,
        /// Variance of one sample's luminance.
        variance: f32,
        /// Mean square by which the luminance of a frame is beyond the history: its noise, and what the history gets wrong.
        surprise: f32,
        /// Samples of the point's sequence already used in the bits of `HISTORY_USED`, body in the 8 bits above, and the bit `HISTORY_EXACT`.
        body_and_used: u32,
    }

    /// Whose history it is.
    struct HistoryTag {
        /// Body in the high 8 bits, `HISTORY_HIDDEN` and `HISTORY_BORDER` below.
        owner: u32,
        /// Frame that wrote it.
        frame: u32,
    }

    /// Which sample sequence the point has (methods whose points have one).
    struct HistorySeed {
        /// Its seed.
        seed: u32,
    }

    /// How far the point's sample sequence was used before the frame.
    struct HistoryUsed {
        /// Samples of it, and `HISTORY_EXACT`. Signed, so that it can be told from the seed.
        before: i32,
    }

    /// A pixel to be traced. Its samples end where those of the next item begin.
    struct WorkItem {
        /// Pixel index.
        pixel: u32,
        /// Samples of all items before it.
        first: u32,
    }

    /// Sizes that one pass leaves for the next.
    struct Schedule {
        /// Workgroups of the tracing pass.
        groups: [u32; 3],
        /// Sum of all pixels' importance, in units of 1 / 256.
        importance: u32,
        /// Work items in the lower 32 bits, their samples in the upper 32: one number, so that both grow in one step.
        listed: u64,
        /// Lit pixels.
        lit: u32,
        /// Nothing.
        unused: u32,
    }

    /// A pixel's light before the spatial filter.
    struct Filtered {
        /// Radiance, divided by the albedo where the method does so.
        light: [f32; 3],
        /// Method dpm: samples that it stands on, 0: nothing is known; and luminance of the albedo. Both as halves.
        weight_and_albedo: u32,
    }

    /// One rigid body in the top level.
    struct Instance {
        /// world-from-object.
        world_from_object: Rows,
        /// object-from-world.
        object_from_world: Rows,
        /// World bounds, lower corner.
        bounds_min: [f32; 3],
        /// First node of the body's BVH.
        node_offset: u32,
        /// World bounds, upper corner.
        bounds_max: [f32; 3],
        /// First triangle of the body, in BVH order.
        triangle_offset: u32,
        /// world-from-object of the previous frame.
        previous_world_from_object: Rows,
        /// Bits: see `INSTANCE_*`.
        flags: u32,
        /// Index of the body in the scene.
        body: u32,
        /// Largest magnitude among object coordinates, for ray offsets.
        extent: f32,
        /// 0 if the body is shown as it was drawn, else the number of its mover, from 1 on.
        mover: u32,
        /// drive = radiance * this * l_P^2 / cos, per channel: pi * exposure * white / (albedo * max_intensity). Without the albedo where the
        /// body has an albedo map.
        drive_gain: [f32; 3],
        /// Where the body's albedo map is in the table of optics: its width, its height, then three numbers a texel. `NO_ALBEDO_MAP`: it has none.
        albedo_map: u32,
    }

    /// A node of the tree over the bodies. The nodes of an octant of directions stand in the order in which a ray meets them, nearest first, each
    /// before all that are below it.
    struct BodyNode {
        /// Lower corner, world space.
        lower: [f32; 3],
        /// Where a ray goes on that does not enter it: the node after all that are below it, counted from the first of its octant.
        after: u32,
        /// Upper corner, world space.
        upper: [f32; 3],
        /// The body in bits 0 to 7, or `BODY_NODE_INNER`; in bits 8 to 15 the flags that any body below it has.
        body: u32,
    }

    /// Attributes of one vertex.
    struct Vertex {
        /// Unit shading normal, object space.
        normal: [f32; 3],
        /// Texture coordinates.
        uv: [f32; 2],
        /// Unit tangent and sign of the bitangent.
        tangent: [f32; 4],
        /// 0.
        reserved: [u32; 3],
    }

    /// Indices and material of one triangle, in BVH order.
    struct TriangleRef {
        /// Vertex indices.
        vertices: [u32; 3],
        /// Material.
        material: u32,
        /// Index into the light table; `NO_LIGHT`: does not emit.
        light: u32,
        /// 0.
        reserved: [u32; 3],
    }

    /// Use of a texture; `texture == NO_TEXTURE`: none. The two rows map uv.
    struct TextureUse {
        /// Index into the texture table.
        texture: u32,
        /// u' = dot(row, (u, v, 1)).
        row_u: [f32; 3],
        /// v' likewise.
        row_v: [f32; 3],
    }

    /// A material as in docs/RENDERING.md.
    struct Material {
        /// Linear base colour.
        base_color: [f32; 3],
        /// Alpha factor.
        alpha: f32,
        /// Emitted radiance.
        emissive: [f32; 3],
        /// Below this alpha nothing is there; negative: opaque.
        alpha_cutoff: f32,
        /// 0..1.
        metallic: f32,
        /// Perceptual.
        roughness: f32,
        /// Index of refraction.
        ior: f32,
        /// 0..1.
        transmission: f32,
        /// Strength of the normal map.
        normal_scale: f32,
        /// Bits: see `MATERIAL_*`.
        flags: u32,
        /// Which albedo table.
        albedo_table: u32,
        /// Base colour.
        base_color_texture: TextureUse,
        /// Metallic and roughness.
        metallic_roughness_texture: TextureUse,
        /// Normals.
        normal_texture: TextureUse,
        /// Emission.
        emissive_texture: TextureUse,
        /// Transmission.
        transmission_texture: TextureUse,
        /// Strength of the clear coat, 0..1.
        coat: f32,
        /// Perceptual roughness of the coat.
        coat_roughness: f32,
        /// Strength of the coat's own normal map.
        coat_normal_scale: f32,
        /// Which albedo table has the coat's.
        coat_table: u32,
        /// Which albedo table has what facets reflect that reflect everything.
        white_table: u32,
        /// Which albedo table has the sheen's as it was fitted. The next has what is left of it.
        sheen_table: u32,
        /// Strength of a dielectric's reflection, 0..1.
        specular: f32,
        /// Its colour at normal incidence.
        specular_color: [f32; 3],
        /// 0..1.
        anisotropy: f32,
        /// Cosine and sine of the angle from the tangent toward the bitangent.
        anisotropy_direction: [f32; 2],
        /// Colour of the sheen.
        sheen_color: [f32; 3],
        /// Perceptual roughness of the sheen.
        sheen_roughness: f32,
        /// Strength of the thin film, 0..1.
        film: f32,
        /// Its index of refraction.
        film_ior: f32,
        /// Its thickness where the texture is 0 and 1, nanometres.
        film_thickness: [f32; 2],
        /// What the solid absorbs, per metre.
        absorption: [f32; 3],
        /// Share of the diffuse light that leaves on the other side.
        shine: f32,
        /// Its colour.
        shine_color: [f32; 3],
        /// 20 over Abbe's number.
        dispersion: f32,
        /// Strength of the coat.
        coat_texture: TextureUse,
        /// Its roughness.
        coat_roughness_texture: TextureUse,
        /// Its normals.
        coat_normal_texture: TextureUse,
        /// Strength of the dielectric reflection.
        specular_texture: TextureUse,
        /// Its colour.
        specular_color_texture: TextureUse,
        /// Direction and strength of anisotropy.
        anisotropy_texture: TextureUse,
        /// Colour of the sheen.
        sheen_color_texture: TextureUse,
        /// Its roughness.
        sheen_roughness_texture: TextureUse,
        /// Strength of the film.
        film_texture: TextureUse,
        /// Its thickness.
        film_thickness_texture: TextureUse,
        /// Share of the light that shines through.
        shine_texture: TextureUse,
        /// Its colour.
        shine_color_texture: TextureUse,
        /// 0.
        reserved: u32,
    }

    /// Where a texture's texels are.
    struct TextureInfo {
        /// First texel.
        offset: u32,
        /// Texels in a row.
        width: u32,
        /// Rows.
        height: u32,
        /// Bits 0..1 wrap u, 2..3 wrap v, 4 sRGB, 5 nearest.
        flags: u32,
    }

    /// One entry of the light table: an alias-table slot and the light itself.
    struct Light {
        /// `LIGHT_*`.
        kind: u32,
        /// Instance that carries it; `NO_INSTANCE`: world.
        instance: u32,
        /// Triangle in BVH order (emissive triangles).
        triangle: u32,
        /// Probability of this light among all.
        select: f32,
        /// Alias table: keep probability of this slot.
        alias_keep: f32,
        /// Alias table: the other light of this slot.
        alias_other: u32,
        /// Position, carrier space.
        position: [f32; 3],
        /// Where it shines, carrier space.
        direction: [f32; 3],
        /// Radiant intensity or irradiance.
        intensity: [f32; 3],
        /// Spot: scale of the cosine.
        cone_scale: f32,
        /// Spot: offset of the cosine.
        cone_offset: f32,
        /// Range, metres.
        range: f32,
        /// Nothing.
        unused: [u32; 2],
    }

    /// A texel of a picture.
    struct Texel {
        /// Red and green, and blue and alpha, as shares of 65535.
        shares: [u32; 2],
    }

    /// A texel of the sky, or of its filtered copies. The last row of the sky has the cumulative shares of its rows in `light`.
    struct SkyTexel {
        /// Radiance.
        light: [f32; 3],
        /// Cumulative share of the row's power up to this texel.
        cumulative: f32,
    }

    /// Four neighbours of a table of directional albedo; of the averages the first two.
    struct AlbedoCell {
        /// At (mu, alpha), at the next mu, at the next alpha, at the next of both.
        corners: [f32; 4],
    }

    /// What the projector ray of a pixel met.
    struct SurfaceHit {
        /// Instance in the high 8 bits, triangle of the body in BVH order in the low 24; `NO_HIT`: nothing.
        id: u32,
        /// Distance from the projector along the unit ray; negative: not lit (the eye cannot see it).
        distance: f32,
    }

    /// Where in the triangle it met it.
    struct Barycentric {
        /// Weights of vertices 1 and 2.
        weights: [f32; 2],
    }

    /// What one frame counted. Zeroed by the host before the frame.
    struct Counters {
        /// Rays, whether they ask for the nearest hit or for any, and whether they are walked or proven to meet nothing.
        rays: u32,
        /// Those of them from the projector and from there to the eye. All of these are walked.
        camera_rays: u32,
        /// Those of them that a horizon proves to meet nothing. They are not walked.
        proven_rays: u32,
        /// Paths.
        samples: u32,
        /// Samples dropped because they were not finite.
        invalid_samples: u32,
        /// Pixels that are lit.
        lit_pixels: u32,
        /// Code values clamped at the top.
        clipped_values: u32,
        /// Drive values that were NaN.
        nan_values: u32,
        /// Contributions limited by the firefly clamp.
        clamped_samples: u32,
    }
}

/// Integer constants shared with GLSL.
pub const CONSTANTS: &[(&str, u32)] = &[
    ("NO_HIT", NO_HIT),
    ("NO_TEXTURE", NO_TEXTURE),
    ("NO_INSTANCE", NO_INSTANCE),
    ("NO_ALBEDO_MAP", NO_ALBEDO_MAP),
    ("NO_LIGHT", NO_LIGHT),
    ("NO_FRAME", NO_FRAME),
    ("INSTANCE_PROJECTED", INSTANCE_PROJECTED),
    ("INSTANCE_EMPTY", INSTANCE_EMPTY),
    ("BODY_NODE_INNER", BODY_NODE_INNER),
    ("HORIZON_STEPS", HORIZON_STEPS),
    ("MATERIAL_DOUBLE_SIDED", MATERIAL_DOUBLE_SIDED),
    ("MATERIAL_THIN", MATERIAL_THIN),
    ("MATERIAL_TRANSMISSIVE", MATERIAL_TRANSMISSIVE),
    ("MATERIAL_BLEND", MATERIAL_BLEND),
    ("LIGHT_TRIANGLE", LIGHT_TRIANGLE),
    ("LIGHT_POINT", LIGHT_POINT),
    ("LIGHT_SPOT", LIGHT_SPOT),
    ("LIGHT_DIRECTIONAL", LIGHT_DIRECTIONAL),
    ("LIGHT_BODY", LIGHT_BODY),
    ("SKY_NODES", SKY_NODES),
    ("SKY_LOBES", SKY_LOBES),
    ("FRAME_CAMERA_IS_EYE", FRAME_CAMERA_IS_EYE),
    ("FRAME_RATE_MAP", FRAME_RATE_MAP),
    ("FRAME_CHECKERBOARD", FRAME_CHECKERBOARD),
    ("FRAME_SPP_BY_ANGLE", FRAME_SPP_BY_ANGLE),
    ("FRAME_TEMPORAL", FRAME_TEMPORAL),
    ("FRAME_DPM", FRAME_DPM),
    ("HISTORY_USED", HISTORY_USED),
    ("HISTORY_EXACT", HISTORY_EXACT),
    ("HISTORY_HIDDEN", HISTORY_HIDDEN),
    ("HISTORY_BORDER", HISTORY_BORDER),
    ("FRAME_ALLOCATE", FRAME_ALLOCATE),
    ("FRAME_STEADY", FRAME_STEADY),
    ("FRAME_SHOWS_ALL", FRAME_SHOWS_ALL),
    ("DEMAND_NOT_LIT", DEMAND_NOT_LIT),
    ("DEMAND_NOT_TRACED", DEMAND_NOT_TRACED),
    ("DEMAND_EXACT", DEMAND_EXACT),
    ("DEMAND_NEW", DEMAND_NEW),
    ("RATE_TABLE_OCTAVE", RATE_TABLE_OCTAVE),
    ("RATE_TABLE_OCTAVES", RATE_TABLE_OCTAVES),
    ("NOISE_SIZE", NOISE_SIZE),
    ("NOISE_FRAMES", NOISE_FRAMES),
    ("ALBEDO_TABLE_SIZE", ALBEDO_TABLE_SIZE),
    ("ENVIRONMENT_NONE", ENVIRONMENT_NONE),
    ("ENVIRONMENT_CONSTANT", ENVIRONMENT_CONSTANT),
    ("ENVIRONMENT_MAP", ENVIRONMENT_MAP),
    ("LENS_NONE", LENS_NONE),
    ("LENS_BROWN", LENS_BROWN),
    ("LENS_FISHEYE", LENS_FISHEYE),
    ("RESPONSE_CODES", RESPONSE_CODES),
    ("OWNER_NONE", OWNER_NONE),
    ("OWNER_STILL", OWNER_STILL),
    ("WORD_ROUGH", WORD_ROUGH),
    ("ROUGH_STEP", ROUGH_STEP),
    ("TRACE_LANES", TRACE_LANES),
    ("TRACE_GROUP_SAMPLES", TRACE_GROUP_SAMPLES),
    ("TRACE_PIXEL_SAMPLES", TRACE_PIXEL_SAMPLES),
    ("TRACE_SLOTS", TRACE_SLOTS),
    ("RAY_NONE", RAY_NONE),
    ("RAY_CLOSEST", RAY_CLOSEST),
    ("RAY_ANY", RAY_ANY),
    ("SAMPLER_INDEPENDENT", SAMPLER_INDEPENDENT),
    ("SAMPLER_BLUE_NOISE", SAMPLER_BLUE_NOISE),
    ("SAMPLER_CONTINUED", SAMPLER_CONTINUED),
    ("SAMPLER_PIXEL_SEQUENCE", SAMPLER_PIXEL_SEQUENCE),
];
/// Kind of a ray that the host walks: there is none.
pub const RAY_NONE: u32 = 0;
/// The nearest surface is wanted.
pub const RAY_CLOSEST: u32 = 1;
/// Any surface is.
pub const RAY_ANY: u32 = 2;
/// A pixel that met nothing.
pub const NO_HIT: u32 = u32::MAX;
/// No texture.
pub const NO_TEXTURE: u32 = u32::MAX;
/// A body whose albedo is the same everywhere.
pub const NO_ALBEDO_MAP: u32 = u32::MAX;
/// Not a light.
pub const NO_LIGHT: u32 = u32::MAX;
/// No frame has this number: what the history holds before the first.
pub const NO_FRAME: u32 = u32::MAX;
/// Bit of [`BodyNode::body`]: the node has two nodes below it, and is no body.
pub const BODY_NODE_INNER: u32 = 1 << 31;
/// Not carried by a body.
pub const NO_INSTANCE: u32 = u32::MAX;
/// The projector's light falls on it.
pub const INSTANCE_PROJECTED: u32 = 1;
/// It has no triangles.
pub const INSTANCE_EMPTY: u32 = 2;
/// Steps of a horizon: the sine of an elevation in each octant of directions.
pub const HORIZON_STEPS: u32 = 15;
/// Back faces are shaded.
pub const MATERIAL_DOUBLE_SIDED: u32 = 1;
/// Transmission goes straight.
pub const MATERIAL_THIN: u32 = 2;
/// Light can pass, straight or in every direction.
pub const MATERIAL_TRANSMISSIVE: u32 = 4;
/// Alpha is the share of the surface that is there.
pub const MATERIAL_BLEND: u32 = 8;
/// Emissive triangle.
pub const LIGHT_TRIANGLE: u32 = 0;
/// Point light.
pub const LIGHT_POINT: u32 = 1;
/// Spot light.
pub const LIGHT_SPOT: u32 = 2;
/// Directional light.
pub const LIGHT_DIRECTIONAL: u32 = 3;
/// All emissive triangles of a body together, as a lamp: `position` is their centre, `direction` the sum of their areas along their normals,
/// `range` the area that shines in all directions alike, `intensity` their radiance.
pub const LIGHT_BODY: u32 = 4;
/// Nodes along a side of the octahedral map of a filtered sky. The outermost lie on its border, so that maps need no wrapping.
pub const SKY_NODES: u32 = 33;
/// Widths of lobes for which the sky is filtered: perceptual roughness from 1/4 to 1 in steps of 1/8. The cosine lobe comes after them.
pub const SKY_LOBES: u32 = 7;
/// Ordinary camera: radiance goes back along the primary ray, everything hit is lit (tests).
pub const FRAME_CAMERA_IS_EYE: u32 = 1;
/// Rates are decided per tile (\[paper\] section 2.2 and 2.3).
pub const FRAME_RATE_MAP: u32 = 2;
/// Half of the coarse pixels in each frame.
pub const FRAME_CHECKERBOARD: u32 = 4;
/// Samples by visual angle.
pub const FRAME_SPP_BY_ANGLE: u32 = 8;
/// Former frames are blended in; without it a traced pixel shows its own samples only.
pub const FRAME_TEMPORAL: u32 = 16;
/// Method dpm: every sample counts once in the history, radiance is filtered without its albedo.
pub const FRAME_DPM: u32 = 32;
/// Bits of [`HistoryNoise::body_and_used`]: samples used. They begin anew after the last; long before, the sequence repeats its points.
pub const HISTORY_USED: u32 = (1 << 23) - 1;
/// Bit of [`HistoryNoise::body_and_used`]: chance had no part in the last frame's light (a mirror of the sky), so that one sample told all of it.
pub const HISTORY_EXACT: u32 = 1 << 31;
/// Bit of [`HistoryTag::owner`]: the pixel itself was not lit in the last frame. Its history waits for a surface point that has just slipped out of it.
pub const HISTORY_HIDDEN: u32 = 2;
/// Bit of [`HistoryTag::owner`]: the point came into view at the border of what was known. It counts as long as the point has no sample of its
/// own.
pub const HISTORY_BORDER: u32 = 4;
/// Method dpm: samples go where they lower the error most.
pub const FRAME_ALLOCATE: u32 = 64;
/// Nothing has jumped, come or gone since the last frame: by so little has light moved that most pixels need not ask for it.
pub const FRAME_STEADY: u32 = 128;
/// The host reads what no pass needs: sights and the shown light of method dpm.
pub const FRAME_SHOWS_ALL: u32 = 256;
/// A pixel's demand (method dpm): it is not lit. Otherwise the pass `reproject` leaves its importance and the bits below, the pass `schedule`
/// [`DEMAND_NOT_TRACED`], and the pass `trace` the sum of the squared luminances of the samples as the bits of a float, with the sign if they are
/// exact.
pub const DEMAND_NOT_LIT: u32 = u32::MAX;
/// No ray of this frame begins at the pixel.
pub const DEMAND_NOT_TRACED: u32 = 0x7fff_ffff;
/// Bit of the demand before the pass `schedule`: as [`HISTORY_EXACT`].
pub const DEMAND_EXACT: u32 = 1 << 30;
/// Bit of the demand before the pass `schedule`: no sample of the point's sequence has been used.
pub const DEMAND_NEW: u32 = 1 << 29;
/// Entries of the table of \[Yang19\]'s b functions per octave of velocity.
pub const RATE_TABLE_OCTAVE: u32 = 1024;
/// Octaves of that table, from 2^-6 pixels per frame.
pub const RATE_TABLE_OCTAVES: u32 = 40;
/// Side of the blue-noise masks.
pub const NOISE_SIZE: u32 = 64;
/// Slices of the blue-noise masks.
pub const NOISE_FRAMES: u32 = 32;
/// Side of the directional-albedo table.
pub const ALBEDO_TABLE_SIZE: u32 = 32;
/// The surroundings are black.
pub const ENVIRONMENT_NONE: u32 = 0;
/// The same radiance comes from every direction.
pub const ENVIRONMENT_CONSTANT: u32 = 1;
/// Radiance comes from a map of directions.
pub const ENVIRONMENT_MAP: u32 = 2;
/// The lens does not bend rays.
pub const LENS_NONE: u32 = 0;
/// Radial, tangential, thin prism, and a tilted panel.
pub const LENS_BROWN: u32 = 1;
/// A fisheye.
pub const LENS_FISHEYE: u32 = 2;
/// Code values of a channel: the table of optics begins with so many thresholds for each of three channels if the light is not proportional
/// to the code value.
pub const RESPONSE_CODES: u32 = 256;
/// Nothing is at the pixel.
pub const OWNER_NONE: u32 = 0;
/// What is at the pixel stays where it was drawn. The owners after it are the movers, in their order.
pub const OWNER_STILL: u32 = 1;
/// Bit of [`Moved::word`]: the pixel is rough. Its code values lie by more than half of [`ROUGH_STEP`] off the middle between two neighbours.
pub const WORD_ROUGH: u32 = 1 << 31;
/// Twice the distance from the middle between the neighbours beyond which a pixel is rough, code values.
pub const ROUGH_STEP: u32 = 48;
/// Lanes of a workgroup of the pass `trace`.
pub const TRACE_LANES: u32 = 64;
/// On a GPU a workgroup of the pass `trace` takes the pixels whose first sample lies in its own range of at most so many: a little below three a
/// lane, because the samples of the last pixel may reach beyond the range.
pub const TRACE_GROUP_SAMPLES: u32 = 180;

/// How long the range of a workgroup of the pass `trace` is on a GPU that wants `groups` of them, for a list of so many items and samples. As
/// `shaders/glsl/group_samples.glsl`.
pub fn group_samples([items, samples]: [u32; 2], groups: u32) -> u32 {
    let each = samples / groups.max(1);
    match samples.div_ceil(items.max(1)) {
        0..=2 if each <= TRACE_LANES => TRACE_LANES - 4,
        0..=4 if each <= 2 * TRACE_LANES => 2 * TRACE_LANES - 8,
        _ => TRACE_GROUP_SAMPLES,
    }
}

/// Samples of a pixel, unless [`crate::specialization::MANY_SAMPLES`] is set.
pub const TRACE_PIXEL_SAMPLES: u32 = 128;
/// Samples for whose light such a workgroup has room: those of its range, and those of the last pixel beyond it.
pub const TRACE_SLOTS: u32 = 320;
/// Random numbers are independent for every path.
pub const SAMPLER_INDEPENDENT: u32 = 0;
/// One point set a frame, shifted at every pixel by blue noise.
pub const SAMPLER_BLUE_NOISE: u32 = 1;
/// One sequence a surface point, continued over frames.
pub const SAMPLER_CONTINUED: u32 = 2;
/// One sequence a pixel, continued over frames.
pub const SAMPLER_PIXEL_SEQUENCE: u32 = 3;

/// Part of a buffer that holds several values of each pixel: of every [`PART_BLOCK`] pixels those of one kind, then those of the next. A shader that
/// needs one kind does not touch the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    /// Binding of the buffer.
    pub binding: &'static str,
    /// Name of the part, as in `B_HISTORY.light`.
    pub name: &'static str,
    /// The struct of an element; empty: a number.
    pub element: &'static str,
    /// Bytes of an element.
    pub bytes: usize,
    /// Bytes of a pixel in the parts before it.
    pub before: usize,
    /// Bytes of a pixel in all parts.
    pub all: usize,
}

impl Counters {
    /// Rays that were walked through the scene: all that no horizon proves to meet nothing.
    pub fn walked_rays(&self) -> u32 {
        self.rays.saturating_sub(self.proven_rays)
    }
}

impl Part {
    /// Where the element of a pixel is, in elements: those of a block from one block to the next, and those before the part's first in a block.
    pub const fn steps(&self) -> [usize; 2] {
        let [all, before] = [self.all * PART_BLOCK, self.before];
        assert!(all.is_multiple_of(self.bytes) && before.is_multiple_of(self.bytes), "whole elements");
        [self.all * PART_BLOCK / self.bytes, self.before * PART_BLOCK / self.bytes]
    }

    /// Index of a pixel's element, in elements.
    pub const fn index(&self, pixel: usize) -> usize {
        let [block, first] = self.steps();
        pixel / PART_BLOCK * block + first + pixel % PART_BLOCK
    }
}

/// Consecutive pixels whose elements of one kind lie side by side. Parts that were as long as the raster would begin, for usual rasters, at the same
/// sets of a processor's caches, and would push each other out where a few pixels around one are read.
pub const PART_BLOCK: usize = 64;

/// Pixels for which a buffer with parts has room: whole blocks.
pub const fn in_blocks(pixels: usize) -> usize {
    pixels.next_multiple_of(PART_BLOCK)
}

macro_rules! parts {
    ($($binding:literal: $($name:literal $element:ident,)+;)*) => {
        /// The parts of every buffer that has some, in the order in which they lie.
        pub const PARTS: &[Part] = &[$($(Part {
            binding: $binding,
            name: $name,
            element: element_name(stringify!($element)),
            bytes: size_of::<$element>(),
            before: bytes_before($binding, $name),
            all: bytes_before($binding, ""),
        }),+),*];

        /// Bytes of a pixel in the parts of a buffer that lie before one of them; in all of them for no name.
        const fn bytes_before(binding: &str, name: &str) -> usize {
            let mut before = 0;
            $($(
                if same($binding, binding) {
                    if same($name, name) {
                        return before;
                    }
                    before += size_of::<$element>();
                }
            )+)*
            before
        }
    };
}

/// Whether two texts are equal, in constants.
const fn same(a: &str, b: &str) -> bool {
    let (a, b) = (a.as_bytes(), b.as_bytes());
    let mut i = 0;
    while i < a.len() && i < b.len() && a[i] == b[i] {
        i += 1;
    }
    i == a.len() && i == b.len()
}

/// A number is no struct.
const fn element_name(of: &'static str) -> &'static str {
    if same(of, "u32") {
        ""
    } else {
        of
    }
}

// The larger elements come first, so that each part begins at a whole element.
parts! {
    "B_SURFACES": "hit" SurfaceHit, "inside" Barycentric,;
    "B_GUIDES": "sight" Sight, "tint" Tint, "shift" Shift, "demand" u32,;
    "B_COARSE_SURFACES": "hit" SurfaceHit, "inside" Barycentric,;
    "B_HISTORY": "light" HistoryLight, "place" HistoryPlace, "noise" HistoryNoise, "tag" HistoryTag, "seed" HistorySeed, "used" HistoryUsed,;
    "B_FORMER": "light" HistoryLight, "place" HistoryPlace, "noise" HistoryNoise, "tag" HistoryTag, "seed" HistorySeed, "used" HistoryUsed,;
}

/// The part of a buffer.
///
/// # Panics
/// There is no such part, which is a mistake of the caller.
pub const fn part(binding: &str, name: &str) -> Part {
    let mut i = 0;
    while i < PARTS.len() {
        if same(PARTS[i].binding, binding) && same(PARTS[i].name, name) {
            return PARTS[i];
        }
        i += 1;
    }
    panic!("no such part")
}

/// A table that shaders read by `{reader}_at(i)`: elements of whole rows of four words, or of a half or a quarter of one.
pub(crate) struct Table {
    pub name: &'static str,
    pub reader: &'static str,
    /// Binding as storage.
    pub storage: &'static str,
    /// Binding as texels; another one where some shader writes the table.
    pub texel: &'static str,
    pub bytes: usize,
    /// Part of the buffer; `None`: the whole.
    pub part: Option<Part>,
    /// GLSL that makes an element of the rows r0, r1, ...
    pub from_rows: String,
    /// GLSL that makes it of the storage `{reader}_table[at]`.
    pub from_storage: String,
    /// GLSL that makes a row of an element `v`.
    pub to_words: String,
}

macro_rules! tables {
    ($($name:ident $reader:literal, $storage:literal $(. $part:literal)? or $texel:literal;)*) => {
        /// What `tables.glsl` is written from.
        pub(crate) fn tables() -> Vec<Table> {
            $(const { assert!(size_of::<$name>() % 16 == 0 || matches!(size_of::<$name>(), 4 | 8)) };)*
            vec![$(Table {
                name: stringify!($name),
                reader: $reader,
                storage: $storage,
                texel: $texel,
                bytes: size_of::<$name>(),
                part: [$(Some(part($storage, $part)),)? None][0],
                from_rows: $name::read_members(&mut 0),
                from_storage: $name::copy_members(concat!($reader, "_table[at]")),
                to_words: $name::words_of("v"),
            }),*]
        }

        /// Bindings that are texel buffers in the shaders that read tables so.
        pub const TEXEL_BINDINGS: &[&str] = &["B_NODES", "B_TRIANGLES", "B_QUEUE_ROWS", $($texel),*];
    };
}

tables! {
    Instance "instance", "B_INSTANCES" or "B_INSTANCES";
    BodyNode "body_node", "B_BODY_NODES" or "B_BODY_NODES";
    Vertex "vertex", "B_VERTICES" or "B_VERTICES";
    TriangleRef "triangle_ref", "B_TRIANGLE_REFS" or "B_TRIANGLE_REFS";
    Material "material", "B_MATERIALS" or "B_MATERIALS";
    AlbedoCell "albedo_cell", "B_ALBEDO" or "B_ALBEDO";
    TextureInfo "texture", "B_TEXTURES" or "B_TEXTURES";
    Texel "texel", "B_TEXELS" or "B_TEXELS";
    Light "light", "B_LIGHTS" or "B_LIGHTS";
    SkyTexel "sky", "B_ENVIRONMENT" or "B_ENVIRONMENT";
    SurfaceHit "surface", "B_SURFACES"."hit" or "B_SURFACE_ROWS";
    Barycentric "barycentric", "B_SURFACES"."inside" or "B_SURFACE_ROWS";
    SurfaceHit "coarse_surface", "B_COARSE_SURFACES"."hit" or "B_COARSE_SURFACES";
    Filtered "coarse_light", "B_COARSE_LIGHT" or "B_COARSE_LIGHT_ROWS";
    Sight "sight", "B_GUIDES"."sight" or "B_GUIDE_ROWS";
    Tint "tint", "B_GUIDES"."tint" or "B_GUIDE_ROWS";
    Shift "shift", "B_GUIDES"."shift" or "B_GUIDE_ROWS";
    HistoryLight "history_light", "B_HISTORY"."light" or "B_HISTORY_ROWS";
    HistoryPlace "history_place", "B_HISTORY"."place" or "B_HISTORY_ROWS";
    HistoryNoise "history_noise", "B_HISTORY"."noise" or "B_HISTORY_ROWS";
    HistoryTag "history_tag", "B_HISTORY"."tag" or "B_HISTORY_ROWS";
    HistorySeed "history_seed", "B_HISTORY"."seed" or "B_HISTORY_ROWS";
    HistoryUsed "history_used", "B_HISTORY"."used" or "B_HISTORY_ROWS";
    HistoryLight "former_light", "B_FORMER"."light" or "B_FORMER";
    HistoryPlace "former_place", "B_FORMER"."place" or "B_FORMER";
    HistoryNoise "former_noise", "B_FORMER"."noise" or "B_FORMER";
    HistoryTag "former_tag", "B_FORMER"."tag" or "B_FORMER";
    HistorySeed "former_seed", "B_FORMER"."seed" or "B_FORMER";
    Filtered "filtered", "B_FILTERED" or "B_FILTERED_ROWS";
}

/// Descriptor bindings of set 0, the same in every shader.
pub const BINDINGS: &[(&str, u32)] = &[
    ("B_FRAME", 0),
    ("B_INSTANCES", 1),
    ("B_NODES", 2),
    ("B_TRIANGLES", 3),
    ("B_TRIANGLE_REFS", 4),
    ("B_VERTICES", 5),
    ("B_MATERIALS", 6),
    ("B_TEXTURES", 7),
    ("B_TEXELS", 8),
    ("B_LIGHTS", 9),
    ("B_ENVIRONMENT", 10),
    ("B_ALBEDO", 11),
    ("B_TILES", 12),
    ("B_SURFACES", 13),
    ("B_RADIANCE", 14),
    ("B_CODES", 15),
    ("B_COUNTERS", 16),
    ("B_GUIDES", 17),
    ("B_HISTORY", 18),
    ("B_RATES", 19),
    ("B_BODY_NODES", 20),
    ("B_SCHEDULE", 21),
    ("B_WORK", 22),
    ("B_NOISE", 23),
    ("B_FILTERED", 24),
    ("B_SHOWN", 25),
    ("B_PLANES", 26),
    ("B_SURFACE_ROWS", 27),
    ("B_GUIDE_ROWS", 28),
    ("B_HISTORY_ROWS", 29),
    ("B_FILTERED_ROWS", 30),
    ("B_FORMER", 31),
    ("B_OPTICS", 32),
    ("B_MOTION", 33),
    ("B_MOVERS", 34),
    ("B_PLANE_GROUPS", 35),
    ("B_QUEUE", 37),
    ("B_QUEUE_ROWS", 38),
    ("B_COARSE_FRAME", 39),
    ("B_COARSE_SURFACES", 40),
    ("B_COARSE_LIGHT", 41),
    ("B_COARSE_LIGHT_ROWS", 42),
];

/// Whether a binding is bound on software Vulkan only: the second bindings of buffers, as texels, and the rays that the host walks.
pub fn is_of_software(binding: &str) -> bool {
    binding.ends_with("_ROWS") || binding == "B_QUEUE"
}

/// Whether a binding is bound only where a reduced raster is enlarged: some devices bind no more than the 32 buffers of the others.
pub fn is_of_enlarging(binding: &str) -> bool {
    binding.starts_with("B_COARSE")
}

/// The binding after them, of the shaders that ask the device for hits: no buffer, but the tree over the bodies of the frame.
pub const TREE_BINDING: (&str, u32) = ("B_BODY_TREE", 36);
