// A hit into a shading point: its position, its normals, and the material there.

layout(set = 0, binding = B_TEXTURES, scalar) readonly buffer Textures { TextureInfo textures[]; };
layout(set = 0, binding = B_TEXELS, scalar) readonly buffer Texels { uvec2 texels[]; };

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
};

uint wrap_texel(int x, uint size, uint mode) {
    int n = int(size);
    if (mode == 1u) return uint(clamp(x, 0, n - 1));
    int period = mode == 2u ? 2 * n : n;
    int m = x - int(floor(float(x) / float(period))) * period;
    m = clamp(m, 0, period - 1);
    return uint(m >= n ? 2 * n - 1 - m : m);
}

vec4 texel(TextureInfo info, int x, int y) {
    uvec2 w = texels[info.offset + wrap_texel(y, info.height, (info.flags >> 2u) & 3u) * info.width + wrap_texel(x, info.width, info.flags & 3u)];
    return vec4(unpackUnorm2x16(w.x), unpackUnorm2x16(w.y));
}

vec4 sample_texture(TextureUse use, vec2 uv) {
    TextureInfo info = textures[use.texture];
    vec2 st = vec2(dot(use.row_u, vec3(uv, 1.0)), dot(use.row_v, vec3(uv, 1.0))) * vec2(info.width, info.height);
    // Coordinates that are very large or not finite must not overflow the conversion to integers.
    st = clamp(st, vec2(-1.0e6), vec2(1.0e6));
    if ((info.flags & 32u) != 0u) return texel(info, int(floor(st.x)), int(floor(st.y)));
    st -= 0.5;
    vec2 base = floor(st);
    vec2 f = st - base;
    int x = int(base.x), y = int(base.y);
    return mix(mix(texel(info, x, y), texel(info, x + 1, y), f.x), mix(texel(info, x, y + 1), texel(info, x + 1, y + 1), f.x), f.y);
}

vec2 interpolate_uv(TriangleRef ref, vec2 b) {
    return vertex_at(ref.vertices.x).uv * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).uv * b.x + vertex_at(ref.vertices.z).uv * b.y;
}

bool alpha_present(uint instance, uint triangle, vec2 barycentric) {
    TriangleRef ref = triangle_ref_at(instance_at(instance).triangle_offset + triangle);
    float cutoff = material_at(ref.material).alpha_cutoff;
    if (cutoff < 0.0) return true;
    float a = material_at(ref.material).alpha;
    if (HAS_TEXTURES && material_at(ref.material).base_color_texture.texture != NO_TEXTURE)
        a *= sample_texture(material_at(ref.material).base_color_texture, interpolate_uv(ref, barycentric)).a;
    return a >= cutoff;
}

// Position of a hit, in the body's space.
vec3 object_position(uint instance, uint triangle, vec2 b) {
    uint row = (instance_at(instance).triangle_offset + triangle) * 3u;
    vec3 p0 = TRI(row).xyz;
    return p0 + b.x * (TRI(row + 1u).xyz - p0) + b.y * (TRI(row + 2u).xyz - p0);
}

vec3 object_normal(uint instance, uint triangle) {
    uint row = (instance_at(instance).triangle_offset + triangle) * 3u;
    vec3 p0 = TRI(row).xyz;
    return normalize(cross(TRI(row + 1u).xyz - p0, TRI(row + 2u).xyz - p0));
}

// A distance larger than the rounding of the hit's position and of the transforms into the body's space and back.
float surface_offset(vec3 p, uint instance) {
    return 1.9e-6 * (max(abs(p.x), max(abs(p.y), abs(p.z))) + instance_at(instance).extent);
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
#ifdef TEXEL_TABLES
    // Horizons are not worked out for software Vulkan.
    return false;
#else
    vec3 d = transform_vector(instance_at(body).object_from_world, direction), a = abs(d);
    uint largest = a.x >= a.y && a.x >= a.z ? 0u : a.y >= a.z ? 1u : 2u;
    uint octant = (d.x < 0.0 ? 1u : 0u) | (d.y < 0.0 ? 2u : 0u) | (d.z < 0.0 ? 4u : 0u);
    uint steps = (floatBitsToUint(TRI(row + largest).w) >> (4u * octant)) & 15u;
    return steps < HORIZON_STEPS && dot(direction, normal) * float(HORIZON_STEPS) > float(steps) * length(direction);
#endif
}

Point shading_point(Hit hit, vec3 v) {
    Point s;
    uint instance = instance_of(hit.id), triangle = triangle_of(hit.id);
    TriangleRef ref = triangle_ref_at(instance_at(instance).triangle_offset + triangle);
    uint m = ref.material;
    vec2 b = hit.barycentric;
    s.p = transform_point(instance_at(instance).world_from_object, object_position(instance, triangle, b));
    s.g = transform_normal(instance_at(instance).world_from_object, object_normal(instance, triangle));
    s.v = v;
    s.flags = material_at(m).flags;
    s.table = material_at(m).albedo_table;
    s.light = ref.light;
    s.offset = surface_offset(s.p, instance);
    s.front = dot(s.g, v) > 0.0;
    s.body = instance;
    s.row = (instance_at(instance).triangle_offset + triangle) * 3u;
    vec3 n = vertex_at(ref.vertices.x).normal * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).normal * b.x + vertex_at(ref.vertices.z).normal * b.y;
    n = dot(n, n) > 1e-12 ? transform_normal(instance_at(instance).world_from_object, n) : s.g;
    vec2 uv = HAS_TEXTURES ? interpolate_uv(ref, b) : vec2(0.0);
    if (HAS_NORMAL_MAPS && material_at(m).normal_texture.texture != NO_TEXTURE) {
        vec4 t4 = vertex_at(ref.vertices.x).tangent * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).tangent * b.x + vertex_at(ref.vertices.z).tangent * b.y;
        vec3 t = transform_vector(instance_at(instance).world_from_object, t4.xyz);
        t -= n * dot(n, t);
        if (dot(t, t) > 1e-12) {
            t = normalize(t);
            vec3 bitangent = cross(n, t) * (t4.w < 0.0 ? -1.0 : 1.0);
            vec3 c = sample_texture(material_at(m).normal_texture, uv).xyz * 2.0 - 1.0;
            c.xy *= material_at(m).normal_scale;
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
    s.base = material_at(m).base_color;
    s.metallic = material_at(m).metallic;
    float roughness = material_at(m).roughness;
    s.transmission = HAS_TRANSMISSION ? material_at(m).transmission : 0.0;
    s.emitted = HAS_EMISSIVE && (s.front || (s.flags & MATERIAL_DOUBLE_SIDED) != 0u) ? material_at(m).emissive : vec3(0.0);
    s.ior = material_at(m).ior;
    if (HAS_TEXTURES) {
        if (material_at(m).base_color_texture.texture != NO_TEXTURE) s.base *= sample_texture(material_at(m).base_color_texture, uv).rgb;
        if (material_at(m).metallic_roughness_texture.texture != NO_TEXTURE) {
            vec4 mr = sample_texture(material_at(m).metallic_roughness_texture, uv);
            roughness *= mr.g;
            s.metallic *= mr.b;
        }
        if (HAS_EMISSIVE && material_at(m).emissive_texture.texture != NO_TEXTURE) s.emitted *= sample_texture(material_at(m).emissive_texture, uv).rgb;
        if (HAS_TRANSMISSION && material_at(m).transmission_texture.texture != NO_TEXTURE)
            s.transmission *= sample_texture(material_at(m).transmission_texture, uv).r;
    }
    s.alpha = max(roughness * roughness, 1e-4);
    return s;
}
