// Random numbers: one stream per path, addressed by (pixel, frame, sample, seed), so a run replays.

struct Sampler {
    uint state;
};

uint hash_u32(uint x) {
    // A full-avalanche 32-bit mix.
    x ^= x >> 16u;
    x *= 0x21f0aaadu;
    x ^= x >> 15u;
    x *= 0x735a2d97u;
    x ^= x >> 15u;
    return x;
}

Sampler start_sampler(uint pixel, uint frame_number, uint sample_index, uint seed) {
    Sampler s;
    s.state = hash_u32(pixel + hash_u32(frame_number + hash_u32(sample_index + hash_u32(seed + 0x9e3779b9u))));
    return s;
}

// [0, 1) always: 24 bits, so rounding never gives 1.
float to_unit(uint x) { return float(x >> 8u) * (1.0 / 16777216.0); }

float sample_1d(inout Sampler s) {
    // PCG output permutation over a linear congruential state.
    s.state = s.state * 747796405u + 2891336453u;
    uint word = ((s.state >> ((s.state >> 28u) + 4u)) ^ s.state) * 277803737u;
    return to_unit((word >> 22u) ^ word);
}

vec2 sample_2d(inout Sampler s) {
    float x = sample_1d(s);
    return vec2(x, sample_1d(s));
}
