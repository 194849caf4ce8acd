// The material model of docs/RENDERING.md: its value, its pdf, and samples of it.

// A surface with a smaller alpha is a mirror.
const float DELTA_ALPHA = 1e-3;
// Index of refraction of every clear coat.
const float COAT_IOR = 1.5;

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

// The same where the roughness differs along x and y.
vec3 sample_brushed_normal(vec3 v, vec2 alpha, vec2 u) {
    vec3 w = normalize(vec3(alpha * v.xy, v.z));
    float phi = 2.0 * PI * u.x;
    float z = (1.0 - u.y) * (1.0 + w.z) - w.z;
    float r = sqrt(clamp(1.0 - z * z, 0.0, 1.0));
    vec3 h = vec3(r * cos(phi), r * sin(phi), z) + w;
    h = vec3(alpha * h.xy, max(h.z, 0.0));
    float l2 = dot(h, h);
    return l2 > 1e-20 ? h * inversesqrt(l2) : vec3(0.0, 0.0, 1.0);
}

// The same where the roughness differs along a tangent and across it: `w` is a direction, local.
float brushed_d(vec2 alpha, vec3 h) {
    vec3 w = vec3(h.xy / alpha, h.z);
    float d = dot(w, w);
    return h.z > 0.0 ? 1.0 / max(PI * alpha.x * alpha.y * d * d, 1e-30) : 0.0;
}

float brushed_lambda(vec2 alpha, vec3 w) {
    vec2 a = alpha * w.xy;
    return 0.5 * (sqrt(1.0 + dot(a, a) / max(w.z * w.z, 1e-12)) - 1.0);
}

mat3 brushed_frame(Point s) { return mat3(s.tangent, cross(s.n, s.tangent), s.n); }

bool is_brushed(Point s) { return HAS_ANISOTROPY && s.across > 0.0; }

// D, and Smith's Lambda of v and l, of the base at a half vector.
vec3 facets(Point s, vec3 h, vec3 l) {
    if (is_brushed(s)) {
        mat3 frame = brushed_frame(s);
        vec2 alpha = vec2(s.alpha, s.across);
        return vec3(brushed_d(alpha, h * frame), brushed_lambda(alpha, s.v * frame), brushed_lambda(alpha, l * frame));
    }
    return vec3(ggx_d(s.alpha, s.n, h), smith_lambda(s.alpha, dot(s.n, s.v)), smith_lambda(s.alpha, abs(dot(s.n, l))));
}

struct Lobes {
    float specular; // Probabilities of the lobes. Their sum is 1, or 0 if the surface absorbs everything.
    float diffuse;
    float transmit;
    float coat;
    float sheen;
    float shine;
    float coat_v;   // What the coat keeps of light from v, and the sheen.
    float sheen_v;
    float albedo_v; // E(n.v).
    float average;  // E_avg.
    float eta;      // Index beyond the surface over the index on this side.
    float dielectric;
};

bool mirror_like(Point s) { return s.alpha < DELTA_ALPHA; }
bool coat_mirror_like(Point s) { return s.coat_alpha < DELTA_ALPHA; }

// The alpha for which the dielectric's albedo is looked up for light along `w`. A mirror reflects by Fresnel's law, which is row 0 of the table.
float table_alpha(Point s, vec3 w) {
    if (is_brushed(s)) {
        vec2 along = vec2(dot(s.tangent, w), dot(cross(s.n, s.tangent), w)), a = along * vec2(s.alpha, s.across);
        return sqrt(dot(a, a) / max(dot(along, along), 1e-12));
    }
    return mirror_like(s) ? 0.0 : s.alpha;
}

// Constants of facets whose reflectance is not that of their index alone.
const bool HAS_OTHER_FACETS = HAS_SPECULAR_COLOR || HAS_IRIDESCENCE;
bool is_tinted(Point s) { return HAS_SPECULAR_COLOR && (s.specular != 1.0 || s.specular_color != vec3(1.0)); }
bool has_film(Point s) { return HAS_IRIDESCENCE && s.film > 0.0; }

float index_to_f0(float a, float b) {
    float r = (a - b) / (a + b);
    return r * r;
}

// Reflectance of the dielectric at normal incidence, without a film.
vec3 dielectric_f0(Point s) {
    float f0 = index_to_f0(s.ior, 1.0);
    return HAS_SPECULAR_COLOR ? min(f0 * s.specular_color, vec3(1.0)) * s.specular : vec3(f0);
}

