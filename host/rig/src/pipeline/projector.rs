//! `[projector.backend]` into an open medium, and the rig file into what is asked of the link over it.

use crate::config::{Compaction, Pace, ProjectorBackend, RigConfig};
use crate::engine::connect::ConnectError;
use dpm_device::link::{packet_bytes, Codec, Epoch, LinkError, LinkSettings, Underrun, COMMIT_BYTES};
use dpm_device::planes::Raster;
use dpm_device::transport::serial::{SerialSettings, SerialTransport};
use dpm_device::transport::usb::{UsbSettings, UsbTransport};
use dpm_device::transport::Transport;

/// From the handshake to slot 0.
const EPOCH_NS: u64 = 5_000_000;

/// A way to a projector outside this process.
pub struct Medium {
    /// The open medium.
    pub transport: Box<dyn Transport>,
    /// What the operator should know, for example a limit of the kernel that leaves room for fewer frames than asked for.
    pub warnings: Vec<String>,
}

/// Bytes of the largest frame of `planes` planes on the wire.
pub fn frame_bytes(raster: Raster, planes: usize) -> usize {
    packet_bytes(raster.plane_bytes()) * planes + packet_bytes(COMMIT_BYTES)
}

/// Opens the medium of a bit-plane projector on USB or a serial port; `None` for the other backends, which have none.
///
/// # Errors
/// Not found; no permission, with the rule or group that gives it; in use by another program.
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

/// Codecs that the rig file allows on its link, bits [`Codec::mask`].
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

/// Flashes a second that the host lets through; `None` when the limiter is off.
pub(crate) fn flash_limit(config: &RigConfig) -> Option<u8> {
    match config.safety.flashes_per_second {
        0 => None,
        n => Some(n.min(255) as u8),
    }
}

/// What the rig asks of its projector.
pub fn link_settings(config: &RigConfig, raster: Raster) -> LinkSettings {
    LinkSettings {
        raster,
        schedule: config.projector.schedule(),
        rate: config.projector.frame_rate,
        watchdog_us: config.watchdog_us(),
        underrun: Underrun::Repeat,
        // At real pace a late frame is better than none; at virtual pace none is late.
        late_slots: if config.real_time.pace == Pace::Virtual { 0 } else { 255 },
        epoch: Epoch::AfterHello(EPOCH_NS),
        codecs: codecs(&config.projector.backend),
        flash_limit: flash_limit(config),
        limits: config.safety.limits.limits(),
    }
}
