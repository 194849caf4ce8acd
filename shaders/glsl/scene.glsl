// Bindings and small functions that most shaders use.
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_EXT_control_flow_attributes : require
#include "generated.glsl"
#include "tables.glsl"

// Where the body and the material of a surface are read, unless the shader that includes this file has read them before.
#ifndef BODY_AT
#define BODY_AT(i) instance_at(i)
#define MATERIAL_AT(i) material_at(i)
#endif

// A loop over a few pixels around. On software Vulkan it is written out and has no branch: there a loop keeps in memory what it carries, and an `if`
// writes that under a mask and skips nothing. On GPUs it stays a loop, because it would take registers, and skips what does not count.
#ifdef TEXEL_TABLES
#define WRITTEN_OUT [[unroll]]
#define SKIP_UNLESS(counts)
#else
#define WRITTEN_OUT [[dont_unroll]]
#define SKIP_UNLESS(counts) if (!(counts)) continue;
#endif

// A storage block, although it is small. Mesa's software Vulkan compiles a shader again for every value of a uniform block that a branch or loop
// reads, which took 15 ms of every frame. The block is read once, where every lane is active, because elsewhere software Vulkan reads lane by lane.
// With FRAME_WHERE_USED it is read where it is used: held from the start to the end it would fill the scalar registers of AMD's GPUs, which the pass
// `trace` and queries need.
#ifdef FRAME_WHERE_USED
layout(set = 0, binding = B_FRAME, scalar) readonly buffer FrameBlock { Frame frame; };
#else
layout(set = 0, binding = B_FRAME, scalar) readonly buffer FrameBlock { Frame frame_block; };
Frame frame = frame_block;
#endif
layout(set = 0, binding = B_COUNTERS, scalar) buffer CountersBlock { Counters counters; };

const float PI = 3.14159265358979;
const float INFINITY = 3.0e38;
// The eye averages over this many frames: 33 ms at 947 fps.
const float EYE_FRAMES = 31.0;
// Weight of a frame in the mean that measures how far a history lags.
const float LAG_WEIGHT = 0.0625;

// Samples that a pixel gets in a frame on average (method dpm). The lengths of histories are given in such frames.
float samples_a_frame() { return max(frame.budget_spp, 0.5); }

vec3 transform_point(vec4 rows[3], vec3 p) {
    return vec3(dot(rows[0], vec4(p, 1.0)), dot(rows[1], vec4(p, 1.0)), dot(rows[2], vec4(p, 1.0)));
}

vec3 transform_vector(vec4 rows[3], vec3 v) {
    return vec3(dot(rows[0].xyz, v), dot(rows[1].xyz, v), dot(rows[2].xyz, v));
}

// All transforms are rigid, so the inverse transpose of the linear part is the linear part itself.
vec3 transform_normal(vec4 rows[3], vec3 n) { return normalize(transform_vector(rows, n)); }

float luminance(vec3 c) { return dot(c, vec3(0.2126, 0.7152, 0.0722)); }

// GLSL does not define min, max and clamp of NaN, so whether a value is finite is tested by its bits.
bool finite(float x) { return (floatBitsToUint(x) & 0x7f800000u) != 0x7f800000u; }
bool finite3(vec3 v) { return finite(v.x) && finite(v.y) && finite(v.z); }

// Adds the counts of all lanes to a counter, with one atomic operation per subgroup.
#define COUNT(counter, value) { uint total_ = subgroupAdd(value); if (subgroupElect() && total_ != 0u) atomicAdd(counters.counter, total_); }
// The same for counts that are nearly always 0. It avoids a sum over the lanes, which costs software Vulkan half as much as a node of the traversal.
#define COUNT_RARE(counter, value) { if ((value) != 0u) atomicAdd(counters.counter, value); }

// What differs from pixel to pixel and does not change while the rig runs: thresholds of the response, flat field, straight rays;
// albedo maps; and the blur of a moving eye.
layout(set = 0, binding = B_OPTICS, scalar) readonly buffer Optics { float optics[]; };

