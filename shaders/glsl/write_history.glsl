// A history into its parts. Only method dpm knows of its noise.
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer HistoryLights { HistoryLight history_lights[]; };
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer HistoryPlaces { HistoryPlace history_places[]; };
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer HistoryNoises { HistoryNoise history_noises[]; };
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer HistoryTags { HistoryTag history_tags[]; };
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer HistorySeeds { HistorySeed history_seeds[]; };
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer HistoryUses { HistoryUsed history_uses[]; };

void write_history(uint at, History h) {
    history_lights[HISTORY_LIGHT_AT(at)] = HistoryLight(h.mean, h.weight);
    history_places[HISTORY_PLACE_AT(at)] = HistoryPlace(h.position, h.normal);
    history_tags[HISTORY_TAG_AT(at)] = HistoryTag(h.instance << 24u | (h.flags & 0xffffffu), h.frame);
    history_seeds[HISTORY_SEED_AT(at)] = HistorySeed(h.seed);
    history_uses[HISTORY_USED_AT(at)] = HistoryUsed(int(h.used | (h.flags & HISTORY_EXACT)));
}

void write_noise(uint at, History h) {
    uint body_and_used = h.used | h.instance * (HISTORY_USED + 1u) | (h.flags & HISTORY_EXACT);
    history_noises[HISTORY_NOISE_AT(at)] = HistoryNoise(h.drift, h.variance, h.surprise, body_and_used);
}

// A pixel that is not lit has no history.
void write_no_history(uint at) {
    history_lights[HISTORY_LIGHT_AT(at)].weight = 0.0;
    history_tags[HISTORY_TAG_AT(at)].frame = frame.frame - 1u;
}
