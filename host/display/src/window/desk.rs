//! The X server that a window is opened on: what it must be able to do, its monitors, and the window's properties.

use x11rb::connection::{Connection as _, RequestConnection as _};
use x11rb::errors::ReplyOrIdError;
use x11rb::properties::{WmSizeHints, WmSizeHintsSpecification};
use x11rb::protocol::present;
use x11rb::protocol::randr::{self, ConnectionExt as _};
use x11rb::protocol::xproto::{self, ConnectionExt as _, ImageOrder, Visualid};
use x11rb::rust_connection::RustConnection;
use x11rb::wrapper::ConnectionExt as _;

use super::WindowSettings;
use crate::scan_out::DisplayError;

/// Bits of a pixel that mean colour: eight for each.
pub(super) const DEPTH: u8 = 24;
/// Rates that differ by less than this share are one rate to the panel's clock.
const SAME_RATE: f64 = 0.01;
/// The window's title and its class.
const TITLE: &str = "dpm";

x11rb::atom_manager! {
    /// Names that the server numbers.
    pub(super) Atoms: AtomsCookie {
        WM_PROTOCOLS,
        WM_DELETE_WINDOW,
        _NET_WM_NAME,
        UTF8_STRING,
        _NET_WM_STATE,
        _NET_WM_STATE_FULLSCREEN,
        _NET_WM_BYPASS_COMPOSITOR,
        _MOTIF_WM_HINTS,
    }
}

/// Where on the screen a window goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Area {
    left: i16,
    top: i16,
    fills_monitor: bool,
}

/// A server on which the window can be opened, and how.
pub(super) struct WindowServer {
    pub(super) server: RustConnection,
    /// Which of the server's screens.
    pub(super) screen: usize,
    pub(super) area: Area,
    pub(super) visual: Visualid,
    pub(super) atoms: Atoms,
    pub(super) warnings: Vec<String>,
}

/// A monitor as the server names it.
#[derive(Clone, Debug, PartialEq)]
struct Monitor {
    name: String,
    left: i16,
    top: i16,
    width: u16,
    height: u16,
    /// Frames a second, where the server knows it.
    hz: Option<f64>,
}

impl WindowServer {
    /// Looks for the server, its abilities and the monitor.
    ///
    /// # Errors
    /// No server answers, it cannot show a window in this way, or the rig file does not fit its monitor.
    pub(super) fn find(settings: &WindowSettings) -> Result<Self, DisplayError> {
        let (server, screen) = RustConnection::connect(settings.server.as_deref()).map_err(|e| {
            let place = settings.server.clone().or_else(|| std::env::var("DISPLAY").ok());
            unsuitable(format!(
                "does not answer at {} ({e}); log in to a desktop (X11, or Wayland with Xwayland), and set DISPLAY or \
                 projector.backend.server",
                place.map_or_else(|| "an unset DISPLAY".into(), |place| format!("{place:?}"))
            ))
        })?;
        if server.extension_information(present::X11_EXTENSION_NAME).ok().flatten().is_none() {
            return Err(unsuitable(
                "has no extension Present, so nothing tells when a picture is shown".into(),
            ));
        }
        let visual = visual(&server, screen)?;
        let monitors = monitors(&server, screen).unwrap_or_default();
        let mut warnings = vec![format!(
            "a window shows light for a desk, not for a projector: a desktop may change its pixels and show them a frame later \
             (docs/DISPLAY.md, \"A window\"); monitors: {}",
            listed(&monitors)
        )];
        let area = place(settings, &monitors, &mut warnings).map_err(unsuitable)?;
        let atoms = Atoms::new(&server).map_err(ReplyOrIdError::from).map_err(of_id)?;
        let atoms = atoms.reply().map_err(ReplyOrIdError::from).map_err(of_id)?;
        Ok(Self { server, screen, area, visual, atoms, warnings })
    }
}

/// Why the server is none for a window.
pub(super) fn unsuitable(what: String) -> DisplayError {
    DisplayError::Unsuitable { card: "the X server".into(), what }
}

/// What an error of the server means.
pub(super) fn of_id(error: impl Into<ReplyOrIdError>) -> DisplayError {
    match error.into() {
        ReplyOrIdError::X11Error(e) => {
            unsuitable(format!("refuses a request of the window: {:?}", e.error_kind))
        }
        _ => DisplayError::Gone,
    }
}

/// A visual whose pixels are eight bits each of blue, green and red, in this order in memory.
fn visual(server: &RustConnection, screen: usize) -> Result<Visualid, DisplayError> {
    let setup = server.setup();
    let format = setup.pixmap_formats.iter().find(|f| f.depth == DEPTH);
    let is_plain = format.is_some_and(|f| f.bits_per_pixel == 32 && f.scanline_pad == 32)
        && setup.image_byte_order == ImageOrder::LSB_FIRST;
    let depths = setup.roots[screen].allowed_depths.iter();
    let mut visuals = depths.filter(|d| d.depth == DEPTH).flat_map(|d| d.visuals.iter());
    let masks = |v: &&xproto::Visualtype| {
        v.class == xproto::VisualClass::TRUE_COLOR
            && [v.red_mask, v.green_mask, v.blue_mask] == [0xff_0000, 0xff00, 0xff]
    };
    match visuals.find(masks) {
        Some(visual) if is_plain => Ok(visual.visual_id),
        _ => Err(unsuitable("has no pictures of eight bits for each of red, green and blue".into())),
    }
}

