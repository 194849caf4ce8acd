// Written by build-shaders from shaders/src/structs.rs and shaders/src/specialization.rs. Do not edit.

#extension GL_EXT_shader_explicit_arithmetic_types_int64 : require

#define NO_HIT 4294967295u
#define NO_TEXTURE 4294967295u
#define NO_INSTANCE 4294967295u
#define NO_ALBEDO_MAP 4294967295u
#define NO_LIGHT 4294967295u
#define NO_FRAME 4294967295u
#define INSTANCE_PROJECTED 1u
#define INSTANCE_EMPTY 2u
#define BODY_NODE_INNER 2147483648u
#define HORIZON_STEPS 15u
#define MATERIAL_DOUBLE_SIDED 1u
#define MATERIAL_THIN 2u
#define MATERIAL_TRANSMISSIVE 4u
#define MATERIAL_BLEND 8u
#define LIGHT_TRIANGLE 0u
#define LIGHT_POINT 1u
#define LIGHT_SPOT 2u
#define LIGHT_DIRECTIONAL 3u
#define LIGHT_BODY 4u
#define SKY_NODES 33u
#define SKY_LOBES 7u
#define FRAME_CAMERA_IS_EYE 1u
#define FRAME_RATE_MAP 2u
#define FRAME_CHECKERBOARD 4u
#define FRAME_SPP_BY_ANGLE 8u
#define FRAME_TEMPORAL 16u
#define FRAME_DPM 32u
#define HISTORY_USED 8388607u
#define HISTORY_EXACT 2147483648u
#define HISTORY_HIDDEN 2u
#define HISTORY_BORDER 4u
#define FRAME_ALLOCATE 64u
#define FRAME_STEADY 128u
#define FRAME_SHOWS_ALL 256u
#define DEMAND_NOT_LIT 4294967295u
#define DEMAND_NOT_TRACED 2147483647u
#define DEMAND_EXACT 1073741824u
#define DEMAND_NEW 536870912u
#define RATE_TABLE_OCTAVE 1024u
#define RATE_TABLE_OCTAVES 40u
#define NOISE_SIZE 64u
#define NOISE_FRAMES 32u
#define ALBEDO_TABLE_SIZE 32u
#define ENVIRONMENT_NONE 0u
#define ENVIRONMENT_CONSTANT 1u
#define ENVIRONMENT_MAP 2u
#define LENS_NONE 0u
#define LENS_BROWN 1u
#define LENS_FISHEYE 2u
#define RESPONSE_CODES 256u
#define OWNER_NONE 0u
#define OWNER_STILL 1u
#define WORD_ROUGH 2147483648u
#define ROUGH_STEP 48u
#define TRACE_LANES 64u
#define TRACE_GROUP_SAMPLES 180u
#define TRACE_PIXEL_SAMPLES 128u
#define TRACE_SLOTS 320u
#define RAY_NONE 0u
#define RAY_CLOSEST 1u
#define RAY_ANY 2u
#define SAMPLER_INDEPENDENT 0u
#define SAMPLER_BLUE_NOISE 1u
#define SAMPLER_CONTINUED 2u
#define SAMPLER_PIXEL_SEQUENCE 3u
#define B_FRAME 0u
#define B_INSTANCES 1u
#define B_NODES 2u
#define B_TRIANGLES 3u
#define B_TRIANGLE_REFS 4u
#define B_VERTICES 5u
#define B_MATERIALS 6u
#define B_TEXTURES 7u
#define B_TEXELS 8u
#define B_LIGHTS 9u
#define B_ENVIRONMENT 10u
#define B_ALBEDO 11u
#define B_TILES 12u
#define B_SURFACES 13u
#define B_RADIANCE 14u
#define B_CODES 15u
#define B_COUNTERS 16u
#define B_GUIDES 17u
#define B_HISTORY 18u
#define B_RATES 19u
#define B_BODY_NODES 20u
#define B_SCHEDULE 21u
#define B_WORK 22u
#define B_NOISE 23u
#define B_FILTERED 24u
#define B_SHOWN 25u
#define B_PLANES 26u
#define B_SURFACE_ROWS 27u
#define B_GUIDE_ROWS 28u
#define B_HISTORY_ROWS 29u
#define B_FILTERED_ROWS 30u
#define B_FORMER 31u
#define B_OPTICS 32u
#define B_MOTION 33u
#define B_MOVERS 34u
#define B_PLANE_GROUPS 35u
#define B_QUEUE 37u
#define B_QUEUE_ROWS 38u
#define B_COARSE_FRAME 39u
#define B_COARSE_SURFACES 40u
#define B_COARSE_LIGHT 41u
#define B_COARSE_LIGHT_ROWS 42u
#define B_BODY_TREE 36u
// Index of a pixel's element in a part of a buffer.
#define SURFACES_HIT_AT(i) (((i) >> 6u) * 128u + 0u + ((i) & 63u))
#define SURFACES_INSIDE_AT(i) (((i) >> 6u) * 128u + 64u + ((i) & 63u))
#define GUIDES_SIGHT_AT(i) (((i) >> 6u) * 144u + 0u + ((i) & 63u))
#define GUIDES_TINT_AT(i) (((i) >> 6u) * 288u + 128u + ((i) & 63u))
#define GUIDES_SHIFT_AT(i) (((i) >> 6u) * 288u + 192u + ((i) & 63u))
#define GUIDES_DEMAND_AT(i) (((i) >> 6u) * 576u + 512u + ((i) & 63u))
#define COARSE_SURFACES_HIT_AT(i) (((i) >> 6u) * 128u + 0u + ((i) & 63u))
#define COARSE_SURFACES_INSIDE_AT(i) (((i) >> 6u) * 128u + 64u + ((i) & 63u))
#define HISTORY_LIGHT_AT(i) (((i) >> 6u) * 256u + 0u + ((i) & 63u))
#define HISTORY_PLACE_AT(i) (((i) >> 6u) * 256u + 64u + ((i) & 63u))
#define HISTORY_NOISE_AT(i) (((i) >> 6u) * 256u + 128u + ((i) & 63u))
#define HISTORY_TAG_AT(i) (((i) >> 6u) * 512u + 384u + ((i) & 63u))
#define HISTORY_SEED_AT(i) (((i) >> 6u) * 1024u + 896u + ((i) & 63u))
#define HISTORY_USED_AT(i) (((i) >> 6u) * 1024u + 960u + ((i) & 63u))
// Sobol dimensions 1 to 3 of the lowest 16 bits of an index, without branch or table look-up.
#define SOBOL_123(i) uvec3((uint(bitfieldExtract(int(i), 0, 1)) & 2147483648u) ^ (uint(bitfieldExtract(int(i), 1, 1)) & 3221225472u) ^ (uint(bitfieldExtract(int(i), 2, 1)) & 2684354560u) ^ (uint(bitfieldExtract(int(i), 3, 1)) & 4026531840u) ^ (uint(bitfieldExtract(int(i), 4, 1)) & 2281701376u) ^ (uint(bitfieldExtract(int(i), 5, 1)) & 3422552064u) ^ (uint(bitfieldExtract(int(i), 6, 1)) & 2852126720u) ^ (uint(bitfieldExtract(int(i), 7, 1)) & 4278190080u) ^ (uint(bitfieldExtract(int(i), 8, 1)) & 2155872256u) ^ (uint(bitfieldExtract(int(i), 9, 1)) & 3233808384u) ^ (uint(bitfieldExtract(int(i), 10, 1)) & 2694840320u) ^ (uint(bitfieldExtract(int(i), 11, 1)) & 4042260480u) ^ (uint(bitfieldExtract(int(i), 12, 1)) & 2290614272u) ^ (uint(bitfieldExtract(int(i), 13, 1)) & 3435921408u) ^ (uint(bitfieldExtract(int(i), 14, 1)) & 2863267840u) ^ (uint(bitfieldExtract(int(i), 15, 1)) & 4294901760u), (uint(bitfieldExtract(int(i), 0, 1)) & 2147483648u) ^ (uint(bitfieldExtract(int(i), 1, 1)) & 3221225472u) ^ (uint(bitfieldExtract(int(i), 2, 1)) & 1610612736u) ^ (uint(bitfieldExtract(int(i), 3, 1)) & 2415919104u) ^ (uint(bitfieldExtract(int(i), 4, 1)) & 3892314112u) ^ (uint(bitfieldExtract(int(i), 5, 1)) & 1543503872u) ^ (uint(bitfieldExtract(int(i), 6, 1)) & 2382364672u) ^ (uint(bitfieldExtract(int(i), 7, 1)) & 3305111552u) ^ (uint(bitfieldExtract(int(i), 8, 1)) & 1753219072u) ^ (uint(bitfieldExtract(int(i), 9, 1)) & 2629828608u) ^ (uint(bitfieldExtract(int(i), 10, 1)) & 3999268864u) ^ (uint(bitfieldExtract(int(i), 11, 1)) & 1435500544u) ^ (uint(bitfieldExtract(int(i), 12, 1)) & 2154299392u) ^ (uint(bitfieldExtract(int(i), 13, 1)) & 3231449088u) ^ (uint(bitfieldExtract(int(i), 14, 1)) & 1626210304u) ^ (uint(bitfieldExtract(int(i), 15, 1)) & 2421489664u), (uint(bitfieldExtract(int(i), 0, 1)) & 2147483648u) ^ (uint(bitfieldExtract(int(i), 1, 1)) & 3221225472u) ^ (uint(bitfieldExtract(int(i), 2, 1)) & 536870912u) ^ (uint(bitfieldExtract(int(i), 3, 1)) & 1342177280u) ^ (uint(bitfieldExtract(int(i), 4, 1)) & 4160749568u) ^ (uint(bitfieldExtract(int(i), 5, 1)) & 1946157056u) ^ (uint(bitfieldExtract(int(i), 6, 1)) & 2717908992u) ^ (uint(bitfieldExtract(int(i), 7, 1)) & 2466250752u) ^ (uint(bitfieldExtract(int(i), 8, 1)) & 3632267264u) ^ (uint(bitfieldExtract(int(i), 9, 1)) & 624951296u) ^ (uint(bitfieldExtract(int(i), 10, 1)) & 1507852288u) ^ (uint(bitfieldExtract(int(i), 11, 1)) & 3872391168u) ^ (uint(bitfieldExtract(int(i), 12, 1)) & 2013790208u) ^ (uint(bitfieldExtract(int(i), 13, 1)) & 3020685312u) ^ (uint(bitfieldExtract(int(i), 14, 1)) & 2181169152u) ^ (uint(bitfieldExtract(int(i), 15, 1)) & 3271884800u))

