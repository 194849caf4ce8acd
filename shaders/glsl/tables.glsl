// Written by build-shaders from shaders/src/structs.rs. Do not edit.
//
// Tables: storage on GPUs; rows of texel buffers on software Vulkan, which reads storage lane by lane where lanes part. What is
// not used of an element is not read. Software Vulkan writes lane by lane too, member by member, so there an element is written as one row.

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_INSTANCES, rgba32ui) uniform readonly uimageBuffer instances_image;
Instance instance_at(uint i) {
    uint at = i;
    uvec4 r0 = imageLoad(instances_image, int(at) * 13 + 0);
    uvec4 r1 = imageLoad(instances_image, int(at) * 13 + 1);
    uvec4 r2 = imageLoad(instances_image, int(at) * 13 + 2);
    uvec4 r3 = imageLoad(instances_image, int(at) * 13 + 3);
    uvec4 r4 = imageLoad(instances_image, int(at) * 13 + 4);
    uvec4 r5 = imageLoad(instances_image, int(at) * 13 + 5);
    uvec4 r6 = imageLoad(instances_image, int(at) * 13 + 6);
    uvec4 r7 = imageLoad(instances_image, int(at) * 13 + 7);
    uvec4 r8 = imageLoad(instances_image, int(at) * 13 + 8);
    uvec4 r9 = imageLoad(instances_image, int(at) * 13 + 9);
    uvec4 r10 = imageLoad(instances_image, int(at) * 13 + 10);
    uvec4 r11 = imageLoad(instances_image, int(at) * 13 + 11);
    uvec4 r12 = imageLoad(instances_image, int(at) * 13 + 12);
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
    uint at = i;
    return Instance(instance_table[at].world_from_object,
        instance_table[at].object_from_world,
        instance_table[at].bounds_min,
        instance_table[at].node_offset,
        instance_table[at].bounds_max,
        instance_table[at].triangle_offset,
        instance_table[at].previous_world_from_object,
        instance_table[at].flags,
        instance_table[at].body,
        instance_table[at].extent,
        instance_table[at].mover,
        instance_table[at].drive_gain,
        instance_table[at].albedo_map);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_BODY_NODES, rgba32ui) uniform readonly uimageBuffer body_nodes_image;
BodyNode body_node_at(uint i) {
    uint at = i;
    uvec4 r0 = imageLoad(body_nodes_image, int(at) * 2 + 0);
    uvec4 r1 = imageLoad(body_nodes_image, int(at) * 2 + 1);
    return BodyNode(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        r0.w,
        vec3(uintBitsToFloat(r1.x), uintBitsToFloat(r1.y), uintBitsToFloat(r1.z)),
        r1.w);
}
#else
layout(set = 0, binding = B_BODY_NODES, scalar) readonly buffer body_node_block { BodyNode body_node_table[]; };
BodyNode body_node_at(uint i) {
    uint at = i;
    return BodyNode(body_node_table[at].lower,
        body_node_table[at].after,
        body_node_table[at].upper,
        body_node_table[at].body);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_VERTICES, rgba32ui) uniform readonly uimageBuffer vertices_image;
Vertex vertex_at(uint i) {
    uint at = i;
    uvec4 r0 = imageLoad(vertices_image, int(at) * 3 + 0);
    uvec4 r1 = imageLoad(vertices_image, int(at) * 3 + 1);
    uvec4 r2 = imageLoad(vertices_image, int(at) * 3 + 2);
    return Vertex(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        vec2(uintBitsToFloat(r0.w), uintBitsToFloat(r1.x)),
        vec4(uintBitsToFloat(r1.y), uintBitsToFloat(r1.z), uintBitsToFloat(r1.w), uintBitsToFloat(r2.x)),
        uvec3(r2.y, r2.z, r2.w));
}
#else
layout(set = 0, binding = B_VERTICES, scalar) readonly buffer vertex_block { Vertex vertex_table[]; };
Vertex vertex_at(uint i) {
    uint at = i;
    return Vertex(vertex_table[at].normal,
        vertex_table[at].uv,
        vertex_table[at].tangent,
        vertex_table[at].reserved);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_TRIANGLE_REFS, rgba32ui) uniform readonly uimageBuffer triangle_refs_image;
TriangleRef triangle_ref_at(uint i) {
    uint at = i;
    uvec4 r0 = imageLoad(triangle_refs_image, int(at) * 2 + 0);
    uvec4 r1 = imageLoad(triangle_refs_image, int(at) * 2 + 1);
    return TriangleRef(uvec3(r0.x, r0.y, r0.z),
        r0.w,
        r1.x,
        uvec3(r1.y, r1.z, r1.w));
}
#else
layout(set = 0, binding = B_TRIANGLE_REFS, scalar) readonly buffer triangle_ref_block { TriangleRef triangle_ref_table[]; };
TriangleRef triangle_ref_at(uint i) {
    uint at = i;
    return TriangleRef(triangle_ref_table[at].vertices,
        triangle_ref_table[at].material,
        triangle_ref_table[at].light,
        triangle_ref_table[at].reserved);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_MATERIALS, rgba32ui) uniform readonly uimageBuffer materials_image;
