// A ray through the bodies by the device's own ray tracing (ray query): the device finds the triangle, in trees that it has built from the same
// triangles. Where the ray meets it is computed anew by `intersect_triangle`, with the arithmetic of `walk_gpu.glsl`, so that a hit on the same
// triangle is the same hit bit for bit, whatever the device's own precision. Which triangle is hit may differ from the walk only where two of them
// are equally near.
#extension GL_EXT_ray_query : require

// A tree over the bodies of this frame, with a tree of triangles in each. A triangle's number in it is its place in the body's BVH order.
layout(set = 0, binding = B_BODY_TREE) uniform accelerationStructureEXT body_tree;

// Where the ray, which is given in world space, meets a triangle by the arithmetic of the walk. The device has found that it does: where the two do
// not agree, because the ray passes within rounding of an edge or of the ends of the ray, `t` and `barycentric` stay as the device gave them.
void meet_anew(vec3 origin, vec3 direction, uint body, uint triangle, float t_max, inout float t, inout vec2 barycentric) {
    LocalRay ray = local_ray(transform_point(instance_at(body).object_from_world, origin), transform_vector(instance_at(body).object_from_world, direction));
    float own_t;
    vec2 own_barycentric;
    if (intersect_triangle(ray, (instance_at(body).triangle_offset + triangle) * 3u, 0.0, t_max, own_t, own_barycentric)) {
        t = own_t;
        barycentric = own_barycentric;
    }
}

// Whether the surface has no hole where the ray meets a triangle.
bool present_anew(vec3 origin, vec3 direction, uint body, uint triangle, float t_max, vec2 barycentric) {
    float t = 0.0;
    meet_anew(origin, direction, body, triangle, t_max, t, barycentric);
    return alpha_present(body, triangle, barycentric);
}

// Traces one ray through all bodies that have any of the bits of `mask` (0: all). With `any_hit` it stops at the first surface, and tells nothing of
// it. On entry `hit.t` is the largest distance. Returns whether there is a hit. Bodies that the ray has left stand in the device's tree all the same.
bool trace_ray(vec3 origin, vec3 direction, uint mask, uint left, bool any_hit, inout Hit hit) {
    hit.id = NO_HIT;
    // A device may do anything with such a ray.
    if (!finite3(origin) || !finite3(direction)) return false;
    rayQueryEXT query;
    uint flags = (HAS_ALPHA_MASK ? 0u : gl_RayFlagsOpaqueEXT) | (any_hit ? gl_RayFlagsTerminateOnFirstHitEXT : 0u);
    rayQueryInitializeEXT(query, body_tree, flags, mask == 0u ? 0xffu : mask & 0xffu, origin, 0.0, direction, hit.t);
    while (rayQueryProceedEXT(query)) {
        // Only bodies with holes have candidates. What is not confirmed is passed by.
        if (!HAS_ALPHA_MASK) continue;
        uint body = rayQueryGetIntersectionInstanceCustomIndexEXT(query, false), triangle = rayQueryGetIntersectionPrimitiveIndexEXT(query, false);
        if (present_anew(origin, direction, body, triangle, hit.t, rayQueryGetIntersectionBarycentricsEXT(query, false))) rayQueryConfirmIntersectionEXT(query);
    }
    if (rayQueryGetIntersectionTypeEXT(query, true) == gl_RayQueryCommittedIntersectionNoneEXT) return false;
    uint body = rayQueryGetIntersectionInstanceCustomIndexEXT(query, true), triangle = rayQueryGetIntersectionPrimitiveIndexEXT(query, true);
    hit.id = (body << 24u) | triangle;
    if (!any_hit) {
        float t_max = hit.t;
        hit.t = rayQueryGetIntersectionTEXT(query, true);
        hit.barycentric = rayQueryGetIntersectionBarycentricsEXT(query, true);
        meet_anew(origin, direction, body, triangle, t_max, hit.t, hit.barycentric);
    }
    return true;
}
