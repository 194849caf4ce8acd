//! The pipelines of the renderer through the compilers of GPU drivers, without a GPU: registers, spills, waves and code size of every pass.
//!
//! Mesa's drivers compile for a GPU that is not there: RADV when it is told a family (`RADV_FORCE_FAMILY`), NVK over a library that plays the
//! kernel's driver. `tests/gpu-compile/drivers` unpacks them from Debian's packages. The program `gpu-compile` runs itself once for each target, with
//! that target's libraries. [`cases::all`] has the pipelines, with the constants that the renderer sets. [`laws`] says what the table must keep.

pub mod cases;
pub mod laws;
pub mod page;
pub mod rehearsal;
pub mod table;
pub mod targets;
