//! The committed dither masks, blue in space and in time.

/// Texels along each side of the committed masks.
pub const SIZE: usize = 64;
/// Slices (frames) of the committed masks.
pub const FRAMES: usize = 32;
/// Independent masks, interleaved.
pub const CHANNELS: usize = 2;

/// The committed masks: `MASK[((frame * SIZE + y) * SIZE + x) * CHANNELS + channel]`, each value 0 to 255 equally often.
/// `(value + 0.5) / 256` is the offset to use. Made by `cargo run -p dpm-lab --example make_blue_noise`.
pub static MASK: &[u8; SIZE * SIZE * FRAMES * CHANNELS] = include_bytes!("data/blue_noise_64x64x32x2.bin");
