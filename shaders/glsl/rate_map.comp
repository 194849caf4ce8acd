// Tiles into shading rates: [paper] eq. 1 to 4 for each tile of 16 x 16 pixels and each axis. Equals host/lab/src/twins/rate_map.rs bit for bit.
//
// Every comparison uses products of sums only, because division, root and power differ between devices.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "scene.glsl"

layout(local_size_x = 16) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_RATES, scalar) writeonly buffer Rates { uint rates[]; };

// What the pixels of one row of a tile contribute to the tile's rate.
struct Row {
    float luminance_sum;
    float square_x, square_y;
    float speed_x, speed_y;
    float size, angle;
    uint lit, pairs_x, pairs_y, odd;
};

shared Row rows_[16];

uint full_half_quarter(vec2 b, float square, float pairs, float size, float tau, float lit) {
    // b E d >= tau, with E^2 = square / pairs and tau = threshold / lit.
    precise float error = square * (size * size) * (lit * lit);
    precise float threshold = (tau * tau) * pairs;
    precise float half_ = (b.x * b.x) * error;
    precise float quarter = (b.y * b.y) * error;
    if (half_ >= threshold) return 0u;
    if (quarter < threshold) return 2u;
    return 1u;
}

vec2 rate_entry(uint i) { return vec2(optics[frame.rate_table_at + 2u * i], optics[frame.rate_table_at + 2u * i + 1u]); }

// b_H and b_Q of [Yang19] from a table: linear in v between entries that are 2^-10 of an octave apart, and (1, 2.13) at rest.
vec2 blur(float v) {
    if (v < 0.015625) {
        precise vec2 low = vec2(1.0, 2.13) + (rate_entry(0) - vec2(1.0, 2.13)) * (v * 64.0);
        return low;
    }
    uint bits = floatBitsToUint(v) - floatBitsToUint(0.015625);
    uint entry = bits >> 13u;
    if (entry + 1u >= RATE_TABLE_OCTAVE * RATE_TABLE_OCTAVES) return rate_entry(RATE_TABLE_OCTAVE * RATE_TABLE_OCTAVES - 1u);
    float f = float(bits & 8191u) * (1.0 / 8192.0);
    precise vec2 a = rate_entry(entry);
    precise vec2 r = a + (rate_entry(entry + 1u) - a) * f;
    return r;
}

// Luminance that the pixel showed in the last frame, -1 if nothing is known, and whether the pixel is lit.
float known_luminance(uint x, uint y, out bool lit) {
    lit = false;
    if (x >= frame.width || y >= frame.height) return 0.0;
    uint at = y * frame.width + x;
    lit = is_lit(surface_at(at));
    if (!lit) return 0.0;
    HistoryLight h = history_light_at(at);
    vec3 c = h.mean;
    precise float l = c.x * 0.2126 + c.y * 0.7152 + c.z * 0.0722;
    return h.weight > 0.0 ? l : -1.0;
}

// What row `y` of the tile at `origin` contributes.
Row read_row(uvec2 origin, uint y) {
    Row r = Row(0.0, 0.0, 0.0, INFINITY, INFINITY, 0.0, 180.0, 0u, 0u, 0u, 0u);
    for (uint i = 0u; i < 16u; i++) {
        uint x = origin.x + i;
        bool lit, lit_left = false, lit_above = false;
        float l = known_luminance(x, y, lit);
        if (!lit) continue;
        // A tile with a value that is unknown, negative or not finite is traced at full rate.
        if (!(l >= 0.0) || !finite(l)) r.odd++;
        precise float sum = r.luminance_sum + l;
        r.luminance_sum = sum;
        r.lit++;
        uint at = y * frame.width + x;
        Sight g = sight_at(at);
        float vx = abs(g.motion.x), vy = abs(g.motion.y);
        if (!finite(vx) || !finite(vy) || !finite(g.size)) r.odd++;
        r.speed_x = vx < r.speed_x ? vx : r.speed_x;
        r.speed_y = vy < r.speed_y ? vy : r.speed_y;
        r.size = g.size > r.size ? g.size : r.size;
        r.angle = g.angle < r.angle ? g.angle : r.angle;
        if (i > 0u) {
            float left = known_luminance(x - 1u, y, lit_left);
            if (lit_left) {
                precise float d = (l - left) * 0.5;
                precise float s = r.square_x + d * d;
                r.square_x = s;
                r.pairs_x++;
            }
        }
        if (y > origin.y) {
            float above = known_luminance(x, y - 1u, lit_above);
            if (lit_above) {
                precise float d = (l - above) * 0.5;
                precise float s = r.square_y + d * d;
                r.square_y = s;
                r.pairs_y++;
            }
        }
    }
    return r;
}

// The sums over all rows of the tile.
Row sum_rows() {
    Row t = rows_[0];
    for (uint i = 1u; i < 16u; i++) {
        Row o = rows_[i];
        precise float l = t.luminance_sum + o.luminance_sum;
        precise float sx = t.square_x + o.square_x;
        precise float sy = t.square_y + o.square_y;
        t.luminance_sum = l;
        t.square_x = sx;
        t.square_y = sy;
        t.speed_x = o.speed_x < t.speed_x ? o.speed_x : t.speed_x;
        t.speed_y = o.speed_y < t.speed_y ? o.speed_y : t.speed_y;
        t.size = o.size > t.size ? o.size : t.size;
        t.angle = o.angle < t.angle ? o.angle : t.angle;
        t.lit += o.lit;
        t.pairs_x += o.pairs_x;
        t.pairs_y += o.pairs_y;
        t.odd += o.odd;
    }
    return t;
}

// The rate of a tile with the sums `t`: log2 of a coarse pixel's width in bits 0 and 1, of its height in bits 2 and 3.
uint rate_of(Row t) {
    if (t.lit == 0u) return 0u;
    uint by_angle = t.angle <= frame.zone_degrees.x ? 0u : (t.angle > frame.zone_degrees.y ? 2u : 1u);
    uint rx = 0u, ry = 0u;
    if (t.odd == 0u) {
        float lit = float(t.lit);
        precise float mean = t.luminance_sum + frame.rate_l * lit;
        precise float tau = frame.rate_t * mean;
        rx = full_half_quarter(blur(t.speed_x), t.square_x, float(max(t.pairs_x, 1u)), t.size, tau, lit);
        ry = full_half_quarter(blur(t.speed_y), t.square_y, float(max(t.pairs_y, 1u)), t.size, tau, lit);
    }
    rx = max(rx, by_angle);
    ry = max(ry, by_angle);
    // The allowed rates are 1x1, 1x2, 2x1, 2x2, 2x4 and 4x2.
    if (rx == 2u && ry == 0u) rx = 1u;
    if (ry == 2u && rx == 0u) ry = 1u;
    if (rx == 2u && ry == 2u) {
        precise float ex = t.square_x * float(max(t.pairs_y, 1u));
        precise float ey = t.square_y * float(max(t.pairs_x, 1u));
        if (ex > ey) rx = 1u; else ry = 1u;
    }
    return rx | (ry << 2u);
}

void main() {
    uint tile = tiles[gl_WorkGroupID.x];
    uvec2 origin = uvec2(tile % frame.tiles_x, tile / frame.tiles_x) * 16u;
    rows_[gl_LocalInvocationID.x] = read_row(origin, origin.y + gl_LocalInvocationID.x);
    barrier();
    if (gl_LocalInvocationID.x == 0u) rates[tile] = rate_of(sum_rows());
}
