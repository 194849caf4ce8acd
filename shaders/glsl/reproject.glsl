// What both reprojections share: which histories of the last frame may serve a surface point, and the history that a lit pixel starts from.
#include "scene.glsl"
#include "history.glsl"
#include "write_history.glsl"

layout(set = 0, binding = B_TILES, scalar) readonly buffer Tiles { uint tiles[]; };

// Two normals are alike where their cosine is above this: they differ by less than 26 degrees.
const float LIKE_NORMAL = 0.9;
// The footprint of a pixel grows no further where light falls more obliquely than this cosine: at 78 degrees.
const float LEAST_COSINE = 0.2;

// Where a pixel's surface point is.
struct Place {
    vec3 normal;     // Body space, unit length.
    float footprint; // Side of the area that the pixel lights, metres.
    vec2 before;     // Raster position in the last frame, pixels.
};

// Whether something is known at `index` of the body since the last frame.
bool is_known(uint index, uint instance) {
    HistoryTag tag = former_tag_at(index);
    return tag.frame == frame.history_frame && tag.owner >> 24u == instance && former_light_at(index).weight > 0.0;
}

// Where the last frame showed a point of a body, pixels. What deforms counts as rigid.
vec2 place_before(uint instance, vec3 position) { return project(transform_point(instance_at(instance).previous_world_from_object, position)); }

// The surface point of a lit pixel, body space.
vec3 body_point(uvec2 pixel, SurfaceHit surface) {
    return transform_point(instance_at(surface.id >> 24u).object_from_world, pixel_direction(pixel) * surface.distance);
}

// Whether the history at `index` is of the last frame, of the same body, and of a point close to `position` with a like normal. Positions and
// normals are in body space. `depth` is how far the point may lie off the tangent plane, in footprints.
bool tap_valid(uint index, uint instance, vec3 position, vec3 normal, float footprint, float depth) {
    if (!is_known(index, instance)) return false;
    vec3 apart = former_place_at(index).position - position;
    vec3 tap_normal = decode_normal(former_place_at(index).normal);
    // Within four footprints.
    return dot(tap_normal, normal) > LIKE_NORMAL && abs(dot(apart, normal)) < depth * footprint && dot(apart, apart) < 16.0 * footprint * footprint;
}

// The history that a lit pixel starts from: nothing is known of its surface point, and the point's sample sequence begins.
History begin_history(uvec2 pixel, uint at, out Place place) {
    SurfaceHit surface = surface_at(at);
    uint instance = surface.id >> 24u;
    uint triangle = surface.id & 0xffffffu;
    TriangleRef ref = triangle_ref_at(instance_at(instance).triangle_offset + triangle);
    vec2 b = barycentric_at(at).weights;
    // Only rotations and translations lie between world and body space, so lengths are the same in both.
    vec3 world = pixel_direction(pixel) * surface.distance;
    vec3 normal = normalize(vertex_at(ref.vertices.x).normal * (1.0 - b.x - b.y) + vertex_at(ref.vertices.y).normal * b.x + vertex_at(ref.vertices.z).normal * b.y);
    float cosine = abs(dot(transform_vector(instance_at(instance).world_from_object, normal), normalize(world)));
    place.normal = normal;
    place.footprint = surface.distance * frame.pixel_size / max(cosine, LEAST_COSINE);
    History h;
    h.mean = vec3(0.0);
    h.weight = 0.0;
    h.position = body_point(pixel, surface);
    h.normal = encode_normal(normal);
    h.drift = 0.0;
    h.variance = 0.0;
    h.surprise = 0.0;
    h.seed = hash_u32(at + hash_u32(frame.frame + hash_u32(frame.seed)));
    h.used = 0u;
    h.instance = instance;
    h.frame = frame.frame;
    h.flags = 0u;
    place.before = place_before(instance, h.position);
    return h;
}
