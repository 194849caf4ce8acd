//! Mode setting by the kernel's DRM: the real [`Kms`].
//!
//! The start is one atomic commit with mode and properties; pictures are handed over by page flips, which an atomic driver
//! turns into the same commit of one plane, and which need no memory.

use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use drm::buffer::{Buffer, DrmFourcc};
use drm::control::atomic::AtomicModeReq;
use drm::control::connector::{Interface, State};
use drm::control::dumbbuffer::{DumbBuffer, DumbMapping};
use drm::control::property::ValueType;
use drm::control::{
    connector, crtc, framebuffer, plane, AtomicCommitFlags, Device as ControlDevice, Event, Mode,
    PageFlipFlags, ResourceHandle,
};
use drm::{ClientCapability, Device, DriverCapability};

use crate::kms::{Connector, Domain, Kms, Property, PropertyOwner, ScanOutSetup};
use crate::mode::Timing;
use crate::scan_out::{DisplayError, Flip, PictureBuffer, Pixels, ScanOut};

mod find;
mod guard;

pub use find::{cards, connector_names, connector_names_of, look_for, open_for};
pub use guard::{let_go, show_black};

use find::path_of;

/// How long another program may need to let go of the displays.
const MASTER_PATIENCE: Duration = Duration::from_millis(1500);
/// How long a way out waits for the kernel to take the black picture.
const BLACK_PATIENCE: Duration = Duration::from_millis(200);
/// Interval of such attempts.
const STEP: Duration = Duration::from_millis(1);

/// The descriptor of a graphics card, with the kernel's calls of the crate drm.
#[derive(Debug)]
pub struct CardDescriptor(pub OwnedFd);

impl AsFd for CardDescriptor {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

impl Device for CardDescriptor {}
impl ControlDevice for CardDescriptor {}

impl CardDescriptor {
    /// The numbers and names of the connectors that this descriptor sees.
    fn connector_names(&self) -> Vec<(u32, String)> {
        let Ok(resources) = self.resource_handles() else { return Vec::new() };
        let known = |handle: &connector::Handle| self.get_connector(*handle, false).ok();
        let infos = resources.connectors().iter().filter_map(known);
        infos.map(|info| (info.handle().into(), info.to_string())).collect()
    }

    /// True while this descriptor, which is a lease, is one: the lender has not taken it back, and drives the card.
    fn is_lent(&self) -> bool {
        drm_ffi::mode::get_lease(self.as_fd(), None).is_ok_and(|lease| lease.count_objects > 0)
    }
}

/// The objects that drive a connector.
#[derive(Clone, Copy)]
struct Route {
    connector: connector::Handle,
    crtc: crtc::Handle,
    plane: plane::Handle,
}

/// A picture in the display's memory.
struct Memory {
    buffer: DumbBuffer,
    framebuffer: framebuffer::Handle,
    map: DumbMapping<'static>,
}

/// What is scanned out.
struct ScanOutput {
    route: Route,
    /// Black, and the two for frames.
    pictures: [Memory; 3],
    mode_blob: u64,
    /// `/sys/class/drm/card0-HDMI-A-1/status`, which tells without asking the display.
    status: Option<File>,
}

/// A graphics card, or the part of it that its owner has lent.
pub struct Card {
    node: CardDescriptor,
    path: PathBuf,
    output: Option<ScanOutput>,
    /// Who lent it.
    lender: Option<String>,
}

fn call(doing: &'static str) -> impl Fn(io::Error) -> DisplayError {
    move |source| match source.raw_os_error() {
        Some(libc::ENODEV | libc::ENXIO) => DisplayError::Gone,
        _ => DisplayError::Call { doing, source },
    }
}

impl Card {
    /// Opens the card at `path` and takes its displays.
    ///
    /// # Errors
    /// No such card, no right to open it, another program that drives its displays, or a driver without atomic mode
    /// setting or monotonic stamps.
    pub fn open(path: &Path) -> Result<Self, DisplayError> {
        let limit = Instant::now() + MASTER_PATIENCE;
        loop {
            // Whoever opens a card that nobody drives may drive it; without special rights only then.
            let card = Self::look(path)?;
            if card.node.acquire_master_lock().is_ok() {
                return Ok(card);
            }
            if Instant::now() >= limit {
                return Err(DisplayError::InUse(card.name()));
            }
            drop(card);
            std::thread::sleep(STEP.saturating_mul(20));
        }
    }

