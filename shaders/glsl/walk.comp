// Rays of a frame through its bodies, in their order, a lane each: the walk alone, for `dpm bench --walk`.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"
#include "bvh.glsl"

layout(local_size_x = TRACE_LANES) in;

// Two rows a ray: origin and length, direction and kind.
layout(set = 0, binding = B_SHOWN, scalar) readonly buffer RayRows { uvec4 ray_rows[]; };
layout(set = 0, binding = B_CODES, scalar) writeonly buffer Hits { uint hits[]; };

void main() {
    uint ray = gl_WorkGroupID.x * TRACE_LANES + gl_LocalInvocationIndex, count = uint(hits.length());
    uvec4 start = ray_rows[2u * min(ray, count - 1u)], way = ray_rows[2u * min(ray, count - 1u) + 1u];
    if (ray >= count) return;
    Hit hit;
    hit.t = uintBitsToFloat(start.w);
    bool any_hit = (way.w & 255u) == RAY_ANY;
    bool met = trace_ray(uintBitsToFloat(start.xyz), uintBitsToFloat(way.xyz), way.w >> 8u, NONE_LEFT, any_hit, hit);
    hits[ray] = met ? hit.id : NO_HIT;
}
