// The light of the paths of each work item into radiance, in the order of its samples. A lane takes a work item.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "path_queue.glsl"
#include "moments.glsl"

layout(local_size_x = TRACE_LANES) in;

#include "trace_items.glsl"

void main() {
    WorkList list = work_list();
    uint item = (queue_now.x + group_index()) * TRACE_LANES + gl_LocalInvocationIndex;
    WorkItem own = work[min(item, list.items - 1u)];
    uint at = own.pixel, spp = first_sample_of(list, item + 1u) - own.first, slot = own.first - queue_now.w;
    bool is_own = item < list.items && slot < queue_room.y && surface_at(at).id != NO_HIT;
    bool dpm = (frame.flags & FRAME_DPM) != 0u;
    Sums sums = NO_SAMPLES;
    uint traced = 0u, invalid = 0u;
    // Every lane takes as many turns as the one that has most samples, and what a lane does not have changes nothing: with turns of their own, lanes of
    // Mesa 22.3 were found to lose their first sample.
    uint turns = subgroupMax(is_own ? spp : 0u), i = 0u;
    do {
        uint row = path_row(slot + min(i, max(spp, 1u) - 1u));
        vec3 light = uintBitsToFloat(QUEUE(row).xyz);
        bool exact = dpm && (QUEUE(row + 3u).w & PATH_EXACT) != 0u;
        bool counts = i < spp && !sums.exact, valid = counts && finite3(light);
        float y = luminance(light);
        sums.light = valid ? sums.light + light : sums.light;
        sums.squares = valid ? sums.squares + y * y : sums.squares;
        sums.count += valid ? 1u : 0u;
        sums.exact = counts ? exact : sums.exact;
        traced += counts ? 1u : 0u;
        invalid += counts && !valid ? 1u : 0u;
        i++;
    } while (i < turns);
    if (!is_own) return;
    write_sums(at, sums);
    COUNT(samples, traced)
    COUNT_RARE(invalid_samples, invalid)
}
