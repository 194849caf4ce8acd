// Which pixels are traced this frame, with how many samples: an unordered list of work items, and the size of the tracing pass.
//
// Method paper: one ray position per coarse pixel (random in its block), every second coarse pixel in every second frame, samples by angle.
// Method dpm: a budget is shared out in proportion to the standard deviation of a sample; fractions are rounded by blue noise in time.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"
#include "noise.glsl"
#include "coarse.glsl"
#include "importance.glsl"
#extension GL_KHR_shader_subgroup_ballot : require

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_RADIANCE, scalar) writeonly buffer Radiance { vec4 radiance_out[]; };
layout(set = 0, binding = B_SCHEDULE, scalar) buffer ScheduleBlock { Schedule schedule; };
layout(set = 0, binding = B_WORK, scalar) writeonly buffer Work { WorkItem work[]; };

uint samples_of(uvec2 pixel, uint at) {
    if ((frame.flags & FRAME_CAMERA_IS_EYE) != 0u) return surface_at(at).id == NO_HIT ? 1u : frame.spp;
    if (!is_lit(surface_at(at))) return 0u;
    if ((frame.flags & FRAME_DPM) != 0u) {
        History h = history_at(at);
        float share = frame.budget_spp;
        if ((frame.flags & FRAME_ALLOCATE) != 0u) share *= float(importance_of(h)) / max(float(schedule.importance), 1.0) * float(schedule.lit);
        // A point never seen before starts with what an average pixel gets; nothing waits longer than two or three frames.
        share = clamp(share, min(0.5, 0.5 * frame.budget_spp), 16.0 * max(frame.budget_spp, 1.0));
        // One sample tells all where chance has no part, and the tracer stops there: the others are for what has just stopped being so. A new
        // point's own light is better than a guess.
        float one = min(1.0, 2.0 * frame.budget_spp);
        if ((h.flags & HISTORY_EXACT) != 0u) share = max(one, 2.0 * frame.budget_spp);
        else if (h.index == 0u) share = max(share, one);
        float whole = floor(share);
        return uint(whole) + (blue_noise(pixel, frame.drawn, 0u) < share - whole ? 1u : 0u);
    }
    uvec2 size = block_size(pixel);
    if (!is_traced_block(pixel, size)) return 0u;
    if (traced_pixel(pixel, size) != pixel) return 0u;
    return (frame.flags & FRAME_SPP_BY_ANGLE) != 0u ? frame.zone_spp[zone_of(guide_at(at).angle)] : frame.spp;
}

void main() {
    uvec2 pixel;
    bool inside = tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel);
    uint at = pixel.y * frame.width + pixel.x;
    uint spp = inside ? samples_of(pixel, at) : 0u;
    // What is traced is written by the tracer.
    if (inside && spp == 0u) radiance_out[at] = vec4(0.0);
    uvec4 ballot = subgroupBallot(spp > 0u);
    uint count = subgroupBallotBitCount(ballot);
    if (count == 0u) return;
    uint first = 0u;
    if (subgroupElect()) {
        first = atomicAdd(schedule.items, count);
        atomicMax(schedule.groups[0], (first + count + 63u) / 64u);
    }
    first = subgroupBroadcastFirst(first);
    if (spp > 0u) work[first + subgroupBallotExclusiveBitCount(ballot)] = WorkItem(at, spp);
}