    /// Opens the card at `path` to look at it, whoever drives its displays.
    ///
    /// # Errors
    /// As [`Card::open`], except for another program.
    pub fn look(path: &Path) -> Result<Self, DisplayError> {
        let name = path.display().to_string();
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .custom_flags(libc::O_NONBLOCK | libc::O_CLOEXEC)
            .open(path)
            .map_err(|e| match e.kind() {
                io::ErrorKind::NotFound => DisplayError::NoCard(name.clone()),
                io::ErrorKind::PermissionDenied => DisplayError::Denied(name.clone()),
                _ => DisplayError::Call { doing: "open the graphics card", source: e },
            })?;
        Self::of(CardDescriptor(file.into()), path.into(), None)
    }

    /// Takes the lease `descriptor`, which `lender` has given: a card with one connector and what drives it. It is given
    /// back with the last duplicate of the descriptor.
    ///
    /// # Errors
    /// The descriptor is none of a graphics card, or as [`Card::open`].
    pub fn lent(descriptor: OwnedFd, lender: String) -> Result<Self, DisplayError> {
        let prepare = || {
            // These are the lender's choice at first. Reading events must never wait, and no program that this one starts may
            // keep the lease but the guardian, which gets its own.
            let flags = rustix::fs::fcntl_getfl(&descriptor)?;
            rustix::fs::fcntl_setfl(&descriptor, flags | rustix::fs::OFlags::NONBLOCK)?;
            rustix::io::fcntl_setfd(&descriptor, rustix::io::FdFlags::CLOEXEC)
        };
        prepare().map_err(|e| call("use the lease")(e.into()))?;
        let path = path_of(&descriptor);
        Self::of(CardDescriptor(descriptor), path, Some(lender))
    }

    /// False if this card is a lease that its owner has taken back.
    pub fn is_still_lent(&self) -> bool {
        self.lender.is_none() || self.node.is_lent()
    }

    /// The names of the connectors that this card has, or that were lent.
    pub fn connector_names(&self) -> Vec<String> {
        self.node.connector_names().into_iter().map(|(_, name)| name).collect()
    }

    /// A card by its descriptor, which sees everything that atomic mode setting needs from now on.
    fn of(node: CardDescriptor, path: PathBuf, lender: Option<String>) -> Result<Self, DisplayError> {
        let name = path.display().to_string();
        let unsuitable = |what: &str| DisplayError::Unsuitable { card: name.clone(), what: what.into() };
        let atomic = node.set_client_capability(ClientCapability::UniversalPlanes, true);
        if atomic.and_then(|()| node.set_client_capability(ClientCapability::Atomic, true)).is_err() {
            return Err(unsuitable(
                "its driver has no atomic mode setting; for NVIDIA's, set nvidia-drm.modeset=1 on the kernel's command line",
            ));
        }
        if node.get_driver_capability(DriverCapability::MonotonicTimestamp).unwrap_or(0) == 0 {
            return Err(unsuitable("its driver does not stamp with the monotonic clock; use a newer kernel"));
        }
        if node.get_driver_capability(DriverCapability::DumbBuffer).unwrap_or(0) == 0 {
            return Err(unsuitable("its driver has no plain buffers to scan out; use another card"));
        }
        Ok(Self { node, path, output: None, lender })
    }

    /// True if a program drives this card's displays, this one included.
    pub fn is_in_use(&self) -> bool {
        match self.node.acquire_master_lock() {
            Ok(()) => self.node.release_master_lock().is_err(),
            Err(_) => true,
        }
    }

    /// What drives `connector`: its present CRTC or the first possible one, and a primary plane for it.
    fn route(&self, info: &connector::Info) -> Result<Option<Route>, DisplayError> {
        let resources = self.node.resource_handles().map_err(call("list the card's resources"))?;
        let mut crtcs = Vec::new();
        for encoder in info.current_encoder().into_iter().chain(info.encoders().iter().copied()) {
            let Ok(encoder) = self.node.get_encoder(encoder) else { continue };
            crtcs.extend(encoder.crtc());
            crtcs.extend(resources.filter_crtcs(encoder.possible_crtcs()));
        }
        let planes = self.node.plane_handles().map_err(call("list the card's planes"))?;
        for crtc in crtcs {
            for plane in &planes {
                let Ok(about) = self.node.get_plane(*plane) else { continue };
                let fits = resources.filter_crtcs(about.possible_crtcs()).contains(&crtc)
                    && about.crtc().is_none_or(|now| now == crtc);
                let is_primary = self.property(*plane, "type").is_some_and(|(_, _, value)| value == 1);
                if fits && is_primary {
                    return Ok(Some(Route { connector: info.handle(), crtc, plane: *plane }));
                }
            }
        }
        Ok(None)
    }

