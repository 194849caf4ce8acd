// The light of a pixel into its code values: compensation for the distance, angle and albedo of the real surface, then quantisation.

layout(set = 0, binding = B_CODES, scalar) writeonly buffer Codes { uint codes[]; };

// floor(255 v + 0.5) in f32 without contraction. Equals the CPU's `quantise` bit for bit.
uint quantise(float v, inout uint nans, inout uint clipped) {
    uint bits = floatBitsToUint(v);
    if ((bits & 0x7fffffffu) > 0x7f800000u) {
        nans++;
        return 0u;
    }
    if (v <= 0.0) return 0u;
    if (v >= 1.0) {
        if (v > 1.0) clipped++;
        return 255u;
    }
    precise float scaled = v * 255.0;
    precise float shifted = scaled + 0.5;
    return uint(shifted);
}

// The same where the light is not proportional to the code value: the code whose light is nearest. `optics` begins with the thresholds of each
// channel, which grow; the code is the number of thresholds after the first that `v` reaches. Equals the CPU's `code_of` bit for bit.
uint quantise_by_response(float v, uint channel, inout uint nans, inout uint clipped) {
    uint bits = floatBitsToUint(v);
    if ((bits & 0x7fffffffu) > 0x7f800000u) {
        nans++;
        return 0u;
    }
    if (v > 1.0) clipped++;
    uint code = 0u;
    for (uint step_ = RESPONSE_CODES / 2u; step_ > 0u; step_ >>= 1u)
        if (v >= optics[channel * RESPONSE_CODES + code + step_]) code += step_;
    return code;
}

// The pixel's ray before the pose, of any length. Without a lens it is times fx fy, because then no quotient is needed.
vec3 ray_of(uvec2 pixel) {
    if (LENS != LENS_NONE) {
        vec2 straight = straight_ray(ivec2(pixel));
        return vec3(straight.x, -straight.y, -1.0);
    }
    vec2 raster = vec2(pixel) + 0.5;
    precise vec3 d = vec3((raster.x - frame.intrinsics.z) * frame.intrinsics.y, (frame.intrinsics.w - raster.y) * frame.intrinsics.x, -(frame.intrinsics.x * frame.intrinsics.y));
    return d;
}

// Absolute cosine between the smooth normal and a ray of the projector. There is no contraction, and no quotient but 1 / x, so it equals the CPU's
// `real_cosine` bit for bit.
float real_cosine(vec4 rows[3], vec3 n0, vec3 n1, vec3 n2, vec2 b, vec3 d) {
    precise float w = (1.0 - b.x) - b.y;
    precise vec3 n = (n0 * w + n1 * b.x) + n2 * b.y;
    precise float dot_ = 0.0, nn = 0.0, dd = 0.0;
    for (int i = 0; i < 3; i++) {
        precise float ni = (rows[i].x * n.x + rows[i].y * n.y) + rows[i].z * n.z;
        precise float di = (frame.world_from_projector[i].x * d.x + frame.world_from_projector[i].y * d.y) + frame.world_from_projector[i].z * d.z;
        dot_ = dot_ + ni * di;
        nn = nn + ni * ni;
        dd = dd + di * di;
    }
    precise float squared = nn * dd;
    if (!(squared > 0.0)) return 0.0; // Opposite normals cancel.
    precise float inverse = 1.0 / sqrt(squared);
    precise float cosine = abs(dot_) * inverse;
    return cosine;
}

// The place among the texels of one axis of an albedo map: the texels below and above, and the way from one to the other.
void albedo_axis(float t, float size, out uint low, out uint high, out float way) {
    precise float x = t * size - 0.5;
    // Coordinates that are very large must not overflow the conversion to integers.
    x = clamp(x, -1.0e6, 1.0e6);
    float below = floor(x);
    precise float rest = x - below;
    way = rest;
    int n = int(size), at = int(below);
    // The remainder of a negative number is not defined.
    int turns = at >= 0 ? at / n : -((n - 1 - at) / n);
    low = uint(at - turns * n);
    high = low + 1u == uint(n) ? 0u : low + 1u;
}

