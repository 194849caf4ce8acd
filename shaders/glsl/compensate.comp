// Radiance into code values: compensation for distance, angle and albedo of the real surface, then quantisation.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require
#include "scene.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = B_TRIANGLES, scalar) readonly buffer TriangleBlock { vec4 triangle_rows[]; };
layout(set = 0, binding = B_SURFACES, scalar) readonly buffer Surfaces { Surface surfaces[]; };
layout(set = 0, binding = B_RADIANCE, scalar) readonly buffer Radiance { vec4 radiance_in[]; };
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

void main() {
    uint index = gl_GlobalInvocationID.x;
    if (index >= frame.width * frame.height) return;
    Surface surface = surfaces[index];
    if (surface.id == NO_HIT || surface.distance < 0.0) {
        codes[index] = 0u;
        return;
    }
    uint instance = surface.id >> 24u;
    uint row = (instances[instance].triangle_offset + (surface.id & 0xffffffu)) * 3u;
    vec3 p0 = triangle_rows[row].xyz;
    vec3 g = transform_normal(instances[instance].world_from_object, cross(triangle_rows[row + 1u].xyz - p0, triangle_rows[row + 2u].xyz - p0));
    uvec2 pixel = uvec2(index % frame.width, index / frame.width);
    float cosine = abs(dot(g, projector_direction(vec2(pixel) + 0.5)));
    vec3 target = max(radiance_in[index].rgb - frame.ambient, vec3(0.0));
    float gain = frame.drive_scale * frame.inverse_albedo * surface.distance * surface.distance / max(cosine, 1e-3);
    vec3 drive = radiance_in[index].rgb == radiance_in[index].rgb ? target * gain : radiance_in[index].rgb;
    uint nans = 0u, clipped = 0u;
    codes[index] = quantise(drive.r, nans, clipped) | (quantise(drive.g, nans, clipped) << 8u) | (quantise(drive.b, nans, clipped) << 16u);
    atomicAdd(counters.lit_pixels, 1u);
    if (nans > 0u) atomicAdd(counters.nan_values, nans);
    if (clipped > 0u) atomicAdd(counters.clipped_values, clipped);
}
