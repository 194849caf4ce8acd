// History of the last frame, carried to where each surface point is now. Writes the prior of every lit pixel.
//
// Validity: same body, the tap's own surface point close to ours and its normal alike, both in body space. Methods paper and miyamoto fetch
// bilinearly, which blurs by up to 1/4 px^2 a frame. Method dpm resamples nothing: a history stays with one surface point.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"
#include "importance.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer Histories { History histories[]; };
layout(set = 0, binding = B_SCHEDULE, scalar) buffer ScheduleBlock { Schedule schedule; };
// Method dpm: what leads from the history's surface point to the pixel's, added to its mean.
layout(set = 0, binding = B_SHOWN, scalar) writeonly buffer Shown { vec4 shown[]; };

// Frames' worth of samples that a new point takes over from those around, where the eye looks and in the periphery: what it takes is a guess
// that stays as bias, and without it there is noise, which flickers.
const float TAKEN_OVER = 6.0, TAKEN_OVER_PERIPHERY = 24.0;

// A history's lag is told from chance by so many times the power that chance gives it, and by this share of the light.
const float LAG_BEYOND_CHANCE = 2.0, LEAST_LAG = 0.007;
// Power of noise counts so much beside that of lag: what the spatial filter takes out, against what noise costs in flicker.
const float NOISE_COUNTS = 1.2;

struct Carried {
    vec3 mean;
    float weight, drift, variance, surprise;
    float total;
};

bool tap_valid(uint index, uint instance, vec3 position, vec3 normal, float footprint, float depth) {
    if (former_at(index).frame != frame.history_frame || former_at(index).instance != instance || !(former_at(index).weight > 0.0)) return false;
    vec3 apart = former_at(index).position - position;
    vec3 tap_normal = decode_normal(former_at(index).normal);
    return dot(tap_normal, normal) > 0.9 && abs(dot(apart, normal)) < depth * footprint && dot(apart, apart) < 16.0 * footprint * footprint;
}

void add_tap(inout Carried c, uint index, float w) {
    c.mean += w * former_at(index).mean;
    c.weight += w * former_at(index).weight;
    c.drift += w * former_at(index).drift;
    c.variance += w * former_at(index).variance;
    c.surprise += w * former_at(index).surprise;
    c.total += w;
}

// Nothing is known of the point; its sequence begins.
void forget(inout History h, uint at) {
    h.mean = vec3(0.0);
    h.weight = 0.0;
    h.drift = 0.0;
    h.variance = 0.0;
    h.surprise = 0.0;
    h.seed = hash_u32(at + hash_u32(frame.frame + hash_u32(frame.seed)));
    h.index = 0u;
    h.flags = 0u;
}

// Methods paper and miyamoto: what the four histories around say, weighted bilinearly. `h` stays as it is where none is valid.
void carry_bilinear(inout History h, vec3 normal, float footprint, vec2 before) {
    if (!all(greaterThan(before, vec2(0.0))) || !all(lessThan(before, vec2(frame.width, frame.height)))) return;
    vec2 base = floor(before - 0.5);
    vec2 f = before - 0.5 - base;
    // What stands still is fetched exactly.
    if (abs(f.x - round(f.x)) < 2e-3 && abs(f.y - round(f.y)) < 2e-3) {
        base += round(f);
        f = vec2(0.0);
    }
    ivec2 corner = ivec2(base);
    ivec2 limit = ivec2(frame.width, frame.height) - 1;
    Carried c = Carried(vec3(0.0), 0.0, 0.0, 0.0, 0.0, 0.0);
    uint nearest = 0u;
    float best = 0.0;
    for (int i = 0; i < 4; i++) {
        ivec2 o = ivec2(i & 1, i >> 1);
        ivec2 q = corner + o;
        float w = (o.x == 1 ? f.x : 1.0 - f.x) * (o.y == 1 ? f.y : 1.0 - f.y);
        if (w <= 0.0 || any(lessThan(q, ivec2(0))) || any(greaterThan(q, limit))) continue;
        uint tap = uint(q.y) * frame.width + uint(q.x);
        if (!tap_valid(tap, h.instance, h.position, normal, footprint, 2.0)) continue;
        add_tap(c, tap, w);
        if (w > best) {
            best = w;
            nearest = tap;
        }
    }
    if (!(c.total > 1e-3) || !finite3(c.mean) || !finite(c.weight)) return;
    float s = 1.0 / c.total;
    h.mean = c.mean * s;
    h.weight = c.weight * s;
    h.drift = c.drift * s;
    h.variance = c.variance * s;
    h.surprise = c.surprise * s;
    // The sequence goes on where the nearest point left it.
    h.seed = former_at(nearest).seed;
    h.index = former_at(nearest).index;
}

