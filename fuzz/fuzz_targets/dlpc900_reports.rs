//! Bytes of a fuzzer into the DLPC900's report assemblers.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::dlpc900_reports(bytes));
