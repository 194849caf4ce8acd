//! Carries packets over a medium: what the link requires of USB, a serial port, or a device in the same process. The
//! device's side needs no operating system.

#[cfg(feature = "std")]
pub mod inproc;
#[cfg(feature = "std")]
mod medium;
#[cfg(any(feature = "serial", feature = "usb"))]
mod priority;
#[cfg(feature = "serial")]
pub mod serial;
#[cfg(feature = "usb")]
pub mod usb;

use crate::time::HostTime;

#[cfg(feature = "std")]
pub use medium::{SendError, Transport, TransportError};

/// The two independent streams of a link. Control never waits behind data.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Lane {
    /// PLANE, FRAME_COMMIT and SYNC.
    Data = 0,
    /// Everything else.
    Control = 1,
}

/// A device: a state machine without I/O. `now` is the true time of the rig, from which the
/// device derives its own clock; it never decreases.
pub trait LinkDevice: Send {
    /// Bytes arrive. The device first advances to `now`.
    fn receive(&mut self, now: HostTime, lane: Lane, bytes: &[u8]);

    /// The bytes received so far on `lane` end a transfer on the medium, and the next ones begin another.
    fn end_of_transfer(&mut self, now: HostTime, lane: Lane);

    /// Advances the device to `now`: light, watchdog.
    fn advance_to(&mut self, now: HostTime);

    /// Advances the device to `now` and takes all its replies, as whole packets.
    fn replies(&mut self, now: HostTime, sink: &mut dyn FnMut(Lane, &[u8]));
}
