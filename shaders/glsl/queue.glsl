// The rays of a frame that the host walks between two dispatches (software Vulkan), and what waits for them. One buffer has everything, and its rows
// of four words are read as texels:
//
// - row 0: the first row of the rays, the first word of the hits, the first word of two lists, the first row of the paths;
// - row 1: room for paths, and samples of a batch;
// - row 2: what the dispatch is about; the host writes it. Of paths: how many the list has from its front on and from its back on, its first word,
//   and the first sample of the batch. Of items: the first workgroup, nothing, nothing, and the first sample of the batch.
//
// A ray is two rows: origin and length, direction and kind. The host writes what each ray meets at its place among the hits.
layout(set = 0, binding = B_QUEUE, scalar) writeonly buffer QueueRows { uvec4 queue_rows[]; };
layout(set = 0, binding = B_QUEUE_ROWS, rgba32ui) uniform readonly uimageBuffer queue_image;
#define QUEUE(i) imageLoad(queue_image, int(i))

uvec4 queue_places = QUEUE(0u);
uvec4 queue_room = QUEUE(1u);
uvec4 queue_now = QUEUE(2u);

uint queue_word(uint i) { return QUEUE(i >> 2u)[i & 3u]; }

void ask(uint ray, vec3 origin, float t_max, vec3 direction, uint kind) {
    uint row = queue_places.x + 2u * ray;
    queue_rows[row] = uvec4(floatBitsToUint(origin), floatBitsToUint(t_max));
    queue_rows[row + 1u] = uvec4(floatBitsToUint(direction), kind);
}

uvec4 ray_start(uint ray) { return QUEUE(queue_places.x + 2u * ray); }
uvec4 ray_way(uint ray) { return QUEUE(queue_places.x + 2u * ray + 1u); }

// What a ray meets, as in SurfaceHit; NO_HIT also of no ray.
uint hit_of(uint ray) { return queue_word(queue_places.y + ray); }
