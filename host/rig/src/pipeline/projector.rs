//! Opens the medium of `[projector.backend]`, and derives the link's settings from the rig file.

use crate::config::{Compaction, Pace, ProjectorBackend, RigConfig};
use crate::engine::connect::ConnectError;
use dpm_device::link::{packet_bytes, Codec, Epoch, LinkError, LinkSettings, Underrun, COMMIT_BYTES};
use dpm_device::planes::Raster;
use dpm_device::transport::serial::{SerialSettings, SerialTransport};
use dpm_device::transport::usb::{UsbSettings, UsbTransport};
use dpm_device::transport::Transport;

/// Time from the handshake to slot 0.
const EPOCH_NS: u64 = 5_000_000;

/// A connection to a projector outside this process.
pub struct Medium {
    /// The open medium.
    pub transport: Box<dyn Transport>,
    /// Warnings for the operator, for example a kernel limit that leaves room for fewer frames than requested.
    pub warnings: Vec<String>,
}

/// Bytes on the wire of the largest frame of `planes` planes.
pub fn frame_bytes(raster: Raster, planes: usize) -> usize {
    packet_bytes(raster.plane_bytes()) * planes + packet_bytes(COMMIT_BYTES)
}

/// Opens the medium of a bit-plane projector on USB or a serial port. `None` for the other backends, which have none.
///
/// # Errors
/// The device was not found; there is no permission (the message names the rule or group that grants it); or another
/// program uses it.
pub fn open(config: &RigConfig, raster: Raster) -> Result<Option<Medium>, ConnectError> {
    let frame_bytes = frame_bytes(raster, config.projector.schedule().len());
    let failed = |e| ConnectError::from(LinkError::Transport(e));
    Ok(match &config.projector.backend {
        ProjectorBackend::Usb(usb) => {
            let settings = UsbSettings {
                vendor_id: usb.vendor_id,
                product_id: usb.product_id,
                serial: usb.serial_number.clone(),
                depth: usb.transfers_in_flight as usize,
                ..UsbSettings::new(frame_bytes)
            };
            let warnings = settings.memory_advice().into_iter().collect();
            let transport = Box::new(UsbTransport::open(settings).map_err(failed)?);
            Some(Medium { transport, warnings })
        }
        ProjectorBackend::Serial(serial) => {
            let settings = SerialSettings { path: serial.port.clone(), baud: serial.baud, frame_bytes };
            let transport = Box::new(SerialTransport::open(settings).map_err(failed)?);
            Some(Medium { transport, warnings: Vec::new() })
        }
        ProjectorBackend::Mock(_) | ProjectorBackend::Dlpc900(_) => None,
    })
}

/// Codecs that the rig file allows on its link, as bits of [`Codec::mask`].
pub(crate) fn codecs(backend: &ProjectorBackend) -> u32 {
    let compaction = match backend {
        ProjectorBackend::Mock(c) => &c.compaction,
        ProjectorBackend::Usb(c) => &c.compaction,
        ProjectorBackend::Serial(c) => &c.compaction,
        ProjectorBackend::Dlpc900(_) => return Codec::Raw.mask(),
    };
    match compaction {
        Compaction::Auto => Codec::ALL,
        Compaction::Only(mask) => *mask | Codec::Raw.mask(),
    }
}

/// Number of flashes per second that the host permits; `None` if the limiter is off.
pub(crate) fn flash_limit(config: &RigConfig) -> Option<u8> {
    match config.safety.flashes_per_second {
        0 => None,
        n => Some(n.min(255) as u8),
    }
}

/// The link settings for the rig's projector.
pub fn link_settings(config: &RigConfig, raster: Raster) -> LinkSettings {
    LinkSettings {
        raster,
        schedule: config.projector.schedule(),
        rate: config.projector.frame_rate,
        watchdog_us: config.watchdog_us(),
        underrun: Underrun::Repeat,
        // At real pace a late frame is better than none. At virtual pace no frame is late.
        late_slots: if config.real_time.pace == Pace::Virtual { 0 } else { 255 },
        epoch: Epoch::AfterHello(EPOCH_NS),
        codecs: codecs(&config.projector.backend),
        flash_limit: flash_limit(config),
        limits: config.safety.limits.limits(),
    }
}
