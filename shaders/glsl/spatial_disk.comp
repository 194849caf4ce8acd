// Spatial filter of the picture, never of the history: the mean over a Poisson disk in the periphery (methods paper and miyamoto).
#version 460
#extension GL_GOOGLE_include_directive : require
#include "spatial.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

// Radius of the disk, pixels.
const float RADIUS_PX = 4.0;
// Exponent of the cosine between normals: the weight of a neighbour whose normal differs by 12 degrees is a half.
const float NORMAL_POWER = 32.0;

// [paper]: the disk's mean is blended in between two angles from the gaze.
vec3 disk_mean(uvec2 pixel, uint at, vec3 own) {
    float blend = periphery(sight_at(at).angle);
    if (!(blend > 0.0)) return own;
    uint instance = surface_at(at).id >> 24u;
    vec3 position = history_place_at(at).position;
    vec3 normal = decode_normal(history_place_at(at).normal);
    float footprint = abs(surface_at(at).distance) * frame.pixel_size;
    mat2 rotation = turn_of(pixel, 1u);
    vec3 sum = own;
    float total = 1.0;
    for (int i = 0; i < 12; i++) {
        ivec2 q = ivec2(pixel) + ivec2(round(rotation * DISK[i] * RADIUS_PX));
        uint tap;
        if (q == ivec2(pixel) || !neighbour(q, instance, tap)) continue;
        vec3 apart = history_place_at(tap).position - position;
        float w = max(dot(decode_normal(history_place_at(tap).normal), normal), 0.0);
        w = pow(w, NORMAL_POWER) * exp(-abs(dot(apart, normal)) / max(footprint, 1e-12));
        sum += w * filtered_at(tap).light;
        total += w;
    }
    return mix(own, sum / total, blend);
}

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    shown[at] = is_lit(surface_at(at)) ? vec4(disk_mean(pixel, at, filtered_at(at).light), 1.0) : vec4(0.0);
}
