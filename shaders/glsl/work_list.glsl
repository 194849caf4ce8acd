// The samples of each pixel into an unordered list of work items, and into the size of the pass `trace`.
#include "scene.glsl"
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_EXT_shader_atomic_int64 : require

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_SCHEDULE, scalar) buffer ScheduleBlock { Schedule schedule; };
layout(set = 0, binding = B_WORK, scalar) writeonly buffer Work { WorkItem work[]; };

// Workgroups of the pass `trace` in a row. Devices may take no more than 65535 in one dimension.
const uint GROUPS_IN_A_ROW = 32768u;

// An ordinary camera traces every pixel alike, the background with one sample.
bool camera_is_eye() { return (frame.flags & FRAME_CAMERA_IS_EYE) != 0u; }
uint samples_of_camera(uint at) { return surface_at(at).id == NO_HIT ? 1u : frame.spp; }

#include "group_samples.glsl"

// Workgroups of the pass `trace` for a list that ends with these items and samples: on software Vulkan a lane takes an item, on a GPU a workgroup
// takes the items of a range of samples.
uint groups_of(uvec2 end) {
#ifdef TEXEL_TABLES
    return (end.x + TRACE_LANES - 1u) / TRACE_LANES;
#else
    return (end.y + group_samples(end.x, end.y) - 1u) / group_samples(end.x, end.y);
#endif
}

void ask_for_groups(uint groups) {
    atomicMax(schedule.groups[0], min(groups, GROUPS_IN_A_ROW));
    if (groups > GROUPS_IN_A_ROW) atomicMax(schedule.groups[1], (groups + GROUPS_IN_A_ROW - 1u) / GROUPS_IN_A_ROW);
}

// Lists the pixel at index `at` with `spp` samples. To be called by every invocation of a workgroup; those outside the raster bring no samples.
void list_work(uint at, uint spp) {
    uvec4 ballot = subgroupBallot(spp > 0u);
    uint items = subgroupBallotBitCount(ballot);
    if (items == 0u) return;
    uint samples_before = subgroupExclusiveAdd(spp);
    uvec2 added = uvec2(items, subgroupAdd(spp));
    uvec2 before = uvec2(0u);
    if (subgroupElect()) {
        // Both counts in one step, so that the samples of the items in the list are in the order of the items.
        before = unpackUint2x32(atomicAdd(schedule.listed, packUint2x32(added)));
        ask_for_groups(groups_of(before + added));
    }
    before = subgroupBroadcastFirst(before);
    if (spp > 0u) work[before.x + subgroupBallotExclusiveBitCount(ballot)] = WorkItem(at, before.y + samples_before);
}
