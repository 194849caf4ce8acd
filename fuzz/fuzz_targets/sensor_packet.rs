//! Bytes of a fuzzer into the decoder of a light sensor's packets.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::sensor_packet(bytes));
