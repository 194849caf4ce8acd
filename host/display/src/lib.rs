//! A bit-plane projector whose panel is a display: any projector or monitor on HDMI or DisplayPort, driven through the
//! kernel's mode setting (KMS).
//!
//! A display is the firmware of [`dpm_device::projector`] with the vertical blanks as its clock: one slot of the link is one
//! blank. [`mode`] says what a mode is, [`set_up`] chooses connector, mode and properties or says why not, [`encoding`] puts
//! planes into pixels, [`pacer`] follows the blanks, [`panel`] is the state machine, and [`transport`] its thread at the end
//! of an in-process cable. [`scan_out`] is the trait that a panel draws through, [`kms`] the other calls of the kernel,
//! [`card`] the real kernel, [`fake`] the kernel of tests. [`lease`] asks a desktop for a part of a card, and [`window`] is a
//! window for a desk without a projector.
//!
//! **Nothing of this has run on real hardware yet.**

pub mod card;
pub mod encoding;
pub mod fake;
pub mod kms;
pub mod lease;
pub mod mode;
pub mod pacer;
pub mod panel;
pub mod scan_out;
pub mod set_up;
pub mod transport;
pub mod window;
