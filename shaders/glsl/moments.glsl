// What the pass `trace` leaves of a pixel's samples for accumulate_samples.comp beside their mean, in the place of its demand (method dpm).
#include "demand.glsl"

struct Moments {
    float sum_squares; // Sum of the squared luminances of the samples.
    bool exact;        // No random choice was made on the way to the light, so that one sample has all of it.
};

uint pack_moments(Moments m) { return floatBitsToUint(m.sum_squares) | (m.exact ? 1u << 31u : 0u); }

Moments unpack_moments(uint demand) { return Moments(uintBitsToFloat(demand & 0x7fffffffu), demand >> 31u != 0u); }
