// Spatial filter of the picture, never of the history: a local linear regression (method dpm).
//
// A pixel's light is replaced by that of a plane through its neighbours, as far as noise explains what the plane misses. Then the lag of the
// histories around is corrected. All of this is without albedo, which is multiplied in at the end. Then the light becomes code values at once.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "spatial.glsl"
#include "compensate.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

// Variance of the mean of a sequence's points, as a share of that of independent samples: for a few frames and for many. The more points there
// are, the more even is their spread.
const float SEQUENCE_VARIANCE_FEW = 0.5, SEQUENCE_VARIANCE_MANY = 0.27, MANY_FRAMES = 60.0;
// The eye is taken to average the picture's noise over this many frames. Noise averages out, but an error of the filter stays.
const float SEEN_FRAMES = 20.0;
// Of the samples of a young point, the share that changes while the eye averages.
const float OWN_CHANGING = 0.3;
// Neighbours may differ by this share of their light beyond what the plane explains.
const float TOLERANCE = 0.025;
// Darker light counts as this bright, so that one can divide by it.
const float LEAST_LEVEL = 0.02;
// Radius of the disk over which lag is estimated, pixels.
const float LAG_RADIUS_PX = 6.0;
// The light is corrected for lag by this factor at the least and at the most.
const float LEAST_CORRECTION = 0.5, MOST_CORRECTION = 2.0;
// Neighbours in the regression have normals with at least this cosine to the pixel's, and lie within so many footprints of its tangent plane.
const float LIKE_NORMAL = 0.6, DEPTH = 3.0;
// Expected squares of the slopes relative to the light: 2 % a pixel over the raster, and a third over the normal's whole range.
const float RASTER_SLOPES = 4e-4, NORMAL_SLOPES = 0.1;
// Squared error of what light is divided by, relative to how it varies around: 5 %.
const float STEEP = 0.0025;
// With next to no samples a frame, half of what a pixel of so many samples differs from its neighbours is taken for chance.
const float DOUBTED_SAMPLES = 4.0;
// Samples that a pixel is taken to hold at the least, so that one can divide by their number.
const float LEAST_HELD = 1e-6;
// What is left of an unknown is never taken as smaller, so that one can divide by it.
const float LEAST_PIVOT = 1e-12;

// The regression's weighted sums over the neighbours.
struct Sums {
    float used;     // Number of neighbours.
    float power;    // Weighted squares of their luminance, relative to the pixel's own.
    float expected; // Weighted variances that chance explains.
    float single;   // Sum of the variances of one sample, each relative to the square of what its light is divided by.
    float plain;    // Sum of the same as they are.
    vec2 divisor;   // Sums of what their light is divided by, and of its squares.
};

float sequence_variance(float held) {
    return mix(SEQUENCE_VARIANCE_FEW, SEQUENCE_VARIANCE_MANY, clamp(held / (MANY_FRAMES * samples_a_frame()), 0.0, 1.0));
}

float weight_of(Filtered f) { return unpackHalf2x16(f.weight_and_albedo).x; }

// Whether something is known of the light of a pixel, on the body `instance`. The surface itself need not be read.
bool is_known(Filtered f, HistoryNoise n, uint instance) {
    return (f.weight_and_albedo & 0xffffu) != 0u && ((n.body_and_used / (HISTORY_USED + 1u)) & 255u) == instance;
}

// How far the history lags: a slope of the light over the histories' age is fitted to the drifts around, as far as chance does not explain it.
float lag_of(uvec2 pixel, uint at) {
    uint instance = surface_at(at).id >> 24u;
    vec3 normal = decode_normal(history_place_at(at).normal);
    mat2 rotation = turn_of(pixel, 0u);
    float frames = 1.0 / samples_a_frame();
    float age = weight_of(filtered_at(at)) * frames, drift = history_noise_at(at).drift;
    float xx = age * age, xy = age * drift, yy = drift * drift, used = 1.0;
    for (int i = 0; i < 12; i++) {
        ivec2 q = ivec2(pixel) + ivec2(round(rotation * DISK[i] * LAG_RADIUS_PX));
        uint tap;
        if (!pixel_beside(q, tap) || q == ivec2(pixel)) continue;
        Filtered f = filtered_at(tap);
        HistoryNoise noise = history_noise_at(tap);
        if (!is_known(f, noise, instance)) continue;
        vec3 n = normal_direction(history_place_at(tap).normal);
        // The eighth power of the cosine.
        float cosine = max(dot(n, normal), 0.0), w = cosine * cosine / dot(n, n);
        w *= w;
        w *= w;
        float x = weight_of(f) * frames, y = noise.drift;
        xx += w * x * x;
        xy += w * x * y;
        yy += w * y * y;
        used += w;
    }
    float fit = xy * xy / max(xx, 1e-12);
    float chance = max(yy - fit, 0.0) / max(used - 1.0, 1.0);
    // Errors of the correction change from frame to frame. In the periphery, where the eye sees flicker best, only what is beyond doubt is corrected.
    float doubt = mix(0.5, 8.0, periphery(angle_of(tint_at(at))));
    float trust = fit > 0.0 ? max(1.0 - doubt * chance / fit, 0.0) : 0.0;
    return trust * xy / max(xx, 1e-12) * age;
}

