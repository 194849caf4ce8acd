// Surfaces into radiance toward the eye: `spp` paths from every lit pixel.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "path.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_SURFACES, scalar) readonly buffer Surfaces { Surface surfaces[]; };
// rgb mean of the samples, w their number.
layout(set = 0, binding = B_RADIANCE, scalar) writeonly buffer Radiance { vec4 radiance_out[]; };

void main() {
    uint tile = tiles[gl_WorkGroupID.x >> 2u];
    uvec2 pixel = uvec2(tile % frame.tiles_x, tile / frame.tiles_x) * 16u + uvec2(gl_WorkGroupID.x & 1u, (gl_WorkGroupID.x >> 1u) & 1u) * 8u + gl_LocalInvocationID.xy;
    if (pixel.x >= frame.width || pixel.y >= frame.height) return;
    uint index = pixel.y * frame.width + pixel.x;
    Surface surface = surfaces[index];
    bool camera_is_eye = (frame.flags & FRAME_CAMERA_IS_EYE) != 0u;
    if (surface.id == NO_HIT || surface.distance < 0.0) {
        vec3 background = surface.id == NO_HIT && camera_is_eye ? environment_radiance(projector_direction(vec2(pixel) + 0.5)) : vec3(0.0);
        radiance_out[index] = vec4(background, 0.0);
        return;
    }
    Hit hit;
    hit.instance = surface.id >> 24u;
    hit.triangle = surface.id & 0xffffffu;
    hit.barycentric = surface.barycentric;
    hit.t = surface.distance;
    vec3 p = transform_point(instances[hit.instance].world_from_object, object_position(hit.instance, hit.triangle, hit.barycentric));
    vec3 toward = normalize((camera_is_eye ? frame.projector_position : frame.eye_position) - p);
    Point first = shading_point(hit, toward);
    vec3 sum = vec3(0.0);
    uint count = 0u, invalid = 0u;
    RayCount rays = RayCount(0u, 0u);
    for (uint i = 0u; i < frame.spp; i++) {
        Sampler rng = start_sampler(index, frame.frame, i, frame.seed);
        vec3 l = trace_path(first, rng, rays);
        // A sample that is not finite counts as absent.
        if (finite3(l)) {
            sum += l;
            count++;
        } else {
            invalid++;
        }
    }
    radiance_out[index] = vec4(count > 0u ? sum / float(count) : vec3(0.0), float(count));
    COUNT(closest_rays, rays.closest)
    COUNT(shadow_rays, rays.shadow)
    COUNT(samples, frame.spp)
    COUNT(invalid_samples, invalid)
}
