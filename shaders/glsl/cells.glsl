// What the passes of a reduced raster share (`render.scale` below 1). A cell is the square between the centres of four traced pixels, and has the panel's
// pixels that lie in it. Cells are numbered by their upper left traced pixel, which is one before the raster at its first column and row.
//
// The pass `cells` lists cells whose four traced pixels show one even surface, and the pixels of all others that have one; the pass `enlarge` works on the
// first list, and adds to the second, on which the pass `edges` works.

layout(set = 0, binding = B_COARSE_FRAME, scalar) readonly buffer CoarseFrameBlock { Frame coarse; };
layout(set = 0, binding = B_SHOWN, scalar) writeonly buffer Shown { vec4 shown[]; };
layout(set = 0, binding = B_SCHEDULE, scalar) buffer ScheduleBlock {
    Schedule edge_list; // Of pixels.
    Schedule even_list; // Of cells.
};
// Of each item, `pixel` belongs to the list of pixels and `first` to the list of cells.
layout(set = 0, binding = B_WORK, scalar) buffer Lists { WorkItem lists[]; };

// Workgroups in a row that work on a list, and lanes of each.
const uint LIST_GROUPS_IN_A_ROW = 32768u, LIST_LANES = 64u;

// Read once, where every lane is active.
uvec2 traced_size = uvec2(coarse.width, coarse.height), panel_size = uvec2(frame.width, frame.height);
float traced_pixel_size = coarse.pixel_size;

// Where a pixel of the panel is, in traced pixels from the centre of the first of the raster.
vec2 place_of(ivec2 pixel) { return (vec2(pixel) + 0.5) * vec2(traced_size) / vec2(panel_size) - 0.5; }

ivec2 cell_at(ivec2 pixel) { return ivec2(floor(place_of(pixel))); }

// The first column and row of a cell.
ivec2 first_of(ivec2 cell) {
    // Rounding may be off by one.
    ivec2 p = ivec2(ceil((vec2(cell) + 0.5) * vec2(panel_size) / vec2(traced_size) - 0.5));
    p += ivec2(lessThan(cell_at(p), cell));
    p -= ivec2(greaterThanEqual(cell_at(p - 1), cell));
    return clamp(p, ivec2(0), ivec2(panel_size));
}

// The most columns and rows of a cell. Where a border between cells can fall on a pixel's centre, rounding may add one.
uvec2 most_pixels() {
    uvec2 whole = panel_size / traced_size, rest = panel_size - whole * traced_size;
    return whole + mix(whole & 1u, uvec2(1u), notEqual(rest, uvec2(0u)));
}

// Cells of which a tile of the panel has the first pixel, at most.
uvec2 cells_of_tile() { return (16u * traced_size + panel_size - 1u) / panel_size; }

uint pack_cell(ivec2 cell) { return uint(cell.x + 1) | uint(cell.y + 1) << 16u; }
ivec2 unpack_cell(uint bits) { return ivec2(int(bits & 0xffffu), int(bits >> 16u)) - 1; }

// Traced pixels around a cell.
struct Taps {
    ivec2 corner;  // The upper left one.
    uvec4 at;      // Index of each: upper left, upper right, lower left, lower right.
    uvec4 id;      // What each shows.
    vec4 distance; // As in SurfaceHit.
};

uint coarse_index(ivec2 q) {
    q = clamp(q, ivec2(0), ivec2(traced_size) - 1);
    return uint(q.y) * traced_size.x + uint(q.x);
}

Taps taps_of(ivec2 cell) {
    Taps t;
    t.corner = cell;
    [[unroll]] for (int k = 0; k < 4; k++) {
        t.at[k] = coarse_index(cell + ivec2(k & 1, k >> 1));
        SurfaceHit surface = coarse_surface_at(t.at[k]);
        t.id[k] = surface.id;
        t.distance[k] = surface.distance;
    }
    return t;
}

// Makes a list longer by what each lane adds, and its dispatch by as many lanes a piece. Gives the place of the first that this lane adds. To be called
// by every invocation that works.
#define ADD_TO_LIST(list, added, lanes, before)                                                                     \
    {                                                                                                               \
        uint sum_ = subgroupAdd(added), own_ = subgroupExclusiveAdd(added), from_ = 0u;                              \
        if (sum_ != 0u && subgroupElect()) {                                                                         \
            from_ = uint(atomicAdd(list.listed, uint64_t(sum_)));                                                    \
            uint groups_ = ((from_ + sum_) * (lanes) + LIST_LANES - 1u) / LIST_LANES;                                \
            atomicMax(list.groups[0], min(groups_, LIST_GROUPS_IN_A_ROW));                                           \
            if (groups_ > LIST_GROUPS_IN_A_ROW) atomicMax(list.groups[1], (groups_ + LIST_GROUPS_IN_A_ROW - 1u) / LIST_GROUPS_IN_A_ROW); \
        }                                                                                                           \
        before = subgroupBroadcastFirst(from_) + own_;                                                               \
    }

// The number of this invocation among those that work on a list.
uint list_item() { return gl_GlobalInvocationID.x + gl_WorkGroupID.y * (LIST_GROUPS_IN_A_ROW * LIST_LANES); }

// Lanes that work on a cell. On software Vulkan one lane has all pixels of a cell, so that what they share is read once.
#ifdef TEXEL_TABLES
#define LANE_HAS_CELL
const uint CELL_LANES = 1u;
#else
uint cell_lanes() { uvec2 n = most_pixels(); return n.x * n.y; }
#define CELL_LANES cell_lanes()
#endif
