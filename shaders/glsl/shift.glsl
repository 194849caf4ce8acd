// From the surface point of a pixel's history to the pixel's own: what is added to the light. reproject_point.comp leaves it for accumulate_samples.comp.

// A half is finite up to this.
const float MOST_HALF = 65504.0;

Shift pack_shift(vec3 shift) {
    shift = clamp(shift, vec3(-MOST_HALF), vec3(MOST_HALF));
    return Shift(uvec2(packHalf2x16(shift.rg), packHalf2x16(vec2(shift.b, 0.0))));
}

vec3 unpack_shift(Shift shift) { return vec3(unpackHalf2x16(shift.halves.x), unpackHalf2x16(shift.halves.y).x); }
