// Coarse pixels: which block a pixel belongs to, whether it is traced this frame, and through which of its pixels the ray goes.
layout(set = 0, binding = B_RATES, scalar) readonly buffer Rates { uint rates[]; };

// Pixels per coarse pixel, x and y: 1, 2 or 4. Tiles are multiples of it, so blocks never straddle tiles.
uvec2 block_size(uvec2 pixel) {
    if ((frame.flags & FRAME_RATE_MAP) == 0u) return uvec2(1u);
    uint rate = rates[(pixel.y >> 4u) * frame.tiles_x + (pixel.x >> 4u)];
    return uvec2(1u << (rate & 3u), 1u << ((rate >> 2u) & 3u));
}

bool is_traced_block(uvec2 pixel, uvec2 size) {
    if ((frame.flags & FRAME_CHECKERBOARD) == 0u) return true;
    uvec2 block = pixel / size;
    return ((block.x + block.y + frame.drawn) & 1u) == 0u;
}

// A random pixel of the block; when nothing is lit there, the next lit one. The same answer for every pixel of the block.
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