// The host sets these before the first frame. What they switch off is compiled away.
// A material of the scene has a texture.
layout(constant_id = 0) const bool HAS_TEXTURES = true;
// A material of the scene has a normal map.
layout(constant_id = 1) const bool HAS_NORMAL_MAPS = true;
// A material of the scene has holes where its alpha is low.
layout(constant_id = 2) const bool HAS_ALPHA_MASK = true;
// A material of the scene lets light through.
layout(constant_id = 3) const bool HAS_TRANSMISSION = true;
// A material of the scene has a specular lobe: it is metallic, or its index of refraction is not 1.
layout(constant_id = 4) const bool HAS_SPECULAR = true;
// A triangle of the scene emits light.
layout(constant_id = 5) const bool HAS_EMISSIVE = true;
// The scene has a point, spot or directional light.
layout(constant_id = 6) const bool HAS_PUNCTUAL = true;
// Light from the surroundings, as `ENVIRONMENT_*`.
layout(constant_id = 7) const uint ENVIRONMENT_KIND = 2u;
// The luminance of indirect contributions is limited.
layout(constant_id = 8) const bool HAS_CLAMP = true;
// A material of the scene has a diffuse lobe: it is not metallic everywhere.
layout(constant_id = 9) const bool HAS_DIFFUSE = true;
// The scene has so many bodies that rays look for them in a tree. Of few they ask each.
layout(constant_id = 10) const bool HAS_BODY_TREE = true;
// Where random numbers come from, as `SAMPLER_*`.
layout(constant_id = 11) const uint SAMPLER = 0u;
// Guides are written, because a pass between tracing and compensation reads them.
layout(constant_id = 12) const bool HAS_GUIDES = true;
// Radiance is divided by the albedo of the surface before it is filtered.
layout(constant_id = 13) const bool HAS_DEMODULATION = true;
// The picture is filtered in space.
layout(constant_id = 14) const bool HAS_FILTER = true;
// How the projector's lens bends rays, as `LENS_*`.
layout(constant_id = 15) const uint LENS = 0u;
// The projector's light is not proportional to the code value.
layout(constant_id = 16) const bool HAS_RESPONSE = false;
// The projector's pixels are not equally bright.
layout(constant_id = 17) const bool HAS_FLAT_FIELD = false;
// The albedo of some body's real surface is a picture over its texture coordinates.
layout(constant_id = 18) const bool HAS_ALBEDO_MAPS = false;
// Parts of a frame in which each channel shows its code value.
layout(constant_id = 19) const uint HALFTONE_PARTS = 8u;
// Bits of a part.
layout(constant_id = 20) const uint HALFTONE_DEPTH = 1u;
// The planes are white, and show the green code value.
layout(constant_id = 21) const bool HALFTONE_WHITE = false;
// Planes that follow are taken from whole words, which are halftones and hold no code values.
layout(constant_id = 22) const bool WARP_WHOLE_WORDS = false;
// Width of the bit planes, pixels.
layout(constant_id = 23) const uint PLANE_WIDTH = 1u;
// Height of the bit planes, pixels.
layout(constant_id = 24) const uint PLANE_HEIGHT = 1u;
// Which planes show bits 0 to 3 of a code value, a byte each from the lowest on; 255: none does.
layout(constant_id = 25) const uint PLANE_OF_BITS_0 = 4294967295u;
// The same for bits 4 to 7.
layout(constant_id = 26) const uint PLANE_OF_BITS_4 = 4294967295u;
// The same for bits 8 to 11.
layout(constant_id = 27) const uint PLANE_OF_BITS_8 = 4294967295u;
// The same for bits 12 to 15.
layout(constant_id = 28) const uint PLANE_OF_BITS_12 = 4294967295u;
// The same for bits 16 to 19.
layout(constant_id = 29) const uint PLANE_OF_BITS_16 = 4294967295u;
// The same for bits 20 to 23.
layout(constant_id = 30) const uint PLANE_OF_BITS_20 = 4294967295u;
// On GPUs: groups of nodes that may wait while a ray walks through a body, at most one for each level of the deepest tree.
layout(constant_id = 31) const uint WALK_STACK = 24u;
// On GPUs: a pixel may have more than `TRACE_PIXEL_SAMPLES` samples, so that those of a workgroup may take several rounds. The loop over the rounds costs registers even where there is one.
layout(constant_id = 32) const bool MANY_SAMPLES = true;
// On GPUs: workgroups of the pass `trace` that keep the whole device busy to the end. A list that has too few samples for so many is cut into shorter ranges, because a lane that takes three samples one after the other while others idle makes the pass longer.
layout(constant_id = 33) const uint TRACE_GROUPS = 1024u;
// A material of the scene has a clear coat.
layout(constant_id = 34) const bool HAS_CLEARCOAT = true;
// A dielectric of the scene reflects in a colour of its own, or less than its index says.
layout(constant_id = 35) const bool HAS_SPECULAR_COLOR = true;
// A material of the scene is rougher along one direction.
layout(constant_id = 36) const bool HAS_ANISOTROPY = true;
// A material of the scene has fibres.
layout(constant_id = 37) const bool HAS_SHEEN = true;
// A solid of the scene absorbs light.
layout(constant_id = 38) const bool HAS_ABSORPTION = true;
// A material of the scene is partly there.
layout(constant_id = 39) const bool HAS_ALPHA_BLEND = true;
// A material of the scene has a thin film.
layout(constant_id = 40) const bool HAS_IRIDESCENCE = true;
// Light shines through a material of the scene in every direction.
layout(constant_id = 41) const bool HAS_DIFFUSE_TRANSMISSION = true;
// A solid of the scene refracts colours differently.
layout(constant_id = 42) const bool HAS_DISPERSION = true;
// Bits below the parts of a halftone, which are shown once. Above 0, the pass `warp` cuts code values into levels.
layout(constant_id = 43) const uint HALFTONE_LOW = 0u;
// Lamps by which histories are relit. A loop over one of them is no loop.
layout(constant_id = 44) const uint LAMPS = 2u;

