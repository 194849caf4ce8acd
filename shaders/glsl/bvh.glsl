// Traversal of rays in two levels: a short list of rigid bodies, each with a compressed wide BVH ([Ylitie17]) with nodes of 80 bytes and eight
// children. `BodyBvh` of the host builds it and lays out the children.
//
// Nodes and triangles are read through NODE and TRI: from texel buffers on software Vulkan, where that is twice as fast, and from storage buffers
// on GPUs. The two also differ in how they keep what waits, see `walk_software.glsl` and `walk_gpu.glsl`. With RAY_QUERY the device traces rays by its
// own trees, see `walk_query.glsl`. With WALK_APART the host walks.
#ifdef TEXEL_TABLES
layout(set = 0, binding = B_NODES, rgba32ui) uniform readonly uimageBuffer node_texels;
layout(set = 0, binding = B_TRIANGLES, rgba32f) uniform readonly imageBuffer triangle_texels;
#define NODE(i) imageLoad(node_texels, int(i))
#define TRI(i) imageLoad(triangle_texels, int(i))
#else
layout(set = 0, binding = B_NODES, scalar) readonly buffer NodeBlock { uvec4 node_words[]; };
layout(set = 0, binding = B_TRIANGLES, scalar) readonly buffer TriangleBlock { vec4 triangle_rows[]; };
#define NODE(i) node_words[i]
#define TRI(i) triangle_rows[i]
#endif

#ifdef ALPHA_TEST
// Defined by the shader that includes this file: whether the surface has no hole at this point.
bool alpha_present(uint instance, uint triangle, vec2 barycentric);
#endif

struct Hit {
    uint id;          // As in SurfaceHit: the body, and its triangle in BVH order; NO_HIT: nothing was hit.
    vec2 barycentric; // Weights of vertices 1 and 2.
    float t;
};

uint instance_of(uint id) { return id >> 24u; }
uint triangle_of(uint id) { return id & 0xffffffu; }

vec4 unpack_bytes(uint x) {
    return vec4(x & 255u, (x >> 8u) & 255u, (x >> 16u) & 255u, x >> 24u);
}

// Hit mask of four children of a node, in the layout of [Ylitie17]: inner children in the top byte in the order of octants, triangles in the low
// 24 bits.
uint half_node_hits(uint meta, uint octant4, vec3 step_inverse, vec3 base_near, vec3 base_far, float t_max,
                    uint near_x, uint far_x, uint near_y, uint far_y, uint near_z, uint far_z) {
    uint is_inner = (meta & (meta << 1u)) & 0x10101010u;
    uint inner_mask = (is_inner >> 4u) * 0xffu;
    uint bit_index = (meta ^ (octant4 & inner_mask)) & 0x1f1f1f1fu;
    uint child_bits = (meta >> 5u) & 0x07070707u;
    // The bit patterns of floats that are not negative have the order of the floats. A negative entry counts as 0, and a negative exit is a miss.
    // The minimum and maximum of integers are one instruction each. Those of floats would need more, because of NaN.
    ivec4 enter = max(max(floatBitsToInt(unpack_bytes(near_x) * step_inverse.x + base_near.x), floatBitsToInt(unpack_bytes(near_y) * step_inverse.y + base_near.y)),
                      max(floatBitsToInt(unpack_bytes(near_z) * step_inverse.z + base_near.z), ivec4(0)));
    ivec4 leave = min(min(floatBitsToInt(unpack_bytes(far_x) * step_inverse.x + base_far.x), floatBitsToInt(unpack_bytes(far_y) * step_inverse.y + base_far.y)),
                      min(floatBitsToInt(unpack_bytes(far_z) * step_inverse.z + base_far.z), ivec4(floatBitsToInt(t_max))));
    bvec4 inside = lessThanEqual(enter, leave);
    uint hits = inside.x ? (child_bits & 255u) << (bit_index & 31u) : 0u;
    hits |= inside.y ? ((child_bits >> 8u) & 255u) << ((bit_index >> 8u) & 31u) : 0u;
    hits |= inside.z ? ((child_bits >> 16u) & 255u) << ((bit_index >> 16u) & 31u) : 0u;
    hits |= inside.w ? (child_bits >> 24u) << (bit_index >> 24u) : 0u;
    return hits;
}