// The sensitivity of an eye, as linear sRGB, to light that a path of `opd` metres has shifted [Belcour17].
vec3 film_sensitivity(float opd, vec3 shift) {
    float phase = 2.0 * PI * opd, p2 = phase * phase;
    const vec3 val = vec3(5.4856e-13, 4.4201e-13, 5.2481e-13), pos = vec3(1.6810e+06, 1.7953e+06, 2.2084e+06),
               var = vec3(4.3278e+09, 9.3046e+09, 6.6121e+09);
    // One column for each of the channels of `shift`.
    vec3 rgb = vec3(0.0);
    for (int i = 0; i < 3; i++) {
        vec3 xyz = val * sqrt(2.0 * PI * var) * cos(pos * phase + shift[i]) * exp(-var * p2);
        xyz.x += 9.7470e-14 * sqrt(2.0 * PI * 4.5282e+09) * cos(2.2399e+06 * phase + shift[i]) * exp(-4.5282e+09 * p2);
        xyz /= 1.0685e-7;
        const vec3 rows[3] = vec3[](vec3(3.2404542, -1.5371385, -0.4985314), vec3(-0.9692660, 1.8760108, 0.0415560), vec3(0.0556434, -0.2040259, 1.0572252));
        rgb[i] = dot(rows[i], xyz);
    }
    return rgb;
}

// Reflectance of a film of a thickness in nanometres on a base of reflectance `f0`, at the cosine `c` outside [Belcour17], as KHR_materials_iridescence
// has it.
vec3 film_reflectance(vec3 f0, float ior, float nm, float c) {
    float film = mix(1.0, ior, smoothstep(0.0, 0.03, nm));
    float inner2 = 1.0 - (1.0 - c * c) / (film * film);
    if (inner2 < 0.0) return vec3(1.0);
    float inner = sqrt(inner2);
    // Schlick's law would let no interface at all reflect everything at grazing angles.
    float r12 = fresnel_dielectric(film, c), t121 = 1.0 - r12;
    vec3 root = sqrt(clamp(f0, vec3(0.0), vec3(0.9999))), base = (1.0 + root) / (1.0 - root);
    vec3 r1 = (base - film) / (base + film);
    vec3 r23 = fresnel_schlick(r1 * r1, inner);
    vec3 shift = PI + mix(vec3(0.0), vec3(PI), lessThan(base, vec3(film)));
    float opd = 2e-9 * film * nm * inner;
    vec3 r123 = min(r12 * r23, vec3(0.9999)), amplitude = sqrt(r123);
    vec3 rs = t121 * t121 * r23 / (1.0 - r123);
    vec3 sum = r12 + rs, cm = rs - t121;
    for (int m = 1; m <= 2; m++) {
        cm *= amplitude;
        sum += cm * 2.0 * film_sensitivity(float(m) * opd, float(m) * shift);
    }
    return clamp(sum, vec3(0.0), vec3(1.0));
}

// By how much the film changes the reflectance at the cosine `c` on this side.
vec3 film_change(Point s, float eta, float c) {
    // From within the film has the same reflectance as at the refracted direction outside.
    float outside = eta < 1.0 ? sqrt(max(1.0 - (1.0 - c * c) / (eta * eta), 0.0)) : c;
    vec3 f0 = mix(dielectric_f0(s), s.base, s.metallic);
    return s.film * (film_reflectance(f0, MATERIAL_AT(s.material).film_ior, s.film_nm, outside) - fresnel_schlick(f0, outside));
}

// What the film changes of the light that facets of a width reflect toward a cosine, in its strongest channel: the mean of four facets that light
// from there sees.
float film_change_of(Point s, float alpha, float mu) {
    vec3 v = vec3(sqrt(max(1.0 - mu * mu, 0.0)), 0.0, mu), sum = vec3(0.0);
    for (int i = 0; i < 4; i++) {
        vec3 h = sample_visible_normal(v, max(alpha, 1e-4), vec2(i < 2 ? 0.125 : 0.375, (i & 1) == 0 ? 0.25 : 0.75));
        sum += film_change(s, s.ior, clamp(dot(v, h), 0.0, 1.0));
    }
    return 0.25 * max3(sum);
}

