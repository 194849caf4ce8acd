// A path between two dispatches: what it has, and what waits for the rays from its newest vertex.
#define WALK_APART
#include "path.glsl"
#include "queue.glsl"

// Bits of a path's flags beside those of WAITS_FOR_LIGHT and the like; from bit 8 on the number of the vertex.
const uint PATH_WAITS = 7u, PATH_EXACT = 8u, PATH_DELTA = 16u;

uint path_row(uint slot) { return queue_places.w + slot * (HAS_ABSORPTION ? 6u : 4u); }

// Keeps the path of a sample and asks for its rays. `goes_on`: what `branch` has said.
void keep_path(uint slot, Path path, Branches b, bool goes_on, Sampler rng, uint at) {
    uint waits = goes_on ? b.waits : 0u, row = path_row(slot);
    uint flags = waits | (path.exact != 0u ? PATH_EXACT : 0u) | (b.next.delta ? PATH_DELTA : 0u) | path.vertex << 8u;
    queue_rows[row] = uvec4(floatBitsToUint(path.radiance), floatBitsToUint(b.sky));
    queue_rows[row + 1u] = uvec4(floatBitsToUint(path.throughput), floatBitsToUint(b.next.pdf));
    queue_rows[row + 2u] = uvec4(floatBitsToUint(b.light), rng.index);
    queue_rows[row + 3u] = uvec4(at, rng.seed, 0u, flags);
    if (HAS_ABSORPTION) {
        queue_rows[row + 4u] = uvec4(floatBitsToUint(b.absorption), 0u);
        queue_rows[row + 5u] = uvec4(floatBitsToUint(path.at.p), 0u);
    }
    // The last ray of a path only says whether there is anything, unless that may glow.
    uint onward = !HAS_EMISSIVE && path.vertex + 1u >= frame.depth ? RAY_ANY : RAY_CLOSEST;
    ask(2u * slot, b.light_origin, b.light_t, b.light_direction, (waits & WAITS_FOR_LIGHT) != 0u ? RAY_ANY : RAY_NONE);
    ask(2u * slot + 1u, b.origin, INFINITY, b.next.direction, (waits & WAITS_ONWARD) != 0u ? onward : RAY_NONE);
}

// The path of a sample once its rays are walked, with the light of a lamp that nothing hides. Returns its flags.
uint take_path(uint slot, out Path path, out Branches b, out Sampler rng, out uint at) {
    uint row = path_row(slot);
    uvec4 r0 = QUEUE(row), r1 = QUEUE(row + 1u), r2 = QUEUE(row + 2u), r3 = QUEUE(row + 3u);
    uvec4 start = ray_start(2u * slot + 1u), way = ray_way(2u * slot + 1u);
    uint flags = r3.w;
    at = r3.x;
    path.radiance = uintBitsToFloat(r0.xyz);
    path.throughput = uintBitsToFloat(r1.xyz);
    path.exact = (flags & PATH_EXACT) != 0u ? 1u : 0u;
    path.vertex = flags >> 8u;
    b.sky = uintBitsToFloat(r0.w);
    b.next.pdf = uintBitsToFloat(r1.w);
    b.next.delta = (flags & PATH_DELTA) != 0u;
    b.next.direction = uintBitsToFloat(way.xyz);
    b.origin = uintBitsToFloat(start.xyz);
    b.light = uintBitsToFloat(r2.xyz);
    b.absorption = vec3(0.0);
    if (HAS_ABSORPTION) {
        b.absorption = uintBitsToFloat(QUEUE(row + 4u).xyz);
        path.at.p = uintBitsToFloat(QUEUE(row + 5u).xyz);
    }
    rng = Sampler(r3.y, r2.w, uvec2(at % frame.width, at / frame.width));
    if ((flags & WAITS_FOR_LIGHT) != 0u && hit_of(2u * slot) == NO_HIT) path.radiance += limit_indirect(b.light, path.vertex);
    return flags;
}

// Keeps what has become of a path that has ended.
void end_path(uint slot, vec3 radiance, bool exact, uint at) {
    uint row = path_row(slot);
    queue_rows[row] = uvec4(floatBitsToUint(radiance), 0u);
    queue_rows[row + 3u] = uvec4(at, 0u, 0u, exact ? PATH_EXACT : 0u);
}
