// What the light of a history is divided by (method dpm): what sky and lamps would send from a surface point toward the eye at the present pose, with
// nothing in the way. So histories hold what of it arrives, which changes little while a body turns or a lamp moves. It is relative to the mean light
// of the scene: under an even sky it is the reflectance. The filtered sky and the lamps are those of host/render/src/scene_data/relight.rs.

layout(set = 0, binding = B_LIGHTS, scalar) readonly buffer Lights { Light lights[]; };
layout(set = 0, binding = B_ENVIRONMENT, scalar) readonly buffer EnvironmentBlock { vec4 environment_texels[]; };

// Of the mean light, what arrives at every point at the least: light that others reflect. Without it what is divided by would vanish where neither sky nor
// lamps shine.
const float LEAST_LIGHT = 0.05;
// What histories are divided by stays between these.
const float LEAST_DIVISOR = 0.02, MOST_DIVISOR = 1e4;

// Mean radiance of the sky over a lobe about the unit vector `d`.
vec3 filtered_sky(vec3 d, uint lobe) {
    if (ENVIRONMENT_KIND == ENVIRONMENT_NONE) return vec3(0.0);
    if (ENVIRONMENT_KIND == ENVIRONMENT_CONSTANT) return frame.environment;
    vec2 q = d.xz / (abs(d.x) + abs(d.y) + abs(d.z));
    if (d.y < 0.0) q = (1.0 - abs(q.yx)) * vec2(q.x >= 0.0 ? 1.0 : -1.0, q.y >= 0.0 ? 1.0 : -1.0);
    vec2 x = (q * 0.5 + 0.5) * float(SKY_NODES - 1u);
    vec2 node = clamp(floor(x), vec2(0.0), vec2(float(SKY_NODES - 2u)));
    vec2 beyond = x - node;
    uint first = frame.environment_height * (frame.environment_width + 1u);
    uint at = first + (lobe * SKY_NODES + uint(node.y)) * SKY_NODES + uint(node.x);
    vec3 upper = mix(environment_texels[at].rgb, environment_texels[at + 1u].rgb, beyond.x);
    at += SKY_NODES;
    return mix(upper, mix(environment_texels[at].rgb, environment_texels[at + 1u].rgb, beyond.x), beyond.y);
}

// The lobe that is nearest to one of this width.
uint nearest_lobe(float alpha) { return uint(clamp(8.0 * sqrt(alpha) - 1.5, 0.0, float(SKY_LOBES - 1u))); }

// Where a lobe's light comes from on average: the rougher the surface, the nearer to its normal [Lagarde14].
vec3 lobe_direction(vec3 n, vec3 v, float alpha) {
    float smooth_ = 1.0 - alpha;
    return normalize(mix(n, reflect(-v, n), smooth_ * (sqrt(smooth_) + alpha)));
}

// A lamp as seen from a point: the unit vector to it, its irradiance on a surface that faces it, and the radius that it shows by the distance.
struct Seen {
    vec3 to;
    vec3 irradiance;
    float radius;
};

Seen lamp_from(vec3 p, uint index) {
    Light lamp = lights[index];
    vec3 position = lamp.position, direction = lamp.direction;
    if (lamp.instance != NO_INSTANCE) {
        position = transform_point(instance_at(lamp.instance).world_from_object, position);
        direction = transform_vector(instance_at(lamp.instance).world_from_object, direction);
    } else {
        position -= frame.world_origin;
    }
    // A sun of the sky has a radius.
    if (lamp.kind == LIGHT_DIRECTIONAL) return Seen(-direction, lamp.intensity, lamp.cone_offset);
    vec3 d = position - p;
    float d2 = max(dot(d, d), 1e-12);
    vec3 to = d * inversesqrt(d2);
    if (HAS_EMISSIVE && lamp.kind == LIGHT_BODY) {
        float area = lamp.range + max(-dot(direction, to), 0.0);
        float disk = area / PI;
        // No more than a sky of its radiance sends.
        return Seen(to, lamp.intensity * (area / (d2 + disk)), sqrt(disk / d2));
    }
    float falloff = 1.0 / d2;
    if (lamp.range < 1.0e30) {
        float x = d2 / (lamp.range * lamp.range);
        falloff *= clamp(1.0 - x * x, 0.0, 1.0);
    }
    if (lamp.kind == LIGHT_SPOT) {
        float c = clamp(dot(-to, direction) * lamp.cone_scale + lamp.cone_offset, 0.0, 1.0);
        falloff *= c * c;
    }
    return Seen(to, lamp.intensity * falloff, 0.0);
}

