// The light of a reduced raster at the panel's own pixels, where the four traced pixels around one show one even surface: what the pixel's ray meets of
// their triangles. Pixels for which these do not serve are listed for the pass `edges`. See cells.glsl.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_EXT_shader_atomic_int64 : require
#ifdef TEXEL_TABLES
#define READ_BEFORE
#endif
#include "enlarge.glsl"

layout(local_size_x = 64) in;

// How far the weights of a triangle's corners may lie beyond the triangle, where a mesh is finer than the traced raster.
const float BEYOND_TRIANGLE = 1.0;
// There the pixel's own triangle is not known, so it may lie beyond a crease: all taps have to agree as far as this, the eighth power of a cosine.
const float ALIKE = 0.43;

// What all pixels of a cell share.
struct Cell {
    Taps taps;
    bool lit;
    uint material;    // Of the triangle of the first tap.
    vec3 origin;      // Of the projector's rays, in the body's space.
    vec3 corners[12]; // Of the triangles of the four taps, relative to it. Software Vulkan has read them before.
};

uint row_of(uint body, uint id) { return (BODY_AT(body).triangle_offset + triangle_of(id)) * 3u; }

Cell cell_of(Taps t) {
    Cell c;
    uint body = min(instance_of(t.id.x), max(frame.instance_count, 1u) - 1u);
#ifdef TEXEL_TABLES
    own_body = instance_at(body);
#endif
    c.taps = t;
    c.lit = t.distance.x > 0.0;
    c.material = triangle_ref_at(BODY_AT(body).triangle_offset + triangle_of(t.id.x)).material;
    c.origin = transform_point(BODY_AT(body).object_from_world, frame.projector_position);
#ifdef TEXEL_TABLES
    own_material = material_at(c.material);
    [[unroll]] for (int k = 0; k < 4; k++) own_lights[k] = light_of(t.at[k]);
    if (LAMPS == 1u) own_lamp = lamp_at(0u);
    [[unroll]] for (int i = 0; i < 12; i++) c.corners[i] = TRI(row_of(body, t.id[i / 3]) + uint(i % 3)).xyz - c.origin;
#endif
    return c;
}

bool meets(Cell c, LocalRay ray, uint k, out float distance_, out vec2 b) {
#ifdef TEXEL_TABLES
    return intersect_corners(ray, c.corners[3u * k], c.corners[3u * k + 1u], c.corners[3u * k + 2u], 0.0, INFINITY, distance_, b);
#else
    return intersect_triangle(ray, row_of(instance_of(c.taps.id.x), c.taps.id[k]), 0.0, INFINITY, distance_, b);
#endif
}

// Where the ray meets the triangles of taps on one body, that of the nearest tap first. If it meets none of them, it goes on in the plane of the nearest
// one: the mesh is finer than the traced raster.
Hit hit_of(Cell c, vec2 beyond, vec3 direction, out bool inside) {
    uint nearest = (beyond.x >= 0.5 ? 1u : 0u) | (beyond.y >= 0.5 ? 2u : 0u), body = instance_of(c.taps.id.x), best = 4u;
    LocalRay ray = local_ray(c.origin, transform_vector(BODY_AT(body).object_from_world, direction));
    Hit hit = Hit(NO_HIT, vec2(0.0), INFINITY);
    // Software Vulkan tests all four in one order, because each is in its place.
    WRITTEN_OUT for (uint i = 0u; i < 4u; i++) {
#ifdef TEXEL_TABLES
        uint k = i, rank = i ^ nearest;
#else
        uint k = i ^ nearest, rank = i;
#endif
        uint id = c.taps.id[k];
        float distance_;
        vec2 b;
        bool within = meets(c, ray, k, distance_, b);
        if (HAS_ALPHA_MASK) within = within && alpha_present(body, triangle_of(id), b);
        bool goes_on = !HAS_ALPHA_MASK && rank == 0u && distance_ > 0.0 && distance_ < INFINITY;
        bool taken = within ? rank < best : goes_on && best == 4u;
        best = within ? min(rank, best) : best;
        hit.id = taken ? id : hit.id;
        hit.t = taken ? distance_ : hit.t;
        hit.barycentric = taken ? clamp(b, vec2(-BEYOND_TRIANGLE), vec2(1.0 + BEYOND_TRIANGLE)) : hit.barycentric;
#ifndef TEXEL_TABLES
        if (within) break;
#endif
    }
    inside = best < 4u;
    return hit;
}

