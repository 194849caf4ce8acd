// Written by build-shaders from shaders/src/structs.rs. Do not edit.
//
// Tables: storage on GPUs; rows of texel buffers on software Vulkan, which reads storage lane by lane where lanes part. What is
// not used of an element is not read.

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_INSTANCES, rgba32ui) uniform readonly uimageBuffer instance_rows;
Instance instance_at(uint i) {
    uvec4 r0 = imageLoad(instance_rows, int(i) * 13 + 0);
    uvec4 r1 = imageLoad(instance_rows, int(i) * 13 + 1);
    uvec4 r2 = imageLoad(instance_rows, int(i) * 13 + 2);
    uvec4 r3 = imageLoad(instance_rows, int(i) * 13 + 3);
    uvec4 r4 = imageLoad(instance_rows, int(i) * 13 + 4);
    uvec4 r5 = imageLoad(instance_rows, int(i) * 13 + 5);
    uvec4 r6 = imageLoad(instance_rows, int(i) * 13 + 6);
    uvec4 r7 = imageLoad(instance_rows, int(i) * 13 + 7);
    uvec4 r8 = imageLoad(instance_rows, int(i) * 13 + 8);
    uvec4 r9 = imageLoad(instance_rows, int(i) * 13 + 9);
    uvec4 r10 = imageLoad(instance_rows, int(i) * 13 + 10);
    uvec4 r11 = imageLoad(instance_rows, int(i) * 13 + 11);
    uvec4 r12 = imageLoad(instance_rows, int(i) * 13 + 12);
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
        r11.w,
        vec3(uintBitsToFloat(r12.x), uintBitsToFloat(r12.y), uintBitsToFloat(r12.z)),
        r12.w);
}
#else
layout(set = 0, binding = B_INSTANCES, scalar) readonly buffer instance_block { Instance instance_table[]; };
Instance instance_at(uint i) {
    return Instance(instance_table[i].world_from_object,
        instance_table[i].object_from_world,
        instance_table[i].bounds_min,
        instance_table[i].node_offset,
        instance_table[i].bounds_max,
        instance_table[i].triangle_offset,
        instance_table[i].previous_world_from_object,
        instance_table[i].flags,
        instance_table[i].body,
        instance_table[i].extent,
        instance_table[i].mover,
        instance_table[i].drive_gain,
        instance_table[i].albedo_map);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_BODY_NODES, rgba32ui) uniform readonly uimageBuffer body_node_rows;
BodyNode body_node_at(uint i) {
    uvec4 r0 = imageLoad(body_node_rows, int(i) * 2 + 0);
    uvec4 r1 = imageLoad(body_node_rows, int(i) * 2 + 1);
    return BodyNode(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        r0.w,
        vec3(uintBitsToFloat(r1.x), uintBitsToFloat(r1.y), uintBitsToFloat(r1.z)),
        r1.w);
}
#else
layout(set = 0, binding = B_BODY_NODES, scalar) readonly buffer body_node_block { BodyNode body_node_table[]; };
BodyNode body_node_at(uint i) {
    return BodyNode(body_node_table[i].lower,
        body_node_table[i].after,
        body_node_table[i].upper,
        body_node_table[i].body);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_VERTICES, rgba32ui) uniform readonly uimageBuffer vertex_rows;
Vertex vertex_at(uint i) {
    uvec4 r0 = imageLoad(vertex_rows, int(i) * 3 + 0);
    uvec4 r1 = imageLoad(vertex_rows, int(i) * 3 + 1);
    uvec4 r2 = imageLoad(vertex_rows, int(i) * 3 + 2);
    return Vertex(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        vec2(uintBitsToFloat(r0.w), uintBitsToFloat(r1.x)),
        vec4(uintBitsToFloat(r1.y), uintBitsToFloat(r1.z), uintBitsToFloat(r1.w), uintBitsToFloat(r2.x)),
        uvec3(r2.y, r2.z, r2.w));
}
#else
layout(set = 0, binding = B_VERTICES, scalar) readonly buffer vertex_block { Vertex vertex_table[]; };
Vertex vertex_at(uint i) {
    return Vertex(vertex_table[i].normal,
        vertex_table[i].uv,
        vertex_table[i].tangent,
        vertex_table[i].reserved);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_TRIANGLE_REFS, rgba32ui) uniform readonly uimageBuffer triangle_ref_rows;
