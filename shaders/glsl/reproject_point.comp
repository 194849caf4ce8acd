// The histories of the last frame, each moved to the pixel in which its surface point is now (method dpm).
//
// A history belongs to one surface point for as long as the point is visible, so nothing is resampled. The pixel's own surface point is at most
// half a pixel away. A plane through the histories around extrapolates from the history's point to the pixel's: the shift.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "reproject.glsl"
#include "importance.glsl"
#include "demand.glsl"
#include "shift.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_SCHEDULE, scalar) buffer ScheduleBlock { Schedule schedule; };

// Where histories are looked for.
// A history may lie this many footprints off the tangent plane of the surface point.
const float DEPTH = 0.5;
// Former places are clamped to this many pixels around the raster, so that they can be converted to integers.
const float MARGIN_PX = 4.0;
// A history whose point is further than this from the pixel's centre is not carried to it. Pixels along the farther axis.
const float FARTHEST_PX = 1.5;
// A point within this distance of the pixel's centre is in the pixel: half a pixel and some slack. Pixels.
const float IN_PIXEL_PX = 0.6;
// A hidden point has to be in the pixel itself. Pixels.
const float HIDDEN_PX = 0.5;
// With fewer valid histories than this among the nine around, a point lies at the border of what is known.
const uint ALL_AROUND = 8u;

// The plane through the histories.
// Added to the variance of their places, so that points on top of each other have no slope. Square pixels.
const float LEAST_SPREAD = 1e-3;
// The plane has no slope where the determinant of the covariance of the places is smaller: the points lie on one line. Pixels^4.
const float LEAST_DETERMINANT = 1e-3;

// A new point.
// Frames' worth of samples that it takes over from the histories around, at the gaze and in the periphery. What it takes over is a guess that
// stays as bias. Without it there is noise, which flickers.
const float TAKEN_OVER = 6.0, TAKEN_OVER_PERIPHERY = 24.0;
// Its place is moved along the surface only where the ray meets the surface less obliquely than this cosine: 84 degrees.
const float LEAST_ALONG = 0.1;
// Noise is never taken as smaller than this power, so that one can divide by it.
const float LEAST_NOISE = 1e-8;

// How long a history serves.
// Lag counts beyond this many times the power that chance explains, and beyond this share of the light.
const float LAG_BEYOND_CHANCE = 1.0, LEAST_LAG = 0.007;
// Weight of the power of noise against that of lag. Points of a sequence average out sooner than frames that are independent, and the spatial filter
// removes some of the noise, but noise also costs flicker.
const float NOISE_COUNTS = 0.5;
// Weight of the structure that the plane leaves over.
const float STRUCTURE_COUNTS = 5.0;
// Structure never cuts a history to fewer frames than this.
const float LEAST_CRISP_FRAMES = 0.3;
// Structure does not count while the point moves by less than this. Pixels a frame.
const float SAME_PLACE_PX = 0.05;

// The valid histories around a pixel: sums over them, weighted by their samples unless noted.
struct Around {
    uint count;
    float weight;
    // Places of their points from the pixel's centre, pixels.
    float x, y, xx, xy, yy;
    // Means, and their squared luminance.
    vec3 mean, mean_x, mean_y;
    float squares;
    // Not weighted: squared drift, surprise, and variance of a sample.
    float lag_power, noise_power, variance;
    // The range of the means.
    vec3 lower, upper;
    // The history whose point is nearest to the pixel's centre, NO_HIT: none; its distance, and its place.
    uint nearest;
    float distance;
    vec2 apart;
};

// A plane through the means of the histories around, over the raster.
struct Plane {
    vec3 mean;
    vec3 slope_x, slope_y;
    // Luminance of the mean, and mean square by which the luminances miss the plane.
    float level, scatter;
};

// Whether the numbers of a history and the place `e` of its point are finite.
bool is_sound(HistoryLight l, HistoryNoise n, vec2 e) {
    return finite(n.drift) && finite(n.variance) && finite(n.surprise) && finite3(l.mean) && finite(l.weight) && finite(e.x + e.y);
}

