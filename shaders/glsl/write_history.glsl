// A history into its parts. Only method dpm knows of its noise.
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer HistoryLights { HistoryLight history_lights[]; };
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer HistoryTags { HistoryTag history_tags[]; };

void write_history(uint at, History h) {
    set_history_light(at, HistoryLight(h.mean, h.weight));
    set_history_place(at, HistoryPlace(h.position, h.normal));
    set_history_tag(at, HistoryTag(h.instance << 24u | (h.flags & 0xffffffu), h.frame));
    set_history_seed(at, HistorySeed(h.seed));
    set_history_used(at, HistoryUsed(int(h.used | (h.flags & HISTORY_EXACT))));
}

void write_noise(uint at, History h) {
    uint body_and_used = h.used | h.instance * (HISTORY_USED + 1u) | (h.flags & HISTORY_EXACT);
    set_history_noise(at, HistoryNoise(h.drift, h.variance, h.surprise, body_and_used));
}

// A pixel that is not lit has no history.
void write_no_history(uint at) {
    history_lights[HISTORY_LIGHT_AT(at)].weight = 0.0;
    history_tags[HISTORY_TAG_AT(at)].frame = frame.frame - 1u;
}
