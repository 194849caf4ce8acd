// Work items into paths: the first vertex of each sample, and the rays from it, which the host walks. A lane takes a work item.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "path_queue.glsl"
#include "moments.glsl"

layout(local_size_x = TRACE_LANES) in;

#include "trace_items.glsl"

void main() {
    WorkList list = work_list();
    // This is read while all lanes are active. There is at least one item, because otherwise no workgroup is dispatched.
    uint item = (queue_now.x + group_index()) * TRACE_LANES + gl_LocalInvocationIndex;
    WorkItem own = work[min(item, list.items - 1u)];
    uint at = own.pixel, spp = first_sample_of(list, item + 1u) - own.first, slot = own.first - queue_now.w;
    if (item >= list.items || slot >= queue_room.y) return;
    Hit met = first_hit(at);
    if (met.id == NO_HIT) {
        radiance_out[at] = vec4(background(at), 1.0);
        spp = 1u;
    }
    Point first = shading_point(met, toward_eye(met));
    Sampler rng = begin_sampler(at, spp);
    uint end = slot + spp, rays = 0u;
    do {
        Path path = begin_path(first, rng, met.id);
        Branches b;
        bool goes_on = branch(path, rng, rays, b) && met.id != NO_HIT;
        keep_path(slot, path, b, goes_on, rng, at);
        rng.index++;
        slot++;
    } while (slot < end);
    if (met.id == NO_HIT) rays = 0u;
    COUNT(rays, rays_of(rays))
    COUNT(proven_rays, proven_rays_of(rays))
}
