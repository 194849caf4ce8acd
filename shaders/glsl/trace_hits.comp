// Paths whose next ray has met a surface: their next vertices, and the rays from there. The host has listed them.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "path_queue.glsl"

layout(local_size_x = TRACE_LANES) in;

void main() {
    uint i = gl_WorkGroupID.x * TRACE_LANES + gl_LocalInvocationIndex;
    uint slot = queue_word(queue_now.z + min(i, queue_now.x - 1u)), at;
    if (i >= queue_now.x) return;
    Path path;
    Branches b;
    Sampler rng;
    take_path(slot, path, b, rng, at);
    Hit hit = meet_anew(hit_of(2u * slot + 1u), b.origin, b.next.direction);
    Point s = shading_point(hit, -normalize(b.next.direction));
#ifdef ENDS
    // Paths have so many vertices at most. What is met may glow.
    arrive(path, b, hit, s);
    end_path(slot, path.radiance, path.exact != 0u, at);
#else
    uint rays = 0u;
    bool goes_on = arrive(path, b, hit, s) && branch(path, rng, rays, b);
    keep_path(slot, path, b, goes_on, rng, at);
    COUNT(rays, rays_of(rays))
    COUNT(proven_rays, proven_rays_of(rays))
#endif
}
