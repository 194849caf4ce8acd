//! Opens the medium of `[projector.backend]`, and derives the link's settings from the rig file.

use super::alp_library;
use crate::config::{
    AlpConfig, AlpWeights, Compaction, DisplayConfig, DisplayEncoding, DisplayLease, Dlpc900BehindConfig,
    Pace, ProjectorBackend, ResponseConfig, RigConfig, SerialProjectorConfig, UsbProjectorConfig,
    WindowConfig,
};
use crate::engine::connect::ConnectError;
use crate::standing::Identity;
use dpm_common::stopping;
use dpm_device::alp::{AlpSettings, AlpTransport, Showing};
use dpm_device::dlpc900::usb::{self, UsbPlace};
use dpm_device::link::{packet_bytes, Codec, Epoch, LinkError, LinkSettings, Underrun, COMMIT_BYTES};
use dpm_device::planes::Raster;
use dpm_device::time::{DeviceTicks, HostClock};
use dpm_device::transport::serial::{SerialSettings, SerialTransport};
use dpm_device::transport::usb::{UsbSettings, UsbTransport};
use dpm_device::transport::{Transport, TransportError};
use dpm_display::encoding::Encoding;
use dpm_display::lease::{self, Access, Lender};
use dpm_display::mode::ModeWish;
use dpm_display::set_up::DisplaySettings;
use dpm_display::transport::{on_card, DisplayTransport, Opener};
use dpm_display::window::{interrupt_program, WindowSettings};
use dpm_handoff::wake::WaitPolicy;
use dpm_render::pack::Halftone;
use std::sync::Arc;

/// What an operator of a DLPC900 must know.
pub const NO_WATCHDOG: &str =
    "a DLPC900 has no watchdog: if this machine fails, or this program and its guard process are both killed, it continues \
     to show its patterns; `dpm dlpc900 idle` ends that";

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

/// What a projector needs whose firmware runs in this process.
#[derive(Clone)]
pub struct Surroundings {
    /// The clock of the run.
    pub clock: Arc<dyn HostClock>,
    /// Called first in the projector's thread, for its rights.
    pub enter: Arc<dyn Fn() + Send + Sync>,
    /// How that thread waits.
    pub wait: WaitPolicy,
    /// True once the run should end, also while a projector is still being set up.
    pub stop: Arc<dyn Fn() -> bool + Send + Sync>,
}

impl Surroundings {
    /// A thread without special rights that parks. A signal stops it.
    pub fn plain(clock: Arc<dyn HostClock>) -> Self {
        Self { clock, enter: Arc::new(|| ()), wait: WaitPolicy::Park, stop: Arc::new(stopping::is_stopping) }
    }
}

/// Whatever opens the medium of a rig's projector: [`open`], or a test that puts a made-up device in its place.
pub type OpenMedium =
    dyn Fn(&RigConfig, Raster, &Surroundings) -> Result<Option<Medium>, ConnectError> + Sync;

/// Opens the medium of a bit-plane projector on USB or a serial port. `None` for the other backends, which have none.
///
/// # Errors
/// The device was not found; there is no permission (the message names the rule or group that grants it); or another
/// program uses it.
pub fn open(
    config: &RigConfig,
    raster: Raster,
    surroundings: &Surroundings,
) -> Result<Option<Medium>, ConnectError> {
    let frame_bytes = frame_bytes(raster, config.projector.schedule().len());
    let failed = |e| match (surroundings.stop)() {
        true => ConnectError::Stopped,
        false => ConnectError::from(LinkError::Transport(e)),
    };
    Ok(match &config.projector.backend {
        ProjectorBackend::Usb(usb) => {
            let settings = usb_settings(usb, frame_bytes);
            let warnings = settings.memory_advice().into_iter().collect();
            let transport = Box::new(UsbTransport::open(settings).map_err(failed)?);
            Some(Medium { transport, warnings })
        }
        ProjectorBackend::Serial(serial) => {
            let settings = serial_settings(serial, frame_bytes);
            // The locks and the standing orders of this run are those of the device that it has found.
            let (first, backend) =
                (Identity::of(&config.projector.backend), config.projector.backend.clone());
            let is_another = move || first.is_certainly_not(&Identity::of(&backend));
            let transport = Box::new(SerialTransport::open_unless(settings, is_another).map_err(failed)?);
            Some(Medium { transport, warnings: Vec::new() })
        }
        ProjectorBackend::Display(display) => {
            Some(open_display(config, display, raster, surroundings).map_err(failed)?)
        }
        ProjectorBackend::Window(window) => Some(open_window(config, window, raster).map_err(failed)?),
        ProjectorBackend::Alp(alp) => Some(open_alp(config, alp, frame_bytes, surroundings)?),
        ProjectorBackend::Mock(_) | ProjectorBackend::Dlpc900(_) => None,
    })
}

