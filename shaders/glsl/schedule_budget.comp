// How many samples each pixel gets this frame: a budget is shared out in proportion to the pixels' importance (method dpm).
//
// Fractions of a sample are rounded by blue noise in time.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "work_list.glsl"
#include "noise.glsl"
#include "demand.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_RADIANCE, scalar) writeonly buffer Radiance { vec4 radiance_out[]; };

// No pixel gets more than this many times the budget of an average pixel, or of one sample where the budget is smaller.
const float LARGEST_SHARE = 16.0;

uint samples_of(uvec2 pixel, uint demand) {
    if (demand == DEMAND_NOT_LIT) return 0u;
    float share = frame.budget_spp;
    if ((frame.flags & FRAME_ALLOCATE) != 0u) share *= float(demand & (DEMAND_NEW - 1u)) / max(float(schedule.importance), 1.0) * float(schedule.lit);
    // No pixel waits longer than two or three frames.
    // Nor more samples than a workgroup of the pass `trace` has room for, unless the budget itself is larger.
    float largest = min(LARGEST_SHARE * max(frame.budget_spp, 1.0), max(float(TRACE_PIXEL_SAMPLES), frame.budget_spp));
    share = clamp(share, min(0.5, 0.5 * frame.budget_spp), largest);
    float one = min(1.0, 2.0 * frame.budget_spp);
    // The light of a deterministic pixel takes one sample, and the tracer stops there. The others are for a pixel that has just stopped being
    // deterministic. A new point is traced at once, because its own light is better than a guess.
    if ((demand & DEMAND_EXACT) != 0u) share = max(one, 2.0 * frame.budget_spp);
    else if ((demand & DEMAND_NEW) != 0u) share = max(share, one);
    float whole = floor(share);
    return uint(whole) + (blue_noise(pixel, frame.drawn, 0u) < share - whole ? 1u : 0u);
}

void main() {
    uvec2 pixel;
    bool inside = tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel);
    uint at = pixel.y * frame.width + pixel.x;
    uint spp = 0u;
    if (inside && camera_is_eye()) {
        spp = samples_of_camera(at);
    } else if (inside) {
        uint demand = demand_at(at);
        spp = samples_of(pixel, demand);
        if (demand != DEMAND_NOT_LIT) set_demand(at, DEMAND_NOT_TRACED);
    }
    if (inside && spp == 0u && (frame.flags & FRAME_SHOWS_ALL) != 0u) radiance_out[at] = vec4(0.0);
    list_work(at, spp);
}