// Frames' worth of samples that serve best where light changes: a history of n frames lags by n times the light's slope over time, and its noise in
// what the eye sees is that of n + EYE_FRAMES frames. The sum of both powers is least where n (n + EYE_FRAMES)^2 is half the ratio of noise
// to slope; the root is taken as the geometric mean of two estimates, exact where n is far below or far beyond the eye's frames. `frames` frames
// lag by `lag_power`. All powers are of luminance without albedo.
float useful_frames(float lag_power, float frame_noise, float light_power, float frames) {
    float by_chance = frame_noise * (LAG_WEIGHT / (2.0 - LAG_WEIGHT));
    float beyond = lag_power - LAG_BEYOND_CHANCE * (by_chance + LEAST_LAG * LEAST_LAG * light_power);
    if (!(beyond > 0.0)) return INFINITY;
    float q = 0.5 * NOISE_COUNTS * frame_noise * frames * frames / beyond;
    float n = min(pow(q, 1.0 / 3.0), q / (EYE_FRAMES * EYE_FRAMES));
    return max(sqrt(n * q / (EYE_FRAMES * EYE_FRAMES + 2.0 * EYE_FRAMES * n + n * n)), 2.0);
}

// The same where light differs from point to point by more than a plane tells: a history is the mean over all places in its pixel that were
// sampled, which blurs, and where that is more than a frame's noise the frames themselves serve better. While a body moves by a twentieth of a pixel
// its points are sampled in one place: what stands is not concerned.
float crisp_frames(float structure, float frame_noise, vec2 motion) {
    if (!(structure > 0.0)) return INFINITY;
    return max(max(frame_noise / structure, 0.3), 0.05 / max(length(motion), 1e-6));
}

// From a history's point to the pixel's, by the plane through the histories around: never beyond what these say, and never by more than half of the
// most they say. A point's mean is what its pixel shows less this, so a step as large as the light itself would feed itself where histories are short.
vec3 bounded_shift(vec3 mean, vec3 shift, vec3 lower, vec3 upper) {
    vec3 most = 0.5 * max(abs(lower), abs(upper));
    return clamp(clamp(mean + shift, lower, upper) - mean, -most, most);
}

