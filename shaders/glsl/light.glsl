// Light sampling: one of the emissive triangles, the punctual lights and the environment is chosen by power.

struct LightSample {
    vec3 to_light;  // From the surface point to the light's point, or to a far point. Not of unit length.
    vec3 radiance;  // Divided by the pdf.
    float pdf;      // Over solid angle; 0 for lights that no ray can hit.
    bool valid;
    bool finite_distance;
    uint left;      // A body that the way from the light to the point does not meet, or NO_INSTANCE.
};

vec2 environment_position(vec3 d) {
    // Row 0 is up. The middle column looks along -Z, turned by the rotation about +Y.
    float azimuth = atan(d.x, -d.z) + frame.environment_rotation;
    float u = azimuth / (2.0 * PI) + 0.5;
    return vec2(u - floor(u), acos(clamp(d.y, -1.0, 1.0)) / PI);
}

vec3 environment_radiance(vec3 d) {
    if (ENVIRONMENT_KIND == ENVIRONMENT_NONE) return vec3(0.0);
    if (ENVIRONMENT_KIND == ENVIRONMENT_CONSTANT) return frame.environment;
    vec2 uv = environment_position(d);
    uint x = min(uint(uv.x * float(frame.environment_width)), frame.environment_width - 1u);
    uint y = min(uint(uv.y * float(frame.environment_height)), frame.environment_height - 1u);
    return sky_at(y * frame.environment_width + x).light;
}

// Pdf over solid angle of the directions of a texel.
float texel_pdf(uint x, uint y) {
    uint w = frame.environment_width, h = frame.environment_height;
    float row = sky_at(w * h + y).light.x - (y > 0u ? sky_at(w * h + y - 1u).light.x : 0.0);
    float column = sky_at(y * w + x).cumulative - (x > 0u ? sky_at(y * w + x - 1u).cumulative : 0.0);
    // Texels are constant and rows are sampled uniformly in the cosine of the polar angle.
    float c0 = cos(PI * float(y) / float(h)), c1 = cos(PI * float(y + 1u) / float(h));
    float solid_angle = 2.0 * PI / float(w) * max(c0 - c1, 1e-12);
    return row * column / solid_angle;
}

// Pdf over solid angle with which sample_environment finds the direction `d`, without the choice of the environment among the lights.
float environment_pdf(vec3 d, vec3 n) {
    if (ENVIRONMENT_KIND == ENVIRONMENT_NONE) return 0.0;
    if (ENVIRONMENT_KIND == ENVIRONMENT_CONSTANT) return max(dot(n, d), 0.0) / PI;
    uint w = frame.environment_width, h = frame.environment_height;
    vec2 uv = environment_position(d);
    return texel_pdf(min(uint(uv.x * float(w)), w - 1u), min(uint(uv.y * float(h)), h - 1u));
}

LightSample sample_environment(vec3 n, vec2 u) {
    LightSample r;
    r.valid = false;
    r.finite_distance = false;
    r.left = NO_INSTANCE;
    r.pdf = 0.0;
    r.radiance = vec3(0.0);
    r.to_light = n;
    if (ENVIRONMENT_KIND == ENVIRONMENT_CONSTANT) {
        mat3 to_world = frame_around(n);
        float radius = sqrt(u.x), phi = 2.0 * PI * u.y;
        float z = sqrt(max(1.0 - u.x, 0.0));
        r.to_light = to_world * vec3(radius * cos(phi), radius * sin(phi), z);
        r.pdf = z / PI;
        r.radiance = frame.environment;
        r.valid = r.pdf > 1e-7;
    } else if (ENVIRONMENT_KIND == ENVIRONMENT_MAP) {
        uint w = frame.environment_width, h = frame.environment_height;
        uint lo = 0u, hi = h - 1u;
        while (lo < hi) {
            uint mid = (lo + hi) / 2u;
            if (sky_at(w * h + mid).light.x > u.y) hi = mid; else lo = mid + 1u;
        }
        uint y = lo;
        float below = y > 0u ? sky_at(w * h + y - 1u).light.x : 0.0;
        float in_row = clamp((u.y - below) / max(sky_at(w * h + y).light.x - below, 1e-12), 0.0, 0.999999);
        lo = 0u;
        hi = w - 1u;
        while (lo < hi) {
            uint mid = (lo + hi) / 2u;
            if (sky_at(y * w + mid).cumulative > u.x) hi = mid; else lo = mid + 1u;
        }
        uint x = lo;
        float left = x > 0u ? sky_at(y * w + x - 1u).cumulative : 0.0;
        float in_column = clamp((u.x - left) / max(sky_at(y * w + x).cumulative - left, 1e-12), 0.0, 0.999999);
        float c0 = cos(PI * float(y) / float(h)), c1 = cos(PI * float(y + 1u) / float(h));
        float cosine = mix(c0, c1, in_row);
        float sine = sqrt(max(1.0 - cosine * cosine, 0.0));
        float azimuth = ((float(x) + in_column) / float(w) - 0.5) * 2.0 * PI - frame.environment_rotation;
        r.to_light = vec3(sine * sin(azimuth), cosine, -sine * cos(azimuth));
        // By the texel that was chosen. At its edge the direction is rounded into the next one, whose pdf may be a ten thousandth.
        r.pdf = texel_pdf(x, y);
        r.radiance = sky_at(y * w + x).light;
        r.valid = r.pdf > 1e-12;
    }
    return r;
}