Material material_at(uint i) {
    uint at = i;
    uvec4 r0 = imageLoad(materials_image, int(at) * 41 + 0);
    uvec4 r1 = imageLoad(materials_image, int(at) * 41 + 1);
    uvec4 r2 = imageLoad(materials_image, int(at) * 41 + 2);
    uvec4 r3 = imageLoad(materials_image, int(at) * 41 + 3);
    uvec4 r4 = imageLoad(materials_image, int(at) * 41 + 4);
    uvec4 r5 = imageLoad(materials_image, int(at) * 41 + 5);
    uvec4 r6 = imageLoad(materials_image, int(at) * 41 + 6);
    uvec4 r7 = imageLoad(materials_image, int(at) * 41 + 7);
    uvec4 r8 = imageLoad(materials_image, int(at) * 41 + 8);
    uvec4 r9 = imageLoad(materials_image, int(at) * 41 + 9);
    uvec4 r10 = imageLoad(materials_image, int(at) * 41 + 10);
    uvec4 r11 = imageLoad(materials_image, int(at) * 41 + 11);
    uvec4 r12 = imageLoad(materials_image, int(at) * 41 + 12);
    uvec4 r13 = imageLoad(materials_image, int(at) * 41 + 13);
    uvec4 r14 = imageLoad(materials_image, int(at) * 41 + 14);
    uvec4 r15 = imageLoad(materials_image, int(at) * 41 + 15);
    uvec4 r16 = imageLoad(materials_image, int(at) * 41 + 16);
    uvec4 r17 = imageLoad(materials_image, int(at) * 41 + 17);
    uvec4 r18 = imageLoad(materials_image, int(at) * 41 + 18);
    uvec4 r19 = imageLoad(materials_image, int(at) * 41 + 19);
    uvec4 r20 = imageLoad(materials_image, int(at) * 41 + 20);
    uvec4 r21 = imageLoad(materials_image, int(at) * 41 + 21);
    uvec4 r22 = imageLoad(materials_image, int(at) * 41 + 22);
    uvec4 r23 = imageLoad(materials_image, int(at) * 41 + 23);
    uvec4 r24 = imageLoad(materials_image, int(at) * 41 + 24);
    uvec4 r25 = imageLoad(materials_image, int(at) * 41 + 25);
    uvec4 r26 = imageLoad(materials_image, int(at) * 41 + 26);
    uvec4 r27 = imageLoad(materials_image, int(at) * 41 + 27);
    uvec4 r28 = imageLoad(materials_image, int(at) * 41 + 28);
    uvec4 r29 = imageLoad(materials_image, int(at) * 41 + 29);
    uvec4 r30 = imageLoad(materials_image, int(at) * 41 + 30);
    uvec4 r31 = imageLoad(materials_image, int(at) * 41 + 31);
    uvec4 r32 = imageLoad(materials_image, int(at) * 41 + 32);
    uvec4 r33 = imageLoad(materials_image, int(at) * 41 + 33);
    uvec4 r34 = imageLoad(materials_image, int(at) * 41 + 34);
    uvec4 r35 = imageLoad(materials_image, int(at) * 41 + 35);
    uvec4 r36 = imageLoad(materials_image, int(at) * 41 + 36);
    uvec4 r37 = imageLoad(materials_image, int(at) * 41 + 37);
    uvec4 r38 = imageLoad(materials_image, int(at) * 41 + 38);
    uvec4 r39 = imageLoad(materials_image, int(at) * 41 + 39);
    uvec4 r40 = imageLoad(materials_image, int(at) * 41 + 40);
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
        uintBitsToFloat(r12.z),
        uintBitsToFloat(r12.w),
        uintBitsToFloat(r13.x),
        r13.y,
        r13.z,
        r13.w,
        uintBitsToFloat(r14.x),
        vec3(uintBitsToFloat(r14.y), uintBitsToFloat(r14.z), uintBitsToFloat(r14.w)),
        uintBitsToFloat(r15.x),
        vec2(uintBitsToFloat(r15.y), uintBitsToFloat(r15.z)),
        vec3(uintBitsToFloat(r15.w), uintBitsToFloat(r16.x), uintBitsToFloat(r16.y)),
        uintBitsToFloat(r16.z),
        uintBitsToFloat(r16.w),
        uintBitsToFloat(r17.x),
        vec2(uintBitsToFloat(r17.y), uintBitsToFloat(r17.z)),
        vec3(uintBitsToFloat(r17.w), uintBitsToFloat(r18.x), uintBitsToFloat(r18.y)),
        uintBitsToFloat(r18.z),
        vec3(uintBitsToFloat(r18.w), uintBitsToFloat(r19.x), uintBitsToFloat(r19.y)),
        uintBitsToFloat(r19.z),
        TextureUse(r19.w,
        vec3(uintBitsToFloat(r20.x), uintBitsToFloat(r20.y), uintBitsToFloat(r20.z)),
        vec3(uintBitsToFloat(r20.w), uintBitsToFloat(r21.x), uintBitsToFloat(r21.y))),
        TextureUse(r21.z,
        vec3(uintBitsToFloat(r21.w), uintBitsToFloat(r22.x), uintBitsToFloat(r22.y)),
        vec3(uintBitsToFloat(r22.z), uintBitsToFloat(r22.w), uintBitsToFloat(r23.x))),
        TextureUse(r23.y,
        vec3(uintBitsToFloat(r23.z), uintBitsToFloat(r23.w), uintBitsToFloat(r24.x)),
        vec3(uintBitsToFloat(r24.y), uintBitsToFloat(r24.z), uintBitsToFloat(r24.w))),
        TextureUse(r25.x,
        vec3(uintBitsToFloat(r25.y), uintBitsToFloat(r25.z), uintBitsToFloat(r25.w)),
        vec3(uintBitsToFloat(r26.x), uintBitsToFloat(r26.y), uintBitsToFloat(r26.z))),
        TextureUse(r26.w,
        vec3(uintBitsToFloat(r27.x), uintBitsToFloat(r27.y), uintBitsToFloat(r27.z)),
        vec3(uintBitsToFloat(r27.w), uintBitsToFloat(r28.x), uintBitsToFloat(r28.y))),
        TextureUse(r28.z,
        vec3(uintBitsToFloat(r28.w), uintBitsToFloat(r29.x), uintBitsToFloat(r29.y)),
        vec3(uintBitsToFloat(r29.z), uintBitsToFloat(r29.w), uintBitsToFloat(r30.x))),
        TextureUse(r30.y,
        vec3(uintBitsToFloat(r30.z), uintBitsToFloat(r30.w), uintBitsToFloat(r31.x)),
        vec3(uintBitsToFloat(r31.y), uintBitsToFloat(r31.z), uintBitsToFloat(r31.w))),
        TextureUse(r32.x,
        vec3(uintBitsToFloat(r32.y), uintBitsToFloat(r32.z), uintBitsToFloat(r32.w)),
        vec3(uintBitsToFloat(r33.x), uintBitsToFloat(r33.y), uintBitsToFloat(r33.z))),
        TextureUse(r33.w,
        vec3(uintBitsToFloat(r34.x), uintBitsToFloat(r34.y), uintBitsToFloat(r34.z)),
        vec3(uintBitsToFloat(r34.w), uintBitsToFloat(r35.x), uintBitsToFloat(r35.y))),
        TextureUse(r35.z,
        vec3(uintBitsToFloat(r35.w), uintBitsToFloat(r36.x), uintBitsToFloat(r36.y)),
        vec3(uintBitsToFloat(r36.z), uintBitsToFloat(r36.w), uintBitsToFloat(r37.x))),
        TextureUse(r37.y,
        vec3(uintBitsToFloat(r37.z), uintBitsToFloat(r37.w), uintBitsToFloat(r38.x)),
        vec3(uintBitsToFloat(r38.y), uintBitsToFloat(r38.z), uintBitsToFloat(r38.w))),
        TextureUse(r39.x,
        vec3(uintBitsToFloat(r39.y), uintBitsToFloat(r39.z), uintBitsToFloat(r39.w)),
        vec3(uintBitsToFloat(r40.x), uintBitsToFloat(r40.y), uintBitsToFloat(r40.z))),
        r40.w);
}
#else
layout(set = 0, binding = B_MATERIALS, scalar) readonly buffer material_block { Material material_table[]; };
Material material_at(uint i) {
    uint at = i;
    return Material(material_table[at].base_color,
        material_table[at].alpha,
        material_table[at].emissive,
        material_table[at].alpha_cutoff,
        material_table[at].metallic,
        material_table[at].roughness,
        material_table[at].ior,
        material_table[at].transmission,
        material_table[at].normal_scale,
        material_table[at].flags,
        material_table[at].albedo_table,
        material_table[at].base_color_texture,
        material_table[at].metallic_roughness_texture,
        material_table[at].normal_texture,
        material_table[at].emissive_texture,
        material_table[at].transmission_texture,
        material_table[at].coat,
        material_table[at].coat_roughness,
        material_table[at].coat_normal_scale,
        material_table[at].coat_table,
        material_table[at].white_table,
        material_table[at].sheen_table,
        material_table[at].specular,
        material_table[at].specular_color,
        material_table[at].anisotropy,
        material_table[at].anisotropy_direction,
        material_table[at].sheen_color,
        material_table[at].sheen_roughness,
        material_table[at].film,
        material_table[at].film_ior,
        material_table[at].film_thickness,
        material_table[at].absorption,
        material_table[at].shine,
        material_table[at].shine_color,
        material_table[at].dispersion,
        material_table[at].coat_texture,
        material_table[at].coat_roughness_texture,
        material_table[at].coat_normal_texture,
        material_table[at].specular_texture,
        material_table[at].specular_color_texture,
        material_table[at].anisotropy_texture,
        material_table[at].sheen_color_texture,
        material_table[at].sheen_roughness_texture,
        material_table[at].film_texture,
        material_table[at].film_thickness_texture,
        material_table[at].shine_texture,
        material_table[at].shine_color_texture,
        material_table[at].reserved);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_ALBEDO, rgba32ui) uniform readonly uimageBuffer albedo_image;
