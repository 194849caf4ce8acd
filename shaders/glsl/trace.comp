// Work items into radiance toward the eye: `spp` paths from the surface point of each listed pixel.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "path.glsl"
#include "moments.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = B_SCHEDULE, scalar) readonly buffer ScheduleBlock { Schedule schedule; };
layout(set = 0, binding = B_WORK, scalar) readonly buffer Work { WorkItem work[]; };
// Mean of the samples in rgb, and their number in w.
layout(set = 0, binding = B_RADIANCE, scalar) writeonly buffer Radiance { vec4 radiance_out[]; };
// Method dpm: `Moments` of the samples. The buffer holds the history's picture from the pass accumulate on.
layout(set = 0, binding = B_FILTERED, scalar) writeonly buffer MomentsBlock { Filtered moments[]; };

// The place in the random sequence from which the pixel's samples go on.
Sampler begin_sampler(WorkItem item, uvec2 pixel) {
    Sampler rng = Sampler(frame.seed, 0u, pixel);
    if (SAMPLER == SAMPLER_INDEPENDENT) {
        rng.seed = hash_u32(item.pixel + hash_u32(frame.frame + hash_u32(frame.seed)));
    } else if (SAMPLER == SAMPLER_BLUE_NOISE) {
        rng.seed = hash_u32(frame.frame + hash_u32(frame.seed));
    } else if (SAMPLER == SAMPLER_PIXEL_SEQUENCE) {
        // The pixel's own sequence continues where the last frame left it. A number of samples by angle is the same in every frame.
        rng.seed = hash_u32(item.pixel + hash_u32(frame.seed));
        rng.index = (frame.flags & FRAME_SPP_BY_ANGLE) != 0u ? frame.drawn * item.spp : frame.first_sample;
    } else {
        History h = history_at(item.pixel);
        rng.seed = h.seed;
        rng.index = h.index;
    }
    return rng;
}

// The first vertex of the paths of a pixel.
Point first_point(Surface surface) {
    Hit hit = Hit(surface.id, surface.barycentric, abs(surface.distance));
    uint instance = instance_of(hit.id);
    vec3 p = transform_point(instance_at(instance).world_from_object, object_position(instance, triangle_of(hit.id), hit.barycentric));
    bool camera_is_eye = (frame.flags & FRAME_CAMERA_IS_EYE) != 0u;
    return shading_point(hit, normalize((camera_is_eye ? frame.projector_position : frame.eye_position) - p));
}

// Software Vulkan computes it once. On a GPU it would live across every walk, in two dozen registers, so it is computed again for each sample.
#ifdef TEXEL_TABLES
#define FIRST_POINT first
#else
#define FIRST_POINT first_point(surface_at(item.pixel))
#endif

void main() {
    // This is read while all lanes are active. There is at least one item, because otherwise no workgroup is dispatched.
    uint items = schedule.items;
    WorkItem item = work[min(gl_GlobalInvocationID.x, items - 1u)];
    if (gl_GlobalInvocationID.x >= items) return;
    Surface surface = surface_at(item.pixel);
    uvec2 pixel = uvec2(item.pixel % frame.width, item.pixel / frame.width);
    if (surface.id == NO_HIT) {
        // Only an ordinary camera traces the background.
        radiance_out[item.pixel] = vec4(environment_radiance(pixel_direction(pixel)), 1.0);
        return;
    }
#ifdef TEXEL_TABLES
    Point first = first_point(surface);
#endif
    Sampler rng = begin_sampler(item, pixel);
    vec3 sum = vec3(0.0);
    float sum_squares = 0.0;
    uint count = 0u, invalid = 0u;
    bool dpm = (frame.flags & FRAME_DPM) != 0u, exact = false;
    uint rays = 0u;
    // A lane whose path ends begins its next sample at once, while the paths of its neighbours continue.
    Path path;
    bool begins = true;
    uint left = item.spp;
    do {
        if (begins) path = begin_path(FIRST_POINT);
        begins = !advance_path(path, rng, rays);
        if (begins) {
            // A sample that is not finite is dropped.
            bool valid = finite3(path.radiance);
            vec3 l = valid ? path.radiance : vec3(0.0);
            float y = luminance(l);
            sum += l;
            sum_squares += y * y;
            count += valid ? 1u : 0u;
            invalid += valid ? 0u : 1u;
            rng.index++;
            exact = dpm && path.exact;
            left = exact ? 0u : left - 1u;
        }
    } while (left > 0u);
    radiance_out[item.pixel] = vec4(count > 0u ? sum / float(count) : vec3(0.0), float(count));
    if (dpm) moments[item.pixel] = pack_moments(Moments(sum_squares, exact));
    COUNT(rays, rays)
    COUNT(samples, count + invalid)
    COUNT_RARE(invalid_samples, invalid)
}
