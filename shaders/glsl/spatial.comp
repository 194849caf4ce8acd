// Spatial filter of the picture, never of the history.
//
// [paper]: Poisson-disk taps, only in the periphery, blended in between two angles. Method dpm: a plane through the neighbours, blended in where
// what it misses is noise, and what the histories around lag behind; all without albedo, which is multiplied on afterwards.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"
#include "noise.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_SHOWN, scalar) writeonly buffer Shown { vec4 shown[]; };

// Twelve points of a Poisson disk of radius 1 (dart throwing with distance 0.45, seed 7).
const vec2 DISK[12] = vec2[](vec2(0.03, -0.09), vec2(-0.51, 0.13), vec2(0.47, 0.22), vec2(-0.08, 0.53), vec2(0.12, -0.62), vec2(-0.46, -0.41),
                             vec2(0.62, -0.31), vec2(-0.94, -0.18), vec2(-0.58, 0.72), vec2(0.43, 0.83), vec2(0.96, 0.12), vec2(-0.31, -0.92));

// Share of independent samples' variance that the sequence leaves, of a few frames and of many: the more there are, the more even their spread.
const float SEQUENCE_VARIANCE_FEW = 0.5, SEQUENCE_VARIANCE_MANY = 0.27, MANY_FRAMES = 60.0;
// Frames that the picture's own noise is taken to be seen over: what a filter gets wrong stays, noise goes.
const float SEEN_FRAMES = 20.0;
// Of a young point's samples, the share that the eye has not seen in all of its frames.
const float OWN_CHANGING = 0.3;
// Neighbours may differ by this share of their light beyond what the plane tells.
const float TOLERANCE = 0.025;

float sequence_variance(float held) {
    return mix(SEQUENCE_VARIANCE_FEW, SEQUENCE_VARIANCE_MANY, clamp(held / (MANY_FRAMES * samples_a_frame()), 0.0, 1.0));
}

// The neighbour at raster position `q`, if it is lit and of the body `instance`.
bool neighbour(ivec2 q, uint instance, out uint tap) {
    tap = 0u;
    if (any(lessThan(q, ivec2(0))) || any(greaterThanEqual(q, ivec2(frame.width, frame.height)))) return false;
    tap = uint(q.y) * frame.width + uint(q.x);
    return is_lit(surface_at(tap)) && surface_at(tap).id >> 24u == instance;
}

// The disk is turned anew in every pixel and frame.
mat2 turn_of(uvec2 pixel, uint dimension) {
    float turn = blue_noise(pixel, frame.drawn, dimension) * 2.0 * PI;
    return mat2(cos(turn), sin(turn), -sin(turn), cos(turn));
}

// Slope of the light at the surface over time, from how far the histories around lag behind, by their age; nothing where chance explains it.
float lag_of(uvec2 pixel, uint at) {
    uint instance = surface_at(at).id >> 24u;
    vec3 normal = decode_normal(history_at(at).normal);
    mat2 rotation = turn_of(pixel, 0u);
    float per_frame = samples_a_frame();
    float age = history_at(at).weight / per_frame, drift = history_at(at).drift;
    float xx = age * age, xy = age * drift, yy = drift * drift, used = 1.0;
    for (int i = 0; i < 12; i++) {
        ivec2 q = ivec2(pixel) + ivec2(round(rotation * DISK[i] * 6.0));
        uint tap;
        if (q == ivec2(pixel) || !neighbour(q, instance, tap)) continue;
        float w = pow(max(dot(decode_normal(history_at(tap).normal), normal), 0.0), 8.0);
        float x = history_at(tap).weight / per_frame, y = history_at(tap).drift;
        xx += w * x * x;
        xy += w * x * y;
        yy += w * y * y;
        used += w;
    }
    float fit = xy * xy / max(xx, 1e-12);
    float chance = max(yy - fit, 0.0) / max(used - 1.0, 1.0);
    // What the correction gets wrong changes from frame to frame: where the eye sees flicker best, only what is beyond doubt is corrected.
    float doubt = mix(0.5, 8.0, periphery(guide_at(at).angle));
    float trust = fit > 0.0 ? max(1.0 - doubt * chance / fit, 0.0) : 0.0;
    return trust * xy / max(xx, 1e-12) * age;
}

