//! Bytes of a fuzzer into the parser of TRACKS, and the planes that they move.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::link_tracks(bytes));
