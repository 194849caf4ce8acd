// History of the last frame, carried to where each surface point is now. Writes the prior of every lit pixel.
//
// Validity: same body, the tap's own surface point close to ours and its normal alike, both in body space. Carried with a kernel that
// reproduces quadratics (Catmull-Rom) where all taps are valid in method dpm: repeated bilinear fetches would blur by 1/6 px^2 a frame.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_SURFACES, scalar) readonly buffer Surfaces { Surface surfaces[]; };
layout(set = 0, binding = B_GUIDES, scalar) readonly buffer Guides { Guide guides[]; };
layout(set = 0, binding = B_HISTORY, scalar) buffer Histories { History histories[]; };
layout(set = 0, binding = B_TILE_STATES, scalar) buffer TileStates { TileState tile_states[]; };
layout(set = 0, binding = B_SCHEDULE, scalar) buffer ScheduleBlock { Schedule schedule; };
layout(set = 0, binding = B_TRIANGLE_REFS, scalar) readonly buffer TriangleRefs { TriangleRef triangle_refs[]; };
layout(set = 0, binding = B_VERTICES, scalar) readonly buffer Vertices { Vertex vertices[]; };

struct Carried {
    vec3 mean;
    float weight, fast, variance, last, noise;
    float total;
};

bool tap_valid(uint index, uint instance, vec3 position, vec3 normal, float footprint) {
    if (histories[index].frame != frame.history_frame || histories[index].instance != instance || !(histories[index].weight > 0.0)) return false;
    vec3 apart = histories[index].position - position;
    vec3 tap_normal = decode_normal(histories[index].normal);
    return dot(tap_normal, normal) > 0.9 && abs(dot(apart, normal)) < 2.0 * footprint && dot(apart, apart) < 16.0 * footprint * footprint;
}

void add_tap(inout Carried c, uint index, float w) {
    c.mean += w * histories[index].mean;
    c.weight += w * histories[index].weight;
    c.fast += w * histories[index].fast;
    c.variance += w * histories[index].variance;
    c.last += w * histories[index].last;
    c.noise += w * histories[index].noise;
    c.total += w;
}

float importance_of(History h, float degrees_) {
    // Standard deviation of one sample, by [Neyman34] the density that lowers the summed variance most; a floor keeps every pixel alive.
    float sigma = h.weight > 0.0 ? sqrt(max(h.variance, 0.0)) : 1.0;
    return clamp(sigma, 0.02, 8.0);
}

// Bias against variance: a history that lags behind by more than half of the noise that the eye would see is too long.
void steer_history(uint tile) {
    TileState t = tile_states[tile];
    if (t.count > 0u) {
        float lag = float(t.lag) / float(t.count), noise = float(t.noise) / float(t.count);
        t.cap = clamp(lag > 0.5 * noise / (31.0 + t.cap) ? t.cap * 0.85 : t.cap * 1.05, min(2.0, frame.history_cap), frame.history_cap);
    } else {
        t.cap = min(16.0, frame.history_cap);
    }
    tile_states[tile] = TileState(t.cap, 0, 0, 0u);
}