TriangleRef triangle_ref_at(uint i) {
    uvec4 r0 = imageLoad(triangle_ref_rows, int(i) * 2 + 0);
    uvec4 r1 = imageLoad(triangle_ref_rows, int(i) * 2 + 1);
    return TriangleRef(uvec3(r0.x, r0.y, r0.z),
        r0.w,
        r1.x,
        uvec3(r1.y, r1.z, r1.w));
}
#else
layout(set = 0, binding = B_TRIANGLE_REFS, scalar) readonly buffer triangle_ref_block { TriangleRef triangle_ref_table[]; };
TriangleRef triangle_ref_at(uint i) {
    return TriangleRef(triangle_ref_table[i].vertices,
        triangle_ref_table[i].material,
        triangle_ref_table[i].light,
        triangle_ref_table[i].reserved);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_MATERIALS, rgba32ui) uniform readonly uimageBuffer material_rows;
Material material_at(uint i) {
    uvec4 r0 = imageLoad(material_rows, int(i) * 13 + 0);
    uvec4 r1 = imageLoad(material_rows, int(i) * 13 + 1);
    uvec4 r2 = imageLoad(material_rows, int(i) * 13 + 2);
    uvec4 r3 = imageLoad(material_rows, int(i) * 13 + 3);
    uvec4 r4 = imageLoad(material_rows, int(i) * 13 + 4);
    uvec4 r5 = imageLoad(material_rows, int(i) * 13 + 5);
    uvec4 r6 = imageLoad(material_rows, int(i) * 13 + 6);
    uvec4 r7 = imageLoad(material_rows, int(i) * 13 + 7);
    uvec4 r8 = imageLoad(material_rows, int(i) * 13 + 8);
    uvec4 r9 = imageLoad(material_rows, int(i) * 13 + 9);
    uvec4 r10 = imageLoad(material_rows, int(i) * 13 + 10);
    uvec4 r11 = imageLoad(material_rows, int(i) * 13 + 11);
    uvec4 r12 = imageLoad(material_rows, int(i) * 13 + 12);
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
layout(set = 0, binding = B_MATERIALS, scalar) readonly buffer material_block { Material material_table[]; };
Material material_at(uint i) {
    return Material(material_table[i].base_color,
        material_table[i].alpha,
        material_table[i].emissive,
        material_table[i].alpha_cutoff,
        material_table[i].metallic,
        material_table[i].roughness,
        material_table[i].ior,
        material_table[i].transmission,
        material_table[i].normal_scale,
        material_table[i].flags,
        material_table[i].albedo_table,
        material_table[i].base_color_texture,
        material_table[i].metallic_roughness_texture,
        material_table[i].normal_texture,
        material_table[i].emissive_texture,
        material_table[i].transmission_texture,
        material_table[i].reserved);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_ALBEDO, rgba32ui) uniform readonly uimageBuffer albedo_cell_rows;
AlbedoCell albedo_cell_at(uint i) {
    uvec4 r0 = imageLoad(albedo_cell_rows, int(i) * 1 + 0);
    return AlbedoCell(vec4(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z), uintBitsToFloat(r0.w)));
}
#else
layout(set = 0, binding = B_ALBEDO, scalar) readonly buffer albedo_cell_block { AlbedoCell albedo_cell_table[]; };
AlbedoCell albedo_cell_at(uint i) {
    return AlbedoCell(albedo_cell_table[i].corners);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_SURFACE_ROWS, rgba32ui) uniform readonly uimageBuffer surface_rows;
