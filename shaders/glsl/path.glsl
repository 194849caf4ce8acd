// One path, from a surface point that the eye sees backwards through the scene to the lights. docs/RENDERING.md has its depth and its weights.
#include "scene.glsl"
#define ALPHA_TEST
#include "bvh.glsl"
#include "shading.glsl"
#include "bsdf.glsl"
#include "light.glsl"
#include "sampler.glsl"

vec3 limit_indirect(vec3 contribution, uint vertex) {
    if (!HAS_CLAMP || vertex < 2u) return contribution;
    float l = luminance(contribution);
    if (l > frame.clamp_indirect) {
        atomicAdd(counters.clamped_samples, 1u);
        return contribution * (frame.clamp_indirect / l);
    }
    return contribution;
}

// The balance heuristic, without overflow. It is 0 if both densities are 0.
float balance(float a, float b) {
    if (!(a > 0.0)) return 0.0;
    return finite(a) ? a / (a + b) : 1.0;
}

// A path that is being traced.
struct Path {
    Point at;        // Its newest vertex.
    uint vertex;     // Number of that vertex; 1 is the first surface point.
    vec3 throughput;
    vec3 radiance;
    uint exact;      // 1: no random choice was made yet, so every sample of the pixel is equal to this one.
};

Path begin_path(Point first) { return Path(first, 1u, vec3(1.0), first.emitted, 1u); }

// Pdf over solid angle with which a sample of the lights would have found the sky in this direction.
float sky_pdf(BsdfSample next, vec3 n) {
    return ENVIRONMENT_KIND == ENVIRONMENT_NONE || next.delta ? 0.0 : environment_pdf(next.direction, n) * frame.environment_select;
}

// Bits of what a path waits for at its newest vertex: for the ray to a light, whose light arrives if nothing is in its way; for its next ray; or, once
// the former is traced, for the light of the sky, because its next ray surely meets nothing. (Words, because each bool would take a scalar register.)
const uint WAITS_FOR_LIGHT = 1u, WAITS_ONWARD = 2u, WAITS_FOR_SKY = 4u;

// The rays from a path's newest vertex that are yet to be traced, and what they need.
struct Branches {
    uint waits;           // WAITS_FOR_LIGHT, WAITS_ONWARD, WAITS_FOR_SKY.
    vec3 light_origin;
    vec3 light_direction;
    float light_t;
    vec3 light;
    BsdfSample next;
    vec3 origin;          // Where the next ray starts.
    float sky;            // Pdf with which a sample of the lights would have found the sky there.
    uint left;            // Bodies that these rays do not meet: two of the ray to the light, and in the upper bits one of the next ray.
};

uint left_onward(Branches b) { return NO_BODY << 10u | b.left >> 20u; }

void add_sky(inout Path path, BsdfSample next, float sky) {
    if (ENVIRONMENT_KIND == ENVIRONMENT_NONE) return;
    float weight = next.delta ? 1.0 : balance(next.pdf, sky);
    path.radiance += limit_indirect(path.throughput * environment_radiance(next.direction) * weight, path.vertex);
}

