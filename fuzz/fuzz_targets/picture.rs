//! Bytes of a fuzzer into the reader of images of textures.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::files::picture(bytes));