fn monitors(server: &RustConnection, screen: usize) -> Result<Vec<Monitor>, ReplyOrIdError> {
    let root = server.setup().roots[screen].root;
    let resources = server.randr_get_screen_resources_current(root)?.reply()?;
    let all = server.randr_get_monitors(root, true)?.reply()?;
    let mut found = Vec::new();
    for monitor in all.monitors {
        let name = server.get_atom_name(monitor.name)?.reply()?;
        let mut hz = None;
        for output in &monitor.outputs {
            let crtc = server.randr_get_output_info(*output, 0)?.reply()?.crtc;
            if crtc != x11rb::NONE {
                let mode = server.randr_get_crtc_info(crtc, 0)?.reply()?.mode;
                hz = hz.or(resources.modes.iter().find(|m| m.id == mode).and_then(rate_of));
            }
        }
        found.push(Monitor {
            name: String::from_utf8_lossy(&name.name).into_owned(),
            left: monitor.x,
            top: monitor.y,
            width: monitor.width,
            height: monitor.height,
            hz,
        });
    }
    Ok(found)
}

fn rate_of(mode: &randr::ModeInfo) -> Option<f64> {
    let pixels = f64::from(mode.htotal) * f64::from(mode.vtotal);
    (mode.dot_clock > 0 && pixels > 0.0).then(|| f64::from(mode.dot_clock) / pixels)
}

fn listed(monitors: &[Monitor]) -> String {
    let all: Vec<String> = monitors
        .iter()
        .map(|m| {
            let rate = m.hz.map_or_else(String::new, |hz| format!(" at {hz:.3} Hz"));
            format!("{:?} {} x {}{rate}", m.name, m.width, m.height)
        })
        .collect();
    if all.is_empty() {
        "none that the X server names".into()
    } else {
        all.join(", ")
    }
}

/// Where the window goes, or why the rig file does not fit.
fn place(
    settings: &WindowSettings,
    monitors: &[Monitor],
    warnings: &mut Vec<String>,
) -> Result<Area, String> {
    let (width, height) = (settings.raster.width(), settings.raster.height());
    let Some(name) = &settings.monitor else {
        let is_larger = |m: &Monitor| u32::from(m.width) < width || u32::from(m.height) < height;
        if !monitors.is_empty() && monitors.iter().all(is_larger) {
            warnings.push(format!(
                "the window of {width} x {height} is larger than every monitor: a part is not seen"
            ));
        }
        return Ok(Area { left: 0, top: 0, fills_monitor: false });
    };
    let Some(monitor) = monitors.iter().find(|m| m.name == *name) else {
        return Err(format!(
            "has no monitor {name:?}; write one of these as projector.backend.monitor: {}",
            listed(monitors)
        ));
    };
    if (u32::from(monitor.width), u32::from(monitor.height)) != (width, height) {
        return Err(format!(
            "shows {} x {} on {name}, and the rig file has projector.width = {width} and projector.height = {height}; write the monitor's",
            monitor.width, monitor.height
        ));
    }
    if let Some(hz) = monitor.hz.filter(|hz| (hz / settings.rate.hz() - 1.0).abs() > SAME_RATE) {
        return Err(format!(
            "shows {hz:.3} frames/s on {name}, and the rig file has projector.frame_rate = {:.3}; write \"{:.0}/1000\"",
            settings.rate.hz(),
            hz * 1000.0
        ));
    }
    Ok(Area { left: monitor.left, top: monitor.top, fills_monitor: true })
}

