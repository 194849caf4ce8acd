// How many samples each pixel gets this frame: one pixel of every coarse pixel is traced (the methods of others).
//
// Method paper: the ray of a coarse pixel goes through a random pixel of its block, every second coarse pixel is traced in every second frame, and
// the number of samples depends on the angle from the gaze. Method miyamoto has blocks of one pixel, method full traces all of them.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "work_list.glsl"
#include "coarse.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_RADIANCE, scalar) writeonly buffer Radiance { vec4 radiance_out[]; };

uint samples_of(uvec2 pixel, uint at) {
    if (!is_lit(surface_at(at))) return 0u;
    uvec2 size = block_size(pixel);
    if (!is_traced_block(pixel, size)) return 0u;
    if (traced_pixel(pixel, size) != pixel) return 0u;
    return (frame.flags & FRAME_SPP_BY_ANGLE) != 0u ? frame.zone_spp[zone_of(sight_at(at).angle)] : frame.spp;
}

void main() {
    uvec2 pixel;
    bool inside = tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel);
    uint at = pixel.y * frame.width + pixel.x;
    uint spp = !inside ? 0u : camera_is_eye() ? samples_of_camera(at) : samples_of(pixel, at);
    // The radiance of the other pixels is written by the pass `trace`.
    if (inside && spp == 0u) radiance_out[at] = vec4(0.0);
    list_work(at, spp);
}
