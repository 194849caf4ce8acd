//! What the host's half of the link requires of a medium.

use std::sync::Arc;

use super::Lane;
use crate::packet::Packet;
use crate::time::{HostClock, HostTime};

/// Why a medium stopped carrying bytes.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TransportError {
    /// The device is gone; opening again may succeed.
    #[error("{device}: unplugged or without power; check cable and supply")]
    Unplugged {
        /// Name of the device.
        device: String,
    },
    /// No such device.
    #[error(
        "{device}: not found; is it plugged in and switched on? `lsusb` or `dpm doctor` list what is there"
    )]
    NotFound {
        /// Name of the device.
        device: String,
    },
    /// The operating system does not let this user open the device.
    #[error("{device}: permission denied; {remedy}")]
    PermissionDenied {
        /// Name of the device.
        device: String,
        /// The remedy.
        remedy: String,
    },
    /// Another program uses the device.
    #[error(
        "{device}: in use by another program; end it first, `fuser -v` on the device file names it (two hosts cannot drive one projector)"
    )]
    InUse {
        /// Name of the device.
        device: String,
    },
    /// The device cannot be used as the rig file says.
    #[error("{device}: {why}")]
    Unsuitable {
        /// Name of the device.
        device: String,
        /// What is wrong, and what to do.
        why: String,
    },
    /// libusb reports an error.
    #[cfg(feature = "usb")]
    #[error("cannot {doing} {device}: {source}; {}", crate::usb_help::remedy(*.source))]
    Usb {
        /// The failed operation.
        doing: &'static str,
        /// Name of the device.
        device: String,
        /// libusb's error.
        source: rusb::Error,
    },
    /// A serial port cannot be opened.
    #[cfg(feature = "serial")]
    #[error("cannot open {device}: {source}; {remedy}")]
    Serial {
        /// Which port.
        device: String,
        /// The library's error.
        source: serialport::Error,
        /// The remedy.
        remedy: &'static str,
    },
}

#[cfg(feature = "usb")]
impl TransportError {
    /// The error of libusb while `doing` something with `device`, which names vendor, product and device file.
    pub(crate) fn of_usb(doing: &'static str, device: String, source: rusb::Error) -> Self {
        match source {
            rusb::Error::NoDevice => Self::Unplugged { device },
            rusb::Error::Busy => Self::InUse { device },
            rusb::Error::Access => Self::PermissionDenied {
                device,
                remedy: format!(
                    "copy packaging/60-dpm.rules to /etc/udev/rules.d/ and plug it in again, or write there: {}",
                    super::usb::UDEV_RULE
                ),
            },
            source => Self::Usb { doing, device, source },
        }
    }
}

/// Why [`Transport::send`] accepted nothing.
#[derive(Debug, thiserror::Error)]
pub enum SendError {
    /// No room now. Nothing was sent; later, or with newer content, it may fit.
    #[error("no room on the link")]
    Busy,
    /// The medium is gone.
    #[error(transparent)]
    Failed(#[from] TransportError),
}

/// A medium. Implementations MUST return within a bounded time, allocate nothing after construction, and take a call's
/// packets **whole or not at all**: a frame is one call, so no medium ever carries part of a frame by choice.
pub trait Transport: Send {
    /// Queues `packets` on `lane`, in order. The slices are not used after the call returns.
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError>;

    /// False when [`Transport::send`] would certainly answer [`SendError::Busy`] on `lane`: spares the work of preparing a frame.
    fn has_room(&mut self, lane: Lane) -> bool {
        let _ = lane;
        true
    }

    /// The temperature of the device's hottest sensor, thousandths of a degree Celsius, when it was last looked at; `None`
    /// for a device that tells none. Never waits.
    fn milli_celsius(&self) -> Option<i32> {
        None
    }

    /// Sets the clock that every `now` of this medium's calls comes from, so that the medium can stamp arrivals between
    /// polls. Without a clock it stamps with the `now` of the poll. A medium that needs no clock ignores it; a second
    /// clock is ignored.
    fn set_clock(&mut self, clock: Arc<dyn HostClock>) {
        let _ = clock;
    }

    /// Discards everything on both lanes that waits and has not been carried, so that the next message on the control
    /// lane goes out first: for an order to go dark. A frame in transmission is lost.
    fn flush_output(&mut self) {}

    /// Passes arrived bytes to `sink`, in order within a lane, without waiting for more. With the bytes comes the
    /// instant of their arrival, which may lie long before the poll, or a little after `now`.
    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError>;

    /// Reopens the medium after it was lost. Unlike all other calls, this may take some milliseconds, because the rig
    /// is dark anyway.
    ///
    /// # Errors
    /// While it is still gone, or cannot be opened.
    fn reopen(&mut self) -> Result<(), TransportError> {
        Ok(())
    }

    /// Name of this medium in messages.
    fn name(&self) -> &str;
}

impl<T: Transport + ?Sized> Transport for &mut T {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        (**self).send(now, lane, packets)
    }
    fn has_room(&mut self, lane: Lane) -> bool {
        (**self).has_room(lane)
    }
    fn set_clock(&mut self, clock: Arc<dyn HostClock>) {
        (**self).set_clock(clock);
    }
    fn flush_output(&mut self) {
        (**self).flush_output();
    }
    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        (**self).receive(now, sink)
    }
    fn reopen(&mut self) -> Result<(), TransportError> {
        (**self).reopen()
    }
    fn name(&self) -> &str {
        (**self).name()
    }
}
