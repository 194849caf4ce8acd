// New samples into the history, and the history into the picture.
//
// [paper]: weight of the new frame by angle, 1 / (n + 1) after a disocclusion. Method dpm: every sample counts once, up to a cap; how far the
// history lags behind the last few frames is kept beside it, for the picture to make up for.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"
#include "coarse.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_RADIANCE, scalar) readonly buffer Radiance { vec4 radiance_in[]; };
layout(set = 0, binding = B_HISTORY, scalar) buffer Histories { History histories[]; };
layout(set = 0, binding = B_FILTERED, scalar) buffer FilteredBlock { Filtered filtered[]; };

// Method dpm: from the history's surface point to the pixel's.
layout(set = 0, binding = B_SHOWN, scalar) readonly buffer Shown { vec4 shown[]; };

// Share of the light by which a frame's noise may stray without a history against it.
const float UNSEEN = 0.002;

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    if (!is_lit(surface_at(at))) {
        filtered[at] = Filtered(vec3(0.0), 0.0);
        return;
    }
    History h = histories[at];
    if ((frame.flags & FRAME_DPM) != 0u) {
        vec4 traced = radiance_in[at];
        vec3 albedo = albedo_of(guide_at(at));
        vec3 shift = shown[at].rgb;
        if (traced.w > 0.0) {
            vec3 fresh = traced.rgb / albedo;
            float y = luminance(traced.rgb);
            h.index += uint(traced.w);
            // Variance of one sample about its frame's mean, which no change of the light enters; of a single sample about the history.
            // Where chance has no part a frame tells all: nothing of before is kept, nor of a guess. What was so and is no longer is not known yet.
            bool exact = filtered[at].light.y > 0.5;
            if (exact || (h.flags & HISTORY_EXACT) != 0u) {
                h.weight = 0.0;
                h.drift = 0.0;
                h.surprise = 0.0;
            }
            h.flags = exact ? HISTORY_EXACT : 0u;
            float second = filtered[at].light.x / traced.w;
            float known = luminance((h.mean + shift) * albedo);
            float about = h.weight > 0.0 ? mix(y, known, h.weight / (h.weight + traced.w)) : y;
            float variance = traced.w > 1.5 ? max(second - y * y, 0.0) * traced.w / (traced.w - 1.0) : (y - about) * (y - about);
            float v_weight = clamp(traced.w / (min(h.weight, 32.0) + traced.w), 0.0, 1.0);
            h.variance = exact ? 0.0 : h.weight > 0.0 ? mix(h.variance, variance, v_weight) : max(variance, 0.25 * y * y);
            // Power of what single frames say beyond the history: their noise, and what the history gets wrong.
            if (h.weight > 0.0) h.surprise = mix(h.surprise, (y - known) * (y - known), h.surprise > 0.0 ? 0.1 : 1.0);
            // Innovation: what the frame says beyond the history, as luminance without albedo. Its mean over the last few frames is the lag.
            float per_frame = samples_a_frame();
            float innovation = luminance(fresh - h.mean - shift);
            h.drift = h.weight > 0.0 ? mix(h.drift, innovation, LAG_WEIGHT) : 0.0;
            // No longer a history than noise calls for: where a frame has next to none (a mirror of an even sky) the eye's own mean does better.
            float frames = min(frame.history_cap, h.variance / per_frame / max(UNSEEN * UNSEEN * known * known, 1e-12));
            h.weight = min(h.weight, frames * per_frame);
            // Every sample counts once, so that the sequence's points keep their even spread; their number follows from the variance of long
            // before, hardly from the sample that is weighed.
            h.mean = h.weight > 0.0 ? mix(h.mean, fresh - shift, traced.w / (h.weight + traced.w)) : fresh - shift;
            h.weight += traced.w;
        }
        filtered[at] = Filtered(max(h.mean + shift, vec3(0.0)), h.weight > 0.0 ? h.variance / h.weight : 0.0);
    } else {
        uvec2 size = block_size(pixel);
        uvec2 source = traced_pixel(pixel, size);
        uint from = source.y * frame.width + source.x;
        vec4 traced = is_traced_block(pixel, size) ? radiance_in[from] : vec4(0.0);
        if (traced.w > 0.0) {
            float floor_ = (frame.flags & FRAME_TEMPORAL) != 0u ? frame.zone_alpha[zone_of(guide_at(at).angle)] : 1.0;
            float alpha = max(1.0 / (h.weight + 1.0), floor_);
            h.mean = mix(h.mean, traced.rgb, alpha);
            h.weight = min(h.weight + 1.0, 4096.0);
        } else if (!(h.weight > 0.0)) {
            // Nothing known and not traced: the nearest of the four coarse neighbours that was.
            const ivec2 beside[4] = ivec2[](ivec2(-1, 0), ivec2(1, 0), ivec2(0, -1), ivec2(0, 1));
            for (int i = 0; i < 4; i++) {
                ivec2 q = ivec2(pixel) + beside[i] * ivec2(size);
                if (any(lessThan(q, ivec2(0))) || any(greaterThanEqual(q, ivec2(frame.width, frame.height)))) continue;
                uvec2 other_size = block_size(uvec2(q));
                if (!is_lit(surface_at(uint(q.y) * frame.width + uint(q.x))) || !is_traced_block(uvec2(q), other_size)) continue;
                uvec2 other = traced_pixel(uvec2(q), other_size);
                vec4 r = radiance_in[other.y * frame.width + other.x];
                if (r.w > 0.0) {
                    h.mean = r.rgb;
                    break;
                }
            }
        }
        filtered[at] = Filtered(h.mean, 1.0);
    }
    histories[at] = h;
}