void main() {
    uvec2 pixel;
    uint tile = tiles[gl_WorkGroupID.x >> 2u];
    if ((gl_WorkGroupID.x & 3u) == 0u && gl_LocalInvocationIndex == 0u) steer_history(tile);
    if (!tile_pixel(tile, pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    uint pixels = frame.width * frame.height;
    uint current = frame.parity * pixels, former = (1u - frame.parity) * pixels;
    Surface surface = surfaces[at];
    uint importance = 0u, lit = 0u;
    if (is_lit(surface)) {
        lit = 1u;
        uint instance = surface.id >> 24u;
        uint triangle = surface.id & 0xffffffu;
        TriangleRef ref = triangle_refs[instances[instance].triangle_offset + triangle];
        vec2 b = surface.barycentric;
        History h;
        h.instance = instance;
        h.frame = frame.frame;
        // Only rotations and translations lie between the spaces, so lengths are the same in both.
        vec3 world = projector_direction(vec2(pixel) + 0.5) * surface.distance;
        h.position = transform_point(instances[instance].object_from_world, world);
        vec3 normal = normalize(vertices[ref.vertices.x].normal * (1.0 - b.x - b.y) + vertices[ref.vertices.y].normal * b.x + vertices[ref.vertices.z].normal * b.y);
        h.normal = encode_normal(normal);
        float cosine = abs(dot(transform_vector(instances[instance].world_from_object, normal), normalize(world)));
        float footprint = surface.distance * frame.pixel_size / max(cosine, 0.2);
        Guide guide = guides[at];
        vec2 before = vec2(pixel) + 0.5 - guide.motion;
        Carried c = Carried(vec3(0.0), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        h.seed = hash_u32(at + hash_u32(frame.frame + hash_u32(frame.seed)));
        h.index = 0u;
        bool inside = all(greaterThan(before, vec2(0.0))) && all(lessThan(before, vec2(frame.width, frame.height)));
        if (inside) {
            vec2 base = floor(before - 0.5);
            vec2 f = before - 0.5 - base;
            // What stands still is fetched exactly.
            if (abs(f.x - round(f.x)) < 2e-3 && abs(f.y - round(f.y)) < 2e-3) {
                base += round(f);
                f = vec2(0.0);
            }
            ivec2 corner = ivec2(base);
            ivec2 limit = ivec2(frame.width, frame.height) - 1;
            bool smooth_ = false;
            float best = 0.0;
            for (int i = 0; i < 4; i++) {
                ivec2 o = ivec2(i & 1, i >> 1);
                ivec2 q = corner + o;
                float w = (o.x == 1 ? f.x : 1.0 - f.x) * (o.y == 1 ? f.y : 1.0 - f.y);
                if (w <= 0.0 || any(lessThan(q, ivec2(0))) || any(greaterThan(q, limit))) continue;
                uint tap = former + uint(q.y) * frame.width + uint(q.x);
                if (!tap_valid(tap, instance, h.position, normal, footprint)) continue;
                add_tap(c, tap, w);
                if (w > best) {
                    // The sequence goes on where the nearest point left it.
                    best = w;
                    h.seed = histories[tap].seed;
                    h.index = histories[tap].index;
                }
            }
            if ((frame.flags & FRAME_DPM) != 0u && c.total > 0.999 && (f.x > 0.0 || f.y > 0.0)) {
                Carried k = Carried(vec3(0.0), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
                vec2 f2 = f * f, f3 = f2 * f;
                vec4 wx = vec4(-0.5 * f3.x + f2.x - 0.5 * f.x, 1.5 * f3.x - 2.5 * f2.x + 1.0, -1.5 * f3.x + 2.0 * f2.x + 0.5 * f.x, 0.5 * f3.x - 0.5 * f2.x);
                vec4 wy = vec4(-0.5 * f3.y + f2.y - 0.5 * f.y, 1.5 * f3.y - 2.5 * f2.y + 1.0, -1.5 * f3.y + 2.0 * f2.y + 0.5 * f.y, 0.5 * f3.y - 0.5 * f2.y);
                bool all_valid = true;
                vec3 lower = vec3(INFINITY), upper = vec3(-INFINITY);
                for (int y = 0; y < 4 && all_valid; y++) {
                    for (int x = 0; x < 4 && all_valid; x++) {
                        float w = wx[x] * wy[y];
                        if (w == 0.0) continue;
                        ivec2 q = corner + ivec2(x - 1, y - 1);
                        all_valid = !(any(lessThan(q, ivec2(0))) || any(greaterThan(q, limit)));
                        if (!all_valid) break;
                        uint tap = former + uint(q.y) * frame.width + uint(q.x);
                        all_valid = tap_valid(tap, instance, h.position, normal, footprint * 2.0);
                        if (!all_valid) break;
                        k.mean += w * histories[tap].mean;
                        lower = min(lower, histories[tap].mean);
                        upper = max(upper, histories[tap].mean);
                    }
                }
                // Overshoot beyond the taps is ringing.
                if (all_valid) c.mean = clamp(k.mean, lower, upper) * c.total;
            }
        }
        if (c.total > 1e-3 && finite3(c.mean) && finite(c.weight)) {
            float s = 1.0 / c.total;
            h.mean = c.mean * s;
            h.weight = c.weight * s;
            h.fast = c.fast * s;
            h.variance = c.variance * s;
            h.last = c.last * s;
            h.noise = c.noise * s;
        } else {
            h.mean = vec3(0.0);
            h.weight = 0.0;
            h.fast = 0.0;
            h.variance = 0.0;
            h.last = -1.0;
            h.noise = 0.0;
            h.seed = hash_u32(at + hash_u32(frame.frame + hash_u32(frame.seed)));
            h.index = 0u;
        }
        histories[current + at] = h;
        importance = uint(importance_of(h, guide.angle) * 64.0);
    } else {
        histories[current + at].weight = 0.0;
        histories[current + at].frame = frame.frame - 1u;
    }
    uint total = subgroupAdd(importance);
    uint lit_total = subgroupAdd(lit);
    if (subgroupElect() && lit_total > 0u) {
        atomicAdd(schedule.importance, total);
        atomicAdd(schedule.lit, lit_total);
    }
}
