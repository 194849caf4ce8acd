// Spatial filter of the picture, never of the history.
//
// [paper]: Poisson-disk taps, only in the periphery, blended in between two angles. Method dpm: the radius grows with the standard error
// that is left, so that what is known well is never blurred; radiance is filtered without its albedo and multiplied by it afterwards.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"
#include "noise.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_SURFACES, scalar) readonly buffer Surfaces { Surface surfaces[]; };
layout(set = 0, binding = B_GUIDES, scalar) readonly buffer Guides { Guide guides[]; };
layout(set = 0, binding = B_HISTORY, scalar) readonly buffer Histories { History histories[]; };
layout(set = 0, binding = B_FILTERED, scalar) readonly buffer Filtered { vec4 filtered[]; };
layout(set = 0, binding = B_SHOWN, scalar) writeonly buffer Shown { vec4 shown[]; };

layout(constant_id = 13) const bool HAS_FILTER = true;

// Twelve points of a Poisson disk of radius 1 (dart throwing with distance 0.45, seed 7).
const vec2 DISK[12] = vec2[](vec2(0.03, -0.09), vec2(-0.51, 0.13), vec2(0.47, 0.22), vec2(-0.08, 0.53), vec2(0.12, -0.62), vec2(-0.46, -0.41),
                             vec2(0.62, -0.31), vec2(-0.94, -0.18), vec2(-0.58, 0.72), vec2(0.43, 0.83), vec2(0.96, 0.12), vec2(-0.31, -0.92));

vec3 albedo_of(uint at) { return vec3(unpackHalf2x16(guides[at].albedo_rg), unpackHalf2x16(guides[at].albedo_b).x); }

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    if (!is_lit(surfaces[at])) {
        shown[at] = vec4(0.0);
        return;
    }
    bool dpm = (frame.flags & FRAME_DPM) != 0u;
    vec4 own = filtered[at];
    float radius = 0.0, blend = 1.0;
    uint history = frame.parity * frame.width * frame.height;
    float error = 0.0;
    if (HAS_FILTER) {
        if (dpm) {
            // Standard error relative to the pixel's luminance (with the visibility floor of [paper] eq. 2).
            error = sqrt(max(own.w, 0.0));
            float y = luminance(own.rgb * albedo_of(at));
            float relative = error / (y + 0.05);
            radius = clamp(relative * 60.0, 0.0, 6.0);
            if (radius < 0.75) radius = 0.0;
        } else {
            blend = clamp((guides[at].angle - frame.filter_degrees.x) / max(frame.filter_degrees.y - frame.filter_degrees.x, 1e-6), 0.0, 1.0);
            radius = blend > 0.0 ? 4.0 : 0.0;
        }
    }
    vec3 result = own.rgb;
    if (radius > 0.0) {
        uint instance = surfaces[at].id >> 24u;
        vec3 position = histories[history + at].position;
        vec3 normal = decode_normal(histories[history + at].normal);
        float footprint = abs(surfaces[at].distance) * frame.pixel_size;
        float turn = blue_noise(pixel, frame.frame, 1u) * 2.0 * PI;
        mat2 rotation = mat2(cos(turn), sin(turn), -sin(turn), cos(turn));
        vec3 sum = own.rgb;
        float total = 1.0;
        for (int i = 0; i < 12; i++) {
            ivec2 q = ivec2(pixel) + ivec2(round(rotation * DISK[i] * radius));
            if (any(lessThan(q, ivec2(0))) || any(greaterThanEqual(q, ivec2(frame.width, frame.height))) || q == ivec2(pixel)) continue;
            uint tap = uint(q.y) * frame.width + uint(q.x);
            if (!is_lit(surfaces[tap]) || surfaces[tap].id >> 24u != instance) continue;
            vec3 apart = histories[history + tap].position - position;
            float w = max(dot(decode_normal(histories[history + tap].normal), normal), 0.0);
            w = pow(w, 32.0) * exp(-abs(dot(apart, normal)) / max(footprint, 1e-12));
            if (dpm) {
                // Neighbours that differ by more than the noise of both are something else.
                float noise = error + sqrt(max(filtered[tap].w, 0.0)) + 1e-4;
                float apart_l = luminance((filtered[tap].rgb - own.rgb) * albedo_of(at));
                w *= exp(-0.5 * apart_l * apart_l / (noise * noise * 4.0));
            }
            sum += w * filtered[tap].rgb;
            total += w;
        }
        result = mix(own.rgb, sum / total, blend);
    }
    shown[at] = vec4(dpm ? result * albedo_of(at) : result, 1.0);
}