    /// A property of an object by its name: its handle, what it takes, and its value.
    fn property<T: ResourceHandle>(
        &self,
        object: T,
        name: &str,
    ) -> Option<(drm::control::property::Handle, drm::control::property::Info, u64)> {
        let all = self.node.get_properties(object).ok()?;
        let (handles, values) = all.as_props_and_values();
        handles.iter().zip(values).find_map(|(handle, value)| {
            let info = self.node.get_property(*handle).ok()?;
            (info.name().to_bytes() == name.as_bytes()).then_some((*handle, info, *value))
        })
    }

    fn properties<T: ResourceHandle>(&self, object: T, owner: PropertyOwner, out: &mut Vec<Property>) {
        let Ok(all) = self.node.get_properties(object) else { return };
        let (handles, values) = all.as_props_and_values();
        for (handle, value) in handles.iter().zip(values) {
            let Ok(info) = self.node.get_property(*handle) else { continue };
            let domain = match info.value_type() {
                ValueType::UnsignedRange(low, high) => Domain::Range(*low, *high),
                ValueType::Boolean => Domain::Range(0, 1),
                // Sets of bits by number: which bits there are, the driver checks.
                ValueType::Bitmask => Domain::Range(0, u64::MAX),
                ValueType::Enum(words) => {
                    let (_, enums) = words.values();
                    Domain::Words(
                        enums.iter().map(|e| (e.name().to_string_lossy().into_owned(), e.value())).collect(),
                    )
                }
                ValueType::Blob => Domain::Blob,
                _ => Domain::Other,
            };
            let name = info.name().to_string_lossy().into_owned();
            out.push(Property { owner, name, domain, is_mutable: info.mutable(), value: *value });
        }
    }

    fn memory(&self, (width, height): (u32, u32)) -> Result<Memory, DisplayError> {
        let made = call("make a picture in the display's memory");
        let buffer = self.node.create_dumb_buffer((width, height), DrmFourcc::Xrgb8888, 32).map_err(&made)?;
        let framebuffer = self.node.add_framebuffer(&buffer, 24, 32).map_err(&made)?;
        // The mapping borrows the description of its buffer, some bytes, for as long as it lives: for ever here, once per
        // start of the scan-out. The picture itself is given back.
        let mut map = self.node.map_dumb_buffer(Box::leak(Box::new(buffer))).map_err(&made)?;
        map.fill(0);
        Ok(Memory { buffer, framebuffer, map })
    }

    fn release(&mut self) {
        let Some(output) = self.output.take() else { return };
        let _ = self.node.destroy_property_blob(output.mode_blob);
        for Memory { buffer, framebuffer, map } in output.pictures {
            drop(map);
            let _ = self.node.destroy_framebuffer(framebuffer);
            let _ = self.node.destroy_dumb_buffer(buffer);
        }
    }

    /// The commit that starts scan-out. A property that an object lacks is an error, because the plan has seen it.
    fn request(
        &self,
        route: Route,
        setup: &ScanOutSetup,
        mode_blob: u64,
        black: framebuffer::Handle,
    ) -> Result<AtomicModeReq, DisplayError> {
        let mut request = AtomicModeReq::new();
        let (width, height) = setup.timing.size();
        let (width, height) = (u64::from(width), u64::from(height));
        let crtc = u64::from(u32::from(route.crtc));
        self.set(&mut request, route.connector, "CRTC_ID", crtc)?;
        self.set(&mut request, route.crtc, "MODE_ID", mode_blob)?;
        self.set(&mut request, route.crtc, "ACTIVE", 1)?;
        for (name, value) in [
            ("FB_ID", u64::from(u32::from(black))),
            ("CRTC_ID", crtc),
            ("SRC_X", 0),
            ("SRC_Y", 0),
            ("SRC_W", width << 16),
            ("SRC_H", height << 16),
            ("CRTC_X", 0),
            ("CRTC_Y", 0),
            ("CRTC_W", width),
            ("CRTC_H", height),
        ] {
            self.set(&mut request, route.plane, name, value)?;
        }
        for (owner, name, value) in &setup.properties {
            match owner {
                PropertyOwner::Connector => self.set(&mut request, route.connector, name, *value)?,
                PropertyOwner::Crtc => self.set(&mut request, route.crtc, name, *value)?,
                PropertyOwner::Plane => self.set(&mut request, route.plane, name, *value)?,
            }
        }
        // Nothing else may lie over the picture: cursors and overlays of whoever was here before.
        for other in self.node.plane_handles().map_err(call("list the card's planes"))? {
            let is_over = self.node.get_plane(other).is_ok_and(|about| about.crtc() == Some(route.crtc));
            if other != route.plane && is_over {
                self.set(&mut request, other, "FB_ID", 0)?;
                self.set(&mut request, other, "CRTC_ID", 0)?;
            }
        }
        Ok(request)
    }

