// Radiance into code values (methods without a filter of their own; that of method dpm does the same at its end).
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require
#include "scene.glsl"
#include "compensate.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_SHOWN, scalar) readonly buffer Shown { vec4 shown[]; };

vec3 light_at(uvec2 pixel, uint index) { return shown[index].rgb; }

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint index = pixel.y * frame.width + pixel.x;
    compensate(pixel, index);
}