// Chooses the rays from the newest vertex, and adds the light of those that surely meet nothing. False: no ray is left to be traced, and the path's
// radiance is complete.
bool branch(inout Path path, Sampler rng, inout uint rays, out Branches b) {
    Point s = path.at;
    uint vertex = path.vertex;
    b.waits = 0u;
    b.left = NONE_LEFT;
    // A single-sided opaque surface seen from behind is black.
    bool black = !s.front && (s.flags & (MATERIAL_DOUBLE_SIDED | MATERIAL_TRANSMISSIVE)) == 0u;
    if (vertex >= frame.depth || black) return false;
    Lobes lobes = lobes_of(s);
    bool only_delta = mirror_like(s) && lobes.diffuse <= 0.0;
    // There is only one way to continue, and no Russian roulette yet.
    path.exact = only_delta && lobes.transmit <= 0.0 && vertex < 3u ? path.exact : 0u;
    // The point on the light and the next direction matter most, so they share a group of four dimensions. Its first two dimensions are the most
    // evenly distributed. Without light samples the next direction takes these, and the choice of its lobe takes the third.
    vec4 u_direction = sample_4d(rng, vertex * 2u - 2u);
    vec4 u_choice = sample_4d(rng, vertex * 2u - 1u);
    bool no_light = frame.environment_select == 0.0 && frame.light_count == 0u;
    vec2 u_light = u_direction.xy, u_bsdf = no_light ? u_direction.xy : u_direction.zw;
    float u_pick = u_choice.x, u_lobe = no_light ? u_direction.z : u_choice.y, u_roulette = u_choice.z;
    if (!only_delta) {
        LightSample light = sample_light(s.p, s.n, u_pick, u_light);
        if (light.valid) {
            vec3 direction = normalize(light.to_light);
            vec3 value;
            float pdf;
            evaluate(s, lobes, direction, value, pdf);
            if (luminance(value) > 0.0) {
                float side = dot(direction, s.g) > 0.0 ? 1.0 : -1.0;
                b.light_origin = s.p + s.g * (side * s.offset);
                b.light_direction = light.finite_distance ? light.to_light - s.g * (side * s.offset) : direction;
                b.light_t = light.finite_distance ? 1.0 : INFINITY;
                float weight = light.pdf > 0.0 ? balance(light.pdf, pdf) : 1.0;
                b.light = path.throughput * value * light.radiance * weight;
                b.left = light.left;
                b.waits = WAITS_FOR_LIGHT;
                rays++;
            }
        }
    }
    b.next = sample_bsdf(s, lobes, u_lobe, u_bsdf);
    bool continues = b.next.valid;
    path.throughput *= b.next.weight;
    if (vertex >= 3u) {
        float survival = min(0.95, max(path.throughput.x, max(path.throughput.y, path.throughput.z)));
        continues = continues && u_roulette < survival;
        path.throughput /= survival;
    }
    b.origin = s.p + s.g * (b.next.below ? -s.offset : s.offset);
    b.sky = continues ? sky_pdf(b.next, s.n) : 0.0;
    // Rays that leave their body and enter the bounds of no other meet nothing.
    if (b.waits != 0u) {
        bool leaves = s.front && leaves_body(s.body, s.row, s.g, b.light_direction);
        b.left = (b.left & NO_BODY) << 10u | (leaves ? s.body : NO_BODY);
        if (leaves && !enters_any(b.light_origin, b.light_direction, b.left, b.light_t)) {
            path.radiance += limit_indirect(b.light, vertex);
            b.waits = 0u;
        }
    }
    if (continues) {
        rays++;
        bool leaves = s.front && leaves_body(s.body, s.row, s.g, b.next.direction);
        b.left |= (leaves ? s.body : NO_BODY) << 20u;
        bool onward = !leaves || enters_any(b.origin, b.next.direction, left_onward(b), INFINITY);
        // Light is added in one order, whichever rays have to be traced.
        if (!onward && (b.waits & WAITS_FOR_LIGHT) == 0u) add_sky(path, b.next, b.sky);
        else b.waits |= onward ? WAITS_ONWARD : WAITS_FOR_SKY;
    }
    return b.waits != 0u;
}

// Traces the rays that `branch` left, and adds their light. False: the path has ended, and its radiance is complete. True: it goes on at `hit`.
bool follow(inout Path path, Branches b, out Hit hit) {
    bool met = false;
#ifdef TEXEL_TABLES
    // On software Vulkan, where registers are plentiful, two walks are faster by a sixth than one in a loop.
    if ((b.waits & WAITS_FOR_LIGHT) != 0u) {
        hit.t = b.light_t;
        if (!trace_ray(b.light_origin, b.light_direction, 0u, b.left, true, hit)) path.radiance += limit_indirect(b.light, path.vertex);
    }
    if ((b.waits & WAITS_ONWARD) != 0u) {
        hit.t = INFINITY;
        met = trace_ray(b.origin, b.next.direction, 0u, left_onward(b), false, hit);
    }
#else
    // On a GPU one walk traces both rays in turn. So the walk's code stands once, and while it runs nothing of the vertex is kept but what these rays
    // need.
    for (uint ray = (b.waits & WAITS_FOR_LIGHT) != 0u ? 0u : 1u; ray < ((b.waits & WAITS_ONWARD) != 0u ? 2u : 1u); ray++) {
        bool to_light = ray == 0u;
        hit.t = to_light ? b.light_t : INFINITY;
        met = trace_ray(to_light ? b.light_origin : b.origin, to_light ? b.light_direction : b.next.direction, 0u,
                        to_light ? b.left : left_onward(b), to_light, hit);
        if (to_light && !met) path.radiance += limit_indirect(b.light, path.vertex);
    }
#endif
    bool onward = (b.waits & WAITS_ONWARD) != 0u;
    if (onward ? !met : (b.waits & WAITS_FOR_SKY) != 0u) add_sky(path, b.next, b.sky);
    return onward && met;
}

// The path's next vertex, at which the ray of `b` arrives. False: the path ends there, and its radiance is complete.
bool arrive(inout Path path, Branches b, Hit hit, Point s) {
    path.at = s;
    if (HAS_EMISSIVE && s.light != NO_LIGHT && luminance(s.emitted) > 0.0) {
        float light_pdf = b.next.delta ? 0.0 : emissive_pdf(s.light, instance_of(hit.id), triangle_of(hit.id), b.origin, s.p, s.g);
        float weight = b.next.delta ? 1.0 : balance(b.next.pdf, light_pdf);
        path.radiance += limit_indirect(path.throughput * s.emitted * weight, path.vertex);
    }
    path.vertex++;
    return path.vertex < frame.depth;
}
