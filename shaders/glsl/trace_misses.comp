// Paths whose next ray has met nothing, or that have none: their light is complete. The host has listed them.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "path_queue.glsl"

layout(local_size_x = TRACE_LANES) in;

void main() {
    uint i = gl_WorkGroupID.x * TRACE_LANES + gl_LocalInvocationIndex;
    // From the end of the list.
    uint slot = queue_word(queue_now.z + queue_room.x - 1u - min(i, queue_now.y - 1u)), at;
    if (i >= queue_now.y) return;
    Path path;
    Branches b;
    Sampler rng;
    uint flags = take_path(slot, path, b, rng, at);
    bool onward = (flags & WAITS_ONWARD) != 0u;
    if (onward ? hit_of(2u * slot + 1u) == NO_HIT : (flags & WAITS_FOR_SKY) != 0u) add_sky(path, b.next, b.sky, b.absorption);
    end_path(slot, path.radiance, path.exact != 0u, at);
}
