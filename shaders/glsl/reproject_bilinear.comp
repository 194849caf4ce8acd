// The histories of the last frame, fetched bilinearly at the former place of each surface point (methods paper and miyamoto).
//
// Every fetch resamples the picture, which blurs it by up to 1/4 px^2 a frame.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "reproject.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

// A history may lie this many footprints off the tangent plane of the surface point.
const float DEPTH = 2.0;
// A former place that is closer to a pixel's centre than this counts as that centre, so that a picture at rest is not resampled. Pixels.
const float AT_REST_PX = 2e-3;
// Histories with less bilinear weight than this in all are as good as none.
const float LEAST_TOTAL = 1e-3;

// Weighted sums over the histories that are blended.
struct Blend {
    vec3 mean;
    float weight;
    float total;
    // The history with the largest weight.
    uint nearest;
    float best;
};

// The four histories around `before`, as far as they are valid for the surface point.
Blend blend_around(Place place) {
    vec2 base = floor(place.before - 0.5);
    vec2 f = place.before - 0.5 - base;
    if (abs(f.x - round(f.x)) < AT_REST_PX && abs(f.y - round(f.y)) < AT_REST_PX) {
        base += round(f);
        f = vec2(0.0);
    }
    ivec2 corner = ivec2(base);
    Blend c = Blend(vec3(0.0), 0.0, 0.0, 0u, 0.0);
    for (int i = 0; i < 4; i++) {
        ivec2 o = ivec2(i & 1, i >> 1);
        ivec2 q = corner + o;
        float w = (o.x == 1 ? f.x : 1.0 - f.x) * (o.y == 1 ? f.y : 1.0 - f.y);
        uint tap;
        if (!pixel_beside(q, tap) || w <= 0.0) continue;
        HistoryLight former = former_light_at(tap);
        if (!is_known(former_tag_at(tap), former, place.instance) || !is_close(former_place_at(tap), place, DEPTH)) continue;
        c.mean += w * former.mean;
        c.weight += w * former.weight;
        c.total += w;
        if (w > c.best) {
            c.best = w;
            c.nearest = tap;
        }
    }
    return c;
}

// Leaves `h` as it is where no history is valid.
void carry_bilinear(inout History h, Place place) {
    if (!all(greaterThan(place.before, vec2(0.0))) || !all(lessThan(place.before, vec2(frame.width, frame.height)))) return;
    Blend c = blend_around(place);
    if (!(c.total > LEAST_TOTAL) || !finite3(c.mean) || !finite(c.weight)) return;
    float s = 1.0 / c.total;
    h.mean = c.mean * s;
    h.weight = c.weight * s;
    h.seed = former_seed_at(c.nearest).seed;
}

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint at = pixel.y * frame.width + pixel.x;
    if (!is_lit(surface_at(at))) {
        write_no_history(at);
        return;
    }
    Place place = place_of(pixel, at);
    History h = begin_history(place, at);
    carry_bilinear(h, place);
    write_history(at, h);
}
