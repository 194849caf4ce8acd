// What both reprojections share: which histories of the last frame may serve a surface point, and the history that a lit pixel starts from.
#include "scene.glsl"
#include "history.glsl"
#include "write_history.glsl"

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };

// Two normals are alike where their cosine is above this: they differ by less than 26 degrees.
const float LIKE_NORMAL = 0.9;
// The footprint of a pixel grows no further where light falls more obliquely than this cosine: at 78 degrees.
const float LEAST_COSINE = 0.2;

// A pixel's surface point.
struct Place {
    uint instance;
    vec3 position;   // Body space.
    vec3 normal;     // Body space, unit length.
    float footprint; // Side of the area that the pixel lights, metres.
    vec2 before;     // Raster position in the last frame, pixels. What deforms counts as rigid.
};

// Whether a history, by two of its parts, is of the last frame and of the body `instance`, and holds light.
bool is_known(HistoryTag tag, HistoryLight light, uint instance) {
    return tag.frame == frame.history_frame && tag.owner >> 24u == instance && light.weight > 0.0;
}

// Whether a history is of a point close to that of `place` with a like normal. `depth` is how far the point may lie off the tangent plane, in
// footprints.
bool is_close(HistoryPlace former, Place place, float depth) {
    vec3 apart = former.position - place.position;
    // Within four footprints.
    return dot(decode_normal(former.normal), place.normal) > LIKE_NORMAL && abs(dot(apart, place.normal)) < depth * place.footprint
           && dot(apart, apart) < 16.0 * place.footprint * place.footprint;
}

// The surface point of a lit pixel.
Place place_of(uvec2 pixel, uint at) {
    SurfaceHit surface = surface_at(at);
    Place place;
    place.instance = surface.id >> 24u;
    TriangleRef ref = triangle_ref_at(instance_at(place.instance).triangle_offset + (surface.id & 0xffffffu));
    vec2 b = barycentric_at(at).weights;
    // Only rotations and translations lie between world and body space, so lengths are the same in both.
    vec3 world = pixel_direction(pixel) * surface.distance;
    place.position = transform_point(instance_at(place.instance).object_from_world, world);
    place.normal = normalize(vertex_at(ref.vertices.x).normal * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).normal * b.x + vertex_at(ref.vertices.z).normal * b.y);
    float cosine = abs(dot(transform_vector(instance_at(place.instance).world_from_object, place.normal), normalize(world)));
    place.footprint = surface.distance * frame.pixel_size / max(cosine, LEAST_COSINE);
    place.before = project(transform_point(instance_at(place.instance).previous_world_from_object, place.position));
    return place;
}

// The history that a surface point starts from: nothing is known of it, and its sample sequence begins.
History begin_history(Place place, uint at) {
    History h;
    // As long as no sample says otherwise, the light that the scene has on average arrives. Nothing that is weighed takes it in.
    h.mean = vec3(frame.mean_light);
    h.weight = 0.0;
    h.position = place.position;
    h.normal = encode_normal(place.normal);
    h.drift = 0.0;
    h.variance = 0.0;
    h.surprise = 0.0;
    h.seed = hash_u32(at + hash_u32(frame.frame + hash_u32(frame.seed)));
    h.used = 0u;
    h.instance = place.instance;
    h.frame = frame.frame;
    h.flags = 0u;
    return h;
}
