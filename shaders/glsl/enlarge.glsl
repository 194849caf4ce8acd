// What the passes `enlarge` and `edges` share: the light of a reduced raster at the panel's own pixels (`render.scale` below 1). Each panel pixel has its
// own first hit, so silhouettes, creases and the border of what the eye sees are those of the panel. Its light is the mean of those of the four traced
// pixels around it whose body, depth and normal agree with that hit, without what the surface there divides it by. What lies off every body stays black.
// Then the light becomes code values at once.
#define COARSE_TABLES
#include "scene.glsl"

#ifdef READ_BEFORE
// The body and the material of all pixels of this lane.
Instance own_body;
Material own_material;
#undef BODY_AT
#undef MATERIAL_AT
#define BODY_AT(i) own_body
#define MATERIAL_AT(i) own_material
#endif
#define ALPHA_TEST
#include "bvh.glsl"
#include "shading.glsl"
#include "bsdf.glsl"
#include "relight.glsl"

// The pixel's surface: not that of memory, because what this invocation has just written there may not be read yet.
SurfaceHit own_surface;
vec2 own_weights;
#define SURFACE_OF(index) own_surface
#define WEIGHTS_OF(index) own_weights
#include "compensate.glsl"
#include "cells.glsl"

// Taps have normals with at least this cosine to the pixel's, and lie within so many footprints of traced pixels of its tangent plane.
const float LIKE_NORMAL = 0.5, DEPTH = 3.0;
// Weight of a tap beside that by its place, so that one counts that alone agrees.
const float LEAST_WEIGHT = 1e-3;

// What a traced pixel has besides.
struct TapLight {
    vec3 light;
    vec3 normal;   // In the body's space, of any length.
    float inverse; // Of that length.
};

TapLight light_of(uint at) {
    Filtered tap = coarse_light_at(at);
    vec3 normal = normal_direction(tap.weight_and_albedo);
    return TapLight(tap.light, normal, inversesqrt(dot(normal, normal)));
}

#ifdef READ_BEFORE
TapLight own_lights[4];
#define LIGHT_OF(t, k) own_lights[k]
#else
#define LIGHT_OF(t, k) light_of(t.at[k])
#endif

// The smooth normal of a point of a triangle, in its body's space and of any length.
vec3 smooth_normal(uint id, vec2 b) {
    TriangleRef ref = triangle_ref_at(BODY_AT(instance_of(id)).triangle_offset + triangle_of(id));
    return vertex_at(ref.vertices.x).normal * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).normal * b.x + vertex_at(ref.vertices.z).normal * b.y;
}

// The straight ray of a pixel, as `straight_ray` gives it, and how it changes from pixel to pixel to the right and down.
struct Rays {
    vec2 straight;
    vec2 right;
    vec2 down;
};

Rays rays_of(uvec2 pixel) {
    if (LENS == LENS_NONE) return Rays(unbent_ray(vec2(pixel) + 0.5), vec2(1.0 / frame.intrinsics.x, 0.0), vec2(0.0, 1.0 / frame.intrinsics.y));
    ivec2 p = ivec2(pixel), last = ivec2(frame.width, frame.height) - 1;
    vec2 straight = straight_ray(p);
    // At the last column and row the neighbour before.
    ivec2 step_ = ivec2(p.x < last.x ? 1 : -1, p.y < last.y ? 1 : -1);
    vec2 right = (straight_ray(clamp(p + ivec2(step_.x, 0), ivec2(0), last)) - straight) * float(step_.x);
    vec2 down = (straight_ray(clamp(p + ivec2(0, step_.y), ivec2(0), last)) - straight) * float(step_.y);
    return Rays(straight, right, down);
}

// The surface of a pixel whose own light is wanted.
struct Surround {
    uint body;
    vec2 place;    // Of the pixel, in traced pixels from the centre of the first of the raster.
    vec3 normal;   // Body space, unit.
    vec3 upright;  // The same before the projector's pose.
    float along;   // Of the pixel's point, along it.
    float farthest;
    Rays rays;
};

