// Work items into radiance toward the eye: paths from the surface point of each listed pixel.
#version 460
#extension GL_GOOGLE_include_directive : require
#ifndef TEXEL_TABLES
#define FRAME_WHERE_USED
#endif
#include "path.glsl"
#include "moments.glsl"

layout(local_size_x = TRACE_LANES) in;

#include "trace_items.glsl"

#ifdef TEXEL_TABLES
#include "trace_software.glsl"
#else
#include "trace_gpu.glsl"
#endif