/// Creates the window, not yet shown.
pub(super) fn create(
    server: &RustConnection,
    screen: usize,
    area: &Area,
    visual: Visualid,
    atoms: &Atoms,
    settings: &WindowSettings,
) -> Result<xproto::Window, ReplyOrIdError> {
    let root = server.setup().roots[screen].root;
    let (width, height) = (settings.raster.width() as u16, settings.raster.height() as u16);
    let colormap = server.generate_id()?;
    server.create_colormap(xproto::ColormapAlloc::NONE, colormap, root, visual)?;
    let aux = xproto::CreateWindowAux::new()
        .background_pixel(0)
        .border_pixel(0)
        .colormap(colormap)
        .cursor(hidden_cursor(server, root)?)
        .event_mask(xproto::EventMask::STRUCTURE_NOTIFY);
    let id = server.generate_id()?;
    let class = xproto::WindowClass::INPUT_OUTPUT;
    server.create_window(DEPTH, id, root, area.left, area.top, width, height, 0, class, visual, &aux)?;
    let (replace, atom, text) = (xproto::PropMode::REPLACE, xproto::AtomEnum::ATOM, xproto::AtomEnum::STRING);
    server.change_property8(replace, id, xproto::AtomEnum::WM_NAME, text, TITLE.as_bytes())?;
    server.change_property8(replace, id, atoms._NET_WM_NAME, atoms.UTF8_STRING, TITLE.as_bytes())?;
    server.change_property8(replace, id, xproto::AtomEnum::WM_CLASS, text, b"dpm\0dpm\0")?;
    server.change_property32(replace, id, atoms.WM_PROTOCOLS, atom, &[atoms.WM_DELETE_WINDOW])?;
    let by_user = WmSizeHintsSpecification::UserSpecified;
    let mut hints = WmSizeHints::new();
    hints.size = Some((by_user, i32::from(width), i32::from(height)));
    if area.fills_monitor {
        hints.position = Some((by_user, i32::from(area.left), i32::from(area.top)));
        server.change_property32(
            replace,
            id,
            atoms._NET_WM_STATE,
            atom,
            &[atoms._NET_WM_STATE_FULLSCREEN],
        )?;
        let cardinal = xproto::AtomEnum::CARDINAL;
        server.change_property32(replace, id, atoms._NET_WM_BYPASS_COMPOSITOR, cardinal, &[1])?;
        // Flags: decorations are given; decorations: none.
        let motif = [2, 0, 0, 0, 0];
        server.change_property32(replace, id, atoms._MOTIF_WM_HINTS, atoms._MOTIF_WM_HINTS, &motif)?;
    } else {
        let size = (i32::from(width), i32::from(height));
        (hints.min_size, hints.max_size) = (Some(size), Some(size));
    }
    hints.set_normal_hints(server, id)?;
    Ok(id)
}

/// A cursor without pixels.
fn hidden_cursor(server: &RustConnection, root: xproto::Window) -> Result<xproto::Cursor, ReplyOrIdError> {
    let (pixmap, cursor, gc) = (server.generate_id()?, server.generate_id()?, server.generate_id()?);
    server.create_pixmap(1, pixmap, root, 1, 1)?;
    server.create_gc(gc, pixmap, &xproto::CreateGCAux::new().foreground(0))?;
    server.poly_fill_rectangle(pixmap, gc, &[xproto::Rectangle { x: 0, y: 0, width: 1, height: 1 }])?;
    server.create_cursor(cursor, pixmap, pixmap, 0, 0, 0, 0, 0, 0, 0, 0)?;
    server.free_gc(gc)?;
    server.free_pixmap(pixmap)?;
    Ok(cursor)
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::{PlaneSchedule, Raster};
    use dpm_device::time::FrameRate;

    fn settings(monitor: Option<&str>, (width, height): (u32, u32), hz: u32) -> WindowSettings {
        WindowSettings {
            server: None,
            monitor: monitor.map(str::to_owned),
            commit_ns: 1_000_000,
            raster: Raster::new(width, height).unwrap(),
            schedule: PlaneSchedule::rgb24(),
            rate: FrameRate::new(hz, 1).unwrap(),
        }
    }

    fn two() -> Vec<Monitor> {
        let monitor = |name: &str, left, width, height, hz| Monitor {
            name: name.into(),
            left,
            top: 0,
            width,
            height,
            hz,
        };
        vec![monitor("eDP-1", 0, 1920, 1080, Some(59.94)), monitor("HDMI-1", 1920, 1024, 768, None)]
    }

    #[test]
    fn a_window_fills_the_monitor_that_is_named_and_whose_size_and_rate_are_the_rigs() {
        let find = |settings: &WindowSettings| place(settings, &two(), &mut Vec::new());
        let right = Area { left: 1920, top: 0, fills_monitor: true };
        assert_eq!(
            find(&settings(Some("HDMI-1"), (1024, 768), 75)),
            Ok(right),
            "an unknown rate is judged later"
        );
        assert_eq!(
            find(&settings(Some("eDP-1"), (1920, 1080), 60)),
            Ok(Area { left: 0, top: 0, fills_monitor: true }),
            "the clock follows half a percent"
        );
        let refused = |settings: &WindowSettings| find(settings).unwrap_err();
        assert!(refused(&settings(Some("DP-7"), (1024, 768), 60)).contains("\"HDMI-1\" 1024 x 768"));
        assert!(refused(&settings(Some("HDMI-1"), (800, 600), 60)).contains("1024 x 768"));
        assert!(refused(&settings(Some("eDP-1"), (1920, 1080), 120)).contains("\"59940/1000\""));
    }

    #[test]
    fn a_window_that_no_monitor_can_hold_is_told() {
        let mut warnings = Vec::new();
        place(&settings(None, (4000, 300), 60), &two(), &mut warnings).unwrap();
        assert!(warnings[0].contains("larger than every monitor"), "{warnings:?}");
        warnings.clear();
        place(&settings(None, (800, 600), 60), &two(), &mut warnings).unwrap();
        assert!(warnings.is_empty());
    }
}
