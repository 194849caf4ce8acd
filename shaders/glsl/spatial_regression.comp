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
// Unknowns of the regression: constant, x, y, and two components of the normal.
const int N = 5;
// Expected squares of the slopes relative to the light: 2 % a pixel over the raster, and a third over the normal's whole range.
const float RASTER_SLOPES = 4e-4, NORMAL_SLOPES = 0.1;

// The regression's weighted sums over the neighbours.
struct Sums {
    float used;     // Number of neighbours.
    float total;    // Their weights.
    float power;    // Weighted squares of their luminance, relative to the pixel's own.
    float expected; // Weighted variances that chance explains.
    float single;   // Sum of the variances of one sample.
};

float sequence_variance(float held) {
    return mix(SEQUENCE_VARIANCE_FEW, SEQUENCE_VARIANCE_MANY, clamp(held / (MANY_FRAMES * samples_a_frame()), 0.0, 1.0));
}

float weight_of(Filtered f) { return unpackHalf2x16(f.weight_and_albedo).x; }

// Whether something is known of the light at raster position `q`, on the body `instance`. The surface itself need not be read.
bool known_beside(ivec2 q, uint instance, out uint tap) {
    tap = 0u;
    if (!on_raster(q)) return false;
    tap = uint(q.y) * frame.width + uint(q.x);
    return weight_of(filtered_at(tap)) > 0.0 && ((history_noise_at(tap).body_and_used / (HISTORY_USED + 1u)) & 255u) == instance;
}

