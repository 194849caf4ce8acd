// The walk of a ray through the bodies on software Vulkan, whose registers are memory and whose loops cost a mask each: what waits is in registers
// that are shifted, and everything that two tests may share is computed once. `walk_gpu.glsl` visits the same boxes and triangles in the same order.

// Entries of the stack, one per level. A tree of 2^24 triangles with eight children a node is at most about 20 levels deep.
const uint STACK_SIZE = 24u;

// The state of a ray on its way through the bodies.
struct Traversal {
    vec3 origin;
    vec3 direction;
    vec3 inverse;
    uint mask;      // Bodies with any of these bits are traversed; 0: all.
    bool any_hit;   // The ray stops at the first surface.
    Hit hit;        // The nearest hit so far. Its `t` limits the ray.
    uint body;      // The body that is being traversed.
    uint left;      // Bodies that the ray does not meet.
    uint next;      // The body after it, or where to look for it in the tree; `end_of_bodies()`: there is none.
    LocalRay local;
    uint node_base;
    uint triangle_base;
    uint octant;
    uint group;     // Children to open: their block in the upper 24 bits, slots of the block in the lower 8 with the nearest highest; 0: none.
    uvec2 triangles;
    uvec4 newest;   // Groups that wait, newest first. These are registers; software Vulkan would write a private array lane by lane.
    uvec4 older;
    uint displaced; // A group that no longer fits in them. It goes to `traversal_stack` before another node is opened.
    uint depth;     // Groups in `traversal_stack`.
};

uint traversal_stack[STACK_SIZE];

void begin_ray(inout Traversal t, vec3 origin, vec3 direction, uint mask, uint left, bool any_hit, float t_max) {
    t.origin = origin;
    t.direction = direction;
    t.inverse = 1.0 / safe_direction(direction);
    t.mask = mask;
    t.any_hit = any_hit;
    t.left = left;
    t.hit.id = NO_HIT;
    t.hit.t = t_max;
    t.group = 0u;
    t.triangles = uvec2(0u);
    t.displaced = 0u;
    t.depth = 0u;
    t.next = HAS_BODY_TREE ? 0u : next_body(0u, origin, t.inverse, mask, left, t_max);
}

// Continues with the next body. In a list there must be one; in the tree there may be none, and then no node is opened.
void enter_next_body(inout Traversal t) {
    uint body = HAS_BODY_TREE ? next_in_tree(t.next, t.origin, t.inverse, t.mask, t.left, t.hit.t) : t.next;
    t.body = min(body, max(frame.instance_count, 1u) - 1u);
    if (!HAS_BODY_TREE) t.next = next_body(t.body + 1u, t.origin, t.inverse, t.mask, t.left, t.hit.t);
    t.local = local_ray(transform_point(instance_at(t.body).object_from_world, t.origin),
                        transform_vector(instance_at(t.body).object_from_world, t.direction));
    t.node_base = instance_at(t.body).node_offset;
    t.triangle_base = instance_at(t.body).triangle_offset;
    bvec3 negative = lessThan(t.local.inverse, vec3(0.0));
    t.octant = (negative.x ? 0u : 4u) | (negative.y ? 0u : 2u) | (negative.z ? 0u : 1u);
    t.group = HAS_BODY_TREE && body == NO_INSTANCE ? 0u : 1u << t.octant; // The root.
    t.newest = uvec4(0u);
    t.older = uvec4(0u);
}

bool at_triangles(Traversal t) { return t.triangles.y != 0u; }

bool at_node(Traversal t) { return t.group != 0u && t.displaced == 0u && !at_triangles(t); }

// The ray needed only one surface and has it, or nothing is left in this body and no other follows.
bool at_end(Traversal t) { return t.any_hit && t.hit.id != NO_HIT || t.group == 0u && t.depth == 0u && t.next >= end_of_bodies(); }

// Steps that are needed once in many nodes: room in the registers, the group that waited longest, or the next body.
void go_on(inout Traversal t) {
    if (t.displaced != 0u) {
        traversal_stack[min(t.depth++, STACK_SIZE - 1u)] = t.displaced;
        t.displaced = 0u;
    } else if (t.group == 0u && t.depth > 0u) {
        t.group = traversal_stack[--t.depth];
    } else if (!at_end(t)) {
        enter_next_body(t);
    }
}

// Opens one node. The children and triangles that the ray meets come next.
void open_node(inout Traversal t) {
    uint bit = uint(findMSB(t.group & 255u));
    uint rest = t.group & ~(1u << bit);
    uint slot = bit ^ t.octant;
    uint node = (t.node_base + ((t.group >> 5u) & ~7u) + slot) * 5u;
    uvec4 n0 = NODE(node);
    uvec4 n1 = NODE(node + 1u);
    uint hits = node_hits(t.local.origin, t.local.inverse, lessThan(t.local.inverse, vec3(0.0)), t.octant * 0x01010101u, t.hit.t, n0, n1, node);
    t.triangles = uvec2(n1.y, hits & 0x00ffffffu);
    uint children = hits >> 24u;
    bool waits = (rest & 255u) != 0u, deeper = children != 0u;
    bool push = waits && deeper, pop = !waits && !deeper;
    t.group = deeper ? (n1.x << 8u) | children : waits ? rest : t.newest.x;
    t.displaced = push ? t.older.w : 0u;
    uvec4 newest = push ? uvec4(rest, t.newest.xyz) : pop ? uvec4(t.newest.yzw, t.older.x) : t.newest;
    t.older = push ? uvec4(t.newest.w, t.older.xyz) : pop ? uvec4(t.older.yzw, 0u) : t.older;
    t.newest = newest;
}

// Tests one triangle.
void test_triangle(inout Traversal t) {
    uint bit = uint(findMSB(t.triangles.y));
    t.triangles.y &= ~(1u << bit);
    uint triangle = t.triangles.x + bit;
    float distance_;
    vec2 barycentric;
    bool meets = intersect_triangle(t.local, (t.triangle_base + triangle) * 3u, 0.0, t.hit.t, distance_, barycentric);
#ifdef ALPHA_TEST
    if (HAS_ALPHA_MASK) meets = meets && alpha_present(t.body, triangle, barycentric);
#endif
    if (meets) {
        t.hit.t = distance_;
        t.hit.id = (t.body << 24u) | triangle;
        t.hit.barycentric = barycentric;
    }
    bool over = meets && t.any_hit;
    t.triangles.y = over ? 0u : t.triangles.y;
    t.group = over ? 0u : t.group;
}

// Traces one ray through all bodies that have any of the bits of `mask` (0: all). With `any_hit` it stops at the first surface. On entry `hit.t` is
// the largest distance. Returns whether there is a hit.
//
// Every loop tests at its end, because software Vulkan runs the body of a loop that tests at its start once more with no lane active.
bool trace_ray(vec3 origin, vec3 direction, uint mask, uint left, bool any_hit, inout Hit hit) {
    Traversal t;
    begin_ray(t, origin, direction, mask, left, any_hit, hit.t);
    do {
        go_on(t);
        do {
            if (at_node(t)) {
                do open_node(t); while (at_node(t));
            }
            if (at_triangles(t)) {
                do test_triangle(t); while (at_triangles(t));
            }
        } while (at_node(t));
    } while (!at_end(t));
    hit = t.hit;
    return t.hit.id != NO_HIT;
}
