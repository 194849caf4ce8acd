// Two-level ray traversal: a short list of rigid bodies, each with a compressed wide BVH ([Ylitie17], 80-byte nodes of eight children).
//
// Nodes and triangles are read through NODE and TRI: texel buffers on software Vulkan (twice as fast there), storage buffers on GPUs.
#ifdef BVH_TEXEL
layout(set = 0, binding = B_NODES) uniform utextureBuffer node_texels;
layout(set = 0, binding = B_TRIANGLES) uniform textureBuffer triangle_texels;
#define NODE(i) texelFetch(node_texels, int(i))
#define TRI(i) texelFetch(triangle_texels, int(i))
#else
layout(set = 0, binding = B_NODES, scalar) readonly buffer NodeBlock { uvec4 node_words[]; };
layout(set = 0, binding = B_TRIANGLES, scalar) readonly buffer TriangleBlock { vec4 triangle_rows[]; };
#define NODE(i) node_words[i]
#define TRI(i) triangle_rows[i]
#endif

#ifdef ALPHA_TEST
// Defined by the shader that includes this: is the surface there at this point?
bool alpha_present(uint instance, uint triangle, vec2 barycentric);
#endif

struct Hit {
    uint instance;
    uint triangle; // of the body, in BVH order
    vec2 barycentric; // weights of vertices 1 and 2
    float t;
};

const int STACK_SIZE = 24; // one entry per level; an 8-wide tree of 2^24 triangles is at most about 20 deep

vec4 unpack_bytes(uint x) {
    return vec4(x & 255u, (x >> 8u) & 255u, (x >> 16u) & 255u, x >> 24u);
}

// Hit mask of four children of a node, as [Ylitie17] lays it out: internal children in the top byte by octant order, triangles in the low 24 bits.
uint half_node_hits(uint meta, uint octant4, vec3 step_inverse, vec3 base_near, vec3 base_far, float t_max,
                    uint near_x, uint far_x, uint near_y, uint far_y, uint near_z, uint far_z) {
    uint is_inner = (meta & (meta << 1u)) & 0x10101010u;
    uint inner_mask = (is_inner >> 4u) * 0xffu;
    uint bit_index = (meta ^ (octant4 & inner_mask)) & 0x1f1f1f1fu;
    uint child_bits = (meta >> 5u) & 0x07070707u;
    vec4 enter = max(max(unpack_bytes(near_x) * step_inverse.x + base_near.x, unpack_bytes(near_y) * step_inverse.y + base_near.y),
                     max(unpack_bytes(near_z) * step_inverse.z + base_near.z, vec4(0.0)));
    vec4 leave = min(min(unpack_bytes(far_x) * step_inverse.x + base_far.x, unpack_bytes(far_y) * step_inverse.y + base_far.y),
                     min(unpack_bytes(far_z) * step_inverse.z + base_far.z, vec4(t_max)));
    bvec4 inside = lessThanEqual(enter, leave);
    uint hits = inside.x ? (child_bits & 255u) << (bit_index & 31u) : 0u;
    hits |= inside.y ? ((child_bits >> 8u) & 255u) << ((bit_index >> 8u) & 31u) : 0u;
    hits |= inside.z ? ((child_bits >> 16u) & 255u) << ((bit_index >> 16u) & 31u) : 0u;
    hits |= inside.w ? (child_bits >> 24u) << (bit_index >> 24u) : 0u;
    return hits;
}

