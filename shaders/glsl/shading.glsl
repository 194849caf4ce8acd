// A hit into a shading point: its position, its normals, and the material there.

struct Point {
    vec3 p;         // Position, world space.
    vec3 g;         // Geometric normal on the side of v.
    vec3 n;         // Shading normal on the side of v.
    vec3 v;         // Unit direction toward the viewer, or toward the vertex before.
    bool front;     // v is on the outside.
    vec3 base;
    float metallic;
    float alpha;    // Roughness of GGX.
    float ior;
    float transmission;
    vec3 emitted;   // Radiance toward v.
    uint flags;
    uint table;
    uint light;     // Index in the light table.
    float offset;   // Distance from the surface at which a new ray starts.
    uint body;
    uint row;       // The first of its triangle's rows.
    // Lobes that few materials have. Without them these are constants, and compiled away.
    uint material;
    float coverage;       // Share of the surface that is there.
    float coat;           // Strength of the clear coat.
    float coat_alpha;
    vec3 coat_normal;     // On the side of v.
    float across;         // Roughness of GGX across the tangent, where it is `alpha` along it; 0: the same everywhere.
    vec3 tangent;         // Unit, across n.
    float specular;       // Strength and colour of the dielectric reflection; 1 and white: as the index says.
    vec3 specular_color;
    vec3 sheen;
    float sheen_alpha;
    float film;           // Strength of the thin film.
    float film_nm;
    float shine;          // Share of the diffuse light that leaves on the other side, and its colour.
    vec3 shine_color;
    vec3 absorption;      // Of the solid behind the outside, per metre.
    float dispersion;
};

float max3(vec3 v) { return max(v.x, max(v.y, v.z)); }

// A sheen is no narrower.
const float LEAST_SHEEN_ALPHA = 1e-3;
// A surface that is rougher along one direction is no smoother than this across it.
const float LEAST_BRUSHED_ALPHA = 1e-3;

// Where two neighbours of one axis of a texture lie.
uvec2 wrap_texels(int x, uint size, uint mode) {
    int n = int(size), period = mode == 2u ? 2 * n : n;
    int m = clamp(x - int(floor(float(x) / float(period))) * period, 0, period - 1);
    ivec2 both = ivec2(m, m + 1 < period ? m + 1 : 0);
    both = mix(both, 2 * n - 1 - both, greaterThanEqual(both, ivec2(n)));
    return uvec2(mode == 1u ? clamp(ivec2(x, x + 1), 0, n - 1) : both);
}

vec4 texel(TextureInfo info, uint x, uint y) {
    uvec2 w = texel_at(info.offset + y * info.width + x).shares;
    return vec4(unpackUnorm2x16(w.x), unpackUnorm2x16(w.y));
}

vec4 sample_texture(TextureUse use, vec2 uv) {
    TextureInfo info = texture_at(use.texture);
    vec2 st = vec2(dot(use.row_u, vec3(uv, 1.0)), dot(use.row_v, vec3(uv, 1.0))) * vec2(info.width, info.height);
    // Coordinates that are very large or not finite must not overflow the conversion to integers.
    st = clamp(st, vec2(-1.0e6), vec2(1.0e6));
    // Of a texture that is not interpolated, the neighbours have no share.
    bool nearest = (info.flags & 32u) != 0u;
    if (!nearest) st -= 0.5;
    vec2 base = floor(st), f = nearest ? vec2(0.0) : st - base;
    uvec2 x = wrap_texels(int(base.x), info.width, info.flags & 3u), y = wrap_texels(int(base.y), info.height, (info.flags >> 2u) & 3u);
    return mix(mix(texel(info, x.x, y.x), texel(info, x.y, y.x), f.x), mix(texel(info, x.x, y.y), texel(info, x.y, y.y), f.x), f.y);
}

vec2 interpolate_uv(TriangleRef ref, vec2 b) {
    return vertex_at(ref.vertices.x).uv * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).uv * b.x + vertex_at(ref.vertices.z).uv * b.y;
}

#ifdef CHANCE_OF_COVERAGE
// Defined by the shader that includes this file: whether a ray meets a triangle whose alpha is the share of it that is there.
bool is_covered(float alpha, uint instance, uint triangle);
#endif

