// A new frame into the history, and the history into the picture: every frame has a weight (methods paper and miyamoto).
//
// [paper]: the weight of the new frame depends on the angle from the gaze; it is 1 / (n + 1) after a disocclusion.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"
#include "coarse.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_RADIANCE, scalar) readonly buffer Radiance { vec4 radiance_in[]; };

// Frames are counted up to here. The weight of a new frame has long been the one by angle then.
const float MOST_FRAMES = 4096.0;

// Blends in the frame that was traced.
void add_frame(inout HistoryLight h, vec3 traced, uint at) {
    float least = (frame.flags & FRAME_TEMPORAL) != 0u ? frame.zone_alpha[zone_of(sight_at(at).angle)] : 1.0;
    float alpha = max(1.0 / (h.weight + 1.0), least);
    h.mean = mix(h.mean, traced, alpha);
    h.weight = min(h.weight + 1.0, MOST_FRAMES);
}

// For a pixel of which nothing is known and that is not traced: shows the first of the four neighbouring coarse pixels that is traced.
void borrow(inout HistoryLight h, uvec2 pixel, uvec2 size) {
    const ivec2 beside[4] = ivec2[](ivec2(-1, 0), ivec2(1, 0), ivec2(0, -1), ivec2(0, 1));
    for (int i = 0; i < 4; i++) {
        ivec2 q = ivec2(pixel) + beside[i] * ivec2(size);
        uint index;
        if (!pixel_beside(q, index)) continue;
        uvec2 other_size = block_size(uvec2(q));
        if (!is_lit(surface_at(index)) || !is_traced_block(uvec2(q), other_size)) continue;
        uvec2 other = traced_pixel(uvec2(q), other_size);
        vec4 r = radiance_in[other.y * frame.width + other.x];
        if (r.w > 0.0) {
            h.mean = r.rgb;
            break;
        }
    }
}

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    if (!is_lit(surface_at(at))) {
        set_filtered(at, Filtered(vec3(0.0), 0u));
        return;
    }
    HistoryLight h = history_light_at(at);
    uvec2 size = block_size(pixel);
    uvec2 source = traced_pixel(pixel, size);
    uint from = source.y * frame.width + source.x;
    vec4 traced = is_traced_block(pixel, size) ? radiance_in[from] : vec4(0.0);
    if (traced.w > 0.0) add_frame(h, traced.rgb, at);
    else if (!(h.weight > 0.0)) borrow(h, pixel, size);
    set_filtered(at, Filtered(h.mean, 0u));
    set_history_light(at, h);
}
