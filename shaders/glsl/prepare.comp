// What the passes `enlarge` and `edges` need of each traced pixel in one row of a table: its light, without what the panel's own surface divides it by
// where textures make that finer, and its smooth normal in its body's space.
#version 460
#extension GL_GOOGLE_include_directive : require
#define COARSE_TABLES
#include "scene.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_SHOWN, scalar) readonly buffer Shown { vec4 shown[]; };

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint index = pixel.y * frame.width + pixel.x;
    SurfaceHit surface = surface_at(index);
    vec3 light = vec3(0.0);
    uint normal = 0u;
    if (is_lit(surface)) {
        light = shown[index].rgb;
        if (HAS_DEMODULATION && HAS_TEXTURES) light /= max(albedo_of(tint_at(index)), vec3(1e-6));
        TriangleRef ref = triangle_ref_at(instance_at(surface.id >> 24u).triangle_offset + (surface.id & 0xffffffu));
        vec2 b = barycentric_at(index).weights;
        vec3 n = vertex_at(ref.vertices.x).normal * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).normal * b.x + vertex_at(ref.vertices.z).normal * b.y;
        normal = encode_normal(n);
    }
    set_coarse_light(index, Filtered(light, normal));
}
