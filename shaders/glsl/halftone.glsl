// How the sum of a channel's planes is shared out over them. Equals the functions of the same names of the CPU's `halftone`.

layout(set = 0, binding = B_NOISE, scalar) readonly buffer Noise { uint noise_bytes[]; };

// What the planes of a channel add up to at full light.
const uint MOST = ((HALFTONE_PARTS * ((1u << HALFTONE_DEPTH) - 1u)) << HALFTONE_LOW) + (1u << HALFTONE_LOW) - 1u;
// Mirrors in a row of a cell, in which all mirrors begin at the same part.
const uint HALFTONE_CELL = 4u;

// The blue noise of a place for a channel's remainders.
uint noise_of(uvec2 place, uint channel) {
    // The mask has two channels; the third of a frame is the first, half a mask aside.
    uint x = (place.x + (channel >> 1u) * (NOISE_SIZE / 2u)) % NOISE_SIZE;
    uint texel = ((frame.drawn % NOISE_FRAMES) * NOISE_SIZE + place.y % NOISE_SIZE) * NOISE_SIZE + x;
    return (noise_bytes[texel >> 1u] >> ((texel & 1u) * 16u + (channel & 1u) * 8u)) & 255u;
}

// The part at which the order of parts begins at a place: the same in each cell of 4 x 4 mirrors. Of four neighbouring cells each begins in another
// quarter of the parts, of 16 each in another sixteenth, and so on. Where the highest bit is split, the order is the same everywhere.
uint phase_of(uvec2 place) {
    if (HALFTONE_LOW > 0u) return 1u;
    uvec2 cell = place % NOISE_SIZE / HALFTONE_CELL;
    uint rank = 0u;
    for (uint level = 0u; level < 4u; level++) {
        uint quarter = (((cell.x ^ cell.y) & 1u) << 1u) | (cell.y & 1u);
        cell >>= 1u;
        rank = (rank << 2u) | (quarter ^ (hash_u32((level << 16u) | (rank << 8u) | (cell.y << 4u) | cell.x) & 3u));
    }
    return (rank * HALFTONE_PARTS / 256u + 5u * (frame.drawn % HALFTONE_PARTS)) % HALFTONE_PARTS;
}

// Bits that add up to `sum`: those below the parts, and parts that are all the same number, or one more in some, the first of the order that begins at
// part `phase`.
uint spread(uint sum, uint phase) {
    uint below = sum & ((1u << HALFTONE_LOW) - 1u);
    sum >>= HALFTONE_LOW;
    uint each = sum / HALFTONE_PARTS;
    uint more = sum % HALFTONE_PARTS;
    uint word = 0u;
    for (uint p = 0u; p < HALFTONE_PARTS; p++) word |= each << (p * HALFTONE_DEPTH);
    // The order of the parts: by the bits of their numbers in reverse.
    int bits = findMSB(HALFTONE_PARTS - 1u) + 1;
    for (uint i = 0u; i < 1u << bits; i++) {
        uint p = bitfieldReverse(i) >> (32 - bits);
        if (p >= HALFTONE_PARTS || more == 0u) continue;
        word += 1u << ((p + phase) % HALFTONE_PARTS * HALFTONE_DEPTH);
        more--;
    }
    return (word << HALFTONE_LOW) | below;
}
