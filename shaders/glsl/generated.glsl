// Written by build-shaders from shaders/src/structs.rs. Do not edit.

#define NO_HIT 4294967295u
#define NO_TEXTURE 4294967295u
#define NO_INSTANCE 4294967295u
#define NO_LIGHT 4294967295u
#define INSTANCE_PROJECTED 1u
#define INSTANCE_EMPTY 2u
#define MATERIAL_DOUBLE_SIDED 1u
#define MATERIAL_THIN 2u
#define MATERIAL_TRANSMISSIVE 4u
#define LIGHT_TRIANGLE 0u
#define LIGHT_POINT 1u
#define LIGHT_SPOT 2u
#define LIGHT_DIRECTIONAL 3u
#define FRAME_CAMERA_IS_EYE 1u
#define FRAME_RATE_MAP 2u
#define FRAME_CHECKERBOARD 4u
#define FRAME_SPP_BY_ANGLE 8u
#define FRAME_TEMPORAL 16u
#define FRAME_DPM 32u
#define FRAME_ALLOCATE 64u
#define RATE_TABLE_OCTAVE 1024u
#define RATE_TABLE_OCTAVES 40u
#define NOISE_SIZE 64u
#define NOISE_FRAMES 32u
#define ALBEDO_TABLE_SIZE 32u
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
#define B_RATE_TABLE 20u
#define B_SCHEDULE 21u
#define B_WORK 22u
#define B_NOISE 23u
#define B_FILTERED 24u
#define B_SHOWN 25u
#define B_TILE_STATES 26u
#define SOBOL_ROW_1 2147483648u, 3221225472u, 2684354560u, 4026531840u, 2281701376u, 3422552064u, 2852126720u, 4278190080u, 2155872256u, 3233808384u, 2694840320u, 4042260480u, 2290614272u, 3435921408u, 2863267840u, 4294901760u, 2147516416u, 3221274624u, 2684395520u, 4026593280u, 2281736192u, 3422604288u, 2852170240u, 4278255360u, 2155905152u, 3233857728u, 2694881440u, 4042322160u, 2290649224u, 3435973836u, 2863311530u, 4294967295u
#define SOBOL_ROW_2 2147483648u, 3221225472u, 1610612736u, 2415919104u, 3892314112u, 1543503872u, 2382364672u, 3305111552u, 1753219072u, 2629828608u, 3999268864u, 1435500544u, 2154299392u, 3231449088u, 1626210304u, 2421489664u, 3900735488u, 1556135936u, 2388680704u, 3314585600u, 1751705600u, 2627492864u, 4008611328u, 1431684352u, 2147543168u, 3221249216u, 1610649184u, 2415969680u, 3892340840u, 1543543964u, 2382425838u, 3305133397u
#define SOBOL_ROW_3 2147483648u, 3221225472u, 536870912u, 1342177280u, 4160749568u, 1946157056u, 2717908992u, 2466250752u, 3632267264u, 624951296u, 1507852288u, 3872391168u, 2013790208u, 3020685312u, 2181169152u, 3271884800u, 546275328u, 1363623936u, 4226424832u, 1977167872u, 2693105664u, 2437829632u, 3689389568u, 635137280u, 1484783744u, 3846176960u, 2044723232u, 3067084880u, 2148008184u, 3222012020u, 537002146u, 1342505107u

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
    float drive_gain;
    vec3 ambient;
    uint light_count;
    uint flags;
    vec3 environment;
    uint environment_width;
    uint environment_height;
    float environment_rotation;
    float environment_select;
    vec3 world_origin;
    uint parity;
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
};

struct Guide {
    vec2 motion;
    float size;
    float angle;
    uint albedo_rg;
    uint albedo_b;
};

struct History {
    vec3 mean;
    float weight;
    vec3 position;
    uint normal;
    float fast;
    float variance;
    float last;
    float noise;
    uint seed;
    uint index;
    uint instance;
    uint frame;
};

struct TileState {
    float cap;
    int lag;
    int noise;
    uint count;
};

struct WorkItem {
    uint pixel;
    uint spp;
};

struct Schedule {
    uvec3 groups;
    uint items;
    uint importance;
    uint lit;
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
};

struct Vertex {
    vec3 normal;
    vec2 uv;
    vec4 tangent;
};

struct TriangleRef {
    uvec3 vertices;
    uint material;
    uint light;
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
};

struct Surface {
    uint id;
    vec2 barycentric;
    float distance;
};

struct Counters {
    uint closest_rays;
    uint shadow_rays;
    uint samples;
    uint invalid_samples;
    uint lit_pixels;
    uint clipped_values;
    uint nan_values;
    uint clamped_samples;
};