// Reflectance of a facet at the cosine `c`: of metal and dielectric together, and in `kept` what the dielectric does not let pass of its share.
vec3 facet_reflectance(Point s, float eta, float c, out float kept) {
    float f = fresnel_dielectric(eta, c), dielectric = 1.0 - s.metallic;
    vec3 plain = vec3(f);
    if (is_tinted(s) && f < 1.0) {
        // Fresnel's law in place of Schlick's power.
        float f0 = index_to_f0(s.ior, 1.0), rise = f0 < 1.0 ? clamp((f - f0) / (1.0 - f0), 0.0, 1.0) : 1.0;
        plain = mix(min(f0 * s.specular_color, vec3(1.0)), vec3(1.0), s.ior == 1.0 ? 0.0 : rise) * s.specular;
    }
    vec3 change = has_film(s) && f < 1.0 ? film_change(s, eta, c) : vec3(0.0);
    kept = clamp(max3(plain + change), 0.0, 1.0);
    return clamp(s.metallic * fresnel_schlick(s.base, c) + dielectric * plain + change, vec3(0.0), vec3(1.0));
}

// What the dielectric reflects of light from a direction `w` at the cosine `mu`: the most of any channel.
float dielectric_albedo(Point s, vec3 w, float mu) {
    float alpha = table_alpha(s, w), e = directional_albedo(s.table, alpha, mu);
    if (HAS_OTHER_FACETS && (is_tinted(s) || has_film(s))) {
        float all = directional_albedo(MATERIAL_AT(s.material).white_table, alpha, mu);
        if (is_tinted(s)) {
            float f0 = index_to_f0(s.ior, 1.0), tinted = min(f0 * max3(s.specular_color), 1.0);
            e = s.specular * (tinted * all + (1.0 - tinted) * (f0 < 1.0 ? max(e - f0 * all, 0.0) / (1.0 - f0) : 0.0));
        }
        if (has_film(s)) e = clamp(e + all * film_change_of(s, alpha, mu), 0.0, 1.0);
    }
    return e;
}

float dielectric_average_at(Point s, float alpha) {
    float e = average_albedo(s.table, alpha);
    if (is_tinted(s)) {
        float all = average_albedo(MATERIAL_AT(s.material).white_table, alpha);
        float f0 = index_to_f0(s.ior, 1.0), tinted = min(f0 * max3(s.specular_color), 1.0);
        e = s.specular * (tinted * all + (1.0 - tinted) * (f0 < 1.0 ? max(e - f0 * all, 0.0) / (1.0 - f0) : 0.0));
    }
    if (has_film(s)) {
        // What the film changes of it, by three nodes.
        for (int i = 0; i < 3; i++) {
            float mu = i == 0 ? 0.11270167 : i == 1 ? 0.5 : 0.88729833;
            e += 2.0 * mu * (i == 1 ? 8.0 : 5.0) / 18.0 * directional_albedo(MATERIAL_AT(s.material).white_table, alpha, mu) * film_change_of(s, alpha, mu);
        }
        e = clamp(e, 0.0, 1.0);
    }
    return e;
}

// The mean of the same over all directions, weighted by their cosines.
float dielectric_average(Point s) {
    if (is_brushed(s)) {
        float between = sqrt(0.5 * (s.alpha * s.alpha + s.across * s.across));
        return 0.25 * (dielectric_average_at(s, s.alpha) + dielectric_average_at(s, s.across)) + 0.5 * dielectric_average_at(s, between);
    }
    return dielectric_average_at(s, table_alpha(s, s.v));
}

// The share of what enters the base by the two directions of its diffuse light.
float into_base(Point s, Lobes q, vec3 l, float nl) {
    return (1.0 - q.albedo_v) * (1.0 - dielectric_albedo(s, l, nl)) / max(1.0 - q.average, 1e-4);
}

// What the layers let through of light between v and l.
struct Through {
    float spread; // Of light that the base sends in all directions, so that the coat is left by as much as enters it.
    float ahead;  // Of light in one direction: as the worse of both ways.
    float coat;   // The same without the sheen.
};

