// Pixels into surfaces, sights and tints: what the projector's ray of each pixel meets, whether the eye sees that point, how it moves and how large it looks.
#version 460
#extension GL_GOOGLE_include_directive : require
#ifdef RAY_QUERY
#define FRAME_WHERE_USED
#endif
#include "scene.glsl"
#define ALPHA_TEST
#include "bvh.glsl"
#include "shading.glsl"
#include "bsdf.glsl"
#include "relight.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };

// Method dpm: in every fourth frame a block of 8 x 8 pixels traces all its rays, and takes nothing from the last frame.
bool asks_anew(uvec2 pixel) {
    return (frame.flags & FRAME_DPM) == 0u || frame.history_frame == NO_FRAME || (((pixel.x >> 3u) + 2u * (pixel.y >> 3u) + frame.drawn) & 3u) == 0u;
}

// Method dpm: in the last frame nothing was lit in this pixel or within two pixels of it, which is as far as a surface can have moved since.
// Surface that only another body's or the eye's motion uncovers here may wait for the block's turn.
bool still_dark(uvec2 pixel) {
    if (!HAS_GUIDES || (frame.flags & FRAME_STEADY) == 0u || asks_anew(pixel)) return false;
    bool dark = true;
    for (int i = 0; i < 25 && dark; i++) {
        ivec2 q = ivec2(pixel) + ivec2(i % 5, i / 5) - 2;
        // Anything may enter over the border of the raster.
        uint tap;
        dark = pixel_beside(q, tap) && former_tag_at(tap).frame != frame.history_frame;
    }
    return dark;
}

// Method dpm: in the last frame the eye saw this body here and everywhere around. Then the ray to the eye is traced in every fourth frame only.
// Light that the eye does not see is harmless, so an object that comes between the eye and the surface may wait. Nothing waits at borders.
bool still_seen(uvec2 pixel, uint instance, vec2 before) {
    if (asks_anew(pixel)) return false;
    // A surface that jumps may be anywhere.
    vec2 motion = abs(vec2(pixel) + 0.5 - before);
    if (!(max(motion.x, motion.y) < 4.0)) return false;
    ivec2 corner = ivec2(floor(clamp(before, vec2(-4.0), vec2(frame.width, frame.height) + 4.0)));
    const ivec2 around[5] = ivec2[](ivec2(0), ivec2(-2, -2), ivec2(2, -2), ivec2(-2, 2), ivec2(2, 2));
    bool seen = true;
    for (int i = 0; i < 5; i++) {
        ivec2 q = corner + around[i];
        uint tap;
        bool inside = pixel_beside(q, tap);
        HistoryTag tag = former_tag_at(tap);
        seen = seen && inside && tag.frame == frame.history_frame && tag.owner >> 24u == instance && (tag.owner & HISTORY_HIDDEN) == 0u;
    }
    return seen;
}

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    SurfaceHit surface = SurfaceHit(NO_HIT, 0.0);
    vec3 direction = pixel_direction(pixel);
    bool camera_is_eye = (frame.flags & FRAME_CAMERA_IS_EYE) != 0u;
    uint mask = camera_is_eye ? 0u : INSTANCE_PROJECTED;
    Hit hit = Hit(NO_HIT, vec2(0.0), INFINITY);
    uint at = pixel.y * frame.width + pixel.x, closest = still_dark(pixel) ? 0u : 1u, shadow = 0u;
    if (closest > 0u && trace_ray(frame.projector_position, direction, mask, NONE_LEFT, false, hit)) {
        uint instance = instance_of(hit.id), triangle = triangle_of(hit.id);
        surface.id = hit.id;
        surface.distance = hit.t;
        if (!camera_is_eye) {
            vec3 o = object_position(instance, triangle, hit.barycentric);
            vec3 p = transform_point(instance_at(instance).world_from_object, o);
            vec2 before = HAS_GUIDES ? project(transform_point(instance_at(instance).previous_world_from_object, o)) : vec2(0.0);
            vec3 g = transform_normal(instance_at(instance).world_from_object, object_normal(instance, triangle));
            vec3 to_eye = frame.eye_position - p;
            // The eye must be on the same side of the surface as the projector.
            float projector_side = -dot(g, direction), eye_side = dot(g, to_eye);
            bool lit = projector_side * eye_side > 0.0;
            if (lit && !(HAS_GUIDES && still_seen(pixel, instance, before))) {
                vec3 offset = g * (sign(eye_side) * surface_offset(p, instance));
                Hit blocker;
                blocker.t = 1.0;
                shadow = 1u;
                lit = !trace_ray(p + offset, to_eye - offset, INSTANCE_PROJECTED, NONE_LEFT, true, blocker);
            }
            if (!lit) surface.distance = -hit.t;
            if (HAS_GUIDES) {
                vec3 to_projector = -p;
                float l_p = length(to_projector), l_e = length(to_eye);
                vec3 to_gaze = frame.gaze_point - frame.eye_position;
                float c = dot(-to_eye, to_gaze) / max(l_e * length(to_gaze), 1e-12);
                float angle = degrees(acos(clamp(c, -1.0, 1.0)));
                if (HAS_DEMODULATION) {
                    vec3 albedo = demodulation(hit, to_eye / max(l_e, 1e-12));
                    set_tint(at, Tint(packHalf2x16(albedo.rg), packHalf2x16(vec2(albedo.b, angle))));
                }
                if (!HAS_DEMODULATION || (frame.flags & FRAME_SHOWS_ALL) != 0u) {
                    // [paper] eq. 3, limited where the light falls at a grazing angle.
                    float size = min((abs(eye_side) / max(l_e * l_e, 1e-12)) * (l_p * l_p / max(abs(dot(g, to_projector)), 1e-6)), 1e3);
                    set_sight(at, Sight(vec2(pixel) + 0.5 - before, size, angle));
                }
            }
        }
    }
    set_surface(at, surface);
    set_barycentric(at, Barycentric(hit.barycentric));
    COUNT(rays, closest + shadow)
    COUNT(camera_rays, closest + shadow)
}