// Which children of a node the ray enters.
uint node_hits(vec3 origin, vec3 inverse, bvec3 negative, uint octant4, float t_max, uvec4 n0, uvec4 n1, uint node) {
    uvec4 nx = NODE(node + 2u);
    uvec4 ny = NODE(node + 3u);
    uvec4 nz = NODE(node + 4u);
    vec3 scale = vec3(uintBitsToFloat((n0.w & 255u) << 23u), uintBitsToFloat(((n0.w >> 8u) & 255u) << 23u), uintBitsToFloat(((n0.w >> 16u) & 255u) << 23u));
    vec3 step_inverse = scale * inverse;
    vec3 base = (uintBitsToFloat(n0.xyz) - origin) * inverse;
    // Planes move apart by their rounding, so that a ray that runs in the plane between two children enters both.
    vec3 slack = (abs(base) + 255.0 * abs(step_inverse)) * 3.0e-7;
    vec3 base_near = base - slack, base_far = base + slack;
    uvec2 near_x = negative.x ? nx.zw : nx.xy, far_x = negative.x ? nx.xy : nx.zw;
    uvec2 near_y = negative.y ? ny.zw : ny.xy, far_y = negative.y ? ny.xy : ny.zw;
    uvec2 near_z = negative.z ? nz.zw : nz.xy, far_z = negative.z ? nz.xy : nz.zw;
    return half_node_hits(n1.z, octant4, step_inverse, base_near, base_far, t_max, near_x.x, far_x.x, near_y.x, far_y.x, near_z.x, far_z.x)
         | half_node_hits(n1.w, octant4, step_inverse, base_near, base_far, t_max, near_x.y, far_x.y, near_y.y, far_y.y, near_z.y, far_z.y);
}

// Rays in the space of one body, with a basis perpendicular to the direction for the triangle test.
struct LocalRay {
    vec3 origin;
    vec3 direction;
    vec3 inverse;
    vec3 u;
    vec3 v;
};

LocalRay local_ray(vec3 origin, vec3 direction) {
    LocalRay r;
    r.origin = origin;
    r.direction = direction;
    // A zero component would make 0 * inf in the slab test: a tiny one of the same sign gives the same hits.
    vec3 safe = vec3(abs(direction.x) < 1e-18 ? (direction.x < 0.0 ? -1e-18 : 1e-18) : direction.x,
                     abs(direction.y) < 1e-18 ? (direction.y < 0.0 ? -1e-18 : 1e-18) : direction.y,
                     abs(direction.z) < 1e-18 ? (direction.z < 0.0 ? -1e-18 : 1e-18) : direction.z);
    r.inverse = 1.0 / safe;
    // [Duff17] branchless basis.
    vec3 d = normalize(direction);
    float s = d.z < 0.0 ? -1.0 : 1.0;
    float a = -1.0 / (s + d.z);
    float b = d.x * d.y * a;
    r.u = vec3(1.0 + s * d.x * d.x * a, s * b, -s * d.x);
    r.v = vec3(b, s + d.y * d.y * a, -d.y);
    return r;
}

// Watertight triangle test: every vertex is mapped to the plane across the ray by the same operations, and the three edge functions are
// exactly antisymmetric in their vertices, so a ray through a shared edge is inside at least one of the two triangles.
bool intersect_triangle(LocalRay r, uint row, float t_min, float t_max, out float t, out vec2 barycentric) {
    vec3 p0 = TRI(row).xyz - r.origin;
    vec3 p1 = TRI(row + 1u).xyz - r.origin;
    vec3 p2 = TRI(row + 2u).xyz - r.origin;
    precise vec2 a = vec2(dot(p0, r.u), dot(p0, r.v));
    precise vec2 b = vec2(dot(p1, r.u), dot(p1, r.v));
    precise vec2 c = vec2(dot(p2, r.u), dot(p2, r.v));
    precise float w0 = b.x * c.y - b.y * c.x;
    precise float w1 = c.x * a.y - c.y * a.x;
    precise float w2 = a.x * b.y - a.y * b.x;
    if ((w0 < 0.0 || w1 < 0.0 || w2 < 0.0) && (w0 > 0.0 || w1 > 0.0 || w2 > 0.0)) return false;
    float area = w0 + w1 + w2;
    if (area == 0.0) return false;
    float inverse_area = 1.0 / area;
    // Depth along the (possibly not unit) direction.
    float along = (w0 * dot(p0, r.direction) + w1 * dot(p1, r.direction) + w2 * dot(p2, r.direction)) * inverse_area;
    t = along / dot(r.direction, r.direction);
    barycentric = vec2(w1, w2) * inverse_area;
    return t > t_min && t < t_max;
}

