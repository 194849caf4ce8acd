// The samples of each pixel into an unordered list of work items, and into the size of the pass `trace`.
#include "scene.glsl"
#extension GL_KHR_shader_subgroup_ballot : require

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_RADIANCE, scalar) writeonly buffer Radiance { vec4 radiance_out[]; };
layout(set = 0, binding = B_SCHEDULE, scalar) buffer ScheduleBlock { Schedule schedule; };
layout(set = 0, binding = B_WORK, scalar) writeonly buffer Work { WorkItem work[]; };

// Work items of a workgroup of the pass `trace`.
const uint TRACE_WORKGROUP = 64u;

// An ordinary camera traces every pixel alike, the background with one sample.
bool camera_is_eye() { return (frame.flags & FRAME_CAMERA_IS_EYE) != 0u; }
uint samples_of_camera(uint at) { return surface_at(at).id == NO_HIT ? 1u : frame.spp; }

// Lists the pixel at index `at` with `spp` samples. To be called by every invocation of a workgroup; those that are not `inside` the raster bring
// no samples.
void list_work(uint at, bool inside, uint spp) {
    // The radiance of traced pixels is written by the pass `trace`, that of the others here.
    if (inside && spp == 0u) radiance_out[at] = vec4(0.0);
    uvec4 ballot = subgroupBallot(spp > 0u);
    uint count = subgroupBallotBitCount(ballot);
    if (count == 0u) return;
    uint first = 0u;
    if (subgroupElect()) {
        first = atomicAdd(schedule.items, count);
        atomicMax(schedule.groups[0], (first + count + TRACE_WORKGROUP - 1u) / TRACE_WORKGROUP);
    }
    first = subgroupBroadcastFirst(first);
    if (spp > 0u) work[first + subgroupBallotExclusiveBitCount(ballot)] = WorkItem(at, spp);
}
