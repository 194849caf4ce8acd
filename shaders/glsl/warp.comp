// Planes that follow the bodies: each group of bits is taken from the pixel whose surface is at this mirror at the group's instant. Equals the CPU's
// `Drawn::word` bit for bit. Where the highest bit is split, what is taken is a code value, which is cut into a level by the place of the body that is
// there.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require
#include "scene.glsl"
#include "halftone.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_MOTION, scalar) readonly buffer Motions { Moved motions[]; };
layout(set = 0, binding = B_MOVERS, scalar) readonly buffer Movers { Mover movers[]; };
layout(set = 0, binding = B_PLANE_GROUPS, scalar) readonly buffer PlaneGroups { PlaneGroup groups[]; };
layout(set = 0, binding = B_CODES, scalar) writeonly buffer Codes { uint codes[]; };

const uint NO_MOVER = 0xffffffffu;

uint index_of(ivec2 pixel) { return uint(pixel.y) * frame.width + uint(pixel.x); }

uint owner_of(Moved moved) { return moved.owner_and_depth >> 24u; }

uint depth_of(Moved moved) { return moved.owner_and_depth & 0xffffffu; }

ivec2 motion_of(Moved moved) { return ivec2(bitfieldExtract(int(moved.motion), 0, 16), bitfieldExtract(int(moved.motion), 16, 16)); }

// How far a point has moved at an instant that moves by `motion` during the exposure, in 1/64 pixel.
ivec2 moved_by(ivec2 motion, int instant) { return (motion * instant + 32768) >> 16; }

// The place at which a point is drawn that reaches the middle of `pixel` at `instant`, in 1/64 pixel. It moves by `motion` during the exposure and
// belongs to mover `m`. The centre of a pixel is a multiple of 64.
ivec2 source(uint m, ivec2 pixel, ivec2 motion, int instant) {
    return (pixel << 6) - moved_by(motion, instant) + moved_by(motion, movers[m].instant);
}

// The pixel in which a place is.
ivec2 nearest_pixel(ivec2 at) { return (at + 32) >> 6; }

// Whether the light of a mover can fall on a pixel.
bool within(uint m, ivec2 pixel) { return all(greaterThanEqual(pixel, movers[m].lower)) && all(lessThan(pixel, movers[m].upper)); }

// How a mover moves at a pixel, about.
ivec2 start_of(uint m, ivec2 pixel) {
    ivec2 from = pixel - movers[m].centre;
    ivec4 slope = movers[m].slope;
    return clamp(movers[m].start + ((slope.xz * from.x + slope.yw * from.y) >> 12), ivec2(-32767), ivec2(32767));
}

// Nothing is there.
const Moved NOTHING = Moved(0u, 0u, 0u);

// What is at a pixel in the area of mover `m`.
Moved moved_at(uint m, ivec2 pixel) {
    if (!within(m, pixel)) return NOTHING;
    uint index = index_of(pixel);
    return Moved(motions[index].word, motions[index].motion, motions[index].owner_and_depth);
}

// The place of mover `m` that is at `pixel` at `instant`. False if none is. `own` is what moves at `pixel` itself.
bool find(uint m, ivec2 pixel, int instant, Moved own, out ivec2 at, out uint depth) {
    uint owner = OWNER_STILL + 1u + m;
    // The point's motion is that of the point that is here now, or of what is about where it comes from.
    Moved near = own;
    if (owner_of(near) != owner) near = moved_at(m, nearest_pixel(source(m, pixel, start_of(m, pixel), instant)));
    at = source(m, pixel, motion_of(near), instant);
    Moved there = NOTHING;
    if (owner_of(near) == owner) there = moved_at(m, nearest_pixel(at));
    depth = depth_of(there);
    return owner_of(there) == owner;
}

// True if a group shows all bits of each channel that it shows.
bool has_whole_codes(uint mask) {
    uvec3 bits = uvec3(mask, mask >> 8u, mask >> 16u) & 255u;
    return all(equal(bits * (255u - bits), uvec3(0u)));
}

// The bits of a channel with the code value `sum / weights` at a place of a body: the level below, or the one above if the noise of the place's cell is
// less than what is left. The noise is that of the cell, so that groups which take places beside one another show bits of one level.
uint bits_of(uint sum, uint weights, ivec2 place, uint channel) {
    uint noise = 2u * noise_of(uvec2(place >> 2), channel) + 1u;
    uint level = (sum * MOST + ((noise * weights * 255u) >> 9u)) / (255u * weights);
    return spread(level, phase_of(uvec2(place)));
}

// What is shown at a place where the code values are `sums / weights`. `from` is the centre of the body.
uint cut(uvec3 sums, uint weights, ivec2 at, ivec2 from) {
    ivec2 place = nearest_pixel(at) - from;
    if (HALFTONE_WHITE) return bits_of(sums.g, weights, place, 0u);
    return bits_of(sums.r, weights, place, 0u) | (bits_of(sums.g, weights, place, 1u) << 8u) | (bits_of(sums.b, weights, place, 2u) << 16u);
}