// Slab test against a body's world bounds.
bool enters_bounds(vec3 origin, vec3 inverse, vec3 lower, vec3 upper, float t_max) {
    vec3 t0 = (lower - origin) * inverse;
    vec3 t1 = (upper - origin) * inverse;
    vec3 near = min(t0, t1), far = max(t0, t1);
    float enter = max(max(near.x, near.y), max(near.z, 0.0));
    float leave = min(min(far.x, far.y), min(far.z, t_max)) * 1.0000004;
    return enter <= leave;
}

// Traces one ray through all bodies that have any of `mask` bits (mask 0: all). ANY_HIT: stops at the first surface.
// Returns true on a hit; `hit.t` must hold the largest distance on entry.
bool trace_ray(vec3 origin, vec3 direction, uint mask, bool any_hit, inout Hit hit) {
    bool found = false;
    vec3 world_inverse = local_ray(origin, direction).inverse;
    for (uint i = 0u; i < frame.instance_count; i++) {
        uint flags = instances[i].flags;
        if ((flags & INSTANCE_EMPTY) != 0u || (mask != 0u && (flags & mask) == 0u)) continue;
        if (!enters_bounds(origin, world_inverse, instances[i].bounds_min, instances[i].bounds_max, hit.t)) continue;
        LocalRay r = local_ray(transform_point(instances[i].object_from_world, origin),
                               transform_vector(instances[i].object_from_world, direction));
        uint node_base = instances[i].node_offset;
        uint triangle_base = instances[i].triangle_offset;
        bvec3 negative = lessThan(r.inverse, vec3(0.0));
        uint octant = (negative.x ? 0u : 4u) | (negative.y ? 0u : 2u) | (negative.z ? 0u : 1u);
        uint octant4 = octant * 0x01010101u;
        uvec2 stack[STACK_SIZE];
        int depth = 0;
        uvec2 group = uvec2(0u, 0x80000000u);
        uvec2 triangles = uvec2(0u);
        for (;;) {
            if ((group.y & 0xff000000u) != 0u) {
                uint child = uint(findMSB(group.y));
                uint base = group.x;
                uint mask_bits = group.y;
                group.y &= ~(1u << child);
                if ((group.y & 0xff000000u) != 0u && depth < STACK_SIZE) stack[depth++] = group;
                uint slot = (child - 24u) ^ (octant & 255u);
                uint relative = uint(bitCount(mask_bits & ~(0xffffffffu << slot)));
                uint node = (node_base + base + relative) * 5u;
                uvec4 n0 = NODE(node);
                uvec4 n1 = NODE(node + 1u);
                uint hits = node_hits(r.origin, r.inverse, negative, octant4, hit.t, n0, n1, node);
                group = uvec2(n1.x, (hits & 0xff000000u) | (n0.w >> 24u));
                triangles = uvec2(n1.y, hits & 0x00ffffffu);
            } else {
                triangles = uvec2(0u);
                group = uvec2(0u);
            }
            while (triangles.y != 0u) {
                uint bit = uint(findMSB(triangles.y));
                triangles.y &= ~(1u << bit);
                uint triangle = triangles.x + bit;
                float t;
                vec2 barycentric;
                if (intersect_triangle(r, (triangle_base + triangle) * 3u, 0.0, hit.t, t, barycentric)) {
#ifdef ALPHA_TEST
                    if (HAS_ALPHA_MASK && !alpha_present(i, triangle, barycentric)) continue;
#endif
                    hit.t = t;
                    hit.instance = i;
                    hit.triangle = triangle;
                    hit.barycentric = barycentric;
                    found = true;
                    if (any_hit) return true;
                }
            }
            if ((group.y & 0xff000000u) == 0u) {
                if (depth == 0) break;
                group = stack[--depth];
            }
        }
    }
    return found;
}