// The straight ray of a pixel's centre: x / z to the right and y / z down, before the lens.
vec2 straight_ray(ivec2 pixel) {
    uint at = frame.rays_at + 2u * (uint(pixel.y) * frame.width + uint(pixel.x));
    return vec2(optics[at], optics[at + 1u]);
}

// Unit direction, in world space, of a straight ray of the projector.
vec3 direction_of(vec2 straight) { return normalize(transform_vector(frame.world_from_projector, vec3(straight.x, -straight.y, -1.0))); }

// The straight ray of a raster position without a lens.
vec2 unbent_ray(vec2 raster) { return vec2((raster.x - frame.intrinsics.z) / frame.intrinsics.x, (raster.y - frame.intrinsics.w) / frame.intrinsics.y); }

// Unit direction, in world space, of the ray through a pixel's centre.
vec3 pixel_direction(uvec2 pixel) { return direction_of(LENS == LENS_NONE ? unbent_ray(vec2(pixel) + 0.5) : straight_ray(ivec2(pixel))); }

// The same through any raster position. Pixel centres are at half integers. Between them the straight rays of a lens are interpolated, and half a
// pixel around the raster they are continued.
vec3 projector_direction(vec2 raster) {
    if (LENS == LENS_NONE) return direction_of(unbent_ray(raster));
    vec2 p = raster - 0.5;
    ivec2 last = ivec2(frame.width, frame.height) - 1;
    ivec2 from = clamp(ivec2(floor(p)), ivec2(0), max(last - 1, ivec2(0))), to = min(from + 1, last);
    vec2 part = p - vec2(from);
    vec2 upper = mix(straight_ray(from), straight_ray(ivec2(to.x, from.y)), part.x);
    vec2 lower = mix(straight_ray(ivec2(from.x, to.y)), straight_ray(to), part.x);
    return direction_of(mix(upper, lower, part.y));
}

// The bent ray of a straight one, by OpenCV's definitions.
vec2 bend(vec2 p) {
    float r2 = dot(p, p);
    if (LENS == LENS_FISHEYE) {
        float r = sqrt(r2), angle = atan(r), a2 = angle * angle;
        vec4 k = frame.lens[0];
        float bent = angle * (1.0 + a2 * (k.x + a2 * (k.y + a2 * (k.z + a2 * k.w))));
        return r > 1e-6 ? p * (bent / r) : p;
    }
    vec4 k = frame.lens[0], rational = frame.lens[1], prism = frame.lens[2];
    float radial = (1.0 + r2 * (k.x + r2 * (k.y + r2 * rational.x))) / (1.0 + r2 * (rational.y + r2 * (rational.z + r2 * rational.w)));
    vec2 tangential = vec2(2.0 * k.z * p.x * p.y + k.w * (r2 + 2.0 * p.x * p.x), k.z * (r2 + 2.0 * p.y * p.y) + 2.0 * k.w * p.x * p.y);
    vec2 q = p * radial + tangential + r2 * (prism.xz + r2 * prism.yw);
    vec3 t = vec3(dot(frame.lens_tilt[0].xyz, vec3(q, 1.0)), dot(frame.lens_tilt[1].xyz, vec3(q, 1.0)), dot(frame.lens_tilt[2].xyz, vec3(q, 1.0)));
    return t.xy / max(t.z, 1e-6);
}

// A raster position that no pixel and no neighbourhood of one reaches.
const vec2 NOWHERE = vec2(-1e6);

