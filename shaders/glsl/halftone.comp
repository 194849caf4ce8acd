// Code values into halftones, for frames that show them in parts of a few bits: words in which each plane of a channel has a bit. Equals the CPU's `halftone` bit for
// bit, which says how and why.
//
// One workgroup is a block of 8 x 8 pixels.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require
#include "scene.glsl"
#include "halftone.glsl"

layout(local_size_x = 8, local_size_y = 8) in;

layout(set = 0, binding = B_CODES, scalar) buffer Codes { uint codes[]; };
layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = B_MOVERS, scalar) readonly buffer Movers { Mover movers[]; };

shared uint keys[64];
shared uint rests;

// A pixel's place on the blue noise. It is fixed to the body that the pixel shows, where that moves: so the values of a surface point are those
// that follow one another in time.
uvec2 place_of(uvec2 pixel, uint index) {
    if (frame.mover_count == 0u) return pixel;
    uint id = surface_at(index).id;
    uint mover = id == NO_HIT ? 0u : instance_at(id >> 24u).mover;
    // The size of the noise is a power of two, so that places left of it and above it wrap around, too.
    return mover == 0u ? pixel : uvec2(ivec2(pixel) - movers[mover - 1u].centre);
}

// The bits of a channel with the code value `code`. All invocations of the workgroup call it; outside the raster `code` is 0.
uint share_out(uint code, uvec2 place, uint channel) {
    uint i = gl_LocalInvocationIndex;
    uint rest = code * MOST % 255u;
    // Unique, and above 0: the number of the mirror decides between equals.
    uint key = rest > 0u ? ((rest + noise_of(place, channel)) << 6u) | i : 0u;
    if (i == 0u) rests = 0u;
    barrier();
    keys[i] = key;
    atomicAdd(rests, rest);
    barrier();
    uint extra = (rests + ((frame.drawn & 1u) == 0u ? 63u : 191u)) / 255u;
    uint before = 0u;
    for (uint k = 0u; k < 64u; k++) before += keys[k] > key ? 1u : 0u;
    uint sum = code * MOST / 255u + (key > 0u && before < extra ? 1u : 0u);
    // The next channel writes the same memory.
    barrier();
    return spread(sum, phase_of(place));
}

void main() {
    uvec2 pixel;
    bool inside = tile_pixel(tiles[gl_WorkGroupID.x >> 2u], pixel);
    uint index = pixel.y * frame.width + pixel.x;
    uint code = inside ? codes[index] : 0u;
    uvec2 place = inside ? place_of(pixel, index) : pixel;
    uint word;
    if (HALFTONE_WHITE) {
        word = share_out((code >> 8u) & 255u, place, 0u);
    } else {
        word = share_out(code & 255u, place, 0u) | (share_out((code >> 8u) & 255u, place, 1u) << 8u) | (share_out((code >> 16u) & 255u, place, 2u) << 16u);
    }
    if (inside) codes[index] = word;
}
