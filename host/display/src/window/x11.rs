//! The window itself: pictures in the server's memory, when each is shown, and when somebody closes it.

use std::ffi::OsString;
use std::os::fd::OwnedFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

use dpm_device::planes::Raster;
use dpm_device::transport::TransportError;
use x11rb::connection::{Connection as _, RequestConnection as _};
use x11rb::errors::{ConnectionError, ReplyOrIdError};
use x11rb::protocol::present::{self, ConnectionExt as _};
use x11rb::protocol::screensaver::ConnectionExt as _;
use x11rb::protocol::xproto::{self, ConnectionExt as _, Gcontext, ImageFormat, Pixmap};
use x11rb::protocol::Event;
use x11rb::rust_connection::RustConnection;

use super::desk::{self, of_id, Atoms, WindowServer};
use super::WindowSettings;
use crate::encoding::{Encoding, PixelMap};
use crate::panel::PanelSettings;
use crate::scan_out::{DisplayError, Flip, PictureBuffer, Pixels, ScanOut};
use crate::transport::{Opener, PanelOutput};

/// Pictures in the server's memory beside the black one: the two of the panel, and two that the server may still read.
const PIXMAPS: usize = 4;
/// How long the server may take to map the window.
const MAP_PATIENCE: Duration = Duration::from_secs(3);
/// Interval at which the server is asked while it maps the window.
const MAP_STEP: Duration = Duration::from_millis(2);
/// A stamp that is further from this machine's clock than this is another clock's, nanoseconds.
const SAME_CLOCK_NS: i64 = 1_000_000_000;

/// The opener of a window. When somebody closes the window, `on_close` is called once, and no other window is opened.
pub fn opener(settings: WindowSettings, on_close: impl Fn() + Send + Sync + 'static) -> Opener {
    let is_closed = Arc::new(AtomicBool::new(false));
    let on_close: OnClose = Arc::new(on_close);
    Arc::new(move || {
        let name = name_of(&settings);
        if is_closed.load(Ordering::Acquire) {
            return Err(DisplayError::Closed.of(name));
        }
        let panel = panel_settings(&settings)
            .map_err(|why| TransportError::Unsuitable { device: name.clone(), why })?;
        let window = X11Window::open(&settings, is_closed.clone(), on_close.clone())
            .map_err(|e| e.of(name.clone()))?;
        let warnings = window.warnings.clone();
        Ok(PanelOutput { out: Box::new(window), panel, name, warnings })
    })
}

/// Looks whether a server is there that can show the window of `settings`, and shows none.
///
/// # Errors
/// What [`opener`] would find before it makes a window.
pub fn look(settings: &WindowSettings) -> Result<(), TransportError> {
    let name = name_of(settings);
    panel_settings(settings).map_err(|why| TransportError::Unsuitable { device: name.clone(), why })?;
    WindowServer::find(settings).map(drop).map_err(|e| e.of(name))
}

/// The window of `settings` in messages.
fn name_of(settings: &WindowSettings) -> String {
    match &settings.monitor {
        Some(monitor) => format!("window on {monitor}"),
        None => "window".into(),
    }
}

/// What the panel has to know, or why the rig file cannot be shown in a window.
fn panel_settings(settings: &WindowSettings) -> Result<PanelSettings, String> {
    let WindowSettings { raster, rate, commit_ns, .. } = *settings;
    let planes = settings.schedule.len();
    let map = PixelMap::new(Encoding::Rgb8, &settings.schedule).ok_or_else(|| {
        format!("projector.planes = {planes} are not the bits of code values; write projector.planes = 24")
    })?;
    let most_ns = rate.slot_len_ns(0) * 9 / 10;
    if commit_ns > most_ns {
        return Err(format!(
            "projector.backend.commit_us = {} leaves no time at {:.3} frames/s; write {} at most",
            commit_ns / 1000,
            rate.hz(),
            most_ns / 1000
        ));
    }
    Ok(PanelSettings { raster, planes, map, rate, lead_ns: commit_ns })
}

type OnClose = Arc<dyn Fn() + Send + Sync>;

/// A picture in the server's memory.
#[derive(Clone, Copy, Debug)]
struct StoredPicture {
    pixmap: Pixmap,
    /// The server does not read it.
    is_idle: bool,
}

/// One of the panel's two pictures.
#[derive(Debug, Default)]
struct WindowPicture {
    pixels: Vec<u8>,
    /// Its pixels were handed out after they were last sent to the server.
    is_changed: bool,
    /// Which of the stored pictures has them.
    stored: usize,
}