AlbedoCell albedo_cell_at(uint i) {
    uint at = i;
    uvec4 r0 = imageLoad(albedo_image, int(at) * 1 + 0);
    return AlbedoCell(vec4(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z), uintBitsToFloat(r0.w)));
}
#else
layout(set = 0, binding = B_ALBEDO, scalar) readonly buffer albedo_cell_block { AlbedoCell albedo_cell_table[]; };
AlbedoCell albedo_cell_at(uint i) {
    uint at = i;
    return AlbedoCell(albedo_cell_table[at].corners);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_TEXTURES, rgba32ui) uniform readonly uimageBuffer textures_image;
TextureInfo texture_at(uint i) {
    uint at = i;
    uvec4 r0 = imageLoad(textures_image, int(at) * 1 + 0);
    return TextureInfo(r0.x,
        r0.y,
        r0.z,
        r0.w);
}
#else
layout(set = 0, binding = B_TEXTURES, scalar) readonly buffer texture_block { TextureInfo texture_table[]; };
TextureInfo texture_at(uint i) {
    uint at = i;
    return TextureInfo(texture_table[at].offset,
        texture_table[at].width,
        texture_table[at].height,
        texture_table[at].flags);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_TEXELS, rgba32ui) uniform readonly uimageBuffer texels_image;
