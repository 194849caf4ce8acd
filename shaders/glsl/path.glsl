// One path, from a surface point that the eye sees backwards through the scene to the lights. docs/RENDERING.md has its depth and its weights.
#include "scene.glsl"
#define ALPHA_TEST
#define CHANCE_OF_COVERAGE
#include "bvh.glsl"
#include "shading.glsl"
#include "bsdf.glsl"
#include "light.glsl"
#include "sampler.glsl"

// What decides where a ray meets a surface that is partly there: the path's sequence, for each ray and triangle dimensions of their own, so that the
// choices at a hundred veils are independent of one another and each is as even over the samples as every other dimension.
struct Coverage {
    uint seed;
    uint index;
    uint chance; // 1: some surface was partly there.
};
Coverage coverage = Coverage(0u, 0u, 0u);

void begin_coverage(Sampler rng, uint ray) {
    if (!HAS_ALPHA_BLEND) return;
    uint pixel = SAMPLER == SAMPLER_BLUE_NOISE ? hash_u32(rng.pixel.y * frame.width + rng.pixel.x) : 0u;
    coverage.seed = mix_seed(rng.seed, 0x10000u + ray) ^ pixel;
    coverage.index = rng.index;
}

bool is_covered(float alpha, uint instance, uint triangle) {
    if (alpha <= 0.0 || alpha >= 1.0) return alpha > 0.0;
    coverage.chance = 1u;
    uint key = hash_u32(coverage.seed + hash_u32(instance << 24u | triangle));
    if (SAMPLER == SAMPLER_INDEPENDENT) return to_unit(hash_u32(key + hash_u32(coverage.index))) < alpha;
    uint shuffled = owen_scramble(coverage.index, key) & 0xffffu;
    return to_unit(owen_scramble(bitfieldReverse(shuffled), mix_seed(key, 1u))) < alpha;
}

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

// The path of a sample. Where the first surface is only partly there, which `branch` is told by vertex 0, the sample may look through it: then what is
// behind is the first vertex.
Path begin_path(Point first, Sampler rng, uint id) {
    Path path = Path(first, 1u, vec3(1.0), first.emitted, 1u);
    if (HAS_ALPHA_BLEND && first.coverage < 1.0) {
        path.exact = 0u;
        begin_coverage(rng, 0u);
        if (!is_covered(first.coverage, instance_of(id), triangle_of(id))) {
            path.vertex = 0u;
            path.radiance = vec3(0.0);
        }
    }
    return path;
}

// What is left of light after a way through a solid: of an endless one 1e-38, because the exponential of infinity is not a number everywhere.
vec3 left_by(vec3 absorption, float way) { return exp(-min(absorption * way, vec3(87.0))); }

// What a ray from a point in a direction goes through: the solid that begins there, or nothing.
vec3 absorption_along(Point s, vec3 direction) {
    return dot(direction, s.g) < 0.0 == s.front ? s.absorption : vec3(0.0);
}

// A path that has met a solid which refracts colours differently goes on with one of its channels, chosen by its throughput. The point has the index
// of that channel from then on.
void choose_channel(inout Path path, inout Point s, float u) {
    vec3 t = path.throughput;
    float sum = t.x + t.y + t.z, at = u * sum;
    path.exact = 0u;
    bvec3 chosen = bvec3(at < t.x, at >= t.x && at < t.x + t.y, at >= t.x + t.y);
    // Rounding chooses no channel without light.
    if (chosen.z && t.z <= 0.0) chosen = t.y > 0.0 ? bvec3(false, true, false) : bvec3(true, false, false);
    path.throughput = mix(vec3(0.0), vec3(sum), chosen);
    float half_spread = (s.ior - 1.0) * 0.025 * s.dispersion;
    s.ior = max(s.ior + (chosen.x ? -half_spread : chosen.z ? half_spread : 0.0), 1.001);
}

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
    vec3 absorption;      // What the next ray goes through takes of its light, per metre.
    uvec2 coverage;       // Seed of the sequence that decides which partly present surfaces these rays meet, and the sample's index.
    uvec2 pixel;
};

uint left_onward(Branches b) { return NO_BODY << 10u | b.left >> 20u; }

