// What the light of a history is divided by (method dpm): what sky and lamps would send from a surface point toward the eye at the present pose, with
// nothing in the way. So histories hold what of it arrives, which changes little while a body turns or a lamp moves. It is relative to the mean light
// of the scene: under an even sky it is the reflectance. The filtered sky and the lamps are those of host/render/src/scene_data/relight.rs.

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
    vec3 upper = mix(sky_at(at).light, sky_at(at + 1u).light, beyond.x);
    at += SKY_NODES;
    return mix(upper, mix(sky_at(at).light, sky_at(at + 1u).light, beyond.x), beyond.y);
}

// The same over a lobe of GGX of this width, between the two that are nearest.
vec3 sky_over(vec3 d, float alpha) {
    if (ENVIRONMENT_KIND != ENVIRONMENT_MAP) return filtered_sky(d, 0u);
    float x = clamp(8.0 * sqrt(alpha) - 2.0, 0.0, float(SKY_LOBES - 1u));
    uint lower = min(uint(x), SKY_LOBES - 2u);
    return mix(filtered_sky(d, lower), filtered_sky(d, lower + 1u), x - float(lower));
}

// Where a lobe's light comes from on average: the rougher the surface, the nearer to its normal [Lagarde14].
vec3 lobe_direction(vec3 n, vec3 v, float alpha) {
    float smooth_ = 1.0 - alpha;
    return normalize(mix(n, reflect(-v, n), smooth_ * (sqrt(smooth_) + alpha)));
}

// A lamp at the present pose.
struct Lamp {
    uint kind;
    vec3 position;
    vec3 direction;
    vec3 intensity;
    float cone_scale;
    float cone_offset;
    float range;
};

Lamp lamp_at(uint i) {
    Light lamp = light_at(frame.light_count + i);
    vec3 position = lamp.position, direction = lamp.direction;
    if (lamp.instance != NO_INSTANCE) {
        position = transform_point(instance_at(lamp.instance).world_from_object, position);
        direction = transform_vector(instance_at(lamp.instance).world_from_object, direction);
    } else {
        position -= frame.world_origin;
    }
    return Lamp(lamp.kind, position, direction, lamp.intensity, lamp.cone_scale, lamp.cone_offset, lamp.range);
}

#ifdef READ_BEFORE
// The lamp of a scene that has one.
Lamp own_lamp;
Lamp lamp_of(uint i) {
    if (LAMPS == 1u) return own_lamp;
    return lamp_at(i);
}
#else
#define lamp_of(i) lamp_at(i)
#endif

// A lamp as seen from a point: the unit vector to it, its irradiance on a surface that faces it, and the radius that it shows by the distance.
struct Seen {
    vec3 to;
    vec3 irradiance;
    float radius;
};

Seen seen_from(Lamp lamp, vec3 p) {
    // A sun of the sky has a radius.
    if (lamp.kind == LIGHT_DIRECTIONAL) return Seen(-lamp.direction, lamp.intensity, lamp.cone_offset);
    vec3 d = lamp.position - p;
    float d2 = max(dot(d, d), 1e-12);
    vec3 to = d * inversesqrt(d2);
    if (HAS_EMISSIVE && lamp.kind == LIGHT_BODY) {
        float area = lamp.range + max(-dot(lamp.direction, to), 0.0);
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
        float c = clamp(dot(-to, lamp.direction) * lamp.cone_scale + lamp.cone_offset, 0.0, 1.0);
        falloff *= c * c;
    }
    return Seen(to, lamp.intensity * falloff, 0.0);
}

