// Blue noise in space and time: one value between 0 and 1 for each pixel, frame and channel.
layout(set = 0, binding = B_NOISE, scalar) readonly buffer Noise { uint noise_bytes[]; };

float blue_noise(uvec2 pixel, uint frame_number, uint channel) {
    uint slice = frame_number % NOISE_FRAMES;
    uint texel = (slice * NOISE_SIZE + pixel.y % NOISE_SIZE) * NOISE_SIZE + pixel.x % NOISE_SIZE;
    uint byte_ = texel * 2u + (channel & 1u);
    uint value = (noise_bytes[byte_ >> 2u] >> ((byte_ & 3u) * 8u)) & 255u;
    return (float(value) + 0.5) / 256.0;
}
