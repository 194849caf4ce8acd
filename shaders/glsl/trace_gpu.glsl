// The work list on a GPU, where the lanes of a subgroup wait for the one that works longest. A workgroup takes the pixels of a range of samples, a
// lane that is free takes the next sample, whichever pixel it belongs to, and the light of each lies in shared memory until all are done. Then each
// pixel's samples are added in their order, so that no sum depends on which lane was free.
#extension GL_KHR_shader_subgroup_ballot : require
#include "group_samples.glsl"

// For each sample first its pixel, its number among the pixel's samples, and how many those are; while it is traced its pixel, and the index and the
// seed of its random numbers; then its light, as bits.
shared uint slots[3u * TRACE_SLOTS];
// A bit for each sample that has all of its pixel's light.
shared uint exact_slots[TRACE_SLOTS / 32u];
// A bit for each sample that waits for the one before it, because the pixel was deterministic in the last frame: if it still is, the first sample has
// all of its light.
shared uint waiting_slots[TRACE_SLOTS / 32u];
// The next sample that no lane has taken.
shared uint next_slot;
// The pixel whose samples end in a later round: what they add up to so far. Written in one round and read in the next.
shared Sums carried[2];

// The workgroup's part of the list: its items, and their samples. It lies in shared memory, because in registers it would live across every walk.
struct Range {
    uint first_item;
    uint end_item;
    uint first;
    uint end;
};
shared Range range;

// The first item between `first` and `end` whose samples begin at or behind `sample_index`, or `end`. Every lane looks at another item, so that few
// looks are enough. To be called by every invocation.
uint find_item(uint sample_index, uint first, uint end) {
    while (first < end) {
        uint step = (end - first + gl_SubgroupSize - 1u) / gl_SubgroupSize;
        uint at = first + gl_SubgroupInvocationID * step;
        bool before = at < end && work[at].first < sample_index;
        uint lanes = subgroupBallotBitCount(subgroupBallot(before));
        if (lanes == 0u) return first;
        end = min(end, first + lanes * step);
        first += (lanes - 1u) * step + 1u;
    }
    return first;
}

void find_range() {
    WorkList list = work_list();
    uint group = group_index(), length = group_samples(list.items, list.samples);
    uint first = find_item(group * length, 0u, list.items);
    // Every item has a sample at least.
    uint end = find_item((group + 1u) * length, first, min(list.items, first + length));
    if (gl_LocalInvocationIndex == 0u) range = Range(first, end, first_sample_of(list, first), first_sample_of(list, end));
}

// Where the samples of an item end.
uint end_of(uint item) { return item + 1u < range.end_item ? work[item + 1u].first : range.end; }

bool is_exact(uint slot) { return (exact_slots[slot / 32u] >> (slot % 32u) & 1u) != 0u; }
bool waits(uint slot) { return (waiting_slots[slot / 32u] >> (slot % 32u) & 1u) != 0u; }

// The samples of the range from `base` on into the slots, as many as there is room for.
void fill_slots(uint base) {
    uint lane = gl_LocalInvocationIndex;
    if (lane < TRACE_SLOTS / 32u) {
        exact_slots[lane] = 0u;
        waiting_slots[lane] = 0u;
    }
    if (lane == 0u) next_slot = 0u;
    barrier();
    bool dpm = (frame.flags & FRAME_DPM) != 0u;
    for (uint item = range.first_item + lane; item < range.end_item; item += TRACE_LANES) {
        uint at = work[item].pixel, first = work[item].first, end = end_of(item);
        bool was_exact = dpm && (used_before(at) & HISTORY_EXACT) != 0u;
        for (uint i = max(first, base); i < min(end, base + TRACE_SLOTS); i++) {
            uint slot = i - base;
            // What comes first in a round waits for nothing.
            if (was_exact && i > first && slot > 0u) atomicOr(waiting_slots[slot / 32u], 1u << (slot % 32u));
            slots[slot] = at;
            slots[slot + TRACE_SLOTS] = i - first;
            slots[slot + 2u * TRACE_SLOTS] = end - first;
        }
    }
}

void keep_light(uint slot, vec3 light, bool exact) {
    uvec3 bits = floatBitsToUint(light);
    slots[slot] = bits.x;
    slots[slot + TRACE_SLOTS] = bits.y;
    slots[slot + 2u * TRACE_SLOTS] = bits.z;
    if (exact) atomicOr(exact_slots[slot / 32u], 1u << (slot % 32u));
}