// Raster position of a point. The projector is the origin of all coordinates.
vec2 project(vec3 p) {
    vec3 q = vec3(dot(vec3(frame.world_from_projector[0].x, frame.world_from_projector[1].x, frame.world_from_projector[2].x), p),
                  dot(vec3(frame.world_from_projector[0].y, frame.world_from_projector[1].y, frame.world_from_projector[2].y), p),
                  dot(vec3(frame.world_from_projector[0].z, frame.world_from_projector[1].z, frame.world_from_projector[2].z), p));
    float depth = max(-q.z, 1e-9);
    if (LENS == LENS_NONE) return vec2(frame.intrinsics.z + frame.intrinsics.x * q.x / depth, frame.intrinsics.w - frame.intrinsics.y * q.y / depth);
    vec2 straight = vec2(q.x, -q.y) / depth;
    // Farther out the lens folds back onto the raster.
    if (!(dot(straight, straight) <= frame.lens_limit * frame.lens_limit)) return NOWHERE;
    return frame.intrinsics.zw + frame.intrinsics.xy * bend(straight);
}

// The pixel of this invocation. Each tile of the list has four workgroups of 8 x 8 pixels. False outside the raster.
bool tile_pixel(uint tile, out uvec2 pixel) {
    pixel = uvec2(tile % frame.tiles_x, tile / frame.tiles_x) * 16u + uvec2(gl_WorkGroupID.x & 1u, (gl_WorkGroupID.x >> 1u) & 1u) * 8u + gl_LocalInvocationID.xy;
    return pixel.x < frame.width && pixel.y < frame.height;
}

// Whether a raster position is a pixel of the picture, and the index of that pixel. Off the raster it is the index of the nearest pixel, so that it may
// be read without a branch.
bool pixel_beside(ivec2 q, out uint index) {
    ivec2 nearest = clamp(q, ivec2(0), ivec2(frame.width, frame.height) - 1);
    index = uint(nearest.y) * frame.width + uint(nearest.x);
    return nearest == q;
}

// What method dpm divides radiance by before it is kept and filtered: see relight.glsl. Under an even sky it is the reflectance.
vec3 albedo_of(Tint t) { return vec3(unpackHalf2x16(t.albedo_rg), unpackHalf2x16(t.albedo_b_and_angle).x); }

// Angle at the eye between the gaze point and the surface point, degrees.
float angle_of(Tint t) { return unpackHalf2x16(t.albedo_b_and_angle).y; }

bool is_lit(SurfaceHit s) { return s.id != NO_HIT && s.distance > 0.0; }

// A unit vector into 2 x 16 bits on the octahedron, and back.
uint encode_normal(vec3 n) {
    n /= max(abs(n.x) + abs(n.y) + abs(n.z), 1e-12);
    vec2 e = n.z >= 0.0 ? n.xy : (1.0 - abs(n.yx)) * vec2(n.x >= 0.0 ? 1.0 : -1.0, n.y >= 0.0 ? 1.0 : -1.0);
    return packSnorm2x16(e);
}

// The direction of a normal, of any length: software Vulkan divides slowly.
vec3 normal_direction(uint bits) {
    const float most = 32767.0;
    vec2 e = vec2(ivec2(int(bits << 16u), int(bits)) >> 16);
    vec3 n = vec3(e, most - abs(e.x) - abs(e.y));
    if (n.z < 0.0) n.xy = (most - abs(n.yx)) * vec2(n.x >= 0.0 ? 1.0 : -1.0, n.y >= 0.0 ? 1.0 : -1.0);
    return n;
}

vec3 decode_normal(uint bits) {
    vec3 n = normal_direction(bits);
    return n * inversesqrt(dot(n, n));
}

uint hash_u32(uint x) {
    // A mix in which every bit of the result depends on every bit of `x`.
    x ^= x >> 16u;
    x *= 0x21f0aaadu;
    x ^= x >> 15u;
    x *= 0x735a2d97u;
    x ^= x >> 15u;
    return x;
}

// The zone of [paper] table 1 in which an angle from the gaze lies.
uint zone_of(float degrees_) { return degrees_ <= frame.zone_degrees.x ? 0u : degrees_ <= frame.zone_degrees.y ? 1u : 2u; }

// How far in the periphery a point is: 0 where the spatial filter of [paper] begins, 1 where it replaces the picture.
float periphery(float angle) { return clamp((angle - frame.filter_degrees.x) / max(frame.filter_degrees.y - frame.filter_degrees.x, 1e-6), 0.0, 1.0); }