/// Looks whether the projector of a rig file is there and may be used. It takes milliseconds, and nothing is opened, lit
/// or loaded; [`open`] may still find more. A DLPC900 is opened first by its own run.
///
/// # Errors
/// What is missing, in the words of [`open`] where that finds it too.
pub fn look(config: &RigConfig) -> Result<(), ConnectError> {
    let raster = config.projector.raster();
    let frame_bytes = frame_bytes(raster, config.projector.schedule().len());
    let looked = match &config.projector.backend {
        ProjectorBackend::Usb(usb) => usb_settings(usb, frame_bytes).look(),
        ProjectorBackend::Serial(serial) => serial_settings(serial, frame_bytes).look(),
        ProjectorBackend::Display(display) => look_at_display(config, display, raster),
        ProjectorBackend::Window(window) => {
            dpm_display::window::look(&window_settings(config, window, raster))
        }
        ProjectorBackend::Alp(alp) => {
            alp_library::find(alp.library.as_deref()).map(drop).map_err(|why| TransportError::Unsuitable {
                device: "ALP".into(),
                why: format!("{why}; {}", alp_library::REMEDY),
            })
        }
        ProjectorBackend::Mock(_) | ProjectorBackend::Dlpc900(_) => Ok(()),
    };
    looked.map_err(|e| ConnectError::from(LinkError::Transport(e)))
}

fn look_at_display(
    config: &RigConfig,
    display: &DisplayConfig,
    raster: Raster,
) -> Result<(), TransportError> {
    let settings = display_settings(config, display, raster)?;
    dpm_display::transport::look(display.card.as_deref(), access(display), &settings)?;
    let Some(behind) = &display.dlpc900 else { return Ok(()) };
    let place = place_of(behind)?;
    usb::look(place)
        .map_err(|e| TransportError::Unsuitable { device: usb::describe(place), why: e.to_string() })
}

fn usb_settings(usb: &UsbProjectorConfig, frame_bytes: usize) -> UsbSettings {
    UsbSettings {
        vendor_id: usb.vendor_id,
        product_id: usb.product_id,
        serial: usb.serial_number.clone(),
        depth: usb.transfers_in_flight as usize,
        ..UsbSettings::new(frame_bytes)
    }
}

fn serial_settings(serial: &SerialProjectorConfig, frame_bytes: usize) -> SerialSettings {
    SerialSettings { path: serial.port.clone(), baud: serial.baud, frame_bytes }
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
            _ => Encoding::Planes24,
        },
        without: display.without.clone(),
        commit_ns: display.commit_ns(projector.frame_rate.slot_len_ns(0)),
        shows_at_pulse: display.dlpc900.is_some(),
        raster,
        schedule: projector.schedule(),
        rate: projector.frame_rate,
    })
}

fn open_display(
    config: &RigConfig,
    display: &DisplayConfig,
    raster: Raster,
    surroundings: &Surroundings,
) -> Result<Medium, TransportError> {
    let settings = display_settings(config, display, raster)?;
    let card = lease::opener(display.card.clone(), display.connector.clone(), access(display));
    let mut opener = on_card(card, settings);
    if let Some(behind) = &display.dlpc900 {
        opener = feeding(opener, config, display, behind, surroundings)?;
    }
    let mut medium = open_panel(config, opener)?;
    medium
        .warnings
        .push("a display as projector has not been tried on real hardware yet (docs/DISPLAY.md)".into());
    if display.dlpc900.is_some() {
        medium.warnings.push(NO_WATCHDOG.into());
    } else if display.encoding == DisplayEncoding::Rgb8 {
        medium.warnings.extend(linear_code_values(config));
    }
    Ok(medium)
}

/// How the rig comes by its display.
fn access(display: &DisplayConfig) -> Access {
    match display.lease {
        DisplayLease::Auto => Access::Auto,
        DisplayLease::Off => Access::Alone,
        DisplayLease::X11 => Access::Lent(Lender::X11),
        DisplayLease::Wayland => Access::Lent(Lender::Wayland),
    }
}

/// A key of the DLPC900 behind a display, refused.
fn refused_behind(key: &str, why: String) -> TransportError {
    TransportError::Unsuitable { device: format!("projector.backend.dlpc900.{key}"), why }
}

/// Where the DLPC900 behind a display is plugged in, if the rig file says it.
fn place_of(behind: &Dlpc900BehindConfig) -> Result<Option<UsbPlace>, TransportError> {
    let place = behind.device.as_deref().map(str::parse::<UsbPlace>).transpose();
    place.map_err(|e| refused_behind("device", e.to_string()))
}