// Adds the history `tap`, whose point is at `e` from the pixel's centre, if it is `used`. There is no branch, see `WRITTEN_OUT`.
void add_history(inout Around a, uint tap, HistoryLight light, HistoryNoise noise, vec2 e, bool used) {
    vec3 m = used ? light.mean : vec3(0.0);
    float w = used ? light.weight : 0.0;
    e = used ? e : vec2(0.0);
    float y = luminance(m);
    vec2 we = w * e;
    a.weight += w;
    a.count += used ? 1u : 0u;
    a.x += we.x;
    a.y += we.y;
    a.xx += we.x * e.x;
    a.xy += we.x * e.y;
    a.yy += we.y * e.y;
    a.mean += w * m;
    a.squares += w * y * y;
    a.mean_x += we.x * m;
    a.mean_y += we.y * m;
    a.lag_power += used ? noise.drift * noise.drift : 0.0;
    a.noise_power += used ? noise.surprise : 0.0;
    a.variance += used ? noise.variance : 0.0;
    a.lower = min(a.lower, used ? m : vec3(INFINITY));
    a.upper = max(a.upper, used ? m : vec3(-INFINITY));
    float far = max(abs(e.x), abs(e.y));
    bool nearer = used && far < a.distance;
    a.distance = nearer ? far : a.distance;
    a.nearest = nearer ? tap : a.nearest;
    a.apart = nearer ? e : a.apart;
}

// Whether a body's point `p` in world space, with a normal in body space, faces the projector.
bool faces(vec4 world_from_object[3], uint normal, vec3 p) {
    return dot(transform_vector(world_from_object, normal_direction(normal)), p) < 0.0;
}

// The valid histories among the nine around the former place of a surface point. At a pixel that is not `lit` those are valid whose points
// face the projector, wherever on the body they lie.
Around look_around(Place place, vec2 centre, bool lit) {
    Around a = Around(0u, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, vec3(0.0), vec3(0.0), vec3(0.0), 0.0, 0.0, 0.0, 0.0,
                      vec3(INFINITY), vec3(-INFINITY), NO_HIT, lit ? FARTHEST_PX : HIDDEN_PX, vec2(0.0));
    ivec2 corner = ivec2(floor(clamp(place.before, vec2(-MARGIN_PX), vec2(frame.width, frame.height) + MARGIN_PX)));
    vec4 world_from_object[3] = instance_at(place.instance).world_from_object;
    [[dont_unroll]] for (int row = -1; row <= 1; row++) {
        WRITTEN_OUT for (int column = -1; column <= 1; column++) {
            uint tap;
            bool valid = pixel_beside(corner + ivec2(column, row), tap);
            SKIP_UNLESS(valid)
            valid = is_known(former_tag_at(tap), former_light_at(tap), place.instance) && valid;
            SKIP_UNLESS(valid)
            HistoryPlace former = former_place_at(tap);
            vec3 p = transform_point(world_from_object, former.position);
            valid = (lit ? is_close(former, place, DEPTH) : faces(world_from_object, former.normal, p)) && valid;
            SKIP_UNLESS(valid)
            HistoryLight light = former_light_at(tap);
            HistoryNoise noise = former_noise_at(tap);
            vec2 e = project(p) - centre;
            valid = is_sound(light, noise, e) && valid;
            SKIP_UNLESS(valid)
            add_history(a, tap, light, noise, e, valid);
        }
    }
    return a;
}

// The plane by weighted least squares.
Plane plane_through(Around a) {
    float s = 1.0 / a.weight;
    float x = a.x * s;
    float y = a.y * s;
    float xx = a.xx * s - x * x + LEAST_SPREAD;
    float xy = a.xy * s - x * y;
    float yy = a.yy * s - y * y + LEAST_SPREAD;
    Plane p;
    p.mean = a.mean * s;
    vec3 with_x = a.mean_x * s - x * p.mean;
    vec3 with_y = a.mean_y * s - y * p.mean;
    float determinant = xx * yy - xy * xy;
    p.slope_x = vec3(0.0);
    p.slope_y = vec3(0.0);
    if (determinant > LEAST_DETERMINANT) {
        p.slope_x = (yy * with_x - xy * with_y) / determinant;
        p.slope_y = (xx * with_y - xy * with_x) / determinant;
    }
    p.level = luminance(p.mean);
    float fit = luminance(p.slope_x) * luminance(with_x) + luminance(p.slope_y) * luminance(with_y);
    p.scatter = max(a.squares * s - p.level * p.level - fit, 0.0);
    return p;
}

// How the plane changes from a place to another that is `away` from it.
vec3 step_along(Plane p, vec2 away) { return -(p.slope_x * away.x + p.slope_y * away.y); }

