// Tiles into surfaces: what each projector pixel's ray meets, and whether the eye sees that point.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"
#define ALPHA_TEST
#include "bvh.glsl"
#include "shading.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_SURFACES, scalar) writeonly buffer Surfaces { Surface surfaces[]; };

void main() {
    // Four workgroups a tile.
    uint tile = tiles[gl_WorkGroupID.x >> 2u];
    uvec2 pixel = uvec2(tile % frame.tiles_x, tile / frame.tiles_x) * 16u + uvec2(gl_WorkGroupID.x & 1u, (gl_WorkGroupID.x >> 1u) & 1u) * 8u + gl_LocalInvocationID.xy;
    if (pixel.x >= frame.width || pixel.y >= frame.height) return;
    Surface surface = Surface(NO_HIT, vec2(0.0), 0.0);
    vec3 direction = projector_direction(vec2(pixel) + 0.5);
    bool camera_is_eye = (frame.flags & FRAME_CAMERA_IS_EYE) != 0u;
    uint mask = camera_is_eye ? 0u : INSTANCE_PROJECTED;
    Hit hit;
    hit.t = INFINITY;
    uint shadow = 0u;
    if (trace_ray(frame.projector_position, direction, mask, false, hit)) {
        surface.id = (hit.instance << 24u) | hit.triangle;
        surface.barycentric = hit.barycentric;
        surface.distance = hit.t;
        if (!camera_is_eye) {
            vec3 p = transform_point(instances[hit.instance].world_from_object, object_position(hit.instance, hit.triangle, hit.barycentric));
            vec3 g = transform_normal(instances[hit.instance].world_from_object, object_normal(hit.instance, hit.triangle));
            vec3 to_eye = frame.eye_position - p;
            // The eye must be on the side that the projector lights.
            float projector_side = -dot(g, direction), eye_side = dot(g, to_eye);
            bool lit = projector_side * eye_side > 0.0;
            if (lit) {
                vec3 offset = g * (sign(eye_side) * surface_offset(p, hit.instance));
                Hit blocker;
                blocker.t = 1.0;
                shadow = 1u;
                lit = !trace_ray(p + offset, to_eye - offset, INSTANCE_PROJECTED, true, blocker);
            }
            if (!lit) surface.distance = -hit.t;
        }
    }
    surfaces[pixel.y * frame.width + pixel.x] = surface;
    COUNT(closest_rays, 1u)
    COUNT(shadow_rays, shadow)
}
