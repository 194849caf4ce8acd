// Written by build-shaders from shaders/src/structs.rs. Do not edit.
//
// Tables of the scene: storage on GPUs; rows of texel buffers on software Vulkan, which reads storage lane by lane where lanes
// part. What is not used of an element is not read.

#ifdef SCENE_TEXELS
layout(set = 0, binding = B_INSTANCES) uniform utextureBuffer instance_rows;
Instance instance_at(uint i) {
    uvec4 r0 = texelFetch(instance_rows, int(i) * 12 + 0);
    uvec4 r1 = texelFetch(instance_rows, int(i) * 12 + 1);
    uvec4 r2 = texelFetch(instance_rows, int(i) * 12 + 2);
    uvec4 r3 = texelFetch(instance_rows, int(i) * 12 + 3);
    uvec4 r4 = texelFetch(instance_rows, int(i) * 12 + 4);
    uvec4 r5 = texelFetch(instance_rows, int(i) * 12 + 5);
    uvec4 r6 = texelFetch(instance_rows, int(i) * 12 + 6);
    uvec4 r7 = texelFetch(instance_rows, int(i) * 12 + 7);
    uvec4 r8 = texelFetch(instance_rows, int(i) * 12 + 8);
    uvec4 r9 = texelFetch(instance_rows, int(i) * 12 + 9);
    uvec4 r10 = texelFetch(instance_rows, int(i) * 12 + 10);
    uvec4 r11 = texelFetch(instance_rows, int(i) * 12 + 11);
    return Instance(vec4[3](vec4(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z), uintBitsToFloat(r0.w)), vec4(uintBitsToFloat(r1.x), uintBitsToFloat(r1.y), uintBitsToFloat(r1.z), uintBitsToFloat(r1.w)), vec4(uintBitsToFloat(r2.x), uintBitsToFloat(r2.y), uintBitsToFloat(r2.z), uintBitsToFloat(r2.w))),
        vec4[3](vec4(uintBitsToFloat(r3.x), uintBitsToFloat(r3.y), uintBitsToFloat(r3.z), uintBitsToFloat(r3.w)), vec4(uintBitsToFloat(r4.x), uintBitsToFloat(r4.y), uintBitsToFloat(r4.z), uintBitsToFloat(r4.w)), vec4(uintBitsToFloat(r5.x), uintBitsToFloat(r5.y), uintBitsToFloat(r5.z), uintBitsToFloat(r5.w))),
        vec3(uintBitsToFloat(r6.x), uintBitsToFloat(r6.y), uintBitsToFloat(r6.z)),
        r6.w,
        vec3(uintBitsToFloat(r7.x), uintBitsToFloat(r7.y), uintBitsToFloat(r7.z)),
        r7.w,
        vec4[3](vec4(uintBitsToFloat(r8.x), uintBitsToFloat(r8.y), uintBitsToFloat(r8.z), uintBitsToFloat(r8.w)), vec4(uintBitsToFloat(r9.x), uintBitsToFloat(r9.y), uintBitsToFloat(r9.z), uintBitsToFloat(r9.w)), vec4(uintBitsToFloat(r10.x), uintBitsToFloat(r10.y), uintBitsToFloat(r10.z), uintBitsToFloat(r10.w))),
        r11.x,
        r11.y,
        uintBitsToFloat(r11.z),
        r11.w);
}
#else
layout(set = 0, binding = B_INSTANCES, scalar) readonly buffer InstanceTable { Instance instance_table[]; };
Instance instance_at(uint i) { return instance_table[i]; }
#endif

#ifdef SCENE_TEXELS
layout(set = 0, binding = B_VERTICES) uniform utextureBuffer vertex_rows;
Vertex vertex_at(uint i) {
    uvec4 r0 = texelFetch(vertex_rows, int(i) * 3 + 0);
    uvec4 r1 = texelFetch(vertex_rows, int(i) * 3 + 1);
    uvec4 r2 = texelFetch(vertex_rows, int(i) * 3 + 2);
    return Vertex(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        vec2(uintBitsToFloat(r0.w), uintBitsToFloat(r1.x)),
        vec4(uintBitsToFloat(r1.y), uintBitsToFloat(r1.z), uintBitsToFloat(r1.w), uintBitsToFloat(r2.x)),
        uvec3(r2.y, r2.z, r2.w));
}
#else
layout(set = 0, binding = B_VERTICES, scalar) readonly buffer VertexTable { Vertex vertex_table[]; };
Vertex vertex_at(uint i) { return vertex_table[i]; }
#endif