// Limits the step from a history's point to the pixel's. The light stays within the range of the histories around, and the step within half of the
// largest of them. Larger steps are unstable: the stored mean is the shown light minus the step, so with short histories a step as large as the
// light would feed itself.
vec3 bounded_shift(vec3 mean, vec3 shift, vec3 lower, vec3 upper) {
    vec3 most = 0.5 * max(abs(lower), abs(upper));
    return clamp(clamp(mean + shift, lower, upper) - mean, -most, most);
}

// The length of a history, in frames' worth of samples, that serves best where light changes. A history of n frames lags by n times the slope of
// the light over time, and its noise in what the eye sees is that of n + EYE_FRAMES frames. The sum of both powers is least where
// n (n + EYE_FRAMES)^2 is half the ratio of noise to slope. The root is taken as the geometric mean of two estimates, which is exact where n is far
// below or far above the eye's frames. `frames` frames lag by `lag_power`. All powers are of luminance without albedo.
float useful_frames(float lag_power, float frame_noise, float light_power, float frames) {
    float by_chance = frame_noise * (LAG_WEIGHT / (2.0 - LAG_WEIGHT));
    float beyond = lag_power - LAG_BEYOND_CHANCE * (by_chance + LEAST_LAG * LEAST_LAG * light_power);
    if (!(beyond > 0.0)) return INFINITY;
    float q = 0.5 * NOISE_COUNTS * frame_noise * frames * frames / beyond;
    float n = min(pow(q, 1.0 / 3.0), q / (EYE_FRAMES * EYE_FRAMES));
    return max(sqrt(n * q / (EYE_FRAMES * EYE_FRAMES + 2.0 * EYE_FRAMES * n + n * n)), 2.0);
}

// The same where light varies from point to point by more than a plane explains. A history is the mean over all places in its pixel that were
// sampled, which blurs. Where that error is larger than a frame's noise, single frames serve better. A point that hardly moves is sampled in one
// place, so its history stays.
float crisp_frames(float structure, float frame_noise, vec2 motion) {
    if (!(structure > 0.0)) return INFINITY;
    return max(max(frame_noise / structure, LEAST_CRISP_FRAMES), SAME_PLACE_PX / max(length(motion), 1e-6));
}

// The shorter of both lengths, from the histories around. `light` is the luminance of the albedo, and all powers are without it.
float longest_useful(Around a, Plane p, float light, float per_frame, vec2 motion) {
    float frames = max(a.weight / float(a.count) / per_frame, 1.0);
    float to_power = 1.0 / (float(a.count) * light * light), of_frame = a.variance * to_power / per_frame;
    float useful = useful_frames(a.lag_power / float(a.count), a.noise_power * to_power, p.level * p.level, frames);
    if (a.count > 1u) useful = min(useful, crisp_frames(STRUCTURE_COUNTS * max(p.scatter - of_frame / frames, 0.0), of_frame, motion));
    return useful;
}

// Moves the point of `h` along the surface, so that it lies a whole number of pixels beside the nearest history's point and the points stay a
// lattice. Returns its place from the pixel's centre.
vec2 place_on_lattice(inout History h, Place place, vec2 centre, vec2 apart) {
    vec2 e = apart - round(apart);
    vec3 n = transform_vector(instance_at(h.instance).world_from_object, place.normal);
    vec3 own = transform_point(instance_at(h.instance).world_from_object, h.position);
    vec3 direction = projector_direction(centre + e);
    float along = dot(n, direction);
    if (abs(along) > LEAST_ALONG) h.position = transform_point(instance_at(h.instance).object_from_world, direction * (dot(n, own) / along));
    else e = vec2(0.0);
    return e;
}

// Samples that a new point takes over with the mean of `known`. The guess is as good as the histories around agree: by their scatter about the plane,
// or by their range where they lie on one side of the point. What chance explains of either does not count.
float taken_over(History known, Around a, Plane p, float light, float per_frame, float angle) {
    float noise = max(known.surprise, LEAST_NOISE);
    float expected = noise * per_frame / known.weight, rest;
    if (a.count < ALL_AROUND) {
        float range = luminance(a.upper - a.lower) * light;
        rest = 0.5 * max(range * range - 4.0 * expected, 0.0);
    } else {
        rest = 2.0 * max(p.scatter * light * light - expected, 0.0);
    }
    float weight = 1.0 / (1.0 / known.weight + rest / (noise * per_frame));
    return min(weight, mix(TAKEN_OVER, TAKEN_OVER_PERIPHERY, periphery(angle)) * per_frame);
}

