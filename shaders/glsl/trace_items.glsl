// The work list, where the paths of a pixel begin, and what its samples add up to.
layout(set = 0, binding = B_SCHEDULE, scalar) readonly buffer ScheduleBlock { Schedule schedule; };
layout(set = 0, binding = B_WORK, scalar) readonly buffer Work { WorkItem work[]; };
// Mean of the samples in rgb, and their number in w.
layout(set = 0, binding = B_RADIANCE, scalar) writeonly buffer Radiance { vec4 radiance_out[]; };

// Samples that the pixel's point had used before the frame, and `HISTORY_EXACT`.
uint used_before(uint at) { return uint(history_used_at(at).before); }

// The list of this frame: its items, and the samples of all of them.
struct WorkList {
    uint items;
    uint samples;
};

// To be read while all lanes are active.
WorkList work_list() {
    uvec2 listed = unpackUint2x32(schedule.listed);
    return WorkList(listed.x, listed.y);
}

uint first_sample_of(WorkList list, uint item) { return item < list.items ? work[item].first : list.samples; }

uint group_index() { return gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x; }

uvec2 pixel_of(uint at) { return uvec2(at % frame.width, at / frame.width); }

// The place in the random sequence from which the samples of the pixel at index `at`, `spp` in this frame, go on.
Sampler begin_sampler(uint at, uint spp) {
    Sampler rng = Sampler(frame.seed, 0u, pixel_of(at));
    if (SAMPLER == SAMPLER_INDEPENDENT) {
        rng.seed = hash_u32(at + hash_u32(frame.frame + hash_u32(frame.seed)));
    } else if (SAMPLER == SAMPLER_BLUE_NOISE) {
        rng.seed = hash_u32(frame.frame + hash_u32(frame.seed));
    } else if (SAMPLER == SAMPLER_PIXEL_SEQUENCE) {
        // The pixel's own sequence continues where the last frame left it. A number of samples by angle is the same in every frame.
        rng.seed = hash_u32(at + hash_u32(frame.seed));
        rng.index = (frame.flags & FRAME_SPP_BY_ANGLE) != 0u ? frame.drawn * spp : frame.first_sample;
    } else {
        rng.seed = history_seed_at(at).seed;
        rng.index = used_before(at) & ~HISTORY_EXACT;
    }
    return rng;
}

// Where the paths of the pixel at index `at` begin.
Hit first_hit(uint at) {
    SurfaceHit surface = surface_at(at);
    return Hit(surface.id, barycentric_at(at).weights, abs(surface.distance));
}

// Unit direction from there to the eye.
vec3 toward_eye(Hit first) {
    uint instance = instance_of(first.id);
    vec3 p = transform_point(instance_at(instance).world_from_object, object_position(instance, triangle_of(first.id), first.barycentric));
    bool camera_is_eye = (frame.flags & FRAME_CAMERA_IS_EYE) != 0u;
    return normalize((camera_is_eye ? frame.projector_position : frame.eye_position) - p);
}

// What only an ordinary camera traces: the background.
vec3 background(uint at) { return environment_radiance(pixel_direction(pixel_of(at))); }

// What the samples of a pixel add up to, in their order.
struct Sums {
    vec3 light;
    float squares; // Of the luminances.
    uint count;
    bool exact;    // The last sample has all of the pixel's light, so that none follows.
};

const Sums NO_SAMPLES = Sums(vec3(0.0), 0.0, 0u, false);

// A sample that is not finite is dropped. True: it was counted.
bool add_sample(inout Sums sums, vec3 light, bool exact) {
    bool valid = finite3(light);
    if (valid) {
        float y = luminance(light);
        sums.light += light;
        sums.squares += y * y;
        sums.count++;
    }
    sums.exact = exact;
    return valid;
}

void write_sums(uint at, Sums sums) {
    radiance_out[at] = vec4(sums.count > 0u ? sums.light / float(sums.count) : vec3(0.0), float(sums.count));
    if ((frame.flags & FRAME_DPM) != 0u) set_demand(at, pack_moments(Moments(sums.squares, sums.exact)));
}
