//! A ViALUX ALP made of software, behind the functions of the vendor's library. For tests only.
//!
//! The shared library `libfake_alp.so` takes the place of `libalp44.so` and its relatives: a program opens it by its path and calls what
//! the vendor's library would export. Nothing of the vendor's is contained: names and numbers are those of the public interface, the rest
//! was written from it.
//!
//! The panel keeps to the rules of the interface, and answers its codes to whoever breaks them: a sequence in use cannot be written, freed
//! or changed; memory and queue are finite; times lie within limits; data cross the cable at its rate; a device that shows something is
//! not freed. Where the interface leaves open what happens, the fake does the worse: mirrors keep the last picture, `AlpProjHalt` ends the
//! light some milliseconds later, memory holds light before it is written.
//!
//! # Faults
//!
//! A plan is a list of `KIND@CALL=WHEN` with semicolons between them. `WHEN` counts that call from 1 since the plan was given: `3`, `3..`
//! or `3..5`.
//!
//! | kind | what happens |
//! |---|---|
//! | `removed` | the cable is pulled; it stays so until there is another plan |
//! | `comm` `not-online` `not-idle` `not-ready` `memory-full` `in-use` `halted` `init` `unknown` | the call answers that code and does nothing |
//! | `slow-MS` | the call takes so many milliseconds more |
//!
//! Calls are `alloc` `free` `halt` `control` `inquire` `seq-alloc` `seq-free` `seq-control` `seq-inquire` `timing` `put` `start` `proj-halt`
//! `proj-control` `proj-inquire` `progress`, and `any`.
//!
//! # A program in a process of its own
//!
//! | variable | what it says |
//! |---|---|
//! | `FAKE_ALP_PANEL` | the panel, see [`Settings::parse`] |
//! | `FAKE_ALP_FAULTS` | a plan of faults |
//! | `FAKE_ALP_FAULTS_FILE` | a file whose present text is the plan |
//! | `FAKE_ALP_LOG` | a file to which every picture that is put (with the [`hash`] of its bytes), every start (with the time at which all that was started ends by itself), and every refusal is added |
//!
//! # In the test's own process
//!
//! [`FakeAlp`] makes devices in the library that the program under test has opened, each with a number of its own.

pub mod codes;
mod control;
mod exports;
mod faults;
mod panel;
mod projection;
mod sequence;
mod settings;
mod world;

pub use control::{library, FakeAlp, Witness};
pub use panel::{Panel, Shown};
pub use projection::Progress;
pub use settings::Settings;
pub use world::hash;