struct Frame {
    vec3 projector_position;
    uint seed;
    vec4 world_from_projector[3];
    vec4 intrinsics;
    vec3 eye_position;
    uint frame;
    vec3 gaze_point;
    uint instance_count;
    uint width;
    uint height;
    uint spp;
    uint depth;
    uint tile_count;
    uint tiles_x;
    float clamp_indirect;
    vec3 ambient;
    uint light_count;
    uint flags;
    vec3 environment;
    uint environment_width;
    uint environment_height;
    float environment_rotation;
    float environment_select;
    vec3 world_origin;
    uint history_frame;
    float budget_spp;
    float history_cap;
    uvec3 zone_spp;
    vec3 zone_alpha;
    vec2 zone_degrees;
    vec2 filter_degrees;
    float rate_t;
    float rate_l;
    float pixel_size;
    uint drawn;
    uint first_sample;
    vec4 lens[3];
    vec4 lens_tilt[3];
    float lens_limit;
    uint rays_at;
    uint flat_field_at;
    uint rate_table_at;
    uint mover_count;
    uint group_count;
    uint body_nodes;
    float mean_light;
};

struct Mover {
    vec4 motion_from_object[3];
    ivec2 lower;
    ivec2 upper;
    ivec2 centre;
    ivec2 start;
    ivec4 slope;
    int instant;
    uvec2 in_turn;
};