// Local linear regression of the light at the surface on raster position and normal, blended in as far as what is left over is noise.
vec3 regressed(uvec2 pixel, uint at, vec3 own) {
    uint instance = surface_at(at).id >> 24u;
    vec3 position = history_at(at).position;
    vec3 normal = decode_normal(history_at(at).normal);
    vec3 across = normalize(abs(normal.x) < 0.7 ? cross(normal, vec3(1.0, 0.0, 0.0)) : cross(normal, vec3(0.0, 1.0, 0.0)));
    vec3 along = cross(normal, across);
    float footprint = abs(surface_at(at).distance) * frame.pixel_size;
    float level = max(luminance(own), 0.02);
    float tolerated = TOLERANCE * TOLERANCE * level * level;
    // Normal equations, lower triangle by rows: constant, x, y, two components of the normal.
    float a[15];
    vec3 b[5];
    for (int i = 0; i < 15; i++) a[i] = 0.0;
    for (int i = 0; i < 5; i++) b[i] = vec3(0.0);
    float used = 0.0, expected = 0.0, single = 0.0, total = 0.0, power = 0.0;
    for (int i = 0; i < 25; i++) {
        ivec2 d = ivec2(i % 5, i / 5) - 2;
        uint tap;
        if (!neighbour(ivec2(pixel) + d, instance, tap)) continue;
        vec3 n = decode_normal(history_at(tap).normal);
        if (dot(n, normal) < 0.6 || abs(dot(history_at(tap).position - position, normal)) > 3.0 * footprint) continue;
        float light = luminance(albedo_of(guide_at(tap)));
        float noise = filtered_at(tap).variance * sequence_variance(history_at(tap).weight) / (light * light);
        float w = 1.0 / (noise + tolerated);
        vec3 m = filtered_at(tap).light - own;
        float v[5] = float[](1.0, float(d.x), float(d.y), dot(n, across), dot(n, along));
        int k = 0;
        for (int r = 0; r < 5; r++) {
            for (int c = 0; c <= r; c++) a[k++] += w * v[r] * v[c];
            b[r] += w * v[r] * m;
        }
        float y = luminance(m);
        power += w * y * y;
        total += w;
        used += 1.0;
        expected += w * noise;
        single += noise * history_at(tap).weight;
    }
    if (used < 4.0) return own;
    // Slopes are not expected beyond 2 % a pixel and a third over the normal's whole range.
    for (int r = 1; r < 5; r++) a[r * (r + 3) / 2] += 1.0 / ((r < 3 ? 4e-4 : 0.1) * level * level);
    // Cholesky; the power of the half solution is what the fit explains.
    float explained = 0.0;
    for (int r = 0; r < 5; r++) {
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
    for (int r = 4; r >= 0; r--) {
        for (int k = r + 1; k < 5; k++) b[r] -= a[k * (k + 1) / 2 + r] * b[k];
        b[r] /= a[r * (r + 3) / 2];
    }
    // Structure that the fit misses, around or at this very pixel, against the noise that the eye's mean leaves [Lee80].
    float structure = max(max(power - explained, 0.0) / total * used / max(used - 4.0, 1.0) - expected / total, 0.0);
    // Single pixels hardly know what a sample of theirs varies: it is that of all around. How many samples they stand on they know.
    float held = history_at(at).weight;
    float noise = single / used / max(held, 1e-6);
    float apart = luminance(b[0]);
    // In the periphery blur is the lesser evil beside flicker.
    float beyond = periphery(guide_at(at).angle);
    structure = max(structure, apart * apart - mix(3.0, 16.0, beyond) * noise);
    // The eye's mean takes out what changes from frame to frame. Of a young point that is little: all its frames stand on the same samples.
    float changing = min(SEEN_FRAMES * samples_a_frame(), OWN_CHANGING * float(history_at(at).index));
    noise *= mix(1.0, 5.0, beyond) * held / (held + changing);
    vec3 result = own + b[0] * (noise / max(structure + noise, 1e-12));
    return finite3(result) ? max(result, vec3(0.0)) : own;
}

// [paper]: mean over a Poisson disk, blended in between two angles.
vec3 disk_mean(uvec2 pixel, uint at, vec3 own) {
    float blend = periphery(guide_at(at).angle);
    if (!(blend > 0.0)) return own;
    uint instance = surface_at(at).id >> 24u;
    vec3 position = history_at(at).position;
    vec3 normal = decode_normal(history_at(at).normal);
    float footprint = abs(surface_at(at).distance) * frame.pixel_size;
    mat2 rotation = turn_of(pixel, 1u);
    vec3 sum = own;
    float total = 1.0;
    for (int i = 0; i < 12; i++) {
        ivec2 q = ivec2(pixel) + ivec2(round(rotation * DISK[i] * 4.0));
        uint tap;
        if (q == ivec2(pixel) || !neighbour(q, instance, tap)) continue;
        vec3 apart = history_at(tap).position - position;
        float w = max(dot(decode_normal(history_at(tap).normal), normal), 0.0);
        w = pow(w, 32.0) * exp(-abs(dot(apart, normal)) / max(footprint, 1e-12));
        sum += w * filtered_at(tap).light;
        total += w;
    }
    return mix(own, sum / total, blend);
}

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    if (!is_lit(surface_at(at))) {
        shown[at] = vec4(0.0);
        return;
    }
    vec3 own = filtered_at(at).light;
    if ((frame.flags & FRAME_DPM) != 0u) {
        vec3 light = own;
        if (HAS_FILTER && (history_at(at).flags & HISTORY_EXACT) == 0u) {
            light = regressed(pixel, at, own);
            float level = luminance(light);
            light *= clamp((level + lag_of(pixel, at)) / max(level, 1e-6), 0.5, 2.0);
        }
        shown[at] = vec4(light * albedo_of(guide_at(at)), 1.0);
        return;
    }
    shown[at] = vec4(HAS_FILTER ? disk_mean(pixel, at, own) : own, 1.0);
}