void add_sky(inout Path path, BsdfSample next, float sky, vec3 absorption) {
    if (ENVIRONMENT_KIND == ENVIRONMENT_NONE) return;
    if (HAS_ABSORPTION) path.throughput *= left_by(absorption, INFINITY);
    float weight = next.delta ? 1.0 : balance(next.pdf, sky);
    path.radiance += limit_indirect(path.throughput * environment_radiance(next.direction) * weight, path.vertex);
}

// Rays of a lane in one word, because each number would take a register across every walk: all of them in the lower half, in the upper half those
// that were proven to meet nothing and not walked. No lane has 42,000 before they are read: 320 samples with paths of 64 vertices and two rays each.
const uint RAY = 1u, PROVEN_RAY = 0x10000u;

uint rays_of(uint counted) { return counted & 0xffffu; }
uint proven_rays_of(uint counted) { return counted >> 16u; }

// Chooses the rays from the newest vertex, and adds the light of those that surely meet nothing. False: no ray is left to be traced, and the path's
// radiance is complete.
bool branch(inout Path path, Sampler rng, inout uint rays, out Branches b) {
    Point s = path.at;
    uint vertex = path.vertex;
    b.waits = 0u;
    b.left = NONE_LEFT;
    b.absorption = vec3(0.0);
    if (HAS_ALPHA_BLEND) {
        b.coverage = uvec2(rng.seed, rng.index);
        b.pixel = rng.pixel;
        coverage.chance = 0u;
    }
    if (HAS_ALPHA_BLEND && vertex == 0u) {
        b.next = BsdfSample(-s.v, vec3(1.0), 0.0, true, true, true);
        b.origin = s.p - s.g * s.offset;
        b.sky = 0.0;
        b.left = NO_BODY << 20u | NONE_LEFT;
        b.waits = WAITS_ONWARD;
        rays += RAY;
        return true;
    }
    // A single-sided opaque surface seen from behind is black.
    bool black = !s.front && (s.flags & (MATERIAL_DOUBLE_SIDED | MATERIAL_TRANSMISSIVE)) == 0u;
    if (vertex >= frame.depth || black) return false;
    if (HAS_DISPERSION && s.dispersion > 0.0) choose_channel(path, s, sample_4d(rng, vertex * 2u - 1u).w);
    Lobes lobes = lobes_of(s);
    bool only_delta = only_deltas(s, lobes);
    // There is only one way to continue, and no Russian roulette yet.
    path.exact = only_delta && lobes.transmit <= 0.0 && vertex < 3u ? path.exact : 0u;
    if (HAS_CLEARCOAT && lobes.coat > 0.0) path.exact = 0u;
    // The point on the light and the next direction matter most, so they share a group of four dimensions. Its first two dimensions are the most
    // evenly distributed. Without light samples the next direction takes these, and the choice of its lobe takes the third.
    vec4 u_direction = sample_4d(rng, vertex * 2u - 2u);
    vec4 u_choice = sample_4d(rng, vertex * 2u - 1u);
    bool no_light = frame.environment_select == 0.0 && frame.light_count == 0u;
    vec2 u_light = u_direction.xy, u_bsdf = no_light ? u_direction.xy : u_direction.zw;
    float u_pick = u_choice.x, u_lobe = no_light ? u_direction.z : u_choice.y, u_roulette = u_choice.z;
    begin_coverage(rng, vertex * 2u);
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
                if (HAS_ABSORPTION) b.light *= left_by(absorption_along(s, direction), light.finite_distance ? length(light.to_light) : INFINITY);
                b.left = light.left;
                b.waits = WAITS_FOR_LIGHT;
                rays += RAY;
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
    if (HAS_ABSORPTION) b.absorption = absorption_along(s, b.next.direction);
    b.origin = s.p + s.g * (b.next.below ? -s.offset : s.offset);
    b.sky = continues ? sky_pdf(b.next, s.n) : 0.0;
    // Rays that leave their body and enter the bounds of no other meet nothing.
    if (b.waits != 0u) {
        bool leaves = s.front && leaves_body(s.body, s.row, s.g, b.light_direction);
        b.left = (b.left & NO_BODY) << 10u | (leaves ? s.body : NO_BODY);
        if (leaves && !enters_any(b.light_origin, b.light_direction, b.left, b.light_t)) {
            path.radiance += limit_indirect(b.light, vertex);
            b.waits = 0u;
            rays += PROVEN_RAY;
        }
    }
    if (continues) {
        rays += RAY;
        bool leaves = s.front && leaves_body(s.body, s.row, s.g, b.next.direction);
        b.left |= (leaves ? s.body : NO_BODY) << 20u;
        bool onward = !leaves || enters_any(b.origin, b.next.direction, left_onward(b), INFINITY);
        if (!onward) rays += PROVEN_RAY;
        // Light is added in one order, whichever rays have to be traced.
        if (!onward && (b.waits & WAITS_FOR_LIGHT) == 0u) add_sky(path, b.next, b.sky, b.absorption);
        else b.waits |= onward ? WAITS_ONWARD : WAITS_FOR_SKY;
    }
    return b.waits != 0u;
}