Texel texel_at(uint i) {
    uint at = i;
    uvec4 row = imageLoad(texels_image, int(at >> 1u));
    uvec4 r0 = (at & 1u) == 0u ? row : row.zwxy;
    return Texel(uvec2(r0.x, r0.y));
}
#else
layout(set = 0, binding = B_TEXELS, scalar) readonly buffer texel_block { Texel texel_table[]; };
Texel texel_at(uint i) {
    uint at = i;
    return Texel(texel_table[at].shares);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_LIGHTS, rgba32ui) uniform readonly uimageBuffer lights_image;
Light light_at(uint i) {
    uint at = i;
    uvec4 r0 = imageLoad(lights_image, int(at) * 5 + 0);
    uvec4 r1 = imageLoad(lights_image, int(at) * 5 + 1);
    uvec4 r2 = imageLoad(lights_image, int(at) * 5 + 2);
    uvec4 r3 = imageLoad(lights_image, int(at) * 5 + 3);
    uvec4 r4 = imageLoad(lights_image, int(at) * 5 + 4);
    return Light(r0.x,
        r0.y,
        r0.z,
        uintBitsToFloat(r0.w),
        uintBitsToFloat(r1.x),
        r1.y,
        vec3(uintBitsToFloat(r1.z), uintBitsToFloat(r1.w), uintBitsToFloat(r2.x)),
        vec3(uintBitsToFloat(r2.y), uintBitsToFloat(r2.z), uintBitsToFloat(r2.w)),
        vec3(uintBitsToFloat(r3.x), uintBitsToFloat(r3.y), uintBitsToFloat(r3.z)),
        uintBitsToFloat(r3.w),
        uintBitsToFloat(r4.x),
        uintBitsToFloat(r4.y),
        uvec2(r4.z, r4.w));
}
#else
layout(set = 0, binding = B_LIGHTS, scalar) readonly buffer light_block { Light light_table[]; };
Light light_at(uint i) {
    uint at = i;
    return Light(light_table[at].kind,
        light_table[at].instance,
        light_table[at].triangle,
        light_table[at].select,
        light_table[at].alias_keep,
        light_table[at].alias_other,
        light_table[at].position,
        light_table[at].direction,
        light_table[at].intensity,
        light_table[at].cone_scale,
        light_table[at].cone_offset,
        light_table[at].range,
        light_table[at].unused);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_ENVIRONMENT, rgba32ui) uniform readonly uimageBuffer environment_image;
SkyTexel sky_at(uint i) {
    uint at = i;
    uvec4 r0 = imageLoad(environment_image, int(at) * 1 + 0);
    return SkyTexel(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        uintBitsToFloat(r0.w));
}
#else
layout(set = 0, binding = B_ENVIRONMENT, scalar) readonly buffer sky_block { SkyTexel sky_table[]; };
SkyTexel sky_at(uint i) {
    uint at = i;
    return SkyTexel(sky_table[at].light,
        sky_table[at].cumulative);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_SURFACE_ROWS, rgba32ui) uniform readonly uimageBuffer surface_rows_image;