struct Moved {
    uint word;
    uint motion;
    uint owner_and_depth;
};

struct PlaneGroup {
    uint mask;
    int instant;
};

struct Sight {
    vec2 motion;
    float size;
    float angle;
};

struct Tint {
    uint albedo_rg;
    uint albedo_b_and_angle;
};

struct Shift {
    uvec2 halves;
};

struct HistoryLight {
    vec3 mean;
    float weight;
};

struct HistoryPlace {
    vec3 position;
    uint normal;
};

struct HistoryNoise {
    float drift;
    float variance;
    float surprise;
    uint body_and_used;
};

struct HistoryTag {
    uint owner;
    uint frame;
};

struct HistorySeed {
    uint seed;
};

struct HistoryUsed {
    int before;
};

struct WorkItem {
    uint pixel;
    uint first;
};

struct Schedule {
    uvec3 groups;
    uint importance;
    uint64_t listed;
    uint lit;
    uint unused;
};

struct Filtered {
    vec3 light;
    uint weight_and_albedo;
};

struct Instance {
    vec4 world_from_object[3];
    vec4 object_from_world[3];
    vec3 bounds_min;
    uint node_offset;
    vec3 bounds_max;
    uint triangle_offset;
    vec4 previous_world_from_object[3];
    uint flags;
    uint body;
    float extent;
    uint mover;
    vec3 drive_gain;
    uint albedo_map;
};

