// Code values into the bit planes that a DMD shows. Equals the CPU's `pack` byte for byte.
//
// One invocation makes four neighbouring bytes of every plane: it transposes a 32 x 32 bit matrix that has one code value in each row.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_scalar_block_layout : require
#include "generated.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = B_CODES, scalar) readonly buffer Codes { uint codes[]; };
layout(set = 0, binding = B_PLANES, scalar) writeonly buffer Planes { uint planes[]; };

// Exchanges the upper bits of a row with the lower bits of the row `j` further down.
#define EXCHANGE(j, mask) for (uint k = 0u; k < 32u; k++) { if ((k & j) == 0u) { uint t = ((a[k] >> j) ^ a[k + j]) & mask; a[k] ^= t << j; a[k + j] ^= t; } }

#define STORE(bit, word) { uint plane = (word >> ((bit & 3u) * 8u)) & 0xffu; if (plane != 255u) planes[plane * words + at] = a[bit]; }

void main() {
    uint row_bytes = (PLANE_WIDTH + 7u) / 8u;
    uint plane_bytes = row_bytes * PLANE_HEIGHT;
    uint words = (plane_bytes + 3u) / 4u;
    uint at = gl_GlobalInvocationID.x;
    if (at >= words) return;
    uint a[32];
    for (uint j = 0u; j < 4u; j++) {
        uint byte_ = at * 4u + j;
        uint row = byte_ / row_bytes, column = (byte_ - row * row_bytes) * 8u;
        // The leftmost of eight pixels is the highest bit. Pixels beyond the row or the plane are dark.
        for (uint x = 0u; x < 8u; x++)
            a[j * 8u + 7u - x] = byte_ < plane_bytes && column + x < PLANE_WIDTH ? codes[row * PLANE_WIDTH + column + x] : 0u;
    }
    EXCHANGE(16u, 0x0000ffffu)
    EXCHANGE(8u, 0x00ff00ffu)
    EXCHANGE(4u, 0x0f0f0f0fu)
    EXCHANGE(2u, 0x33333333u)
    EXCHANGE(1u, 0x55555555u)
    for (uint bit = 0u; bit < 4u; bit++) STORE(bit, PLANE_OF_BITS_0)
    for (uint bit = 4u; bit < 8u; bit++) STORE(bit, PLANE_OF_BITS_4)
    for (uint bit = 8u; bit < 12u; bit++) STORE(bit, PLANE_OF_BITS_8)
    for (uint bit = 12u; bit < 16u; bit++) STORE(bit, PLANE_OF_BITS_12)
    for (uint bit = 16u; bit < 20u; bit++) STORE(bit, PLANE_OF_BITS_16)
    for (uint bit = 20u; bit < 24u; bit++) STORE(bit, PLANE_OF_BITS_20)
}