// Of a lamp's light, what a surface sends toward the eye by the model of docs/RENDERING.md. `diffuse` is its reflectance below the coat, and `average`
// the coat's E_avg.
vec3 reflected(Point s, vec3 diffuse, float average, Seen lamp) {
    float nl = dot(s.n, lamp.to), nv = dot(s.n, s.v), radius = min(lamp.radius, 1.0);
    // A disk sets little by little: a parabola between its edges on the horizon.
    float risen = nl + radius;
    if (risen <= 0.0) return vec3(0.0);
    if (nl < radius) nl = risen * risen / (4.0 * radius);
    vec3 value = diffuse * (nl / PI);
    if (HAS_SPECULAR) {
        value *= (1.0 - directional_albedo(s.table, s.alpha, nl)) / max(1.0 - average, 1e-4);
        // A wide lamp makes the lobe wider: half vectors move by half of its radius.
        float alpha = min(sqrt(s.alpha * s.alpha + 0.25 * radius * radius), 1.0);
        vec3 h = normalize(s.v + lamp.to);
        float away = 1.0 - clamp(dot(s.v, h), 0.0, 1.0), index = (s.ior - 1.0) / (s.ior + 1.0);
        vec3 f0 = mix(vec3(index * index), s.base, s.metallic);
        vec3 f = f0 + (1.0 - f0) * (away * away * away * away * away);
        value += f * (ggx_d(alpha, s.n, h) / ((1.0 + smith_lambda(alpha, nv) + smith_lambda(alpha, nl)) * 4.0 * nv));
    }
    return value * lamp.irradiance;
}

// Light from below the surface itself is lost, whatever the direction of the shading normal: that share of a cosine lobe is (1 - cos) / 2 of the angle
// between the normals.
vec3 demodulation(Hit hit, vec3 toward) {
    Point s = shading_point(hit, toward);
    float nv = dot(s.n, s.v);
    float e = HAS_SPECULAR ? directional_albedo(s.table, s.alpha, nv) : 0.0;
    float m = pow(clamp(1.0 - nv, 0.0, 1.0), 5.0);
    vec3 diffuse = (1.0 - e) * (1.0 - s.metallic) * s.base;
    vec3 specular = mix(vec3(e), s.base + (1.0 - s.base) * m, s.metallic);
    float above = 0.5 + 0.5 * dot(s.n, s.g);
    vec3 least = vec3(LEAST_LIGHT * frame.mean_light);
    vec3 light = s.emitted;
    if (HAS_DIFFUSE) light += diffuse * (above * max(filtered_sky(s.n, SKY_LOBES), least));
    if (HAS_SPECULAR) light += specular * max(filtered_sky(lobe_direction(s.n, s.v, s.alpha), nearest_lobe(s.alpha)), least);
    if (HAS_EMISSIVE || HAS_PUNCTUAL || ENVIRONMENT_KIND == ENVIRONMENT_MAP) {
        float average = HAS_SPECULAR && HAS_DIFFUSE ? average_albedo(s.table, s.alpha) : 0.0;
        for (uint i = 0u; i < frame.lamp_count; i++) light += reflected(s, diffuse, average, lamp_from(s.p, frame.light_count + i));
    }
    return clamp(light / frame.mean_light, vec3(LEAST_DIVISOR), vec3(MOST_DIVISOR));
}
