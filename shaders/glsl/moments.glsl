// What the pass `trace` leaves for accumulate_samples.comp, in the place where that pass then writes the history's picture (method dpm).
struct Moments {
    float sum_squares; // Sum of the squared luminances of the samples.
    bool exact;        // No random choice was made on the way to the light, so that one sample has all of it.
};

Filtered pack_moments(Moments m) { return Filtered(vec3(m.sum_squares, m.exact ? 1.0 : 0.0, 0.0), 0.0); }

Moments unpack_moments(Filtered f) { return Moments(f.light.x, f.light.y > 0.5); }