// Whether all taps lie in the tangent plane of the pixel's point.
bool is_plane(Surround g, Taps t) {
    float most = 0.0;
    [[unroll]] for (int k = 0; k < 4; k++) most = max(most, off_plane(g, t.corner + ivec2(k & 1, k >> 1), t.distance[k]));
    return most <= g.farthest;
}

// Writes a pixel, unless what it shows is not that of the cell: returns whether it was written.
bool enlarge(uvec2 pixel, Cell c, inout uint lit, inout uint nans, inout uint clipped) {
    vec3 direction = pixel_direction(pixel);
    bool inside;
    float least;
    Hit hit = hit_of(c, place_of(ivec2(pixel)) - vec2(c.taps.corner), direction, inside);
    bool even = hit.id != NO_HIT;
    Hit known = Hit(even ? hit.id : c.taps.id.x, hit.barycentric, hit.t);
    Surround g = surround_of(pixel, known, direction);
    vec4 light = mean_of(g, c.taps, least);
    even = even && is_plane(g, c.taps) && (!c.lit || (inside ? light.w > 0.0 : least >= ALIKE));
    even = even && triangle_ref_at(BODY_AT(g.body).triangle_offset + triangle_of(known.id)).material == c.material;
    bool shows = c.lit && even;
    own_light = with_texture(light.rgb, known, direction);
    if (!even) hit = Hit(NO_HIT, vec2(0.0), INFINITY);
    if (!shows) own_light = vec3(0.0);
    write_pixel(pixel, pixel.y * panel_size.x + pixel.x, hit, shows, nans, clipped);
    lit += shows ? 1u : 0u;
    return even;
}

void main() {
    uint item = list_item();
#ifdef LANE_HAS_CELL
    uint number = item;
#else
    uint number = item / CELL_LANES;
#endif
    if (number >= uint(even_list.listed)) return;
    ivec2 cell = unpack_cell(lists[number].first);
    uvec2 from = uvec2(first_of(cell)), to = uvec2(first_of(cell + 1));
#ifndef LANE_HAS_CELL
    // A lane has one pixel.
    uint k = item - number * CELL_LANES, columns = most_pixels().x;
    from += uvec2(k % columns, k / columns);
    if (any(greaterThanEqual(from, to))) return;
    to = from + 1u;
#endif
    Cell c = cell_of(taps_of(cell));
    uint lit = 0u, nans = 0u, clipped = 0u, left = 0u, bit = 1u, before;
    uvec2 p = from;
#ifdef LANE_HAS_CELL
    do {
#endif
        left |= enlarge(p, c, lit, nans, clipped) ? 0u : bit;
        bit <<= 1u;
        p = p.x + 1u < to.x ? uvec2(p.x + 1u, p.y) : uvec2(from.x, p.y + 1u);
#ifdef LANE_HAS_CELL
    } while (p.y < to.y);
#endif
    ADD_TO_LIST(edge_list, uint(bitCount(left)), 1u, before)
    float columns_ = float(to.x - from.x);
    bool any_left = left != 0u;
    do {
        uint k = uint(max(findLSB(left), 0)), row = uint((float(k) + 0.5) / columns_);
        if (any_left) lists[before++].pixel = (from.y + row) * panel_size.x + from.x + k - row * (to.x - from.x);
        left &= left - 1u;
        any_left = any_left && left != 0u;
    } while (any_left);
    COUNT(lit_pixels, lit)
    COUNT_RARE(nan_values, nans)
    COUNT_RARE(clipped_values, clipped)
}