// Method dpm: every history belongs to one surface point for as long as it is seen. It goes to the pixel that the point is in now, so nothing is
// ever resampled; the pixel's own point, at most half a pixel away, is reached by the gradient of the histories around.
void carry_point(inout History h, vec3 normal, float footprint, uvec2 pixel, vec2 before) {
    vec2 centre = vec2(pixel) + 0.5;
    uint at = pixel.y * frame.width + pixel.x;
    ivec2 corner = ivec2(floor(clamp(before, vec2(-4.0), vec2(frame.width, frame.height) + 4.0)));
    vec3 sum = vec3(0.0), sum_x = vec3(0.0), sum_y = vec3(0.0), lower = vec3(INFINITY), upper = vec3(-INFINITY);
    float squares = 0.0, total = 0.0, x = 0.0, y = 0.0, xx = 0.0, xy = 0.0, yy = 0.0, nearest = 1.5;
    uint owner = NO_HIT, taps = 0u;
    vec2 apart = vec2(0.0);
    float lag_power = 0.0, noise_power = 0.0, variance = 0.0;
    for (int i = 0; i < 9; i++) {
        ivec2 q = corner + ivec2(i % 3, i / 3) - 1;
        if (any(lessThan(q, ivec2(0))) || any(greaterThanEqual(q, ivec2(frame.width, frame.height)))) continue;
        uint tap = uint(q.y) * frame.width + uint(q.x);
        if (!tap_valid(tap, h.instance, h.position, normal, footprint, 0.5)) continue;
        vec2 e = project(transform_point(instance_at(h.instance).world_from_object, former_at(tap).position)) - centre;
        vec3 m = former_at(tap).mean;
        float w = former_at(tap).weight;
        // A broken history is as good as none.
        bool sound = finite(former_at(tap).drift) && finite(former_at(tap).variance) && finite(former_at(tap).surprise);
        if (!sound || !finite3(m) || !finite(w) || !finite(e.x + e.y)) continue;
        total += w;
        taps++;
        x += w * e.x;
        y += w * e.y;
        xx += w * e.x * e.x;
        xy += w * e.x * e.y;
        yy += w * e.y * e.y;
        sum += w * m;
        squares += w * luminance(m) * luminance(m);
        sum_x += w * e.x * m;
        sum_y += w * e.y * m;
        lag_power += former_at(tap).drift * former_at(tap).drift;
        noise_power += former_at(tap).surprise;
        variance += former_at(tap).variance;
        lower = min(lower, m);
        upper = max(upper, m);
        float far = max(abs(e.x), abs(e.y));
        if (far < nearest) {
            nearest = far;
            owner = tap;
            apart = e;
        }
    }
    vec3 shift = vec3(0.0), g_x = vec3(0.0), g_y = vec3(0.0);
    if (owner != NO_HIT) {
        History known = former_at(owner);
        float s = 1.0 / total;
        x *= s;
        y *= s;
        xx = xx * s - x * x + 1e-3;
        xy = xy * s - x * y;
        yy = yy * s - y * y + 1e-3;
        sum *= s;
        sum_x = sum_x * s - x * sum;
        sum_y = sum_y * s - y * sum;
        float determinant = xx * yy - xy * xy;
        if (determinant > 1e-3) {
            g_x = (yy * sum_x - xy * sum_y) / determinant;
            g_y = (xx * sum_y - xy * sum_x) / determinant;
            shift = -(g_x * apart.x + g_y * apart.y);
            shift = bounded_shift(known.mean, shift, lower, upper);
        }
        known.frame = h.frame;
        float light = luminance(albedo_of(guide_at(at))), per_frame = samples_a_frame();
        // All powers without albedo.
        float level = luminance(sum), frames = max(total / float(taps) / per_frame, 1.0);
        float to_power = 1.0 / (float(taps) * light * light), of_frame = variance * to_power / per_frame;
        float useful = useful_frames(lag_power / float(taps), noise_power * to_power, level * level, frames);
        float fit = luminance(g_x) * luminance(sum_x) + luminance(g_y) * luminance(sum_y);
        float scatter = max(squares * s - level * level - fit, 0.0);
        if (taps > 1u) useful = min(useful, crisp_frames(1.5 * max(scatter - of_frame / frames, 0.0), of_frame, centre - before));
        known.weight = min(known.weight, useful * per_frame);
        if (nearest <= 0.6) {
            h = known;
        } else {
            // No history's point is in this pixel. A new one begins a whole number of pixels beside the nearest, so that the points stay a lattice.
            vec2 e = apart - round(apart);
            vec3 n = transform_vector(instance_at(h.instance).world_from_object, normal);
            vec3 own = transform_point(instance_at(h.instance).world_from_object, h.position);
            vec3 direction = projector_direction(centre + e);
            float along = dot(n, direction);
            if (abs(along) > 0.1) h.position = transform_point(instance_at(h.instance).object_from_world, direction * (dot(n, own) / along));
            else e = vec2(0.0);
            vec3 there = -(g_x * (apart.x - e.x) + g_y * (apart.y - e.y));
            known.mean = clamp(known.mean + there, lower, upper);
            shift = -(g_x * e.x + g_y * e.y);
            shift = bounded_shift(known.mean, shift, lower, upper);
            known.position = h.position;
            known.normal = h.normal;
            known.seed = h.seed;
            known.index = 0u;
            known.flags = (known.flags & ~HISTORY_BORDER) | (taps < 8u ? HISTORY_BORDER : 0u);
            // Known as well as the histories around it agree: their scatter about the plane, or about each other where they lie on one side.
            float noise = max(known.surprise, 1e-8);
            float expected = noise * per_frame / known.weight, rest;
            if (taps < 8u) {
                float range = luminance(upper - lower) * light;
                rest = 0.5 * max(range * range - 4.0 * expected, 0.0);
            } else {
                rest = 2.0 * max(scatter * light * light - expected, 0.0);
            }
            known.weight = 1.0 / (1.0 / known.weight + rest / (noise * per_frame));
            known.weight = min(known.weight, mix(TAKEN_OVER, TAKEN_OVER_PERIPHERY, periphery(guide_at(at).angle)) * per_frame);
            h = known;
        }
    }
    shown[at] = vec4(shift, 0.0);
}

