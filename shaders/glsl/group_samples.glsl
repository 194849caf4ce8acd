// On GPUs: how long the range of samples is that a workgroup of the pass `trace` takes of a list of so many items and samples. A list that is too
// short for TRACE_GROUPS ranges of three samples a lane is cut into ranges of two, or of one, less what the last pixel may reach beyond them. Where
// pixels have many samples they would reach far beyond, and leave lanes idle.
uint group_samples(uint items, uint samples) {
    uint each = samples / max(TRACE_GROUPS, 1u), a_pixel = (samples + max(items, 1u) - 1u) / max(items, 1u);
    if (a_pixel <= 2u && each <= TRACE_LANES) return TRACE_LANES - 4u;
    return a_pixel <= 4u && each <= 2u * TRACE_LANES ? 2u * TRACE_LANES - 8u : TRACE_GROUP_SAMPLES;
}