// The normal equations of the regression. The unknowns are two slopes over the raster, two over the normal, and the constant.
struct Equations {
    vec4 slopes;    // Diagonal of the matrix.
    float constant; // The sum of the weights.
    // What lies beside the diagonal: each unknown with those after it.
    vec4 x;
    vec3 y;
    vec2 u;
    float v;
    // Right sides, a column for each unknown.
    vec3 light_x, light_y, light_u, light_v, light;
};

// Fills the normal equations from the 5 x 5 pixels around.
Sums gather(uvec2 pixel, uint at, vec3 own, float tolerated, out Equations a) {
    uint instance = surface_at(at).id >> 24u;
    vec3 position = history_place_at(at).position;
    vec3 normal = decode_normal(history_place_at(at).normal);
    vec3 across = normalize(abs(normal.x) < 0.7 ? cross(normal, vec3(1.0, 0.0, 0.0)) : cross(normal, vec3(0.0, 1.0, 0.0)));
    vec3 along = cross(normal, across);
    float farthest = DEPTH * abs(surface_at(at).distance) * frame.pixel_size;
    a = Equations(vec4(0.0), 0.0, vec4(0.0), vec3(0.0), vec2(0.0), 0.0, vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0));
    // Neighbours are weighed by their numbers of samples alone. By their variances those whose samples missed the light would weigh most.
    float divisor = unpackHalf2x16(filtered_at(at).weight_and_albedo).y, single = history_noise_at(at).variance / (divisor * divisor);
    Sums s = Sums(0.0, 0.0, 0.0, 0.0, 0.0, vec2(0.0));
    [[dont_unroll]] for (int row = -2; row <= 2; row++) {
        WRITTEN_OUT for (int column = -2; column <= 2; column++) {
            ivec2 d = ivec2(column, row);
            uint tap;
            bool like = pixel_beside(ivec2(pixel) + d, tap);
            SKIP_UNLESS(like)
            Filtered f = filtered_at(tap);
            HistoryNoise history = history_noise_at(tap);
            like = is_known(f, history, instance) && like;
            SKIP_UNLESS(like)
            HistoryPlace place = history_place_at(tap);
            vec3 n = decode_normal(place.normal);
            like = like && dot(n, normal) >= LIKE_NORMAL && abs(dot(place.position - position, normal)) <= farthest;
            SKIP_UNLESS(like)
            vec2 weight_and_albedo = unpackHalf2x16(f.weight_and_albedo);
            float weight = weight_and_albedo.x, light = weight_and_albedo.y;
            float noise = like ? history.variance * sequence_variance(weight) / (weight * light * light) : 0.0;
            float w = like ? 1.0 / (single * sequence_variance(weight) / weight + tolerated) : 0.0;
            vec3 m = like ? f.light - own : vec3(0.0);
            vec4 e = vec4(d, dot(n, across), dot(n, along));
            vec4 we = w * e;
            a.slopes += we * e;
            a.constant += w;
            a.x += we.x * vec4(e.yzw, 1.0);
            a.y += we.y * vec3(e.zw, 1.0);
            a.u += we.z * vec2(e.w, 1.0);
            a.v += we.w;
            a.light_x += we.x * m;
            a.light_y += we.y * m;
            a.light_u += we.z * m;
            a.light_v += we.w * m;
            a.light += w * m;
            float y = luminance(m);
            s.power += w * y * y;
            s.used += like ? 1.0 : 0.0;
            s.expected += w * noise;
            s.single += like ? noise * weight : 0.0;
            s.divisor += like ? vec2(light, light * light) : vec2(0.0);
            s.plain += like ? noise * weight * light * light : 0.0;
        }
    }
    return s;
}

// The power that an unknown explains when it is taken out, by its right side and the inverse of its pivot.
float explained_by(vec3 light, float inverse) {
    float y = luminance(light);
    return y * y * inverse;
}

