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