Surface surface_at(uint i) {
    uvec4 r0 = imageLoad(surface_rows, int(i) * 1 + 0);
    return Surface(r0.x,
        vec2(uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        uintBitsToFloat(r0.w));
}
#else
layout(set = 0, binding = B_SURFACES, scalar) readonly buffer surface_block { Surface surface_table[]; };
Surface surface_at(uint i) {
    return Surface(surface_table[i].id,
        surface_table[i].barycentric,
        surface_table[i].distance);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_GUIDE_ROWS, rgba32ui) uniform readonly uimageBuffer guide_rows;
Guide guide_at(uint i) {
    uvec4 r0 = imageLoad(guide_rows, int(i) * 2 + 0);
    uvec4 r1 = imageLoad(guide_rows, int(i) * 2 + 1);
    return Guide(vec2(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y)),
        uintBitsToFloat(r0.z),
        uintBitsToFloat(r0.w),
        r1.x,
        r1.y,
        uvec2(r1.z, r1.w));
}
#else
layout(set = 0, binding = B_GUIDES, scalar) readonly buffer guide_block { Guide guide_table[]; };
Guide guide_at(uint i) {
    return Guide(guide_table[i].motion,
        guide_table[i].size,
        guide_table[i].angle,
        guide_table[i].albedo_rg,
        guide_table[i].albedo_b,
        guide_table[i].reserved);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_HISTORY_ROWS, rgba32ui) uniform readonly uimageBuffer history_rows;
History history_at(uint i) {
    uvec4 r0 = imageLoad(history_rows, int(i) * 4 + 0);
    uvec4 r1 = imageLoad(history_rows, int(i) * 4 + 1);
    uvec4 r2 = imageLoad(history_rows, int(i) * 4 + 2);
    uvec4 r3 = imageLoad(history_rows, int(i) * 4 + 3);
    return History(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        uintBitsToFloat(r0.w),
        vec3(uintBitsToFloat(r1.x), uintBitsToFloat(r1.y), uintBitsToFloat(r1.z)),
        r1.w,
        uintBitsToFloat(r2.x),
        uintBitsToFloat(r2.y),
        uintBitsToFloat(r2.z),
        r2.w,
        r3.x,
        r3.y,
        r3.z,
        r3.w);
}
#else
layout(set = 0, binding = B_HISTORY, scalar) readonly buffer history_block { History history_table[]; };
History history_at(uint i) {
    return History(history_table[i].mean,
        history_table[i].weight,
        history_table[i].position,
        history_table[i].normal,
        history_table[i].drift,
        history_table[i].variance,
        history_table[i].surprise,
        history_table[i].seed,
        history_table[i].index,
        history_table[i].instance,
        history_table[i].frame,
        history_table[i].flags);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_FORMER, rgba32ui) uniform readonly uimageBuffer former_rows;
History former_at(uint i) {
    uvec4 r0 = imageLoad(former_rows, int(i) * 4 + 0);
    uvec4 r1 = imageLoad(former_rows, int(i) * 4 + 1);
    uvec4 r2 = imageLoad(former_rows, int(i) * 4 + 2);
    uvec4 r3 = imageLoad(former_rows, int(i) * 4 + 3);
    return History(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        uintBitsToFloat(r0.w),
        vec3(uintBitsToFloat(r1.x), uintBitsToFloat(r1.y), uintBitsToFloat(r1.z)),
        r1.w,
        uintBitsToFloat(r2.x),
        uintBitsToFloat(r2.y),
        uintBitsToFloat(r2.z),
        r2.w,
        r3.x,
        r3.y,
        r3.z,
        r3.w);
}
#else
layout(set = 0, binding = B_FORMER, scalar) readonly buffer former_block { History former_table[]; };
History former_at(uint i) {
    return History(former_table[i].mean,
        former_table[i].weight,
        former_table[i].position,
        former_table[i].normal,
        former_table[i].drift,
        former_table[i].variance,
        former_table[i].surprise,
        former_table[i].seed,
        former_table[i].index,
        former_table[i].instance,
        former_table[i].frame,
        former_table[i].flags);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_FILTERED_ROWS, rgba32ui) uniform readonly uimageBuffer filtered_rows;
Filtered filtered_at(uint i) {
    uvec4 r0 = imageLoad(filtered_rows, int(i) * 1 + 0);
    return Filtered(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        uintBitsToFloat(r0.w));
}
#else
layout(set = 0, binding = B_FILTERED, scalar) readonly buffer filtered_block { Filtered filtered_table[]; };
Filtered filtered_at(uint i) {
    return Filtered(filtered_table[i].light,
        filtered_table[i].variance);
}
#endif
