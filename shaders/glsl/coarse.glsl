// Coarse pixels: the block of a pixel, whether the block is traced this frame, and the pixel of the block through which its ray goes.
layout(set = 0, binding = B_RATES, scalar) readonly buffer Rates { uint rates[]; };

// Width and height of a coarse pixel: 1, 2 or 4 pixels. The size of a tile is a multiple of them, so a block lies in one tile.
uvec2 block_size(uvec2 pixel) {
    if ((frame.flags & FRAME_RATE_MAP) == 0u) return uvec2(1u);
    uint rate = rates[(pixel.y >> 4u) * frame.tiles_x + (pixel.x >> 4u)];
    return uvec2(1u << (rate & 3u), 1u << ((rate >> 2u) & 3u));
}

// With the checkerboard, every second block is traced in every second frame.
bool is_traced_block(uvec2 pixel, uvec2 size) {
    if ((frame.flags & FRAME_CHECKERBOARD) == 0u) return true;
    uvec2 block = pixel / size;
    return ((block.x + block.y + frame.drawn) & 1u) == 0u;
}

// A random pixel of the block, or the next lit one after it. The answer is the same for every pixel of the block.
uvec2 traced_pixel(uvec2 pixel, uvec2 size) {
    uint n = size.x * size.y;
    uvec2 origin = pixel / size * size;
    if (n == 1u) return pixel;
    uint start = hash_u32(origin.y * frame.width + origin.x + hash_u32((frame.frame >> 0u) + hash_u32(frame.seed ^ 0x51ed270bu))) % n;
    for (uint k = 0u; k < n; k++) {
        uint i = (start + k) % n;
        uvec2 candidate = origin + uvec2(i % size.x, i / size.x);
        if (candidate.x < frame.width && candidate.y < frame.height && is_lit(surface_at(candidate.y * frame.width + candidate.x))) return candidate;
    }
    return pixel;
}
