// How much a pixel's samples are worth (method dpm).

// What comes into view gets a good start: its first samples serve it for all of its life.
const float GOOD_START = 4.0;

// Frames of a history that halve what a further sample is worth: about half of the eye's own 31, for early samples serve in all frames to come.
const float ENOUGH_FRAMES = 16.0;

// Standard deviation of a sample [Neyman34], lowered by what the history already holds: a surface point that has just come into view is behind
// the others. In units of 1 / 256; a floor keeps every pixel alive. Nothing where chance has no part.
uint importance_of(History h) {
    if ((h.flags & HISTORY_EXACT) != 0u) return 0u;
    float sigma = h.weight > 0.0 ? sqrt(max(h.variance, 0.0)) : 1.0;
    sigma /= 1.0 + max(h.weight / samples_a_frame(), 1.0) / ENOUGH_FRAMES;
    if ((h.flags & HISTORY_BORDER) != 0u) sigma *= GOOD_START;
    return uint(clamp(sigma, 0.004, 8.0) * 256.0);
}