// How far a tap lies off the tangent plane of the pixel's point.
float off_plane(Surround g, ivec2 q, float distance_) {
    vec2 pixels = (vec2(q) - g.place) * vec2(panel_size) / vec2(traced_size);
    vec2 straight = g.rays.straight + g.rays.right * pixels.x + g.rays.down * pixels.y;
    vec3 d = vec3(straight.x, -straight.y, -1.0);
    return abs(dot(d, g.upright) * inversesqrt(dot(d, d)) * abs(distance_) - g.along);
}

Surround surround_of(uvec2 pixel, Hit hit, vec3 direction) {
    Surround g;
    g.body = instance_of(hit.id);
    g.place = place_of(ivec2(pixel));
    vec3 n = smooth_normal(hit.id, hit.barycentric);
    float l2 = dot(n, n);
    g.normal = n * inversesqrt(max(l2, 1e-30));
    vec3 w = l2 > 1e-12 ? transform_vector(BODY_AT(g.body).world_from_object, g.normal) : -direction;
    g.upright = frame.world_from_projector[0].xyz * w.x + frame.world_from_projector[1].xyz * w.y + frame.world_from_projector[2].xyz * w.z;
    g.along = dot(direction, w) * hit.t;
    g.farthest = DEPTH * hit.t * traced_pixel_size;
    g.rays = rays_of(pixel);
    return g;
}

// How far a tap agrees with the pixel's surface, 0 to 1.
float agreement(Surround g, ivec2 q, uint id, float distance_, TapLight tap) {
    float cosine = dot(tap.normal, g.normal) * tap.inverse;
    bool like = id != NO_HIT && distance_ > 0.0 && instance_of(id) == g.body && cosine >= LIKE_NORMAL && off_plane(g, q, distance_) <= g.farthest;
    float w = cosine * cosine;
    w *= w;
    return like ? w * w : 0.0;
}

// The mean light of the taps that agree, and the sum of their weights; 0: none agrees. `least` is how far that one agrees which agrees least.
vec4 mean_of(Surround g, Taps t, out float least) {
    vec4 sum = vec4(0.0);
    vec2 beyond = g.place - vec2(t.corner);
    least = 1.0;
    [[unroll]] for (int k = 0; k < 4; k++) {
        TapLight tap = LIGHT_OF(t, k);
        vec2 share = mix(1.0 - beyond, beyond, vec2(k & 1, k >> 1));
        float agrees = agreement(g, t.corner + ivec2(k & 1, k >> 1), t.id[k], t.distance[k], tap);
        least = min(least, agrees);
        sum += (share.x * share.y + LEAST_WEIGHT) * agrees * vec4(tap.light, 1.0);
    }
    return sum.w > 0.0 ? vec4(sum.rgb / sum.w, sum.w) : vec4(0.0);
}

// The light with what the panel's own surface divides it by, where textures make that finer than the traced raster.
vec3 with_texture(vec3 light, Hit hit, vec3 direction) {
    if (!HAS_DEMODULATION || !HAS_TEXTURES) return light;
    vec3 to_eye = frame.eye_position - direction * hit.t;
    return light * demodulation(hit, to_eye * inversesqrt(max(dot(to_eye, to_eye), 1e-24)));
}

vec3 own_light;
vec3 light_at(uvec2 pixel, uint index) { return own_light; }

// Writes a pixel: what its ray meets, and its code values.
void write_pixel(uvec2 pixel, uint index, Hit hit, bool lit, inout uint nans, inout uint clipped) {
    own_surface = SurfaceHit(hit.id, hit.id == NO_HIT ? 0.0 : lit ? hit.t : -hit.t);
    own_weights = hit.barycentric;
    set_surface(index, own_surface);
    if ((frame.flags & FRAME_SHOWS_ALL) != 0u) {
        set_barycentric(index, Barycentric(own_weights));
        shown[index] = vec4(own_light, lit ? 1.0 : 0.0);
    }
    uint code = 0u;
    if (lit) code = codes_of(pixel, index, own_surface, nans, clipped);
    codes[index] = code;
}