    fn set<T: ResourceHandle + Copy>(
        &self,
        request: &mut AtomicModeReq,
        object: T,
        name: &str,
        value: u64,
    ) -> Result<(), DisplayError> {
        let Some((handle, ..)) = self.property(object, name) else {
            let what = format!("its driver has no property {name:?}; use another card or a newer kernel");
            return Err(DisplayError::Unsuitable { card: self.name(), what });
        };
        request.add_raw_property(object.into(), handle, value);
        Ok(())
    }

    fn find(&self, name: &str) -> Result<connector::Info, DisplayError> {
        let resources = self.node.resource_handles().map_err(call("list the card's resources"))?;
        let all = resources.connectors().iter().filter_map(|c| self.node.get_connector(*c, false).ok());
        all.into_iter().find(|info| info.to_string() == name).ok_or(DisplayError::Gone)
    }

    fn show(
        &self,
        crtc: crtc::Handle,
        picture: framebuffer::Handle,
        flags: PageFlipFlags,
    ) -> Result<(), DisplayError> {
        self.node.page_flip(crtc, picture, flags, None).map_err(|e| match e.raw_os_error() {
            Some(libc::EBUSY) => DisplayError::Busy,
            // The objects of a lease are not there for those from whom it was taken. Its owner may have lost the card, too.
            Some(libc::ENOENT | libc::EACCES | libc::EPERM) if self.lender.is_some() => DisplayError::Revoked,
            // What is gone is refused in several ways.
            Some(libc::ENODEV | libc::ENXIO | libc::EINVAL | libc::EACCES | libc::EPERM) => {
                DisplayError::Gone
            }
            _ => DisplayError::Call { doing: "hand over a picture", source: e },
        })
    }
}

fn timing_of(mode: &Mode) -> Timing {
    let ((width, height), h, v) = (mode.size(), mode.hsync(), mode.vsync());
    Timing {
        clock_khz: mode.clock(),
        row: [width, h.0, h.1, h.2],
        frame: [height, v.0, v.1, v.2],
        flags: mode.flags().bits(),
    }
}

fn mode_of(timing: &Timing) -> drm_ffi::drm_mode_modeinfo {
    let mut name = [0; 32];
    for (place, byte) in name.iter_mut().zip(timing.to_string().bytes().take(31)) {
        *place = byte as std::ffi::c_char;
    }
    drm_ffi::drm_mode_modeinfo {
        clock: timing.clock_khz,
        hdisplay: timing.row[0],
        hsync_start: timing.row[1],
        hsync_end: timing.row[2],
        htotal: timing.row[3],
        vdisplay: timing.frame[0],
        vsync_start: timing.frame[1],
        vsync_end: timing.frame[2],
        vtotal: timing.frame[3],
        vrefresh: timing.rate().map_or(0, |rate| rate.hz().round() as u32),
        flags: timing.flags,
        name,
        ..Default::default()
    }
}

impl Kms for Card {
    fn name(&self) -> String {
        self.path.display().to_string()
    }

    fn connectors(&mut self) -> Result<Vec<Connector>, DisplayError> {
        let resources = self.node.resource_handles().map_err(call("list the card's resources"))?;
        let mut all = Vec::new();
        for handle in resources.connectors() {
            let Ok(info) = self.node.get_connector(*handle, true) else { continue };
            if info.interface() == Interface::Writeback {
                continue;
            }
            let mut properties = Vec::new();
            self.properties(*handle, PropertyOwner::Connector, &mut properties);
            if let Some(route) = self.route(&info)? {
                self.properties(route.crtc, PropertyOwner::Crtc, &mut properties);
                self.properties(route.plane, PropertyOwner::Plane, &mut properties);
            }
            all.push(Connector {
                name: info.to_string(),
                is_virtual: info.interface() == Interface::Virtual,
                is_connected: info.state() == State::Connected,
                modes: info.modes().iter().map(timing_of).collect(),
                properties,
            });
        }
        Ok(all)
    }