SurfaceHit surface_at(uint i) {
    uint at = SURFACES_HIT_AT(i);
    uvec4 row = imageLoad(surface_rows_image, int(at >> 1u));
    uvec4 r0 = (at & 1u) == 0u ? row : row.zwxy;
    return SurfaceHit(r0.x,
        uintBitsToFloat(r0.y));
}
#else
layout(set = 0, binding = B_SURFACES, scalar) readonly buffer surface_block { SurfaceHit surface_table[]; };
SurfaceHit surface_at(uint i) {
    uint at = SURFACES_HIT_AT(i);
    return SurfaceHit(surface_table[at].id,
        surface_table[at].distance);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_SURFACES, scalar) writeonly buffer surfaces_uvec2s_block { uvec2 surfaces_uvec2s[]; };
void set_surface(uint i, SurfaceHit v) { surfaces_uvec2s[SURFACES_HIT_AT(i)] = uvec2(v.id, floatBitsToUint(v.distance)); }
#else
layout(set = 0, binding = B_SURFACES, scalar) writeonly buffer surface_out_block { SurfaceHit surface_out[]; };
void set_surface(uint i, SurfaceHit v) { surface_out[SURFACES_HIT_AT(i)] = v; }
#endif

#ifdef TEXEL_TABLES
Barycentric barycentric_at(uint i) {
    uint at = SURFACES_INSIDE_AT(i);
    uvec4 row = imageLoad(surface_rows_image, int(at >> 1u));
    uvec4 r0 = (at & 1u) == 0u ? row : row.zwxy;
    return Barycentric(vec2(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y)));
}
#else
layout(set = 0, binding = B_SURFACES, scalar) readonly buffer barycentric_block { Barycentric barycentric_table[]; };
Barycentric barycentric_at(uint i) {
    uint at = SURFACES_INSIDE_AT(i);
    return Barycentric(barycentric_table[at].weights);
}
#endif

#ifdef TEXEL_TABLES
void set_barycentric(uint i, Barycentric v) { surfaces_uvec2s[SURFACES_INSIDE_AT(i)] = uvec2(floatBitsToUint(v.weights)); }
#else
layout(set = 0, binding = B_SURFACES, scalar) writeonly buffer barycentric_out_block { Barycentric barycentric_out[]; };
void set_barycentric(uint i, Barycentric v) { barycentric_out[SURFACES_INSIDE_AT(i)] = v; }
#endif

#ifdef COARSE_TABLES
#ifdef TEXEL_TABLES
layout(set = 0, binding = B_COARSE_SURFACES, rgba32ui) uniform readonly uimageBuffer coarse_surfaces_image;
SurfaceHit coarse_surface_at(uint i) {
    uint at = COARSE_SURFACES_HIT_AT(i);
    uvec4 row = imageLoad(coarse_surfaces_image, int(at >> 1u));
    uvec4 r0 = (at & 1u) == 0u ? row : row.zwxy;
    return SurfaceHit(r0.x,
        uintBitsToFloat(r0.y));
}
#else
layout(set = 0, binding = B_COARSE_SURFACES, scalar) readonly buffer coarse_surface_block { SurfaceHit coarse_surface_table[]; };
SurfaceHit coarse_surface_at(uint i) {
    uint at = COARSE_SURFACES_HIT_AT(i);
    return SurfaceHit(coarse_surface_table[at].id,
        coarse_surface_table[at].distance);
}
#endif
#endif

#ifdef COARSE_TABLES
#ifdef TEXEL_TABLES
layout(set = 0, binding = B_COARSE_LIGHT_ROWS, rgba32ui) uniform readonly uimageBuffer coarse_light_rows_image;
Filtered coarse_light_at(uint i) {
    uint at = i;
    uvec4 r0 = imageLoad(coarse_light_rows_image, int(at) * 1 + 0);
    return Filtered(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        r0.w);
}
#else
layout(set = 0, binding = B_COARSE_LIGHT, scalar) readonly buffer coarse_light_block { Filtered coarse_light_table[]; };
Filtered coarse_light_at(uint i) {
    uint at = i;
    return Filtered(coarse_light_table[at].light,
        coarse_light_table[at].weight_and_albedo);
}
#endif
#endif

#ifdef COARSE_TABLES
#ifdef TEXEL_TABLES
layout(set = 0, binding = B_COARSE_LIGHT, scalar) writeonly buffer coarse_light_uvec4s_block { uvec4 coarse_light_uvec4s[]; };
void set_coarse_light(uint i, Filtered v) { coarse_light_uvec4s[i] = uvec4(floatBitsToUint(v.light), v.weight_and_albedo); }
#else
layout(set = 0, binding = B_COARSE_LIGHT, scalar) writeonly buffer coarse_light_out_block { Filtered coarse_light_out[]; };
void set_coarse_light(uint i, Filtered v) { coarse_light_out[i] = v; }
#endif
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_GUIDE_ROWS, rgba32ui) uniform readonly uimageBuffer guide_rows_image;
Sight sight_at(uint i) {
    uint at = GUIDES_SIGHT_AT(i);
    uvec4 r0 = imageLoad(guide_rows_image, int(at) * 1 + 0);
    return Sight(vec2(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y)),
        uintBitsToFloat(r0.z),
        uintBitsToFloat(r0.w));
}
#else
layout(set = 0, binding = B_GUIDES, scalar) readonly buffer sight_block { Sight sight_table[]; };
Sight sight_at(uint i) {
    uint at = GUIDES_SIGHT_AT(i);
    return Sight(sight_table[at].motion,
        sight_table[at].size,
        sight_table[at].angle);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_GUIDES, scalar) writeonly buffer guides_uvec4s_block { uvec4 guides_uvec4s[]; };