// Where the path of a slot's sample begins. Its random numbers are then told by the slot. False: it has no path, because it is the background.
bool begin_slot(uint slot, out Hit hit) {
    uint at = slots[slot];
    hit = first_hit(at);
    if (hit.id == NO_HIT) return false;
    Sampler rng = begin_sampler(at, slots[slot + 2u * TRACE_SLOTS]);
    slots[slot + 2u * TRACE_SLOTS] = rng.seed;
    slots[slot + TRACE_SLOTS] += rng.index;
    return true;
}

Sampler sampler_of(uint slot) { return Sampler(slots[slot + 2u * TRACE_SLOTS], slots[slot + TRACE_SLOTS], pixel_of(slots[slot])); }

// The light of every slot. A lane whose path ends takes the next slot at once, while the paths of its neighbours continue.
void trace_slots(uint base) {
    uint rays = 0u;
    Path path;
    Branches branches;
    Hit hit;
    // What the lane is about, in one word, because each bool would take a scalar register: the path of its slot is yet to begin, and it has traced the
    // sample before the slot's.
    const uint BEGINS = 1u, FOLLOWS = 2u;
    uint state = BEGINS;
    uint count = min(range.end - base, TRACE_SLOTS);
    uint slot = atomicAdd(next_slot, 1u);
    while (slot < count) {
        bool begins = (state & BEGINS) != 0u;
        bool is_left_out = state == BEGINS && waits(slot);
        bool ended = is_left_out || begins && !begin_slot(slot, hit);
        if (ended) {
            path.radiance = background(slots[slot]);
            path.exact = 0u;
        } else {
            // The code that shades is large, and stands once for all vertices.
            Point s = shading_point(hit, begins ? toward_eye(hit) : -normalize(branches.next.direction));
            if (begins) path = begin_path(s, sampler_of(slot), hit.id);
            else ended = !arrive(path, branches, hit, s);
            ended = ended || !branch(path, sampler_of(slot), rays, branches) || !follow(path, branches, hit);
        }
        state &= FOLLOWS;
        if (ended) {
            bool exact = (frame.flags & FRAME_DPM) != 0u && path.exact != 0u;
            if (!is_left_out) keep_light(slot, path.radiance, exact);
            bool follows = !is_left_out && !exact && slot + 1u < count && waits(slot + 1u);
            slot = follows ? slot + 1u : atomicAdd(next_slot, 1u);
            state = follows ? BEGINS | FOLLOWS : BEGINS;
        }
    }
    COUNT(rays, rays_of(rays))
    COUNT(proven_rays, proven_rays_of(rays))
}

// Adds the light of the slots, pixel by pixel, and writes the pixels whose last sample is among them.
void add_slots(uint base) {
    uint round = (base - range.first) / TRACE_SLOTS, samples = 0u, invalid = 0u;
    for (uint item = range.first_item + gl_LocalInvocationIndex; item < range.end_item; item += TRACE_LANES) {
        uint at = work[item].pixel, first = work[item].first, end = end_of(item);
        uint from = max(first, base), to = min(end, base + TRACE_SLOTS);
        if (from >= to) continue;
        Sums sums = NO_SAMPLES;
        if (from > first) sums = carried[(round + 1u) & 1u];
        uint slot = from - base;
        for (; slot < to - base && !sums.exact; slot++) {
            vec3 light = uintBitsToFloat(uvec3(slots[slot], slots[slot + TRACE_SLOTS], slots[slot + 2u * TRACE_SLOTS]));
            if (!add_sample(sums, light, is_exact(slot))) invalid++;
        }
        // The background has no path, and a sample that still waits was not traced.
        uint traced = slot - (from - base);
        for (; slot < to - base; slot++) traced += waits(slot) ? 0u : 1u;
        if (surface_at(at).id != NO_HIT) samples += traced;
        if (to < end) carried[round & 1u] = sums;
        else write_sums(at, sums);
    }
    COUNT(samples, samples)
    COUNT_RARE(invalid_samples, invalid)
}

void main() {
    find_range();
    barrier();
    uint base = range.first;
    do {
        fill_slots(base);
        barrier();
        trace_slots(base);
        barrier();
        add_slots(base);
        base += TRACE_SLOTS;
        // The slots are filled anew only after all have been added.
        if (MANY_SAMPLES) barrier();
    } while (MANY_SAMPLES && base < range.end);
}
