//! Bytes of a fuzzer into the document and the binary chunk of a glTF file.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::files::gltf_parts(bytes));