// Solves the normal equations for the constant, which is the last of the unknowns: the others are taken out one after the other, and need not be
// known. `explained` is the power that the fit explains. Without arrays, which software Vulkan would keep in memory.
vec3 solve(Equations a, out float explained) {
    float inverse = 1.0 / max(a.slopes.x, LEAST_PIVOT);
    vec4 x = a.x * inverse;
    a.slopes.yzw -= x.xyz * a.x.xyz;
    a.constant -= x.w * a.x.w;
    a.y -= x.x * a.x.yzw;
    a.u -= x.y * a.x.zw;
    a.v -= x.z * a.x.w;
    a.light_y -= x.x * a.light_x;
    a.light_u -= x.y * a.light_x;
    a.light_v -= x.z * a.light_x;
    a.light -= x.w * a.light_x;
    explained = explained_by(a.light_x, inverse);
    inverse = 1.0 / max(a.slopes.y, LEAST_PIVOT);
    vec3 y = a.y * inverse;
    a.slopes.zw -= y.xy * a.y.xy;
    a.constant -= y.z * a.y.z;
    a.u -= y.x * a.y.yz;
    a.v -= y.y * a.y.z;
    a.light_u -= y.x * a.light_y;
    a.light_v -= y.y * a.light_y;
    a.light -= y.z * a.light_y;
    explained += explained_by(a.light_y, inverse);
    inverse = 1.0 / max(a.slopes.z, LEAST_PIVOT);
    vec2 u = a.u * inverse;
    a.slopes.w -= u.x * a.u.x;
    a.constant -= u.y * a.u.y;
    a.v -= u.x * a.u.y;
    a.light_v -= u.x * a.light_u;
    a.light -= u.y * a.light_u;
    explained += explained_by(a.light_u, inverse);
    inverse = 1.0 / max(a.slopes.w, LEAST_PIVOT);
    float v = a.v * inverse;
    a.constant -= v * a.v;
    a.light -= v * a.light_v;
    explained += explained_by(a.light_v, inverse);
    inverse = 1.0 / max(a.constant, LEAST_PIVOT);
    explained += explained_by(a.light, inverse);
    return a.light * inverse;
}

// The light at the surface by the regression, blended in as far as what the regression misses is noise.
vec3 regressed(uvec2 pixel, uint at, vec3 own) {
    float level = max(luminance(own), LEAST_LEVEL);
    Equations a;
    Sums s = gather(pixel, at, own, TOLERANCE * TOLERANCE * level * level, a);
    if (s.used < 4.0) return own;
    a.slopes += vec4(vec2(1.0 / (RASTER_SLOPES * level * level)), vec2(1.0 / (NORMAL_SLOPES * level * level)));
    float explained, total = a.constant;
    vec3 step_ = solve(a, explained);
    // The structure that the fit misses, around or at this very pixel, against the noise that the eye's mean leaves [Lee80].
    float structure = max(max(s.power - explained, 0.0) / total * s.used / max(s.used - 4.0, 1.0) - s.expected / total, 0.0);
    // A single pixel hardly knows the variance of its samples, so that of the neighbourhood is taken. It does know their number.
    // Beside a highlight it is larger relative to the light than on it, and on a highlight larger as it is: the smaller counts.
    vec2 held_and_divisor = unpackHalf2x16(filtered_at(at).weight_and_albedo);
    // A pixel without a sample takes all of its neighbours' light.
    float held = max(held_and_divisor.x, LEAST_HELD);
    float noise = min(s.single, s.plain / (held_and_divisor.y * held_and_divisor.y)) / s.used / held;
    float apart = luminance(step_);
    // In the periphery the eye sees flicker better than blur.
    float beyond = periphery(angle_of(tint_at(at)));
    // Where a pixel waits for its samples, its few ones do not show that it differs from its neighbours.
    float sure = held / (held + DOUBTED_SAMPLES * max(1.0 - frame.budget_spp, 0.0));
    structure = max(structure, sure * apart * apart - mix(3.0, 16.0, beyond) * noise);
    // What histories are divided by errs the more the steeper it is.
    structure = max(structure, STEEP * max(s.divisor.y * s.used / (s.divisor.x * s.divisor.x) - 1.0, 0.0));
    // The eye's mean removes what changes from frame to frame. Of a young point that is little, because all its frames share the same samples.
    float changing = min(SEEN_FRAMES * samples_a_frame(), OWN_CHANGING * float(history_noise_at(at).body_and_used & HISTORY_USED));
    noise *= mix(1.0, 5.0, beyond) * held / (held + changing);
    vec3 result = own + step_ * (noise / max(structure + noise, 1e-12));
    return finite3(result) ? max(result, vec3(0.0)) : own;
}

// The light of the pixel toward the eye.
vec3 light_of(uvec2 pixel, uint at) {
    if (!is_lit(surface_at(at))) return vec3(0.0);
    vec3 light = filtered_at(at).light;
    if (HAS_FILTER && (history_noise_at(at).body_and_used & HISTORY_EXACT) == 0u) {
        light = regressed(pixel, at, light);
        float level = luminance(light);
        light *= clamp((level + lag_of(pixel, at)) / max(level, 1e-6), LEAST_CORRECTION, MOST_CORRECTION);
    }
    return light * albedo_of(tint_at(at));
}

// It is computed before all else, so that what compensation needs does not take registers meanwhile.
vec3 own_light;
vec3 light_at(uvec2 pixel, uint at) { return own_light; }

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    own_light = light_of(pixel, at);
    if ((frame.flags & FRAME_SHOWS_ALL) != 0u) shown[at] = vec4(own_light, is_lit(surface_at(at)) ? 1.0 : 0.0);
    compensate(pixel, at);
}