void set_sight(uint i, Sight v) { guides_uvec4s[GUIDES_SIGHT_AT(i)] = uvec4(floatBitsToUint(v.motion), floatBitsToUint(v.size), floatBitsToUint(v.angle)); }
#else
layout(set = 0, binding = B_GUIDES, scalar) writeonly buffer sight_out_block { Sight sight_out[]; };
void set_sight(uint i, Sight v) { sight_out[GUIDES_SIGHT_AT(i)] = v; }
#endif

#ifdef TEXEL_TABLES
Tint tint_at(uint i) {
    uint at = GUIDES_TINT_AT(i);
    uvec4 row = imageLoad(guide_rows_image, int(at >> 1u));
    uvec4 r0 = (at & 1u) == 0u ? row : row.zwxy;
    return Tint(r0.x,
        r0.y);
}
#else
layout(set = 0, binding = B_GUIDES, scalar) readonly buffer tint_block { Tint tint_table[]; };
Tint tint_at(uint i) {
    uint at = GUIDES_TINT_AT(i);
    return Tint(tint_table[at].albedo_rg,
        tint_table[at].albedo_b_and_angle);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_GUIDES, scalar) writeonly buffer guides_uvec2s_block { uvec2 guides_uvec2s[]; };
void set_tint(uint i, Tint v) { guides_uvec2s[GUIDES_TINT_AT(i)] = uvec2(v.albedo_rg, v.albedo_b_and_angle); }
#else
layout(set = 0, binding = B_GUIDES, scalar) writeonly buffer tint_out_block { Tint tint_out[]; };
void set_tint(uint i, Tint v) { tint_out[GUIDES_TINT_AT(i)] = v; }
#endif

#ifdef TEXEL_TABLES
Shift shift_at(uint i) {
    uint at = GUIDES_SHIFT_AT(i);
    uvec4 row = imageLoad(guide_rows_image, int(at >> 1u));
    uvec4 r0 = (at & 1u) == 0u ? row : row.zwxy;
    return Shift(uvec2(r0.x, r0.y));
}
#else
layout(set = 0, binding = B_GUIDES, scalar) readonly buffer shift_block { Shift shift_table[]; };
Shift shift_at(uint i) {
    uint at = GUIDES_SHIFT_AT(i);
    return Shift(shift_table[at].halves);
}
#endif

