//! Opens the medium of `[projector.backend]`, and derives the link's settings from the rig file.

use crate::config::{
    Compaction, DisplayConfig, DisplayEncoding, Pace, ProjectorBackend, ResponseConfig, RigConfig,
};
use crate::engine::connect::ConnectError;
use dpm_device::link::{packet_bytes, Codec, Epoch, LinkError, LinkSettings, Underrun, COMMIT_BYTES};
use dpm_device::planes::Raster;
use dpm_device::time::DeviceTicks;
use dpm_device::transport::serial::{SerialSettings, SerialTransport};
use dpm_device::transport::usb::{UsbSettings, UsbTransport};
use dpm_device::transport::{Transport, TransportError};
use dpm_display::card::open_for;
use dpm_display::encoding::Encoding;
use dpm_display::mode::ModeWish;
use dpm_display::set_up::DisplaySettings;
use dpm_display::transport::DisplayTransport;
use dpm_handoff::wake::WaitPolicy;
use std::sync::Arc;

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
        ProjectorBackend::Display(display) => Some(open_display(config, display, raster).map_err(failed)?),
        ProjectorBackend::Mock(_) | ProjectorBackend::Dlpc900(_) => None,
    })
}

/// What a rig file says of its display.
///
/// # Errors
/// The mode is none; the check of the rig file has refused it.
pub fn display_settings(
    config: &RigConfig,
    display: &DisplayConfig,
    raster: Raster,
) -> Result<DisplaySettings, TransportError> {
    let no_mode = |why: String| TransportError::Unsuitable { device: "projector.backend.mode".into(), why };
    let projector = &config.projector;
    Ok(DisplaySettings {
        connector: display.connector.clone(),
        mode: display.mode.parse::<ModeWish>().map_err(|e| no_mode(e.to_string()))?,
        encoding: match display.encoding {
            DisplayEncoding::Rgb8 => Encoding::Rgb8,
            DisplayEncoding::Planes24 => Encoding::Planes24,
        },
        without: display.without.clone(),
        commit_ns: display.commit_ns(projector.frame_rate.slot_len_ns(0)),
        raster,
        schedule: projector.schedule(),
        rate: projector.frame_rate,
    })
}

fn open_display(
    config: &RigConfig,
    display: &DisplayConfig,
    raster: Raster,
) -> Result<Medium, TransportError> {
    let settings = display_settings(config, display, raster)?;
    let (card, connector) = (display.card.clone(), display.connector.clone());
    let opener = Arc::new(move || open_for(card.as_deref(), connector.as_deref()));
    // Blanks are milliseconds apart: no thread needs to spin for them. The panel stands for another machine, so no stage may
    // delay it.
    let priority = config.real_time.priority;
    let above = if priority > 0 { (priority + 1).min(99) } else { 0 };
    let transport = DisplayTransport::open(opener, settings, WaitPolicy::Park, above)?;
    let mut warnings = transport.warnings().to_vec();
    warnings.push("a display as projector has not been tried on real hardware yet (docs/DISPLAY.md)".into());
    let is_linear = matches!(config.projector.response, ResponseConfig::Linear(_));
    if display.encoding == DisplayEncoding::Rgb8 && is_linear {
        warnings.push(
            "projector.response is \"linear\", which no display's code values are: grey will be too bright; write \
             response = { kind = \"srgb\" }, or measure it"
                .into(),
        );
    }
    Ok(Medium { transport: Box::new(transport), warnings })
}

/// Codecs that the rig file allows on its link, as bits of [`Codec::mask`].
pub(crate) fn codecs(backend: &ProjectorBackend) -> u32 {
    let compaction = match backend {
        ProjectorBackend::Mock(c) => &c.compaction,
        ProjectorBackend::Usb(c) => &c.compaction,
        ProjectorBackend::Serial(c) => &c.compaction,
        ProjectorBackend::Dlpc900(_) | ProjectorBackend::Display(_) => return Codec::Raw.mask(),
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
        // The slots of a display are its vertical blanks, which its clock counts from 0.
        epoch: match config.projector.backend {
            ProjectorBackend::Display(_) => Epoch::At(DeviceTicks(0)),
            _ => Epoch::AfterHello(EPOCH_NS),
        },
        codecs: codecs(&config.projector.backend),
        flash_limit: flash_limit(config),
        limits: config.safety.limits.limits(),
    }
}