// The children of a node that the ray enters.
uint node_hits(vec3 origin, vec3 inverse, bvec3 negative, uint octant4, float t_max, uvec4 n0, uvec4 n1, uint node) {
    uvec4 nx = NODE(node + 2u);
    uvec4 ny = NODE(node + 3u);
    uvec4 nz = NODE(node + 4u);
    vec3 scale = vec3(uintBitsToFloat((n0.w & 255u) << 23u), uintBitsToFloat(((n0.w >> 8u) & 255u) << 23u), uintBitsToFloat(((n0.w >> 16u) & 255u) << 23u));
    vec3 step_inverse = scale * inverse;
    vec3 base = (uintBitsToFloat(n0.xyz) - origin) * inverse;
    // The planes are moved apart by their rounding, so that a ray in the plane between two children enters both.
    vec3 slack = (abs(base) + 255.0 * abs(step_inverse)) * 3.0e-7;
    vec3 base_near = base - slack, base_far = base + slack;
    uvec2 near_x = negative.x ? nx.zw : nx.xy, far_x = negative.x ? nx.xy : nx.zw;
    uvec2 near_y = negative.y ? ny.zw : ny.xy, far_y = negative.y ? ny.xy : ny.zw;
    uvec2 near_z = negative.z ? nz.zw : nz.xy, far_z = negative.z ? nz.xy : nz.zw;
    return half_node_hits(n1.z, octant4, step_inverse, base_near, base_far, t_max, near_x.x, far_x.x, near_y.x, far_y.x, near_z.x, far_z.x)
         | half_node_hits(n1.w, octant4, step_inverse, base_near, base_far, t_max, near_x.y, far_x.y, near_y.y, far_y.y, near_z.y, far_z.y);
}

// A ray in the space of one body, with a basis perpendicular to its direction for the triangle test.
struct LocalRay {
    vec3 origin;
    vec3 direction;
    vec3 inverse;
    vec3 u;
    vec3 v;
    float length2; // Squared length of the direction.
};

// A component of zero would give 0 * inf in the slab test. A tiny one of the same sign gives the same hits.
vec3 safe_direction(vec3 direction) {
    return vec3(abs(direction.x) < 1e-18 ? (direction.x < 0.0 ? -1e-18 : 1e-18) : direction.x,
                     abs(direction.y) < 1e-18 ? (direction.y < 0.0 ? -1e-18 : 1e-18) : direction.y,
                     abs(direction.z) < 1e-18 ? (direction.z < 0.0 ? -1e-18 : 1e-18) : direction.z);
}

LocalRay local_ray(vec3 origin, vec3 direction) {
    LocalRay r;
    r.origin = origin;
    r.direction = direction;
    r.length2 = dot(direction, direction);
    r.inverse = 1.0 / safe_direction(direction);
    // The basis of [Duff17], without branches.
    vec3 d = normalize(direction);
    float s = d.z < 0.0 ? -1.0 : 1.0;
    float a = -1.0 / (s + d.z);
    float b = d.x * d.y * a;
    r.u = vec3(1.0 + s * d.x * d.x * a, s * b, -s * d.x);
    r.v = vec3(b, s + d.y * d.y * a, -d.y);
    return r;
}

// A watertight triangle test. Every vertex is mapped to the plane across the ray by the same operations, and the three edge functions are exactly
// antisymmetric in their vertices. So a ray through a shared edge is inside at least one of the two triangles.
// The vertices are relative to the ray's origin.
bool intersect_corners(LocalRay r, vec3 p0, vec3 p1, vec3 p2, float t_min, float t_max, out float t, out vec2 barycentric) {
    precise vec2 a = vec2(dot(p0, r.u), dot(p0, r.v));
    precise vec2 b = vec2(dot(p1, r.u), dot(p1, r.v));
    precise vec2 c = vec2(dot(p2, r.u), dot(p2, r.v));
    precise float w0 = b.x * c.y - b.y * c.x;
    precise float w1 = c.x * a.y - c.y * a.x;
    precise float w2 = a.x * b.y - a.y * b.x;
    // The signs are tested by bits, for which a minimum or maximum is one instruction, as above. A negative zero has no sign. Nothing returns early,
    // because that would add two masks on software Vulkan.
    uvec3 bits = floatBitsToUint(vec3(w0, w1, w2));
    bool negative = max(bits.x, max(bits.y, bits.z)) > 0x80000000u;
    bool positive = max(int(bits.x), max(int(bits.y), int(bits.z))) > 0;
    float area = w0 + w1 + w2;
    float inverse_area = 1.0 / area;
    // Depth along the direction, whose length may differ from 1.
    float along = (w0 * dot(p0, r.direction) + w1 * dot(p1, r.direction) + w2 * dot(p2, r.direction)) * inverse_area;
    t = along / r.length2;
    barycentric = vec2(w1, w2) * inverse_area;
    return !(negative && positive) && area != 0.0 && t > t_min && t < t_max;
}

