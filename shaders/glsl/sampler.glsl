// Random numbers in groups of four. The specialization constant SAMPLER says from which sequence they come.
#include "noise.glsl"

struct Sampler {
    uint seed;  // Of the path's sequence.
    uint index; // Of the sample in the sequence.
    uvec2 pixel;
};

// Always below 1: with 24 bits nothing is rounded.
float to_unit(uint x) { return float(x >> 8u) * (1.0 / 16777216.0); }

// Owen scrambling by a hash. Equals host/lab/src/sobol.rs bit for bit.
uint owen_scramble(uint x, uint seed) {
    x = bitfieldReverse(x);
    x += seed;
    x ^= x * 0x641ca70eu;
    x *= (seed >> 16u) | 1u;
    x ^= x * 0x6f9e06c2u;
    x ^= x * 0xb0cfba9cu;
    return bitfieldReverse(x);
}

uint mix_seed(uint seed, uint value) {
    uint x = seed ^ (value * 0x9e3779b9u + 0x7f4a7c15u);
    x = (x ^ (x >> 16u)) * 0x85ebca6bu;
    x = (x ^ (x >> 13u)) * 0xc2b2ae35u;
    x = (x ^ (x >> 16u)) + value;
    x = (x ^ (x >> 15u)) * 0x2c1b3c6du;
    return x ^ (x >> 14u);
}

uvec4 sobol_4d(uint index, uint group, uint seed) {
    uint key = mix_seed(seed, group);
    uint shuffled = owen_scramble(index, key) & 0xffffu;
    uvec4 x = uvec4(bitfieldReverse(shuffled), SOBOL_123(shuffled));
    return uvec4(owen_scramble(x.x, mix_seed(key, 1u)), owen_scramble(x.y, mix_seed(key, 2u)),
                 owen_scramble(x.z, mix_seed(key, 3u)), owen_scramble(x.w, mix_seed(key, 4u)));
}

// Four random numbers: the dimensions of group `group` of this path.
vec4 sample_4d(Sampler s, uint group) {
    if (SAMPLER == SAMPLER_INDEPENDENT) {
        uint state = hash_u32(s.seed + hash_u32(s.index + hash_u32(group + 0x9e3779b9u)));
        uvec4 x;
        for (int i = 0; i < 4; i++) {
            // The output permutation of PCG over a linear congruential state.
            state = state * 747796405u + 2891336453u;
            uint word = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
            x[i] = (word >> 22u) ^ word;
        }
        return vec4(to_unit(x.x), to_unit(x.y), to_unit(x.z), to_unit(x.w));
    }
    uvec4 x = sobol_4d(s.index, group, s.seed);
    vec4 u = vec4(to_unit(x.x), to_unit(x.y), to_unit(x.z), to_unit(x.w));
    if (SAMPLER == SAMPLER_BLUE_NOISE) {
        // Every dimension reads the mask at its own offset, so that the dimensions are independent.
        for (int i = 0; i < 4; i++) {
            uint h = hash_u32(group * 4u + uint(i) + 1u);
            u[i] += blue_noise(s.pixel + uvec2(h & 63u, (h >> 6u) & 63u), frame.drawn + ((h >> 12u) & 31u), uint(i));
            u[i] = min(u[i] - floor(u[i]), 0.99999994);
        }
    }
    return u;
}