    fn start(&mut self, setup: &ScanOutSetup) -> Result<(), DisplayError> {
        self.release();
        let info = self.find(&setup.connector)?;
        let route = self.route(&info)?.ok_or_else(|| DisplayError::Unsuitable {
            card: self.name(),
            what: format!(
                "{} has no free CRTC with a primary plane; unplug another display",
                setup.connector
            ),
        })?;
        let size = setup.timing.size();
        let pictures = [self.memory(size)?, self.memory(size)?, self.memory(size)?];
        let blob = self
            .node
            .create_property_blob(&mode_of(&setup.timing))
            .map_err(call("describe the mode to the kernel"))?;
        let mode_blob = u64::from(blob);
        let black = pictures[0].framebuffer;
        let class = self.path.file_name().map(|card| card.to_string_lossy().into_owned()).unwrap_or_default();
        let status = File::open(format!("/sys/class/drm/{class}-{}/status", setup.connector)).ok();
        self.output = Some(ScanOutput { route, pictures, mode_blob, status });
        let request = self.request(route, setup, mode_blob, black)?;
        let test = AtomicCommitFlags::TEST_ONLY | AtomicCommitFlags::ALLOW_MODESET;
        self.node
            .atomic_commit(test, request.clone())
            .map_err(call("set the mode with these properties (the driver refuses them together)"))?;
        let set = self.node.atomic_commit(AtomicCommitFlags::ALLOW_MODESET, request);
        // A lease that is used again may still hold events of the pictures before.
        let _ = self.node.receive_events().map(Iterator::count);
        set.map_err(call("set the mode"))
    }

    fn lender(&self) -> Option<&str> {
        self.lender.as_deref()
    }
}

impl ScanOut for Card {
    fn pixels(&mut self, frame: usize) -> Pixels<'_> {
        let output = self.output.as_mut().expect("started");
        let memory = &mut output.pictures[1 + frame];
        let pitch = memory.buffer.pitch() as usize;
        Pixels { bytes: &mut memory.map, pitch }
    }

    fn flip(&mut self, picture: PictureBuffer) -> Result<(), DisplayError> {
        let output = self.output.as_ref().ok_or(DisplayError::Gone)?;
        let index = match picture {
            PictureBuffer::Black => 0,
            PictureBuffer::Frame(frame) => 1 + frame,
        };
        self.show(output.route.crtc, output.pictures[index].framebuffer, PageFlipFlags::EVENT)
    }

    fn flips(&mut self, sink: &mut dyn FnMut(Flip)) {
        // Without an event the descriptor, which never waits, answers EAGAIN.
        let Ok(events) = self.node.receive_events() else { return };
        let crtc = self.output.as_ref().map(|output| output.route.crtc);
        for event in events {
            if let Event::PageFlip(flip) = event {
                if Some(flip.crtc) == crtc {
                    let at_ns = i64::try_from(flip.duration.as_nanos()).unwrap_or(i64::MAX);
                    sink(Flip { sequence: flip.frame, at_ns });
                }
            }
        }
    }

    fn lost(&mut self) -> Option<DisplayError> {
        let mut word = [0; 16];
        let is_connected = match self.output.as_ref().and_then(|output| output.status.as_ref()) {
            Some(status) => {
                matches!(status.read_at(&mut word, 0), Ok(n) if !word[..n].starts_with(b"disconnected"))
            }
            None => true,
        };
        if !is_connected {
            return Some(DisplayError::Gone);
        }
        (!self.is_still_lent()).then_some(DisplayError::Revoked)
    }

    fn now_ns(&self) -> i64 {
        let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
        now.tv_sec.saturating_mul(1_000_000_000).saturating_add(now.tv_nsec)
    }

    fn blacken(&mut self) {
        let Some(output) = self.output.as_ref() else { return };
        let limit = Instant::now() + BLACK_PATIENCE;
        while let Err(DisplayError::Busy) =
            self.show(output.route.crtc, output.pictures[0].framebuffer, PageFlipFlags::empty())
        {
            if Instant::now() >= limit {
                break;
            }
            std::thread::sleep(STEP);
        }
    }

    fn guarded(&self) -> Option<(OwnedFd, Vec<OsString>)> {
        let output = self.output.as_ref()?;
        let descriptor = self.node.0.try_clone().ok()?;
        let number = |n: u32| OsString::from(n.to_string());
        let arguments = vec![
            OsString::from("--crtc"),
            number(output.route.crtc.into()),
            OsString::from("--black"),
            number(output.pictures[0].framebuffer.into()),
        ];
        Some((descriptor, arguments))
    }
}

impl Drop for Card {
    fn drop(&mut self) {
        self.blacken();
        self.release();
    }
}