bool alpha_present(uint instance, uint triangle, vec2 barycentric) {
    TriangleRef ref = triangle_ref_at(instance_at(instance).triangle_offset + triangle);
    float cutoff = material_at(ref.material).alpha_cutoff;
    if (cutoff < 0.0) return true;
    float a = material_at(ref.material).alpha;
    if (HAS_TEXTURES && material_at(ref.material).base_color_texture.texture != NO_TEXTURE)
        a *= sample_texture(material_at(ref.material).base_color_texture, interpolate_uv(ref, barycentric)).a;
#ifdef CHANCE_OF_COVERAGE
    if (HAS_ALPHA_BLEND && (material_at(ref.material).flags & MATERIAL_BLEND) != 0u) return is_covered(a, instance, triangle);
#endif
    return a >= cutoff;
}

// Position of a hit, in the body's space.
vec3 object_position(uint instance, uint triangle, vec2 b) {
    uint row = (BODY_AT(instance).triangle_offset + triangle) * 3u;
    vec3 p0 = TRI(row).xyz;
    return p0 + b.x * (TRI(row + 1u).xyz - p0) + b.y * (TRI(row + 2u).xyz - p0);
}

vec3 object_normal(uint instance, uint triangle) {
    uint row = (BODY_AT(instance).triangle_offset + triangle) * 3u;
    vec3 p0 = TRI(row).xyz;
    return normalize(cross(TRI(row + 1u).xyz - p0, TRI(row + 2u).xyz - p0));
}

// A distance larger than the rounding of the hit's position and of the transforms into the body's space and back.
float surface_offset(vec3 p, uint instance) {
    return 1.9e-6 * (max(abs(p.x), max(abs(p.y), abs(p.z))) + BODY_AT(instance).extent);
}

// The albedo E of docs/RENDERING.md, with nodes at (i / 31)^2 of alpha and of mu. A row has the cells between two alphas, and each of its cells lies
// between two mus. The row after the last has E_avg, with cells between two alphas.
const uint ALBEDO_CELLS = ALBEDO_TABLE_SIZE - 1u;
uint albedo_row(uint table, uint row) { return (table * ALBEDO_TABLE_SIZE + row) * ALBEDO_CELLS; }

// The place of alpha or mu among the nodes: the lower node, and the distance beyond it.
void albedo_position(float v, out uint node, out float beyond) {
    float x = sqrt(clamp(v, 0.0, 1.0)) * float(ALBEDO_CELLS);
    node = min(uint(x), ALBEDO_CELLS - 1u);
    beyond = x - float(node);
}

float directional_albedo(uint table, float alpha, float mu) {
    uint row, column;
    float above, beside;
    albedo_position(alpha, row, above);
    albedo_position(mu, column, beside);
    vec4 e = albedo_cell_at(albedo_row(table, row) + column).corners;
    return mix(mix(e.x, e.y, beside), mix(e.z, e.w, beside), above);
}

float average_albedo(uint table, float alpha) {
    uint row;
    float above;
    albedo_position(alpha, row, above);
    vec4 e = albedo_cell_at(albedo_row(table, ALBEDO_CELLS) + row).corners;
    return mix(e.x, e.y, above);
}

// Whether a ray that starts on the outside of a triangle surely does not meet the triangle's body again: it is above the horizon that `horizons` of the
// host found. `row` is the first of the triangle's rows, and `normal` is of unit length.
bool leaves_body(uint body, uint row, vec3 normal, vec3 direction) {
#if defined(TEXEL_TABLES) && !defined(WALK_APART)
    // Horizons are not worked out for software Vulkan, unless the host walks.
    return false;
#else
    vec3 d = transform_vector(BODY_AT(body).object_from_world, direction), a = abs(d);
    uint largest = a.x >= a.y && a.x >= a.z ? 0u : a.y >= a.z ? 1u : 2u;
    uint octant = (d.x < 0.0 ? 1u : 0u) | (d.y < 0.0 ? 2u : 0u) | (d.z < 0.0 ? 4u : 0u);
    uint steps = (floatBitsToUint(TRI(row + largest).w) >> (4u * octant)) & 15u;
    return steps < HORIZON_STEPS && dot(direction, normal) * float(HORIZON_STEPS) > float(steps) * length(direction);
#endif
}

float factor_of(TextureUse use, vec2 uv, uint channel) {
    return HAS_TEXTURES && use.texture != NO_TEXTURE ? sample_texture(use, uv)[channel] : 1.0;
}