// Makes the choices at surfaces that are partly there those of a ray.
void aim_coverage(Branches b, uint ray) {
    if (HAS_ALPHA_BLEND) begin_coverage(Sampler(b.coverage.x, b.coverage.y, b.pixel), ray);
}

#ifndef WALK_APART
// Traces the rays that `branch` left, and adds their light. False: the path has ended, and its radiance is complete. True: it goes on at `hit`.
bool follow(inout Path path, Branches b, out Hit hit) {
    bool met = false;
#ifdef TEXEL_TABLES
    // On software Vulkan, where registers are plentiful, two walks are faster by a sixth than one in a loop.
    if ((b.waits & WAITS_FOR_LIGHT) != 0u) {
        hit.t = b.light_t;
        aim_coverage(b, path.vertex * 2u);
        if (!trace_ray(b.light_origin, b.light_direction, 0u, b.left, true, hit)) path.radiance += limit_indirect(b.light, path.vertex);
    }
    if ((b.waits & WAITS_ONWARD) != 0u) {
        hit.t = INFINITY;
        aim_coverage(b, path.vertex * 2u + 1u);
        met = trace_ray(b.origin, b.next.direction, 0u, left_onward(b), false, hit);
    }
#else
    // On a GPU one walk traces both rays in turn. So the walk's code stands once, and while it runs nothing of the vertex is kept but what these rays
    // need.
    for (uint ray = (b.waits & WAITS_FOR_LIGHT) != 0u ? 0u : 1u; ray < ((b.waits & WAITS_ONWARD) != 0u ? 2u : 1u); ray++) {
        bool to_light = ray == 0u;
        hit.t = to_light ? b.light_t : INFINITY;
        aim_coverage(b, path.vertex * 2u + ray);
        met = trace_ray(to_light ? b.light_origin : b.origin, to_light ? b.light_direction : b.next.direction, 0u,
                        to_light ? b.left : left_onward(b), to_light, hit);
        if (to_light && !met) path.radiance += limit_indirect(b.light, path.vertex);
    }
#endif
    bool onward = (b.waits & WAITS_ONWARD) != 0u;
    if (onward ? !met : (b.waits & WAITS_FOR_SKY) != 0u) add_sky(path, b.next, b.sky, b.absorption);
    if (HAS_ALPHA_BLEND && coverage.chance != 0u) path.exact = 0u;
    return onward && met;
}
#endif

// The path's next vertex, at which the ray of `b` arrives. False: the path ends there, and its radiance is complete.
bool arrive(inout Path path, Branches b, Hit hit, Point s) {
    if (HAS_ABSORPTION) {
        // The back of a solid is met from within it, wherever the ray comes from.
        vec3 absorption = s.front ? b.absorption : mix(s.absorption, b.absorption, equal(s.absorption, vec3(0.0)));
        path.throughput *= left_by(absorption, distance(path.at.p, s.p));
    }
    path.at = s;
    if (HAS_EMISSIVE && s.light != NO_LIGHT && luminance(s.emitted) > 0.0) {
        float light_pdf = b.next.delta ? 0.0 : emissive_pdf(s.light, instance_of(hit.id), triangle_of(hit.id), b.origin, s.p, s.g);
        float weight = b.next.delta ? 1.0 : balance(b.next.pdf, light_pdf);
        path.radiance += limit_indirect(path.throughput * s.emitted * weight, path.vertex);
    }
    path.vertex++;
    return path.vertex < frame.depth;
}
