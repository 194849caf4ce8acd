// The panel's pixels by what the traced pixels around them show: cells with one even surface are listed, the pixels of cells without any are made black, and
// all other pixels are listed one by one. A lane takes a cell. See cells.glsl.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_EXT_shader_atomic_int64 : require
#define COARSE_TABLES
#include "scene.glsl"
#include "cells.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_CODES, scalar) writeonly buffer Codes { uint codes[]; };

// Whether all taps show one body, and all or none of them are lit.
bool is_even(Taps t) {
    uint body = t.id.x >> 24u;
    bool same = t.id.x != NO_HIT && t.id.y >> 24u == body && t.id.z >> 24u == body && t.id.w >> 24u == body;
    bvec4 lit = greaterThan(t.distance, vec4(0.0));
    return same && (all(lit) || !any(lit));
}

void make_black(uint index) {
    set_surface(index, SurfaceHit(NO_HIT, 0.0));
    codes[index] = 0u;
    if ((frame.flags & FRAME_SHOWS_ALL) != 0u) {
        set_barycentric(index, Barycentric(vec2(0.0)));
        shown[index] = vec4(0.0);
    }
}

void main() {
    uvec2 of_tile = cells_of_tile();
    uint each = of_tile.x * of_tile.y, number = gl_GlobalInvocationID.x / each, rest = gl_GlobalInvocationID.x - number * each;
    uint tile = tiles[min(number, max(frame.tile_count, 1u) - 1u)];
    ivec2 corner = ivec2(tile % frame.tiles_x, tile / frame.tiles_x) * 16;
    // A cell belongs to the tile of its first pixel.
    ivec2 first = cell_at(corner);
    first = max(first + ivec2(lessThan(first_of(first), corner)), ivec2(0));
    ivec2 cell = first + ivec2(rest % of_tile.x, rest / of_tile.x);
    bool of_tiles = number < frame.tile_count;
    // Those before the first traced column and row belong to no tile, and are worked on in every frame.
    if (!of_tiles) {
        int behind = int(gl_GlobalInvocationID.x - frame.tile_count * each), rows = int(traced_size.y) + 1;
        cell = behind < rows ? ivec2(-1, behind - 1) : ivec2(behind - rows, -1);
    }
    ivec2 from = first_of(cell), to = first_of(cell + 1);
    ivec2 end = of_tiles ? min(corner + 16, to) : to;
    bool mine = all(lessThan(from, end)) && all(lessThan(cell, ivec2(traced_size)));
    Taps t = taps_of(cell);
    bool even = mine && is_even(t), nothing = mine && t.id == uvec4(NO_HIT), edge = mine && !even && !nothing;
    uint place, before;
    ADD_TO_LIST(even_list, even ? 1u : 0u, CELL_LANES, place)
    if (even) lists[place].first = pack_cell(cell);
    ADD_TO_LIST(edge_list, edge ? uint((to.x - from.x) * (to.y - from.y)) : 0u, 1u, before)
    ivec2 p = from;
    bool more;
    do {
        uint index = uint(p.y) * panel_size.x + uint(p.x);
        if (edge) lists[before++].pixel = index;
        if (nothing) make_black(index);
        p = p.x + 1 < to.x ? ivec2(p.x + 1, p.y) : ivec2(from.x, p.y + 1);
        more = (edge || nothing) && p.y < to.y;
    } while (more);
}