/// The opener of a display with the DLPC900 that it feeds.
fn feeding(
    opener: Opener,
    config: &RigConfig,
    display: &DisplayConfig,
    behind: &Dlpc900BehindConfig,
    surroundings: &Surroundings,
) -> Result<Opener, TransportError> {
    let place = place_of(behind)?;
    let schedule = config.projector.schedule();
    let Some(video) = display.video_patterns(config.projector.frame_rate, &schedule) else {
        return Ok(opener);
    };
    let video = video.map_err(|e| refused_behind("exposure_us", e.to_string()))?;
    Ok(dpm_display::dlpc900::behind(
        opener,
        Arc::new(move || usb::open(place)),
        video,
        surroundings.stop.clone(),
    ))
}

/// What a rig file says of its window.
fn window_settings(config: &RigConfig, window: &WindowConfig, raster: Raster) -> WindowSettings {
    let projector = &config.projector;
    WindowSettings {
        server: window.server.clone(),
        monitor: window.monitor.clone(),
        commit_ns: window.commit_ns(projector.frame_rate.slot_len_ns(0)),
        raster,
        schedule: projector.schedule(),
        rate: projector.frame_rate,
    }
}

fn open_window(config: &RigConfig, window: &WindowConfig, raster: Raster) -> Result<Medium, TransportError> {
    let settings = window_settings(config, window, raster);
    let mut medium = open_panel(config, dpm_display::window::opener(settings, interrupt_program))?;
    medium.warnings.extend(linear_code_values(config));
    Ok(medium)
}

/// A panel in this process behind what `opener` opens.
fn open_panel(config: &RigConfig, opener: Opener) -> Result<Medium, TransportError> {
    // Blanks are milliseconds apart: no thread needs to spin for them. The panel stands for another machine, so no stage may
    // delay it.
    let priority = config.real_time.priority;
    let above = if priority > 0 { (priority + 1).min(99) } else { 0 };
    let transport = DisplayTransport::open(opener, WaitPolicy::Park, above)?;
    let warnings = transport.warnings().to_vec();
    Ok(Medium { transport: Box::new(transport), warnings })
}

/// What to tell of code values that are said to be linear.
fn linear_code_values(config: &RigConfig) -> Option<String> {
    matches!(config.projector.response, ResponseConfig::Linear(_)).then(|| {
        "projector.response is \"linear\", which no display's code values are: grey will be too bright; write \
         response = { kind = \"srgb\" }, or measure it"
            .into()
    })
}

fn open_alp(
    config: &RigConfig,
    alp: &AlpConfig,
    frame_bytes: usize,
    surroundings: &Surroundings,
) -> Result<Medium, ConnectError> {
    let schedule = config.projector.schedule();
    let opened = AlpTransport::open(AlpSettings {
        library: alp.library.clone(),
        number: alp.device_number as i32,
        raster: config.projector.raster(),
        showing: Showing {
            schedule,
            weights: alp.weights.weights(),
            rate: config.projector.frame_rate,
            frames: alp.frames_in_flight as usize,
            runs: alp.slots_per_sequence,
        },
        max_celsius: alp.max_celsius,
        frame_bytes,
        clock: surroundings.clock.clone(),
        enter: surroundings.enter.clone(),
        wait: surroundings.wait,
    });
    let transport = opened.map_err(|e| {
        let device = "projector.backend".to_owned();
        ConnectError::from(LinkError::Transport(TransportError::Unsuitable { device, why: e.to_string() }))
    })?;
    let mut warnings: Vec<String> = transport.welcome().map(ToString::to_string).into_iter().collect();
    if alp.weights == AlpWeights::Equal && Halftone::of(&schedule).is_none() {
        warnings.push(format!(
            "projector.backend.weights = \"equal\": the {} planes are lit equally long, so levels are right only if the light source is dimmed from \
             plane to plane; `projector.weights` = \"equal\" shows grey without that (docs/ALP.md)",
            schedule.len()
        ));
    }
    Ok(Medium { transport: Box::new(transport), warnings })
}

/// Codecs that the rig file allows on its link, as bits of [`Codec::mask`].
pub(crate) fn codecs(backend: &ProjectorBackend) -> u32 {
    let compaction = match backend {
        ProjectorBackend::Mock(c) => &c.compaction,
        ProjectorBackend::Usb(c) => &c.compaction,
        ProjectorBackend::Serial(c) => &c.compaction,
        // The firmware of a display, a window and an ALP runs in this process: nothing is saved by compacting.
        ProjectorBackend::Dlpc900(_)
        | ProjectorBackend::Display(_)
        | ProjectorBackend::Window(_)
        | ProjectorBackend::Alp(_) => return Codec::Raw.mask(),
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
            ProjectorBackend::Display(_) | ProjectorBackend::Window(_) => Epoch::At(DeviceTicks(0)),
            _ => Epoch::AfterHello(EPOCH_NS),
        },
        codecs: codecs(&config.projector.backend),
        flash_limit: flash_limit(config),
        limits: config.safety.limits.limits(),
    }
}