#ifdef TEXEL_TABLES
void set_shift(uint i, Shift v) { guides_uvec2s[GUIDES_SHIFT_AT(i)] = uvec2(v.halves); }
#else
layout(set = 0, binding = B_GUIDES, scalar) writeonly buffer shift_out_block { Shift shift_out[]; };
void set_shift(uint i, Shift v) { shift_out[GUIDES_SHIFT_AT(i)] = v; }
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_HISTORY_ROWS, rgba32ui) uniform readonly uimageBuffer history_rows_image;
HistoryLight history_light_at(uint i) {
    uint at = HISTORY_LIGHT_AT(i);
    uvec4 r0 = imageLoad(history_rows_image, int(at) * 1 + 0);
    return HistoryLight(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        uintBitsToFloat(r0.w));
}
#else
layout(set = 0, binding = B_HISTORY, scalar) readonly buffer history_light_block { HistoryLight history_light_table[]; };
HistoryLight history_light_at(uint i) {
    uint at = HISTORY_LIGHT_AT(i);
    return HistoryLight(history_light_table[at].mean,
        history_light_table[at].weight);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer history_uvec4s_block { uvec4 history_uvec4s[]; };
void set_history_light(uint i, HistoryLight v) { history_uvec4s[HISTORY_LIGHT_AT(i)] = uvec4(floatBitsToUint(v.mean), floatBitsToUint(v.weight)); }
#else
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer history_light_out_block { HistoryLight history_light_out[]; };
void set_history_light(uint i, HistoryLight v) { history_light_out[HISTORY_LIGHT_AT(i)] = v; }
#endif

#ifdef TEXEL_TABLES
HistoryPlace history_place_at(uint i) {
    uint at = HISTORY_PLACE_AT(i);
    uvec4 r0 = imageLoad(history_rows_image, int(at) * 1 + 0);
    return HistoryPlace(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        r0.w);
}
#else
layout(set = 0, binding = B_HISTORY, scalar) readonly buffer history_place_block { HistoryPlace history_place_table[]; };
HistoryPlace history_place_at(uint i) {
    uint at = HISTORY_PLACE_AT(i);
    return HistoryPlace(history_place_table[at].position,
        history_place_table[at].normal);
}
#endif

#ifdef TEXEL_TABLES
void set_history_place(uint i, HistoryPlace v) { history_uvec4s[HISTORY_PLACE_AT(i)] = uvec4(floatBitsToUint(v.position), v.normal); }
#else
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer history_place_out_block { HistoryPlace history_place_out[]; };
void set_history_place(uint i, HistoryPlace v) { history_place_out[HISTORY_PLACE_AT(i)] = v; }
#endif

#ifdef TEXEL_TABLES
HistoryNoise history_noise_at(uint i) {
    uint at = HISTORY_NOISE_AT(i);
    uvec4 r0 = imageLoad(history_rows_image, int(at) * 1 + 0);
    return HistoryNoise(uintBitsToFloat(r0.x),
        uintBitsToFloat(r0.y),
        uintBitsToFloat(r0.z),
        r0.w);
}
#else
layout(set = 0, binding = B_HISTORY, scalar) readonly buffer history_noise_block { HistoryNoise history_noise_table[]; };
HistoryNoise history_noise_at(uint i) {
    uint at = HISTORY_NOISE_AT(i);
    return HistoryNoise(history_noise_table[at].drift,
        history_noise_table[at].variance,
        history_noise_table[at].surprise,
        history_noise_table[at].body_and_used);
}
#endif

#ifdef TEXEL_TABLES
void set_history_noise(uint i, HistoryNoise v) { history_uvec4s[HISTORY_NOISE_AT(i)] = uvec4(floatBitsToUint(v.drift), floatBitsToUint(v.variance), floatBitsToUint(v.surprise), v.body_and_used); }
#else
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer history_noise_out_block { HistoryNoise history_noise_out[]; };
void set_history_noise(uint i, HistoryNoise v) { history_noise_out[HISTORY_NOISE_AT(i)] = v; }
#endif

#ifdef TEXEL_TABLES
HistoryTag history_tag_at(uint i) {
    uint at = HISTORY_TAG_AT(i);
    uvec4 row = imageLoad(history_rows_image, int(at >> 1u));
    uvec4 r0 = (at & 1u) == 0u ? row : row.zwxy;
    return HistoryTag(r0.x,
        r0.y);
}
#else
layout(set = 0, binding = B_HISTORY, scalar) readonly buffer history_tag_block { HistoryTag history_tag_table[]; };
HistoryTag history_tag_at(uint i) {
    uint at = HISTORY_TAG_AT(i);
    return HistoryTag(history_tag_table[at].owner,
        history_tag_table[at].frame);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer history_uvec2s_block { uvec2 history_uvec2s[]; };
void set_history_tag(uint i, HistoryTag v) { history_uvec2s[HISTORY_TAG_AT(i)] = uvec2(v.owner, v.frame); }
#else
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer history_tag_out_block { HistoryTag history_tag_out[]; };
void set_history_tag(uint i, HistoryTag v) { history_tag_out[HISTORY_TAG_AT(i)] = v; }
#endif

#ifdef TEXEL_TABLES
HistorySeed history_seed_at(uint i) {
    uint at = HISTORY_SEED_AT(i);
    uvec4 r0 = uvec4(imageLoad(history_rows_image, int(at >> 2u))[at & 3u]);
    return HistorySeed(r0.x);
}
#else
layout(set = 0, binding = B_HISTORY, scalar) readonly buffer history_seed_block { HistorySeed history_seed_table[]; };
HistorySeed history_seed_at(uint i) {
    uint at = HISTORY_SEED_AT(i);
    return HistorySeed(history_seed_table[at].seed);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer history_uints_block { uint history_uints[]; };
void set_history_seed(uint i, HistorySeed v) { history_uints[HISTORY_SEED_AT(i)] = uint(v.seed); }
#else
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer history_seed_out_block { HistorySeed history_seed_out[]; };
void set_history_seed(uint i, HistorySeed v) { history_seed_out[HISTORY_SEED_AT(i)] = v; }
#endif

#ifdef TEXEL_TABLES
HistoryUsed history_used_at(uint i) {
    uint at = HISTORY_USED_AT(i);
    uvec4 r0 = uvec4(imageLoad(history_rows_image, int(at >> 2u))[at & 3u]);
    return HistoryUsed(int(r0.x));
}
#else
layout(set = 0, binding = B_HISTORY, scalar) readonly buffer history_used_block { HistoryUsed history_used_table[]; };
HistoryUsed history_used_at(uint i) {
    uint at = HISTORY_USED_AT(i);
    return HistoryUsed(history_used_table[at].before);
}
#endif

#ifdef TEXEL_TABLES
void set_history_used(uint i, HistoryUsed v) { history_uints[HISTORY_USED_AT(i)] = uint(uint(v.before)); }
#else
layout(set = 0, binding = B_HISTORY, scalar) writeonly buffer history_used_out_block { HistoryUsed history_used_out[]; };
void set_history_used(uint i, HistoryUsed v) { history_used_out[HISTORY_USED_AT(i)] = v; }
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_FORMER, rgba32ui) uniform readonly uimageBuffer former_image;
HistoryLight former_light_at(uint i) {
    uint at = HISTORY_LIGHT_AT(i);
    uvec4 r0 = imageLoad(former_image, int(at) * 1 + 0);
    return HistoryLight(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        uintBitsToFloat(r0.w));
}
#else
layout(set = 0, binding = B_FORMER, scalar) readonly buffer former_light_block { HistoryLight former_light_table[]; };
HistoryLight former_light_at(uint i) {
    uint at = HISTORY_LIGHT_AT(i);
    return HistoryLight(former_light_table[at].mean,
        former_light_table[at].weight);
}
#endif

#ifdef TEXEL_TABLES
HistoryPlace former_place_at(uint i) {
    uint at = HISTORY_PLACE_AT(i);
    uvec4 r0 = imageLoad(former_image, int(at) * 1 + 0);
    return HistoryPlace(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        r0.w);
}
#else
layout(set = 0, binding = B_FORMER, scalar) readonly buffer former_place_block { HistoryPlace former_place_table[]; };
HistoryPlace former_place_at(uint i) {
    uint at = HISTORY_PLACE_AT(i);
    return HistoryPlace(former_place_table[at].position,
        former_place_table[at].normal);
}
#endif

#ifdef TEXEL_TABLES
HistoryNoise former_noise_at(uint i) {
    uint at = HISTORY_NOISE_AT(i);
    uvec4 r0 = imageLoad(former_image, int(at) * 1 + 0);
    return HistoryNoise(uintBitsToFloat(r0.x),
        uintBitsToFloat(r0.y),
        uintBitsToFloat(r0.z),
        r0.w);
}
#else
layout(set = 0, binding = B_FORMER, scalar) readonly buffer former_noise_block { HistoryNoise former_noise_table[]; };
HistoryNoise former_noise_at(uint i) {
    uint at = HISTORY_NOISE_AT(i);
    return HistoryNoise(former_noise_table[at].drift,
        former_noise_table[at].variance,
        former_noise_table[at].surprise,
        former_noise_table[at].body_and_used);
}
#endif

#ifdef TEXEL_TABLES
HistoryTag former_tag_at(uint i) {
    uint at = HISTORY_TAG_AT(i);
    uvec4 row = imageLoad(former_image, int(at >> 1u));
    uvec4 r0 = (at & 1u) == 0u ? row : row.zwxy;
    return HistoryTag(r0.x,
        r0.y);
}
#else
layout(set = 0, binding = B_FORMER, scalar) readonly buffer former_tag_block { HistoryTag former_tag_table[]; };
HistoryTag former_tag_at(uint i) {
    uint at = HISTORY_TAG_AT(i);
    return HistoryTag(former_tag_table[at].owner,
        former_tag_table[at].frame);
}
#endif

#ifdef TEXEL_TABLES
HistorySeed former_seed_at(uint i) {
    uint at = HISTORY_SEED_AT(i);
    uvec4 r0 = uvec4(imageLoad(former_image, int(at >> 2u))[at & 3u]);
    return HistorySeed(r0.x);
}
#else
layout(set = 0, binding = B_FORMER, scalar) readonly buffer former_seed_block { HistorySeed former_seed_table[]; };
HistorySeed former_seed_at(uint i) {
    uint at = HISTORY_SEED_AT(i);
    return HistorySeed(former_seed_table[at].seed);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_FILTERED_ROWS, rgba32ui) uniform readonly uimageBuffer filtered_rows_image;
Filtered filtered_at(uint i) {
    uint at = i;
    uvec4 r0 = imageLoad(filtered_rows_image, int(at) * 1 + 0);
    return Filtered(vec3(uintBitsToFloat(r0.x), uintBitsToFloat(r0.y), uintBitsToFloat(r0.z)),
        r0.w);
}
#else
layout(set = 0, binding = B_FILTERED, scalar) readonly buffer filtered_block { Filtered filtered_table[]; };
Filtered filtered_at(uint i) {
    uint at = i;
    return Filtered(filtered_table[at].light,
        filtered_table[at].weight_and_albedo);
}
#endif

#ifdef TEXEL_TABLES
layout(set = 0, binding = B_FILTERED, scalar) writeonly buffer filtered_uvec4s_block { uvec4 filtered_uvec4s[]; };
void set_filtered(uint i, Filtered v) { filtered_uvec4s[i] = uvec4(floatBitsToUint(v.light), v.weight_and_albedo); }
#else
layout(set = 0, binding = B_FILTERED, scalar) writeonly buffer filtered_out_block { Filtered filtered_out[]; };
void set_filtered(uint i, Filtered v) { filtered_out[i] = v; }
#endif