/// A window that shows pictures.
pub struct X11Window {
    server: RustConnection,
    id: xproto::Window,
    atoms: Atoms,
    gc: Gcontext,
    raster: Raster,
    black: Pixmap,
    stored: [StoredPicture; PIXMAPS],
    frames: [WindowPicture; 2],
    /// The number of the newest picture that was handed over, and whether it was taken.
    newest: (u32, bool),
    /// Stamps that were read and not yet passed on.
    taken: Vec<Flip>,
    is_gone: bool,
    is_closed: Arc<AtomicBool>,
    on_close: OnClose,
    warnings: Vec<String>,
}

impl X11Window {
    fn open(
        settings: &WindowSettings,
        is_closed: Arc<AtomicBool>,
        on_close: OnClose,
    ) -> Result<Self, DisplayError> {
        let WindowServer { server, screen, area, visual, atoms, warnings } = WindowServer::find(settings)?;
        let raster = settings.raster;
        let id = desk::create(&server, screen, &area, visual, &atoms, settings).map_err(of_id)?;
        let gc = server.generate_id().map_err(of_id)?;
        server.create_gc(gc, id, &xproto::CreateGCAux::new().foreground(0)).map_err(of_connection)?;
        let (width, height) = (raster.width() as u16, raster.height() as u16);
        let new_pixmap = || -> Result<Pixmap, ReplyOrIdError> {
            let pixmap = server.generate_id()?;
            server.create_pixmap(desk::DEPTH, pixmap, id, width, height)?;
            let whole = xproto::Rectangle { x: 0, y: 0, width, height };
            server.poly_fill_rectangle(pixmap, gc, &[whole])?;
            Ok(pixmap)
        };
        let black = new_pixmap().map_err(of_id)?;
        let mut stored = [StoredPicture { pixmap: black, is_idle: true }; PIXMAPS];
        for one in &mut stored {
            one.pixmap = new_pixmap().map_err(of_id)?;
        }
        let frame =
            || WindowPicture { pixels: vec![0; 4 * raster.pixel_count()], ..WindowPicture::default() };
        let frames = [frame(), WindowPicture { stored: 1, ..frame() }];
        let (newest, taken, is_gone) = ((0, true), Vec::with_capacity(PIXMAPS), false);
        let mut window = Self {
            server,
            id,
            atoms,
            gc,
            raster,
            black,
            stored,
            frames,
            newest,
            taken,
            is_gone,
            is_closed,
            on_close,
            warnings,
        };
        window.map().map_err(|e| e.unwrap_or(DisplayError::Gone))?;
        Ok(window)
    }

    /// Shows the window, and has its pictures told.
    fn map(&mut self) -> Result<(), Option<DisplayError>> {
        let (server, id) = (&self.server, self.id);
        let told = present::EventMask::COMPLETE_NOTIFY | present::EventMask::IDLE_NOTIFY;
        let lost = |_: ConnectionError| None;
        let events = server.generate_id().map_err(|_| None)?;
        server.present_select_input(events, id, told).map_err(lost)?;
        server.map_window(id).map_err(lost)?;
        // A screen that sleeps gives no blanks.
        let _ = server.screensaver_suspend(1);
        server.flush().map_err(lost)?;
        let limit = Instant::now() + MAP_PATIENCE;
        while Instant::now() < limit {
            match server.poll_for_event().map_err(lost)? {
                Some(Event::MapNotify(_)) => return Ok(()),
                Some(_) => {}
                None => std::thread::sleep(MAP_STEP),
            }
        }
        Err(Some(desk::unsuitable("does not show the window; is the desktop locked?".into())))
    }

    /// Reads what the server tells.
    fn read(&mut self) {
        loop {
            match self.server.poll_for_event() {
                Ok(Some(event)) => self.told(&event),
                Ok(None) => return,
                Err(_) => {
                    self.is_gone = true;
                    return;
                }
            }
        }
    }

    fn told(&mut self, event: &Event) {
        match event {
            Event::PresentCompleteNotify(shown) if shown.kind == present::CompleteKind::PIXMAP => {
                if shown.serial != self.newest.0 || self.newest.1 {
                    return;
                }
                self.newest.1 = true;
                let (now, stamp) = (self.now_ns(), (shown.ust as i64).saturating_mul(1000));
                // A server without stamps, or with another clock, still tells in time.
                let at_ns = if (now.saturating_sub(stamp)).abs() < SAME_CLOCK_NS { stamp } else { now };
                self.taken.push(Flip { sequence: shown.msc as u32, at_ns });
            }
            Event::PresentIdleNotify(idle) => {
                let known = self.stored.iter_mut().filter(|one| one.pixmap == idle.pixmap);
                known.for_each(|one| one.is_idle = true);
            }
            Event::DestroyNotify(gone) if gone.window == self.id => self.is_gone = true,
            Event::ClientMessage(word)
                if word.data.as_data32()[0] == self.atoms.WM_DELETE_WINDOW
                    && !self.is_closed.swap(true, Ordering::AcqRel) =>
            {
                (self.on_close)();
            }
            _ => {}
        }
    }

