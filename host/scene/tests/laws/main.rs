//! The integration tests of this crate, in one program: one link, one row of costs.

mod animation;
mod body_picture;
mod common;
mod compressed_gltf;
mod deform;
mod deforming;
mod file_memory;
mod gltf_scenes;
mod ktx2_formats;
mod ktx2_textures;
mod mutated_gltf;
mod odd_gltf;
mod odd_pictures;
mod opencv_lens;
