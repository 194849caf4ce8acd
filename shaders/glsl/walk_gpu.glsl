// The walk of a ray through the bodies on GPUs, where the registers that live across it decide how many waves fit: the groups that wait and the ray
// in world space lie in shared memory, the ray is in one space at a time, and the basis for the triangle test is computed at each triangle. It visits
// the same boxes and triangles in the same order as `walk_software.glsl`, with the same arithmetic, so both find the same hits bit for bit.

// Lanes of a workgroup of the passes that walk.
const uint WALK_LANES = 64u;

// For each lane the groups that wait, at most one for each level of the deepest tree.
shared uint waiting_groups[WALK_STACK * WALK_LANES];
// For each lane the origin and the direction of its ray in world space.
shared float world_rays[6u * WALK_LANES];

void set_world_ray(vec3 origin, vec3 direction) {
    uint lane = gl_LocalInvocationIndex;
    world_rays[lane] = origin.x;
    world_rays[lane + WALK_LANES] = origin.y;
    world_rays[lane + 2u * WALK_LANES] = origin.z;
    world_rays[lane + 3u * WALK_LANES] = direction.x;
    world_rays[lane + 4u * WALK_LANES] = direction.y;
    world_rays[lane + 5u * WALK_LANES] = direction.z;
}

// No lane reads what another has written, so no barrier is needed.
vec3 world_ray(uint first) {
    uint at = first * WALK_LANES + gl_LocalInvocationIndex;
    return vec3(world_rays[at], world_rays[at + WALK_LANES], world_rays[at + 2u * WALK_LANES]);
}
vec3 world_origin() { return world_ray(0u); }
vec3 world_direction() { return world_ray(3u); }

// The state of a ray on its way through the bodies.
struct Traversal {
    vec3 origin;    // In the space of `body`.
    vec3 direction;
    vec3 inverse;
    Hit hit;        // The nearest hit so far. Its `t` limits the ray.
    uint body;      // The body that is being traversed.
    uint left;      // Bodies that the ray does not meet.
    uint next;      // The body after it, or where to look for it in the tree; `end_of_bodies()`: there is none.
    uint node_base;
    uint triangle_base;
    uint octant;
    uint group;     // Children to open: their block in the upper 24 bits, slots of the block in the lower 8 with the nearest highest; 0: none.
    uvec2 triangles;
    uint depth;     // Groups that wait.
};

void begin_ray(inout Traversal t, vec3 origin, vec3 direction, uint mask, uint left, float t_max) {
    set_world_ray(origin, direction);
    t.left = left;
    t.hit.id = NO_HIT;
    t.hit.t = t_max;
    t.group = 0u;
    t.triangles = uvec2(0u);
    t.depth = 0u;
    t.next = HAS_BODY_TREE ? 0u : next_body(0u, origin, 1.0 / safe_direction(direction), mask, left, t_max);
}

// Continues with the next body. In a list there must be one; in the tree there may be none.
void enter_next_body(inout Traversal t, uint mask) {
    vec3 origin = world_origin(), direction = world_direction(), inverse = 1.0 / safe_direction(direction);
    if (HAS_BODY_TREE) {
        t.body = next_in_tree(t.next, origin, inverse, mask, t.left, t.hit.t);
        if (t.body == NO_INSTANCE) return;
    } else {
        t.body = min(t.next, max(frame.instance_count, 1u) - 1u);
        t.next = next_body(t.body + 1u, origin, inverse, mask, t.left, t.hit.t);
    }
    t.origin = transform_point(instance_at(t.body).object_from_world, origin);
    t.direction = transform_vector(instance_at(t.body).object_from_world, direction);
    t.inverse = 1.0 / safe_direction(t.direction);
    t.node_base = instance_at(t.body).node_offset;
    t.triangle_base = instance_at(t.body).triangle_offset;
    t.octant = (t.inverse.x < 0.0 ? 0u : 4u) | (t.inverse.y < 0.0 ? 0u : 2u) | (t.inverse.z < 0.0 ? 0u : 1u);
    t.group = 1u << t.octant; // The root.
}

uint waiting_at(uint depth) { return min(depth, WALK_STACK - 1u) * WALK_LANES + gl_LocalInvocationIndex; }

// Opens one node. The children and triangles that the ray meets come next.
void open_node(inout Traversal t) {
    uint bit = uint(findMSB(t.group & 255u));
    uint rest = t.group & ~(1u << bit);
    uint node = (t.node_base + ((t.group >> 5u) & ~7u) + (bit ^ t.octant)) * 5u;
    uvec4 n0 = NODE(node);
    uvec4 n1 = NODE(node + 1u);
    uint hits = node_hits(t.origin, t.inverse, lessThan(t.inverse, vec3(0.0)), t.octant * 0x01010101u, t.hit.t, n0, n1, node);
    t.triangles = uvec2(n1.y, hits & 0x00ffffffu);
    uint children = hits >> 24u;
    bool waits = (rest & 255u) != 0u;
    if (children != 0u) {
        if (waits) waiting_groups[waiting_at(t.depth++)] = rest;
        t.group = (n1.x << 8u) | children;
    } else {
        t.group = waits ? rest : 0u;
    }
}

// Tests one triangle. Once a ray that needs only one surface has it, nothing is left.
void test_triangle(inout Traversal t, bool any_hit) {
    uint bit = uint(findMSB(t.triangles.y));
    t.triangles.y &= ~(1u << bit);
    uint triangle = t.triangles.x + bit;
    float distance_;
    vec2 barycentric;
    bool meets = intersect_triangle(local_ray(t.origin, t.direction), (t.triangle_base + triangle) * 3u, 0.0, t.hit.t, distance_, barycentric);
#ifdef ALPHA_TEST
    if (HAS_ALPHA_MASK) meets = meets && alpha_present(t.body, triangle, barycentric);
#endif
    if (meets) {
        t.hit = Hit((t.body << 24u) | triangle, barycentric, distance_);
        if (any_hit) {
            t.triangles.y = 0u;
            t.group = 0u;
            t.depth = 0u;
            t.next = end_of_bodies();
        }
    }
}

bool at_end(Traversal t) { return t.group == 0u && t.triangles.y == 0u && t.depth == 0u && t.next >= end_of_bodies(); }

// Traces one ray through all bodies that have any of the bits of `mask` (0: all). With `any_hit` it stops at the first surface. On entry `hit.t` is
// the largest distance. Returns whether there is a hit.
bool trace_ray(vec3 origin, vec3 direction, uint mask, uint left, bool any_hit, inout Hit hit) {
    Traversal t;
    begin_ray(t, origin, direction, mask, left, hit.t);
    while (!at_end(t)) {
        if (t.group == 0u) {
            if (t.depth > 0u) {
                t.group = waiting_groups[waiting_at(--t.depth)];
            } else {
                enter_next_body(t, mask);
            }
        }
        while (t.group != 0u && t.triangles.y == 0u) open_node(t);
        while (t.triangles.y != 0u) test_triangle(t, any_hit);
    }
    hit = t.hit;
    return t.hit.id != NO_HIT;
}
