// How much a further sample of a pixel is worth (method dpm).

// Factor for a point that has just come into view. Its first samples serve all frames to come.
const float GOOD_START = 4.0;

// A history of this many frames halves the worth of a further sample. It is about half of the eye's own 31 frames, because early samples serve all
// frames to come.
const float ENOUGH_FRAMES = 16.0;

// Standard deviation of a sample [Neyman34], divided by what the history already holds, so that a surface point that has just come into view
// catches up. In units of 1 / 256. A lower limit gives every pixel a sample now and then. A deterministic pixel has no importance.
uint importance_of(History h) {
    if ((h.flags & HISTORY_EXACT) != 0u) return 0u;
    float sigma = h.weight > 0.0 ? sqrt(max(h.variance, 0.0)) : 1.0;
    sigma /= 1.0 + max(h.weight / samples_a_frame(), 1.0) / ENOUGH_FRAMES;
    if ((h.flags & HISTORY_BORDER) != 0u && h.used == 0u) sigma *= GOOD_START;
    return uint(clamp(sigma, 0.004, 8.0) * 256.0);
}
