// The light of a reduced raster at the panel's own pixels, where the four traced pixels around one show one even surface: what the pixel's ray meets of
// their triangles. All other pixels are listed for the pass `edges`. See enlarge.glsl.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_EXT_shader_atomic_int64 : require
#include "enlarge.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_WORK, scalar) writeonly buffer Edges { WorkItem edges[]; };

// How far the weights of a triangle's corners may lie beyond the triangle, where a mesh is finer than the traced raster.
const float BEYOND_TRIANGLE = 1.0;
// There the pixel's own triangle is not known, so it may lie beyond a crease: all taps have to agree as far as this, the eighth power of a cosine.
const float ALIKE = 0.43;

uint pick(uvec4 v, uint k) { return (k & 2u) == 0u ? ((k & 1u) == 0u ? v.x : v.y) : ((k & 1u) == 0u ? v.z : v.w); }

// Whether all taps show one body, and all or none of them are lit.
bool is_even(Taps t) {
    uint body = instance_of(t.id.x);
    bool same = t.id.x != NO_HIT && instance_of(t.id.y) == body && instance_of(t.id.z) == body && instance_of(t.id.w) == body;
    bvec4 lit = greaterThan(t.distance, vec4(0.0));
    return same && (all(lit) || !any(lit));
}

// Where the ray meets the triangles of taps on one body, that of the nearest tap first. If it meets none of them, it goes on in the plane of the nearest
// one: the mesh is finer than the traced raster.
Hit hit_of(Taps t, vec3 direction, out bool inside) {
    uint nearest = (t.beyond.x >= 0.5 ? 1u : 0u) | (t.beyond.y >= 0.5 ? 2u : 0u);
    uint body = min(instance_of(t.id.x), max(frame.instance_count, 1u) - 1u);
    LocalRay ray = local_ray(transform_point(instance_at(body).object_from_world, frame.projector_position),
                             transform_vector(instance_at(body).object_from_world, direction));
    uint first = instance_at(body).triangle_offset, k = 0u;
    Hit hit = Hit(NO_HIT, vec2(0.0), INFINITY);
    inside = false;
    do {
        uint id = pick(t.id, nearest ^ k);
        float distance_;
        vec2 b;
        inside = intersect_triangle(ray, (first + triangle_of(id)) * 3u, 0.0, INFINITY, distance_, b);
        if (HAS_ALPHA_MASK) inside = inside && alpha_present(body, triangle_of(id), b);
        bool goes_on = !HAS_ALPHA_MASK && k == 0u && distance_ > 0.0 && distance_ < INFINITY;
        if (inside || goes_on) hit = Hit(id, clamp(b, vec2(-BEYOND_TRIANGLE), vec2(1.0 + BEYOND_TRIANGLE)), distance_);
        k++;
    } while (!inside && k < 4u);
    return hit;
}

// Whether all taps lie in the tangent plane of the pixel's point.
bool is_plane(Surround g, Taps t) {
    float most = 0.0;
    [[unroll]] for (int k = 0; k < 4; k++) most = max(most, off_plane(g, t, t.corner + ivec2(k & 1, k >> 1), t.distance[k]));
    return most <= g.farthest;
}

void list_edge(uint index, bool listed) {
    uvec4 ballot = subgroupBallot(listed);
    uint items = subgroupBallotBitCount(ballot), before = 0u;
    if (items == 0u) return;
    if (subgroupElect()) {
        before = uint(atomicAdd(schedule.listed, uint64_t(items)));
        uint groups = (before + items + EDGE_LANES - 1u) / EDGE_LANES;
        atomicMax(schedule.groups[0], min(groups, EDGE_GROUPS_IN_A_ROW));
        if (groups > EDGE_GROUPS_IN_A_ROW) atomicMax(schedule.groups[1], (groups + EDGE_GROUPS_IN_A_ROW - 1u) / EDGE_GROUPS_IN_A_ROW);
    }
    before = subgroupBroadcastFirst(before);
    if (listed) edges[before + subgroupBallotExclusiveBitCount(ballot)] = WorkItem(index, 0u);
}

void main() {
    uvec2 pixel;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel)) return;
    uint index = pixel.y * frame.width + pixel.x;
    vec3 direction = pixel_direction(pixel);
    Taps t = taps_of(pixel);
    Hit hit = Hit(NO_HIT, vec2(0.0), INFINITY);
    bool even = is_even(t), lit = even && t.distance.x > 0.0;
    own_light = vec3(0.0);
    if (even) {
        bool inside;
        float least;
        hit = hit_of(t, direction, inside);
        even = hit.id != NO_HIT;
        uint known = even ? hit.id : t.id.x;
        Surround g = surround_of(pixel, Hit(known, hit.barycentric, hit.t), direction);
        vec4 light = mean_of(g, t, least);
        even = even && is_plane(g, t) && (!lit || (inside ? light.w > 0.0 : least >= ALIKE));
        own_light = lit && even ? with_texture(light.rgb, Hit(known, hit.barycentric, hit.t), direction) : vec3(0.0);
    }
    bool nothing = t.id == uvec4(NO_HIT);
    if (!even) hit = Hit(NO_HIT, vec2(0.0), INFINITY);
    write_pixel(pixel, index, hit, lit && even);
    list_edge(index, !even && !nothing);
}
