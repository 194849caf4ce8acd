// New samples into the history, and the history into the picture: every sample counts once, up to a cap (method dpm).
//
// How far the history lags behind the last few frames is kept beside it, so that later passes can correct the picture.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"
#include "moments.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_RADIANCE, scalar) readonly buffer Radiance { vec4 radiance_in[]; };
layout(set = 0, binding = B_HISTORY, scalar) buffer Histories { History histories[]; };
// Read as `Moments`, then written as the history's picture.
layout(set = 0, binding = B_FILTERED, scalar) buffer FilteredBlock { Filtered filtered[]; };
// From the history's surface point to the pixel's: written by reproject_point.comp. The buffer holds the picture from the pass spatial on.
layout(set = 0, binding = B_SHOWN, scalar) readonly buffer Shifts { vec4 shifts[]; };

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
float new_variance(History h, float count, float y, float known, float sum_squares) {
    float second = sum_squares / count;
    float about = h.weight > 0.0 ? mix(y, known, h.weight / (h.weight + count)) : y;
    float variance = count > 1.5 ? max(second - y * y, 0.0) * count / (count - 1.0) : (y - about) * (y - about);
    float v_weight = clamp(count / (min(h.weight, VARIANCE_SAMPLES) + count), 0.0, 1.0);
    return h.weight > 0.0 ? mix(h.variance, variance, v_weight) : max(variance, LEAST_VARIANCE * y * y);
}

// Adds the samples of a frame: `traced` has their mean and their number.
void add_samples(inout History h, vec4 traced, vec3 shift, vec3 albedo, Moments moments) {
    vec3 fresh = traced.rgb / albedo;
    float y = luminance(traced.rgb);
    bool exact = moments.exact;
    h.index += uint(traced.w);
    // A deterministic pixel needs no history, so drop it. Also drop it when a pixel stops being deterministic.
    if (exact || (h.flags & HISTORY_EXACT) != 0u) {
        h.weight = 0.0;
        h.drift = 0.0;
        h.surprise = 0.0;
    }
    h.flags = exact ? HISTORY_EXACT : 0u;
    float known = luminance((h.mean + shift) * albedo);
    h.variance = exact ? 0.0 : new_variance(h, traced.w, y, known, moments.sum_squares);
    // Mean square of what single frames add to the history: their noise, and the history's error.
    if (h.weight > 0.0) h.surprise = mix(h.surprise, (y - known) * (y - known), h.surprise > 0.0 ? SURPRISE_WEIGHT : 1.0);
    // The innovation is how far a frame is from the history, as luminance without albedo. Its mean over the last few frames is the lag.
    float per_frame = samples_a_frame();
    float innovation = luminance(fresh - h.mean - shift);
    h.drift = h.weight > 0.0 ? mix(h.drift, innovation, LAG_WEIGHT) : 0.0;
    // The history is no longer than noise requires. Where a frame has next to no noise, as in a mirror of an even sky, the eye's own mean is better.
    float frames = min(frame.history_cap, h.variance / per_frame / max(UNSEEN * UNSEEN * known * known, LEAST_POWER));
    h.weight = min(h.weight, frames * per_frame);
    // Every sample counts once, so that the points of the sequence keep their even spread. Their number hardly depends on the sample that is
    // weighed, because the variance is a mean over many.
    h.mean = h.weight > 0.0 ? mix(h.mean, fresh - shift, traced.w / (h.weight + traced.w)) : fresh - shift;
    h.weight += traced.w;
}

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    if (!is_lit(surface_at(at))) {
        filtered[at] = Filtered(vec3(0.0), 0.0);
        return;
    }
    History h = histories[at];
    vec4 traced = radiance_in[at];
    vec3 shift = shifts[at].rgb;
    if (traced.w > 0.0) add_samples(h, traced, shift, albedo_of(guide_at(at)), unpack_moments(filtered[at]));
    filtered[at] = Filtered(max(h.mean + shift, vec3(0.0)), h.weight > 0.0 ? h.variance / h.weight : 0.0);
    histories[at] = h;
}
