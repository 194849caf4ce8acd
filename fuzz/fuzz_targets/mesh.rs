//! Bytes of a fuzzer into the readers of OBJ, PLY and STL files.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::files::mesh(bytes));
