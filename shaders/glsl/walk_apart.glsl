// Where a ray meets the triangle that the host's walk has found for it (`host/render/src/walker`), by the arithmetic of `walk_software.glsl`: both
// find the same triangle, so it is the same hit bit for bit.
Hit meet_anew(uint id, vec3 origin, vec3 direction) {
    // A lane that has nothing to meet may compute anything.
    uint body = min(instance_of(id), max(frame.instance_count, 1u) - 1u);
    LocalRay ray = local_ray(transform_point(instance_at(body).object_from_world, origin), transform_vector(instance_at(body).object_from_world, direction));
    Hit hit;
    hit.id = id;
    intersect_triangle(ray, (instance_at(body).triangle_offset + triangle_of(id)) * 3u, 0.0, INFINITY, hit.t, hit.barycentric);
    return hit;
}
