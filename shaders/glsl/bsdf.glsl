// The material model of docs/RENDERING.md: its value, its pdf, and samples of it.

// A surface with a smaller alpha is a mirror.
const float DELTA_ALPHA = 1e-3;

// Unpolarised Fresnel reflectance of a dielectric. `eta` is the index beyond the surface over the index on this side. The result is 1 at total
// reflection, and exactly 0 for eta = 1.
float fresnel_dielectric(float eta, float cosine) {
    float c = clamp(cosine, 0.0, 1.0);
    float g2 = eta * eta - 1.0 + c * c;
    if (g2 <= 0.0) return eta == 1.0 ? 0.0 : 1.0;
    if (eta == 1.0) return 0.0;
    float g = sqrt(g2);
    float a = (g - c) / (g + c);
    float b = (c * (g + c) - 1.0) / (c * (g - c) + 1.0);
    return clamp(0.5 * a * a * (1.0 + b * b), 0.0, 1.0);
}

vec3 fresnel_schlick(vec3 f0, float cosine) {
    float m = clamp(1.0 - cosine, 0.0, 1.0);
    float m2 = m * m;
    return f0 + (1.0 - f0) * (m2 * m2 * m);
}

float ggx_d(float alpha, vec3 n, vec3 h) {
    // The sine comes from the cross product, because 1 - (n.h)^2 would cancel near the peak of a small alpha.
    float a2 = alpha * alpha;
    float nh = clamp(dot(n, h), 0.0, 1.0);
    vec3 c = cross(n, h);
    float s2 = dot(c, c);
    float d = nh * nh * a2 + s2;
    return a2 / max(PI * d * d, 1e-30);
}

float smith_lambda(float alpha, float nx) {
    float c2 = nx * nx;
    float t2 = max(1.0 - c2, 0.0) / max(c2, 1e-12);
    return 0.5 * (sqrt(1.0 + alpha * alpha * t2) - 1.0);
}

mat3 frame_around(vec3 n) {
    float s = n.z < 0.0 ? -1.0 : 1.0;
    float a = -1.0 / (s + n.z);
    float b = n.x * n.y * a;
    return mat3(vec3(1.0 + s * n.x * n.x * a, s * b, -s * n.x), vec3(b, s + n.y * n.y * a, -n.y), n);
}

// A visible normal of GGX by the spherical cap [Dupuy23]. In the local frame, in which z is the normal and v.z > 0.
vec3 sample_visible_normal(vec3 v, float alpha, vec2 u) {
    vec3 w = normalize(vec3(alpha * v.xy, v.z));
    float phi = 2.0 * PI * u.x;
    float z = (1.0 - u.y) * (1.0 + w.z) - w.z;
    float r = sqrt(clamp(1.0 - z * z, 0.0, 1.0));
    vec3 h = vec3(r * cos(phi), r * sin(phi), z) + w;
    h = vec3(alpha * h.xy, max(h.z, 0.0));
    float l2 = dot(h, h);
    return l2 > 1e-20 ? h * inversesqrt(l2) : vec3(0.0, 0.0, 1.0);
}

struct Lobes {
    float specular; // Probabilities of the three lobes. Their sum is 1, or 0 if the surface absorbs everything.
    float diffuse;
    float transmit;
    float albedo_v; // E(n.v).
    float average;  // E_avg.
    float eta;      // Index beyond the surface over the index on this side.
    float dielectric;
};

bool mirror_like(Point s) { return s.alpha < DELTA_ALPHA; }

// The alpha for which the coat's albedo is looked up. A mirror reflects by Fresnel's law, which is row 0 of the table.
float coat_alpha(Point s) { return mirror_like(s) ? 0.0 : s.alpha; }

Lobes lobes_of(Point s) {
    Lobes l;
    float nv = dot(s.n, s.v);
    bool inside = !s.front && (s.flags & MATERIAL_THIN) == 0u && s.transmission > 0.0;
    l.eta = inside ? 1.0 / s.ior : s.ior;
    l.dielectric = 1.0 - s.metallic;
    l.albedo_v = 0.0;
    l.average = 0.0;
    float specular = 0.0, diffuse = 0.0, transmit = 0.0;
    if (inside) {
        // The facets of a rough surface may transmit light where the mean surface reflects it totally.
        float f = clamp(fresnel_dielectric(l.eta, nv), 0.05, mirror_like(s) ? 1.0 : 0.95);
        specular = f * l.dielectric + s.metallic;
        transmit = (1.0 - f) * l.dielectric * s.transmission;
    } else {
        if (HAS_SPECULAR) {
            l.albedo_v = l.dielectric > 0.0 ? directional_albedo(s.table, coat_alpha(s), nv) : 0.0;
            if (HAS_DIFFUSE) l.average = average_albedo(s.table, coat_alpha(s));
            specular = l.dielectric * l.albedo_v + (s.metallic > 0.0 ? s.metallic * luminance(fresnel_schlick(s.base, nv)) : 0.0);
        }
        float rest = l.dielectric * (1.0 - l.albedo_v) * luminance(s.base);
        diffuse = rest * (1.0 - s.transmission);
        transmit = rest * s.transmission;
    }
    if (!HAS_TRANSMISSION) transmit = 0.0;
    if (!HAS_DIFFUSE) diffuse = 0.0;
    float sum = specular + diffuse + transmit;
    float scale = sum > 1e-12 ? 1.0 / sum : 0.0;
    l.specular = specular * scale;
    l.diffuse = diffuse * scale;
    l.transmit = transmit * scale;
    return l;
}