Through through_layers(Point s, Lobes q, vec3 l) {
    Through t = Through(1.0, 1.0, 1.0);
    if (HAS_CLEARCOAT && q.coat_v > 0.0) {
        float row = mirror_row(s.coat_alpha);
        uint table = MATERIAL_AT(s.material).coat_table;
        float a = 1.0 - q.coat_v, b = 1.0 - s.coat * directional_albedo(table, row, abs(dot(s.coat_normal, l)));
        t.spread = a * b / max(1.0 - s.coat * average_albedo(table, row), 1e-4);
        t.coat = min(a, b);
    }
    float sheen = 1.0;
    if (HAS_SHEEN && q.sheen_v > 0.0)
        sheen = min(1.0 - q.sheen_v, 1.0 - max3(s.sheen) * directional_albedo(MATERIAL_AT(s.material).sheen_table + 1u, s.sheen_alpha, abs(dot(s.n, l))));
    t.spread *= sheen;
    t.ahead = t.coat * sheen;
    return t;
}

// Shadowing of fibres [Estevez17].
float sheen_fit(float x, float alpha) {
    float t = (1.0 - alpha) * (1.0 - alpha);
    float a = mix(21.5473, 25.3245, t), b = mix(3.82987, 3.32435, t), c = mix(0.19823, 0.16801, t), d = mix(-1.97760, -1.27393, t), e = mix(-4.32054, -4.85967, t);
    return a / (1.0 + b * pow(max(x, 1e-12), c)) + d * x + e;
}

float sheen_lambda(float c, float alpha) {
    return exp(c < 0.5 ? sheen_fit(c, alpha) : 2.0 * sheen_fit(0.5, alpha) - sheen_fit(1.0 - c, alpha));
}

// Value of a white sheen times n.l.
float sheen_value(Point s, vec3 l, float nv, float nl) {
    vec3 h = normalize(s.v + l), c = cross(s.n, h);
    float sine2 = clamp(dot(c, c), 1e-30, 1.0);
    float d = (2.0 + 1.0 / s.sheen_alpha) * pow(sine2, 0.5 / s.sheen_alpha) / (2.0 * PI);
    // At grazing angles the fit would send out more than it gets.
    uint fitted = MATERIAL_AT(s.material).sheen_table;
    float most = max(directional_albedo(fitted, s.sheen_alpha, nv), directional_albedo(fitted, s.sheen_alpha, nl));
    return d / (max(most, 1.0) * (1.0 + sheen_lambda(nv, s.sheen_alpha) + sheen_lambda(nl, s.sheen_alpha)) * 4.0 * nv);
}

// A solid seen from within. Neither coat nor sheen is there.
bool is_inside(Point s) { return !s.front && (s.flags & MATERIAL_THIN) == 0u && s.transmission > 0.0; }

Lobes lobes_of(Point s) {
    Lobes l;
    float nv = dot(s.n, s.v);
    bool inside = is_inside(s);
    l.eta = inside ? 1.0 / s.ior : s.ior;
    l.dielectric = 1.0 - s.metallic;
    l.albedo_v = 0.0;
    l.average = 0.0;
    float specular = 0.0, diffuse = 0.0, transmit = 0.0;
    if (inside) {
        // The facets of a rough surface may transmit light where the mean surface reflects it totally.
        float f = fresnel_dielectric(l.eta, nv);
        if (HAS_OTHER_FACETS && (is_tinted(s) || has_film(s))) facet_reflectance(s, l.eta, nv, f);
        f = clamp(f, 0.05, mirror_like(s) ? 1.0 : 0.95);
        specular = f * l.dielectric + s.metallic;
        transmit = (1.0 - f) * l.dielectric * s.transmission;
    } else {
        if (HAS_SPECULAR) {
            l.albedo_v = l.dielectric > 0.0 ? dielectric_albedo(s, s.v, nv) : 0.0;
            if (HAS_DIFFUSE) l.average = dielectric_average(s);
            specular = l.dielectric * l.albedo_v + (s.metallic > 0.0 ? s.metallic * luminance(fresnel_schlick(s.base, nv)) : 0.0);
        }
        float rest = l.dielectric * (1.0 - l.albedo_v) * luminance(s.base);
        diffuse = rest * (1.0 - s.transmission);
        transmit = rest * s.transmission;
    }
    if (!HAS_TRANSMISSION) transmit = 0.0;
    if (!HAS_DIFFUSE) diffuse = 0.0;
    float coat = 0.0, sheen = 0.0, shine = 0.0;
    l.coat_v = 0.0;
    l.sheen_v = 0.0;
    if (HAS_DIFFUSE_TRANSMISSION && HAS_DIFFUSE && !inside && s.shine > 0.0) {
        shine = l.dielectric * (1.0 - l.albedo_v) * (1.0 - s.transmission) * s.shine * luminance(s.shine_color);
        diffuse *= 1.0 - s.shine;
    }
    if (HAS_SHEEN && !inside && max3(s.sheen) > 0.0) {
        float albedo = directional_albedo(MATERIAL_AT(s.material).sheen_table + 1u, s.sheen_alpha, nv);
        l.sheen_v = max3(s.sheen) * albedo;
        sheen = luminance(s.sheen) * albedo;
        float under = 1.0 - l.sheen_v;
        specular *= under;
        diffuse *= under;
        transmit *= under;
        shine *= under;
    }
    if (HAS_CLEARCOAT && !inside && s.coat > 0.0) {
        l.coat_v = s.coat * directional_albedo(MATERIAL_AT(s.material).coat_table, mirror_row(s.coat_alpha), dot(s.coat_normal, s.v));
        coat = l.coat_v;
        float under = 1.0 - l.coat_v;
        specular *= under;
        diffuse *= under;
        transmit *= under;
        shine *= under;
        sheen *= under;
    }
    float sum = specular + diffuse + transmit;
    if (HAS_CLEARCOAT) sum += coat;
    if (HAS_SHEEN) sum += sheen;
    if (HAS_DIFFUSE_TRANSMISSION) sum += shine;
    float scale = sum > 1e-12 ? 1.0 / sum : 0.0;
    l.specular = specular * scale;
    l.diffuse = diffuse * scale;
    l.transmit = transmit * scale;
    l.coat = coat * scale;
    l.sheen = sheen * scale;
    l.shine = shine * scale;
    return l;
}

