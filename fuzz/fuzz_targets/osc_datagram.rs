//! Bytes of a fuzzer into the decoder of OSC datagrams.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::osc_datagram(bytes));
