// The panel's pixels around which traced pixels do not show one even surface: their rays are traced through the scene, and to the eye. A lane takes a
// pixel of the list that the pass `enlarge` has left. See enlarge.glsl.
#version 460
#extension GL_GOOGLE_include_directive : require
#ifdef RAY_QUERY
#define FRAME_WHERE_USED
#endif
#include "enlarge.glsl"

layout(local_size_x = 64) in;

// Rank of a tap on the same body that does not agree, among those from which light is taken if nothing agrees: behind all that do.
const float DISAGREES = 1e3, NO_TAP = 1e9;

// The light of the nearest of the 4 x 4 traced pixels around that agrees; else of the nearest lit one on the body; else none.
vec3 nearest_light(Surround g, ivec2 corner, bool wanted) {
    float best = NO_TAP;
    vec3 found = vec3(0.0);
    int i = wanted ? 0 : 15;
    do {
        ivec2 q = corner + ivec2(i & 3, i >> 2) - 1;
        uint at = coarse_index(q);
        SurfaceHit surface = coarse_surface_at(at);
        TapLight tap = light_of(at);
        bool lit = surface.id != NO_HIT && surface.distance > 0.0 && instance_of(surface.id) == g.body;
        vec2 apart = vec2(q) - g.place;
        float rank = dot(apart, apart) + (agreement(g, q, surface.id, surface.distance, tap) > 0.0 ? 0.0 : DISAGREES);
        bool nearer = wanted && lit && rank < best;
        best = nearer ? rank : best;
        found = nearer ? tap.light : found;
        i++;
    } while (i < 16);
    return found;
}

// Whether the eye sees a surface from the side that the projector lights.
bool is_seen(vec3 p, Hit hit, vec3 direction, inout uint rays) {
    uint body = instance_of(hit.id);
    vec3 g = transform_normal(instance_at(body).world_from_object, object_normal(body, triangle_of(hit.id)));
    vec3 to_eye = frame.eye_position - p;
    float projector_side = -dot(g, direction), eye_side = dot(g, to_eye);
    bool lit = projector_side * eye_side > 0.0;
    if (lit) {
        vec3 offset = g * (sign(eye_side) * surface_offset(p, body));
        Hit blocker;
        blocker.t = 1.0;
        rays++;
        lit = !trace_ray(p + offset, to_eye - offset, INSTANCE_PROJECTED, NONE_LEFT, true, blocker);
    }
    return lit;
}

void main() {
    uint item = list_item();
    if (item >= uint(edge_list.listed)) return;
    uint index = lists[item].pixel, rays = 1u, nans = 0u, clipped = 0u;
    uvec2 pixel = uvec2(index % panel_size.x, index / panel_size.x);
    vec3 direction = pixel_direction(pixel);
    Taps t = taps_of(cell_at(ivec2(pixel)));
    Hit hit = Hit(NO_HIT, vec2(0.0), INFINITY);
    bool lit = trace_ray(frame.projector_position, direction, INSTANCE_PROJECTED, NONE_LEFT, false, hit);
    own_light = vec3(0.0);
    if (lit) {
        lit = is_seen(direction * hit.t, hit, direction, rays);
        Surround g = surround_of(pixel, hit, direction);
        float least;
        vec4 light = mean_of(g, t, least);
        vec3 other = nearest_light(g, t.corner, light.w <= 0.0);
        own_light = lit ? with_texture(light.w > 0.0 ? light.rgb : other, hit, direction) : vec3(0.0);
    }
    write_pixel(pixel, index, hit, lit, nans, clipped);
    COUNT(lit_pixels, lit ? 1u : 0u)
    COUNT_RARE(nan_values, nans)
    COUNT_RARE(clipped_values, clipped)
    COUNT(rays, rays)
    COUNT(camera_rays, rays)
}