vec3 albedo_texel(uint map, uint width, uint x, uint y) {
    uint at = map + 2u + 3u * (y * width + x);
    return vec3(optics[at], optics[at + 1u], optics[at + 2u]);
}

// Albedo of the real surface at texture coordinates, which the picture repeats beyond 0..1. Equals the CPU's `AlbedoMap::at` bit for bit.
vec3 albedo_at(uint map, vec2 uv) {
    uint width = uint(optics[map]), x0, x1, y0, y1;
    float fx, fy;
    albedo_axis(uv.x, optics[map], x0, x1, fx);
    albedo_axis(uv.y, optics[map + 1u], y0, y1, fy);
    vec3 a = albedo_texel(map, width, x0, y0), b = albedo_texel(map, width, x0, y1);
    precise vec3 above = a + (albedo_texel(map, width, x1, y0) - a) * fx;
    precise vec3 below = b + (albedo_texel(map, width, x1, y1) - b) * fx;
    precise vec3 albedo = above + (below - above) * fy;
    return albedo;
}

// Where the pixel's surface is, unless the shader that includes this file has it elsewhere.
#ifndef SURFACE_OF
#define SURFACE_OF(index) surface_at(index)
#define WEIGHTS_OF(index) barycentric_at(index).weights
#endif

// Defined by the shader that includes this file: the radiance toward the eye that a lit pixel shows.
vec3 light_at(uvec2 pixel, uint index);

// The code values of a lit pixel at `index`.
uint codes_of(uvec2 pixel, uint index, SurfaceHit surface, inout uint nans, inout uint clipped) {
    uint instance = surface.id >> 24u, code = 0u;
    TriangleRef ref = triangle_ref_at(BODY_AT(instance).triangle_offset + (surface.id & 0xffffffu));
    vec2 b = WEIGHTS_OF(index);
    // The real surface is smooth, so its normal is the interpolated one, without the normal map of the look.
    float cosine = real_cosine(BODY_AT(instance).world_from_object, vertex_at(ref.vertices.x).normal, vertex_at(ref.vertices.y).normal,
                               vertex_at(ref.vertices.z).normal, b, ray_of(pixel));
    precise float geometry = (surface.distance * surface.distance) * (1.0 / max(cosine, 1e-3));
    precise vec3 drive = (light_at(pixel, index) - frame.ambient) * (BODY_AT(instance).drive_gain * geometry);
    uint map = BODY_AT(instance).albedo_map;
    if (HAS_ALBEDO_MAPS && map != NO_ALBEDO_MAP) {
        precise float w = (1.0 - b.x) - b.y;
        precise vec2 uv = (vertex_at(ref.vertices.x).uv * w + vertex_at(ref.vertices.y).uv * b.x) + vertex_at(ref.vertices.z).uv * b.y;
        precise vec3 reflected = drive * (1.0 / albedo_at(map, uv));
        drive = reflected;
    }
    if (HAS_FLAT_FIELD) {
        uint at = frame.flat_field_at + 3u * index;
        precise vec3 even = drive * vec3(optics[at], optics[at + 1u], optics[at + 2u]);
        drive = even;
    }
    if (HAS_RESPONSE) {
        for (uint c = 0u; c < 3u; c++) code |= quantise_by_response(drive[c], c, nans, clipped) << (8u * c);
    } else {
        code = quantise(drive.r, nans, clipped) | (quantise(drive.g, nans, clipped) << 8u) | (quantise(drive.b, nans, clipped) << 16u);
    }
    return code;
}

// Writes the code values of the pixel at `index`. To be called by every invocation that has a pixel.
void compensate(uvec2 pixel, uint index) {
    SurfaceHit surface = SURFACE_OF(index);
    uint nans = 0u, clipped = 0u, lit = 0u, code = 0u;
    if (surface.id != NO_HIT && surface.distance > 0.0) {
        code = codes_of(pixel, index, surface, nans, clipped);
        lit = 1u;
    }
    codes[index] = code;
    COUNT(lit_pixels, lit)
    COUNT_RARE(nan_values, nans)
    COUNT_RARE(clipped_values, clipped)
}
