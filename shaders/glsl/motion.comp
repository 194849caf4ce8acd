// How far the surface of each pixel moves on the raster while the planes of the frame last, and a copy of the word that was drawn there, from which
// the pass `warp` takes the bits. Only tiles on which the light of a moving body can fall are listed.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require
#include "scene.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_CODES, scalar) readonly buffer Codes { uint codes[]; };
layout(set = 0, binding = B_MOVERS, scalar) readonly buffer Movers { Mover movers[]; };
layout(set = 0, binding = B_MOTION, scalar) writeonly buffer Motions { Moved motions[]; };

// Motion of a surface point of a mover during the exposure, in 1/64 pixel.
ivec2 motion_of(uint mover, uint instance, vec3 world) {
    vec3 object = transform_point(instance_at(instance).object_from_world, world);
    vec3 half_way = 0.5 * transform_point(movers[mover].motion_from_object, object);
    vec2 moved = project(world + half_way) - project(world - half_way);
    // A point that leaves the lens is left where it was drawn.
    if (!(max(abs(moved.x), abs(moved.y)) < 1e5)) return ivec2(0);
    return ivec2(clamp(floor(moved * 64.0 + 0.5), -32767.0, 32767.0));
}

// Code values at a pixel, or at the nearest pixel of the raster.
ivec3 codes_at(ivec2 pixel) {
    pixel = clamp(pixel, ivec2(0), ivec2(frame.width, frame.height) - 1);
    uint word = codes[uint(pixel.y) * frame.width + uint(pixel.x)];
    return ivec3(word & 255u, (word >> 8u) & 255u, (word >> 16u) & 255u);
}

// True if the code values of a pixel are not about in the middle between those to its left and right, and of those above and below.
bool is_rough(ivec2 pixel) {
    ivec3 twice = 2 * codes_at(pixel);
    ivec3 across = abs(codes_at(pixel - ivec2(1, 0)) - twice + codes_at(pixel + ivec2(1, 0)));
    ivec3 down = abs(codes_at(pixel - ivec2(0, 1)) - twice + codes_at(pixel + ivec2(0, 1)));
    return any(greaterThan(max(across, down), ivec3(ROUGH_STEP)));
}

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint index = pixel.y * frame.width + pixel.x;
    SurfaceHit surface = surface_at(index);
    uint owner = OWNER_NONE, depth = 0u;
    ivec2 motion = ivec2(0);
    if (surface.id != NO_HIT) {
        uint instance = surface.id >> 24u;
        // The distance of what the eye cannot see is negative.
        float distance_ = abs(surface.distance);
        uint mover = instance_at(instance).mover;
        if (mover != 0u) motion = motion_of(mover - 1u, instance, pixel_direction(pixel) * distance_);
        owner = OWNER_STILL + mover;
        // The bits of positive numbers grow with them.
        depth = floatBitsToUint(distance_) >> 7u;
    }
    uint word = codes[index];
    if (owner > OWNER_STILL && !WARP_WHOLE_WORDS && is_rough(ivec2(pixel))) word |= WORD_ROUGH;
    motions[index].word = word;
    motions[index].motion = (uint(motion.x) & 0xffffu) | (uint(motion.y) << 16u);
    motions[index].owner_and_depth = (owner << 24u) | (depth & 0xffffffu);
}