// Value times |n.l|, and pdf, of the lobes that are not delta functions, for the direction `l`.
void evaluate(Point s, Lobes q, vec3 l, out vec3 value, out float pdf) {
    value = vec3(0.0);
    pdf = 0.0;
    float nv = dot(s.n, s.v), nl = dot(s.n, l), gl = dot(s.g, l);
    if (nl > 0.0 && gl > 0.0) {
        if (HAS_SPECULAR && q.specular > 0.0 && !mirror_like(s)) {
            vec3 h = normalize(s.v + l);
            float vh = clamp(dot(s.v, h), 0.0, 1.0);
            float d = ggx_d(s.alpha, s.n, h);
            float lv = smith_lambda(s.alpha, nv), ll = smith_lambda(s.alpha, nl);
            vec3 f = vec3(0.0);
            if (s.metallic > 0.0) f += s.metallic * fresnel_schlick(s.base, vh);
            if (q.dielectric > 0.0) f += q.dielectric * fresnel_dielectric(q.eta, vh);
            value += f * (d / ((1.0 + lv + ll) * 4.0 * nv));
            pdf += q.specular * d / ((1.0 + lv) * 4.0 * nv);
        }
        if (HAS_DIFFUSE && q.diffuse > 0.0) {
            float k = q.dielectric * (1.0 - s.transmission);
            if (HAS_SPECULAR) {
                k *= (1.0 - q.albedo_v) * (1.0 - directional_albedo(s.table, coat_alpha(s), nl)) / max(1.0 - q.average, 1e-4);
            }
            value += s.base * (k * nl / PI);
            pdf += q.diffuse * nl / PI;
        }
    } else if (HAS_TRANSMISSION && nl < 0.0 && gl < 0.0 && q.transmit > 0.0 && !mirror_like(s) && (s.flags & MATERIAL_THIN) == 0u) {
        // [Walter07] eq. 21, with the half vector on the side of v.
        vec3 h = normalize(s.v + l * q.eta);
        if (dot(h, s.n) < 0.0) h = -h;
        float vh = dot(s.v, h), lh = dot(l, h);
        if (vh > 0.0 && lh < 0.0) {
            float d = ggx_d(s.alpha, s.n, h);
            float lv = smith_lambda(s.alpha, nv), ll = smith_lambda(s.alpha, nl);
            float denominator = vh + q.eta * lh;
            float jacobian = q.eta * q.eta * abs(lh) / max(denominator * denominator, 1e-20);
            float f = fresnel_dielectric(q.eta, vh);
            // Radiance that crosses the surface toward the viewer is scaled by 1 / eta^2.
            value += s.base * (q.dielectric * s.transmission * (1.0 - f) * d * vh * jacobian / ((1.0 + lv + ll) * nv * q.eta * q.eta));
            pdf += q.transmit * d * vh * jacobian / ((1.0 + lv) * nv);
        }
    }
}

struct BsdfSample {
    vec3 direction;
    vec3 weight; // f |n.l| / pdf.
    float pdf;   // Over solid angle, of all lobes that are not delta functions. Not used for delta functions.
    bool delta;
    bool valid;
    bool below;  // The direction goes through the surface.
};

BsdfSample sample_bsdf(Point s, Lobes q, float u_lobe, vec2 u) {
    BsdfSample r;
    r.valid = false;
    r.delta = false;
    r.below = false;
    r.pdf = 0.0;
    r.weight = vec3(0.0);
    r.direction = s.n;
    if (q.specular + q.diffuse + q.transmit <= 0.0) return r;
    mat3 to_world = frame_around(s.n);
    vec3 v = vec3(dot(s.v, to_world[0]), dot(s.v, to_world[1]), dot(s.v, to_world[2]));
    float nv = v.z;
    bool mirror = mirror_like(s);
    if (u_lobe < q.specular) {
        if (mirror) {
            r.direction = reflect(-s.v, s.n);
            vec3 f = s.metallic * fresnel_schlick(s.base, nv) + q.dielectric * fresnel_dielectric(q.eta, nv);
            r.weight = f / q.specular;
            r.delta = true;
            r.valid = dot(r.direction, s.g) > 0.0;
            return r;
        }
        vec3 h = sample_visible_normal(v, s.alpha, u);
        r.direction = to_world * reflect(-v, h);
    } else if (u_lobe < q.specular + q.diffuse || !HAS_TRANSMISSION || q.transmit <= 0.0) {
        // Weighted by the cosine, by projection of a disk.
        float radius = sqrt(u.x), phi = 2.0 * PI * u.y;
        r.direction = to_world * vec3(radius * cos(phi), radius * sin(phi), sqrt(max(1.0 - u.x, 0.0)));
    } else {
        r.below = true;
        if ((s.flags & MATERIAL_THIN) != 0u) {
            r.direction = -s.v;
            r.weight = s.base * (q.dielectric * s.transmission * (1.0 - q.albedo_v) / q.transmit);
            r.delta = true;
            r.valid = true;
            return r;
        }
        vec3 h = mirror ? vec3(0.0, 0.0, 1.0) : sample_visible_normal(v, s.alpha, u);
        vec3 l = refract(-v, h, 1.0 / q.eta);
        if (dot(l, l) < 0.5) return r; // Total reflection. The specular lobe has it.
        r.direction = to_world * l;
        if (mirror) {
            float f = fresnel_dielectric(q.eta, nv);
            r.weight = s.base * (q.dielectric * s.transmission * (1.0 - f) / (q.eta * q.eta * q.transmit));
            r.delta = true;
            r.valid = dot(r.direction, s.g) < 0.0;
            return r;
        }
    }
    // A facet may send light to the wrong side. That light is lost, and is no sample of the lobe on that side.
    if ((dot(r.direction, s.n) < 0.0) != r.below) return r;
    vec3 value;
    evaluate(s, q, r.direction, value, r.pdf);
    r.valid = r.pdf > 1e-12;
    if (r.valid) r.weight = value / r.pdf;
    return r;
}