// A pixel beside a body's edge keeps the history of a point that is in it although its own ray misses: the next frame may bring it back.
void keep_hidden(uvec2 pixel) {
    vec2 centre = vec2(pixel) + 0.5;
    ivec2 size = ivec2(frame.width, frame.height);
    uint instance = NO_HIT;
    vec2 before = centre;
    for (int i = 0; i < 8; i++) {
        const ivec2 beside[8] = ivec2[](ivec2(-1, 0), ivec2(1, 0), ivec2(0, -1), ivec2(0, 1), ivec2(-1, -1), ivec2(1, -1), ivec2(-1, 1), ivec2(1, 1));
        ivec2 q = ivec2(pixel) + beside[i];
        if (any(lessThan(q, ivec2(0))) || any(greaterThanEqual(q, size))) continue;
        uint other = uint(q.y) * frame.width + uint(q.x);
        if (!is_lit(surface_at(other))) continue;
        instance = surface_at(other).id >> 24u;
        before = centre - guide_at(other).motion;
        break;
    }
    if (instance == NO_HIT) return;
    ivec2 corner = ivec2(floor(clamp(before, vec2(-4.0), vec2(size) + 4.0)));
    float nearest = 0.5;
    uint owner = NO_HIT;
    for (int i = 0; i < 9; i++) {
        ivec2 q = corner + ivec2(i % 3, i / 3) - 1;
        if (any(lessThan(q, ivec2(0))) || any(greaterThanEqual(q, size))) continue;
        uint tap = uint(q.y) * frame.width + uint(q.x);
        if (former_at(tap).frame != frame.history_frame || former_at(tap).instance != instance || !(former_at(tap).weight > 0.0)) continue;
        vec3 p = transform_point(instance_at(instance).world_from_object, former_at(tap).position);
        vec2 e = project(p) - centre;
        float far = max(abs(e.x), abs(e.y));
        if (far < nearest && dot(transform_vector(instance_at(instance).world_from_object, decode_normal(former_at(tap).normal)), p) < 0.0) {
            nearest = far;
            owner = tap;
        }
    }
    if (owner == NO_HIT) return;
    History h = former_at(owner);
    h.frame = frame.frame;
    h.flags |= HISTORY_HIDDEN;
    histories[pixel.y * frame.width + pixel.x] = h;
}

void main() {
    uvec2 pixel;
    uint tile = tiles[gl_WorkGroupID.x >> 2u];
    if (!tile_pixel(tile, pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    Surface surface = surface_at(at);
    uint importance = 0u, lit = 0u;
    if (is_lit(surface)) {
        lit = 1u;
        uint instance = surface.id >> 24u;
        uint triangle = surface.id & 0xffffffu;
        TriangleRef ref = triangle_ref_at(instance_at(instance).triangle_offset + triangle);
        vec2 b = surface.barycentric;
        History h;
        h.instance = instance;
        h.frame = frame.frame;
        // Only rotations and translations lie between the spaces, so lengths are the same in both.
        vec3 world = projector_direction(vec2(pixel) + 0.5) * surface.distance;
        h.position = transform_point(instance_at(instance).object_from_world, world);
        vec3 normal = normalize(vertex_at(ref.vertices.x).normal * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).normal * b.x + vertex_at(ref.vertices.z).normal * b.y);
        h.normal = encode_normal(normal);
        float cosine = abs(dot(transform_vector(instance_at(instance).world_from_object, normal), normalize(world)));
        float footprint = surface.distance * frame.pixel_size / max(cosine, 0.2);
        vec2 before = vec2(pixel) + 0.5 - guide_at(at).motion;
        forget(h, at);
        if ((frame.flags & FRAME_DPM) != 0u) carry_point(h, normal, footprint, pixel, before);
        else carry_bilinear(h, normal, footprint, before);
        h.flags &= ~HISTORY_HIDDEN;
        histories[at] = h;
        importance = importance_of(h);
    } else {
        histories[at].weight = 0.0;
        histories[at].frame = frame.frame - 1u;
        if ((frame.flags & FRAME_DPM) != 0u) keep_hidden(pixel);
    }
    uint total = subgroupAdd(importance);
    uint lit_total = subgroupAdd(lit);
    if (subgroupElect() && lit_total > 0u) {
        atomicAdd(schedule.importance, total);
        atomicAdd(schedule.lit, lit_total);
    }
}
