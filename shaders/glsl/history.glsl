// What former frames say about the surface point of a pixel: the parts of a history put together, and what a bit of them means.

struct History {
    vec3 mean;
    float weight;
    vec3 position;
    uint normal;
    float drift;
    float variance;
    float surprise;
    uint used;
    uint seed;
    uint instance;
    uint frame;
    // `HISTORY_*`.
    uint flags;
};

// All of a history of the last frame.
History former_at(uint i) {
    HistoryLight l = former_light_at(i);
    HistoryPlace p = former_place_at(i);
    HistoryNoise n = former_noise_at(i);
    HistoryTag t = former_tag_at(i);
    uint flags = (t.owner & 0xffffffu) | (n.body_and_used & HISTORY_EXACT);
    return History(l.mean, l.weight, p.position, p.normal, n.drift, n.variance, n.surprise, n.body_and_used & HISTORY_USED, former_seed_at(i).seed, t.owner >> 24u, t.frame, flags);
}