#ifdef SCENE_TEXELS
layout(set = 0, binding = B_TRIANGLE_REFS) uniform utextureBuffer triangle_ref_rows;
TriangleRef triangle_ref_at(uint i) {
    uvec4 r0 = texelFetch(triangle_ref_rows, int(i) * 2 + 0);
    uvec4 r1 = texelFetch(triangle_ref_rows, int(i) * 2 + 1);
    return TriangleRef(uvec3(r0.x, r0.y, r0.z),
        r0.w,
        r1.x,
        uvec3(r1.y, r1.z, r1.w));
}
#else
layout(set = 0, binding = B_TRIANGLE_REFS, scalar) readonly buffer TriangleRefTable { TriangleRef triangle_ref_table[]; };
TriangleRef triangle_ref_at(uint i) { return triangle_ref_table[i]; }
#endif

#ifdef SCENE_TEXELS
layout(set = 0, binding = B_MATERIALS) uniform utextureBuffer material_rows;
Material material_at(uint i) {
    uvec4 r0 = texelFetch(material_rows, int(i) * 13 + 0);
    uvec4 r1 = texelFetch(material_rows, int(i) * 13 + 1);
    uvec4 r2 = texelFetch(material_rows, int(i) * 13 + 2);
    uvec4 r3 = texelFetch(material_rows, int(i) * 13 + 3);
    uvec4 r4 = texelFetch(material_rows, int(i) * 13 + 4);
    uvec4 r5 = texelFetch(material_rows, int(i) * 13 + 5);
    uvec4 r6 = texelFetch(material_rows, int(i) * 13 + 6);
    uvec4 r7 = texelFetch(material_rows, int(i) * 13 + 7);
    uvec4 r8 = texelFetch(material_rows, int(i) * 13 + 8);
    uvec4 r9 = texelFetch(material_rows, int(i) * 13 + 9);
    uvec4 r10 = texelFetch(material_rows, int(i) * 13 + 10);
    uvec4 r11 = texelFetch(material_rows, int(i) * 13 + 11);
    uvec4 r12 = texelFetch(material_rows, int(i) * 13 + 12);
    return Material(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        uintBitsToFloat(r0.w),
        vec3(uintBitsToFloat(r1.x), uintBitsToFloat(r1.y), uintBitsToFloat(r1.z)),
        uintBitsToFloat(r1.w),
        uintBitsToFloat(r2.x),
        uintBitsToFloat(r2.y),
        uintBitsToFloat(r2.z),
        uintBitsToFloat(r2.w),
        uintBitsToFloat(r3.x),
        r3.y,
        r3.z,
        TextureUse(r3.w,
        vec3(uintBitsToFloat(r4.x), uintBitsToFloat(r4.y), uintBitsToFloat(r4.z)),
        vec3(uintBitsToFloat(r4.w), uintBitsToFloat(r5.x), uintBitsToFloat(r5.y))),
        TextureUse(r5.z,
        vec3(uintBitsToFloat(r5.w), uintBitsToFloat(r6.x), uintBitsToFloat(r6.y)),
        vec3(uintBitsToFloat(r6.z), uintBitsToFloat(r6.w), uintBitsToFloat(r7.x))),
        TextureUse(r7.y,
        vec3(uintBitsToFloat(r7.z), uintBitsToFloat(r7.w), uintBitsToFloat(r8.x)),
        vec3(uintBitsToFloat(r8.y), uintBitsToFloat(r8.z), uintBitsToFloat(r8.w))),
        TextureUse(r9.x,
        vec3(uintBitsToFloat(r9.y), uintBitsToFloat(r9.z), uintBitsToFloat(r9.w)),
        vec3(uintBitsToFloat(r10.x), uintBitsToFloat(r10.y), uintBitsToFloat(r10.z))),
        TextureUse(r10.w,
        vec3(uintBitsToFloat(r11.x), uintBitsToFloat(r11.y), uintBitsToFloat(r11.z)),
        vec3(uintBitsToFloat(r11.w), uintBitsToFloat(r12.x), uintBitsToFloat(r12.y))),
        uvec2(r12.z, r12.w));
}
#else
layout(set = 0, binding = B_MATERIALS, scalar) readonly buffer MaterialTable { Material material_table[]; };
Material material_at(uint i) { return material_table[i]; }
#endif
