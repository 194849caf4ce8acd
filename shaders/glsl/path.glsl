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
    bool exact;      // No random choice was made yet, so every sample of the pixel is equal to this one.
};

Path begin_path(Point first) { return Path(first, 1u, vec3(1.0), first.emitted, true); }

// Pdf over solid angle with which a sample of the lights would have found the sky in this direction.
float sky_pdf(BsdfSample next, vec3 n) {
    return ENVIRONMENT_KIND == ENVIRONMENT_NONE || next.delta ? 0.0 : environment_pdf(next.direction, n) * frame.environment_select;
}

bool is_blocked(vec3 origin, vec3 direction, float t_max, inout uint rays) {
    Hit blocker;
    blocker.t = t_max;
    rays++;
    return trace_ray(origin, direction, 0u, true, blocker);
}

// Adds the light that reaches the newest vertex and continues to the next one. False: the path has ended, and its radiance is complete.
bool advance_path(inout Path path, Sampler rng, inout uint rays) {
    Point s = path.at;
    uint vertex = path.vertex;
    // A single-sided opaque surface seen from behind is black.
    bool black = !s.front && (s.flags & (MATERIAL_DOUBLE_SIDED | MATERIAL_TRANSMISSIVE)) == 0u;
    if (vertex >= frame.depth || black) return false;
    Lobes lobes = lobes_of(s);
    bool only_delta = mirror_like(s) && lobes.diffuse <= 0.0;
    // There is only one way to continue, and no Russian roulette yet.
    path.exact = path.exact && only_delta && lobes.transmit <= 0.0 && vertex < 3u;
    // The point on the light and the next direction matter most, so they share a group of four dimensions. Its first two dimensions are the most
    // evenly distributed. Without light samples the next direction takes these, and the choice of its lobe takes the third.
    vec4 u_direction = sample_4d(rng, vertex * 2u - 2u);
    vec4 u_choice = sample_4d(rng, vertex * 2u - 1u);
    bool no_light = frame.environment_select == 0.0 && frame.light_count == 0u;
    vec2 u_light = u_direction.xy, u_bsdf = no_light ? u_direction.xy : u_direction.zw;
    float u_pick = u_choice.x, u_lobe = no_light ? u_direction.z : u_choice.y, u_roulette = u_choice.z;
    // On a GPU the ray to the light and the next ray are both chosen before either is traced, and one walk traces them in turn. So the walk's code
    // stands once, and while it runs nothing of the vertex is kept but what these rays need. On software Vulkan, where registers are plentiful, two
    // walks are faster by a sixth.
    bool shadow = false;
    vec3 shadow_origin = vec3(0.0), shadow_direction = vec3(0.0), shadow_light = vec3(0.0);
    float shadow_t = 0.0;
    if (!only_delta) {
        LightSample light = sample_light(s.p, s.n, u_pick, u_light);
        if (light.valid) {
            vec3 direction = normalize(light.to_light);
            vec3 value;
            float pdf;
            evaluate(s, lobes, direction, value, pdf);
            if (luminance(value) > 0.0) {
                float side = dot(direction, s.g) > 0.0 ? 1.0 : -1.0;
                shadow = true;
                shadow_origin = s.p + s.g * (side * s.offset);
                shadow_direction = light.finite_distance ? light.to_light - s.g * (side * s.offset) : direction;
                shadow_t = light.finite_distance ? 1.0 : INFINITY;
                float weight = light.pdf > 0.0 ? balance(light.pdf, pdf) : 1.0;
                shadow_light = path.throughput * value * light.radiance * weight;
#ifdef TEXEL_TABLES
                if (!is_blocked(shadow_origin, shadow_direction, shadow_t, rays)) path.radiance += limit_indirect(shadow_light, vertex);
#endif
            }
        }
    }
    BsdfSample next = sample_bsdf(s, lobes, u_lobe, u_bsdf);
    bool continues = next.valid;
    path.throughput *= next.weight;
    if (vertex >= 3u) {
        float survival = min(0.95, max(path.throughput.x, max(path.throughput.y, path.throughput.z)));
        continues = continues && u_roulette < survival;
        path.throughput /= survival;
    }
    vec3 origin = s.p + s.g * (next.below ? -s.offset : s.offset);
    vec3 from = s.p;
    Hit hit;
#ifdef TEXEL_TABLES
    if (!continues) return false;
    hit.t = INFINITY;
    rays++;
    bool met = trace_ray(origin, next.direction, 0u, false, hit);
    float sky = met ? 0.0 : sky_pdf(next, s.n);
#else
    float sky = sky_pdf(next, s.n);
    bool met = false;
    for (uint ray = shadow ? 0u : 1u; ray < (continues ? 2u : 1u); ray++) {
        bool to_light = ray == 0u;
        hit.t = to_light ? shadow_t : INFINITY;
        rays++;
        met = trace_ray(to_light ? shadow_origin : origin, to_light ? shadow_direction : next.direction, 0u, to_light, hit);
        if (to_light && !met) path.radiance += limit_indirect(shadow_light, vertex);
    }
    if (!continues) return false;
#endif
    if (!met) {
        if (ENVIRONMENT_KIND != ENVIRONMENT_NONE) {
            float weight = next.delta ? 1.0 : balance(next.pdf, sky);
            path.radiance += limit_indirect(path.throughput * environment_radiance(next.direction) * weight, vertex);
        }
        return false;
    }
    s = shading_point(hit, -normalize(next.direction));
    path.at = s;
    path.vertex++;
    if (HAS_EMISSIVE && s.light != NO_LIGHT && luminance(s.emitted) > 0.0) {
        float light_pdf = next.delta ? 0.0 : emissive_pdf(s.light, instance_of(hit.id), triangle_of(hit.id), from, s.p, s.g);
        float weight = next.delta ? 1.0 : balance(next.pdf, light_pdf);
        path.radiance += limit_indirect(path.throughput * s.emitted * weight, vertex);
    }
    return path.vertex < frame.depth;
}
