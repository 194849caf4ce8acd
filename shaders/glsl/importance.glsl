// How much a further sample of a pixel is worth (method dpm).

// Factor for a point that has just come into view. Its first samples serve all frames to come.
const float GOOD_START = 4.0;

// A history of this many frames halves the worth of a further sample. It is about half of the eye's own 31 frames, because early samples serve all
// frames to come.
const float ENOUGH_FRAMES = 16.0;

// The standard deviation of a sample by the model is this share of what the light is divided by.
const float MODEL_NOISE = 0.3;

// Standard deviation of a sample [Neyman34], divided by what the history already holds, so that a surface point that has just come into view
// catches up. In units of 1 / 256. A lower limit gives every pixel a sample now and then. A deterministic pixel has no importance.
//
// No sample decides how many follow it: a point whose few samples missed the light would get fewer, and stay dark for longer. So the variance is that of
// the histories `around`, or by a model where that is more: the light `expected` at the point is not even known to be there.
uint importance_of(History h, float around, float expected) {
    if ((h.flags & HISTORY_EXACT) != 0u) return 0u;
    float sigma = h.weight > 0.0 ? max(sqrt(max(around, 0.0)), MODEL_NOISE * expected) : 1.0;
    sigma /= 1.0 + max(h.weight / samples_a_frame(), 1.0) / ENOUGH_FRAMES;
    if ((h.flags & HISTORY_BORDER) != 0u && h.used == 0u) sigma *= GOOD_START;
    return uint(clamp(sigma, 0.004, 8.0) * 256.0);
}