    /// The stored picture that has the pixels of `frame`, which are sent if they have changed.
    fn send(&mut self, frame: usize) -> Result<Pixmap, DisplayError> {
        if !self.frames[frame].is_changed {
            return Ok(self.stored[self.frames[frame].stored].pixmap);
        }
        let other = self.frames[1 - frame].stored;
        let free = (0..PIXMAPS).find(|i| *i != other && self.stored[*i].is_idle).ok_or(DisplayError::Busy)?;
        let (pixmap, pitch) = (self.stored[free].pixmap, 4 * self.raster.width() as usize);
        // A request has a greatest length: the picture goes in bands.
        let rows = (self.server.maximum_request_bytes().saturating_sub(64) / pitch).max(1);
        for (band, pixels) in self.frames[frame].pixels.chunks(rows * pitch).enumerate() {
            let (width, height) = (self.raster.width() as u16, (pixels.len() / pitch) as u16);
            let top = (band * rows) as i16;
            self.server
                .put_image(
                    ImageFormat::Z_PIXMAP,
                    pixmap,
                    self.gc,
                    width,
                    height,
                    0,
                    top,
                    0,
                    desk::DEPTH,
                    pixels,
                )
                .map_err(of_connection)?;
        }
        self.frames[frame].stored = free;
        self.frames[frame].is_changed = false;
        Ok(pixmap)
    }

    /// Has the server show `pixmap` from the next blank on.
    fn present(&mut self, pixmap: Pixmap) -> Result<(), ConnectionError> {
        let serial = self.newest.0.wrapping_add(1);
        let none = x11rb::NONE;
        self.server.present_pixmap(
            self.id,
            pixmap,
            serial,
            none,
            none,
            0,
            0,
            none,
            none,
            none,
            0,
            0,
            0,
            0,
            &[],
        )?;
        self.server.flush()?;
        self.newest = (serial, false);
        for one in self.stored.iter_mut().filter(|one| one.pixmap == pixmap) {
            one.is_idle = false;
        }
        Ok(())
    }
}

fn of_connection(_: ConnectionError) -> DisplayError {
    DisplayError::Gone
}

impl ScanOut for X11Window {
    fn pixels(&mut self, frame: usize) -> Pixels<'_> {
        let frame = &mut self.frames[frame];
        frame.is_changed = true;
        Pixels { bytes: &mut frame.pixels, pitch: 4 * self.raster.width() as usize }
    }

    fn flip(&mut self, picture: PictureBuffer) -> Result<(), DisplayError> {
        self.read();
        if let Some(why) = self.lost() {
            return Err(why);
        }
        if !self.newest.1 {
            return Err(DisplayError::Busy);
        }
        let pixmap = match picture {
            PictureBuffer::Black => self.black,
            PictureBuffer::Frame(frame) => self.send(frame)?,
        };
        self.present(pixmap).map_err(of_connection)
    }

    fn flips(&mut self, sink: &mut dyn FnMut(Flip)) {
        self.read();
        self.taken.drain(..).for_each(sink);
    }

    fn lost(&mut self) -> Option<DisplayError> {
        self.read();
        if self.is_closed.load(Ordering::Acquire) {
            return Some(DisplayError::Closed);
        }
        self.is_gone.then_some(DisplayError::Gone)
    }

    fn now_ns(&self) -> i64 {
        let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
        now.tv_sec.saturating_mul(1_000_000_000).saturating_add(now.tv_nsec)
    }

    fn blacken(&mut self) {
        // A picture that waits for its blank would follow: the black one is handed over behind it.
        let _ = self.present(self.black);
        let (width, height) = (self.raster.width() as u16, self.raster.height() as u16);
        let whole = xproto::Rectangle { x: 0, y: 0, width, height };
        let _ = self.server.poly_fill_rectangle(self.id, self.gc, &[whole]);
        let _ = self.server.flush();
    }

    fn guarded(&self) -> Option<(OwnedFd, Vec<OsString>)> {
        // The server takes the window away when this program is gone.
        None
    }
}
