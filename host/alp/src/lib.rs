//! ViALUX ALP-4 and ALP-5 (V-Modules with DLP7000, DLP9500, DLP6500 and others), by the library that their user has installed.
//!
//! Reading order: `abi` has the interface's numbers, `library` opens the vendor's library and is the only place that calls it, `timing`
//! shares a frame's time among its planes, [`Alp`] is the device, and
//! [`AlpProjector`] makes a bit-plane projector of it. Nothing of the vendor's is contained or linked: the library is opened at
//! run time. `docs/ALP.md` says what was confirmed by which source. **Nothing here ran on real hardware.**

mod abi;
mod driver;
mod error;
mod library;
mod projector;
mod timing;
mod transport;

pub use driver::{Alp, AlpFacts, Pause, QueueProgress, ShowMode, Temperatures, MAX_RUNS};
pub use error::AlpError;
pub use projector::{AlpCounts, AlpProjector, MEMORY_SPARE};
pub use timing::Weights;
pub use transport::{AlpSettings, AlpTransport, AlpWelcome};
