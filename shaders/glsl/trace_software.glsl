// The work list on software Vulkan: a lane takes a work item, and its first vertex is computed once for all of its samples.

void main() {
    WorkList list = work_list();
    // This is read while all lanes are active. There is at least one item, because otherwise no workgroup is dispatched.
    uint item = group_index() * TRACE_LANES + gl_LocalInvocationIndex;
    uint at = work[min(item, list.items - 1u)].pixel;
    uint spp = first_sample_of(list, item + 1u) - first_sample_of(list, item);
    if (item >= list.items) return;
    Hit met = first_hit(at);
    if (met.id == NO_HIT) {
        radiance_out[at] = vec4(background(at), 1.0);
        return;
    }
    Point first = shading_point(met, toward_eye(met));
    Sampler rng = begin_sampler(at, spp);
    bool dpm = (frame.flags & FRAME_DPM) != 0u;
    Sums sums = NO_SAMPLES;
    uint traced = 0u, invalid = 0u, all_rays = 0u, proven = 0u;
    // A lane whose path ends begins its next sample at once, while the paths of its neighbours continue.
    Path path;
    bool begins = true;
    do {
        if (begins) path = begin_path(first, rng, met.id);
        Branches branches;
        Hit hit;
        uint rays = 0u;
        begins = !branch(path, rng, rays, branches) || !follow(path, branches, hit)
              || !arrive(path, branches, hit, shading_point(hit, -normalize(branches.next.direction)));
        all_rays += rays_of(rays);
        proven += proven_rays_of(rays);
        if (begins) {
            if (!add_sample(sums, path.radiance, dpm && path.exact != 0u)) invalid++;
            rng.index++;
            traced++;
        }
    } while (traced < spp && !sums.exact);
    write_sums(at, sums);
    COUNT(rays, all_rays)
    COUNT(proven_rays, proven)
    COUNT(samples, traced)
    COUNT_RARE(invalid_samples, invalid)
}