// How far the history lags: a slope of the light over the histories' age is fitted to the drifts around, as far as chance does not explain it.
float lag_of(uvec2 pixel, uint at) {
    uint instance = surface_at(at).id >> 24u;
    vec3 normal = decode_normal(history_place_at(at).normal);
    mat2 rotation = turn_of(pixel, 0u);
    float per_frame = samples_a_frame();
    float age = weight_of(filtered_at(at)) / per_frame, drift = history_noise_at(at).drift;
    float xx = age * age, xy = age * drift, yy = drift * drift, used = 1.0;
    for (int i = 0; i < 12; i++) {
        ivec2 q = ivec2(pixel) + ivec2(round(rotation * DISK[i] * LAG_RADIUS_PX));
        uint tap;
        if (q == ivec2(pixel) || !known_beside(q, instance, tap)) continue;
        float w = pow(max(dot(decode_normal(history_place_at(tap).normal), normal), 0.0), 8.0);
        float x = weight_of(filtered_at(tap)) / per_frame, y = history_noise_at(tap).drift;
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

// Fills the normal equations `a` (lower triangle by rows) and `b` from the 5 x 5 pixels around.
Sums gather(uvec2 pixel, uint at, vec3 own, float tolerated, out float a[15], out vec3 b[N]) {
    uint instance = surface_at(at).id >> 24u;
    vec3 position = history_place_at(at).position;
    vec3 normal = decode_normal(history_place_at(at).normal);
    vec3 across = normalize(abs(normal.x) < 0.7 ? cross(normal, vec3(1.0, 0.0, 0.0)) : cross(normal, vec3(0.0, 1.0, 0.0)));
    vec3 along = cross(normal, across);
    float footprint = abs(surface_at(at).distance) * frame.pixel_size;
    for (int i = 0; i < 15; i++) a[i] = 0.0;
    for (int i = 0; i < N; i++) b[i] = vec3(0.0);
    Sums s = Sums(0.0, 0.0, 0.0, 0.0, 0.0);
    for (int i = 0; i < 25; i++) {
        ivec2 d = ivec2(i % 5, i / 5) - 2;
        uint tap;
        if (!known_beside(ivec2(pixel) + d, instance, tap)) continue;
        vec3 n = decode_normal(history_place_at(tap).normal);
        if (dot(n, normal) < LIKE_NORMAL || abs(dot(history_place_at(tap).position - position, normal)) > DEPTH * footprint) continue;
        vec2 weight_and_albedo = unpackHalf2x16(filtered_at(tap).weight_and_albedo);
        float weight = weight_and_albedo.x, light = weight_and_albedo.y;
        float noise = history_noise_at(tap).variance * sequence_variance(weight) / (weight * light * light);
        float w = 1.0 / (noise + tolerated);
        vec3 m = filtered_at(tap).light - own;
        // Without loops, of which software Vulkan would keep the arrays in memory.
        vec2 e = vec2(d);
        vec2 f = vec2(dot(n, across), dot(n, along));
        vec2 we = w * e, wf = w * f;
        a[0] += w;
        a[1] += we.x;
        a[2] += we.x * e.x;
        a[3] += we.y;
        a[4] += we.y * e.x;
        a[5] += we.y * e.y;
        a[6] += wf.x;
        a[7] += wf.x * e.x;
        a[8] += wf.x * e.y;
        a[9] += wf.x * f.x;
        a[10] += wf.y;
        a[11] += wf.y * e.x;
        a[12] += wf.y * e.y;
        a[13] += wf.y * f.x;
        a[14] += wf.y * f.y;
        b[0] += w * m;
        b[1] += we.x * m;
        b[2] += we.y * m;
        b[3] += wf.x * m;
        b[4] += wf.y * m;
        float y = luminance(m);
        s.power += w * y * y;
        s.total += w;
        s.used += 1.0;
        s.expected += w * noise;
        s.single += noise * weight;
    }
    return s;
}

// Solves the normal equations by Cholesky's decomposition, with the solution in `b`. Returns the power that the fit explains, which is that of the
// solution of the first triangle.
float solve(inout float a[15], inout vec3 b[N]) {
    float explained = 0.0;
    for (int r = 0; r < N; r++) {
        for (int c = 0; c <= r; c++) {
            float sum = a[r * (r + 1) / 2 + c];
            for (int k = 0; k < c; k++) sum -= a[r * (r + 1) / 2 + k] * a[c * (c + 1) / 2 + k];
            a[r * (r + 1) / 2 + c] = r == c ? sqrt(max(sum, 1e-12)) : sum / a[c * (c + 3) / 2];
        }
        for (int k = 0; k < r; k++) b[r] -= a[r * (r + 1) / 2 + k] * b[k];
        b[r] /= a[r * (r + 3) / 2];
        float e = luminance(b[r]);
        explained += e * e;
    }
    for (int r = N - 1; r >= 0; r--) {
        for (int k = r + 1; k < N; k++) b[r] -= a[k * (k + 1) / 2 + r] * b[k];
        b[r] /= a[r * (r + 3) / 2];
    }
    return explained;
}

// The light at the surface by the regression, blended in as far as what the regression misses is noise.
vec3 regressed(uvec2 pixel, uint at, vec3 own) {
    float level = max(luminance(own), LEAST_LEVEL);
    float a[15];
    vec3 b[N];
    Sums s = gather(pixel, at, own, TOLERANCE * TOLERANCE * level * level, a, b);
    if (s.used < 4.0) return own;
    for (int r = 1; r < N; r++) a[r * (r + 3) / 2] += 1.0 / ((r < 3 ? RASTER_SLOPES : NORMAL_SLOPES) * level * level);
    float explained = solve(a, b);
    // The structure that the fit misses, around or at this very pixel, against the noise that the eye's mean leaves [Lee80].
    float structure = max(max(s.power - explained, 0.0) / s.total * s.used / max(s.used - 4.0, 1.0) - s.expected / s.total, 0.0);
    // A single pixel hardly knows the variance of its samples, so that of the neighbourhood is taken. It does know their number.
    float held = weight_of(filtered_at(at));
    float noise = s.single / s.used / max(held, 1e-6);
    float apart = luminance(b[0]);
    // In the periphery the eye sees flicker better than blur.
    float beyond = periphery(angle_of(tint_at(at)));
    structure = max(structure, apart * apart - mix(3.0, 16.0, beyond) * noise);
    // The eye's mean removes what changes from frame to frame. Of a young point that is little, because all its frames share the same samples.
    float changing = min(SEEN_FRAMES * samples_a_frame(), OWN_CHANGING * float(history_noise_at(at).body_and_used & HISTORY_USED));
    noise *= mix(1.0, 5.0, beyond) * held / (held + changing);
    vec3 result = own + b[0] * (noise / max(structure + noise, 1e-12));
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