// Whether no lobe is sampled by more than a direction: light that is sampled has no part then.
bool only_deltas(Point s, Lobes q) {
    bool only = mirror_like(s) && q.diffuse <= 0.0;
    if (HAS_SHEEN) only = only && q.sheen <= 0.0;
    if (HAS_DIFFUSE_TRANSMISSION) only = only && q.shine <= 0.0;
    if (HAS_CLEARCOAT) only = only && (q.coat <= 0.0 || coat_mirror_like(s));
    return only;
}

// Value times |n.l|, and pdf, of the lobes that are not delta functions, for the direction `l`.
void evaluate(Point s, Lobes q, vec3 l, out vec3 value, out float pdf) {
    value = vec3(0.0);
    pdf = 0.0;
    float nv = dot(s.n, s.v), nl = dot(s.n, l), gl = dot(s.g, l);
    Through through = Through(1.0, 1.0, 1.0);
    if (HAS_CLEARCOAT || HAS_SHEEN) through = through_layers(s, q, l);
    if (nl > 0.0 && gl > 0.0) {
        if (HAS_SPECULAR && q.specular > 0.0 && !mirror_like(s)) {
            vec3 h = normalize(s.v + l);
            float vh = clamp(dot(s.v, h), 0.0, 1.0);
            vec3 facet = facets(s, h, l);
            float d = facet.x, lv = facet.y, ll = facet.z;
            vec3 f = vec3(0.0);
            if (s.metallic > 0.0) f += s.metallic * fresnel_schlick(s.base, vh);
            if (q.dielectric > 0.0) f += q.dielectric * fresnel_dielectric(q.eta, vh);
            if (HAS_OTHER_FACETS && (is_tinted(s) || has_film(s))) {
                float kept;
                f = facet_reflectance(s, q.eta, vh, kept);
            }
            if (HAS_CLEARCOAT || HAS_SHEEN) f *= through.ahead;
            value += f * (d / ((1.0 + lv + ll) * 4.0 * nv));
            pdf += q.specular * d / ((1.0 + lv) * 4.0 * nv);
        }
        if (HAS_DIFFUSE && q.diffuse > 0.0) {
            float k = q.dielectric * (1.0 - s.transmission);
            if (HAS_SPECULAR) k *= into_base(s, q, l, nl);
            if (HAS_DIFFUSE_TRANSMISSION) k *= 1.0 - s.shine;
            if (HAS_CLEARCOAT || HAS_SHEEN) k *= through.spread;
            value += s.base * (k * nl / PI);
            pdf += q.diffuse * nl / PI;
        }
        if (HAS_SHEEN && q.sheen > 0.0) {
            float k = sheen_value(s, l, nv, nl);
            if (HAS_CLEARCOAT) k *= through.coat;
            value += s.sheen * k;
            pdf += q.sheen / (2.0 * PI);
        }
    } else if (HAS_TRANSMISSION && nl < 0.0 && gl < 0.0 && q.transmit > 0.0 && !mirror_like(s) && (s.flags & MATERIAL_THIN) == 0u) {
        // [Walter07] eq. 21, with the half vector on the side of v.
        vec3 h = normalize(s.v + l * q.eta);
        if (dot(h, s.n) < 0.0) h = -h;
        float vh = dot(s.v, h), lh = dot(l, h);
        if (vh > 0.0 && lh < 0.0) {
            vec3 facet = facets(s, h, l);
            float d = facet.x, lv = facet.y, ll = facet.z;
            float denominator = vh + q.eta * lh;
            float jacobian = q.eta * q.eta * abs(lh) / max(denominator * denominator, 1e-20);
            float f = fresnel_dielectric(q.eta, vh);
            if (HAS_OTHER_FACETS && (is_tinted(s) || has_film(s))) facet_reflectance(s, q.eta, vh, f);
            // Radiance that crosses the surface toward the viewer is scaled by 1 / eta^2.
            value += s.base * (q.dielectric * s.transmission * (1.0 - f) * d * vh * jacobian / ((1.0 + lv + ll) * nv * q.eta * q.eta));
            // What was let in from the outside was let through by the layers there.
            if (HAS_CLEARCOAT || HAS_SHEEN) value *= (1.0 - q.coat_v) * (1.0 - q.sheen_v);
            pdf += q.transmit * d * vh * jacobian / ((1.0 + lv) * nv);
        }
    }
    if (HAS_DIFFUSE_TRANSMISSION && q.shine > 0.0 && nl < 0.0 && gl < 0.0) {
        float k = q.dielectric * (1.0 - s.transmission) * s.shine;
        if (HAS_SPECULAR) k *= into_base(s, q, l, -nl);
        if (HAS_CLEARCOAT || HAS_SHEEN) k *= through.spread;
        value += s.shine_color * (k * -nl / PI);
        pdf += q.shine * -nl / PI;
    }
    float cl = HAS_CLEARCOAT ? dot(s.coat_normal, l) : 0.0;
    if (HAS_CLEARCOAT && q.coat > 0.0 && !coat_mirror_like(s) && cl > 0.0 && gl > 0.0) {
        vec3 h = normalize(s.v + l);
        float d = ggx_d(s.coat_alpha, s.coat_normal, h), cv = dot(s.coat_normal, s.v);
        float lv = smith_lambda(s.coat_alpha, cv), ll = smith_lambda(s.coat_alpha, cl);
        value += s.coat * fresnel_dielectric(COAT_IOR, clamp(dot(s.v, h), 0.0, 1.0)) * d / ((1.0 + lv + ll) * 4.0 * cv);
        pdf += q.coat * d / ((1.0 + lv) * 4.0 * cv);
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

vec3 sample_facet(Point s, vec3 v, vec2 u) {
    if (is_brushed(s)) return sample_brushed_normal(v, vec2(s.alpha, s.across), u);
    return sample_visible_normal(v, s.alpha, u);
}

BsdfSample sample_bsdf(Point s, Lobes q, float u_lobe, vec2 u) {
    BsdfSample r;
    r.valid = false;
    r.delta = false;
    r.below = false;
    r.pdf = 0.0;
    r.weight = vec3(0.0);
    r.direction = s.n;
    float sum = q.specular + q.diffuse + q.transmit;
    if (HAS_CLEARCOAT) sum += q.coat;
    if (HAS_SHEEN) sum += q.sheen;
    if (HAS_DIFFUSE_TRANSMISSION) sum += q.shine;
    if (sum <= 0.0) return r;
    mat3 to_world = frame_around(s.n);
    if (is_brushed(s)) to_world = brushed_frame(s);
    vec3 v = vec3(dot(s.v, to_world[0]), dot(s.v, to_world[1]), dot(s.v, to_world[2]));
    float nv = v.z;
    bool mirror = mirror_like(s), by_coat = false;
    // Where the number lies behind the lobes that every surface may have.
    float behind = u_lobe - q.specular - q.diffuse;
    if (u_lobe < q.specular) {
        if (mirror) {
            r.direction = reflect(-s.v, s.n);
            vec3 f = s.metallic * fresnel_schlick(s.base, nv) + q.dielectric * fresnel_dielectric(q.eta, nv);
            if (HAS_OTHER_FACETS && (is_tinted(s) || has_film(s))) {
                float kept;
                f = facet_reflectance(s, q.eta, nv, kept);
            }
            if (HAS_CLEARCOAT || HAS_SHEEN) f *= through_layers(s, q, r.direction).ahead;
            r.weight = f / q.specular;
            r.delta = true;
            r.valid = dot(r.direction, s.g) > 0.0;
            return r;
        }
        vec3 h = sample_facet(s, v, u);
        r.direction = to_world * reflect(-v, h);
    } else if (HAS_CLEARCOAT && behind >= 0.0 && behind < q.coat) {
        by_coat = true;
        mat3 frame = frame_around(s.coat_normal);
        vec3 seen = s.v * frame;
        if (coat_mirror_like(s)) {
            r.direction = reflect(-s.v, s.coat_normal);
            r.weight = vec3(s.coat * fresnel_dielectric(COAT_IOR, seen.z) / q.coat);
            r.delta = true;
            r.valid = dot(r.direction, s.g) > 0.0;
            return r;
        }
        r.direction = frame * reflect(-seen, sample_visible_normal(seen, s.coat_alpha, u));
    } else if (HAS_SHEEN && behind >= q.coat && behind < q.coat + q.sheen) {
        // Fibres reflect most at grazing angles, so every direction is as likely.
        float radius = sqrt(max(u.x * (2.0 - u.x), 0.0)), phi = 2.0 * PI * u.y;
        r.direction = to_world * vec3(radius * cos(phi), radius * sin(phi), 1.0 - u.x);
    } else if (HAS_DIFFUSE_TRANSMISSION && behind >= q.coat + q.sheen && behind < q.coat + q.sheen + q.shine) {
        r.below = true;
        float radius = sqrt(u.x), phi = 2.0 * PI * u.y;
        r.direction = to_world * vec3(radius * cos(phi), radius * sin(phi), -sqrt(max(1.0 - u.x, 0.0)));
    } else if (u_lobe < q.specular + q.diffuse || !HAS_TRANSMISSION || q.transmit <= 0.0) {
        // Weighted by the cosine, by projection of a disk.
        float radius = sqrt(u.x), phi = 2.0 * PI * u.y;
        r.direction = to_world * vec3(radius * cos(phi), radius * sin(phi), sqrt(max(1.0 - u.x, 0.0)));
    } else {
        r.below = true;
        if ((s.flags & MATERIAL_THIN) != 0u) {
            r.direction = -s.v;
            r.weight = s.base * (q.dielectric * s.transmission * (1.0 - q.albedo_v) / q.transmit);
            if (HAS_CLEARCOAT || HAS_SHEEN) r.weight *= (1.0 - q.coat_v) * (1.0 - q.sheen_v);
            r.delta = true;
            r.valid = true;
            return r;
        }
        vec3 h = mirror ? vec3(0.0, 0.0, 1.0) : sample_facet(s, v, u);
        vec3 l = refract(-v, h, 1.0 / q.eta);
        if (dot(l, l) < 0.5) return r; // Total reflection. The specular lobe has it.
        r.direction = to_world * l;
        if (mirror) {
            float f = fresnel_dielectric(q.eta, nv);
            if (HAS_OTHER_FACETS && (is_tinted(s) || has_film(s))) facet_reflectance(s, q.eta, nv, f);
            r.weight = s.base * (q.dielectric * s.transmission * (1.0 - f) / (q.eta * q.eta * q.transmit));
            if (HAS_CLEARCOAT || HAS_SHEEN) r.weight *= (1.0 - q.coat_v) * (1.0 - q.sheen_v);
            r.delta = true;
            r.valid = dot(r.direction, s.g) < 0.0;
            return r;
        }
    }
    // A facet may send light to the wrong side. That light is lost, and is no sample of the lobe on that side.
    if ((dot(r.direction, by_coat ? s.coat_normal : s.n) < 0.0) != r.below) return r;
    vec3 value;
    evaluate(s, q, r.direction, value, r.pdf);
    r.valid = r.pdf > 1e-12;
    if (r.valid) r.weight = value / r.pdf;
    return r;
}