vec3 color_of(TextureUse use, vec2 uv) {
    return HAS_TEXTURES && use.texture != NO_TEXTURE ? sample_texture(use, uv).rgb : vec3(1.0);
}

// The nearest direction to `n` for which `v` is just above the surface; `other` where there is none.
vec3 bend_toward(vec3 n, vec3 v, vec3 other) {
    float nv = dot(n, v);
    if (nv >= 1e-3) return n;
    vec3 across = n - nv * v;
    float l2 = dot(across, across);
    return l2 > 1e-12 ? across * (sqrt(1.0 - 1e-6) * inversesqrt(l2)) + 1e-3 * v : other;
}

float coat_alpha_of(uint m, vec2 uv) {
    float roughness = MATERIAL_AT(m).coat_roughness * factor_of(MATERIAL_AT(m).coat_roughness_texture, uv, 1u);
    return max(roughness * roughness, 1e-4);
}

float sheen_alpha_of(uint m, vec2 uv) {
    float roughness = MATERIAL_AT(m).sheen_roughness * factor_of(MATERIAL_AT(m).sheen_roughness_texture, uv, 3u);
    return max(roughness * roughness, LEAST_SHEEN_ALPHA);
}

// A mirror reflects by Fresnel's law, which is row 0 of the table.
float mirror_row(float alpha) { return alpha < 1e-3 ? 0.0 : alpha; }

// What coat and sheen let through of the light that a surface emits at a cosine to its geometric normal.
float emission_through_layers(uint m, vec2 uv, float mu) {
    float through = 1.0;
    if (HAS_CLEARCOAT && MATERIAL_AT(m).coat > 0.0) {
        float coat = MATERIAL_AT(m).coat * factor_of(MATERIAL_AT(m).coat_texture, uv, 0u);
        through -= coat * directional_albedo(MATERIAL_AT(m).coat_table, mirror_row(coat_alpha_of(m, uv)), mu);
    }
    if (HAS_SHEEN && max3(MATERIAL_AT(m).sheen_color) > 0.0) {
        float sheen = max3(MATERIAL_AT(m).sheen_color * color_of(MATERIAL_AT(m).sheen_color_texture, uv));
        through *= 1.0 - sheen * directional_albedo(MATERIAL_AT(m).sheen_table + 1u, sheen_alpha_of(m, uv), mu);
    }
    return through;
}

// The interpolated tangent of a hit, across `n`, and the sign of the bitangent in w; 0: there is none.
vec4 tangent_at(TriangleRef ref, vec2 b, uint instance, vec3 n) {
    vec4 t4 = vertex_at(ref.vertices.x).tangent * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).tangent * b.x + vertex_at(ref.vertices.z).tangent * b.y;
    vec3 t = transform_vector(BODY_AT(instance).world_from_object, t4.xyz);
    t -= n * dot(n, t);
    return dot(t, t) > 1e-12 ? vec4(normalize(t), t4.w < 0.0 ? -1.0 : 1.0) : vec4(0.0);
}