// What is shown of a pixel's word at a place.
uint shown(uint word, ivec2 at, ivec2 from) {
    if (HALFTONE_LOW == 0u) return word;
    return cut(uvec3(word & 255u, (word >> 8u) & 255u, (word >> 16u) & 255u), 1u, at, from);
}

// The word of the pixel that this frame takes for a place between pixels. Frames take each of those around it as often as it is near: in turn, or
// because the instants for which the body is drawn spread the places over a pixel.
uint word_of_one(uint m, ivec2 at, uint g) {
    uvec2 turn = frame.drawn * uvec2(0x9E3779B9u, 0x6A09E667u) + g * uvec2(0x61C88647u, 0x3C6EF372u);
    ivec2 step_ = mix(ivec2(32), ivec2(turn >> 26u), equal(movers[m].in_turn, uvec2(1u)));
    Moved there = moved_at(m, (at + step_) >> 6);
    return owner_of(there) == OWNER_STILL + 1u + m ? there.word : motions[index_of(nearest_pixel(at))].word;
}

// The word of mover `m` at a place, for group `g`. Halftones of equal planes are taken whole. Code values are between those of the pixels around the place that
// show the body. Where these are rough, bits of different groups would be those of codes that the picture does not have, and their sum would be
// far off: there each frame takes the code of one pixel.
uint word_of(uint m, ivec2 at, uint g) {
    if (WARP_WHOLE_WORDS) return motions[index_of(nearest_pixel(at))].word;
    uvec2 part = uvec2(at & 63);
    uint weights = 0u, all_words = 0u;
    uvec3 sums = uvec3(0u);
    for (uint tap = 0u; tap < 4u; tap++) {
        uvec2 step_ = uvec2(tap & 1u, tap >> 1u);
        uvec2 weight2 = mix(64u - part, part, equal(step_, uvec2(1u)));
        ivec2 pixel = (at >> 6) + ivec2(step_);
        Moved there = moved_at(m, pixel);
        uint weight = owner_of(there) == OWNER_STILL + 1u + m ? weight2.x * weight2.y : 0u;
        weights += weight;
        all_words |= weight > 0u ? there.word : 0u;
        sums += weight * uvec3(there.word & 255u, (there.word >> 8u) & 255u, (there.word >> 16u) & 255u);
    }
    if ((all_words & WORD_ROUGH) != 0u && !has_whole_codes(groups[g].mask)) return shown(word_of_one(m, at, g), at, movers[m].centre);
    // The nearest of the four shows the body, so the weights are positive.
    if (HALFTONE_LOW > 0u) return cut(sums, max(weights, 1u), at, movers[m].centre);
    uvec3 code = (sums + weights / 2u) / max(weights, 1u);
    return code.r | (code.g << 8u) | (code.b << 16u);
}

// The bits that the mirror `pixel` shows in the planes of group `g`.
uint word_at(ivec2 pixel, uint g, Moved own) {
    int instant = groups[g].instant;
    uint owner = owner_of(own), closest = 0xffffffffu, mover = NO_MOVER;
    if (owner == OWNER_STILL) closest = depth_of(own);
    ivec2 place;
    for (uint m = 0u; m < frame.mover_count; m++) {
        ivec2 at;
        uint depth;
        if (within(m, pixel) && find(m, pixel, instant, own, at, depth) && depth < closest) {
            closest = depth;
            mover = m;
            place = at;
        }
    }
    if (mover != NO_MOVER) return word_of(mover, place, g);
    if (owner <= OWNER_STILL) return owner == OWNER_STILL ? shown(own.word, pixel << 6, ivec2(0)) : 0u;
    // A body has left this mirror and uncovers what was hidden. What is seen behind its edge goes on here.
    uint left = owner - OWNER_STILL - 1u;
    ivec2 at = source(left, pixel, motion_of(own), instant);
    Moved behind = moved_at(left, nearest_pixel(at));
    return owner_of(behind) == OWNER_NONE ? 0u : shown(behind.word, at, ivec2(0));
}

bool is_near_mover(ivec2 pixel) {
    bool near = false;
    for (uint m = 0u; m < frame.mover_count; m++) near = near || within(m, pixel);
    return near;
}

void main() {
    uvec2 at;
    if (!tile_pixel(tiles[gl_WorkGroupID.x >> 2u], at)) return;
    ivec2 pixel = ivec2(at);
    // What no mover can reach stays as the halftone has it.
    if (HALFTONE_LOW > 0u && !is_near_mover(pixel)) return;
    uint index = index_of(pixel);
    Moved own = Moved(motions[index].word, motions[index].motion, motions[index].owner_and_depth);
    uint word = WARP_WHOLE_WORDS ? own.word : own.word & ~WORD_ROUGH;
    for (uint g = 0u; g < frame.group_count; g++) {
        uint mask = groups[g].mask;
        word = (word & ~mask) | (word_at(pixel, g, own) & mask);
    }
    codes[index] = word;
}
