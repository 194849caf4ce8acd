//! Processor time of tests, and what the machine did beside them. The program of the same name measures whole tests.
//!
//! ```
//! let begin = test_meter::core_seconds();
//! assert!((0..1000).map(|n| n % 7).sum::<u32>() > 0);
//! assert!(test_meter::core_seconds() - begin < 5.0, "however busy the machine is");
//! ```

pub mod machine;

pub use machine::core_seconds;