bool intersect_triangle(LocalRay r, uint row, float t_min, float t_max, out float t, out vec2 barycentric) {
    return intersect_corners(r, TRI(row).xyz - r.origin, TRI(row + 1u).xyz - r.origin, TRI(row + 2u).xyz - r.origin, t_min, t_max, t, barycentric);
}

// Slab test against the world bounds of a body.
bool enters_bounds(vec3 origin, vec3 inverse, vec3 lower, vec3 upper, float t_max) {
    vec3 t0 = (lower - origin) * inverse;
    vec3 t1 = (upper - origin) * inverse;
    vec3 near = min(t0, t1), far = max(t0, t1);
    float enter = max(max(near.x, near.y), max(near.z, 0.0));
    float leave = min(min(far.x, far.y), min(far.z, t_max)) * 1.0000004;
    return enter <= leave;
}

// Up to two bodies that a ray surely does not meet, ten bits each (NO_BODY: none). NONE_LEFT: it may meet all.
const uint NO_BODY = 1023u;
const uint NONE_LEFT = NO_BODY << 10u | NO_BODY;
bool has_left(uint left, uint body) { return body == (left & 1023u) || body == (left >> 10u & 1023u); }

// The next body from `first` on that has any of the bits of `mask` (0: all), is none of those that the ray has left, and whose bounds it enters
// before `t_max`. The number of bodies if there is none.
uint next_body(uint first, vec3 origin, vec3 inverse, uint mask, uint left, float t_max) {
    uint i = first;
    bool enters = false;
    do {
        if (i < frame.instance_count) {
            uint flags = instance_at(i).flags;
            enters = (flags & INSTANCE_EMPTY) == 0u && !has_left(left, i) && (mask == 0u || (flags & mask) != 0u)
                  && enters_bounds(origin, inverse, instance_at(i).bounds_min, instance_at(i).bounds_max, t_max);
            i += enters ? 0u : 1u;
        }
    } while (!enters && i < frame.instance_count);
    return i;
}

// The next body in the tree from its node `at` on, and `at` moves behind it. NO_INSTANCE: there is none. Otherwise as above. Bodies come about in
// the order in which the ray meets them, because the nodes of each octant of directions stand in that order.
uint next_in_tree(inout uint at, vec3 origin, vec3 inverse, uint mask, uint left, float t_max) {
    uint first = ((inverse.x < 0.0 ? 1u : 0u) | (inverse.y < 0.0 ? 2u : 0u) | (inverse.z < 0.0 ? 4u : 0u)) * frame.body_nodes;
    uint body = BODY_NODE_INNER;
    do {
        if (at < frame.body_nodes) {
            BodyNode node = body_node_at(first + at);
            bool gone = (node.body & BODY_NODE_INNER) == 0u && has_left(left, node.body & 255u);
            bool enters = !gone && (mask == 0u || ((node.body >> 8u) & mask) != 0u) && enters_bounds(origin, inverse, node.lower, node.upper, t_max);
            body = enters ? node.body : BODY_NODE_INNER;
            at = enters ? at + 1u : node.after;
        }
    } while ((body & BODY_NODE_INNER) != 0u && at < frame.body_nodes);
    return (body & BODY_NODE_INNER) != 0u ? NO_INSTANCE : body & 255u;
}

// Where a walk has been at all bodies.
uint end_of_bodies() { return HAS_BODY_TREE ? frame.body_nodes : frame.instance_count; }

// Whether a ray enters the bounds of any body that it has not left.
bool enters_any(vec3 origin, vec3 direction, uint left, float t_max) {
    vec3 inverse = 1.0 / safe_direction(direction);
    uint at = 0u;
    if (HAS_BODY_TREE) return next_in_tree(at, origin, inverse, 0u, left, t_max) != NO_INSTANCE;
    return next_body(0u, origin, inverse, 0u, left, t_max) < frame.instance_count;
}

#if defined(WALK_APART)
#include "walk_apart.glsl"
#elif defined(TEXEL_TABLES)
#include "walk_software.glsl"
#elif defined(RAY_QUERY)
#include "walk_query.glsl"
#else
#include "walk_gpu.glsl"
#endif
