// Radiance into code values: compensation for distance, angle and albedo of the real surface, then quantisation.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require
#include "scene.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_SURFACES, scalar) readonly buffer Surfaces { Surface surfaces[]; };
layout(set = 0, binding = B_SHOWN, scalar) readonly buffer Shown { vec4 shown[]; };
layout(set = 0, binding = B_CODES, scalar) writeonly buffer Codes { uint codes[]; };

// floor(255 v + 0.5) in f32 without contraction: bit for bit the CPU's `quantise`.
uint quantise(float v, inout uint nans, inout uint clipped) {
    uint bits = floatBitsToUint(v);
    if ((bits & 0x7fffffffu) > 0x7f800000u) {
        nans++;
        return 0u;
    }
    if (v <= 0.0) return 0u;
    if (v >= 1.0) {
        if (v > 1.0) clipped++;
        return 255u;
    }
    precise float scaled = v * 255.0;
    precise float shifted = scaled + 0.5;
    return uint(shifted);
}

layout(set = 0, binding = B_TRIANGLE_REFS, scalar) readonly buffer TriangleRefs { TriangleRef triangle_refs[]; };
layout(set = 0, binding = B_VERTICES, scalar) readonly buffer Vertices { Vertex vertices[]; };
layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint index = pixel.y * frame.width + pixel.x;
    Surface surface = surfaces[index];
    uint nans = 0u, clipped = 0u, lit = 0u, code = 0u;
    if (surface.id != NO_HIT && surface.distance > 0.0) {
        uint instance = surface.id >> 24u;
        TriangleRef ref = triangle_refs[instances[instance].triangle_offset + (surface.id & 0xffffffu)];
        vec2 b = surface.barycentric;
        // The real surface is smooth: its normal is the interpolated one, without the look's normal map.
        vec3 n = vertices[ref.vertices.x].normal * (1.0 - b.x - b.y) + vertices[ref.vertices.y].normal * b.x + vertices[ref.vertices.z].normal * b.y;
        float cosine = abs(dot(transform_normal(instances[instance].world_from_object, n), projector_direction(vec2(pixel) + 0.5)));
        vec3 target = shown[index].rgb - frame.ambient;
        float geometry = surface.distance * surface.distance / max(cosine, 1e-3);
        vec3 drive = target * (frame.drive_gain * geometry);
        code = quantise(drive.r, nans, clipped) | (quantise(drive.g, nans, clipped) << 8u) | (quantise(drive.b, nans, clipped) << 16u);
        lit = 1u;
    }
    codes[index] = code;
    COUNT(lit_pixels, lit)
    COUNT(nan_values, nans)
    COUNT(clipped_values, clipped)
}