// Carries `known`, the nearest of the histories around, into `h`, or begins a new point beside it where no history's point is in the pixel. Returns
// the shift from the history's point to the pixel's.
vec3 carry_point(inout History h, History known, Around a, Place place, uvec2 pixel, uint at) {
    vec2 centre = vec2(pixel) + 0.5;
    Plane p = plane_through(a);
    float light = luminance(albedo_of(tint_at(at))), per_frame = samples_a_frame();
    float useful = longest_useful(a, p, light, per_frame, centre - place.before);
    known.weight = min(known.weight, useful * per_frame);
    if (a.distance <= IN_PIXEL_PX) {
        h = known;
        return bounded_shift(known.mean, step_along(p, a.apart), a.lower, a.upper);
    }
    vec2 e = place_on_lattice(h, place, centre, a.apart);
    known.mean = clamp(known.mean + step_along(p, a.apart - e), a.lower, a.upper);
    known.position = h.position;
    known.normal = h.normal;
    known.seed = h.seed;
    known.used = 0u;
    known.flags = (known.flags & ~HISTORY_BORDER) | (a.count < ALL_AROUND ? HISTORY_BORDER : 0u);
    known.weight = taken_over(known, a, p, light, per_frame, angle_of(tint_at(at)));
    h = known;
    return bounded_shift(known.mean, step_along(p, e), a.lower, a.upper);
}

// One of the eight pixels around that is lit, the pixel itself: none.
uvec2 lit_beside(uvec2 pixel) {
    const ivec2 beside[8] = ivec2[](ivec2(-1, 0), ivec2(1, 0), ivec2(0, -1), ivec2(0, 1), ivec2(-1, -1), ivec2(1, -1), ivec2(-1, 1), ivec2(1, 1));
    uvec2 found = pixel;
    WRITTEN_OUT for (int i = 7; i >= 0; i--) {
        ivec2 q = ivec2(pixel) + beside[i];
        uint index;
        bool there = pixel_beside(q, index);
        if (is_lit(surface_at(index)) && there) found = uvec2(q);
    }
    return found;
}

// The history of a pixel, and the shift from its point to the pixel's. Returns whether there is one. Lit pixels always have one.
//
// A pixel beside a body's edge keeps the history of a point that is in it, although its own ray misses the body. The next frame may bring the pixel
// back onto the body. The body that is lit beside it would have shown this pixel in the last frame as far away as it did that one.
// `variance` is that of a sample by the histories around without the point's own.
bool carry(uvec2 pixel, uint at, bool lit, out History h, out vec3 shift, out float variance) {
    shift = vec3(0.0);
    variance = 0.0;
    uvec2 of = lit ? pixel : lit_beside(pixel);
    if (!lit && of == pixel) return false;
    Place place = place_of(of, of.y * frame.width + of.x);
    place.before += vec2(pixel) - vec2(of);
    Around a = look_around(place, vec2(pixel) + 0.5, lit);
    h = begin_history(place, at);
    if (a.nearest != NO_HIT) {
        History known = former_at(a.nearest);
        variance = a.count > 1u ? max(a.variance - known.variance, 0.0) / float(a.count - 1u) : 0.0;
        known.frame = frame.frame;
        if (lit) shift = carry_point(h, known, a, place, pixel, at);
        else h = known;
    }
    h.flags = lit ? h.flags & ~HISTORY_HIDDEN : h.flags | HISTORY_HIDDEN;
    return lit || a.nearest != NO_HIT;
}

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    uint importance = 0u, demand = DEMAND_NOT_LIT;
    bool lit = is_lit(surface_at(at));
    History h;
    vec3 shift;
    float variance;
    bool keeps = carry(pixel, at, lit, h, shift, variance);
    if (lit) {
        set_shift(at, pack_shift(shift));
        importance = importance_of(h, variance, luminance(albedo_of(tint_at(at))) * frame.mean_light);
        demand = importance | ((h.flags & HISTORY_EXACT) != 0u ? DEMAND_EXACT : 0u) | (h.used == 0u ? DEMAND_NEW : 0u);
    }
    set_demand(at, demand);
    // Once for both, because software Vulkan writes lane by lane.
    if (keeps) {
        write_history(at, h);
        write_noise(at, h);
    } else {
        write_no_history(at);
    }
    uint total = subgroupAdd(importance);
    uint lit_total = subgroupAdd(lit ? 1u : 0u);
    if (subgroupElect() && lit_total > 0u) {
        atomicAdd(schedule.importance, total);
        atomicAdd(schedule.lit, lit_total);
    }
}