// Chooses a light for the point and samples it. `pdf` and `radiance` include the choice.
LightSample sample_light(vec3 p, vec3 n, float u_pick, vec2 u) {
    LightSample r;
    r.valid = false;
    r.finite_distance = true;
    r.left = NO_INSTANCE;
    r.pdf = 0.0;
    r.radiance = vec3(0.0);
    r.to_light = n;
    float to_environment = frame.environment_select;
    if (ENVIRONMENT_KIND != ENVIRONMENT_NONE && u_pick < to_environment) {
        r = sample_environment(n, u);
        r.pdf *= to_environment;
        if (r.valid) r.radiance /= r.pdf;
        return r;
    }
    if (!(HAS_EMISSIVE || HAS_PUNCTUAL) || frame.light_count == 0u) return r;
    float rest = clamp((u_pick - to_environment) / max(1.0 - to_environment, 1e-7), 0.0, 0.9999999);
    float scaled = rest * float(frame.light_count);
    uint slot = min(uint(scaled), frame.light_count - 1u);
    uint index = scaled - float(slot) < light_at(slot).alias_keep ? slot : light_at(slot).alias_other;
    uint kind = light_at(index).kind;
    float select = light_at(index).select * (1.0 - to_environment);
    if (select <= 0.0) return r;
    uint carrier = light_at(index).instance;
    if (HAS_EMISSIVE && kind == LIGHT_TRIANGLE) {
        uint row = (instance_at(carrier).triangle_offset + light_at(index).triangle) * 3u;
        vec3 p0 = TRI(row).xyz;
        vec3 e1 = TRI(row + 1u).xyz - p0, e2 = TRI(row + 2u).xyz - p0;
        float su = sqrt(u.x);
        vec2 b = vec2(su * (1.0 - u.y), u.y * su); // Uniform over the triangle.
        vec3 q = transform_point(instance_at(carrier).world_from_object, p0 + b.x * e1 + b.y * e2);
        vec3 scaled_normal = transform_vector(instance_at(carrier).world_from_object, cross(e1, e2));
        float area = 0.5 * length(scaled_normal);
        vec3 normal = scaled_normal / max(2.0 * area, 1e-30);
        vec3 d = q - p;
        float d2 = dot(d, d);
        float cosine = -dot(normal, d) * inversesqrt(max(d2, 1e-30));
        if (cosine > 0.0 && leaves_body(carrier, row, normal, -d)) r.left = carrier;
        TriangleRef ref = triangle_ref_at(instance_at(carrier).triangle_offset + light_at(index).triangle);
        bool both = (material_at(ref.material).flags & MATERIAL_DOUBLE_SIDED) != 0u;
        if (both) {
            normal = cosine < 0.0 ? -normal : normal;
            cosine = abs(cosine);
        }
        if (cosine <= 1e-6 || area <= 0.0 || d2 <= 0.0) return r;
        vec3 emitted = material_at(ref.material).emissive;
        if (HAS_TEXTURES && material_at(ref.material).emissive_texture.texture != NO_TEXTURE)
            emitted *= sample_texture(material_at(ref.material).emissive_texture, interpolate_uv(ref, b)).rgb;
        if (HAS_ALPHA_MASK && !alpha_present(carrier, light_at(index).triangle, b)) return r;
        if (HAS_CLEARCOAT || HAS_SHEEN) emitted *= emission_through_layers(ref.material, HAS_TEXTURES ? interpolate_uv(ref, b) : vec2(0.0), cosine);
        r.pdf = select * d2 / (cosine * area);
        r.radiance = emitted / r.pdf;
        r.to_light = q + normal * surface_offset(q, carrier) - p;
        r.valid = finite(r.pdf) && r.pdf > 0.0;
        return r;
    }
    if (HAS_PUNCTUAL && kind != LIGHT_TRIANGLE) {
        vec3 position = light_at(index).position, direction = light_at(index).direction;
        if (carrier != NO_INSTANCE) {
            position = transform_point(instance_at(carrier).world_from_object, position);
            direction = transform_vector(instance_at(carrier).world_from_object, direction);
        } else {
            position -= frame.world_origin;
        }
        if (kind == LIGHT_DIRECTIONAL) {
            r.to_light = -direction;
            r.finite_distance = false;
            r.radiance = light_at(index).intensity / select;
            r.valid = true;
            return r;
        }
        vec3 d = position - p;
        float d2 = dot(d, d);
        if (d2 <= 1e-20) return r;
        float distance_ = sqrt(d2);
        float falloff = 1.0 / d2;
        if (light_at(index).range < 1.0e30) {
            // The smooth window of KHR_lights_punctual.
            float x = distance_ / light_at(index).range;
            x *= x;
            falloff *= clamp(1.0 - x * x, 0.0, 1.0);
        }
        if (kind == LIGHT_SPOT) {
            float c = clamp(dot(-d / distance_, direction) * light_at(index).cone_scale + light_at(index).cone_offset, 0.0, 1.0);
            falloff *= c * c;
        }
        r.to_light = d;
        r.radiance = light_at(index).intensity * (falloff / select);
        r.valid = falloff > 0.0;
    }
    return r;
}

// Pdf over solid angle with which sample_light would have found this point of an emissive triangle from `p`.
float emissive_pdf(uint light, uint instance, uint triangle, vec3 p, vec3 q, vec3 g) {
    uint row = (instance_at(instance).triangle_offset + triangle) * 3u;
    vec3 p0 = TRI(row).xyz;
    float area = 0.5 * length(cross(TRI(row + 1u).xyz - p0, TRI(row + 2u).xyz - p0));
    vec3 d = q - p;
    float d2 = dot(d, d);
    float cosine = abs(dot(g, d)) * inversesqrt(max(d2, 1e-30));
    float denominator = cosine * area;
    return denominator > 1e-30 ? light_at(light).select * (1.0 - frame.environment_select) * d2 / denominator : 0.0;
}