// The lobes that few materials have. `smooth_normal` is interpolated, on the outside.
void add_lobes(inout Point s, TriangleRef ref, vec2 b, vec2 uv, vec3 smooth_normal) {
    uint m = ref.material;
    s.material = m;
    s.coverage = 1.0;
    if (HAS_ALPHA_BLEND && (s.flags & MATERIAL_BLEND) != 0u)
        s.coverage = clamp(MATERIAL_AT(m).alpha * factor_of(MATERIAL_AT(m).base_color_texture, uv, 3u), 0.0, 1.0);
    s.coat = HAS_CLEARCOAT ? MATERIAL_AT(m).coat : 0.0;
    s.coat_alpha = 1.0;
    s.coat_normal = s.n;
    if (HAS_CLEARCOAT && s.coat > 0.0) {
        s.coat *= factor_of(MATERIAL_AT(m).coat_texture, uv, 0u);
        s.coat_alpha = coat_alpha_of(m, uv);
        vec3 n = smooth_normal;
        if (HAS_TEXTURES && MATERIAL_AT(m).coat_normal_texture.texture != NO_TEXTURE) {
            vec4 t = tangent_at(ref, b, s.body, n);
            vec3 c = sample_texture(MATERIAL_AT(m).coat_normal_texture, uv).xyz * 2.0 - 1.0;
            c.xy *= MATERIAL_AT(m).coat_normal_scale;
            vec3 mapped = t.xyz * c.x + cross(n, t.xyz) * t.w * c.y + n * c.z;
            if (t.w != 0.0 && dot(mapped, mapped) > 1e-12) n = normalize(mapped);
        }
        s.coat_normal = bend_toward(s.front ? n : -n, s.v, s.g);
    }
    s.across = 0.0;
    s.tangent = s.n;
    if (HAS_ANISOTROPY && MATERIAL_AT(m).anisotropy > 0.0) {
        float strength = MATERIAL_AT(m).anisotropy;
        vec2 along = MATERIAL_AT(m).anisotropy_direction;
        if (HAS_TEXTURES && MATERIAL_AT(m).anisotropy_texture.texture != NO_TEXTURE) {
            vec3 c = sample_texture(MATERIAL_AT(m).anisotropy_texture, uv).xyz;
            vec2 d = c.xy * 2.0 - 1.0;
            d = dot(d, d) > 1e-12 ? normalize(d) : vec2(1.0, 0.0);
            along = vec2(along.x * d.x - along.y * d.y, along.x * d.y + along.y * d.x);
            strength *= c.z;
        }
        float along_alpha = mix(s.alpha, 1.0, strength * strength);
        vec4 t = tangent_at(ref, b, s.body, smooth_normal);
        vec3 tangent = t.xyz * along.x + cross(smooth_normal, t.xyz) * t.w * along.y;
        tangent -= s.n * dot(s.n, tangent);
        if (along_alpha >= LEAST_BRUSHED_ALPHA && strength > 0.0 && dot(tangent, tangent) > 1e-12) {
            s.tangent = normalize(tangent);
            s.across = max(s.alpha, LEAST_BRUSHED_ALPHA);
            s.alpha = max(along_alpha, LEAST_BRUSHED_ALPHA);
        }
    }
    s.specular = HAS_SPECULAR_COLOR ? MATERIAL_AT(m).specular * factor_of(MATERIAL_AT(m).specular_texture, uv, 3u) : 1.0;
    s.specular_color = HAS_SPECULAR_COLOR ? MATERIAL_AT(m).specular_color * color_of(MATERIAL_AT(m).specular_color_texture, uv) : vec3(1.0);
    s.sheen = vec3(0.0);
    s.sheen_alpha = 1.0;
    if (HAS_SHEEN && max3(MATERIAL_AT(m).sheen_color) > 0.0) {
        s.sheen = MATERIAL_AT(m).sheen_color * color_of(MATERIAL_AT(m).sheen_color_texture, uv);
        s.sheen_alpha = sheen_alpha_of(m, uv);
    }
    s.film = HAS_IRIDESCENCE ? MATERIAL_AT(m).film : 0.0;
    s.film_nm = 0.0;
    if (HAS_IRIDESCENCE && s.film > 0.0) {
        s.film *= factor_of(MATERIAL_AT(m).film_texture, uv, 0u);
        vec2 range = MATERIAL_AT(m).film_thickness;
        s.film_nm = mix(range.x, range.y, factor_of(MATERIAL_AT(m).film_thickness_texture, uv, 1u));
    }
    s.shine = HAS_DIFFUSE_TRANSMISSION ? MATERIAL_AT(m).shine : 0.0;
    s.shine_color = vec3(0.0);
    if (HAS_DIFFUSE_TRANSMISSION && s.shine > 0.0) {
        s.shine *= factor_of(MATERIAL_AT(m).shine_texture, uv, 3u);
        s.shine_color = MATERIAL_AT(m).shine_color * color_of(MATERIAL_AT(m).shine_color_texture, uv);
    }
    s.absorption = HAS_ABSORPTION ? MATERIAL_AT(m).absorption : vec3(0.0);
    s.dispersion = HAS_DISPERSION && (s.flags & MATERIAL_THIN) == 0u && s.transmission > 0.0 ? MATERIAL_AT(m).dispersion : 0.0;
    if (HAS_EMISSIVE && (HAS_CLEARCOAT || HAS_SHEEN) && max3(s.emitted) > 0.0)
        s.emitted *= emission_through_layers(m, uv, abs(dot(s.g, s.v)));
}

