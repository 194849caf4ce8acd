// What both spatial filters share: neighbours on the same body, and a disk of them.
#include "scene.glsl"
#include "noise.glsl"

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_SHOWN, scalar) writeonly buffer Shown { vec4 shown[]; };

// Twelve points of a Poisson disk of radius 1 (dart throwing with distance 0.45, seed 7).
const vec2 DISK[12] = vec2[](vec2(0.03, -0.09), vec2(-0.51, 0.13), vec2(0.47, 0.22), vec2(-0.08, 0.53), vec2(0.12, -0.62), vec2(-0.46, -0.41),
                             vec2(0.62, -0.31), vec2(-0.94, -0.18), vec2(-0.58, 0.72), vec2(0.43, 0.83), vec2(0.96, 0.12), vec2(-0.31, -0.92));

// The index of the neighbour at raster position `q`. False if it is not lit, or not of the body `instance`.
bool neighbour(ivec2 q, uint instance, out uint tap) {
    if (!pixel_beside(q, tap)) return false;
    return is_lit(surface_at(tap)) && surface_at(tap).id >> 24u == instance;
}

// A rotation of the disk that differs in every pixel and frame.
mat2 turn_of(uvec2 pixel, uint dimension) {
    float turn = blue_noise(pixel, frame.drawn, dimension) * 2.0 * PI;
    return mat2(cos(turn), sin(turn), -sin(turn), cos(turn));
}