struct BodyNode {
    vec3 lower;
    uint after;
    vec3 upper;
    uint body;
};

struct Vertex {
    vec3 normal;
    vec2 uv;
    vec4 tangent;
    uvec3 reserved;
};

struct TriangleRef {
    uvec3 vertices;
    uint material;
    uint light;
    uvec3 reserved;
};

struct TextureUse {
    uint texture;
    vec3 row_u;
    vec3 row_v;
};

struct Material {
    vec3 base_color;
    float alpha;
    vec3 emissive;
    float alpha_cutoff;
    float metallic;
    float roughness;
    float ior;
    float transmission;
    float normal_scale;
    uint flags;
    uint albedo_table;
    TextureUse base_color_texture;
    TextureUse metallic_roughness_texture;
    TextureUse normal_texture;
    TextureUse emissive_texture;
    TextureUse transmission_texture;
    float coat;
    float coat_roughness;
    float coat_normal_scale;
    uint coat_table;
    uint white_table;
    uint sheen_table;
    float specular;
    vec3 specular_color;
    float anisotropy;
    vec2 anisotropy_direction;
    vec3 sheen_color;
    float sheen_roughness;
    float film;
    float film_ior;
    vec2 film_thickness;
    vec3 absorption;
    float shine;
    vec3 shine_color;
    float dispersion;
    TextureUse coat_texture;
    TextureUse coat_roughness_texture;
    TextureUse coat_normal_texture;
    TextureUse specular_texture;
    TextureUse specular_color_texture;
    TextureUse anisotropy_texture;
    TextureUse sheen_color_texture;
    TextureUse sheen_roughness_texture;
    TextureUse film_texture;
    TextureUse film_thickness_texture;
    TextureUse shine_texture;
    TextureUse shine_color_texture;
    uint reserved;
};

struct TextureInfo {
    uint offset;
    uint width;
    uint height;
    uint flags;
};

struct Light {
    uint kind;
    uint instance;
    uint triangle;
    float select;
    float alias_keep;
    uint alias_other;
    vec3 position;
    vec3 direction;
    vec3 intensity;
    float cone_scale;
    float cone_offset;
    float range;
    uvec2 unused;
};

struct Texel {
    uvec2 shares;
};

struct SkyTexel {
    vec3 light;
    float cumulative;
};

struct AlbedoCell {
    vec4 corners;
};

struct SurfaceHit {
    uint id;
    float distance;
};

struct Barycentric {
    vec2 weights;
};

struct Counters {
    uint rays;
    uint camera_rays;
    uint proven_rays;
    uint samples;
    uint invalid_samples;
    uint lit_pixels;
    uint clipped_values;
    uint nan_values;
    uint clamped_samples;
};