Point shading_point(Hit hit, vec3 v) {
    Point s;
    uint instance = instance_of(hit.id), triangle = triangle_of(hit.id);
    TriangleRef ref = triangle_ref_at(BODY_AT(instance).triangle_offset + triangle);
    uint m = ref.material;
    vec2 b = hit.barycentric;
    s.p = transform_point(BODY_AT(instance).world_from_object, object_position(instance, triangle, b));
    s.g = transform_normal(BODY_AT(instance).world_from_object, object_normal(instance, triangle));
    s.v = v;
    s.flags = MATERIAL_AT(m).flags;
    s.table = MATERIAL_AT(m).albedo_table;
    s.light = ref.light;
    s.offset = surface_offset(s.p, instance);
    s.front = dot(s.g, v) > 0.0;
    s.body = instance;
    s.row = (BODY_AT(instance).triangle_offset + triangle) * 3u;
    vec3 n = vertex_at(ref.vertices.x).normal * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).normal * b.x + vertex_at(ref.vertices.z).normal * b.y;
    n = dot(n, n) > 1e-12 ? transform_normal(BODY_AT(instance).world_from_object, n) : s.g;
    vec2 uv = HAS_TEXTURES ? interpolate_uv(ref, b) : vec2(0.0);
    vec3 smooth_normal = n;
    if (HAS_NORMAL_MAPS && MATERIAL_AT(m).normal_texture.texture != NO_TEXTURE) {
        vec4 t4 = vertex_at(ref.vertices.x).tangent * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).tangent * b.x + vertex_at(ref.vertices.z).tangent * b.y;
        vec3 t = transform_vector(BODY_AT(instance).world_from_object, t4.xyz);
        t -= n * dot(n, t);
        if (dot(t, t) > 1e-12) {
            t = normalize(t);
            vec3 bitangent = cross(n, t) * (t4.w < 0.0 ? -1.0 : 1.0);
            vec3 c = sample_texture(MATERIAL_AT(m).normal_texture, uv).xyz * 2.0 - 1.0;
            c.xy *= MATERIAL_AT(m).normal_scale;
            vec3 mapped = t * c.x + bitangent * c.y + n * c.z;
            if (dot(mapped, mapped) > 1e-12) n = normalize(mapped);
        }
    }
    if (!s.front) {
        s.g = -s.g;
        n = -n;
    }
    float nv = dot(n, v);
    if (nv < 1e-3) {
        // The normal is bent to the nearest direction for which v is just above the surface.
        vec3 across = n - nv * v;
        float l2 = dot(across, across);
        n = l2 > 1e-12 ? across * (sqrt(1.0 - 1e-6) * inversesqrt(l2)) + 1e-3 * v : s.g;
    }
    s.n = n;
    s.base = MATERIAL_AT(m).base_color;
    s.metallic = MATERIAL_AT(m).metallic;
    float roughness = MATERIAL_AT(m).roughness;
    s.transmission = HAS_TRANSMISSION ? MATERIAL_AT(m).transmission : 0.0;
    s.emitted = HAS_EMISSIVE && (s.front || (s.flags & MATERIAL_DOUBLE_SIDED) != 0u) ? MATERIAL_AT(m).emissive : vec3(0.0);
    s.ior = MATERIAL_AT(m).ior;
    if (HAS_TEXTURES) {
        if (MATERIAL_AT(m).base_color_texture.texture != NO_TEXTURE) s.base *= sample_texture(MATERIAL_AT(m).base_color_texture, uv).rgb;
        if (MATERIAL_AT(m).metallic_roughness_texture.texture != NO_TEXTURE) {
            vec4 mr = sample_texture(MATERIAL_AT(m).metallic_roughness_texture, uv);
            roughness *= mr.g;
            s.metallic *= mr.b;
        }
        if (HAS_EMISSIVE && MATERIAL_AT(m).emissive_texture.texture != NO_TEXTURE) s.emitted *= sample_texture(MATERIAL_AT(m).emissive_texture, uv).rgb;
        if (HAS_TRANSMISSION && MATERIAL_AT(m).transmission_texture.texture != NO_TEXTURE)
            s.transmission *= sample_texture(MATERIAL_AT(m).transmission_texture, uv).r;
    }
    s.alpha = max(roughness * roughness, 1e-4);
    add_lobes(s, ref, b, uv, smooth_normal);
    return s;
}