// Of a lamp's light, what a surface sends toward the eye by the model of docs/RENDERING.md. A disk sets little by little behind the surface: of one that
// has begun to, the part that is left shines from its own middle.
vec3 reflected(Point s, Lobes q, Seen lamp) {
    float radius = min(lamp.radius, 1.0), height = dot(s.g, lamp.to), share = 1.0;
    vec3 l = lamp.to;
    if (height < radius && (!HAS_DIFFUSE_TRANSMISSION || height > -radius)) {
        float risen = height + radius;
        if (risen <= 0.0) return vec3(0.0);
        share = risen / (2.0 * radius);
        l = normalize(l + s.g * (0.5 * risen - height));
    }
    // A wide lamp makes lobes wider: half vectors move by half of its radius.
    float spread = 0.25 * radius * radius;
    s.alpha = min(sqrt(s.alpha * s.alpha + spread), 1.0);
    if (HAS_ANISOTROPY && s.across > 0.0) s.across = min(sqrt(s.across * s.across + spread), 1.0);
    if (HAS_CLEARCOAT) s.coat_alpha = min(sqrt(s.coat_alpha * s.coat_alpha + spread), 1.0);
    vec3 value;
    float pdf;
    evaluate(s, q, l, value, pdf);
    return value * share * lamp.irradiance;
}

// Of the sky's light, what a lobe with this reflectance for even light sends toward the eye.
vec3 sky_light(vec3 sky, vec3 reflectance) { return reflectance * max(sky, vec3(LEAST_LIGHT * frame.mean_light)); }

// Light from below the surface itself is lost, whatever the direction of the shading normal: that share of a cosine lobe is (1 - cos) / 2 of the angle
// between the normals.
vec3 demodulation(Hit hit, vec3 toward) {
    Point s = shading_point(hit, toward);
    Lobes q = lobes_of(s);
    float nv = dot(s.n, s.v);
    // What the layers leave of light on its way to the base and back.
    float under = (1.0 - q.coat_v) * (1.0 - q.sheen_v), above = 0.5 + 0.5 * dot(s.n, s.g);
    float below = q.dielectric * (1.0 - q.albedo_v) * under, matte = below * (1.0 - s.transmission);
    vec3 light = s.emitted;
    if (HAS_DIFFUSE || HAS_SHEEN) {
        vec3 diffuse = HAS_DIFFUSE ? s.base * matte : vec3(0.0);
        if (HAS_DIFFUSE_TRANSMISSION && q.shine > 0.0) {
            light += sky_light(filtered_sky(-s.n, SKY_LOBES), s.shine_color * (matte * s.shine * above));
            diffuse *= 1.0 - s.shine;
        }
        // The light of a sheen is as spread.
        if (HAS_SHEEN && q.sheen_v > 0.0) diffuse += s.sheen * (q.sheen_v / max3(s.sheen) * (1.0 - q.coat_v));
        light += sky_light(filtered_sky(s.n, SKY_LOBES), diffuse * above);
    }
    if (HAS_SPECULAR) {
        vec3 specular = s.metallic * fresnel_schlick(s.base, nv) + q.dielectric * q.albedo_v;
        if (HAS_OTHER_FACETS && (is_tinted(s) || has_film(s))) {
            float kept;
            specular = facet_reflectance(s, q.eta, nv, kept);
        }
        float alpha = is_brushed(s) ? sqrt(s.alpha * s.across) : s.alpha;
        light += sky_light(sky_over(lobe_direction(s.n, s.v, alpha), alpha), specular * under);
    }
    if (HAS_CLEARCOAT && q.coat_v > 0.0)
        light += sky_light(sky_over(lobe_direction(s.coat_normal, s.v, s.coat_alpha), s.coat_alpha), vec3(q.coat_v));
    // What lies behind a solid is seen through two of its surfaces at the least. It is taken to lie straight ahead.
    if (HAS_TRANSMISSION && s.transmission > 0.0) light += sky_light(sky_over(-s.v, s.alpha), s.base * (below * s.transmission));
    if (LAMPS > 0u) {
        q.transmit = 0.0;
        uint i = 0u;
        // It tests at its end, because software Vulkan runs a loop that tests at its start once more.
        do light += reflected(s, q, seen_from(lamp_of(i), s.p)); while (++i < LAMPS);
    }
    return clamp(light / frame.mean_light, vec3(LEAST_DIVISOR), vec3(MOST_DIVISOR));
}
