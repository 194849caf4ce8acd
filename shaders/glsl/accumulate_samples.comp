// New samples into the history, and the history into the picture: every sample counts once, up to a cap (method dpm).
//
// How far the history lags behind the last few frames is kept beside it, so that later passes can correct the picture.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"
#include "moments.glsl"
#include "shift.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_RADIANCE, scalar) readonly buffer Radiance { vec4 radiance_in[]; };

// Share of the light by which a frame's noise may stray before a history helps against it.
const float UNSEEN = 0.002;
// The variance of a sample is the mean over this many samples.
const float VARIANCE_SAMPLES = 32.0;
// A first single sample says nothing of its variance. At least this share of its square is taken.
const float LEAST_VARIANCE = 0.25;
// Weight of a frame in the mean of the surprise.
const float SURPRISE_WEIGHT = 0.1;
// Powers are never taken as smaller than this, so that one can divide by them.
const float LEAST_POWER = 1e-12;

// The variance of one sample, after a frame of `count` samples with the mean luminance `y`. Several samples are compared with their frame's mean,
// so that a change of the light does not enter. A single sample is compared with `known`, the luminance of the history.
float new_variance(float weight, float before, float count, float y, float known, float sum_squares) {
    float second = sum_squares / count;
    float about = weight > 0.0 ? mix(y, known, weight / (weight + count)) : y;
    float variance = count > 1.5 ? max(second - y * y, 0.0) * count / (count - 1.0) : (y - about) * (y - about);
    float v_weight = clamp(count / (min(weight, VARIANCE_SAMPLES) + count), 0.0, 1.0);
    return weight > 0.0 ? mix(before, variance, v_weight) : max(variance, LEAST_VARIANCE * y * y);
}

// Adds the samples of a frame: `traced` has their mean and their number.
void add_samples(inout HistoryLight l, inout HistoryNoise n, vec4 traced, vec3 shift, vec3 albedo, Moments moments) {
    vec3 fresh = traced.rgb / albedo;
    float y = luminance(traced.rgb);
    bool exact = moments.exact;
    // A deterministic pixel needs no history, so drop it. Also drop it when a pixel stops being deterministic.
    if (exact || (n.body_and_used & HISTORY_EXACT) != 0u) {
        l.weight = 0.0;
        n.drift = 0.0;
        n.surprise = 0.0;
    }
    uint used = (n.body_and_used + uint(traced.w)) & HISTORY_USED;
    n.body_and_used = (n.body_and_used & ~(HISTORY_USED | HISTORY_EXACT)) | used | (exact ? HISTORY_EXACT : 0u);
    float known = luminance((l.mean + shift) * albedo);
    n.variance = exact ? 0.0 : new_variance(l.weight, n.variance, traced.w, y, known, moments.sum_squares);
    // Mean square of what single frames add to the history: their noise, and the history's error.
    if (l.weight > 0.0) n.surprise = mix(n.surprise, (y - known) * (y - known), n.surprise > 0.0 ? SURPRISE_WEIGHT : 1.0);
    // The innovation is how far a frame is from the history, as luminance without albedo. Its mean over the last few frames is the lag.
    float per_frame = samples_a_frame();
    float innovation = luminance(fresh - l.mean - shift);
    n.drift = l.weight > 0.0 ? mix(n.drift, innovation, LAG_WEIGHT) : 0.0;
    // The history is no longer than noise requires. Where a frame has next to no noise, as in a mirror of an even sky, the eye's own mean is better.
    float frames = min(frame.history_cap, n.variance / per_frame / max(UNSEEN * UNSEEN * known * known, LEAST_POWER));
    l.weight = min(l.weight, frames * per_frame);
    // Every sample counts once, so that the points of the sequence keep their even spread. Their number hardly depends on the sample that is
    // weighed, because the variance is a mean over many.
    l.mean = l.weight > 0.0 ? mix(l.mean, fresh - shift, traced.w / (l.weight + traced.w)) : fresh - shift;
    l.weight += traced.w;
}

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    uint demand = demand_at(at);
    if (demand == DEMAND_NOT_LIT) {
        set_filtered(at, Filtered(vec3(0.0), 0u));
        return;
    }
    HistoryLight l = history_light_at(at);
    // From the history's surface point to the pixel's, left by reproject_point.comp.
    vec3 shift = unpack_shift(shift_at(at)), albedo = albedo_of(tint_at(at));
    if (demand != DEMAND_NOT_TRACED) {
        vec4 traced = radiance_in[at];
        if (traced.w > 0.0) {
            HistoryNoise n = history_noise_at(at);
            add_samples(l, n, traced, shift, albedo, unpack_moments(demand));
            set_history_light(at, l);
            set_history_noise(at, n);
        }
    }
    // A half is finite up to MOST_HALF.
    set_filtered(at, Filtered(max(l.mean + shift, vec3(0.0)), packHalf2x16(vec2(min(l.weight, MOST_HALF), luminance(albedo)))));
}
